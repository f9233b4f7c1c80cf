"""Rows of a pack of worlds on a CPU, looked at and copied in registers: numbers of a pack lie one behind the other.

What a step does to every number of every node, such as asking whether it is finite, costs as much as a scene has nodes,
also where few of them are solved for. Here a loop over rows takes as many numbers as a register holds.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

# No number that is neither finite nor near passes a comparison. Of a register's comparisons all are kept to the end.
_ARE_FINITE = """
typedef REAL wide_t __attribute__((vector_size(64), aligned(4)));
const int width = 64 / sizeof(REAL), count = last - first;
const REAL* value = &wp::index(value_in, pack, 0, 0) + first;
wide_t x = {};
auto ok = x == x;
int good = 1, i = 0;
for (; i + width <= count; i += width) {
    __builtin_memcpy(&x, value + i, sizeof(x));
    ok &= x - x == wide_t{};
}
for (int k = 0; k < width; ++k) good &= ok[k] != 0;
for (; i < count; ++i) good &= value[i] - value[i] == 0;
return good;
"""
_ARE_NEAR = """
typedef REAL wide_t __attribute__((vector_size(64), aligned(4)));
const int width = 64 / sizeof(REAL), count = last - first;
const REAL* before = &wp::index(x0_in, pack, 0, 0) + first;
const REAL* now = &wp::index(x_in, pack, 0, 0) + first;
wide_t x0, x = {};
const wide_t far = wide_t{} + way, out = wide_t{} + place;
auto ok = x == x;
int good = 1, i = 0;
for (; i + width <= count; i += width) {
    __builtin_memcpy(&x0, before + i, sizeof(x0));
    __builtin_memcpy(&x, now + i, sizeof(x));
    const wide_t moved = x - x0;
    ok &= (moved <= far) & (-moved <= far) & (x <= out) & (-x <= out);
}
for (int k = 0; k < width; ++k) good &= ok[k] != 0;
for (; i < count; ++i) {
    const REAL moved = now[i] - before[i];
    good &= (moved <= way) & (-moved <= way) & (now[i] <= place) & (-now[i] <= place);
}
return good;
"""
_ARE_SAME = """
int same = 1;
for (int world = first; world < last; ++world) {
    const REAL* a = &wp::index(a_in, world, 0);
    const REAL* b = &wp::index(b_in, world, 0);
    for (int i = 0; i < a_in.shape[1]; ++i) same &= a[i] == b[i];
}
return same;
"""
_ADD = """
typedef REAL wide_t __attribute__((vector_size(64), aligned(4)));
const int width = 64 / sizeof(REAL), count = last - first;
const REAL* value = &wp::index(value_in, pack, 0, 0) + first;
REAL* target = &wp::index(target_out, pack, 0, 0) + first;
wide_t x, y;
int i = 0;
for (; i + width <= count; i += width) {
    __builtin_memcpy(&x, value + i, sizeof(x));
    __builtin_memcpy(&y, target + i, sizeof(y));
    y += x;
    __builtin_memcpy(target + i, &y, sizeof(y));
}
for (; i < count; ++i) target[i] += value[i];
"""
_COPY = """
const REAL* value = &wp::index(value_in, pack, 0, 0) + first;
__builtin_memcpy(&wp::index(target_out, pack, 0, 0) + start + first, value, (last - first) * sizeof(REAL));
"""
# A listed node of all worlds after the other, as worlds are read where they left off and lanes stand side by side.
_TAKE = """
const int lanes = listed_out.shape[2], begin = lanes * pack, rest = bar_out.shape[0] - begin;
const int worlds = rest < lanes ? rest : lanes;
REAL* listed = &wp::index(listed_out, pack, 0, 0);
for (int l = 0; l < lanes; ++l) {
    REAL* bar = &wp::index(bar_out, begin + (l < worlds ? l : 0), 0);
    for (int i = first; i < last; ++i) {
        REAL* value = bar + 3 * node.data[i];
        REAL* target = listed + 3 * lanes * i + l;
        for (int c = 0; c < 3; ++c) target[lanes * c] = l < worlds ? value[c] : 0;
    }
}
for (int l = 0; l < worlds; ++l)
    for (int i = first; i < last; ++i)
        for (int c = 0; c < 3; ++c) wp::index(bar_out, begin + l, 3 * node.data[i] + c) = 0;
"""
# Eight registers of eight numbers, a, as columns, in b.
TURN_ROWS = """
        for (int k = 0; k < 8; k += 2) {
            b[k] = __builtin_shufflevector(a[k], a[k + 1], 0, 8, 1, 9, 4, 12, 5, 13);
            b[k + 1] = __builtin_shufflevector(a[k], a[k + 1], 2, 10, 3, 11, 6, 14, 7, 15);
        }
        for (int k = 0; k < 8; k += 4)
            for (int m = 0; m < 2; ++m) {
                a[k + 2 * m] = __builtin_shufflevector(b[k + m], b[k + 2 + m], 0, 1, 8, 9, 4, 5, 12, 13);
                a[k + 2 * m + 1] = __builtin_shufflevector(b[k + m], b[k + 2 + m], 2, 3, 10, 11, 6, 7, 14, 15);
            }
        for (int k = 0; k < 4; ++k) {
            b[k] = __builtin_shufflevector(a[k], a[k + 4], 0, 1, 2, 3, 8, 9, 10, 11);
            b[k + 4] = __builtin_shufflevector(a[k], a[k + 4], 4, 5, 6, 7, 12, 13, 14, 15);
        }
"""
# Squares of eight rows of eight worlds change places in registers; what is left over goes number by number.
_INTERLEAVE = """
typedef REAL row_t __attribute__((vector_size(8 * sizeof(REAL)), aligned(4)));
const int lanes = target_out.shape[2];
REAL* target = &wp::index(target_out, pack, 0, 0);
int row = first;
if (lanes == 8) {
    const REAL* source[8];
    for (int k = 0; k < 8; ++k)
        source[k] = &wp::index(source_in, 8 * pack + k < world_count ? 8 * pack + k : world_count - 1, 0);
    for (; row + 8 <= last; row += 8) {
        row_t a[8], b[8];
        for (int k = 0; k < 8; ++k) __builtin_memcpy(a + k, source[k] + row, sizeof(row_t));
TURN        for (int k = 0; k < 8; ++k) __builtin_memcpy(target + 8 * (row + k), b + k, sizeof(row_t));
    }
}
for (; row < last; ++row)
    for (int lane = 0; lane < lanes; ++lane) {
        const int world = lanes * pack + lane;
        target[lanes * row + lane] = wp::index(source_in, world < world_count ? world : world_count - 1, row);
    }
"""
# The other way round, into two arrays of the state.
_STORE = """
typedef REAL row_t __attribute__((vector_size(8 * sizeof(REAL)), aligned(4)));
const int lanes = value_in.shape[2], begin = lanes * pack;
const int worlds = begin + lanes < target_out.shape[0] ? lanes : target_out.shape[0] - begin;
const REAL* value = &wp::index(value_in, pack, 0, 0);
int row = first;
if (lanes == 8)
    for (; row + 8 <= last; row += 8) {
        row_t a[8], b[8];
        for (int k = 0; k < 8; ++k) __builtin_memcpy(a + k, value + 8 * (row + k), sizeof(row_t));
        TURN
        for (int k = 0; k < worlds; ++k) {
            __builtin_memcpy(&wp::index(target_out, begin + k, row), b + k, sizeof(row_t));
            __builtin_memcpy(&wp::index(good_out, begin + k, row), b + k, sizeof(row_t));
        }
    }
for (int k = 0; k < worlds; ++k) {
    REAL* target = &wp::index(target_out, begin + k, 0);
    REAL* good = &wp::index(good_out, begin + k, 0);
    for (int i = row; i < last; ++i) target[i] = value[lanes * i + k];
    for (int i = row; i < last; ++i) good[i] = value[lanes * i + k];
}
"""
# Gradients by nodes of the worlds of a pack, from where lanes stand side by side; squares of eight rows and worlds turn
_GIVE = """
#pragma clang fp contract(off)
typedef REAL row_t __attribute__((vector_size(8 * sizeof(REAL)), aligned(4)));
const int lanes = LANES.shape[2], begin = lanes * pack, rest = BAR.shape[0] - begin;
const int worlds = rest < lanes ? rest : lanes;
auto give = [&](auto at, auto put) {
    int row = START;
    if (lanes == 8)
        for (; row + 8 <= END; row += 8) {
            row_t a[8], b[8];
            for (int k = 0; k < 8; ++k) a[k] = at(row + k, row_t{});
TURN
            for (int k = 0; k < worlds; ++k) put(begin + k, row, b[k]);
        }
    for (; row < END; ++row)
        for (int k = 0; k < worlds; ++k) put(begin + k, row, at(row, k));
};
"""
_GIVE_NODES = (
    _GIVE.replace("LANES", "node_bar").replace("BAR", "x_bar").replace("START", "3 * first").replace("END", "3 * last")
    + """
struct Sum {
    const wp::array_t<REAL>& array; const int pack;
    row_t operator()(int row, row_t a) const {
        __builtin_memcpy(&a, &wp::index(array, pack, row, 0), sizeof(a));
        return a;
    }
    REAL operator()(int row, int lane) const { return wp::index(array, pack, row, lane); }
};
struct Weighted {
    const wp::array_t<REAL>&array, &density; const wp::array_t<int>& body; const int pack;
    row_t operator()(int row, row_t a) const {
        row_t d;
        __builtin_memcpy(&a, &wp::index(array, pack, row, 0), sizeof(a));
        __builtin_memcpy(&d, &wp::index(density, pack, body.data[row / 3], 0), sizeof(d));
        return d * a;
    }
    REAL operator()(int row, int lane) const {
        return wp::index(density, pack, body.data[row / 3], lane) * wp::index(array, pack, row, lane);
    }
};
if (lanes == 1) {  // a world alone, whose numbers follow each other
    const REAL *sum = &wp::index(node_bar, pack, 0, 0), *mass = &wp::index(mass_p, pack, 0, 0);
    REAL *x = &wp::index(x_bar, pack, 0), *v = &wp::index(v_bar, pack, 0);
    for (int row = 3 * first; row < 3 * last; ++row) x[row] += sum[row];
    for (int node = first; node < last; ++node) {
        const REAL weight = wp::index(density, pack, node_body.data[node], 0);
        for (int c = 0; c < 3; ++c) v[3 * node + c] = weight * mass[3 * node + c];
    }
    return;
}
give(Sum{node_bar, pack}, [&](int world, int row, auto value) {
    auto total = value;
    __builtin_memcpy(&total, &wp::index(x_bar, world, row), sizeof(total));
    total += value;
    __builtin_memcpy(&wp::index(x_bar, world, row), &total, sizeof(total));
});
give(Weighted{mass_p, density, node_body, pack}, [&](int world, int row, auto value) {
    __builtin_memcpy(&wp::index(v_bar, world, row), &value, sizeof(value));
});
"""
)
_GIVE_FORCES = (
    _GIVE.replace("LANES", "node_p").replace("BAR", "force_bar").replace("START", "first").replace("END", "last")
    + """
struct Scaled {
    const wp::array_t<REAL>& array; const int pack; const REAL h;
    row_t operator()(int row, row_t a) const {
        __builtin_memcpy(&a, &wp::index(array, pack, row, 0), sizeof(a));
        return h * a;
    }
    REAL operator()(int row, int lane) const { return h * wp::index(array, pack, row, lane); }
};
if (lanes == 1) {
    const REAL* value = &wp::index(node_p, pack, 0, 0);
    REAL* target = &wp::index(force_bar, pack, 0);
    for (int row = first; row < last; ++row) target[row] = h * value[row];
    return;
}
give(Scaled{node_p, pack, h}, [&](int world, int row, auto value) {
    __builtin_memcpy(&wp::index(force_bar, world, row), &value, sizeof(value));
});
"""
)
_SEED = """
#pragma clang fp contract(off)
const int lanes = seed.shape[2], last_world = x_bar.shape[0] - 1;
for (int l = 0; l < lanes; ++l) {
    const int world = lanes * pack + l < last_world ? lanes * pack + l : last_world;
    const bool has_nodes = x_bar.shape[1] > 0;
    const REAL *x = has_nodes ? &wp::index(x_bar, world, 0) : nullptr;
    const REAL *v = has_nodes ? &wp::index(v_bar, world, 0) : nullptr;
    REAL *a = &wp::index(seed, pack, 0, 0) + l, *b = &wp::index(y, pack, 0, 0) + l;
    for (int dof = first; dof < last; ++dof) {
        const int row = 3 * dof_node.data[dof];
        const REAL* free = &wp::index(dof_free, dof, 0);
        for (int c = 0; c < 3; ++c) {
            // a dof behind all nodes is of a frame, which is prescribed
            const REAL value = row < x_bar.shape[1] ? (v[row + c] + h * x[row + c]) * free[c] : 0;
            a[lanes * (3 * dof + c)] = value, b[lanes * (3 * dof + c)] = value;
        }
    }
}
"""


@cache
def adjoint_functions(real: Any) -> SimpleNamespace:
    """What takes gradients between the state and packs of worlds of a CPU, for one scalar type."""
    name = "double" if real is wp.float64 else "float"

    @wp.func_native(_GIVE_NODES.replace("TURN", TURN_ROWS).replace("REAL", name))
    def give_nodes(
        node_body: wp.array(dtype=wp.int32),
        density: wp.array3d(dtype=real),
        mass_p: wp.array3d(dtype=real),
        node_bar: wp.array3d(dtype=real),
        pack: int,
        first: int,
        last: int,
        x_bar: wp.array2d(dtype=real),
        v_bar: wp.array2d(dtype=real),
    ):
        """Gradients by positions and velocities of nodes ``first`` to ``last`` at the start of a step."""

    @wp.func_native(_GIVE_FORCES.replace("TURN", TURN_ROWS).replace("REAL", name))
    def give_forces(
        h: real, node_p: wp.array3d(dtype=real), pack: int, first: int, last: int, force_bar: wp.array2d(dtype=real)
    ):
        """h p of rows ``first`` to ``last``."""

    @wp.func_native(_SEED.replace("REAL", name))
    def seed(
        h: real,
        dof_node: wp.array(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        x_bar: wp.array2d(dtype=real),
        v_bar: wp.array2d(dtype=real),
        pack: int,
        first: int,
        last: int,
        seed: wp.array3d(dtype=real),
        y: wp.array3d(dtype=real),
    ):
        """y_v + h y_x of dofs ``first`` to ``last``."""

    return SimpleNamespace(give_nodes=give_nodes, give_forces=give_forces, seed=seed)


@cache
def functions(real: Any) -> SimpleNamespace:
    """What looks at rows of a pack of worlds and copies them, for one scalar type of a CPU."""
    name = "double" if real is wp.float64 else "float"

    @wp.func_native(_ARE_FINITE.replace("REAL", name))
    def are_finite(value_in: wp.array3d(dtype=real), pack: int, first: int, last: int) -> int:
        """Whether numbers ``first`` to ``last`` of a pack are finite."""

    @wp.func_native(_ARE_NEAR.replace("REAL", name))
    def are_near(
        x0_in: wp.array3d(dtype=real),
        x_in: wp.array3d(dtype=real),
        pack: int,
        first: int,
        last: int,
        way: real,
        place: real,
    ) -> int:
        """Whether numbers ``first`` to ``last`` of a pack are finite, at most ``place``, and ``way`` from what was."""

    @wp.func_native(_ARE_SAME.replace("REAL", name))
    def are_same(a_in: wp.array2d(dtype=real), b_in: wp.array2d(dtype=real), first: int, last: int) -> int:
        """Whether all numbers of worlds ``first`` to ``last`` of the state are those of another array."""

    @wp.func_native(_ADD.replace("REAL", name))
    def add_numbers(
        value_in: wp.array3d(dtype=real), target_out: wp.array3d(dtype=real), pack: int, first: int, last: int
    ):
        """Add numbers ``first`` to ``last`` of a pack to those of another array."""

    @wp.func_native(_COPY.replace("REAL", name))
    def copy_numbers(
        value_in: wp.array3d(dtype=real),
        target_out: wp.array3d(dtype=real),
        pack: int,
        start: int,
        first: int,
        last: int,
    ):
        """Copy numbers ``first`` to ``last`` of a pack to those of another array, from ``start`` on."""

    @wp.func_native(_TAKE.replace("REAL", name))
    def take_nodes(
        node: wp.array(dtype=wp.int32),
        pack: int,
        first: int,
        last: int,
        bar_out: wp.array2d(dtype=real),
        listed_out: wp.array3d(dtype=real),
    ):
        """Gradients by listed nodes ``first`` to ``last`` of the worlds of a pack; 0 in the state afterwards."""

    @wp.func_native(_INTERLEAVE.replace("TURN", TURN_ROWS).replace("REAL", name))
    def interleave_rows(
        source_in: wp.array2d(dtype=real),
        pack: int,
        world_count: int,
        first: int,
        last: int,
        target_out: wp.array3d(dtype=real),
    ):
        """Copy rows ``first`` to ``last`` of worlds into lanes; lanes past the last world repeat it."""

    @wp.func_native(_STORE.replace("TURN", TURN_ROWS).replace("REAL", name))
    def store_rows(
        value_in: wp.array3d(dtype=real),
        pack: int,
        first: int,
        last: int,
        target_out: wp.array2d(dtype=real),
        good_out: wp.array2d(dtype=real),
    ):
        """Copy rows ``first`` to ``last`` of all worlds of a pack into two arrays of the state."""

    return SimpleNamespace(
        are_finite=are_finite,
        are_near=are_near,
        are_same=are_same,
        add_numbers=add_numbers,
        copy_numbers=copy_numbers,
        take_nodes=take_nodes,
        interleave_rows=interleave_rows,
        store_rows=store_rows,
    )
