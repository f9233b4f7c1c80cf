"""Parameters that are looked for: bounds, scale, start, and the unit interval that fits work in.

A fit sees u in [0, 1]: p = low + u (high - low) on a linear scale, p = low (high / low)^u on a logarithmic one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from softwarp import checks
from softwarp.advice import nearest

FloatArray = NDArray[np.float64]

STEP = 5.0e-3  # of differences, as a part of the bounds: 1e-7 of rounding in float32 becomes 1e-5 of a slope of one
LARGEST_STEP = 0.25


@dataclass(frozen=True)
class Parameter:
    """A physical quantity that a fit looks for.

    Attributes:
        name: What tables and messages call it.
        low: Least value, in its unit.
        high: Largest value, above ``low``.
        scale: ``log`` for what is positive and known to an order of magnitude, such as a modulus.
        start: Where the fit begins; None takes the middle of the bounds in the parameter's scale.
        unit: For tables.
        target: Array of ``sim.params`` that ``Worlds`` writes it to, or ``law.`` and the name of a parameter of the
            material of body ``item``, as in ``law.c10``; empty for what the residuals use themselves.
        item: Body, rod, cable, pair or component of the target; None writes all.
        step: Step of differences as a part of the bounds.

    Raises:
        ValueError: For bounds that are not finite and ordered, bounds of a logarithmic scale that are not positive, a
            start outside the bounds, another scale, and what is no text or number where one is meant.
    """

    name: str
    low: float
    high: float
    scale: Literal["linear", "log"] = "linear"
    start: float | None = None
    unit: str = ""
    target: str = ""
    item: int | None = None
    step: float = STEP

    def __post_init__(self) -> None:
        if self.name is None:
            raise ValueError(checks.refusal("name of a parameter", "be a text of at least one character", self.name))
        label = f"parameter {checks.label(self.name, '', 'name of a parameter')!r}"
        for what, text in (("unit", self.unit), ("target", self.target)):
            if not isinstance(text, str):
                raise ValueError(checks.refusal(f"{label}: {what}", "be a text", text))
        if self.item is not None:
            object.__setattr__(self, "item", checks.count(self.item, f"{label}: item", low=0))
        checks.choice(self.scale, f"{label}: scale", ("linear", "log"))
        low = checks.number(self.low, f"{label}: low")
        checks.number(self.high, f"{label}: high", above=low)
        if self.scale == "log" and low <= 0.0:
            advice = "raise it, or take scale='linear'"
            raise ValueError(checks.refusal(f"{label}: low", "be positive on a logarithmic scale", self.low, advice))
        if self.start is not None:
            checks.number(self.start, f"{label}: start", low=low, high=self.high)
        checks.number(self.step, f"{label}: step", above=0.0, high=LARGEST_STEP)

    def value(self, u: Any) -> Any:
        """Values of places in [0, 1], of the same shape."""
        if self.scale == "log":
            return self.low * np.exp(np.multiply(u, np.log(self.high / self.low)))
        return self.low + np.multiply(u, self.high - self.low)

    def place(self, value: Any) -> Any:
        """Places in [0, 1] of values, of the same shape."""
        if self.scale == "log":
            return np.log(np.divide(value, self.low)) / np.log(self.high / self.low)
        return np.subtract(value, self.low) / (self.high - self.low)

    def slope(self, value: float) -> float:
        """dp/du at a value."""
        return value * float(np.log(self.high / self.low)) if self.scale == "log" else self.high - self.low


class Space:
    """All parameters of a fit, and the way between values and places in the unit cube.

    Args:
        parameters: At least one, with names that differ.

    Raises:
        ValueError: For none, two of one name, or what is no ``Parameter``.
    """

    def __init__(self, parameters: Sequence[Parameter]) -> None:
        self.parameters = list(parameters) if isinstance(parameters, Iterable) else []
        if not self.parameters:
            raise ValueError(checks.refusal("fit: parameters", "hold at least one Parameter", parameters))
        for parameter in self.parameters:
            if not isinstance(parameter, Parameter):
                raise ValueError(checks.refusal("fit: parameters", "hold Parameter(name, low, high)", parameter))
        self.names = [parameter.name for parameter in self.parameters]
        twice = {name for name in self.names if self.names.count(name) > 1}
        if twice:
            raise ValueError(f"fit: parameter {sorted(twice)[0]!r} is given twice; names must differ")

    def __len__(self) -> int:
        return len(self.parameters)

    def values(self, u: FloatArray) -> FloatArray:
        """Values (..., parameter) of places (..., parameter)."""
        return np.stack([p.value(u[..., i]) for i, p in enumerate(self.parameters)], axis=-1).astype(np.float64)

    def places(self, values: FloatArray) -> FloatArray:
        """Places (..., parameter) of values (..., parameter)."""
        return np.stack([p.place(values[..., i]) for i, p in enumerate(self.parameters)], axis=-1).astype(np.float64)

    def slopes(self, values: FloatArray) -> FloatArray:
        """dp/du at values, shape (parameter,)."""
        return np.array([p.slope(float(v)) for p, v in zip(self.parameters, values, strict=True)])

    def steps(self) -> FloatArray:
        """Steps of differences in u, shape (parameter,)."""
        return np.array([p.step for p in self.parameters])

    def start(self, given: Mapping[str, float] | None) -> FloatArray:
        """Place where a fit begins, shape (parameter,).

        Args:
            given: Values by name, in place of the parameters' own.

        Raises:
            ValueError: For a name that no parameter has, or a value outside its bounds.
            TypeError: For what has no names.
        """
        if not (given is None or isinstance(given, Mapping)):
            raise TypeError(checks.refusal("fit: start", "be values by name, {'modulus': 1e5}", given))
        chosen: dict[str, float | None] = {p.name: p.start for p in self.parameters}
        for name, told in ({} if given is None else given).items():
            if name not in chosen:
                raise ValueError(f"fit: start has {name!r}, which is no parameter; {nearest(name, self.names)}")
            chosen[name] = told
        u = np.full(len(self), 0.5)
        for i, p in enumerate(self.parameters):
            value = chosen[p.name]
            if value is not None:
                u[i] = p.place(checks.number(value, f"fit: start of {p.name!r}", low=p.low, high=p.high))
        return u
