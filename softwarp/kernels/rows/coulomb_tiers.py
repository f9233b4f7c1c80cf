"""Which kernel of ``coulomb_warp`` solves a world's contacts: by their number. Theory: docs/theory/coulomb.md."""

import math
from dataclasses import dataclass

import warp as wp

from softwarp.kernels.algebra.lanes import Variant

WIDTH = 32  # threads of a warp
LINES = 8  # of Newton's system that are eliminated at a time, and that stand free behind its last one
# Kernels with one world a block: contacts of a thread, bytes of shared memory for the matrix and for Newton's system
NEAR = ((1, 22000, 0), (2, 49152, 0), (2, 0, 37000), (3, 0, 37000))


@dataclass(frozen=True)
class Tier:
    """Worlds whose contacts have a kernel to themselves.

    Attributes:
        above: Their contacts are more than this.
        most: And at most this.
        own_contacts: Contacts that a thread owns at most.
        near_rows: Rows of W whose lower triangle fits into shared memory; 0 reads W where it is.
        near_unknowns: Unknowns of Newton's method up to which its system lies there too.
    """

    above: int
    most: int
    own_contacts: int
    near_rows: int
    near_unknowns: int = 0


def tiers(variant: Variant, rows: int, capacity: int) -> list[Tier]:
    """Kernels that solve together for all worlds.

    Args:
        variant: Scalar type.
        rows: Static rows.
        capacity: Contacts of a world at most.
    """
    found, above = [], -1
    size = wp.types.type_size_in_bytes(variant.real)
    for own, available, spare in NEAR:
        entries = available // size
        near_rows = (math.isqrt(8 * entries + 1) - 1) // 2
        # (unknowns + LINES) (unknowns + 2) entries at most
        unknowns = max((math.isqrt((LINES - 2) ** 2 + 4 * (spare // size)) - LINES - 2) // 2, 0)
        unknowns -= 1 - unknowns % 2 if unknowns else 0  # lines of an odd number of entries lie in banks of their own
        room = (near_rows - rows) // 3 if available else capacity
        most = min(room, WIDTH * own, capacity)
        if most > above and (near_rows >= rows or not available):
            found.append(Tier(above, most, min(own, max(-(-most // WIDTH), 1)), near_rows, unknowns))
            above = most
    if above < capacity:
        found.append(Tier(above, capacity, max(-(-capacity // WIDTH), 1), 0))
    return found
