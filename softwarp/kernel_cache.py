"""What processes with one cache of kernels do once for all of them: parse Warp's headers, and compile a module.

Warp keeps its parsed headers for one thread of one process, which costs every one of them two to three seconds before
its first module; here they stand in the cache beside the modules. Clang itself looks whether they still fit, and Warp
makes them anew where they do not. And of several processes that need the same module at a time, as those of a sweep or
of ``pytest -n`` do, one compiles it and the others wait for it.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from pathlib import Path
from typing import Any

import warp as wp
from warp._src import context

HEADERS = "wp_headers_"  # folders; Warp clears what begins with wp_
LOCK = ".softwarp-lock"  # ending of files that exist while somebody compiles
LOOK = 0.05  # s between two looks whether others have parsed headers

_warps_own = context.Runtime.get_clang_pch_dir
_tried: set[Path] = set()  # folders of headers that this process has begun a module with


@cache
def _machine() -> str:
    """Of what parsed headers depend on beside Warp's version: where Warp lies, and the processor."""
    native = Path(wp.__file__).parent / "native"
    with suppress(OSError):
        told = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").partition("\n\n")[0].splitlines()
        kind = sorted(line for line in told if line.startswith(("model name", "flags", "Features", "CPU part")))
        stamp = str((native / "builtin.h").stat().st_mtime_ns)
        return hashlib.sha256("\n".join([wp.config.version, str(native), stamp, *kind]).encode()).hexdigest()[:12]
    return ""


def headers() -> Path | None:
    """Folder of parsed headers in the cache that is in use; ``None`` where the processor or the cache is not known."""
    where = wp.config.kernel_cache_dir
    return Path(where) / f"{HEADERS}{_machine()}" if where and _machine() else None


@contextmanager
def turn(path: Path) -> Iterator[None]:
    """Meanwhile no other thread or process is in this block with the same path; nothing where files have no locks."""
    file = None
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("w", encoding="utf-8")
        fcntl.flock(file, fcntl.LOCK_EX)
    try:
        yield
    finally:
        if file is not None:
            with suppress(OSError):  # whoever waits with the old file finds the module made
                path.unlink()
            file.close()


@contextmanager
def once(folder: Any, name: str) -> Iterator[None]:
    """Around the compiling of a module: others that need it wait here, and so do all while the first parses headers.

    Args:
        folder: Of the module, in a cache.
        name: Of the file that is made there.
    """
    path = Path(folder) / name
    if path.exists():
        yield
        return
    with turn(path.parent.with_name(f"{path.parent.name}.{name}{LOCK}")):
        place = headers() if name.endswith(".o") and not path.exists() else None
        with nullcontext() if place is None else _parsed(place):
            yield


@contextmanager
def _parsed(place: Path) -> Iterator[None]:
    """Around the compiling of a module: of all that find no parsed headers one goes on, the others once they are there.

    This holds for the first module of a process: Warp may be told to do without.
    """
    file = None
    if place not in _tried and not any(place.glob("*.pch")):
        _tried.add(place)
        with suppress(OSError):
            place.mkdir(parents=True, exist_ok=True)
            file = (place / f"first{LOCK}").open("w", encoding="utf-8")
            while not any(place.glob("*.pch")):
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    time.sleep(LOOK)
    try:
        yield
    finally:
        if file is not None:
            with suppress(OSError):
                (place / f"first{LOCK}").unlink()
            file.close()


def _folder(runtime: Any) -> str | None:
    own: str | None = _warps_own(runtime)
    place = headers() if own is not None else None
    if place is not None:
        with suppress(OSError):
            place.mkdir(parents=True, exist_ok=True)
            if os.access(place, os.W_OK):
                return str(place)
    return own


def share() -> None:
    """Let Warp of this process keep parsed headers in the cache."""
    context.Runtime.get_clang_pch_dir = _folder
