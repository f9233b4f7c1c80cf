"""Inverse control: commands that bring effectors to targets, for all worlds at once. Theory: docs/theory/inverse.md."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from softwarp import checks, interop
from softwarp.control.actuators import plan_actuators
from softwarp.control.effectors import Effector, PointEffector, check_effectors, plan_effectors
from softwarp.kernels.inverse import effector
from softwarp.model.fields import allocate
from softwarp.plan.compile import coupled
from softwarp.simulation import Simulation
from softwarp.solvers.inverse.actuators import CABLE, CHAMBER, JOINT
from softwarp.solvers.inverse.grip import Grip
from softwarp.solvers.inverse.problem import InverseOptions
from softwarp.solvers.inverse.system import EQUILIBRIUM, InverseSystem
from softwarp.threads import alone

COMMANDS = {
    (CABLE, False): "cable_displacement",
    (CABLE, True): "cable_tension",
    (CHAMBER, False): "cavity_volume",
    (CHAMBER, True): "cavity_pressure",
    (JOINT, False): "joint_target",
    (JOINT, True): "joint_force",
}  # in ``sim.control``, by kind of actuator and whether an effort is commanded


def _positive(value: float, name: str, **limits: Any) -> float:
    return checks.number(value, f"inverse control: {name}", above=0.0, **limits)


@dataclass(frozen=True)
class Solution:
    """What ``InverseController.solve`` found; one row per world.

    Attributes:
        command: Commands in the order of the actuators, in their units, (world, actuator).
        effort: Efforts in equilibrium with the targets, as multipliers of the rows [N]: tensions; pressures times the
            area of their chamber; torques over the length that the joint's rows are scaled by; (world, actuator).
        error: Distance of every effector to its target that is predicted [m], (world, effector).
        outcome: ``Outcome``, int32, (world,).
    """

    command: Tensor
    effort: Tensor
    error: Tensor
    outcome: Tensor


class InverseController:
    """Finds at every call the commands that bring effectors as near to their targets as bounds allow.

    The worlds are linearised at their present state, as in an implicit step of length ``horizon``; a controller that is
    asked again and again corrects what this misses. Commands of displacements stay within the limits of their actuators
    and change no faster than their rates. Where more actuators than needed are at hand, they share the work with the
    least energy.

    Args:
        sim: Simulation; its commands are written by ``apply``.
        effectors: Markers, ``PointEffector`` or ``OrientationEffector``.
        cables: Cables that may be used; None takes all. The same for the next two.
        chambers: Air chambers under pressure or volume control.
        joints: Joints with a motor.
        period: Time between two calls [s]; None takes one step.
        horizon: Time [s] in which to be at the target, velocities taken along; None takes ``period``, and infinity
            looks for commands under which the robot comes to rest there; not with motors, without which a joint
            does not hold.
        energy: Weight of the actuators' energy; larger ones prefer small efforts to small distances.
        share: Part of the change that is commanded at once, up to 1; all of it keeps slender bodies swinging.
        max_step: Longest way [m] that effectors are asked to go at once; None takes a twentieth of the scene's extent.
        tolerance: Distance [m] from a target that counts as reached.
        settle: Distance [m] from a target that stands still below which lengths of cables are changed by the exact
            sensitivity in equilibrium; None never does. For slender bodies that their own cables compress so much that
            they would buckle, were not the lengths held. Also makes the ordinary linearisation exact. Needs cables
            under length control as the only actuators, on soft bodies alone.
        contact: Let contacts answer to what the actuators do. False leaves them out of the prediction: what is touched
            by things that weigh next to nothing, as a ball in a maze, is steered faster, and as well.
        grip: What the robot holds by friction, and how firmly. None lets the energy that it costs loosen the grip.

    Raises:
        ValueError: For effectors or actuators that do not exist, or a setting outside its range.
    """

    @alone
    def __init__(
        self,
        sim: Simulation,
        effectors: Sequence[Effector | int],
        *,
        cables: Sequence[int] | None = None,
        chambers: Sequence[int] | None = None,
        joints: Sequence[int] | None = None,
        period: float | None = None,
        horizon: float | None = None,
        energy: float = 1.0e-4,
        share: float = 0.35,
        max_step: float | None = None,
        tolerance: float = 1.0e-4,
        settle: float | None = None,
        contact: bool = True,
        grip: Grip | None = None,
    ) -> None:
        self.sim = sim
        model = sim.model
        if model.reduction is not None and settle is not None:
            raise ValueError("inverse control: settle does not know reduced bodies; leave it out, or do not reduce")
        self.effectors = check_effectors(effectors, model)
        if model.floating_count:
            raise ValueError(
                "inverse control: it does not know reduced bodies with a floating frame; use a reduction with "
                "frame='fixed', or the full model"
            )
        period = sim.dt if period is None else _positive(period, "period")
        horizon = period if horizon is None else _positive(horizon, "horizon", infinite=True)
        self.options = InverseOptions(
            horizon=EQUILIBRIUM if horizon == math.inf else horizon,
            momentum=horizon != math.inf,
            period=period,
            energy=_positive(energy, "energy"),
            share=_positive(share, "share", high=1.0),
            max_step=0.05 * model.extent if max_step is None else _positive(max_step, "max_step"),
            tolerance=_positive(tolerance, "tolerance"),
            settle=0.0 if settle is None else _positive(settle, "settle"),
            contact=checks.flag(contact, "inverse control: contact"),
            grip=grip,
        )
        self._check_grip()
        self.actuators = plan_actuators(model, cables, chambers, joints)
        if horizon == math.inf:
            self._check_equilibrium()
        if settle is not None:
            self._check_settling()
        plan = plan_effectors(self.effectors, model if settle is None else coupled(model))
        rows = effector.TARGET_ROWS * plan.count
        self._target = allocate(sim.num_worlds, rows, sim.variant.real, model.device)
        self._target_view = interop.view(self._target, plan.count, effector.TARGET_ROWS)
        self._plan = plan
        self._make_systems()

    def _make_systems(self) -> None:
        """Systems for the simulation as it is; made anew when its room for contacts has grown."""
        plan, is_exact = self._plan, self.options.settle > 0.0
        self._room = self.sim.model.contact_capacity
        self._systems = [
            (worlds, InverseSystem(system, plan, self.actuators, self.options, self._target[worlds]))
            for worlds, system in self.sim.make_systems(3 * plan.count, exact=is_exact)
        ]
        self._is_compiled = False
        self._graphs: list[Any] | None = None

    def _check_grip(self) -> None:
        """A grip needs contacts that answer, and a pair that is there."""
        grip, pairs = self.options.grip, self.sim.model.pair_count
        if grip is None:
            return
        if not pairs or not self.options.contact:
            raise ValueError("inverse control: a grip needs contacts that are looked at: a contact pair, contact=True")
        if grip.pair >= pairs:
            raise ValueError(f"inverse control: grip: pair must be below the scene's {pairs}, got {grip.pair}")

    def _check_equilibrium(self) -> None:
        """Without its motor a joint moves freely: no equilibrium is near the state from which predictions start."""
        motors = self.actuators.item[self.actuators.kind == JOINT]
        if motors.size:
            name = self.sim.model.joint_names[motors[0]]
            raise ValueError(
                f"inverse control: an infinite horizon needs a robot that stands without its actuators; joint {name!r} "
                "does not hold without its motor: give a finite horizon, or name cables or chambers"
            )

    def _check_settling(self) -> None:
        model, plan = self.sim.model, self.actuators
        parts: dict[str, object] = {"rigid bodies or rods": model.frames, "chambers": model.cavities}
        parts |= {"membranes": model.membranes, "contact": model.contact}
        held = [name for name, part in parts.items() if part is not None]
        if held:
            raise ValueError(f"inverse control: settle needs a scene of soft bodies and cables; this one has {held[0]}")
        if plan.is_effort.any():
            name = model.cable_names[plan.item[plan.is_effort][0]]
            raise ValueError(f"inverse control: settle needs cables under length control; {name!r} is not, name others")
        if self.options.horizon == EQUILIBRIUM:
            raise ValueError("inverse control: settle goes with a finite horizon; leave horizon out")

    @property
    def command_names(self) -> list[str]:
        """Names of the actuators, in the order of the commands."""
        model, plan = self.sim.model, self.actuators
        names = (model.cable_names, model.cavity_names, model.joint_names)
        return [names[kind][item] for kind, item in zip(plan.kind, plan.item, strict=True)]

    def positions(self) -> Tensor:
        """Where the point effectors are [m], (world, point, 3)."""
        points = [e for e in self.effectors if isinstance(e, PointEffector)]
        if not points:
            return self.sim.marker_x[:, :0]
        return torch.stack([self.sim.marker_x[:, list(e.markers)].mean(dim=1) for e in points], dim=1)

    def solve(self, targets: Tensor, *, apply: bool = True) -> Solution:
        """Commands towards targets, from the present state.

        Args:
            targets: Positions [m] of point effectors and quaternions x y z w of orientations, in the order of the
                effectors: (world, 3) for one point, (world, effector, 3) for points, (world, effector, 4) for any.
            apply: Write the commands to ``sim.control``.

        Raises:
            ValueError: If the targets have another shape.
        """
        self._set_targets(targets)
        if self._room != self.sim.model.contact_capacity:
            self._make_systems()
        if self._is_compiled and self._graphs is None and interop.records(self.sim.device):
            self._graphs = [self._capture(system) for _, system in self._systems]  # not on torch's default stream
        if self._graphs is None:  # the first call compiles kernels, which a capture cannot
            with interop.on_torch_stream(self.sim.device):
                for _, system in self._systems:
                    system.solve()
            self._is_compiled = True
        else:
            with interop.replaying(self.sim.device):
                for graph in self._graphs:
                    wp.capture_launch(graph)
        solution = self._collect()
        if apply:
            self.apply(solution)
        return solution

    def apply(self, solution: Solution) -> None:
        """Write commands to ``sim.control``."""
        self.write(solution.command)

    def write(self, command: Tensor) -> None:
        """Write commands (world, actuator), in the order of the actuators, to ``sim.control``."""
        for view, items, chosen in self._commanded():
            view[:, items] = command[:, chosen].to(view.dtype)

    def present(self) -> Tensor:
        """Commands that stand in ``sim.control``, in the order of the actuators, float64 (world, actuator)."""
        found = torch.zeros((self.sim.num_worlds, self.actuators.count), dtype=torch.float64, device=self.sim.device)
        for view, items, chosen in self._commanded():
            found[:, chosen] = view[:, items].to(found.dtype)
        return found

    def _commanded(self) -> Iterator[tuple[Tensor, NDArray[np.int32], NDArray[np.int64]]]:
        """Views of ``sim.control`` with the actuators in them: columns, and places among all actuators."""
        plan, control = self.actuators, self.sim.control.tensors()
        for (kind, is_effort), name in COMMANDS.items():
            chosen = np.flatnonzero((plan.kind == kind) & (plan.is_effort == is_effort))
            if chosen.size:
                yield control[name], plan.item[chosen], chosen

    def _capture(self, system: InverseSystem) -> Any:
        with interop.capturing(self.sim.device) as capture:
            system.solve()
        return capture.graph

    def _set_targets(self, targets: Tensor) -> None:
        worlds, count = self.sim.num_worlds, len(self.effectors)
        given = torch.as_tensor(targets)
        if given.ndim == 2 and count == 1:
            given = given[:, None]
        sizes = {len("xyz") if isinstance(e, PointEffector) else effector.TARGET_ROWS for e in self.effectors}
        if given.ndim != 3 or given.shape[:2] != (worlds, count) or not max(sizes) <= given.shape[2] <= 4:
            raise ValueError(
                f"inverse control: targets must have shape ({worlds}, {count}, {max(sizes)}), got {tuple(given.shape)}"
            )
        self._target_view[..., : given.shape[2]] = given.to(self._target_view)

    def _collect(self) -> Solution:
        def gather(name: str) -> Tensor:
            parts = [wp.to_torch(getattr(system.problem, name), requires_grad=False) for _, system in self._systems]
            return torch.cat(parts)

        rows = gather("predicted")
        counts = torch.as_tensor(self._systems[0][1].problem.effectors.row_weight > 0.0, device=rows.device)
        error = (rows * counts).unflatten(1, (-1, 3)).norm(dim=-1)
        return Solution(gather("command"), gather("x"), error, gather("status")[:, 0])
