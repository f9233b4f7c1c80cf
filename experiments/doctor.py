"""``softwarp doctor``: what is installed, which devices there are, and whether a kernel compiles and runs."""

import importlib
import importlib.util
import os
import platform
import tempfile
import time
from importlib import metadata
from pathlib import Path

import numpy as np
import torch
import warp as wp

from softwarp.threads import begin

PACKAGES = ("softwarp", "torch", "torchrl", "tensordict", "warp-lang", "numpy", "gymnasium", "hydra-core", "usd-core")
OPTIONAL = {"av": "mp4 video", "imageio": "gif video", "stable_baselines3": "Stable-Baselines3 example"}


class CheckFailed(Exception):
    """A check that stops softwarp from working; the text says what to do."""


def main() -> int:
    """Print a line per check; returns 1 if one that matters failed."""
    failed = 0
    for check in (packages, cores, warp_cache, kernel, devices, torchrl_extension, usd, optional):
        try:
            mark, text = "ok  ", check()
        except (CheckFailed, OSError) as error:
            mark, text, failed = "FAIL", str(error), 1
        print(f"{mark}  {check.__name__.replace('_', ' '):<18}{text}")
    print("\nsoftwarp is ready" if not failed else "\nsoftwarp will not work before the failed checks are mended")
    return failed


def packages() -> str:
    """Versions; all of them must be there."""
    found, missing = [f"python {platform.python_version()}"], []
    for package in PACKAGES:
        try:
            found.append(f"{package} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            missing.append(package)
    if missing == ["softwarp"]:
        return ", ".join(found) + ", softwarp from source"
    if missing:
        raise CheckFailed(f"not installed: {', '.join(missing)}; pip install softwarp again")
    return ", ".join(found)


def cores() -> str:
    """Cores that this process may use."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{usable} usable of {os.cpu_count()}, {platform.machine()}"


def warp_cache() -> str:
    """Warp keeps compiled kernels in a folder."""
    begin()
    folder = Path(wp.config.kernel_cache_dir)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise CheckFailed(f"{folder}: {error.strerror}; set WARP_CACHE_PATH to a folder you can write to") from error
    return str(folder)


@wp.kernel(module="unique")  # type: ignore[untyped-decorator]
def _double(values: wp.array[float]) -> None:
    i = wp.tid()
    values[i] = 2.0 * values[i]


def kernel() -> str:
    """A small kernel is compiled, launched and checked on every device."""
    told = []
    for device in wp.get_devices():
        start = time.perf_counter()
        values = wp.array(np.arange(8.0), dtype=float, device=device)
        try:
            wp.launch(_double, dim=8, inputs=[values], device=device)
            result = values.numpy()
        except Exception as error:
            raise CheckFailed(f"{device.alias}: {error}; update the driver or reinstall warp-lang") from error
        if not np.array_equal(result, 2.0 * np.arange(8.0)):
            raise CheckFailed(f"{device.alias}: a kernel that doubles 0 to 7 gave {result.tolist()}")
        told.append(f"{device.alias} compiled and right in {time.perf_counter() - start:.1f} s")
    return ", ".join(told)


def devices() -> str:
    """Devices of Warp and of Torch; they should be the same."""
    names = [f"{device.alias} ({device.name})" for device in wp.get_devices()]
    cuda = torch.cuda.device_count()
    if cuda != wp.get_cuda_device_count():
        names.append(f"Torch sees {cuda} CUDA devices: install a Torch built for this driver to use them")
    return ", ".join(names)


def torchrl_extension() -> str:
    """TorchRL's compiled part serves prioritised replay only."""
    try:
        importlib.import_module("torchrl._torchrl")
    except ImportError:
        return "missing: prioritised replay is not available, nothing else is lost"
    return "present"


def usd() -> str:
    """USD files are written by usd-core."""
    try:
        usd_module = importlib.import_module("pxr.Usd")
    except ImportError as error:
        raise CheckFailed(f"usd-core does not load ({error}); pip install usd-core") from error
    return ".".join(map(str, usd_module.GetVersion()))


def optional() -> str:
    """Extras."""
    found = {
        use: "present" if importlib.util.find_spec(name) else f"missing ({name})" for name, use in OPTIONAL.items()
    }
    return ", ".join(f"{use}: {state}" for use, state in found.items())
