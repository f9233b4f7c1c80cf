"""Laws in SIMD lanes against the functions of one element in float64."""

import numpy as np
import pytest
import warp as wp

from softwarp.kernels.elements.laws import LAWS
from softwarp.kernels.elements.ogden import three, twelve

ROUNDING = 2.0**-24
PARAMETERS = {
    "corotational": (1.6e5, 1.4e6),
    "neo_hookean": (1.6e5, 1.4e6),
    "yeoh": (1.5e6, 8.0e4, 1.0e3, 2.0e2),
    "mooney_rivlin": (1.5e6, 5.0e4, 3.0e4),
}
every_law = pytest.mark.parametrize("name", PARAMETERS)


def stretches(rng, count=64):
    """Small and large ones, equal ones among them, that float32 holds."""
    s = np.exp(rng.uniform(-0.6, 0.6, (count, 3)) * rng.choice([1e-3, 0.1, 1.0], (count, 1)))
    s[:8, 1] = s[:8, 0]
    s[0] = 1.0
    return s.astype(np.float32).astype(np.float64)


def in_lanes(name, given, function, shape):
    """Rows of a function of three numbers and the law's parameters, eight at a time."""
    law, count = LAWS[name], len(given)
    table = wp.types.matrix((law.count, 8), wp.float32)

    @wp.kernel(module="unique", enable_backward=False)
    def apply(given: wp.array(dtype=three), p: wp.array(dtype=table), out: wp.array(dtype=shape)):
        i = wp.tid()
        out[i] = function(given[i][0], given[i][1], given[i][2], p[i])

    packed = given.reshape(-1, 8, 3).transpose(0, 2, 1).astype(np.float32)
    parameters = np.broadcast_to(np.array(PARAMETERS[name])[None, :, None], (count // 8, law.count, 8))
    out = wp.zeros(count // 8, dtype=shape, device="cpu")
    inputs = [wp.array(packed, dtype=three, device="cpu")]
    inputs.append(wp.array(parameters.astype(np.float32), dtype=table, device="cpu"))
    wp.launch(apply, dim=count // 8, inputs=inputs, outputs=[out], device="cpu")
    return out.numpy().transpose(0, 2, 1).reshape(count, -1)


def one_by_one(name, given):
    """The same by ``materials``: of given s, slopes, or a, b and c of their invariants, and the tangent as in lanes."""
    law = LAWS[name]
    stress_of, principal, by_slopes = law.invariants or law.slopes, law.principal, law.invariants is None

    @wp.kernel(module="unique", enable_backward=False)
    def apply(
        s: wp.array(dtype=wp.vec3d),
        p: wp.types.vector(law.count, wp.float64),
        stress_out: wp.array(dtype=wp.vec3d),
        hessian_out: wp.array(dtype=wp.mat33d),
        minus_out: wp.array(dtype=wp.vec3d),
        plus_out: wp.array(dtype=wp.vec3d),
    ):
        i = wp.tid()
        if wp.static(by_slopes):
            stress_out[i] = stress_of(s[i], p)
        else:
            J = s[i][0] * s[i][1] * s[i][2]
            area = wp.vec3d(s[i][1] * s[i][2], s[i][2] * s[i][0], s[i][0] * s[i][1])
            a, b, c = stress_of(wp.dot(s[i], s[i]), wp.dot(area, area), J, p)
            stress_out[i] = wp.vec3d(a, b, c)
        H, minus, plus = principal(s[i], p)
        hessian_out[i] = H
        minus_out[i] = minus
        plus_out[i] = plus

    outputs = [wp.zeros(len(given), dtype=dtype, device="cpu") for dtype in (wp.vec3d, wp.mat33d, wp.vec3d, wp.vec3d)]
    inputs = [wp.array(given, dtype=wp.vec3d, device="cpu"), PARAMETERS[name]]
    wp.launch(apply, dim=len(given), inputs=inputs, outputs=outputs, device="cpu")
    stress, H, minus, plus = (output.numpy() for output in outputs)
    rows = [H[:, a, b] for a, b in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    return stress, np.concatenate([np.stack(rows, axis=1), minus, plus], axis=1)


@every_law
def test_law_in_lanes(name, rng):
    """Coefficients or slopes of the stress, stretch Hessian and shear eigenvalues."""
    s = stretches(rng)
    stress, tangent = one_by_one(name, s)
    square, J = s**2, s.prod(axis=1)
    if LAWS[name].slopes:
        found = in_lanes(name, s, LAWS[name].lanes.slopes, three)
    else:
        invariants = np.stack([square.sum(axis=1), (J[:, None] ** 2 / square).sum(axis=1), J], axis=1)
        found = in_lanes(name, invariants, LAWS[name].lanes.invariants, three)
    bulk = max(PARAMETERS[name])
    np.testing.assert_allclose(found, stress, rtol=1e-5, atol=30 * ROUNDING * bulk)
    found = in_lanes(name, s, LAWS[name].lanes.principal, twelve)
    np.testing.assert_allclose(found, tangent, rtol=1e-5, atol=3e-6 * np.abs(tangent).max())


@pytest.mark.parametrize("name", [name for name in PARAMETERS if LAWS[name].is_upright])
def test_no_stress_of_mirrored_elements_in_lanes(name, rng):
    """Where J is not positive, stress and tangent are not numbers, and those of the other lanes are."""
    s = stretches(rng)[:8]
    s[3, 2], s[5, 0] = -s[3, 2], 0.0
    invariants = np.stack([(s**2).sum(axis=1), np.ones(8), s.prod(axis=1)], axis=1)
    stress = in_lanes(name, invariants, LAWS[name].lanes.invariants, three)
    tangent = in_lanes(name, s, LAWS[name].lanes.principal, twelve)
    good = np.array([True, True, True, False, True, False, True, True])
    assert (np.isfinite(stress[:, 1]) == good).all()
    assert (np.isfinite(tangent).all(axis=1) == good).all()


def test_bound_of_polar_in_lanes():
    """Where a pair of stretches cancels, the rotational eigenvalue is bounded as that of one element."""
    s = np.ones((8, 3))
    s[:, 2] = [-1.0, -0.9999, -1.0002, -1.01, 0.0, -0.5, 1.0, -0.9]
    s = s.astype(np.float32).astype(np.float64)
    _, tangent = one_by_one("corotational", s)
    found = in_lanes("corotational", s, LAWS["corotational"].lanes.principal, twelve)
    np.testing.assert_allclose(found, tangent, rtol=2e-5)
