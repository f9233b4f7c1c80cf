"""Trees of boxes with a fixed topology: refitting, and the distance of a point from a box. Theory: docs/theory/bvh.md.

Nodes are stored in depth-first order, the left child behind its parent; ``skip`` is where the search goes on if a node
is left out. So a search needs no stack, and a refit from the last node to the first none either.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.collision import geometry
from softwarp.model.codes import SUM_OF_POINTS, UNBOUNDED, Carrier


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Refit of the trees over soft surfaces and rods, on elements."""
    S = variant.S
    real = variant.real
    mul, sqrt = variant.mul, variant.sqrt
    world_fastest = variant.world_fastest
    module = variant.module("bvh")
    types = geometry.structures(real)
    Scene = types.Scene

    @wp.kernel(module=module, enable_backward=False)
    def refit(
        # Model
        tree_skip: wp.array(dtype=wp.int32),
        corner_start: wp.array(dtype=wp.int32),
        corner_row: wp.array(dtype=wp.int32),
        corner_radius: wp.array(dtype=real),
        task_start: wp.array(dtype=wp.int32),
        task_node: wp.array(dtype=wp.int32),
        first_task: int,
        # Workspace in
        x_in: wp.array2d(dtype=S),
        pose_in: wp.array2d(dtype=S),
        # Workspace out
        tree_box_out: wp.array2d(dtype=S),
    ):
        """Boxes of the tree nodes of one task, children before parents: rows low (3), high (3)."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        task = first_task + item
        for k in range(task_start[task], task_start[task + 1]):
            node = task_node[k]
            row = 6 * node
            begin = corner_start[node]
            end = corner_start[node + 1]
            if begin < end:
                low_x = S(real(UNBOUNDED))
                low_y = S(real(UNBOUNDED))
                low_z = S(real(UNBOUNDED))
                high_x = S(real(-UNBOUNDED))
                high_y = S(real(-UNBOUNDED))
                high_z = S(real(-UNBOUNDED))
                for j in range(begin, end):
                    at = corner_row[j]
                    x = S(real(0.0))
                    y = S(real(0.0))
                    z = S(real(0.0))
                    if at >= 0:
                        x = x_in[w, at]
                        y = x_in[w, at + 1]
                        z = x_in[w, at + 2]
                    else:
                        x = pose_in[w, -1 - at]
                        y = pose_in[w, -at]
                        z = pose_in[w, 1 - at]
                    radius = S(corner_radius[j])
                    low_x = wp.min(low_x, x - radius)
                    low_y = wp.min(low_y, y - radius)
                    low_z = wp.min(low_z, z - radius)
                    high_x = wp.max(high_x, x + radius)
                    high_y = wp.max(high_y, y + radius)
                    high_z = wp.max(high_z, z + radius)
                tree_box_out[w, row] = low_x
                tree_box_out[w, row + 1] = low_y
                tree_box_out[w, row + 2] = low_z
                tree_box_out[w, row + 3] = high_x
                tree_box_out[w, row + 4] = high_y
                tree_box_out[w, row + 5] = high_z
            else:
                left = 6 * (node + 1)
                right = 6 * tree_skip[node + 1]
                for c in range(3):
                    tree_box_out[w, row + c] = wp.min(tree_box_out[w, left + c], tree_box_out[w, right + c])
                    tree_box_out[w, row + 3 + c] = wp.max(tree_box_out[w, left + 3 + c], tree_box_out[w, right + 3 + c])

    @wp.kernel(module=module, enable_backward=False)
    def embed(
        # Model
        node_count: int,
        followed: wp.array(dtype=wp.int32),
        carrier: wp.array2d(dtype=wp.int32),
        carrier_weight: wp.array2d(dtype=real),
        # Workspace in
        x_in: wp.array2d(dtype=S),
        # Workspace out
        x_out: wp.array2d(dtype=S),
    ):
        """Vector of one node, or of one embedded point, which comes after all nodes; on a CPU of all of them."""
        w, part = wp.tid()
        first = int(0)
        last = followed.shape[0]
        if wp.static(world_fastest):
            part, w = wp.tid()
            first = part
            last = part + 1
        for number in range(first, last):
            item = followed[number]
            for c in range(3):
                if item < node_count:
                    x_out[w, 3 * item + c] = x_in[w, 3 * item + c]
                else:
                    total = S(real(0.0))
                    for k in range(4):
                        node = carrier[item - node_count, k]
                        total += x_in[w, 3 * node + c] * carrier_weight[item - node_count, k]
                    x_out[w, 3 * item + c] = total

    @wp.struct
    class Bounds:
        low: S
        high: S
        slowest: S
        fastest: S

    @wp.func
    def bounds_of_none():
        b = Bounds()
        b.low = S(real(UNBOUNDED))
        b.high = S(real(-UNBOUNDED))
        b.slowest = S(real(UNBOUNDED))
        b.fastest = S(real(-UNBOUNDED))
        return b

    @wp.func
    def with_point(b: Bounds, p: S, v: S, radius: S):
        """Bounds of one coordinate and of its velocity, with those of one more point."""
        wider = Bounds()
        wider.low = wp.min(b.low, p - radius)
        wider.high = wp.max(b.high, p + radius)
        wider.slowest = wp.min(b.slowest, v)
        wider.fastest = wp.max(b.fastest, v)
        return wider

    @wp.func
    def put_bounds(b: Bounds, part_out: wp.array2d(dtype=S), w: int, row: int):
        part_out[w, row] = b.low
        part_out[w, row + 1] = b.high
        part_out[w, row + 2] = b.slowest
        part_out[w, row + 3] = b.fastest

    @wp.kernel(module=module, enable_backward=False)
    def spread_part(
        # Model
        scene: Scene,
        object_frame: wp.array(dtype=wp.int32),
        object_point: wp.array2d(dtype=wp.int32),
        parts: int,
        # Workspace in
        x_in: wp.array2d(dtype=S),
        pose_in: wp.array2d(dtype=S),
        v_in: wp.array2d(dtype=S),
        twist_in: wp.array2d(dtype=S),
        # Workspace out
        part_out: wp.array2d(dtype=S),
    ):
        """Bounds over part of the points of one object: per coordinate low, high, slowest, fastest."""
        w, task = wp.tid()
        if wp.static(world_fastest):
            task, w = wp.tid()
        item = task // parts
        if object_frame[item] == wp.static(SUM_OF_POINTS):
            x = bounds_of_none()
            y = bounds_of_none()
            z = bounds_of_none()
            for point in range(object_point[item, 0] + task % parts, object_point[item, 1], parts):
                index = scene.point_index[point]
                radius = S(scene.point_radius[point])
                if scene.point_kind[point] == wp.static(Carrier.NODE):
                    at = 3 * index
                    x = with_point(x, x_in[w, at], v_in[w, at], radius)
                    y = with_point(y, x_in[w, at + 1], v_in[w, at + 1], radius)
                    z = with_point(z, x_in[w, at + 2], v_in[w, at + 2], radius)
                else:
                    at = 7 * index
                    speed = 6 * index
                    x = with_point(x, pose_in[w, at], twist_in[w, speed], radius)
                    y = with_point(y, pose_in[w, at + 1], twist_in[w, speed + 1], radius)
                    z = with_point(z, pose_in[w, at + 2], twist_in[w, speed + 2], radius)
            put_bounds(x, part_out, w, 12 * task)
            put_bounds(y, part_out, w, 12 * task + 4)
            put_bounds(z, part_out, w, 12 * task + 8)

    @wp.kernel(module=module, enable_backward=False)
    def spread(
        # Model
        object_frame: wp.array(dtype=wp.int32),
        parts: int,
        # Workspace in
        part_in: wp.array2d(dtype=S),
        # Workspace out
        box_out: wp.array2d(dtype=S),
        velocity_out: wp.array2d(dtype=S),
    ):
        """Centre, half extent, largest speed and bounds of velocities of one object that is the sum of its points."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        if object_frame[item] == wp.static(SUM_OF_POINTS):
            row = 7 * item
            speed = S(real(0.0))
            for c in range(3):
                low = S(real(UNBOUNDED))
                high = S(real(-UNBOUNDED))
                slowest = S(real(UNBOUNDED))
                fastest = S(real(-UNBOUNDED))
                for part in range(parts):
                    k = 12 * (item * parts + part) + 4 * c
                    low = wp.min(low, part_in[w, k])
                    high = wp.max(high, part_in[w, k + 1])
                    slowest = wp.min(slowest, part_in[w, k + 2])
                    fastest = wp.max(fastest, part_in[w, k + 3])
                box_out[w, row + c] = (low + high) * real(0.5)
                box_out[w, row + 3 + c] = (high - low) * real(0.5)
                velocity_out[w, 6 * item + c] = slowest
                velocity_out[w, 6 * item + 3 + c] = fastest
                speed += wp.max(mul(fastest, fastest), mul(slowest, slowest))
            box_out[w, row + 6] = sqrt(speed)

    return SimpleNamespace(embed=embed, refit=refit, spread_part=spread_part, spread=spread)


@cache
def functions(scalar: Any) -> SimpleNamespace:
    """Search in trees; boxes of soft surfaces and rods are those of the world, boxes of rigid meshes are shared."""
    real = scalar
    types = geometry.structures(real)
    vec3 = types.vec3
    Scene, Motion = types.Scene, types.Motion

    @wp.func
    def box_gap(scene: Scene, motion: Motion, pack: int, lane: int, node: int, p: vec3, half: vec3):
        """Squared distance between the box of a tree node and the box p +- half."""
        gap = real(0.0)
        for c in range(3):
            low = real(0.0)
            high = real(0.0)
            if node < scene.moving_nodes:
                low = motion.tree_box[pack, 6 * node + c, lane]
                high = motion.tree_box[pack, 6 * node + 3 + c, lane]
            else:
                low = scene.tree_box[node, c]
                high = scene.tree_box[node, 3 + c]
            out = wp.max(wp.max(low - p[c], p[c] - high) - half[c], real(0.0))
            gap += out * out
        return gap

    return SimpleNamespace(box_gap=box_gap)
