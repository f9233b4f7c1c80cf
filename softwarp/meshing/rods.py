"""Rods: centre lines, frames along them, sections, and the strain at rest.

Lengths in metres. A rod is a chain of nodes with a frame each; local z is the tangent, local x and y span the section.
The strain of a segment is that of kernels/elements/rod.py: (Gamma, kappa) = log of the motion from its first frame to
its second, divided by its length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from softwarp import checks
from softwarp.meshing.tets import FloatArray

ANGLE_MAX = 2.5  # rad that a segment may turn from node to node, at rest and when it is made
MOST_SEGMENTS = 100_000
SHORT = 1e-9  # length of a segment, relative to the longest, below which two points are one


@dataclass(frozen=True, eq=False)
class RodGeometry:
    """A rod cut into segments; made by ``rod_geometry``.

    Attributes:
        positions: Nodes [m], shape (n, 3).
        quaternions: Frames at the nodes, local to world, (x, y, z, w), shape (n, 4); local z is the tangent.
        length: Length of the segments at rest [m], shape (n - 1,).
        section: Area, shear area [m^2], second moments of area about local x and y, torsion constant [m^4], shape
            (n - 1, 5).
        rest: Strain at rest: Gamma (3) and curvature (3) [1/m] in local axes, shape (n - 1, 6).
        node_volume: Volume lumped at the nodes [m^3], shape (n,).
        node_inertia: Rotational inertia about local axes per unit density [m^5], shape (n, 3).
        radius: Outer radius of the segments [m], shape (n - 1,).
    """

    positions: FloatArray
    quaternions: FloatArray
    length: FloatArray
    section: FloatArray
    rest: FloatArray
    node_volume: FloatArray
    node_inertia: FloatArray
    radius: FloatArray


def rod_geometry(
    points: ArrayLike,
    *,
    radius: ArrayLike,
    inner_radius: ArrayLike = 0.0,
    curvature: ArrayLike | None = None,
    normal: ArrayLike | None = None,
    nu: float = 0.5,
    section: ArrayLike | None = None,
) -> RodGeometry:
    """Cut a rod along points into segments with frames, sections and strain at rest.

    Frames follow the curve without turning about it. Points on a circle get its exact tangents.

    Args:
        points: Centre line [m], shape (n, 3), at least two.
        radius: Outer radius [m], one or one per segment.
        inner_radius: Radius of the bore [m], one or one per segment; 0 for a solid rod.
        curvature: Intrinsic curvature and twist [1/m] in local axes, shape (3,) or (n - 1, 3); the rod then starts at
            the points, unstretched. Without it the points are its stress-free shape.
        normal: Local x axis of the first node, made orthogonal to the tangent; by default near world x, or y.
        nu: Poisson's ratio that the shear area of round sections is taken for (Cowper, 1966).
        section: Sections that are not round: area, shear area, I_x, I_y, torsion constant, shape (5,) or (n - 1, 5);
            ``radius`` then serves contact and pictures only.

    Raises:
        ValueError: For points, radii, curvature, normal or section that give no rod; the message says which and why.
    """
    positions = _points(points)
    count = len(positions) - 1
    outer = _per_segment(radius, count, "radius")
    tangents = _tangents(positions)
    frames = _transport(tangents, _first_normal(tangents[0], normal))
    translation, turn = _relative_motion(positions, frames)
    length = np.linalg.norm(translation, axis=1)
    if curvature is None:
        rest = np.concatenate([translation, turn], axis=1) / length[:, None]
    else:
        rest = np.concatenate([np.tile([0.0, 0.0, 1.0], (count, 1)), _curvature(curvature, length)], axis=1)
    if section is None:
        sections = round_section(outer, _per_segment(inner_radius, count, "inner_radius", zero=True), nu)
    else:
        sections = _given_section(section, count)
    inertia = np.stack([sections[:, 2], sections[:, 3], sections[:, 2] + sections[:, 3]], axis=1)
    return RodGeometry(
        positions=positions,
        quaternions=_quaternions(frames),
        length=length,
        section=sections,
        rest=rest,
        node_volume=_lumped(sections[:, 0] * length),
        node_inertia=_lumped(inertia * length[:, None]),
        radius=outer,
    )


def straight(
    length: float, segments: int, *, start: ArrayLike = (0.0, 0.0, 0.0), direction: ArrayLike = (0.0, 0.0, 1.0)
) -> FloatArray:
    """Points on a line of a length [m] from ``start``, shape (segments + 1, 3)."""
    s = np.linspace(0.0, _positive(length, "length"), _segments(segments) + 1)
    return _place(start, "start") + s[:, None] * _unit(direction, "direction")


def arc(
    radius: float,
    angle: float,
    segments: int,
    *,
    start: ArrayLike = (0.0, 0.0, 0.0),
    tangent: ArrayLike = (0.0, 0.0, 1.0),
    normal: ArrayLike = (1.0, 0.0, 0.0),
) -> FloatArray:
    """Points on a circular arc, shape (segments + 1, 3).

    Args:
        radius: Radius [m].
        angle: Angle from first to last point [rad].
        segments: Number of segments.
        start: First point [m].
        tangent: Direction in which it leaves the first point.
        normal: Direction from the first point to the centre, made orthogonal to the tangent.

    Raises:
        ValueError: For a radius or angle that is not positive, or a normal along the tangent.
    """
    t = _unit(tangent, "tangent")
    n = _first_normal(t, normal)
    a = np.linspace(0.0, _positive(angle, "angle"), _segments(segments) + 1)[:, None]
    return _place(start, "start") + _positive(radius, "radius") * (np.sin(a) * t + (1.0 - np.cos(a)) * n)


def helix(
    radius: float, pitch: float, turns: float, segments: int, *, centre: ArrayLike = (0.0, 0.0, 0.0)
) -> FloatArray:
    """Points on a helix around the z axis through ``centre``, from (radius, 0, 0) on, shape (segments + 1, 3).

    Args:
        radius: Radius [m].
        pitch: Rise per turn [m]; negative for a left-handed helix.
        turns: Number of turns.
        segments: Number of segments.
        centre: Point on the axis at the height of the first point [m].

    Raises:
        ValueError: For a radius or number of turns that is not positive.
    """
    turn = np.linspace(0.0, _positive(turns, "turns"), _segments(segments) + 1)
    a = 2.0 * np.pi * turn
    r = _positive(radius, "radius")
    pitch = checks.number(pitch, "pitch of a rod", low=-checks.FARTHEST, high=checks.FARTHEST)
    return _place(centre, "centre") + np.stack([r * np.cos(a), r * np.sin(a), pitch * turn], axis=1)


def _positive(value: float, what: str) -> float:
    return checks.number(value, f"{what} of a rod", above=0.0, high=checks.FARTHEST)


def _place(point: ArrayLike, what: str) -> FloatArray:
    return checks.array(point, f"{what} of a rod", (3,), need="be three finite numbers")


def _segments(count: int) -> int:
    return checks.count(count, "segments of a rod", high=MOST_SEGMENTS)


def _unit(direction: ArrayLike, what: str) -> FloatArray:
    need = "be three finite numbers, not all zero"
    vector = checks.array(direction, f"{what} of a rod", (3,), need=need)
    size = float(np.linalg.norm(vector))
    if not size > 0.0:
        raise ValueError(checks.refusal(f"{what} of a rod", need, direction))
    return np.asarray(vector / size)


def _points(points: ArrayLike) -> FloatArray:
    positions = checks.as_array(points)
    if positions.dtype.kind not in "fiu":
        raise ValueError(checks.refusal("points of a rod", "be numbers in shape (n, 3)", points))
    positions = np.array(positions, dtype=np.float64)
    if positions.ndim != 2 or positions.shape[1] != 3 or len(positions) < 2:
        raise ValueError(f"points of a rod must have shape (n, 3) with n >= 2, got {positions.shape}")
    if not np.isfinite(positions).all():
        bad = int(np.flatnonzero(~np.isfinite(positions).all(axis=1))[0])
        raise ValueError(f"point {bad} of a rod is {positions[bad]}; points must be finite")
    if np.abs(positions).max() > checks.FARTHEST:
        raise ValueError(f"points of a rod must lie within {checks.FARTHEST:g} m, got {np.abs(positions).max():g} m")
    chords = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    short = int(np.argmin(chords))
    if chords[short] <= SHORT * chords.max():
        raise ValueError(f"points {short} and {short + 1} of a rod coincide at {positions[short]} m; drop one of them")
    return positions


def _per_segment(value: ArrayLike, count: int, what: str, zero: bool = False) -> FloatArray:
    array = checks.as_array(value)
    if array.dtype.kind not in "fiu":
        raise ValueError(checks.refusal(f"{what} of a rod", "be a number or one per segment", value))
    array = array.astype(np.float64)
    if array.shape not in ((), (count,)):
        raise ValueError(f"{what} of a rod must be one number or one per segment ({count}), got shape {array.shape}")
    low = array < 0.0 if zero else array <= checks.SMALLEST
    low |= array > checks.FARTHEST
    if low.any() or not np.isfinite(array).all():
        bad = array[low | ~np.isfinite(array)].flat[0]
        raise ValueError(f"{what} of a rod must be {'at least zero' if zero else 'positive'} and finite, got {bad:g} m")
    return np.array(np.broadcast_to(array, (count,)))


def _tangents(positions: FloatArray) -> FloatArray:
    """Unit tangents at the nodes: those of the circles through three neighbours; mirrored at the chord for the ends."""
    chord = np.diff(positions, axis=0)
    size = np.linalg.norm(chord, axis=1, keepdims=True)
    direction = chord / size
    inner = direction[:-1] / size[:-1] + direction[1:] / size[1:]
    inner_size = np.linalg.norm(inner, axis=1, keepdims=True)
    fold = np.flatnonzero(inner_size[:, 0] * (size[:-1] + size[1:])[:, 0] < 1e-6)
    if len(fold):
        raise ValueError(
            f"a rod folds back on itself at point {fold[0] + 1}, {positions[fold[0] + 1]} m; round the bend"
        )
    inner = inner / inner_size
    if not len(inner):
        return np.repeat(direction, 2, axis=0)
    first = 2.0 * (direction[0] @ inner[0]) * direction[0] - inner[0]
    last = 2.0 * (direction[-1] @ inner[-1]) * direction[-1] - inner[-1]
    return np.concatenate([first[None], inner, last[None]])


def _first_normal(tangent: FloatArray, normal: ArrayLike | None) -> FloatArray:
    if normal is None:
        chosen = np.array([1.0, 0.0, 0.0] if abs(tangent[0]) < 0.9 else [0.0, 1.0, 0.0])
    else:
        chosen = _unit(normal, "normal")
    across = chosen - (chosen @ tangent) * tangent
    size = np.linalg.norm(across)
    if size < 1e-6:
        raise ValueError(f"normal of a rod must not point along its tangent {tangent}, got {normal!r}")
    return np.asarray(across / size)


def _transport(tangents: FloatArray, normal: FloatArray) -> FloatArray:
    """Frames (n, 3, 3) with columns d1, d2, tangent; each is the one before, turned the shortest way."""
    frames = np.empty((len(tangents), 3, 3))
    for i, t in enumerate(tangents):
        if i:
            before = tangents[i - 1]
            cosine = float(before @ t)
            if cosine < np.cos(ANGLE_MAX):
                angle = np.arccos(max(cosine, -1.0))
                raise ValueError(
                    f"a rod turns by {angle:.3g} rad between points {i - 1} and {i}; at most {ANGLE_MAX} rad are "
                    "possible: use shorter segments"
                )
            normal = normal - (normal @ t) / (1.0 + cosine) * (before + t)
            normal = normal - (normal @ t) * t
            normal = normal / np.linalg.norm(normal)
        frames[i] = np.stack([normal, np.cross(t, normal), t], axis=1)
    return frames


def _quaternions(frames: FloatArray) -> FloatArray:
    """Unit quaternions (x, y, z, w) of rotation matrices; neighbours have the same sign."""
    result = np.empty((len(frames), 4))
    for i, R in enumerate(frames):
        # K has the quaternion as eigenvector of its largest eigenvalue (Bar-Itzhack, 2000)
        K = np.empty((4, 4))
        K[:3, :3] = R + R.T - np.trace(R) * np.eye(3)
        K[:3, 3] = K[3, :3] = [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]
        K[3, 3] = np.trace(R)
        q = np.linalg.eigh(K)[1][:, -1]
        reference = result[i - 1] if i else np.array([0.0, 0.0, 0.0, 1.0])
        result[i] = -q if q @ reference < 0.0 else q
    return result


def _relative_motion(positions: FloatArray, frames: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Logarithm of the motion from each frame to the next: translation [m] and rotation vector, shapes (n - 1, 3)."""
    back = frames[:-1].transpose(0, 2, 1)
    d = (back @ np.diff(positions, axis=0)[:, :, None])[:, :, 0]
    q = _quaternions(np.concatenate([np.eye(3)[None], back @ frames[1:]]))[1:]
    q = q * np.where(q[:, 3:] < 0.0, -1.0, 1.0)
    sine = np.linalg.norm(q[:, :3], axis=1)
    half = np.arctan2(sine, q[:, 3])
    small = half < 1e-4  # where the first terms of the series are exact to rounding
    safe = np.where(small, 1.0, half)
    turn = q[:, :3] * np.where(small, 2.0 + half**2 / 3.0, 2.0 * half / np.where(small, 1.0, sine))[:, None]
    c = np.where(small, 1.0 / 12.0 + half**2 / 180.0, (1.0 - safe / np.tan(safe)) / (4.0 * safe**2))
    across = np.cross(turn, d)
    return d - 0.5 * across + c[:, None] * np.cross(turn, across), turn


def _curvature(curvature: ArrayLike, length: FloatArray) -> FloatArray:
    shapes = ((3,), (len(length), 3))
    need = f"be finite and of shape (3,) or ({len(length)}, 3)"
    array = checks.array(curvature, "curvature of a rod", *shapes, need=need)
    array = np.array(np.broadcast_to(array, (len(length), 3)))
    angle = np.linalg.norm(array, axis=1) * length
    worst = int(np.argmax(angle))
    if angle[worst] > ANGLE_MAX:
        raise ValueError(
            f"segment {worst} of a rod, {length[worst]:g} m, turns by {angle[worst]:.3g} rad with the curvature "
            f"{array[worst]} 1/m; at most {ANGLE_MAX} rad are possible: use shorter segments"
        )
    return array


def round_section(outer: FloatArray, inner: FloatArray, nu: float) -> FloatArray:
    """Area, shear area [m^2], I_x, I_y and torsion constant [m^4] of circles and rings, shape (n, 5)."""
    if (inner >= outer).any():
        bad = int(np.flatnonzero(inner >= outer)[0])
        raise ValueError(
            f"inner_radius of a rod must be below its radius, got {inner[bad]:g} m and {outer[bad]:g} m (segment {bad})"
        )
    checks.number(nu, "Poisson's ratio of a rod", above=-1.0, high=0.5)
    area = np.pi * (outer**2 - inner**2)
    second = np.pi / 4.0 * (outer**4 - inner**4)
    m2 = (inner / outer) ** 2
    shear = 6.0 * (1.0 + nu) * (1.0 + m2) ** 2 / ((7.0 + 6.0 * nu) * (1.0 + m2) ** 2 + (20.0 + 12.0 * nu) * m2)
    return np.stack([area, shear * area, second, second, 2.0 * second], axis=1)


def _given_section(section: ArrayLike, count: int) -> FloatArray:
    array = checks.as_array(section)
    if array.dtype.kind not in "fiu":
        raise ValueError(checks.refusal("section of a rod", "be numbers in shape (5,) or one row per segment", section))
    array = array.astype(np.float64)
    if array.shape not in ((5,), (count, 5)):
        raise ValueError(
            f"section of a rod must hold area, shear area, I_x, I_y and torsion constant, shape (5,) or ({count}, 5), "
            f"got shape {array.shape}"
        )
    if not (np.isfinite(array).all() and (array > 0.0).all()):
        raise ValueError(f"section of a rod must be positive and finite, got {section!r}")
    return np.array(np.broadcast_to(array, (count, 5)))


def _lumped(value: FloatArray) -> FloatArray:
    """Half of what every segment has, to each of its nodes."""
    nodes = np.zeros((len(value) + 1, *value.shape[1:]))
    nodes[:-1] += 0.5 * value
    nodes[1:] += 0.5 * value
    return nodes
