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
    """Begin with the file that waits for no other, and leave out the ``cuda`` tests where Warp finds no CUDA device.

    Of two processes that begin with files which need the same kernels one would wait while the other compiles them.
    """
    items.sort(key=lambda item: item.path.name != BESIDE)
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
    """Give out whole files, whose fixtures and kernels are made once, in their order: the longest come first."""
    from xdist.scheduler import LoadFileScheduling

    config.option.loadscopereorder = False
    return LoadFileScheduling(config, log)
