"""Contacts of one world on a CPU in float32, eight of them in the lanes of SIMD registers.

A world by itself has no neighbours to share registers with, as ``contact`` has; here contacts that are near each other
in the elimination tree share them. A *group* of eight has one path, the union of theirs, and entry k of its sides is
a 3x3 block for every contact: component r of the dof, axis s and lane at ``72 (path_limit group + k) + 8 (3 r + s) +
lane``. A block of L is read once for a group, and W is made of products of 24 columns. Groups are filled in the order
of the lowest dof that a contact touches; contacts that come late begin a new one. Theory: docs/theory/contact.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.rows import contact as contact_rows
from softwarp.kernels.rows import places, touch
from softwarp.model.codes import SLOTS

GROUP = 8  # contacts
BLOCK = 9 * GROUP  # numbers of a path entry
COLUMNS = 3 * GROUP

_TYPES = """
typedef float group_t __attribute__((vector_size(32)));
#define LOAD(v, source) __builtin_memcpy(&v, source, sizeof(v))
#define STORE(target, v) __builtin_memcpy(target, &v, sizeof(v))
"""
_END = """
#undef LOAD
#undef STORE
"""


@wp.func_native(
    _TYPES
    + """
float* y = &wp::index(side_out, w, first);
const float* l = &wp::index(lower, w, 0);
const float* inverse = &wp::index(diagonal, w, 0);
const int* rows = &wp::index(place, w, place_first);
const int* path = &wp::index(path_of, w, path_first);
group_t z[9], v[9], t;
for (int k = 0; k < count; ++k) {
    const int j = path[k];
    const float* d = inverse + 6 * j;
    for (int i = 0; i < 9; ++i) LOAD(v[i], y + 72 * k + 8 * i);
    for (int s = 0; s < 3; ++s) {
        z[s] = v[s] * d[0];
        z[3 + s] = v[s] * d[1] + v[3 + s] * d[2];
        z[6 + s] = v[s] * d[3] + v[3 + s] * d[4] + v[6 + s] * d[5];
    }
    for (int i = 0; i < 9; ++i) STORE(y + 72 * k + 8 * i, z[i]);
    const int end = col_start.data[j + 1];
    for (int b = col_start.data[j]; b < end; ++b) {
        float* x = y + 72 * rows[l_row.data[b]];
        const float* a = l + 9 * b;
        for (int r = 0; r < 3; ++r)
            for (int s = 0; s < 3; ++s) {
                LOAD(t, x + 8 * (3 * r + s));
                t -= z[s] * a[3 * r] + z[3 + s] * a[3 * r + 1] + z[6 + s] * a[3 * r + 2];
                STORE(x + 8 * (3 * r + s), t);
            }
    }
}
"""
    + _END
)
def substitute_path(
    side_out: wp.array2d(dtype=wp.float32),
    w: int,
    first: int,
    count: int,
    path_of: wp.array2d(dtype=wp.int32),
    path_first: int,
    place: wp.array2d(dtype=wp.int32),
    place_first: int,
    l_row: wp.array(dtype=wp.int32),
    col_start: wp.array(dtype=wp.int32),
    lower: wp.array2d(dtype=wp.float32),
    diagonal: wp.array2d(dtype=wp.float32),
):
    """``Y <- L^-1 Y`` of a group, column by column along its path; rows below a path entry lie on the path."""


@wp.func_native(
    _TYPES
    + """
const float* y = &wp::index(side, w, 0);
const int* mine = &wp::index(path_of, w, path_first);
const int* theirs = &wp::index(place, w, place_first);
int* common = &wp::index(common_out, w, common_first);
int shared = 0;
for (int k = 0; k < count; ++k)
    if (theirs[mine[k]] >= 0) {
        common[2 * shared] = 72 * k;
        common[2 * shared + 1] = 72 * theirs[mine[k]];
        ++shared;
    }
const float* a = y + first;
const float* b = y + other;
const int* columns = &wp::index(member, w, column_first);
const int* rows = &wp::index(member, w, row_first);
float* out = &wp::index(delassus_out, w, 0);
float product[4][24];
for (int s = 0; s < 3; ++s)
    for (int half = 0; half < 8; half += 4) {
        group_t sum[4][3] = {}, p, q, u;
        for (int k = 0; k < shared; ++k) {
            const float* x = a + common[2 * k];
            const float* z = b + common[2 * k + 1] + 8 * s + half;
            for (int r = 0; r < 3; ++r, x += 24, z += 24) {
                LOAD(p, x);
                LOAD(q, x + 8);
                LOAD(u, x + 16);
                for (int i = 0; i < 4; ++i) {
                    sum[i][0] += p * z[i];
                    sum[i][1] += q * z[i];
                    sum[i][2] += u * z[i];
                }
            }
        }
        __builtin_memcpy(product, sum, sizeof(sum));
        for (int i = 0; i < 4; ++i) {
            if (rows[half + i] < 0) continue;
            const long row = corner + 3 * rows[half + i] + s;
            for (int lane = 0; lane < 8; ++lane) {
                if (columns[lane] < 0) continue;
                for (int c = 0; c < 3; ++c) {
                    const long column = corner + 3 * columns[lane] + c;
                    const float value = product[i][8 * c + lane] * scale;
                    out[row * order + column] = value;
                    out[column * order + row] = value;
                }
            }
        }
    }
"""
    + _END
)
def group_product(
    side: wp.array2d(dtype=wp.float32),
    w: int,
    first: int,
    other: int,
    count: int,
    path_of: wp.array2d(dtype=wp.int32),
    path_first: int,
    place: wp.array2d(dtype=wp.int32),
    place_first: int,
    common_out: wp.array2d(dtype=wp.int32),
    common_first: int,
    member: wp.array2d(dtype=wp.int32),
    column_first: int,
    row_first: int,
    corner: int,
    order: int,
    scale: wp.float32,
    delassus_out: wp.array2d(dtype=wp.float32),
):
    """Write ``Y' Z`` of two groups, and its mirror image, into W.

    Sides of the one begin at ``first``, its contacts at ``column_first``; those of the other at ``other`` and at
    ``row_first``. The rows of contact 0 begin at ``corner``.
    """


@wp.func_native(
    _TYPES
    + """
const float* x = &wp::index(side, w, first);
const float* v = &wp::index(y, w, y_first);
const int* path = &wp::index(path_of, w, path_first);
group_t sum[3] = {}, t;
for (int k = 0; k < count; ++k) {
    const float* u = v + 3 * path[k];
    for (int r = 0; r < 3; ++r, x += 24)
        for (int s = 0; s < 3; ++s) {
            LOAD(t, x + 8 * s);
            sum[s] += t * u[r];
        }
}
wp::vec_t<24, wp::float32> result;
__builtin_memcpy(&result, sum, sizeof(sum));
"""
    + _END
    + "return result;\n"
)
def vector_product(
    side: wp.array2d(dtype=wp.float32),
    w: int,
    first: int,
    count: int,
    path_of: wp.array2d(dtype=wp.int32),
    path_first: int,
    y: wp.array2d(dtype=wp.float32),
    y_first: int,
) -> wp.types.vector(COLUMNS, wp.float32):
    """``Y' y`` of a group; entry 8 s + lane."""


@wp.func_native(
    _TYPES
    + """
const float* x = &wp::index(side, w, first);
float* v = &wp::index(y_out, w, 0);
const int* path = &wp::index(path_of, w, path_first);
group_t c[3], t, u, s;
__builtin_memcpy(c, &change, sizeof(c));
for (int k = 0; k < count; ++k)
    for (int r = 0; r < 3; ++r, x += 24) {
        LOAD(t, x);
        LOAD(u, x + 8);
        LOAD(s, x + 16);
        t = t * c[0] + u * c[1] + s * c[2];
        v[3 * path[k] + r] += ((t[0] + t[4]) + (t[1] + t[5])) + ((t[2] + t[6]) + (t[3] + t[7]));
    }
"""
    + _END
)
def add_product(
    side: wp.array2d(dtype=wp.float32),
    w: int,
    first: int,
    count: int,
    path_of: wp.array2d(dtype=wp.int32),
    path_first: int,
    change: wp.types.vector(COLUMNS, wp.float32),
    y_out: wp.array2d(dtype=wp.float32),
):
    """``y += Y change`` of a group."""


@cache
def kernels() -> SimpleNamespace:
    """Contact kernels of one world in float32."""
    scalar = variant("scalar")
    module = scalar.module("contact_wide")
    slot_row = contact_rows.kernels(scalar).slot_row
    Touch, first_dof, own_axes, mode_row = vars(touch.functions(scalar)).values()
    unplace, number_places = places.unplace, places.numbering(wp.float32)
    columns = wp.types.vector(COLUMNS, wp.float32)

    @wp.kernel(module=module, enable_backward=False)
    def fill_groups(
        # Symbolic
        size: int,
        # Model
        dof_free: wp.array2d(dtype=wp.float32),
        modes: Touch,
        # Workspace in
        pack_first_in: wp.array2d(dtype=wp.int32),
        pack_count_in: wp.array2d(dtype=wp.int32),
        dof_in: wp.array2d(dtype=wp.int32),
        # Workspace out
        group_first_out: wp.array2d(dtype=wp.int32),
        group_count_out: wp.array2d(dtype=wp.int32),
        seat_out: wp.array2d(dtype=wp.int32),
        member_out: wp.array2d(dtype=wp.int32),
        lowest_out: wp.array2d(dtype=wp.int32),
    ):
        """Groups of the contacts to be worked on, in the order of the lowest dof of each; -1 where a seat is empty."""
        w = wp.tid()
        first = pack_first_in[w, 0]
        count = pack_count_in[w, 0]
        group = int(0)  # after those of the contacts before the first
        for contact in range(first):
            group = wp.max(group, seat_out[w, contact] // wp.static(GROUP) + 1)
        begin = wp.static(GROUP) * group
        for contact in range(first, count):
            lowest = size
            for slot in range(int(wp.static(SLOTS))):
                dof = dof_in[w, wp.static(SLOTS) * contact + slot]
                if dof >= 0:
                    dof = first_dof(modes, size, dof)
                    if dof_free[dof, 0] + dof_free[dof, 1] + dof_free[dof, 2] > 0.0:
                        lowest = wp.min(lowest, dof)
            seat = begin + contact - first
            while seat > begin and lowest_out[w, wp.max(seat - 1, 0)] > lowest:
                lowest_out[w, seat] = lowest_out[w, seat - 1]
                member_out[w, seat] = member_out[w, seat - 1]
                seat -= 1
            lowest_out[w, seat] = lowest
            member_out[w, seat] = contact
        end = begin + count - first
        for seat in range(begin, end):
            seat_out[w, member_out[w, seat]] = seat
        groups = (end + wp.static(GROUP - 1)) // wp.static(GROUP)
        for seat in range(end, wp.static(GROUP) * groups):
            member_out[w, seat] = -1
        group_first_out[w, 0] = group
        group_count_out[w, 0] = groups

    @wp.kernel(module=module, enable_backward=False)
    def find_path(
        # Symbolic
        size: int,
        path_limit: int,
        parent: wp.array(dtype=wp.int32),
        # Model
        dof_free: wp.array2d(dtype=wp.float32),
        modes: Touch,
        # Workspace in
        group_first_in: wp.array2d(dtype=wp.int32),
        group_count_in: wp.array2d(dtype=wp.int32),
        member_in: wp.array2d(dtype=wp.int32),
        dof_in: wp.array2d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=wp.float32),
        lever_in: wp.array3d(dtype=wp.float32),
        axes_in: wp.array3d(dtype=wp.float32),
        # Workspace out
        path_size_out: wp.array2d(dtype=wp.int32),
        path_out: wp.array2d(dtype=wp.int32),
        place_out: wp.array2d(dtype=wp.int32),
        side_out: wp.array2d(dtype=wp.float32),
    ):
        """Path of one group in ascending order, the place of every dof in it (or -1), and Y = P H'."""
        w, group = wp.tid()
        if group < group_first_in[w, 0] or group >= group_count_in[w, 0]:
            return
        base = group * size
        unplace(place_out, w, base, size)
        first = size
        for lane in range(int(wp.static(GROUP))):
            contact = member_in[w, wp.static(GROUP) * group + lane]
            if contact >= 0:
                for slot in range(int(wp.static(SLOTS))):
                    dof = dof_in[w, wp.static(SLOTS) * contact + slot]
                    if dof >= 0:
                        dof = first_dof(modes, size, dof)
                        if dof_free[dof, 0] + dof_free[dof, 1] + dof_free[dof, 2] == 0.0:
                            dof = -1
                        else:
                            first = wp.min(first, dof)
                    while dof >= 0:
                        if place_out[w, base + dof] >= 0:
                            dof = -1
                        else:
                            place_out[w, base + dof] = 0
                            dof = parent[dof]
        start = group * path_limit
        k = number_places(place_out, path_out, side_out, w, base, first, size, start)
        path_size_out[w, group] = k
        for lane in range(int(wp.static(GROUP))):
            contact = member_in[w, wp.static(GROUP) * group + lane]
            if contact >= 0:
                for slot in range(int(wp.static(SLOTS))):
                    dof = dof_in[w, wp.static(SLOTS) * contact + slot]
                    place = int(-1)
                    if dof >= size:
                        node = dof - size
                        for axis in range(3):
                            n = slot_row(weight_in, lever_in, axes_in, w, 0, contact, slot, axis)
                            own = own_axes(modes, node, n, w, 0)
                            for block in range(modes.begin[node], modes.end[node]):
                                t = wp.static(BLOCK) * (start + place_out[w, base + modes.dof[block]]) + lane
                                h = mode_row(modes, block, node, n, own, w, 0)
                                for r in range(3):
                                    side_out[w, t + wp.static(GROUP) * (3 * r + axis)] += h[r]
                    elif dof >= 0:
                        place = place_out[w, base + dof]
                    if place >= 0:
                        t = wp.static(BLOCK) * (start + place) + lane
                        for axis in range(3):
                            h = slot_row(weight_in, lever_in, axes_in, w, 0, contact, slot, axis)
                            for r in range(3):
                                side_out[w, t + wp.static(GROUP) * (3 * r + axis)] += h[r] * dof_free[dof, r]

    @wp.kernel(module=module, enable_backward=False)
    def substitute(
        # Symbolic
        size: int,
        path_limit: int,
        l_row: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
        # Workspace in
        group_first_in: wp.array2d(dtype=wp.int32),
        group_count_in: wp.array2d(dtype=wp.int32),
        path_size_in: wp.array2d(dtype=wp.int32),
        path_in: wp.array2d(dtype=wp.int32),
        place_in: wp.array2d(dtype=wp.int32),
        lower_in: wp.array2d(dtype=wp.float32),
        diagonal_in: wp.array2d(dtype=wp.float32),
        # Workspace out
        side_out: wp.array2d(dtype=wp.float32),
    ):
        """Half-solved sides of one group."""
        w, group = wp.tid()
        if group < group_first_in[w, 0] or group >= group_count_in[w, 0]:
            return
        start = group * path_limit
        begin = wp.static(BLOCK) * start
        count = path_size_in[w, group]
        base = group * size
        substitute_path(
            side_out, w, begin, count, path_in, start, place_in, base, l_row, col_start, lower_in, diagonal_in
        )

    @wp.kernel(module=module, enable_backward=False)
    def delassus_contacts(
        # Symbolic
        size: int,
        path_limit: int,
        row_count: int,
        order: int,
        # Workspace in
        group_first_in: wp.array2d(dtype=wp.int32),
        group_count_in: wp.array2d(dtype=wp.int32),
        member_in: wp.array2d(dtype=wp.int32),
        path_size_in: wp.array2d(dtype=wp.int32),
        path_in: wp.array2d(dtype=wp.int32),
        place_in: wp.array2d(dtype=wp.int32),
        side_in: wp.array2d(dtype=wp.float32),
        scale: wp.float32,
        # Workspace out
        common_out: wp.array2d(dtype=wp.int32),
        delassus_out: wp.array2d(dtype=wp.float32),
    ):
        """Blocks of W, and their mirror images, of the contacts of all new groups with those of all before."""
        w = wp.tid()
        for group in range(group_first_in[w, 0], group_count_in[w, 0]):
            start = group * path_limit
            begin = wp.static(BLOCK) * start
            count = path_size_in[w, group]
            for other in range(group + 1):
                end = wp.static(BLOCK) * path_limit * other
                group_product(
                    side_in,
                    w,
                    begin,
                    end,
                    count,
                    path_in,
                    start,
                    place_in,
                    other * size,
                    common_out,
                    0,
                    member_in,
                    wp.static(GROUP) * group,
                    wp.static(GROUP) * other,
                    row_count,
                    order,
                    scale,
                    delassus_out,
                )

    @wp.kernel(module=module, enable_backward=False)
    def delassus_rows(
        # Symbolic
        size: int,
        path_limit: int,
        row_count: int,
        order: int,
        # Workspace in
        group_first_in: wp.array2d(dtype=wp.int32),
        group_count_in: wp.array2d(dtype=wp.int32),
        member_in: wp.array2d(dtype=wp.int32),
        path_size_in: wp.array2d(dtype=wp.int32),
        path_in: wp.array2d(dtype=wp.int32),
        side_in: wp.array2d(dtype=wp.float32),
        y_in: wp.array2d(dtype=wp.float32),
        scale: wp.float32,
        # Workspace out
        delassus_out: wp.array2d(dtype=wp.float32),
    ):
        """Entries of W between one group and the static rows."""
        w, group = wp.tid()
        if group < group_first_in[w, 0] or group >= group_count_in[w, 0]:
            return
        start = group * path_limit
        begin = wp.static(BLOCK) * start
        count = path_size_in[w, group]
        for row in range(row_count):
            sums = vector_product(side_in, w, begin, count, path_in, start, y_in, 3 * size * (1 + row))
            for lane in range(int(wp.static(GROUP))):
                contact = member_in[w, wp.static(GROUP) * group + lane]
                if contact >= 0:
                    for s in range(3):
                        i = row_count + 3 * contact + s
                        value = sums[wp.static(GROUP) * s + lane] * scale
                        delassus_out[w, row * order + i] = value
                        delassus_out[w, i * order + row] = value

    @wp.kernel(module=module, enable_backward=False)
    def free_gap(
        # Symbolic
        path_limit: int,
        row_count: int,
        # Workspace in
        group_count_in: wp.array2d(dtype=wp.int32),
        member_in: wp.array2d(dtype=wp.int32),
        path_size_in: wp.array2d(dtype=wp.int32),
        path_in: wp.array2d(dtype=wp.int32),
        side_in: wp.array2d(dtype=wp.float32),
        y_in: wp.array2d(dtype=wp.float32),
        x_scale: wp.float32,
        # Workspace out
        gap_out: wp.array2d(dtype=wp.float32),
    ):
        """Gaps of one group: add s Y' y, the motion without new multipliers."""
        w, group = wp.tid()
        if group >= group_count_in[w, 0]:
            return
        start = group * path_limit
        sums = vector_product(side_in, w, wp.static(BLOCK) * start, path_size_in[w, group], path_in, start, y_in, 0)
        for lane in range(int(wp.static(GROUP))):
            contact = member_in[w, wp.static(GROUP) * group + lane]
            if contact >= 0:
                for s in range(3):
                    gap_out[w, row_count + 3 * contact + s] += sums[wp.static(GROUP) * s + lane] * x_scale

    @wp.kernel(module=module, enable_backward=False)
    def add_change(
        # Symbolic
        path_limit: int,
        row_count: int,
        # Workspace in
        group_count_in: wp.array2d(dtype=wp.int32),
        member_in: wp.array2d(dtype=wp.int32),
        path_size_in: wp.array2d(dtype=wp.int32),
        path_in: wp.array2d(dtype=wp.int32),
        side_in: wp.array2d(dtype=wp.float32),
        change_in: wp.array2d(dtype=wp.float32),
        f_scale: wp.float32,
        # Workspace out
        y_out: wp.array2d(dtype=wp.float32),
    ):
        """y += f Y change of all contacts, group after group."""
        w = wp.tid()
        for group in range(group_count_in[w, 0]):
            change = columns()
            for lane in range(int(wp.static(GROUP))):
                contact = member_in[w, wp.static(GROUP) * group + lane]
                if contact >= 0:
                    for s in range(3):
                        change[wp.static(GROUP) * s + lane] = change_in[w, row_count + 3 * contact + s] * f_scale
            start = group * path_limit
            add_product(side_in, w, wp.static(BLOCK) * start, path_size_in[w, group], path_in, start, change, y_out)

    return SimpleNamespace(
        fill_groups=fill_groups,
        find_path=find_path,
        substitute=substitute,
        delassus_contacts=delassus_contacts,
        delassus_rows=delassus_rows,
        free_gap=free_gap,
        add_change=add_change,
    )
