"""Inverse problem of a shard's worlds: compliance between actuators and effectors, and the efforts that follow.

Equations: docs/theory/inverse.md, docs/theory/effector.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.inverse import effector, program
from softwarp.model.codes import FAR
from softwarp.model.model import Model
from softwarp.solvers.collision import contact_list
from softwarp.solvers.inverse.actuators import MAPS, ActuatorBounds, ActuatorPlan
from softwarp.solvers.inverse.laws import PIVOTS, Laws
from softwarp.solvers.inverse.settling import Settling
from softwarp.solvers.multipliers import ContactResponse
from softwarp.solvers.system import System
from softwarp.solvers.workspace import rows

EQUILIBRIUM = 1.0e3  # s, length of an implicit step without momentum that ends in equilibrium
SOFTNESS = 1.0e-6  # squared distance of an effector that is worth as much as that of a displacement from its bound


@dataclass(frozen=True)
class EffectorPlan:
    """Rows of all effectors of a model, on the host.

    Attributes:
        kind, frame, length: Of every effector; ``kernels.inverse.effector``.
        value_start, value_marker, value_weight: Markers whose weighted sum a point is.
        entry_start: Entries of every effector.
        entry_dof, entry_weight, entry_frame: Dof, weight, and the master whose rotation it is, or -1.
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
    entry_weight: NDArray[np.float64]
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
    """

    horizon: float
    momentum: bool
    period: float
    energy: float
    share: float
    max_step: float
    tolerance: float
    settle: float = 0.0


class InverseSystem:
    """Workspace and launches for one shard.

    Args:
        system: A system of its own with room for ``effectors.row_count`` more sides; to settle, one that is exact.
        effectors: What is to reach its target.
        actuators: What may be used for it.
        options: Settings.
        target: Targets of this shard's worlds, (world, ``kernels.inverse.effector.TARGET_ROWS`` effector).

    Attributes:
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
        model = system.model
        self.first_effector = system.rows_count
        self.effector_rows = 3 * effectors.count
        self.first_contact = self.first_effector + self.effector_rows
        self.response = self._make_response(model)
        name = "cuda" if system.variant.world_fastest else "scalar"
        self.wide = variant(name, "float64")
        self.k_effector = effector.kernels(system.variant)
        self.k = program.kernels(system.variant)
        self._upload()
        passive = np.setdiff1d(self.response.bounded.numpy(), actuators.row)
        passive = passive[passive < self.first_effector]
        has_laws = passive.size > 0 or self.response.capacity > 0
        self.laws = Laws(self, passive.tolist()) if has_laws else None
        self._allocate()
        self.settling = Settling(self, options.settle) if options.settle > 0.0 else None

    def _make_response(self, model: Model) -> ContactResponse:
        """Compliances of rows, effectors and contacts; effectors are rows that never have a multiplier."""
        s = self.system
        none = contact_list.allocate(s.variant, s.world_count, 0, s.device)
        held = set() if s.joints is None else set(s.joints.unbounded)  # rigid servos among them
        return ContactResponse(
            model.symbolic,
            s.index,
            model.dof_free,
            s.variant,
            s.world_count,
            s.rows_count + self.effector_rows,
            none if s.contact is None else s.contact.contacts,
            s.device,
            unbounded=sorted(held - set(self.actuators.row.tolist())),
            panels=s.linear.panels,
        )

    def _upload(self) -> None:
        s, e, a = self.system, self.effectors, self.actuators

        def integer(values: NDArray[Any]) -> wp.array:
            return wp.array(values, dtype=wp.int32, device=s.device)

        def real(values: NDArray[np.float64], dtype: Any = None) -> wp.array:
            return wp.array(values, dtype=dtype or s.variant.real, device=s.device)

        self.entry = [
            integer(values) for values in (np.repeat(np.arange(e.count), np.diff(e.entry_start)), e.entry_dof)
        ]
        self.entry += [real(e.entry_weight), integer(e.entry_frame)]
        self.entry += [integer(e.part_start), integer(e.part_item), real(e.part_weight)]
        self.value = [integer(e.kind), integer(e.frame), real(e.length)]
        self.value += [integer(e.value_start), integer(e.value_marker), real(e.value_weight)]
        self.value += [integer(e.entry_start), integer(e.entry_dof)]
        self.row_weight = real(e.row_weight, wp.float64)
        self.actuator_row, self.is_effort = integer(a.row), integer(a.is_effort)

    def _allocate(self) -> None:
        s, n, e = self.system, self.actuators.count, self.effector_rows
        self.bounded_rows = q = 2 * n + (0 if self.laws is None else self.laws.count)
        self.row = s._rows(9 * max(len(self.effectors.entry_dof), 1))
        self.error = s._rows(e)

        def wide(count: int, dtype: Any = wp.float64) -> wp.array:
            return rows.allocate(self.wide, s.world_count, max(count, 1), s.device, dtype).S

        self.bound = ActuatorBounds(s, self.actuators, self.options.period)
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
        self.soft.assign(np.broadcast_to(softness, (s.world_count, q)))

    # Stages

    def solve(self) -> None:
        """Commands from the present state."""
        if self.settling is None:
            self.linearise()
        else:
            self.settling.linearise(self.options.horizon)
        self.bound.measure()
        self.optimise()
        if self.settling is not None:
            self.settling.adjust()

    def linearise(self) -> None:
        """Compliances and gaps of all rows at the present state and multipliers, into ``response``."""
        s, o, y, r = self.system, self.options, self.system.linear.y, self.response
        h = o.horizon
        s.load()
        s.scale(h)
        s.measure_rows()
        s.command(h)
        if s.joints is not None and not o.momentum:
            s.joints.measure()  # where they are, instead of where their velocities lead
        s.find_contacts(o.period, moving=False, falling=False)  # a robot that stands does not fall in a long period
        if s.rows_count:
            s.place(s.compliance, s.rows_count, r.compliance, 0)
        s.forces()
        s.tangent()
        s.right_hand_side(h, inertia=o.momentum, moving=False)
        s.linear.factor(s.a)
        y.zero()
        s.rows_into_sides()
        self.place_effectors()
        s.each(s.k.accumulate, s.dof_rows, [s.b.S], [y.S])
        s._start_unknowns(y)
        s.add_row_forces(y, h)
        r.add_forces(y, h)
        r.sides(s.linear)
        s.linear.forward(1 + s.rows_count + self.effector_rows)
        r.delassus(y, h * h)
        s._free_gaps(y, h, r.gap)
        self.measure_effectors(h)
        r.gaps(y, u=s.u, v=s.dof_v, v0=s.dof_v0, x_scale=h, recovery=FAR, bounce_speed=FAR)
        r.eliminate_gaps(s.multiplier)

    def optimise(self) -> None:
        """The quadratic program, and commands from its solution."""
        s, o, k, b = self.system, self.options, self.k, self.bound.value
        n, e = self.actuators.count, self.effector_rows
        inputs = [n, e, self.first_effector, self.response.order, s.world_count, self.actuator_row]
        inputs += [self.response.matrix.real, self.response.gap.real, s.target.real, s.multiplier.real]
        inputs += [b[name] for name in ("effort_low", "effort_high", "way_low", "way_high")]
        outputs = [self.effort, self.effect, self.compliance, self.way, self.gap, self.low, self.high]
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
        inputs = [n, e, o.tolerance, o.max_step, o.share, self.row_weight, self.is_effort]
        inputs += [s.overflow.real, self.outcome]
        inputs += [self.multiplier, self.effort, self.effect, self.compliance, self.way, self.gap, self.low, self.high]
        inputs += [b[name] for name in ("way_low", "way_high", "stop_low", "stop_high", "now", *MAPS)]
        outputs = [self.x, self.predicted, self.displacement, self.command, self.status]
        self._each(k.conclude, inputs, outputs)

    def _solve_program(self) -> None:
        """Efforts for the blocks that were collected."""
        o, k, n, q = self.options, self.k, self.actuators.count, self.bounded_rows
        inputs = [n, 2 * n, self.effector_rows, o.energy, o.max_step, self.row_weight]
        inputs += [self.effect, self.compliance, self.gap]
        self._each(k.assemble, inputs, [self.hessian, self.linear, self.normal])
        inputs = [n, q, self.hessian, self.linear, self.normal, self.low, self.high, self.soft]
        outputs = [self.chol, self.half, self.size, self.gram, self.rate, self.step, self.active, self.sign]
        self._each(k.dual_active_set, inputs, [*outputs, self.multiplier, self.x, self.outcome])

    def place_effectors(self) -> None:
        """Rows of the effectors, and their transpose among the right-hand sides."""
        s, state = self.system, self.system.state
        inputs = [s.world_count, s.lanes, s.model.dof_count, 1 + self.first_effector, *self.entry, s.model.dof_free]
        inputs += [state.marker_x, state.node_x, state.frame_pose]
        entries = len(self.effectors.entry_dof)
        s.each_real(self.k_effector.effector_rows, entries, inputs, [self.row.real, s.linear.y.real])

    def measure_effectors(self, x_scale: float = 0.0) -> None:
        """Distances now, and as gaps those after the motion of the half-solved right-hand side."""
        s, state, y = self.system, self.system.state, self.system.linear.y
        inputs = [s.world_count, s.lanes, s.model.dof_count, self.first_effector, *self.value]
        inputs += [state.marker_x, state.frame_pose, self.target, self.row.real, s.u.real, y.real]
        outputs = [self.error.real, self.response.gap.real]
        s.each_real(self.k_effector.effector_gap, self.effectors.count, [*inputs, x_scale], outputs)

    def _each(self, kernel: Any, inputs: list[Any], outputs: list[Any]) -> None:
        s = self.system
        wp.launch(kernel, dim=s.world_count, inputs=inputs, outputs=outputs, device=s.device)
