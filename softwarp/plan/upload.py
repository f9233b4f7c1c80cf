"""Host arrays on a device."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray


def upload(arrays: dict[str, NDArray[Any]], device: str, real: Any) -> dict[str, wp.array]:
    """Copy arrays to a device, floating point ones as ``real``."""
    return {
        name: wp.array(
            np.ascontiguousarray(value, dtype=wp.dtype_to_numpy(real) if value.dtype.kind == "f" else np.int32),
            dtype=real if value.dtype.kind == "f" else wp.int32,
            device=device,
        )
        for name, value in arrays.items()
    }


def checked_device(device: str) -> str:
    """Name of an existing Warp device.

    Raises:
        ValueError: If there is no such device; the message lists those that exist.
    """
    wp.init()
    names = [str(d) for d in wp.get_devices()]
    wanted = "cuda:0" if str(device) == "cuda" else str(device)
    if wanted not in names:
        raise ValueError(f"device {device!r} is not available on this machine; available: {', '.join(names)}")
    return wanted
