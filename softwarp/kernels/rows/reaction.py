"""Forces that hold nodes and frames in their places. Equations: docs/theory/reaction.md."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type; ``contact_wrenches`` has one world per element of an array."""
    S = variant.S
    real = variant.real
    mul = variant.mul
    world_fastest = variant.world_fastest
    module = variant.module("reaction")
    vec3 = wp.types.vector(3, real)

    @wp.kernel(module=module, enable_backward=False)
    def held_nodes(
        # Model
        held_node: wp.array(dtype=wp.int32),
        entry_start: wp.array(dtype=wp.int32),
        entry_point: wp.array(dtype=wp.int32),
        entry_row: wp.array(dtype=wp.int32),
        entry_weight: wp.array(dtype=real),
        # Workspace in
        node_internal_in: wp.array2d(dtype=S),
        node_external_in: wp.array2d(dtype=S),
        point_gradient_in: wp.array2d(dtype=S),
        multiplier_in: wp.array2d(dtype=S),
        # Workspace out
        reaction_out: wp.array2d(dtype=S),
    ):
        """Elastic force less loads and the forces of cables and chambers on one node without unknowns."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        row = 3 * held_node[item]
        for c in range(3):
            total = node_internal_in[w, row + c] - node_external_in[w, row + c]
            for p in range(entry_start[item], entry_start[item + 1]):
                pull = mul(point_gradient_in[w, 3 * entry_point[p] + c], multiplier_in[w, entry_row[p]])
                total -= pull * entry_weight[p]
            reaction_out[w, 3 * item + c] = total

    @wp.kernel(module=module, enable_backward=False)
    def contact_wrenches(
        # Model
        frame_master: wp.array(dtype=wp.int32),
        pair_frame: wp.array2d(dtype=wp.int32),
        # State
        frame_pose_in: wp.array2d(dtype=real),
        contact_pair_in: wp.array2d(dtype=wp.int32),
        contact_point_in: wp.array2d(dtype=real),
        contact_load_in: wp.array2d(dtype=real),
        # Workspace out
        wrench_out: wp.array2d(dtype=real),
    ):
        """Force, and moment about its origin, of the contacts of all rigid bodies that one master carries."""
        w, frame = wp.tid()
        if wp.static(world_fastest):
            frame, w = wp.tid()
        force = vec3()
        moment = vec3()
        x = vec3(frame_pose_in[w, 7 * frame], frame_pose_in[w, 7 * frame + 1], frame_pose_in[w, 7 * frame + 2])
        for contact in range(contact_pair_in.shape[1]):
            pair = contact_pair_in[w, contact]
            if pair >= 0:
                k = 3 * contact
                load = vec3(contact_load_in[w, k], contact_load_in[w, k + 1], contact_load_in[w, k + 2])
                point = vec3(contact_point_in[w, k], contact_point_in[w, k + 1], contact_point_in[w, k + 2])
                for side in range(2):
                    part = pair_frame[pair, side]
                    if part >= 0 and frame_master[wp.max(part, 0)] == frame:
                        f = load * real(1 - 2 * side)
                        force += f
                        moment += wp.cross(point - x, f)
        for c in range(3):
            wrench_out[w, 6 * frame + c] = force[c]
            wrench_out[w, 6 * frame + 3 + c] = moment[c]

    return SimpleNamespace(held_nodes=held_nodes, contact_wrenches=contact_wrenches)
