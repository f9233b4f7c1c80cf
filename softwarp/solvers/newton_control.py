"""Launches of the per-world Newton control: accept, reject, advance. Theory: docs/theory/newton.md."""

from __future__ import annotations

import numpy as np

from softwarp.kernels import newton
from softwarp.materials import lame
from softwarp.model import Model
from softwarp.solvers import rows
from softwarp.solvers.system import System

ROUNDING_FLOAT32 = 1e-3  # relative imbalance that coordinates of this precision can cause in stiff, thin bodies
ROUNDING_FLOAT64 = 1e-10
STATIC_STEP = 0.05  # of the scene's extent: first bound on a quasi-static step


class NewtonControl:
    """Keeps the last accepted iterate of every world and moves on from it.

    Args:
        system: Worlds to iterate.
        static: Quasi-static mode: steps are bounded by a length, which a rejected world shortens.
    """

    def __init__(self, system: System, static: bool) -> None:
        self.system, self.static = system, static
        self.kernels = newton.kernels(system.variant)
        self.rounding = ROUNDING_FLOAT64 if system.model.precision == "float64" else ROUNDING_FLOAT32
        self.rounding_force = _rounding_force(system.model)
        self.initial_step = STATIC_STEP * system.model.extent if static else 1.0

        def allocate(count: int) -> rows.Rows:
            return rows.allocate(system.variant, system.world_count, count, system.device)

        self.reference = allocate(system.dof_rows)
        self.direction = allocate(1 if static else system.dof_rows)
        self.multiplier = allocate(max(system.rows_count, 1))

    def begin(self, pseudo_mass: float) -> None:
        """Reset the control rows of all worlds."""
        inputs = [self.initial_step, pseudo_mass]
        self.system.each_real(self.kernels.begin, None, inputs, [self.system.newton.real])

    def judge(self, *, first: bool, tolerance: float) -> None:
        """Accept or reject the present iterate; needs ``System.imbalance``."""
        s = self.system
        s.each(s.k_constraint.row_gap, s.rows_count, [s.displacement.S, s.target.S], [s.gap.S])
        inputs = [first, self.static, tolerance, self.rounding, self.rounding_force, self.initial_step, s.rows_count]
        inputs += [s.model.cable_rest_length, s.norm.real, s.gap.real]
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
        s.each_real(self.kernels.hold, s.rows_count, [s.newton.real], [s.multiplier.real, self.multiplier.real])
        inputs = [s.newton.real, s.u.real, self.reference.real]
        if self.static:
            s.each_real(self.kernels.limit_step, None, [s.dof_rows, s.u.real], [s.newton.real])
            s.each_real(self.kernels.advance_static, s.dof_rows, inputs, [s.dof_v.real])
            return
        s.each_real(self.kernels.advance, s.dof_rows, inputs, [self.direction.real, s.dof_v.real])

    def pseudo_mass(self) -> None:
        """Use the worlds' pseudo-masses as factors of M in A."""
        s = self.system
        inputs = [s.model.extent, s.input["youngs"].real, s.input["density"].real, s.newton.real]
        s.each_real(self.kernels.pseudo_mass, s.model.body_count, inputs, [s.body["mass"].real])


def _rounding_force(model: Model) -> float:
    """Force imbalance [N] that rounding of the coordinates to the model's precision causes in its tets."""
    epsilon = 2.2e-16 if model.precision == "float64" else 1.2e-7
    mu, lam = lame(model.defaults["youngs"].max(), model.defaults["nu"].max())
    volumes = np.abs(model.tet_volume.numpy()).astype(np.float64)
    return float(epsilon * model.extent * (2.0 * mu + lam) * np.sqrt((12.0 * volumes ** (2.0 / 3.0)).sum()))
