"""Exact sensitivities of soft bodies with cables for inverse control, and the last millimetres to a target.

Equations: docs/theory/settling.md.
"""

from __future__ import annotations

import warp as wp

from softwarp.kernels.inverse import settling
from softwarp.solvers.inverse.problem import InverseProblem
from softwarp.solvers.quasi_static import QuasiStatic
from softwarp.solvers.workspace import rows

STILL = 1.0  # s for which a target must not have moved before the worlds settle at it


class Settling:
    """Linearisation by the exact tangent, and the law for the neighbourhood of a target.

    Args:
        problem: Inverse problem on a coupled model (``plan.compile.coupled``), exact and with tangents that are not
            clamped.
        radius: Distance [m] from a target below which a world settles.
    """

    def __init__(self, problem: InverseProblem, radius: float) -> None:
        self.problem, self.radius = problem, radius
        system, e, allocate = problem.system, problem.effector_rows, problem.doubles
        self.static = QuasiStatic(system)
        self.k = settling.kernels(system.variant)
        self.count = count = system.rows.count
        self.patience = max(1, round(STILL / problem.options.period))
        self.effect = system.shard.rows(e * (1 + count))
        self.matrix, self.motion = allocate(count * count), allocate(count * e)
        self.gram, self.side = allocate(e * e), allocate(2 * e)
        seen = rows.allocate(
            problem.wide, system.world_count, problem.target.shape[1], problem.target.device, system.variant.real
        )
        self.seen, self.still = seen.S, allocate(1, wp.int32)

    def linearise(self, h: float) -> None:
        """Columns of the actuators in W, and gaps, as in an implicit step of length ``h`` [s], with its momentum.

        A / h^2 takes the place of A, as the exact parts of the tangent come without a factor.
        """
        p, system, s, work = self.problem, self.problem.system, self.problem.system.shard, self.problem.system.work
        system.load()
        system.scale(h)
        system.measure_rows()
        system.command(h)
        system.forces()
        system.tangent()
        system.right_hand_side(h, inertia=p.options.momentum, moving=False)
        s.each_real(self.k.multiply, work.a.real.shape[1], [1.0 / (h * h)], [work.a.real])
        s.each_real(self.k.multiply, s.dof_rows, [1.0 / h], [work.b.real])
        self._respond(loaded=True)
        p.measure_effectors()
        inputs = [self.count, p.response.order, work.gap.real, self.static.compliance.real, self.effect.real]
        s.each_real(self.k.spread, self.count + p.effector_rows, inputs, [p.response.matrix.real, p.response.gap.real])

    def adjust(self) -> None:
        """Replace the commands of worlds near a target that stands still; needs ``linearise`` and commands."""
        p, system, s, work = self.problem, self.problem.system, self.problem.system.shard, self.problem.system.work
        system.scale(0.0, inertia=False)
        system.tangent()
        self._respond(loaded=False)
        inputs = [s.world_count, p.target.shape[1], p.target]
        p.each_world(self.k.wait, inputs, [self.seen, self.still])
        inputs = [self.count, p.effector_rows, s.world_count, s.model.cable_force_control, p.row_weight]
        inputs += [self.static.compliance.real, self.effect.real, work.multiplier.real]
        s.each_real(self.k.sensitivity, None, inputs, [self.matrix, self.motion])
        inputs = [p.actuators.count, p.effector_rows, s.world_count, self.patience, self.radius]
        inputs += [p.options.tolerance, p.options.max_step, p.actuator_row, p.row_weight, p.error.real]
        names = ("command_cable_displacement", "cable_min_displacement", "cable_max_displacement")
        inputs += [work.multiplier.real, *(s.input[name].real for name in names)]
        inputs += [p.compliance, self.motion, self.still]
        s.each_real(self.k.settle, None, inputs, [self.gram, self.side, p.command, p.status])

    def _respond(self, *, loaded: bool) -> None:
        """Exact A, its factors, and the response to all efforts; ``loaded`` to the forces in ``b`` as well."""
        p, system, s, static = self.problem, self.problem.system, self.problem.system.shard, self.static
        y = system.linear.y
        system.exact_tangent(static.a_upper)
        static.lu.factor(system.work.a, static.a_upper)
        if loaded:
            system.b_into_sides()
            system.rows.add_forces(y, 1.0)
        else:
            y.zero()
            system.rows.into_sides()
        static.lu.solve(1 + self.count)
        static.measure_compliance()
        if loaded:
            p.place_effectors()
        inputs = [s.model.dof_count, 1 + self.count, p.entry_start, p.entry[1], p.row.real, y.real]
        s.each_real(self.k.effector_response, p.effector_rows, inputs, [self.effect.real])
