"""Cauchy stress and Green-Lagrange strain of tetrahedra. Laws, symbols and checks: docs/theory/hyperelastic.md.

With the stress P = d psi / d F the Cauchy stress is s = P F' / J, and E = (F'F - 1) / 2. No step does this.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.elements import strain
from softwarp.kernels.elements.energy import LEAST_J
from softwarp.kernels.elements.laws import LAWS


@single_worlds
def kernels(variant: Variant, law: str) -> SimpleNamespace:
    """Kernels of one law for one scalar type, one world per element of an array.

    Args:
        variant: Scalar type and memory order, ``scalar`` or ``cuda``.
        law: One of ``laws.LAWS``.
    """
    real = variant.real
    world_fastest = variant.world_fastest
    module = variant.module(f"tensors.{law}")
    stress_of = LAWS[law].stress
    f = strain.functions(variant, law)
    law_parameters, deformation = f.law_parameters, f.deformation

    @wp.kernel(module=module, enable_backward=False)
    def evaluate(
        # Model
        tet_index: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        body_law_start: wp.array(dtype=wp.int32),
        # State
        youngs_in: wp.array2d(dtype=real),
        nu_in: wp.array2d(dtype=real),
        law_parameter_in: wp.array2d(dtype=real),
        node_x_in: wp.array2d(dtype=real),
        # Workspace out
        stress_out: wp.array2d(dtype=real),
        strain_out: wp.array2d(dtype=real),
    ):
        """Cauchy stress [Pa] and Green-Lagrange strain of one tet, by rows."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        tet = tet_index[item]
        body = tet_body[tet]
        p = law_parameters(youngs_in, nu_in, law_parameter_in, body_law_start, w, body)
        F = deformation(node_x_in, w, tet_node, tet_gradient, tet)
        J = wp.max(wp.determinant(F), real(wp.static(LEAST_J)))
        s = stress_of(F, p) * wp.transpose(F) * (real(1.0) / J)
        E = real(0.5) * (wp.transpose(F) * F - wp.identity(n=3, dtype=real))
        for i in range(3):
            for j in range(3):
                stress_out[w, 9 * tet + 3 * i + j] = real(0.5) * (s[i, j] + s[j, i])
                strain_out[w, 9 * tet + 3 * i + j] = E[i, j]

    return SimpleNamespace(evaluate=evaluate)
