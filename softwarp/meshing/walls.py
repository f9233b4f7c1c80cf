"""How thick the walls of a solid are and how narrow its gaps, and whether its surface crosses itself.

Lines of a lattice (``meshing.lattice``) enter and leave the solid. Between an entry and the next exit lies a chord of
length c along the direction d; where the normals m and n at its ends are opposed and near to d, it crosses a wall of
thickness c min(|d . m|, |d . n|). Between an exit and the next entry lies a gap likewise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softwarp.meshing.lattice import Crossings, Family, Lattice, families, in_metres
from softwarp.meshing.tets import FloatArray, IntArray, MeshError

OPPOSED = -0.95  # cosine between normals of the two sides of a wall; edges and tips of wedges are no walls
ACROSS = 0.85  # cosine between a normal and a chord that crosses the wall; one of seven directions always does
SHARE = 0.005  # of all chords, those that may be shorter than what counts as the thinnest wall
NOTHING = 1e-6  # cells; an interval shorter than this is rounding


@dataclass(frozen=True)
class Thinnest:
    """The thinnest wall or narrowest gap.

    Attributes:
        width: Thickness [m]; infinite where there is none.
        place: Where it is [m], shape (3,).
    """

    width: float
    place: FloatArray


def measure(
    lattice: Lattice, met: list[Crossings], vertices: FloatArray, triangles: IntArray, name: str
) -> tuple[Thinnest, Thinnest]:
    """Thinnest wall and narrowest gap of a solid.

    Args:
        lattice: Lines run along it.
        met: ``crossings`` of its families with the surface.
        vertices: Of the surface [m], shape (v, 3).
        triangles: Corners, outward from the solid, shape (t, 3).
        name: What messages call the surface.

    Raises:
        MeshError: If the surface crosses itself.
    """
    corner = vertices[triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal /= np.where(length > 0.0, length, 1.0)
    widths: list[list[FloatArray]] = [[], []]
    places: list[list[FloatArray]] = [[], []]
    for family, found in zip(families(), met, strict=True):
        if len(found.at) < 2:
            continue
        way = np.linalg.inv(family.axes)[:, 2] * lattice.cell
        same = (found.line[1:] == found.line[:-1]).all(axis=1)
        extent = np.diff(found.at)
        _check_winding(lattice, family, found, same, extent, name)
        first, second = normal[found.triangle[:-1]], normal[found.triangle[1:]]
        slope = np.minimum(np.abs(first @ way), np.abs(second @ way))
        opposed = same & (np.einsum("ij,ij->i", first, second) < OPPOSED) & (slope > ACROSS * np.linalg.norm(way))
        for kind, sign in enumerate((1, -1)):
            chosen = opposed & (found.sign[:-1] == sign) & (found.sign[1:] == -sign)
            widths[kind].append((extent * slope)[chosen])
            middle = Crossings(found.line[:-1], found.at[:-1] + 0.5 * extent, found.sign[:-1], found.triangle[:-1])
            places[kind].append(_places(lattice, family, middle)[chosen])
    wall, gap = (_thinnest(w, p) for w, p in zip(widths, places, strict=True))
    return wall, gap


def _thinnest(widths: list[FloatArray], places: list[FloatArray]) -> Thinnest:
    """The width that all but a small share of the chords exceed."""
    width = np.concatenate(widths) if widths else np.zeros(0)
    if not width.size:
        return Thinnest(np.inf, np.zeros(3))
    index = np.argsort(width)[int(SHARE * width.size)]
    return Thinnest(float(width[index]), np.concatenate(places)[index])


def _places(lattice: Lattice, family: Family, found: Crossings) -> FloatArray:
    """Positions of crossings [m], shape (crossing, 3)."""
    local = np.column_stack([found.line, found.at]) + family.shift
    return in_metres(lattice, local @ np.linalg.inv(family.axes).T)


def _check_winding(
    lattice: Lattice, family: Family, found: Crossings, same: np.ndarray, extent: FloatArray, name: str
) -> None:
    """Refuse a surface that a line enters twice, or leaves before it entered."""
    total = np.cumsum(found.sign)
    start = np.concatenate([[True], ~same])
    before = np.maximum.accumulate(np.where(start, np.arange(len(start)), 0))
    turns = total - (total - found.sign)[before]
    wrong = np.flatnonzero(same & (extent > NOTHING) & ((turns[:-1] < 0) | (turns[:-1] > 1)))
    if wrong.size:
        place = _places(lattice, family, found)[wrong[0]]
        raise MeshError(
            f"surface {name!r} crosses itself or another shell near {_text(place)} m, where it is wound "
            f"{int(turns[wrong[0]])} times around; join overlapping parts with meshing.union, or repair it in the "
            f"program that made it"
        )


def _text(x: FloatArray) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in x) + ")"
