"""A figurine with a horse's head, like a knight of chess: what a hand meets that is neither convex nor symmetric.

Rings of nodes about a bent axis in the plane y = 0, from the flat foot over the waist, where a hand holds it, to the
muzzle. It stands in z = 0 and looks towards +x. Its shape is our own.
"""

from __future__ import annotations

import math

import numpy as np

from softwarp import checks
from softwarp.meshing.tets import FloatArray, MeshError, SurfaceMesh

# Rings: x and z of the middle, tilt of the axis from z towards x [degree], half extents in the plane and across it, and
# how far the mane stands out behind, all lengths in heights of the figurine.
RINGS = (
    (0.00, 0.00, 0.0, 0.36, 0.36, 0.00),
    (0.00, 0.09, 0.0, 0.36, 0.36, 0.00),
    (0.00, 0.15, 0.0, 0.25, 0.25, 0.00),
    (0.00, 0.28, 0.0, 0.17, 0.19, 0.00),
    (-0.01, 0.42, -4.0, 0.17, 0.18, 0.00),
    (-0.03, 0.56, 0.0, 0.20, 0.17, 0.03),
    (-0.02, 0.69, 12.0, 0.19, 0.15, 0.05),
    (0.02, 0.81, 32.0, 0.17, 0.13, 0.05),
    (0.11, 0.88, 64.0, 0.15, 0.12, 0.03),
    (0.21, 0.87, 92.0, 0.13, 0.11, 0.00),
    (0.32, 0.83, 108.0, 0.10, 0.09, 0.00),
    (0.41, 0.79, 110.0, 0.07, 0.07, 0.00),
)
AROUND = 12  # nodes of a ring
WIDTH = 0.72  # of the foot, in heights


def figurine(width: float = 0.040, *, name: str = "figurine") -> SurfaceMesh:
    """The closed surface of the figurine.

    Args:
        width: Diameter of its foot [m]; it is 1 / 0.72 times as high.
        name: What messages call it.

    Returns:
        146 vertices and 288 triangles, counter-clockwise from outside.

    Raises:
        MeshError: If the width is not positive.
        ValueError: If the name is no text.
    """
    name = checks.label(name, "figurine")
    try:
        checks.number(width, f"mesh {name!r}: width [m]", above=0.0)
    except ValueError as error:
        raise MeshError(str(error)) from None
    rings = np.array([_ring(*ring) for ring in RINGS])
    ends = np.array([rings[0].mean(axis=0), rings[-1].mean(axis=0)])
    nodes = np.concatenate([rings.reshape(-1, 3), ends])
    nodes[:, 2] -= nodes[:, 2].min()
    return SurfaceMesh(nodes * (width / WIDTH), np.array(_triangles(len(rings)), dtype=np.int32), name)


def _ring(x: float, z: float, tilt: float, along: float, across: float, mane: float) -> FloatArray:
    """Nodes of one ring, counter-clockwise about its axis, the first one in front."""
    angle = 2.0 * math.pi * np.arange(AROUND) / AROUND
    ahead = along * np.cos(angle) - mane * (np.arange(AROUND) == AROUND // 2)
    cos, sin = math.cos(math.radians(tilt)), math.sin(math.radians(tilt))
    return np.stack([x + ahead * cos, across * np.sin(angle), z - ahead * sin], axis=1)


def _triangles(rings: int) -> list[tuple[int, int, int]]:
    """Corners of the bands between the rings, and of the two ends."""
    triangles, foot, muzzle = [], rings * AROUND, rings * AROUND + 1
    for place in range(AROUND):
        beside = (place + 1) % AROUND
        triangles.append((foot, beside, place))
        for ring in range(rings - 1):
            a, b = ring * AROUND + place, ring * AROUND + beside
            triangles += [(a, b, b + AROUND), (a, b + AROUND, a + AROUND)]
        last = (rings - 1) * AROUND
        triangles.append((muzzle, last + place, last + beside))
    return triangles
