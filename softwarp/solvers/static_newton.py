"""Corrections of an equilibrium with a tangent of before, that of its adjoint. Theory: docs/theory/statics.md.

With a factor of A and the sides Z = A^-1 H' near a pose, its imbalance r = f_ext - f + H' T and its rows' laws are
corrected by

    u = A^-1 r + Z (T_new - T),   d + H u + C T_new = target or a bound of T_new,

at a thousandth of the cost of a factor. What is left shrinks by the relative error of the tangent.
"""

from __future__ import annotations

from softwarp.kernels.rows import active_set
from softwarp.solvers.static_adjoint import StaticAdjoint


class StaticNewton:
    """Corrections of the worlds of one shard, with the factor that their adjoint has or that is made anew.

    Args:
        adjoint: Of these worlds; its factor, rows and right-hand sides are shared.

    Attributes:
        u: Correction of all dofs [m].
        value: Multipliers after it.
        negative: Negative pivots of the rows that are between their bounds, or -1 where none were found.
    """

    def __init__(self, adjoint: StaticAdjoint) -> None:
        self.adjoint, self.system, self.shard = adjoint, adjoint.system, adjoint.shard
        self.count = count = adjoint.model.row_count
        self.k = active_set.kernels(self.system.variant)
        self.epsilon = 1.0e-13 if adjoint.model.precision == "float64" else 1.0e-6
        allocate, rows = self.shard.rows, max(count, 1)
        self.u, self.value, self.change = allocate(self.shard.dof_rows), allocate(rows), allocate(rows)
        self.gap, self.is_active, self.negative = allocate(rows), allocate(rows), allocate(1)
        self.compliance, self.matrix = allocate(rows * rows), allocate(rows * rows)
        self.sides = allocate(self.system.linear.y.real.shape[1])

    def begin(self) -> None:
        """Load state, commands and parameters."""
        self.system.load()
        self.system.scale(0.0, inertia=False)

    def keep_sides(self) -> None:
        """Z, which the rows' gradients are about to overwrite; needs ``prepare`` of the adjoint, or ``linearise``."""
        self.sides.copy_from(self.system.linear.y)

    def linearise(self) -> None:
        """Factor and Z, in ``y``, where the worlds are; needs ``measure``, and ``keep_sides`` after it."""
        system, adjoint = self.system, self.adjoint
        system.tangent()
        system.exact_tangent(adjoint.a_upper)
        adjoint.lu.factor(self.shard.work.a, adjoint.a_upper)
        system.linear.y.zero()
        system.rows.into_sides()
        adjoint.lu.solve(1 + self.count)

    def measure(self) -> None:
        """Imbalance b at the trial positions, forces of rows included."""
        system, w = self.system, self.shard.work
        system.move(1.0)
        system.measure_rows()
        system.command(0.0)
        system.forces()
        system.right_hand_side(1.0, inertia=False, moving=False)
        system.rows.into_sides()
        system.rows.add_forces(w.b, 1.0)

    def respond(self) -> None:
        """A^-1 b in side 0, which has b, and gaps and compliance of rows."""
        s, m, w, y, count = self.shard, self.adjoint.model, self.shard.work, self.system.linear.y, self.count
        self.adjoint.lu.solve(1)
        if count:
            inputs = [m.dof_count, count, m.row_entry_start, m.entry_dof, w.row.S, y.S, w.displacement.S, w.target.S]
            s.each(self.k.compliance, count * (1 + count), inputs, [self.gap.S, self.compliance.S])

    def choose(self) -> None:
        """Multipliers between their bounds, from gaps without any."""
        s, m, w, count = self.shard, self.adjoint.model, self.shard.work, self.count
        s.each(self.k.add_own, count, [count, w.compliance.S], [self.compliance.S])
        inputs = [count, self.epsilon, m.extent, self.compliance.real, self.gap.real]
        inputs += [w.lower_bound.real, w.upper_bound.real, w.multiplier.real]
        outputs = [self.is_active.real, self.matrix.real, self.value.real, self.negative.real]
        s.each_real(self.k.active_set, None, inputs, outputs)

    def combine(self) -> None:
        """The correction, from the change of multipliers."""
        s, m = self.shard, self.adjoint.model
        inputs = [m.dof_count, self.count, self.system.linear.y.S, self.change.S]
        s.each(self.k.combine, s.dof_rows, inputs, [self.u.S])

    def finish(self) -> None:
        """Write the trial positions and multipliers to the state."""
        self.measure()
        self.system.commit(0.0, 0.0, iterated=False)
