"""Damping of turning, as the full model has it: stiffness-proportional, on velocities of turning too.

Stiffness times the velocities of a rigid rotation is no force of an element at rest, but of one under stress it is:
K (w x x) = w x f. Damping by beta K therefore resists a body under pressure that turns, and the full model's does so
much. Reduced bodies with a floating frame have the same: with E = (e_m x y) / radius of an element's corners against
the first one, in the body's axes, K E adds up on modes and on turning itself. Theory: docs/theory/reduction.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.elements import mode_sums

ROWS = 36  # of an element: three axes by nine displacements, then turning by turning


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels of one scalar type."""
    sums = _by_modes(variant) if variant.world_fastest else _by_bodies(variant)
    return SimpleNamespace(**vars(sums), **vars(_by_worlds(variant)))


@single_worlds
def _by_worlds(variant: Variant) -> SimpleNamespace:
    """Kernels on single worlds."""
    real = variant.real
    module = variant.module("floating_drag")
    one = single.functions(variant)
    vec3, vector_at, put = one.vec3, one.vector_at, one.put

    @wp.func
    def block_at(array: wp.array3d(dtype=real), pack: int, lane: int, row: int, size: int):
        """3 x 3 block of a matrix with rows of ``size`` entries."""
        a = vector_at(array, pack, lane, row)
        b = vector_at(array, pack, lane, row + size)
        c = vector_at(array, pack, lane, row + 2 * size)
        return wp.matrix_from_rows(a, b, c)

    @wp.kernel(module=module, enable_backward=False)
    def drag_rows(
        size: int,
        begin: int,
        # Model
        sample: wp.array(dtype=wp.int32),
        sample_body: wp.array(dtype=wp.int32),
        corner: wp.array2d(dtype=wp.int32),
        radius: wp.array(dtype=real),
        # Workspace in
        axes_in: wp.array3d(dtype=real),
        x_in: wp.array3d(dtype=real),
        stiffness_in: wp.array3d(dtype=real),
        # Workspace out
        drag_row_out: wp.array3d(dtype=real),
    ):
        """K E and E' K E of one sample, whose stiffness is in the body's axes; ``begin`` samples stand before it."""
        pack, item, lane = wp.tid()
        f = sample_body[item]
        if f >= 0:
            R = block_at(axes_in, pack, lane, 9 * f, 3)
            e = sample[item]
            row = wp.static(ROWS) * (begin + item)
            origin = vector_at(x_in, pack, lane, 3 * corner[e, 0])
            for m in range(3):
                axis = vec3()
                axis[m] = real(1.0) / radius[f]
                turned = vec3()
                for i in range(size // 3):
                    force = vec3()
                    for j in range(size // 3):
                        d = wp.transpose(R) * (vector_at(x_in, pack, lane, 3 * corner[e, j + 1]) - origin)
                        at = size * size * item + 3 * (size * i + j)
                        force += block_at(stiffness_in, pack, lane, at, size) * wp.cross(axis, d)
                    put(drag_row_out, pack, lane, row + 9 * m + 3 * i, force)
                    d = wp.transpose(R) * (vector_at(x_in, pack, lane, 3 * corner[e, i + 1]) - origin)
                    turned += wp.cross(d, force) / radius[f]
                put(drag_row_out, pack, lane, row + 27 + 3 * m, turned)

    return SimpleNamespace(drag_rows=drag_rows)


@cache
def _by_bodies(host: Variant) -> SimpleNamespace:
    """Sums over samples on a CPU: one thread for a body."""
    S, real = host.S, host.real
    module = host.module("floating_drag_sums")
    push_modes = mode_sums.functions(host).push_modes

    @wp.kernel(module=module, enable_backward=False)
    def drag_sums(
        wide_count: int,
        # Model
        number: wp.array(dtype=wp.int32),
        first_wide: wp.array(dtype=wp.int32),
        moment_body: wp.array(dtype=wp.int32),
        moment_start: wp.array(dtype=wp.int32),
        body_stride: wp.array(dtype=wp.int32),
        body_tets: wp.array(dtype=wp.int32),
        body_tris: wp.array(dtype=wp.int32),
        tet_first: wp.array(dtype=wp.int32),
        tri_first: wp.array(dtype=wp.int32),
        tet_basis: wp.array(dtype=real),
        tri_basis: wp.array(dtype=real),
        # Workspace in
        drag_row_in: wp.array2d(dtype=S),
        # Workspace out
        wide_drag_out: wp.array2d(dtype=S),
        turning_drag_out: wp.array2d(dtype=S),
    ):
        """What turning one body does on its modes, and on turning."""
        w, f = wp.tid()
        n = number[f]
        stride = body_stride[n]
        for m in range(3):
            for k in range(stride):
                wide_drag_out[w, m * wide_count + first_wide[f] + k] = S(real(0.0))
        for c in range(9):
            turning_drag_out[w, 9 * f + c] = S(real(0.0))
        tets = tet_first.shape[0]
        for s in range(body_tets[n], body_tets[n + 1]):
            row = wp.static(ROWS) * s
            for m in range(3):
                target = m * wide_count + first_wide[f]
                for i in range(3):
                    at = tet_first[s] + 3 * i * stride
                    push_modes(tet_basis, at, stride, drag_row_in, w, row + 9 * m + 3 * i, wide_drag_out, target)
            for c in range(9):
                turning_drag_out[w, 9 * f + c] += drag_row_in[w, row + 27 + c]
        for s in range(body_tris[n], body_tris[n + 1]):
            row = wp.static(ROWS) * (tets + s)
            for m in range(3):
                target = m * wide_count + first_wide[f]
                for i in range(2):
                    at = tri_first[s] + 3 * i * stride
                    push_modes(tri_basis, at, stride, drag_row_in, w, row + 9 * m + 3 * i, wide_drag_out, target)
            for c in range(9):
                turning_drag_out[w, 9 * f + c] += drag_row_in[w, row + 27 + c]

    return SimpleNamespace(drag_sums=drag_sums)


@cache
def _by_modes(variant: Variant) -> SimpleNamespace:
    """The same on a GPU: one thread for a mode, the first one of a body for turning as well."""
    S = variant.S
    module = variant.module("floating_drag_sums")

    @wp.kernel(module=module, enable_backward=False)
    def drag_sums(
        wide_count: int,
        # Model
        number: wp.array(dtype=wp.int32),
        first_wide: wp.array(dtype=wp.int32),
        moment_body: wp.array(dtype=wp.int32),
        moment_start: wp.array(dtype=wp.int32),
        body_stride: wp.array(dtype=wp.int32),
        body_tets: wp.array(dtype=wp.int32),
        body_tris: wp.array(dtype=wp.int32),
        tet_first: wp.array(dtype=wp.int32),
        tri_first: wp.array(dtype=wp.int32),
        tet_basis: wp.array(dtype=S),
        tri_basis: wp.array(dtype=S),
        # Workspace in
        drag_row_in: wp.array2d(dtype=S),
        # Workspace out
        wide_drag_out: wp.array2d(dtype=S),
        turning_drag_out: wp.array2d(dtype=S),
    ):
        """What turning a body does on one of its modes, and on turning."""
        item, w = wp.tid()
        f = moment_body[item]
        n = number[f]
        k = item - moment_start[f]
        stride = body_stride[n]
        tets = tet_first.shape[0]
        for m in range(3):
            s = S(0.0)
            for e in range(body_tets[n], body_tets[n + 1]):
                for c in range(9):
                    s += drag_row_in[w, wp.static(ROWS) * e + 9 * m + c] * tet_basis[tet_first[e] + c * stride + k]
            for e in range(body_tris[n], body_tris[n + 1]):
                row = wp.static(ROWS) * (tets + e) + 9 * m
                for c in range(6):
                    s += drag_row_in[w, row + c] * tri_basis[tri_first[e] + c * stride + k]
            wide_drag_out[w, m * wide_count + first_wide[f] + k] = s
        if k < 9:
            s = S(0.0)
            for e in range(body_tets[n], body_tets[n + 1]):
                s += drag_row_in[w, wp.static(ROWS) * e + 27 + k]
            for e in range(body_tris[n], body_tris[n + 1]):
                s += drag_row_in[w, wp.static(ROWS) * (tets + e) + 27 + k]
            turning_drag_out[w, 9 * f + k] = s

    return SimpleNamespace(drag_sums=drag_sums)
