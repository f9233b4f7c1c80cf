"""Panel Cholesky: one thread block factorises and solves one world. Theory: docs/theory/cholesky.md.

A panel is a group of columns with one list of rows (softwarp/solvers/linear/panels.py), and a round works on panels
that do not depend on each other. The blocks of a round stay in registers from their first sum to the last product, and
the column that is eliminated passes through shared memory. What a panel subtracts from the rows below it is kept as an
update for the panel above. The inverse of a panel's triangle comes along as further rows, so that a substitution has
no chain within a panel. Every sum has one writer and a fixed order: results repeat to the bit and depend on no other
world.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.team import exchange_code
from softwarp.model.codes import PANEL_FIRST_STEP, PANEL_IDENTITY, PANEL_UPDATE

THREADS = 512  # per block, at most; benchmarks/trunk.py
ITEMS = 3  # blocks of a round that a thread holds in registers
ITEMS_ALONE = 600  # those of the only thread of a CPU's block; for tests
SLOTS = 640  # blocks of the columns in elimination, in shared memory
STAGE_BYTES = 46080  # of L in shared memory, of the 48 KiB that a block has
LAST_STEP = PANEL_FIRST_STEP - 1  # mask of an item's last step
FIRST_BIT = PANEL_FIRST_STEP.bit_length() - 1  # of its first step
FLAGS = PANEL_UPDATE + LAST_STEP  # the last step of an item that belongs to a column
PARTS = 4  # threads of a warp that share a sum over the columns of a panel
ROW_PARTS = 8  # and over its rows


def item_limit(variant: Variant) -> int:
    """Blocks that a round may hold in registers."""
    return ITEMS * THREADS if variant.world_fastest else ITEMS_ALONE


def stage_limit(variant: Variant) -> int:
    """Blocks of L that a round may hold in shared memory."""
    return STAGE_BYTES // (9 * wp.types.type_size_in_bytes(variant.real))


# A CPU runs these kernels in tests only: with one thread to a block, or with as many as a GPU, which are fibers.
_BARRIER = """
#if defined(__CUDA_ARCH__)
__syncthreads();
#else
WP_TILE_SYNC();
#endif
"""

_SHARED = """
#if defined(__CUDA_ARCH__)
__shared__ SCALAR store[COUNT];
#else
static SCALAR store[COUNT];
#endif
if (write) store[place] = value;
else value = store[place];
return value;
"""

# Blocks in shared memory; in float32 a block has the room of twelve entries, so that three accesses move it.
_SLOT = """
#if defined(__CUDA_ARCH__)
__shared__ __align__(16) SCALAR store[STRIDE * COUNT];
#else
static SCALAR store[STRIDE * COUNT];
#endif
SCALAR* p = store + STRIDE * slot;
#if defined(__CUDA_ARCH__) && STRIDE == 12
float4* q = reinterpret_cast<float4*>(p);
if (write) {
    q[0] = make_float4(m.data[0][0], m.data[0][1], m.data[0][2], m.data[1][0]);
    q[1] = make_float4(m.data[1][1], m.data[1][2], m.data[2][0], m.data[2][1]);
    p[8] = m.data[2][2];
} else {
    float4 x = q[0], y = q[1];
    m.data[0][0] = x.x; m.data[0][1] = x.y; m.data[0][2] = x.z;
    m.data[1][0] = x.w; m.data[1][1] = y.x; m.data[1][2] = y.y;
    m.data[2][0] = y.z; m.data[2][1] = y.w; m.data[2][2] = p[8];
}
#else
for (int k = 0; k < 9; ++k) {
    if (write) p[k] = m.data[k / 3][k % 3];
    else m.data[k / 3][k % 3] = p[k];
}
#endif
return m;
"""

_INVERSE_ROOT = """
#if defined(__CUDA_ARCH__)
SCALAR y = ROOT(x);
return y + (SCALAR)0.5 * y * ((SCALAR)1 - x * y * y);  // Newton: ROOT is good to two units only
#else
return (SCALAR)1 / ::sqrt(x);
#endif
"""


@wp.func_native(_BARRIER)
def barrier():
    """Wait for all threads of the block; their writes are visible after it."""


def shared_memory(real: Any, count: int) -> str:
    """Native code that reads or writes one of ``count`` scalars in memory that the threads of a block share."""
    return _SHARED.replace("SCALAR", name_of(real)).replace("COUNT", str(count))


def named(code: str, values: dict[str, str]) -> str:
    """Native code with names replaced by what they stand for."""
    for name, value in values.items():
        code = code.replace(name, value)
    return code


def name_of(real: Any) -> str:
    """Name of a scalar type in native code."""
    return "double" if real is wp.float64 else "float"


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Cooperative kernels of one world per thread block, for variants without lanes."""
    S = variant.S
    module = variant.module("cholesky_panel")
    items = ITEMS if variant.world_fastest else ITEMS_ALONE
    is_double = S is wp.float64
    mat = wp.types.matrix((3, 3), dtype=S)
    vec = wp.types.vector(3, dtype=S)
    held = wp.types.vector(9 * items, dtype=S)
    integers = wp.types.vector(items, dtype=wp.int32)
    stride = "9" if is_double else "12"
    slot_code = _SLOT.replace("SCALAR", name_of(S)).replace("STRIDE", stride).replace("COUNT", str(SLOTS))
    root_code = _INVERSE_ROOT.replace("SCALAR", name_of(S)).replace("ROOT", "rsqrt" if is_double else "rsqrtf")

    @wp.func_native(slot_code)
    def slot_block(slot: int, m: mat, write: bool) -> mat: ...

    @wp.func_native(shared_memory(S, 9 * stage_limit(variant)))
    def stage_entry(place: int, value: S, write: bool) -> S: ...

    @wp.func_native(root_code)
    def inverse_root(x: S) -> S: ...

    @wp.func_native(exchange_code(S))
    def exchange(value: S, offset: int) -> S: ...

    @wp.func
    def sum_parts(value: vec, parts: int):
        """Sum over neighbouring threads of a warp, the same bits in each."""
        total = value
        offset = parts // 2
        while offset > 0:
            total += vec(exchange(total[0], offset), exchange(total[1], offset), exchange(total[2], offset))
            offset = offset // 2
        return total

    @wp.func
    def take(slot: int):
        """A block of a column in elimination."""
        return slot_block(slot, mat(), False)

    @wp.func
    def put(slot: int, s: mat):
        """Show a block to the other threads."""
        slot_block(slot, s, True)

    @wp.func
    def pivot_inverse(s: mat):
        """Inverse of the lower Cholesky factor of a symmetric block."""
        i00 = inverse_root(s[0, 0])
        l10 = s[1, 0] * i00
        l20 = s[2, 0] * i00
        i11 = inverse_root(s[1, 1] - l10 * l10)
        l21 = (s[2, 1] - l20 * l10) * i11
        i22 = inverse_root(s[2, 2] - l20 * l20 - l21 * l21)
        i10 = -l10 * i00 * i11
        i21 = -l21 * i11 * i22
        i20 = -(l20 * i00 + l21 * i10) * i22
        return mat(i00, S(0.0), S(0.0), i10, i11, S(0.0), i20, i21, i22)

    @wp.func
    def get(s: held, i: int):
        """Block ``i`` of a thread."""
        k = 9 * i
        return mat(s[k], s[k + 1], s[k + 2], s[k + 3], s[k + 4], s[k + 5], s[k + 6], s[k + 7], s[k + 8])

    @wp.func
    def start(a: wp.array2d(dtype=S), w: int, source: int):
        """Block of A, of the identity (-2), or zero (-1)."""
        k = 9 * wp.max(source, 0)  # loaded in any case, so that no branch keeps loads from being under way together
        s = mat(
            a[w, k],
            a[w, k + 1],
            a[w, k + 2],
            a[w, k + 3],
            a[w, k + 4],
            a[w, k + 5],
            a[w, k + 6],
            a[w, k + 7],
            a[w, k + 8],
        )
        if source < 0:
            one = wp.where(source == wp.static(PANEL_IDENTITY), S(1.0), S(0.0))
            s = mat(one, S(0.0), S(0.0), S(0.0), one, S(0.0), S(0.0), S(0.0), one)
        return s

    @wp.func
    def block(values: wp.array2d(dtype=S), w: int, k: int, stride: int):
        """A block whose entries lie a stride apart, column after column."""
        return mat(
            values[w, k],
            values[w, k + 3 * stride],
            values[w, k + 6 * stride],
            values[w, k + stride],
            values[w, k + 4 * stride],
            values[w, k + 7 * stride],
            values[w, k + 2 * stride],
            values[w, k + 5 * stride],
            values[w, k + 8 * stride],
        )

    @wp.func
    def store(values: wp.array2d(dtype=S), w: int, k: int, stride: int, m: mat):
        """Write a block as ``block`` reads it."""
        for c in range(3):
            for r in range(3):
                values[w, k + (3 * c + r) * stride] = m[r, c]

    @wp.kernel(module=module, enable_backward=False, launch_bounds=THREADS)
    def factor_panels(
        # Symbolic
        round_count: int,
        round_item: wp.array(dtype=wp.int32),
        round_width: wp.array(dtype=wp.int32),
        round_late: wp.array(dtype=wp.int32),
        item_source: wp.array(dtype=wp.vec4i),
        item_place: wp.array(dtype=wp.vec4i),
        child: wp.array(dtype=wp.vec2i),
        late_row: wp.array(dtype=wp.vec4i),
        threads: int,
        # Workspace in
        a_in: wp.array2d(dtype=S),
        # Workspace out
        update_out: wp.array2d(dtype=S),
        lower_out: wp.array2d(dtype=S),
    ):
        """A = L L' of one world; writes the rows below each panel and the inverse of its triangle, transposed."""
        w, thread = wp.tid()
        for turn in range(round_count):
            begin = round_item[turn]
            count = round_item[turn + 1] - begin
            s = held()
            left = integers()  # slots of an item's two rows; the panel's first slot is for the inverse of a pivot
            right = integers()
            order = integers()  # its last step, the first one, and whether it is an update
            target = integers()  # where it goes
            stride = integers()
            origin = integers()  # where it starts from
            first = integers()
            last = integers()
            children = int(0)
            some = int(0)
            # Several loops, so that the loads of all items are under way together.
            for i in range(wp.static(items)):
                item = thread + i * threads
                order[i] = -wp.static(PANEL_UPDATE)  # no item: never at a step
                target[i] = -1
                origin[i] = -1
                if item < count:
                    source = item_source[begin + item]
                    place = item_place[begin + item]
                    first[i] = source[0]
                    last[i] = source[1]
                    origin[i] = source[2]
                    target[i] = source[3]
                    left[i] = place[0]
                    right[i] = place[1]
                    order[i] = place[2]
                    stride[i] = place[3]
            for i in range(wp.static(items)):
                m = start(a_in, w, origin[i])
                for r in range(3):
                    for c in range(3):
                        s[9 * i + 3 * r + c] = m[r, c]
            for i in range(wp.static(items)):
                if last[i] > first[i]:
                    children = wp.max(children, last[i] - first[i])
                    some = first[i]
            for p in range(children):
                for i in range(wp.static(items)):
                    has = first[i] + p < last[i]
                    entry = child[wp.where(has, first[i] + p, some)]
                    m = block(update_out, w, entry[0], entry[1])
                    for r in range(3):
                        for c in range(3):
                            s[9 * i + 3 * r + c] += wp.where(has, m[r, c], S(0.0))
            for step in range(round_width[turn]):
                for i in range(wp.static(items)):
                    if order[i] == step and left[i] == right[i]:
                        put(left[i] - step - 2, pivot_inverse(get(s, i)))
                barrier()
                for i in range(wp.static(items)):
                    if order[i] & wp.static(FLAGS) == step and left[i] != right[i]:
                        m = get(s, i) * wp.transpose(take(right[i] - step - 2))
                        put(left[i], m)
                        for r in range(3):
                            for c in range(3):
                                s[9 * i + 3 * r + c] = m[r, c]
                for q in range(round_late[turn] + thread, round_late[turn + 1], threads):
                    row = late_row[q]
                    if step < row[3]:
                        put(row[0], block(lower_out, w, row[1] + 9 * step * row[2], row[2]))
                barrier()
                for i in range(wp.static(items)):
                    if (
                        order[i] & wp.static(LAST_STEP) > step
                        and (order[i] >> wp.static(FIRST_BIT)) & wp.static(LAST_STEP) <= step
                    ):
                        m = take(left[i]) * wp.transpose(take(right[i]))
                        for r in range(3):
                            for c in range(3):
                                s[9 * i + 3 * r + c] -= m[r, c]
            for i in range(wp.static(items)):
                if target[i] >= 0:
                    if order[i] >= wp.static(PANEL_UPDATE):
                        store(update_out, w, target[i], stride[i], get(s, i))
                    else:
                        store(lower_out, w, target[i], stride[i], get(s, i))
            barrier()

    @wp.func
    def read(values: wp.array2d(dtype=S), w: int, k: int):
        """Three consecutive entries."""
        return vec(values[w, k], values[w, k + 1], values[w, k + 2])

    @wp.func
    def write(values: wp.array2d(dtype=S), w: int, k: int, value: vec):
        """Three consecutive entries."""
        values[w, k] = value[0]
        values[w, k + 1] = value[1]
        values[w, k + 2] = value[2]

    @wp.func
    def load_stage(lower: wp.array2d(dtype=S), w: int, begin: int, end: int, thread: int, threads: int):
        """Part of L into shared memory, four loads of a thread under way at a time."""
        for k in range(begin + thread, end, 4 * threads):
            last = end - 1
            a = lower[w, k]
            b = lower[w, wp.min(k + threads, last)]
            c = lower[w, wp.min(k + 2 * threads, last)]
            d = lower[w, wp.min(k + 3 * threads, last)]
            stage_entry(k - begin, a, True)
            stage_entry(wp.min(k + threads, last) - begin, b, True)
            stage_entry(wp.min(k + 2 * threads, last) - begin, c, True)
            stage_entry(wp.min(k + 3 * threads, last) - begin, d, True)

    @wp.func
    def staged(k: int, stride: int):
        """``block`` of the part of L in shared memory."""
        z = S(0.0)
        return mat(
            stage_entry(k, z, False),
            stage_entry(k + 3 * stride, z, False),
            stage_entry(k + 6 * stride, z, False),
            stage_entry(k + stride, z, False),
            stage_entry(k + 4 * stride, z, False),
            stage_entry(k + 7 * stride, z, False),
            stage_entry(k + 2 * stride, z, False),
            stage_entry(k + 5 * stride, z, False),
            stage_entry(k + 8 * stride, z, False),
        )

    @wp.kernel(module=module, enable_backward=False, launch_bounds=THREADS)
    def forward_panels(
        # Symbolic
        size: int,
        row_count: int,
        turn_count: int,
        turn_column: wp.array(dtype=wp.int32),
        turn_row: wp.array(dtype=wp.int32),
        turn_lower: wp.array(dtype=wp.int32),
        column: wp.array(dtype=wp.vec4i),
        column_part: wp.array(dtype=wp.int32),
        row: wp.array(dtype=wp.vec4i),
        row_part: wp.array(dtype=wp.int32),
        part: wp.array(dtype=wp.int32),
        sides: int,
        scratch: int,
        threads: int,
        # Workspace in
        lower_in: wp.array2d(dtype=S),
        skipped_in: wp.array2d(dtype=wp.int32),
        # Workspace out
        part_out: wp.array2d(dtype=S),
        half_out: wp.array2d(dtype=S),
        y_out: wp.array2d(dtype=S),
    ):
        """y <- L^-1 y for the first right-hand sides of one world; ``half`` has them by column in order of rounds."""
        w, thread = wp.tid()
        if skipped_in[w, 0] != 0:
            return
        parts = wp.min(threads, wp.static(PARTS))
        lane = thread % parts
        for turn in range(turn_count):
            begin = turn_column[turn]
            columns = (turn_column[turn + 1] - begin) * sides
            first_row = turn_row[turn]
            rows = (turn_row[turn + 1] - first_row) * sides
            lower = turn_lower[turn]
            for task in range(thread, columns + rows, threads):  # sums of the panels below
                if task < columns:
                    q = begin + task // sides
                    side = task % sides
                    t = read(y_out, w, 3 * (side * size + column[q][0]))
                    for p in range(column_part[q], column_part[q + 1]):
                        t -= read(part_out, w, 3 * (side * row_count + part[p]))
                    write(half_out, w, scratch + 3 * task, t)
                else:
                    at = first_row + (task - columns) // sides
                    side = (task - columns) % sides
                    t = vec()
                    for p in range(row_part[at], row_part[at + 1]):
                        t += read(part_out, w, 3 * (side * row_count + part[p]))
                    write(part_out, w, 3 * (side * row_count + at), t)
            load_stage(lower_in, w, lower, turn_lower[turn + 1], thread, threads)
            barrier()
            for base in range(0, columns * parts, threads):
                task = (base + thread) // parts
                entry = column[begin + wp.min(task, columns - 1) // sides]
                side = task % sides
                first = scratch + 3 * ((task // sides - entry[1]) * sides + side)
                k = entry[2]
                t = vec()
                if task < columns:
                    for p in range(lane, entry[1] + 1, parts):
                        inverse = staged(entry[3] - lower + p * k + entry[1], k * k)
                        t += wp.transpose(inverse) * read(half_out, w, first + 3 * sides * p)
                t = sum_parts(t, parts)
                if task < columns and lane == 0:
                    write(half_out, w, 3 * (side * size + begin + task // sides), t)
                    write(y_out, w, 3 * (side * size + entry[0]), t)
            barrier()
            for base in range(0, rows * parts, threads):
                task = (base + thread) // parts
                at = first_row + wp.min(task, rows - 1) // sides
                side = task % sides
                entry = row[at]
                t = vec()
                if task < rows:
                    for p in range(lane, entry[2], parts):
                        y = read(half_out, w, 3 * (side * size + entry[3] + p))
                        t += staged(entry[0] - lower + 9 * p * entry[1], entry[1]) * y
                t = sum_parts(t, parts)
                if task < rows and lane == 0:
                    k = 3 * (side * row_count + at)
                    write(part_out, w, k, read(part_out, w, k) + t)
            barrier()

    @wp.kernel(module=module, enable_backward=False, launch_bounds=THREADS)
    def backward_panels(
        # Symbolic
        turn_count: int,
        turn_column: wp.array(dtype=wp.int32),
        turn_lower: wp.array(dtype=wp.int32),
        column: wp.array(dtype=wp.vec4i),
        column_lower: wp.array(dtype=wp.vec4i),
        row_index: wp.array(dtype=wp.int32),
        scratch: int,
        threads: int,
        is_added: bool,
        # Workspace in
        lower_in: wp.array2d(dtype=S),
        skipped_in: wp.array2d(dtype=wp.int32),
        # Workspace out
        half_out: wp.array2d(dtype=S),
        y_out: wp.array2d(dtype=S),
        u_out: wp.array2d(dtype=S),
    ):
        """y <- L^-T y for the first right-hand side of one world, also added to u if asked for."""
        w, thread = wp.tid()
        if skipped_in[w, 0] != 0:
            return
        row_parts = wp.min(threads, wp.static(ROW_PARTS))
        parts = wp.min(threads, wp.static(PARTS))
        for back in range(turn_count):
            turn = turn_count - 1 - back
            begin = turn_column[turn]
            columns = turn_column[turn + 1] - begin
            lower = turn_lower[turn]
            load_stage(lower_in, w, lower, turn_lower[turn + 1], thread, threads)
            barrier()
            for base in range(0, columns * row_parts, threads):
                task = (base + thread) // row_parts
                q = begin + wp.min(task, columns - 1)
                entry = column_lower[q]
                k = entry[0] - lower + 9 * column[q][1] * entry[1]
                t = vec()
                if task < columns:
                    for at in range(thread % row_parts, entry[1], row_parts):
                        x = read(half_out, w, 3 * row_index[entry[2] + at])
                        t += wp.transpose(staged(k + at, entry[1])) * x
                t = sum_parts(t, row_parts)
                if task < columns and thread % row_parts == 0:
                    write(half_out, w, scratch + 3 * task, read(y_out, w, 3 * column[q][0]) - t)
            barrier()
            for base in range(0, columns * parts, threads):
                task = (base + thread) // parts
                q = begin + wp.min(task, columns - 1)
                entry = column[q]
                first = scratch + 3 * (task - entry[1])
                k = entry[2]
                t = vec()
                if task < columns:
                    for p in range(entry[1] + thread % parts, k, parts):
                        t += staged(entry[3] - lower + entry[1] * k + p, k * k) * read(half_out, w, first + 3 * p)
                t = sum_parts(t, parts)
                if task < columns and thread % parts == 0:
                    write(half_out, w, 3 * q, t)
                    write(y_out, w, 3 * entry[0], t)
                    if is_added:
                        write(u_out, w, 3 * entry[0], read(u_out, w, 3 * entry[0]) + t)
            barrier()

    return SimpleNamespace(
        factor_panels=factor_panels,
        forward_panels=forward_panels,
        backward_panels=backward_panels,
        block=block,
        store=store,
    )
