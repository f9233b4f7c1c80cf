"""Fixtures and options for all tests.

Tests marked ``cuda`` are left out, and counted as deselected, on a machine without a CUDA device.
"""

import os

import numpy as np
import pytest

os.environ.setdefault("MPLBACKEND", "Agg")


@pytest.fixture
def rng() -> np.random.Generator:
    """A fresh random generator with a fixed seed."""
    return np.random.default_rng(0)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the ``cuda`` tests where Warp finds no CUDA device."""
    needs_cuda = [item for item in items if item.get_closest_marker("cuda")]
    if not needs_cuda:
        return
    import warp as wp

    if wp.is_cuda_available():
        return
    config.hook.pytest_deselected(items=needs_cuda)
    left_out = set(needs_cuda)
    items[:] = [item for item in items if item not in left_out]
