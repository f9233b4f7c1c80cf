"""Cauchy stress and Green-Lagrange strain of tetrahedra. Laws, symbols and checks: docs/theory/hyperelastic.md.

With the stress P = d psi / d F the Cauchy stress is s = P F' / J, and E = (F'F - 1) / 2. No step does this.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
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
    vec3 = wp.types.vector(3, real)
    mat33 = wp.types.matrix((3, 3), real)
    stress_of, own = LAWS[law].stress, LAWS[law].own
    vector = wp.types.vector(LAWS[law].count, real)

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
        one = real(1.0)
        p = vector()
        if wp.static(own == 0):
            two = real(2.0)
            nu = nu_in[w, body]
            p[0] = youngs_in[w, body] / (two * (one + nu))
            p[1] = two * p[0] * nu / (one - two * nu)
        else:
            for i in range(own):
                p[i] = law_parameter_in[w, body_law_start[body] + i]
        a = tet_node[tet, 0] * 3
        F = mat33()
        for b in range(3):
            n = tet_node[tet, b + 1] * 3
            edge = vec3()
            for c in range(3):
                edge[c] = node_x_in[w, n + c] - node_x_in[w, a + c]
            g = vec3(tet_gradient[tet, 3 * b], tet_gradient[tet, 3 * b + 1], tet_gradient[tet, 3 * b + 2])
            F += wp.outer(edge, g)
        J = wp.max(wp.determinant(F), real(wp.static(LEAST_J)))
        s = stress_of(F, p) * wp.transpose(F) * (one / J)
        E = real(0.5) * (wp.transpose(F) * F - wp.identity(n=3, dtype=real))
        for i in range(3):
            for j in range(3):
                stress_out[w, 9 * tet + 3 * i + j] = real(0.5) * (s[i, j] + s[j, i])
                strain_out[w, 9 * tet + 3 * i + j] = E[i, j]

    return SimpleNamespace(evaluate=evaluate)
