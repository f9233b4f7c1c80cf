"""Solids of revolution about z from quadratic tetrahedra: few elements, round all the same."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from softwarp import checks
from softwarp.meshing.prisms import cut_prisms
from softwarp.meshing.quadratic import QuadraticMesh, elevate
from softwarp.meshing.tets import EDGES, FloatArray, MeshError, orient


def revolve(
    skin: ArrayLike,
    axis: ArrayLike | None = None,
    *,
    sectors: int = 3,
    start: float = 0.0,
    name: str = "solid of revolution",
) -> QuadraticMesh:
    """A solid between discs, each cut into ``sectors`` wedges with curved rims; three tetrahedra a wedge and layer.

    The rim of a disc is a chain of parabolas, drawn out a little so that every section has the second moment of area of
    its circle: a slender solid bends as the round one does.

    Args:
        skin: Radius and height [m] of the discs' rims and of the rims' middles between them, in turn, from the bottom
            to the top, shape (2 layers + 1, 2). A middle need not lie half way: nearer to a disc, elements are finer
            there.
        axis: Heights [m] on the axis of the same, shape (2 layers + 1,); None takes those of discs, and means between.
        sectors: Wedges of a disc, at least 3.
        start: Angle [rad] of the first corner.
        name: What messages call the mesh.

    Raises:
        MeshError: If arrays have other shapes, a radius is not positive, or elements fold.
        ValueError: For an angle, a number of wedges or a name that is none.
    """
    name = checks.label(name, "solid of revolution")
    checks.count(sectors, "revolve: sectors", low=3)
    start = checks.number(start, "revolve: start [rad]", low=-1e3, high=1e3)
    outline = _numbers(skin)
    if outline.ndim != 2 or outline.shape[1] != 2 or len(outline) < 3 or len(outline) % 2 == 0:
        raise MeshError(f"mesh {name!r}: skin must have the shape (2 layers + 1, 2), got {outline.shape}")
    if not (np.isfinite(outline).all() and (outline[:, 0] > 0.0).all()):
        raise MeshError(f"mesh {name!r}: skin must be finite, its radii positive; the least is {outline[:, 0].min():g}")
    layers = len(outline) // 2
    if axis is None:
        heights = np.interp(np.arange(len(outline)), 2 * np.arange(layers + 1), outline[::2, 1])
    else:
        heights = _numbers(axis)
    if heights.shape != (len(outline),) or not np.isfinite(heights).all():
        raise MeshError(f"mesh {name!r}: axis must be finite, of the shape ({len(outline)},), got {heights.shape}")

    turn = np.exp(1j * (start + 2.0 * np.pi * np.arange(sectors) / sectors))
    disc = np.concatenate([[0.0], turn])
    corner = 1 + np.arange(sectors)
    wedges = np.stack([np.zeros_like(corner), corner, np.roll(corner, -1)], axis=1)
    pair = np.arange(2 * len(disc))
    tets = [cut_prisms(wedges, pair, layer * len(disc) + pair) for layer in range(layers)]
    plain = np.tile(np.stack([disc.real, disc.imag], axis=1), (layers + 1, 1))
    nodes = np.column_stack([plain, np.repeat(np.arange(layers + 1.0), len(disc))])
    mesh = elevate(nodes, orient(nodes, np.concatenate(tets)), name=name)

    # Of an edge node: the mean distance from the axis of its ends, the angle between them, the height by ``skin``.
    ends, middle = mesh.elements[:, EDGES].reshape(-1, 2), mesh.elements[:, 4:].ravel()
    across = mesh.nodes[:, 0] + 1j * mesh.nodes[:, 1]
    share, direction = np.abs(across), across.copy()
    share[middle] = share[ends].mean(axis=1)
    direction[middle] = across[ends].sum(axis=1)
    length = np.abs(direction)
    direction = np.divide(direction, length, out=np.zeros_like(direction), where=length > 0.0)
    station = np.rint(2.0 * mesh.nodes[:, 2]).astype(np.int64)
    radial = direction * share * _draw(sectors) * outline[station, 0]
    z = (1.0 - share) * heights[station] + share * outline[station, 1]
    return QuadraticMesh(np.column_stack([radial.real, radial.imag, z]), mesh.elements, name)


def _numbers(value: ArrayLike) -> FloatArray:
    """The value as floats; one of no shape that fits for what holds no real numbers."""
    found = checks.as_array(value)
    return found.astype(np.float64) if found.dtype.kind in "fiu" else np.zeros(())


def _draw(sectors: int) -> float:
    """Factor on the radius that gives a circle of ``sectors`` parabolas the second moment of area of the circle."""
    place, weight = np.polynomial.legendre.leggauss(4)  # exact for the degree 7 of the integral along the rim
    t, half = 0.5 * (place + 1.0), np.pi / sectors
    shapes = np.stack([(1.0 - t) * (1.0 - 2.0 * t), 4.0 * t * (1.0 - t), t * (2.0 * t - 1.0)], axis=1)
    slopes = np.stack([4.0 * t - 3.0, 4.0 - 8.0 * t, 4.0 * t - 1.0], axis=1)
    points: FloatArray = np.array([[np.cos(a), np.sin(a)] for a in (-half, 0.0, half)])
    (x, y), (dx, dy) = (shapes @ points).T, (slopes @ points).T
    moment = sectors * float(np.sum(0.5 * weight * (x * dy - y * dx) * (x * x + y * y))) / 4.0
    return float((0.5 * np.pi / moment) ** 0.25)
