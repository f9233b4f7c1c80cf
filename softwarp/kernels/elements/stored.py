"""Stored stiffness of elements with up to four corners, and its sum in A. Theory: docs/theory/implicit_euler.md.

An element keeps ten 3x3 blocks K_ab, a >= b, in 90 rows; K_ba is the transpose. Hyperelastic tetrahedra, those at Gauss
points, membranes and rod segments store theirs; block (a, b) of an element has the code 16 element + 4 a + b.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import wide
from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """How a stored block is read."""
    S = variant.S
    vector, rows = algebra(variant).vector, algebra(variant).rows

    @wp.func
    def read_block(stiffness: wp.array2d(dtype=S), w: int, code: int):
        """K_ab of one element."""
        a = (code >> 2) & 3
        b = code & 3
        i = (code >> 4) * 90 + ((a * (a + 1)) // 2 + b) * 9
        across = 1
        down = 3
        if a < b:  # the transpose is stored
            i = (code >> 4) * 90 + ((b * (b + 1)) // 2 + a) * 9
            across = 3
            down = 1
        j = i + down
        k = j + down
        return rows(
            vector(stiffness[w, i], stiffness[w, i + across], stiffness[w, i + 2 * across]),
            vector(stiffness[w, j], stiffness[w, j + across], stiffness[w, j + 2 * across]),
            vector(stiffness[w, k], stiffness[w, k + across], stiffness[w, k + 2 * across]),
        )

    return SimpleNamespace(read_block=read_block)


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Sums of stored blocks, with and without weights."""
    S = variant.S
    real = variant.real
    world_fastest = variant.world_fastest
    module = variant.module("stored")
    a = algebra(variant)
    Matrix, rows, row_x, row_y, row_z, vector = a.Matrix, a.rows, a.row_x, a.row_y, a.row_z, a.vector
    summed, scaled, add_matrix = a.summed, a.scaled, a.add_matrix
    read_block = functions(variant).read_block

    @wp.func
    def times(m: Matrix, s: S):
        return rows(scaled(row_x(m), s), scaled(row_y(m), s), scaled(row_z(m), s))

    @wp.func
    def matrix(x: wide.wide):
        return rows(vector(x[0], x[1], x[2]), vector(x[3], x[4], x[5]), vector(x[6], x[7], x[8]))

    @wp.func
    def sum_each(stiffness: wp.array2d(dtype=S), w: int, begin: int, end: int, entry: wp.array(dtype=wp.int32)):
        """Sum of the blocks of some entries."""
        x = Matrix()
        for p in range(begin, end):
            x = summed(x, read_block(stiffness, w, entry[p]))
        return x

    @wp.func
    def sum_wide(
        stiffness: wp.array2d(dtype=wp.float32), w: int, begin: int, end: int, entry: wp.array(dtype=wp.int32)
    ):
        """The same for one world in float32."""
        return matrix(wide.block_sum(stiffness, w, begin, end, entry))

    @wp.func
    def weighted_each(
        stiffness: wp.array2d(dtype=S),
        w: int,
        begin: int,
        end: int,
        entry: wp.array(dtype=wp.int32),
        weight: wp.array(dtype=real),
    ):
        """Weighted sum of the blocks of some entries."""
        x = Matrix()
        for p in range(begin, end):
            x = summed(x, times(read_block(stiffness, w, entry[p]), S(weight[p])))
        return x

    @wp.func
    def weighted_wide(
        stiffness: wp.array2d(dtype=wp.float32),
        w: int,
        begin: int,
        end: int,
        entry: wp.array(dtype=wp.int32),
        weight: wp.array(dtype=wp.float32),
    ):
        """The same for one world in float32."""
        return matrix(wide.weighted_block_sum(stiffness, w, begin, end, entry, weight))

    block_sum, weighted_sum = (sum_wide, weighted_wide) if wide.is_wide(variant) else (sum_each, weighted_each)

    @wp.kernel(module=module, enable_backward=False)
    def block_stiffness(
        # Model
        element_body: wp.array(dtype=wp.int32),
        entry_start: wp.array(dtype=wp.int32),
        entry: wp.array(dtype=wp.int32),
        # Workspace in
        body_stiffness_scale_in: wp.array2d(dtype=S),
        stiffness_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
    ):
        """Add the stored stiffness of all elements around one 3x3 block of A."""
        w, block = wp.tid()
        if wp.static(world_fastest):
            block, w = wp.tid()
        begin = entry_start[block]
        end = entry_start[block + 1]
        if begin < end:
            x = block_sum(stiffness_in, w, begin, end, entry)
            scale = body_stiffness_scale_in[w, element_body[entry[begin] >> 4]]
            add_matrix(a_out, w, 9 * block, times(x, scale))

    @wp.kernel(module=module, enable_backward=False)
    def weighted_stiffness(
        # Model
        element_body: wp.array(dtype=wp.int32),
        entry_start: wp.array(dtype=wp.int32),
        entry: wp.array(dtype=wp.int32),
        entry_weight: wp.array(dtype=real),
        # Workspace in
        body_stiffness_scale_in: wp.array2d(dtype=S),
        stiffness_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
    ):
        """The same where corners are sums of nodes: every entry has the product of two nodes' weights."""
        w, block = wp.tid()
        if wp.static(world_fastest):
            block, w = wp.tid()
        begin = entry_start[block]
        end = entry_start[block + 1]
        if begin < end:
            x = weighted_sum(stiffness_in, w, begin, end, entry, entry_weight)
            scale = body_stiffness_scale_in[w, element_body[entry[begin] >> 4]]
            add_matrix(a_out, w, 9 * block, times(x, scale))

    return SimpleNamespace(block_stiffness=block_stiffness, weighted_stiffness=weighted_stiffness)
