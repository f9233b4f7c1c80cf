"""What a robot holds by friction, for inverse control. Theory: docs/theory/laws.md."""

from __future__ import annotations

import math
from dataclasses import dataclass

from softwarp import checks


@dataclass(frozen=True)
class Grip:
    """Keeps the sum of the normal forces of a contact pair in a range, so that what is held goes on being held.

    Attributes:
        pair: From ``ModelBuilder.add_contact``.
        least: Sum of the normal forces [N] that is kept at least, where it can be.
        most: Largest sum [N].

    Raises:
        ValueError: For what is no number of a pair, and forces that are not positive or exclude each other.
    """

    pair: int
    least: float
    most: float = math.inf

    def __post_init__(self) -> None:
        """Refuse what no scene can have."""
        checks.count(self.pair, "grip: pair", low=0)
        checks.number(self.least, "grip: least [N]", above=0.0)
        checks.number(self.most, "grip: most [N]", low=self.least, infinite=True)
