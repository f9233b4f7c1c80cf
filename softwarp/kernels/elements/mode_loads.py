"""Forces and rows of nodes onto the modes of reduced bodies, summed as a device does it best.

Theory: docs/theory/reduction.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import team
from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.elements import mode_sums

GROUP = 4  # modes that a thread of a GPU adds forces to; strides are multiples of it
AHEAD = 4  # nodes whose forces it reads at once

# Four entries of a row, to which a GPU's threads go with one access.
_FOUR = """
#if defined(__CUDA_ARCH__)
struct alignas(16) Four { SCALAR x[4]; };
const Four four = *(const Four*)(basis.data + at);
for (int c = 0; c < 4; ++c) row.c[c] = four.x[c];
#else
for (int c = 0; c < 4; ++c) row.c[c] = basis.data[at + c];
#endif
return row;
"""


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """``add_forces``, ``mode_rows`` and ``touch_loads`` for one scalar type, or ``touch_forces`` on a GPU."""
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
    """The same on a GPU: threads share the nodes for some modes of a world; their sums are added in a fixed order.

    The warps of a block have the same worlds, so that what one reads of a node is near for the others.
    """
    S = variant.S
    module = variant.module("mode_loads")
    Row = wp.types.vector(GROUP, S)
    Forces = wp.types.vector(3 * AHEAD, S)
    Places = wp.types.vector(AHEAD, wp.int32)
    Ahead = wp.types.vector(AHEAD, S)
    Three = wp.types.vector(3, S)
    seat, whole = vars(team.functions(variant)).values()

    @wp.func_native(_FOUR.replace("SCALAR", "double" if S is wp.float64 else "float"))
    def four(basis: wp.array(dtype=S), at: int, row: Row) -> Row: ...

    @wp.kernel(module=module, enable_backward=False)
    def add_forces(
        parts: int,
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
        group = wp.tid()
        item, world, part = seat(group, wide_body.shape[0] // wp.static(GROUP), parts)
        w = wp.min(world, balance_in.shape[0] - 1)  # all threads of a warp take part in its exchanges
        k = wp.static(GROUP) * item
        body = wide_body[k]
        stride = body_stride[body]
        last = body_node[body + 1]
        s = Row()
        for p in range(body_node[body] + wp.static(AHEAD) * part, last, wp.static(AHEAD) * parts):
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
                    s += four(basis, row, Row()) * fx
                    s += four(basis, row + stride, Row()) * fy
                    s += four(basis, row + 2 * stride, Row()) * fz
        for c in range(wp.static(GROUP)):
            s[c] = whole(s[c], parts)
        if part == 0 and world < balance_in.shape[0]:
            for c in range(wp.static(GROUP)):
                wide_force_out[w, k + c] += s[c]

    @wp.kernel(module=module, enable_backward=False)
    def mode_rows(
        parts: int,
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
        group = wp.tid()
        item, world, part = seat(group, wide_row.shape[0] // wp.static(GROUP), parts)
        w = wp.min(world, point_gradient_in.shape[0] - 1)
        k = wp.static(GROUP) * item
        row = wide_row[k]
        stride = body_stride[row_body[row]]
        at = row_basis[row] + k - row_wide[row]
        first = 3 * row_point[row]
        last = 3 * row_points[row]
        s = Row()
        for p in range(wp.static(AHEAD) * part, last, wp.static(AHEAD) * parts):
            gradient = Ahead()
            for n in range(wp.static(AHEAD)):  # likewise
                if p + n < last:
                    gradient[n] = point_gradient_in[w, first + p + n]
            for n in range(wp.static(AHEAD)):
                if p + n < last:
                    s += four(point_basis, at + (p + n) * stride, Row()) * gradient[n]
        for c in range(wp.static(GROUP)):
            s[c] = whole(s[c], parts)
        if part == 0 and world < point_gradient_in.shape[0]:
            for c in range(wp.static(GROUP)):
                wide_row_out[w, k + c] = s[c]

    @wp.kernel(module=module, enable_backward=False)
    def touch_forces(
        parts: int,
        dof_count: int,
        # Model
        mode_dof: wp.array(dtype=wp.int32),
        block_touch: wp.array2d(dtype=wp.int32),
        touch_begin: wp.array(dtype=wp.int32),
        touch_stride: wp.array(dtype=wp.int32),
        touch_basis: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=S),
        # Workspace in
        dof_in: wp.array2d(dtype=S),
        # Workspace out
        target_out: wp.array2d(dtype=S),
    ):
        """Add to forces on one dof of three modes Phi' f of the nodes that touch something; most have none."""
        group = wp.tid()
        block, world, part = seat(group, mode_dof.shape[0], parts)
        w = wp.min(world, dof_in.shape[0] - 1)
        last = block_touch[block, 1]
        s = Three()
        for p in range(block_touch[block, 0] + wp.static(AHEAD) * part, last, wp.static(AHEAD) * parts):
            f = Forces()
            for n in range(wp.static(AHEAD)):  # unrolled, likewise
                if p + n < last:
                    for c in range(3):
                        f[3 * n + c] = dof_in[w, 3 * (dof_count + p + n) + c]
            for n in range(wp.static(AHEAD)):
                fx = f[3 * n]
                fy = f[3 * n + 1]
                fz = f[3 * n + 2]
                if fx * fx + fy * fy + fz * fz > S(0.0):
                    stride = touch_stride[p + n]
                    x = touch_basis[p + n] + 3 * (block - touch_begin[p + n])
                    y = x + stride
                    z = y + stride
                    for c in range(3):
                        s[c] += fx * basis[x + c] + fy * basis[y + c] + fz * basis[z + c]
        target = 3 * mode_dof[block]
        for c in range(3):
            total = whole(s[c], parts)
            if part == 0 and world < dof_in.shape[0]:
                target_out[w, target + c] += total

    return SimpleNamespace(add_forces=add_forces, mode_rows=mode_rows, touch_forces=touch_forces)
