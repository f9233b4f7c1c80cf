"""Inverse problem of a shard's worlds: compliance between actuators and effectors, and the efforts that follow.

Equations: docs/theory/inverse.md, docs/theory/effector.md.
"""

from __future__ import annotations

import warp as wp

from softwarp.kernels.inverse import program
from softwarp.model.codes import FAR
from softwarp.solvers.inverse.actuators import MAPS, ActuatorPlan
from softwarp.solvers.inverse.laws import PIVOTS, Laws
from softwarp.solvers.inverse.problem import EffectorPlan, InverseOptions, InverseProblem
from softwarp.solvers.inverse.settling import Settling
from softwarp.solvers.system import System

EQUILIBRIUM = 1.0e3  # s, length of an implicit step without momentum that ends in equilibrium


class InverseSystem:
    """Operations on the inverse problem of one shard.

    Args:
        system, effectors, actuators, options, target: Of ``InverseProblem``.

    Attributes:
        problem: Response, arrays and results.
        laws: Rows that obey a law beside the actuators, or None.
        settling: The last millimetres by exact sensitivities, or None.
    """

    def __init__(
        self,
        system: System,
        effectors: EffectorPlan,
        actuators: ActuatorPlan,
        options: InverseOptions,
        target: wp.array,
    ) -> None:
        self.problem = problem = InverseProblem(system, effectors, actuators, options, target)
        self.system, self.options = system, options
        self.k = program.kernels(system.variant)
        self.laws = Laws(problem) if problem.laws else None
        self.settling = Settling(problem, options.settle) if options.settle > 0.0 else None

    def solve(self) -> None:
        """Commands from the present state."""
        if self.settling is None:
            self.linearise()
        else:
            self.settling.linearise(self.options.horizon)
        self.problem.bound.measure()
        self.optimise()
        if self.settling is not None:
            self.settling.adjust()

    def linearise(self) -> None:
        """Compliances and gaps of all rows at the present state and multipliers, into the response."""
        s, o, p, y = self.system, self.options, self.problem, self.system.linear.y
        h, r, work = o.horizon, self.problem.response, self.system.work
        s.load()
        s.scale(h)
        s.measure_rows()
        s.command(h, predict=o.momentum)  # without, joints stand where they are instead of where velocities lead
        if o.contact:  # a robot that stands does not fall in a long period
            s.find_contacts(o.period, moving=False, falling=False)
        s.shard.place(work.compliance, s.rows.count, r.compliance, 0)
        s.forces()
        s.tangent()
        s.right_hand_side(h, inertia=o.momentum, moving=False)
        s.factor()
        s.b_into_sides()
        p.place_effectors()
        s.start_unknowns()
        s.rows.add_forces(y, h)
        r.add_forces(y, h)
        r.sides(s.linear)
        s.linear.forward(1 + s.rows.count + p.effector_rows)
        r.delassus(y, h * h)
        s.rows.free_gaps(h, r.gap)
        p.measure_effectors(h)
        if r.subspace is not None:
            r.subspace.expand(work.u, work.dof_v)
        r.gaps(y, u=work.u, v=work.dof_v, v0=work.dof_v0, x_scale=h, recovery=FAR, bounce_speed=FAR)
        r.eliminate_gaps(work.multiplier)

    def optimise(self) -> None:
        """The quadratic program, and commands from its solution."""
        s, o, k, p, b = self.system.shard, self.options, self.k, self.problem, self.problem.bound.value
        n, e = p.actuators.count, p.effector_rows
        inputs = [n, e, p.first_effector, p.response.order, s.world_count, p.actuator_row]
        inputs += [p.response.matrix.real, p.response.gap.real, s.work.target.real, s.work.multiplier.real]
        inputs += [b[name] for name in ("effort_low", "effort_high", "way_low", "way_high")]
        outputs = [p.effort, p.effect, p.compliance, p.way, p.gap, p.low, p.high]
        s.each_real(k.collect, None, inputs, outputs)
        if self.laws is None:
            self._solve_program()
        else:
            self.laws.begin()
            for pivot in range(PIVOTS + 1):
                self.laws.respond()
                self._solve_program()
                self.laws.pivot(first=pivot == 0, last=pivot == PIVOTS)
            self.laws.respond()
            self._solve_program()
        inputs = [n, e, o.tolerance, o.max_step, o.share, p.row_weight, p.is_effort]
        inputs += [self.system.multipliers.overflow.real, p.outcome]
        inputs += [p.multiplier, p.effort, p.effect, p.compliance, p.way, p.gap, p.low, p.high]
        inputs += [b[name] for name in ("way_low", "way_high", "stop_low", "stop_high", "now", *MAPS)]
        p.each_world(k.conclude, inputs, [p.x, p.predicted, p.displacement, p.command, p.status])

    def _solve_program(self) -> None:
        """Efforts for the blocks that were collected."""
        o, k, p = self.options, self.k, self.problem
        n, q = p.actuators.count, p.bounded_rows
        inputs = [n, 2 * n, p.effector_rows, o.energy, o.max_step, p.row_weight]
        p.each_world(k.assemble, [*inputs, p.effect, p.compliance, p.gap], [p.hessian, p.linear, p.normal])
        inputs = [n, q, p.hessian, p.linear, p.normal, p.low, p.high, p.soft]
        outputs = [p.chol, p.half, p.size, p.gram, p.rate, p.step, p.active, p.sign]
        p.each_world(k.dual_active_set, inputs, [*outputs, p.multiplier, p.x, p.outcome])
