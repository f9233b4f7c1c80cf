"""Gradients of membranes in a step: by the corners of triangles and by moduli. Theory: docs/theory/adjoint.md.

With the columns of F, of X = sum p_b g_b' and of Y = sum v_b g_b' a triangle has in A v = b, per volume,

    h S : F'X + k (C[sym F'Y] : sym F'X + S+ : Y'X),     C[E] = 2 mu E + lam tr(E) 1,

S+ the stress without its negative principal values where tangents are projected, else S. Warp differentiates it;
a step has it with the other sign.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds

PARAMETERS = 3  # rows of a triangle: by mu, by lam, by the factor k of the stiffness
TINY = {"float32": 1.0e-12, "float64": 1.0e-24}  # Pa^2, so that the root of two equal principal stresses has a slope


@single_worlds
def kernels(variant: Variant, project: bool) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds.

    Args:
        variant: Scalar type and memory order.
        project: As of ``membrane.kernels``.
    """
    real = variant.real
    module = variant.module(f"adjoint.membrane.{'spd' if project else 'exact'}")
    one = single.functions(variant)
    vec3, vector_at, put = one.vec3, one.vector_at, one.put
    tiny = TINY["float64" if real is wp.float64 else "float32"]

    @wp.func
    def tension(sxx: real, sxy: real, syy: real):
        """The stress without its negative principal values."""
        mean = real(0.5) * (sxx + syy)
        difference = real(0.5) * (sxx - syy)
        radius = wp.sqrt(difference * difference + sxy * sxy + real(wp.static(tiny)))
        low = wp.max(mean - radius, real(0.0))
        share = (wp.max(mean + radius, real(0.0)) - low) / (real(2.0) * radius)
        least = mean - radius
        return vec3(share * (sxx - least) + low, share * sxy, share * (syy - least) + low)

    @wp.func
    def product(a: vec3, b: vec3, c: vec3, d: vec3):
        """Symmetric part of (a b)' (c d), of the columns: xx, xy, yy."""
        return vec3(wp.dot(a, c), real(0.5) * (wp.dot(a, d) + wp.dot(b, c)), wp.dot(b, d))

    @wp.func
    def contraction(a: vec3, b: vec3):
        """a : b of symmetric ones."""
        return a[0] * b[0] + real(2.0) * a[1] * b[1] + a[2] * b[2]

    @wp.func
    def value(
        fx: vec3,
        fy: vec3,
        px: vec3,
        py: vec3,
        vx: vec3,
        vy: vec3,
        mu: real,
        lam: real,
        h: real,
        k: real,
    ):
        """What one triangle has per volume."""
        strain = real(0.5) * (product(fx, fy, fx, fy) - vec3(real(1.0), real(0.0), real(1.0)))
        pressure = lam * (strain[0] + strain[2])
        stress = real(2.0) * mu * strain + vec3(pressure, real(0.0), pressure)
        left = stress
        if wp.static(project):
            left = tension(stress[0], stress[1], stress[2])
        along = product(fx, fy, px, py)
        fast = product(fx, fy, vx, vy)
        stiff = real(2.0) * mu * contraction(fast, along) + lam * (fast[0] + fast[2]) * (along[0] + along[2])
        stiff += contraction(left, product(vx, vy, px, py))
        return h * contraction(stress, along) + k * stiff

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
        value_out[sample] = value(a, a, a, a, a, a, b, b, b, b)

    @wp.func
    def way(array: wp.array3d(dtype=real), pack: int, lane: int, node: wp.array2d(dtype=wp.int32), tri: int, b: int):
        """From corner 0 to another one."""
        first = vector_at(array, pack, lane, 3 * node[tri, 0])
        return vector_at(array, pack, lane, 3 * node[tri, b]) - first

    @wp.kernel(module=module, enable_backward=False)
    def triangle_adjoint(
        first: int,
        h: real,
        # Model
        tri_node: wp.array2d(dtype=wp.int32),
        tri_membrane: wp.array(dtype=wp.int32),
        tri_gradient: wp.array2d(dtype=real),
        tri_volume: wp.array(dtype=real),
        element_body: wp.array(dtype=wp.int32),
        # Workspace in
        youngs_in: wp.array3d(dtype=real),
        nu_in: wp.array3d(dtype=real),
        stiffness_in: wp.array3d(dtype=real),
        x_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        p_in: wp.array3d(dtype=real),
        # Workspace out
        corner_out: wp.array3d(dtype=real),
        parameter_out: wp.array3d(dtype=real),
    ):
        """Gradients by the corners of one triangle, of which the fourth is missing, and by its constants."""
        pack, tri, lane = wp.tid()
        ax = tri_gradient[tri, 0]
        ay = tri_gradient[tri, 1]
        bx = tri_gradient[tri, 2]
        by = tri_gradient[tri, 3]
        xa = way(x_in, pack, lane, tri_node, tri, 1)
        xb = way(x_in, pack, lane, tri_node, tri, 2)
        pa = way(p_in, pack, lane, tri_node, tri, 1)
        pb = way(p_in, pack, lane, tri_node, tri, 2)
        va = way(v_in, pack, lane, tri_node, tri, 1)
        vb = way(v_in, pack, lane, tri_node, tri, 2)
        youngs = youngs_in[pack, tri_membrane[tri], lane]
        nu = nu_in[pack, tri_membrane[tri], lane]
        mu = youngs / (real(2.0) * (real(1.0) + nu))
        lam = youngs * nu / (real(1.0) - nu * nu)
        k = stiffness_in[pack, element_body[tri], lane]
        gx, gy, gpx, gpy, gvx, gvy, by_mu, by_lam, gh, by_k = wp.grad(value)(
            ax * xa + bx * xb,
            ay * xa + by * xb,
            ax * pa + bx * pb,
            ay * pa + by * pb,
            ax * va + bx * vb,
            ay * va + by * vb,
            mu,
            lam,
            h,
            k,
        )
        volume = -tri_volume[tri]
        a = volume * (ax * gx + ay * gy)
        b = volume * (bx * gx + by * gy)
        row = 12 * (first + tri)
        put(corner_out, pack, lane, row, -a - b)
        put(corner_out, pack, lane, row + 3, a)
        put(corner_out, pack, lane, row + 6, b)
        put(corner_out, pack, lane, row + 9, vec3())
        put(parameter_out, pack, lane, wp.static(PARAMETERS) * tri, volume * vec3(by_mu, by_lam, by_k))

    @wp.kernel(module=module, enable_backward=False)
    def moduli(
        lanes: int,
        # Model
        membrane_start: wp.array(dtype=wp.int32),
        membrane_tri: wp.array(dtype=wp.int32),
        # Workspace in
        youngs_in: wp.array3d(dtype=real),
        nu_in: wp.array3d(dtype=real),
        parameter_in: wp.array3d(dtype=real),
        # State out
        youngs_bar_out: wp.array2d(dtype=real),
        nu_bar_out: wp.array2d(dtype=real),
    ):
        """Add the gradients by the moduli of one membrane: mu = E / 2(1 + nu), lam = E nu / (1 - nu^2)."""
        pack, membrane, lane = wp.tid()
        world = pack * lanes + lane
        if world < youngs_bar_out.shape[0]:
            by_mu = real(0.0)
            by_lam = real(0.0)
            for i in range(membrane_start[membrane], membrane_start[membrane + 1]):
                row = wp.static(PARAMETERS) * membrane_tri[i]
                by_mu += parameter_in[pack, row, lane]
                by_lam += parameter_in[pack, row + 1, lane]
            nu = nu_in[pack, membrane, lane]
            two = real(2.0)
            more = real(1.0) + nu
            rest = real(1.0) - nu * nu
            by_nu = by_lam * (real(1.0) + nu * nu) / (rest * rest) - by_mu / (two * more * more)
            youngs_bar_out[world, membrane] = (
                youngs_bar_out[world, membrane] + by_mu / (two * more) + by_lam * nu / rest
            )
            nu_bar_out[world, membrane] = nu_bar_out[world, membrane] + youngs_in[pack, membrane, lane] * by_nu

    @wp.kernel(module=module, enable_backward=False)
    def damping(
        h: real,
        lanes: int,
        # Model
        body_start: wp.array(dtype=wp.int32),
        body_tri: wp.array(dtype=wp.int32),
        # Workspace in
        parameter_in: wp.array3d(dtype=real),
        # State out
        rayleigh_stiffness_bar_out: wp.array2d(dtype=real),
    ):
        """Add the gradient by the damping of one body, with which k grows by h."""
        pack, body, lane = wp.tid()
        world = pack * lanes + lane
        if world < rayleigh_stiffness_bar_out.shape[0]:
            total = real(0.0)
            for i in range(body_start[body], body_start[body + 1]):
                total += h * parameter_in[pack, wp.static(PARAMETERS) * body_tri[i] + 2, lane]
            rayleigh_stiffness_bar_out[world, body] = rayleigh_stiffness_bar_out[world, body] + total

    return SimpleNamespace(reach=reach, triangle_adjoint=triangle_adjoint, moduli=moduli, damping=damping)
