"""Newton's systems of a world's rows and contacts on a GPU: where they lie, and how the threads of a warp solve them.

Theory: docs/theory/coulomb.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.linear.cholesky_panels import name_of
from softwarp.kernels.rows.coulomb_tiers import LINES

MOST = 95  # rows of a system up to which it is solved: all worlds wait for the one that takes longest
ENDLESS = 1.0e30

# A line of the system: one entry per unknown, the right side, and behind the last one 1 / pivot. Threads own columns;
# the solution ends in the column of the right side.
_SOLVE = """
SCALAR* const far = (SCALAR*)&wp::index(system_out, w, 0);
#if NEAR > 0
#if defined(__CUDA_ARCH__)
__shared__ SCALAR near[(NEAR + LINES) * (NEAR + 2)];
#else
static SCALAR near[(NEAR + LINES) * (NEAR + 2)];
#endif
const bool is_near = unknowns <= NEAR;
if (!solves) return (wp::uint64)(size_t)(is_near ? near : far);
#else
if (!solves) return (wp::uint64)(size_t)far;
#endif
#if defined(__CUDA_ARCH__)
#define MEET __syncwarp();
#define TELL(value, source) __shfl_sync(0xffffffffu, value, source)
#else
static SCALAR slot;
#define MEET WP_TILE_SYNC();
#define TELL(value, source) ({ if (thread == source) slot = value; MEET const SCALAR told = slot; MEET told; })
#endif
// Two pivots at a time. Loads of a group of lines, the first one before the pivots are inverted, wait for no store, and
// no load asks whether it must: lines behind the last one may be read and written, and a thread without a column of its
// own reads that of the right side.
// ``columns`` has the size of a thread's share of the columns, ``entries`` that of a line, if it is known.
auto solved = [&](const auto& columns, SCALAR* const a, const auto& entries) {
    const int COLUMNS = sizeof(columns), pitch = sizeof(entries) > 1 ? sizeof(entries) : stride;
    SCALAR* own[COLUMNS];
    #pragma unroll
    for (int m = 0; m < COLUMNS; ++m) own[m] = a + (thread + 32 * m < unknowns ? thread + 32 * m : unknowns);
    for (int k = 0; k < unknowns; k += 2) {
        SCALAR* const pivots = a + k * pitch;
        SCALAR* const others = pivots + pitch;
        const bool is_pair = k + 1 < unknowns;
        const SCALAR pivot = pivots[k], least = pivots[unknowns + 1], right = pivots[k + 1];
        const SCALAR below = others[k], corner = others[k + 1], lesser = others[unknowns + 1];
        SCALAR inverse = 0, reciprocal = 0, beside = 0, top[COLUMNS], next[COLUMNS];
        bool is_own[COLUMNS];
        #pragma unroll
        for (int m = 0; m < COLUMNS; ++m) {
            const int c = thread + 32 * m;
            is_own[m] = c > k + 1 && c <= unknowns;
            top[m] = own[m][k * pitch];
            next[m] = own[m][(k + 1) * pitch];
        }
        bool is_first = true;
        int r = is_pair ? k + 2 : unknowns;
        do {
            SCALAR factor[LINES], further[LINES], entry[COLUMNS][LINES];
            const SCALAR* const line = a + r * pitch + k;
            #pragma unroll
            for (int i = 0; i < LINES; ++i) {
                factor[i] = line[i * pitch];
                further[i] = line[i * pitch + 1];
                #pragma unroll
                for (int m = 0; m < COLUMNS; ++m) entry[m][i] = own[m][(r + i) * pitch];
            }
            if (is_first) {
                inverse = (pivot < 0 ? -pivot : pivot) > least ? (SCALAR)1 / pivot : (SCALAR)0;
                beside = right * inverse;
                const SCALAR second = corner - below * beside;
                reciprocal = (second < 0 ? -second : second) > lesser ? (SCALAR)1 / second : (SCALAR)0;
                #pragma unroll
                for (int m = 0; m < COLUMNS; ++m) {
                    top[m] *= inverse;
                    next[m] -= below * top[m];
                    if (is_own[m]) own[m][(k + 1) * pitch] = next[m];
                    next[m] *= reciprocal;
                }
                is_first = false;
            }
            #pragma unroll
            for (int i = 0; i < LINES; ++i) {
                further[i] -= factor[i] * beside;
                #pragma unroll
                for (int m = 0; m < COLUMNS; ++m) {
                    entry[m][i] = entry[m][i] - factor[i] * top[m] - further[i] * next[m];
                    if (is_own[m]) own[m][(r + i) * pitch] = entry[m][i];
                }
            }
            r += LINES;
        } while (r < unknowns);
        MEET
        if (thread == 0) {
            pivots[unknowns + 1] = inverse;
            if (is_pair) others[unknowns + 1] = reciprocal;
        }
    }
    MEET
    SCALAR x[COLUMNS], total = 0;
    const SCALAR* line[COLUMNS];
    #pragma unroll
    for (int m = 0; m < COLUMNS; ++m) {
        const int u = thread + 32 * m;
        line[m] = a + (u < unknowns ? u : unknowns - 1) * pitch;
        x[m] = line[m][unknowns];
    }
    #pragma unroll
    for (int part = COLUMNS - 1; part >= 0; --part) {
        const int end = unknowns < 32 * part + 32 ? unknowns : 32 * part + 32;
        #pragma unroll 4
        for (int k = end - 1; k >= 32 * part; --k) {
            const SCALAR told = TELL(x[part], k % 32) * a[k * pitch + unknowns + 1];
            total += told;
            #pragma unroll
            for (int m = 0; m <= part; ++m) {
                const int u = thread + 32 * m;
                const SCALAR less = x[m] - line[m][k] * told;
                x[m] = u < k ? less : u == k ? told : x[m];
            }
        }
    }
    #pragma unroll
    for (int m = 0; m < COLUMNS; ++m)
        if (thread + 32 * m < unknowns) a[(thread + 32 * m) * pitch + unknowns] = x[m];
    MEET
    return total;
};
const char one[1] = {}, two[2] = {}, all[MOST / 32 + 1] = {};
SCALAR total;
#if NEAR > 0
const char entries[NEAR + 2] = {};
if (is_near) {
    if (unknowns < 32) total = solved(one, near, entries);
    else if (unknowns < 64) total = solved(two, near, entries);
    else total = solved(all, near, entries);
} else
#endif
if (unknowns < 32) total = solved(one, far, one);
else if (unknowns < 64) total = solved(two, far, one);
else total = solved(all, far, one);
#undef MEET
#undef TELL
return (total < 0 ? -total : total) < ENDLESS ? 0 : 1;
"""


def stride_of(rows: int) -> int:
    """Entries of a line of the system of a world with so many rows: unknowns, right side, reciprocal pivot."""
    return min(rows, MOST) + 2


def entries(rows: int) -> int:
    """Entries of the system of a world with so many rows."""
    return (min(rows, MOST) + LINES) * stride_of(rows)


@cache
def functions(variant: Variant, near_unknowns: int) -> SimpleNamespace:
    """``system_of``, ``put`` and ``got`` for one scalar type of the ``cuda`` variant.

    Systems of up to ``near_unknowns`` lie in shared memory, which one world then has to itself.
    """
    real = variant.real
    source = _SOLVE.replace("SCALAR", name_of(real)).replace("MOST", str(MOST)).replace("ENDLESS", str(ENDLESS))

    @wp.func_native(source.replace("NEAR", str(near_unknowns)).replace("LINES", str(LINES)))
    def system_of(
        system_out: wp.array2d(dtype=real), w: int, thread: int, unknowns: int, stride: int, solves: bool
    ) -> wp.uint64:
        """Address of the first line of a world's system; or solve it, and 1 if a number of the solution is endless."""

    @wp.func_native(f"(({name_of(real)}*)system_out)[entry] = value;")
    def put(system_out: wp.uint64, entry: int, value: real): ...

    @wp.func_native(f"return (({name_of(real)}*)system)[entry];")
    def got(system: wp.uint64, entry: int) -> real: ...

    return SimpleNamespace(system_of=system_of, put=put, got=got)
