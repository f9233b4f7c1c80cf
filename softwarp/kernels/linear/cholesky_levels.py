"""Block Cholesky on a GPU: one thread block factorises and solves a group of worlds, level by level, in one launch.

A thread block holds ``worlds`` neighbouring worlds (so that loads coalesce) times ``workers`` threads per world. The
workers share the tiles or groups of columns of a level (``solvers/linear/tiles.py``) and meet at a barrier after it,
which costs far less than a launch per level. The latency of memory bounds them, so a thread has the loads of a whole
product of tiles under way at a time, and by then knows what to load next. Where a level has less to do than there are
workers, several split a sum; parts are added in a fixed order, so results repeat to the bit.
Theory: docs/theory/cholesky.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.linear import cholesky
from softwarp.kernels.linear.cholesky_panels import barrier, name_of

FACTOR_THREADS = 512  # per block: 128 registers each, which four blocks of a product and four sums take
THREADS = 512  # and in substitutions; benchmarks/trunk.py
SPLIT = 16  # threads that share the sum of a level's only group; others give the same bits
SIDES = (9, 6, 3)  # right-hand sides that a thread may carry at a time
TILE_ROWS = 36  # scratch rows of a part of a tile's sum
GROUP_ROWS = 6  # and of a group's, for one side

# Numbers of a world. Warp's own indices take the compiler nine instructions for each of them.
_PLACE = """
SCALAR* p = reinterpret_cast<SCALAR*>(reinterpret_cast<char*>(values.data)
    + static_cast<long long>(values.strides[0]) * w + static_cast<long long>(values.strides[1]) * row);
const long long next = values.strides[1] / sizeof(SCALAR);
"""
_READ = """
wp::mat_t<3, 3, SCALAR> m;
for (int k = 0; k < 9; ++k, p += next) m.data[k / 3][k % 3] = *p;
return m;
"""
_WRITE = "for (int k = 0; k < 9; ++k, p += next) *p = m.data[k / 3][k % 3];"
_READ_TRIANGLE = """
wp::mat_t<3, 3, SCALAR> m(static_cast<SCALAR>(0));
for (int r = 0; r < 3; ++r) for (int c = 0; c <= r; ++c, p += next) m.data[r][c] = *p;
return m;
"""
_WRITE_TRIANGLE = "for (int r = 0; r < 3; ++r) for (int c = 0; c <= r; ++c, p += next) *p = m.data[r][c];"
_READ3 = """
wp::vec_t<3, SCALAR> v;
for (int k = 0; k < 3; ++k, p += next) v.c[k] = *p;
return v;
"""
_READ_SIDES = """
wp::mat_t<3, SIDES, SCALAR> m;
for (int side = 0; side < SIDES; ++side)
    for (int c = 0; c < 3; ++c) m.data[c][side] = p[(static_cast<long long>(side) * stride + c) * next];
return m;
"""
_WRITE3 = "for (int k = 0; k < 3; ++k, p += next) *p = v.c[k];"


def worlds_per_block(world_count: int) -> int:
    """Full coalescing for large batches, more workers per world for small ones; benchmarks/trunk.py."""
    return 32 if world_count > 2048 else 16


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """Blocks and their products as matrices."""
    S = variant.S
    diagonal_inverse = cholesky.kernels(variant).diagonal_inverse
    mat33, vec3 = wp.types.matrix((3, 3), S), wp.types.vector(3, S)

    @wp.struct
    class Tile:
        """Blocks (row 1, col 1), (1, 2), (2, 1), (2, 2)."""

        aa: mat33
        ab: mat33
        ba: mat33
        bb: mat33

    def code(text: str) -> str:
        place = _PLACE.replace("values", "values_out") if text.startswith("for") else _PLACE
        return (place + text).replace("SCALAR", name_of(S))

    @wp.func_native(code(_READ))
    def read_rows(values: wp.array2d(dtype=S), w: int, row: int) -> mat33: ...

    @wp.func_native(code(_WRITE))
    def write_rows(values_out: wp.array2d(dtype=S), w: int, row: int, m: mat33): ...

    @wp.func_native(code(_READ_TRIANGLE))
    def read_triangle_rows(values: wp.array2d(dtype=S), w: int, row: int) -> mat33: ...

    @wp.func_native(code(_WRITE_TRIANGLE))
    def write_triangle_rows(values_out: wp.array2d(dtype=S), w: int, row: int, m: mat33): ...

    @wp.func_native(code(_READ3))
    def read3(values: wp.array2d(dtype=S), w: int, row: int) -> vec3: ...

    @wp.func_native(code(_WRITE3))
    def write3(values_out: wp.array2d(dtype=S), w: int, row: int, v: vec3): ...

    @wp.func
    def read(values: wp.array2d(dtype=S), w: int, block: int):
        return read_rows(values, w, 9 * block)

    @wp.func
    def write_block_of(values: wp.array2d(dtype=S), w: int, block: int, m: mat33):
        write_rows(values, w, 9 * block, m)

    @wp.func
    def read_triangle(values: wp.array2d(dtype=S), w: int, column: int):
        """Inverse of a pivot's factor."""
        return read_triangle_rows(values, w, 6 * column)

    @wp.func
    def write_triangle(values: wp.array2d(dtype=S), w: int, column: int, m: mat33):
        write_triangle_rows(values, w, 6 * column, m)

    @wp.func
    def inverse_root(m: mat33):
        """Inverse of the lower factor of a symmetric block."""
        i00, i10, i11, i20, i21, i22 = diagonal_inverse(m[0, 0], m[1, 0], m[1, 1], m[2, 0], m[2, 1], m[2, 2])
        none = S(0.0)
        return mat33(i00, none, none, i10, i11, none, i20, i21, i22)

    @wp.func
    def finish_forward(
        lower: wp.array2d(dtype=S),
        diagonal: wp.array2d(dtype=S),
        y: wp.array2d(dtype=S),
        w: int,
        offset: int,
        columns: wp.vec4i,
        s1: vec3,
        s2: vec3,
    ):
        """The rows of a group from the sums of what is to their left."""
        i = offset + 3 * columns[0]
        y1 = read_triangle(diagonal, w, columns[0]) * (read3(y, w, i) - s1)
        write3(y, w, i, y1)
        if columns[1] >= 0:
            j = offset + 3 * columns[1]
            right = read3(y, w, j) - s2 - read(lower, w, columns[2]) * y1
            write3(y, w, j, read_triangle(diagonal, w, columns[1]) * right)

    return SimpleNamespace(
        Tile=Tile,
        mat33=mat33,
        vec3=vec3,
        read=read,
        write_block_of=write_block_of,
        read3=read3,
        write3=write3,
        read_triangle=read_triangle,
        write_triangle=write_triangle,
        inverse_root=inverse_root,
        finish_forward=finish_forward,
    )


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Cooperative kernels for the ``cuda`` variant of one scalar type."""
    return SimpleNamespace(factor_block=_factor(variant), substitute_block=_substitute(variant))


def _factor(variant: Variant) -> wp.Kernel:
    S = variant.S
    f = functions(variant)
    Tile, mat33, read, write_block_of, write_triangle = f.Tile, f.mat33, f.read, f.write_block_of, f.write_triangle
    inverse_root = f.inverse_root

    @wp.func
    def tile_sum(lower: wp.array2d(dtype=S), w: int, begin: int, end: int, entry: wp.array(dtype=wp.vec4i)):
        """``sum_k L_ik L_jk'`` of a tile over some columns k."""
        s = Tile()
        coming = entry[begin]
        for p in range(begin, end):
            at = coming
            coming = entry[p + 1]
            a = read(lower, w, at[0])
            b = read(lower, w, at[1])
            c = read(lower, w, at[2])
            d = read(lower, w, at[3])
            s.aa = s.aa + a * wp.transpose(c)
            s.ab = s.ab + a * wp.transpose(d)
            s.ba = s.ba + b * wp.transpose(c)
            s.bb = s.bb + b * wp.transpose(d)
        return s

    @wp.func
    def left_of(a: wp.array2d(dtype=S), w: int, source: int, s: mat33):
        """``A_ij - s``, where A may have no such block."""
        x = read(a, w, wp.max(source, 0))
        return wp.where(source < 0, -s, x - s)

    @wp.func
    def store_block_of(values: wp.array2d(dtype=S), w: int, block: int, x: mat33):
        if block >= 0:
            write_block_of(values, w, block, x)

    @wp.func
    def store_tile(
        a: wp.array2d(dtype=S),
        lower: wp.array2d(dtype=S),
        corner: wp.array2d(dtype=S),
        w: int,
        column: wp.vec4i,
        block: wp.vec4i,
        source: wp.vec4i,
        s: Tile,
    ):
        """What is left of A; the corner of a diagonal tile stays apart until all tiles of its group have read it."""
        aa = left_of(a, w, source[0], s.aa)
        ab = left_of(a, w, source[1], s.ab)
        ba = left_of(a, w, source[2], s.ba)
        bb = left_of(a, w, source[3], s.bb)
        store_block_of(lower, w, block[0], aa)
        store_block_of(lower, w, block[1], ab)
        store_block_of(lower, w, block[3], bb)
        if column[3] == 0:
            store_block_of(lower, w, block[2], ba)
        else:
            write_block_of(corner, w, column[2], ba)

    @wp.func
    def solve_tile_row(
        lower: wp.array2d(dtype=S),
        w: int,
        first: int,
        second: int,
        x1: mat33,
        x2: mat33,
        d1: mat33,
        l21: mat33,
        d2: mat33,
    ):
        """Blocks of one row, solved with the factor of the group's diagonal."""
        x = x1 * wp.transpose(d1)
        store_block_of(lower, w, first, x)
        store_block_of(lower, w, second, (x2 - x * wp.transpose(l21)) * wp.transpose(d2))

    @wp.kernel(module=variant.module("cholesky_factor"), enable_backward=False, launch_bounds=FACTOR_THREADS)
    def factor_block(
        # Symbolic
        zero: int,
        level_count: int,
        level_piece: wp.array(dtype=wp.int32),
        piece: wp.array(dtype=wp.vec4i),
        entry: wp.array(dtype=wp.vec4i),
        level_split: wp.array(dtype=wp.int32),
        split: wp.array(dtype=wp.vec4i),
        level_tile: wp.array(dtype=wp.int32),
        tile: wp.array(dtype=wp.vec4i),
        tile_block: wp.array(dtype=wp.vec4i),
        tile_source: wp.array(dtype=wp.vec4i),
        world_count: int,
        worlds: int,
        threads: int,
        # Workspace in
        a_in: wp.array2d(dtype=S),
        # Workspace out
        part_out: wp.array2d(dtype=S),
        corner_out: wp.array2d(dtype=S),
        lower_out: wp.array2d(dtype=S),
        diagonal_out: wp.array2d(dtype=S),
    ):
        """A = L L' for the worlds of one block."""
        group, place = wp.tid()
        w = group * worlds + place % worlds
        worker = place // worlds
        workers = threads // worlds
        active = w < world_count
        for level in range(level_count):
            if active:
                for q in range(level_piece[level] + worker, level_piece[level + 1], workers):
                    work = piece[q]
                    t = work[0]
                    s = tile_sum(lower_out, w, work[1], work[2], entry)
                    if work[3] < 0:
                        store_tile(a_in, lower_out, corner_out, w, tile[t], tile_block[t], tile_source[t], s)
                    else:
                        k = 4 * work[3]
                        write_block_of(part_out, w, k, s.aa)
                        write_block_of(part_out, w, k + 1, s.ab)
                        write_block_of(part_out, w, k + 2, s.ba)
                        write_block_of(part_out, w, k + 3, s.bb)
            barrier()
            if level_split[level] < level_split[level + 1]:
                if active:
                    for q in range(level_split[level] + worker, level_split[level + 1], workers):
                        work = split[q]
                        t = work[0]
                        s = Tile()
                        for part in range(work[1], work[2]):
                            k = 4 * part
                            s.aa = s.aa + read(part_out, w, k)
                            s.ab = s.ab + read(part_out, w, k + 1)
                            s.ba = s.ba + read(part_out, w, k + 2)
                            s.bb = s.bb + read(part_out, w, k + 3)
                        store_tile(a_in, lower_out, corner_out, w, tile[t], tile_block[t], tile_source[t], s)
                barrier()
            if active:
                for t in range(level_tile[level] + worker, level_tile[level + 1], workers):
                    column = tile[t]
                    block = tile_block[t]
                    pivot = read(lower_out, w, column[0])
                    corner = read(corner_out, w, column[2])
                    last = read(lower_out, w, wp.max(column[1], 0))
                    aa = read(lower_out, w, wp.where(block[0] < 0, zero, block[0]))
                    ab = read(lower_out, w, wp.where(block[1] < 0, zero, block[1]))
                    ba = read(lower_out, w, wp.where(block[2] < 0, zero, block[2]))
                    bb = read(lower_out, w, wp.where(block[3] < 0, zero, block[3]))
                    d1 = inverse_root(pivot)
                    l21 = mat33()
                    d2 = mat33()
                    if column[1] >= 0:
                        l21 = corner * wp.transpose(d1)
                        d2 = inverse_root(last - l21 * wp.transpose(l21))
                    if column[3] == 0:
                        solve_tile_row(lower_out, w, block[0], block[1], aa, ab, d1, l21, d2)
                        solve_tile_row(lower_out, w, block[2], block[3], ba, bb, d1, l21, d2)
                    else:
                        write_triangle(diagonal_out, w, column[0], d1)
                        if column[1] >= 0:
                            write_block_of(lower_out, w, block[2], l21)
                            write_triangle(diagonal_out, w, column[1], d2)
            barrier()

    return factor_block


@cache
def forward_kernels(variant: Variant, held_sides: int) -> SimpleNamespace:
    """The forward substitution of so many right-hand sides at a time."""
    S, sides = variant.S, held_sides
    f = functions(variant)
    vec3, read, read3, write3, finish_forward = f.vec3, f.read, f.read3, f.write3, f.finish_forward
    columns_of = wp.types.matrix((3, sides), S)

    @wp.func_native((_PLACE + _READ_SIDES).replace("SCALAR", name_of(S)).replace("SIDES", str(sides)))
    def read_sides(values: wp.array2d(dtype=S), w: int, row: int, stride: int) -> columns_of: ...

    @wp.kernel(module=variant.module(f"cholesky_forward.{sides}"), enable_backward=False, launch_bounds=THREADS)
    def forward_block(
        # Symbolic
        size: int,
        level_count: int,
        level_group: wp.array(dtype=wp.int32),
        group: wp.array(dtype=wp.vec4i),
        group_left: wp.array(dtype=wp.int32),
        left: wp.array(dtype=wp.vec4i),
        world_count: int,
        worlds: int,
        threads: int,
        bundles: int,
        # Workspace in
        lower_in: wp.array2d(dtype=S),
        diagonal_in: wp.array2d(dtype=S),
        # Workspace out
        part_out: wp.array2d(dtype=S),
        y_out: wp.array2d(dtype=S),
    ):
        """y <- L^-1 y for ``bundles`` times ``sides`` right-hand sides of the worlds of one block."""
        pack, place = wp.tid()
        w = pack * worlds + place % worlds
        worker = place // worlds
        workers = threads // worlds
        active = w < world_count
        stride = 3 * size
        for level in range(level_count):
            first = level_group[level]
            tasks = (level_group[level + 1] - first) * bundles
            split = wp.max(SPLIT // tasks, 1)
            if active:
                for q in range(worker, tasks * split, workers):
                    task = q // split
                    g = first + task // bundles
                    offset = wp.static(sides) * stride * (task % bundles)
                    end = group_left[g + 1]
                    begin = wp.min(group_left[g] + q % split, end)
                    s1 = columns_of()
                    s2 = columns_of()
                    coming = left[begin]
                    for p in range(begin, end, split):
                        at = coming
                        coming = left[wp.min(p + split, end)]
                        l1 = read(lower_in, w, at[1])
                        l2 = read(lower_in, w, at[2])
                        yk = read_sides(y_out, w, offset + 3 * at[0], stride)
                        s1 = s1 + l1 * yk
                        s2 = s2 + l2 * yk
                    if split == 1:
                        columns = group[g]
                        for side in range(wp.static(sides)):
                            a = vec3(s1[0, side], s1[1, side], s1[2, side])
                            b = vec3(s2[0, side], s2[1, side], s2[2, side])
                            finish_forward(lower_in, diagonal_in, y_out, w, offset + side * stride, columns, a, b)
                    else:
                        k = q * wp.static(sides * GROUP_ROWS)
                        for side in range(wp.static(sides)):
                            write3(part_out, w, k, vec3(s1[0, side], s1[1, side], s1[2, side]))
                            write3(part_out, w, k + 3, vec3(s2[0, side], s2[1, side], s2[2, side]))
                            k += wp.static(GROUP_ROWS)
            barrier()
            if split > 1:
                if active:
                    for q in range(worker, wp.static(sides) * tasks, workers):
                        task = q // wp.static(sides)
                        side = q % wp.static(sides)
                        a = vec3()
                        b = vec3()
                        for part in range(split):
                            k = ((task * split + part) * wp.static(sides) + side) * wp.static(GROUP_ROWS)
                            a = a + read3(part_out, w, k)
                            b = b + read3(part_out, w, k + 3)
                        offset = stride * (wp.static(sides) * (task % bundles) + side)
                        finish_forward(lower_in, diagonal_in, y_out, w, offset, group[first + task // bundles], a, b)
                barrier()

    return SimpleNamespace(forward_block=forward_block)


def _substitute(variant: Variant) -> wp.Kernel:
    S = variant.S
    f = functions(variant)
    vec3, read, read3, write3, read_triangle = f.vec3, f.read, f.read3, f.write3, f.read_triangle
    finish_forward = f.finish_forward

    @wp.func
    def finish_backward(
        lower: wp.array2d(dtype=S),
        diagonal: wp.array2d(dtype=S),
        y: wp.array2d(dtype=S),
        w: int,
        columns: wp.vec4i,
        s1: vec3,
        s2: vec3,
    ):
        """The columns of a group from the sums of what is below them."""
        i = 3 * columns[0]
        right = read3(y, w, i) - s1
        if columns[1] >= 0:
            j = 3 * columns[1]
            x2 = wp.transpose(read_triangle(diagonal, w, columns[1])) * (read3(y, w, j) - s2)
            write3(y, w, j, x2)
            right = right - wp.transpose(read(lower, w, columns[2])) * x2
        write3(y, w, i, wp.transpose(read_triangle(diagonal, w, columns[0])) * right)

    @wp.kernel(module=variant.module("cholesky_block"), enable_backward=False, launch_bounds=THREADS)
    def substitute_block(
        # Symbolic
        backward: bool,
        level_count: int,
        level_group: wp.array(dtype=wp.int32),
        group: wp.array(dtype=wp.vec4i),
        group_start: wp.array(dtype=wp.int32),
        item: wp.array(dtype=wp.vec4i),
        world_count: int,
        worlds: int,
        threads: int,
        # Workspace in
        lower_in: wp.array2d(dtype=S),
        diagonal_in: wp.array2d(dtype=S),
        # Workspace out
        part_out: wp.array2d(dtype=S),
        y_out: wp.array2d(dtype=S),
    ):
        """y <- L^-1 y, or L^-T y if ``backward``, for the first right-hand side of the worlds of one block.

        ``item`` lists what is left of groups, or what is below them.
        """
        pack, place = wp.tid()
        w = pack * worlds + place % worlds
        worker = place // worlds
        workers = threads // worlds
        active = w < world_count
        for step in range(level_count):
            level = wp.where(backward, level_count - 1 - step, step)
            first = level_group[level]
            tasks = level_group[level + 1] - first
            split = wp.max(SPLIT // tasks, 1)
            if active:
                for q in range(worker, tasks * split, workers):
                    g = first + q // split
                    end = group_start[g + 1]
                    begin = wp.min(group_start[g] + q % split, end)
                    s1 = vec3()
                    s2 = vec3()
                    coming = item[begin]
                    for p in range(begin, end, split):
                        at = coming
                        coming = item[wp.min(p + split, end)]
                        l1 = read(lower_in, w, at[1])
                        l2 = read(lower_in, w, at[2])
                        yk = read3(y_out, w, 3 * at[0])
                        if backward:
                            l1 = wp.transpose(l1)
                            l2 = wp.transpose(l2)
                        s1 = s1 + l1 * yk
                        s2 = s2 + l2 * yk
                    if split > 1:
                        k = q * wp.static(GROUP_ROWS)
                        write3(part_out, w, k, s1)
                        write3(part_out, w, k + 3, s2)
                    elif backward:
                        finish_backward(lower_in, diagonal_in, y_out, w, group[g], s1, s2)
                    else:
                        finish_forward(lower_in, diagonal_in, y_out, w, 0, group[g], s1, s2)
            barrier()
            if split > 1:
                if active:
                    for task in range(worker, tasks, workers):
                        s1 = vec3()
                        s2 = vec3()
                        for part in range(split):
                            k = (task * split + part) * wp.static(GROUP_ROWS)
                            s1 = s1 + read3(part_out, w, k)
                            s2 = s2 + read3(part_out, w, k + 3)
                        if backward:
                            finish_backward(lower_in, diagonal_in, y_out, w, group[first + task], s1, s2)
                        else:
                            finish_forward(lower_in, diagonal_in, y_out, w, 0, group[first + task], s1, s2)
                barrier()

    return substitute_block
