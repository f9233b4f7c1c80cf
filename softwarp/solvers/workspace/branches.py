"""Launches that need not wait for each other, each on a stream of its own."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import warp as wp


class Branches:
    """Streams of a GPU beside the current one. A recording takes them up as branches of its graph.

    Args:
        device: The GPU.
    """

    def __init__(self, device: Any) -> None:
        self.device = wp.get_device(device)

    @contextmanager
    def side_by_side(self, count: int) -> Iterator[list[wp.Stream]]:
        """So many streams, the current one among them: they begin when it is here, and it goes on when all are done."""
        main = wp.get_stream(self.device)
        others = [_beside(self.device.alias, main.cuda_stream, number) for number in range(count - 1)]
        if others:
            begun = main.record_event()
            for stream in others:
                stream.wait_event(begun)
        yield [main, *others]
        for stream in others:
            main.wait_event(stream.record_event())


@cache
def _beside(device: str, _current: int | None, _number: int) -> wp.Stream:
    """A stream beside a current one: a recording keeps those that it has taken up until it ends.

    Torch's wait for no other. Warp's wait for the default one, so that CUDA would refuse what other threads launch
    there while they are recorded.
    """
    torch = sys.modules.get("torch")
    if torch is None:
        return wp.Stream(device)
    return wp.stream_from_torch(torch.cuda.Stream(wp.device_to_torch(wp.get_device(device))))
