"""Directional derivatives of contacts with shapes and soft bodies in a step. Theory: docs/theory/adjoint.md.

Slopes of nodes change the touch of a contact: its normal n by dn, its distance, its places and its weights. Its axes
turn with n, by n x dn. With slopes of what a step reads, -z of forces and g = h H dv, contacts in the states of
``contact_adjoint`` obey

    open    z = 0
    stick   g_n = C z_n + S_n,   g_t = S_t
    slip    g_n = C z_n + S_n,   z_t = mu r z_n + k (1 - r r') (g_t - S_t) - dmu l_n r,

where S = -dg* - h d[axes' s(v)] at the same v, and dofs are pushed by h d[H'] l. What a touch changes by is what
``touch_adjoint`` has by it: one gradient for each of its parts.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.collision import broad, features, forms, geometry
from softwarp.kernels.rows import touch_adjoint, touch_gather
from softwarp.kernels.rows.touch_adjoint import AT_START, LATE, MEASURED, PARTS, SHAPE
from softwarp.model.codes import SHORTEST, Carrier, CoupleColumn

OUTPUTS = 13  # parts of a touch: normal, distance, both places, and three weights
FORCES = 3 * SHAPE  # rows of a contact: what pushes its points


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds: (pack, row, lane)."""
    real = variant.real
    module = variant.module("directional.touch")
    types = geometry.structures(real)
    vec3, Scene, Motion = types.vec3, types.Scene, types.Motion
    one = single.functions(variant)
    vector_at, put = one.vector_at, one.put
    structs, sums = forms.structures(real), forms.functions(real)
    Touch, Meeting = structs.Touch, structs.Meeting
    touch_of, touch_sum = sums.touch_of, sums.touch_sum
    meeting_of = forms.finders(real).meeting_of
    own, of_touch = touch_adjoint.functions(variant), touch_adjoint.kernels(variant)
    Topology, Contact, Fields, Part = own.Topology, own.Contact, own.Fields, own.Part
    sides_of, levered, velocity = own.sides_of, own.levered, own.velocity
    point_bar, by_gap, along, way_of = of_touch.point_bar, of_touch.by_gap, of_touch.along, of_touch.way_of
    gathered = touch_gather.kernels(variant)
    face_of, feature_of = gathered.face_of, gathered.feature_of
    member = broad.kernels(variant).member
    point_x = geometry.functions(real).point_x
    face_normal = features.functions(real).face_normal

    @wp.struct
    class Slopes:
        x: wp.array3d(dtype=real)  # of nodes
        v: wp.array3d(dtype=real)
        u: wp.array3d(dtype=real)  # of dofs in a first solution

    @wp.kernel(module=module, enable_backward=True)
    def reach(
        # Samples in
        meeting_in: wp.array(dtype=Meeting),
        touch_in: wp.array(dtype=Touch),
        # Samples out
        value_out: wp.array(dtype=real),
    ):
        """Makes Warp differentiate this sum; nobody launches it, as of ``elements.adjoint``."""
        sample = wp.tid()
        value_out[sample] = touch_sum(meeting_in[sample], touch_in[sample])

    @wp.func
    def unit(part: int):
        """One part of a touch: 0 to 2 of the normal, 3 the distance, then both places and the weights."""
        axis = vec3()
        axis[wp.where(part > 3, part - 1, part) % 3] = real(1.0)
        by = Touch()
        if part < 3:
            by.n = axis
        elif part == 3:
            by.d = real(1.0)
        elif part < 7:
            by.a = axis
        elif part < 10:
            by.b = axis
        elif part == 10:
            by.s = real(1.0)
        elif part == 11:
            by.u = real(1.0)
        else:
            by.v = real(1.0)
        return by

    @wp.func
    def scaled(by: Touch, factor: real, total: Touch):
        """total + factor by."""
        found = total
        found.n = found.n + factor * by.n
        found.d = found.d + factor * by.d
        found.a = found.a + factor * by.a
        found.b = found.b + factor * by.b
        found.s = found.s + factor * by.s
        found.u = found.u + factor * by.u
        found.v = found.v + factor * by.v
        return found

    @wp.func
    def point_slope(scene: Scene, top: Topology, x: wp.array3d(dtype=real), pack: int, lane: int, point: int):
        """Slope of a point; 0 of one that a frame carries."""
        found = vec3()
        if point >= 0:
            if scene.point_kind[point] == wp.static(Carrier.NODE):
                if top.node_frame[scene.point_index[point]] < 0:
                    found = vector_at(x, pack, lane, 3 * scene.point_index[point])
        return found

    @wp.func
    def face_slope(
        scene: Scene, motion: Motion, top: Topology, x: wp.array3d(dtype=real), pack: int, lane: int, face: int
    ):
        """Slope of the normal of a soft triangle."""
        i = scene.face_corner[face, 0]
        j = scene.face_corner[face, 1]
        k = scene.face_corner[face, 2]
        a = point_x(scene, motion, pack, lane, i)
        e = point_x(scene, motion, pack, lane, j) - a
        f = point_x(scene, motion, pack, lane, k) - a
        da = point_slope(scene, top, x, pack, lane, i)
        de = point_slope(scene, top, x, pack, lane, j) - da
        df = point_slope(scene, top, x, pack, lane, k) - da
        m = wp.cross(e, f)
        n = wp.normalize(m)
        by_m = (wp.cross(de, f) + wp.cross(e, df)) / wp.max(wp.length(m), real(wp.static(SHORTEST * SHORTEST)))
        return by_m - n * wp.dot(n, by_m)

    @wp.func
    def inset_slope(scene: Scene, motion: Motion, top: Topology, x: wp.array3d(dtype=real), c: Contact, point: int):
        """Slope of the inset of a soft point or edge, which follows the faces around it."""
        first = scene.fan_start[point]
        last = scene.fan_start[point + 1]
        length = scene.point_inset[point][0]
        edge = int(-1)
        if c.is_edge != 0:
            edge = feature_of(scene, c.couple, c.key)
            first = 0
            last = 2
            length = scene.edge_inset[edge][0]
        mean = vec3()
        change = vec3()
        for k in range(first, last):
            face = face_of(scene, edge, k)
            if face >= 0:
                mean += face_normal(scene, motion, c.pack, c.lane, face)
                change += face_slope(scene, motion, top, x, c.pack, c.lane, face)
        size = wp.length(mean)
        found = vec3()
        if size > real(0.0):
            n = mean / size
            found = (n * wp.dot(n, change) - change) * (length / size)
        return found

    @wp.func
    def touch_slope(
        scene: Scene, motion: Motion, top: Topology, x: wp.array3d(dtype=real), c: Contact, m: Meeting, outputs: int
    ):
        """What the slopes of points make of a touch."""
        inset = vec3()
        point = member(scene, c.couple, c.key, c.mark, 0)
        if scene.point_kind[point] == wp.static(Carrier.NODE):
            if wp.dot(m.feature.inset, m.feature.inset) > real(0.0):
                inset = inset_slope(scene, motion, top, x, c, point)
        total = Touch()
        for part in range(outputs):
            found, _by = wp.grad(touch_sum)(m, unit(part))
            value = wp.dot(found.feature.inset, inset)
            for k in range(wp.static(SHAPE)):
                which = member(scene, c.couple, c.key, c.mark, k)
                if which >= 0:
                    bar = point_bar(k, m, found)
                    value += wp.dot(bar, point_slope(scene, top, x, c.pack, c.lane, which))
            total = scaled(unit(part), value, total)
        return total

    @wp.func
    def weight_slope(k: int, is_edge: int, by: Touch):
        """What the weight of a part changes by."""
        value = real(0.0)
        if k == 0 and is_edge != 0:
            value = -by.s
        elif k == 1:
            value = by.s
        elif k == 2:
            value = by.u + by.v
        elif k == 3:
            value = -by.u
        elif k == 4:
            value = -by.v
        return value

    @wp.func
    def arm_slope(t: Touch, by: Touch, way: int):
        """What the place on the other side changes by; see ``touch_adjoint.sides_of``."""
        found = by.b
        if t.d <= real(0.0):
            if way == 0:
                found = by.a
            elif way == 2:
                found = by.b + real(0.5) * (by.d * t.n + t.d * by.n)
        return found

    @wp.func
    def rate(u: wp.array3d(dtype=real), c: Contact, part: Part, weight: real, arm: vec3):
        """What the share of a part in s(u) changes by."""
        total = weight * velocity(u, c, part)
        if part.turn >= 0:
            total += part.weight * wp.cross(vector_at(u, c.pack, c.lane, 3 * part.turn), arm)
        return total

    @wp.func
    def add_change(out: wp.array3d(dtype=real), c: Contact, contact: int, axis: int, value: real):
        """Add to one row of a contact."""
        out[c.pack, 3 * contact + axis, c.lane] = out[c.pack, 3 * contact + axis, c.lane] + value

    @wp.kernel(module=module, enable_backward=False)
    def changes(
        h: real,
        share: real,
        recovery: real,
        bounce_speed: real,
        nodes: int,
        at_end: bool,
        normal_rows: int,
        outputs: int,
        # Model
        scene: Scene,
        top: Topology,
        # Workspace in
        motion: Motion,
        fields: Fields,
        slopes: Slopes,
        look_in: wp.array3d(dtype=wp.int32),
        normal_in: wp.array3d(dtype=real),
        count_in: wp.array3d(dtype=wp.int32),
        listed_in: wp.array3d(dtype=wp.int32),
        key_in: wp.array3d(dtype=wp.int32),
        couple_in: wp.array3d(dtype=wp.int32),
        face_in: wp.array3d(dtype=wp.int32),
        axes_in: wp.array3d(dtype=real),
        gap_in: wp.array3d(dtype=real),
        restitution_in: wp.array3d(dtype=real),
        softness_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        mode_in: wp.array3d(dtype=real),
        # Workspace out
        change_out: wp.array3d(dtype=real),
        force_out: wp.array3d(dtype=real),
    ):
        """S of one contact, and h d[H'] l of its points; ``at_end`` adds what looks at where a first solution leads.

        There, a contact that was measured has its distance alone.
        """
        pack, contact, lane = wp.tid()
        if not at_end:
            put(change_out, pack, lane, 3 * contact, vec3())
            for k in range(wp.static(SHAPE)):
                put(force_out, pack, lane, wp.static(FORCES) * contact + 3 * k, vec3())
        look = look_in[pack, contact, lane]
        is_there = (at_end and look > wp.static(AT_START)) or (not at_end and look <= wp.static(MEASURED))
        if contact >= count_in[pack, 0, lane] or mode_in[pack, 4 * contact, lane] == real(0.0) or not is_there:
            return
        c = Contact()
        c.pack = pack
        c.lane = lane
        c.couple = couple_in[pack, contact, lane]
        c.key = key_in[pack, contact, lane]
        c.mark = face_in[pack, contact, lane]
        c.is_edge = scene.couple[c.couple, wp.static(CoupleColumn.EDGES)]
        normal = vector_at(normal_in, pack, lane, normal_rows * contact)
        m = meeting_of(scene, motion, pack, lane, c.couple, c.key, c.mark, normal)
        t = touch_of(m)
        by = touch_slope(scene, motion, top, slopes.x, c, m, outputs)
        if at_end and look == wp.static(MEASURED):
            add_change(change_out, c, contact, 0, -by.d)
            return
        way = way_of(scene, motion, top, c, nodes)
        sides = sides_of(scene, motion, top, c, t, way)
        arm = arm_slope(t, by, way)
        spin = wp.cross(t.n, by.n)
        force = along(axes_in, multiplier_in, pack, lane, contact)
        turned = wp.cross(spin, force)
        v = vec3()
        v0 = vec3()
        u = vec3()
        dv = vec3()
        dv0 = vec3()
        du = vec3()
        for k in range(wp.static(PARTS)):
            part = levered(scene, motion, top, c, t, sides, k)
            if part.is_used != 0:
                weight = weight_slope(k, c.is_edge, by)
                v += part.weight * velocity(fields.v, c, part)
                v0 += part.weight * velocity(fields.v0, c, part)
                u += part.weight * velocity(fields.u, c, part)
                dv += rate(fields.v, c, part, weight, arm)
                dv0 += rate(fields.v0, c, part, weight, arm)
                du += rate(fields.u, c, part, weight, arm)
                if k < wp.static(SHAPE) and part.is_node != 0 and part.frame < 0:
                    if part.shift >= 0:
                        node = scene.point_index[member(scene, c.couple, c.key, c.mark, k)]
                        dv0 += part.weight * vector_at(slopes.v, pack, lane, 3 * node)
                        du += part.weight * vector_at(slopes.u, pack, lane, 3 * part.shift)
                    row = wp.static(FORCES) * contact + 3 * k
                    put(force_out, pack, lane, row, h * (weight * force + part.weight * turned))
        by_d, before = by_gap(
            h,
            share,
            recovery,
            bounce_speed,
            gap_in[pack, contact, lane],
            contact >= listed_in[pack, 0, lane],
            softness_in[pack, contact, lane],
            restitution_in[pack, contact, lane],
            wp.dot(t.n, v0),
            real(1.0),
        )
        if look == wp.static(MEASURED):
            by_d += real(1.0)
        total = by_d * by.d - before * (wp.dot(by.n, v0) + wp.dot(t.n, dv0))
        if look == wp.static(MEASURED) or look == wp.static(LATE):
            total += h * (wp.dot(by.n, u) + wp.dot(t.n, du))
        add_change(change_out, c, contact, 0, total)
        moved = dv - wp.cross(spin, v)
        for a in range(3):
            axis = vector_at(axes_in, pack, lane, 9 * contact + 3 * a)
            add_change(change_out, c, contact, a, -h * wp.dot(axis, moved))

    @wp.kernel(module=module, enable_backward=False)
    def frictions(
        lanes: int,
        # State
        mu_slope_in: wp.array2d(dtype=real),
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        pair_in: wp.array3d(dtype=wp.int32),
        multiplier_in: wp.array3d(dtype=real),
        mode_in: wp.array3d(dtype=real),
        # Workspace out
        offset_out: wp.array3d(dtype=real),
    ):
        """dmu l_n r of one contact that slips; else 0."""
        pack, contact, lane = wp.tid()
        offset = vec3()
        if contact < count_in[pack, 0, lane] and mode_in[pack, 4 * contact, lane] == real(2.0):
            world = wp.min(pack * lanes + lane, mu_slope_in.shape[0] - 1)
            friction = mu_slope_in[world, pair_in[pack, contact, lane]] * multiplier_in[pack, 3 * contact, lane]
            offset[1] = friction * mode_in[pack, 4 * contact + 2, lane]
            offset[2] = friction * mode_in[pack, 4 * contact + 3, lane]
        put(offset_out, pack, lane, 3 * contact, offset)

    @wp.kernel(module=module, enable_backward=False)
    def take_changes(
        rows: int,
        # Workspace in
        change_in: wp.array3d(dtype=real),
        # Workspace out
        gap_out: wp.array3d(dtype=real),
    ):
        """g - S of one row of contacts."""
        pack, row, lane = wp.tid()
        gap_out[pack, rows + row, lane] = gap_out[pack, rows + row, lane] - change_in[pack, row, lane]

    @wp.kernel(module=module, enable_backward=False)
    def push_dofs(
        # Model
        scene: Scene,
        top: Topology,
        dof_free: wp.array2d(dtype=real),
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        key_in: wp.array3d(dtype=wp.int32),
        couple_in: wp.array3d(dtype=wp.int32),
        face_in: wp.array3d(dtype=wp.int32),
        mode_in: wp.array3d(dtype=real),
        force_in: wp.array3d(dtype=real),
        # Workspace out
        side_out: wp.array3d(dtype=real),
    ):
        """Add what pushes the points of one world's contacts to the right-hand side of their dofs, in their order."""
        pack, lane = wp.tid()
        for contact in range(count_in[pack, 0, lane]):
            if mode_in[pack, 4 * contact, lane] > real(0.0):
                couple = couple_in[pack, contact, lane]
                key = key_in[pack, contact, lane]
                mark = face_in[pack, contact, lane]
                for k in range(wp.static(SHAPE)):
                    point = member(scene, couple, key, mark, k)
                    if point >= 0:
                        dof = int(-1)
                        if scene.point_kind[point] == wp.static(Carrier.NODE):
                            dof = top.node_dof[scene.point_index[point]]
                        if dof >= 0:
                            force = vector_at(force_in, pack, lane, wp.static(FORCES) * contact + 3 * k)
                            for i in range(3):
                                value = side_out[pack, 3 * dof + i, lane] + dof_free[dof, i] * force[i]
                                side_out[pack, 3 * dof + i, lane] = value

    @wp.kernel(module=module, enable_backward=False)
    def lead(
        h: real,
        # Model
        node_dof: wp.array(dtype=wp.int32),
        # Workspace in
        x_slope_in: wp.array3d(dtype=real),
        u_slope_in: wp.array3d(dtype=real),
        # Workspace out
        end_slope_out: wp.array3d(dtype=real),
    ):
        """Slope of one node's place where a first solution leads to."""
        pack, node, lane = wp.tid()
        dof = node_dof[node]
        for i in range(3):
            value = x_slope_in[pack, 3 * node + i, lane]
            if dof >= 0:
                value += h * u_slope_in[pack, 3 * dof + i, lane]
            end_slope_out[pack, 3 * node + i, lane] = value

    return SimpleNamespace(
        Slopes=Slopes,
        changes=changes,
        frictions=frictions,
        take_changes=take_changes,
        push_dofs=push_dofs,
        lead=lead,
    )
