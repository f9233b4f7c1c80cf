"""What all options of scenes and tasks have in common: numbers that are numbers, tuples of the declared length."""

from __future__ import annotations

import dataclasses
import math
import typing
from typing import Any


def check_options(config: Any) -> None:
    """Turn lists into the tuples that a dataclass declares (YAML has no tuples); refuse nan and wrong lengths.

    Args:
        config: Instance of a dataclass; its fields are looked at, and lists replaced, in place.

    Raises:
        ValueError: With the name of the option, its value and what it must be.
    """
    hints, owner = typing.get_type_hints(type(config)), type(config).__name__
    for name in (field.name for field in dataclasses.fields(config)):
        value, hint = getattr(config, name), hints[name]
        kinds = (hint, *typing.get_args(hint))  # of an optional tuple, its tuple stands among the arguments
        declared = [typing.get_args(kind) for kind in kinds if typing.get_origin(kind) is tuple]
        if declared and isinstance(value, list | tuple):
            value = tuple(value)
            setattr(config, name, value)
            if Ellipsis not in declared[0] and len(value) != len(declared[0]):
                raise ValueError(f"{owner}: {name} must have {len(declared[0])} values, got {value}")
        numbers = value if isinstance(value, tuple) else (value,)
        if any(isinstance(number, float) and math.isnan(number) for number in numbers):
            raise ValueError(f"{owner}: {name} must be a number, got {value}")
