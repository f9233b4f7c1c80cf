"""The linearised system of a range of worlds: load state, evaluate forces and tangents, solve with multipliers, commit.

``ImplicitEuler`` and ``QuasiStatic`` are sequences of these operations. What the forces are is said by the terms, which
every operation walks in their order; here they are put together. Equations: docs/theory/implicit_euler.md.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.elements import assembly, norms
from softwarp.kernels.frames import prescribed
from softwarp.model.model import Model
from softwarp.model.resolution import resolved_sizes
from softwarp.model.state import Control, Parameters, State
from softwarp.solvers.linear.cholesky import LinearSolver
from softwarp.solvers.linear.free_bodies import FreeBodies, free_parts
from softwarp.solvers.multipliers import BoundedMultipliers, ContactMultipliers, Multipliers, StaticRows
from softwarp.solvers.options import Options
from softwarp.solvers.terms.contact import ContactTerm
from softwarp.solvers.terms.inversion import InversionTerm
from softwarp.solvers.terms.table import terms_of
from softwarp.solvers.terms.term import Pace
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard

Index = dict[str, wp.array]


class System:
    """Operations on the worlds of one shard.

    Args:
        model: Scene.
        index: Device arrays of the symbolic structure.
        variant: Scalar type and memory order.
        state, control, parameters: The shard's worlds.
        options: Solver options.
        more_sides: Right-hand sides of the linear solver besides those of the model's rows, for rows of the caller.
        exact: Give the workspace room for the exact tangent of statics.

    Attributes:
        shard: Worlds, inputs and how kernels run on them.
        work: Workspace.
        terms: Effects, in the order in which a step walks them.
        linear: Solver of ``A u = b``.
        inversion: What looks for elements that are inside out.
        free: Bodies whose mass it must not lose, if the scene has any in float32.
        rows: Multiplier rows besides contacts.
        multipliers: Laws of all rows.
        watch: Called with the number of every pass of a linear solve, after it, where somebody wants to know.
        always: Take further looks at contacts whether a world needs one or not, as where a recording cannot branch.
    """

    def __init__(
        self,
        model: Model,
        index: Index,
        variant: Variant,
        state: State,
        control: Control,
        parameters: Parameters,
        options: Options,
        more_sides: int = 0,
        *,
        exact: bool = False,
    ) -> None:
        self.model, self.variant, self.options, self.index = model, variant, options, index
        self.shard = shard = Shard(model, variant, state, control, parameters, options, exact)
        self.state, self.work, self.world_count = state, shard.work, shard.world_count
        parts = free_parts(model) if variant.real == wp.float32 else []
        sides = max(1 + model.row_count + more_sides, 3 if parts else 1)
        worlds = (self.world_count, sides, model.device, options.gpu_path)
        contacts = 0 if model.contact is None else model.contact.capacity
        self.linear = LinearSolver(model.symbolic, index, variant, *worlds, contacts=contacts)
        self.free = FreeBodies(shard, self.linear, parts) if parts else None
        self.k = assembly.kernels(variant)
        self.k_prescribed = prescribed.kernels(variant)
        nobody = [wp.empty(0, dtype=dtype, device=model.device) for dtype in (wp.int32, variant.real)]
        self.lumped_mass: list[wp.array] = nobody
        quadratic = model.quadratic
        self.consistent_mass = nobody if quadratic is None else [quadratic.mass_body, quadratic.mass_volume]
        self.terms = terms_of(shard)
        self.inversion = next((term for term in self.terms if isinstance(term, InversionTerm)), None)
        self.rows = StaticRows(shard, self.linear, self.terms)
        self.unbounded = sorted(row for term in self.terms for row in term.unbounded)
        self.contact = next((term for term in self.terms if isinstance(term, ContactTerm)), None)
        self.multipliers = self._make_multipliers()
        self.velocities = [name for name in ("v0", "twist0") if name == "v0" or model.frame_count]
        self.h = 0.0  # of ``scale``
        self.always = False
        self.watch: Callable[[int], None] | None = None
        corrections = [term.corrections for term in self.terms]
        self.passes = max(options.refinement, self.multipliers.corrections, *corrections, 0)

    def _make_multipliers(self) -> Multipliers:
        if any(term.responds for term in self.terms):
            return ContactMultipliers(self.rows, self.contact, self.unbounded, self.peek, self.measure_way)
        return BoundedMultipliers(self.rows) if self.rows.count else Multipliers(self.rows)

    @property
    def follows_paths(self) -> bool:
        """Whether ``solve_static`` follows paths, as it does without chambers and cables that stretch."""
        return all(term.follows_paths for term in self.terms)

    @property
    def has_exact_tangent(self) -> bool:
        """Whether ``exact_tangent`` and ``QuasiStatic`` know all effects of the scene."""
        return all(term.has_exact_tangent for term in self.terms)

    def with_options(
        self,
        options: Options,
        model: Model | None = None,
        index: Index | None = None,
        more_sides: int = 0,
        *,
        exact: bool = False,
    ) -> System:
        """The same worlds with other options, perhaps another structure of A, and a workspace of their own."""
        s = self.shard
        worlds = (s.state, s.control, s.parameters)
        structure = (model or self.model, index or self.index, self.variant)
        return System(*structure, *worlds, options, more_sides, exact=exact)

    # The start of a step

    def load(self, *, without: tuple[str, ...] = ()) -> None:
        """Bring state, commands and parameters into the workspace; raise flags for commands that are not finite.

        Args:
            without: Inputs, by name, that the caller has no use for.
        """
        s, w = self.shard, self.work
        s.load(without=without)
        w.flag.zero()
        w.x.copy_from(s.input["x0"])
        w.dof_v.zero()
        if "command_node_force" not in without:
            s.check_finite(s.input["command_node_force"], 3 * self.model.node_count)
        for term in self.terms:
            term.load()

    def scale(self, h: float, *, inertia: bool = True) -> None:
        """Moduli and matrix factors of every body.

        Args:
            h: Step [s]; 0 selects the quasi-static mode.
            inertia: Whether A has the mass matrix; without, for ``h`` = 0, it is the stiffness.
        """
        s, i, w = self.shard, self.shard.input, self.work
        self.h = h
        inputs = [i["youngs"].S, i["nu"].S, i["rayleigh_mass"].S, i["rayleigh_stiffness"].S, h]
        outputs = [w.body_mu.S, w.body_lam.S, w.body_mass.S, w.body_stiffness.S, w.body_damping.S]
        s.each(self.k.body_moduli, self.model.body_count, inputs, outputs)
        for term in self.terms:
            term.scale(h)
        if not inertia:
            w.body_mass.zero()

    # Rows

    def measure_rows(self) -> None:
        """Points, displacements (of chambers: volumes) and gradients of all rows at the trial positions."""
        for term in self.terms:
            term.measure()

    def command(self, h: float, pace: Pace | None = None, *, predict: bool = True) -> None:
        """Targets and bounds of rows, and prescribed velocities, from commands, limits and measured displacements.

        Args:
            h: Step [s].
            pace: What it does of the commands, where it is part of a longer step.
            predict: Whether gaps of joints are those that the velocities of the start lead to.
        """
        for term in self.terms:
            term.command(h, pace or Pace(h, h, h))
        self.row_laws()
        if predict:
            for term in self.terms:
                term.predict(h)

    def row_laws(self) -> None:
        """Laws of rows at the present displacements; needs ``measure_rows``."""
        for term in self.terms:
            term.law()

    def find_contacts(
        self, h: float, moving: bool, falling: bool = True, look: float | None = None, *, keeps: bool = False
    ) -> None:
        """Contacts at the trial positions; ``moving`` says that velocities have been found in this step.

        With ``keeps`` those that pressed in earlier iterates of the step are among them.
        """
        for term in self.terms:
            term.find(h, h if look is None else look, moving=moving, falling=falling, keeps=keeps)

    def check_velocities(self) -> None:
        """Raise flags for start velocities that are not finite; Newton's step control would hide them."""
        for velocity in (self.shard.input[name] for name in self.velocities):
            self.shard.check_finite(velocity, velocity.real.shape[1])

    # The linear system

    def forces(self) -> None:
        """Element forces, then elastic and external force of every node, at the trial positions."""
        s, m, w, i = self.shard, self.model, self.work, self.shard.input
        for term in self.terms:
            term.forces()
        inputs = [m.node_body, m.node_volume, m.node_heft, m.node_load, m.corner_start, m.corner]
        inputs += [i["density"].S, i["gravity"].S, i["command_node_force"].S, w.element_force.S]
        outputs = [w.node_mass.S, w.node_internal.S, w.node_external.S]
        s.each(self.k.node_forces, self.variant.parts(m.body_node_count), inputs, outputs)
        for term in self.terms:
            term.weigh()

    def loads(self) -> None:
        """External force of every node."""
        s, m, i = self.shard, self.model, self.shard.input
        inputs = [m.node_body, m.node_heft, m.node_load]
        inputs += [i["density"].S, i["gravity"].S, i["command_node_force"].S]
        s.each(self.k.node_loads, self.variant.parts(m.body_node_count), inputs, [self.work.node_external.S])
        for term in self.terms:
            term.weigh()

    def tangent(self) -> None:
        """A = m_scale M + k_scale K at the trial positions; needs ``forces``."""
        s, m, w = self.shard, self.model, self.work
        inputs = [m.dof_count, m.node_count, m.dof_node, m.node_body]
        inputs += self.consistent_mass if self.h > 0.0 else self.lumped_mass
        inputs += [w.body_mass.S, w.node_mass.S, s.input["density"].S]
        s.each(self.k.block_mass, self.variant.parts(s.blocks), inputs, [w.a.S])
        for term in self.terms:
            term.tangent(self.h)

    def exact_tangent(self, a_upper: Rows) -> None:
        """Add to A what ``tangent`` leaves out: stiffness of taut cables, turning of elements.

        Args:
            a_upper: Receives the transposes of the blocks above the diagonal.
        """
        for term in self.terms:
            term.stiffen()
        a_upper.copy_from(self.work.a)
        for term in self.terms:
            term.turn(a_upper)
        self._mask(self.work.a)
        self._mask(a_upper)

    def right_hand_side(self, f_scale: float, inertia: bool, moving: bool) -> None:
        """b of ``kernels.elements.assembly``; needs ``forces`` and ``tangent``. Completes A.

        Tangents of loads and dashpots come after b, because damping is proportional to the stiffness of elements only.
        """
        self._impulses(f_scale, inertia, moving)
        for term in self.terms:
            term.load_tangent(self.h)
        self._prescribe()

    def _impulses(self, f_scale: float, inertia: bool, moving: bool) -> None:
        """b of all dofs, of prescribed scalars too."""
        s, m, w = self.shard, self.model, self.work
        inputs = [m.node_count, m.dof_node, m.node_body, m.neighbour_start, m.neighbour, m.neighbour_block]
        inputs += [w.body_mass.S, w.body_damping.S, w.node_mass.S, w.node_internal.S, w.node_external.S]
        for term in self.terms:
            term.lean()
        counts = moving or (s.leaning and inertia)
        inputs += [s.felt["v0"].S, w.a.S, s.felt["dof_v"].S, f_scale, 1.0 if inertia else 0.0, counts]
        s.each(self.k.right_hand_side, self.variant.parts(m.dof_count), inputs, [w.b.S])
        if counts:
            for term in self.terms:
                term.slot_velocities()
        for term in self.terms:
            term.right_hand_side(f_scale, inertia, moving)

    def unheld_forces(self, everything: wp.array) -> None:
        """Into b what acts on every dof at rest [N], on prescribed scalars too: loads, elastic forces and static rows.

        Args:
            everything: Ones, (dof, 3).
        """
        self.load()
        self.scale(0.0, inertia=False)
        self.measure_rows()
        self.forces()
        self._impulses(1.0, inertia=False, moving=False)
        self.rows.into_sides()
        self.rows.add_forces(self.work.b, 1.0, everything)

    def _prescribe(self) -> None:
        """Eliminate prescribed scalars from A u = b."""
        s, m, w, k = self.shard, self.model, self.work, self.k_prescribed
        inputs = [m.prescribed_dof, m.dof_free, w.prescribed_v.S, w.dof_v.S]
        s.each(k.prescribed_change, m.prescribed_dof.size, inputs, [w.prescribed_change.S])
        inputs = [m.touched_dof, m.dof_free, m.neighbour_start, m.neighbour, m.neighbour_block]
        inputs += [w.a.S, w.prescribed_change.S]
        s.each(k.known_to_right, m.touched_dof.size, inputs, [w.b.S])
        self._mask(w.a)

    def _mask(self, blocks: Rows) -> None:
        """Take the rows and columns of prescribed scalars out of a matrix; they become those of 1."""
        m = self.model
        inputs = [m.masked_block, m.block_row, m.block_col, m.dof_free]
        self.shard.each(self.k_prescribed.mask_blocks, m.masked_block.size, inputs, [blocks.S])

    def b_into_sides(self) -> None:
        """Right-hand side 0 receives b, the others the transposed rows."""
        y = self.linear.y
        y.zero()
        self.rows.into_sides()
        self.shard.add(self.work.b, y, self.shard.dof_rows)

    def start_unknowns(self) -> None:
        """Unknowns start from what is prescribed, which the right-hand side then need not bring about."""
        s, m, w = self.shard, self.model, self.work
        if m.prescribed_dof.size == 0:
            w.u.zero()
            return
        w.u.copy_from(w.prescribed_change)
        inputs = [m.prescribed_dof, m.dof_free]
        s.each(self.k_prescribed.clear_known, m.prescribed_dof.size, inputs, [self.linear.y.S])

    def solve(self, f_scale: float, x_scale: float) -> None:
        """Unknowns ``u`` and multipliers of ``A u = b + f_scale H' multiplier`` with the rows' laws."""
        further = self.multipliers.further
        self.factor()
        for correction in range(1 + self.passes):
            if further is not None and correction == self.passes:
                further.mark()
            self._pass(f_scale, x_scale, correction)
        if further is not None:
            for number in range(self.options.further_passes):
                further.watch(x_scale)
                look = partial(self._pass, f_scale, x_scale, self.passes + 1 + number)
                further.take(look, always=self.always)
            further.end()

    def factor(self) -> None:
        """Factorise A, so that free bodies keep their mass in it."""
        a = self.work.a
        if self.free is not None and self.h > 0.0:
            self.free.mark(a)
        self.linear.factor(a)
        if self.free is not None and self.h > 0.0:
            self.free.mend(a)

    def residual(self, b: Rows, u: Rows, y: Rows) -> None:
        """y = b - A u, for iterative refinement; needs ``factor``."""
        s, m, w = self.shard, self.model, self.work
        inputs = [m.neighbour_start, m.neighbour, m.neighbour_block, w.a.S, b.S, u.S]
        s.each(self.k.residual, s.variant.parts(m.dof_count), inputs, [y.S])
        if self.free is not None and self.h > 0.0:
            self.free.residual(w.a, b, u, y)

    def _pass(self, f_scale: float, x_scale: float, correction: int) -> None:
        """One pass of ``solve``: the first one, 0, or a correction of the unknowns so far."""
        s, w, linear = self.shard, self.work, self.linear
        if correction == 0:
            self.b_into_sides()
            self.start_unknowns()
        else:
            for term in self.terms:
                term.correct(x_scale)
            self.residual(w.b, w.u, linear.y)
        self.multipliers.respond(f_scale, x_scale, correction)
        if linear.panels is not None:
            linear.panels.backward(w.u)
        else:
            linear.backward()
            s.add(linear.y, w.u, s.dof_rows)
        if self.watch is not None:
            self.watch(correction)

    def measure_way(self, h: float, part: float) -> None:
        """How much of the unknowns' way ``restrain`` would let worlds go."""
        self.work.share_of_way.fill(1.0)
        for term in self.terms:
            term.measure_way(h, part)

    def restrain(self, h: float, part: float = 1.0) -> None:
        """Let the unknowns of a single linearisation go no farther than it holds, or a part of that."""
        for term in self.terms:
            term.restrain(h, part)

    def add_unknowns(self) -> None:
        """Velocities receive the unknowns."""
        self.shard.add(self.work.u, self.work.dof_v, self.shard.dof_rows)

    def imbalance(self, f_scale: float, inertia: bool) -> None:
        """Norms of b + f_scale H' multiplier and of the forces in it, into ``norm``; overwrites side 0."""
        s, m, w, y = self.shard, self.model, self.work, self.linear.y
        self.b_into_sides()
        self.multipliers.add_forces(y, f_scale)
        forces = w.element_force.real.shape[1] if m.quadratic_count or m.hex_count else 12 * m.tet_count
        inputs = [m.dof_count, m.node_count, m.dof_node, forces]
        inputs += [w.node_mass.S, w.node_external.S, s.input["v0"].S]
        inputs += [w.element_force.S, y.S, f_scale, 1.0 if inertia else 0.0]
        if self.variant.world_fastest:
            k = norms.kernels(self.variant)
            s.each(k.force_squares, norms.PARTS, inputs, [w.norm_part.S])
            s.each_world(k.force_norms, [w.norm_part.S], [w.norm.S])
        else:
            s.each_world(self.k.force_norms, inputs, [w.norm.S])
        for term in self.terms:
            term.norms(f_scale)

    def rotation_step(self, x_scale: float) -> None:
        """Make changes of rotation in ``u`` changes of angular velocity; needs ``solve`` at the present velocities."""
        for term in self.terms:
            term.rotation_step(x_scale)

    # The end of a step

    def move(self, x_scale: float) -> None:
        """Trial positions x0 + x_scale v."""
        self._move_nodes(x_scale)
        for term in self.terms:
            term.move(x_scale)

    def peek(self, x_scale: float) -> None:
        """The same of what contacts look at; needs another ``move`` before anything else is done with positions."""
        self._move_nodes(x_scale)
        for term in self.terms:
            term.peek(x_scale)

    def arrive(self, x_scale: float) -> None:
        """The same at the end of a step; ``commit`` follows."""
        self._move_nodes(x_scale)
        for term in self.terms:
            term.arrive(x_scale)

    def _move_nodes(self, x_scale: float) -> None:
        s, w = self.shard, self.work
        count = self.model.own_node_count
        inputs = [count, self.model.node_dof, s.input["x0"].S, w.dof_v.S, x_scale]
        s.each(self.k.trial_position, self.variant.parts(count), inputs, [w.x.S])

    def commit(self, h: float, v_scale: float, iterated: bool) -> None:
        """Check every world; write the good ones to the state and give each its status.

        ``iterated`` says that Newton's control rows tell which worlds converged.
        """
        s, m, w, k, state = self.shard, self.model, self.work, self.shard.k_state, self.state
        for term in self.terms:
            term.release(h, self.linear, self.multipliers.response)
        inputs = [m.node_dof, s.input["x0"].real, w.x.real, w.dof_v.real]
        inputs += [w.commanded.real, self.options.reach * m.extent, m.node_size * resolved_sizes(m.precision)]
        s.each_real(k.check_nodes, self.variant.parts(m.node_count), inputs, [w.flag.real])
        if m.row_count:
            s.check_finite(w.multiplier, m.row_count)
        for term in self.terms:
            term.commit(h)
        for term in self.terms:
            term.check(h)
        inputs = [m.node_dof, s.lanes, w.flag.real, w.x.real, w.dof_v.real, v_scale]
        parts = self.variant.parts(m.own_node_count)
        s.each_real(k.commit_nodes, parts, inputs, [state.node_x, state.node_v, state.good_x, state.good_v])
        for term in self.terms:
            term.write()
        inputs = [s.lanes, h, iterated, w.flag.real, w.residual.real, w.control.real, self.multipliers.overflow.real]
        inputs += [w.compression.real, w.inverted.real]
        outputs = [state.status, state.contact_overflow, state.time, state.residual]
        s.each_real(k.commit_status, None, inputs, [*outputs, state.compression, state.inverted_count])

    def refresh(self) -> None:
        """Outputs that follow from positions into the state, where these were written by hand."""
        if not any(term.refreshes for term in self.terms):
            return
        self.load()
        self.measure_rows()
        for term in self.terms:
            term.refresh()
