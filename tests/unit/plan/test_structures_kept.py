"""Structures of scenes that are gone stay for those that are built again, as far as they are small."""

import gc
import weakref

import numpy as np
import pytest

from softwarp.plan import ordering


def test_structures_stay_for_scenes_that_are_built_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """The latest ones, and none that takes more than all may."""
    edges = np.array([(k, k + 1) for k in range(7)] + [(0, 5)], dtype=np.int32)
    kept = weakref.ref(ordering.analyze(edges, 8))
    gc.collect()
    assert kept() is not None and ordering.analyze(edges[::-1], 8) is kept()
    monkeypatch.setattr(ordering, "MOST_RECENT", 100)
    ordering.analyze(edges, 9)
    gc.collect()
    assert kept() is None and not ordering._recent
