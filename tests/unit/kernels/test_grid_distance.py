"""The distance of a grid without its gradient: that of ``grid`` to the bit, and near that of a ball and of a box."""

import numpy as np
import pytest
import warp as wp

from softwarp.kernels.collision import shapes

NODES, SPACING, ORIGIN = (21, 25, 29), 0.03, np.array([-0.3, -0.36, -0.42])
RADIUS, HALF = 0.2, np.array([0.15, 0.2, 0.25])


def ball(points):
    return np.linalg.norm(points, axis=1) - RADIUS


def box(points):
    depth = np.abs(points) - HALF
    return np.linalg.norm(np.maximum(depth, 0.0), axis=1) + np.minimum(depth.max(axis=1), 0.0)


def found(distance, real, points):
    """Distances of ``grid_distance`` and of ``grid`` at points, from samples of a function."""
    f = shapes.functions(real)
    grid_distance = f.grid_distance

    @wp.kernel(module="unique", enable_backward=False)
    def probe_distance(
        value: wp.array(dtype=real),
        nodes: wp.vec3i,
        origin: f.vec3,
        spacing: real,
        point: wp.array(dtype=f.vec3),
        found: wp.array(dtype=real),
    ):
        i = wp.tid()
        found[i] = grid_distance(value, 0, nodes, origin, spacing, point[i])

    samples = np.stack(np.meshgrid(*axes(), indexing="ij"), axis=-1).reshape(-1, 3)
    value, point = wp.array(distance(samples), dtype=real), wp.array(points, dtype=f.vec3)
    alone, with_gradient = (wp.zeros(len(points), dtype=real) for _ in range(2))
    inputs = [value, wp.vec3i(*NODES), f.vec3(*ORIGIN), real(SPACING), point]
    wp.launch(probe_distance, dim=len(points), inputs=[*inputs, alone])
    wp.launch(f.probe_grid, dim=len(points), inputs=[*inputs, with_gradient, wp.zeros(len(points), dtype=f.vec3)])
    return alone.numpy(), with_gradient.numpy()


def axes():
    return [ORIGIN[c] + SPACING * np.arange(NODES[c]) for c in range(3)]


@pytest.mark.parametrize("real", [wp.float64, pytest.param(wp.float32, marks=pytest.mark.slow)])
@pytest.mark.parametrize("distance", [ball, box])
def test_grid_distance(distance, real, rng):
    """Bit for bit ``grid``'s, inside, on the border and beside; inside it errs as a trilinear interpolant does.

    |grad d| = 1 bounds the error by the way to the farthest corner of a cell, where d has edges. Away from them it is
    h^2 / (8 R) per direction of curvature 1/R, and nothing where the box is flat.
    """
    with wp.ScopedDevice("cpu"):
        inside = rng.uniform(-1.0, 1.0, (1000, 3)) * -ORIGIN
        border = np.where(rng.random((200, 3)) < 0.5, -ORIGIN, inside[:200])
        at = np.stack([rng.choice(axis, 200) for axis in axes()], axis=1)
        points = np.vstack([inside, border, at, rng.uniform(-0.6, 0.6, (1000, 3))])
        alone, with_gradient = found(distance, real, points)
    np.testing.assert_array_equal(alone, with_gradient)

    rounding = 1e-14 if real is wp.float64 else 1e-6
    error = np.abs(alone - distance(points))
    assert error[:1200].max() < np.sqrt(3.0) * SPACING
    assert error[1200:1400].max() < rounding
    if distance is ball:
        away = np.linalg.norm(inside, axis=1) > RADIUS
        least = RADIUS - np.sqrt(3.0) * SPACING  # radius where a cell may reach to
        assert error[:1000][away].max() < SPACING**2 / (4.0 * least)
    else:
        depth = np.sort(np.abs(inside) - HALF, axis=1)
        flat = (depth[:, 2] - depth[:, 1] > 2.0 * SPACING) & (depth[:, 1] < -SPACING)
        assert flat.sum() > 100 and error[:1000][flat].max() < rounding
