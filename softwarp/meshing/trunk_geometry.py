"""The trunk: a tapered silicone rod, cut by ten V-shaped grooves down to thin necks, along +z from the origin.

Dimensions [m] measured on the mesh of the trunk example of the SoftRobots plugin for SOFA, which SofaGym reuses; source
and comparison: assets/trunk/README.md.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from softwarp import checks
from softwarp.meshing.quadratic import QuadraticMesh
from softwarp.meshing.resolutions import check_name
from softwarp.meshing.revolved import revolve
from softwarp.meshing.rings import band, fan
from softwarp.meshing.tets import FloatArray, IntArray, MeshError, SurfaceMesh, TetMesh, orient

LENGTH = 0.195
BASE_RADIUS, TIP_RADIUS = 0.013, 0.005  # linear in between
TAPER = (TIP_RADIUS - BASE_RADIUS) / LENGTH
CLAMP = 0.020  # the robot is held from z = 0 to here
PITCH = 0.0175  # from neck to neck
NECK_Z = tuple(0.024 + PITCH * k for k in range(10))
NECK_RADIUS = (0.0025,) * 4 + (0.002,) * 6
GROOVE_ANGLE = (20.0, 25.0, 30.0, 30.0, 30.0, 40.0, 40.0, 40.0, 40.0, 40.0)  # flank to horizontal [degree]

# A cable crosses both flanks of a groove, 3 mm below and above the neck, on a line that leans inward by 8 mm on 195 mm.
# Where that is outside the flank, the flank bulges out to hold it.
CABLE_RADIUS, CABLE_Z = 0.010, (0.021, 0.027)  # where it crosses the first groove
CABLE_STEP = (8.0 / np.hypot(8.0, 195.0), 195.0 / np.hypot(8.0, 195.0))  # inward and upward, per length of cable
CABLE_SIDES = ((0.0, 1.0), (-1.0, 0.0), (0.0, -1.0), (1.0, 0.0))  # (x, y) of four cables in order; the diamond's too
CABLE_COVER = 0.00005  # material over a cable where the flank bulges, along z
STRAIGHT_COVER = 0.0005  # the same under a straight flank: it makes up for most of what an octagon lacks of its circle
ROUND = {  # of ``round_trunk``: wedges, layers of a flank, and the necks' radii as shares of ``NECK_RADIUS``
    "coarse": (3, 1, (0.501, 0.548, 0.599, 0.612, 0.589, 0.66, 0.678, 0.696, 0.712, 0.726)),
    "fine": (6, 2, (0.63, 0.673, 0.728, 0.738, 0.721, 0.802, 0.812, 0.822, 0.83, 0.836)),
}
CORE = 0.62  # radius of the ring inside a flat section, relative to its skin; chosen for well-shaped tetrahedra


@dataclass(frozen=True)
class _Detail:
    """How finely the trunk is cut."""

    rings: tuple[int, ...]  # nodes per ring from the axis outward, the skin last
    corners: int  # of the polygon inscribed in the circle of a neck
    collar: bool  # whether the flanks have a ring where the cables cross, or are straight from neck to rim
    clamp: int = 2  # layers from z = 0 to CLAMP
    half: int = 1  # layers from a neck to the next disc
    disc: int = 1  # layers in a disc

    @property
    def node_count(self) -> int:
        core, skin, grooves = 1 + sum(self.rings[:-1]), self.rings[-1], len(NECK_Z)
        full = core + skin if self.collar else core
        held = self.clamp * full + (core + skin) + core  # up to the lower flank of the first groove
        return held + grooves * (2 * self.half - 1) * core + full + (grooves * self.disc + grooves - 1) * full


DETAILS = {
    "coarse": _Detail((8, 8), corners=4, collar=False, clamp=1),
    "medium": _Detail((8, 16), corners=4, collar=True),
    "fine": _Detail((8, 16, 16), corners=16, collar=True, clamp=4, half=3, disc=2),
}


def trunk(resolution: str | int = "medium") -> TetMesh:
    """The tapered silicone trunk, base at the origin, tip at z = 195 mm [m].

    A quarter turn about z and the mirrors x = 0, y = 0 and x = y map the mesh to itself, tetrahedra included, so that
    symmetric commands give symmetric motion. A layer of nodes lies at the top of the clamp, z = 20 mm. Linear
    tetrahedra are too stiff in the bending of the thin necks, so finer meshes are softer: assets/trunk/README.md.

    Args:
        resolution: "coarse" (305 nodes), "medium" (674) or "fine" (2710); or a wished number of nodes, which gives the
            nearest mesh of the family.

    Returns:
        The mesh, named after the resolution.

    Raises:
        MeshError: If the name is unknown or the number lies outside the family.
    """
    detail = _detail(resolution)
    stack = _Stack(detail.rings)
    skin = "own" if detail.collar else "core"

    def flat(z: float) -> FloatArray:
        return stack.section(z, (CORE * _radius(z), z), (_radius(z), z))

    stack.add(flat(0.0), skin=skin)
    stack.add(flat(CLAMP), detail.clamp, skin, top="own")
    for groove, (z, radius) in enumerate(zip(NECK_Z, NECK_RADIUS, strict=True)):
        if groove == 0:  # the edge of the clamp is its lower rim
            collar, _ = _flank(0, -1, collar=True)
            stack.add(stack.section(collar[1], collar, collar), skin="below")
        else:
            collar, rim = _flank(groove, -1, collar=detail.collar)
            stack.add(stack.section(rim[1], collar, rim), detail.disc, skin)
        stack.add(stack.section(z, (radius, z), (radius, z), corners=detail.corners), detail.half, "none")
        collar, rim = _flank(groove, +1, collar=detail.collar)
        stack.add(stack.section(rim[1], collar, rim), detail.half, "none", top=skin, widening=True)
    stack.add(flat(LENGTH), detail.disc, skin)
    nodes, tets = stack.mesh()
    return TetMesh(nodes, tets, f"trunk {resolution}")


def round_trunk(detail: str = "coarse") -> QuadraticMesh:
    """The trunk as a solid of revolution of curved quadratic elements, whose grooves bend as true ones do.

    The strain at the sharp bottom of a groove knows no bound, so that coarse elements there are far too stiff however
    they are shaped: a round neck of three elements bends two to four times too little. Its radius is therefore reduced
    until the stiffness of each groove against bending equals the converged one, which ``assets/trunk/necks.py`` finds
    with axisymmetric elements. Under its weight, and lifted or tilted by gravity, the coarse mesh is within 3 % of
    converged shapes, where linear elements are 27 to 66 % off; its grooves twist 3 to 34 % too easily, and are 7 to
    70 % too stiff along the axis. Flanks are cones without bulges for cables, whose points lie up to 0.8 mm outside.

    Args:
        detail: "coarse", 630 nodes, three wedges around and one layer in each flank and disc; or "fine", 2375 nodes,
            six and two, for comparison.

    Raises:
        MeshError: If the detail is another.
    """
    check_name(detail, ROUND, "round_trunk", "detail")
    sectors, parts, shares = ROUND[detail]
    outline = [(BASE_RADIUS, 0.0), (_radius(CLAMP), CLAMP)]
    for groove, share in enumerate(shares):
        below, above = rims(groove)
        outline += [below] if groove else []  # the edge of the clamp is the lower rim of the first
        outline += [(share * NECK_RADIUS[groove], NECK_Z[groove]), above]
    outline.append((TIP_RADIUS, LENGTH))
    skin = divided(outline, 2 * parts)
    return revolve(skin, skin[:, 1], sectors=sectors, start=0.5 * np.pi, name=f"trunk round {detail}")


def rims(groove: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """(radius, z) [m] where the flanks of a groove meet the taper, below and above its neck."""
    return _flank(groove, -1, collar=True)[1], _flank(groove, +1, collar=True)[1]


def divided(corners: Sequence[tuple[float, float]], parts: int) -> FloatArray:
    """Corners of an outline and the points that divide its sides into equal parts, shape (parts sides + 1, 2)."""
    stations = np.arange(parts * (len(corners) - 1) + 1) / parts
    return np.stack([np.interp(stations, np.arange(len(corners)), column) for column in zip(*corners, strict=True)], 1)


def trunk_skin(corners: int = 8) -> SurfaceMesh:
    """The trunk for contact: a tapered polygon from rim to rim of its discs, flat across the grooves, closed.

    Thick everywhere, so that nothing gets inside unseen, where the grooves of the body itself would let thin things in.
    Of eight corners every point but those across a groove lies on the boundary of every resolution and is a node of it.

    Args:
        corners: Of every rim, evenly spaced, the first on the side of +x; 3 to 1000.

    Returns:
        The surface [m]: rings of corners upwards, then the middles of base and tip.

    Raises:
        ValueError: For another number of corners.
    """
    corners = checks.count(corners, "trunk_skin: corners", low=3, high=1000)
    rims = [(BASE_RADIUS, 0.0), (_radius(CLAMP), CLAMP)]
    rims += [_flank(groove, +1, collar=True)[1] for groove in range(len(NECK_Z))]
    rims += [_flank(groove, -1, collar=True)[1] for groove in range(1, len(NECK_Z))]
    rims.append((TIP_RADIUS, LENGTH))
    angle = 2.0 * np.pi * np.arange(corners) / corners
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings = [
        np.column_stack([radius * around, np.full(corners, z)]) for radius, z in sorted(rims, key=lambda rim: rim[1])
    ]
    count = len(rings) * corners
    ring = np.arange(count, dtype=np.int32).reshape(-1, corners)
    triangles = [band(low, high) for low, high in itertools.pairwise(ring)]
    triangles += [fan(ring[0], count), fan(ring[-1], count + 1)[:, ::-1]]
    points = np.concatenate([*rings, [[0.0, 0.0, 0.0], [0.0, 0.0, LENGTH]]])
    return SurfaceMesh(points, np.concatenate(triangles), "trunk skin")


def _detail(resolution: str | int) -> _Detail:
    """The named member of the family, or the one nearest to a node count."""
    if isinstance(resolution, bool) or not isinstance(resolution, (int, np.integer)):
        return DETAILS[check_name(resolution, DETAILS, "trunk", more=", or a node count")]
    family = list(DETAILS.values())
    for detail, half, disc in itertools.product(DETAILS.values(), range(1, 4), range(1, 6)):
        family.append(replace(detail, clamp=disc + 1, half=half, disc=disc))
    counts = [detail.node_count for detail in family]
    low, high = min(counts) // 2, 2 * max(counts)
    if not low <= resolution <= high:
        raise MeshError(
            f"trunk: the node count must lie between {low} and {high}, got {resolution!r}; the family has "
            f"{min(counts)} to {max(counts)} nodes"
        )
    return min(family, key=lambda detail: abs(detail.node_count - resolution))


def _radius(z: float) -> float:
    """Radius of the taper [m] at height z [m]."""
    return BASE_RADIUS + TAPER * z


def _flank(groove: int, side: int, *, collar: bool) -> tuple[tuple[float, float], tuple[float, float]]:
    """(radius, z) of the collar and of the rim [m], below (side -1) or above (+1) the neck of a groove."""
    neck_z, neck_radius = NECK_Z[groove], NECK_RADIUS[groove]
    inward, upward = CABLE_STEP
    cable_radius = CABLE_RADIUS - groove * PITCH * inward
    cable_z = CABLE_Z[side > 0] + groove * PITCH * upward
    cover = CABLE_COVER if collar else STRAIGHT_COVER
    highest = abs(cable_z - neck_z) - cover  # above the neck, so that the cable is inside

    slope = float(np.tan(np.radians(GROOVE_ANGLE[groove])))
    height = min(slope * (cable_radius - neck_radius), highest)
    if not collar:
        slope = min(slope, highest / (cable_radius - neck_radius))
    rim_z = neck_z + side * (_radius(neck_z) - neck_radius) / (1.0 / slope - side * TAPER)
    rim = (_radius(rim_z), rim_z)
    return ((cable_radius, neck_z + side * height) if collar else rim), rim


class _Stack:
    """Discs stacked along z, all cut into the same triangles; between two discs every triangle is a prism.

    No edge of a disc crosses a plane of symmetry, and every prism is cut into tetrahedra from its corner nearest to the
    axis outward, so the tetrahedra are as symmetric as the disc. A disc may lack its skin ring, or borrow the nodes of
    another ring for it: the prisms there lose the tetrahedra that vanish.
    """

    def __init__(self, rings: tuple[int, ...]) -> None:
        self.ring = np.repeat(np.arange(len(rings) + 1), (1, *rings))
        self.angle = np.concatenate([[0.0], *(2.0 * np.pi * np.arange(n) / n for n in rings)])
        self.skin = self.ring == len(rings)
        self.core_edge = self.ring == len(rings) - 1
        self.triangles = _sorted_outward(_disc(rings), self.ring, self.angle)
        self.points: list[FloatArray] = []  # of each disc, shape (vertex, 3)
        self.blocks: list[FloatArray] = []  # nodes that each disc adds
        self.layers: list[NDArray[np.int64]] = []  # node of each vertex of each disc, -1 where there is none
        self.widening: list[bool] = []  # of the prisms below each disc but the first

    def section(
        self, axis_z: float, core: tuple[float, float], skin: tuple[float, float], corners: int = 0
    ) -> FloatArray:
        """Vertices of a disc [m], shape (vertex, 3).

        Args:
            axis_z: Height of its centre.
            core: Radius and height of the outermost core ring; rings inside are evenly spaced.
            skin: Radius and height of the skin.
            corners: Of the polygon inscribed in the circle, the first on the x axis; 0 puts all nodes on the circle.
        """
        share = self.ring / (self.ring.max() - 1)
        radius = np.where(self.skin, skin[0], share * core[0])
        z = np.where(self.skin, skin[1], axis_z + share * (core[1] - axis_z))
        if corners:
            half = np.pi / corners
            radius = radius * np.cos(half) / np.cos(self.angle % (2.0 * half) - half)
        return np.stack([radius * np.cos(self.angle), radius * np.sin(self.angle), z], axis=1)

    def add(
        self, points: FloatArray, steps: int = 1, skin: str = "own", *, top: str | None = None, widening: bool = False
    ) -> None:
        """Put a disc on top, reached in equal steps from the last one.

        Args:
            points: Its vertices [m], shape (vertex, 3).
            steps: Layers of prisms.
            skin: Where the skin nodes of each step come from: "own"; "core": the outermost core ring is moved out to be
                the skin; "below": the skin of the disc below; "none".
            top: The same for the last step, if different.
            widening: Cut the prisms from the top disc; good where they widen upwards.
        """
        last = self.points[-1] if self.points else points
        for step in range(1, steps + 1):
            self._push(last + (points - last) * (step / steps), top if top and step == steps else skin)
            self.widening.append(widening)
        self.points.append(points)

    def _push(self, points: FloatArray, skin: str) -> None:
        new = np.ones(len(points), dtype=bool) if skin == "own" else ~self.skin
        layer = np.full(len(points), -1)
        layer[new] = sum(len(block) for block in self.blocks) + np.arange(new.sum())
        if skin == "core":
            layer[self.skin] = layer[self.core_edge]
            points[self.core_edge] = points[self.skin]
        elif skin == "below":
            layer[self.skin] = self.layers[-1][self.skin]
        self.blocks.append(points[new])
        self.layers.append(layer)

    def mesh(self) -> tuple[FloatArray, IntArray]:
        """Nodes (node, 3) [m] and tetrahedra (tet, 4) of positive volume."""
        nodes, tets = np.concatenate(self.blocks), []
        for (low, high), widening in zip(itertools.pairwise(self.layers), self.widening[1:], strict=True):
            start, end = (high, low) if widening else (low, high)
            (a, b, c), (d, e, f) = start[self.triangles].T, end[self.triangles].T
            tets += [np.stack(corners, axis=1) for corners in ((a, b, c, f), (a, b, e, f), (a, d, e, f))]
        every = np.concatenate(tets)
        ordered = np.sort(every, axis=1)
        every = every[(ordered[:, 0] >= 0) & (ordered[:, 1:] != ordered[:, :-1]).all(axis=1)]
        return nodes, orient(nodes, every)


def _disc(rings: tuple[int, ...]) -> list[tuple[int, int, int]]:
    """Triangles of a disc: vertex 0 in the centre, then the rings; each ring as many nodes as the last, or twice."""
    triangles = [(0, 1 + i, 1 + (i + 1) % rings[0]) for i in range(rings[0])]
    start = 1
    for n, m in itertools.pairwise(rings):
        outer = start + n
        for i in range(n):
            a, b = start + i, start + (i + 1) % n
            if m == 2 * n:
                c, d, e = outer + 2 * i, outer + 2 * i + 1, outer + (2 * i + 2) % m
                triangles += [(a, c, d), (a, d, b), (b, d, e)]
            else:  # diagonals end at odd nodes outside, which keeps the planes of symmetry free
                c, d = outer + i, outer + (i + 1) % m
                triangles += [(a, c, d), (a, d, b)] if i % 2 == 0 else [(a, c, b), (b, c, d)]
        start = outer
    return triangles


def _sorted_outward(
    triangles: list[tuple[int, int, int]], ring: NDArray[np.int64], angle: FloatArray
) -> NDArray[np.int64]:
    """Triangles with corners ordered by ring, then by angle to the nearest coordinate axis: a symmetric order."""
    quarter = np.pi / 2.0
    rank = np.empty(len(ring), dtype=np.int64)
    rank[np.lexsort((np.abs((angle + quarter / 2.0) % quarter - quarter / 2.0), ring))] = np.arange(len(ring))
    corners = np.array(triangles)
    return np.asarray(np.take_along_axis(corners, np.argsort(rank[corners], axis=1), axis=1))
