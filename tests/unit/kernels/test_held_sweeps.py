"""Sweeps over a few rows in registers against those that any number of rows takes."""

import numpy as np
import pytest
import warp as wp

from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.rows import delassus, held_sweeps


@pytest.mark.parametrize("sweeps", [1, 40])
def test_sweeps_are_those_of_any_number_of_rows(sweeps: int, rng: np.random.Generator) -> None:
    """Multipliers, changes, gaps and residual of eight worlds of five rows, some of them at a bound."""
    chosen, worlds, n = variant("cuda", "float64"), 8, 5
    roots = rng.standard_normal((worlds, n, n))
    W = roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(n)
    lower = np.zeros((worlds, n))
    upper = np.full((worlds, n), 0.3)
    gap, start = rng.standard_normal((worlds, n)), np.full((worlds, n), 0.1)

    def arrays(*values: np.ndarray) -> list[wp.array]:
        return [wp.array(value.reshape(worlds, -1), dtype=wp.float64, device="cpu") for value in values]

    results = []
    for kernel, first in (
        (delassus.kernels(chosen).gauss_seidel, [n]),
        (held_sweeps.kernels(chosen, n).gauss_seidel, []),
    ):
        outputs = arrays(gap, start, np.ones((worlds, n)), np.ones((worlds, 1)))
        wp.launch(kernel, dim=worlds, inputs=[*first, sweeps, *arrays(W, lower, upper)], outputs=outputs, device="cpu")
        results.append([output.numpy() for output in outputs])
    for one, two in zip(*results, strict=True):
        np.testing.assert_allclose(two, one, rtol=1e-12, atol=1e-14)
    multiplier = results[0][1]
    assert (multiplier == 0.0).any()
    assert (multiplier == 0.3).any()
    assert ((multiplier > 0.0) & (multiplier < 0.3)).any()
