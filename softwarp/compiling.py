"""Kernels on their way from source to memory: Warp's lines about it kept quiet, long waits told, several at a time.

Warp compiles a module when one of its kernels is first launched, one after the other, and keeps the result in its
cache. ``ahead`` finds the modules of some work before it is done and compiles them side by side, so that their number
is known. Whatever compiles for long, in whatever way it began, is told in a line on standard error.
"""

from __future__ import annotations

import atexit
import logging
import multiprocessing
import os
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from typing import Any

import warp as wp
from warp._src import context

from softwarp import kernel_cache, notices, recording

QUIET_SECONDS = 1.5  # of compiling before it is told
PAUSE = 0.4  # s without compiling after which what comes next is told anew
LOOK = 0.1  # s between two looks at the clock
MOST_AT_A_TIME = 4  # modules; each takes some 200 MB while it is compiled

_NO_GPU = (  # how Warp's lines begin that only say so
    b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver",
    b"Warp CUDA error 100: no CUDA-capable device is detected",
)


class _Logger:
    """Takes Warp's lines to the logger ``softwarp.warp``, where they are heard if somebody asks for them."""

    def __init__(self, own: Any) -> None:
        self._own, self._log = own, notices.log.getChild("warp")

    def debug(self, message: str) -> None:
        """A line that Warp writes only where ``wp.config.log_level`` asks for it."""
        self._own.debug(message)

    def info(self, message: str) -> None:
        """The banner, and a line for every module that is loaded."""
        if wp.config.log_level < wp.LOG_INFO or not self._log.hasHandlers():
            if wp.config.log_level < wp.LOG_INFO or self._log.isEnabledFor(logging.INFO):
                self._own.info(message)
        else:
            self._log.info(message)

    def warning(self, message: str, category: type[Warning] | None = None, stacklevel: int = 1) -> None:
        """As Warp does."""
        self._own.warning(message, category=category, stacklevel=stacklevel + 1)

    def error(self, message: str) -> None:
        """As Warp does."""
        self._own.error(message)


@contextmanager
def without_driver_line() -> Iterator[None]:
    """Meanwhile Warp's remark that there is no GPU does not reach standard error; all else does, at the end.

    It is written by native code that asks nobody.
    """
    try:
        outside = None if notices.log.isEnabledFor(logging.INFO) else os.dup(2)
    except OSError:  # there is no standard error
        outside = None
    if outside is None:
        yield
        return
    kept = os.memfd_create("softwarp-stderr")
    os.dup2(kept, 2)
    try:
        yield
    finally:
        os.dup2(outside, 2)
        size = os.fstat(kept).st_size
        lines = os.pread(kept, size, 0).splitlines(keepends=True)
        rest = b"".join(line for line in lines if not line.startswith(_NO_GPU))
        with suppress(OSError):
            os.write(2, rest)
        os.close(outside)
        os.close(kept)


class _Watch:
    """Counts modules and tells of them while they are compiled; a thread of its own renews the line."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.active = 0  # modules that are compiled now
        self.done = 0  # compiled since the line began
        self.expected = 0  # modules of all groups that are loaded now, those excepted that were in the cache
        self.groups = 0
        self.seconds = 0.0  # that this process has compiled, all together
        self._since = 0.0  # when the first of those that are active began
        self._begun: float | None = None  # when the line began
        self._ended = 0.0  # when the last module was done
        self._line: notices.Line | None = None
        self._thread: threading.Thread | None = None
        self._place: socket.socket | None = None

    def begin(self) -> None:
        """A module is looked for in the cache and, perhaps, compiled."""
        now = time.monotonic()
        with self.lock:
            if self.active == 0:
                self._since = now
            self.active += 1
            if self._begun is None:
                self._begun, self.done = now, 0
            if self._thread is None and notices.are_shown():
                self._thread = threading.Thread(target=self._run, name="softwarp-compiling", daemon=True)
                self._thread.start()

    def end(self, compiled: bool) -> None:
        """The module is there."""
        now = time.monotonic()
        with self.lock:
            self.active -= 1
            self.done += compiled
            if self.groups and not compiled:
                self.expected -= 1
            if self.active == 0:
                self.seconds += now - self._since
                self._ended = now
                if self.done == 0:
                    self._begun = None
                elif self._line is not None and not self.groups:
                    self._line.clear()

    @contextmanager
    def group(self, count: int) -> Iterator[None]:
        """Meanwhile so many modules are loaded."""
        with self.lock:
            self.groups += 1
            self.expected += count
        try:
            yield
        finally:
            with self.lock:
                self.groups -= 1
                if self.groups == 0:
                    self.expected = 0
            self.close()

    def close(self) -> None:
        """Leave a last line if one was begun and nothing compiles any more."""
        with self.lock:
            if self.active == 0 and self._begun is not None:
                if self._line is not None:
                    self._line.end(f"compiled {_files(self.done)} of kernels in {self._ended - self._begun:.0f} s")
                self._line, self._begun = None, None

    def spent(self) -> float:
        """Seconds that this process has compiled until now."""
        with self.lock:
            return self.seconds + (time.monotonic() - self._since if self.active else 0.0)

    def _run(self) -> None:
        while True:
            time.sleep(LOOK)
            with self.lock:
                now, begun = time.monotonic(), self._begun
                if begun is None:
                    self._thread = None
                    return
                is_over = self.active == 0 and self.groups == 0 and now - self._ended > PAUSE
                if not is_over and now - begun > QUIET_SECONDS and self.active and notices.are_shown():
                    self._tell(now - begun)
            if is_over:
                self.close()

    def _tell(self, seconds: float) -> None:
        if not self._may_tell():
            return
        self._line = self._line or notices.Line()
        self._line.show(f"compiling kernels: {self._state()}, {seconds:.0f} s (once; they are kept)")

    def _state(self) -> str:
        """How many are done, of how many if that is known: modules that are met on the way come unannounced."""
        if self.expected > self.done:
            return f"{self.done} of about {self.expected}"
        return f"{_files(self.done)} done, one more" if self.done else "the first file"

    def _may_tell(self) -> bool:
        """Whether this process is the one to tell: of several workers of one parent the first that compiles long."""
        parent = multiprocessing.parent_process()
        if parent is None or self._place is not None:
            return True
        place = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            place.bind(f"\0softwarp-compiling-{parent.pid}")  # a name that one process at a time has, until it ends
        except OSError:
            place.close()
            return False
        self._place = place
        return True


def _files(count: int) -> str:
    return "1 file" if count == 1 else f"{count} files"


_watch = _Watch()


def spent() -> float:
    """Seconds that this process has compiled kernels until now."""
    return _watch.spent()


def _listen() -> None:
    """Hear of every module that Warp compiles, and keep Warp's own lines about it from those who did not ask."""
    compile_module: Callable[..., bool] = context.Module._compile

    def told(self: Any, *arguments: Any, **named: Any) -> bool:
        _watch.begin()
        compiled = True
        try:
            folder, name = (*arguments[1:3], None, None)[:2]  # that Module.load names; whoever exports kernels does not
            with kernel_cache.once(folder, name) if folder and name else nullcontext():
                compiled = compile_module(self, *arguments, **named)
            return compiled
        finally:
            _watch.end(compiled)

    context.Module._compile = told
    kernel_cache.share()
    recording.quicken()
    own = wp.get_logger()
    if wp.config.log_level == wp.LOG_INFO and type(own).__module__.startswith("warp."):  # nobody has chosen otherwise
        wp.set_logger(_Logger(own))


def ahead(work: Iterable[Callable[[], None]], device: str, recording: AbstractContextManager[Any]) -> None:
    """Compile and load the kernels of some work, several modules at a time, without doing it; in a turn with Warp.

    Args:
        work: Launches kernels, as in a capture: nothing in it may depend on what they compute.
        device: Where.
        recording: A capture, which keeps copies from being done; what it records is dropped.
    """
    needed: dict[tuple[Any, int | None], None] = {}
    caller, launch = threading.get_ident(), wp.launch

    def note(kernel: Any, *arguments: Any, **named: Any) -> Any:
        if threading.get_ident() != caller:
            return launch(kernel, *arguments, **named)
        if not kernel.is_generic:
            needed[kernel.module, named.get("block_dim")] = None
        return None

    with recording:
        wp.launch = note
        try:
            for part in work:
                part()
        finally:
            wp.launch = launch
    missing = [(module, block) for module, block in needed if not (module.execs and module.hashers)]  # or outdated
    if not missing:
        return
    cores = min(len(os.sched_getaffinity(0)), MOST_AT_A_TIME)
    with _watch.group(len(missing)):
        pool = ThreadPoolExecutor(cores)
        try:
            begun = [pool.submit(wp.force_load, device, [module], block, 0) for module, block in missing]
            for loaded in begun:
                loaded.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _in_child() -> None:
    global _watch
    _watch = _Watch()


_listen()
atexit.register(_watch.close)
os.register_at_fork(after_in_child=_in_child)
