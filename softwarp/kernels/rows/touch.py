"""Contacts at nodes of reduced bodies: their rows in modes. Theory: docs/theory/reduction.md.

Such a node has no unknown of its own. Where contacts name dofs, it has a number behind all of them; its entry of H is
spread over the modes of its body.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """Arrays as a struct, and functions of single worlds."""
    real = variant.real
    one = single.functions(variant)
    vec3, vector_at = one.vec3, one.vector_at

    @wp.struct
    class Touch:
        """Modes at the nodes that may touch something; arrays of ``ReductionModel``.

        From ``floating`` on of bodies with a floating frame: body of a node or -1, radius of gyration; R and the arms
        of touching nodes, which the state changes.
        """

        first: wp.array(dtype=wp.int32)
        begin: wp.array(dtype=wp.int32)
        end: wp.array(dtype=wp.int32)
        dof: wp.array(dtype=wp.int32)
        stride: wp.array(dtype=wp.int32)
        place: wp.array(dtype=wp.int32)
        basis: wp.array(dtype=real)
        floating: wp.array(dtype=wp.int32)
        radius: wp.array(dtype=real)
        axes: wp.array3d(dtype=real)
        arm: wp.array3d(dtype=real)

    @wp.func
    def first_dof(touch: Touch, size: int, dof: int):
        """A dof, or the first one of the body that a node belongs to; all others of the body are its ancestors."""
        result = dof
        if dof >= size:
            result = touch.first[dof - size]
        return result

    @wp.func
    def own_axes(touch: Touch, node: int, n_world: vec3, pack: int, lane: int):
        """An entry of H at a node in the axes of its body's modes."""
        n = n_world
        f = touch.floating[node]
        if f >= 0:
            for c in range(3):
                axis = vec3(
                    touch.axes[pack, 9 * f + c, lane],
                    touch.axes[pack, 9 * f + 3 + c, lane],
                    touch.axes[pack, 9 * f + 6 + c, lane],
                )
                n[c] = wp.dot(axis, n_world)
        return n

    @wp.func
    def mode_row(touch: Touch, block: int, node: int, n_world: vec3, n: vec3, pack: int, lane: int):
        """Three entries of H at a block of modes for an entry at a node, in the world's axes and ``own_axes``."""
        f = touch.floating[node]
        if f >= 0:
            if block == touch.begin[node]:
                return n_world
            if block == touch.begin[node] + 1:
                return wp.cross(vector_at(touch.arm, pack, lane, 3 * node), n_world) / touch.radius[f]
        at = touch.place[node] + 3 * (block - touch.begin[node])
        h = vec3()
        for r in range(3):
            for c in range(3):
                h[r] += touch.basis[at + c * touch.stride[node] + r] * n[c]
        return h

    return SimpleNamespace(Touch=Touch, first_dof=first_dof, own_axes=own_axes, mode_row=mode_row)
