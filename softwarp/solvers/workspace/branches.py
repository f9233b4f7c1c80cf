"""Launches that need not wait for each other, each on a stream of its own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import warp as wp


class Branches:
    """Streams of a GPU beside the current one. A recording takes them up as branches of its graph.

    Args:
        device: The GPU.
    """

    def __init__(self, device: Any) -> None:
        self.device = wp.get_device(device)
        self.streams: list[wp.Stream] = []

    @contextmanager
    def side_by_side(self, count: int) -> Iterator[list[wp.Stream]]:
        """So many streams, the current one among them: they begin when it is here, and it goes on when all are done."""
        main = wp.get_stream(self.device)
        while len(self.streams) < count - 1:
            self.streams.append(wp.Stream(self.device))
        others = self.streams[: count - 1]
        begun = main.record_event()
        for stream in others:
            stream.wait_event(begun)
        yield [main, *others]
        for stream in others:
            main.wait_event(stream.record_event())
