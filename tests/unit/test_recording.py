"""Recorded launches hold the same bytes as by Warp's own way."""

from typing import Any

import numpy as np
import pytest
import warp as wp
from warp._src.apic import capture

from softwarp import recording, threads


@wp.kernel(enable_backward=False)
def _scale(
    count: int,
    x: wp.array[wp.float32],
    shift: wp.vec3,
    factor: wp.float64,
    grid: wp.array2d[wp.vec3],
    y: wp.array[wp.float32],
):
    i = wp.tid()
    if i < count:
        y[i] = wp.float32(factor) * x[i] + shift[1]
    if grid.shape[0] > 0:
        y[i] += grid[0, 0][2]


def told(info: Any) -> tuple[Any, ...]:
    """All that is kept of a launch."""
    records = [bytes(info.params[i]) for i in range(info.num_params)]
    places = [bytes(info.relocs[i]) for i in range(info.num_relocs)]
    values = bytes(info.value_data[: info.value_data_size])
    return info.kernel_key, info.module_hash, info.is_forward, info.kernel_dim, records, places, values


@pytest.mark.parametrize("savable", [False, True])
def test_a_launch_is_noted_down_as_warp_does(savable: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Arrays, parts of arrays, arrays with gradients, empty and missing ones, numbers and vectors; the replay, too."""
    threads.begin()
    pairs = []

    def both(self: Any, *arguments: Any, **named: Any) -> Any:
        pairs.append(
            (recording._warps_own(self, *arguments, **named), recording._build_launch_info(self, *arguments, **named))
        )
        assert told(pairs[-1][0]) == told(pairs[-1][1])
        return pairs[-1][1]

    x = wp.array(np.arange(8.0), dtype=wp.float32, device="cpu", requires_grad=True)
    y = wp.zeros(8, dtype=wp.float32, device="cpu")
    grid = wp.array(np.full((2, 2, 3), 0.5), dtype=wp.vec3, device="cpu")
    shift = wp.vec3(0.0, 1.0, 0.0)
    wp.launch(_scale, 4, inputs=[4, x, shift, 2.0, grid], outputs=[y], device="cpu")  # compiled before
    monkeypatch.setattr(capture.APICapture, "build_launch_info", both)
    with wp.ScopedCapture(device="cpu", apic=savable) as recorded:
        wp.launch(_scale, 4, inputs=[4, x, shift, 2.0, grid], outputs=[y], device="cpu")
        wp.launch(_scale, 4, inputs=[4, x[2:6], shift, 3.0, None], outputs=[y[4:]], device="cpu")
        wp.launch(_scale, 4, inputs=[0, x, shift, 3.0, grid[1:]], outputs=[y[::2]], device="cpu")
    assert len(pairs) == 3 and vars(_scale)[recording._KEPT].is_plain
    y.zero_()
    wp.capture_launch(recorded.graph)
    np.testing.assert_array_equal(y.numpy(), [2.0, 3.5, 6.0, 7.5, 7.5, 10.0, 13.5, 16.0])
