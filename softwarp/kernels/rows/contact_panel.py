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
from softwarp.kernels.linear.cholesky_panels import barrier, shared_memory
from softwarp.kernels.rows import touch
from softwarp.model.codes import SLOTS

THREADS = 128  # per block; benchmarks/contact.py
MOST_PANELS = 2048  # panels whose places on a path a block keeps in shared memory
MOST_COLUMNS = 64  # of a panel, whose part of the sides it keeps as well
GROUP = 4  # contacts that a block substitutes for

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


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Cooperative kernels of contacts, for variants without lanes."""
    S = variant.S
    module = variant.module("contact_panel")
    block = cholesky_panels.kernels(variant).block
    vec = wp.types.vector(3, dtype=S)
    Touch, first_dof, _, _ = vars(touch.functions(variant)).values()

    @wp.func_native(_MARK.replace("COUNT", str(MOST_PANELS)))
    def mark(place: int, value: int, write: bool) -> int: ...

    @wp.func_native(shared_memory(S, 9 * MOST_COLUMNS * GROUP))
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
        first = wp.max(wp.static(GROUP) * group, pack_first_in[w, 0])
        end = wp.min(wp.static(GROUP) * (group + 1), pack_count_in[w, 0])
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
                    keep = 9 * wp.static(MOST_COLUMNS) * (contact - first)
                    if place >= 0:
                        begin = 9 * (contact * path_limit + place)
                        for task in range(worker, 3 * k, workers):
                            t = task // 3
                            y = vec()
                            for j in range(t + 1):
                                at = begin + 9 * j + task % 3
                                z = vec(side_out[w, at], side_out[w, at + 3], side_out[w, at + 6])
                                y += wp.transpose(block(lower_in, w, inverse + j * k + t, k * k)) * z
                            for r in range(3):
                                solved(keep + 9 * t + 3 * r + task % 3, y[r], True)
                barrier()
                for contact in range(first + thread % lanes, end, lanes):
                    base = contact * size
                    start = contact * path_limit
                    place = place_in[w, base + column[q][0]]
                    keep = 9 * wp.static(MOST_COLUMNS) * (contact - first)
                    if place >= 0:
                        for task in range(worker, 9 * k, workers):
                            side_out[w, 9 * (start + place) + task] = solved(keep + task, zero, False)
                        for task in range(worker, 3 * below[1], workers):
                            row = task // 3
                            s = vec()
                            for t in range(k):
                                at = keep + 9 * t + task % 3
                                y = part(at)
                                s += block(lower_in, w, below[0] + row + 9 * t * below[1], below[1]) * y
                            at = 9 * (start + place_in[w, base + column[row_index[below[2] + row]][0]]) + task % 3
                            for r in range(3):
                                side_out[w, at + 3 * r] -= s[r]
                barrier()

    return SimpleNamespace(find_path=find_path, substitute=substitute)
