"""Launches that are recorded once and replayed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import warp as wp

from softwarp import interop
from softwarp.threads import Workers


class Replayed:
    """Launches that are recorded at their second call and replayed from then on, those of shards side by side.

    A recording knows addresses alone, so the launches, and with them what they read and write, stay alive beside it.

    Args:
        device: Warp device.
        launches: One function a shard.
        workers: Threads for several shards.
        is_compiled: Whether all kernels have run before, so that the first call records.
    """

    def __init__(
        self,
        device: str,
        launches: Sequence[Callable[[], None]],
        workers: Workers | None,
        *,
        is_compiled: bool = False,
    ) -> None:
        self._device, self._launches, self._workers = device, launches, workers
        self._is_compiled = is_compiled  # else by the first call, which a recording cannot do
        self._graphs: list[Any] = []

    def __call__(self) -> None:
        """Launch all."""
        if not self._graphs:
            if not (self._is_compiled and interop.records(self._device)):
                with interop.on_torch_stream(self._device):
                    for launch in self._launches:
                        launch()
                self._is_compiled = True
                return
            self._graphs = [self._record(launch) for launch in self._launches]
        with interop.replaying(self._device):
            if self._workers is None:
                for graph in self._graphs:
                    wp.capture_launch(graph)
            else:
                self._workers.run(wp.capture_launch, self._graphs, helping=True)

    def _record(self, launch: Callable[[], None]) -> Any:
        with interop.capturing(self._device) as capture:
            launch()
        return capture.graph
