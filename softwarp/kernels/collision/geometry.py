"""What can touch what, as arrays that kernels read, and where it is now. Theory: docs/theory/collision.md.

A *point* is a ball around a place that moves with a node or a frame; a capsule between two points is an *edge*. A
*target* is a shape on a frame, or a tree of triangles or segments whose corners are points.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.collision import shapes
from softwarp.model.codes import Carrier, CoupleColumn

# Rows of a touch, the geometry of one contact
NORMAL, POINT_B, POINT_A, DISTANCE, SHARE, BARY, TOUCH_ROWS = 0, 3, 6, 9, 10, 11, 13

TURNED = 0.98  # cosine of the angle from which a normal gets rows of its own
APART = 1.0  # m, gap of what is no contact


@cache
def structures(scalar: Any) -> SimpleNamespace:
    """Structs of one scalar type: ``Scene``, ``Motion``, ``Touch``, ``Others``, ``Sample`` and ``Brackets``."""
    real = scalar
    vec3 = wp.types.vector(3, real)
    vec4 = wp.types.vector(4, real)

    @wp.struct
    class Scene:
        point_kind: wp.array(dtype=wp.int32)  # model.codes.Carrier
        point_index: wp.array(dtype=wp.int32)  # node or frame, -1 the world
        point_quarter: wp.array(dtype=wp.int32)  # of a rim: quarter turns from its nearest point
        point_local: wp.array(dtype=vec3)  # in the frame [m]
        point_inset: wp.array(dtype=vec3)  # from a corner into its body, in the frame; x is the length for nodes [m]
        point_axis: wp.array(dtype=vec3)  # of a rim: axis times radius, in the frame [m]
        point_radius: wp.array(dtype=real)
        point_rest: wp.array(dtype=vec3)  # in the pose of rest, for self-contact [m]
        fan_start: wp.array(dtype=wp.int32)  # (point + 1) triangles around a point
        fan: wp.array(dtype=wp.int32)
        edge_point: wp.array2d(dtype=wp.int32)  # (edge, 2)
        edge_radius: wp.array(dtype=real)
        edge_face: wp.array2d(dtype=wp.int32)  # (edge, 2) triangles left and right of it, -1 for none
        edge_inset: wp.array(dtype=vec3)  # as point_inset
        target_kind: wp.array(dtype=wp.int32)
        target_frame: wp.array(dtype=wp.int32)  # -1 the world
        target_x: wp.array(dtype=vec3)  # pose in the frame
        target_q: wp.array(dtype=vec4)
        target_size: wp.array(dtype=vec3)
        target_depth: wp.array(dtype=real)  # deepest penetration that counts [m]
        target_tree: wp.array2d(dtype=wp.int32)  # (target, 2) first tree node and the one after the last
        tree_skip: wp.array(dtype=wp.int32)  # (tree node,) where the search goes on if this node is left out
        tree_first: wp.array(dtype=wp.int32)  # of a leaf: first entry of tree_face; -1 for inner nodes
        tree_last: wp.array(dtype=wp.int32)
        tree_face: wp.array(dtype=wp.int32)
        tree_box: wp.array2d(dtype=real)  # (tree node, 6) low and high corner in the frame, of rigid meshes
        moving_nodes: int  # tree nodes of soft surfaces and rods, which come first
        target_grid: wp.array2d(dtype=wp.int32)  # (target, 4) first value, samples along x, y, z
        grid_origin: wp.array(dtype=vec3)  # (target,)
        grid_spacing: wp.array(dtype=real)  # (target,)
        grid_value: wp.array(dtype=real)
        face_corner: wp.array2d(dtype=wp.int32)  # (face, 3) points; the third of a segment is -1
        face_beside: wp.array2d(dtype=wp.int32)  # (face, 3) face across the edge from corner k to k + 1, -1 for none
        face_edge: wp.array2d(dtype=wp.int32)  # (face, 3) edge from corner k to k + 1 if the face owns it, else -1
        face_radius: wp.array(dtype=real)
        couple_clear: wp.array(dtype=real)  # self-contact: distance at rest up to which neighbours are left out [m]
        couple: wp.array2d(dtype=wp.int32)

    @wp.struct
    class Motion:
        x: wp.array3d(dtype=real)  # (pack, 3 node + c, lane)
        pose: wp.array3d(dtype=real)  # (pack, 7 frame + c, lane)
        v: wp.array3d(dtype=real)
        twist: wp.array3d(dtype=real)  # (pack, 6 frame + c, lane)
        tree_box: wp.array3d(dtype=real)  # (pack, 6 tree node + c, lane) low and high corner
        choice: wp.array3d(dtype=real)  # (pack, choice, lane) number of the target among those to choose from

    @wp.struct
    class Touch:
        distance: real  # between the surfaces; negative where they overlap [m]
        normal: vec3  # unit, from b to a
        a: vec3  # point, or point on the axis of the edge, of side a [m]
        b: vec3  # point on the target's surface [m]
        share: real  # of an edge: weight of its second point
        u: real  # of a face: weight of its second corner
        v: real  # and of its third
        region: int  # CORNER, EDGE or FACE of the target, perhaps with FLAT
        face: int  # nearest face, -1 for none

    @wp.struct
    class Others:
        first: vec3  # normals of the contacts that a point has already; 0 for none
        second: vec3
        is_inside: int  # whether it is inside the solid

    @wp.struct
    class Sample:
        t: real  # place along an edge, 0 to 1
        f: real  # distance there [m]
        slope: real  # its change per length
        n: vec3
        region: int

    @wp.struct
    class Brackets:
        a: Sample  # the distance along an edge still falls
        b: Sample  # falls no longer
        u: Sample  # does not rise yet
        v: Sample  # rises
        falls: bool
        rises: bool
        lowest: Sample  # least distance from a round part, or from one edge or corner; t is -1 elsewhere

    searches = {"Touch": Touch, "Others": Others, "Sample": Sample, "Brackets": Brackets}
    return SimpleNamespace(Scene=Scene, Motion=Motion, **searches, vec3=vec3, vec4=vec4)


@cache
def functions(scalar: Any) -> SimpleNamespace:
    """Where points and targets are, and how fast they move."""
    real = scalar
    types = structures(real)
    vec3, vec4 = types.vec3, types.vec4
    Scene, Motion = types.Scene, types.Motion
    shape = shapes.functions(real)
    rotate = shape.rotate

    @wp.func
    def frame_x(motion: Motion, pack: int, lane: int, frame: int):
        """Origin of a frame; the world's is 0."""
        x = vec3()
        if frame >= 0:
            x = vec3(
                motion.pose[pack, 7 * frame, lane],
                motion.pose[pack, 7 * frame + 1, lane],
                motion.pose[pack, 7 * frame + 2, lane],
            )
        return x

    @wp.func
    def frame_q(motion: Motion, pack: int, lane: int, frame: int):
        """Orientation of a frame."""
        q = vec4(real(0.0), real(0.0), real(0.0), real(1.0))
        if frame >= 0:
            row = 7 * frame + 3
            q = vec4(
                motion.pose[pack, row, lane],
                motion.pose[pack, row + 1, lane],
                motion.pose[pack, row + 2, lane],
                motion.pose[pack, row + 3, lane],
            )
        return q

    @wp.func
    def turned(motion: Motion, pack: int, lane: int, frame: int, local: vec3):
        """A vector of a frame in world axes."""
        v = local
        if frame >= 0:
            v = rotate(frame_q(motion, pack, lane, frame), local)
        return v

    @wp.func
    def point_x(scene: Scene, motion: Motion, pack: int, lane: int, point: int):
        """Position of a point; of a rim, its centre."""
        index = scene.point_index[point]
        x = vec3()
        if scene.point_kind[point] == wp.static(Carrier.NODE):
            x = vec3(
                motion.x[pack, 3 * index, lane],
                motion.x[pack, 3 * index + 1, lane],
                motion.x[pack, 3 * index + 2, lane],
            )
        else:
            x = frame_x(motion, pack, lane, index) + turned(motion, pack, lane, index, scene.point_local[point])
        return x

    @wp.func
    def node_x(motion: Motion, pack: int, lane: int, node: int):
        """Position of a node."""
        return vec3(
            motion.x[pack, 3 * node, lane], motion.x[pack, 3 * node + 1, lane], motion.x[pack, 3 * node + 2, lane]
        )

    @wp.func
    def carrier_x(scene: Scene, motion: Motion, pack: int, lane: int, point: int):
        """Position of what carries a point: the node, or the origin of the frame."""
        index = scene.point_index[point]
        x = vec3()
        if scene.point_kind[point] == wp.static(Carrier.NODE):
            x = node_x(motion, pack, lane, index)
        else:
            x = frame_x(motion, pack, lane, index)
        return x

    @wp.func
    def frame_v(motion: Motion, pack: int, lane: int, frame: int, x: vec3):
        """Velocity of the material point at x that a frame carries."""
        v = vec3()
        if frame >= 0:
            row = 6 * frame
            w = vec3(
                motion.twist[pack, row + 3, lane], motion.twist[pack, row + 4, lane], motion.twist[pack, row + 5, lane]
            )
            v = vec3(
                motion.twist[pack, row, lane], motion.twist[pack, row + 1, lane], motion.twist[pack, row + 2, lane]
            )
            v += wp.cross(w, x - frame_x(motion, pack, lane, frame))
        return v

    @wp.func
    def point_v(scene: Scene, motion: Motion, pack: int, lane: int, point: int, x: vec3):
        """Velocity of a point at x."""
        index = scene.point_index[point]
        v = vec3()
        if scene.point_kind[point] == wp.static(Carrier.NODE):
            v = vec3(
                motion.v[pack, 3 * index, lane],
                motion.v[pack, 3 * index + 1, lane],
                motion.v[pack, 3 * index + 2, lane],
            )
        else:
            v = frame_v(motion, pack, lane, index, x)
        return v

    @wp.func
    def target_of(scene: Scene, motion: Motion, pack: int, lane: int, couple: int):
        """The target of a couple, which worlds may choose."""
        target = scene.couple[couple, wp.static(CoupleColumn.TARGET)]
        row = scene.couple[couple, wp.static(CoupleColumn.CHOICE)]
        if row >= 0:
            last = scene.couple[couple, wp.static(CoupleColumn.CHOICES)] - 1
            target += wp.clamp(int(motion.choice[pack, row, lane]), 0, last)
        return target

    @wp.func
    def target_x(scene: Scene, motion: Motion, pack: int, lane: int, target: int):
        """Origin of a shape."""
        frame = scene.target_frame[target]
        return frame_x(motion, pack, lane, frame) + turned(motion, pack, lane, frame, scene.target_x[target])

    @wp.func
    def target_q(scene: Scene, motion: Motion, pack: int, lane: int, target: int):
        """Orientation of a shape."""
        p = frame_q(motion, pack, lane, scene.target_frame[target])
        q = scene.target_q[target]
        pv = vec3(p[0], p[1], p[2])
        qv = vec3(q[0], q[1], q[2])
        u = p[3] * qv + q[3] * pv + wp.cross(pv, qv)
        return vec4(u[0], u[1], u[2], p[3] * q[3] - wp.dot(pv, qv))

    return SimpleNamespace(
        frame_x=frame_x,
        frame_q=frame_q,
        turned=turned,
        point_x=point_x,
        carrier_x=carrier_x,
        node_x=node_x,
        frame_v=frame_v,
        point_v=point_v,
        target_of=target_of,
        target_x=target_x,
        target_q=target_q,
    )
