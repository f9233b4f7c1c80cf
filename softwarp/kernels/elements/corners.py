"""Corners of linear tetrahedra on the elements of a variant. Theory: docs/theory/corotational.md."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """Edges, and constants that all worlds share."""
    S, real = variant.S, variant.real
    a = algebra(variant)
    rows, constant, subtract, read_vector = a.rows, a.constant, a.subtract, a.read_vector

    @wp.func
    def constants(values: wp.array2d(dtype=real), i: int):
        """Nine numbers that all worlds share, row by row."""
        return rows(constant(values, i, 0), constant(values, i, 3), constant(values, i, 6))

    @wp.func
    def edges(x: wp.array2d(dtype=S), w: int, tet_node: wp.array2d(dtype=wp.int32), tet: int):
        """Edges from corner 0 to the others, in rows."""
        origin = read_vector(x, w, 3 * tet_node[tet, 0])
        return rows(
            subtract(read_vector(x, w, 3 * tet_node[tet, 1]), origin),
            subtract(read_vector(x, w, 3 * tet_node[tet, 2]), origin),
            subtract(read_vector(x, w, 3 * tet_node[tet, 3]), origin),
        )

    return SimpleNamespace(constants=constants, edges=edges)
