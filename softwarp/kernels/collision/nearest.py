"""Nearest faces of points and nearest sides of edges in trees of triangles and rods. Theory: docs/theory/collision.md.

Positions are in the coordinates of the target: those of the frame for a rigid mesh, else those of the world.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.collision import bvh, closest, faces, features, geometry, shapes
from softwarp.kernels.collision.faces import CONE, SHARP
from softwarp.model.codes import BALL_RANKS, FACE, FAR

COINCIDENT = 1.0e-4  # relative difference of distances up to which two faces count as the sides of one sheet
SAME = 0.9  # cosine above which two contacts of one point count as the same
KEPT = 16  # places near a ball among which its contacts are chosen
BEHIND = 0.25  # part of the distance at rest by which a surface may penetrate itself


@cache
def searches(scalar: Any) -> SimpleNamespace:
    """Searches for the nearest face of a point and the nearest side of an edge."""
    real = scalar
    types = geometry.structures(real)
    vec3, vec4 = types.vec3, types.vec4
    Scene, Motion, Touch, Others = types.Scene, types.Motion, types.Touch, types.Others
    place = geometry.functions(real)
    point_x = place.point_x
    single = faces.functions(real)
    touch_face, touch_side, rest_gap = single.touch_face, single.touch_side, single.rest_gap
    face_gap, is_in_cone, is_lowest = single.face_gap, single.is_in_cone, single.is_lowest
    face_normal = features.functions(real).face_normal
    box_gap = bvh.functions(real).box_gap
    shape = shapes.functions(real)
    rotate, to_local, to_world = shape.rotate, shape.to_local, shape.to_world
    segment_segment = closest.functions(real).segment_segment
    corner_x = single.corner_x
    faces_t, gaps_t = wp.types.vector(KEPT, wp.int32), wp.types.vector(KEPT, real)
    taken_t = wp.types.vector(BALL_RANKS - 1, wp.int32)

    @wp.func
    def is_other(touch: Touch, others: Others, rank: int, limit: real):
        """Whether a nearest point is a contact besides those found: inside a face, in another direction.

        Behind a face it counts only for what is inside the solid, as far as ``limit``, and not on the far side of a
        wall: what is outside is behind many faces, none of which it has passed.
        """
        n = touch.normal
        good = bool(True)
        if rank > 0:
            good = touch.region == wp.static(FACE)
            good = good and wp.dot(n, others.first) < real(SAME) and wp.dot(n, others.second) < real(SAME)
            if touch.distance < real(0.0):
                good = good and others.is_inside != 0 and -touch.distance <= limit
                good = good and wp.dot(n, others.first) > real(-0.5) and wp.dot(n, others.second) > real(-0.5)
        return good

    @wp.func
    def with_other(others: Others, touch: Touch, rank: int):
        """The contacts found, and one more."""
        found = others
        if rank == 0:
            found.first = touch.normal
            found.is_inside = int(touch.distance < real(0.0))
        else:
            found.second = touch.normal
        return found

    @wp.func
    def is_nearer(touch: Touch, gap: real, best: Touch, bound: real):
        """Whether a face is nearer than the best one so far; of two faces at one place, that on the near side is.

        The two sides of a sheet without thickness lie at one place: rounding must not decide between them.
        """
        nearer = gap < bound
        if best.face >= 0 and touch.distance * best.distance < real(0.0):
            if wp.abs(gap - bound) <= real(COINCIDENT) * wp.abs(bound):
                nearer = touch.distance > real(0.0)
        return nearer

    @wp.func
    def near_gap(scene: Scene, motion: Motion, pack: int, lane: int, target: int, p: vec3):
        """Distance of p from the nearest face of one leaf, that of the nearer boxes: a bound for the search."""
        none = vec3()
        node = int(scene.target_tree[target, 0])
        while scene.tree_first[node] < 0:
            left = node + 1
            right = scene.tree_skip[left]
            node = right
            near = box_gap(scene, motion, pack, lane, left, p, none)
            if near <= box_gap(scene, motion, pack, lane, right, p, none):
                node = left
        gap = real(FAR)
        for k in range(scene.tree_first[node], scene.tree_last[node]):
            gap = wp.min(gap, face_gap(scene, motion, pack, lane, target, scene.tree_face[k], p))
        return gap

    @wp.func
    def nearest_face(
        scene: Scene,
        motion: Motion,
        pack: int,
        lane: int,
        target: int,
        p: vec3,
        reach: real,
        own: int,
        clear: real,
        others: Others,
        rank: int,
        limit: real,
        known: real,
    ):
        """The face nearest to p within ``reach``, -1 if there is none; ``own`` is the point of self-contact or -1.

        The search for the nearest one begins at the distance ``known`` of some face, ``FAR`` where none is known.
        """
        best = Touch()
        best.face = -1
        best.distance = reach
        bound = reach
        if rank == 0 and own < 0:
            near = known
            if near >= real(FAR):
                near = near_gap(scene, motion, pack, lane, target, p)
            bound = wp.min(bound, near + real(1.0e-5) * wp.abs(near) + real(1.0e-12))
        node = scene.target_tree[target, 0]
        last = scene.target_tree[target, 1]
        while node < last:
            step = scene.tree_skip[node]
            within = real(1.0 + COINCIDENT) * wp.max(bound, real(0.0))
            if box_gap(scene, motion, pack, lane, node, p, vec3()) <= within * within:
                start = scene.tree_first[node]
                if start < 0:
                    step = node + 1
                else:
                    for k in range(start, scene.tree_last[node]):
                        face = scene.tree_face[k]
                        gap = face_gap(scene, motion, pack, lane, target, face, p)
                        if gap <= within:
                            touch = touch_face(scene, motion, pack, lane, target, face, p)
                            good = is_nearer(touch, gap, best, bound) and is_other(touch, others, rank, limit)
                            if good and own >= 0:
                                rest = rest_gap(scene, own, face)
                                good = rest > clear and touch.distance > -real(BEHIND) * rest
                            if good:
                                best = touch
                                bound = gap
            node = step
        return best

    @wp.func
    def ball_faces(scene: Scene, motion: Motion, pack: int, lane: int, target: int, p: vec3, reach: real, first: vec3):
        """Faces within ``reach`` that the ball about p touches besides its nearest one, whose normal is ``first``.

        One walk through the tree keeps the nearest places on faces before p where no way along the surface comes nearer
        (inside a face, or the end of a wall); of these, ascending, one in each direction is taken. Faces in the
        direction of the nearest one have none that their neighbours do not have as well.

        Returns:
            Faces, the nearest first, -1 for none.
        """
        face_of = faces_t()
        gap_of = gaps_t()
        nx = gaps_t()
        ny = gaps_t()
        nz = gaps_t()
        count = int(0)
        node = int(scene.target_tree[target, 0])
        last = scene.target_tree[target, 1]
        while node < last:
            step = scene.tree_skip[node]
            if box_gap(scene, motion, pack, lane, node, p, vec3()) <= reach * reach:
                start = scene.tree_first[node]
                if start < 0:
                    step = node + 1
                else:
                    for k in range(start, scene.tree_last[node]):
                        face = scene.tree_face[k]
                        a = corner_x(scene, motion, pack, lane, target, scene.face_corner[face, 0])
                        b = corner_x(scene, motion, pack, lane, target, scene.face_corner[face, 1])
                        c = corner_x(scene, motion, pack, lane, target, scene.face_corner[face, 2])
                        across = wp.cross(b - a, c - a)
                        height = wp.dot(p - a, across)
                        far = height < real(0.0)  # behind it
                        if not far:
                            size = wp.length(across)
                            far = height > reach * size or wp.dot(across, first) >= real(SAME) * size
                        if not far:
                            touch = touch_face(scene, motion, pack, lane, target, face, p)
                            good = touch.distance <= reach and wp.dot(touch.normal, first) < real(SAME)
                            if good and touch.region != wp.static(FACE):
                                good = is_lowest(scene, motion, pack, lane, target, touch)
                            if good:
                                place = int(count)
                                if count < wp.static(KEPT):
                                    count += 1
                                else:
                                    place = 0
                                    for j in range(1, wp.static(KEPT)):
                                        if gap_of[j] > gap_of[place]:
                                            place = j
                                    good = touch.distance < gap_of[place]
                                if good:
                                    face_of[place] = face
                                    gap_of[place] = touch.distance
                                    nx[place] = touch.normal[0]
                                    ny[place] = touch.normal[1]
                                    nz[place] = touch.normal[2]
            node = step
        taken = taken_t()
        for rank in range(wp.static(BALL_RANKS - 1)):
            taken[rank] = -1
            best = int(-1)
            for j in range(count):
                if face_of[j] >= 0:
                    if best < 0:
                        best = j
                    elif gap_of[j] < gap_of[best]:
                        best = j
            if best >= 0:
                taken[rank] = face_of[best]
                n = vec3(nx[best], ny[best], nz[best])
                for j in range(count):
                    if wp.dot(n, vec3(nx[j], ny[j], nz[j])) >= real(SAME):
                        face_of[j] = -1
        return taken

    @wp.func
    def nearest_side(
        scene: Scene,
        motion: Motion,
        pack: int,
        lane: int,
        target: int,
        edge: int,
        x: vec3,
        q: vec4,
        reach: real,
        own: bool,
        clear: real,
        ahead: real,
    ):
        """The side of a face that an edge meets at the smallest distance; face -1 if there is none within ``reach``.

        Boxes within ``ahead`` beyond that are looked at as well: the second result is a distance that no face is nearer
        than, 0 where one may be within ``reach``.
        """
        best = Touch()
        best.face = -1
        best.distance = reach + scene.edge_radius[edge]
        i = scene.edge_point[edge, 0]
        j = scene.edge_point[edge, 1]
        p0 = to_local(x, q, point_x(scene, motion, pack, lane, i))
        p1 = to_local(x, q, point_x(scene, motion, pack, lane, j))
        half = vec3()
        for c in range(3):
            half[c] = real(0.5) * wp.abs(p1[c] - p0[c])
        middle = real(0.5) * (p0 + p1)
        bound = best.distance
        room = bound + ahead
        outer = room * room
        node = int(scene.target_tree[target, 0])
        last = scene.target_tree[target, 1]
        left = scene.edge_face[edge, 0]
        right = scene.edge_face[edge, 1]
        if left >= 0 and right >= 0:
            n1 = face_normal(scene, motion, pack, lane, left)
            if wp.dot(n1, face_normal(scene, motion, pack, lane, right)) >= real(SHARP):
                node = last  # the faces beside it are one plane
                room = real(0.0)
        while node < last:
            step = scene.tree_skip[node]
            gap = box_gap(scene, motion, pack, lane, node, middle, half)
            if gap <= outer:
                start = scene.tree_first[node]
                if start < 0:
                    step = node + 1
                elif gap > bound * bound:
                    room = wp.min(room, wp.sqrt(gap))
                else:
                    room = real(0.0)
                    for k in range(start, scene.tree_last[node]):
                        face = scene.tree_face[k]
                        side = int(0)
                        while side < 3:
                            other = scene.face_edge[face, side]
                            if other >= 0 and (not own or other > edge):
                                touch = touch_side(scene, motion, pack, lane, target, face, side, p0, p1)
                                good = wp.abs(touch.distance) < bound
                                if good and scene.face_corner[face, 2] >= 0:
                                    good = is_in_cone(
                                        scene, motion, pack, lane, target, face, side, touch.normal, real(CONE)
                                    )
                                if good and own:
                                    rest = rest_between(scene, edge, other)
                                    good = rest > clear and touch.distance > -real(BEHIND) * rest
                                if good:
                                    good = leaves(scene, motion, pack, lane, edge, rotate(q, touch.normal), real(CONE))
                                if good:
                                    best = touch
                                    bound = wp.abs(touch.distance)
                            side += 1
            node = step
        return best, room

    @wp.func
    def rest_between(scene: Scene, edge: int, other: int):
        """Distance at rest between two edges of one surface; 0 if they share a point."""
        gap = real(FAR)
        i = scene.edge_point[edge, 0]
        j = scene.edge_point[edge, 1]
        k = scene.edge_point[other, 0]
        m = scene.edge_point[other, 1]
        a = scene.point_rest[i]
        b = scene.point_rest[j]
        c = scene.point_rest[k]
        d = scene.point_rest[m]
        gap = wp.min(wp.min(wp.length(a - c), wp.length(a - d)), wp.min(wp.length(b - c), wp.length(b - d)))
        s, t = segment_segment(a, b, c, d)
        if s > real(0.0) and s < real(1.0) and t > real(0.0) and t < real(1.0):
            gap = wp.min(gap, wp.length(a + s * (b - a) - c - t * (d - c)))
        if i == k or i == m or j == k or j == m:
            gap = real(0.0)
        return gap

    @wp.func
    def leaves(scene: Scene, motion: Motion, pack: int, lane: int, edge: int, n: vec3, cone: real):
        """Whether -n leaves the body of a feature edge outwards, to a sine of ``cone``; always for round edges."""
        good = bool(True)
        left = scene.edge_face[edge, 0]
        right = scene.edge_face[edge, 1]
        if left >= 0:
            e = point_x(scene, motion, pack, lane, scene.edge_point[edge, 1])
            e = wp.normalize(e - point_x(scene, motion, pack, lane, scene.edge_point[edge, 0]))
            n1 = face_normal(scene, motion, pack, lane, left)
            good = wp.dot(-n, wp.cross(n1, e)) <= cone
            if right >= 0:
                n2 = face_normal(scene, motion, pack, lane, right)
                good = good and wp.dot(-n, wp.cross(e, n2)) <= cone
                good = good and wp.dot(n, n1 + n2) < real(0.0)
        return good

    @wp.func
    def placed(touch: Touch, x: vec3, q: vec4, offset: vec3, radius: real):
        """A touch of the probe a + offset as one of a ball around a, in world coordinates."""
        result = Touch()
        result.normal = rotate(q, touch.normal)
        result.a = to_world(x, q, touch.a) - offset
        d = touch.distance - wp.dot(result.normal, offset)
        result.b = result.a - d * result.normal
        result.distance = d - radius
        result.share = touch.share
        result.u = touch.u
        result.v = touch.v
        result.region = touch.region
        result.face = touch.face
        return result

    return SimpleNamespace(
        nearest_face=nearest_face,
        ball_faces=ball_faces,
        nearest_side=nearest_side,
        leaves=leaves,
        placed=placed,
        box_gap=box_gap,
        with_other=with_other,
    )
