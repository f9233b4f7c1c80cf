"""Elastic energy and von Mises stress of tetrahedra. Laws, symbols and checks: docs/theory/hyperelastic.md.

With the energy density psi(F) and the stress P = d psi / d F, the Cauchy stress is s = P F' / J, and von Mises' measure
of it sqrt(3/2 dev s : dev s). The guard of ``corotational`` counts as energy. Nothing here is part of a step.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.elements import strain
from softwarp.kernels.elements.corotational import GUARD, GUARD_GROWTH
from softwarp.kernels.elements.laws import LAWS

LEAST_J = 1.0e-6  # volume ratio that stress is divided by at least: elements may be inverted


@single_worlds
def kernels(variant: Variant, law: str) -> SimpleNamespace:
    """Kernels of one law for one scalar type, one world per element of an array.

    Args:
        variant: Scalar type and memory order, ``scalar`` or ``cuda``.
        law: One of ``laws.LAWS``.
    """
    real = variant.real
    world_fastest = variant.world_fastest
    module = variant.module(f"energy.{law}")
    energy_of, stress_of, own = LAWS[law].energy, LAWS[law].stress, LAWS[law].own
    f = strain.functions(variant, law)
    law_parameters, deformation = f.law_parameters, f.deformation

    @wp.kernel(module=module, enable_backward=False)
    def evaluate(
        # Model
        tet_index: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet_volume: wp.array(dtype=real),
        body_law_start: wp.array(dtype=wp.int32),
        body_guard: wp.array(dtype=real),
        # State
        youngs_in: wp.array2d(dtype=real),
        nu_in: wp.array2d(dtype=real),
        law_parameter_in: wp.array2d(dtype=real),
        node_x_in: wp.array2d(dtype=real),
        # Workspace out
        energy_out: wp.array2d(dtype=real),
        stress_out: wp.array2d(dtype=real),
    ):
        """Elastic energy [J] and von Mises Cauchy stress [Pa] of one tet."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        tet = tet_index[item]
        body = tet_body[tet]
        p = law_parameters(youngs_in, nu_in, law_parameter_in, body_law_start, w, body)
        F = deformation(node_x_in, w, tet_node, tet_gradient, tet)
        density = energy_of(F, p)
        J = wp.determinant(F)
        if wp.static(own == 0):
            depth = wp.max(body_guard[body] - J, real(0.0))
            # int d (1 + growth min(d / J0, 1)^2): a fourth power up to J = 0, and a square with five times k beyond
            growth = real(wp.static(GUARD_GROWTH))
            inner = wp.min(depth, wp.max(body_guard[body], real(0.0)))
            relative = inner / body_guard[body]
            square = real(0.5) * inner * inner + real(0.25) * growth * relative * relative * inner * inner
            square += real(0.5) * (real(1.0) + growth) * (depth * depth - inner * inner)
            density += real(wp.static(GUARD)) * (p[1] + real(2.0) * p[0]) * square
        energy_out[w, tet] = tet_volume[tet] * density
        J = wp.max(J, real(wp.static(LEAST_J)))
        s = stress_of(F, p) * wp.transpose(F) * (real(1.0) / J)
        deviator = s - (wp.trace(s) / real(3.0)) * wp.identity(n=3, dtype=real)
        stress_out[w, tet] = wp.sqrt(real(1.5) * wp.ddot(deviator, deviator))

    return SimpleNamespace(evaluate=evaluate)
