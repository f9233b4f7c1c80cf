"""Rows of contacts of eight worlds in SIMD lanes: paths, sides, known gaps, forces and outputs, on a CPU in float32.

Results are those of the kernels for single worlds in ``contact``, ``contact_force`` and ``collision.output``, with the
same bits. Worlds of a pack mostly touch with the same dofs, whose entries then are whole registers; where dofs differ,
lanes are gathered. Theory: docs/theory/contact.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import LANE_COUNT, variant, vec8
from softwarp.kernels.collision.output import NO_PAIR
from softwarp.kernels.rows import contact, places
from softwarp.model.codes import SLOTS

# Rounded as Warp's own arithmetic is: products and sums one after the other.
_TYPES = f"""
#pragma clang fp contract(off)
typedef float lane_t __attribute__((vector_size({4 * LANE_COUNT}), aligned(4), may_alias));
typedef int mask_t __attribute__((vector_size({4 * LANE_COUNT}), aligned(4), may_alias));
const int lanes = {LANE_COUNT}, slots = {SLOTS};
auto any = [](mask_t m) {{ return __builtin_reduce_or(m) != 0; }};
"""

# Dofs of a slot in the worlds that are ``on``, and whether they are all the same; entries of H at a slot.
_SLOT = """
struct Slot {
    mask_t dof, on;
    int common;
    bool is_common;
};
auto slot_of = [&](int contact, int slot, mask_t present) {
    Slot s;
    __builtin_memcpy(&s.dof, &wp::index(dof_in, w, slots * contact + slot, 0), sizeof(s.dof));
    s.on = present & (s.dof >= 0);
    s.common = __builtin_reduce_max(s.on ? s.dof : mask_t{} - 1);
    s.is_common = !any(s.on & (s.dof != s.common));
    return s;
};
auto row = [](const float* rows, int number) {
    lane_t value;
    __builtin_memcpy(&value, rows + lanes * number, sizeof(value));
    return value;
};
auto entries = [&](int contact, int slot, int axis, lane_t (&h)[3]) {
    const float* const axes = &wp::index(axes_in, w, 9 * contact + 3 * axis, 0);
    const float* const lever = &wp::index(lever_in, w, 3 * (slots * contact + slot), 0);
    const lane_t weight = row(&wp::index(weight_in, w, slots * contact + slot, 0), 0);
    const lane_t n0 = row(axes, 0), n1 = row(axes, 1), n2 = row(axes, 2);
    const lane_t r0 = row(lever, 0), r1 = row(lever, 1), r2 = row(lever, 2);
    h[0] = weight * n0 + (r1 * n2 - r2 * n1);
    h[1] = weight * n1 + (r2 * n0 - r0 * n2);
    h[2] = weight * n2 + (r0 * n1 - r1 * n0);
};
"""


@wp.func_native(
    _TYPES
    + """
int* const place = &wp::index(place_out, w, contact * size);
int first = size;
for (int slot = 0; slot < slots; ++slot) {
    const int* const dofs = &wp::index(dof_in, w, slots * contact + slot, 0);
    int last = -1;
    for (int lane = 0; lane < lanes; ++lane) {
        int dof = dofs[lane];
        if (dof < 0 || dof == last) continue;
        last = dof;
        if (dof >= size) dof = first_dof.data[dof - size];
        const float* const is_free = &wp::index(dof_free, dof, 0);
        if (is_free[0] + is_free[1] + is_free[2] == 0) continue;
        first = dof < first ? dof : first;
        for (; dof >= 0 && place[dof] < 0; dof = parent.data[dof]) place[dof] = 0;
    }
}
return first;
"""
)
def mark_path(
    w: int,
    contact: int,
    size: int,
    parent: wp.array(dtype=wp.int32),
    dof_free: wp.array2d(dtype=wp.float32),
    first_dof: wp.array(dtype=wp.int32),
    dof_in: wp.array3d(dtype=wp.int32),
    place_out: wp.array2d(dtype=wp.int32),
) -> int:
    """Set the places of a contact's dofs and their ancestors to 0; returns the first of them, ``size`` if none."""


@wp.func_native(
    _TYPES
    + _SLOT
    + """
mask_t count;
__builtin_memcpy(&count, &wp::index(count_in, w, 0, 0), sizeof(count));
const mask_t present = count > contact;
for (int slot = 0; slot < slots; ++slot) {
    const Slot s = slot_of(contact, slot, present);
    if (!any(s.on)) continue;
    for (int axis = 0; axis < 3; ++axis) {
        lane_t h[3];
        entries(contact, slot, axis, h);
        for (int lane = 0; lane < (s.is_common ? 1 : lanes); ++lane) {
            const int dof = s.is_common ? s.common : s.dof[lane];
            if (!s.is_common && !s.on[lane]) continue;
            const int place = wp::index(place_in, w, contact * size + dof);
            if (place < 0) continue;
            float* const out = &wp::index(side_out, w, 9 * (contact * path_limit + place), 0);
            for (int r = 0; r < 3; ++r) {
                float* const at = out + lanes * (3 * r + axis);
                const float is_free = wp::index(dof_free, dof, r);
                if (!s.is_common) { at[lane] += h[r][lane] * is_free; continue; }
                const lane_t old = row(at, 0), value = s.on ? old + h[r] * is_free : old;
                __builtin_memcpy(at, &value, sizeof(value));
            }
        }
    }
}
"""
)
def scatter_slots(
    w: int,
    contact: int,
    size: int,
    path_limit: int,
    dof_free: wp.array2d(dtype=wp.float32),
    count_in: wp.array3d(dtype=wp.int32),
    dof_in: wp.array3d(dtype=wp.int32),
    weight_in: wp.array3d(dtype=wp.float32),
    lever_in: wp.array3d(dtype=wp.float32),
    axes_in: wp.array3d(dtype=wp.float32),
    place_in: wp.array2d(dtype=wp.int32),
    side_out: wp.array3d(dtype=wp.float32),
):
    """Y_c = P H_c' of one contact."""


@wp.func_native(
    _TYPES
    + _SLOT
    + """
mask_t count, listed;
__builtin_memcpy(&count, &wp::index(count_in, w, 0, 0), sizeof(count));
__builtin_memcpy(&listed, &wp::index(listed_in, w, 0, 0), sizeof(listed));
const mask_t present = count > contact;
auto larger = [](lane_t a, lane_t b) { return a > b ? a : b; };
auto size = [&](lane_t a) { return a < 0.0f ? -a : a; };
const float *const v = &wp::index(v_in, w, 0, 0), *const u = &wp::index(u_in, w, 0, 0);
const float* const v0 = &wp::index(v0_in, w, 0, 0);
const lane_t zero = {}, restitution = row(&wp::index(restitution_in, w, contact, 0), 0);
const bool bounces = any(restitution > 0.0f);
lane_t slip[3] = {}, before = {};
for (int slot = 0; slot < slots; ++slot) {
    const Slot s = slot_of(contact, slot, present);
    if (!any(s.on)) continue;
    lane_t x[3] = {}, x0[3] = {};
    for (int r = 0; r < 3; ++r) {
        if (s.is_common) {
            x[r] = row(v, 3 * s.common + r) + row(u, 3 * s.common + r);
            x0[r] = row(v0, 3 * s.common + r);
            continue;
        }
        for (int lane = 0; lane < lanes; ++lane) {
            if (!s.on[lane]) continue;
            const int t = lanes * (3 * s.dof[lane] + r) + lane;
            x[r][lane] = v[t] + u[t];
            x0[r][lane] = v0[t];
        }
    }
    for (int axis = 0; axis < 3; ++axis) {
        lane_t h[3];
        entries(contact, slot, axis, h);
        slip[axis] += s.on ? h[0] * x[0] + h[1] * x[1] + h[2] * x[2] : zero;
        if (axis == 0 && bounces) before += s.on ? h[0] * x0[0] + h[1] * x0[1] + h[2] * x0[2] : zero;
    }
}
const lane_t distance = row(&wp::index(distance_in, w, contact, 0), 0);
const lane_t softness = row(&wp::index(softness_in, w, contact, 0), 0);
const mask_t is_taken_back = (distance < 0.0f) & (softness == 0.0f) & (listed > contact);
const lane_t target = is_taken_back ? larger(share * distance, zero - recovery * x_scale) : distance;
lane_t normal = target + x_scale * slip[0];
const mask_t is_bounce = (restitution > 0.0f) & (before < -bounce_speed) & (distance + x_scale * before <= 0.0f);
if (is_measured) {
    const lane_t end = row(&wp::index(end_in, w, contact, 0), 0);
    const float* const point = &wp::index(point_in, w, 3 * contact, 0);
    const lane_t place = larger(larger(size(row(point, 0)), size(row(point, 1))), size(row(point, 2)));
    const lane_t measured = end - (distance - target) + place * ROUNDING;
    const mask_t is_less = (end < UNKNOWN) & (measured < normal);
    normal = is_less ? measured : normal;
}
normal = is_bounce ? x_scale * (restitution * before + slip[0]) : normal;
const lane_t gaps[3] = {
    present ? normal : zero + 1.0f, present ? x_scale * slip[1] : zero, present ? x_scale * slip[2] : zero
};
__builtin_memcpy(&wp::index(gap_out, w, row_count + 3 * contact, 0), gaps, sizeof(gaps));
""".replace("ROUNDING", f"{contact.ROUNDING * 2.0**-23}f").replace("UNKNOWN", f"{contact.UNKNOWN}f")
)
def contact_gap(
    w: int,
    contact: int,
    row_count: int,
    listed_in: wp.array3d(dtype=wp.int32),
    count_in: wp.array3d(dtype=wp.int32),
    dof_in: wp.array3d(dtype=wp.int32),
    weight_in: wp.array3d(dtype=wp.float32),
    lever_in: wp.array3d(dtype=wp.float32),
    axes_in: wp.array3d(dtype=wp.float32),
    distance_in: wp.array3d(dtype=wp.float32),
    restitution_in: wp.array3d(dtype=wp.float32),
    softness_in: wp.array3d(dtype=wp.float32),
    v0_in: wp.array3d(dtype=wp.float32),
    v_in: wp.array3d(dtype=wp.float32),
    u_in: wp.array3d(dtype=wp.float32),
    point_in: wp.array3d(dtype=wp.float32),
    end_in: wp.array3d(dtype=wp.float32),
    is_measured: bool,
    x_scale: wp.float32,
    share: wp.float32,
    recovery: wp.float32,
    bounce_speed: wp.float32,
    gap_out: wp.array3d(dtype=wp.float32),
):
    """Gaps of one contact from the velocities known so far, as ``known_gap`` of ``contact`` has them."""


@wp.func_native(
    _TYPES
    + _SLOT
    + """
mask_t count;
__builtin_memcpy(&count, &wp::index(count_in, w, 0, 0), sizeof(count));
for (int contact = 0; any(count > contact); ++contact) {
    const float* const multiplier = &wp::index(multiplier_in, w, 3 * contact, 0);
    for (int slot = 0; slot < slots; ++slot) {
        const Slot s = slot_of(contact, slot, count > contact);
        if (!any(s.on)) continue;
        lane_t force[3] = {};
        for (int axis = 0; axis < 3; ++axis) {
            lane_t h[3];
            entries(contact, slot, axis, h);
            const lane_t pull = row(multiplier, axis) * f_scale;
            for (int r = 0; r < 3; ++r) force[r] += h[r] * pull;
        }
        for (int lane = 0; lane < (s.is_common ? 1 : lanes); ++lane) {
            const int dof = s.is_common ? s.common : s.dof[lane];
            if (!s.is_common && !s.on[lane]) continue;
            for (int r = 0; r < 3; ++r) {
                if (dof < dof_free.shape[0] && !(wp::index(dof_free, dof, r) > 0.0f)) continue;
                float* const at = &wp::index(target_out, w, 3 * dof + r, 0);
                if (!s.is_common) { at[lane] += force[r][lane]; continue; }
                const lane_t old = row(at, 0), value = s.on ? old + force[r] : old;
                __builtin_memcpy(at, &value, sizeof(value));
            }
        }
    }
}
"""
)
def push(
    w: int,
    dof_free: wp.array2d(dtype=wp.float32),
    count_in: wp.array3d(dtype=wp.int32),
    dof_in: wp.array3d(dtype=wp.int32),
    weight_in: wp.array3d(dtype=wp.float32),
    lever_in: wp.array3d(dtype=wp.float32),
    axes_in: wp.array3d(dtype=wp.float32),
    multiplier_in: wp.array3d(dtype=wp.float32),
    f_scale: wp.float32,
    target_out: wp.array3d(dtype=wp.float32),
):
    """target += f P H' multiplier of all contacts of a pack, in their order."""


@wp.func_native(
    _TYPES
    + """
auto row = [](const float* rows, int number) {
    lane_t value;
    __builtin_memcpy(&value, rows + lanes * number, sizeof(value));
    return value;
};
auto whole = [](const int* rows, int number) {
    mask_t value;
    __builtin_memcpy(&value, rows + lanes * number, sizeof(value));
    return value;
};
const int* const flag = &wp::index(flag_in, w, 0, 0);
const mask_t is_good = (whole(flag, 0) + whole(flag, 1)) == 0;
const mask_t is_used = whole(&wp::index(count_in, w, 0, 0), 0) > contact;
const mask_t pair = is_used ? whole(&wp::index(pair_in, w, contact, 0), 0) : mask_t{} + NO_PAIR;
const mask_t couple = whole(&wp::index(couple_in, w, contact, 0), 0);
const float* const axes = &wp::index(axes_in, w, 9 * contact, 0);
const float* const place = &wp::index(point_in, w, 3 * contact, 0);
const float* const multiplier = &wp::index(multiplier_in, w, 3 * contact, 0);
const lane_t zero = {}, gap = is_used ? row(&wp::index(gap_in, w, contact, 0), 0) : zero;
lane_t sign = {}, point[3], normal[3], load[3];
for (int lane = 0; lane < lanes; ++lane)
    if (is_used[lane]) sign[lane] = couple_sign.data[couple[lane]];
for (int c = 0; c < 3; ++c) {
    lane_t force = {};
    for (int axis = 0; axis < 3; ++axis) force += row(axes, 3 * axis + c) * row(multiplier, axis);
    point[c] = is_used ? row(place, c) : zero;
    normal[c] = is_used ? sign * row(axes, c) : zero;
    load[c] = is_used ? sign * force : zero;
}
for (int lane = 0; lane < lanes && lanes * w + lane < pair_out.shape[0]; ++lane) {
    if (!is_good[lane]) continue;
    const int world = lanes * w + lane;
    wp::index(pair_out, world, contact) = pair[lane];
    wp::index(gap_out, world, contact) = gap[lane];
    for (int c = 0; c < 3; ++c) {
        wp::index(point_out, world, 3 * contact + c) = point[c][lane];
        wp::index(normal_out, world, 3 * contact + c) = normal[c][lane];
        wp::index(load_out, world, 3 * contact + c) = load[c][lane];
    }
}
""".replace("NO_PAIR", f"{NO_PAIR}")
)
def write_contact(
    w: int,
    contact: int,
    couple_sign: wp.array(dtype=wp.int32),
    flag_in: wp.array3d(dtype=wp.int32),
    count_in: wp.array3d(dtype=wp.int32),
    pair_in: wp.array3d(dtype=wp.int32),
    couple_in: wp.array3d(dtype=wp.int32),
    axes_in: wp.array3d(dtype=wp.float32),
    point_in: wp.array3d(dtype=wp.float32),
    gap_in: wp.array3d(dtype=wp.float32),
    multiplier_in: wp.array3d(dtype=wp.float32),
    pair_out: wp.array2d(dtype=wp.int32),
    point_out: wp.array2d(dtype=wp.float32),
    normal_out: wp.array2d(dtype=wp.float32),
    load_out: wp.array2d(dtype=wp.float32),
    gap_out: wp.array2d(dtype=wp.float32),
):
    """One contact of good worlds as users see it, as ``write_contacts`` of ``collision.output`` has it."""


@cache
def kernels() -> SimpleNamespace:
    """Compile-once set of kernels of packs of eight worlds."""
    module = variant("lanes").module("contact_lanes")
    number_places = places.numbering(vec8)

    @wp.kernel(module=module, enable_backward=False)
    def find_path(
        # Symbolic
        size: int,
        path_limit: int,
        parent: wp.array(dtype=wp.int32),
        # Model
        dof_free: wp.array2d(dtype=wp.float32),
        first_dof: wp.array(dtype=wp.int32),
        # Workspace in
        pack_first_in: wp.array2d(dtype=wp.int32),
        pack_count_in: wp.array2d(dtype=wp.int32),
        dof_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        path_size_out: wp.array2d(dtype=wp.int32),
        path_out: wp.array2d(dtype=wp.int32),
        place_out: wp.array2d(dtype=wp.int32),
        side_out: wp.array2d(dtype=vec8),
    ):
        """Path of one contact in ascending order, the place of every dof in it (or -1), and zero right-hand sides."""
        w, contact = wp.tid()
        if contact < pack_first_in[w, 0] or contact >= pack_count_in[w, 0]:
            return
        base = contact * size
        places.unplace(place_out, w, base, size)
        first = mark_path(w, contact, size, parent, dof_free, first_dof, dof_in, place_out)
        path_size_out[w, contact] = number_places(
            place_out, path_out, side_out, w, base, first, size, contact * path_limit
        )

    @wp.kernel(module=module, enable_backward=False)
    def scatter_rows(
        # Symbolic
        size: int,
        path_limit: int,
        # Model
        dof_free: wp.array2d(dtype=wp.float32),
        # Workspace in
        pack_first_in: wp.array2d(dtype=wp.int32),
        pack_count_in: wp.array2d(dtype=wp.int32),
        count_in: wp.array3d(dtype=wp.int32),
        dof_in: wp.array3d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=wp.float32),
        lever_in: wp.array3d(dtype=wp.float32),
        axes_in: wp.array3d(dtype=wp.float32),
        place_in: wp.array2d(dtype=wp.int32),
        # Workspace out
        side_out: wp.array3d(dtype=wp.float32),
    ):
        """Y_c = P H_c' of one contact; without modes of reduced bodies."""
        w, contact = wp.tid()
        if contact < pack_first_in[w, 0] or contact >= pack_count_in[w, 0]:
            return
        scatter_slots(
            w,
            contact,
            size,
            path_limit,
            dof_free,
            count_in,
            dof_in,
            weight_in,
            lever_in,
            axes_in,
            place_in,
            side_out,
        )

    @wp.kernel(module=module, enable_backward=False)
    def known_gap(
        row_count: int,
        # Workspace in
        pack_count_in: wp.array3d(dtype=wp.int32),
        listed_in: wp.array3d(dtype=wp.int32),
        count_in: wp.array3d(dtype=wp.int32),
        dof_in: wp.array3d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=wp.float32),
        lever_in: wp.array3d(dtype=wp.float32),
        axes_in: wp.array3d(dtype=wp.float32),
        distance_in: wp.array3d(dtype=wp.float32),
        restitution_in: wp.array3d(dtype=wp.float32),
        softness_in: wp.array3d(dtype=wp.float32),
        v0_in: wp.array3d(dtype=wp.float32),
        v_in: wp.array3d(dtype=wp.float32),
        u_in: wp.array3d(dtype=wp.float32),
        point_in: wp.array3d(dtype=wp.float32),
        end_in: wp.array3d(dtype=wp.float32),
        is_measured: bool,
        x_scale: wp.float32,
        share: wp.float32,
        recovery: wp.float32,
        bounce_speed: wp.float32,
        # Workspace out
        gap_out: wp.array3d(dtype=wp.float32),
    ):
        """Gaps of one contact of a pack."""
        w, contact = wp.tid()
        if contact >= pack_count_in[w, 0, 0]:
            return
        contact_gap(
            w,
            contact,
            row_count,
            listed_in,
            count_in,
            dof_in,
            weight_in,
            lever_in,
            axes_in,
            distance_in,
            restitution_in,
            softness_in,
            v0_in,
            v_in,
            u_in,
            point_in,
            end_in,
            is_measured,
            x_scale,
            share,
            recovery,
            bounce_speed,
            gap_out,
        )

    @wp.kernel(module=module, enable_backward=False)
    def add_force(
        # Model
        dof_free: wp.array2d(dtype=wp.float32),
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        dof_in: wp.array3d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=wp.float32),
        lever_in: wp.array3d(dtype=wp.float32),
        axes_in: wp.array3d(dtype=wp.float32),
        multiplier_in: wp.array3d(dtype=wp.float32),
        f_scale: wp.float32,
        # Workspace out
        target_out: wp.array3d(dtype=wp.float32),
    ):
        """target += f P H' multiplier of all contacts of a pack."""
        w = wp.tid()
        push(w, dof_free, count_in, dof_in, weight_in, lever_in, axes_in, multiplier_in, f_scale, target_out)

    @wp.kernel(module=module, enable_backward=False)
    def write_contacts(
        # Model
        couple_sign: wp.array(dtype=wp.int32),
        # Workspace in
        flag_in: wp.array3d(dtype=wp.int32),
        count_in: wp.array3d(dtype=wp.int32),
        pair_in: wp.array3d(dtype=wp.int32),
        couple_in: wp.array3d(dtype=wp.int32),
        axes_in: wp.array3d(dtype=wp.float32),
        point_in: wp.array3d(dtype=wp.float32),
        gap_in: wp.array3d(dtype=wp.float32),
        multiplier_in: wp.array3d(dtype=wp.float32),
        # State out
        contact_pair_out: wp.array2d(dtype=wp.int32),
        contact_point_out: wp.array2d(dtype=wp.float32),
        contact_normal_out: wp.array2d(dtype=wp.float32),
        contact_load_out: wp.array2d(dtype=wp.float32),
        contact_gap_out: wp.array2d(dtype=wp.float32),
    ):
        """All contacts of a pack as users see them."""
        w = wp.tid()
        for c in range(contact_pair_out.shape[1]):
            write_contact(
                w,
                c,
                couple_sign,
                flag_in,
                count_in,
                pair_in,
                couple_in,
                axes_in,
                point_in,
                gap_in,
                multiplier_in,
                contact_pair_out,
                contact_point_out,
                contact_normal_out,
                contact_load_out,
                contact_gap_out,
            )

    return SimpleNamespace(
        find_path=find_path,
        scatter_rows=scatter_rows,
        known_gap=known_gap,
        add_force=add_force,
        write_contacts=write_contacts,
    )
