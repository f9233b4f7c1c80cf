"""Forces and rows of nodes onto the modes of reduced bodies, summed as a device does it best.

Theory: docs/theory/reduction.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.elements import mode_sums

GROUP = 4  # modes that a thread of a GPU adds forces to; strides are multiples of it
AHEAD = 4  # nodes whose forces it reads at once


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """``add_forces`` and ``mode_rows`` for one scalar type, and on a CPU ``touch_loads``."""
    return _by_modes(variant) if variant.world_fastest else _by_bodies(variant)


@cache
def _by_bodies(host: Variant) -> SimpleNamespace:
    """Sums over nodes on a CPU: one thread for a body, or for a row."""
    S, real, mul, any_positive = host.S, host.real, host.mul, host.any_positive
    module = host.module("mode_loads")
    push_modes = mode_sums.functions(host).push_modes

    @wp.func
    def is_loaded(force: wp.array2d(dtype=S), w: int, row: int):
        """Whether a force is not zero."""
        x = force[w, row]
        y = force[w, row + 1]
        z = force[w, row + 2]
        return any_positive(mul(x, x) + mul(y, y) + mul(z, z))

    @wp.kernel(module=module, enable_backward=False)
    def add_forces(
        # Model
        body_node: wp.array(dtype=wp.int32),
        order: wp.array(dtype=wp.int32),
        node_basis: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        body_wide: wp.array(dtype=wp.int32),
        body_stride: wp.array(dtype=wp.int32),
        wide_body: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=real),
        # Workspace in
        balance_in: wp.array2d(dtype=S),
        # Workspace out
        wide_force_out: wp.array2d(dtype=S),
    ):
        """Add Phi' f over the nodes of one body; most have no force besides their weight."""
        w, body = wp.tid()
        first = body_wide[body]
        stride = body_stride[body]
        for p in range(body_node[body], body_node[body + 1]):
            i = order[p]
            if is_loaded(balance_in, w, 3 * i):
                push_modes(basis, node_basis[i], stride, balance_in, w, 3 * i, wide_force_out, first)

    @wp.kernel(module=module, enable_backward=False)
    def mode_rows(
        # Model
        row_body: wp.array(dtype=wp.int32),
        row_point: wp.array(dtype=wp.int32),
        row_points: wp.array(dtype=wp.int32),
        row_basis: wp.array(dtype=wp.int32),
        row_wide: wp.array(dtype=wp.int32),
        wide_row: wp.array(dtype=wp.int32),
        body_stride: wp.array(dtype=wp.int32),
        point_basis: wp.array(dtype=real),
        # Workspace in
        point_gradient_in: wp.array2d(dtype=S),
        # Workspace out
        wide_row_out: wp.array2d(dtype=S),
    ):
        """One row of H on the modes of a body, from the gradient by its points."""
        w, row = wp.tid()
        first = row_wide[row]
        stride = body_stride[row_body[row]]
        for k in range(stride):
            wide_row_out[w, first + k] = S(real(0.0))
        for p in range(row_points[row]):
            at = row_basis[row] + 3 * stride * p
            push_modes(point_basis, at, stride, point_gradient_in, w, 3 * (row_point[row] + p), wide_row_out, first)

    @wp.kernel(module=module, enable_backward=False)
    def touch_loads(
        dof_count: int,
        # Model
        body_modes: wp.array(dtype=wp.int32),
        body_stride: wp.array(dtype=wp.int32),
        body_wide: wp.array(dtype=wp.int32),
        mode_dof: wp.array(dtype=wp.int32),
        block_touch: wp.array2d(dtype=wp.int32),
        touch_basis: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=real),
        # Workspace in
        dof_in: wp.array2d(dtype=S),
        # Workspace out
        wide_out: wp.array2d(dtype=S),
        target_out: wp.array2d(dtype=S),
    ):
        """Add Phi' f of the nodes that touch something to forces on the dofs of their bodies' modes."""
        w = wp.tid()
        block = int(0)
        for body in range(body_modes.shape[0]):
            first = body_wide[body]
            stride = body_stride[body]
            last = block + body_modes[body] // 3
            for k in range(stride):
                wide_out[w, first + k] = S(real(0.0))
            for i in range(block_touch[last - 1, 0], block_touch[last - 1, 1]):
                row = 3 * (dof_count + i)
                if is_loaded(dof_in, w, row):
                    push_modes(basis, touch_basis[i], stride, dof_in, w, row, wide_out, first)
            while block < last:
                if block_touch[block, 1] > block_touch[block, 0]:  # not a rigid one of a floating frame
                    for c in range(3):
                        target_out[w, 3 * mode_dof[block] + c] += wide_out[w, first + c]
                first += 3
                block += 1

    return SimpleNamespace(add_forces=add_forces, mode_rows=mode_rows, touch_loads=touch_loads)


@cache
def _by_modes(variant: Variant) -> SimpleNamespace:
    """The same on a GPU: one thread for some modes, whose sums run over nodes in order.

    The warps of a block have the same 32 worlds, so that what one reads of a node is near for the others.
    """
    S = variant.S
    module = variant.module("mode_loads")
    Row = wp.types.vector(GROUP, S)
    Forces = wp.types.vector(3 * AHEAD, S)
    Places = wp.types.vector(AHEAD, wp.int32)

    @wp.func
    def shared(item: int, w: int, items: int, worlds: int):
        """Item and world of a thread, such that 32 worlds have all their items before the next 32."""
        if worlds % 32 != 0:
            return item, w
        place = item * worlds + w
        return place // 32 % items, place // 32 // items * 32 + place % 32

    @wp.kernel(module=module, enable_backward=False)
    def add_forces(
        # Model
        body_node: wp.array(dtype=wp.int32),
        order: wp.array(dtype=wp.int32),
        node_basis: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        body_wide: wp.array(dtype=wp.int32),
        body_stride: wp.array(dtype=wp.int32),
        wide_body: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=S),
        # Workspace in
        balance_in: wp.array2d(dtype=S),
        # Workspace out
        wide_force_out: wp.array2d(dtype=S),
    ):
        """Add Phi' f over the nodes of their body to a group of wide modes; most nodes have no force at all."""
        item, world = wp.tid()
        items = wide_body.shape[0] // wp.static(GROUP)
        group, w = shared(item, world, items, balance_in.shape[0])
        k = wp.static(GROUP) * group
        body = wide_body[k]
        stride = body_stride[body]
        last = body_node[body + 1]
        s = Row()
        for p in range(body_node[body], last, wp.static(AHEAD)):
            f = Forces()
            at = Places()
            for n in range(wp.static(AHEAD)):  # unrolled: these loads do not wait for each other
                if p + n < last:
                    i = order[p + n]
                    at[n] = node_basis[i]
                    f[3 * n] = balance_in[w, 3 * i]
                    f[3 * n + 1] = balance_in[w, 3 * i + 1]
                    f[3 * n + 2] = balance_in[w, 3 * i + 2]
            for n in range(wp.static(AHEAD)):
                fx = f[3 * n]
                fy = f[3 * n + 1]
                fz = f[3 * n + 2]
                if fx * fx + fy * fy + fz * fz > S(0.0):
                    row = at[n] + k - body_wide[body]
                    for c in range(wp.static(GROUP)):
                        s[c] += fx * basis[row + c] + fy * basis[row + c + stride] + fz * basis[row + c + 2 * stride]
        for c in range(wp.static(GROUP)):
            wide_force_out[w, k + c] += s[c]

    @wp.kernel(module=module, enable_backward=False)
    def mode_rows(
        # Model
        row_body: wp.array(dtype=wp.int32),
        row_point: wp.array(dtype=wp.int32),
        row_points: wp.array(dtype=wp.int32),
        row_basis: wp.array(dtype=wp.int32),
        row_wide: wp.array(dtype=wp.int32),
        wide_row: wp.array(dtype=wp.int32),
        body_stride: wp.array(dtype=wp.int32),
        point_basis: wp.array(dtype=S),
        # Workspace in
        point_gradient_in: wp.array2d(dtype=S),
        # Workspace out
        wide_row_out: wp.array2d(dtype=S),
    ):
        """A group of wide modes of a row of H, from the gradient by its points."""
        item, world = wp.tid()
        items = wide_row.shape[0] // wp.static(GROUP)
        group, w = shared(item, world, items, point_gradient_in.shape[0])
        k = wp.static(GROUP) * group
        row = wide_row[k]
        stride = body_stride[row_body[row]]
        at = row_basis[row] + k - row_wide[row]
        first = 3 * row_point[row]
        s = Row()
        for p in range(3 * row_points[row]):
            gradient = point_gradient_in[w, first + p]
            for c in range(wp.static(GROUP)):
                s[c] += gradient * point_basis[at + p * stride + c]
        for c in range(wp.static(GROUP)):
            wide_row_out[w, k + c] = s[c]

    return SimpleNamespace(add_forces=add_forces, mode_rows=mode_rows)
