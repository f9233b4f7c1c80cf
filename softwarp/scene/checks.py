"""Numbers that several kinds of parts are given: vectors, poses and lists of nodes, checked once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from softwarp import checks
from softwarp.scene.parts import FloatArray, IntArray
from softwarp.shapes.base import check_rotation, rotation_matrix

Box = tuple[Sequence[float], Sequence[float]]


def vector(value: Sequence[float], name: str) -> FloatArray:
    """Three finite numbers.

    Raises:
        ValueError: For anything else.
    """
    limit = checks.FARTHEST
    return checks.array(value, name, (3,), low=-limit, high=limit, need="be three finite numbers")


def corners(box: Box, name: str) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest corner of a box [m].

    Raises:
        ValueError: For anything but two corners of three finite numbers each, the lowest first.
    """
    low, high = checks.array(box, f"{name}: box", (2, 3), need="be two corners ((x0, y0, z0), (x1, y1, z1)) [m]")
    if (low > high).any():
        raise ValueError(f"{name}: box corners must be (lowest, highest), got {box!r}")
    return low, high


def factors(value: Sequence[float], name: str) -> tuple[float, float]:
    """Rayleigh's factors of mass [1/s] and stiffness [s].

    Raises:
        ValueError: For anything but two finite numbers of at least 0.
    """
    mass, stiffness = checks.array(value, name, (2,), low=0.0, need="be two finite factors >= 0")
    return float(mass), float(stiffness)


def limits(values: dict[str, Any], name: str) -> dict[str, float]:
    """Limits as numbers, which may be infinite.

    Raises:
        ValueError: For what is no number.
    """
    return {key: checks.number(value, f"{name}: {key}", infinite=True) for key, value in values.items()}


def distance(value: float | None, name: str) -> float | None:
    """A length [m] of at least 0, or None.

    Raises:
        ValueError: For anything else.
    """
    return None if value is None else checks.number(value, name, low=0.0, high=checks.FARTHEST)


def as_pose(value: ArrayLike, name: str) -> FloatArray:
    """Position and unit quaternion x y z w from (3,), (7,) or a 4x4 matrix.

    Raises:
        ValueError: For another shape, numbers that are not finite, a zero quaternion, or a matrix that is no motion.
    """
    limit, shapes = checks.FARTHEST, ((3,), (7,), (4, 4))
    need = "be 3 or 7 finite numbers or a 4x4 matrix"
    array = checks.array(value, name, *shapes, low=-limit, high=limit, need=need)
    if array.shape == (3,):
        return np.append(array, [0.0, 0.0, 0.0, 1.0])
    if array.shape == (4, 4):
        from scipy.spatial.transform import Rotation

        check_rotation(array, name)
        return np.concatenate([array[:3, 3], Rotation.from_matrix(array[:3, :3]).as_quat()])
    length = float(np.linalg.norm(array[3:]))
    if length < 1e-6:
        raise ValueError(f"{name}: the quaternion x y z w must not be zero, got {value!r}")
    return np.append(array[:3], array[3:] / length)


def node_indices(nodes: ArrayLike | None, count: int, name: str) -> IntArray:
    """Sorted node indices from indices (negative ones count from the end) or flags.

    Raises:
        ValueError: For an empty list, or an index that does not exist.
    """
    array = checks.as_array(nodes)
    if array.dtype == bool and array.shape == (count,):
        array = np.flatnonzero(array)
    if array.size == 0 or array.ndim != 1 or not np.issubdtype(array.dtype, np.integer):
        raise ValueError(checks.refusal(name, "be a non-empty list of node indices", nodes))
    wrong = array[(array < -count) | (array >= count)]
    if wrong.size:
        raise ValueError(f"{name}: index {int(wrong[0])} is outside {-count} .. {count - 1}")
    return np.unique(array % count).astype(np.int32)


def to_local(pose: FloatArray, point: FloatArray) -> FloatArray:
    """A point [m] in the axes of a pose."""
    return np.asarray(rotation_matrix(pose[3:]).T @ (point - pose[:3]))
