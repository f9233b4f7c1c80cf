"""Equilibrium without inertia: f_int(x) = f_ext + H' multiplier. Theory: docs/theory/statics.md."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softwarp.kernels.elements import quadratic, turning
from softwarp.kernels.rows import active_set
from softwarp.kernels.step import newton, statics
from softwarp.solvers.linear.lu import LUSolver
from softwarp.solvers.newton_control import ROUNDING_FLOAT64, rounding_force
from softwarp.solvers.system import System
from softwarp.solvers.workspace import rows

STEP_BOUND = 0.05  # of the scene's extent: how far a node may move in one iteration
ROUNDING_FLOAT32 = 5.0e-3  # relative imbalance that coordinates of this precision can cause; the distance decides
DISTANCE = 5.0e-4  # of the scene's extent: length of a Newton step below which a world may count as converged


class QuasiStatic:
    """Newton's method with the exact tangent along a path from the start state to the equilibrium, in every world.

    The tangent contains the stiffness of taut cables and the turning of ``large`` tets, which makes it unsymmetric, so
    that it is factorised as L U; multipliers are found directly. Where the path is lost, a pseudo-mass lets a world
    slide to the next stable state.

    Args:
        system: Worlds, on a coupled model (``assembly_plan.coupled``) and with tangents that are not clamped.
    """

    def __init__(self, system: System) -> None:
        self.system = system
        model, count = system.model, max(system.rows_count, 1)
        self.lu = LUSolver(system.linear)
        self.k = statics.kernels(system.variant)
        self.k_rows = active_set.kernels(system.variant)
        is_double = model.precision == "float64"
        self.rounding = ROUNDING_FLOAT64 if is_double else ROUNDING_FLOAT32
        self.rounding_force = rounding_force(model)
        self.epsilon = 1.0e-13 if is_double else 1.0e-6

        def allocate(items: int) -> rows.Rows:
            return rows.allocate(system.variant, system.world_count, items, system.device)

        system.newton = allocate(statics.ROWS)
        self.a_upper = allocate(9 * len(model.symbolic.a_row))
        self.turning = allocate(turning.TURNING_ROWS * model.tet_count if system.turned else 1)
        points = 0 if system.quadratic is None else system.quadratic.turning_points
        self.point_turning = allocate(turning.TURNING_ROWS * points) if points else None
        self.node_turning = allocate(quadratic.TURNING_ROWS * points) if points else None
        self.start_imbalance, self.reference = allocate(system.dof_rows), allocate(system.dof_rows)
        self.start_displacement, self.start_multiplier = allocate(count), allocate(count)
        self.reference_multiplier, self.value = allocate(count), allocate(count)
        self.compliance, self.matrix, self.is_active = allocate(count * count), allocate(count * count), allocate(count)
        self.contact = allocate(1)

    def start(self) -> None:
        """Load the state as the start of the path, and measure how far it is from equilibrium."""
        system = self.system
        system.load()
        system.scale(0.0)
        system.each_real(self.k.begin, None, [], [system.newton.real])
        self._load()
        system.clamp_multipliers()
        system.imbalance(1.0, inertia=False)
        inputs = [system.model.dof_count, 0, system.linear.y.S, self.value.S]
        system.each(self.k_rows.combine, system.dof_rows, inputs, [self.start_imbalance.S])
        self.start_displacement.copy_from(system.displacement)
        self.start_multiplier.copy_from(system.multiplier)
        self.reference_multiplier.copy_from(system.multiplier)
        self.reference.zero()
        self.contact.zero()

    def iterate(self, tolerance: float) -> None:
        """Evaluate the present iterate and take one step from it."""
        system, control = self.system, self.system.newton.real
        self.evaluate()
        self._tangent()
        self._solve()
        model, near = system.model, DISTANCE * system.model.extent
        inputs = [system.dof_rows, tolerance, self.rounding, self.rounding_force, near, system.u.real]
        system.each_real(self.k.arrive, None, inputs, [control])
        inputs = [system.dof_rows, model.dof_count, STEP_BOUND * model.extent, system.rows_count > 0]
        inputs += [system.u.real, self.lu.pivot.real, self.contact.real]
        system.each_real(self.k.walk, None, inputs, [control])
        self._advance()

    def evaluate(self) -> None:
        """Merit of the present iterate at its point of the path."""
        system, control = self.system, self.system.newton.real
        self._load()
        inputs = [system.model.cable_force_control, control]
        inputs += [self.start_displacement.real, self.start_multiplier.real]
        outputs = [system.target.real, system.upper_bound.real]
        system.each_real(self.k.path_command, system.rows_count, inputs, outputs)
        system.each_real(self.k.path_load, system.dof_rows, [control, self.start_imbalance.real], [system.b.real])
        system.imbalance(1.0, inertia=False)
        row_gap = system.k_constraint.row_gap
        system.each(
            row_gap,
            system.rows_count,
            [
                system.displacement.S,
                system.target.S,
                system.compliance.S,
                system.floor.S,
                system.ceiling.S,
                system.multiplier.S,
            ],
            [system.gap.S],
        )
        inputs = [system.rows_count, system.model.cable_rest_length, system.norm.real, system.gap.real]
        inputs += [system.multiplier.real, system.lower_bound.real, system.upper_bound.real]
        system.each_real(self.k.measure, None, inputs, [control])

    def finish(self) -> None:
        """Commit the last iterates with zero velocity.

        A world that is not at the end of its path goes back to where it was in equilibrium with a part of the load.
        """
        system = self.system
        system.each_real(self.k.finish, None, [], [system.newton.real])
        self._advance()
        self.evaluate()
        system.commit(0.0, 0.0, iterated=True)

    def verdict(self) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Relative residual and whether it converged, per world (reads back to the host)."""
        values = self.system.newton.real.numpy()
        merit, frozen = (
            values[:, row, :].reshape(-1)[: self.system.world_count] for row in (newton.MERIT, newton.FROZEN)
        )
        return merit.astype(np.float64), frozen > 0.5

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
        system, model = self.system, self.system.model
        inputs = [model.extent, system.input["youngs"].real, system.input["density"].real, system.newton.real]
        system.each_real(self.k.pseudo_mass, model.body_count, inputs, [system.body["mass"].real])
        system.tangent()
        self.complete_tangent()

    def complete_tangent(self) -> None:
        """Add what the tangent of a step leaves out: stiffness of taut cables, turning of elements."""
        system, model = self.system, self.system.model
        if system.is_coupled:
            system.cable_tangent()
        self.a_upper.copy_from(system.a)
        k = turning.kernels(system.variant)
        for law in system.turned:
            tets, kernel = model.law_tets[law], k.tet_turning if law == "large" else k.warped_turning
            inputs = [tets, model.tet_node, model.tet_body, model.tet_gradient, model.tet_volume, model.tet_frame]
            inputs += [system.body["mu"].real, system.body["lam"].real, system.x.real]
            system.each_real(kernel, tets.size, inputs, [self.turning.real])
        if system.turned:
            inputs = [model.large_entry_start, model.large_entry, self.turning.S]
            system.each(k.block_turning, len(model.symbolic.a_row), inputs, [system.a.S, self.a_upper.S])
        if system.quadratic is not None and self.point_turning is not None and self.node_turning is not None:
            system.quadratic.turn(self.a_upper, self.point_turning, self.node_turning)

    def _solve(self) -> None:
        """Step ``u`` and multipliers ``value`` of A u = b + H' value with the rows' laws."""
        system, model, y = self.system, self.system.model, self.system.linear.y
        count = system.rows_count
        self.lu.factor(system.a, self.a_upper)
        y.zero()
        system.rows_into_sides()
        system.each(system.k.accumulate, system.dof_rows, [system.b.S], [y.S])
        self.lu.solve(1 + count)
        if count:
            self.measure_compliance()
            inputs = [count, self.epsilon, model.extent, self.compliance.real, system.gap.real]
            inputs += [system.lower_bound.real, system.upper_bound.real, system.multiplier.real]
            outputs = [self.is_active.real, self.matrix.real, self.value.real, self.contact.real]
            system.each_real(self.k_rows.active_set, None, inputs, outputs)
        inputs = [model.dof_count, count, y.S, self.value.S]
        system.each(self.k_rows.combine, system.dof_rows, inputs, [system.u.S])

    def measure_compliance(self) -> None:
        """Gaps of the rows without multipliers, and their compliance, from the solved sides."""
        system, model = self.system, self.system.model
        count = system.rows_count
        inputs = [model.dof_count, count, model.row_entry_start, model.entry_dof, system.row.S, system.linear.y.S]
        inputs += [system.displacement.S, system.target.S]
        outputs = [system.gap.S, self.compliance.S]
        system.each(self.k_rows.compliance, count * (1 + count), inputs, outputs)

    def _advance(self) -> None:
        """Move positions and multipliers as the control rows say."""
        system, control = self.system, self.system.newton.real
        outputs = [system.dof_v.real, self.reference.real]
        system.each_real(self.k.advance, system.dof_rows, [control, system.u.real, True], outputs)
        outputs = [system.multiplier.real, self.reference_multiplier.real]
        system.each_real(self.k.advance, system.rows_count, [control, self.value.real, False], outputs)
