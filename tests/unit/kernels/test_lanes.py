"""Arithmetic of the scalar types that kernels are compiled for."""

from typing import Any

import numpy as np
import pytest
import warp as wp

from softwarp.kernels.algebra.lanes import Variant, variant
from softwarp.solvers.workspace.rows import allocate


def every_function(chosen: Variant) -> Any:
    """A kernel that applies all functions to rows 0 and 1."""
    S = chosen.S
    add, sub, mul, div = chosen.add, chosen.sub, chosen.mul, chosen.div
    sqrt, sin, cos, atan2 = chosen.sqrt, chosen.sin, chosen.cos, chosen.atan2

    @wp.kernel(module=chosen.module("test_lanes"), enable_backward=False)
    def apply(a: wp.array2d(dtype=S), out: wp.array2d(dtype=S)):
        w = wp.tid()
        out[w, 0] = add(a[w, 0], a[w, 1])
        out[w, 1] = sub(a[w, 0], a[w, 1])
        out[w, 2] = mul(a[w, 0], a[w, 1])
        out[w, 3] = div(a[w, 0], a[w, 1])
        out[w, 4] = sqrt(mul(a[w, 0], a[w, 0]))
        out[w, 5] = sin(a[w, 0])
        out[w, 6] = cos(a[w, 0])
        out[w, 7] = atan2(a[w, 0], a[w, 1])

    return apply


@pytest.mark.parametrize(("name", "precision"), [("scalar", "float64"), ("scalar", "float32"), ("lanes", "float32")])
def test_elementwise_functions(name: str, precision: str, rng: np.random.Generator) -> None:
    """Every lane has NumPy's value: to the bit in arithmetic, to rounding in angles."""
    chosen = variant(name, precision)
    rows, out = allocate(chosen, 24, 2, "cpu"), allocate(chosen, 24, 8, "cpu")
    values = rng.standard_normal(rows.real.shape).astype(precision)
    rows.real.assign(values)
    wp.launch(every_function(chosen), dim=rows.S.shape[0], inputs=[rows.S], outputs=[out.S], device="cpu")
    a, b = values[:, 0], values[:, 1]
    found = out.real.numpy().swapaxes(0, 1)
    for measured, expected in zip(found, (a + b, a - b, a * b, a / b, np.sqrt(a * a)), strict=False):
        np.testing.assert_array_equal(measured, expected)
    tolerance = 4.0 * np.finfo(precision).eps
    for measured, expected in zip(found[5:], (np.sin(a), np.cos(a), np.arctan2(a, b)), strict=True):
        np.testing.assert_allclose(measured, expected, rtol=tolerance, atol=tolerance)
