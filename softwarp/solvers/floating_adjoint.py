"""Floating frames of reduced bodies in the adjoint of a step. Equations: docs/theory/adjoint.md."""

from __future__ import annotations

import numpy as np
import warp as wp

from softwarp.kernels.elements import adjoint as of_tets
from softwarp.kernels.elements import (
    floating_adjoint,
    floating_moment_adjoint,
    floating_pull,
    membrane_adjoint,
    samples,
)
from softwarp.model.floating import FloatingModel
from softwarp.model.gradients import Ends, Gradients
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.element_adjoint import TetAdjoint
from softwarp.solvers.membrane_adjoint import MembraneAdjoint
from softwarp.solvers.terms.floating import FloatingFrames
from softwarp.solvers.terms.reduction import ReductionTerm
from softwarp.solvers.workspace.rows import Rows, alias
from softwarp.solvers.workspace.shard import Shard


class Places:
    """Bodies as they are at one end of a step: amplitudes, frames, and all listed nodes.

    Args:
        shard: Worlds.
        term: Reduced bodies, with floating frames.
        model: These.
    """

    def __init__(self, shard: Shard, term: ReductionTerm, model: FloatingModel) -> None:
        self.shard, self.term, self.model = shard, term, model
        assert term.frames is not None
        self.frames: FloatingFrames = term.frames
        modes, nodes, m = term.model.count, shard.model.node_count, model
        self.q, self.v = shard.rows(modes), shard.rows(modes)
        self.turn, self.centre = shard.rows(4 * m.count), shard.rows(3 * m.count)
        self.wide_q, self.wide_v = shard.rows(term.model.wide_count), shard.rows(term.model.wide_count)
        self.x, self.node_v = shard.rows(3 * nodes), shard.rows(3 * nodes)

    def frame(self, x_scale: float) -> None:
        """Frames x_scale times the velocities after the start, from amplitudes there."""
        s, m, r = self.shard, self.model, self.term.model
        inputs = [m.first, m.block, r.mode_dof, m.centre, m.radius]
        inputs += [s.input["mode_turn0"].real, s.work.dof_v.real, x_scale]
        outputs = [self.q.real, self.turn.real, self.centre.real]
        s.each_real(self.frames.k.trial_frame, m.count, inputs, outputs)

    def widen(self) -> None:
        """Wide amplitudes, 1 of places at rest, and velocities."""
        s, r, k = self.shard, self.term.model, self.term.k
        for values, wide in ((self.q, self.wide_q), (self.v, self.wide_v)):
            s.each(k.widen, r.wide_count, [r.wide_mode, values.S], [wide.S])
        s.each_real(self.frames.k.at_rest, self.model.count, [self.model.first_wide], [self.wide_q.real])

    def place(self, *, moves: bool) -> None:
        """All listed nodes and, if it ``moves``, their velocities; needs ``widen``."""
        s, m, r, k = self.shard, self.model, self.term.model, self.frames.k
        self.term.place_both(r.node_rest, self.wide_q, self.wide_v, self.x, self.node_v)
        listed = [m.listed, m.listed_body, r.node]
        inputs = [int(r.node.size), *listed, self.turn.real, self.centre.real]
        s.each_real(k.place_nodes, int(m.listed.size), inputs, [self.x.real])
        if not moves:
            return
        inputs = [*listed, m.first, m.radius, self.turn.real, self.centre.real, self.v.real, self.x.real]
        s.each_real(k.node_velocities, int(m.listed.size), inputs, [self.node_v.real])


class FloatingAdjoint:
    """Floating frames of one shard.

    Args:
        shard: Worlds.
        term: Reduced bodies, with such frames.
        h: Step [s].
        gradients: Arrays of these worlds.

    Attributes:
        own_v, own_p: v and p of nodes as their elements feel them without turning.
        is_end_known: Whether what ``hold`` has been told of says where nodes are at the end of the step.
        touch_p, touch_v: What contacts have by p and v of the nodes that touch something, behind those of dofs.
    """

    def __init__(self, shard: Shard, term: ReductionTerm, h: float, gradients: Gradients) -> None:
        self.shard, self.term, self.h, self.gradients = shard, term, h, gradients
        assert term.model.floating is not None
        self.model: FloatingModel = term.model.floating
        m, nodes = self.model, shard.model.node_count
        self.k, self.k_pull = floating_adjoint.kernels(shard.variant), floating_pull.kernels(shard.variant)
        self.k_moment = floating_moment_adjoint.kernels(shard.variant)
        self.start, self.end = Places(shard, term, m), Places(shard, term, m)
        moments = 9 * int(m.moment_body.size)
        self.moment, self.rate = shard.rows(moments), shard.rows(moments)
        self.start_bar, self.end_bar, self.rate_bar = (shard.rows(moments) for _ in range(3))
        self.q0_bar, self.q1_bar, self.nothing = (shard.rows(term.model.count) for _ in range(3))
        self.turn_bar, self.rigid = shard.rows(3 * m.count), shard.rows(9 * m.count)
        self.arm, self.no_arm = (shard.rows(3 * int(term.model.node.size)) for _ in range(2))
        self.own_v, self.own_p = shard.rows(3 * nodes), shard.rows(3 * nodes)
        self.elastic, self.damped = (shard.rows(shard.model.body_count) for _ in range(2))
        self.corner = shard.rows(shard.work.element_force.real.shape[1])
        self.parameter: list[Rows] = []
        self.asks, self.placed = True, int(term.model.node.size)
        self.is_end_known = False
        self._ends: list[tuple[wp.array, Rows]] = []
        touch = np.full(int(term.model.node.size), -1)
        touch[term.model.touch_listed.numpy()] = np.arange(int(term.model.touch_listed.size))
        self.listed_touch = wp.array(touch, dtype=wp.int32, device=shard.device)
        self.touch_p, self.touch_v = (shard.rows(3 * shard.model.dof_room) for _ in range(2))

    def hold(self, ends: Ends) -> None:
        """Nodes at the end of a step are in ``ends`` wherever ``is_end_known``."""
        self._ends = [(ends.node_x, self.end.x), (ends.node_v, self.end.node_v)]

    def _take_ends(self, *, moves: bool) -> None:
        s = self.shard
        for array, target in self._ends if moves else self._ends[:1]:
            if s.variant.lanes > 1:
                inputs = [array, s.world_count, s.lanes]
                s.each_real(s.k_state.interleave, None, inputs, [target.real])
            else:
                target.copy_from(alias(s.variant, array))

    def find_places(self, *, arrives: bool, moves: bool = True) -> None:
        """Where all nodes were and are; needs the solution of the step.

        Args:
            arrives: Whether bodies turn on as at the end of a step, with their momentum, and not as in a look ahead.
            moves: Whether velocities of nodes at the end matter.
        """
        s, m, r, i, w = self.shard, self.model, self.term.model, self.shard.input, self.shard.work
        start, end, k = self.start, self.end, self.start.frames.k_inertia
        start.q.copy_from(i["mode_q0"])
        start.v.copy_from(i["mode_v0"])
        start.frame(0.0)
        start.x.copy_from(i["x0"])  # a step has placed them
        start.node_v.copy_from(i["v0"])
        inputs = [r.mode_dof, i["mode_q0"].S, w.dof_v.S, self.h]
        s.each(self.term.k.trial_amplitude, r.count // 3, inputs, [end.q.S, end.v.S])
        end.frame(self.h)
        end.widen()
        if not arrives:
            end.place(moves=moves)
            return
        for wide, target in ((end.wide_q, self.moment), (end.wide_v, self.rate)):
            inputs = [m.moment_first, m.moment_wide, m.moment_stride, m.moments, wide.S]
            s.each(k.moments, int(m.moment_body.size), inputs, [target.S])
        outputs = [end.v.real, end.turn.real]
        s.each_real(k.turn_on, m.count, [*self._motion(), *self._moments(), self.h], outputs)
        if self.is_end_known:
            self._take_ends(moves=moves)
            return
        end.widen()
        end.place(moves=moves)

    def _motion(self) -> list[wp.array]:
        m, i, w = self.model, self.shard.input, self.shard.work
        inputs = [m.first, m.modes, m.block, self.term.model.mode_dof, m.moment_start, m.radius, m.volume]
        return [*inputs, i["mode_turn0"].real, w.dof_v.real, i["mode_q0"].real, self.end.q.real]

    def _moments(self) -> list[wp.array]:
        return [self.shard.work.start_moment.real, self.moment.real, self.rate.real]

    def take_turns(self) -> None:
        """Gradients by turns at the end of the step."""
        s, outputs = self.shard, [self.gradients.mode_turn, self.turn_bar.real]
        s.each_real(self.k.take_turns, self.model.count, [s.lanes, self.end.turn.real], outputs)

    def turn_bars(self, by_x: Rows, by_v: Rows | None, *, at_end: bool) -> None:
        """Gradients by listed nodes go to the axes of their bodies; what is of the frames is kept aside.

        Args:
            by_x: Gradients by places.
            by_v: By velocities; None where there are none.
            at_end: Whether nodes are those of the end of the step.
        """
        s, m, at = self.shard, self.model, self.end if at_end else self.start
        arm = self.no_arm if at_end else self.arm
        inputs = [m.listed_start, m.listed, self.term.model.node]
        if by_v is None:
            inputs += [at.turn.real, at.centre.real, at.x.real, arm.real]
            s.each_real(self.k.place_bars, m.count, inputs, [by_x.real, self.rigid.real, self.turn_bar.real])
            return
        inputs += [m.first, m.radius, at.turn.real, at.centre.real, at.x.real, at.node_v.real, at.v.real, arm.real]
        outputs = [by_x.real, by_v.real, self.rigid.real, self.turn_bar.real]
        s.each_real(self.k.node_bars, m.count, inputs, outputs)

    def rigid_bars(self, wide: Rows, *, by_velocities: bool) -> None:
        """That is told in the places of rigid modes."""
        inputs = [by_velocities, self.model.first_wide, self.rigid.real]
        self.shard.each_real(self.k.rigid_bars, self.model.count, inputs, [wide.real])

    def turn_back(self) -> None:
        """Gradients by what the end of the step has made of the unknowns become those by these; needs ``turn_bars``."""
        s, m, g = self.shard, self.model, self.gradients
        motion = self._motion()
        inputs = [s.lanes, *motion[:5], m.moment_stride, *motion[5:], *self._moments(), self.h]
        outputs = [g.mode_q, g.mode_v, self.turn_bar.real, self.start_bar.real, self.end_bar.real, self.rate_bar.real]
        s.each_real(self.k.turn_back, m.count, inputs, [*outputs, self.q0_bar.real, self.q1_bar.real])
        self._of_moments(self.end_bar, self.q1_bar, g.mode_q)
        self._of_moments(self.rate_bar, self.nothing, g.mode_v)

    def look_back(self) -> None:
        """Likewise, of what contacts look at where a solution leads to."""
        s, m, g = self.shard, self.model, self.gradients
        self.start_bar.zero()
        self.q0_bar.zero()
        inputs = [s.lanes, m.first, m.block, self.term.model.mode_dof, m.radius, s.work.dof_v.real, self.h]
        s.each_real(self.k.trial_back, m.count, inputs, [g.mode_q, g.mode_v, self.turn_bar.real])

    def _of_moments(self, moment_bar: Rows, mode_bar: Rows, bar: wp.array) -> None:
        s, m = self.shard, self.model
        if not s.variant.world_fastest:
            inputs = [s.lanes, m.moment_start, m.moment_first, m.moment_stride, m.moments, m.first, m.modes]
            s.each_real(self.k_moment.body_moment_bars, m.count, [*inputs, moment_bar.real, mode_bar.real], [bar])
            return
        inputs = [s.lanes, m.moment_body, m.moment_start, m.moment_first, m.moment_stride, m.moments]
        inputs += [m.first, m.modes, moment_bar.real, mode_bar.real]
        s.each_real(self.k_moment.moment_bars, int(m.moment_body.size), inputs, [bar])

    def place(self, p: Rows, node_v: Rows, node_p: Rows, count: int) -> None:
        """Velocities and p of the first ``count`` listed nodes, from what modes have in the axes of their bodies."""
        s, m, at = self.shard, self.model, self.start
        self.own_v.copy_from(node_v)
        self.own_p.copy_from(node_p)
        self.placed = count
        inputs = [count, m.listed, m.listed_body, self.term.model.node, m.block, self.term.model.mode_dof, m.radius]
        inputs += [at.turn.real, at.centre.real, at.x.real, s.work.dof_v.real, p.real]
        outputs = [self.own_v.real, self.own_p.real, node_v.real, node_p.real]
        s.each_real(self.k.turn_fields, s.variant.parts(int(m.listed.size)), inputs, outputs)

    def pull(
        self,
        tets: TetAdjoint | None,
        skin: MembraneAdjoint | None,
        node_v: Rows,
        node_p: Rows,
        p: Rows,
        corner: Rows,
        *,
        parameters: bool,
    ) -> None:
        """Elements, which feel turning by their damping alone.

        Args:
            tets: Linear tetrahedra.
            skin: Membranes.
            node_v: What elements have in the place of velocities of nodes; ``own_v`` is that without turning.
            node_p: Their p.
            p: That of dofs.
            corner: Receives gradients by corners.
            parameters: Whether those by parameters are asked for.
        """
        s, m, r, w, k = self.shard, self.model, self.term.model, self.shard.work, self.k_pull
        inputs, outputs = [w.body_stiffness.real, w.body_damping.real], [self.elastic.real, self.damped.real]
        s.each_real(k.split_stiffness, s.model.body_count, inputs, outputs)
        self.asks = parameters
        held: list[tuple[Rows, int, int]] = []
        if tets is not None and parameters:
            held.append((tets.parameter, of_tets.ROWS, of_tets.PARAMETERS))
        if skin is not None and parameters:
            held.append((skin.parameter, membrane_adjoint.PARAMETERS, 2))
        if len(self.parameter) < len(held):
            self.parameter = [s.rows(part.real.shape[1]) for part, _, _ in held]
        for v, along, stiffness, h, target in (
            (self.own_v, self.own_p, self.elastic, self.h, self.corner),
            (node_v, node_p, self.damped, 0.0, corner),
        ):
            if tets is not None:
                tets.pull(v, along, stiffness, h, target, parameters=parameters)
            if skin is not None:
                skin.pull(v, along, stiffness, h, target)
            if h > 0.0:
                for (part, _, _), room in zip(held, self.parameter, strict=False):
                    room.copy_from(part)
        s.add(self.corner, corner, corner.real.shape[1])
        for (part, size, omit), room in zip(held, self.parameter, strict=False):
            s.each_real(k.join, part.real.shape[1], [size, omit, room.real], [part.real])
        given = [m.block, r.mode_dof, m.radius, w.body_damping.real]
        given += [node_v.real, node_p.real, w.dof_v.real, p.real]
        if tets is not None:
            inputs = [samples.TET, 0, r.tet_sample, m.tet_body, s.model.tet_node, s.model.tet_body, *given]
            s.each_real(k.drag_bars, int(m.tet_body.size), [*inputs, w.sample_stiffness.real], [corner.real])
        if skin is not None:
            thin = skin.model
            inputs = [samples.TRI, s.model.tet_count, r.tri_sample, m.tri_body, thin.tri_node, thin.element_body]
            inputs += [*given, w.thin_stiffness.real]
            s.each_real(k.drag_bars, int(m.tri_body.size), inputs, [corner.real])

    def to_state(self, index: AdjointIndex, p: Rows, wide_p: Rows, q: Rows, corner: Rows) -> None:
        """Gradients by velocities, turns and arms at the start, by density, Rayleigh's alpha and gravity.

        Args:
            index: Of the model.
            p: Adjoint of the velocities of dofs.
            wide_p: Of wide modes.
            q: That of rows.
            corner: Gradients by corners of elements.
        """
        s, m, r, at = self.shard, self.model, self.term.model, self.start
        i, w, g = s.input, s.work, self.gradients
        inputs = [
            r.wide_count,
            self.h,
            s.lanes,
            self.asks,
            m.body,
            m.first,
            m.modes,
            m.block,
            r.mode_dof,
            m.moment_start,
        ]
        inputs += [m.first_wide, m.radius, m.volume, w.body_mass.real, w.body_damping.real, w.wide_drag.real]
        inputs += [w.turning_drag.real, i["density"].real, i["gravity"].real, i["mode_turn0"].real, i["mode_q0"].real]
        inputs += [i["mode_v0"].real, w.dof_v.real, p.real, w.start_moment.real]
        outputs = [g.mode_v, g.density, g.rayleigh_mass, g.gravity]
        outputs += [self.turn_bar.real, self.start_bar.real, self.q0_bar.real]
        s.each_real(self.k_pull.turning_bars, None, inputs, outputs)
        points = [index.node_point_start, index.node_point, index.node_point_weight]
        inputs = [self.h, s.model.dof_count, self.placed, m.listed_start, m.listed, self.listed_touch]
        inputs += [r.node, m.block, r.mode_dof, m.radius, *points, index.point_row]
        inputs += [s.model.corner_start, s.model.corner, r.node_body, r.node_basis, r.body_wide, r.body_stride, r.basis]
        inputs += [at.turn.real, wide_p.real, at.centre.real, at.x.real]
        inputs += [self.own_v.real, self.own_p.real, w.dof_v.real, p.real]
        inputs += [w.point_gradient.real, w.multiplier.real, q.real, w.node_external.real, corner.real]
        inputs += [self.touch_p.real, self.touch_v.real]
        s.each_real(self.k_pull.arm_bars, m.count, inputs, [self.arm.real, self.turn_bar.real])

    def finish(self) -> None:
        """Gradients by amplitudes that inertia has, and by quaternions, at the start; nodes are taken over before."""
        s, g = self.shard, self.gradients
        self._of_moments(self.start_bar, self.q0_bar, g.mode_q)
        inputs = [s.lanes, self.start.turn.real, self.turn_bar.real]
        s.each_real(self.k.give_turns, self.model.count, inputs, [g.mode_turn])

    def forget(self) -> None:
        """What has been told to the start of the step does not count again, for another solution of it."""
        for bar in (self.turn_bar, self.start_bar, self.q0_bar):
            bar.zero()
