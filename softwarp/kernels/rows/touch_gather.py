"""Where the parts of contacts are takes up what they have by S. Theory: docs/theory/adjoint.md.

``touch_adjoint.parts`` finds it contact by contact; here one thread of a world adds it in their order, so that sums are
the same bits every time.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.collision import broad, features, geometry
from softwarp.kernels.rows import touch_adjoint
from softwarp.kernels.rows.touch_adjoint import (
    ARM,
    BOUNCE,
    INSET,
    LEVER,
    PART_ROWS,
    PARTS,
    PLACE,
    PUSH,
    ROWS,
    SHAPE,
    TURN,
    WEIGHT,
)
from softwarp.model.codes import SHORTEST, Carrier, CoupleColumn, Target


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds: (pack, row, lane)."""
    real = variant.real
    module = variant.module("adjoint.touch_gather")
    types = geometry.structures(real)
    vec3, Scene, Motion = types.vec3, types.Scene, types.Motion
    one = single.functions(variant)
    vector_at, quat_at, quat = one.vector_at, one.quat_at, one.quat
    own = touch_adjoint.functions(variant)
    Topology = own.Topology
    member = broad.kernels(variant).member
    place = geometry.functions(real)
    point_x, target_of = place.point_x, place.target_of
    face_normal = features.functions(real).face_normal

    @wp.func
    def add_world(array: wp.array2d(dtype=real), world: int, row: int, v: vec3):
        """Add a vector to three rows of a state array."""
        for c in range(3):
            array[world, row + c] = array[world, row + c] + v[c]

    @wp.func
    def add_turn(
        motion: Motion, pack: int, lane: int, world: int, frame: int, turn: vec3, pose_bar: wp.array2d(dtype=real)
    ):
        """Add a gradient by the turn of a frame to that by its quaternion."""
        q = quat_at(motion.pose, pack, lane, 7 * frame + 3)
        by_q = quat(turn[0], turn[1], turn[2], real(0.0)) * q * real(2.0)
        for c in range(4):
            pose_bar[world, 7 * frame + 3 + c] = pose_bar[world, 7 * frame + 3 + c] + by_q[c]

    @wp.func
    def add_lever(
        motion: Motion,
        pack: int,
        lane: int,
        world: int,
        node: int,
        frame: int,
        bar: vec3,
        rest_pose: wp.array2d(dtype=real),
        rest_bar: wp.array2d(dtype=real),
    ):
        """Add to the gradient by the rest position of a node what it has by where a frame carries it."""
        if node < rest_bar.shape[1] / 3:
            q = quat(rest_pose[frame, 3], rest_pose[frame, 4], rest_pose[frame, 5], rest_pose[frame, 6])
            now = quat_at(motion.pose, pack, lane, 7 * frame + 3)
            add_world(rest_bar, world, 3 * node, wp.quat_rotate(q, wp.quat_rotate_inv(now, bar)))

    @wp.func
    def add_face(
        scene: Scene,
        motion: Motion,
        top: Topology,
        pack: int,
        lane: int,
        world: int,
        face: int,
        by_n: vec3,
        rest_pose: wp.array2d(dtype=real),
        x_bar: wp.array2d(dtype=real),
        pose_bar: wp.array2d(dtype=real),
        rest_bar: wp.array2d(dtype=real),
    ):
        """Add what the corners of a soft triangle have by its normal."""
        a = point_x(scene, motion, pack, lane, scene.face_corner[face, 0])
        b = point_x(scene, motion, pack, lane, scene.face_corner[face, 1])
        c = point_x(scene, motion, pack, lane, scene.face_corner[face, 2])
        m = wp.cross(b - a, c - a)
        n = wp.normalize(m)
        by_m = (by_n - n * wp.dot(n, by_n)) / wp.max(wp.length(m), real(wp.static(SHORTEST * SHORTEST)))
        bar_b = wp.cross(c - a, by_m)
        bar_c = wp.cross(by_m, b - a)
        bar_a = -bar_b - bar_c
        for k in range(3):
            bar = bar_a
            x = a
            if k == 1:
                bar = bar_b
                x = b
            elif k == 2:
                bar = bar_c
                x = c
            node = scene.point_index[scene.face_corner[face, k]]
            frame = top.node_frame[node]
            if frame < 0:
                add_world(x_bar, world, 3 * node, bar)
            else:
                origin = vector_at(motion.pose, pack, lane, 7 * frame)
                add_world(pose_bar, world, 7 * frame, bar)
                add_turn(motion, pack, lane, world, frame, wp.cross(x - origin, bar), pose_bar)
                add_lever(motion, pack, lane, world, node, frame, bar, rest_pose, rest_bar)

    @wp.func
    def face_of(scene: Scene, edge: int, k: int):
        """Face k of a fan or, with an edge, beside it."""
        face = int(-1)
        if edge < 0:
            face = scene.fan[k]
        else:
            face = scene.edge_face[edge, k]
        return face

    @wp.func
    def feature_of(scene: Scene, couple: int, key: int):
        """Number of the feature of a key."""
        offset = key - scene.couple[couple, wp.static(CoupleColumn.KEY)]
        width = scene.couple[couple, wp.static(CoupleColumn.WIDTH)]
        return scene.couple[couple, wp.static(CoupleColumn.FIRST)] + offset / width

    @wp.func
    def owner_of(
        scene: Scene, motion: Motion, top: Topology, pack: int, lane: int, couple: int, key: int, mark: int, k: int
    ):
        """Node, or master of the frame that carries a part, of a contact; -1 for none."""
        node = int(-1)
        frame = int(-1)
        if k == wp.static(SHAPE):
            target = target_of(scene, motion, pack, lane, couple)
            if scene.target_kind[target] <= wp.static(Target.GRID):
                frame = scene.target_frame[target]
        else:
            point = member(scene, couple, key, mark, k)
            if point >= 0:
                frame = scene.point_index[point]
                if scene.point_kind[point] == wp.static(Carrier.NODE):
                    node = frame
                    frame = top.node_frame[node]
                    if frame >= 0:
                        node = -1
        if frame >= 0:
            frame = top.frame_master[frame]
        return node, frame

    @wp.func
    def carried_of(scene: Scene, couple: int, key: int, mark: int, k: int):
        """Node of a part of a contact; -1 for a shape, or a part that is none."""
        node = int(-1)
        if k < wp.static(SHAPE):
            point = member(scene, couple, key, mark, k)
            if point >= 0:
                if scene.point_kind[point] == wp.static(Carrier.NODE):
                    node = scene.point_index[point]
        return node

    @wp.func
    def add_inset(
        scene: Scene,
        motion: Motion,
        top: Topology,
        pack: int,
        lane: int,
        world: int,
        point: int,
        edge: int,
        by_inset: vec3,
        rest_pose: wp.array2d(dtype=real),
        x_bar: wp.array2d(dtype=real),
        pose_bar: wp.array2d(dtype=real),
        rest_bar: wp.array2d(dtype=real),
    ):
        """Add what the faces around a soft point or beside an edge (-1 for none) have by its inset."""
        first = scene.fan_start[point]
        last = scene.fan_start[point + 1]
        length = scene.point_inset[point][0]
        if edge >= 0:
            first = 0
            last = 2
            length = scene.edge_inset[edge][0]
        mean = vec3()
        for k in range(first, last):
            face = face_of(scene, edge, k)
            if face >= 0:
                mean += face_normal(scene, motion, pack, lane, face)
        size = wp.length(mean)
        if size > real(0.0):
            n = mean / size
            by_n = (n * wp.dot(n, by_inset) - by_inset) * (length / size)
            for k in range(first, last):
                face = face_of(scene, edge, k)
                if face >= 0:
                    add_face(scene, motion, top, pack, lane, world, face, by_n, rest_pose, x_bar, pose_bar, rest_bar)

    @wp.kernel(module=module, enable_backward=False)
    def gather(
        lanes: int,
        moves: bool,
        at_end: bool,
        # Model
        scene: Scene,
        top: Topology,
        frame_is_kinematic: wp.array(dtype=wp.int32),
        rest_pose: wp.array2d(dtype=real),
        # Workspace in
        motion: Motion,
        count_in: wp.array3d(dtype=wp.int32),
        pair_in: wp.array3d(dtype=wp.int32),
        key_in: wp.array3d(dtype=wp.int32),
        couple_in: wp.array3d(dtype=wp.int32),
        face_in: wp.array3d(dtype=wp.int32),
        multiplier_in: wp.array3d(dtype=real),
        mode_in: wp.array3d(dtype=real),
        way_in: wp.array3d(dtype=real),
        rows_in: wp.array3d(dtype=real),
        # State out
        x_bar_out: wp.array2d(dtype=real),
        v_bar_out: wp.array2d(dtype=real),
        mu_bar_out: wp.array2d(dtype=real),
        pose_bar_out: wp.array2d(dtype=real),
        twist_bar_out: wp.array2d(dtype=real),
        velocity_bar_out: wp.array2d(dtype=real),
        rest_bar_out: wp.array2d(dtype=real),
    ):
        """Add what the contacts of one world have by S to gradients by nodes, frames and friction, in their order.

        By rest positions of nodes that frames carry, too, if there is room for these.

        What they have where the first solution leads to (``at_end``) has none by friction, of which ``way`` has h H p
        and what is added to it.
        """
        pack, lane = wp.tid()
        world = pack * lanes + lane
        if world >= mu_bar_out.shape[0]:
            return
        for contact in range(count_in[pack, 0, lane]):
            if mode_in[pack, 4 * contact, lane] > real(0.0):
                start = wp.static(ROWS) * contact
                couple = couple_in[pack, contact, lane]
                key = key_in[pack, contact, lane]
                push = vector_at(rows_in, pack, lane, start + wp.static(PUSH))
                bounce = vector_at(rows_in, pack, lane, start + wp.static(BOUNCE))
                for k in range(wp.static(PARTS)):
                    row = start + wp.static(PART_ROWS) * k
                    node, frame = owner_of(scene, motion, top, pack, lane, couple, key, face_in[pack, contact, lane], k)
                    place = vector_at(rows_in, pack, lane, row + wp.static(PLACE))
                    weight = rows_in[pack, row + wp.static(WEIGHT), lane]
                    if node >= 0:
                        add_world(x_bar_out, world, 3 * node, place)
                        if top.node_dof[node] >= 0:
                            add_world(v_bar_out, world, 3 * node, weight * bounce)
                    elif frame >= 0 and moves:
                        arm = vector_at(rows_in, pack, lane, row + wp.static(ARM))
                        turn = vector_at(rows_in, pack, lane, row + wp.static(TURN))
                        add_world(pose_bar_out, world, 7 * frame, place)
                        add_turn(motion, pack, lane, world, frame, turn, pose_bar_out)
                        carried = carried_of(scene, couple, key, face_in[pack, contact, lane], k)
                        if carried >= 0:
                            lever = vector_at(rows_in, pack, lane, row + wp.static(LEVER))
                            add_lever(motion, pack, lane, world, carried, frame, lever, rest_pose, rest_bar_out)
                        add_world(twist_bar_out, world, 6 * frame, weight * bounce)
                        add_world(twist_bar_out, world, 6 * frame + 3, wp.cross(arm, bounce))
                        if frame_is_kinematic[frame] != 0:
                            add_world(velocity_bar_out, world, 6 * frame, weight * push)
                            add_world(velocity_bar_out, world, 6 * frame + 3, wp.cross(arm, push))
                inset = vector_at(rows_in, pack, lane, start + wp.static(INSET))
                point = member(scene, couple, key, face_in[pack, contact, lane], 0)
                if wp.dot(inset, inset) > real(0.0) and scene.point_kind[point] == wp.static(Carrier.NODE):
                    edge = int(-1)
                    if scene.couple[couple, wp.static(CoupleColumn.EDGES)] != 0:
                        edge = feature_of(scene, couple, key)
                    add_inset(
                        scene,
                        motion,
                        top,
                        pack,
                        lane,
                        world,
                        point,
                        edge,
                        inset,
                        rest_pose,
                        x_bar_out,
                        pose_bar_out,
                        rest_bar_out,
                    )
                if mode_in[pack, 4 * contact, lane] == real(2.0) and not at_end:
                    slip = mode_in[pack, 4 * contact + 2, lane] * way_in[pack, 3 * contact + 1, lane]
                    slip += mode_in[pack, 4 * contact + 3, lane] * way_in[pack, 3 * contact + 2, lane]
                    pair = pair_in[pack, contact, lane]
                    by_mu = multiplier_in[pack, 3 * contact, lane] * slip
                    mu_bar_out[world, pair] = mu_bar_out[world, pair] + by_mu

    return SimpleNamespace(gather=gather, face_of=face_of, feature_of=feature_of)
