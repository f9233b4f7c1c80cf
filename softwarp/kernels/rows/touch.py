"""Contacts at nodes of reduced bodies: their rows in modes. Theory: docs/theory/reduction.md.

Such a node has no unknown of its own. Where contacts name dofs, it has a number behind all of them; its entry of H is
spread over the modes of its body.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """Arrays as a struct, and functions of single worlds."""
    real = variant.real
    vec3 = wp.types.vector(3, real)

    @wp.struct
    class Touch:
        """Modes at the nodes that may touch something; arrays of ``ReductionModel``."""

        first: wp.array(dtype=wp.int32)
        begin: wp.array(dtype=wp.int32)
        end: wp.array(dtype=wp.int32)
        dof: wp.array(dtype=wp.int32)
        stride: wp.array(dtype=wp.int32)
        place: wp.array(dtype=wp.int32)
        basis: wp.array(dtype=real)

    @wp.func
    def first_dof(touch: Touch, size: int, dof: int):
        """A dof, or the first one of the body that a node belongs to; all others of the body are its ancestors."""
        result = dof
        if dof >= size:
            result = touch.first[dof - size]
        return result

    @wp.func
    def mode_row(touch: Touch, block: int, node: int, n: vec3):
        """Three entries of H at a block of modes for an entry ``n`` at a node."""
        at = touch.place[node] + 3 * (block - touch.begin[node])
        h = vec3()
        for r in range(3):
            for c in range(3):
                h[r] += touch.basis[at + c * touch.stride[node] + r] * n[c]
        return h

    return SimpleNamespace(Touch=Touch, first_dof=first_dof, mode_row=mode_row)
