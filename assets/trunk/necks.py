"""Find how stiff the trunk's grooves are, and the necks with which coarse quadratic elements are as stiff.

    python assets/trunk/necks.py

A groove is looked at from the middle of one disc to the middle of the next (the first from the clamp), these planes
held rigid, at small strains. Its converged stiffness comes from biquadratic axisymmetric elements, graded into the
bottom of the groove, with displacements that vary as the cosine of the angle about the axis (bending, shear) or not at
all (torsion, axial). The radius of the neck of ``meshing.round_trunk`` is then chosen so that the bending stiffness of
its elements is the same; ``ROUND`` in ``softwarp/meshing/trunk_geometry.py`` holds the shares that are printed.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.sparse import coo_array, csr_array
from scipy.sparse.linalg import splu

import softwarp as sw
from softwarp.meshing import revolve
from softwarp.meshing import trunk_geometry as trunk

YOUNGS, NU = 450.0e3, 0.45
MODES = ("bending [N m/rad]", "torsion [N m/rad]", "axial [N/m]", "shear [N/m]")
FLANK, RADIUS, GRADE, PARTS = 10, 8, 1.6, 3  # graded layers of a flank and rings, their ratio, cuts of each
Array = NDArray[np.float64]


def outline(groove: int, share: float = 1.0) -> list[tuple[float, float]]:
    """(radius, z) [m] from the middle of the disc below to that of the disc above."""
    below, above = trunk.rims(groove)
    middle = trunk.NECK_Z[groove]
    neck = (share * trunk.NECK_RADIUS[groove], middle)
    ends = [(trunk.BASE_RADIUS + trunk.TAPER * z, z) for z in (middle - trunk.PITCH / 2, middle + trunk.PITCH / 2)]
    low = [(trunk.BASE_RADIUS + trunk.TAPER * trunk.CLAMP, trunk.CLAMP)] if groove == 0 else [ends[0], below]
    return [*low, neck, above, ends[1]]


def graded(count: int) -> Array:
    """Places from 0 to 1 whose steps grow by ``GRADE``, each cut into ``PARTS``."""
    widths = np.repeat(GRADE ** np.arange(count), PARTS) / PARTS
    return np.concatenate([[0.0], np.cumsum(widths)]) / widths.sum()


def with_middles(places: Array) -> Array:
    """Places and the middles between them, in turn."""
    return np.interp(np.arange(2 * len(places) - 1) / 2.0, np.arange(len(places)), places)


def converged(groove: int) -> Array:
    """Stiffness of a groove in the four ``MODES``."""
    corners, even = np.array(outline(groove)), np.linspace(0.0, 1.0, 4 * PARTS + 1)
    sides = [even] * (len(corners) == 5) + [1.0 - graded(FLANK)[::-1], graded(FLANK), even]
    sides = [side + number for number, side in enumerate(sides)]
    stations = with_middles(np.unique(np.concatenate(sides)))
    skin = [np.interp(stations, np.arange(len(corners)), column) for column in corners.T]
    ring = with_middles(1.0 - graded(RADIUS)[::-1])
    points = np.stack([np.outer(skin[0], ring).ravel(), np.repeat(skin[1], len(ring))], axis=1)
    node = np.arange(len(points)).reshape(len(stations), len(ring))
    cut = [node[i : len(stations) - 2 + i : 2, j : len(ring) - 2 + j : 2] for i in range(3) for j in range(3)]
    elements = np.stack([part.ravel() for part in cut], axis=1)
    (bending, shear), (torsion, axial) = (
        harmonic(points, elements, node, is_cosine, trunk.NECK_Z[groove]) for is_cosine in (True, False)
    )
    return np.array([bending, torsion, axial, shear])


def harmonic(points: Array, elements: NDArray[np.int64], node: NDArray[np.int64], cosine: bool, neck: float) -> Array:
    """Stiffness in two modes of displacements (u cos, v sin, w cos) of the angle, or (u, v, w), along r, angle, z."""
    lame, shear = YOUNGS * NU / ((1.0 + NU) * (1.0 - 2.0 * NU)), YOUNGS / (2.0 * (1.0 + NU))
    elastic = np.diag([2.0 * shear] * 3 + [shear] * 3)
    elastic[:3, :3] += lame
    place, weight = np.polynomial.legendre.leggauss(3)
    blocks = np.zeros((len(elements), 27, 27))
    for s, ws in zip(place, weight, strict=True):
        for t, wt in zip(place, weight, strict=True):
            shape = np.outer(*[[x * (x - 1.0) / 2.0, 1.0 - x * x, x * (x + 1.0) / 2.0] for x in (s, t)]).ravel()
            one, other = ([x * (x - 1.0) / 2.0, 1.0 - x * x, x * (x + 1.0) / 2.0] for x in (s, t))
            along = np.outer([s - 0.5, -2.0 * s, s + 0.5], other).ravel()
            across = np.outer(one, [t - 0.5, -2.0 * t, t + 0.5]).ravel()
            slopes = np.stack([across, along])
            jacobian = np.einsum("ak,ekc->eac", slopes, points[elements])
            dr, dz = np.moveaxis(np.linalg.solve(jacobian, np.broadcast_to(slopes, (len(elements), 2, 9))), 1, 0)
            radius = points[elements][:, :, 0] @ shape
            hoop = shape / radius[:, None]
            strain = np.zeros((len(elements), 6, 27))  # rr, angle, zz, rz, r angle, z angle
            u, v, w = slice(0, 27, 3), slice(1, 27, 3), slice(2, 27, 3)
            strain[:, 0, u], strain[:, 1, u], strain[:, 2, w] = dr, hoop, dz
            strain[:, 3, u], strain[:, 3, w], strain[:, 4, v], strain[:, 5, v] = dz, dr, dr - hoop, dz
            if cosine:
                strain[:, 1, v], strain[:, 4, u], strain[:, 5, w] = hoop, -hoop, -hoop
            volume = (np.pi if cosine else 2.0 * np.pi) * ws * wt * np.abs(np.linalg.det(jacobian)) * radius
            blocks += volume[:, None, None] * np.einsum("epi,pq,eqj->eij", strain, elastic, strain, optimize=True)
    freedom = (3 * elements[:, :, None] + np.arange(3)).reshape(len(elements), 27)
    rows, columns = np.repeat(freedom, 27, axis=1).ravel(), np.tile(freedom, (1, 27)).ravel()
    size = 3 * len(points)
    matrix = csr_array(coo_array((blocks.ravel(), (rows, columns)), shape=(size, size)))

    bottom, top, axis = node[0], node[-1], node[1:-1, 0]
    held = [np.concatenate([3 * end + k for end in (bottom, top) for k in range(3)])]
    if cosine:  # on the axis v = -u, w = 0
        tie, sign = np.arange(size), np.ones(size)
        tie[3 * axis + 1], sign[3 * axis + 1] = 3 * axis, -1.0
        tied = csr_array(coo_array((sign, (np.arange(size), tie)), shape=(size, size)))
        matrix = csr_array(tied.T @ matrix @ tied)
        held += [3 * axis + 1, 3 * axis + 2]
    else:
        held += [3 * axis, 3 * axis + 1]
    motion = np.zeros((size, 2))
    r, z = points[top, 0], points[top, 1] - neck
    if cosine:  # a turn about the middle of the neck; a shift across
        motion[3 * top, 0], motion[3 * top + 1, 0], motion[3 * top + 2, 0] = z, -z, -r
        motion[3 * top, 1], motion[3 * top + 1, 1] = 1.0, -1.0
    else:  # a turn about the axis; a shift along it
        motion[3 * top + 1, 0], motion[3 * top + 2, 1] = r, 1.0
    return stiffness(matrix, np.setdiff1d(np.arange(size), np.concatenate(held)), motion)


def stiffness(matrix: csr_array, free: NDArray[np.int64], motion: Array) -> Array:
    """Twice the energies of motions (unknown, mode) of what is held, the rest in equilibrium."""
    factor = splu(matrix[free][:, free].tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    moved = motion.copy()
    moved[free] -= factor.solve((matrix @ motion)[free])
    return np.asarray(np.einsum("ik,ik->k", moved, matrix @ moved))


def coarse(groove: int, detail: str, share: float) -> Array:
    """Stiffness of a groove of ``meshing.round_trunk`` in the four ``MODES``."""
    sectors, parts, _ = trunk.ROUND[detail]
    mesh = revolve(trunk.divided(outline(groove, share), 2 * parts), sectors=sectors, start=0.5 * np.pi)
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_tets(mesh, material=sw.Corotational(YOUNGS, NU, method="warped"), density=1000.0)
    simulation = sw.Simulation(builder.finalize(1, "cpu", "float64"))
    x = mesh.nodes
    top, bottom = (np.flatnonzero(x[:, 2] == extreme) for extreme in (x[:, 2].max(), x[:, 2].min()))
    held = (3 * np.concatenate([top, bottom])[:, None] + np.arange(3)).ravel()
    away = x[top] - [0.0, 0.0, trunk.NECK_Z[groove]]
    motion = np.zeros((x.size, 6))
    modes = [np.cross(axis, away) for axis in np.eye(3)] + [np.tile(axis, (len(top), 1)) for axis in np.eye(3)]
    motion[(3 * top[:, None] + np.arange(3)).ravel()] = np.stack([mode.ravel() for mode in modes], axis=1)
    found = stiffness(csr_array(simulation.stiffness_matrix()), np.setdiff1d(np.arange(x.size), held), motion)
    return np.array([found[:2].mean(), found[2], found[5], found[3:5].mean()])  # of both axes across


def main() -> None:
    """Print stiffness and shares of all grooves."""
    print("groove, converged " + ", ".join(MODES))
    target = [converged(groove) for groove in range(len(trunk.NECK_Z))]
    for groove, values in enumerate(target):
        print(groove, *(f"{value:.4g}" for value in values))
    for detail in trunk.ROUND:
        shares = []
        for groove, values in enumerate(target):
            low = 0.45 if detail == "coarse" else 0.6
            share = brentq(lambda s: coarse(groove, detail, s)[0] - values[0], low, 0.9, xtol=1e-4)  # noqa: B023
            shares.append(round(share, 3))
            print(detail, groove, f"{share:.3f}", np.round(coarse(groove, detail, share) / values, 2))
        print(detail, tuple(shares))


if __name__ == "__main__":
    main()
