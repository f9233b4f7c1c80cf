"""Isotropic hyperelastic tetrahedra. Theory, symbols and checks: docs/theory/hyperelastic.md.

Every law is an energy density psi(F) [Pa] with its first Piola-Kirchhoff stress P = dpsi/dF. Tangents use the principal
stretches: with F = U diag(s) V', dP = U (C : U' dF V) V', where C has a 3x3 stretch block psi_ij and, for every pair
of axes, the eigenvalues (psi_i - psi_j)/(s_i - s_j) and (psi_i + psi_j)/(s_i + s_j). Clamping these at zero gives the
nearest positive semidefinite tangent. Reference: Smith, de Goes, Kim (2019), Analytic Eigensystems for Isotropic
Distortion Energies.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import Variant

LAWS = ("corotational", "st_venant_kirchhoff", "neo_hookean", "stable_neo_hookean")


@wp.func
def cofactor(F: Any):
    """cof F = J F^-T, defined for singular F too."""
    c0 = wp.cross(F[1], F[2])
    c1 = wp.cross(F[2], F[0])
    c2 = wp.cross(F[0], F[1])
    return wp.matrix_from_rows(c0, c1, c2)


@wp.func
def stvk_energy(F: Any, mu: Any, lam: Any):
    """psi = mu E:E + lam/2 (tr E)^2 with E = (F'F - 1)/2."""
    half = type(mu)(0.5)
    E = half * (wp.transpose(F) * F - wp.identity(n=3, dtype=type(mu)))
    return mu * wp.ddot(E, E) + half * lam * wp.trace(E) * wp.trace(E)


@wp.func
def stvk_stress(F: Any, mu: Any, lam: Any):
    """P = F (2 mu E + lam tr(E) 1)."""
    identity = wp.identity(n=3, dtype=type(mu))
    E = type(mu)(0.5) * (wp.transpose(F) * F - identity)
    return F * (type(mu)(2.0) * mu * E + lam * wp.trace(E) * identity)


@wp.func
def stvk_principal(s: Any, mu: Any, lam: Any):
    """Stretch Hessian and the two shear eigenvalues per pair (12, 02, 01 by the missing axis)."""
    trace = type(mu)(0.5) * lam * (wp.dot(s, s) - type(mu)(3.0))
    H = lam * wp.outer(s, s)
    for i in range(3):
        H[i, i] += mu * (type(mu)(3.0) * s[i] * s[i] - type(mu)(1.0)) + trace
    minus = s
    plus = s
    for k in range(3):
        a = s[(k + 1) % 3]
        b = s[(k + 2) % 3]
        square = a * a + b * b - type(mu)(1.0)
        minus[k] = mu * (square + a * b) + trace
        plus[k] = mu * (square - a * b) + trace
    return H, minus, plus


@wp.func
def neo_hookean_energy(F: Any, mu: Any, lam: Any):
    """psi = mu/2 (I1 - 3) - mu ln J + lam/2 (ln J)^2 (Bonet and Wood, 2008)."""
    half = type(mu)(0.5)
    log_j = wp.log(wp.determinant(F))
    return half * mu * (wp.ddot(F, F) - type(mu)(3.0)) - mu * log_j + half * lam * log_j * log_j


@wp.func
def neo_hookean_stress(F: Any, mu: Any, lam: Any):
    """P = mu (F - F^-T) + lam ln J F^-T."""
    J = wp.determinant(F)
    return mu * F + ((lam * wp.log(J) - mu) / J) * cofactor(F)


@wp.func
def neo_hookean_principal(s: Any, mu: Any, lam: Any):
    """Stretch Hessian and shear eigenvalues."""
    c = mu - lam * wp.log(s[0] * s[1] * s[2])
    inverse = s
    for i in range(3):
        inverse[i] = type(mu)(1.0) / s[i]
    H = lam * wp.outer(inverse, inverse)
    minus = s
    plus = s
    for k in range(3):
        H[k, k] += mu + c * inverse[k] * inverse[k]
        shear = c * inverse[(k + 1) % 3] * inverse[(k + 2) % 3]
        minus[k] = mu + shear
        plus[k] = mu - shear
    return H, minus, plus


@wp.func
def stable_neo_hookean_energy(F: Any, mu: Any, lam: Any):
    """psi = mu/2 (I1 - 3) + (lam + mu)/2 ((J - a)^2 - (1 - a)^2), a = 1 + mu/(lam + mu); zero at rest.

    Reference: Smith, de Goes, Kim (2018), Stable Neo-Hookean Flesh Simulation, without the logarithmic barrier.
    """
    half = type(mu)(0.5)
    lam2 = lam + mu
    a = type(mu)(1.0) + mu / lam2
    J = wp.determinant(F)
    rest = (type(mu)(1.0) - a) * (type(mu)(1.0) - a)
    return half * mu * (wp.ddot(F, F) - type(mu)(3.0)) + half * lam2 * ((J - a) * (J - a) - rest)


@wp.func
def stable_neo_hookean_stress(F: Any, mu: Any, lam: Any):
    """P = mu F + (lam + mu) (J - a) cof F."""
    lam2 = lam + mu
    a = type(mu)(1.0) + mu / lam2
    return mu * F + (lam2 * (wp.determinant(F) - a)) * cofactor(F)


@wp.func
def stable_neo_hookean_principal(s: Any, mu: Any, lam: Any):
    """Stretch Hessian and shear eigenvalues."""
    lam2 = lam + mu
    pressure = lam2 * (s[0] * s[1] * s[2] - type(mu)(1.0)) - mu
    area = s
    for k in range(3):
        area[k] = s[(k + 1) % 3] * s[(k + 2) % 3]
    H = lam2 * wp.outer(area, area)
    minus = s
    plus = s
    for k in range(3):
        i = (k + 1) % 3
        j = (k + 2) % 3
        shear = pressure * s[k]
        H[k, k] += mu
        H[i, j] += shear
        H[j, i] += shear
        minus[k] = mu - shear
        plus[k] = mu + shear
    return H, minus, plus


@wp.func
def corotational_energy(F: Any, mu: Any, lam: Any):
    """psi = mu sum (s_i - 1)^2 + lam/2 (sum s_i - 3)^2 with signed principal stretches."""
    U, s, V = wp.svd3(F)
    one = type(mu)(1.0)
    trace = s[0] + s[1] + s[2] - type(mu)(3.0)
    square = (s[0] - one) * (s[0] - one) + (s[1] - one) * (s[1] - one) + (s[2] - one) * (s[2] - one)
    return mu * square + type(mu)(0.5) * lam * trace * trace


@wp.func
def corotational_stress(F: Any, mu: Any, lam: Any):
    """P = 2 mu (F - R) + lam (tr(R'F) - 3) R, R the rotation nearest to F (det R = +1 for inverted F too)."""
    U, s, V = wp.svd3(F)
    R = U * wp.transpose(V)
    return type(mu)(2.0) * mu * (F - R) + (lam * (s[0] + s[1] + s[2] - type(mu)(3.0))) * R


@wp.func
def corotational_principal(s: Any, mu: Any, lam: Any):
    """Stretch Hessian and shear eigenvalues; the rotational one is bounded where a pair of stretches cancels."""
    two = type(mu)(2.0)
    trace = lam * (s[0] + s[1] + s[2] - type(mu)(3.0))
    minus = s
    plus = s
    for k in range(3):
        total = s[(k + 1) % 3] + s[(k + 2) % 3]
        if wp.abs(total) < type(mu)(1.0e-3):
            total = type(mu)(1.0e-3)
        minus[k] = two * mu
        plus[k] = two * (mu * (total - two) + trace) / total
    H = lam * wp.outer(s * type(mu)(0.0), s)
    for i in range(3):
        for j in range(3):
            H[i, j] = lam
        H[i, i] += two * mu
    return H, minus, plus


@wp.func
def clamp_symmetric(H: Any):
    """Nearest positive semidefinite matrix to a symmetric 3x3 one."""
    Q, d = wp.eig3(H)
    zero = d[0] - d[0]
    D = wp.diag(wp.max(d, d * zero))
    return Q * D * wp.transpose(Q)


_ENERGY = {
    "corotational": corotational_energy,
    "st_venant_kirchhoff": stvk_energy,
    "neo_hookean": neo_hookean_energy,
    "stable_neo_hookean": stable_neo_hookean_energy,
}
_STRESS = {
    "corotational": corotational_stress,
    "st_venant_kirchhoff": stvk_stress,
    "neo_hookean": neo_hookean_stress,
    "stable_neo_hookean": stable_neo_hookean_stress,
}
_PRINCIPAL = {
    "corotational": corotational_principal,
    "st_venant_kirchhoff": stvk_principal,
    "neo_hookean": neo_hookean_principal,
    "stable_neo_hookean": stable_neo_hookean_principal,
}


def law_functions(law: str) -> tuple[Any, Any, Any]:
    """Warp functions ``energy(F, mu, lam)``, ``stress(F, mu, lam)`` and ``principal(s, mu, lam)`` of a law."""
    return _ENERGY[law], _STRESS[law], _PRINCIPAL[law]


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


@cache
def kernels(variant: Variant, law: str, project: bool) -> SimpleNamespace:
    """Kernels of one hyperelastic law for one scalar type.

    Args:
        variant: Scalar type and memory order.
        law: One of ``LAWS``.
        project: Whether element tangents are clamped to positive semidefinite ones.
    """
    real = variant.real
    module = variant.module(f"hyperelastic.{law}.{'spd' if project else 'exact'}")
    vec3 = wp.types.vector(3, real)
    mat33 = wp.types.matrix((3, 3), real)
    _, stress_of, principal_of = law_functions(law)

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
        # Workspace in
        body_mu_in: wp.array3d(dtype=real),
        body_lam_in: wp.array3d(dtype=real),
        node_x_in: wp.array3d(dtype=real),
        # Workspace out
        tet_force_out: wp.array3d(dtype=real),
    ):
        """Elastic corner forces dE/dx [N] of one tet."""
        pack, item, lane = wp.tid()
        tet = tet_index[item]
        body = tet_body[tet]
        F = deformation(node_x_in, pack, lane, tet, tet_node, tet_gradient)
        P = tet_volume[tet] * stress_of(F, body_mu_in[pack, body, lane], body_lam_in[pack, body, lane])
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
        # Workspace in
        body_mu_in: wp.array3d(dtype=real),
        body_lam_in: wp.array3d(dtype=real),
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
        H, minus, plus = principal_of(s, body_mu_in[pack, body, lane], body_lam_in[pack, body, lane])
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
def gather_kernels(variant: Variant) -> SimpleNamespace:
    """Sum of stored element stiffness blocks, shared by all laws."""
    S = variant.S
    mul = variant.mul
    real = variant.real
    world_fastest = variant.world_fastest
    module = variant.module("hyperelastic.gather")

    @wp.kernel(module=module, enable_backward=False)
    def block_stiffness(
        # Model
        tet_body: wp.array(dtype=wp.int32),
        entry_start: wp.array(dtype=wp.int32),
        entry: wp.array(dtype=wp.int32),
        # Workspace in
        body_stiffness_scale_in: wp.array2d(dtype=S),
        tet_stiffness_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
    ):
        """Add the stored stiffness of all tets around one 3x3 block of A."""
        w, block = wp.tid()
        if wp.static(world_fastest):
            block, w = wp.tid()
        begin = entry_start[block]
        end = entry_start[block + 1]
        if begin < end:
            k00 = S(real(0.0))
            k01 = S(real(0.0))
            k02 = S(real(0.0))
            k10 = S(real(0.0))
            k11 = S(real(0.0))
            k12 = S(real(0.0))
            k20 = S(real(0.0))
            k21 = S(real(0.0))
            k22 = S(real(0.0))
            for p in range(begin, end):
                a = (entry[p] >> 2) & 3
                b = entry[p] & 3
                i = (entry[p] >> 4) * 90 + ((a * (a + 1)) // 2 + b) * 9
                across = 1
                down = 3
                if a < b:  # the transpose is stored
                    i = (entry[p] >> 4) * 90 + ((b * (b + 1)) // 2 + a) * 9
                    across = 3
                    down = 1
                k00 += tet_stiffness_in[w, i]
                k01 += tet_stiffness_in[w, i + across]
                k02 += tet_stiffness_in[w, i + 2 * across]
                k10 += tet_stiffness_in[w, i + down]
                k11 += tet_stiffness_in[w, i + down + across]
                k12 += tet_stiffness_in[w, i + down + 2 * across]
                k20 += tet_stiffness_in[w, i + 2 * down]
                k21 += tet_stiffness_in[w, i + 2 * down + across]
                k22 += tet_stiffness_in[w, i + 2 * down + 2 * across]
            scale = body_stiffness_scale_in[w, tet_body[entry[begin] >> 4]]
            row = block * 9
            a_out[w, row] += mul(scale, k00)
            a_out[w, row + 1] += mul(scale, k01)
            a_out[w, row + 2] += mul(scale, k02)
            a_out[w, row + 3] += mul(scale, k10)
            a_out[w, row + 4] += mul(scale, k11)
            a_out[w, row + 5] += mul(scale, k12)
            a_out[w, row + 6] += mul(scale, k20)
            a_out[w, row + 7] += mul(scale, k21)
            a_out[w, row + 8] += mul(scale, k22)

    return SimpleNamespace(block_stiffness=block_stiffness)


@cache
def evaluation_kernels(law: str) -> SimpleNamespace:
    """Energy, stress and tangent of given deformation gradients, in float64, for tests and plots."""
    module = wp.get_module(f"softwarp.kernels.elements.hyperelastic.evaluate.{law}")
    energy_of, stress_of, principal_of = law_functions(law)

    @wp.kernel(module=module, enable_backward=False)
    def evaluate(
        # Samples in
        F_in: wp.array(dtype=wp.mat33d),
        mu: wp.float64,
        lam: wp.float64,
        project: bool,
        # Samples out
        energy_out: wp.array(dtype=wp.float64),
        stress_out: wp.array(dtype=wp.mat33d),
        tangent_out: wp.array3d(dtype=wp.float64),
    ):
        """Energy density, stress and tangent [Pa] of one deformation gradient."""
        sample = wp.tid()
        F = F_in[sample]
        energy_out[sample] = energy_of(F, mu, lam)
        stress_out[sample] = stress_of(F, mu, lam)
        U, s, V = wp.svd3(F)
        H, minus, plus = principal_of(s, mu, lam)
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
