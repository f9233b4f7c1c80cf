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
#
# K of a chunk is copied from the blocks that elements store, ``stored``, and scaled on the way; of worlds in lanes
# squares of eight numbers of eight worlds change places in registers. K that was put together before is read in place.
_SUM = """
#ifdef __AVX512F__
#define HIGH 8
#else
#define HIGH 4
#endif
#define LINES 24
#define KEPT(sample, e) (c.is_copied ? e : sample)
typedef REAL wide_t __attribute__((vector_size(64), aligned(4)));
struct Chunk {
    const REAL *p, *k_tet, *k_tri, *next, *end;
    const int *tet, *tri;
    int rows, tets, tris;
    bool is_copied;
    REAL* t;
};
struct Source {
    const REAL *k, *scale;
    const int* item;
    int each, size, at[81];
    static Source blocks(const REAL* k, const REAL* scale, const int* item, int size) {
        Source s = {k, scale, item, 90, size};
        for (int i = 0; i < size; ++i)
            for (int j = 0; j < size; ++j) {
                const int a = 1 + i / 3, b = 1 + j / 3, r = i % 3, c = j % 3;
                const int across = 9 * (b * (b + 1) / 2 + a) + 3 * c + r, down = 9 * (a * (a + 1) / 2 + b) + 3 * r + c;
                s.at[i * size + j] = a < b ? across : down;
            }
        return s;
    }
    static Source whole(const REAL* k, int size) {
        Source s = {k, nullptr, nullptr, size * size, size};
        for (int i = 0; i < size * size; ++i) s.at[i] = i;
        return s;
    }
};
struct Sum {
PARTS
    static void take(const Source& s, const int* list, int step, int count, int room, REAL* out) {
        typedef REAL lanes_t __attribute__((vector_size(LANES * sizeof(REAL)), aligned(4)));
        const int size = s.size * s.size;
        lanes_t scale;
        for (int lane = 0; lane < LANES; ++lane) scale[lane] = s.scale ? s.scale[lane] : 1;
        for (int e = 0; e < count; ++e, out += size) {
            const int item = list[step * e];
            const REAL* from = s.k + (long long)LANES * s.each * (s.item ? s.item[item] : item);
            if (LANES == 1) {
                for (int i = 0; i < size; ++i) out[i] = from[s.at[i]] * scale[0];
                continue;
            }
            for (int i = 0; i < size; i += 8) {
                const int first = i + 8 > size ? size - 8 : i;
                lanes_t x[LANES];
                for (int k = 0; k < LANES; ++k) {
                    __builtin_memcpy(x + k, from + LANES * s.at[first + k], sizeof(lanes_t));
                    x[k] *= scale;
                }
                TURN
                for (int k = 0; k < LANES; ++k) __builtin_memcpy(out + k * room + first, x + k, sizeof(lanes_t));
            }
        }
    }
};
const int width = 64 / sizeof(REAL), room = stride * stride;
const REAL* k_tet = (const REAL*)&wp::index(tet_stiffness, w, 0);
const REAL* k_tri = (const REAL*)&wp::index(tri_stiffness, w, 0);
const REAL* scale = (const REAL*)&wp::index(body_scale, w, body);
const Source tets_of = is_stored ? Source::blocks(k_tet, scale, tet_sample.data, 9) : Source::whole(k_tet, 9);
const Source tris_of = is_stored ? Source::blocks(k_tri, scale, tri_sample.data, 6) : Source::whole(k_tri, 6);
REAL* sum = (REAL*)&wp::index(sum_out, w, sum_first);
Chunk c;
c.t = (REAL*)&wp::index(strip_out, w, 0);
REAL* own = c.t + (ROWS + 3) * 2 * width;
REAL* whole = LANES == 1 ? sum : own + LANES * kept;
c.is_copied = LANES > 1 || is_stored;
for (int i = 0; i < LANES * room; ++i) whole[i] = 0;
for (int chunk = begin; chunk < end; ++chunk) {
    const int *tets = chunk_tets.data + chunk, *tris = chunk_tris.data + chunk;
    c.tet = tet_list.data + 5 * tets[0], c.tets = tets[1] - tets[0];
    c.tri = tri_list.data + 4 * tris[0], c.tris = tris[1] - tris[0];
    c.p = basis.data + chunk_basis.data[chunk], c.rows = chunk_rows.data[chunk];
    c.next = c.p + (c.rows + 3) * stride;
    c.end = chunk + 1 < end ? c.next + (chunk_rows.data[chunk + 1] + 3) * stride : c.next;
    c.k_tet = k_tet, c.k_tri = k_tri;
    if (c.is_copied) {
        Sum::take(tets_of, c.tet, 5, c.tets, kept, own);
        Sum::take(tris_of, c.tri, 4, c.tris, kept, own + 81 * c.tets);
    }
    for (int lane = 0; lane < LANES; ++lane) {
        if (c.is_copied) c.k_tet = own + lane * kept, c.k_tri = c.k_tet + 81 * c.tets;
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
# Rows of eight numbers become columns.
_TURN = """
                lanes_t y[8];
                for (int k = 0; k < 8; k += 2) {
                    y[k] = __builtin_shufflevector(x[k], x[k + 1], 0, 8, 2, 10, 4, 12, 6, 14);
                    y[k + 1] = __builtin_shufflevector(x[k], x[k + 1], 1, 9, 3, 11, 5, 13, 7, 15);
                }
                for (int k = 0; k < 8; k += 4)
                    for (int m = k; m < k + 2; ++m) {
                        x[m] = __builtin_shufflevector(y[m], y[m + 2], 0, 1, 8, 9, 4, 5, 12, 13);
                        x[m + 2] = __builtin_shufflevector(y[m], y[m + 2], 2, 3, 10, 11, 6, 7, 14, 15);
                    }
                for (int k = 0; k < 4; ++k) {
                    y[k] = __builtin_shufflevector(x[k], x[k + 4], 0, 1, 2, 3, 8, 9, 10, 11);
                    y[k + 4] = __builtin_shufflevector(x[k], x[k + 4], 4, 5, 6, 7, 12, 13, 14, 15);
                }
                for (int k = 0; k < 8; ++k) x[k] = y[k];
"""


def _source(real: str, lanes: int) -> str:
    """C++ of the sum."""
    sides, kinds = ("1", "2"), ("4", "3")
    parts = [_ELEMENT.replace("CORNERS", kind).replace("SIDE", side) for kind in kinds for side in sides]
    parts += [part.replace("SIDE", side) for part in (_TILE, _COLUMNS) for side in sides]
    code = _SUM.replace("PARTS", "".join(parts)).replace("TURN", _TURN if lanes > 1 else "").replace("REAL", real)
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
        is_stored: bool,
        tet_sample: wp.array(dtype=wp.int32),
        tri_sample: wp.array(dtype=wp.int32),
        tet_stiffness: wp.array2d(dtype=S),
        tri_stiffness: wp.array2d(dtype=S),
        body_scale: wp.array2d(dtype=S),
        w: int,
        body: int,
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
        is_stored: bool,
        # Model
        body_number: wp.array(dtype=wp.int32),
        tet_sample: wp.array(dtype=wp.int32),
        tri_sample: wp.array(dtype=wp.int32),
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
        body_stiffness_scale_in: wp.array2d(dtype=S),
        # Workspace out
        strip_out: wp.array2d(dtype=S),
        sum_out: wp.array2d(dtype=S),
    ):
        """Lower triangles of the stiffness of all reduced bodies in modes.

        Elements' own is as they store it, in blocks, which a body's factor scales here; or of samples, put together.
        """
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
                is_stored,
                tet_sample,
                tri_sample,
                tet_stiffness_in,
                tri_stiffness_in,
                body_stiffness_scale_in,
                w,
                body_number[body],
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
