"""Equilibrium without inertia: f_int(x) = f_ext + H' multiplier. Theory: docs/theory/statics.md."""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp.kernels.rows import active_set
from softwarp.kernels.step import newton, statics
from softwarp.model.codes import CavityControl
from softwarp.model.fields import real_of
from softwarp.model.model import Model
from softwarp.solvers.linear.lu import LUSolver
from softwarp.solvers.newton_control import ROUNDING_FLOAT64, rounding_force
from softwarp.solvers.system import System

STEP_BOUND = 0.05  # of the scene's extent: how far a node may move in one iteration
ROUNDING_FLOAT32 = 5.0e-3  # relative imbalance that coordinates of this precision can cause; the distance decides
FLAT = 1.0e-3  # of the scene's extent: least depth of a chamber against which its volume's error is measured
DISTANCE = 5.0e-4  # of the scene's extent: length of a Newton step below which a world may count as converged


class QuasiStatic:
    """Newton's method with the exact tangent along a path from the start state to the equilibrium, in every world.

    The tangent contains the stiffness of taut cables and the turning of ``large`` tets, which makes it unsymmetric, so
    that it is factorised as L U; multipliers are found directly. Where the path is lost, a pseudo-mass lets a world
    slide to the next stable state.

    Args:
        system: Worlds, on a coupled model (``plan.compile.coupled``), exact and with tangents that are not clamped.
    """

    def __init__(self, system: System) -> None:
        if not system.shard.exact:
            raise ValueError("statics need a system with exact=True, whose workspace has room for the exact tangent")
        self.system, self.shard, self.work = system, system.shard, system.work
        model, count = system.model, max(system.rows.count, 1)
        self.lu = LUSolver(system.linear)
        self.k = statics.kernels(system.variant)
        self.k_rows = active_set.kernels(system.variant)
        is_double = model.precision == "float64"
        self.rounding = ROUNDING_FLOAT64 if is_double else ROUNDING_FLOAT32
        self.rounding_force = rounding_force(model)
        self.epsilon = 1.0e-13 if is_double else 1.0e-6
        allocate, dofs = self.shard.rows, self.shard.dof_rows
        self.a_upper = allocate(9 * self.shard.blocks)
        self.start_imbalance, self.reference = allocate(dofs), allocate(dofs)
        self.start_value, self.start_multiplier = allocate(count), allocate(count)
        self.imposed, self.length = _row_kinds(model), _row_lengths(model)
        self.reference_multiplier, self.value = allocate(count), allocate(count)
        self.compliance, self.matrix, self.is_active = allocate(count * count), allocate(count * count), allocate(count)
        self.contact = allocate(1)

    def start(self) -> None:
        """Load the state as the start of the path, and measure how far it is from equilibrium."""
        system, s, w = self.system, self.shard, self.work
        system.load()
        system.scale(0.0)
        s.each_real(self.k.begin, None, [], [w.control.real])
        self._load()
        inputs = [self.imposed, w.displacement.real, w.compliance.real, w.lower_bound.real, w.upper_bound.real]
        s.each_real(self.k.start_rows, system.rows.count, inputs, [w.multiplier.real, self.start_value.real])
        system.imbalance(1.0, inertia=False)
        inputs = [system.model.dof_count, 0, system.linear.y.S, self.value.S]
        s.each(self.k_rows.combine, s.dof_rows, inputs, [self.start_imbalance.S])
        self.start_multiplier.copy_from(w.multiplier)
        self.reference_multiplier.copy_from(w.multiplier)
        self.reference.zero()
        self.contact.zero()

    def iterate(self, tolerance: float) -> None:
        """Evaluate the present iterate and take one step from it."""
        s, w, model = self.shard, self.work, self.system.model
        self.evaluate()
        self._tangent()
        self._solve()
        near = DISTANCE * model.extent
        inputs = [s.dof_rows, tolerance, self.rounding, self.rounding_force, near, w.u.real]
        s.each_real(self.k.arrive, None, inputs, [w.control.real])
        inputs = [s.dof_rows, model.dof_count, STEP_BOUND * model.extent, self.system.rows.count > 0]
        inputs += [w.u.real, self.lu.pivot.real, self.contact.real]
        s.each_real(self.k.walk, None, inputs, [w.control.real])
        self._advance()

    def evaluate(self) -> None:
        """Merit of the present iterate at its point of the path."""
        system, s, w, count = self.system, self.shard, self.work, self.system.rows.count
        self._load()
        inputs = [self.imposed, w.control.real, self.start_value.real, self.start_multiplier.real]
        s.each_real(self.k.path_command, count, inputs, [w.target.real, w.lower_bound.real, w.upper_bound.real])
        s.each_real(self.k.path_load, s.dof_rows, [w.control.real, self.start_imbalance.real], [w.b.real])
        system.imbalance(1.0, inertia=False)
        system.rows.measure_gaps()
        inputs = [count, self.length, w.norm.real, w.gap.real]
        inputs += [w.multiplier.real, w.lower_bound.real, w.upper_bound.real]
        s.each_real(self.k.measure, None, inputs, [w.control.real])

    def saddles(self) -> NDArray[np.bool_]:
        """Worlds whose state is an equilibrium that is not stable, were it one, shape (world,); reads back to the host.

        A has more negative pivots there than the rows hold back. Nothing of the state changes.
        """
        self.start()
        self.evaluate()
        self._tangent()
        self._solve()
        pivots, held, steps = (rows.real.numpy() for rows in (self.lu.pivot, self.contact, self.work.u))
        unstable = pivots[:, : self.system.model.dof_count].sum(axis=1) - held[:, 0]
        is_sound = np.isfinite(steps).all(axis=1)
        return np.asarray((is_sound & (unstable > 0.5)).reshape(-1)[: self.system.world_count])

    def finish(self) -> None:
        """Commit the last iterates with zero velocity.

        A world that is not at the end of its path goes back to where it was in equilibrium with a part of the load.
        """
        self.shard.each_real(self.k.finish, None, [], [self.work.control.real])
        self._advance()
        self.evaluate()
        self.system.commit(0.0, 0.0, iterated=True)

    def verdict(self) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Relative residual and whether it converged, per world (reads back to the host)."""
        values = self.work.control.real.numpy()
        merit, frozen = (
            values[:, row, :].reshape(-1)[: self.system.world_count] for row in (newton.MERIT, newton.FROZEN)
        )
        return merit.astype(np.float64), frozen > 0.5

    def lost(self) -> NDArray[np.bool_]:
        """Worlds whose path has ended short of the commands, or that come no nearer at its end.

        The first ones slide, or their strides are the shortest.

        To be asked before ``finish``; reads back to the host.
        """
        values = self.work.control.real.numpy()
        names = (statics.FROZEN, statics.LOADED, statics.STRIDE, statics.T, statics.STUCK)
        frozen, loaded, stride, t, stuck = (values[:, row, :].reshape(-1)[: self.system.world_count] for row in names)
        short = (stride <= 1.01 * statics.MIN_STRIDE) & (t < 1.0)
        return np.asarray(((frozen < 0.5) & ((loaded > 0.5) | short)) | (stuck > 0.5))

    def _load(self) -> None:
        """Forces and commands at the present positions."""
        system = self.system
        system.move(1.0)
        system.measure_rows()
        system.command(0.0)
        system.forces()
        system.right_hand_side(1.0, inertia=False, moving=False)

    def _tangent(self) -> None:
        """A and, transposed, the part above its diagonal."""
        s, w, model = self.shard, self.work, self.system.model
        inputs = [model.extent, s.input["youngs"].real, s.input["density"].real, w.control.real]
        s.each_real(self.k.pseudo_mass, model.body_count, inputs, [w.body_mass.real])
        self.system.tangent()
        self.system.exact_tangent(self.a_upper)

    def _solve(self) -> None:
        """Step ``u`` and multipliers ``value`` of A u = b + H' value with the rows' laws."""
        system, s, w, model = self.system, self.shard, self.work, self.system.model
        count = system.rows.count
        self.lu.factor(w.a, self.a_upper)
        system.b_into_sides()
        self.lu.solve(1 + count)
        if count:
            self.measure_compliance()
            s.each(self.k_rows.add_own, count, [count, w.compliance.S], [self.compliance.S])
            inputs = [count, self.epsilon, model.extent, self.compliance.real, w.gap.real]
            inputs += [w.lower_bound.real, w.upper_bound.real, w.multiplier.real]
            outputs = [self.is_active.real, self.matrix.real, self.value.real, self.contact.real]
            s.each_real(self.k_rows.active_set, None, inputs, outputs)
        inputs = [model.dof_count, count, system.linear.y.S, self.value.S]
        s.each(self.k_rows.combine, s.dof_rows, inputs, [w.u.S])

    def measure_compliance(self) -> None:
        """Gaps of the rows without multipliers, and their compliance, from the solved sides."""
        s, w, model, count = self.shard, self.work, self.system.model, self.system.rows.count
        inputs = [model.dof_count, count, model.row_entry_start, model.entry_dof, w.row.S, self.system.linear.y.S]
        inputs += [w.displacement.S, w.target.S]
        s.each(self.k_rows.compliance, count * (1 + count), inputs, [w.gap.S, self.compliance.S])

    def _advance(self) -> None:
        """Move positions and multipliers as the control rows say."""
        s, w = self.shard, self.work
        inputs = [w.control.real, w.u.real, True]
        s.each_real(self.k.advance, s.dof_rows, inputs, [w.dof_v.real, self.reference.real])
        inputs = [w.control.real, self.value.real, False]
        s.each_real(self.k.advance, self.system.rows.count, inputs, [w.multiplier.real, self.reference_multiplier.real])


def _row_kinds(model: Model) -> wp.array:
    """What the commands of rows impose: ``FREE``, ``PULLED`` or ``PRESSED``, (row,)."""
    kinds = np.where(model.cable_force_control.numpy() != 0, statics.PULLED, statics.FREE)
    if model.cavities is not None:
        is_pressed = model.cavities.cavity_control.numpy() == CavityControl.PRESSURE
        kinds = np.concatenate([kinds, np.where(is_pressed, statics.PRESSED, statics.FREE)])
    return wp.array(kinds, dtype=wp.int32, device=model.device)


def _row_lengths(model: Model) -> wp.array:
    """Against which gaps of rows are measured [m], (row,): lengths of cables, volumes of chambers per surface."""
    lengths = model.cable_rest_length.numpy()
    if model.cavities is not None:
        depths = model.cavities.cavity_rest_volume.numpy() / model.cavities.cavity_area.numpy()
        lengths = np.concatenate([lengths, np.maximum(depths, FLAT * model.extent)])
    return wp.array(lengths, dtype=real_of(model.precision), device=model.device)
