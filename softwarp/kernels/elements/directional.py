"""Directional derivatives of linear tetrahedra in a step: forces along a change of positions and of parameters.

With the direction D = sum dx_b g_b' of F, a tet of a step A v = b adds to the right-hand side of the step's tangent

    -V (h C(F)[D] + k D^3 psi(F)[D, Y] + dk C(F)[Y] + d/dp (h P + k C[Y]) dp) g_b,   Y = sum v_b g_b'.

Third derivatives of an energy are symmetric, so that the first two are what ``adjoint`` has of h P : D + k C[Y] : D by
F. With a clamped tangent, whose eigenvalues are c_i and whose modes are Q_i, the second one is

    k P+ D^3 psi[D, Y+] + k sum_j- sum_i+ f_ij (Q_i : D^3 psi[D, Q_j]) ((Q_j : Y) Q_i + (Q_i : Y) Q_j),

where P+ and Y+ are of the positive modes. What parameters change is found component by component, from the gradients
that ``adjoint`` has by them; a direction without them costs nothing. Theory: docs/theory/adjoint.md.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.elements.adjoint import contraction, functions, projection
from softwarp.kernels.elements.laws import LAWS, law_parameters


@single_worlds
def kernels(variant: Variant, law: str, project: bool) -> SimpleNamespace:
    """Directional derivatives of tets of one law of ``laws.LAWS``; arguments as of ``adjoint.kernels``."""
    f = functions(variant)
    real, mat33, awake = variant.real, f.mat33, LAWS[law].awake
    module = variant.module(f"directional.{law}.{'spd' if project else 'exact'}")
    decomposed, gradient_at, gradient_of, put_corners = f.decomposed, f.gradient_at, f.gradient_of, f.put_corners
    pull, parameters = contraction(variant, law, module).pull, law_parameters(real, law)
    spectrum = projection(variant, law)
    nine, mode, modes, along = spectrum.nine, spectrum.mode, spectrum.modes, spectrum.along
    projected_stiffness, add_to = spectrum.projected_stiffness, single.functions(variant).add_to

    @wp.func
    def upper(values: nine, axes: mat33, U: mat33, V: mat33, Y: mat33, factors: nine):
        """sum over positive modes of their factor times their part of Y."""
        total = mat33()
        count = int(wp.static(9))  # a loop that stays one
        for i in range(count):
            if values[i] >= real(0.0):
                m = U * mode(i, axes) * wp.transpose(V)
                total += factors[i] * wp.ddot(m, Y) * m
        return total

    @wp.func
    def bent(n: int, low: mat33, part: mat33, values: nine, axes: mat33, U: mat33, V: mat33, Y: mat33):
        """What ``part``, k D^3 psi along D and a negative mode ``low`` of number n, makes of Y; n = 9: along Y+."""
        factors = nine()
        count = int(wp.static(9))
        for i in range(count):
            factors[i] = real(1.0)
            if n < count:
                factors[i] = values[i] / (values[i] - values[n])
        total = upper(values, axes, U, V, part, factors)
        if n < count:
            total = wp.ddot(low, Y) * total + wp.ddot(part, upper(values, axes, U, V, Y, factors)) * low
        return total

    @wp.func
    def other(n: int, values: nine, axes: mat33, U: mat33, V: mat33, Y: mat33):
        """Mode of number n; n = 9: Y+."""
        count = int(wp.static(9))
        ones = nine()
        for i in range(count):
            ones[i] = real(1.0)
        if n < count:
            return U * mode(n, axes) * wp.transpose(V)
        return upper(values, axes, U, V, Y, ones)

    @wp.func
    def put_force(
        gradient: wp.array2d(dtype=real), out: wp.array3d(dtype=real), pack: int, lane: int, tet: int, force: mat33
    ):
        """Forces of corners."""
        b = force * gradient_at(gradient, tet, 0)
        c = force * gradient_at(gradient, tet, 1)
        put_corners(out, pack, lane, tet, b, c, force * gradient_at(gradient, tet, 2))

    @wp.kernel(module=module, enable_backward=False)
    def tet_direction(
        # Model
        tet_index: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet_volume: wp.array(dtype=real),
        body_law_start: wp.array(dtype=wp.int32),
        # Workspace in
        body_mu_in: wp.array3d(dtype=real),
        body_lam_in: wp.array3d(dtype=real),
        law_parameter_in: wp.array3d(dtype=real),
        body_stiffness_in: wp.array3d(dtype=real),
        node_x_in: wp.array3d(dtype=real),
        node_v_in: wp.array3d(dtype=real),
        x_slope_in: wp.array3d(dtype=real),
        h: real,
        # Workspace out
        corner_out: wp.array3d(dtype=real),
    ):
        """What one tet adds to the right-hand side at its corners."""
        pack, item, lane = wp.tid()
        tet = tet_index[item]
        body = tet_body[tet]
        p = parameters(body_law_start, body_mu_in, body_lam_in, law_parameter_in, pack, body, lane)
        F = gradient_of(node_x_in, pack, lane, tet_node, tet_gradient, tet)
        D = gradient_of(x_slope_in, pack, lane, tet_node, tet_gradient, tet)
        Y = gradient_of(node_v_in, pack, lane, tet_node, tet_gradient, tet)
        k = body_stiffness_in[pack, body, lane]
        values = nine()
        axes = mat33()
        U = mat33()
        V = mat33()
        if wp.static(project):
            U, s, V = decomposed(F)
            values, axes = modes(s, p)
        is_clamped = wp.min(values) < real(0.0)
        force, _p, _s = pull(F, p, D, Y, h, wp.where(is_clamped, real(0.0), k))
        if wp.static(project):
            if is_clamped:
                stages = int(wp.static(10))
                for n in range(stages):
                    if n == 9 or values[n] < real(0.0):
                        low = other(n, values, axes, U, V, Y)
                        part, _p, _s = pull(F, p, D, low, real(0.0), k)
                        force += bent(n, low, part, values, axes, U, V, Y)
        put_force(tet_gradient, corner_out, pack, lane, tet, -tet_volume[tet] * force)

    @wp.kernel(module=module, enable_backward=False)
    def tet_constants(
        # Model
        tet_index: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet_volume: wp.array(dtype=real),
        body_law_start: wp.array(dtype=wp.int32),
        # Workspace in
        body_mu_in: wp.array3d(dtype=real),
        body_lam_in: wp.array3d(dtype=real),
        law_parameter_in: wp.array3d(dtype=real),
        body_stiffness_in: wp.array3d(dtype=real),
        mu_slope_in: wp.array3d(dtype=real),
        lam_slope_in: wp.array3d(dtype=real),
        law_slope_in: wp.array3d(dtype=real),
        stiffness_slope_in: wp.array3d(dtype=real),
        node_x_in: wp.array3d(dtype=real),
        node_v_in: wp.array3d(dtype=real),
        h: real,
        # Workspace out
        corner_out: wp.array3d(dtype=real),
    ):
        """Add what the parameters of one tet's law change, and its factor of the stiffness."""
        pack, item, lane = wp.tid()
        tet = tet_index[item]
        body = tet_body[tet]
        change = parameters(body_law_start, mu_slope_in, lam_slope_in, law_slope_in, pack, body, lane)
        more = stiffness_slope_in[pack, body, lane]
        changes = wp.dot(change, change) > real(0.0)
        if changes or more != real(0.0):
            p = parameters(body_law_start, body_mu_in, body_lam_in, law_parameter_in, pack, body, lane)
            if wp.static(awake is not None):
                p = awake(p)
            F = gradient_of(node_x_in, pack, lane, tet_node, tet_gradient, tet)
            Y = gradient_of(node_v_in, pack, lane, tet_node, tet_gradient, tet)
            k = body_stiffness_in[pack, body, lane]
            values = nine()
            axes = mat33()
            U = mat33()
            V = mat33()
            if wp.static(project):
                U, s, V = decomposed(F)
                values, axes = modes(s, p)
            is_clamped = wp.min(values) < real(0.0)
            force = mat33()
            entries = int(wp.static(9))
            for entry in range(entries):
                E = mat33()
                E[entry / 3, entry % 3] = real(1.0)
                _F, by_p, stiffness = pull(F, p, E, Y, h, wp.where(is_clamped, real(0.0), k))
                if wp.static(project):
                    if is_clamped:
                        for n in range(entries + 1):
                            if n == 9 or values[n] < real(0.0):
                                A, B = along(n, values, axes, U, V, E, Y)
                                _G, more_p, _s = pull(F, p, A, B, real(0.0), k)
                                by_p += more_p
                        stiffness = projected_stiffness(values, axes, U, V, E, Y)
                force[entry / 3, entry % 3] = wp.dot(by_p, change) + more * stiffness
            force = -tet_volume[tet] * force
            b = force * gradient_at(tet_gradient, tet, 0)
            c = force * gradient_at(tet_gradient, tet, 1)
            d = force * gradient_at(tet_gradient, tet, 2)
            add_to(corner_out, pack, lane, 12 * tet, -(b + c + d))
            add_to(corner_out, pack, lane, 12 * tet + 3, b)
            add_to(corner_out, pack, lane, 12 * tet + 6, c)
            add_to(corner_out, pack, lane, 12 * tet + 9, d)

    return SimpleNamespace(tet_direction=tet_direction, tet_constants=tet_constants)
