"""Energies, stresses and tangents of solids. Theory, symbols: docs/theory/hyperelastic.md; list: ``laws``.

A law is an energy density psi(F) [Pa] with its first Piola-Kirchhoff stress P = dpsi/dF, given by the invariants of F
or by the slopes psi_i. The tangent follows from its derivatives by the principal stretches: psi_ij and, for every pair
of axes, (psi_i - psi_j)/(s_i - s_j) and (psi_i + psi_j)/(s_i + s_j), by the missing axis. By I1 = F:F, I2 = |cof F|^2
and J = det F, ``derivatives`` are psi_1, psi_2, psi_J and psi_11, psi_12, psi_1J, psi_22, psi_2J, psi_JJ. Every
function takes the law's parameters as one vector ``p``: Lame constants (mu, lam), or parameters of its own in the order
that the material declares.

Those of laws by stretches are differentiated once more, by Warp: they write into fresh vectors (``s - s``), never into
a copy of an argument or over a value that was read, for which Warp's gradients are wrong.
"""

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
def stvk_invariants(I1: Any, I2: Any, J: Any, p: Any):
    """P = F (2 mu E + lam tr(E) 1): a = lam/2 (I1 - 3) - mu, c = mu."""
    mu = p[0]
    lam = p[1]
    return type(mu)(0.5) * lam * (I1 - type(mu)(3.0)) - mu, type(mu)(0.0), mu


@wp.func
def stvk_derivatives(I1: Any, I2: Any, J: Any, p: Any):
    """Of psi = mu/4 (I1^2 - 2 I2 - 2 I1 + 3) + lam/8 (I1 - 3)^2, as tr C^2 = I1^2 - 2 I2."""
    mu = p[0]
    lam = p[1]
    half = type(mu)(0.5)
    none = type(mu)(0.0)
    first = half * (mu * (I1 - type(mu)(1.0)) + half * lam * (I1 - type(mu)(3.0)))
    return wp.vector(first, -half * mu, none, half * (mu + half * lam), none, none, none, none, none)


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
def neo_hookean_invariants(I1: Any, I2: Any, J: Any, p: Any):
    """P = mu (F - F^-T) + lam ln J F^-T: a = mu, b = (lam ln J - mu)/J."""
    mu = p[0]
    lam = p[1]
    return mu, (lam * wp.log(J) - mu) / J, type(mu)(0.0)


@wp.func
def neo_hookean_derivatives(I1: Any, I2: Any, J: Any, p: Any):
    """psi_1 = mu/2 and psi_J = (lam ln J - mu)/J."""
    mu = p[0]
    lam = p[1]
    none = type(mu)(0.0)
    slope = lam * wp.log(J) - mu
    curvature = (lam - slope) / (J * J)
    return wp.vector(type(mu)(0.5) * mu, none, slope / J, none, none, none, none, none, curvature)


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
def stable_neo_hookean_invariants(I1: Any, I2: Any, J: Any, p: Any):
    """P = mu F + (lam + mu) (J - a) cof F."""
    mu = p[0]
    lam = p[1]
    lam2 = lam + mu
    a = type(mu)(1.0) + mu / lam2
    return mu, lam2 * (J - a), type(mu)(0.0)


@wp.func
def stable_neo_hookean_derivatives(I1: Any, I2: Any, J: Any, p: Any):
    """psi_1 = mu/2 and psi_J = (lam + mu) (J - a)."""
    mu = p[0]
    lam2 = p[1] + mu
    none = type(mu)(0.0)
    slope = lam2 * (J - type(mu)(1.0)) - mu
    return wp.vector(type(mu)(0.5) * mu, none, slope, none, none, none, none, none, lam2)


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
def corotational_slopes(s: Any, p: Any):
    """psi_i = 2 mu (s_i - 1) + lam (sum s_i - 3)."""
    mu = p[0]
    lam = p[1]
    trace = lam * (s[0] + s[1] + s[2] - type(mu)(3.0))
    psi = s
    for i in range(3):
        psi[i] = type(mu)(2.0) * mu * (s[i] - type(mu)(1.0)) + trace
    return psi


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


@wp.func
def isochoric(J: Any):
    """J^(-2/3); not a number for J < 0, so that the step control rejects mirrored elements."""
    return wp.pow(J, type(J)(-2.0) / type(J)(3.0))


@wp.func
def volumetric(J: Any, bulk: Any):
    """U = bulk/2 (J - 1)^2 with J U' and J^2 U''; the volumetric part of all laws of isochoric invariants."""
    change = J - type(J)(1.0)
    return type(J)(0.5) * bulk * change * change, bulk * J * change, bulk * J * J


@wp.func
def only_unmirrored(J: Any, psi: Any):
    """Infinite energy for a flat or mirrored element."""
    return wp.where(J > type(J)(0.0), psi, type(J)(wp.inf))


@wp.func
def distortion(J: Any, square: Any):
    """x = J^(-2/3) I1 - 3 with I1 = F:F, the sum of squared stretches."""
    return isochoric(J) * square - type(J)(3.0)


@wp.func
def distortion_invariants(I1: Any, J: Any, slope: Any, bulk: Any):
    """a = 2 W' J^(-2/3) and b = k/J with k = J U' - 2/3 W' (x + 3), of a law W(x) + U with ``slope`` W'."""
    two = type(bulk)(2.0)
    j = isochoric(J)
    _, first, _ = volumetric(J, bulk)
    return two * slope * j, (first - two / type(bulk)(3.0) * slope * j * I1) / J, type(bulk)(0.0)


@wp.func
def distortion_derivatives(I1: Any, J: Any, slope: Any, curvature: Any, bulk: Any):
    """Of W(x) + U with W' and W'': x_1 = J^(-2/3), x_J = -2/3 x_1 I1/J."""
    third = type(bulk)(1.0) / type(bulk)(3.0)
    two = type(bulk)(2.0)
    none = type(bulk)(0.0)
    by_one = isochoric(J)
    mixed = -two * third * by_one / J
    by_j = mixed * I1
    twice = -type(bulk)(5.0) * third * by_j / J
    return wp.vector(
        slope * by_one,
        none,
        slope * by_j + bulk * (J - type(bulk)(1.0)),
        curvature * by_one * by_one,
        none,
        curvature * by_one * by_j + slope * mixed,
        none,
        none,
        curvature * by_j * by_j + slope * twice + bulk,
    )


@wp.func
def distortion_principal(s: Any, slope: Any, curvature: Any, bulk: Any):
    """Stretch Hessian and shear eigenvalues of a law W(x) + U with W' and W''; d_i = s_i dx/ds_i."""
    two = type(bulk)(2.0)
    third = type(bulk)(1.0) / type(bulk)(3.0)
    J = s[0] * s[1] * s[2]
    j = isochoric(J)
    q = j * wp.cw_mul(s, s)
    total = q[0] + q[1] + q[2]
    _, first, second = volumetric(J, bulk)
    k = first - two * third * slope * total
    minus = s
    plus = s
    d = s
    for m in range(3):
        pair = s[(m + 1) % 3] * s[(m + 2) % 3]
        minus[m] = two * slope * j - k / pair
        plus[m] = two * slope * j + k / pair
        d[m] = two * (q[m] - third * total)
    H = wp.outer(s, s)
    for a in range(3):
        for b in range(3):
            h = two * two * third * slope * (third * total - q[a] - q[b]) + curvature * d[a] * d[b]
            h += first + second
            if a == b:
                h += two * slope * (q[a] + third * total) - first
            H[a, b] = h / (s[a] * s[b])
    return H, minus, plus


@wp.func
def yeoh_slopes(x: Any, p: Any):
    """W' and W'' of W = c10 x + c20 x^2 + c30 x^3."""
    two = type(x)(2.0)
    three = type(x)(3.0)
    return p[1] + x * (two * p[2] + three * x * p[3]), two * (p[2] + three * x * p[3])


@wp.func
def yeoh_energy(F: Any, p: Any):
    """psi = c10 x + c20 x^2 + c30 x^3 + U (Yeoh, 1993); p = bulk, c10, c20, c30."""
    J = wp.determinant(F)
    U, _, _ = volumetric(J, p[0])
    x = distortion(J, wp.ddot(F, F))
    return only_unmirrored(J, x * (p[1] + x * (p[2] + x * p[3])) + U)


@wp.func
def yeoh_invariants(I1: Any, I2: Any, J: Any, p: Any):
    """Those of W(x) + U."""
    slope, _ = yeoh_slopes(distortion(J, I1), p)
    return distortion_invariants(I1, J, slope, p[0])


@wp.func
def yeoh_derivatives(I1: Any, I2: Any, J: Any, p: Any):
    """Those of W(x) + U."""
    slope, curvature = yeoh_slopes(distortion(J, I1), p)
    return distortion_derivatives(I1, J, slope, curvature, p[0])


@wp.func
def yeoh_principal(s: Any, p: Any):
    """Those of W(x) + U."""
    slope, curvature = yeoh_slopes(distortion(s[0] * s[1] * s[2], wp.dot(s, s)), p)
    return distortion_principal(s, slope, curvature, p[0])


@wp.func
def mooney_rivlin_energy(F: Any, p: Any):
    """psi = c10 (J^(-2/3) I1 - 3) + c01 (J^(-4/3) I2 - 3) + U with I2 = |cof F|^2; p = bulk, c10, c01."""
    three = type(p[0])(3.0)
    J = wp.determinant(F)
    j = isochoric(J)
    G = cofactor(F)
    U, _, _ = volumetric(J, p[0])
    return only_unmirrored(J, p[1] * (j * wp.ddot(F, F) - three) + p[2] * (j * j * wp.ddot(G, G) - three) + U)


@wp.func
def mooney_rivlin_invariants(I1: Any, I2: Any, J: Any, p: Any):
    """P = (a + b I1) F - b F F'F + k/J cof F with a = 2 c10 J^(-2/3), b = 2 c01 J^(-4/3)."""
    two = type(p[0])(2.0)
    j = isochoric(J)
    a = two * p[1] * j
    b = two * p[2] * j * j
    _, first, _ = volumetric(J, p[0])
    k = first - (a * I1 + two * b * I2) / type(p[0])(3.0)
    return a + b * I1, k / J, -b


@wp.func
def mooney_rivlin_derivatives(I1: Any, I2: Any, J: Any, p: Any):
    """Of c10 J^(-2/3) I1 + c01 J^(-4/3) I2 + U."""
    third = type(J)(1.0) / type(J)(3.0)
    two = type(J)(2.0)
    none = type(J)(0.0)
    j = isochoric(J)
    a = p[1] * j
    b = p[2] * j * j
    mixed = -two * third * a / J
    other = -two * two * third * b / J
    first = mixed * I1 + other * I2
    second = -(type(J)(5.0) * mixed * I1 + type(J)(7.0) * other * I2) * third / J
    return wp.vector(a, b, first + p[0] * (J - type(J)(1.0)), none, none, mixed, none, other, second + p[0])


@wp.func
def mooney_rivlin_principal(s: Any, p: Any):
    """Stretch Hessian and shear eigenvalues; q_i = J^(-2/3) s_i^2 and r_i = 1/q_i sum to the two invariants."""
    two = type(p[0])(2.0)
    three = type(p[0])(3.0)
    J = s[0] * s[1] * s[2]
    j = isochoric(J)
    q = j * wp.cw_mul(s, s)
    r = s
    for m in range(3):
        r[m] = q[(m + 1) % 3] * q[(m + 2) % 3]
    A = p[1] * (q[0] + q[1] + q[2])
    B = p[2] * (r[0] + r[1] + r[2])
    a = two * p[1] * j
    b = two * p[2] * j * j
    _, first, second = volumetric(J, p[0])
    k = first - (two * A + two * two * B) / three
    minus = s
    plus = s
    for m in range(3):
        pair = s[(m + 1) % 3] * s[(m + 2) % 3]
        minus[m] = a + b * (s[m] * s[m] - pair) - k / pair
        plus[m] = a + b * (s[m] * s[m] + pair) + k / pair
    H = wp.outer(s, s)
    for i in range(3):
        for m in range(3):
            mixed = p[1] * (q[i] + q[m]) + p[2] * (r[i] + r[m])
            h = two * two / three * ((A + B) / three - mixed) + first + second
            if i == m:
                h += two * (p[1] * q[i] + three * p[2] * r[i]) + two / three * (A - B) - first
            H[i, m] = h / (s[i] * s[m])
    return H, minus, plus


@wp.func
def sinh_ratio(x: Any, up: Any, down: Any):
    """sinh(x)/x; ``up`` and ``down`` are exp(x) and exp(-x)."""
    one = type(x)(1.0)
    y = x * x
    near = one + y / type(x)(110.0)
    near = one + y / type(x)(72.0) * near
    near = one + y / type(x)(42.0) * near
    near = one + y / type(x)(20.0) * near
    near = one + y / type(x)(6.0) * near
    is_near = y < type(x)(0.25)
    safe = wp.where(is_near, one, x)
    return wp.where(is_near, near, type(x)(0.5) * (up - down) / safe)


@wp.func
def exp_remainder(x: Any):
    """(exp(x) - 1 - x)/x^2."""
    one = type(x)(1.0)
    near = one + x / type(x)(12.0)
    for n in range(8):
        near = one + x / type(x)(11 - n) * near
    near = type(x)(0.5) * (one + x / type(x)(3.0) * near)
    is_near = x * x < type(x)(0.25)
    safe = wp.where(is_near, one, x)
    return wp.where(is_near, near, (wp.exp(safe) - one - safe) / (safe * safe))


@wp.func
def without_mean(v: Any):
    """v_i less their mean."""
    mean = (v[0] + v[1] + v[2]) / type(v[0])(3.0)
    r = v - v
    for i in range(3):
        r[i] = v[i] - mean
    return r


@wp.func
def log_stretches(s: Any):
    """e_i = ln s_i less their mean; not a number where an element is mirrored, as svd3 makes one stretch negative."""
    e = s - s
    for i in range(3):
        e[i] = wp.log(s[i])
    return without_mean(e)


@wp.func
def half_powers(e: Any, alpha: Any):
    """sbar_i^(alpha/2)."""
    h = e - e
    for i in range(3):
        h[i] = wp.exp(type(alpha)(0.5) * alpha * e[i])
    return h


@wp.func
def power_strain(e: Any, alpha: Any, h: Any):
    """(sbar_i^alpha - 1)/alpha, accurate for small strain and small alpha; ``h`` are half powers."""
    strain = e - e
    for i in range(3):
        strain[i] = e[i] * h[i] * sinh_ratio(type(alpha)(0.5) * alpha * e[i], h[i], type(alpha)(1.0) / h[i])
    return strain


@wp.func
def ogden_awake(p: Any):
    """The parameters with a modulus of 1e-30 Pa for each that is 0, whose term the functions below leave out."""
    q = p
    for term in range(3):
        if p[2 * term + 1] == type(p[0])(0.0):
            q[2 * term + 1] = type(p[0])(1.0e-30)
    return q


@wp.func
def ogden_kirchhoff(e: Any, p: Any):
    """Principal Kirchhoff stresses s_i psi_i without the volumetric part."""
    t = e - e
    for term in range(3):
        if p[2 * term + 1] != type(p[0])(0.0):
            alpha = p[2 * term + 2]
            strain = power_strain(e, alpha, half_powers(e, alpha))
            t += type(p[0])(2.0) * p[2 * term + 1] * without_mean(strain)
    return t


@wp.func
def ogden_energy(F: Any, p: Any):
    """psi = sum 2 mu/alpha^2 (sum_i sbar_i^alpha - 3) + U (Ogden, 1972); p = bulk, mu_1, alpha_1, .., alpha_3.

    Written as sum 2 mu e_i^2 f(alpha e_i) with f(x) = (exp(x) - 1 - x)/x^2, equal as sum e_i = 0: nothing cancels.
    """
    U, s, V = wp.svd3(F)
    e = log_stretches(s)
    J = wp.determinant(F)
    psi, _, _ = volumetric(J, p[0])
    for term in range(3):
        for i in range(3):
            psi += type(J)(2.0) * p[2 * term + 1] * e[i] * e[i] * exp_remainder(p[2 * term + 2] * e[i])
    return only_unmirrored(J, psi)


@wp.func
def ogden_slopes(s: Any, p: Any):
    """psi_i = (t_i + J U') / s_i."""
    t = ogden_kirchhoff(log_stretches(s), p)
    _, first, _ = volumetric(s[0] * s[1] * s[2], p[0])
    psi = s - s
    for i in range(3):
        psi[i] = (t[i] + first) / s[i]
    return psi


@wp.func
def ogden_changes(e: Any, p: Any):
    """The stresses above, their slopes s_j dt_i/ds_j, and (t_i - t_j)/(e_i - e_j) of each pair of axes."""
    half = type(p[0])(0.5)
    three = type(p[0])(3.0)
    t = e - e
    h = wp.outer(t, t)
    slope = e - e
    for term in range(3):
        if p[2 * term + 1] != type(p[0])(0.0):
            twice = type(p[0])(2.0) * p[2 * term + 1]
            alpha = p[2 * term + 2]
            root = half_powers(e, alpha)
            t += twice * without_mean(power_strain(e, alpha, root))
            power = wp.cw_mul(root, root)
            mean = (power[0] + power[1] + power[2]) / three
            for i in range(3):
                for m in range(3):
                    h[i, m] -= twice * (power[i] + power[m] - mean) / three
                h[i, i] += twice * power[i]
            for m in range(3):
                up = root[(m + 1) % 3]
                down = root[(m + 2) % 3]
                x = half * alpha * (e[(m + 1) % 3] - e[(m + 2) % 3])
                slope[m] += twice * up * down * sinh_ratio(x, up / down, down / up)
    return t, h, slope


@wp.func
def ogden_principal(s: Any, p: Any):
    """Stretch Hessian and shear eigenvalues; equal stretches need no special case."""
    half = type(p[0])(0.5)
    e = log_stretches(s)
    _, first, second = volumetric(s[0] * s[1] * s[2], p[0])
    t, H, slope = ogden_changes(e, p)
    minus = s - s
    plus = s - s
    for i in range(3):
        t[i] += first
    for m in range(3):
        i = (m + 1) % 3
        j = (m + 2) % 3
        d = half * (e[i] - e[j])
        r = wp.sqrt(s[i] / s[j])
        sinh = sinh_ratio(d, r, type(d)(1.0) / r)
        cosh = wp.sqrt(type(d)(1.0) + d * d * sinh * sinh)
        mean = half * (t[i] + t[j])
        minus[m] = (slope[m] * cosh / sinh - mean) / (s[i] * s[j])
        plus[m] = (mean - half * (t[i] - t[j]) * (s[i] - s[j]) / (s[i] + s[j])) / (s[i] * s[j])
    result = H - H
    for i in range(3):
        for j in range(3):
            own = wp.where(i == j, t[i], t[i] - t[i])
            result[i, j] = (H[i, j] - own + first + second) / (s[i] * s[j])
    return result, minus, plus
