"""The part of an edge that is searched in a grid: around its lowest sample, left out only where all of it is far."""

import numpy as np
import pytest
import warp as wp

from softwarp.kernels.collision import edges_in_grids, shapes
from softwarp.kernels.collision.edges_in_grids import SAMPLES
from softwarp.model.codes import FAR

NODES, SPACING, ORIGIN = (21, 25, 29), 0.03, np.array([-0.3, -0.36, -0.42])
RADIUS, REACH, DENSE = 0.1, 0.05, 257


def samples():
    """Distances from a ball, whose slopes are 1 in all directions, and edges beside it are nearest in their middle."""
    axes = [ORIGIN[c] + SPACING * np.arange(NODES[c]) for c in range(3)]
    return np.linalg.norm(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3), axis=1) - RADIUS


@pytest.mark.parametrize("real", [wp.float64, pytest.param(wp.float32, marks=pytest.mark.slow)])
def test_only_what_is_far_is_left_out(real, rng):
    """By 257 places of each of 2 000 edges; with care for all, the part is that around the lowest of nine samples."""
    f, vec3 = edges_in_grids.functions(real), shapes.functions(real).vec3
    near_part, grid_distance = f.near_part, shapes.functions(real).grid_distance

    @wp.kernel(module="unique", enable_backward=False)
    def probe(
        value: wp.array(dtype=real),
        nodes: wp.vec3i,
        origin: vec3,
        spacing: real,
        start: wp.array(dtype=vec3),
        way: wp.array(dtype=vec3),
        reach: real,
        care: real,
        part: wp.array2d(dtype=real),
        dense: wp.array2d(dtype=real),
    ):
        i = wp.tid()
        d = way[i]
        low, high = near_part(value, 0, nodes, origin, spacing, start[i], d, wp.length(d), real(0.0), reach, care)
        part[i, 0] = low
        part[i, 1] = high
        for k in range(dense.shape[1]):
            t = real(k) / real(dense.shape[1] - 1)
            dense[i, k] = grid_distance(value, 0, nodes, origin, spacing, start[i] + t * d)

    count = 2000
    ends = rng.uniform(-0.22, 0.22, (count, 3))
    ways = rng.normal(size=(count, 3)) * 0.08
    value, start, way = wp.array(samples(), dtype=real), wp.array(ends, dtype=vec3), wp.array(ways, dtype=vec3)
    grid = [value, wp.vec3i(*NODES), vec3(*ORIGIN), real(SPACING), start, way]
    told = []
    for care in (FAR, 0.02, -0.01):
        part, dense = wp.zeros((count, 2), dtype=real), wp.zeros((count, DENSE), dtype=real)
        wp.launch(probe, dim=count, inputs=[*grid, real(REACH), real(care), part, dense], device="cpu")
        told.append(part.numpy())
    dense = dense.numpy().astype(np.float64)
    coarse = dense[:, :: (DENSE - 1) // (SAMPLES - 1)]
    at, length = coarse.argmin(axis=1), np.linalg.norm(ways, axis=1)
    is_part = (at > 0) & (at < SAMPLES - 1) & (dense[:, DENSE // 2] - 0.5 * length <= REACH)
    everything = told[0]
    assert np.array_equal(everything[:, 0] >= 0.0, is_part) and 100 < is_part.sum() < count - 100
    assert np.allclose(everything[is_part], np.stack([at - 1, at + 1], axis=1)[is_part] / (SAMPLES - 1))
    for care, part in zip((0.02, -0.01), told[1:], strict=True):
        kept = part[:, 0] >= 0.0
        assert np.array_equal(part[kept], everything[kept])
        dropped = is_part & ~kept
        assert dropped.sum() > 50 and (dense[dropped].min(axis=1) > care).all()
        assert not (kept & ~is_part).any()
