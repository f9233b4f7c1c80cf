"""What a kernel of linear tetrahedra reads and writes, one or eight at a time. Theory: docs/theory/hyperelastic.md.

Elements are computed with the variant ``inner``, on a CPU in float32 always ``lanes``: eight worlds of one tet, or
eight tets of one world, which ``bundle`` gathers and scatters. An *item* of a list is one tet, or eight. Laws are
evaluated lane by lane.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.algebra import bundle, lanes
from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra
from softwarp.kernels.algebra.wide import is_wide
from softwarp.kernels.elements import corners

STORED_ROWS = 90  # of an element: ten blocks K_ab, a >= b
CORNER_ROWS = 12  # a vector of each corner


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """Access of one variant."""
    bundled = is_wide(variant)
    inner = lanes.variant("lanes") if bundled else variant
    S, T, real = variant.S, inner.S, variant.real
    world_fastest, is_packed = variant.world_fastest, variant.lanes > 1
    a, tet = algebra(inner), corners.functions(inner)
    Vector, Matrix, vector, rows = a.Vector, a.Matrix, a.vector, a.rows

    if inner.lanes > 1:

        @wp.func
        def entry(table: Any, row: int):
            """One row of a table of all lanes."""
            return table[row]

        @wp.func
        def of_lane(value: T, lane: int):
            return value[lane]

    else:

        @wp.func
        def entry(table: Any, row: int):
            return table[row, 0]

        @wp.func
        def of_lane(value: T, lane: int):
            return value

    if bundled:
        nine, member = bundle.nine, bundle.member

        @wp.func
        def matrix(m: nine):
            return rows(vector(m[0], m[1], m[2]), vector(m[3], m[4], m[5]), vector(m[6], m[7], m[8]))

        @wp.func
        def edges(
            x: wp.array2d(dtype=S),
            w: int,
            tet_node: wp.array2d(dtype=wp.int32),
            index: wp.array(dtype=wp.int32),
            i: int,
        ):
            """Edges from corner 0 to the others, in rows."""
            return matrix(bundle.edges(x, w, tet_node, index, i))

        @wp.func
        def gradients(tet_gradient: wp.array2d(dtype=real), index: wp.array(dtype=wp.int32), i: int):
            """Gradients of the shape functions 1 to 3, in rows."""
            return matrix(bundle.constants(tet_gradient, index, i))

        @wp.func
        def write_block(
            stiffness: wp.array2d(dtype=S), w: int, index: wp.array(dtype=wp.int32), i: int, row: int, m: Matrix
        ):
            k = wp.matrix_from_rows(m.xx, m.xy, m.xz, m.yx, m.yy, m.yz, m.zx, m.zy, m.zz)
            bundle.scatter(stiffness, w, index, i, wp.static(STORED_ROWS), row, k)

        @wp.func
        def add_block(
            A: wp.array2d(dtype=S),
            w: int,
            index: wp.array(dtype=wp.int32),
            i: int,
            tet_block: wp.array2d(dtype=wp.int32),
            pair: int,
            m: Matrix,
        ):
            """Add to the block of A of one pair of corners, unless one is fixed."""
            k = wp.matrix_from_rows(m.xx, m.xy, m.xz, m.yx, m.yy, m.yz, m.zx, m.zy, m.zz)
            bundle.add_blocks(A, w, index, i, tet_block, pair, k)

        @wp.func
        def of_tet(values: wp.array(dtype=real), index: wp.array(dtype=wp.int32), i: int):
            """A number of every tet that all worlds share."""
            return bundle.numbers(values, index, i)

        @wp.func
        def of_scene(
            values: wp.array(dtype=real), tet_body: wp.array(dtype=wp.int32), index: wp.array(dtype=wp.int32), i: int
        ):
            """A number of every tet's body that all worlds share."""
            return bundle.owners_numbers(values, tet_body, index, i)

        @wp.func
        def of_body(
            values: wp.array2d(dtype=S),
            w: int,
            tet_body: wp.array(dtype=wp.int32),
            index: wp.array(dtype=wp.int32),
            i: int,
        ):
            """A number of every tet's body."""
            return bundle.owners_rows(values, w, tet_body, index, i)

        @wp.func
        def write_corner(
            out: wp.array2d(dtype=S), w: int, index: wp.array(dtype=wp.int32), i: int, row: int, f: Vector
        ):
            bundle.scatter_vector(out, w, index, i, wp.static(CORNER_ROWS), row, wp.matrix_from_rows(f.x, f.y, f.z))

        @wp.func
        def write_corners(
            out: wp.array2d(dtype=S),
            w: int,
            index: wp.array(dtype=wp.int32),
            i: int,
            b: Vector,
            c: Vector,
            d: Vector,
        ):
            """Vectors of corners 1 to 3; that of corner 0 balances them."""
            k = wp.matrix_from_rows(b.x, b.y, b.z, c.x, c.y, c.z, d.x, d.y, d.z)
            bundle.scatter_corners(out, w, index, i, k)

        @wp.func
        def all_edges(x: wp.array2d(dtype=S), w: int, tet_node: wp.array2d(dtype=wp.int32), i: int):
            """The same of all tets in their order, as ``all_numbers``."""
            return matrix(bundle.all_edges(x, w, tet_node, i))

        all_numbers = bundle.all_numbers

        @wp.func
        def largest(value: T):
            """The largest number of what a thread holds of one world."""
            return wp.max(value)

    else:

        @wp.func
        def member(index: wp.array(dtype=wp.int32), i: int, lane: int):
            """The tet of one lane."""
            return index[i]

        @wp.func
        def edges(
            x: wp.array2d(dtype=S),
            w: int,
            tet_node: wp.array2d(dtype=wp.int32),
            index: wp.array(dtype=wp.int32),
            i: int,
        ):
            return tet.edges(x, w, tet_node, index[i])

        @wp.func
        def gradients(tet_gradient: wp.array2d(dtype=real), index: wp.array(dtype=wp.int32), i: int):
            return tet.constants(tet_gradient, index[i])

        @wp.func
        def write_block(
            stiffness: wp.array2d(dtype=S), w: int, index: wp.array(dtype=wp.int32), i: int, row: int, m: Matrix
        ):
            a.write_matrix(stiffness, w, wp.static(STORED_ROWS) * index[i] + row, m)

        @wp.func
        def add_block(
            A: wp.array2d(dtype=S),
            w: int,
            index: wp.array(dtype=wp.int32),
            i: int,
            tet_block: wp.array2d(dtype=wp.int32),
            pair: int,
            m: Matrix,
        ):
            code = tet_block[index[i], pair]
            if code >= 0:
                if code % 2 == 1:
                    m = a.transposed(m)
                a.add_matrix(A, w, 9 * (code / 2), m)

        @wp.func
        def of_body(
            values: wp.array2d(dtype=S),
            w: int,
            tet_body: wp.array(dtype=wp.int32),
            index: wp.array(dtype=wp.int32),
            i: int,
        ):
            return values[w, tet_body[index[i]]]

        @wp.func
        def of_tet(values: wp.array(dtype=real), index: wp.array(dtype=wp.int32), i: int):
            return S(values[index[i]])

        @wp.func
        def of_scene(
            values: wp.array(dtype=real), tet_body: wp.array(dtype=wp.int32), index: wp.array(dtype=wp.int32), i: int
        ):
            return S(values[tet_body[index[i]]])

        @wp.func
        def write_corner(
            out: wp.array2d(dtype=S), w: int, index: wp.array(dtype=wp.int32), i: int, row: int, f: Vector
        ):
            a.write_vector(out, w, wp.static(CORNER_ROWS) * index[i] + row, f)

        @wp.func
        def write_corners(
            out: wp.array2d(dtype=S),
            w: int,
            index: wp.array(dtype=wp.int32),
            i: int,
            b: Vector,
            c: Vector,
            d: Vector,
        ):
            total = a.add(a.add(b, c), d)
            write_corner(out, w, index, i, 0, vector(-total.x, -total.y, -total.z))
            write_corner(out, w, index, i, 3, b)
            write_corner(out, w, index, i, 6, c)
            write_corner(out, w, index, i, 9, d)

        all_edges = tet.edges

        @wp.func
        def all_numbers(values: wp.array(dtype=real), i: int):
            return S(values[i])

        @wp.func
        def largest(value: S):
            return value

    @wp.func
    def place_of(w: int, lane: int):
        """Pack and lane of a world in arrays of single worlds."""
        pack = int(w)
        place = int(0)
        if wp.static(world_fastest):
            pack = 0
            place = w
        elif wp.static(is_packed):
            place = lane
        return pack, place

    return SimpleNamespace(
        inner=inner,
        per_item=inner.lanes // variant.lanes,
        entry=entry,
        of_lane=of_lane,
        member=member,
        edges=edges,
        gradients=gradients,
        write_block=write_block,
        add_block=add_block,
        of_body=of_body,
        of_tet=of_tet,
        of_scene=of_scene,
        all_edges=all_edges,
        all_numbers=all_numbers,
        largest=largest,
        write_corner=write_corner,
        write_corners=write_corners,
        place_of=place_of,
    )
