"""Numbers that several kinds of parts are given: vectors, poses and lists of nodes, checked once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from softwarp.scene.parts import FloatArray, IntArray
from softwarp.shapes.base import rotation_matrix

Box = tuple[Sequence[float], Sequence[float]]


def vector(value: Sequence[float], name: str) -> FloatArray:
    """Three finite numbers.

    Raises:
        ValueError: For anything else.
    """
    array = np.asarray(value, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ValueError(f"{name} must be three finite numbers, got {value!r}")
    return array


def as_pose(value: ArrayLike, name: str) -> FloatArray:
    """Position and unit quaternion x y z w from (3,), (7,) or a 4x4 matrix.

    Raises:
        ValueError: For another shape, numbers that are not finite, or a zero quaternion.
    """
    array = np.asarray(value, dtype=np.float64)
    if array.shape not in ((3,), (7,), (4, 4)) or not np.isfinite(array).all():
        raise ValueError(f"{name} must be 3 or 7 finite numbers or a 4x4 matrix, got {value!r}")
    if array.shape == (3,):
        return np.append(array, [0.0, 0.0, 0.0, 1.0])
    if array.shape == (4, 4):
        from scipy.spatial.transform import Rotation

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
    array = np.asarray(nodes)
    if array.dtype == bool and array.shape == (count,):
        array = np.flatnonzero(array)
    if array.size == 0 or array.ndim != 1 or not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"{name} must be a non-empty list of node indices, got {nodes!r}")
    wrong = array[(array < -count) | (array >= count)]
    if wrong.size:
        raise ValueError(f"{name}: index {int(wrong[0])} is outside {-count} .. {count - 1}")
    return np.unique(array % count).astype(np.int32)


def to_local(pose: FloatArray, point: FloatArray) -> FloatArray:
    """A point [m] in the axes of a pose."""
    return np.asarray(rotation_matrix(pose[3:]).T @ (point - pose[:3]))
