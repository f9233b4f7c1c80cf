"""Stiffness of reduced bodies in modes on a CPU, by the nodes that elements share. Theory: docs/theory/reduction.md.

An element's rows E are differences of modes at its corners. Elements that share nodes lie in patches, whose modes P at
all nodes are counted against one of them: then the sum of ``E' K E`` is ``P' T``, where T gathers at the nodes of a
patch what the forces ``K E`` of its elements are. A node that many elements share has three rows there, instead of
three for each of them. Some patches are a chunk, whose P and T stay in cache; registers run along the modes.
"""

from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.model.codes import CHUNK_ROWS

# K E of one element added to T, SIDE registers of modes, which read every number of K once. A row of T has two.
_ELEMENT = """
    static inline __attribute__((always_inline, min_vector_width(512))) void element_CORNERS_SIDE(
        const REAL* own, const REAL* p, const int* row, int stride, REAL* t
    ) {
        #pragma clang fp contract(fast)
        const int width = 64 / sizeof(REAL), size = 3 * (CORNERS - 1);
        wide_t s[size][SIDE] = {}, first[3][SIDE], x[SIDE], y[SIDE];
        for (int c = 0; c < 3; ++c) __builtin_memcpy(first[c], p + (3 * row[0] + c) * stride, sizeof(x));
        for (int a = 0; a < size; ++a) {
            __builtin_memcpy(x, p + (3 * row[1 + a / 3] + a % 3) * stride, sizeof(x));
            for (int m = 0; m < SIDE; ++m) x[m] -= first[a % 3][m];
            for (int i = 0; i < size; ++i)
                for (int m = 0; m < SIDE; ++m) s[i][m] += own[i * size + a] * x[m];
        }
        #pragma clang loop unroll(full)
        for (int c = 0; c < 3; ++c) {
            REAL* out = t + (3 * row[0] + c) * 2 * width;
            __builtin_memcpy(y, out, sizeof(y));
            #pragma clang loop unroll(full)
            for (int i = c; i < size; i += 3)
                for (int m = 0; m < SIDE; ++m) y[m] -= s[i][m];
            __builtin_memcpy(out, y, sizeof(y));
        }
        #pragma clang loop unroll(full)
        for (int i = 0; i < size; ++i) {
            REAL* out = t + (3 * row[1 + i / 3] + i % 3) * 2 * width;
            __builtin_memcpy(y, out, sizeof(y));
            for (int m = 0; m < SIDE; ++m) y[m] += s[i][m];
            __builtin_memcpy(out, y, sizeof(y));
        }
    }
"""
# A tile of P' T added to the sum.
_TILE = """
    static inline __attribute__((always_inline, min_vector_width(512))) void tile_SIDE(
        const REAL* p, const REAL* t, int rows, int stride, REAL* out
    ) {
        #pragma clang fp contract(fast)
        const int width = 64 / sizeof(REAL);
        wide_t x[SIDE], y[HIGH][SIDE];
        for (int r = 0; r < HIGH; ++r) __builtin_memcpy(y[r], out + r * stride, sizeof(x));
        for (int k = 0; k < rows; ++k, p += stride, t += 2 * width) {
            __builtin_memcpy(x, t, sizeof(x));
            for (int r = 0; r < HIGH; ++r)
                for (int m = 0; m < SIDE; ++m) y[r][m] += p[r] * x[m];
        }
        for (int r = 0; r < HIGH; ++r) __builtin_memcpy(out + r * stride, y[r], sizeof(x));
    }
"""
# What a chunk adds to the sum, SIDE registers of its columns: T of them, then tiles. Meanwhile P of the next chunk
# comes nearer.
_COLUMNS = """
    static __attribute__((min_vector_width(512))) void columns_SIDE(Chunk& c, int j, int stride, int count, REAL* out) {
        const int width = 64 / sizeof(REAL);
        for (int i = 0; i < (c.rows + 3) * 2 * width; ++i) c.t[i] = 0;
        const REAL* p = c.p + j;
        for (int e = 0; e < c.tets; ++e)
            element_4_SIDE(c.k_tet + 81 * KEPT(c.tet[5 * e], e), p, c.tet + 5 * e + 1, stride, c.t);
        for (int e = 0; e < c.tris; ++e)
            element_3_SIDE(c.k_tri + 36 * KEPT(c.tri[4 * e], e), p, c.tri + 4 * e + 1, stride, c.t);
        for (int i = j; i < count; i += HIGH) {
            for (int k = 0; k < LINES && c.next < c.end; ++k, c.next += width) __builtin_prefetch(c.next, 0, 2);
            if (i < j + width) tile_1(c.p + i, c.t, c.rows, stride, out + i * stride + j);
            else tile_SIDE(c.p + i, c.t, c.rows, stride, out + i * stride + j);
        }
    }
"""
# Of one world at a time: with a world in every lane each product would read its number of P anew, so that their K are
# taken apart. Tiles of the sum, some modes by two registers, stay in registers; those on its diagonal by one. A
# register of 64 bytes is asked for, as compilers halve it on processors that have it, and a product fused with its
# sum. Sixteen sums are under way where there are 32 registers, else four of two registers each. Strides are multiples
# of 16 numbers, so that what a register holds more than ``count`` stays within a row.
_SUM = """
#ifdef __AVX512F__
#define HIGH 8
#else
#define HIGH 4
#endif
#define LINES 24
#define KEPT(sample, e) (LANES > 1 ? e : sample)
typedef REAL wide_t __attribute__((vector_size(64), aligned(4)));
struct Chunk {
    const REAL *p, *k_tet, *k_tri, *next, *end;
    const int *tet, *tri;
    int rows, tets, tris;
    REAL* t;
};
struct Sum {
PARTS
    static void take(const REAL* k, const int* list, int step, int size, int count, int lane, REAL* out) {
        for (int e = 0; e < count; ++e, out += size) {
            const REAL* from = k + (long long)LANES * size * list[step * e] + lane;
            for (int i = 0; i < size; ++i) out[i] = from[LANES * i];
        }
    }
};
const int width = 64 / sizeof(REAL), room = stride * stride;
const REAL* k_tet = (const REAL*)&wp::index(tet_stiffness, w, 0);
const REAL* k_tri = (const REAL*)&wp::index(tri_stiffness, w, 0);
REAL* sum = (REAL*)&wp::index(sum_out, w, sum_first);
Chunk c;
c.t = (REAL*)&wp::index(strip_out, w, 0);
REAL* own = c.t + (ROWS + 3) * 2 * width;
REAL* whole = LANES == 1 ? sum : own + kept;
for (int i = 0; i < LANES * room; ++i) whole[i] = 0;
for (int chunk = begin; chunk < end; ++chunk) {
    const int *tets = chunk_tets.data + chunk, *tris = chunk_tris.data + chunk;
    c.tet = tet_list.data + 5 * tets[0], c.tets = tets[1] - tets[0];
    c.tri = tri_list.data + 4 * tris[0], c.tris = tris[1] - tris[0];
    c.p = basis.data + chunk_basis.data[chunk], c.rows = chunk_rows.data[chunk];
    c.next = c.p + (c.rows + 3) * stride;
    c.end = chunk + 1 < end ? c.next + (chunk_rows.data[chunk + 1] + 3) * stride : c.next;
    c.k_tet = k_tet, c.k_tri = k_tri;
    for (int lane = 0; lane < LANES; ++lane) {
        if (LANES > 1) {
            c.k_tet = own, c.k_tri = own + 81 * c.tets;
            Sum::take(k_tet, c.tet, 5, 81, c.tets, lane, own);
            Sum::take(k_tri, c.tri, 4, 36, c.tris, lane, own + 81 * c.tets);
        }
        for (int j = 0; j < count; j += 2 * width)
            if (HIGH == 8 && j + width < count) Sum::columns_2(c, j, stride, count, whole + lane * room);
            else for (int i = j; i < count && i < j + 2 * width; i += width)
                Sum::columns_1(c, i, stride, count, whole + lane * room);
    }
}
for (int i = 0; LANES > 1 && i < room; ++i)
    for (int lane = 0; lane < LANES; ++lane) sum[LANES * i + lane] = whole[lane * room + i];
#undef HIGH
#undef LINES
#undef KEPT
"""


def _source(real: str, lanes: int) -> str:
    """C++ of the sum."""
    sides, kinds = ("1", "2"), ("4", "3")
    parts = [_ELEMENT.replace("CORNERS", kind).replace("SIDE", side) for kind in kinds for side in sides]
    parts += [part.replace("SIDE", side) for part in (_TILE, _COLUMNS) for side in sides]
    code = _SUM.replace("PARTS", "".join(parts)).replace("REAL", real)
    return code.replace("ROWS", str(CHUNK_ROWS)).replace("LANES", str(lanes))


def mode_stiffness(variant: Variant) -> Any:
    """Kernel that sums it up, one thread for a world or a pack."""
    S, real = variant.S, variant.real
    module = variant.module("patches")

    @wp.func_native(_source("double" if real is wp.float64 else "float", variant.lanes))
    def sum_up(
        chunk_rows: wp.array(dtype=wp.int32),
        chunk_basis: wp.array(dtype=wp.int32),
        chunk_tets: wp.array(dtype=wp.int32),
        chunk_tris: wp.array(dtype=wp.int32),
        tet_list: wp.array(dtype=wp.int32),
        tri_list: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=real),
        tet_stiffness: wp.array2d(dtype=S),
        tri_stiffness: wp.array2d(dtype=S),
        w: int,
        begin: int,
        end: int,
        kept: int,
        stride: int,
        count: int,
        strip_out: wp.array2d(dtype=S),
        sum_out: wp.array2d(dtype=S),
        sum_first: int,
    ):
        """Lower triangle of the sum of all chunks of a body."""

    @wp.kernel(module=module, enable_backward=False)
    def mode_stiffness(
        kept: int,
        # Model
        body_modes: wp.array(dtype=wp.int32),
        body_stride: wp.array(dtype=wp.int32),
        body_chunk: wp.array(dtype=wp.int32),
        chunk_rows: wp.array(dtype=wp.int32),
        chunk_basis: wp.array(dtype=wp.int32),
        chunk_tets: wp.array(dtype=wp.int32),
        chunk_tris: wp.array(dtype=wp.int32),
        tet_list: wp.array(dtype=wp.int32),
        tri_list: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=real),
        # Workspace in
        tet_stiffness_in: wp.array2d(dtype=S),
        tri_stiffness_in: wp.array2d(dtype=S),
        # Workspace out
        strip_out: wp.array2d(dtype=S),
        sum_out: wp.array2d(dtype=S),
    ):
        """Lower triangles of the stiffness of all reduced bodies in modes."""
        w = wp.tid()
        first = int(0)
        for body in range(body_modes.shape[0]):
            stride = body_stride[body]
            sum_up(
                chunk_rows,
                chunk_basis,
                chunk_tets,
                chunk_tris,
                tet_list,
                tri_list,
                basis,
                tet_stiffness_in,
                tri_stiffness_in,
                w,
                body_chunk[body],
                body_chunk[body + 1],
                kept,
                stride,
                body_modes[body],
                strip_out,
                sum_out,
                first,
            )
            first += stride * stride

    return mode_stiffness
