"""What the threads of a warp own of a world's rows and contacts, and how they tell each other of it.

Static row r belongs to thread r mod 32, and so does contact c; a thread keeps three numbers of a contact. Sums and
columns of W come from here to the sweeps of ``coulomb_warp`` and to ``coulomb_warp_newton``.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.linear.cholesky_panels import name_of
from softwarp.kernels.rows.coulomb_tiers import WIDTH

COPIED_ROWS = 8  # of the matrix that are on their way to shared memory at once

# Threads without a contact of their own read what the last one has, which costs less than to ask each time.
_NEAR = """
#if defined(__CUDA_ARCH__)
__shared__ SCALAR near[SIZE];
#else
static SCALAR near[SIZE];
#endif
wp::vec_t<OWN_ROWS + 3 * OWN, SCALAR> share;
if (writes) {
    near[place] = value;
    return share;
}
const int own = j * (j + 1) / 2;
#pragma unroll
for (int k = 0; k < OWN_ROWS; ++k) {
    const int i = thread + 32 * k;
    share[k] = i < rows ? near[i < j ? own + i : i * (i + 1) / 2 + j] : (SCALAR)0;
}
if (count > 0) {
    #pragma unroll
    for (int k = 0; k < OWN; ++k) {
        const int i = rows + 3 * (thread + 32 * k < count ? thread + 32 * k : count - 1), line = i * (i + 1) / 2;
        const int lines[3] = {line, line + i + 1, line + 2 * i + 3};
        #pragma unroll
        for (int axis = 0; axis < 3; ++axis)
            share[OWN_ROWS + 3 * k + axis] = near[i + axis < j ? own + i + axis : lines[axis] + j];
    }
}
return share;
"""

# Numbers of a line of W that stand behind one another: one address for a contact's three.
_FAR = """
const SCALAR* const line = &wp::index(delassus, w, j * order);
wp::vec_t<OWN_ROWS + 3 * OWN, SCALAR> share;
#pragma unroll
for (int k = 0; k < OWN_ROWS; ++k) {
    const int row = thread + 32 * k;
    share[k] = row < rows ? line[row] : (SCALAR)0;
}
if (count > 0) {
    #pragma unroll
    for (int k = 0; k < OWN; ++k) {
        const int contact = thread + 32 * k < count ? thread + 32 * k : count - 1;
        const SCALAR* const own = line + rows + 3 * contact;
        #pragma unroll
        for (int axis = 0; axis < 3; ++axis) share[OWN_ROWS + 3 * k + axis] = own[axis];
    }
}
return share;
"""

# Where the threads of a warp are fibers of a block on a CPU, which tests use, they tell each other through memory.
_ALL = """
#if defined(__CUDA_ARCH__)
ON_A_GPU
#else
static TYPE slots[32];
slots[WP_TILE_THREAD_IDX] = VALUE;
WP_TILE_SYNC();
RESULT
WP_TILE_SYNC();
return result;
#endif
"""


def everyone(on_gpu: str, kind: str, value: str, result: str) -> str:
    """Native code of an exchange: on a GPU, and from what all threads have put into ``slots``."""
    return _ALL.replace("ON_A_GPU", on_gpu).replace("TYPE", kind).replace("VALUE", value).replace("RESULT", result)


def from_source(kind: str) -> str:
    """Native code of what one thread tells all others."""
    on_gpu = "return __shfl_sync(0xffffffffu, value, source);"
    return everyone(on_gpu, kind, "value", f"const {kind} result = slots[source];")


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncwarp();
#else
WP_TILE_SYNC();
#endif
""")
def meet():
    """Wait for the threads of the warp; their writes are visible after it."""


@wp.func_native(
    everyone(
        "return __ffs(__ballot_sync(0xffffffffu, flag)) - 1;",
        "bool",
        "flag",
        "int result = -1;\nfor (int k = 31; k >= 0; --k) if (slots[k]) result = k;",
    )
)
def first_thread(flag: bool) -> int:
    """The first thread whose flag is set; -1 for none."""


@wp.func_native(
    everyone(
        "return (int)__ballot_sync(0xffffffffu, flag);",
        "bool",
        "flag",
        "unsigned bits = 0;\nfor (int k = 0; k < 32; ++k) bits |= (unsigned)slots[k] << k;\nconst int result = bits;",
    )
)
def threads_with(flag: bool) -> int:
    """A bit for each thread, set where its flag is."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __ffs(bits) - 1;
#else
return __builtin_ffs(bits) - 1;
#endif
""")
def lowest_bit(bits: int) -> int:
    """Number of the lowest bit that is set; -1 for none."""


@wp.func_native("return (int)((unsigned)bits & ((unsigned)bits - 1u));")
def without_lowest(bits: int) -> int:
    """The same bits but for the lowest one that is set."""


@wp.func_native(from_source("int"))
def told_number(value: int, source: int) -> int:
    """The whole number of one thread."""


@wp.func_native(
    everyone(
        """
const unsigned units = __ballot_sync(0xffffffffu, count & 1), pairs = __ballot_sync(0xffffffffu, count & 2);
const unsigned before = (1u << thread) - 1u;
return __popc(units & before) + 2 * __popc(pairs & before) + ((__popc(units) + 2 * __popc(pairs)) << 16);
""",
        "int",
        "count",
        "int result = 0;\nfor (int k = 0; k < 32; ++k) result += slots[k] * (k < thread ? 65537 : 65536);",
    )
)
def places(count: int, thread: int) -> int:
    """Sum of ``count``, 0 to 3, over the threads before this one, and 65536 times that over all."""


@cache
def functions(variant: Variant, own_rows: int, own_contacts: int, near_rows: int) -> SimpleNamespace:
    """Functions for one scalar type of the ``cuda`` variant.

    Args:
        variant: Scalar type.
        own_rows: Static rows that a thread owns at most.
        own_contacts: Contacts that a thread owns at most.
        near_rows: Rows of W that fit into shared memory, which one world then has to itself; 0 for none.
    """
    real = variant.real
    Owned = wp.types.vector(own_rows + 3 * own_contacts, real)  # static rows, then the rows of contacts
    Copied = wp.types.vector(COPIED_ROWS, real)

    exchanged = f"const {name_of(real)} result = slots[WP_TILE_THREAD_IDX ^ offset];"

    @wp.func_native(everyone("return __shfl_xor_sync(0xffffffffu, value, offset);", name_of(real), "value", exchanged))
    def exchange(value: real, offset: int) -> real:
        """The value of the thread whose number differs in the bits of ``offset``."""

    @wp.func_native(from_source(name_of(real)))
    def told(value: real, source: int) -> real:
        """The value of one thread."""

    @wp.func
    def warp_sum(value: real):
        """Sum over the threads, the same bits in each."""
        total = value
        total += exchange(total, 16)
        total += exchange(total, 8)
        total += exchange(total, 4)
        total += exchange(total, 2)
        total += exchange(total, 1)
        return total

    @wp.func
    def warp_max(value: real):
        """Largest value of the threads."""
        most = value
        most = wp.max(most, exchange(most, 16))
        most = wp.max(most, exchange(most, 8))
        most = wp.max(most, exchange(most, 4))
        most = wp.max(most, exchange(most, 2))
        most = wp.max(most, exchange(most, 1))
        return most

    @wp.func
    def load(source: wp.array2d(dtype=real), w: int, begin: int, thread: int, rows: int, count: int):
        """The thread's share of ``total`` entries from ``begin`` on; 0 where it owns nothing."""
        share = Owned()
        for k in range(wp.static(own_rows)):
            row = thread + wp.static(WIDTH) * k
            if row < rows:
                share[k] = source[w, begin + row]
        for k in range(wp.static(own_contacts)):
            contact = thread + wp.static(WIDTH) * k
            if contact < count:
                i = begin + rows + 3 * contact
                for axis in range(3):
                    share[wp.static(own_rows) + 3 * k + axis] = source[w, i + axis]
        return share

    @wp.func
    def store(target: wp.array2d(dtype=real), share: Owned, w: int, begin: int, thread: int, rows: int, count: int):
        """The inverse of ``load``."""
        for k in range(wp.static(own_rows)):
            row = thread + wp.static(WIDTH) * k
            if row < rows:
                target[w, begin + row] = share[k]
        for k in range(wp.static(own_contacts)):
            contact = thread + wp.static(WIDTH) * k
            if contact < count:
                i = begin + rows + 3 * contact
                for axis in range(3):
                    target[w, i + axis] = share[wp.static(own_rows) + 3 * k + axis]

    near_source = _NEAR.replace("SCALAR", name_of(real)).replace("SIZE", str(max(near_rows * (near_rows + 1) // 2, 1)))

    @wp.func_native(near_source.replace("OWN_ROWS", str(own_rows)).replace("OWN", str(own_contacts)))
    def near_share(j: int, thread: int, rows: int, count: int, place: int, value: real, writes: bool) -> Owned:
        """The thread's entries of column j of the lower triangle in shared memory; or write one entry of that."""

    @wp.func
    def bring_near(delassus: wp.array2d(dtype=real), w: int, order: int, thread: int, total: int):
        """Copy the lower triangle of W to shared memory, row after row."""
        values = Copied()
        for first in range(0, total, wp.static(COPIED_ROWS)):
            for column in range(thread, wp.min(first + wp.static(COPIED_ROWS), total), wp.static(WIDTH)):
                for k in range(wp.static(COPIED_ROWS)):
                    row = first + k
                    if row < total and column <= row:
                        values[k] = delassus[w, row * order + column]
                for k in range(wp.static(COPIED_ROWS)):
                    row = first + k
                    if row < total and column <= row:
                        near_share(0, thread, 0, 0, row * (row + 1) / 2 + column, values[k], True)
        meet()

    @wp.func
    def near_column(delassus: wp.array2d(dtype=real), w: int, order: int, j: int, thread: int, rows: int, count: int):
        """The thread's entries of column j of W, from shared memory; any number where it owns nothing."""
        return near_share(j, thread, rows, count, 0, real(0.0), False)

    @wp.func_native(
        _FAR.replace("SCALAR", name_of(real)).replace("OWN_ROWS", str(own_rows)).replace("OWN", str(own_contacts))
    )
    def far_column(
        delassus: wp.array2d(dtype=real), w: int, order: int, j: int, thread: int, rows: int, count: int
    ) -> Owned:
        """The same of column j of W, which is symmetric, from a row of it in the device's memory."""

    column = near_column if near_rows else far_column

    @wp.func
    def moved_gaps(
        delassus: wp.array2d(dtype=real),
        before: Owned,
        change: Owned,
        w: int,
        thread: int,
        order: int,
        rows: int,
        count: int,
    ):
        """Gaps after a change of multipliers, of which each thread has what it owns."""
        gap = before
        for k in range(wp.static(own_rows)):
            for owner in range(wp.min(rows - wp.static(WIDTH) * k, wp.static(WIDTH))):
                d = told(change[k], owner)
                if d != real(0.0):
                    gap += column(delassus, w, order, owner + wp.static(WIDTH) * k, thread, rows, count) * d
        for k in range(wp.static(own_contacts)):
            e = wp.static(own_rows) + 3 * k
            left = threads_with(change[e] != real(0.0) or change[e + 1] != real(0.0) or change[e + 2] != real(0.0))
            while left != 0:  # columns of two contacts are loaded at a time
                one = lowest_bit(left)
                left = without_lowest(left)
                is_pair = left != 0
                two = wp.where(is_pair, lowest_bit(left), one)
                left = without_lowest(left)
                i = rows + 3 * (one + wp.static(WIDTH) * k)
                j = rows + 3 * (two + wp.static(WIDTH) * k)
                line0 = column(delassus, w, order, i, thread, rows, count)
                line1 = column(delassus, w, order, i + 1, thread, rows, count)
                line2 = column(delassus, w, order, i + 2, thread, rows, count)
                next0 = column(delassus, w, order, j, thread, rows, count)
                next1 = column(delassus, w, order, j + 1, thread, rows, count)
                next2 = column(delassus, w, order, j + 2, thread, rows, count)
                gap += line0 * told(change[e], one)
                gap += line1 * told(change[e + 1], one)
                gap += line2 * told(change[e + 2], one)
                share = wp.where(is_pair, real(1.0), real(0.0))
                gap += next0 * (share * told(change[e], two))
                gap += next1 * (share * told(change[e + 1], two))
                gap += next2 * (share * told(change[e + 2], two))
        return gap

    return SimpleNamespace(
        Owned=Owned,
        exchange=exchange,
        told=told,
        warp_sum=warp_sum,
        warp_max=warp_max,
        load=load,
        store=store,
        bring_near=bring_near,
        column=column,
        moved_gaps=moved_gaps,
    )
