"""The cup: a soft conical beaker with a flat bottom, open at the top, along +z from the origin.

Dimensions [m] measured on the cup mesh of SofaGym's TrunkCup scene; source and comparison: assets/trunk_cup/README.md.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from softwarp.meshing.resolutions import check_name
from softwarp.meshing.rings import band, fan
from softwarp.meshing.tets import FloatArray, IntArray, SurfaceMesh, TetMesh, orient

HEIGHT = 0.0786
BOTTOM_RADIUS, RIM_RADIUS = 0.0208, 0.0350  # outer, linear in between
WALL = 0.00195  # thickness of wall and bottom, which gives the published volume

DETAILS = {"coarse": (16, 8), "medium": (16, 10), "fine": (32, 16)}  # corners around, layers above the bottom


@dataclass(frozen=True)
class CupMesh:
    """A cup and what of it touches.

    Attributes:
        mesh: The solid.
        skin: Its boundary, coarser in the bottom, closed; its points are nodes of the mesh.
    """

    mesh: TetMesh
    skin: SurfaceMesh


def cup(resolution: str = "coarse") -> CupMesh:
    """The conical cup, bottom at z = 0, axis x = y = 0 [m].

    The wall is one layer of prisms thick. The skin for contact has all corners and layers of the wall, inside and out:
    an open one would let through what comes over the rim, and one with fewer layers what presses a fold into the wall.

    Args:
        resolution: "coarse" (354 nodes), "medium" (418) or "fine" (1218).

    Raises:
        MeshError: If the name is unknown.
    """
    check_name(resolution, DETAILS, "cup")
    corners, layers = DETAILS[resolution]
    heights = np.concatenate([[0.0], np.linspace(WALL, HEIGHT, layers + 1)])
    slope = (RIM_RADIUS - BOTTOM_RADIUS) / HEIGHT
    outer = [_ring(BOTTOM_RADIUS + slope * z, z, corners) for z in heights]
    inner = [_ring(BOTTOM_RADIUS + slope * z - WALL * np.hypot(1.0, slope), z, corners) for z in heights]
    middle = [_ring(0.5 * BOTTOM_RADIUS, z, corners) for z in heights[:2]]
    axis = [np.array([[0.0, 0.0, z]]) for z in heights[:2]]
    nodes = np.concatenate([*outer, *inner, *middle, *axis])
    first = {"outer": 0, "inner": len(outer), "middle": 2 * len(outer)}

    def ring(kind: str, level: int) -> IntArray:
        start = (first[kind] + level) * corners
        return np.arange(start, start + corners, dtype=np.int32)

    tets: list[IntArray] = []
    for level in range(layers + 1):  # the lowest is the rim of the bottom
        rows = [ring(kind, k) for k in (level, level + 1) for kind in ("outer", "inner")]
        tets.append(_bricks(*rows))
    tets.append(_bricks(ring("inner", 0), ring("middle", 0), ring("inner", 1), ring("middle", 1)))
    centre = len(nodes) - 2
    tets.append(_wedges(ring("middle", 0), ring("middle", 1), centre, centre + 1))
    solid = TetMesh(nodes, orient(nodes, np.concatenate(tets)), f"cup {resolution}")
    inside = range(1, layers + 2)
    outside = [0, *inside[1:]]
    skin = [band(ring("outer", a), ring("outer", b)) for a, b in itertools.pairwise(outside)]
    skin += [band(ring("outer", layers + 1), ring("inner", layers + 1))]
    skin += [band(ring("inner", b), ring("inner", a)) for a, b in itertools.pairwise(inside)]
    skin += [band(ring("inner", 1), ring("middle", 1)), fan(ring("middle", 1), centre + 1)[:, ::-1]]
    skin += [band(ring("middle", 0), ring("outer", 0)), fan(ring("middle", 0), centre)]
    used, corner = np.unique(np.concatenate(skin), return_inverse=True)
    return CupMesh(solid, SurfaceMesh(nodes[used], corner.reshape(-1, 3).astype(np.int32), f"cup {resolution} skin"))


def _ring(radius: float, z: float, corners: int) -> FloatArray:
    """Corners of a regular polygon inscribed in a circle [m], shape (corner, 3)."""
    angle = 2.0 * np.pi * np.arange(corners) / corners
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(corners, z)], axis=1)


def _bricks(low_out: IntArray, low_in: IntArray, high_out: IntArray, high_in: IntArray) -> IntArray:
    """Six tetrahedra for each brick between neighbouring corners of four rings, diagonals alike all the way round."""
    a, b, c, d, e, f, g, h = (
        row for ring in (low_out, low_in, high_out, high_in) for row in (ring, np.roll(ring, -1))
    )  # a brick's vertex along x is b - a, along y is c - a, along z is e - a
    paths = ((b, d), (b, f), (c, d), (c, g), (e, f), (e, g))  # from a to h along edges, Kuhn's six
    return np.concatenate([np.stack((a, p, q, h), axis=1) for p, q in paths])


def _wedges(low: IntArray, high: IntArray, low_axis: int, high_axis: int) -> IntArray:
    """Three tetrahedra for each wedge between the axis and two neighbouring corners of two rings."""
    a, b, c, d = low, np.roll(low, -1), high, np.roll(high, -1)
    m, n = np.full_like(a, low_axis), np.full_like(a, high_axis)
    # The face between the rings has the diagonal from a to d, as bricks have it.
    return np.concatenate([np.stack(t, axis=1) for t in ((m, a, b, d), (m, a, c, d), (m, n, c, d))])
