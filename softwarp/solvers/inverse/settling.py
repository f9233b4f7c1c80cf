"""Exact sensitivities of soft bodies with cables for inverse control, and the last millimetres to a target.

Equations: docs/theory/settling.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.inverse import settling
from softwarp.solvers.quasi_static import QuasiStatic
from softwarp.solvers.workspace import rows

if TYPE_CHECKING:
    from softwarp.solvers.inverse.system import InverseSystem

STILL = 1.0  # s for which a target must not have moved before the worlds settle at it


class Settling:
    """Linearisation by the exact tangent, and the law for the neighbourhood of a target.

    Args:
        owner: Inverse problem on a coupled model (``assembly_plan.coupled``), with tangents that are not clamped.
        radius: Distance [m] from a target below which a world settles.
    """

    def __init__(self, owner: InverseSystem, radius: float) -> None:
        self.owner, self.radius = owner, radius
        system, e = owner.system, owner.effector_rows
        self.static = QuasiStatic(system)
        self.k = settling.kernels(system.variant)
        self.count = count = system.rows_count
        self.patience = max(1, round(STILL / owner.options.period))
        self.entry_start = wp.array(owner.effectors.entry_start, dtype=wp.int32, device=system.device)
        self.effect = rows.allocate(system.variant, system.world_count, e * (1 + count), system.device)
        wide = variant("cuda" if system.variant.world_fastest else "scalar", "float64")

        def allocate(items: int, dtype: Any = wp.float64) -> wp.array:
            return rows.allocate(wide, system.world_count, items, system.device, dtype).S

        self.matrix, self.motion = allocate(count * count), allocate(count * e)
        self.gram, self.side = allocate(e * e), allocate(2 * e)
        self.seen, self.still = allocate(owner.target.shape[1], system.variant.real), allocate(1, wp.int32)

    def linearise(self, h: float) -> None:
        """Columns of the actuators in W, and gaps, as in an implicit step of length ``h`` [s], with its momentum.

        A / h^2 takes the place of A, as the exact parts of the tangent come without a factor.
        """
        s, o = self.owner.system, self.owner
        s.load()
        s.scale(h)
        s.measure_rows()
        s.command(h)
        s.forces()
        s.tangent()
        s.right_hand_side(h, inertia=o.options.momentum, moving=False)
        s.each_real(self.k.multiply, s.a.real.shape[1], [1.0 / (h * h)], [s.a.real])
        s.each_real(self.k.multiply, s.dof_rows, [1.0 / h], [s.b.real])
        self._respond(loaded=True)
        o.measure_effectors()
        inputs = [self.count, o.response.order, s.gap.real, self.static.compliance.real, self.effect.real]
        s.each_real(self.k.spread, self.count + o.effector_rows, inputs, [o.response.matrix.real, o.response.gap.real])

    def adjust(self) -> None:
        """Replace the commands of worlds near a target that stands still; needs ``linearise`` and commands."""
        s, o = self.owner.system, self.owner
        s.scale(0.0)
        s.body["mass"].zero()
        s.tangent()
        self._respond(loaded=False)
        wp.launch(
            self.k.wait,
            dim=s.world_count,
            inputs=[s.world_count, o.target.shape[1], o.target],
            outputs=[self.seen, self.still],
            device=s.device,
        )
        inputs = [self.count, o.effector_rows, s.world_count, s.model.cable_force_control, o.row_weight]
        inputs += [self.static.compliance.real, self.effect.real, s.multiplier.real]
        s.each_real(self.k.sensitivity, None, inputs, [self.matrix, self.motion])
        inputs = [o.actuators.count, o.effector_rows, s.world_count, self.patience, self.radius]
        inputs += [o.options.tolerance, o.options.max_step, o.actuator_row, o.row_weight, o.error.real]
        names = ("command_cable_displacement", "cable_min_displacement", "cable_max_displacement")
        inputs += [s.multiplier.real, *(s.input[name].real for name in names)]
        inputs += [o.compliance, self.motion, self.still]
        s.each_real(self.k.settle, None, inputs, [self.gram, self.side, o.command, o.status])

    def _respond(self, *, loaded: bool) -> None:
        """Exact A, its factors, and the response to all efforts; ``loaded`` to the forces in ``b`` as well."""
        s, static, y = self.owner.system, self.static, self.owner.system.linear.y
        static.complete_tangent()
        static.lu.factor(s.a, static.a_upper)
        y.zero()
        s.rows_into_sides()
        if loaded:
            s.each(s.k.accumulate, s.dof_rows, [s.b.S], [y.S])
            s.add_row_forces(y, 1.0)
        static.lu.solve(1 + self.count)
        static.measure_compliance()
        o = self.owner
        if loaded:
            o.place_effectors()
        inputs = [s.model.dof_count, 1 + self.count, self.entry_start, o.entry[1], o.row.real, y.real]
        s.each_real(self.k.effector_response, o.effector_rows, inputs, [self.effect.real])
