"""What the parts of inverse control share for one shard: plans, options, the response to all rows, and arrays.

Equations: docs/theory/inverse.md, docs/theory/effector.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.inverse import effector, labels
from softwarp.solvers.collision import contact_list
from softwarp.solvers.inverse.actuators import ActuatorBounds, ActuatorPlan
from softwarp.solvers.inverse.grip import Grip
from softwarp.solvers.response import ContactResponse
from softwarp.solvers.subspace import touch_struct
from softwarp.solvers.system import System
from softwarp.solvers.workspace import rows

SOFTNESS = 1.0e-6  # squared distance of an effector that is worth as much as that of a displacement from its bound
GRIP_SOFTNESS = 1.0e4  # N^2/m^2, likewise: a newton that a grip lacks is worth a centimetre


@dataclass(frozen=True)
class EffectorPlan:
    """Rows of all effectors of a model, on the host.

    Attributes:
        kind, frame, length: Of every effector; ``kernels.inverse.effector``.
        value_start, value_marker, value_weight: Markers whose weighted sum a point is.
        entry_start: Entries of every effector.
        entry_dof, entry_block, entry_frame: Dof, its block of H (9), and the master whose rotation it is, or -1.
        part_start, part_item, part_weight: What a rotation carries: markers, or nodes as -1 - node.
        row_weight: Weight of every row, 0 for an axis that is free.
    """

    kind: NDArray[np.int32]
    frame: NDArray[np.int32]
    length: NDArray[np.float64]
    value_start: NDArray[np.int32]
    value_marker: NDArray[np.int32]
    value_weight: NDArray[np.float64]
    entry_start: NDArray[np.int32]
    entry_dof: NDArray[np.int32]
    entry_block: NDArray[np.float64]
    entry_frame: NDArray[np.int32]
    part_start: NDArray[np.int32]
    part_item: NDArray[np.int32]
    part_weight: NDArray[np.float64]
    row_weight: NDArray[np.float64]

    @property
    def count(self) -> int:
        """Effectors."""
        return len(self.kind)


@dataclass(frozen=True)
class InverseOptions:
    """Settings of the inverse problem.

    Attributes:
        horizon: Length of the implicit step that is looked ahead [s].
        momentum: Whether it takes velocities along; without, a long one ends in equilibrium.
        period: Time between two commands, for rates [s].
        energy: Weight of the actuators' energy, relative to that of the distance.
        share: Part of the change of efforts or displacements that is commanded.
        max_step: Longest way that effectors are asked to go in one solve [m].
        tolerance: Distance to a target that counts as none [m].
        settle: Distance to a target below which the exact sensitivity in equilibrium leads [m]; 0 does without.
        contact: Whether contacts answer to what the actuators do.
        grip: What the robot holds by friction.
    """

    horizon: float
    momentum: bool
    period: float
    energy: float
    share: float
    max_step: float
    tolerance: float
    settle: float = 0.0
    contact: bool = True
    grip: Grip | None = None


class InverseProblem:
    """Rows, response and arrays of the inverse problem of one shard.

    Args:
        system: A system of its own with room for ``effectors.row_count`` more sides; to settle, one that is exact.
        effectors: What is to reach its target.
        actuators: What may be used for it.
        options: Settings.
        target: Targets of this shard's worlds, (world, ``kernels.inverse.effector.TARGET_ROWS`` effector).

    Attributes:
        response: Compliances of rows, effectors and contacts; effectors are rows that never have a multiplier.
        passive: Static rows that are neither actuators nor eliminated.
        laws: Inequalities of passive rows and contacts; rows of the program after those of the actuators.
        command: Commands in the actuators' units, float64, (world, actuator).
        status: ``model.codes.Outcome``, (world, 1).
        predicted: Distance of every effector row to its target that is predicted [m], (world, row).
    """

    def __init__(
        self,
        system: System,
        effectors: EffectorPlan,
        actuators: ActuatorPlan,
        options: InverseOptions,
        target: wp.array,
    ) -> None:
        self.system, self.options, self.target = system, options, target
        self.effectors, self.actuators = effectors, actuators
        self.first_effector = system.rows.count
        self.effector_rows = 3 * effectors.count
        self.first_contact = self.first_effector + self.effector_rows
        self.response = self._make_response()
        self.wide = variant("cuda" if system.variant.world_fastest else "scalar", "float64")
        self.k_effector = effector.kernels(system.variant)
        self._upload()
        passive = np.setdiff1d(self.response.bounded.numpy(), actuators.row)
        self.passive = passive[passive < self.first_effector].tolist()
        self.laws = len(self.passive) + labels.CONTACT_LAWS * self.response.capacity
        self._allocate()

    def _make_response(self) -> ContactResponse:
        s, contact = self.system, self.system.contact if self.options.contact else None
        none = contact_list.allocate(s.variant, s.world_count, 0, s.model.device)
        return ContactResponse(
            s.model.symbolic,
            s.index,
            s.model.dof_free,
            s.variant,
            s.world_count,
            s.rows.count + self.effector_rows,
            none if contact is None else contact.contacts,
            s.model.device,
            unbounded=sorted(set(s.unbounded) - set(self.actuators.row.tolist())),  # rigid servos among them
            panels=s.linear.panels,
            touch=None if contact is None else touch_struct(s.shard),
            subspace=None if contact is None else contact.subspace,
        )

    def _upload(self) -> None:
        s, e, a = self.system, self.effectors, self.actuators

        def integer(values: NDArray[Any]) -> wp.array:
            return wp.array(values, dtype=wp.int32, device=s.model.device)

        def real(values: NDArray[np.float64], dtype: Any = None) -> wp.array:
            return wp.array(values, dtype=dtype or s.variant.real, device=s.model.device)

        self.entry = [
            integer(values) for values in (np.repeat(np.arange(e.count), np.diff(e.entry_start)), e.entry_dof)
        ]
        self.entry += [real(e.entry_block), integer(e.entry_frame)]
        self.entry += [integer(e.part_start), integer(e.part_item), real(e.part_weight)]
        self.value = [integer(e.kind), integer(e.frame), real(e.length)]
        self.value += [integer(e.value_start), integer(e.value_marker), real(e.value_weight)]
        self.value += [integer(e.entry_start), integer(e.entry_dof)]
        self.entry_start = integer(e.entry_start)
        self.row_weight = real(e.row_weight, wp.float64)
        self.actuator_row, self.is_effort = integer(a.row), integer(a.is_effort)

    def _allocate(self) -> None:
        shard, n, e, wide = self.system.shard, self.actuators.count, self.effector_rows, self.doubles
        self.bounded_rows = q = 2 * n + self.laws + (self.options.grip is not None)
        self.row = shard.rows(9 * max(len(self.effectors.entry_dof), 1))
        self.error = shard.rows(e)
        self.bound = ActuatorBounds(shard, self.actuators, self.options.period)
        self.effort, self.way, self.x = wide(n), wide(n), wide(n)
        self.effect, self.compliance, self.gap = wide(e * n), wide(n * n), wide(2 * e)
        self.low, self.high, self.soft = wide(q), wide(q), wide(q)
        self.hessian, self.linear, self.normal = wide(n * n), wide(n), wide(q * n)
        self.chol, self.half, self.size, self.gram = wide(n * n), wide(q * n), wide(q), wide(q * q)
        self.rate, self.step, self.sign, self.multiplier = wide(q), wide(n + q), wide(q), wide(q)
        self.active, self.outcome = wide(q, wp.int32), wide(1, wp.int32)
        self.predicted, self.displacement, self.command = wide(e), wide(n), wide(n)
        self.status = wide(1, wp.int32)
        softness = np.concatenate([np.zeros(n), np.full(q - n, SOFTNESS)])
        softness[2 * n + self.laws :] = GRIP_SOFTNESS
        self.soft.assign(np.broadcast_to(softness, (shard.world_count, q)))

    def doubles(self, count: int, dtype: Any = wp.float64) -> wp.array:
        """Zeroed array (world, row) of at least one row in float64, or of another type."""
        s = self.system
        return rows.allocate(self.wide, s.world_count, max(count, 1), s.model.device, dtype).S

    def each_world(self, kernel: Any, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel of single worlds."""
        s = self.system
        wp.launch(kernel, dim=s.world_count, inputs=inputs, outputs=outputs, device=s.model.device)

    def place_effectors(self) -> None:
        """Rows of the effectors, and their transpose among the right-hand sides."""
        s, state = self.system.shard, self.system.state
        inputs = [s.world_count, s.lanes, s.model.dof_count, 1 + self.first_effector, *self.entry, s.model.dof_free]
        inputs += [state.marker_x, state.node_x, state.frame_pose]
        outputs = [self.row.real, self.system.linear.y.real]
        s.each_real(self.k_effector.effector_rows, len(self.effectors.entry_dof), inputs, outputs)

    def measure_effectors(self, x_scale: float = 0.0) -> None:
        """Distances now, and as gaps those after the motion of the half-solved right-hand side."""
        s, state, y = self.system.shard, self.system.state, self.system.linear.y
        inputs = [s.world_count, s.lanes, s.model.dof_count, self.first_effector, *self.value]
        inputs += [state.marker_x, state.frame_pose, self.target, self.row.real, s.work.u.real, y.real]
        outputs = [self.error.real, self.response.gap.real]
        s.each_real(self.k_effector.effector_gap, self.effectors.count, [*inputs, x_scale], outputs)
