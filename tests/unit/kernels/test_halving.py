"""Halvings of an edge near a box, three at a time, against halvings one by one."""

import numpy as np
import warp as wp

from softwarp.kernels.collision import shapes
from softwarp.kernels.collision.halving import AT_ONCE, box_halvings
from softwarp.kernels.collision.shape_touches import BISECTIONS

box_slope = shapes.functions(wp.float32).box_slope


@wp.kernel(enable_backward=False, module="unique")
def _halve(
    size: wp.array(dtype=wp.vec3),
    start: wp.array(dtype=wp.vec3),
    way: wp.array(dtype=wp.vec3),
    bound: wp.array(dtype=wp.float32),
    halvings: int,
    together: wp.array(dtype=wp.vec2),
    single: wp.array(dtype=wp.vec2),
):
    i = wp.tid()
    length = wp.length(way[i])
    together[i] = box_halvings(size[i], start[i], way[i], length, 0.0, 1.0, bound[i], halvings / AT_ONCE)
    left = wp.float32(0.0)
    right = wp.float32(1.0)
    for _k in range(halvings):
        t = 0.5 * (left + right)
        slope = box_slope(size[i], start[i] + t * way[i], way[i]) / length
        if slope < bound[i] or (slope == bound[i] and bound[i] > 0.0):
            left = t
        else:
            right = t
    single[i] = wp.vec2(left, right)


def test_brackets_have_the_same_bits(rng: np.random.Generator) -> None:
    """Edges across, along and inside boxes, and ones whose slope is the bound itself: the same brackets to the bit."""
    count = 20000
    size = rng.uniform(0.02, 0.1, (count, 3)).astype(np.float32)
    start = rng.uniform(-0.1, 0.1, (count, 3)).astype(np.float32)
    way = rng.normal(0.0, 0.05, (count, 3)).astype(np.float32)
    way[::3, 2] = 0.0  # along a face
    way[1::3, :2] = 0.0  # across one
    start[::5, 2] = 0.5 * size[::5, 2]  # on its plane
    start[::7] *= np.float32(0.01)
    way[2::9] = [0.0, 0.0, 0.5]  # slopes are 1 or -1
    bound = np.where(rng.random(count) < 0.5, 1e-3, -1e-3).astype(np.float32)
    bound[2::9] = np.sign(bound[2::9])
    found = [wp.empty(count, dtype=wp.vec2, device="cpu") for _ in range(2)]
    arrays = [wp.array(values, dtype=wp.vec3, device="cpu") for values in (size, start, way)]
    inputs = [*arrays, wp.array(bound, dtype=wp.float32, device="cpu"), BISECTIONS]
    wp.launch(_halve, dim=count, inputs=inputs, outputs=found, device="cpu")
    together, single = (brackets.numpy() for brackets in found)
    np.testing.assert_array_equal(together, single)
    inside = (single[:, 0] > 0.01) & (single[:, 1] < 0.99)
    assert inside.mean() > 0.1
    np.testing.assert_allclose(single[:, 1] - single[:, 0], 2.0**-BISECTIONS)
