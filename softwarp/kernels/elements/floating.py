"""Reduced bodies with a floating frame: places, velocities, loads and rows of what turns with the body.

A node is at c + R y with y = X + Phi q, in axes that turn with the body, and its velocity is V + w x R y + R Phi v. The
modes hold no rigid motion: sum m Phi = 0 and sum m X x Phi = 0. The first column of a basis is X, of amplitude 1.
All kernels take single worlds; what is summed over modes comes from ``reduction``.
Theory: docs/theory/reduction.md, "A floating frame".
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels on single worlds."""
    real = variant.real
    module = variant.module("floating")
    one = single.functions(variant)
    vec3, vector_at, quat_at = one.vec3, one.vector_at, one.quat_at
    put, put_quat, exponential = one.put, one.put_quat, one.exponential

    @wp.func
    def matrix_at(array: wp.array3d(dtype=real), pack: int, lane: int, row: int):
        """Matrix in nine rows."""
        a = vector_at(array, pack, lane, row)
        b = vector_at(array, pack, lane, row + 3)
        c = vector_at(array, pack, lane, row + 6)
        return wp.matrix_from_rows(a, b, c)

    @wp.kernel(module=module, enable_backward=False)
    def trial_frame(
        # Model
        first: wp.array(dtype=wp.int32),
        block: wp.array(dtype=wp.int32),
        mode_dof: wp.array(dtype=wp.int32),
        centre: wp.array2d(dtype=real),
        radius: wp.array(dtype=real),
        # Workspace in
        turn0_in: wp.array3d(dtype=real),
        dof_v_in: wp.array3d(dtype=real),
        x_scale: real,
        # Workspace out
        mode_q_out: wp.array3d(dtype=real),
        turn_out: wp.array3d(dtype=real),
        centre_out: wp.array3d(dtype=real),
    ):
        """Where one frame is after x_scale times the velocities; the amplitude of turning stays 0."""
        pack, f, lane = wp.tid()
        q = quat_at(turn0_in, pack, lane, 4 * f)
        v = vector_at(dof_v_in, pack, lane, 3 * mode_dof[block[f] + 1]) * (x_scale / radius[f])
        if wp.length_sq(v) > real(0.0):
            q = wp.normalize(exponential(v) * q)
        put_quat(turn_out, pack, lane, 4 * f, q)
        put(mode_q_out, pack, lane, first[f] + 3, vec3())
        rest = vec3(centre[f, 0], centre[f, 1], centre[f, 2])
        put(centre_out, pack, lane, 3 * f, rest + vector_at(mode_q_out, pack, lane, first[f]))

    @wp.kernel(module=module, enable_backward=False)
    def hold_axes(
        # Workspace in
        turn_in: wp.array3d(dtype=real),
        # Workspace out
        axes_out: wp.array3d(dtype=real),
    ):
        """R of one body, that rows and forces go by until the next one."""
        pack, f, lane = wp.tid()
        R = wp.quat_to_matrix(wp.normalize(quat_at(turn_in, pack, lane, 4 * f)))
        for r in range(3):
            put(axes_out, pack, lane, 9 * f + 3 * r, vec3(R[r, 0], R[r, 1], R[r, 2]))

    @wp.kernel(module=module, enable_backward=False)
    def hold_arms(
        # Model
        touch: wp.array(dtype=wp.int32),
        touch_body: wp.array(dtype=wp.int32),
        touch_node: wp.array(dtype=wp.int32),
        # Workspace in
        x_in: wp.array3d(dtype=real),
        centre_in: wp.array3d(dtype=real),
        # Workspace out
        arm_out: wp.array3d(dtype=real),
    ):
        """From the centre of mass to one node that may touch something."""
        pack, item, lane = wp.tid()
        i = touch[item]
        x = vector_at(x_in, pack, lane, 3 * touch_node[i])
        put(arm_out, pack, lane, 3 * i, x - vector_at(centre_in, pack, lane, 3 * touch_body[i]))

    @wp.kernel(module=module, enable_backward=False)
    def at_rest(
        # Model
        first_wide: wp.array(dtype=wp.int32),
        # Workspace out
        wide_q_out: wp.array3d(dtype=real),
    ):
        """Amplitude 1 of the place at rest."""
        pack, f, lane = wp.tid()
        wide_q_out[pack, first_wide[f], lane] = real(1.0)

    @wp.func
    def placed(turn: wp.array3d(dtype=real), centre: wp.array3d(dtype=real), pack: int, lane: int, f: int, y: vec3):
        """c + R y."""
        q = wp.normalize(quat_at(turn, pack, lane, 4 * f))
        return vector_at(centre, pack, lane, 3 * f) + wp.quat_rotate(q, y)

    @wp.kernel(module=module, enable_backward=False)
    def place_nodes(
        end: int,
        # Model
        listed: wp.array(dtype=wp.int32),
        listed_body: wp.array(dtype=wp.int32),
        node: wp.array(dtype=wp.int32),
        # Workspace in
        turn_in: wp.array3d(dtype=real),
        centre_in: wp.array3d(dtype=real),
        # Workspace out
        x_out: wp.array3d(dtype=real),
    ):
        """Place of one listed node before ``end``, from that in the body's axes."""
        pack, item, lane = wp.tid()
        if listed[item] < end:
            row = 3 * node[listed[item]]
            y = vector_at(x_out, pack, lane, row)
            put(x_out, pack, lane, row, placed(turn_in, centre_in, pack, lane, listed_body[item], y))

    @wp.kernel(module=module, enable_backward=False)
    def place_touching(
        # Model
        touch: wp.array(dtype=wp.int32),
        touch_body: wp.array(dtype=wp.int32),
        touch_node: wp.array(dtype=wp.int32),
        # Workspace in
        turn_in: wp.array3d(dtype=real),
        centre_in: wp.array3d(dtype=real),
        # Workspace out
        x_out: wp.array3d(dtype=real),
    ):
        """The same of one node that may touch something."""
        pack, item, lane = wp.tid()
        i = touch[item]
        row = 3 * touch_node[i]
        y = vector_at(x_out, pack, lane, row)
        put(x_out, pack, lane, row, placed(turn_in, centre_in, pack, lane, touch_body[i], y))

    @wp.kernel(module=module, enable_backward=False)
    def node_velocities(
        # Model
        listed: wp.array(dtype=wp.int32),
        listed_body: wp.array(dtype=wp.int32),
        node: wp.array(dtype=wp.int32),
        first: wp.array(dtype=wp.int32),
        radius: wp.array(dtype=real),
        # Workspace in
        turn_in: wp.array3d(dtype=real),
        centre_in: wp.array3d(dtype=real),
        mode_v_in: wp.array3d(dtype=real),
        x_in: wp.array3d(dtype=real),
        # Workspace out
        reduced_v_out: wp.array3d(dtype=real),
    ):
        """Velocity of one listed node, from what its modes do in the body's axes."""
        pack, item, lane = wp.tid()
        f = listed_body[item]
        i = listed[item]
        arm = vector_at(x_in, pack, lane, 3 * node[i]) - vector_at(centre_in, pack, lane, 3 * f)
        spin = vector_at(mode_v_in, pack, lane, first[f] + 3) / radius[f]
        q = wp.normalize(quat_at(turn_in, pack, lane, 4 * f))
        u = wp.quat_rotate(q, vector_at(reduced_v_out, pack, lane, 3 * node[i]))
        v = vector_at(mode_v_in, pack, lane, first[f])
        put(reduced_v_out, pack, lane, 3 * node[i], v + wp.cross(spin, arm) + u)

    @wp.kernel(module=module, enable_backward=False)
    def touch_velocities(
        dof_count: int,
        # Model
        touch: wp.array(dtype=wp.int32),
        touch_body: wp.array(dtype=wp.int32),
        block: wp.array(dtype=wp.int32),
        mode_dof: wp.array(dtype=wp.int32),
        radius: wp.array(dtype=real),
        # Workspace in
        axes_in: wp.array3d(dtype=real),
        arm_in: wp.array3d(dtype=real),
        # Workspace out
        dof_out: wp.array3d(dtype=real),
    ):
        """The same of one node that may touch something, behind those of the dofs."""
        pack, item, lane = wp.tid()
        i = touch[item]
        f = touch_body[i]
        row = 3 * (dof_count + i)
        spin = vector_at(dof_out, pack, lane, 3 * mode_dof[block[f] + 1]) / radius[f]
        u = matrix_at(axes_in, pack, lane, 9 * f) * vector_at(dof_out, pack, lane, row)
        v = vector_at(dof_out, pack, lane, 3 * mode_dof[block[f]])
        put(dof_out, pack, lane, row, v + wp.cross(spin, vector_at(arm_in, pack, lane, 3 * i)) + u)

    @wp.kernel(module=module, enable_backward=False)
    def rigid_forces(
        dof_count: int,
        # Model
        touch_range: wp.array2d(dtype=wp.int32),
        block: wp.array(dtype=wp.int32),
        mode_dof: wp.array(dtype=wp.int32),
        radius: wp.array(dtype=real),
        # Workspace in
        arm_in: wp.array3d(dtype=real),
        dof_in: wp.array3d(dtype=real),
        # Workspace out
        target_out: wp.array3d(dtype=real),
    ):
        """Add force and moment of all nodes of one body that touch something."""
        pack, f, lane = wp.tid()
        force = vec3()
        moment = vec3()
        for i in range(touch_range[f, 0], touch_range[f, 1]):
            p = vector_at(dof_in, pack, lane, 3 * (dof_count + i))
            if wp.length_sq(p) > real(0.0):
                force += p
                moment += wp.cross(vector_at(arm_in, pack, lane, 3 * i), p)
        row = 3 * mode_dof[block[f]]
        put(target_out, pack, lane, row, vector_at(target_out, pack, lane, row) + force)
        row = 3 * mode_dof[block[f] + 1]
        put(target_out, pack, lane, row, vector_at(target_out, pack, lane, row) + moment / radius[f])

    @wp.kernel(module=module, enable_backward=False)
    def turn_forces(
        dof_count: int,
        # Model
        touch: wp.array(dtype=wp.int32),
        touch_body: wp.array(dtype=wp.int32),
        # Workspace in
        axes_in: wp.array3d(dtype=real),
        # Workspace out
        dof_out: wp.array3d(dtype=real),
    ):
        """Force at one such node in the body's axes, for its modes."""
        pack, item, lane = wp.tid()
        i = touch[item]
        row = 3 * (dof_count + i)
        R = matrix_at(axes_in, pack, lane, 9 * touch_body[i])
        put(dof_out, pack, lane, row, wp.transpose(R) * vector_at(dof_out, pack, lane, row))

    @wp.kernel(module=module, enable_backward=False)
    def turn_loads(
        # Model
        listed: wp.array(dtype=wp.int32),
        listed_body: wp.array(dtype=wp.int32),
        # Workspace in
        axes_in: wp.array3d(dtype=real),
        # Workspace out
        listed_force_out: wp.array3d(dtype=real),
    ):
        """Force on one listed node in the body's axes."""
        pack, item, lane = wp.tid()
        row = 3 * listed[item]
        R = matrix_at(axes_in, pack, lane, 9 * listed_body[item])
        put(listed_force_out, pack, lane, row, wp.transpose(R) * vector_at(listed_force_out, pack, lane, row))

    @wp.kernel(module=module, enable_backward=False)
    def rigid_loads(
        # Model
        body: wp.array(dtype=wp.int32),
        first_wide: wp.array(dtype=wp.int32),
        listed_start: wp.array(dtype=wp.int32),
        listed: wp.array(dtype=wp.int32),
        node: wp.array(dtype=wp.int32),
        radius: wp.array(dtype=real),
        volume: wp.array(dtype=real),
        # Workspace in
        density_in: wp.array3d(dtype=real),
        gravity_in: wp.array3d(dtype=real),
        x_in: wp.array3d(dtype=real),
        centre_in: wp.array3d(dtype=real),
        node_external_in: wp.array3d(dtype=real),
        # Workspace out
        wide_force_out: wp.array3d(dtype=real),
    ):
        """Force and moment on one body; elastic forces have neither."""
        pack, f, lane = wp.tid()
        centre = vector_at(centre_in, pack, lane, 3 * f)
        force = vector_at(gravity_in, pack, lane, 0) * (volume[f] * density_in[pack, body[f], lane])
        moment = vec3()
        for item in range(listed_start[f], listed_start[f + 1]):
            row = 3 * node[listed[item]]
            p = vector_at(node_external_in, pack, lane, row)
            if wp.length_sq(p) > real(0.0):
                force += p
                moment += wp.cross(vector_at(x_in, pack, lane, row) - centre, p)
        put(wide_force_out, pack, lane, first_wide[f], force)
        put(wide_force_out, pack, lane, first_wide[f] + 3, moment / radius[f])

    @wp.kernel(module=module, enable_backward=False)
    def turn_stiffness(
        size: int,
        # Model
        sample_body: wp.array(dtype=wp.int32),
        # Workspace in
        axes_in: wp.array3d(dtype=real),
        # Workspace out
        stiffness_out: wp.array3d(dtype=real),
    ):
        """R' K R of one sample, a matrix with rows of ``size`` entries, where its body has a floating frame."""
        pack, item, lane = wp.tid()
        f = sample_body[item]
        if f >= 0:
            R = matrix_at(axes_in, pack, lane, 9 * f)
            for i in range(size // 3):
                for j in range(size // 3):
                    row = size * size * item + 3 * (size * i + j)
                    a = vector_at(stiffness_out, pack, lane, row)
                    b = vector_at(stiffness_out, pack, lane, row + size)
                    c = vector_at(stiffness_out, pack, lane, row + 2 * size)
                    K = wp.transpose(R) * wp.matrix_from_rows(a, b, c) * R
                    for r in range(3):
                        put(stiffness_out, pack, lane, row + size * r, vec3(K[r, 0], K[r, 1], K[r, 2]))

    @wp.kernel(module=module, enable_backward=False)
    def turn_gradients(
        # Model
        point_body: wp.array(dtype=wp.int32),
        # Workspace in
        axes_in: wp.array3d(dtype=real),
        point_gradient_in: wp.array3d(dtype=real),
        # Workspace out
        turned_gradient_out: wp.array3d(dtype=real),
    ):
        """Gradient of a row by one point, in the axes of the body that carries it."""
        pack, p, lane = wp.tid()
        g = vector_at(point_gradient_in, pack, lane, 3 * p)
        if point_body[p] >= 0:
            g = wp.transpose(matrix_at(axes_in, pack, lane, 9 * point_body[p])) * g
        put(turned_gradient_out, pack, lane, 3 * p, g)

    @wp.kernel(module=module, enable_backward=False)
    def rigid_rows(
        # Model
        row: wp.array(dtype=wp.int32),
        row_body: wp.array(dtype=wp.int32),
        row_point: wp.array(dtype=wp.int32),
        row_points: wp.array(dtype=wp.int32),
        row_wide: wp.array(dtype=wp.int32),
        point_body: wp.array(dtype=wp.int32),
        radius: wp.array(dtype=real),
        # Workspace in
        centre_in: wp.array3d(dtype=real),
        point_x_in: wp.array3d(dtype=real),
        point_gradient_in: wp.array3d(dtype=real),
        # Workspace out
        wide_row_out: wp.array3d(dtype=real),
    ):
        """One row of H on the rigid modes of one body."""
        pack, item, lane = wp.tid()
        f = row_body[item]
        r = row[item]
        centre = vector_at(centre_in, pack, lane, 3 * f)
        force = vec3()
        moment = vec3()
        for p in range(row_point[r], row_point[r] + row_points[r]):
            if point_body[p] == f:
                g = vector_at(point_gradient_in, pack, lane, 3 * p)
                force += g
                moment += wp.cross(vector_at(point_x_in, pack, lane, 3 * p) - centre, g)
        put(wide_row_out, pack, lane, row_wide[r], force)
        put(wide_row_out, pack, lane, row_wide[r] + 3, moment / radius[f])

    return SimpleNamespace(
        trial_frame=trial_frame,
        hold_axes=hold_axes,
        hold_arms=hold_arms,
        at_rest=at_rest,
        place_nodes=place_nodes,
        place_touching=place_touching,
        node_velocities=node_velocities,
        touch_velocities=touch_velocities,
        rigid_forces=rigid_forces,
        turn_forces=turn_forces,
        turn_loads=turn_loads,
        rigid_loads=rigid_loads,
        turn_stiffness=turn_stiffness,
        turn_gradients=turn_gradients,
        rigid_rows=rigid_rows,
    )
