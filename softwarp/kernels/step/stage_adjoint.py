"""Adjoint of a stage of BDF2, a backward Euler step that is linearised where the start velocities lead to.

With x = x0 + h v0, k = h (h + beta) and m = 1 + h alpha a stage solves, for the velocities v at its end,

    m M v + K(x) (k v - h^2 v0) = M v0 - h f(x) + h f_ext + h H(x)' T,      d(x) + h H(x) (v - v0) + C T = target,

so that elements have v - h^2 / k v0 in the place of v, rows v - v0, and the velocities of the start count three times:
by M, by x, and by K and H. With s = A p, the seed less h H' q, K p is (s - m M p) / k. Theory: docs/theory/adjoint.md.
State arrays are ``[world, row]``; workspace arrays ``[pack, row, lane]``.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.elements import rod_adjoint
from softwarp.kernels.frames import adjoint as of_frames
from softwarp.model.codes import Spin


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type and memory order."""
    real = variant.real
    module = variant.module("adjoint.stage")
    one = single.functions(variant)
    vec3, quat, vector_at, quat_at, put, add_to = one.vec3, one.quat, one.vector_at, one.quat_at, one.put, one.add_to
    exponential, logarithm = one.exponential, one.logarithm
    turns, of_rods = of_frames.functions(variant), rod_adjoint.functions(variant)
    turn_bar, jacobian_transposed = turns.turn_bar, turns.jacobian_transposed
    slopes, twisted = of_rods.slopes, of_rods.twisted

    @wp.kernel(module=module, enable_backward=False)
    def start_points(
        # Model
        point_row: wp.array(dtype=wp.int32),
        # Workspace in
        point_gradient_in: wp.array3d(dtype=real),
        start_in: wp.array3d(dtype=real),
        # Workspace out
        point_bar_out: wp.array3d(dtype=real),
    ):
        """Gradient by one point of a row where the stage started, by its displacement there."""
        pack, point, lane = wp.tid()
        here = vector_at(point_gradient_in, pack, lane, 3 * point)
        put(point_bar_out, pack, lane, 3 * point, start_in[pack, point_row[point], lane] * here)

    @wp.kernel(module=module, enable_backward=False)
    def start_frames(
        nodes: int,
        # Model
        frame_item_start: wp.array(dtype=wp.int32),
        frame_item: wp.array(dtype=wp.int32),
        carried_slot: wp.array(dtype=wp.int32),
        carried_offset: wp.array2d(dtype=real),
        node_point_start: wp.array(dtype=wp.int32),
        node_point: wp.array(dtype=wp.int32),
        node_point_weight: wp.array(dtype=real),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        point_bar_in: wp.array3d(dtype=real),
        # Workspace out
        start_out: wp.array3d(dtype=real),
    ):
        """Add what the points that one frame carries have where the stage started, by its place and turn there."""
        pack, frame, lane = wp.tid()
        q = quat_at(pose0_in, pack, lane, 7 * frame + 3)
        place = vec3()
        turn = vec3()
        for k in range(frame_item_start[frame], frame_item_start[frame + 1]):
            item = frame_item[k]
            node = carried_slot[item]
            if node < nodes:
                total = vec3()
                for i in range(node_point_start[node], node_point_start[node + 1]):
                    total += node_point_weight[i] * vector_at(point_bar_in, pack, lane, 3 * node_point[i])
                offset = vec3(carried_offset[item, 0], carried_offset[item, 1], carried_offset[item, 2])
                place += total
                turn += wp.cross(wp.quat_rotate(q, offset), total)
        add_to(start_out, pack, lane, 6 * frame, place)
        add_to(start_out, pack, lane, 6 * frame + 3, turn)

    @wp.kernel(module=module, enable_backward=False)
    def nodes(
        h: real,
        lanes: int,
        # Model
        node_dof: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        node_point_start: wp.array(dtype=wp.int32),
        node_point: wp.array(dtype=wp.int32),
        node_point_weight: wp.array(dtype=real),
        # Workspace in
        density_in: wp.array3d(dtype=real),
        beta_in: wp.array3d(dtype=real),
        body_mass_in: wp.array3d(dtype=real),
        seed_in: wp.array3d(dtype=real),
        pushed_in: wp.array3d(dtype=real),
        node_p_in: wp.array3d(dtype=real),
        node_mass_p_in: wp.array3d(dtype=real),
        node_bar_in: wp.array3d(dtype=real),
        point_bar_in: wp.array3d(dtype=real),
        # State out
        x_bar_out: wp.array2d(dtype=real),
        v_bar_out: wp.array2d(dtype=real),
        force_bar_out: wp.array2d(dtype=real),
    ):
        """Gradients by the position, the velocity and the force of one node at the start of the stage.

        ``node_bar_in`` is that by x, ``pushed_in`` s of dofs, ``point_bar_in`` that by points at the start.
        """
        pack, node, lane = wp.tid()
        world = pack * lanes + lane
        if world < x_bar_out.shape[0]:
            body = node_body[node]
            mass_p = density_in[pack, body, lane] * vector_at(node_mass_p_in, pack, lane, 3 * node)
            by_x = vector_at(node_bar_in, pack, lane, 3 * node)
            by_v = vec3()
            dof = node_dof[node]
            if dof >= 0:
                seed = vector_at(seed_in, pack, lane, 3 * dof)
                pushed = vector_at(pushed_in, pack, lane, 3 * dof)
                share = h / (h + beta_in[pack, body, lane])  # h^2 / k
                by_v = h * by_x + seed - pushed + share * (pushed - body_mass_in[pack, body, lane] * mass_p)
            for i in range(node_point_start[node], node_point_start[node + 1]):
                by_x += node_point_weight[i] * vector_at(point_bar_in, pack, lane, 3 * node_point[i])
            for c in range(3):
                row = 3 * node + c
                found = mass_p[c]
                if dof >= 0:
                    found += by_v[c] * dof_free[dof, c]
                x_bar_out[world, row] = x_bar_out[world, row] + by_x[c]
                v_bar_out[world, row] = found
                force_bar_out[world, row] = h * node_p_in[pack, row, lane]

    @wp.kernel(module=module, enable_backward=False)
    def part(
        factor: real,
        # State
        bar_in: wp.array2d(dtype=real),
        # State out
        part_out: wp.array2d(dtype=real),
        rest_out: wp.array2d(dtype=real),
    ):
        """Gradient by an extrapolated value, as those by the end of the stage before and by the start of the step."""
        world, row = wp.tid()
        bar = bar_in[world, row]
        part_out[world, row] = factor * bar
        rest_out[world, row] = bar - factor * bar

    @wp.func
    def turn_of(bar: wp.array2d(dtype=real), world: int, row: int, q: quat):
        """Gradient by a turn from that by a quaternion."""
        return turn_bar(q, vec3(bar[world, row], bar[world, row + 1], bar[world, row + 2]), bar[world, row + 3])

    @wp.func
    def put_turn(bar: wp.array2d(dtype=real), world: int, row: int, q: quat, turn: vec3):
        """Gradient by a quaternion, along which it keeps its length, from that by a turn."""
        found = quat(turn[0], turn[1], turn[2], real(0.0)) * q * real(2.0)
        for c in range(4):
            bar[world, row + c] = found[c]

    @wp.kernel(module=module, enable_backward=False)
    def part_frames(
        factor: real,
        lanes: int,
        # Model
        frame_master: wp.array(dtype=wp.int32),
        frame_spin: wp.array(dtype=wp.int32),
        # State
        pose0_in: wp.array2d(dtype=real),
        pose1_in: wp.array2d(dtype=real),
        # State out
        pose_bar_out: wp.array2d(dtype=real),
        twist_bar_out: wp.array2d(dtype=real),
        pose_rest_out: wp.array2d(dtype=real),
        twist_rest_out: wp.array2d(dtype=real),
    ):
        """The same of one frame, which is turned on about the axis of its turn so far; free tops are left out.

        With q1 = exp(phi) q0 the frame is at exp(c phi) q0; phi changes by T(phi)^-1 of the turn of its exponential.
        """
        pack, frame, lane = wp.tid()
        world = pack * lanes + lane
        if world < pose_bar_out.shape[0] and frame_master[frame] == frame:
            if frame_spin[frame] != wp.static(Spin.FREE_TOP):
                row = 7 * frame
                for c in range(3):
                    bar = pose_bar_out[world, row + c]
                    pose_bar_out[world, row + c] = factor * bar
                    pose_rest_out[world, row + c] = bar - factor * bar
                for c in range(6):
                    bar = twist_bar_out[world, 6 * frame + c]
                    twist_bar_out[world, 6 * frame + c] = factor * bar
                    twist_rest_out[world, 6 * frame + c] = bar - factor * bar
                q0 = quat()
                q1 = quat()
                for c in range(4):
                    q0[c] = pose0_in[world, row + 3 + c]
                    q1[c] = pose1_in[world, row + 3 + c]
                phi = logarithm(q1 * wp.quat_inverse(q0))
                q = wp.normalize(exponential(phi * factor) * q0)
                g = turn_of(pose_bar_out, world, row + 3, q)
                by_phi = factor * jacobian_transposed(factor * phi, g)
                curl, _ = slopes(wp.dot(phi, phi))
                by_end = twisted(-phi, curl, by_phi)
                by_start = wp.quat_rotate_inv(exponential(factor * phi), g)
                by_start -= wp.quat_rotate_inv(exponential(phi), by_end)
                put_turn(pose_bar_out, world, row + 3, q1, by_end)
                put_turn(pose_rest_out, world, row + 3, q0, by_start)

    @wp.kernel(module=module, enable_backward=False)
    def add(
        # State
        bar_in: wp.array2d(dtype=real),
        # State out
        sum_out: wp.array2d(dtype=real),
    ):
        """Add one gradient to another."""
        world, row = wp.tid()
        sum_out[world, row] = sum_out[world, row] + bar_in[world, row]

    return SimpleNamespace(
        start_points=start_points,
        start_frames=start_frames,
        nodes=nodes,
        part=part,
        part_frames=part_frames,
        add=add,
    )
