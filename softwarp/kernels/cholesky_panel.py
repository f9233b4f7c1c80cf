"""Panel Cholesky: one thread block factorises and solves one world. Theory: docs/theory/cholesky.md.

A panel is a group of columns with one list of rows (softwarp/solvers/panels.py), and a round works on panels that do
not depend on each other. The blocks of a round stay in registers from their first sum to the last product, and the
column that is eliminated passes through shared memory. What a panel subtracts from the rows below it is kept as an
update for the panel above. The inverse of a panel's triangle comes along as further rows, so that a substitution has
no chain within a panel. Every sum has one writer and a fixed order: results repeat to the bit and depend on no other
world.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels import cholesky
from softwarp.kernels.lanes import Variant

THREADS = 512  # per block; benchmarks/trunk.py
ITEMS = 3  # blocks of a round that a thread holds in registers
ITEMS_ALONE = 600  # those of the only thread of a CPU's block; for tests
SLOTS = 640  # blocks of the columns in elimination, in shared memory
STAGE_BYTES = 46080  # of L in shared memory, of the 48 KiB that a block has
UPDATE = 65536  # marks items that belong to no column, as in solvers/panels.py
LATE = -3  # from which downwards the source of an item tells a panel with a late update, as there
FLAGS = UPDATE + 255  # the last step of an item that belongs to one
PARTS = 8  # threads that share the sum of a column in a backward substitution


def item_limit(variant: Variant) -> int:
    """Blocks that a round may hold in registers."""
    return ITEMS * THREADS if variant.world_fastest else ITEMS_ALONE


def stage_limit(variant: Variant) -> int:
    """Blocks of L that a round may hold in shared memory."""
    return STAGE_BYTES // (9 * wp.types.type_size_in_bytes(variant.real))


# The CPU runs these kernels in tests only, with one thread per block.
_BARRIER = """
#if defined(__CUDA_ARCH__)
__syncthreads();
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


@wp.func_native(_BARRIER)
def barrier():
    """Wait for all threads of the block; their writes are visible after it."""


def shared_memory(real: Any, count: int) -> str:
    """Native code that reads or writes one of ``count`` scalars in memory that the threads of a block share."""
    return _SHARED.replace("SCALAR", "double" if real is wp.float64 else "float").replace("COUNT", str(count))


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Cooperative kernels of one world per thread block, for variants without lanes."""
    S = variant.S
    module = variant.module("cholesky_panel")
    items = ITEMS if variant.world_fastest else ITEMS_ALONE
    diagonal_inverse = cholesky.kernels(variant).diagonal_inverse
    mat = wp.types.matrix((3, 3), dtype=S)
    vec = wp.types.vector(3, dtype=S)
    held = wp.types.vector(9 * items, dtype=S)
    integers = wp.types.vector(items, dtype=wp.int32)

    @wp.func_native(shared_memory(S, 9 * SLOTS))
    def slot_entry(place: int, value: S, write: bool) -> S: ...

    @wp.func_native(shared_memory(S, 9 * stage_limit(variant)))
    def stage_entry(place: int, value: S, write: bool) -> S: ...

    @wp.func
    def take(slot: int):
        """A block of a column in elimination."""
        z = S(0.0)
        return mat(
            slot_entry(slot, z, False),
            slot_entry(slot + wp.static(SLOTS), z, False),
            slot_entry(slot + wp.static(2 * SLOTS), z, False),
            slot_entry(slot + wp.static(3 * SLOTS), z, False),
            slot_entry(slot + wp.static(4 * SLOTS), z, False),
            slot_entry(slot + wp.static(5 * SLOTS), z, False),
            slot_entry(slot + wp.static(6 * SLOTS), z, False),
            slot_entry(slot + wp.static(7 * SLOTS), z, False),
            slot_entry(slot + wp.static(8 * SLOTS), z, False),
        )

    @wp.func
    def put(slot: int, s: mat):
        """Show a block to the other threads."""
        for r in range(3):
            for c in range(3):
                slot_entry(slot + (3 * r + c) * wp.static(SLOTS), s[r, c], True)

    @wp.func
    def get(s: held, i: int):
        """Block ``i`` of a thread."""
        k = 9 * i
        return mat(s[k], s[k + 1], s[k + 2], s[k + 3], s[k + 4], s[k + 5], s[k + 6], s[k + 7], s[k + 8])

    @wp.func
    def start(a: wp.array2d(dtype=S), w: int, source: int):
        """Block of A, of the identity (-2), or zero (-1)."""
        s = mat()
        if source >= 0:
            k = 9 * source
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
        elif source == -2:
            s = mat(S(1.0), S(0.0), S(0.0), S(0.0), S(1.0), S(0.0), S(0.0), S(0.0), S(1.0))
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
    def product(lower: wp.array2d(dtype=S), w: int, i: int, j: int, columns: int, rows: int):
        """``sum_k L_ik L_jk'`` over the columns of a panel."""
        m = mat()
        for k in range(columns):
            step = 9 * rows * k
            m += block(lower, w, i + step, rows) * wp.transpose(block(lower, w, j + step, rows))
        return m

    @wp.kernel(module=module, enable_backward=False, launch_bounds=THREADS)
    def factor_panels(
        # Symbolic
        round_count: int,
        round_item: wp.array(dtype=wp.int32),
        round_width: wp.array(dtype=wp.int32),
        item_source: wp.array(dtype=wp.vec4i),
        item_place: wp.array(dtype=wp.vec4i),
        child: wp.array(dtype=wp.vec2i),
        late: wp.array(dtype=wp.vec2i),
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
            for i in range(wp.static(items)):
                item = thread + i * threads
                order[i] = -wp.static(UPDATE)  # no item: never at a step
                if item < count:
                    source = item_source[begin + item]
                    place = item_place[begin + item]
                    left[i] = place[0]
                    right[i] = place[1]
                    order[i] = place[2]
                    m = start(a_in, w, source[2])
                    for p in range(source[0], source[1]):
                        m += block(update_out, w, child[p][0], child[p][1])
                    if source[2] <= wp.static(LATE):
                        panel = late[wp.static(LATE) - source[2]]
                        m -= product(lower_out, w, place[0], place[1], panel[0], panel[1])
                    for r in range(3):
                        for c in range(3):
                            s[9 * i + 3 * r + c] = m[r, c]
            for step in range(round_width[turn]):
                for i in range(wp.static(items)):
                    if order[i] == step and left[i] == right[i]:
                        i00, i10, i11, i20, i21, i22 = diagonal_inverse(
                            s[9 * i], s[9 * i + 3], s[9 * i + 4], s[9 * i + 6], s[9 * i + 7], s[9 * i + 8]
                        )
                        put(left[i] - step - 2, mat(i00, S(0.0), S(0.0), i10, i11, S(0.0), i20, i21, i22))
                barrier()
                for i in range(wp.static(items)):
                    if order[i] & wp.static(FLAGS) == step and left[i] != right[i]:
                        m = get(s, i) * wp.transpose(take(right[i] - step - 2))
                        put(left[i], m)
                        for r in range(3):
                            for c in range(3):
                                s[9 * i + 3 * r + c] = m[r, c]
                barrier()
                for i in range(wp.static(items)):
                    if order[i] & 255 > step and (order[i] >> 8) & 255 <= step:
                        m = take(left[i]) * wp.transpose(take(right[i]))
                        for r in range(3):
                            for c in range(3):
                                s[9 * i + 3 * r + c] -= m[r, c]
            for i in range(wp.static(items)):
                item = thread + i * threads
                if item < count:
                    target = item_source[begin + item][3]
                    stride = item_place[begin + item][3]
                    if order[i] >= wp.static(UPDATE):
                        for c in range(3):
                            for r in range(3):
                                update_out[w, target + (3 * c + r) * stride] = s[9 * i + 3 * r + c]
                    elif target >= 0:
                        for c in range(3):
                            for r in range(3):
                                lower_out[w, target + (3 * c + r) * stride] = s[9 * i + 3 * r + c]
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
        """Part of L into shared memory, with many loads under way at a time."""
        for k in range(begin + thread, end, threads):
            stage_entry(k - begin, lower[w, k], True)

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
        # Workspace out
        part_out: wp.array2d(dtype=S),
        half_out: wp.array2d(dtype=S),
        y_out: wp.array2d(dtype=S),
    ):
        """y <- L^-1 y for the first right-hand sides of one world; ``half`` has them by column in order of rounds."""
        w, thread = wp.tid()
        for turn in range(turn_count):
            begin = turn_column[turn]
            columns = turn_column[turn + 1] - begin
            first_row = turn_row[turn]
            rows = turn_row[turn + 1] - first_row
            lower = turn_lower[turn]
            load_stage(lower_in, w, lower, turn_lower[turn + 1], thread, threads)
            for task in range(thread, columns * sides, threads):
                q = begin + task % columns
                side = task // columns
                t = read(y_out, w, 3 * (side * size + column[q][0]))
                for p in range(column_part[q], column_part[q + 1]):
                    t -= read(part_out, w, 3 * (side * row_count + part[p]))
                write(half_out, w, scratch + 3 * task, t)
            barrier()
            for task in range(thread, columns * sides, threads):
                q = begin + task % columns
                side = task // columns
                entry = column[q]
                first = scratch + 3 * (task - entry[1])
                k = entry[2]
                t = vec()
                for p in range(entry[1] + 1):
                    inverse = staged(entry[3] - lower + p * k + entry[1], k * k)
                    t += wp.transpose(inverse) * read(half_out, w, first + 3 * p)
                write(half_out, w, 3 * (side * size + q), t)
                write(y_out, w, 3 * (side * size + entry[0]), t)
            barrier()
            for task in range(thread, rows * sides, threads):
                at = first_row + task % rows
                side = task // rows
                entry = row[at]
                k = entry[0] - lower
                y = 3 * (side * size + entry[3])
                t = vec()
                for p in range(row_part[at], row_part[at + 1]):
                    t += read(part_out, w, 3 * (side * row_count + part[p]))
                for _p in range(entry[2]):
                    t += staged(k, entry[1]) * read(half_out, w, y)
                    k += 9 * entry[1]
                    y += 3
                write(part_out, w, 3 * (side * row_count + at), t)
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
        # Workspace in
        lower_in: wp.array2d(dtype=S),
        # Workspace out
        part_out: wp.array2d(dtype=S),
        half_out: wp.array2d(dtype=S),
        y_out: wp.array2d(dtype=S),
    ):
        """y <- L^-T y for the first right-hand side of one world."""
        w, thread = wp.tid()
        for back in range(turn_count):
            turn = turn_count - 1 - back
            begin = turn_column[turn]
            columns = turn_column[turn + 1] - begin
            lower = turn_lower[turn]
            load_stage(lower_in, w, lower, turn_lower[turn + 1], thread, threads)
            barrier()
            for task in range(thread, columns * wp.static(PARTS), threads):
                q = begin + task // wp.static(PARTS)
                entry = column_lower[q]
                k = entry[0] - lower + 9 * column[q][1] * entry[1]
                t = vec()
                for at in range(task % wp.static(PARTS), entry[1], wp.static(PARTS)):
                    x = read(half_out, w, 3 * row_index[entry[2] + at])
                    t += wp.transpose(staged(k + at, entry[1])) * x
                write(part_out, w, 3 * task, t)
            barrier()
            for task in range(thread, columns, threads):
                t = read(y_out, w, 3 * column[begin + task][0])
                for p in range(wp.static(PARTS)):
                    t -= read(part_out, w, 3 * (task * wp.static(PARTS) + p))
                write(half_out, w, scratch + 3 * task, t)
            barrier()
            for task in range(thread, columns, threads):
                q = begin + task
                entry = column[q]
                first = scratch + 3 * (task - entry[1])
                k = entry[2]
                t = vec()
                for p in range(entry[1], k):
                    t += staged(entry[3] - lower + entry[1] * k + p, k * k) * read(half_out, w, first + 3 * p)
                write(half_out, w, 3 * q, t)
                write(y_out, w, 3 * entry[0], t)
            barrier()

    return SimpleNamespace(
        factor_panels=factor_panels, forward_panels=forward_panels, backward_panels=backward_panels, block=block
    )
