"""Ogden's law in SIMD lanes against the functions of one element in float64, and the powers that it takes."""

import numpy as np
import warp as wp

from softwarp.kernels.algebra.lane_powers import exp_lanes, log_lanes
from softwarp.kernels.algebra.lanes import vec8
from softwarp.kernels.elements import materials, ogden

ROUNDING = 2.0**-24
LAW = np.array([5.0e5, 1.1e5, 1.3, 2.0e4, 5.0, 1.5e4, -2.0])  # bulk, mu_1, alpha_1, .., alpha_3
vec7d = wp.types.vector(7, wp.float64)


@wp.kernel(enable_backward=False)
def powers(x: wp.array(dtype=vec8), exp_out: wp.array(dtype=vec8), log_out: wp.array(dtype=vec8)):
    i = wp.tid()
    exp_out[i] = exp_lanes(x[i])
    log_out[i] = log_lanes(x[i])


@wp.kernel(enable_backward=False)
def in_lanes(
    s: wp.array(dtype=ogden.three),
    p: wp.array(dtype=ogden.parameters),
    slopes_out: wp.array(dtype=ogden.three),
    principal_out: wp.array(dtype=ogden.twelve),
):
    i = wp.tid()
    slopes_out[i] = ogden.slopes(s[i][0], s[i][1], s[i][2], p[i])
    principal_out[i] = ogden.principal(s[i][0], s[i][1], s[i][2], p[i])


@wp.kernel(enable_backward=False)
def one_by_one(
    s: wp.array(dtype=wp.vec3d),
    p: vec7d,
    slopes_out: wp.array(dtype=wp.vec3d),
    hessian_out: wp.array(dtype=wp.mat33d),
    minus_out: wp.array(dtype=wp.vec3d),
    plus_out: wp.array(dtype=wp.vec3d),
):
    i = wp.tid()
    slopes_out[i] = materials.ogden_slopes(s[i], p)
    H, minus, plus = materials.ogden_principal(s[i], p)
    hessian_out[i] = H
    minus_out[i] = minus
    plus_out[i] = plus


def test_powers_of_lanes() -> None:
    """To two roundings (ln near 1: of a thousandth); not a number stays so, and what is not positive becomes one."""
    x = np.concatenate([np.linspace(-86.0, 86.0, 799), [np.nan]]).astype(np.float32)
    y = np.concatenate([10.0 ** np.linspace(-30.0, 30.0, 400), 1.0 + np.linspace(-0.3, 0.3, 398), [-1.0, 0.0]])
    results = []
    for values in (x, y.astype(np.float32)):
        given = wp.array(values.reshape(-1, 8), dtype=vec8, device="cpu")
        outputs = [wp.zeros_like(given), wp.zeros_like(given)]
        wp.launch(powers, dim=len(given), inputs=[given], outputs=outputs, device="cpu")
        results.append([output.numpy().ravel() for output in outputs])
    np.testing.assert_allclose(results[0][0], np.exp(x.astype(np.float64)), rtol=2.0 * ROUNDING)
    expected = np.log(y[:-2].astype(np.float32).astype(np.float64))
    np.testing.assert_allclose(results[1][1][:-2], expected, rtol=2.0 * ROUNDING, atol=1e-3 * ROUNDING)
    assert np.isnan(results[1][1][-2:]).all()


def test_law_in_lanes(rng: np.random.Generator) -> None:
    """Slopes, stretch Hessian and shear eigenvalues of small and large stretches, equal ones among them."""
    count = 64
    s = np.exp(rng.uniform(-0.6, 0.6, (count, 3)) * rng.choice([1e-3, 0.1, 1.0], (count, 1)))
    s[:8, 1] = s[:8, 0]
    s[0] = 1.0
    s = s.astype(np.float32).astype(np.float64)
    outputs = [wp.zeros(count, dtype=dtype, device="cpu") for dtype in (wp.vec3d, wp.mat33d, wp.vec3d, wp.vec3d)]
    given = wp.array(s, dtype=wp.vec3d, device="cpu")
    wp.launch(one_by_one, dim=count, inputs=[given, vec7d(*LAW)], outputs=outputs, device="cpu")
    slopes, H, minus, plus = (output.numpy() for output in outputs)
    packed = wp.array(s.reshape(-1, 8, 3).transpose(0, 2, 1).astype(np.float32), dtype=ogden.three, device="cpu")
    law = np.broadcast_to(LAW[None, :, None], (count // 8, 7, 8)).astype(np.float32)
    results = [wp.zeros(count // 8, dtype=dtype, device="cpu") for dtype in (ogden.three, ogden.twelve)]
    given = [packed, wp.array(law, dtype=ogden.parameters, device="cpu")]
    wp.launch(in_lanes, dim=count // 8, inputs=given, outputs=results, device="cpu")
    found_slopes, found = (result.numpy().transpose(0, 2, 1).reshape(count, -1) for result in results)
    expected = np.stack([H[:, a, b] for a, b in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))], axis=1)
    scale = np.abs(H).max()
    np.testing.assert_allclose(found_slopes, slopes, rtol=1e-5, atol=100 * ROUNDING * LAW[0])
    np.testing.assert_allclose(found[:, :6], expected, rtol=1e-5, atol=3e-6 * scale)
    np.testing.assert_allclose(found[:, 6:9], minus, rtol=1e-5, atol=3e-6 * scale)
    np.testing.assert_allclose(found[:, 9:], plus, rtol=1e-5, atol=3e-6 * scale)
