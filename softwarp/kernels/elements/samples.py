"""Stiffness of reduced bodies in modes: elements that count, projected. Theory: docs/theory/reduction.md.

A sample is an element with its weight in its volume. Forces of an element only depend on where its later corners are
against the first one, so that its stiffness K, 9 x 9 or of a triangle 6 x 6, acts on rows E of as many displacements in
every mode, and the body's stiffness in modes is the sum of ``E' K E``. On a CPU ``patches`` sums it up by nodes.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra
from softwarp.kernels.elements import corotational, patches, stored

TET, TRI = 9, 6  # rows of E
TILE = 8  # modes that a thread of a GPU holds; strides are multiples of it


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type."""
    S = variant.S
    world_fastest = variant.world_fastest
    module = variant.module("samples")
    a = algebra(variant)
    Matrix, read_vector, scaled, outer = a.Matrix, a.read_vector, a.scaled, a.outer
    row_x, row_y, row_z = a.row_x, a.row_y, a.row_z
    read_block = stored.functions(variant).read_block
    isotropic = corotational.kernels(variant).isotropic

    @wp.func
    def put(out: wp.array2d(dtype=S), w: int, row: int, size: int, m: Matrix, scale: S):
        """Write a 3x3 block into a matrix with rows of ``size`` entries."""
        x = scaled(row_x(m), scale)
        y = scaled(row_y(m), scale)
        z = scaled(row_z(m), scale)
        out[w, row] = x.x
        out[w, row + 1] = x.y
        out[w, row + 2] = x.z
        out[w, row + size] = y.x
        out[w, row + size + 1] = y.y
        out[w, row + size + 2] = y.z
        out[w, row + 2 * size] = z.x
        out[w, row + 2 * size + 1] = z.y
        out[w, row + 2 * size + 2] = z.z

    @wp.kernel(module=module, enable_backward=False)
    def tet_stiffness(
        # Model
        tet_sample: wp.array(dtype=wp.int32),
        tet_turned: wp.array(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        # Workspace in
        body_mu_in: wp.array2d(dtype=S),
        body_lam_in: wp.array2d(dtype=S),
        body_stiffness_scale_in: wp.array2d(dtype=S),
        tet_gradient_in: wp.array2d(dtype=S),
        tet_stiffness_in: wp.array2d(dtype=S),
        # Workspace out
        stiffness_out: wp.array2d(dtype=S),
    ):
        """k_scale K of one tet, 9 x 9, from turned gradients or from stored blocks."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        tet = tet_sample[item]
        body = tet_body[tet]
        scale = body_stiffness_scale_in[w, body]
        for i in range(1, 4):
            for j in range(1, 4):
                row = wp.static(TET * TET) * item + 3 * (wp.static(TET) * (i - 1) + j - 1)
                m = Matrix()
                if tet_turned[item] != 0:
                    g = read_vector(tet_gradient_in, w, wp.static(corotational.TURNED_ROWS) * tet + 3 * i)
                    h = read_vector(tet_gradient_in, w, wp.static(corotational.TURNED_ROWS) * tet + 3 * j)
                    m = isotropic(outer(g, h), body_mu_in[w, body], body_lam_in[w, body])
                else:
                    m = read_block(tet_stiffness_in, w, 16 * tet + 4 * i + j)
                put(stiffness_out, w, row, wp.static(TET), m, scale)

    @wp.kernel(module=module, enable_backward=False)
    def tri_stiffness(
        # Model
        tri_sample: wp.array(dtype=wp.int32),
        element_body: wp.array(dtype=wp.int32),
        # Workspace in
        body_stiffness_scale_in: wp.array2d(dtype=S),
        membrane_stiffness_in: wp.array2d(dtype=S),
        # Workspace out
        stiffness_out: wp.array2d(dtype=S),
    ):
        """k_scale K of one membrane triangle, 6 x 6."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        tri = tri_sample[item]
        scale = body_stiffness_scale_in[w, element_body[tri]]
        for i in range(1, 3):
            for j in range(1, 3):
                row = wp.static(TRI * TRI) * item + 3 * (wp.static(TRI) * (i - 1) + j - 1)
                m = read_block(membrane_stiffness_in, w, 16 * tri + 4 * i + j)
                put(stiffness_out, w, row, wp.static(TRI), m, scale)

    result = SimpleNamespace(tet_stiffness=tet_stiffness, tri_stiffness=tri_stiffness)
    if world_fastest:
        return SimpleNamespace(**vars(result), **vars(_gathered(variant)))
    return SimpleNamespace(**vars(result), mode_stiffness=patches.mode_stiffness(variant))


@cache
def _gathered(variant: Variant) -> SimpleNamespace:
    """Kernels of a GPU: one thread for a tile of modes of a sample, then one for a tile of the sum.

    Registers hold a tile, so that what lies in memory is read once for ``TILE`` modes.
    """
    half_tet, half_tri = (_half_product(variant, size) for size in (TET, TRI))
    return SimpleNamespace(half_tet=half_tet, half_tri=half_tri, whole_product=_whole_product(variant))


def _half_product(variant: Variant, size: int) -> Any:
    """K E of samples with ``size`` rows."""
    S = variant.S
    module = variant.module("samples")
    Strip, Row = wp.types.matrix((size, TILE), S), wp.types.vector(TILE, S)

    @wp.kernel(module=module, enable_backward=False)
    def half_product(
        tiles: int,
        # Model
        sample_stride: wp.array(dtype=wp.int32),
        sample_basis: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=S),
        # Workspace in
        stiffness_in: wp.array2d(dtype=S),
        # Workspace out
        half_out: wp.array2d(dtype=S),
    ):
        """A tile of columns of K E of one sample; ``half_out`` has as many rows as all E have."""
        task, w = wp.tid()
        item = task // tiles
        tile = task - item * tiles
        stride = sample_stride[item]
        if wp.static(TILE) * tile < stride:
            at = sample_basis[item] + wp.static(TILE) * tile
            e = Strip()
            for a in range(wp.static(size)):
                for c in range(wp.static(TILE)):
                    e[a, c] = basis[at + a * stride + c]
            first = wp.static(size * size) * item
            for i in range(wp.static(size)):
                s = Row()
                for a in range(wp.static(size)):
                    k = stiffness_in[w, first + wp.static(size) * i + a]
                    for c in range(wp.static(TILE)):
                        s[c] += k * e[a, c]
                for c in range(wp.static(TILE)):
                    half_out[w, at + i * stride + c] = s[c]

    return half_product


# A tile of the sum in registers. Rows of E, which all worlds share, are read by sixteen bytes, two rows at once.
_SUM = """
struct alignas(16) Piece { REAL v[16 / sizeof(REAL)]; };
const int each = 16 / sizeof(REAL);
const long long across = half_in.strides[1] / sizeof(REAL), down = sum_out.strides[1] / sizeof(REAL);
const REAL* y = &wp::index(half_in, w, cols);
const Piece* e = (const Piece*)(basis.data + rows);
REAL s[TILE][TILE] = {};
#pragma unroll 2
for (int k = 0; k < count; ++k) {
    REAL a[TILE], b[TILE];
    for (int c = 0; c < TILE; ++c) b[c] = y[c * across];
    for (int p = 0; p < TILE / each; ++p) {
        const Piece piece = e[p];
        for (int q = 0; q < each; ++q) a[p * each + q] = piece.v[q];
    }
    for (int r = 0; r < TILE; ++r)
        for (int c = 0; c < TILE; ++c) s[r][c] += a[r] * b[c];
    y += stride * across;
    e += stride / each;
}
REAL* out = &wp::index(sum_out, w, at);
for (int r = 0; r < TILE; ++r)
    for (int c = 0; c < TILE; ++c) {
        REAL& sum = out[(r * stride + c) * down];
        sum = more ? sum + s[r][c] : s[r][c];
    }
"""
WARP = 32  # threads of a GPU's warp, worlds side by side


def _whole_product(variant: Variant) -> Any:
    """Sums of E' (K E)."""
    S, real = variant.S, variant.real
    module = variant.module("samples")

    @wp.func_native(_SUM.replace("REAL", "double" if real is wp.float64 else "float").replace("TILE", str(TILE)))
    def add_square(
        w: int,
        count: int,
        stride: int,
        rows: int,
        cols: int,
        at: int,
        more: bool,
        basis: wp.array(dtype=S),
        half_in: wp.array2d(dtype=S),
        sum_out: wp.array2d(dtype=S),
    ): ...

    @wp.kernel(module=module, enable_backward=False)
    def whole_product(
        size: int,
        squares: int,
        more: bool,
        # Model
        body_stride: wp.array(dtype=wp.int32),
        body_samples: wp.array(dtype=wp.int32),
        body_basis: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=S),
        # Workspace in
        half_in: wp.array2d(dtype=S),
        # Workspace out
        sum_out: wp.array2d(dtype=S),
    ):
        """A tile of the stiffness in modes on or below its diagonal, or what more samples add to it.

        The warps of a block take tiles of one column for the same worlds, so that K E comes once from far away for all.
        """
        number, world = wp.tid()
        task = int(number)
        w = int(world)
        worlds = half_in.shape[0]
        if worlds % wp.static(WARP) == 0:
            thread = number * worlds + world
            warp = thread // wp.static(WARP)
            task = warp % squares
            w = wp.static(WARP) * (warp // squares) + thread % wp.static(WARP)
        body = int(0)
        first = int(0)
        stride = int(body_stride[body])
        tiles = int(stride // wp.static(TILE))
        while task >= tiles * (tiles + 1) // 2:
            task -= tiles * (tiles + 1) // 2
            first += stride * stride
            body += 1
            stride = body_stride[body]
            tiles = stride // wp.static(TILE)
        j = int(0)
        while task >= tiles - j:
            task -= tiles - j
            j += 1
        i = j + task
        count = size * (body_samples[body + 1] - body_samples[body])
        rows = body_basis[body] + wp.static(TILE) * i
        cols = body_basis[body] + wp.static(TILE) * j
        at = first + wp.static(TILE) * (i * stride + j)
        add_square(w, count, stride, rows, cols, at, more, basis, half_in, sum_out)

    return whole_product
