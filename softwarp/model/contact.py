"""Contact pairs of a scene: who may touch whom."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from softwarp.scene.parts import Handle

IntArray = NDArray[np.int32]


@dataclass
class ContactModel:
    """Host description of contact; every shard builds its detector from it.

    Attributes:
        names: Name of every pair.
        parts: Parts (a, b) of every pair.
        capacity: Contacts that a world can hold.
        scene: Objects and pairs, a ``plan.collision_scene.CollisionScene``.
        topology: How nodes and frames hang together, a ``solvers.collision.detector.Topology``.
        couple_sign: 1 where the feature side of a couple is part a of its pair, else -1, shape (couple,).
    """

    names: tuple[str, ...]
    parts: tuple[tuple[Handle, Handle], ...]
    capacity: int
    scene: Any
    topology: Any
    couple_sign: IntArray

    @property
    def count(self) -> int:
        """Pairs."""
        return len(self.names)

    def find(self, a: Handle, b: Handle) -> tuple[int, float]:
        """Pair of two parts, and 1 if they stand in this order, -1 in the other.

        Raises:
            ValueError: If no such pair was added; the message lists those that were.
        """
        for number, (first, second) in enumerate(self.parts):
            for sign, one, two in ((1.0, first, second), (-1.0, second, first)):
                if (one.kind, int(one)) == (a.kind, int(a)) and (two.kind, int(two)) == (b.kind, int(b)):
                    return number, sign
        raise ValueError(f"{a!r} and {b!r} are no contact pair; pairs are {', '.join(self.names)}; use add_contact")
