"""Cavities of a solid, found again in its mesh; whether the mesh has the shells and holes of its surface."""

from __future__ import annotations

import numpy as np

from softwarp.meshing.shells import Shells
from softwarp.meshing.solid import CavityWall
from softwarp.meshing.surfaces import check_closed, surface_parts, surface_volume
from softwarp.meshing.tets import FloatArray, IntArray, MeshError, boundary, compact
from softwarp.meshing.walls import Thinnest


def cavity_walls(
    shells: Shells,
    nodes: FloatArray,
    tets: IntArray,
    edge: float,
    wall: Thinnest,
    gap: Thinnest,
    *,
    strict: bool,
) -> dict[str, CavityWall]:
    """Walls of all cavities, by name, in the order of the shells.

    Args:
        shells: The surface.
        nodes: Of its mesh [m], shape (node, 3).
        tets: Corners, shape (tet, 4).
        edge: Edge length that was asked for [m].
        wall: Thinnest wall of the surface.
        gap: Its narrowest gap.
        strict: Whether to refuse a mesh with other parts, cavities or holes than the surface.

    Raises:
        MeshError: If the mesh touches itself, lacks a cavity, or differs while ``strict``.
    """
    label = shells.surface.name
    skin = boundary(tets, label)[0]
    part = surface_parts(skin)
    made = [skin[part == k] for k in range(int(part.max()) + 1)]
    given = [shells.shell(k) for k in range(int(shells.part.max()) + 1)]
    try:
        for triangles in made:
            check_closed(*compact(nodes, triangles), name=label)
    except MeshError as error:
        told = str(error).split(";")[0].removeprefix(f"surface {label!r} ")
        raise MeshError(f"surface {label!r}: its mesh {told}; {_advice(edge, wall, gap)}") from None
    air = [triangles[:, ::-1] for triangles in made if surface_volume(nodes, triangles) < 0.0]
    wanted = sorted((k in shells.cavities, _holes(t)) for k, (_, t) in enumerate(given))
    found = sorted((surface_volume(nodes, t) < 0.0, _holes(t)) for t in made)
    if wanted != found and (strict or len(air) < len(shells.cavities)):
        raise MeshError(
            f"surface {label!r} has {_told(wanted)}, its mesh would have {_told(found)}; {_advice(edge, wall, gap)}"
        )
    return _named(shells, nodes, air, given)


def _named(
    shells: Shells, nodes: FloatArray, air: list[IntArray], given: list[tuple[FloatArray, IntArray]]
) -> dict[str, CavityWall]:
    """Each cavity of the surface with the nearest one of the mesh, by middle and size."""
    if not shells.cavities:
        return {}
    from scipy.optimize import linear_sum_assignment

    far = np.empty((len(shells.cavities), len(air)))
    for row, k in enumerate(shells.cavities):
        x = given[k][0]
        for column, triangles in enumerate(air):
            y = nodes[np.unique(triangles)]
            away = np.abs(np.stack([y.min(axis=0) - x.min(axis=0), y.max(axis=0) - x.max(axis=0)]))
            far[row, column] = float(away.max())
    columns = linear_sum_assignment(far)[1]
    result = {}
    for name, column in zip(shells.cavities.values(), columns, strict=True):
        triangles = air[int(column)]
        vertices, corners = compact(nodes, triangles)
        result[name] = CavityWall(vertices, corners, name, np.unique(triangles).astype(np.int32))
    return result


def _holes(triangles: IntArray) -> int:
    """Handles of a closed surface of one part, from Euler's formula V - E + F = 2 - 2 g with E = 3 F / 2."""
    return 1 - (len(np.unique(triangles)) - len(triangles) // 2) // 2


def _told(kinds: list[tuple[bool, int]]) -> str:
    """Parts, cavities and holes in words."""
    cavities = sum(is_cavity for is_cavity, _ in kinds)
    counts = ((len(kinds) - cavities, "part"), (cavities, "cavit"), (sum(holes for _, holes in kinds), "hole"))
    return ", ".join(f"{n} {word}{_ending(word, n)}" for n, word in counts)


def _ending(word: str, count: int) -> str:
    if word == "cavit":
        return "y" if count == 1 else "ies"
    return "" if count == 1 else "s"


def _advice(edge: float, wall: Thinnest, gap: Thinnest) -> str:
    """Why, and what would do."""
    width, kind = min((wall.width, "wall"), (gap.width, "gap"))
    if not np.isfinite(width):
        return f"take shorter edges than edge_length={edge:g}"
    place = (wall if kind == "wall" else gap).place
    where = "(" + ", ".join(f"{value:.4g}" for value in place) + ")"
    finer = min(0.6 * width, 0.7 * edge)
    told = f"edge_length={finer:.2g}" if finer > 1e-3 * edge else "joining what touches"
    return (
        f"at edge_length={edge:g} m walls, gaps and bridges of about an edge are lost: the narrowest {kind} measures "
        f"{width:.3g} m at {where} m. Try {told}, or keep what comes with strict=False"
    )
