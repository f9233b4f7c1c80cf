"""Half-solved sides of contacts with a factor in panels: by thread blocks. Theory: docs/theory/contact.md.

As ``find_path`` and ``substitute`` of ``contact``, with paths that take in whole panels: a path lists the columns of
the panels on it in order of rounds, so that those of one panel stand together. A block finds the path of one contact;
it substitutes for several that follow each other in the list, so that what it reads of L serves all of them. A CPU
runs the kernels in tests only.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.linear import cholesky_panels
from softwarp.kernels.linear.cholesky_panels import barrier, name_of, named, shared_memory
from softwarp.kernels.rows import contact as contact_rows
from softwarp.kernels.rows import touch
from softwarp.model.codes import SLOTS

THREADS = 128  # per block; benchmarks/contact.py
MOST_PANELS = 2048  # panels whose places on a path a block keeps in shared memory
MOST_COLUMNS = 64  # of a panel, whose part of the sides it keeps as well
GROUP = 4  # contacts that a block substitutes for
NEAR = 96  # contacts up to which a block keeps the sides of all that come before its own in shared memory
NEAR_GROUP = 8  # contacts of such a block: two for each of its warps
NEAR_DOFS = {"float": 8, "double": 4}  # dofs of which it keeps them at a time
SPREAD = 32  # threads that spread the rows of a contact over the modes of a body

_MARK = """
#if defined(__CUDA_ARCH__)
__shared__ int store[COUNT];
#else
static int store[COUNT];
#endif
if (write) store[place] = value;
else value = store[place];
return value;
"""

# Blocks of W of contacts first .. end - 1 with all up to them. Sums run over the dofs in order of their columns, as
# paths do; a dof that is not on a path adds zeros. A lane of a warp has every 32nd of the other contacts.
_PRODUCTS = """
#if defined(__CUDA_ARCH__)
__shared__ SCALAR near[NEAR * (9 * DOFS + 1)];
#define MEET __syncthreads();
#else
static SCALAR near[NEAR * (9 * DOFS + 1)];
#define MEET WP_TILE_SYNC();
#endif
const int size = counts[0], path_limit = counts[1], row_count = counts[2], order = counts[3];
const int EACH = GROUP / (THREADS / 32), OTHERS = NEAR / 32, STRIDE = 9 * DOFS + 1;
const SCALAR* const sides = &wp::index(side, w, 0);
const int* const places = &wp::index(place, w, 0);
SCALAR* const out = &wp::index(delassus_out, w, 0);
const int own = first + thread / 32, lane = thread % 32;
SCALAR sum[EACH][OTHERS][9] = {};
for (int q = 0; q < size; q += DOFS) {
    const int dofs = size - q < DOFS ? size - q : DOFS;
    const int own_dof = thread % DOFS;
    const int row = own_dof < dofs ? wp::index(column, q + own_dof)[0] : 0;
    #pragma unroll 2
    for (int c = thread / DOFS; c < end; c += THREADS / DOFS) {
        const int k = own_dof < dofs ? places[c * size + row] : -1;
        const SCALAR* const from = sides + 9 * (c * path_limit + (k < 0 ? 0 : k));
        SCALAR* const to = near + c * STRIDE + 9 * own_dof;
        #pragma unroll
        for (int i = 0; i < 9; ++i) to[i] = k < 0 ? (SCALAR)0 : from[i];
    }
    MEET
    for (int d = 0; d < dofs; ++d)
        #pragma unroll
        for (int i = 0; i < EACH; ++i) {
            const int c = own + i * (THREADS / 32);
            if (c >= end) continue;
            SCALAR a[9];
            #pragma unroll
            for (int k = 0; k < 9; ++k) a[k] = near[c * STRIDE + 9 * d + k];
            #pragma unroll
            for (int m = 0; m < OTHERS; ++m) {
                const int other = lane + 32 * m;
                if (other > c) continue;
                const SCALAR* const b = near + other * STRIDE + 9 * d;
                #pragma unroll
                for (int r = 0; r < 9; r += 3)
                    #pragma unroll
                    for (int k = 0; k < 9; ++k) sum[i][m][k] += a[r + k / 3] * b[r + k % 3];
            }
        }
    MEET
}
#pragma unroll
for (int i = 0; i < EACH; ++i) {
    const int c = own + i * (THREADS / 32);
    #pragma unroll
    for (int m = 0; m < OTHERS; ++m) {
        const int other = lane + 32 * m;
        if (c >= end || other > c) continue;
        const int row = row_count + 3 * c, col = row_count + 3 * other;
        #pragma unroll
        for (int k = 0; k < 9; ++k) {
            const SCALAR value = sum[i][m][k] * scale;
            out[(row + k / 3) * order + col + k % 3] = value;
            out[(col + k % 3) * order + row + k / 3] = value;
        }
    }
}
#undef MEET
"""


@cache
def kernels(variant: Variant, wide: bool = False) -> SimpleNamespace:
    """Cooperative kernels of contacts, for variants without lanes.

    Args:
        variant: Scalar type.
        wide: Whether panels are as wide as those of modes, of which few threads find enough to do: each takes all three
            axes of a contact, for which it reads L once, and a block has twice as many contacts.
    """
    S = variant.S
    module = variant.module("contact_panel_wide" if wide else "contact_panel")
    group_size, axes = (2 * GROUP, 3) if wide else (GROUP, 1)
    shares, room = 3 // axes, 9 * MOST_COLUMNS + 8  # tasks of a block of L, entries of a contact, in banks of their own
    Sums = wp.types.vector(3 * axes, dtype=S)
    block = cholesky_panels.kernels(variant).block
    vec = wp.types.vector(3, dtype=S)
    Side = wp.types.vector(9, dtype=S)
    Touch, first_dof, own_axes, mode_row = vars(touch.functions(variant)).values()
    slot_row, real = contact_rows.kernels(variant, together=True).slot_row, variant.real

    @wp.func_native(_MARK.replace("COUNT", str(MOST_PANELS)))
    def mark(place: int, value: int, write: bool) -> int: ...

    @wp.func_native(shared_memory(S, room * group_size))
    def solved(place: int, value: S, write: bool) -> S: ...

    @wp.func
    def climb(row: int, column_panel: wp.array(dtype=wp.int32), panel: wp.array(dtype=wp.vec4i)):
        """Mark the panels from a column to its root; others may mark the same ones at the same time."""
        p = column_panel[row]
        while p >= 0:
            if mark(p, 0, False) == 1:
                p = -1
            else:
                mark(p, 1, True)
                p = panel[p][2]

    @wp.kernel(module=module, enable_backward=False, launch_bounds=THREADS)
    def find_path(
        # Symbolic
        size: int,
        path_limit: int,
        panel_count: int,
        position: wp.array(dtype=wp.int32),
        column_panel: wp.array(dtype=wp.int32),
        column: wp.array(dtype=wp.vec4i),
        panel: wp.array(dtype=wp.vec4i),
        threads: int,
        # Model
        dof_free: wp.array2d(dtype=S),
        modes: Touch,
        # Workspace in
        pack_first_in: wp.array2d(dtype=wp.int32),
        pack_count_in: wp.array2d(dtype=wp.int32),
        dof_in: wp.array2d(dtype=wp.int32),
        # Workspace out
        path_size_out: wp.array2d(dtype=wp.int32),
        path_out: wp.array2d(dtype=wp.int32),
        place_out: wp.array2d(dtype=wp.int32),
        side_out: wp.array2d(dtype=S),
    ):
        """Path of one contact, the place of every dof in it (or -1), and zero right-hand sides."""
        w, contact, thread = wp.tid()
        if contact < pack_first_in[w, 0] or contact >= pack_count_in[w, 0]:
            return
        for p in range(thread, panel_count, threads):
            mark(p, 0, True)
        barrier()
        for slot in range(thread, int(wp.static(SLOTS)), threads):
            dof = dof_in[w, wp.static(SLOTS) * contact + slot]
            if dof >= 0:
                dof = first_dof(modes, size, dof)
                if dof_free[dof, 0] + dof_free[dof, 1] + dof_free[dof, 2] > S(0.0):
                    climb(position[dof], column_panel, panel)
        barrier()
        if thread == 0:
            k = int(0)
            for p in range(panel_count):
                if mark(p, 0, False) == 1:
                    mark(p, k, True)
                    k += panel[p][1]
                else:
                    mark(p, -1, True)
            path_size_out[w, contact] = k
        barrier()
        start = contact * path_limit
        for q in range(thread, size, threads):
            row = column[q][0]
            place = mark(column_panel[q], 0, False)
            if place >= 0:
                place += column[q][1]
                path_out[w, start + place] = row
                for c in range(9):
                    side_out[w, 9 * (start + place) + c] = S(0.0)
            place_out[w, contact * size + row] = place

    @wp.kernel(module=module, enable_backward=False)
    def spread_rows(
        # Symbolic
        size: int,
        path_limit: int,
        # Model
        dof_free: wp.array2d(dtype=real),
        modes: Touch,
        # Workspace in
        pack_first_in: wp.array2d(dtype=wp.int32),
        pack_count_in: wp.array2d(dtype=wp.int32),
        dof_in: wp.array2d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=real),
        lever_in: wp.array3d(dtype=real),
        axes_in: wp.array3d(dtype=real),
        place_in: wp.array2d(dtype=wp.int32),
        # Workspace out
        side_out: wp.array2d(dtype=S),
    ):
        """Y_c = P H_c' of one contact: ``scatter_rows`` of ``contact``, where threads share the modes of a body.

        A block of modes has the same thread in every slot, which keeps its sum meanwhile, and so has a dof that is
        none. Slots are filled from the first one on.
        """
        w, c, thread = wp.tid()
        if c < pack_first_in[w, 0] or c >= pack_count_in[w, 0]:
            return
        pack = w
        lane = int(0)
        if wp.static(variant.world_fastest):
            pack = int(0)
            lane = w
        start = 9 * c * path_limit
        held = int(-1)  # block whose entries are in ``side``
        at = int(0)
        side = Side()
        slot = int(0)
        while slot < wp.static(SLOTS):
            dof = dof_in[w, wp.static(SLOTS) * c + slot]
            if dof >= size:
                node = dof - size
                n0 = slot_row(weight_in, lever_in, axes_in, pack, lane, c, slot, 0)
                n1 = slot_row(weight_in, lever_in, axes_in, pack, lane, c, slot, 1)
                n2 = slot_row(weight_in, lever_in, axes_in, pack, lane, c, slot, 2)
                own0 = own_axes(modes, node, n0, pack, lane)
                own1 = own_axes(modes, node, n1, pack, lane)
                own2 = own_axes(modes, node, n2, pack, lane)
                for p in range(modes.begin[node] + thread, modes.end[node], wp.static(SPREAD)):
                    if p != held:
                        if held >= 0:
                            for k in range(9):
                                side_out[w, at + k] = side[k]
                        held = p
                        at = start + 9 * place_in[w, c * size + modes.dof[p]]
                        for k in range(9):
                            side[k] = side_out[w, at + k]
                    h0 = mode_row(modes, p, node, n0, own0, pack, lane)
                    h1 = mode_row(modes, p, node, n1, own1, pack, lane)
                    h2 = mode_row(modes, p, node, n2, own2, pack, lane)
                    for r in range(3):
                        side[3 * r] += h0[r]
                        side[3 * r + 1] += h1[r]
                        side[3 * r + 2] += h2[r]
            elif dof >= 0 and dof % wp.static(SPREAD) == thread:
                place = place_in[w, c * size + dof]
                if place >= 0:
                    for axis in range(3):
                        h = slot_row(weight_in, lever_in, axes_in, pack, lane, c, slot, axis)
                        for r in range(3):
                            side_out[w, start + 9 * place + 3 * r + axis] += h[r] * dof_free[dof, r]
            slot = wp.where(dof < 0, wp.static(SLOTS), slot + 1)
        if held >= 0:
            for k in range(9):
                side_out[w, at + k] = side[k]

    sizes = {"SCALAR": name_of(S), "DOFS": str(NEAR_DOFS[name_of(S)])}
    sizes |= {"NEAR": str(NEAR), "GROUP": str(NEAR_GROUP), "THREADS": str(THREADS)}

    @wp.func_native(named(_PRODUCTS, sizes))
    def near_products(
        counts: wp.vec4i,
        column: wp.array(dtype=wp.vec4i),
        place: wp.array2d(dtype=wp.int32),
        side: wp.array2d(dtype=S),
        scale: real,
        w: int,
        first: int,
        end: int,
        thread: int,
        delassus_out: wp.array2d(dtype=S),
    ): ...

    @wp.kernel(module=module, enable_backward=False, launch_bounds=THREADS)
    def delassus_near(
        # Symbolic
        size: int,
        path_limit: int,
        row_count: int,
        order: int,
        column: wp.array(dtype=wp.vec4i),
        # Workspace in
        pack_first_in: wp.array2d(dtype=wp.int32),
        pack_count_in: wp.array2d(dtype=wp.int32),
        place_in: wp.array2d(dtype=wp.int32),
        side_in: wp.array2d(dtype=S),
        scale: real,
        # Workspace out
        delassus_out: wp.array2d(dtype=S),
    ):
        """``delassus_contacts`` of ``contact`` for some contacts of a world, whose paths take in most of its dofs."""
        w, group, thread = wp.tid()
        first = wp.max(wp.static(NEAR_GROUP) * group, pack_first_in[w, 0])
        end = wp.min(wp.static(NEAR_GROUP) * (group + 1), pack_count_in[w, 0])
        if first < end:
            counts = wp.vec4i(size, path_limit, row_count, order)
            near_products(counts, column, place_in, side_in, scale, w, first, end, thread, delassus_out)

    @wp.func
    def part(place: int):
        """One column of what ``solved`` keeps of a dof."""
        zero = S(0.0)
        return vec(solved(place, zero, False), solved(place + 3, zero, False), solved(place + 6, zero, False))

    @wp.func
    def team_of(contacts: int, threads: int):
        """Contacts that threads work on side by side: a power of two, so that each thread has one of them."""
        lanes = int(1)
        while lanes < contacts and lanes < threads:
            lanes *= 2
        return lanes

    @wp.kernel(module=module, enable_backward=False, launch_bounds=THREADS)
    def substitute(
        # Symbolic
        size: int,
        path_limit: int,
        panel_count: int,
        column: wp.array(dtype=wp.vec4i),
        column_lower: wp.array(dtype=wp.vec4i),
        row_index: wp.array(dtype=wp.int32),
        panel: wp.array(dtype=wp.vec4i),
        threads: int,
        # Workspace in
        pack_first_in: wp.array2d(dtype=wp.int32),
        pack_count_in: wp.array2d(dtype=wp.int32),
        place_in: wp.array2d(dtype=wp.int32),
        lower_in: wp.array2d(dtype=S),
        # Workspace out
        side_out: wp.array2d(dtype=S),
    ):
        """Y_c <- L^-1 Y_c for some contacts, panel by panel along their paths; rows below a panel lie on the path."""
        w, group, thread = wp.tid()
        first = wp.max(wp.static(group_size) * group, pack_first_in[w, 0])
        end = wp.min(wp.static(group_size) * (group + 1), pack_count_in[w, 0])
        if first >= end:
            return
        for p in range(thread, panel_count, threads):
            row = column[panel[p][0]][0]
            found = int(0)
            for contact in range(first, end):
                if place_in[w, contact * size + row] >= 0:
                    found = 1
            mark(p, found, True)
        barrier()
        zero = S(0.0)
        lanes = team_of(end - first, threads)
        worker = thread // lanes
        workers = threads // lanes
        for p in range(panel_count):
            if mark(p, 0, False) == 1:
                q = panel[p][0]
                k = panel[p][1]
                inverse = column[q][3]
                below = column_lower[q]
                for contact in range(first + thread % lanes, end, lanes):
                    base = contact * size
                    place = place_in[w, base + column[q][0]]
                    keep = wp.static(room) * (contact - first)
                    if place >= 0:
                        begin = 9 * (contact * path_limit + place)
                        for task in range(worker, wp.static(shares) * k, workers):
                            t = task // wp.static(shares)
                            y = Sums()
                            for j in range(t + 1):
                                turned = wp.transpose(block(lower_in, w, inverse + j * k + t, k * k))
                                for a in range(wp.static(axes)):
                                    at = begin + 9 * j + task % wp.static(shares) + a
                                    z = turned * vec(side_out[w, at], side_out[w, at + 3], side_out[w, at + 6])
                                    for r in range(3):
                                        y[3 * a + r] += z[r]
                            for a in range(wp.static(axes)):
                                for r in range(3):
                                    solved(keep + 9 * t + 3 * r + task % wp.static(shares) + a, y[3 * a + r], True)
                barrier()
                for contact in range(first + thread % lanes, end, lanes):
                    base = contact * size
                    start = contact * path_limit
                    place = place_in[w, base + column[q][0]]
                    keep = wp.static(room) * (contact - first)
                    if place >= 0:
                        for task in range(worker, 9 * k, workers):
                            side_out[w, 9 * (start + place) + task] = solved(keep + task, zero, False)
                        for task in range(worker, wp.static(shares) * below[1], workers):
                            row = task // wp.static(shares)
                            axis = task % wp.static(shares)
                            s = Sums()
                            for t in range(k):
                                lower = block(lower_in, w, below[0] + row + 9 * t * below[1], below[1])
                                for a in range(wp.static(axes)):
                                    z = lower * part(keep + 9 * t + axis + a)
                                    for r in range(3):
                                        s[3 * a + r] += z[r]
                            at = 9 * (start + place_in[w, base + column[row_index[below[2] + row]][0]]) + axis
                            for a in range(wp.static(axes)):
                                for r in range(3):
                                    side_out[w, at + 3 * r + a] -= s[3 * a + r]
                barrier()

    found = {"find_path": find_path, "spread_rows": spread_rows, "substitute": substitute, "group": group_size}
    return SimpleNamespace(**found, delassus_near=delassus_near)
