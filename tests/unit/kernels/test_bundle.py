"""Eight elements of a world at a time: every number of every element is where it belongs, and no other is touched."""

import numpy as np
import pytest
import warp as wp

from softwarp.kernels.algebra import lanes
from softwarp.kernels.algebra.lanes import LANE_COUNT
from softwarp.kernels.algebra.vectors import algebra
from softwarp.kernels.elements import access

WORLDS, NODES, BODIES = 2, 7, 3
ELEMENTS = 21  # of a list that holds 19 of them: two bundles, and three elements that the last one repeats
COUNT = 19
at = access.functions(lanes.variant("scalar"))
a = algebra(at.inner)
rows, scaled, row_x, row_y, row_z = a.rows, a.scaled, a.row_x, a.row_y, a.row_z
edges, gradients, of_tet, of_scene, of_body = at.edges, at.gradients, at.of_tet, at.of_scene, at.of_body
write_corners, write_block, all_edges, all_numbers = at.write_corners, at.write_block, at.all_edges, at.all_numbers


@wp.kernel(enable_backward=False)
def write_all(
    index: wp.array(dtype=wp.int32),
    node: wp.array2d(dtype=wp.int32),
    body: wp.array(dtype=wp.int32),
    constants: wp.array2d(dtype=wp.float32),
    number: wp.array(dtype=wp.float32),
    bodys_number: wp.array(dtype=wp.float32),
    bodys_row: wp.array2d(dtype=wp.float32),
    x: wp.array2d(dtype=wp.float32),
    edge_out: wp.array2d(dtype=wp.float32),
    constant_out: wp.array2d(dtype=wp.float32),
    corner_out: wp.array2d(dtype=wp.float32),
):
    w, item = wp.tid()
    e = edges(x, w, node, index, item)
    g = gradients(constants, index, item)
    write_block(edge_out, w, index, item, 9, e)
    write_block(constant_out, w, index, item, 0, g)
    p = of_tet(number, index, item)
    q = of_scene(bodys_number, body, index, item)
    r = of_body(bodys_row, w, body, index, item)
    write_corners(corner_out, w, index, item, scaled(row_x(e), p), scaled(row_y(e), q), scaled(row_z(e), r))


@wp.kernel(enable_backward=False)
def write_in_order(
    index: wp.array(dtype=wp.int32),
    node: wp.array2d(dtype=wp.int32),
    number: wp.array(dtype=wp.float32),
    x: wp.array2d(dtype=wp.float32),
    corner_out: wp.array2d(dtype=wp.float32),
):
    w, item = wp.tid()
    e = all_edges(x, w, node, item)
    p = all_numbers(number, item)
    write_corners(corner_out, w, index, item, scaled(row_x(e), p), scaled(row_y(e), p), scaled(row_z(e), p))


def test_all_elements_come_in_their_order():
    rng = np.random.default_rng(0)
    node = rng.integers(0, NODES, (ELEMENTS, 4)).astype(np.int32)
    number = rng.normal(size=ELEMENTS).astype(np.float32)
    x = rng.normal(size=(WORLDS, 3 * NODES)).astype(np.float32)
    inputs = [wp.array(v, device="cpu") for v in (np.arange(ELEMENTS, dtype=np.int32), node, number, x)]
    corner = wp.zeros((WORLDS, 12 * ELEMENTS), dtype=wp.float32, device="cpu")
    wp.launch(write_in_order, dim=(WORLDS, -(-ELEMENTS // LANE_COUNT)), inputs=inputs, outputs=[corner], device="cpu")
    place = x.reshape(WORLDS, NODES, 3)[:, node]
    expected = (place[:, :, 1:] - place[:, :, :1]) * number[:, None, None]
    np.testing.assert_array_equal(corner.numpy().reshape(WORLDS, ELEMENTS, 4, 3)[:, :, 1:], expected)


@pytest.mark.parametrize("count", [COUNT, 2 * LANE_COUNT, 1])
def test_what_is_gathered_is_written_where_it_belongs(count):
    rng = np.random.default_rng(0)
    index = rng.permutation(ELEMENTS)[:count].astype(np.int32)
    node = rng.integers(0, NODES, (ELEMENTS, 4)).astype(np.int32)
    body = rng.integers(0, BODIES, ELEMENTS).astype(np.int32)
    inputs = [rng.normal(size=shape).astype(np.float32) for shape in ((ELEMENTS, 9), ELEMENTS, BODIES)]
    rows_in = [rng.normal(size=(WORLDS, size)).astype(np.float32) for size in (BODIES, 3 * NODES)]
    outputs = [np.full((WORLDS, ELEMENTS * size), np.nan, dtype=np.float32) for size in (90, 90, 12)]
    on_device = [[wp.array(v, device="cpu") for v in values] for values in ([index, node, body, *inputs], rows_in)]
    results = [wp.array(v, device="cpu") for v in outputs]
    dim = (WORLDS, -(-count // LANE_COUNT))
    wp.launch(write_all, dim=dim, inputs=on_device[0] + on_device[1], outputs=results, device="cpu")

    x = rows_in[1].reshape(WORLDS, NODES, 3)[:, node[index]]
    edge = x[:, :, 1:] - x[:, :, :1]
    constants, number, bodys_number = inputs
    corner = edge.copy()
    corner[:, :, 0] *= number[index, None]
    corner[:, :, 1] *= bodys_number[body[index], None]
    corner[:, :, 2] *= rows_in[0][:, body[index], None]
    balance = -((corner[:, :, 0] + corner[:, :, 1]) + corner[:, :, 2])
    edge_rows, constant_rows, corner_rows = (v.reshape(WORLDS, ELEMENTS, -1) for v in outputs)
    edge_rows[:, index, 9:18] = edge.reshape(WORLDS, count, 9)
    constant_rows[:, index, :9] = constants[index]
    corner_rows[:, index] = np.concatenate([balance[:, :, None], corner], axis=2).reshape(WORLDS, count, 12)
    for expected, found in zip(outputs, results, strict=True):
        np.testing.assert_array_equal(found.numpy(), expected)
