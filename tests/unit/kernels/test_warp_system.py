"""Newton's systems of contacts as the threads of a warp eliminate them, which are fibers of a block on a CPU."""

import numpy as np
import pytest
import warp as wp

from softwarp.kernels.algebra import lanes
from softwarp.kernels.rows import warp_system
from softwarp.kernels.rows.coulomb_newton import PIVOT
from softwarp.kernels.rows.warp_share import meet

SIZES = [1, 2, 3, 9, 31, 32, 33, 40, 63, 64, 65, 94, 95]


@pytest.mark.slow
@pytest.mark.parametrize("near", [0, 63])
def test_systems_of_all_sizes_are_solved(monkeypatch, near):
    """Beside NumPy, to rounding; memory holds no number before, and what lies behind the systems is left alone."""
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    variant = lanes.variant("cuda", "float64")
    systems = warp_system.functions(variant, near)
    system_of, put, got = systems.system_of, systems.put, systems.got

    @wp.kernel(module="unique", enable_backward=False)
    def solve(
        given: wp.array3d(dtype=wp.float64),
        size: wp.array(dtype=wp.int32),
        stride: int,
        work: wp.array2d(dtype=wp.float64),
        solution: wp.array2d(dtype=wp.float64),
        lost: wp.array(dtype=wp.uint64),
    ):
        w, thread = wp.tid()
        count = size[w]
        lines = system_of(work, w, thread, count, stride, False)
        pitch = wp.where(count <= wp.static(near), wp.static(near + 2), stride)
        meet()
        for i in range(count):
            for j in range(thread, count + 2, 32):
                put(lines, i * pitch + j, given[w, i, j])
        meet()
        lost[w] = system_of(work, w, thread, count, stride, True)
        for i in range(thread, count, 32):
            solution[w, i] = got(lines, i * pitch + count)
        meet()

    rng, most, stride = np.random.default_rng(1), max(SIZES), warp_system.stride_of(max(SIZES))
    given, expected = np.zeros((len(SIZES), most, stride)), np.zeros((len(SIZES), most))
    for w, n in enumerate(SIZES):
        matrix, right = rng.normal(size=(n, n)) + 3.0 * np.sqrt(n) * np.eye(n), rng.normal(size=n)
        given[w, :n, :n], given[w, :n, n], given[w, :n, n + 1] = matrix, right, PIVOT * np.abs(np.diag(matrix))
        expected[w, :n] = np.linalg.solve(matrix, right)
    entries = warp_system.entries(most)
    work = wp.array(np.full((len(SIZES), entries + 1), np.nan), dtype=wp.float64, device="cpu")
    work.numpy()[:, entries] = 7.0
    solution = wp.zeros((len(SIZES), most), dtype=wp.float64, device="cpu")
    lost = wp.zeros(len(SIZES), dtype=wp.uint64, device="cpu")
    inputs = [wp.array(given, dtype=wp.float64, device="cpu"), wp.array(SIZES, dtype=wp.int32, device="cpu"), stride]
    wp.launch(solve, (len(SIZES), 32), inputs, [work, solution, lost], device="cpu", block_dim=32)
    np.testing.assert_allclose(solution.numpy(), expected, rtol=1e-10, atol=1e-13)
    assert not lost.numpy().any() and (work.numpy()[:, entries] == 7.0).all()
