"""Launches on several streams of a GPU: those before and after them wait, in a recording too."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
import warp as wp

from softwarp import interop
from softwarp.solvers.workspace.branches import Branches


@wp.kernel
def add(place: int, value: wp.array(dtype=float), sums: wp.array(dtype=float)):
    sums[place] += value[0]


@wp.kernel
def double(value: wp.array(dtype=float)):
    value[0] *= 2.0


@pytest.mark.cuda
@pytest.mark.parametrize("count", [1, 2, 4])
@pytest.mark.parametrize("way", ["at once", "recorded", "under a condition"])
def test_streams_begin_after_what_comes_before_and_end_before_what_follows(count: int, way: str) -> None:
    device = "cuda:0"
    branches, value = Branches(device), wp.ones(1, dtype=float, device=device)
    sums, condition = wp.zeros(count, dtype=float, device=device), wp.ones(1, dtype=wp.int32, device=device)

    def work() -> None:
        for _ in range(20):
            wp.launch(double, 1, [value], device=device)
            with branches.side_by_side(count) as streams:
                for place, stream in enumerate(streams):
                    wp.launch(add, 1, [place, value, sums], device=device, stream=stream)

    if way == "at once":
        work()
    else:
        wp.load_module(device=device)
        with wp.ScopedCapture(device=device) as capture:
            if way == "recorded":
                work()
            else:
                wp.capture_if(condition, work)
        wp.capture_launch(capture.graph)
    assert sums.numpy().tolist() == [2.0**21 - 2.0] * count


@pytest.mark.cuda
def test_recordings_beside_work_on_the_default_stream() -> None:
    """Another thread launches on the stream that CUDA lets Warp's own streams wait for."""
    device, is_over = "cuda:0", threading.Event()
    branches, value = Branches(device), wp.ones(1, dtype=float, device=device)
    sums = wp.zeros(3, dtype=float, device=device)
    wp.load_module(device=device)

    def keep_busy() -> int:
        x, turns = torch.ones(64, device=device), 0
        while not is_over.is_set():
            x, turns = x.sin(), turns + 1
        return turns

    with ThreadPoolExecutor(1) as pool:
        busy = pool.submit(keep_busy)
        try:
            for _ in range(50):
                with interop.capturing(device) as capture, branches.side_by_side(3) as streams:
                    for place, stream in enumerate(streams):
                        wp.launch(add, 1, [place, value, sums], device=device, stream=stream)
                with interop.replaying(device):
                    wp.capture_launch(capture.graph)
        finally:
            is_over.set()
    wp.synchronize_device(device)
    assert busy.result() > 0
    assert sums.numpy().tolist() == [50.0] * 3
