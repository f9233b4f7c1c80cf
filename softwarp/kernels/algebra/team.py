"""Long sums on a GPU: some threads of a warp share one of a world, and add what each has in a fixed order.

Eight worlds lie beside each other in a warp, whose accesses so take in whole sectors of 32 bytes.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import Variant

BESIDE = 8  # worlds of a warp
PARTS = 4  # threads that share a sum

_EXCHANGE = """
#if defined(__CUDA_ARCH__)
return __shfl_xor_sync(0xffffffffu, value, offset);
#else
if (WP_TILE_BLOCK_DIM == 1) return value;
static SCALAR slots[1024];
slots[WP_TILE_THREAD_IDX] = value;
WP_TILE_SYNC();
const SCALAR result = slots[WP_TILE_THREAD_IDX ^ offset];
WP_TILE_SYNC();
return result;
#endif
"""


def exchange_code(real: Any) -> str:
    """Native code of the value of the thread whose number differs in the bits of ``offset``."""
    return _EXCHANGE.replace("SCALAR", "double" if real is wp.float64 else "float")


def team(device: Any, worlds: int, sums: int) -> tuple[int, int]:
    """Threads that share a sum on a device, and those of a launch in all, for so many sums of each world."""
    parts = PARTS if wp.get_device(device).is_cuda else 1
    return parts, sums * -(-worlds // BESIDE) * BESIDE * parts


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """What kernels with such sums share, for one scalar type of the ``cuda`` variant."""
    S = variant.S

    @wp.func_native(exchange_code(S))
    def exchange(value: S, offset: int) -> S: ...

    @wp.func
    def seat(place: int, sums: int, parts: int):
        """Sum, world and part of a thread: ``BESIDE`` worlds have all their sums before the next."""
        rest = place // (wp.static(BESIDE) * parts)
        world = rest // sums * wp.static(BESIDE) + place % wp.static(BESIDE)
        return rest % sums, world, place // wp.static(BESIDE) % parts

    @wp.func
    def whole(part: S, parts: int):
        """What the threads of a sum have together; all threads of a warp take part."""
        total = part
        offset = wp.static(BESIDE) * parts // 2
        while offset >= wp.static(BESIDE):
            total += exchange(total, offset)
            offset = offset // 2
        return total

    return SimpleNamespace(seat=seat, whole=whole)
