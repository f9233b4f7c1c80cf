"""Glances at the numbers of a pack: every number counts, wherever it stands; worlds come into lanes as they are."""

import numpy as np
import pytest
import warp as wp

from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.step import transfer

LANES, NODES, PACKS = 8, 5, 2  # 15 rows: a square of eight rows, and seven more
ROWS = 3 * NODES


def host(values):
    return wp.array(values, device="cpu")


@pytest.mark.parametrize("lanes", [1, LANES])
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_worlds_come_into_lanes_as_they_are(lanes, precision):
    worlds = PACKS * lanes - (lanes > 1) * 3
    state = np.random.default_rng(0).normal(size=(worlds, ROWS)).astype(precision)
    pack = wp.zeros((PACKS, ROWS, lanes), dtype=variant("scalar", precision).real, device="cpu")
    kernel = transfer.kernels(variant("scalar", precision)).interleave
    wp.launch(kernel, dim=(PACKS, lanes), inputs=[host(state), worlds, lanes], outputs=[pack], device="cpu")
    for world in range(PACKS * lanes):
        np.testing.assert_array_equal(pack.numpy()[world // lanes, :, world % lanes], state[min(world, worlds - 1)])


@pytest.mark.parametrize("lanes", [1, LANES])
@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("count", [ROWS, ROWS - 4])
def test_rows_are_added_in_all_worlds_and_none_behind_the_last(lanes, precision, count):
    rng = np.random.default_rng(0)
    value, before = (rng.normal(size=(PACKS, ROWS, lanes)).astype(precision) for _ in range(2))
    target = host(before)
    kernel = transfer.kernels(variant("scalar", precision)).add_rows
    wp.launch(kernel, dim=(PACKS, 1, lanes), inputs=[count, host(value)], outputs=[target], device="cpu")
    value[:, count:] = 0.0
    np.testing.assert_array_equal(target.numpy(), before + value)


def checked_nodes(x, v, lanes, dof=0):
    """Flags of all packs after a step from the origin of a row of nodes, of which one is solved for."""
    start, commanded = np.zeros_like(x), np.zeros((PACKS, 1, lanes), dtype=np.float32)
    node_dof = np.full(NODES, -1, dtype=np.int32)
    node_dof[2] = dof
    flag = wp.zeros((PACKS, 2, lanes), dtype=wp.int32, device="cpu")
    inputs = [host(node_dof), *(host(a) for a in (start, x, v, commanded)), 0.5, 2.0]
    kernel = transfer.kernels(variant("scalar")).check_nodes
    wp.launch(kernel, dim=(PACKS, 1, lanes), inputs=inputs, outputs=[flag], device="cpu")
    return flag.numpy()


@pytest.mark.parametrize("lanes", [1, LANES])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 0.6, -0.6])
def test_no_node_is_overlooked_and_no_other_world_is_flagged(lanes, value):
    good = np.zeros((PACKS, ROWS, lanes), dtype=np.float32)
    still = np.zeros((PACKS, 3, lanes), dtype=np.float32)
    assert not checked_nodes(good, still, lanes).any()
    for row in range(ROWS):
        for lane in range(lanes):
            x = good.copy()
            x[1, row, lane] = value
            flag = checked_nodes(x, still, lanes)
            assert flag[1, 1 if np.isfinite(value) else 0, lane] > 0
            flag[1, :, lane] = 0
            assert not flag.any()
    v = still.copy()
    v[0, 2, lanes - 1] = np.nan
    assert checked_nodes(good, v, lanes)[0, 0, lanes - 1] == 1


@pytest.mark.parametrize("lanes", [1, LANES])
def test_only_the_first_rows_count(lanes):
    kernel = transfer.kernels(variant("scalar")).check_rows
    for row in range(ROWS):
        values = np.zeros((PACKS, ROWS, lanes), dtype=np.float32)
        values[0, row, lanes - 1] = np.inf
        flag = wp.zeros((PACKS, 2, lanes), dtype=wp.int32, device="cpu")
        wp.launch(kernel, dim=(PACKS, 1, lanes), inputs=[11, host(values)], outputs=[flag], device="cpu")
        expected = np.zeros((PACKS, 2, lanes))
        expected[0, 0, lanes - 1] = row < 11
        np.testing.assert_array_equal(flag.numpy(), expected)
