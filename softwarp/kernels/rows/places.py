"""Places of dofs on the path of a contact, or of a group of contacts, in SIMD registers on a CPU in float32.

An entry of a path has nine numbers in eight lanes, whether those are worlds or contacts of one world. Theory:
docs/theory/contact.md.
"""

from functools import cache
from typing import Any

import warp as wp

_NUMBER = """
int* const place = &wp::index(place_out, w, base);
int* const path = &wp::index(path_out, w, start);
int found = 0;
for (int row = first; row < size; ++row)
    if (place[row] >= 0) {
        place[row] = found;
        path[found++] = row;
    }
if (found > 0) __builtin_memset((void*)&wp::index(side_out, w, ENTRY * start), 0, 72 * found * sizeof(float));
return found;
"""


@wp.func_native("__builtin_memset(&wp::index(place_out, w, first), 0xff, count * sizeof(int));")
def unplace(place_out: wp.array2d(dtype=wp.int32), w: int, first: int, count: int):
    """Set the places of ``count`` dofs to -1, none."""


@cache
def numbering(scalar: Any) -> wp.Function:
    """Number the dofs from ``first`` on that have a place, list them, and clear their sides; returns how many.

    Args:
        scalar: What sides consist of: vectors of eight lanes, or single numbers, eight for each of them.
    """

    @wp.func_native(_NUMBER.replace("ENTRY", "9" if scalar is not wp.float32 else "72"))
    def number_places(
        place_out: wp.array2d(dtype=wp.int32),
        path_out: wp.array2d(dtype=wp.int32),
        side_out: wp.array2d(dtype=scalar),
        w: int,
        base: int,
        first: int,
        size: int,
        start: int,
    ) -> int:
        """Places, paths and sides of one contact or group."""

    return number_places
