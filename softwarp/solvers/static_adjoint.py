"""The adjoint of an equilibrium, by the implicit function theorem. Theory: docs/theory/adjoint.md.

At an equilibrium f(x) = f_ext + H' T with the rows' laws, d + C T = target or a bound of T. How x follows commands and
parameters is told by the exact tangent, with the stiffness of taut cables and the turning of elements; the adjoint has
its transpose.
"""

from __future__ import annotations

from softwarp.kernels.rows import active_set
from softwarp.model.gradients import Gradients
from softwarp.solvers.adjoint import StepAdjoint
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.linear.lu import LUSolver
from softwarp.solvers.system import System

LAPSE = 1.0e20  # s, in which rates bound nothing
MARGIN = {"float64": 1.0e-7, "float32": 1.0e-3}  # of a force: closer to a bound it is at it


class StaticAdjoint(StepAdjoint):
    """Pulls gradients by positions and tensions at rest back to commands and parameters.

    Args:
        system: Worlds, on a coupled model (``plan.compile.coupled``), exact and with tangents that are not clamped; in
            equilibrium.
        gradients: Arrays of these worlds, read and written.
        index: Of the model.
        rest: Whether gradients by the rest shape are asked for.
    """

    def __init__(self, system: System, gradients: Gradients, index: AdjointIndex, *, rest: bool = False) -> None:
        super().__init__(system, 1.0, gradients, index, rest=rest)
        self.margin, self.lapse, self.rate_lapse = MARGIN[system.model.precision], LAPSE, LAPSE
        self.stiffness = self.shard.rows(system.model.body_count)  # zeros: no velocities, no damping
        self.lu = LUSolver(system.linear)
        self.a_upper = self.shard.rows(9 * self.shard.blocks)
        self.k_active = active_set.kernels(system.variant)

    def prepare(self, *, without: tuple[str, ...] = ()) -> None:
        """The factor of the tangent and what rows answer with, for any number of ``pull``.

        Args:
            without: Nothing; all inputs are needed.
        """
        system = self.system
        system.load()
        system.scale(0.0, inertia=False)
        system.measure_rows()
        system.command(0.0)
        system.forces()
        system.tangent()
        system.exact_tangent(self.a_upper)
        self.lu.factor(self.a_upper, self.shard.work.a)  # what is above the diagonal, transposed, is below that of A'
        system.linear.y.zero()
        system.rows.into_sides()
        self.lu.solve(1 + self.model.row_count)

    def pull(self, *, parameters: bool = True) -> None:
        """Gradients by the equilibrium become those by what it follows from; needs ``prepare``.

        Args:
            parameters: Whether those by parameters are asked for.
        """
        self._seed()
        self._solve_transposed()
        self.to_commands()
        self._to_elements(parameters=parameters)
        self._to_state()
        if parameters:
            self._to_parameters()

    def _solve_transposed(self) -> None:
        """p and q from A' p + H' q = y_x, -H p + C q = y_T."""
        s, m, w, linear, count = self.shard, self.model, self.shard.work, self.system.linear, self.model.row_count
        self.lu.solve(1)
        if count:
            inputs = [m.dof_count, count, m.row_entry_start, m.entry_dof, w.row.S, linear.y.S]
            outputs = [self.gap.S, self.delassus.S]
            s.each(self.k_active.compliance, count * (1 + count), [*inputs, self.force.S, self.none.S], outputs)
            inputs = [count, self.delassus.real, w.compliance.real, self.active.real, self.gap.real]
            s.each_real(self.k_rows.eliminate, None, inputs, [self.factor.real, self.change.real, self.q.real])
        s.each(self.k_active.combine, s.dof_rows, [m.dof_count, count, linear.y.S, self.change.S], [self.p.S])
