"""Isotropic hyperelastic tetrahedra. Theory, symbols and checks: docs/theory/hyperelastic.md; laws: ``materials``.

With F = U diag(s) V', dP = U (C : U' dF V) V', where C has a 3x3 stretch block psi_ij and, for every pair of axes, the
eigenvalues (psi_i - psi_j)/(s_i - s_j) and (psi_i + psi_j)/(s_i + s_j). Clamping these at zero gives the nearest
positive semidefinite tangent. Reference: Smith, de Goes, Kim (2019), Analytic Eigensystems for Isotropic Distortion
Energies.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.elements.materials import LAWS


@wp.func
def clamp_symmetric(H: Any):
    """Nearest positive semidefinite matrix to a symmetric 3x3 one."""
    Q, d = wp.eig3(H)
    zero = d[0] - d[0]
    D = wp.diag(wp.max(d, d * zero))
    return Q * D * wp.transpose(Q)


@wp.func
def tangent_block(H: Any, minus: Any, plus: Any, ga: Any, gb: Any):
    """ga_j C_ijkl gb_l in the principal frame; ga and gb are V' grad N."""
    half = ga[0] - ga[0] + type(ga[0])(0.5)
    K = H
    for i in range(3):
        for k in range(3):
            if i == k:
                value = H[i, i] * ga[i] * gb[i]
                for step in range(1, 3):
                    j = (i + step) % 3
                    m = 3 - i - j
                    value += half * (minus[m] + plus[m]) * ga[j] * gb[j]
                K[i, i] = value
            else:
                m = 3 - i - k
                K[i, k] = H[i, k] * ga[i] * gb[k] + half * (minus[m] - plus[m]) * ga[k] * gb[i]
    return K


def law_parameters(real: Any, law: str) -> Any:
    """Warp function that gathers the vector ``p`` of a body's law from arrays of shape (pack, row, lane).

    A law in Lame constants finds them at the body's row, one with parameters of its own from row ``start`` onwards.
    """
    count = LAWS[law].count
    vector = wp.types.vector(count, real)

    @wp.func
    def lame(
        start: wp.array(dtype=wp.int32),
        mu: wp.array3d(dtype=real),
        lam: wp.array3d(dtype=real),
        own: wp.array3d(dtype=real),
        pack: int,
        body: int,
        lane: int,
    ):
        return vector(mu[pack, body, lane], lam[pack, body, lane])

    @wp.func
    def declared(
        start: wp.array(dtype=wp.int32),
        mu: wp.array3d(dtype=real),
        lam: wp.array3d(dtype=real),
        own: wp.array3d(dtype=real),
        pack: int,
        body: int,
        lane: int,
    ):
        p = vector()
        for i in range(count):
            p[i] = own[pack, start[body] + i, lane]
        return p

    return declared if LAWS[law].own else lame


@cache
def kernels(variant: Variant, law: str, project: bool) -> SimpleNamespace:
    """Kernels of one hyperelastic law for one scalar type.

    Args:
        variant: Scalar type and memory order.
        law: One of ``materials.LAWS``.
        project: Whether element tangents are clamped to positive semidefinite ones.
    """
    real = variant.real
    module = variant.module(f"hyperelastic.{law}.{'spd' if project else 'exact'}")
    vec3 = wp.types.vector(3, real)
    mat33 = wp.types.matrix((3, 3), real)
    stress_of, principal_of = LAWS[law].stress, LAWS[law].principal
    parameters = law_parameters(real, law)

    @wp.func
    def corner(x: wp.array3d(dtype=real), pack: int, lane: int, node: int):
        return vec3(x[pack, 3 * node, lane], x[pack, 3 * node + 1, lane], x[pack, 3 * node + 2, lane])

    @wp.func
    def deformation(
        x: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        tet: int,
        tet_node: wp.array2d(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
    ):
        """F = sum (x_b - x_a) g_b'."""
        xa = corner(x, pack, lane, tet_node[tet, 0])
        F = mat33()
        for b in range(3):
            g = vec3(tet_gradient[tet, 3 * b], tet_gradient[tet, 3 * b + 1], tet_gradient[tet, 3 * b + 2])
            F += wp.outer(corner(x, pack, lane, tet_node[tet, b + 1]) - xa, g)
        return F

    @wp.kernel(module=module, enable_backward=False)
    def tet_force(
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
        node_x_in: wp.array3d(dtype=real),
        # Workspace out
        tet_force_out: wp.array3d(dtype=real),
    ):
        """Elastic corner forces dE/dx [N] of one tet."""
        pack, item, lane = wp.tid()
        tet = tet_index[item]
        body = tet_body[tet]
        F = deformation(node_x_in, pack, lane, tet, tet_node, tet_gradient)
        p = parameters(body_law_start, body_mu_in, body_lam_in, law_parameter_in, pack, body, lane)
        P = tet_volume[tet] * stress_of(F, p)
        total = vec3()
        row = tet * 12
        for b in range(3):
            f = P * vec3(tet_gradient[tet, 3 * b], tet_gradient[tet, 3 * b + 1], tet_gradient[tet, 3 * b + 2])
            total -= f
            for c in range(3):
                tet_force_out[pack, row + 3 * b + 3 + c, lane] = f[c]
        for c in range(3):
            tet_force_out[pack, row + c, lane] = total[c]

    @wp.kernel(module=module, enable_backward=False)
    def tet_stiffness(
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
        node_x_in: wp.array3d(dtype=real),
        # Workspace out
        tet_stiffness_out: wp.array3d(dtype=real),
    ):
        """The ten blocks K_ab, a >= b, of one tet [N/m]."""
        pack, item, lane = wp.tid()
        tet = tet_index[item]
        body = tet_body[tet]
        F = deformation(node_x_in, pack, lane, tet, tet_node, tet_gradient)
        U, s, V = wp.svd3(F)
        p = parameters(body_law_start, body_mu_in, body_lam_in, law_parameter_in, pack, body, lane)
        H, minus, plus = principal_of(s, p)
        if wp.static(project):
            H = clamp_symmetric(H)
            minus = wp.max(minus, vec3())
            plus = wp.max(plus, vec3())
        g1 = vec3(tet_gradient[tet, 0], tet_gradient[tet, 1], tet_gradient[tet, 2])
        g2 = vec3(tet_gradient[tet, 3], tet_gradient[tet, 4], tet_gradient[tet, 5])
        g3 = vec3(tet_gradient[tet, 6], tet_gradient[tet, 7], tet_gradient[tet, 8])
        G = wp.matrix_from_rows(-(g1 + g2 + g3) * V, g1 * V, g2 * V, g3 * V)
        Ut = wp.transpose(U)
        for a in range(4):
            for b in range(a + 1):
                K = tet_volume[tet] * (U * tangent_block(H, minus, plus, G[a], G[b]) * Ut)
                row = tet * 90 + ((a * (a + 1)) // 2 + b) * 9
                for r in range(3):
                    for c in range(3):
                        tet_stiffness_out[pack, row + 3 * r + c, lane] = K[r, c]

    return SimpleNamespace(tet_force=tet_force, tet_stiffness=tet_stiffness)


@cache
def evaluation_kernels(law: str) -> SimpleNamespace:
    """Energy, stress and tangent of given deformation gradients, in float64, for tests and plots."""
    module = wp.get_module(f"softwarp.kernels.elements.hyperelastic.evaluate.{law}")
    energy_of, stress_of, principal_of = LAWS[law].energy, LAWS[law].stress, LAWS[law].principal
    vector = wp.types.vector(LAWS[law].count, wp.float64)

    @wp.kernel(module=module, enable_backward=False)
    def evaluate(
        # Samples in
        F_in: wp.array(dtype=wp.mat33d),
        p: vector,
        project: bool,
        # Samples out
        energy_out: wp.array(dtype=wp.float64),
        stress_out: wp.array(dtype=wp.mat33d),
        tangent_out: wp.array3d(dtype=wp.float64),
    ):
        """Energy density, stress and tangent [Pa] of one deformation gradient."""
        sample = wp.tid()
        F = F_in[sample]
        energy_out[sample] = energy_of(F, p)
        stress_out[sample] = stress_of(F, p)
        U, s, V = wp.svd3(F)
        H, minus, plus = principal_of(s, p)
        if project:
            H = clamp_symmetric(H)
            minus = wp.max(minus, wp.vec3d())
            plus = wp.max(plus, wp.vec3d())
        Ut = wp.transpose(U)
        for j in range(3):
            for k in range(3):
                ej = wp.vec3d()
                ek = wp.vec3d()
                ej[j] = wp.float64(1.0)
                ek[k] = wp.float64(1.0)
                K = U * tangent_block(H, minus, plus, ej * V, ek * V) * Ut
                for r in range(3):
                    for c in range(3):
                        tangent_out[sample, 3 * r + j, 3 * c + k] = K[r, c]

    return SimpleNamespace(evaluate=evaluate)
