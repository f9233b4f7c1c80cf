"""Fits STIFFNESS of softwarp/meshing/finger_bricks.py: numerical coarsening of the gripper's finger.

    python assets/gripper/coarsen.py fit     # factors, and errors under all loads
    python assets/gripper/coarsen.py truth   # renews converged.csv and pulled.csv; pip install pypardiso first

Hexahedra are cut from the grid of the tetrahedra, every cell into equal parts along its axes. Where cavities have
corners and walls fold, strains have no bound: ways converge with the 1.06th power of the cells' size (a notch of 80
degrees), which two sizes and the power tell the limit of. Loads that are small are weights, pulls at the ends of cables
and pushes on palms, in the finger's plane and out of it; large ones are pulls of the cable. All are spread over some
millimetres, about the points of bricks that take them, since there is no limit under a point.

Reference: Kharevych, Mullen, Owhadi, Desbrun (2009), Numerical coarsening of inhomogeneous elastic materials.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.sparse.linalg import splu

from softwarp.meshing import embed, finger_bricks, finger_geometry
from softwarp.meshing.hexes import SIGNS, node_volumes
from softwarp.plan import hexes as plan

Floats = NDArray[np.float64]
HERE = Path(__file__).parent
YOUNGS, NU = 20.0e6, 0.48
MU, LAM = 0.5 * YOUNGS / (1.0 + NU), YOUNGS * NU / (1.0 + NU) / (1.0 - 2.0 * NU)
ORDER = 1.06  # in which ways converge
FINE, BENT = (4, 6), (3, 4)  # parts of an edge of a cell, for small loads and for large ones
SPREAD = 0.004  # m, over which loads are spread
TIP, MIDDLE = (0.0865, 0.003, 0.0), (0.0215, -0.011, 0.0)  # m, what is looked at
END, PALM, PHALANX = (0.077, -0.011, 0.0), (0.074, -0.015, 0.0), (0.0215, -0.015, 0.0)  # m, what is pulled or pushed
GUIDE, ROOT = (0.0325, -0.0115, 0.0), (0.0135, -0.011, 0.0)
SIDE, END_SIDE, GUIDE_SIDE = (0.07, -0.008, 0.0045), (0.077, -0.011, 0.0045), (0.0275, -0.0115, 0.0045)
SMALL = ("weight y", "weight x", "end", "palm", "phalanx", "guide", "weight z", "end sideways", "twist")
TENSIONS = (6.0, 12.0, 24.0, 36.0, 48.0)  # N
PULL_STEP = 4.0  # N, between equilibria that are looked at
FARTHER = 1.74  # as far as from 3 to 4 parts it is from there to the limit, for small pulls at the end of the cable
ITERATIONS = 60
PRIOR, DOUBT = -0.3, 0.03  # logarithm of factors that nothing tells, and how much it counts
LENGTHS = (2.5, 5.0, 10.0, 15.0, 20.0)  # mm of cable


class Finger:
    """A finger of hexahedra, the flange held, in float64: forces, tangents, ways under small loads and large pulls.

    Args:
        nodes: Positions [m].
        hexes: Corners.
        symmetry: "whole", or the half with z above 0, that moves as its "mirror" image or "against" it.
    """

    def __init__(self, nodes: Floats, hexes: NDArray[np.int64], symmetry: str) -> None:
        self.rest, self.hexes, self.symmetry, self.factors = nodes, hexes, symmetry, np.ones(len(hexes))
        groups = np.array_split(hexes, max(1, len(hexes) // 2000))
        self.stiffness = np.concatenate([_stiffness(nodes[group]) for group in groups])
        self.gradients = _mean_gradients(nodes[hexes])
        self.volumes = np.bincount(hexes.ravel(), node_volumes(nodes, hexes).ravel(), minlength=len(nodes))
        held = np.repeat(nodes[:, :1] < finger_geometry.FLANGE[1] + 1e-9, 3, axis=1)
        middle = np.abs(nodes[:, 2]) < 1e-9
        if symmetry == "mirror":
            held[middle, 2] = True
        if symmetry == "against":
            held[middle, :2] = True
        self.free = np.flatnonzero(~held.ravel())
        self.unknowns = (3 * hexes[:, :, None] + np.arange(3)).reshape(-1, 24)

    def forces(self, x: Floats) -> Floats:
        """Of every hexahedron on its corners at places x, (hex, 8, 3); docs/theory/hexahedral.md."""
        return self._forces(x[self.hexes]) * self.factors[:, None, None]

    def _forces(self, corners: Floats) -> Floats:
        local = corners - corners[:, :1]
        deformed = local.transpose(0, 2, 1) @ self.gradients
        left, _, right = np.linalg.svd(deformed)
        left[np.linalg.det(left) * np.linalg.det(right) < 0.0, :, 2] *= -1.0
        turn = left @ right
        y, rest = local @ turn, self.rest[self.hexes]
        f = (self.stiffness @ (y - (rest - rest[:, :1])).reshape(-1, 24, 1)).reshape(-1, 8, 3)
        s = turn.transpose(0, 2, 1) @ deformed
        spin = np.trace(s, axis1=1, axis2=2)[:, None, None] * np.eye(3) - 0.5 * (s + s.transpose(0, 2, 1))
        h = np.linalg.solve(spin, np.cross(y, f).sum(axis=1)[..., None])[..., 0]
        return np.asarray((f + np.cross(self.gradients, h[:, None])) @ turn.transpose(0, 2, 1))

    def tangent(self, x: Floats, step: float = 1e-8) -> Floats:
        """Derivatives of those forces, symmetric, (hex, 24, 24)."""
        corners = x[self.hexes]
        now, result = self._forces(corners), np.empty((len(self.hexes), 24, 24))
        for i in range(24):
            apart = np.zeros(24)
            apart[i] = step
            result[:, :, i] = ((self._forces(corners + apart.reshape(8, 3)) - now) / step).reshape(-1, 24)
        return 0.5 * (result + result.transpose(0, 2, 1)) * self.factors[:, None, None]

    def factored(self, blocks: Floats) -> Callable[[Floats], Floats]:
        """Solve with the sum of matrices of elements: right-hand sides (3 node, n) to ways of all nodes."""
        rows, columns = np.repeat(self.unknowns, 24, axis=1).ravel(), np.tile(self.unknowns, (1, 24)).ravel()
        whole = sp.csr_matrix((blocks.ravel(), (rows, columns)), shape=(3 * len(self.rest),) * 2)
        solve = _solver(whole[self.free][:, self.free])

        def ways(loads: Floats) -> Floats:
            u = np.zeros_like(loads)
            u[self.free] = solve(loads[self.free]).reshape(len(self.free), -1)
            return u

        return ways

    def shares(self, point: Sequence[float]) -> Floats:
        """Weights of nodes whose mean is a point: around it in fine meshes, of one brick in the whole coarse one."""
        p = np.array(point)
        if self.symmetry == "whole":
            return _inside(self.rest, self.hexes, p)
        off = self.rest - p
        w = self.volumes * np.exp(-(off**2).sum(axis=1) / SPREAD**2)
        w /= w.sum()
        basis = np.column_stack([np.ones(len(off)), off if p[2] > 0.0 else off[:, :2]])
        return np.asarray(w * (basis @ np.linalg.solve((basis * w[:, None]).T @ basis, np.eye(basis.shape[1])[0])))

    def pair(self, point: Sequence[float], sign: float) -> Floats:
        """Weights of a point beside the plane z = 0 and, in the whole finger, of its image."""
        one = self.shares(point)
        return one + sign * self.shares(np.array(point) * [1.0, 1.0, -1.0]) if self.symmetry == "whole" else one

    def small(self) -> tuple[Floats, Floats]:
        """Loads, (3 node, load), and what is measured, (3 node, measure), in the order of converged.csv."""
        twice = 2.0 if self.symmetry == "whole" else 1.0
        loads, told = [], []
        if self.symmetry != "against":
            loads += [_along(self.volumes, 1), _along(self.volumes, 0), _along(-twice * self.shares(END), 0)]
            loads += [_along(twice * self.shares(PALM), 1), _along(twice * self.shares(PHALANX), 1)]
            loads += [_along(-twice * self.shares(GUIDE), 0)]
            told += [_along(self.shares(p), axis) for p in (TIP, END, GUIDE, ROOT) for axis in (0, 1)]
        if self.symmetry != "mirror":
            loads += [_along(self.volumes, 2), _along(self.pair(END_SIDE, 1.0), 2), _along(self.pair(SIDE, -1.0), 1)]
            told += [_along(self.shares(TIP), 2)]
            told += [_along(self.shares(p), axis) for p in (END_SIDE, GUIDE_SIDE) for axis in range(3)]
        return np.stack(loads, axis=1), np.stack(told, axis=1)


def _along(weights: Floats, axis: int) -> Floats:
    return np.asarray((weights[:, None] * np.eye(3)[axis]).ravel())


def _stiffness(corners: Floats) -> Floats:
    return plan.stiffness(plan.shape_arrays(corners - corners[:, :1], None), MU, LAM)


def _mean_gradients(corners: Floats) -> Floats:
    total, volume = np.zeros_like(corners), np.zeros(len(corners))
    for point in SIGNS / np.sqrt(3.0):
        slopes = _slopes(point)
        jacobian = np.einsum("eai,ak->eik", corners, slopes)
        weight = np.linalg.det(jacobian)
        total += weight[:, None, None] * np.einsum("ak,eki->eai", slopes, np.linalg.inv(jacobian))
        volume += weight
    return np.asarray(total / volume[:, None, None])


def _slopes(point: Floats) -> Floats:
    """Derivatives of the eight shape functions at natural coordinates, (8, 3)."""
    f = 1.0 + SIGNS * point
    return np.asarray(SIGNS * np.stack([f[:, 1] * f[:, 2], f[:, 0] * f[:, 2], f[:, 0] * f[:, 1]], axis=1) / 8.0)


def _inside(nodes: Floats, hexes: NDArray[np.int64], point: Floats) -> Floats:
    """Trilinear weights of the nodes around a point."""
    found: list[tuple[float, int, Floats]] = []
    for one in np.argsort(((nodes[hexes].mean(axis=1) - point) ** 2).sum(axis=1))[:12]:
        natural = np.zeros(3)
        for _ in range(20):
            miss = (1.0 + SIGNS * natural).prod(axis=1) / 8.0 @ nodes[hexes[one]] - point
            natural = np.clip(natural - np.linalg.solve(nodes[hexes[one]].T @ _slopes(natural), miss), -3.0, 3.0)
        found.append((round(float(np.abs(natural).max()), 9), int(one), natural))
    _, one, natural = min(found, key=lambda item: item[0])
    weights = np.zeros(len(nodes))
    weights[hexes[one]] = (1.0 + SIGNS * np.clip(natural, -1.0, 1.0)).prod(axis=1) / 8.0
    return weights


def _solver(matrix: sp.csr_matrix) -> Callable[[Floats], Floats]:
    try:
        from pypardiso import PyPardisoSolver
    except ImportError:
        return splu(
            matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        ).solve
    solver = PyPardisoSolver()
    return lambda right: solver.solve(matrix, np.asfortranarray(right))


class Pulled:
    """A finger whose cable is pulled by given tensions; half fingers take half of them.

    Args:
        finger: What is pulled.
        carriers: Weights of the nodes that carry the points of the cable but the first, which is held, (5, node).
    """

    def __init__(self, finger: Finger, carriers: Floats) -> None:
        self.finger, self.carriers = finger, carriers
        self.share = 1.0 if finger.symmetry == "whole" else 0.5
        self.told = np.stack([_along(finger.shares(p), axis) for p in (TIP, MIDDLE) for axis in (0, 1)], axis=1)
        self.length = self._cable(finger.rest)[0]
        self.places, self.tension = finger.rest.copy(), 0.0

    def _cable(self, x: Floats) -> tuple[float, Floats, Floats]:
        """Length [m] and its first and second derivatives by the carried points."""
        points = self.carriers @ x
        if self.finger.symmetry != "whole":
            points[:, 2] = 0.0
        cable, start = finger_geometry.cable_path()
        legs = np.diff(np.concatenate([start[None], cable[:1], points]), axis=0)
        lengths = np.linalg.norm(legs, axis=1)
        along, count = legs / lengths[:, None], len(points)
        slope = along[1:].copy()
        slope[:-1] -= along[2:]
        bend = np.zeros((count, 3, count, 3))
        for i in range(count):
            block = (np.eye(3) - np.outer(along[i + 1], along[i + 1])) / lengths[i + 1]
            for a, b in ((i, i), (i - 1, i - 1), (i, i - 1), (i - 1, i)):
                if min(a, b) >= 0:
                    bend[a, :, b] += block if a == b else -block
        if self.finger.symmetry != "whole":
            bend[:, 2] = bend[..., 2] = 0.0
        return float(lengths.sum()), slope, bend.reshape(3 * count, 3 * count)

    def _linear(self, tension: float) -> Callable[[Floats], Floats]:
        """Small ways for forces (3 node, n), at the places of now."""
        bend = self.share * tension * self._cable(self.places)[2]
        solve = self.finger.factored(self.finger.tangent(self.places))
        carried = np.kron(self.carriers, np.eye(3))
        pulled = solve(carried.T)

        def ways(forces: Floats) -> Floats:
            u = solve(forces)
            inner = np.eye(len(bend)) + bend @ carried @ pulled
            return np.asarray(u - pulled @ np.linalg.solve(inner, bend @ carried @ u))

        return ways

    def rest(self, tension: float) -> Floats:
        """Mm that the cable is shorter, ways of tip and middle in x and y; from the places of now, in smaller steps."""
        reached, step = self.tension, tension - self.tension
        while True:
            places = self._newton(reached + step)
            if places is None:
                step *= 0.5
                if abs(step) < 0.01 * tension:
                    raise RuntimeError(f"no equilibrium under {tension:g} N")
                continue
            self.places, reached = places, reached + step
            step = tension - reached
            if abs(step) < 1e-9 * tension:
                self.tension = tension
                return self._answers()

    def _newton(self, tension: float, iterations: int = 15) -> Floats | None:
        finger, before = self.finger, self.places
        for _ in range(iterations):
            _, slope, _ = self._cable(self.places)
            pull = -self.share * tension * self.carriers.T @ slope
            inner = finger.forces(self.places).reshape(-1, 24)
            missing = np.bincount(finger.unknowns.ravel(), inner.ravel(), 3 * len(finger.rest)) - pull.ravel()
            if np.abs(missing[finger.free]).max() < 1e-5 * np.abs(pull).max():
                found, self.places = self.places, before
                return found
            step = -self._linear(tension)(missing[:, None])
            self.places = self.places + step.reshape(-1, 3) * min(1.0, 0.01 / np.abs(step).max())
        self.places = before
        return None

    def _answers(self) -> Floats:
        shorter = self.length - self._cable(self.places)[0]
        return 1e3 * np.append(shorter, (self.places - self.finger.rest).ravel() @ self.told)


def bricks() -> tuple[Finger, Pulled, NDArray[np.int64], NDArray[np.int64]]:
    """The coarse finger, its cable, the region of every hexahedron, and which entries of the table regions are."""
    made = finger_bricks()
    finger = Finger(made.mesh.nodes, made.mesh.hexes.astype(np.int64), "whole")
    entries, regions = np.unique(made.regions, return_inverse=True)
    tets = made.mesh.linear().tets
    carriers = np.zeros((len(made.cable) - 1, len(made.mesh.nodes)))
    for row, point in zip(carriers, made.cable[1:], strict=True):
        tet, shares = embed(made.mesh.nodes, tets, point[None], tolerance=0.001)
        row[tets[tet[0]]] = shares[0]
    return finger, Pulled(finger, carriers), regions.ravel(), entries


def cut(parts: int, symmetry: str) -> Finger:
    """The half with z above 0, every cell cut into equal parts."""
    sections, hollow = finger_geometry.bellows_finger()
    grid = finger_geometry.refined(sections, parts)
    for axis in range(3):
        hollow = np.repeat(hollow, parts, axis=axis)
    cells = np.argwhere(hollow == 0)
    cells = cells[cells[:, 1] >= hollow.shape[1] // 2]
    number = np.arange(grid[..., 0].size).reshape(grid.shape[:3])
    corners = (cells[:, None] + ((SIGNS + 1.0) / 2.0).astype(np.int64)).transpose(2, 0, 1)
    used, hexes = np.unique(number[tuple(corners)], return_inverse=True)
    return Finger(grid.reshape(-1, 3)[used], hexes.reshape(-1, 8), symmetry)


def limit(coarse: Floats, fine: Floats, parts: Sequence[int]) -> Floats:
    """What ways of two sizes of cells tend to."""
    near, far = (float(part) ** -ORDER for part in parts)
    return fine + (fine - coarse) * far / (near - far)


def renew() -> None:
    """Find the limits of all ways: converged.csv [m], a row a load, and pulled.csv [N, mm], a row a length."""
    table = np.zeros((len(SMALL), 15))
    for symmetry, where in (("mirror", np.ix_(range(6), range(8))), ("against", np.ix_(range(6, 9), range(8, 15)))):
        found = []
        for parts in FINE:
            finger = cut(parts, symmetry)
            loads, told = finger.small()
            found.append((told.T @ finger.factored(finger.stiffness)(loads)).T)
        table[where] = limit(found[0], found[1], FINE)
    np.savetxt(HERE / "converged.csv", table, "%.5g", ",")
    paths = []
    for parts in BENT:
        finger = cut(parts, "mirror")
        pulled = Pulled(finger, np.array([finger.shares(p) for p in finger_geometry.cable_path()[0][1:]]))
        rows = np.array([[0.0] * 6] + [[tension, *pulled.rest(tension)] for tension in TENSIONS])
        paths.append(CubicSpline(rows[:, 1], np.delete(rows, 1, axis=1))(LENGTHS))
    rows = paths[1] + FARTHER * (paths[1] - paths[0])
    np.savetxt(HERE / "pulled.csv", np.column_stack([rows[:, :1], LENGTHS, rows[:, 1:]]), "%.5g", ",")


def extents(table: Floats) -> Floats:
    """What errors of converged.csv are parts of [m]: ways of the tip or of the end, more for what goes less far."""
    plane = np.linalg.norm(table[:, :2], axis=1)
    out = np.maximum(np.abs(table[:, 8]), np.linalg.norm(table[:, 9:12], axis=1))
    tip = np.where(np.arange(len(table)) < 6, plane, out)[:, None]
    inner = np.maximum(np.linalg.norm(table[:, 4:6], axis=1)[:, None], 0.3 * tip)
    sizes = np.hstack([np.repeat(tip, 4, 1), np.repeat(2.0 * inner, 2, 1), np.repeat(4.0 * inner, 2, 1)] + [tip] * 7)
    sizes[:6, 8:] = sizes[6:, :8] = np.inf  # not in the table
    return np.asarray(sizes)


def fit() -> None:
    """Levenberg's method on logarithms of the factors, for small loads; then errors under those and large pulls."""
    table = np.loadtxt(HERE / "converged.csv", delimiter=",")
    finger, pulled, regions, entries = bricks()
    loads, told = finger.small()
    sizes = extents(table)

    def residual(log: Floats) -> tuple[Floats, Floats, Floats]:
        finger.factors = np.exp(log)[regions]
        blocks = finger.stiffness * finger.factors[:, None, None]
        ways = finger.factored(blocks)(np.hstack([loads, told]))
        u, v = (part[finger.unknowns] for part in np.split(ways, [len(SMALL)], axis=1))
        slopes = np.zeros((len(log), len(SMALL), told.shape[1]))
        np.add.at(slopes, regions, -np.einsum("eil,eij,ejm->elm", u, blocks, v, optimize=True))
        small = (told.T @ ways[:, : len(SMALL)]).T
        rows = np.vstack([(slopes / sizes).reshape(len(log), -1).T, DOUBT * np.eye(len(log))])
        return np.concatenate([((small - table) / sizes).ravel(), DOUBT * (log - PRIOR)]), rows, small

    log, damping = np.full(len(entries), PRIOR), 1e-2
    now, slopes, small = residual(log)
    for _ in range(ITERATIONS):
        square = slopes.T @ slopes
        change = np.linalg.solve(square + damping * np.diag(np.diag(square)), -slopes.T @ now)
        trial = residual(log + np.clip(change, -1.0, 1.0))
        if trial[0] @ trial[0] < now @ now:
            log, (now, slopes, small), damping = log + np.clip(change, -1.0, 1.0), trial, 0.4 * damping
        else:
            damping *= 4.0
    factors = np.ones(28)
    factors[entries] = np.exp(log)
    print("SOLID =", f"{factors[27]:.3f}", "STIFFNESS =", factors[:27].reshape(3, 3, 3).round(3).tolist())
    tell_small(table, small)
    finger.factors = factors[finger_bricks().regions]
    tell_pulls(pulled)


def tell_small(table: Floats, small: Floats) -> None:
    """Print how far off the tip, or the end where a load twists, is under small loads."""
    for load, name in enumerate(SMALL):
        at = [9, 10, 11] if name == "twist" else [0, 1, 8]
        off = np.linalg.norm((small - table)[load, at]) / np.linalg.norm(table[load, at])
        print(f"{name:13s} {100.0 * off:5.2f} %")


def tell_pulls(pulled: Pulled) -> None:
    """Print how far off the tip, and the tension, are under lengths of the cable."""
    rows = [np.zeros(6)]
    while rows[-1][1] < LENGTHS[-1]:
        tension = rows[-1][0] + PULL_STEP
        rows.append(np.append(tension, pulled.rest(tension)))
    path = CubicSpline(np.array(rows)[:, 1], np.delete(np.array(rows), 1, axis=1))
    for limit_tension, length, *way in np.loadtxt(HERE / "pulled.csv", delimiter=","):
        tension, x, y = path(length)[:3]
        off = np.hypot(x - way[0], y - way[1]) / np.hypot(way[0], way[1])
        told = f"tip {100.0 * off:.2f} %, tension {100.0 * (tension / limit_tension - 1.0):+.1f} %"
        print(f"cable {length:g} mm shorter: {told}")


if __name__ == "__main__":
    {"truth": renew, "fit": fit}[sys.argv[1]]()
