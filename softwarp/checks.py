"""What arguments must be: numbers, counts, flags, choices, names and arrays, each checked once, where it comes in.

Every refusal is a ``ValueError`` that names the argument, what it must be, and what was given.
"""

from __future__ import annotations

import math
import numbers
import os
import reprlib
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

LARGEST = 1.0e30  # of any finite number: float32 holds it, and kernels take it for no bound
FARTHEST = 1.0e9  # m, of any length or coordinate: its cube is finite in float32
SMALLEST = 1.0e-30  # of any positive number: float32 holds it
MOST = 2**31 - 1  # of any count: the largest 32-bit integer

_SHORT = reprlib.Repr()
_SHORT.maxlist = _SHORT.maxtuple = 8
_SHORT.maxstring = _SHORT.maxother = 80


def shown(value: Any) -> str:
    """A value as messages show it, on one line of bounded length."""
    return " ".join(_SHORT.repr(value).split())


def number(
    value: Any,
    name: str,
    *,
    low: float = -LARGEST,
    high: float = LARGEST,
    above: float | None = None,
    below: float | None = None,
    infinite: bool = False,
    advice: str = "",
) -> float:
    """The value as a float.

    Args:
        value: A real number of Python, NumPy or torch; flags are none.
        name: Object, argument and unit, for the message.
        low: Least value.
        high: Largest value.
        above: What it must lie above; 0 asks for a positive number.
        below: What it must lie below.
        infinite: Whether plus and minus infinity are allowed, where the limits are.
        advice: The way out, for the end of the message.

    Raises:
        ValueError: For anything else.
    """
    found = _real(value)
    if found is not None and (math.isfinite(found) or (infinite and math.isinf(found))):
        is_within = low <= found <= high or (infinite and math.isinf(found) and _unbounded(found, low, high))
        is_within &= above is None or found > (max(above, SMALLEST) if above == 0.0 else above)
        is_within &= below is None or found < below
        if is_within:
            return found
    raise ValueError(refusal(name, _need(low, high, above, below, infinite), value, advice))


def _real(value: Any) -> float | None:
    """A real number as a float, or None: also of arrays and tensors without axes."""
    if getattr(value, "shape", None) == () and hasattr(value, "item"):
        try:
            value = value.item()
        except (RuntimeError, TypeError, ValueError):
            return None
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, numbers.Real):
        return None
    try:
        return float(value)
    except OverflowError:
        return None


def _unbounded(value: float, low: float, high: float) -> bool:
    return high >= LARGEST if value > 0.0 else low <= -LARGEST


def _need(low: float, high: float, above: float | None, below: float | None, infinite: bool) -> str:
    """What a number must be, in words."""
    left = f"({above:g}" if above is not None else f"[{low:g}" if low > -LARGEST else ""
    right = f"{below:g})" if below is not None else f"{high:g}]" if high < LARGEST else ""
    kind = "a number" if infinite else "a finite number"
    if left and right:
        return f"lie in {left}, {right}"
    if left == "(0":
        return "be positive" + ("" if infinite else " and finite")
    if left:
        bound = f"above {above:g}" if above is not None else f"at least {low:g}"
        return f"be {bound}" + ("" if infinite else " and finite")
    if right:
        bound = f"below {below:g}" if below is not None else f"at most {high:g}"
        return f"be {bound}" + ("" if infinite else " and finite")
    return f"be {kind}"


def count(value: Any, name: str, *, low: int = 1, high: int = MOST, advice: str = "") -> int:
    """The value as an int; integers of Python and NumPy count, flags and floats do not.

    Raises:
        ValueError: For anything else, or an integer outside [low, high].
    """
    is_integer = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if is_integer and low <= int(value) <= high:
        return int(value)
    need = f"be an integer of at least {low}" + (f" and at most {high}" if is_integer and int(value) > high else "")
    raise ValueError(refusal(name, need, value, advice))


def seed(value: Any, name: str = "seed") -> int:
    """The value as an int that random generators take.

    Raises:
        ValueError: For anything but an integer in [0, 2^63).
    """
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool) and 0 <= int(value) < 2**63:
        return int(value)
    raise ValueError(refusal(name, "be an integer that lies in [0, 2^63)", value))


def flag(value: Any, name: str) -> bool:
    """The value as a bool.

    Raises:
        ValueError: For anything but True and False.
    """
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    raise ValueError(refusal(name, "be True or False", value))


def choice(value: Any, name: str, allowed: Collection[str]) -> str:
    """The value, one of some words.

    Raises:
        ValueError: For anything else.
    """
    if isinstance(value, str) and value in allowed:
        return value
    raise ValueError(refusal(name, f"be one of {', '.join(allowed)}", value))


def label(value: Any, default: str, name: str = "name") -> str:
    """A name that the user gave, or the default for None.

    Raises:
        ValueError: For anything but a text of at least one character.
    """
    if value is None:
        return default
    if isinstance(value, str) and value.strip():
        return value
    raise ValueError(refusal(name, "be a text of at least one character, or None", value, f"it stands for {default!r}"))


def path(value: Any, name: str) -> str:
    """The value as the path of a file.

    Raises:
        ValueError: For anything but a path of at least one character.
    """
    if isinstance(value, (str, os.PathLike)):
        text = os.fspath(value)
        if isinstance(text, str) and text.strip() and "\0" not in text:
            return text
    raise ValueError(refusal(name, "be the path of a file or folder", value))


def array(
    value: Any,
    name: str,
    *shapes: tuple[int | None, ...],
    low: float = -LARGEST,
    high: float = LARGEST,
    above: float | None = None,
    need: str = "",
) -> NDArray[np.float64]:
    """The value as an array of finite numbers; None in a shape stands for any length.

    Args:
        value: Numbers in lists, arrays or tensors of a CPU; a copy is made only where the type changes.
        name: Object, argument and unit, for the message.
        shapes: What its shape may be; none allow all.
        low: Least value.
        high: Largest value.
        above: What all values must lie above.
        need: What it must be, in words, for the message; empty tells shapes and limits.

    Raises:
        ValueError: For anything else.
    """
    found = as_array(value)
    if found.dtype.kind in "fiu" and _fits(found.shape, shapes):
        result = found.astype(np.float64, copy=False)
        is_within = np.isfinite(result) & (result >= low) & (result <= high)
        if above is not None:
            is_within &= result > (max(above, SMALLEST) if above == 0.0 else above)
        if bool(is_within.all()):
            return np.asarray(result)
    wanted = need or f"{_need(low, high, above, None, False)}, in shape {_shapes_text(shapes)}"
    raise ValueError(refusal(name, wanted, value))


def integers(
    value: Any, name: str, *shapes: tuple[int | None, ...], low: int = 0, high: int = MOST, need: str = ""
) -> NDArray[np.int32]:
    """The value as an array of 32-bit integers, checked before it is cast.

    Raises:
        ValueError: For other types or shapes, and for integers outside [low, high].
    """
    found = as_array(value)
    if found.dtype.kind in "iu" and _fits(found.shape, shapes):
        if bool(((found >= low) & (found <= high)).all()):
            return found.astype(np.int32)
    wanted = need or f"be integers in [{low}, {high}], in shape {_shapes_text(shapes)}"
    raise ValueError(refusal(name, wanted, value))


def as_array(value: Any) -> NDArray[Any]:
    """What was given as an array of its own type, before anything is cast; one object without axes if NumPy has none.

    So rows of several lengths, or memory of a GPU, are refused by type and shape as all else is.
    """
    try:
        return np.asarray(value)
    except (ValueError, TypeError, RuntimeError, OverflowError):
        return np.asarray(None)


def _fits(shape: tuple[int, ...], allowed: Sequence[tuple[int | None, ...]]) -> bool:
    def matches(wanted: tuple[int | None, ...]) -> bool:
        return len(wanted) == len(shape) and all(w in (None, s) for w, s in zip(wanted, shape, strict=True))

    return not allowed or any(matches(wanted) for wanted in allowed)


def _shapes_text(shapes: Sequence[tuple[int | None, ...]]) -> str:
    def text(shape: tuple[int | None, ...]) -> str:
        return "(" + ", ".join("n" if size is None else str(size) for size in shape) + ")"

    return " or ".join(map(text, shapes)) or "(...)"


def refusal(name: str, need: str, value: Any, advice: str = "") -> str:
    """The message that refuses a value."""
    return f"{name} must {need}, got {_given(value)}" + (f"; {advice}" if advice else "")


def _given(value: Any) -> str:
    """What was given: arrays by type and shape, and by their values where these are few."""
    shape, dtype = getattr(value, "shape", ()), getattr(value, "dtype", None)
    if dtype is None or not isinstance(shape, tuple) or not shape:
        return shown(value)
    values = f" {shown(value.tolist())}" if math.prod(shape) <= 16 else ""
    return f"{dtype} {tuple(shape)}{values}"
