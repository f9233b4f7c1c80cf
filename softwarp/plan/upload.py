"""From arrays of a plan to arrays of a device, by what the model's records declare."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np
import warp as wp

from softwarp.model.fields import declarations
from softwarp.model.structure import GatherLists
from softwarp.threads import alone, begin, check_gpu

Record = TypeVar("Record")


@alone
def upload(record: Record, device: str, real: Any) -> Record:
    """The same record with its declared arrays on a device, and those of the records in it.

    Plans fill declared arrays with NumPy's. Floating point ones become ``real``, all others 32-bit integers; what is
    on the device already stays there.
    """
    declared = declarations(record)
    values = {entry.name: getattr(record, entry.name) for entry in fields(record)}  # type: ignore[arg-type]
    changed: dict[str, Any] = {name: _on_device(values[name], device, real) for name in declared}
    for name, value in values.items():
        if name not in declared and is_dataclass(value) and declarations(value):
            changed[name] = upload(value, device, real)
    return replace(record, **changed)  # type: ignore[type-var]


def _on_device(value: Any, device: str, real: Any) -> Any:
    """An array, the arrays of several kinds, or lists of arrays."""
    if isinstance(value, dict):
        return {kind: _on_device(part, device, real) for kind, part in value.items()}
    if isinstance(value, GatherLists):
        return GatherLists(*(_on_device(part, device, real) for part in value))
    if not isinstance(value, np.ndarray):
        return value
    dtype = real if value.dtype.kind == "f" else wp.int32
    return wp.array(np.ascontiguousarray(value, dtype=wp.dtype_to_numpy(dtype)), dtype=dtype, device=device)


def checked_device(device: str) -> str:
    """Name of an existing Warp device.

    Raises:
        ValueError: If there is no such device; the message lists those that exist.
        OSError: If there is no place for compiled kernels.
        RuntimeError: For a GPU in a process that was forked after Warp had begun.
    """
    begin()
    names = [str(d) for d in wp.get_devices()]
    wanted = "cuda:0" if str(device) == "cuda" else str(device)
    if wanted not in names:
        raise ValueError(f"device {device!r} is not available on this machine; available: {', '.join(names)}")
    if wanted != "cpu":
        check_gpu(wanted)
    return wanted
