"""Launches in less of Python's time: arrays that are what a kernel asks for are passed on, and recordings are quicker.

Of every launch that is recorded on a CPU Warp keeps the bytes of its arguments and where arrays lie in them, which it
finds out anew for each. Here what all launches of a kernel have in common is found once. A recording holds the same
bytes as by Warp's own way, which goes on with all that is not plain arrays and numbers, with adjoint launches, and with
what can be saved.
"""

from __future__ import annotations

import ctypes
import struct
from typing import Any

import warp as wp
from warp._src import context, types
from warp._src.apic import capture
from warp._src.apic.types import (
    APIC_RELOC_DATA_PTR,
    APIC_RELOC_NULL,
    APICLaunchInfo,
    APICLaunchParamRecord,
    APICLaunchPtrLocation,
)

_KEPT = "_softwarp_layout"  # attribute of a kernel
_AT_DATA, _AT_GRADIENT = types.array_t.data.offset, types.array_t.grad.offset
_NOWHERE = (-1, 0, APIC_RELOC_NULL)

_warps_own = capture.APICapture.build_launch_info
_warps_pack = context.pack_arg


class _Layout:
    """What the recorded launches of a kernel have in common.

    Args:
        kernel: Of Warp.
        kinds: Types of its packed arguments.

    Attributes:
        is_plain: Whether all arguments are arrays and numbers; nothing else is set otherwise.
        arrays: Which arguments are arrays.
        pads: Bytes before each argument.
    """

    def __init__(self, kernel: Any, kinds: tuple[Any, ...]) -> None:
        self.kinds = kinds
        asked = [argument.type for argument in kernel.adj.args]
        self.arrays = [i for i, kind in enumerate(asked) if types.matches_array_class(kind, types.array)]
        self.is_plain = 0 < len(kinds) == len(asked) and all(
            kind is types.array_t if i in self.arrays else _is_number(asked[i], kind) for i, kind in enumerate(kinds)
        )
        if not self.is_plain:
            return
        self.records = (APICLaunchParamRecord * len(kinds))()
        self.pads: list[bytes] = []
        end = 0
        for i, (record, kind) in enumerate(zip(self.records, kinds, strict=True)):
            align = max(ctypes.alignment(kind), 1)
            self.pads.append(bytes(-end % align))
            record.param_index = i + 1
            record.value_offset = end + len(self.pads[-1])
            record.value_size = ctypes.sizeof(kind)
            record.value_align = align
            record.num_relocs = 2 if i in self.arrays else 0
            end = record.value_offset + record.value_size
        self.bytes_type = ctypes.c_uint8 * end
        self.size = end
        self.places_type = APICLaunchPtrLocation * (2 * len(self.arrays))
        self.pack = struct.Struct("<" + "IiQB7x" * (2 * len(self.arrays))).pack
        self.key = kernel.key.encode("utf-8")


def _is_number(asked: Any, packed: Any) -> bool:
    """Whether an argument holds no addresses: a scalar, a vector or a matrix."""
    if asked is types.handle or asked is types.uint64 or types.is_array(asked) or not isinstance(asked, type):
        return False
    return issubclass(packed, (ctypes._SimpleCData, ctypes.Array))


def _place(recording: Any, array: Any) -> tuple[int, int, int]:
    """Region and place of an array's memory, found once in a recording."""
    pointer = array.ptr
    if not pointer:
        return _NOWHERE
    known = recording.__dict__.setdefault("_softwarp_places", {})
    found = known.get(id(array))
    if found is None or found[1] != pointer:  # the array is kept, so that no other has its identity
        region, offset = recording.track_array(array)
        found = known[id(array)] = (array, pointer, (region, offset, APIC_RELOC_DATA_PTR))
    place: tuple[int, int, int] = found[2]
    return place


def _build_launch_info(
    self: Any,
    kernel: Any,
    module_exec: Any,
    hooks: Any,
    params: list[Any],
    fwd_args: list[Any],
    adjoint: bool,
    adj_args: list[Any] | None = None,
) -> Any:
    """As Warp's own; see there."""
    values = params[1:]
    kinds = tuple(map(type, values))
    layout = kernel.__dict__.get(_KEPT)
    if layout is None or layout.kinds != kinds:
        layout = _Layout(kernel, kinds)
        setattr(kernel, _KEPT, layout)
    if adjoint or self.apic_savable or not self.device.is_cpu or not layout.is_plain:
        return _warps_own(self, kernel, module_exec, hooks, params, fwd_args, adjoint, adj_args)
    places: list[int] = []
    for i in layout.arrays:
        array, packed = fwd_args[i], values[i]
        data = gradient = _NOWHERE
        if array is not None:
            if not isinstance(array, types.array):
                return _warps_own(self, kernel, module_exec, hooks, params, fwd_args, adjoint, adj_args)
            data = _place(self, array)
            if array.grad is not None:
                gradient = _place(self, array.grad)
            expected = (array.ptr or 0, array.grad.ptr or 0 if array.grad is not None else 0)
            if (packed.data, packed.grad) != expected:  # which Warp refuses
                return _warps_own(self, kernel, module_exec, hooks, params, fwd_args, adjoint, adj_args)
        places += (_AT_DATA, *data, _AT_GRADIENT, *gradient)
    self._collect_metadata(kernel, module_exec)
    info = APICLaunchInfo()
    info.kernel_key, info.module_hash = layout.key, self._hash_to_str(module_exec.module_hash).encode("utf-8")
    info.is_forward, info.kernel_dim = 1, kernel.adj.kernel_dim
    info.params, info.num_params = layout.records, len(values)
    pieces = [piece for pair in zip(layout.pads, values, strict=True) for piece in pair]
    info.value_data = layout.bytes_type.from_buffer_copy(b"".join(pieces))
    info.value_data_size = layout.size
    if places:
        info.relocs = layout.places_type.from_buffer_copy(layout.pack(*places))
        info.num_relocs = len(layout.arrays) * 2
    return info


def _pack_arg(kernel: Any, arg_type: Any, arg_name: str, value: Any, device: Any, adjoint: bool = False) -> Any:
    """As Warp's own, which asks ten questions of an array that is just what it should be."""
    if (
        type(value) is types.array
        and getattr(arg_type, "_concrete_cls", None) is types.array
        and value.dtype is arg_type.dtype
        and value.ndim == arg_type.ndim
        and wp.config.launch_array_access_mode is wp.config.LaunchArrayAccessMode.RELAXED
    ):
        return value.__ctype__()
    return _warps_pack(kernel, arg_type, arg_name, value, device, adjoint)


def quicken() -> None:
    """Let Warp of this process launch and record in this way."""
    capture.APICapture.build_launch_info = _build_launch_info
    context.pack_arg = _pack_arg
