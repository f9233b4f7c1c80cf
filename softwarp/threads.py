"""Taking turns with Warp: what threads may do at the same time, and what a forked process may go on with.

Warp keeps the kernels of a module, the capture that is going on and a GPU's current stream once per process. While one
thread adds a kernel to a module, another's launch from it fails; while one captures a graph, what others launch and
allocate is noted down in it too, by several threads at once. So whoever builds, compiles, captures, allocates or
launches holds ``alone`` meanwhile. What needs no turn is the replay of a captured step on a CPU: it reads its own
recording and writes its own simulation. From the third step on simulations in different threads run side by side.

A fork waits for the turn, so that the child finds Warp whole and not half through something, and a child's pools of
threads start anew. A GPU cannot be taken along.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait  # imported first: a fork then takes its lock after ours
from contextlib import ContextDecorator, nullcontext
from typing import TypeVar

import warp as wp

from softwarp import compiling

Item = TypeVar("Item")


class _Turn(ContextDecorator):
    """Context and decorator within which no other thread talks to Warp; may be entered again by the same thread.

    Attributes:
        owner: Identifier of the thread whose turn it is, None if it is nobody's.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.owner: int | None = None
        self._depth = 0

    def __enter__(self) -> None:
        self.lock.acquire()
        self.owner = threading.get_ident()
        self._depth += 1

    def __exit__(self, *error: object) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.owner = None
        self.lock.release()


alone = _Turn()


class Workers:
    """A pool of threads that starts with its first work, and anew in a forked process, which inherits none.

    Args:
        count: Threads.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._pool: ThreadPoolExecutor | None = None
        self._process = os.getpid()

    def run(self, work: Callable[[Item], object], items: Iterable[Item], *, helping: bool = False) -> None:
        """Do a piece of work for every item; returns when all are done, also on an interrupt, or raises an error.

        Args:
            work: Function of an item.
            items: What to do it for.
            helping: Do the first here, which spares a short piece its way to another thread; an interrupt may cut it.
        """
        if self._pool is None or self._process != os.getpid():
            self._pool, self._process = ThreadPoolExecutor(self._count), os.getpid()
        rest = list(items)
        mine = [rest.pop(0)] if helping and rest else []
        begun = [self._pool.submit(work, item) for item in rest]
        try:
            for item in mine:
                work(item)
            for done in begun:
                done.result()
        except BaseException:
            wait(begun)
            raise


_has_begun = False  # Warp has looked for GPUs in this process
_is_inherited = False  # it did so before this process was forked from another


def begin() -> None:
    """Start Warp, which also looks for GPUs; any number of times.

    Raises:
        OSError: If there is no place for compiled kernels.
    """
    global _has_begun
    with alone:
        try:
            with nullcontext() if _has_begun else compiling.without_driver_line():
                wp.init()
        except OSError as error:
            raise OSError(
                f"compiled kernels cannot be kept in {wp.config.kernel_cache_dir}: {error.strerror}; set the "
                "environment variable WARP_CACHE_PATH to a folder that this process may write to"
            ) from error
        _has_begun = True


def check_gpu(device: str) -> None:
    """Refuse a GPU in a process that was forked after Warp began: drivers do not survive that.

    Raises:
        RuntimeError: With what to do instead.
    """
    if _is_inherited:
        raise RuntimeError(
            f"device {device!r} cannot be used in this process: it was forked from one in which softwarp had begun, "
            "and a GPU's driver does not survive that; start processes by 'spawn', such as "
            "multiprocessing.get_context('spawn') or AsyncVectorEnv(..., context='spawn'), or use device 'cpu'"
        )


def _in_child() -> None:
    global _is_inherited
    _is_inherited = _has_begun
    alone.lock.release()
    torch = sys.modules.get("torch")
    if _has_begun and torch is not None:
        torch.set_num_threads(1)  # its operations would wait for threads that the child does not have


os.register_at_fork(before=alone.lock.acquire, after_in_parent=alone.lock.release, after_in_child=_in_child)
