"""Joints in the adjoint of a step: solutions one after the other, pulled back from the last to the first.

A step with joints solves its linear system several times, with rows linearised about the velocities of the solution
before, and lets momentum keep a part of the last one only. All solutions have the same matrix and the same rows, so
that each has the adjoint of a step without joints. Equations: docs/theory/adjoint.md.
"""

from __future__ import annotations

from dataclasses import fields
from functools import partial

import warp as wp

from softwarp.kernels.frames import gyration_adjoint
from softwarp.kernels.rows import joint_adjoint
from softwarp.model.gradients import FLOATING, FRAMES, JOINTS, MEMORIES, MODES, STATE, Gradients
from softwarp.solvers.adjoint import StepAdjoint
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.frame_adjoint import FrameAdjoint
from softwarp.solvers.joint_sides import JointSides
from softwarp.solvers.leaning_adjoint import LeaningFrames
from softwarp.solvers.system import System
from softwarp.solvers.terms.joints import JointTerm
from softwarp.solvers.terms.term import Pace
from softwarp.solvers.workspace.rows import Rows, allocate

SHARE, TAKEN, GIVEN, WHOLE = 0, 1, 2, -1  # rows of ``gyration_adjoint.shares``; 1


class JointStepAdjoint(StepAdjoint):
    """Adjoint of a step of a scene with joints; see ``StepAdjoint``.

    Args:
        system: Worlds.
        h: Step [s].
        gradients: Arrays of these worlds.
        index: Of the model.
        pace: What it does of the commands, where it is a stage of a longer step.
        rest: Whether gradients by the rest shape are asked for.
    """

    def __init__(
        self,
        system: System,
        h: float,
        gradients: Gradients,
        index: AdjointIndex,
        pace: Pace | None = None,
        *,
        rest: bool = False,
    ) -> None:
        super().__init__(system, h, gradients, index, rest=rest)
        if pace is not None:
            self.pace, self.lapse = pace, pace.lapse
        assert self.frames is not None
        joints = next(term for term in system.terms if isinstance(term, JointTerm))
        self.joints = JointAdjoint(self, joints, self.frames)

    @property
    def solution(self) -> list[wp.array]:
        """As of ``StepAdjoint``, with all solutions of the step."""
        kept = super().solution
        if self.leaning is not None and self.system.options.refinement == 0:  # else it is there
            kept.append(self.system.work.a.real)
        return [*kept, *self.joints.solution]

    def solve_again(self) -> None:
        """As of ``StepAdjoint``; another stage of the same worlds may have watched the last solve."""
        self.system.watch = self.joints.keep
        super().solve_again()

    def pull(self, *, parameters: bool = True) -> None:
        """As of ``StepAdjoint``."""
        self.joints.pull(parameters=parameters)


class JointAdjoint(JointSides):
    """Gradients through the solutions of one system with joints.

    Args:
        owner: Adjoint of one solution, of the same system.
        term: Joints.
        frames: Adjoint of frames, whose velocities are split here.

    Attributes:
        solution: What a step leaves of all its solutions.
    """

    def __init__(self, owner: StepAdjoint, term: JointTerm, frames: FrameAdjoint) -> None:
        super().__init__(owner.shard, term, frames)
        self.owner, s = owner, owner.shard
        self.h, self.last = owner.h, owner.system.passes
        self.k, self.k_free = joint_adjoint.kernels(s.variant), gyration_adjoint.kernels(s.variant)
        dofs, rows, turning = 3 * s.model.dof_room, s.model.row_count, 6 * max(term.gyrating, 1)
        self.u, self.force, self.differences = (
            [s.rows(count) for _ in range(1 + self.last)] for count in (dofs, rows, turning)
        )
        self.contact = owner.contact
        held = [self.u, self.force, self.differences]
        if self.contact is not None:
            self.contact_force = [s.rows(3 * self.contact.contacts.capacity) for _ in range(1 + self.last)]
            self.contact.knows_way, self.contact.drops_open = True, False
            held.append(self.contact_force)
        self.solution = [part.real for parts in held for part in parts]
        owner.system.watch = self.keep
        self._allocate(dofs, rows)
        frames.end_v = self.end_v
        if not isinstance(frames, LeaningFrames):
            frames.inertial_v = self.inertial_v
        if owner.leaning is not None:
            owner.leaning.multiply = self._multiply
        g = owner.gradients
        names = [
            *STATE,
            *FRAMES,
            *JOINTS,
            *MEMORIES,
            *MODES,
            *FLOATING,
            *(f.name for f in fields(g) if f.name.startswith("command_")),
        ]
        parts = [getattr(g, name) for name in names]
        self.sums = [(part, wp.zeros(part.shape, dtype=part.dtype, device=s.device)) for part in parts if part.size]

    def _allocate(self, dofs: int, rows: int) -> None:
        s, frames, term = self.shard, 6 * self.frames.model.count, self.term
        self.end_v, self.inertial_v, self.response, self.needed_response = (s.rows(dofs) for _ in range(4))
        self.p_kept = s.rows(dofs)
        self.seed, self.seed_kept, self.still, self.against = (s.rows(3 * s.model.dof_count) for _ in range(4))
        self.known, self.other, self.twist, self.p_frame, self.drift = (s.rows(frames) for _ in range(5))
        self.free = s.rows(frames)
        self.known_bar, self.bar, self.bar_before, self.place, self.velocity_bar = (s.rows(frames) for _ in range(5))
        self.unused, self.none = s.rows(frames), s.rows(frames)
        self.correction, self.needed, self.gap, self.needed_gap, self.q_kept, self.passed = (
            s.rows(rows) for _ in range(6)
        )
        self.softness, self.no_force = s.rows(rows), s.rows(rows)
        self.share = s.rows(gyration_adjoint.SHARES)
        self.side = s.rows(joint_adjoint.SIDES * max(term.model.rows, 1))
        self.coordinate, self.no_coordinate = (s.rows(max(term.model.count, 1)) for _ in range(2))
        self.mode = allocate(s.variant, s.world_count, max(term.model.rows, 1), s.device, wp.int32)
        self.nothing_moved = s.rows(self.frames.moved.real.shape[1])

    def keep(self, number: int) -> None:
        """Keep the solution of one pass of a step."""
        w = self.shard.work
        self.u[number].copy_from(w.u)
        self.force[number].copy_from(w.multiplier)
        if self.contact is not None:
            self.contact_force[number].copy_from(self.contact.contacts.multiplier)
        if self.term.gyrating:
            self.differences[number].copy_from(w.gyration)

    def pull(self, *, parameters: bool) -> None:
        """Gradients by the end of the step become those by its start.

        The last solution comes before the one that momentum is projected to, which has the commands' forces from it.
        """
        owner, w, last = self.owner, self.shard.work, self.last
        self.softness.copy_from(w.compliance)
        for bars in (self.known_bar, self.bar, self.bar_before, self.place, self.velocity_bar):
            bars.zero()
        self._begin_sides()
        self._find_corrections()
        self._seed()
        self._project()
        self._pull_last(parameters=parameters)
        self._pull_energies(parameters=parameters)
        self._pull_projected(parameters=parameters)
        for number in reversed(range(last)):
            self._pull_earlier(number, parameters=parameters)
        w.compliance.copy_from(self.softness)
        self._collect(sets=True)
        owner.force.zero()

    # Solutions

    def _begin_sides(self) -> None:
        """Half-solved sides of all rows, and W."""
        owner, s, m, h = self.owner, self.shard, self.shard.model, self.h
        y = owner.system.linear.y
        y.zero()
        owner.system.rows.into_sides()
        if self.contact is not None:
            self.contact.begin(self.u[self.last])
        owner.system.linear.forward(1 + m.row_count)
        if self.contact is not None:
            self.contact.laws.delassus(y, h * h, whole=True)
        inputs = [m.dof_count, m.row_count, owner.index.row_pair, y.S, h * h]
        s.each(owner.system.rows.k.delassus, len(owner.index.row_pair), inputs, [owner.delassus.S])

    def _find_corrections(self) -> None:
        """What velocities that close gaps, and those that remove H v0, are: multipliers and responses."""
        w, h = self.shard.work, self.h
        self._look_from(self.last)
        if self.term.gyrating:
            w.gyration.copy_from(self.differences[self.last])
        self.term._measure_gap(h)
        self._respond(w.joint_gap, -1.0, self.gap, self.correction, self.response)
        self._respond(w.joint_speed, h, self.needed_gap, self.needed, self.needed_response)
        self._find_shares(self.still)
        self.end_v.copy_from(self.u[self.last])
        self._add(SHARE, -1.0, self.response, self.end_v)
        self._take(self.last, self.end_v)
        w.dof_v.copy_from(self.u[self.last])
        self._spread(self.last, self.drift)

    def _respond(self, value: Rows, factor: float, gap: Rows, multiplier: Rows, response: Rows) -> None:
        """Multipliers of rows without bounds that make up for a gap, and the velocities A^-1 h H' of these."""
        owner, s, m = self.owner, self.shard, self.shard.model
        self._hold(value, factor, gap)
        multiplier.zero()
        inputs = [m.row_count, owner.delassus.real, self.softness.real, owner.active.real, gap.real]
        outputs = [owner.factor.real, owner.change.real, multiplier.real]
        s.each_real(owner.k_rows.solve, None, inputs, outputs)
        owner.p.zero()
        self._clear_side()
        inputs = [m.dof_count, m.row_count, multiplier.S, self.h]
        s.each(owner.system.rows.k.add_change, s.variant.parts(s.dof_rows), inputs, [owner.system.linear.y.S])
        owner.add_solution()
        response.copy_from(owner.p)

    def _hold(self, value: Rows, factor: float, gap: Rows) -> None:
        s, m = self.shard, self.term.model
        inputs = [self.term.first_row, s.model.row_count, m.row_kind, self.is_held, value.real, factor]
        s.each_real(self.k_free.held_gaps, None, inputs, [gap.real, self.owner.active.real])

    def _clear_side(self) -> None:
        """Right-hand side 0 becomes 0."""
        s, m, w, system = self.shard, self.shard.model, self.shard.work, self.owner.system
        inputs = [m.neighbour_start, m.neighbour, m.neighbour_block, w.a.S, self.still.S, self.still.S]
        s.each(system.k.residual, s.variant.parts(m.dof_count), inputs, [system.linear.y.S])

    def _find_shares(self, kept_bar: Rows) -> None:
        inputs = [self.shard.model.row_count, self.needed_gap.real, self.needed.real, self.gap.real]
        inputs += [self.correction.real, self.response.real, kept_bar.real]
        self.shard.each_real(self.k_free.shares, None, inputs, [self.share.real])

    def _solve(self, seed: Rows) -> None:
        """p, q and z of a seed and of what ``owner.force`` and ``contact.force`` have, with rows that are active."""
        owner = self.owner
        owner.seed.copy_from(seed)
        owner.p.zero()
        owner.q.zero()
        for correction in range(1 + owner.system.options.refinement):
            owner.solve(1 + correction)
        if self.contact is not None:
            self.contact.find_way(owner.p, self.contact.way)

    def _find_modes(self) -> None:
        """States of contacts in the solution that is in place."""
        if self.contact is not None:
            self.contact.begin(self.shard.work.dof_v, first=False)

    def _give_forces(self) -> None:
        """Contacts keep their forces where rows with bounds do: no z, and nothing by friction."""
        if self.contact is not None:
            self.contact.z.zero()
            self.contact.way.zero()

    # Gradients

    def _seed(self) -> None:
        """Gradients by the last solution, by the velocities that momentum is projected to, and by differences."""
        owner, s, m, g, frames = self.owner, self.shard, self.shard.model, self.owner.gradients, self.frames
        parts, y = s.variant.parts(m.dof_count), owner.system.linear.y.real
        scalars = [self.h, s.lanes, m.dof_node, m.dof_free]
        nothing = self._zeros(g.node_x)
        s.each_real(owner.k.seed, parts, [*scalars, nothing, g.node_v], [frames.kept.real, y])
        s.each_real(owner.k.seed, parts, [*scalars, g.node_x, nothing], [self.seed.real, y])
        if owner.modes is not None:  # which keep the velocities that they move with
            owner.modes.seed(self.seed, owner.system.linear.y, arrives=True)
        frames.seed(self.seed, owner.system.linear.y)
        if owner.leaning is not None:
            owner.leaning.seed(self.seed, owner.system.linear.y)
        self._find_shares(frames.kept)
        self.seed_kept.zero()
        self._add(SHARE, 1.0, frames.kept, self.seed_kept)
        self._add(WHOLE, 1.0, frames.kept, self.seed)
        self._add(WHOLE, -1.0, self.seed_kept, self.seed)
        self._to_frames(frames.kept, self.twist)
        self._add(WHOLE, -1.0, self.twist, self.bar)

    def _project(self) -> None:
        """p and q of the velocities that momentum is projected to; what is passed to forces of the last solution."""
        owner, w = self.owner, self.shard.work
        self._hold(w.joint_gap, 0.0, owner.change)
        w.compliance.copy_from(self.softness)
        owner.force.zero()
        if self.contact is not None:
            self.contact.force.zero()
            self.contact.mode.zero()  # none that responds
            self.contact.z.zero()
        self._solve(self.seed_kept)
        owner.find_bounds(self.passed)
        if self.contact is not None:  # forces of the last solution push here too
            self.contact.force.copy_from(self.contact.way)
        self.p_kept.copy_from(owner.p)
        self.q_kept.copy_from(owner.q)
        self._add(GIVEN, 1.0, self.response, self.p_kept)

    def _pull_last(self, *, parameters: bool) -> None:
        """Gradients by the last solution."""
        owner, w, last = self.owner, self.shard.work, self.last
        self._place(last)
        owner.seed_forces()
        self._add(WHOLE, 1.0, self.passed, owner.force)
        self._find_states()
        self._find_modes()
        self._solve(self.seed)
        owner.to_commands()
        self._to_motors()
        self._add(GIVEN, -1.0, self.response, owner.p)
        self._add(TAKEN, 1.0, self.needed_response, owner.p)
        self._to_frames(w.dof_v, self.twist)
        self._pull(last, parameters=parameters, ends=True)

    def _pull_energies(self, *, parameters: bool) -> None:
        """Gradients by the energies that the share depends on, beyond what both solutions have of them."""
        owner, s, w, m, g = self.owner, self.shard, self.shard.work, self.term.model, self.owner.gradients
        inputs = [self.term.first_row, s.lanes, GIVEN, TAKEN, self.h, m.joint_row_start, m.row_kind, m.joint_control]
        inputs += [m.joint_scale, s.input["joint_stiffness"].real, s.input["joint_damping"].real, self.share.real]
        inputs += [self.correction.real, self.needed.real]
        s.each_real(self.k.energies, m.count, inputs, [g.joint_stiffness, g.joint_damping])
        owner.q.zero()
        self._add(GIVEN, 2.0, self.correction, owner.q)
        self._to_frames(self.response, self.twist)
        self.free.zero()
        self._add(WHOLE, 0.5, self.twist, self.free)
        self.other.copy_from(self.free)
        self._add(WHOLE, 1.0, self.drift, self.other)
        self.unused.zero()
        rows = [self.known, self.none, self.other, self.free, self.none, self.no_force, owner.q]
        bars = [self.place, self.bar, self.known_bar, self.unused]
        self._of_rows(rows, self.no_coordinate, bars, weighs=True)
        owner.q.zero()
        self._add(TAKEN, -2.0, self.needed, owner.q)
        self._to_frames(self.needed_response, self.other)
        self.free.zero()
        self._add(WHOLE, -1.0, self.other, self.free)
        rows = [self.none, self.other, s.input["twist0"], self.free, self.none, self.no_force, owner.q]
        bars = [self.place, self.velocity_bar, self.unused, self.unused]
        self._of_rows(rows, self.no_coordinate, bars, projects=True, weighs=True)
        owner.q.zero()
        owner.p.zero()
        self._add(TAKEN, -1.0, self.needed_response, owner.p)
        self._add(WHOLE, 1.0, self.needed_response, w.dof_v)
        self._to_frames(w.dof_v, self.twist)
        owner.to_commands(follows=False)
        self.coordinate.zero()
        self._give_forces()
        self._pull(self.last, parameters=parameters)

    def _pull_projected(self, *, parameters: bool) -> None:
        """Gradients by the velocities that momentum is projected to."""
        owner, w, last = self.owner, self.shard.work, self.last
        self._place(last)
        self._add(WHOLE, -1.0, self.response, w.dof_v)
        self._add(WHOLE, -1.0, self.correction, w.multiplier)
        owner.p.copy_from(self.p_kept)
        owner.q.copy_from(self.q_kept)
        owner.bound.zero()
        self._find_states(projects=True)
        self._to_frames(w.dof_v, self.twist)
        owner.to_commands(follows=False)
        self._to_motors()
        self._give_forces()
        self._pull(last, parameters=parameters, projects=True, closes=True)

    def _pull_earlier(self, number: int, *, parameters: bool) -> None:
        """Gradients by a solution that the next one is linearised about."""
        owner, s, m = self.owner, self.shard, self.frames.model
        self._look_from(number)
        self.seed.zero()
        s.each_real(
            self.k_free.to_dofs, m.count, [m.frame_dof, s.model.dof_free, self.known_bar.real], [self.seed.real]
        )
        self.other.copy_from(self.known_bar)
        self.known_bar.zero()
        self._place(number)
        owner.force.zero()
        self._find_states()
        if self.contact is not None:
            self.contact.force.zero()
        self._find_modes()
        self._solve(self.seed)
        owner.to_commands()
        self._to_motors()
        self._to_frames(s.work.dof_v, self.twist)
        self._pull(number, parameters=parameters, closes=True, bare=self.other)

    def _pull(
        self,
        number: int,
        *,
        parameters: bool,
        projects: bool = False,
        ends: bool = False,
        closes: bool = False,
        bare: Rows | None = None,
    ) -> None:
        """Add the gradients that one solution has, whose velocities, forces, p and q are in place.

        Args:
            number: Of the solution.
            parameters: Whether those by parameters are asked for.
            projects: Whether it has the velocities that momentum is projected to.
            ends: Whether it moves what there is.
            closes: Whether it is the last one with its differences and what it is linearised about.
            bare: Gradients by velocities of kinematic bodies that it passes on.
        """
        owner, s, w, frames = self.owner, self.shard, self.shard.work, self.frames
        self.inertial_v.copy_from(w.dof_v)
        self._take(number, self.inertial_v)
        if isinstance(frames, LeaningFrames):
            frames.differences = partial(self._take, number)
        own = frames.start, frames.moved, frames.bare
        if not ends:
            frames.start, frames.moved, frames.bare = self.place, self.nothing_moved, self.none
            if bare is not None:
                frames.bare = bare
        held = frames.bare
        self._to_frames(owner.p, self.p_frame)
        self.unused.zero()
        rows = [self.known, self.drift, self.twist, self.none, self.p_frame, w.multiplier, owner.q]
        bars = [self.place, self.unused, self.known_bar, self.bar]
        self._of_rows(rows, self.coordinate, bars, projects=projects)
        self._add(WHOLE, 1.0, self.unused, held)
        g, f = self.term.model.gyrating_frame, frames.model
        inputs = [g, f.frame_dof, s.input["pose0"].real, w.compound.real, owner.p.real]
        s.each_real(self.k_free.momenta, self.term.gyrating, inputs, [self.bar.real])
        if closes:
            self._close(number)
        if ends:
            self._add(WHOLE, 1.0, self.place, frames.start)
        owner.to_start(parameters=parameters)
        if owner.modes is not None and owner.modes.frames is not None:
            owner.modes.frames.forget()
        frames.start, frames.moved, frames.bare = own
        self.place.zero()
        if held is self.none:
            self.none.zero()
        if closes and number == 0:
            self._to_start_twists()
        self._collect()

    def _close(self, number: int) -> None:
        """Gradients by the differences of a solution go to what they were found from."""
        s, w = self.shard, self.shard.work
        inputs = [self.h, self.term.model.gyrating_frame, s.input["pose0"].real, w.compound.real, self.known.real]
        before = self.drift
        if number:
            self._spread(number - 1, before)
        else:
            before.zero()
        self.bar_before.zero()
        outputs = [self.known_bar.real, self.bar_before.real, self.place.real, self.frames.share.real]
        s.each_real(self.k_free.spins, self.term.gyrating, [*inputs, before.real, self.bar.real], outputs)
        self.bar.copy_from(self.bar_before)

    def _to_start_twists(self) -> None:
        """Gradients by the twists at the start that the first solution is linearised about."""
        s, g = self.shard, self.owner.gradients
        for bars in (self.known_bar, self.velocity_bar):
            s.each_real(self.k_free.add_state, g.frame_twist.shape[1], [s.lanes, bars.real], [g.frame_twist])

    def _of_rows(
        self,
        rows: list[Rows],
        coordinate: Rows,
        bars: list[Rows],
        *,
        projects: bool = False,
        weighs: bool = False,
    ) -> None:
        """Add to bars of places, velocities, linearised velocities and differences of frames what rows have.

        Args:
            rows: Twists that rows are linearised about, differences, twists, those of free coordinates where energies
                are weighed, p, forces and q.
            coordinate: Gradients by the joints' coordinates at the start.
            bars: Receive.
            projects: As of ``_pull``.
            weighs: Whether it is the energy of a correction that depends on the rows.
        """
        s, m = self.shard, self.term.model
        inputs = [self.term.first_row, projects, weighs, self.h, m.row_joint, m.row_kind, m.row_axis, self.joint_frame]
        inputs += [self.joint_place, m.joint_free, m.joint_length, s.input["pose0"].real]
        inputs += [*(part.real for part in rows), coordinate.real]
        s.each_real(self.k.rows_adjoint, m.rows, inputs, [self.side.real])
        inputs = [projects, weighs, *self.sides, m.row_kind, self.side.real]
        s.each_real(self.k.gather, self.frames.model.count, inputs, [bar.real for bar in bars])

    def _to_motors(self) -> None:
        """Gradients by commands, and by the coordinates that they count from."""
        owner, s, m, i, g = self.owner, self.shard, self.term.model, self.shard.input, self.owner.gradients
        inputs = [self.term.first_row, s.lanes, s.options.recovery_speed, self.h, owner.lapse]
        inputs += [m.joint_row_start, m.row_kind, m.joint_control, m.joint_scale]
        inputs += [i[f"command_joint_{name}"].real for name in ("target", "force")]
        names = ("stiffness", "damping", "max_force", "max_rate", "min_position", "max_position")
        inputs += [i[f"joint_{name}"].real for name in names]
        inputs += [s.work.joint_position.real, i["joint_reference"].real, s.work.lag.real]
        inputs += [self.mode.real, owner.q.real, owner.bound.real, s.work.multiplier.real]
        outputs = [g.joint_reference, g.command_joint_target, g.command_joint_force]
        outputs += [g.joint_stiffness, g.joint_damping, self.coordinate.real]
        s.each_real(self.k.commands, m.count, inputs, outputs)

    # Velocities and states

    def _place(self, number: int) -> None:
        """Velocities and forces of one solution."""
        w = self.shard.work
        w.dof_v.copy_from(self.u[number])
        w.multiplier.copy_from(self.force[number])
        if self.contact is not None:
            self.contact.contacts.multiplier.copy_from(self.contact_force[number])
        self._spread(number, self.drift)

    def _look_from(self, number: int) -> None:
        """Gaps of the rows of one solution, linearised about the velocities of the one before, or of the start."""
        if number:
            self._to_frames(self.u[number - 1], self.known)
        else:
            self.known.copy_from(self.shard.input["twist0"])
        self.term._predict(self.known, self.h, self.shard.work.joint_other_speed)

    def _find_states(self, *, projects: bool = False) -> None:
        """Which rows are active, and which are stopped by limits."""
        owner, s, m, w = self.owner, self.shard, self.shard.model, self.shard.work
        w.compliance.copy_from(self.softness)
        if projects:
            self._hold(w.joint_gap, 0.0, owner.change)
        else:
            owner.find_activity()
        inputs = [self.term.first_row, projects, self.h, m.row_entry_start, m.entry_dof, self.is_held]
        inputs += [w.displacement.real, w.row.real, w.dof_v.real, w.target.real, w.lower_bound.real]
        inputs += [w.upper_bound.real, self.softness.real, w.multiplier.real]
        outputs = [owner.active.real, w.compliance.real, self.mode.real]
        s.each_real(self.k.row_states, self.term.model.rows, inputs, outputs)

    def _spread(self, number: int, twist: Rows) -> None:
        """Differences of one solution among the twists of all frames."""
        twist.zero()
        inputs = [self.term.model.gyrating_frame, self.differences[number].real]
        self.shard.each_real(self.term.k_turn.spread_difference, self.term.gyrating, inputs, [twist.real])

    def _take(self, number: int, v: Rows) -> None:
        """Velocities without the differences of one solution."""
        m = self.frames.model
        inputs = [self.term.model.gyrating_frame, m.frame_dof, self.differences[number].real]
        self.shard.each_real(self.term.k_turn.take_gyration, self.term.gyrating, inputs, [v.real])

    def _add(self, row: int, factor: float, value: Rows, target: Rows) -> None:
        """target += factor share value."""
        inputs = [self.share.real, row, factor, value.real]
        self.shard.each_real(self.k_free.add_scaled, value.real.shape[1], inputs, [target.real])

    def _multiply(self, product: Rows) -> None:
        """A p of the solution that is pulled."""
        owner, s, m, w = self.owner, self.shard, self.shard.model, self.shard.work
        inputs = [m.neighbour_start, m.neighbour, m.neighbour_block, w.a.S, self.still.S, owner.p.S]
        s.each(owner.system.k.residual, s.variant.parts(m.dof_count), inputs, [self.against.S])
        product.zero()
        self._add(WHOLE, -1.0, self.against, product)

    def _zeros(self, like: wp.array) -> wp.array:
        """Zeros of the shape of a state array."""
        if not hasattr(self, "_nothing"):
            self._nothing = wp.zeros(like.shape, dtype=like.dtype, device=self.shard.device)
        return self._nothing

    def _collect(self, *, sets: bool = False) -> None:
        """Add the gradients that one solution has written to their sums; or put these in their place."""
        s = self.shard
        for part, total in self.sums:
            s.each_real(self.k_free.collect, part.shape[1], [s.lanes, int(sets)], [part, total])
