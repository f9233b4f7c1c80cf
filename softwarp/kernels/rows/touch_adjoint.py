"""Gradients of contacts in a step by where everything is. Theory: docs/theory/adjoint.md.

Contacts have, with the adjoint p of velocities and z of their forces F, in axes that turn with the normal,

    S = h F.s(p) - h z.s(v) - z_n g*(d),   s(u) = sum c_k (V_k + w_k x r_k),

where c_k are the weights of what takes part, r_k its lever if a frame carries it and g* the target of the distance d.
A contact whose distance d1 was measured where a first solution u leads to has g* - d + d1 - h n.s(u) in the place of
g*: d1 is of a touch of its own, at the end of that way, where late contacts have everything. What Newton's method has
found at the end of a step has everything there too, and g*(d - h n.s(u)) with the velocities u of that step.
Its gradients by normal, distance, places and weights are by hand; those of these by points are Warp's, of
``collision.forms``.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.collision import broad, forms, geometry
from softwarp.kernels.collision.closest import INSIDE, SIDE, VERTEX
from softwarp.model.codes import Carrier, CoupleColumn, Target

# Parts of a contact: two points of its feature, three of a face, the shape; and the rows of each
PARTS, SHAPE = 6, 5
PLACE, TURN, ARM, LEVER, WEIGHT, PART_ROWS = 0, 3, 6, 9, 12, 13  # LEVER: by where a frame carries it
PUSH, BOUNCE, INSET = PARTS * PART_ROWS, PARTS * PART_ROWS + 3, PARTS * PART_ROWS + 6
AHEAD = PARTS * PART_ROWS + 9
ROWS = AHEAD + 1  # of a contact: its parts, z, by the velocity before, by the inset of its feature, by u along n

# What the normal law of a contact looks at: the start of the step alone, a distance where the first solution leads to
# too, everything there, that without the way to it as it bounces; everything where a step ends, with the distance that
# it had before its velocities u took it there
AT_START, MEASURED, LATE, BOUNCED, AT_END = range(5)


@single_worlds
def functions(variant: Variant) -> SimpleNamespace:
    """Parts of a contact, and what S has by its touch."""
    real = variant.real
    types = geometry.structures(real)
    vec3, Scene, Motion = types.vec3, types.Scene, types.Motion
    Touch = forms.structures(real).Touch
    vector_at = single.functions(variant).vector_at
    place = geometry.functions(real)
    point_x, carrier_x, frame_x, target_of = place.point_x, place.carrier_x, place.frame_x, place.target_of
    member = broad.kernels(variant).member

    @wp.struct
    class Topology:
        node_dof: wp.array(dtype=wp.int32)
        node_frame: wp.array(dtype=wp.int32)
        frame_dof: wp.array(dtype=wp.int32)
        frame_master: wp.array(dtype=wp.int32)

    @wp.struct
    class Contact:
        pack: int
        lane: int
        couple: int
        key: int
        mark: int  # three times its face, see ``collision.surface_phase``
        is_edge: int

    @wp.struct
    class Fields:  # of dofs
        p: wp.array3d(dtype=real)
        v: wp.array3d(dtype=real)
        v0: wp.array3d(dtype=real)
        u: wp.array3d(dtype=real)  # of the first solution

    @wp.struct
    class Part:
        is_used: int
        weight: real
        shift: int  # dof of its place, -1 for none
        turn: int  # and of the turn of the frame that carries it
        frame: int
        is_node: int
        x: vec3
        carrier: vec3  # place of the node, or of the frame
        origin: vec3  # of the frame
        arm: vec3  # from the frame to the contact

    @wp.struct
    class Sides:  # where the feature (a) and what it touches (b) do so, and the means of their carriers
        at_a: vec3
        at_b: vec3
        middle_a: vec3
        middle_b: vec3

    @wp.struct
    class Law:
        force: vec3  # of a contact, in world axes
        z: vec3
        way: vec3  # z_n n where a distance counts from where u leads to, else 0
        before: real  # factor of the normal velocity before
        p: vec3  # s(p), and so on
        v: vec3
        v0: vec3
        u: vec3

    @wp.func
    def weight_of(k: int, is_edge: int, t: Touch):
        """Weight of a part: 1 - s, s; minus 1 - u - v, u, v; -1 of a shape."""
        weight = real(-1.0)
        if k == 0:
            weight = real(1.0)
            if is_edge != 0:
                weight = real(1.0) - t.s
        elif k == 1:
            weight = t.s
        elif k == 2:
            weight = t.u + t.v - real(1.0)
        elif k == 3:
            weight = -t.u
        elif k == 4:
            weight = -t.v
        return weight

    @wp.func
    def part_of(scene: Scene, motion: Motion, top: Topology, c: Contact, t: Touch, k: int):
        """A part of a contact; its lever is 0."""
        part = Part()
        pack = c.pack
        lane = c.lane
        part.shift = -1
        part.turn = -1
        part.frame = -1
        if k < wp.static(SHAPE):
            point = member(scene, c.couple, c.key, c.mark, k)
            if point >= 0:
                part.is_used = 1
                part.x = point_x(scene, motion, pack, lane, point)
                part.carrier = carrier_x(scene, motion, pack, lane, point)
                part.frame = scene.point_index[point]
                if scene.point_kind[point] == wp.static(Carrier.NODE):
                    part.is_node = 1
                    node = scene.point_index[point]
                    part.frame = top.node_frame[node]
                    part.shift = top.node_dof[node]
        else:
            target = target_of(scene, motion, pack, lane, c.couple)
            if scene.target_kind[target] <= wp.static(Target.GRID):
                part.frame = scene.target_frame[target]
                if part.frame >= 0:
                    part.is_used = 1
        if part.frame >= 0:
            part.shift = top.frame_dof[2 * part.frame]
            part.turn = top.frame_dof[2 * part.frame + 1]
            part.origin = frame_x(motion, pack, lane, top.frame_master[part.frame])
            if k == wp.static(SHAPE):
                part.carrier = part.origin
        if part.is_used != 0:
            part.weight = weight_of(k, c.is_edge, t)
        return part

    @wp.func
    def middle_of(scene: Scene, motion: Motion, top: Topology, c: Contact, t: Touch, first: int, last: int):
        """Weighted mean of the carriers of a side."""
        middle = vec3()
        for k in range(first, last):
            part = part_of(scene, motion, top, c, t, k)
            middle += wp.abs(part.weight) * part.carrier
        return middle

    @wp.func
    def sides_of(scene: Scene, motion: Motion, top: Topology, c: Contact, t: Touch, way: int):
        """Where both sides touch, in the ways of ``by_places``; see ``collision.broad.slots``."""
        sides = Sides()
        sides.at_b = t.b
        sides.at_a = t.b + t.d * t.n
        if t.d <= real(0.0):
            if way == 0:
                sides.at_b = t.a
            elif way == 2:
                sides.at_b = t.b + real(0.5) * t.d * t.n
            sides.at_a = sides.at_b
        sides.middle_a = middle_of(scene, motion, top, c, t, 0, 2)
        sides.middle_b = middle_of(scene, motion, top, c, t, 2, wp.static(SHAPE))
        return sides

    @wp.func
    def levered(scene: Scene, motion: Motion, top: Topology, c: Contact, t: Touch, sides: Sides, k: int):
        """A part with its lever."""
        part = part_of(scene, motion, top, c, t, k)
        part.arm = wp.where(k < 2, sides.at_a, sides.at_b) - part.origin
        if k < wp.static(SHAPE):
            part.arm += part.carrier - wp.where(k < 2, sides.middle_a, sides.middle_b)
        return part

    @wp.func
    def velocity(u: wp.array3d(dtype=real), c: Contact, part: Part):
        """V + w x r of a part."""
        total = vec3()
        if part.shift >= 0:
            total += vector_at(u, c.pack, c.lane, 3 * part.shift)
        if part.turn >= 0:
            total += wp.cross(vector_at(u, c.pack, c.lane, 3 * part.turn), part.arm)
        return total

    @wp.func
    def by_arm(h: real, law: Law, n: vec3, fields: Fields, c: Contact, part: Part):
        """S by the lever of a part."""
        total = vec3()
        if part.turn >= 0:
            row = 3 * part.turn
            total += h * wp.cross(law.force, vector_at(fields.p, c.pack, c.lane, row))
            total -= h * wp.cross(law.z, vector_at(fields.v, c.pack, c.lane, row))
            total += h * wp.cross(law.way, vector_at(fields.u, c.pack, c.lane, row))
            total -= law.before * wp.cross(n, vector_at(fields.v0, c.pack, c.lane, row))
        return part.weight * total

    @wp.func
    def by_weight(h: real, law: Law, n: vec3, fields: Fields, c: Contact, part: Part):
        """S by the weight of a part."""
        total = h * wp.dot(law.force, velocity(fields.p, c, part))
        total -= h * wp.dot(law.z, velocity(fields.v, c, part))
        total += h * wp.dot(law.way, velocity(fields.u, c, part))
        return total - law.before * wp.dot(n, velocity(fields.v0, c, part))

    @wp.func
    def by_tangent(n: vec3, by_first: vec3, by_second: vec3):
        """What two tangents of a normal, as ``collision.broad`` chooses them, pass on to it."""
        least = int(0)
        for c in range(1, 3):
            if wp.abs(n[c]) < wp.abs(n[least]):
                least = c
        e = vec3()
        e[least] = real(1.0)
        q = e - n[least] * n
        length = wp.length(q)
        t = q / length
        by_n = wp.cross(t, by_second)
        by_t = by_first + wp.cross(by_second, n)
        by_q = (by_t - t * wp.dot(t, by_t)) / length
        return by_n - n[least] * by_q - wp.dot(n, by_q) * e

    @wp.func
    def by_places(d: real, way: int, forced: vec3, on_b: vec3, t: Touch, by: Touch):
        """Add what the places that levers reach to have by the touch: ``forced`` of the feature, ``on_b`` of the other.

        Where both sides touch, ways 0, 1, 2 take a, b and the middle; what is apart has a place for each side.
        """
        found = by
        both = forced + on_b
        if d > real(0.0):
            found.b = found.b + both
            found.n = found.n + d * forced
            found.d = found.d + wp.dot(t.n, forced)
        elif way == 0:
            found.a = found.a + both
        elif way == 1:
            found.b = found.b + both
        else:
            found.b = found.b + both
            found.n = found.n + real(0.5) * d * both
            found.d = found.d + real(0.5) * wp.dot(t.n, both)
        return found

    return SimpleNamespace(
        Topology=Topology,
        Contact=Contact,
        Fields=Fields,
        Part=Part,
        Law=Law,
        sides_of=sides_of,
        levered=levered,
        velocity=velocity,
        by_arm=by_arm,
        by_weight=by_weight,
        by_tangent=by_tangent,
        by_places=by_places,
    )


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds: (pack, row, lane)."""
    real = variant.real
    module = variant.module("adjoint.touch")
    types = geometry.structures(real)
    vec3, Scene, Motion = types.vec3, types.Scene, types.Motion
    one = single.functions(variant)
    vector_at, put = one.vector_at, one.put
    structs, sums = forms.structures(real), forms.functions(real)
    Touch, Meeting = structs.Touch, structs.Meeting
    touch_of, touch_sum = sums.touch_of, sums.touch_sum
    meeting_of = forms.finders(real).meeting_of
    own = functions(variant)
    Topology, Contact, Fields, Part, Law = own.Topology, own.Contact, own.Fields, own.Part, own.Law
    sides_of, levered, velocity, by_arm, by_weight = (
        own.sides_of,
        own.levered,
        own.velocity,
        own.by_arm,
        own.by_weight,
    )
    by_tangent, by_places = own.by_tangent, own.by_places
    of_contact = broad.kernels(variant)
    member, is_held = of_contact.member, of_contact.is_held
    place = geometry.functions(real)
    target_of = place.target_of

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
    def corner_bar(part: int, k: int, g0: vec3, g1: vec3, g2: vec3):
        """What corner k of a triangle has by the points of the form on a part of it."""
        bar = vec3()
        if part == wp.static(INSIDE):
            bar = g0
            if k == 1:
                bar = g1
            elif k == 2:
                bar = g2
        elif part < wp.static(VERTEX):
            if k == part - wp.static(SIDE):
                bar = g0
            elif k == (part - wp.static(SIDE) + 1) % 3:
                bar = g1
        elif k == part - wp.static(VERTEX):
            bar = g0
        return bar

    @wp.func
    def point_bar(k: int, m: Meeting, by: Meeting):
        """What point k of a contact has by a meeting."""
        bar = by.feature.a0
        if k == 1:
            bar = by.feature.a1
        elif k > 1:
            bar = corner_bar(m.form.part, k - 2, by.form.b0, by.form.b1, by.form.b2)
            if m.face >= 0:
                if m.has_foot != 0:
                    bar += corner_bar(m.second.part, k - 2, by.second.b0, by.second.b1, by.second.b2)
                if k == 2:
                    bar += by.c0
                elif k == 3:
                    bar += by.c1
                else:
                    bar += by.c2
        return bar

    @wp.func
    def shape_bar(m: Meeting, by: Meeting, origin: vec3):
        """What the place and the turn of a shape's frame have by the points of forms."""
        place = by.form.b0 + by.form.b1 + by.form.b2 + by.second.b0 + by.second.b1 + by.second.b2
        turn = wp.cross(m.form.b0 - origin, by.form.b0) + wp.cross(m.form.b1 - origin, by.form.b1)
        turn += wp.cross(m.form.b2 - origin, by.form.b2) + wp.cross(m.second.b0 - origin, by.second.b0)
        turn += wp.cross(m.second.b1 - origin, by.second.b1) + wp.cross(m.second.b2 - origin, by.second.b2)
        return place, turn

    @wp.func
    def by_gap(
        h: real,
        share: real,
        recovery: real,
        bounce_speed: real,
        distance: real,
        is_late: bool,
        softness: real,
        bounce: real,
        before: real,
        z: real,
    ):
        """S by the distance, and the factor of the normal velocity before in it."""
        by_d = -z
        factor = real(0.0)
        if distance < real(0.0) and softness == real(0.0) and not is_late:
            by_d = -z * share
            if share * distance < -recovery * h:
                by_d = real(0.0)
        if bounce > real(0.0) and before < -bounce_speed and distance + h * before <= real(0.0):
            by_d = real(0.0)
            factor = z * h * bounce
        return by_d, factor

    @wp.func
    def with_weight(by: Touch, c: Contact, k: int, value: real):
        """Add what the weight of a part passes on to shares."""
        found = by
        if k == 0 and c.is_edge != 0:
            found.s = found.s - value
        elif k == 1:
            found.s = found.s + value
        elif k == 2:
            found.u = found.u + value
            found.v = found.v + value
        elif k == 3:
            found.u = found.u - value
        elif k == 4:
            found.v = found.v - value
        return found

    @wp.func
    def along(axes: wp.array3d(dtype=real), values: wp.array3d(dtype=real), pack: int, lane: int, contact: int):
        """A vector of the world from its components."""
        total = vec3()
        for a in range(3):
            total += values[pack, 3 * contact + a, lane] * vector_at(axes, pack, lane, 9 * contact + 3 * a)
        return total

    @wp.func
    def way_of(scene: Scene, motion: Motion, top: Topology, c: Contact, nodes: int):
        """Where sides that touch do so: 0 at the feature's place, 1 at the other's, 2 between them."""
        way = int(2)
        first = member(scene, c.couple, c.key, c.mark, 0)
        if scene.point_kind[first] == wp.static(Carrier.NODE) and not is_held(scene, top.node_frame, nodes, first):
            way = 0
        elif scene.target_kind[target_of(scene, motion, c.pack, c.lane, c.couple)] == wp.static(Target.SOFT):
            way = 1
        return way

    @wp.func
    def put_part(
        rows_out: wp.array3d(dtype=real), c: Contact, row: int, part: Part, place: vec3, turn: vec3, lever: vec3
    ):
        """Write the rows of a part."""
        put(rows_out, c.pack, c.lane, row + wp.static(PLACE), place)
        put(rows_out, c.pack, c.lane, row + wp.static(TURN), turn)
        put(rows_out, c.pack, c.lane, row + wp.static(ARM), part.weight * part.arm)
        put(rows_out, c.pack, c.lane, row + wp.static(LEVER), lever)
        rows_out[c.pack, row + wp.static(WEIGHT), c.lane] = part.weight

    @wp.kernel(module=module, enable_backward=False)
    def parts(
        h: real,
        share: real,
        recovery: real,
        bounce_speed: real,
        nodes: int,
        at_end: bool,
        normal_rows: int,
        # Model
        scene: Scene,
        top: Topology,
        # Workspace in
        motion: Motion,
        fields: Fields,
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
        z_in: wp.array3d(dtype=real),
        # Workspace out
        rows_out: wp.array3d(dtype=real),
    ):
        """What the parts of one contact have by S; ``gather`` takes it where they are.

        At the end of the first solution's way (``at_end``) a contact that was measured there has its distance alone.
        """
        pack, contact, lane = wp.tid()
        start = wp.static(ROWS) * contact
        for row in range(wp.static(ROWS)):
            rows_out[pack, start + row, lane] = real(0.0)
        look = look_in[pack, contact, lane]
        is_there = (at_end and look > wp.static(AT_START)) or (not at_end and look <= wp.static(MEASURED))
        if contact >= count_in[pack, 0, lane] or mode_in[pack, 4 * contact, lane] == real(0.0) or not is_there:
            return
        has_law = not at_end or look != wp.static(MEASURED)
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
        way = way_of(scene, motion, top, c, nodes)
        sides = sides_of(scene, motion, top, c, t, way)
        law = Law()
        row = 3 * contact
        z = z_in[pack, row, lane]
        way_z = wp.where(look == wp.static(MEASURED) or look == wp.static(LATE), z, real(0.0))
        if has_law:
            law.force = along(axes_in, multiplier_in, pack, lane, contact)
            law.z = along(axes_in, z_in, pack, lane, contact)
            law.way = way_z * t.n
        for k in range(wp.static(PARTS)):
            part = levered(scene, motion, top, c, t, sides, k)
            law.p = law.p + part.weight * velocity(fields.p, c, part)
            law.v = law.v + part.weight * velocity(fields.v, c, part)
            law.v0 = law.v0 + part.weight * velocity(fields.v0, c, part)
            law.u = law.u + part.weight * velocity(fields.u, c, part)
        by = Touch()
        by_d, before = by_gap(
            h,
            share,
            recovery,
            bounce_speed,
            gap_in[pack, contact, lane],
            contact >= listed_in[pack, 0, lane],
            softness_in[pack, contact, lane],
            restitution_in[pack, contact, lane],
            wp.dot(t.n, law.v0),
            z,
        )
        by.d = by_d
        if look == wp.static(AT_END):
            way_z = -by_d
            law.way = way_z * t.n
            rows_out[pack, start + wp.static(AHEAD), lane] = way_z
        if has_law:
            law.before = before
            by_axis = h * (multiplier_in[pack, row, lane] * law.p - z * law.v + way_z * law.u) - before * law.v0
            by_first = h * (multiplier_in[pack, row + 1, lane] * law.p - z_in[pack, row + 1, lane] * law.v)
            by_second = h * (multiplier_in[pack, row + 2, lane] * law.p - z_in[pack, row + 2, lane] * law.v)
            by.n = by_axis + by_tangent(t.n, by_first, by_second)
        if look == wp.static(MEASURED):
            by.d = wp.where(at_end, -z, by_d + z)
        arms_a = vec3()
        arms_b = vec3()
        for k in range(wp.static(PARTS)):
            part = levered(scene, motion, top, c, t, sides, k)
            bar = by_arm(h, law, t.n, fields, c, part)
            if k < 2:
                arms_a += bar
            else:
                arms_b += bar
        by = by_places(t.d, way, arms_a, arms_b, t, by)
        for k in range(wp.static(SHAPE)):
            part = levered(scene, motion, top, c, t, sides, k)
            if part.is_used != 0:
                value = by_weight(h, law, t.n, fields, c, part)
                value += wp.where(k < 2, -wp.dot(part.carrier, arms_a), wp.dot(part.carrier, arms_b))
                by = with_weight(by, c, k, value)
        found, _by = wp.grad(touch_sum)(m, by)
        inset = found.feature.inset
        if wp.dot(m.feature.inset, m.feature.inset) == real(0.0):
            inset = vec3()  # it does not follow its faces where none is taken
        for k in range(wp.static(PARTS)):
            part = levered(scene, motion, top, c, t, sides, k)
            if part.is_used != 0:
                arm = by_arm(h, law, t.n, fields, c, part)
                place = vec3()
                turn = vec3()
                lever = vec3()
                if k == wp.static(SHAPE):
                    place, turn = shape_bar(m, found, part.origin)
                    place -= arm
                else:
                    place = point_bar(k, m, found)
                    carriers = arm - wp.abs(part.weight) * wp.where(k < 2, arms_a, arms_b)
                    if part.is_node != 0:
                        place += carriers
                    if part.frame >= 0:
                        turn = wp.cross(part.x - part.origin, place)
                        lever = place
                        place -= arm
                    if part.is_node == 0:
                        place += carriers
                        if k == 0:
                            turn += wp.cross(m.feature.inset, inset)
                            if m.feature.rim != 0:
                                place += found.feature.a1
                                turn += wp.cross(m.feature.a1 - part.origin, found.feature.a1)
                put_part(rows_out, c, start + wp.static(PART_ROWS) * k, part, place, turn, lever)
        put(rows_out, pack, lane, start + wp.static(PUSH), h * (law.way - law.z))
        put(rows_out, pack, lane, start + wp.static(BOUNCE), -law.before * t.n)
        put(rows_out, pack, lane, start + wp.static(INSET), inset)

    return SimpleNamespace(
        parts=parts,
        Topology=Topology,
        Fields=Fields,
        point_bar=point_bar,
        by_gap=by_gap,
        along=along,
        way_of=way_of,
    )
