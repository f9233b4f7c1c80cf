"""Gradients of rod segments in a step: by the poses of their ends and by moduli. Theory: docs/theory/adjoint.md.

With the logarithm (u, phi) of the motion from frame 1 to frame 2, and its changes u'[p], phi'[p] along the adjoint p
and along the velocities v, a segment has in A v = b

    S = h (n.u'[p] + m.phi'[p]) + k (C u'[p].u'[v] + D phi'[p].phi'[v]) / L + k max(n_3, 0) / l (1 - t t') p.v,

a function of the span d, of phi and of p and v, all in the axes of frame 1. Warp differentiates it; what turns with
frame 1 are all these vectors.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.algebra.rotation import logarithm_series
from softwarp.model.codes import SHORTEST

PARAMETERS = 3  # rows of a segment: by Young's modulus, by Poisson's ratio, by Rayleigh's beta


@single_worlds
def functions(variant: Variant) -> SimpleNamespace:
    """The logarithm of a turn, for one scalar type."""
    real, vec3 = variant.real, single.functions(variant).vec3
    coefficients, pole = logarithm_series(real)
    terms, series = len(coefficients), wp.types.vector(len(coefficients), real)(*reversed(coefficients))

    @wp.func
    def slopes(y: real):
        """c of the logarithm and its derivative by y = |phi|^2."""
        c = real(0.0)
        dc = real(0.0)
        for k in range(wp.static(terms)):
            dc = dc * y + c
            c = c * y + series[k]
        near = real(1.0) / (real(wp.static(pole)) - y)
        return c + real(2.0) * near, dc + real(2.0) * near * near

    @wp.func
    def twisted(phi: vec3, c: real, x: vec3):
        """A x of u = A d."""
        first = wp.cross(phi, x)
        return x - real(0.5) * first + c * wp.cross(phi, first)

    return SimpleNamespace(slopes=slopes, twisted=twisted)


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds: (pack, row, lane)."""
    real = variant.real
    module = variant.module("adjoint.rod")
    one = single.functions(variant)
    vec3, vector_at, quat_at, put, logarithm = one.vec3, one.vector_at, one.quat_at, one.put, one.logarithm
    f = functions(variant)
    slopes, twisted = f.slopes, f.twisted

    @wp.func
    def change(d: vec3, phi: vec3, u: vec3, c: real, dc: real, way: vec3, first: vec3, second: vec3):
        """u' along a change of the span and turns of both ends."""
        two = real(2.0)
        turn = second - first
        along = wp.dot(phi, u)
        bent = c * (phi * wp.dot(u, turn) + u * wp.dot(phi, turn)) - two * c * along * turn
        bent += two * dc * along * wp.cross(phi, wp.cross(phi, turn)) - real(0.5) * wp.cross(u, turn)
        return twisted(phi, c, way + wp.cross(d, second)) + bent

    @wp.func
    def value(
        d: vec3,
        phi: vec3,
        way_p: vec3,
        first_p: vec3,
        second_p: vec3,
        way_v: vec3,
        first_v: vec3,
        second_v: vec3,
        C: vec3,
        D: vec3,
        k: real,
        h: real,
        inverse: real,
        stretched: vec3,
        bent: vec3,
    ):
        """S of one segment."""
        c, dc = slopes(wp.dot(phi, phi))
        u = twisted(phi, c, d)
        n = wp.cw_mul(C, u * inverse - stretched)
        m = wp.cw_mul(D, phi * inverse - bent)
        up = change(d, phi, u, c, dc, way_p, first_p, second_p)
        uv = change(d, phi, u, c, dc, way_v, first_v, second_v)
        turn_p = twisted(phi, c, second_p - first_p)
        turn_v = twisted(phi, c, second_v - first_v)
        length = wp.max(wp.length(d), real(wp.static(SHORTEST)))
        t = d / length
        taut = wp.max(n[2], real(0.0)) / length
        stiff = inverse * (wp.dot(wp.cw_mul(C, up), uv) + wp.dot(wp.cw_mul(D, turn_p), turn_v))
        stiff += taut * (wp.dot(way_p, way_v) - wp.dot(t, way_p) * wp.dot(t, way_v))
        return h * (wp.dot(n, up) + wp.dot(m, turn_p)) + k * stiff

    @wp.kernel(module=module, enable_backward=True)
    def reach(
        # Samples in
        vector_in: wp.array(dtype=vec3),
        number_in: wp.array(dtype=real),
        # Samples out
        value_out: wp.array(dtype=real),
    ):
        """Makes Warp differentiate ``value``; nobody launches it, as of ``elements.adjoint``."""
        sample = wp.tid()
        a = vector_in[sample]
        b = number_in[sample]
        value_out[sample] = value(a, a, a, a, a, a, a, a, a, a, b, b, b, a, a)

    @wp.func
    def local(array: wp.array3d(dtype=real), pack: int, lane: int, row: int, q: wp.types.quaternion(real)):
        """What a frame has, in the axes of frame 1."""
        return wp.quat_rotate_inv(q, vector_at(array, pack, lane, row))

    @wp.kernel(module=module, enable_backward=False)
    def segment_adjoint(
        # Model
        seg_frame: wp.array2d(dtype=wp.int32),
        seg_rod: wp.array(dtype=wp.int32),
        seg_body: wp.array(dtype=wp.int32),
        seg_length: wp.array(dtype=real),
        seg_section: wp.array2d(dtype=real),
        seg_scale: wp.array(dtype=real),
        seg_rest: wp.array2d(dtype=real),
        # Workspace in
        rod_youngs_in: wp.array3d(dtype=real),
        rod_nu_in: wp.array3d(dtype=real),
        body_stiffness_in: wp.array3d(dtype=real),
        pose0_in: wp.array3d(dtype=real),
        frame_v_in: wp.array3d(dtype=real),
        frame_p_in: wp.array3d(dtype=real),
        h: real,
        # Workspace out
        corner_out: wp.array3d(dtype=real),
        way_out: wp.array3d(dtype=real),
        parameter_out: wp.array3d(dtype=real),
    ):
        """Gradients by place and turn of both ends of one segment, by its parameters, and by what moves its ends.

        ``way`` has those by the ways of p and v, and by the turns of both ends in v, in world axes.
        """
        pack, seg, lane = wp.tid()
        f = seg_frame[seg, 0]
        g = seg_frame[seg, 1]
        q = quat_at(pose0_in, pack, lane, 7 * f + 3)
        phi = logarithm(wp.quat_inverse(q) * quat_at(pose0_in, pack, lane, 7 * g + 3))
        span = vector_at(pose0_in, pack, lane, 7 * g) - vector_at(pose0_in, pack, lane, 7 * f)
        d = wp.quat_rotate_inv(q, span)
        way_p = local(frame_p_in, pack, lane, 6 * g, q) - local(frame_p_in, pack, lane, 6 * f, q)
        first_p = local(frame_p_in, pack, lane, 6 * f + 3, q)
        second_p = local(frame_p_in, pack, lane, 6 * g + 3, q)
        way_v = local(frame_v_in, pack, lane, 6 * g, q) - local(frame_v_in, pack, lane, 6 * f, q)
        first_v = local(frame_v_in, pack, lane, 6 * f + 3, q)
        second_v = local(frame_v_in, pack, lane, 6 * g + 3, q)
        rod = seg_rod[seg]
        nu = rod_nu_in[pack, rod, lane]
        e = rod_youngs_in[pack, rod, lane] * seg_scale[seg]
        shear = e / (real(2.0) + real(2.0) * nu)
        C = vec3(shear * seg_section[seg, 1], shear * seg_section[seg, 1], e * seg_section[seg, 0])
        D = vec3(e * seg_section[seg, 2], e * seg_section[seg, 3], shear * seg_section[seg, 4])
        inverse = real(1.0) / seg_length[seg]
        stretched = vec3(seg_rest[seg, 0], seg_rest[seg, 1], seg_rest[seg, 2])
        bent = vec3(seg_rest[seg, 3], seg_rest[seg, 4], seg_rest[seg, 5])
        k = body_stiffness_in[pack, seg_body[seg], lane]
        gd, gphi, gwp, g1p, g2p, gwv, g1v, g2v, gC, gD, gk, gh, gi, gs, gb = wp.grad(value)(
            d, phi, way_p, first_p, second_p, way_v, first_v, second_v, C, D, k, h, inverse, stretched, bent
        )
        c, dc = slopes(wp.dot(phi, phi))
        second = twisted(-phi, c, gphi)
        first = wp.cross(d, gd) + wp.cross(way_p, gwp) + wp.cross(first_p, g1p) + wp.cross(second_p, g2p)
        first += wp.cross(way_v, gwv) + wp.cross(first_v, g1v) + wp.cross(second_v, g2v)
        place = wp.quat_rotate(q, gd)
        put(corner_out, pack, lane, 12 * seg, place)
        put(corner_out, pack, lane, 12 * seg + 3, wp.quat_rotate(q, first + second))
        put(corner_out, pack, lane, 12 * seg + 6, -place)
        put(corner_out, pack, lane, 12 * seg + 9, -wp.quat_rotate(q, second))
        put(way_out, pack, lane, 12 * seg, wp.quat_rotate(q, gwp))
        put(way_out, pack, lane, 12 * seg + 3, wp.quat_rotate(q, gwv))
        put(way_out, pack, lane, 12 * seg + 6, wp.quat_rotate(q, g1v))
        put(way_out, pack, lane, 12 * seg + 9, wp.quat_rotate(q, g2v))
        row = wp.static(PARAMETERS) * seg
        sheared = C[0] * gC[0] + C[1] * gC[1] + D[2] * gD[2]
        parameter_out[pack, row, lane] = -(wp.dot(C, gC) + wp.dot(D, gD)) / rod_youngs_in[pack, rod, lane]
        parameter_out[pack, row + 1, lane] = sheared / (real(1.0) + nu)
        parameter_out[pack, row + 2, lane] = -h * gk

    return SimpleNamespace(segment_adjoint=segment_adjoint, reach=reach)
