"""Arrows, points and axes that explain a picture: contacts with their forces, joints, elements inside out."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.io import palette
from softwarp.io.parts import Parts
from softwarp.model.codes import JOINT_KINDS
from softwarp.shapes import Sphere

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

_SIDES = 12
_OCTAHEDRON = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])


@dataclass
class Notes:
    """Triangles that several worlds share, and where their vertices are in each.

    Attributes:
        triangles: Corners, shape (tri, 3).
        color: sRGB, shape (vertex, 3).
        x: Positions [m], shape (n, vertex, 3).
        shape: The same things at full size, which tell where they have edges, shape (vertex, 3).
    """

    triangles: Ints
    color: Floats
    x: Floats
    shape: Floats


def contact_notes(x: Any, force: Any, size: float, strongest: float) -> Notes:
    """A point and an arrow per contact.

    Args:
        x: Contact points [m], NaN for none, shape (n, contact, 3).
        force: Forces [N], same shape.
        size: Size of the scene [m].
        strongest: Force whose arrow is ``palette.ARROW_LENGTH`` long [N].
    """
    where, load = (np.asarray(a.detach().cpu() if hasattr(a, "detach") else a, dtype=np.float64) for a in (x, force))
    there = np.asarray(np.isfinite(np.concatenate([where, load], axis=-1)).all(axis=-1))
    where, load = np.where(there[..., None], where, 0.0), np.where(there[..., None], load, 0.0)
    load = load / max(strongest, 1e-30)
    load /= np.maximum(np.linalg.norm(load, axis=-1, keepdims=True) / palette.ARROW_EXCESS, 1.0)
    points = _balls(where, np.where(there, palette.POINT_RADIUS * size, 0.0), palette.CONTACT)
    return joined(
        [points, _arrows(where, load * palette.ARROW_LENGTH * size, palette.ARROW_RADIUS * size, palette.FORCE)]
    )


def joint_notes(parts: Parts, frame_pose: Floats, size: float) -> Notes:
    """Axes of hinges and sliders, points of balls and welds.

    Args:
        parts: Joints.
        frame_pose: Poses of all rigid bodies, then of all rod nodes, shape (n, frame, 7).
        size: Size of the scene [m].
    """
    found = []
    radius, color = palette.ARROW_RADIUS * size, palette.JOINT
    for joint, kind in enumerate(parts.joint_kind):
        line = parts.joint_line(joint, frame_pose, 0.5 * palette.AXIS_LENGTH * size)
        anchor, low, high = line[:, :1], line[:, 1:2], line[:, 2:]
        found.append(_balls(anchor, np.full(anchor.shape[:2], 1.8 * radius), color))
        if JOINT_KINDS[int(kind)] == "slider":
            found += [_arrows(anchor, end - anchor, radius, color) for end in (low, high)]
        elif JOINT_KINDS[int(kind)] == "hinge":
            found.append(_arrows(low, high - low, radius, color, head=False))
    return joined(found)


def inversion_notes(x: Any, size: float) -> Notes:
    """An octahedron per element inside out: as many as a body can have stay cheap to draw.

    Args:
        x: Centroids [m], NaN for none, shape (n, inverted, 3).
        size: Size of the scene [m].
    """
    where = np.asarray(x, dtype=np.float64)
    there = np.isfinite(where).all(axis=-1, keepdims=True)
    corners = np.concatenate([np.eye(3), -np.eye(3)])
    radius = np.where(there, palette.MARK_RADIUS * size, 0.0)
    vertices = np.where(there, where, 0.0)[:, :, None] + radius[..., None] * corners
    items = where.shape[1]
    return Notes(
        _repeated(_OCTAHEDRON, 6, items),
        _painted(6 * items, palette.INVERTED),
        vertices.reshape(len(where), -1, 3),
        np.tile(corners, (items, 1)),
    )


def joined(notes: list[Notes]) -> Notes:
    """Several as one."""
    first = np.cumsum([0, *(n.x.shape[1] for n in notes)])
    return Notes(
        np.concatenate([n.triangles + f for n, f in zip(notes, first, strict=False)]).astype(np.int32),
        np.concatenate([n.color for n in notes]),
        np.concatenate([n.x for n in notes], axis=1),
        np.concatenate([n.shape for n in notes]),
    )


def _balls(centre: Floats, radius: Floats, color: tuple[float, float, float]) -> Notes:
    """Balls about centres (n, item, 3) with radii (n, item)."""
    x, tri = Sphere(1.0).surface(_SIDES)
    items = centre.shape[1]
    vertices = centre[:, :, None] + radius[..., None, None] * x
    return Notes(
        _repeated(tri, len(x), items),
        _painted(items * len(x), color),
        vertices.reshape(len(centre), -1, 3),
        np.tile(x, (items, 1)),
    )


def _arrows(
    base: Floats, vector: Floats, radius: float, color: tuple[float, float, float], *, head: bool = True
) -> Notes:
    """Arrows from points (n, item, 3) along vectors of their length; short ones are all head."""
    x = _arrow(base, vector, radius, head)
    shape = _arrow(np.zeros(3), np.array([0.0, 0.0, 10.0]), 1.0, head)
    i = np.arange(_SIDES)
    j = (i + 1) % _SIDES
    last = 2 * _SIDES
    tri = [np.column_stack([np.full(_SIDES, last + _SIDES), j, i])]
    for a in (0, _SIDES):
        b = a + _SIDES
        tri += [np.column_stack([a + i, a + j, b + j]), np.column_stack([a + i, b + j, b + i])]
    tri.append(np.column_stack([last + i, last + j, np.full(_SIDES, last + _SIDES + 1)]))
    items = base.shape[1]
    return Notes(
        _repeated(np.concatenate(tri), len(shape), items),
        _painted(items * len(shape), color),
        x.reshape(len(base), -1, 3),
        np.tile(shape, (items, 1)),
    )


def _arrow(base: Floats, vector: Floats, radius: float, head: bool) -> Floats:
    """Vertices of arrows, shape (..., vertex, 3): three rings, then the two ends."""
    length = np.linalg.norm(vector, axis=-1)
    along = vector / np.maximum(length, 1e-300)[..., None]
    side = np.cross(along, np.eye(3)[np.argmin(np.abs(along), axis=-1)])
    side /= np.maximum(np.linalg.norm(side, axis=-1, keepdims=True), 1e-300)
    neck = np.maximum(length - 6.0 * radius, 0.0) if head else length
    wide = np.where(length > 0.0, np.minimum(radius, 0.2 * length), 0.0)
    rings = [(0.0 * neck, wide), (neck, wide), (neck, (2.6 if head else 1.0) * wide)]
    angle = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    circle = np.cos(angle)[:, None] * side[..., None, :] + np.sin(angle)[:, None] * np.cross(along, side)[..., None, :]
    vertices = [
        base[..., None, :] + z[..., None, None] * along[..., None, :] + r[..., None, None] * circle for z, r in rings
    ]
    return np.concatenate([*vertices, base[..., None, :], (base + vector)[..., None, :]], axis=-2)


def _repeated(triangles: NDArray[Any], vertices: int, items: int) -> Ints:
    """Triangles of one thing for several."""
    shift = vertices * np.arange(items)[:, None, None]
    return np.asarray((triangles[None] + shift).reshape(-1, 3), dtype=np.int32)


def _painted(count: int, color: tuple[float, float, float]) -> Floats:
    return np.tile(np.array(color), (count, 1))
