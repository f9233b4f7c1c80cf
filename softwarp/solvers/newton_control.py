"""Launches of the per-world Newton control: accept, reject, advance. Theory: docs/theory/newton.md."""

from __future__ import annotations

from softwarp.kernels import newton
from softwarp.solvers import rows
from softwarp.solvers.system import System


class NewtonControl:
    """Keeps the last accepted iterate of every world and moves on from it.

    Args:
        system: Worlds to iterate.
        static: Quasi-static mode: rejected worlds raise their pseudo-mass instead of halving the step.
    """

    def __init__(self, system: System, static: bool) -> None:
        self.system, self.static = system, static
        self.kernels = newton.kernels(system.variant)

        def allocate(count: int) -> rows.Rows:
            return rows.allocate(system.variant, system.world_count, count, system.device)

        self.reference = allocate(system.dof_rows)
        self.direction = allocate(1 if static else system.dof_rows)
        self.multiplier = allocate(max(system.rows_count, 1))

    def begin(self, pseudo_mass: float) -> None:
        """Reset the control rows of all worlds."""
        self.system.each_real(self.kernels.begin, None, [pseudo_mass], [self.system.newton.real])

    def judge(self, *, first: bool, tolerance: float) -> None:
        """Accept or reject the present iterate; needs ``System.imbalance``."""
        s = self.system
        s.each(s.k_constraint.row_gap, s.rows_count, [s.displacement.S, s.target.S], [s.gap.S])
        inputs = [first, self.static, tolerance, s.rows_count, s.model.cable_rest_length, s.norm.real, s.gap.real]
        inputs += [s.multiplier.real, s.lower_bound.real, s.upper_bound.real]
        s.each_real(self.kernels.judge, None, inputs, [s.newton.real])

    def keep(self, *, restore: bool) -> None:
        """Store accepted iterates; ``restore`` sends rejected worlds back."""
        s = self.system
        inputs = [restore, s.newton.real]
        s.each_real(self.kernels.keep, s.dof_rows, inputs, [s.dof_v.real, self.reference.real])

    def advance(self) -> None:
        """Move on from the last accepted iterate of every world that has not converged."""
        s = self.system
        s.each_real(
            self.kernels.hold, s.rows_count, [s.newton.real], [s.multiplier.real, self.multiplier.real]
        )
        inputs = [self.static, s.newton.real, s.u.real, self.reference.real]
        s.each_real(self.kernels.advance, s.dof_rows, inputs, [self.direction.real, s.dof_v.real])

    def pseudo_mass(self) -> None:
        """Use the worlds' pseudo-masses as factors of M in A."""
        s = self.system
        inputs, outputs = [s.newton.real], [s.body["mass"].real]
        s.each_real(self.kernels.pseudo_mass, s.model.body_count, inputs, outputs)
