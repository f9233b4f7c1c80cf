"""Frames that turn with reduced bodies, for ``ReductionTerm``. Equations: docs/theory/reduction.md."""

from __future__ import annotations

import warp as wp

from softwarp.kernels.elements import floating, floating_drag, floating_inertia, samples
from softwarp.model.floating import FloatingModel
from softwarp.model.reduction import ReductionModel
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


class FloatingFrames:
    """Floating frames of one shard: what is done with them where ``ReductionTerm`` does the rest of a stage.

    Args:
        shard: Worlds.
        modes: All reduced bodies.
        model: Those that have such a frame.
    """

    def __init__(self, shard: Shard, modes: ReductionModel, model: FloatingModel) -> None:
        self.shard, self.modes, self.model = shard, modes, model
        self.k, self.k_inertia = floating.kernels(shard.variant), floating_inertia.kernels(shard.variant)
        self.k_drag = floating_drag.kernels(shard.variant)
        self.count, self.listed, self.touching = model.count, int(model.listed.size), int(model.touch.size)

    # Places

    def start(self) -> None:
        """Frames of the start; wide amplitudes follow, then ``start_moments``."""
        self.shard.check_finite(self.shard.input["mode_turn0"], 4 * self.count)
        self.turn(0.0)

    def start_moments(self) -> None:
        """What inertia needs of the amplitudes at the start."""
        self._sum(self.shard.work.wide_q, self.shard.work.start_moment)

    def turn(self, x_scale: float) -> None:
        """Trial frames from the trial amplitudes."""
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [m.first, m.block, self.modes.mode_dof, m.centre, m.radius]
        inputs += [s.input["mode_turn0"].real, w.dof_v.real, x_scale]
        s.each_real(self.k.trial_frame, self.count, inputs, [w.mode_q.real, w.mode_turn.real, w.frame_centre.real])

    def unit(self) -> None:
        """Amplitude 1 of places at rest, once wide amplitudes are set."""
        self.shard.each_real(self.k.at_rest, self.count, [self.model.first_wide], [self.shard.work.wide_q.real])

    def place(self, end: int) -> None:
        """Listed nodes before ``end`` from their places in the frames."""
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [end, m.listed, m.listed_body, self.modes.node, w.mode_turn.real, w.frame_centre.real]
        s.each_real(self.k.place_nodes, self.listed, inputs, [w.x.real])

    def place_touching(self) -> None:
        """The same of those that may touch something."""
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [m.touch, m.touch_body, m.touch_node, w.mode_turn.real, w.frame_centre.real]
        s.each_real(self.k.place_touching, self.touching, inputs, [w.x.real])

    def velocities(self) -> None:
        """Velocities of all listed nodes from those in the frames."""
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [m.listed, m.listed_body, self.modes.node, m.first, m.radius]
        inputs += [w.mode_turn.real, w.frame_centre.real, w.mode_v.real, w.x.real]
        s.each_real(self.k.node_velocities, self.listed, inputs, [w.reduced_v.real])

    def hold(self) -> None:
        """Forces and rows go by these frames and places from now on."""
        s, m, w = self.shard, self.model, self.shard.work
        s.each_real(self.k.hold_axes, self.count, [w.mode_turn.real], [w.frame_axes.real])
        inputs = [m.touch, m.touch_body, m.touch_node, w.x.real, w.frame_centre.real]
        s.each_real(self.k.hold_arms, self.touching, inputs, [w.touch_arm.real])

    # The linear system

    def turn_stiffness(self) -> None:
        """Stiffness of the elements that count, in the frames."""
        s, m, w = self.shard, self.model, self.shard.work
        for size, body, stiffness in (
            (samples.TET, m.tet_body, w.sample_stiffness),
            (samples.TRI, m.tri_body, w.thin_stiffness),
        ):
            s.each_real(self.k.turn_stiffness, int(body.size), [size, body, w.frame_axes.real], [stiffness.real])

    def drag(self) -> None:
        """What damping does where a body turns."""
        s, m, r, w = self.shard, self.model, self.modes, self.shard.work
        tets, thin = int(m.tet_body.size), s.model.membranes
        given = [m.radius, w.frame_axes.real, w.x.real]
        inputs = [samples.TET, 0, r.tet_sample, m.tet_body, s.model.tet_node, *given, w.sample_stiffness.real]
        s.each_real(self.k_drag.drag_rows, tets, inputs, [w.drag_row.real])
        if thin is not None:
            inputs = [samples.TRI, tets, r.tri_sample, m.tri_body, thin.tri_node, *given, w.thin_stiffness.real]
            s.each_real(self.k_drag.drag_rows, int(m.tri_body.size), inputs, [w.drag_row.real])
        inputs = [r.wide_count, m.number, m.first_wide, m.moment_body, m.moment_start, r.body_stride]
        inputs += [r.body_tets, r.body_tris, r.tet_first, r.tri_first, r.tet_basis, r.tri_basis, w.drag_row.S]
        items = int(m.moment_body.size) if s.variant.world_fastest else self.count
        s.each(self.k_drag.drag_sums, items, inputs, [w.wide_drag.S, w.turning_drag.S])

    def tangent(self) -> None:
        """Blocks of A that the state changes."""
        s, m, w, i = self.shard, self.model, self.shard.work, self.shard.input
        inputs = [self.modes.wide_count, m.pair, m.pair_body, m.pair_mode, self.modes.pair_block, m.body, m.first]
        inputs += [m.modes, m.moment_start, m.radius, m.first_wide, w.body_mass.real, w.body_damping.real]
        inputs += [w.wide_drag.real, w.turning_drag.real, i["density"].real, i["mode_turn0"].real, i["mode_q0"].real]
        s.each_real(self.k_inertia.turning_tangent, int(m.pair.size), [*inputs, w.start_moment.real], [w.a.real])

    def turn_loads(self) -> None:
        """Forces on nodes in the frames."""
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [m.listed, m.listed_body, w.frame_axes.real]
        s.each_real(self.k.turn_loads, self.listed, inputs, [w.listed_force.real])

    def rigid_loads(self) -> None:
        """Forces on rigid modes."""
        s, m, w, i = self.shard, self.model, self.shard.work, self.shard.input
        inputs = [m.body, m.first_wide, m.listed_start, m.listed, self.modes.node, m.radius, m.volume]
        inputs += [i["density"].real, i["gravity"].real, w.x.real, w.frame_centre.real, w.node_external.real]
        s.each_real(self.k.rigid_loads, self.count, inputs, [w.wide_force.real])

    def momentum(self, moving: bool) -> None:
        """Add inertia that the state changes to b."""
        s, m, w, i = self.shard, self.model, self.shard.work, self.shard.input
        inputs = [self.modes.wide_count, m.body, m.first, m.modes, m.block, self.modes.mode_dof, m.moment_start]
        inputs += [m.radius, m.first_wide, w.body_mass.real, w.body_damping.real]
        inputs += [w.wide_drag.real, w.turning_drag.real, i["density"].real, i["mode_turn0"].real]
        inputs += [i["mode_q0"].real, i["mode_v0"].real, w.mode_v.real, w.start_moment.real, moving]
        s.each_real(self.k_inertia.turning_momentum, self.count, inputs, [w.b.real])

    def gradients(self) -> wp.array:
        """Gradients of rows by points, in the frames of the bodies that carry them."""
        s, w = self.shard, self.shard.work
        inputs = [self.model.point_body, w.frame_axes.real, w.point_gradient.real]
        s.each_real(self.k.turn_gradients, int(self.model.point_body.size), inputs, [w.turned_gradient.real])
        return w.turned_gradient.S

    def rows(self) -> None:
        """Rows of H on rigid modes."""
        s, m, r, w = self.shard, self.model, self.modes, self.shard.work
        inputs = [m.row, m.row_body, r.row_point, r.row_points, r.row_wide, m.point_body, m.radius]
        inputs += [w.frame_centre.real, w.point_x.real, w.point_gradient.real]
        s.each_real(self.k.rigid_rows, int(m.row.size), inputs, [w.wide_row.real])

    # The end of a step

    def turn_on(self, x_scale: float) -> None:
        """Frames and velocities at the end of a step, from the trial amplitudes and their velocities, wide ones too."""
        s, m, w, i = self.shard, self.model, self.shard.work, self.shard.input
        self._sum(w.wide_q, w.moment)
        self._sum(w.wide_v, w.moment_rate)
        inputs = [m.first, m.modes, m.block, self.modes.mode_dof, m.moment_start, m.radius, m.volume]
        inputs += [i["mode_turn0"].real, w.dof_v.real, i["mode_q0"].real, w.mode_q.real]
        inputs += [w.start_moment.real, w.moment.real, w.moment_rate.real, x_scale]
        s.each_real(self.k_inertia.turn_on, self.count, inputs, [w.mode_v.real, w.mode_turn.real])

    def _sum(self, wide: Rows, target: Rows) -> None:
        s, m = self.shard, self.model
        inputs = [m.moment_first, m.moment_wide, m.moment_stride, m.moments, wide.S]
        s.each(self.k_inertia.moments, int(m.moment_body.size), inputs, [target.S])
