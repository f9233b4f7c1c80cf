"""Deformation gradient and law parameters of a tetrahedron, world by world, where what is told is no part of a step."""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.elements.laws import LAWS


@single_worlds
def functions(variant: Variant, law: str) -> SimpleNamespace:
    """Functions of one law for one scalar type.

    Args:
        variant: Scalar type, ``scalar`` or ``cuda``.
        law: One of ``laws.LAWS``.
    """
    real = variant.real
    vec3 = wp.types.vector(3, real)
    mat33 = wp.types.matrix((3, 3), real)
    own = LAWS[law].own
    vector = wp.types.vector(LAWS[law].count, real)

    @wp.func
    def law_parameters(
        youngs: wp.array2d(dtype=real),
        nu: wp.array2d(dtype=real),
        own_parameters: wp.array2d(dtype=real),
        body_law_start: wp.array(dtype=wp.int32),
        w: int,
        body: int,
    ):
        """The law's own, or Lame's constants (mu, lam)."""
        p = vector()
        if wp.static(own == 0):
            two = real(2.0)
            ratio = nu[w, body]
            p[0] = youngs[w, body] / (two * (real(1.0) + ratio))
            p[1] = two * p[0] * ratio / (real(1.0) - two * ratio)
        else:
            for i in range(own):
                p[i] = own_parameters[w, body_law_start[body] + i]
        return p

    @wp.func
    def deformation(
        x: wp.array2d(dtype=real),
        w: int,
        tet_node: wp.array2d(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet: int,
    ):
        """F, from the edges and the gradients of the corners at rest."""
        a = tet_node[tet, 0] * 3
        F = mat33()
        for b in range(3):
            n = tet_node[tet, b + 1] * 3
            edge = vec3()
            for c in range(3):
                edge[c] = x[w, n + c] - x[w, a + c]
            g = vec3(tet_gradient[tet, 3 * b], tet_gradient[tet, 3 * b + 1], tet_gradient[tet, 3 * b + 2])
            F += wp.outer(edge, g)
        return F

    return SimpleNamespace(law_parameters=law_parameters, deformation=deformation)
