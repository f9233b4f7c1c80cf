"""Fixtures and options for all tests.

Tests marked ``cuda`` are left out, and counted as deselected, on a machine without a CUDA device. With ``-n auto`` the
files of tests are shared out among processes, one for each core.
"""

import gc
import os
from typing import Any

os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("OMP_NUM_THREADS", "1")  # threads would spin for a core that another process works on

import numpy as np  # which reads the variable, as Torch does
import pytest

BESIDE = "test_cuda_compile.py"  # compiles for most of a minute what no other file needs
MOST_PROCESSES = 8  # each holds up to 2 GB: Torch and the kernels of the tests it ran


@pytest.fixture
def rng() -> np.random.Generator:
    """A fresh random generator with a fixed seed."""
    return np.random.default_rng(0)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Physics last, as the scheduler below likes it, and no ``cuda`` tests where Warp finds no CUDA device."""
    items.sort(key=lambda item: (item.path.name != BESIDE, "physics" in item.path.parts))
    needs_cuda = [item for item in items if item.get_closest_marker("cuda")]
    if not needs_cuda:
        return
    import warp as wp

    if wp.is_cuda_available():
        return
    config.hook.pytest_deselected(items=needs_cuda)
    left_out = set(needs_cuda)
    items[:] = [item for item in items if item not in left_out]


def pytest_collection_finish(session: pytest.Session) -> None:
    """Keep half a million objects of modules and tests out of every search for garbage from here on."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Processes for ``-n auto``: one for each core that this one may use."""
    return min(len(os.sched_getaffinity(0)), MOST_PROCESSES)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give out whole files, whose fixtures and kernels are made once, from both ends of their list.

    Promises of environments and batches come first, physics last, and they need other kernels: of two processes that
    begin with files which need the same ones, one would wait while the other compiles them. They meet at short files.
    """
    from xdist.scheduler import LoadFileScheduling

    class FromBothEnds(LoadFileScheduling):  # type: ignore[misc]
        def _assign_work_unit(self, node: Any) -> None:
            if self.nodes.index(node) % 2:
                self.workqueue.move_to_end(next(reversed(self.workqueue)), last=False)
            super()._assign_work_unit(node)

    config.option.loadscopereorder = False
    return FromBothEnds(config, log)
