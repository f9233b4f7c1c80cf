"""Launches that are recorded once and replayed."""

import gc
import weakref

import warp as wp

from softwarp.gradients.replayed import Replayed


class _Step:
    def __init__(self):
        self.room = wp.zeros(1, dtype=wp.float32, device="cpu")

    def launch(self):
        self.room.fill_(1.0)


def test_what_was_recorded_keeps_its_memory():
    """A recording of a GPU knows addresses alone: what they belong to is not freed under it."""
    step = _Step()
    replayed, owner = Replayed("cpu", [step.launch], None), weakref.ref(step)
    del step
    for _ in range(4):
        replayed()
        gc.collect()
        assert owner() is not None
    del replayed
    gc.collect()
    assert owner() is None
