"""Solver arrays: one memory block seen as SIMD elements ``[w, row]`` and as scalars ``[pack, row, lane]``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.model import memory


@dataclass(frozen=True)
class Rows:
    """A workspace array of one variant.

    Attributes:
        S: View for kernels on elements, shape (w, row).
        real: View for kernels on single worlds, shape (pack, row, lane).
    """

    S: wp.array
    real: wp.array

    def zero(self) -> None:
        """Set all entries to zero."""
        self.real.zero_()

    def fill(self, value: float) -> None:
        """Set all entries, unless arrays are only counted."""
        memory.fill(self.real, value)

    def copy_from(self, other: Rows) -> None:
        """Copy all entries of an array of the same shape."""
        wp.copy(self.real, other.real)


def shape(variant: Variant, world_count: int) -> tuple[int, int]:
    """Packs and lanes that hold ``world_count`` worlds."""
    if variant.world_fastest:
        return 1, world_count
    return -(-world_count // variant.lanes), variant.lanes


def allocate(variant: Variant, world_count: int, rows: int, device: Any, dtype: Any = None) -> Rows:
    """Zeroed workspace array; ``dtype`` overrides the scalar type (flags)."""
    packs, lanes = shape(variant, world_count)
    real = dtype or variant.real
    base = memory.zeros((packs, rows, lanes), real, device)
    return Rows(S=_element_view(variant, base, rows, real), real=base)


def alias(variant: Variant, array: wp.array) -> Rows:
    """View a state array ``[world, row]`` as a workspace array without a copy; not for lanes.

    On a GPU the state array has the world fastest, on a CPU slowest, as the workspace has it.
    """
    worlds, rows = array.shape
    packs, lanes = shape(variant, worlds)
    size = wp.types.type_size_in_bytes(array.dtype)
    strides = (size, array.strides[1], size) if variant.world_fastest else (array.strides[0], size, size)
    base = wp.array(ptr=array.ptr, shape=(packs, rows, lanes), strides=strides, dtype=array.dtype, device=array.device)
    base._owner = array  # keeps the memory alive as long as the view
    return Rows(S=array, real=base)


def at_address(variant: Variant, like: wp.array, address: int) -> Rows:
    """View memory that somebody else holds as a workspace array; ``like`` has its shape [pack, row, lane]."""
    base = wp.array(ptr=address, shape=like.shape, dtype=like.dtype, device=like.device)
    return Rows(S=_element_view(variant, base, like.shape[1], like.dtype), real=base)


def _element_view(variant: Variant, base: wp.array, rows: int, real: Any) -> wp.array:
    packs, _, lanes = base.shape
    size = wp.types.type_size_in_bytes(real)
    if variant.lanes > 1 and real is variant.real:
        view = wp.array(ptr=base.ptr, shape=(packs, rows), dtype=variant.S, device=base.device)
    elif variant.world_fastest:
        view = wp.array(ptr=base.ptr, shape=(lanes, rows), strides=(size, size * lanes), dtype=real, device=base.device)
    else:
        view = wp.array(ptr=base.ptr, shape=(packs, rows * lanes), dtype=real, device=base.device)
    view._owner = base
    return view


def allocate_whole(variant: Variant, world_count: int, count: int, device: Any, dtype: Any = None) -> Rows:
    """Workspace array in which a world's entries lie side by side on a GPU, for kernels that share a world."""
    if not variant.world_fastest:
        return allocate(variant, world_count, count, device, dtype)
    real = dtype or variant.real
    array = memory.zeros((world_count, count), real, device)
    size = wp.types.type_size_in_bytes(real)
    shape, strides = (1, count, world_count), (array.strides[0] * world_count, size, array.strides[0])
    base = wp.array(ptr=array.ptr, shape=shape, strides=strides, dtype=real, device=device)
    base._owner = array  # keeps the memory alive as long as the view
    return Rows(S=array, real=base)
