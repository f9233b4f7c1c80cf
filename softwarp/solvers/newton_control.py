"""Launches of the per-world Newton control: accept, reject, advance. Theory: docs/theory/newton.md."""

from __future__ import annotations

import numpy as np

from softwarp.kernels.step import newton
from softwarp.model.model import Model
from softwarp.scene.materials import lame
from softwarp.solvers.system import System
from softwarp.solvers.workspace import rows

ROUNDING_FLOAT32 = 1e-3  # relative imbalance that coordinates of this precision can cause in stiff, thin bodies
ROUNDING_FLOAT64 = 1e-10


class NewtonControl:
    """Keeps the last accepted iterate of every world and moves on from it.

    Args:
        system: Worlds to iterate.
    """

    def __init__(self, system: System) -> None:
        self.system = system
        self.kernels = newton.kernels(system.variant)
        self.rounding = ROUNDING_FLOAT64 if system.model.precision == "float64" else ROUNDING_FLOAT32
        self.rounding_force = rounding_force(system.model)

        def allocate(count: int) -> rows.Rows:
            return rows.allocate(system.variant, system.world_count, count, system.device)

        self.reference, self.best = allocate(system.dof_rows), allocate(system.dof_rows)
        self.direction = allocate(system.dof_rows)
        count = max(system.rows_count, 1)
        self.multiplier, self.best_multiplier = allocate(count), allocate(count)
        self.share = allocate(1) if system.cavities is None else system.cavities.share

    def begin(self) -> None:
        """Reset the control rows of all worlds."""
        self.system.each_real(self.kernels.begin, None, [], [self.system.newton.real])
        self.multiplier.copy_from(self.system.multiplier)

    def judge(self, *, first: bool, tolerance: float, f_scale: float) -> None:
        """Accept or reject the present iterate; needs ``System.imbalance`` with the same ``f_scale``.

        Forces that are not finite at the first one raise a flag, because no step could mend them.
        """
        s = self.system
        if first:
            s.check_finite(s.norm.real, 2)
        s.each(
            s.k_constraint.row_gap,
            s.rows_count,
            [s.displacement.S, s.target.S, s.compliance.S, s.floor.S, s.ceiling.S, s.multiplier.S],
            [s.gap.S],
        )
        inputs = [first, tolerance, self.rounding, self.rounding_force * f_scale]
        inputs += [s.model.segment_count == 0, s.rows_count]
        inputs += [s.model.row_size, s.norm.real, s.gap.real]
        inputs += [s.multiplier.real, s.lower_bound.real, s.upper_bound.real]
        s.each_real(self.kernels.judge, None, inputs, [s.newton.real])

    def keep(self, *, last: bool) -> None:
        """Store accepted and best iterates; after the ``last`` one, worlds that have not converged get their best."""
        s, k, control = self.system, self.kernels, self.system.newton.real
        s.each_real(k.keep, s.dof_rows, [control, s.dof_v.real], [self.reference.real])
        s.each_real(k.keep_best, s.dof_rows, [last, control], [s.dof_v.real, self.best.real])
        s.each_real(k.keep_best, s.rows_count, [last, control], [s.multiplier.real, self.best_multiplier.real])

    def advance(self, h: float) -> None:
        """Move on from the last accepted iterate of every world that has not converged."""
        s = self.system
        s.each_real(self.kernels.check_direction, None, [s.dof_rows, s.u.real], [s.newton.real, self.share.real])
        s.each_real(self.kernels.hold, s.rows_count, [s.newton.real], [s.multiplier.real, self.multiplier.real])
        if s.contact is not None:
            force = s.contact.contacts.multiplier.real
            s.each_real(self.kernels.drop_failed, force.shape[1], [s.newton.real], [force])
        if s.rows_count or s.contact is not None:
            s.imbalance(h, inertia=True)
            s.each_real(self.kernels.refer, None, [s.norm.real], [s.newton.real])
        inputs = [s.newton.real, s.u.real, self.reference.real]
        s.each_real(self.kernels.advance, s.dof_rows, inputs, [self.direction.real, s.dof_v.real])
        inputs = [s.newton.real, self.best.real]
        s.each_real(self.kernels.go_back, s.dof_rows, inputs, [s.dof_v.real, self.reference.real])
        inputs = [s.newton.real, self.best_multiplier.real]
        s.each_real(self.kernels.go_back, s.rows_count, inputs, [s.multiplier.real, self.multiplier.real])


def rounding_force(model: Model) -> float:
    """Force imbalance [N] that rounding of the coordinates to the model's precision causes in tets and rod segments."""
    epsilon = 2.2e-16 if model.precision == "float64" else 1.2e-7
    square = 0.0
    for array in (model.tet_volume, *(() if model.quadratic is None else (model.quadratic.point_volume,))):
        if array.size == 0:
            continue
        mu, lam = lame(model.defaults["youngs"].max(), model.defaults["nu"].max())
        volumes = np.abs(array.numpy()).astype(np.float64)
        square += float(((2.0 * mu + lam) ** 2 * 12.0 * volumes ** (2.0 / 3.0)).sum())
    if model.frames is not None and model.segment_count:
        f = model.frames
        area, length = f.seg_section.numpy()[:, 0].astype(np.float64), f.seg_length.numpy().astype(np.float64)
        square += float(2.0 * ((model.defaults["rod_youngs"].max() * area / length) ** 2).sum())
    return float(epsilon * model.extent * np.sqrt(square))
