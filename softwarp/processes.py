"""How processes of the command line end: with the one that started them, and soon after an interrupt."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import connection, parent_process
from pathlib import Path
from typing import Any

_LIFELINE = "SOFTWARP_LIFELINE"  # environment variable: number of a pipe that ends when the parent does
_LAUNCHER = "SOFTWARP_LAUNCHER"  # environment variable: the process that started the ranks of a run
_TO_SAVE = 60.0  # s that a process without a parent has for saving
_GRACE = 1.5  # s from an interrupt to the end of a process whose main thread compiles and cannot hear it
_LOOK = 0.05  # s between two looks at the main thread

_pipe: tuple[int, int] | None = None


def child_options(environment: dict[str, str]) -> dict[str, Any]:
    """Options of ``subprocess.Popen`` for a ``softwarp`` command that is not to outlive this process.

    Args:
        environment: Of the command.
    """
    global _pipe
    if _pipe is None:
        _pipe = os.pipe()  # whose second end nobody inherits: it closes when this process ends, even by kill -9
    return {"env": environment | {_LIFELINE: str(_pipe[0])}, "pass_fds": (_pipe[0],)}


def end_with_parent() -> None:
    """Be told to save and end, by SIGTERM, when a parent that has passed ``child_options`` is gone."""
    given = os.environ.pop(_LIFELINE, "")
    if not given.isdecimal():
        return
    pipe = int(given)
    try:
        os.set_inheritable(pipe, False)
    except OSError:  # no such pipe: the variable came from elsewhere
        return

    def wait() -> None:
        os.read(pipe, 1)
        sys.stderr.write("softwarp: the command that started this one is gone, so this one ends too\n")
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(_TO_SAVE)
        os._exit(128 + signal.SIGTERM)

    threading.Thread(target=wait, name="softwarp-parent", daemon=True).start()


def is_follower() -> bool:
    """Whether torchrun started this process as one of several, and not as the first, which tells how things go."""
    return os.environ.get("RANK", "0") not in ("", "0") and "LOCAL_RANK" in os.environ


def launches_ranks() -> None:
    """Tell processes that torchrun's launcher starts here by whom they are started."""
    os.environ[_LAUNCHER] = str(os.getpid())


def end_with_launcher() -> None:
    """As one of several processes of torchrun: save and end when the one that started them is gone, even by kill -9."""
    if not {"LOCAL_RANK", "TORCHELASTIC_RUN_ID"} <= set(os.environ):
        return
    launcher = int(os.environ.get(_LAUNCHER, os.getppid()))  # which may be gone already while this one starts

    def wait() -> None:
        while os.getppid() == launcher:
            time.sleep(1.0)
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(_TO_SAVE)
        os._exit(128 + signal.SIGTERM)

    threading.Thread(target=wait, name="softwarp-launcher", daemon=True).start()


def serve_parent() -> None:
    """For the start of a pool's process: end at once on an interrupt, and when the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    parent = parent_process()
    if parent is None:
        return

    def wait() -> None:
        connection.wait([parent.sentinel])
        os._exit(128 + signal.SIGTERM)

    threading.Thread(target=wait, name="softwarp-parent", daemon=True).start()


@contextmanager
def hearing_interrupts(verb: str) -> Iterator[None]:
    """Meanwhile SIGINT and SIGTERM end the process even while its main thread compiles kernels.

    Python's handlers run between two lines of Python, which a compiler may keep apart for a minute. What ends the
    process is then a thread of its own, which leaves other native work alone: that soon comes to an end.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    read, write = os.pipe()
    os.set_blocking(write, False)
    previous = signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    threading.Thread(target=_listen, args=(read, verb), name="softwarp-interrupts", daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(previous)
        os.close(write)


def _listen(pipe: int, verb: str) -> None:
    while received := os.read(pipe, 1):
        number = received[0]
        if number not in (signal.SIGINT, signal.SIGTERM):
            continue
        seen, since = _place(), time.monotonic()
        while not connection.wait([pipe], timeout=_LOOK):  # until the next signal, or the end
            place = _place()
            if place is None or place != seen:
                seen, since = place, time.monotonic()
            elif time.monotonic() - since > _GRACE:
                _leave(f"softwarp {verb}: interrupted while kernels were compiled; what was saved before is whole\n")
                os._exit(128 + number)
    os.close(pipe)


def _place() -> tuple[int, int] | None:
    """Where in Python the main thread stands, if it has its turn with Warp; None otherwise."""
    main, threads = threading.main_thread().ident, sys.modules.get("softwarp.threads")
    if main is None or threads is None or threads.alone.owner != main:  # without that module there is no Warp
        return None
    frame = sys._current_frames()[main]
    return id(frame), frame.f_lasti


def _leave(message: str) -> None:
    """Say why, and remove what the compiler has begun."""
    os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, message.encode())
    import warp as wp

    folder = Path(wp.config.kernel_cache_dir or os.devnull)
    for begun in folder.glob(f"*_p{os.getpid()}_t*"):
        shutil.rmtree(begun, ignore_errors=True)
