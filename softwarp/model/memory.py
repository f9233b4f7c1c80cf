"""Memory: what arrays take, what a device has free, and the refusal of what does not fit before it is allocated.

Arrays that grow with the number of worlds are made by ``zeros``. Within ``counting`` it adds up bytes and gives arrays
without memory, so that what a batch takes is said by the code that allocates it, not by formulas beside it. Within
``pooled`` it gives one owner after the other the same arrays.
"""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

import warp as wp

from softwarp import host

NOWHERE = 4096  # address of arrays that are only counted; nothing may be read or written there


@dataclass
class Bill:
    """Bytes that arrays would have taken."""

    total: int = 0


class Pool:
    """Arrays for owners that work in turns, each of which leaves nothing in them that it needs later."""

    def __init__(self) -> None:
        self._arrays: list[wp.array] = []
        self._next = 0

    def begin(self) -> None:
        """Give the first array next: another owner comes."""
        self._next = 0

    def take(self, shape: tuple[int, ...], dtype: Any, device: Any) -> wp.array:
        """The next array, or its first entries: as the last owner left them, zeroed for the first one.

        An owner that asks for what does not fit, or for nothing, gets an array of its own.
        """
        number, self._next = self._next, self._next + 1
        if number == len(self._arrays):
            self._arrays.append(_zeros(shape, dtype, device))
        array = self._arrays[number]
        if array.dtype is not dtype or array.shape[1:] != shape[1:] or array.shape[0] < shape[0] or 0 in shape:
            return _zeros(shape, dtype, device)
        return array if array.shape == shape else array[: shape[0]]


_bill: ContextVar[Bill | None] = ContextVar("bill", default=None)
_pool: ContextVar[Pool | None] = ContextVar("pool", default=None)


@contextmanager
def counting() -> Iterator[Bill]:
    """Let ``zeros`` of this thread count instead of allocate; the arrays may be sliced, but not read or written."""
    bill = Bill()
    token = _bill.set(bill)
    try:
        yield bill
    finally:
        _bill.reset(token)


@contextmanager
def pooled(pool: Pool) -> Iterator[None]:
    """Let ``zeros`` of this thread give the arrays that the pool has given to owners before."""
    pool.begin()
    token = _pool.set(pool)
    try:
        yield
    finally:
        _pool.reset(token)


@contextmanager
def lasting() -> Iterator[None]:
    """Within ``pooled``: let ``zeros`` make new arrays, for what its owner finds again at its next turn."""
    token = _pool.set(None)
    try:
        yield
    finally:
        _pool.reset(token)


def zeros(shape: tuple[int, ...], dtype: Any, device: Any) -> wp.array:
    """Zeroed array, or one without memory while arrays are counted, or one of a pool."""
    pool = _pool.get()
    return _zeros(shape, dtype, device) if pool is None else pool.take(shape, dtype, device)


def _zeros(shape: tuple[int, ...], dtype: Any, device: Any) -> wp.array:
    bill, size = _bill.get(), math.prod(shape) * wp.types.type_size_in_bytes(dtype)
    if bill is None or size == 0:
        return wp.zeros(shape, dtype=dtype, device=device)
    bill.total += size
    return wp.array(ptr=NOWHERE, shape=shape, dtype=dtype, device=device)


def fill(array: wp.array, value: float) -> None:
    """Set all entries of an array from ``zeros``."""
    if _bill.get() is None:
        array.fill_(value)


def require(
    needed: int,
    device: Any,
    thing: str,
    count: int,
    item: str,
    reclaim: Callable[[], None] | None = None,
    most: Callable[[int], int] | None = None,
) -> None:
    """Refuse to allocate more than is free.

    Args:
        needed: Bytes.
        device: Warp's or Torch's name of the device.
        thing: What needs them, for the message.
        count: How many items take them.
        item: Their name in the plural.
        reclaim: Gives caches back to the device; called before anything is refused.
        most: Gives the number of items that fit into so many bytes; None takes bytes in proportion.

    Raises:
        MemoryError: If less is free; the message tells how many items fit.
    """
    free = free_bytes(device)
    if needed <= free:
        return
    gc.collect()
    if reclaim is not None:
        reclaim()
    free = free_bytes(device)
    if needed > free:
        fitting = count * free // needed if most is None else most(free)
        advice = f"{fitting} {item} fit" if fitting else f"not one of its {item} fits"
        raise MemoryError(
            f"{thing} needs {readable(needed)} for {count} {item}, {readable(free)} are free on {device}; {advice}"
        )


def readable(count: float) -> str:
    """Bytes in the unit that suits them, such as ``61.3 GiB``."""
    for unit in ("bytes", "KiB", "MiB", "GiB"):
        if count < 1024.0:
            return f"{count:.3g} {unit}"
        count /= 1024.0
    return f"{count:.3g} TiB"


def free_bytes(device: Any) -> int:
    """Bytes that are free on a device; of the host, within the limits that its processes are given."""
    name = str(device)
    if name.startswith("cuda"):
        return int(wp.get_device(name).free_memory)
    return host.free_memory()
