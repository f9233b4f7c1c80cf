"""Geometrically exact rod segments: stretch, shear, bending and twist. Theory, symbols and checks: docs/theory/rod.md.

A segment ties frames 1 and 2 with positions x and rotations R. Its strain is constant along it (helicoidal
interpolation): with h = (R1'R2, R1'(x2 - x1)) the logarithm (u, phi) = log h gives Gamma = u / L and kappa = phi / L.
Energy L/2 [(Gamma - Gamma0)' C (Gamma - Gamma0) + (kappa - kappa0)' D (kappa - kappa0)] with C = diag(GA_s, GA_s, EA)
and D = diag(EI1, EI2, GJ). References: Simo and Vu-Quoc (1986); Sonneville, Cardona, Bruls (2014).
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.rotation import rotations
from softwarp.kernels.algebra.vectors import algebra
from softwarp.model.codes import SHORTEST


@cache
def kernels(variant: Variant, project: bool = True, varying: bool = False) -> SimpleNamespace:
    """Rod kernels for one scalar type.

    Args:
        variant: Scalar type and memory order.
        project: Whether stiffness is the positive semidefinite one that suits steps, or the exact second derivative of
            the energy along rotation vectors, which suits statics and may be indefinite.
        varying: Whether sections differ from world to world and step to step, as those of telescopes do; they are then
            read from ``law``, which ``plain_law`` fills for other rods.
    """
    S = variant.S
    real = variant.real
    mul, div, sqrt = variant.mul, variant.div, variant.sqrt
    world_fastest = variant.world_fastest
    module = variant.module(("rod" if project else "rod.exact") + (".varying" if varying else ""))
    a, r = algebra(variant), rotations(variant)
    Vector, vector, Motion, read_quaternion = a.Vector, a.vector, r.Motion, r.read_quaternion
    constant, read_vector, write_vector, write_matrix = a.constant, a.read_vector, a.write_vector, a.write_matrix
    add, subtract, scaled, product = a.add, a.subtract, a.scaled, a.product
    dot, cross, combination = a.dot, a.cross, a.combination
    transposed, summed, negative, matmul, matvec = a.transposed, a.summed, a.negative, a.matmul, a.matvec
    subtracted, mirrored = a.subtracted, a.mirrored
    weighted, gram, crossed, dyad = a.weighted, a.gram, a.crossed, a.dyad
    composed, symmetric_part = a.composed, a.symmetric_part
    inverse_turn, rotation_vector, logarithm = r.inverse_turn, r.rotation_vector, r.logarithm

    @wp.func
    def relative_rotation(pose: wp.array2d(dtype=S), w: int, f: int, g: int):
        """log(Rf' Rg)."""
        return rotation_vector(read_quaternion(pose, w, 7 * f + 3), read_quaternion(pose, w, 7 * g + 3))

    @wp.func
    def turned_span(pose: wp.array2d(dtype=S), w: int, f: int, g: int):
        """Rf' (xg - xf)."""
        span = subtract(read_vector(pose, w, 7 * g), read_vector(pose, w, 7 * f))
        return matvec(inverse_turn(read_quaternion(pose, w, 7 * f + 3)), span)

    @wp.func
    def tension(axial: S, span: Vector):
        """max(N, 0) / l (1 - t t') with the direction t and length l of the span."""
        inverse = div(S(real(1.0)), wp.max(sqrt(dot(span, span)), S(real(wp.static(SHORTEST)))))
        k = mul(wp.max(axial, S(real(0.0))), inverse)
        t = scaled(span, inverse)
        none = S(real(0.0))
        return dyad(t, scaled(t, k * real(-0.5)), k, vector(none, none, none))

    @wp.func
    def stiffness(seg_section: wp.array2d(dtype=real), seg: int, scale: real, youngs: S, nu: S):
        """Diagonals C [N] and D [N m^2]."""
        e = youngs * scale
        shear = div(e, nu * real(2.0) + S(real(2.0)))
        c = vector(shear * seg_section[seg, 1], shear * seg_section[seg, 1], e * seg_section[seg, 0])
        d = vector(e * seg_section[seg, 2], e * seg_section[seg, 3], shear * seg_section[seg, 4])
        return c, d

    @wp.kernel(module=module, enable_backward=False)
    def plain_law(
        # Model
        plain_segment: wp.array(dtype=wp.int32),
        seg_rod: wp.array(dtype=wp.int32),
        seg_length: wp.array(dtype=real),
        seg_section: wp.array2d(dtype=real),
        seg_scale: wp.array(dtype=real),
        seg_rest: wp.array2d(dtype=real),
        # Workspace in
        rod_youngs_in: wp.array2d(dtype=S),
        rod_nu_in: wp.array2d(dtype=S),
        # Workspace out
        law_out: wp.array2d(dtype=S),
    ):
        """Length, stiffnesses and rest strain of one segment that is the same in all worlds but for its moduli."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        seg = plain_segment[item]
        c, d = stiffness(seg_section, seg, seg_scale[seg], rod_youngs_in[w, seg_rod[seg]], rod_nu_in[w, seg_rod[seg]])
        law_out[w, 13 * seg] = S(seg_length[seg])
        write_vector(law_out, w, 13 * seg + 1, c)
        write_vector(law_out, w, 13 * seg + 4, d)
        write_vector(law_out, w, 13 * seg + 7, constant(seg_rest, seg, 0))
        write_vector(law_out, w, 13 * seg + 10, constant(seg_rest, seg, 3))

    @wp.func
    def force_slope(n: Vector, g: Motion):
        """d(A' n) / dphi."""
        p = cross(g.phi, n)
        column = subtract(scaled(cross(g.phi, p), g.dc * real(2.0)), scaled(n, g.c))
        spin = add(scaled(n, S(real(0.5))), scaled(p, g.c))
        return composed(column, g.phi, mul(g.c, dot(g.phi, n)), spin)

    @wp.func
    def moment_slope(n: Vector, g: Motion):
        """d(D' n) / dphi, where D' n is the derivative of A' n in the direction u."""
        two = real(2.0)
        dc = g.dc * two
        p = cross(g.phi, n)
        q = cross(g.phi, p)
        un = cross(g.u, n)
        along = dot(g.u, g.phi)
        bend = mul(dc, along)
        first = scaled(add(cross(g.u, p), cross(g.phi, un)), dc)
        first = add(subtract(first, scaled(n, bend)), scaled(q, mul(g.ddc, along) * real(4.0)))
        second = subtract(scaled(q, dc), scaled(n, g.c))
        trace = mul(g.c, dot(g.u, n)) + mul(bend, dot(g.phi, n))
        spin = add(scaled(un, g.c), scaled(p, bend))
        none = S(real(0.0))
        return summed(composed(first, g.phi, trace, spin), composed(second, g.u, none, vector(none, none, none)))

    @wp.kernel(module=module, enable_backward=False)
    def element(
        # Model
        first: int,
        seg_frame: wp.array2d(dtype=wp.int32),
        seg_rod: wp.array(dtype=wp.int32),
        seg_length: wp.array(dtype=real),
        seg_section: wp.array2d(dtype=real),
        seg_scale: wp.array(dtype=real),
        seg_rest: wp.array2d(dtype=real),
        # Workspace in
        rod_youngs_in: wp.array2d(dtype=S),
        rod_nu_in: wp.array2d(dtype=S),
        law_in: wp.array2d(dtype=S),
        pose_in: wp.array2d(dtype=S),
        # Workspace out
        element_force_out: wp.array2d(dtype=S),
        element_stiffness_out: wp.array2d(dtype=S),
    ):
        """dE/dq [N, N m] and B' C B with the stiffening by tension of one segment, corners (t1, r1, t2, r2)."""
        w, seg = wp.tid()
        if wp.static(world_fastest):
            seg, w = wp.tid()
        f = seg_frame[seg, 0]
        g = seg_frame[seg, 1]
        span = subtract(read_vector(pose_in, w, 7 * g), read_vector(pose_in, w, 7 * f))
        back = inverse_turn(read_quaternion(pose_in, w, 7 * f + 3))  # R1'
        motion = logarithm(matvec(back, span), relative_rotation(pose_in, w, f, g))
        u = motion.u
        phi = motion.phi

        # d(u, phi) = (M d(x2 - x1) + (N + M [span]x) dr2 - N dr1, M (dr2 - dr1))
        half_c = motion.c * real(0.5)
        along = dot(u, phi)
        bend = mul(motion.dc, along)
        trace = (mul(motion.c, along) + mul(bend, motion.angle2)) * real(-2.0)
        M = matmul(dyad(phi, scaled(phi, half_c), S(real(1.0)) - mul(motion.c, motion.angle2), phi), back)
        N = matmul(dyad(phi, add(scaled(u, motion.c), scaled(phi, bend)), trace, u), back)

        inverse = S(real(1.0) / seg_length[seg])
        c, d = stiffness(seg_section, seg, seg_scale[seg], rod_youngs_in[w, seg_rod[seg]], rod_nu_in[w, seg_rod[seg]])
        stretched = constant(seg_rest, seg, 0)
        bent = constant(seg_rest, seg, 3)
        if wp.static(varying):
            inverse = div(S(real(1.0)), law_in[w, 13 * seg])
            c = read_vector(law_in, w, 13 * seg + 1)
            d = read_vector(law_in, w, 13 * seg + 4)
            stretched = read_vector(law_in, w, 13 * seg + 7)
            bent = read_vector(law_in, w, 13 * seg + 10)
        n = product(c, subtract(scaled(u, inverse), stretched))
        m = product(d, subtract(scaled(phi, inverse), bent))
        force = combination(n, M)
        moment = add(combination(n, N), combination(m, M))
        row = 12 * (first + seg)
        write_vector(element_force_out, w, row, scaled(force, S(real(-1.0))))
        write_vector(element_force_out, w, row + 3, scaled(moment, S(real(-1.0))))
        write_vector(element_force_out, w, row + 6, force)
        write_vector(element_force_out, w, row + 9, subtract(moment, cross(span, force)))

        # with C and D divided by the length, V = N + M [span]x: K = M'CM, X = M'CN, Y = M'CV, W = N'CN, Z = V'CN
        c = scaled(c, inverse)
        CM = weighted(c, M)
        K = gram(M, CM)
        X = matmul(transposed(CM), N)
        Y = subtracted(X, transposed(crossed(span, K)))
        W = gram(N, weighted(c, N))
        Z = subtracted(W, crossed(span, X))
        last = mirrored(subtracted(transposed(Z), crossed(span, Y)))
        T = K
        turning = gram(M, weighted(scaled(d, inverse), M))
        if wp.static(project):
            T = summed(K, tension(n.z, span))
            W = summed(W, turning)
            Z = summed(Z, turning)
            last = summed(last, turning)
        else:
            # the change of force and moment at constant n and m: P and U with (x2 - x1) and r2 - r1, see the theory
            slope = force_slope(n, motion)
            forward = transposed(back)
            P = matmul(forward, matmul(slope, M))
            U = matmul(summed(force_slope(m, motion), moment_slope(n, motion)), M)
            U = summed(turning, matmul(forward, summed(U, matmul(slope, N))))
            Pt = transposed(P)
            crossing = transposed(crossed(span, Pt))  # -P [span]x
            X = summed(X, Pt)
            Y = summed(Y, P)
            W = summed(W, symmetric_part(U))
            Z = summed(Z, transposed(subtracted(U, crossing)))
            last = summed(last, symmetric_part(subtracted(subtracted(U, crossing), crossed(span, P))))

        row = 90 * (first + seg)
        write_matrix(element_stiffness_out, w, row, T)
        write_matrix(element_stiffness_out, w, row + 9, transposed(X))
        write_matrix(element_stiffness_out, w, row + 18, W)
        write_matrix(element_stiffness_out, w, row + 27, negative(T))
        write_matrix(element_stiffness_out, w, row + 36, negative(X))
        write_matrix(element_stiffness_out, w, row + 45, T)
        write_matrix(element_stiffness_out, w, row + 54, negative(transposed(Y)))
        write_matrix(element_stiffness_out, w, row + 63, negative(Z))
        write_matrix(element_stiffness_out, w, row + 72, transposed(Y))
        write_matrix(element_stiffness_out, w, row + 81, last)

    @wp.kernel(module=module, enable_backward=False)
    def strain(
        # Model
        seg_frame: wp.array2d(dtype=wp.int32),
        seg_length: wp.array(dtype=real),
        # Workspace in
        law_in: wp.array2d(dtype=S),
        pose_in: wp.array2d(dtype=S),
        # Workspace out
        seg_strain_out: wp.array2d(dtype=S),
    ):
        """Strain of one segment in its own axes: Gamma (3, at rest about (0, 0, 1)) and kappa (3) [1/m]."""
        w, seg = wp.tid()
        if wp.static(world_fastest):
            seg, w = wp.tid()
        f = seg_frame[seg, 0]
        g = seg_frame[seg, 1]
        motion = logarithm(turned_span(pose_in, w, f, g), relative_rotation(pose_in, w, f, g))
        inverse = S(real(1.0) / seg_length[seg])
        if wp.static(varying):
            inverse = div(S(real(1.0)), law_in[w, 13 * seg])
        write_vector(seg_strain_out, w, 6 * seg, scaled(motion.u, inverse))
        write_vector(seg_strain_out, w, 6 * seg + 3, scaled(motion.phi, inverse))

    @wp.kernel(module=module, enable_backward=False)
    def resultant(
        # Model
        seg_rod: wp.array(dtype=wp.int32),
        seg_length: wp.array(dtype=real),
        seg_section: wp.array2d(dtype=real),
        seg_scale: wp.array(dtype=real),
        seg_rest: wp.array2d(dtype=real),
        # Workspace in
        rod_youngs_in: wp.array2d(dtype=S),
        rod_nu_in: wp.array2d(dtype=S),
        law_in: wp.array2d(dtype=S),
        seg_strain_in: wp.array2d(dtype=S),
        # Workspace out
        seg_resultant_out: wp.array2d(dtype=S),
        seg_energy_out: wp.array2d(dtype=S),
    ):
        """Inner force (3) [N] and moment (3) [N m] in the segment's axes, and elastic energy [J], from its strain."""
        w, seg = wp.tid()
        if wp.static(world_fastest):
            seg, w = wp.tid()
        c, d = stiffness(seg_section, seg, seg_scale[seg], rod_youngs_in[w, seg_rod[seg]], rod_nu_in[w, seg_rod[seg]])
        stretched = constant(seg_rest, seg, 0)
        bent = constant(seg_rest, seg, 3)
        length = S(seg_length[seg])
        if wp.static(varying):
            length = law_in[w, 13 * seg]
            c = read_vector(law_in, w, 13 * seg + 1)
            d = read_vector(law_in, w, 13 * seg + 4)
            stretched = read_vector(law_in, w, 13 * seg + 7)
            bent = read_vector(law_in, w, 13 * seg + 10)
        gamma = subtract(read_vector(seg_strain_in, w, 6 * seg), stretched)
        kappa = subtract(read_vector(seg_strain_in, w, 6 * seg + 3), bent)
        n = product(c, gamma)
        m = product(d, kappa)
        write_vector(seg_resultant_out, w, 6 * seg, n)
        write_vector(seg_resultant_out, w, 6 * seg + 3, m)
        seg_energy_out[w, seg] = mul(dot(n, gamma) + dot(m, kappa), length) * real(0.5)

    return SimpleNamespace(element=element, strain=strain, resultant=resultant, plain_law=plain_law)
