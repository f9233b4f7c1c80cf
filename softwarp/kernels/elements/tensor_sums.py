"""Stiffness of reduced bodies in modes on a GPU's tensor cores: the sums of ``samples`` in one kernel, K E kept near.

A block of threads has two worlds, two warps for each. It takes eight samples at a time, and two rows of each in a
round. K E of some rounds lie in shared memory; the two warps of a world share the tiles, 16 x 8 modes, of the lower
triangle of the ``E' (K E)`` that they add up in registers. Tensor cores take factors of 11 bits. Each number is
therefore the sum of two of float16, a = a1 + a2, and a b is a2 b1 + a1 b2 + a1 b1, so that what is left out is about
what a product of float32 rounds. E is split ahead of time (``fragments``), in the order in which threads of a warp hold
it; K E once by the thread that finds it. Powers of two bring both to where float16 has its range: one for E, and for
K E of a world one for every eight samples, from the largest entry of K in them. Tensor cores also round sums towards
zero; so they only add up sixteen terms, and what comes of it is added as other numbers are. The order of sums is fixed
and the same for every world. Theory: docs/theory/reduction.md.
"""

import re
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.elements.samples import TET, TRI

GROUP = 2  # worlds of a block
THREADS = 128  # of a block
WIDEST = 96  # modes of a body, whose sums the registers of two warps hold
OLDEST = 80  # compute capability from which tensor cores take numbers of float32's range
BLOCKS = 2  # at once on a multiprocessor, which bounds the registers of a thread
TOP = 14  # binary logarithm of the bound that factors of float16 are brought to
TOGETHER = 8  # samples in a round
CHUNK = 2  # rounds whose K E lie in shared memory

# Samples of one kind, SIZE rows of E each, in PAIRS rounds. K of eight samples lies pair by pair of its rows, those of
# both worlds beside each other. What a thread takes of E serves CHUNK rounds; warps then meet, and again behind their
# products. K of the next samples comes meanwhile.
_ADD = """
{
const int most = COUNT, stages = (most + 7) / 8, t = thread >> 4, c = 2 * (thread & 15);
const float* e = BASIS.data + E_FIRST + c;
const uint4* halves = (const uint4*)HALVES.data + (thread & 31);
const long long across = STIFFNESS.strides[1] / sizeof(float);
const float* k = &wp::index(STIFFNESS, group * 2 + (group * 2 + (thread & 1) < worlds ? (thread & 1) : 0), K_FIRST);
float held[PAIRS * SIZE / 4 + 1];
float2 own[SIZE][PIECES];
auto fetch = [&](int sample) {
    #pragma unroll
    for (int p = 0; p < PAIRS * SIZE / 4 + 1; ++p) {
        const int q = (128 * p + thread) >> 1, s = q / (2 * PAIRS * SIZE), at = q % (2 * PAIRS * SIZE);
        held[p] = q < 16 * PAIRS * SIZE && sample + s < most && at < SIZE * SIZE
            ? k[((long long)(sample + s) * (SIZE * SIZE) + at) * across] : 0.0f;
    }
};
auto keep = [&]() {
    unsigned largest = 0;
    #pragma unroll
    for (int p = 0; p < PAIRS * SIZE / 4 + 1; ++p) {
        const int q = (128 * p + thread) >> 1, s = q / (2 * PAIRS * SIZE), at = q % (2 * PAIRS * SIZE);
        const int row = at / SIZE;
        if (q < 16 * PAIRS * SIZE)
            near_k[4 * ((s * PAIRS + row / 2) * SIZE + at % SIZE) + 2 * (thread & 1) + (row & 1)] = held[p];
        largest = max(largest, __float_as_uint(held[p]) & 0x7fffffffu);
    }
    #pragma unroll
    for (int far = 2; far < 32; far *= 2) largest = max(largest, __shfl_xor_sync(0xffffffffu, largest, far));
    if ((thread & 31) < 2) near_most[4 * (thread & 1) + (thread >> 5)] = largest;
};
auto exponent = [&](int world) {
    unsigned largest = 0;
    #pragma unroll
    for (int q = 0; q < 4; ++q) largest = max(largest, near_most[4 * world + q]);
    return max((int)(__float_as_uint(__uint_as_float(largest) * (SIZE * MOST)) >> 23) & 255, 20);
};
auto rows = [&](int sample) {
    const float* mine = e + (long long)(sample + t < most ? sample + t : 0) * (SIZE * MODES);
    #pragma unroll
    for (int a = 0; a < SIZE; ++a)
        #pragma unroll
        for (int p = 0; p < PIECES; ++p)
            if (c + 32 * p < MODES) own[a][p] = *(const float2*)&mine[a * MODES + 32 * p];
};
__syncthreads();
if (stages > 0) {
    fetch(0);
    keep();
    fetch(8);
}
__syncthreads();
for (int stage = 0; stage < stages; ++stage) {
    const int mine = exponent(thread >> 6);
    const float back = __uint_as_float((unsigned)(mine + 1 - TOP) << 23) * BACK;
    const float scales[2] = {__uint_as_float((unsigned)(253 + TOP - exponent(0)) << 23),
                             __uint_as_float((unsigned)(253 + TOP - exponent(1)) << 23)};
    #pragma unroll
    for (int part = 0; part < PAIRS; part += CHUNK) {
        rows(8 * stage);
        #pragma unroll
        for (int r = part; r < (part + CHUNK < PAIRS ? part + CHUNK : PAIRS); ++r) {
            float2 sum[4][PIECES];
            #pragma unroll
            for (int i = 0; i < 4; ++i)
                #pragma unroll
                for (int p = 0; p < PIECES; ++p) sum[i][p] = make_float2(0.0f, 0.0f);
            #pragma unroll
            for (int a = 0; a < SIZE; ++a) {
                const float4 g = *(const float4*)&near_k[4 * ((t * PAIRS + r) * SIZE + a)];
                #pragma unroll
                for (int p = 0; p < PIECES; ++p) {
                    sum[0][p].x += g.x * own[a][p].x, sum[0][p].y += g.x * own[a][p].y;
                    sum[1][p].x += g.y * own[a][p].x, sum[1][p].y += g.y * own[a][p].y;
                    sum[2][p].x += g.z * own[a][p].x, sum[2][p].y += g.z * own[a][p].y;
                    sum[3][p].x += g.w * own[a][p].x, sum[3][p].y += g.w * own[a][p].y;
                }
            }
            #pragma unroll
            for (int world = 0; world < 2; ++world)
                #pragma unroll
                for (int p = 0; p < PIECES; ++p)
                    if (c + 32 * p < MODES) {
                        const float scale = scales[world];
                        uint2 head, tail;
                        split(sum[2 * world][p].x * scale, sum[2 * world + 1][p].x * scale, head.x, tail.x);
                        split(sum[2 * world][p].y * scale, sum[2 * world + 1][p].y * scale, head.y, tail.y);
                        *(uint2*)&near_y[r - part][world][t][c + 32 * p] = head;
                        *(uint2*)&near_y[r - part][world][8 + t][c + 32 * p] = tail;
                    }
        }
        __syncthreads();
        if (part + CHUNK >= PAIRS) {
            keep();
            fetch(8 * stage + 16);
        }
        #pragma unroll 1
        for (int r = part; r < (part + CHUNK < PAIRS ? part + CHUNK : PAIRS); ++r) {
            const uint4* x = halves + (long long)(stage * PAIRS + r) * (64 * ROWS);
            const unsigned* y = &near_y[r - part][thread >> 6][lane][high];
            uint4 a1[OWN], a2[OWN];
            unsigned b1[2], b2[2];
            if (side == 0) {
                MULTIPLY_0
            } else {
                MULTIPLY_1
            }
        }
        __syncthreads();
    }
}
}
"""

# What one warp does in a round: its rows of tiles of E, then column by column K E, and a ``_PRODUCT`` for each tile.
_LOAD = "a1[M] = x[64 * ROW], a2[M] = x[64 * ROW + 32];"
_COLUMN = """
b1[0] = y[8 * J], b1[1] = y[4 * WIDE + 8 * J], b2[0] = y[8 * WIDE + 8 * J], b2[1] = y[12 * WIDE + 8 * J];
"""
_PRODUCT = """
{
    float d[4], zero[4] = {0.0f, 0.0f, 0.0f, 0.0f};
    multiply(d, a2[M], b1, zero);
    multiply(d, a1[M], b2, d);
    multiply(d, a1[M], b1, d);
    s[M][J][0] += d[0] * back, s[M][J][1] += d[1] * back, s[M][J][2] += d[2] * back, s[M][J][3] += d[3] * back;
}
"""
_WRITE = "out[((ROW + high) * MODES + COLUMN + 2 * lane) * down] = s[M][J][Q];"

_ALL = """
const int worlds = sum_out.shape[0];
#if defined(__CUDA_ARCH__)
#if __CUDA_ARCH__ >= 800
__shared__ __align__(16) unsigned near_y[CHUNK][2][16][WIDE];
__shared__ __align__(16) float near_k[1440];
__shared__ unsigned near_most[8];
const int high = (thread & 31) >> 2, lane = thread & 3, side = (thread >> 5) & 1;
auto split = [](float low, float up, unsigned& head, unsigned& tail) {
    float a, b;
    asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(head) : "f"(up), "f"(low));
    asm("{.reg .f16 l, h; mov.b32 {l, h}, %2; cvt.f32.f16 %0, l; cvt.f32.f16 %1, h;}" : "=f"(a), "=f"(b) : "r"(head));
    asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(tail) : "f"(up - b), "f"(low - a));
};
auto multiply = [](float* d, const uint4& a, const unsigned* b, const float* c) {
    asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, "
        "{%10, %11, %12, %13};"
        : "=f"(d[0]), "=f"(d[1]), "=f"(d[2]), "=f"(d[3])
        : "r"(a.x), "r"(a.y), "r"(a.z), "r"(a.w), "r"(b[0]), "r"(b[1]), "f"(c[0]), "f"(c[1]), "f"(c[2]),
          "f"(c[3]));
};
float s[OWN][TILES][4] = {};
ADD_TETS
ADD_TRIS
const int world = group * 2 + (thread >> 6);
if (world < worlds) {
    const long long down = sum_out.strides[1] / sizeof(float);
    float* out = &wp::index(sum_out, world, sum_first);
    if (side == 0) {
        WRITE_0
    } else {
        WRITE_1
    }
}
#endif
#else
for (int world = group * 2; thread == 0 && world < worlds && world < group * 2 + 2; ++world)
    for (int i = 0; i < MODES; ++i)
        for (int j = 0; j < MODES; ++j) {
            float sum = 0.0f;
            for (int kind = 0; kind < 2; ++kind) {
                const int size = kind ? 6 : 9, first = kind ? tri_first : tet_first;
                const float* e = kind ? tri_basis.data + tri_at : tet_basis.data + tet_at;
                for (int sample = 0; sample < (kind ? tri_count : tet_count); ++sample, e += size * MODES)
                    for (int r = 0; r < size; ++r)
                        for (int c = 0; c < size; ++c) {
                            const int at = first + size * (size * sample + r) + c;
                            const float k = kind ? wp::index(thin_in, world, at) : wp::index(stiffness_in, world, at);
                            sum += e[r * MODES + i] * k * e[c * MODES + j];
                        }
            }
            wp::index(sum_out, world, sum_first + i * MODES + j) = sum;
        }
#endif
"""


def _shared_out(tiles: int) -> tuple[list[int], list[int]]:
    """Rows of tiles of both warps of a world: row r has 2 r + 2 of them."""
    rows: tuple[list[int], list[int]] = ([], [])
    for row in reversed(range(tiles)):
        rows[sum(r + 1 for r in rows[0]) > sum(r + 1 for r in rows[1])].append(row)
    return rows


def _filled(text: str, **values: int | str) -> str:
    """Text with its words in capitals replaced."""
    for name, value in values.items():
        text = re.sub(rf"\b{name}\b", str(value), text)
    return text


def _multiply(rows: list[int]) -> str:
    """How a warp multiplies for its rows of tiles."""
    lines = [_filled(_LOAD, ROW=row, M=m) for m, row in enumerate(rows)]
    for j in range(2 * max(rows, default=-1) + 2):
        lines.append(_filled(_COLUMN, J=j))
        lines += [_filled(_PRODUCT, M=m, J=j) for m, row in enumerate(rows) if j < 2 * row + 2]
    return "\n".join(lines)


def _write(rows: list[int]) -> str:
    """How it writes their sums."""
    return "\n".join(
        _filled(_WRITE, ROW=16 * row + 8 * (q // 2), COLUMN=8 * j + q % 2, M=m, J=j, Q=q)
        for m, row in enumerate(rows)
        for j in range(2 * row + 2)
        for q in range(4)
    )


def _source(modes: int) -> str:
    """Native code for bodies with a stride of some modes."""
    both = _shared_out(modes // 16)
    parts = {f"MULTIPLY_{side}": _multiply(rows) for side, rows in enumerate(both)}
    add = _ADD.replace("PAIRS", "((SIZE + 1) / 2)")
    add = _filled(add, **parts)
    tets = _filled(add, COUNT="tet_count", BASIS="tet_basis", E_FIRST="tet_at", STIFFNESS="stiffness_in")
    tets = _filled(
        tets, HALVES="tet_halves", K_FIRST="tet_first", MOST="tet_most", BACK="tet_back", SIZE=TET, PAIRS=-(-TET // 2)
    )
    tris = _filled(add, COUNT="tri_count", BASIS="tri_basis", E_FIRST="tri_at", STIFFNESS="thin_in")
    tris = _filled(
        tris, HALVES="tri_halves", K_FIRST="tri_first", MOST="tri_most", BACK="tri_back", SIZE=TRI, PAIRS=-(-TRI // 2)
    )
    text = _filled(_ALL, ADD_TETS=tets, ADD_TRIS=tris, WRITE_0=_write(both[0]), WRITE_1=_write(both[1]))
    pieces = -(-modes // 32)
    text = _filled(text, WIDE=32 * pieces + 8, PIECES=pieces, MODES=modes, TOP=TOP, ROWS=modes // 16)
    return _filled(text, OWN=max(map(len, both)), TILES=modes // 8, CHUNK=CHUNK)


@dataclass(frozen=True)
class Fragments:
    """Rows E of the samples of one kind in one body, as tensor cores take them.

    Attributes:
        halves: Pairs of float16, those of two rows: (round, tile of 16 modes, head or tail, thread of a warp, 4).
        most: Largest entry of E.
        back: What their sums are multiplied by.
    """

    halves: npt.NDArray[np.int32]
    most: float
    back: float


def fragments(basis: npt.NDArray[np.float32]) -> Fragments:
    """Split E, shape (sample, row, mode); samples are filled up to eight, rows to pairs, with zeros."""
    count, size, modes = basis.shape
    most = float(np.abs(basis).max(initial=0.0))
    scale = 2.0 ** (TOP - int(np.frexp(most)[1]))
    stages, rounds, tiles = -(-count // TOGETHER), -(-size // 2), modes // 16
    rows = np.zeros((stages * TOGETHER, 2 * rounds, modes), dtype=np.float32)
    rows[:count, :size] = basis * np.float32(scale)
    heads = rows.astype(np.float16)
    halves = np.zeros((stages, rounds, tiles, 2, 32, 4, 2), dtype=np.float16)
    thread = np.arange(32)
    for number, part in enumerate((heads, (rows - heads).astype(np.float16))):
        split = part.reshape(stages, TOGETHER, rounds, 2, tiles, 16)
        for q in range(4):
            sample, mode = thread % 4 + 4 * (q // 2), thread // 4 + 8 * (q % 2)
            for row in range(2):
                halves[:, :, :, number, :, q, row] = np.moveaxis(split[:, sample, :, row, :, mode], 0, -1)
    whole = halves.ravel() if count else np.zeros(8, dtype=np.float16)
    return Fragments(whole.view(np.int32), most, 1.0 / scale)


def serves(device: Any, precision: str, widest: int) -> bool:
    """Whether the kernel is for bodies with some modes on a device; ``samples`` has those of the others."""
    return precision == "float32" and widest <= WIDEST and wp.get_device(device).arch >= OLDEST


@cache
def kernels(variant: Variant, modes: int) -> SimpleNamespace:
    """Kernel of the ``cuda`` variant in float32, for bodies with a stride of ``modes``, at most ``WIDEST``."""
    module = variant.module(f"tensor_sums_{modes}")

    @wp.func_native(_source(modes))
    def add_up(
        group: int,
        thread: int,
        tet_count: int,
        tet_at: int,
        tet_first: int,
        tri_count: int,
        tri_at: int,
        tri_first: int,
        sum_first: int,
        tet_most: float,
        tet_back: float,
        tri_most: float,
        tri_back: float,
        tet_basis: wp.array(dtype=wp.float32),
        tri_basis: wp.array(dtype=wp.float32),
        tet_halves: wp.array(dtype=wp.int32),
        tri_halves: wp.array(dtype=wp.int32),
        stiffness_in: wp.array2d(dtype=wp.float32),
        thin_in: wp.array2d(dtype=wp.float32),
        sum_out: wp.array2d(dtype=wp.float32),
    ): ...

    @wp.kernel(module=module, enable_backward=False, launch_bounds=(THREADS, BLOCKS))
    def stiffness(
        tet_count: int,
        tet_at: int,
        tet_first: int,
        tri_count: int,
        tri_at: int,
        tri_first: int,
        sum_first: int,
        tet_most: float,
        tet_back: float,
        tri_most: float,
        tri_back: float,
        # Model
        tet_basis: wp.array(dtype=wp.float32),
        tri_basis: wp.array(dtype=wp.float32),
        tet_halves: wp.array(dtype=wp.int32),
        tri_halves: wp.array(dtype=wp.int32),
        # Workspace in
        stiffness_in: wp.array2d(dtype=wp.float32),
        thin_in: wp.array2d(dtype=wp.float32),
        # Workspace out
        sum_out: wp.array2d(dtype=wp.float32),
    ):
        """Stiffness in modes of one body for a group of worlds, on and below its diagonal.

        Of tets, and then of triangles: how many, their first entry among ``tet_basis`` and among ``stiffness_in``; and
        of what ``fragments`` made of both their E the largest entry, and what sums are multiplied by.
        """
        group, thread = wp.tid()
        add_up(
            group,
            thread,
            tet_count,
            tet_at,
            tet_first,
            tri_count,
            tri_at,
            tri_first,
            sum_first,
            tet_most,
            tet_back,
            tri_most,
            tri_back,
            tet_basis,
            tri_basis,
            tet_halves,
            tri_halves,
            stiffness_in,
            thin_in,
            sum_out,
        )

    return SimpleNamespace(stiffness=stiffness)
