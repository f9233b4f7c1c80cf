"""Arrays with named axes: what a container declares is brought to its type and shape, or refused."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Declared = Mapping[str, tuple[tuple[str | int, ...], str]]  # name -> (axes, dtype); a number is a fixed length


class TrajectoryError(ValueError):
    """A recording or a trajectory file that cannot be used, and why."""


def nothing() -> NDArray[Any]:
    """The value of an array that has not been given."""
    return np.empty(0)


def normalise(container: Any, declared: Declared, sizes: dict[str, int], optional: tuple[str, ...] = ()) -> None:
    """Give every declared array of a frozen dataclass its type, and check its shape.

    Axes named alike have the same length: the first array to use a name sets it. An array that was not given becomes
    an empty one of the right shape.

    Args:
        container: Holds the arrays as attributes.
        declared: Axes and type of every array, in the order of checking.
        sizes: Lengths of axes known so far; the new ones are added.
        optional: Arrays that may be None.

    Raises:
        TrajectoryError: If a shape does not fit, or an array is missing although there is something to describe.
    """
    for field, (axes, dtype) in declared.items():
        value = getattr(container, field)
        if value is None and field in optional:
            continue
        given = np.asarray(value)
        if given.dtype.kind not in "biuf":
            raise TrajectoryError(f"trajectory: {field} must be numbers, got {given.dtype}")
        array = np.ascontiguousarray(given, dtype=dtype)
        if array.shape == (0,):
            shape = tuple(axis if isinstance(axis, int) else sizes.get(axis, 0) for axis in axes)
            if math.prod(shape):
                raise TrajectoryError(f"trajectory: {field} is missing; it must have shape {shape}")
            array = np.zeros(shape, dtype=dtype)
        object.__setattr__(container, field, array)
        _check_shape(field, array.shape, axes, sizes)


def _check_shape(field: str, shape: tuple[int, ...], axes: tuple[str | int, ...], sizes: dict[str, int]) -> None:
    pairs = zip(axes, shape, strict=False)
    wanted = [axis if isinstance(axis, int) else sizes.setdefault(axis, length) for axis, length in pairs]
    if len(shape) != len(axes) or list(shape) != wanted:
        named = ", ".join(str(axis) if isinstance(axis, int) else f"{axis} {sizes.get(axis, '?')}" for axis in axes)
        raise TrajectoryError(f"trajectory: {field} must have shape ({named}), got {shape}")
