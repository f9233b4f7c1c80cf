"""Stiffness of reduced bodies in modes on a GPU's tensor cores: the sums of ``samples`` in one kernel, K E kept near.

A block of threads has two worlds, two warps for each. Eight samples at a time, and three rows of each, their E, which
all worlds share, and K E lie in shared memory; the two warps of a world share the tiles, 16 x 8 modes, of the lower
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

GROUP = 2  # worlds of a block
THREADS = 128  # of a block
WIDEST = 96  # modes of a body, whose sums the registers of two warps hold
OLDEST = 80  # compute capability from which tensor cores take numbers of float32's range
BLOCKS = 2  # at once on a multiprocessor, which bounds the registers of a thread

# Samples of one kind, SIZE rows of E each. Columns in shared memory are swapped by sample, so that the threads of a
# warp find them in different banks.
_ADD = """
{
const int most = COUNT;
const float* e = BASIS.data + E_FIRST;
const long long across = STIFFNESS.strides[1] / sizeof(float);
const float* k = &wp::index(STIFFNESS, group * 2 + (group * 2 + (thread & 1) < worlds ? (thread & 1) : 0), K_FIRST);
float held[(48 * SIZE + 127) / 128];
auto fetch = [&](int sample, int round) {
    #pragma unroll
    for (int p = 0; p < (48 * SIZE + 127) / 128; ++p) {
        const int q = (128 * p + thread) >> 1, t = q / (3 * SIZE), at = q % (3 * SIZE);
        held[p] = q < 24 * SIZE && sample + t < most
            ? k[((long long)(sample + t) * (SIZE * SIZE) + 3 * SIZE * round + at) * across] : 0.0f;
    }
};
if (most > 0) fetch(0, 0);
for (int sample = 0; sample < most; sample += 8) {
    __syncthreads();
    for (int q = thread; q < 8 * SIZE * QUADS; q += 128) {
        const int row = q / QUADS, t = row / SIZE, c = 4 * (q - row * QUADS);
        float4 piece = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        if (sample + t < most) piece = ((const float4*)e)[(long long)sample * (SIZE * QUADS) + q];
        *(float4*)&near_e[row * WIDE + (c ^ (8 * (t & 3)))] = piece;
    }
    #pragma unroll 1
    for (int round = 0; round < SIZE / 3; ++round) {
        #pragma unroll
        for (int p = 0; p < (48 * SIZE + 127) / 128; ++p) {
            const int q = (128 * p + thread) >> 1, t = q / (3 * SIZE), at = q % (3 * SIZE);
            if (q < 24 * SIZE) near_k[3 * (((thread & 1) * 8 + t) * SIZE + at % SIZE) + at / SIZE] = held[p];
        }
        __syncthreads();
        {
            const int t = (thread >> 3) & 7, turn = 8 * (t & 3);
            const float* mine = &near_e[t * SIZE * WIDE];
            const float* row = &near_k[3 * ((thread >> 6) * 8 + t) * SIZE];
            float4 s[3][PIECES];
            #pragma unroll
            for (int i = 0; i < 3; ++i)
                #pragma unroll
                for (int p = 0; p < PIECES; ++p) s[i][p] = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
            #pragma unroll
            for (int a = 0; a < SIZE; ++a) {
                #pragma unroll
                for (int p = 0; p < PIECES; ++p) {
                    const int c = 4 * ((thread & 7) + 8 * p);
                    if (c < MODES) {
                        const float4 x = *(const float4*)&mine[a * WIDE + (c ^ turn)];
                        #pragma unroll
                        for (int i = 0; i < 3; ++i) {
                            const float g = row[3 * a + i];
                            s[i][p].x += g * x.x;
                            s[i][p].y += g * x.y;
                            s[i][p].z += g * x.z;
                            s[i][p].w += g * x.w;
                        }
                    }
                }
            }
            #pragma unroll
            for (int i = 0; i < 3; ++i)
                #pragma unroll
                for (int p = 0; p < PIECES; ++p) {
                    const int c = 4 * ((thread & 7) + 8 * p);
                    if (c < MODES) *(float4*)&near_y[(((thread >> 6) * 3 + i) * 8 + t) * WIDE + (c ^ turn)] = s[i][p];
                }
        }
        __syncthreads();
        if (round + 1 < SIZE / 3) fetch(sample, round + 1);
        else fetch(sample + 8, 0);
        if (side == 0) {
            MULTIPLY_0
        } else {
            MULTIPLY_1
        }
    }
}
}
"""

# What one warp does with the three rows; then come ``_COLUMNS``, with a ``_PRODUCT`` for each tile.
_MULTIPLY = """
#pragma unroll 1
for (int i = 0; i < 3; ++i) {
    const float* x = &near_e[(lane * SIZE + 3 * round + i) * WIDE];
    const float* y = &near_y[(((thread >> 6) * 3 + i) * 8 + lane) * WIDE];
    unsigned a1[OWN][4], a2[OWN][4], b1[2], b2[2];
    LOADS
    COLUMNS
}
"""
_LOAD = "split(x[PART * 4 * SIZE * WIDE + FAR + place[TURN]], a1[M][Q], a2[M][Q]);"
_COLUMN = """
split(y[FAR + place[TURN]], b1[0], b2[0]);
split(y[4 * WIDE + FAR + place[TURN]], b1[1], b2[1]);
"""
_PRODUCT = """
{
    float d[4], zero[4] = {0.0f, 0.0f, 0.0f, 0.0f};
    multiply(d, a2[M], b1, zero);
    multiply(d, a1[M], b2, d);
    multiply(d, a1[M], b1, d);
    s[M][J][0] += d[0], s[M][J][1] += d[1], s[M][J][2] += d[2], s[M][J][3] += d[3];
}
"""
_WRITE = "out[((ROW + high) * MODES + COLUMN + 2 * lane) * down] = s[M][J][Q];"

_ALL = """
const int worlds = sum_out.shape[0];
#if defined(__CUDA_ARCH__)
#if __CUDA_ARCH__ >= 800
__shared__ __align__(16) float near_e[72 * WIDE];
__shared__ __align__(16) float near_y[48 * WIDE];
__shared__ __align__(16) float near_k[432];
const int high = (thread & 31) >> 2, lane = thread & 3, side = (thread >> 5) & 1;
int place[4];
#pragma unroll
for (int q = 0; q < 4; ++q) place[q] = ((8 * q) ^ (8 * lane)) + high;
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
    loads = [
        _filled(_LOAD, PART=q // 2, FAR=16 * row // 32 * 32, TURN=2 * row % 4 + q % 2, M=m, Q=q)
        for m, row in enumerate(rows)
        for q in range(4)
    ]
    columns = []
    for j in range(2 * max(rows, default=-1) + 2):
        columns.append(_filled(_COLUMN, FAR=8 * j // 32 * 32, TURN=j % 4))
        columns += [_filled(_PRODUCT, M=m, J=j) for m, row in enumerate(rows) if j < 2 * row + 2]
    return _filled(_MULTIPLY, LOADS="\n    ".join(loads), COLUMNS="".join(columns)) if rows else ""


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
    add = _filled(_ADD, **parts)
    tets = _filled(add, COUNT="tet_count", BASIS="tet_basis", E_FIRST="tet_at", STIFFNESS="stiffness_in")
    tets = _filled(tets, K_FIRST="tet_first", SIZE=TET)
    tris = _filled(add, COUNT="tri_count", BASIS="tri_basis", E_FIRST="tri_at", STIFFNESS="thin_in")
    tris = _filled(tris, K_FIRST="tri_first", SIZE=TRI)
    text = _filled(_ALL, ADD_TETS=tets, ADD_TRIS=tris, WRITE_0=_write(both[0]), WRITE_1=_write(both[1]))
    wide, quads = -(-modes // 32) * 32, modes // 4
    text = _filled(text, WIDE=wide, QUADS=quads, PIECES=-(-quads // 8), MODES=modes)
    return _filled(text, OWN=max(map(len, both)), TILES=modes // 8)


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
