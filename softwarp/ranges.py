"""What the fields of a dataclass may hold, declared beside them and checked in one way, for all options there are."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import types
import typing
from dataclasses import dataclass
from typing import Any

from softwarp.checks import LARGEST, choice, count, flag, number, refusal, shown


@dataclass(frozen=True)
class Range:
    """What the numbers of a field must be, declared in the annotation of a dataclass: ``Annotated[float, Range(...)]``.

    Of a tuple or list it holds for every entry.

    Attributes:
        low: Least value.
        high: Largest value.
        above: What it must lie above; 0 asks for a positive number.
        below: What it must lie below.
        infinite: Whether plus and minus infinity are allowed.
        rising: Whether the entries of a tuple are (low, high) with low <= high.
    """

    low: float = -LARGEST
    high: float = LARGEST
    above: float | None = None
    below: float | None = None
    infinite: bool = False
    rising: bool = False

    def __str__(self) -> str:
        """The interval, empty if any finite number will do."""
        if self == Range(infinite=self.infinite, rising=self.rising):
            return ""
        low = f"({self.above:g}" if self.above is not None else "(-inf" if self.low == -LARGEST else f"[{self.low:g}"
        high = f"{self.below:g})" if self.below is not None else "inf)" if self.high == LARGEST else f"{self.high:g}]"
        return f"in {low}, {high}"

    def check(self, value: Any, name: str) -> float:
        """The number as a float; one outside is refused, see ``number``."""
        low, high, infinite = self.low, self.high, self.infinite
        return number(value, name, low=low, high=high, above=self.above, below=self.below, infinite=infinite)


ANY = Range()
LONGEST = 2**63 - 1  # of any integer: a 64-bit one
Limit = typing.Annotated[float, Range(infinite=True)]  # of what may be unlimited
Seed = typing.Annotated[int, Range(low=0, high=LONGEST)]


def check_fields(record: Any, owner: str = "") -> None:
    """Refuse values that the annotations of a dataclass do not allow; others become of the types that it declares.

    Numbers must be finite and of their type, whether they have a ``Range`` or not; None must be declared. Lists become
    the declared tuples, integers and scalars of NumPy the declared floats: tensors made of them are of floats then.

    Args:
        record: Instance of a dataclass; its fields are looked at, and replaced, in place.
        owner: What messages call it; empty takes the name of its class.

    Raises:
        ValueError: With the name of the field, its value and what it must be.
    """
    cls: Any = type(record)
    hints = hints_of(cls)
    for entry in dataclasses.fields(record):
        value = getattr(record, entry.name)
        checked = _checked(value, hints[entry.name], ANY, f"{owner or type(record).__name__}: {entry.name}")
        if checked is not value:
            object.__setattr__(record, entry.name, checked)


@functools.cache
def hints_of(cls: type) -> dict[str, Any]:
    """Types of all fields; one that a subclass declares anew without a ``Range`` keeps that of its base."""
    hints: dict[str, Any] = {}
    for base in reversed(cls.__mro__):
        own = typing.get_type_hints(base, include_extras=True)
        for name in inspect.get_annotations(base):
            hint, before = own[name], hints.get(name)
            is_same = typing.get_origin(before) is typing.Annotated and typing.get_args(before)[0] == hint
            hints[name] = before if is_same else hint
    return hints


def range_of(hint: Any) -> Range:
    """The range that an annotation declares, at any depth; ``ANY`` without one."""
    if typing.get_origin(hint) is typing.Annotated:
        own = [note for note in hint.__metadata__ if isinstance(note, Range)]
        return own[0] if own else range_of(typing.get_args(hint)[0])
    found = (range_of(part) for part in typing.get_args(hint))
    return next((limits for limits in found if limits is not ANY), ANY)


def _checked(value: Any, hint: Any, limits: Range, name: str) -> Any:
    """The value, as of the types that the hint declares."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        declared = next((note for note in arguments[1:] if isinstance(note, Range)), limits)
        return _checked(value, arguments[0], declared, name)
    if origin in (typing.Union, types.UnionType):
        kinds = [kind for kind in arguments if kind is not type(None)]
        return value if value is None and len(kinds) < len(arguments) else _checked(value, kinds[0], limits, name)
    if origin in (tuple, list):
        return _checked_entries(value, origin, arguments, limits, name)
    if origin is typing.Literal:
        choice(value, name, arguments)
    elif hint is bool:
        return flag(value, name)
    elif hint is int:
        low = -LONGEST if limits.low == -LARGEST else int(limits.low)
        return count(value, name, low=low, high=LONGEST if limits.high == LARGEST else int(limits.high))
    elif hint is float:
        return limits.check(value, name)
    elif hint is str and not isinstance(value, str):
        raise ValueError(refusal(name, "be a text", value))
    return value


def _checked_entries(value: Any, origin: type, arguments: tuple[Any, ...], limits: Range, name: str) -> Any:
    """Entries of a tuple or list, each by its own hint."""
    if not isinstance(value, (tuple, list)):
        raise ValueError(refusal(name, "be a tuple or a list", value))
    is_open = origin is list or Ellipsis in arguments
    if not is_open and len(value) != len(arguments):
        raise ValueError(f"{name} must have {len(arguments)} values, got {shown(value)}")
    hints = [arguments[0]] * len(value) if is_open else arguments
    entries = [
        _checked(entry, hint, limits, f"{name}[{i}]") for i, (entry, hint) in enumerate(zip(value, hints, strict=True))
    ]
    if limits.rising and len(value) == 2 and not value[0] <= value[1]:
        raise ValueError(refusal(name, "be (low, high) with low <= high", value))
    return origin(entries)
