"""Laws of solids: energy, stress and tangent in principal stretches. Theory, symbols: docs/theory/hyperelastic.md.

A law is an energy density psi(F) [Pa] with its first Piola-Kirchhoff stress P = dpsi/dF. The tangent follows from its
derivatives by the principal stretches: psi_ij and, for every pair of axes, (psi_i - psi_j)/(s_i - s_j) and
(psi_i + psi_j)/(s_i + s_j), by the missing axis. Every function takes the law's parameters as one vector ``p``, the
Lame constants (mu, lam). ``LAWS`` is the list of all laws.
"""

from dataclasses import dataclass
from typing import Any

import warp as wp


@wp.func
def cofactor(F: Any):
    """cof F = J F^-T, defined for singular F too."""
    c0 = wp.cross(F[1], F[2])
    c1 = wp.cross(F[2], F[0])
    c2 = wp.cross(F[0], F[1])
    return wp.matrix_from_rows(c0, c1, c2)


@wp.func
def stvk_energy(F: Any, p: Any):
    """psi = mu E:E + lam/2 (tr E)^2 with E = (F'F - 1)/2."""
    mu = p[0]
    lam = p[1]
    half = type(mu)(0.5)
    E = half * (wp.transpose(F) * F - wp.identity(n=3, dtype=type(mu)))
    return mu * wp.ddot(E, E) + half * lam * wp.trace(E) * wp.trace(E)


@wp.func
def stvk_stress(F: Any, p: Any):
    """P = F (2 mu E + lam tr(E) 1)."""
    mu = p[0]
    lam = p[1]
    identity = wp.identity(n=3, dtype=type(mu))
    E = type(mu)(0.5) * (wp.transpose(F) * F - identity)
    return F * (type(mu)(2.0) * mu * E + lam * wp.trace(E) * identity)


@wp.func
def stvk_principal(s: Any, p: Any):
    """Stretch Hessian and the two shear eigenvalues per pair (12, 02, 01 by the missing axis)."""
    mu = p[0]
    lam = p[1]
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
def neo_hookean_energy(F: Any, p: Any):
    """psi = mu/2 (I1 - 3) - mu ln J + lam/2 (ln J)^2 (Bonet and Wood, 2008)."""
    mu = p[0]
    lam = p[1]
    half = type(mu)(0.5)
    log_j = wp.log(wp.determinant(F))
    return half * mu * (wp.ddot(F, F) - type(mu)(3.0)) - mu * log_j + half * lam * log_j * log_j


@wp.func
def neo_hookean_stress(F: Any, p: Any):
    """P = mu (F - F^-T) + lam ln J F^-T."""
    mu = p[0]
    lam = p[1]
    J = wp.determinant(F)
    return mu * F + ((lam * wp.log(J) - mu) / J) * cofactor(F)


@wp.func
def neo_hookean_principal(s: Any, p: Any):
    """Stretch Hessian and shear eigenvalues."""
    mu = p[0]
    lam = p[1]
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
def stable_neo_hookean_energy(F: Any, p: Any):
    """psi = mu/2 (I1 - 3) + (lam + mu)/2 ((J - a)^2 - (1 - a)^2), a = 1 + mu/(lam + mu); zero at rest.

    Reference: Smith, de Goes, Kim (2018), Stable Neo-Hookean Flesh Simulation, without the logarithmic barrier.
    """
    mu = p[0]
    lam = p[1]
    half = type(mu)(0.5)
    lam2 = lam + mu
    a = type(mu)(1.0) + mu / lam2
    J = wp.determinant(F)
    rest = (type(mu)(1.0) - a) * (type(mu)(1.0) - a)
    return half * mu * (wp.ddot(F, F) - type(mu)(3.0)) + half * lam2 * ((J - a) * (J - a) - rest)


@wp.func
def stable_neo_hookean_stress(F: Any, p: Any):
    """P = mu F + (lam + mu) (J - a) cof F."""
    mu = p[0]
    lam = p[1]
    lam2 = lam + mu
    a = type(mu)(1.0) + mu / lam2
    return mu * F + (lam2 * (wp.determinant(F) - a)) * cofactor(F)


@wp.func
def stable_neo_hookean_principal(s: Any, p: Any):
    """Stretch Hessian and shear eigenvalues."""
    mu = p[0]
    lam = p[1]
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
def corotational_energy(F: Any, p: Any):
    """psi = mu sum (s_i - 1)^2 + lam/2 (sum s_i - 3)^2 with signed principal stretches."""
    mu = p[0]
    lam = p[1]
    U, s, V = wp.svd3(F)
    one = type(mu)(1.0)
    trace = s[0] + s[1] + s[2] - type(mu)(3.0)
    square = (s[0] - one) * (s[0] - one) + (s[1] - one) * (s[1] - one) + (s[2] - one) * (s[2] - one)
    return mu * square + type(mu)(0.5) * lam * trace * trace


@wp.func
def corotational_stress(F: Any, p: Any):
    """P = 2 mu (F - R) + lam (tr(R'F) - 3) R, R the rotation nearest to F (det R = +1 for inverted F too)."""
    mu = p[0]
    lam = p[1]
    U, s, V = wp.svd3(F)
    R = U * wp.transpose(V)
    return type(mu)(2.0) * mu * (F - R) + (lam * (s[0] + s[1] + s[2] - type(mu)(3.0))) * R


@wp.func
def corotational_principal(s: Any, p: Any):
    """Stretch Hessian and shear eigenvalues; the rotational one is bounded where a pair of stretches cancels."""
    mu = p[0]
    lam = p[1]
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


@dataclass(frozen=True)
class Law:
    """One law as kernels see it.

    Attributes:
        name: Of the element kernels, and ``law`` of the material.
        energy: Warp function ``energy(F, p)``.
        stress: Warp function ``stress(F, p)``.
        principal: Warp function ``principal(s, p)``.
    """

    name: str
    energy: Any
    stress: Any
    principal: Any


LAWS = {
    law.name: law
    for law in (
        Law("corotational", corotational_energy, corotational_stress, corotational_principal),
        Law("st_venant_kirchhoff", stvk_energy, stvk_stress, stvk_principal),
        Law("neo_hookean", neo_hookean_energy, neo_hookean_stress, neo_hookean_principal),
        Law("stable_neo_hookean", stable_neo_hookean_energy, stable_neo_hookean_stress, stable_neo_hookean_principal),
    )
}
