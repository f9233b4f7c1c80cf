"""Which kernel of ``coulomb_warp`` solves a world's contacts: by their number. Theory: docs/theory/coulomb.md."""

import math
from dataclasses import dataclass

import warp as wp

from softwarp.kernels.algebra.lanes import Variant

WIDTH = 32  # threads of a warp
NEAR_BYTES = (22000, 49152)  # of shared memory for a world's matrix, in two sizes: ten or four worlds a multiprocessor


@dataclass(frozen=True)
class Tier:
    """Worlds whose contacts have a kernel to themselves.

    Attributes:
        above: Their contacts are more than this.
        most: And at most this.
        own_contacts: Contacts that a thread owns at most.
        near_rows: Rows of W whose lower triangle fits into shared memory; 0 reads W where it is.
    """

    above: int
    most: int
    own_contacts: int
    near_rows: int


def tiers(variant: Variant, rows: int, capacity: int) -> list[Tier]:
    """Kernels that solve together for all worlds.

    Args:
        variant: Scalar type.
        rows: Static rows.
        capacity: Contacts of a world at most.
    """
    found, above = [], -1
    for number, available in enumerate(NEAR_BYTES):
        entries = available // wp.types.type_size_in_bytes(variant.real)
        near_rows = (math.isqrt(8 * entries + 1) - 1) // 2
        most = min((near_rows - rows) // 3, WIDTH * (number + 1), capacity)
        if most > above and near_rows >= rows:
            found.append(Tier(above, most, number + 1, near_rows))
            above = most
    if above < capacity:
        found.append(Tier(above, capacity, max(-(-capacity // WIDTH), 1), 0))
    return found
