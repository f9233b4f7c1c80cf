"""Between the state that users see and the solver's workspace: interleave, check, commit, embed.

State arrays are ``[world, row]``; workspace arrays are used here in their scalar view ``[pack, row, lane]``.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import packs
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.step.newton import FROZEN
from softwarp.model.codes import Excess, Status


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type and memory order; the type is that of a single world."""
    real = variant.real
    world_fastest = variant.world_fastest
    vec3 = wp.types.vector(3, real)
    quat = wp.types.quaternion(real)
    module = variant.module("state")
    of_packs = packs.functions(real)
    are_finite, are_near, interleave_rows = of_packs.are_finite, of_packs.are_near, of_packs.interleave_rows
    add_numbers, copy_numbers = of_packs.add_numbers, of_packs.copy_numbers

    @wp.kernel(module=module, enable_backward=False)
    def interleave(
        # State
        source_in: wp.array2d(dtype=real),
        world_count: int,
        lanes: int,
        # Workspace out
        target_out: wp.array3d(dtype=real),
    ):
        """Copy worlds into lanes; lanes past the last world repeat it."""
        pack, part = wp.tid()
        rows = source_in.shape[1]
        first = part * rows // lanes
        last = (part + 1) * rows // lanes
        if wp.static(world_fastest):
            for row in range(first, last):
                for lane in range(lanes):
                    target_out[pack, row, lane] = source_in[wp.min(pack * lanes + lane, world_count - 1), row]
        else:
            interleave_rows(source_in, pack, world_count, first, last, target_out)

    @wp.kernel(module=module, enable_backward=False)
    def place_rows(
        first: int,
        count: int,
        # Workspace in
        value_in: wp.array3d(dtype=real),
        # Workspace out
        target_out: wp.array3d(dtype=real),
    ):
        """Copy ``count`` rows to the rows from ``first`` on; a graph cannot hold copies between parts of arrays.

        On a CPU a thread has its share of a pack's numbers.
        """
        pack, part, lane = wp.tid()
        if wp.static(world_fastest):
            target_out[pack, first + part, lane] = value_in[pack, part, lane]
        else:
            lanes = value_in.shape[2]
            copy_numbers(value_in, target_out, pack, first * lanes, lane * count, (lane + 1) * count)

    @wp.kernel(module=module, enable_backward=False)
    def add_rows(
        count: int,
        # Workspace in
        value_in: wp.array3d(dtype=real),
        # Workspace out
        target_out: wp.array3d(dtype=real),
    ):
        """Add the first ``count`` rows to those of another array; on a CPU a thread its share of a pack's numbers."""
        pack, part, lane = wp.tid()
        if wp.static(world_fastest):
            target_out[pack, part, lane] += value_in[pack, part, lane]
        else:
            add_numbers(value_in, target_out, pack, lane * count, (lane + 1) * count)

    @wp.kernel(module=module, enable_backward=False)
    def check_nodes(
        # Model
        node_dof: wp.array(dtype=wp.int32),
        # Workspace in
        node_x0_in: wp.array3d(dtype=real),
        node_x_in: wp.array3d(dtype=real),
        dof_v_in: wp.array3d(dtype=real),
        commanded_in: wp.array3d(dtype=real),
        reach: real,
        resolved: real,
        # Workspace out
        flag_out: wp.array3d(dtype=wp.int32),
    ):
        """Raise flag 0 where a node is not finite, flag 1 where it went too far: in one step, or from the origin.

        It may go ``reach`` [m] in a step, and as far as commands carry kinematic bodies; none of its coordinates may
        exceed ``resolved`` [m]. Atomics make the larger code win on a GPU; only worlds that fail run them.

        On a CPU a thread glances at its share of a pack's numbers, and where something is wrong there, looks at every
        node of all worlds of the pack.
        """
        pack, part, lane = wp.tid()
        nodes = node_dof.shape[0]
        lanes = flag_out.shape[2]
        first = part
        last = part + 1
        begin = lane
        end = lane + 1
        if wp.static(not world_fastest):
            size = 3 * nodes
            here = are_near(node_x0_in, node_x_in, pack, lane * size, (lane + 1) * size, reach, resolved)
            size = dof_v_in.shape[1]
            if here > 0 and are_finite(dof_v_in, pack, lane * size, (lane + 1) * size) > 0:
                return
            first = int(0)
            last = nodes
            begin = int(0)
            end = lanes
        for other in range(begin, end):
            limit = reach + commanded_in[pack, 0, other]
            for node in range(first, last):
                dof = node_dof[node]
                for c in range(3):
                    x = node_x_in[pack, 3 * node + c, other]
                    moved = wp.abs(x - node_x0_in[pack, 3 * node + c, other])
                    good = wp.isfinite(x)
                    if dof >= 0:
                        good = good and wp.isfinite(dof_v_in[pack, 3 * dof + c, other])
                    if not good:
                        flag_out[pack, 0, other] = 1
                    elif moved > limit:
                        wp.atomic_max(flag_out, pack, 1, other, wp.static(int(Excess.WAY)))  # rare, so without a cost
                    elif wp.abs(x) > resolved:
                        wp.atomic_max(flag_out, pack, 1, other, wp.static(int(Excess.PLACE)))  # likewise

    @wp.kernel(module=module, enable_backward=False)
    def check_rows(
        count: int,
        # Workspace in
        value_in: wp.array3d(dtype=real),
        # Workspace out
        flag_out: wp.array3d(dtype=wp.int32),
    ):
        """Raise flag 0 where one of the first ``count`` commands or multipliers is not finite.

        On a CPU a thread glances at its share of a pack's numbers first, as ``check_nodes`` does.
        """
        pack, part, lane = wp.tid()
        first = part
        last = part + 1
        begin = lane
        end = lane + 1
        if wp.static(not world_fastest):
            if are_finite(value_in, pack, lane * count, (lane + 1) * count) > 0:
                return
            first = int(0)
            last = count
            begin = int(0)
            end = flag_out.shape[2]
        for other in range(begin, end):
            for row in range(first, last):
                if not wp.isfinite(value_in[pack, row, other]):
                    flag_out[pack, 0, other] = 1

    @wp.kernel(module=module, enable_backward=False)
    def check_pairs(
        # Workspace in
        mu_in: wp.array3d(dtype=real),
        restitution_in: wp.array3d(dtype=real),
        distance_in: wp.array3d(dtype=real),
        alarm_in: wp.array3d(dtype=real),
        compliance_in: wp.array3d(dtype=real),
        # Workspace out
        flag_out: wp.array3d(dtype=wp.int32),
    ):
        """Raise flag 0 where a number of a contact law is negative or no number, which detection could pass over."""
        pack, pair, lane = wp.tid()
        mu = mu_in[pack, pair, lane]
        restitution = restitution_in[pack, pair, lane]
        distance = distance_in[pack, pair, lane]
        compliance = compliance_in[pack, pair, lane]
        least = wp.min(wp.min(mu, restitution), wp.min(distance, compliance))
        total = mu + restitution + distance + compliance + alarm_in[pack, pair, lane]
        if least < real(0.0) or not wp.isfinite(total):
            flag_out[pack, 0, lane] = 1

    @wp.kernel(module=module, enable_backward=False)
    def commit_nodes(
        # Model
        node_dof: wp.array(dtype=wp.int32),
        lanes: int,
        # Workspace in
        flag_in: wp.array3d(dtype=wp.int32),
        node_x_in: wp.array3d(dtype=real),
        dof_v_in: wp.array3d(dtype=real),
        v_scale: real,
        # State out
        node_x_out: wp.array2d(dtype=real),
        node_v_out: wp.array2d(dtype=real),
        good_x_out: wp.array2d(dtype=real),
        good_v_out: wp.array2d(dtype=real),
    ):
        """Write a good world's new positions and velocities; a failed one keeps what it had.

        Where a failed world had been given coordinates that are not finite, it gets back its last good ones.
        """
        pack, part, lane = wp.tid()
        world = pack * lanes + lane
        if world < node_x_out.shape[0]:
            is_good = flag_in[pack, 0, lane] + flag_in[pack, 1, lane] == 0
            last = node_dof.shape[0]
            if wp.static(world_fastest):
                last = part + 1
            for node in range(part, last):
                dof = node_dof[node]
                for c in range(3):
                    row = 3 * node + c
                    if is_good:
                        v = real(0.0)
                        if dof >= 0:
                            v = dof_v_in[pack, 3 * dof + c, lane] * v_scale
                        x = node_x_in[pack, row, lane]
                        node_x_out[world, row] = x
                        node_v_out[world, row] = v
                        good_x_out[world, row] = x
                        good_v_out[world, row] = v
                    else:
                        if not wp.isfinite(node_x_out[world, row]):
                            node_x_out[world, row] = good_x_out[world, row]
                        if not wp.isfinite(node_v_out[world, row]):
                            node_v_out[world, row] = good_v_out[world, row]

    @wp.kernel(module=module, enable_backward=False)
    def commit_rows(
        lanes: int,
        # Workspace in
        flag_in: wp.array3d(dtype=wp.int32),
        value_in: wp.array3d(dtype=real),
        # State out
        value_out: wp.array2d(dtype=real),
    ):
        """Write a good world's multipliers."""
        pack, row, lane = wp.tid()
        world = pack * lanes + lane
        if world < value_out.shape[0]:
            if flag_in[pack, 0, lane] + flag_in[pack, 1, lane] == 0:
                value_out[world, row] = value_in[pack, row, lane]
            elif not wp.isfinite(value_out[world, row]):
                value_out[world, row] = real(0.0)

    @wp.kernel(module=module, enable_backward=False)
    def commit_status(
        lanes: int,
        h: real,
        iterated: bool,
        # Workspace in
        flag_in: wp.array3d(dtype=wp.int32),
        residual_in: wp.array3d(dtype=real),
        newton_in: wp.array3d(dtype=real),
        overflow_in: wp.array3d(dtype=wp.int32),
        compression_in: wp.array3d(dtype=real),
        inverted_in: wp.array3d(dtype=wp.int32),
        # State out
        status_out: wp.array2d(dtype=wp.int32),
        overflow_out: wp.array2d(dtype=wp.int32),
        time_out: wp.array2d(dtype=real),
        residual_out: wp.array2d(dtype=real),
        compression_out: wp.array2d(dtype=real),
        inverted_out: wp.array2d(dtype=wp.int32),
    ):
        """One ``Status`` per world. Time advances unless the step is taken back; the largest overflow stays."""
        pack, lane = wp.tid()
        world = pack * lanes + lane
        if world < status_out.shape[0]:
            status = int(wp.static(Status.OK))
            if flag_in[pack, 0, lane] != 0:
                status = wp.static(Status.NONFINITE)
            elif flag_in[pack, 1, lane] == wp.static(int(Excess.WAY)):
                status = wp.static(Status.DIVERGED)
            elif flag_in[pack, 1, lane] != 0:
                status = wp.static(Status.TOO_FAR)
            else:
                if inverted_in[pack, 0, lane] > 0:
                    status = wp.static(Status.INVERTED)
                if iterated and newton_in[pack, wp.static(FROZEN), lane] < real(0.5):
                    status = wp.static(Status.MAX_ITERATIONS)
                if overflow_in[pack, 0, lane] > 0:
                    status = wp.static(Status.CONTACT_OVERFLOW)
                overflow_out[world, 0] = wp.max(overflow_out[world, 0], overflow_in[pack, 0, lane])
                time_out[world, 0] = time_out[world, 0] + h
                residual_out[world, 0] = residual_in[pack, 0, lane]
                compression_out[world, 0] = compression_in[pack, 0, lane]
                inverted_out[world, 0] = inverted_in[pack, 0, lane]
            status_out[world, 0] = status

    @wp.kernel(module=module, enable_backward=False)
    def gather_dofs(
        # Model
        dof_node: wp.array(dtype=wp.int32),
        # Workspace in
        node_in: wp.array3d(dtype=real),
        # Workspace out
        dof_out: wp.array3d(dtype=real),
    ):
        """Copy a nodal vector field to the free nodes in elimination order."""
        pack, dof, lane = wp.tid()
        for c in range(3):
            dof_out[pack, 3 * dof + c, lane] = node_in[pack, 3 * dof_node[dof] + c, lane]

    @wp.kernel(module=module, enable_backward=False)
    def embed(
        # Model
        point_node: wp.array2d(dtype=wp.int32),
        point_weight: wp.array2d(dtype=real),
        point_anchor: wp.array2d(dtype=real),
        anchored: bool,
        # State
        node_in: wp.array2d(dtype=real),
        # State out
        point_out: wp.array2d(dtype=real),
    ):
        """Weighted sum of nodal vectors at a point of a body; ``anchored`` adds points fixed in space."""
        world, point = wp.tid()
        if wp.static(world_fastest):
            point, world = wp.tid()
        for c in range(3):
            value = real(0.0)
            if anchored:
                value = point_anchor[point, c]
            for k in range(4):
                node = point_node[point, k]
                if node >= 0:
                    value += point_weight[point, k] * node_in[world, 3 * node + c]
            point_out[world, 3 * point + c] = value

    @wp.kernel(module=module, enable_backward=False)
    def embed_in_frames(
        # Model
        point_frame: wp.array(dtype=wp.int32),
        point_local: wp.array2d(dtype=real),
        # State
        frame_pose_in: wp.array2d(dtype=real),
        frame_twist_in: wp.array2d(dtype=real),
        # State out
        point_x_out: wp.array2d(dtype=real),
        point_v_out: wp.array2d(dtype=real),
    ):
        """Position and velocity of a point that a frame carries."""
        world, point = wp.tid()
        if wp.static(world_fastest):
            point, world = wp.tid()
        frame = point_frame[point]
        if frame >= 0:
            q = quat()
            r = vec3()
            v = vec3()
            w = vec3()
            for c in range(4):
                q[c] = frame_pose_in[world, 7 * frame + 3 + c]
            for c in range(3):
                r[c] = point_local[point, c]
                v[c] = frame_twist_in[world, 6 * frame + c]
                w[c] = frame_twist_in[world, 6 * frame + 3 + c]
            r = wp.quat_rotate(q, r)
            v = v + wp.cross(w, r)
            for c in range(3):
                point_x_out[world, 3 * point + c] = frame_pose_in[world, 7 * frame + c] + r[c]
                point_v_out[world, 3 * point + c] = v[c]

    @wp.kernel(module=module, enable_backward=False)
    def cable_lengths(
        # Model
        cable_point_start: wp.array(dtype=wp.int32),
        cable_rest_length: wp.array(dtype=real),
        cable_closing_length: wp.array(dtype=real),
        # State
        cable_x_in: wp.array2d(dtype=real),
        # State out
        cable_length_out: wp.array2d(dtype=real),
        cable_displacement_out: wp.array2d(dtype=real),
    ):
        """Length and displacement of one cable from its points."""
        world, cable = wp.tid()
        if wp.static(world_fastest):
            cable, world = wp.tid()
        closing = cable_closing_length[cable]
        length = real(0.0)
        for p in range(cable_point_start[cable] + 1, cable_point_start[cable + 1]):
            square = real(0.0)
            for c in range(3):
                d = cable_x_in[world, 3 * p + c] - cable_x_in[world, 3 * p - 3 + c]
                square += d * d
            segment = wp.sqrt(square)
            least = wp.max(segment, closing)
            length += segment + real(0.5) * (least - segment) * (least - segment) / least
        cable_length_out[world, cable] = length
        cable_displacement_out[world, cable] = cable_rest_length[cable] - length

    return SimpleNamespace(
        interleave=interleave,
        place_rows=place_rows,
        add_rows=add_rows,
        check_nodes=check_nodes,
        check_rows=check_rows,
        check_pairs=check_pairs,
        commit_nodes=commit_nodes,
        commit_rows=commit_rows,
        commit_status=commit_status,
        gather_dofs=gather_dofs,
        embed=embed,
        embed_in_frames=embed_in_frames,
        cable_lengths=cable_lengths,
    )
