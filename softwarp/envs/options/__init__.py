"""What options of scenes and tasks may be: kinds of numbers with plausible ranges, declared as the types of fields.

A field that declares no kind takes any finite number. ``check_options`` looks at all fields, of every environment.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

from softwarp.advice import nearest
from softwarp.ranges import Range, check_fields

Length = Annotated[float, Range(low=1.0e-6, high=1.0e3)]  # m, of what has an extent
Distance = Annotated[float, Range(low=0.0, high=1.0e3)]  # m
Place = Annotated[float, Range(low=-1.0e3, high=1.0e3)]  # m, a coordinate, a displacement
Sizes = Annotated[tuple[float, float, float], Range(low=1.0e-6, high=1.0e3)]  # m
Places = Annotated[tuple[float, float], Range(low=-1.0e3, high=1.0e3)]  # m
PlaceRange = Annotated[tuple[float, float], Range(low=-1.0e3, high=1.0e3, rising=True)]  # m
LengthRange = Annotated[tuple[float, float], Range(low=1.0e-6, high=1.0e3, rising=True)]  # m
AngleRange = Annotated[tuple[float, float], Range(low=-6.3, high=6.3, rising=True)]  # rad
PositiveRange = Annotated[tuple[float, float], Range(above=0.0, high=1.0e13, rising=True)]
HalfAngle = Annotated[float, Range(low=0.0, high=math.pi)]  # rad
Fraction = Annotated[float, Range(low=-1.0, high=1.0)]
Force = Annotated[float, Range(low=-1.0e9, high=1.0e9)]  # N
Mass = Annotated[float, Range(low=1.0e-9, high=1.0e9)]  # kg
Pressure = Annotated[float, Range(above=0.0, high=1.0e6)]  # Pa, of air in soft bodies
Density = Annotated[float, Range(low=0.0, high=1.0e6)]  # kg/m^3
Modulus = Annotated[float, Range(low=1.0, high=1.0e13)]  # Pa
PoissonRatio = Annotated[float, Range(above=-1.0, below=0.5)]  # of solids
RodPoissonRatio = Annotated[float, Range(above=-1.0, high=0.5)]
Rayleigh = Annotated[tuple[float, float], Range(low=0.0, high=1.0e6)]  # 1/s on mass, s on stiffness
Damping = Annotated[float, Range(low=0.0, high=1.0e6)]  # 1/s
Gravity = Annotated[tuple[float, float, float], Range(low=-1.0e4, high=1.0e4)]  # m/s^2
Speed = Annotated[float, Range(low=1.0e-9, high=1.0e3)]  # m/s
Spread = Annotated[float, Range(low=0.0, high=1.0e3)]  # of draws around 0
Unlimited = Annotated[float, Range(low=0.0, infinite=True)]  # of a rate
LowLimit = Annotated[float, Range(high=1.0e9, infinite=True)]  # -inf for none
HighLimit = Annotated[float, Range(low=-1.0e9, infinite=True)]  # inf for none
Angle = Annotated[float, Range(low=-6.3, high=6.3)]  # rad, at most a turn
Share = Annotated[float, Range(low=0.0, below=1.0)]
Positive = Annotated[float, Range(above=0.0, high=1.0e9)]
NotNegative = Annotated[float, Range(low=0.0, high=1.0e9)]
Duration = Annotated[float, Range(low=1.0e-6, high=1.0e3)]  # s
Wait = Annotated[float, Range(low=0.0, high=1.0e3)]  # s
Looks = Annotated[int, Range(low=0, high=100)]
Count = Annotated[int, Range(low=1, high=1_000_000)]
Further = Annotated[int, Range(low=0, high=1_000_000)]  # of what there need not be
Pieces = Annotated[int, Range(low=1, high=1_000)]
Pixels = Annotated[int, Range(low=1, high=16_384)]


def check_options(config: Any) -> None:
    """Turn lists into the tuples that a dataclass declares (YAML has no tuples); refuse what a field cannot hold.

    Args:
        config: Instance of a dataclass; its fields are looked at, and lists replaced, in place.

    Raises:
        ValueError: With the name of the option, its value and what it must be.
    """
    check_fields(config)


def check_choice(config: object, name: str, choices: tuple[str, ...]) -> None:
    """Refuse an option's value that is not one of its choices.

    Raises:
        ValueError: With the nearest choices.
    """
    value = getattr(config, name)
    if value not in choices:
        raise ValueError(f"{type(config).__name__}: unknown {name} {value!r}; {nearest(str(value), choices)}")


def check_borne(config: Any, borne: float) -> None:
    """Refuse a ``min_tension`` with which cables crush a body whatever they are told.

    Args:
        config: Options with ``min_tension`` [N] and ``youngs`` [Pa].
        borne: Largest tension over modulus that the body bears [m^2].

    Raises:
        ValueError: With the largest tension.
    """
    most = borne * config.youngs
    if config.min_tension > most:
        raise ValueError(
            f"{type(config).__name__}: min_tension must be at most {most:.3g} N, got {config.min_tension!r}: cables "
            f"that never pull less crush a body whose youngs is {config.youngs:g} Pa; make youngs larger or "
            "min_tension smaller"
        )
