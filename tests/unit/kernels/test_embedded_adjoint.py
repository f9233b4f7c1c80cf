"""Gradients of embedded points of collision surfaces go to the nodes that carry them, and nothing behind them does."""

import numpy as np
import pytest
import warp as wp

from softwarp.kernels.algebra import lanes
from softwarp.kernels.rows import embedded_adjoint

NODES = 5


@pytest.mark.parametrize("points", [0, 2])
def test_spread_reads_no_more_than_there_is(points: int) -> None:
    """Without embedded points lists of carriers have a row all the same; what lies behind nodes is not read then."""
    rng = np.random.default_rng(points)
    carrier = rng.integers(0, NODES, (max(points, 1), 4)).astype(np.int32)
    weight = rng.uniform(0.0, 1.0, carrier.shape)
    whole = np.full((1, 3 * NODES + 12), np.nan)
    whole[0, : 3 * (NODES + points)] = rng.standard_normal(3 * (NODES + points))
    bar = wp.zeros((1, 3 * NODES), dtype=wp.float64, device="cpu")
    given = [carrier, weight, np.arange(NODES, dtype=np.int32), whole]
    arrays = [wp.array(part, device="cpu") for part in given]
    kernel = embedded_adjoint.kernels(lanes.variant("scalar", "float64")).spread
    wp.launch(kernel, (1, 1), [1, NODES, points, True, *arrays], [bar], device="cpu")
    expected = whole[0, : 3 * NODES].reshape(NODES, 3).copy()
    for point in range(points):
        for node, share in zip(carrier[point], weight[point], strict=True):
            expected[node] += share * whole[0, 3 * (NODES + point) : 3 * (NODES + point) + 3]
    np.testing.assert_allclose(bar.numpy().reshape(NODES, 3), expected, rtol=1e-13)
