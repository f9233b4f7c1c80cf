"""Stiffness of reduced bodies in modes on a GPU's tensor cores: the sums of ``samples`` in one kernel, K E kept near.

A block of threads has two worlds, four warps for each. Eight samples at a time, and three rows of each, their E, which
all worlds share, and K E lie in shared memory; the four warps of a world share the tiles, 16 x 8 modes, of the lower
triangle of the ``E' (K E)`` that they add up in registers. Tensor cores take factors of 11 bits. Each number is
therefore split into two, a = a1 + a2, and a b is a2 b1 + a1 b2 + a1 b1, so that what is left out is no larger than
what a product of float32 rounds. They also round sums towards zero; so they only add up eight terms, and what comes
of it is added as other numbers are. The order of sums is fixed and the same for every world.
Theory: docs/theory/reduction.md.
"""

import re
from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.elements.samples import TET, TRI

GROUP = 2  # worlds of a block, as its code has them
THREADS = 256  # of a block, as its code has them
WIDEST = 96  # modes of a body, whose sums the registers of four warps hold
OLDEST = 80  # compute capability from which tensor cores take numbers of float32's range
MOST_AT_ONCE = 3  # tiles that a warp multiplies by turns, since a product waits for the one before of its tile
BLOCKS = 2  # at once on a multiprocessor, which bounds the registers of a thread

# Samples of one kind, SIZE rows of E each. Columns in shared memory are swapped by sample, so that the threads of a
# warp find them in different banks. ``told`` keeps the compiler from holding on to addresses, which it can have again
# for little, in registers that products need.
_ADD = """
{
const int most = COUNT;
const float* e = BASIS.data + E_FIRST;
const long long across = STIFFNESS.strides[1] / sizeof(float);
const float* k = &wp::index(STIFFNESS, group * 2 + (group * 2 + (thread & 1) < worlds ? (thread & 1) : 0), K_FIRST);
float held[(48 * SIZE + 255) / 256];
auto fetch = [&](int sample, int round) {
    const int own = told(thread);
    #pragma unroll
    for (int p = 0; p < (48 * SIZE + 255) / 256; ++p) {
        const int q = (256 * p + own) >> 1, t = q / (3 * SIZE), at = q % (3 * SIZE);
        held[p] = q < 24 * SIZE && sample + t < most
            ? k[((long long)(sample + t) * (SIZE * SIZE) + 3 * SIZE * round + at) * across] : 0.0f;
    }
};
if (most > 0) fetch(0, 0);
for (int sample = 0; sample < most; sample += 8) {
    __syncthreads();
    for (int q = told(thread); q < 8 * SIZE * QUADS; q += 256) {
        const int row = q / QUADS, t = row / SIZE, c = 4 * (q - row * QUADS);
        float4 piece = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        if (sample + t < most) piece = ((const float4*)e)[(long long)sample * (SIZE * QUADS) + q];
        *(float4*)&near_e[row * WIDE + (c ^ (8 * (t & 3)))] = piece;
    }
    #pragma unroll 1
    for (int round = 0; round < SIZE / 3; ++round) {
        const int own = told(thread);
        #pragma unroll
        for (int p = 0; p < (48 * SIZE + 255) / 256; ++p) {
            const int q = (256 * p + own) >> 1, t = q / (3 * SIZE), at = q % (3 * SIZE);
            const int entry = ((own & 1) * 8 + t) * SIZE + at % SIZE;
            if (q < 24 * SIZE) near_k[at < 2 * SIZE ? 2 * entry + at / SIZE : 32 * SIZE + entry] = held[p];
        }
        __syncthreads();
        {
            const int t = (own >> 4) & 7, turn = 8 * (t & 3);
            const float* mine = &near_e[t * SIZE * WIDE];
            const int row = ((own >> 7) * 8 + t) * SIZE;
            float2 s[3][PIECES];
            #pragma unroll
            for (int i = 0; i < 3; ++i)
                #pragma unroll
                for (int p = 0; p < PIECES; ++p) s[i][p] = make_float2(0.0f, 0.0f);
            #pragma unroll
            for (int a = 0; a < SIZE; ++a) {
                const float2 g = ((const float2*)near_k)[row + a];
                const float h = near_k[32 * SIZE + row + a];
                #pragma unroll
                for (int p = 0; p < PIECES; ++p) {
                    const int c = 2 * ((own & 15) + 16 * p);
                    if (c < MODES) {
                        const float2 x = *(const float2*)&mine[a * WIDE + (c ^ turn)];
                        s[0][p].x += g.x * x.x, s[0][p].y += g.x * x.y;
                        s[1][p].x += g.y * x.x, s[1][p].y += g.y * x.y;
                        s[2][p].x += h * x.x, s[2][p].y += h * x.y;
                    }
                }
            }
            #pragma unroll
            for (int i = 0; i < 3; ++i)
                #pragma unroll
                for (int p = 0; p < PIECES; ++p) {
                    const int c = 2 * ((own & 15) + 16 * p);
                    if (c < MODES) *(float2*)&near_y[(((own >> 7) * 3 + i) * 8 + t) * WIDE + (c ^ turn)] = s[i][p];
                }
        }
        __syncthreads();
        if (round + 1 < SIZE / 3) fetch(sample, round + 1);
        else fetch(sample + 8, 0);
        if (side == 0) {
            MULTIPLY_0
        } else if (side == 1) {
            MULTIPLY_1
        } else if (side == 2) {
            MULTIPLY_2
        } else {
            MULTIPLY_3
        }
    }
}
}
"""

# What one warp does with the three rows: it loads its part of E, and multiplies columns of K E.
_MULTIPLY = """
#pragma unroll 1
for (int i = 0; i < 3; ++i) {
    const float* x = &near_e[(lane * SIZE + 3 * round + i) * WIDE];
    const float* y = &near_y[(((thread >> 7) * 3 + i) * 8 + lane) * WIDE];
    unsigned a1[OWN][4], a2[OWN][4], b1[2][2], b2[2][2];
    float d[AT_ONCE][4], zero[4] = {0.0f, 0.0f, 0.0f, 0.0f};
    LOADS
    COLUMNS
}
"""
_LOAD = "split(x[PART * 4 * SIZE * WIDE + FAR + place[TURN]], a1[M][Q], a2[M][Q]);"
_COLUMN = """
split(y[FAR + place[TURN]], b1[P][0], b2[P][0]);
split(y[4 * WIDE + FAR + place[TURN]], b1[P][1], b2[P][1]);
"""
# A product of one tile, and what becomes of its sum.
_PRODUCT = "multiply(d[D], HALF_A, HALF_B, OLD);"
_SUM = "s[NUMBER][0] += d[D][0], s[NUMBER][1] += d[D][1], s[NUMBER][2] += d[D][2], s[NUMBER][3] += d[D][3];"
_WRITE = "out[((ROW + high) * MODES + COLUMN + 2 * lane) * down] = s[NUMBER][Q];"

_ALL = """
const int worlds = sum_out.shape[0];
#if defined(__CUDA_ARCH__)
#if __CUDA_ARCH__ >= 800
__shared__ __align__(16) float near_e[72 * WIDE];
__shared__ __align__(16) float near_y[48 * WIDE];
__shared__ __align__(16) float near_k[432];
const int high = (thread & 31) >> 2, lane = thread & 3, side = ((thread >> 5) + 2 * (thread >> 7)) & 3;
int place[4];
#pragma unroll
for (int q = 0; q < 4; ++q) place[q] = ((8 * q) ^ (8 * lane)) + high;
auto told = [](int value) {
    asm volatile("" : "+r"(value));
    return value;
};
auto split = [](float value, unsigned& head, unsigned& tail) {
    head = (__float_as_uint(value) + 0x1000u) & 0xffffe000u;
    tail = __float_as_uint(value - __uint_as_float(head));
};
auto multiply = [](float* d, const unsigned* a, const unsigned* b, const float* c) {
    asm("mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, "
        "{%10, %11, %12, %13};"
        : "=f"(d[0]), "=f"(d[1]), "=f"(d[2]), "=f"(d[3])
        : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b[0]), "r"(b[1]), "f"(c[0]), "f"(c[1]), "f"(c[2]),
          "f"(c[3]));
};
float s[TILES][4] = {};
ADD_TETS
ADD_TRIS
const int world = group * 2 + (thread >> 7);
if (world < worlds) {
    const long long down = sum_out.strides[1] / sizeof(float);
    float* out = &wp::index(sum_out, world, sum_first);
    if (side == 0) {
        WRITE_0
    } else if (side == 1) {
        WRITE_1
    } else if (side == 2) {
        WRITE_2
    } else {
        WRITE_3
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


def _shared_out(rows: int) -> list[list[range]]:
    """Columns of tiles in every row, of each warp of a world: row r of ``rows`` has 2 r + 2 of them.

    Of the two triangles left by a square of half of the modes, a warp has one each, and two warps share the square: few
    numbers of E and K E go into many products.
    """
    half = (rows + 1) // 2
    triangle = [range(2 * r + 2) for r in range(half)]
    none: list[range] = [range(0)] * half
    low = range(half, rows)
    return [
        triangle,
        none + [range(2 * half, 2 * r + 2) for r in low],
        none + [range(half) for _ in low],
        none + [range(half, 2 * half) for _ in low],
    ]


def _filled(text: str, **values: int | str) -> str:
    """Text with its words in capitals replaced."""
    for name, value in values.items():
        text = re.sub(rf"\b{name}\b", str(value), text)
    return text


def _tiles(share: list[range]) -> dict[tuple[int, int], int]:
    """Numbers of a warp's tiles by row and column."""
    every = [(row, column) for row, columns in enumerate(share) for column in columns]
    return {tile: number for number, tile in enumerate(every)}


def _columns(tiles: dict[tuple[int, int], int]) -> list[list[int]]:
    """A warp's columns, some long ones with short ones, of so many tiles together."""
    left = sorted({column for _, column in tiles})
    tall = {column: sum(c == column for _, c in tiles) for column in left}
    groups = []
    while left:
        group = [left.pop(0)]
        if left and tall[group[0]] + tall[left[-1]] <= MOST_AT_ONCE:
            group.append(left.pop())
        groups.append(group)
    return groups


def _multiply(share: list[range]) -> str:
    """How a warp multiplies for its tiles."""
    tiles = _tiles(share)
    own = sorted({row for row, _ in tiles})
    loads = [
        _filled(_LOAD, PART=q // 2, FAR=16 * row // 32 * 32, TURN=2 * row % 4 + q % 2, M=m, Q=q)
        for m, row in enumerate(own)
        for q in range(4)
    ]
    columns = []
    for group in _columns(tiles):
        here = [(p, m, j) for p, j in enumerate(group) for m, row in enumerate(own) if (row, j) in tiles]
        columns += [_filled(_COLUMN, FAR=8 * j // 32 * 32, TURN=j % 4, P=p) for p, j in enumerate(group)]
        for a, b, old in (("a2[M]", "b1[P]", "zero"), ("a1[M]", "b2[P]", "d[D]"), ("a1[M]", "b1[P]", "d[D]")):
            product = _filled(_PRODUCT, HALF_A=a, HALF_B=b, OLD=old)
            columns += [_filled(product, M=m, P=p, D=n) for n, (p, m, _) in enumerate(here)]
        columns += [_filled(_SUM, D=n, NUMBER=tiles[own[m], j]) for n, (_, m, j) in enumerate(here)]
    words = {"LOADS": "\n    ".join(loads), "COLUMNS": "\n    ".join(columns), "OWN": len(own), "AT_ONCE": MOST_AT_ONCE}
    return _filled(_MULTIPLY, **words) if tiles else ""


def _write(share: list[range]) -> str:
    """How it writes their sums."""
    return "\n".join(
        _filled(_WRITE, ROW=16 * row + 8 * (q // 2), COLUMN=8 * column + q % 2, NUMBER=number, Q=q)
        for (row, column), number in _tiles(share).items()
        for q in range(4)
    )


def _source(modes: int) -> str:
    """Native code for bodies with a stride of some modes."""
    shares = _shared_out(modes // 16)
    parts = {f"MULTIPLY_{side}": _multiply(share) for side, share in enumerate(shares)}
    add = _filled(_ADD, **parts)
    tets = _filled(add, COUNT="tet_count", BASIS="tet_basis", E_FIRST="tet_at", STIFFNESS="stiffness_in")
    tets = _filled(tets, K_FIRST="tet_first", SIZE=TET)
    tris = _filled(add, COUNT="tri_count", BASIS="tri_basis", E_FIRST="tri_at", STIFFNESS="thin_in")
    tris = _filled(tris, K_FIRST="tri_first", SIZE=TRI)
    writes = {f"WRITE_{side}": _write(share) for side, share in enumerate(shares)}
    text = _filled(_ALL, ADD_TETS=tets, ADD_TRIS=tris, **writes)
    wide, quads = -(-modes // 32) * 32, modes // 4
    text = _filled(text, WIDE=wide, QUADS=quads, PIECES=wide // 32, MODES=modes)
    return _filled(text, TILES=max(len(_tiles(share)) for share in shares))


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
        tet_basis: wp.array(dtype=wp.float32),
        tri_basis: wp.array(dtype=wp.float32),
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
        # Model
        tet_basis: wp.array(dtype=wp.float32),
        tri_basis: wp.array(dtype=wp.float32),
        # Workspace in
        stiffness_in: wp.array2d(dtype=wp.float32),
        thin_in: wp.array2d(dtype=wp.float32),
        # Workspace out
        sum_out: wp.array2d(dtype=wp.float32),
    ):
        """Stiffness in modes of one body for a group of worlds, on and below its diagonal.

        Of tets, and then of triangles: how many, their first entry among ``tet_basis`` and among ``stiffness_in``.
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
            tet_basis,
            tri_basis,
            stiffness_in,
            thin_in,
            sum_out,
        )

    return SimpleNamespace(stiffness=stiffness)
