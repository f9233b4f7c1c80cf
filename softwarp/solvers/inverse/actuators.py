"""Actuators of inverse control: their rows, and their bounds in every world. Equations: docs/theory/inverse.md."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.inverse import actuator
from softwarp.solvers.workspace import rows
from softwarp.solvers.workspace.shard import Shard

CABLE, CHAMBER, JOINT = range(3)
BOUNDS = (
    "effort_low",
    "effort_high",
    "way_low",
    "way_high",
    "stop_low",
    "stop_high",
    "now",
)  # of inverse.actuator
MAPS = ("base", "spring", "unit")


@dataclass(frozen=True)
class ActuatorPlan:
    """Actuators on the host.

    Attributes:
        row: Row of multipliers.
        kind: CABLE, CHAMBER or JOINT.
        item: Its number among those of its kind.
        is_effort: Whether the command is an effort instead of a displacement.
    """

    row: NDArray[np.int32]
    kind: NDArray[np.int32]
    item: NDArray[np.int32]
    is_effort: NDArray[np.bool_]

    @property
    def count(self) -> int:
        """Actuators."""
        return len(self.row)

    def of(self, kind: int) -> NDArray[np.int32]:
        """Actuators of a kind."""
        return np.flatnonzero(self.kind == kind).astype(np.int32)


class ActuatorBounds:
    """Bounds and units of the actuators of one shard.

    Args:
        shard: Its worlds.
        plan: Actuators.
        period: Time between two commands [s].

    Attributes:
        value: Arrays (world, actuator), float64, by the names in ``BOUNDS`` and ``MAPS``.
    """

    def __init__(self, shard: Shard, plan: ActuatorPlan, period: float) -> None:
        self.shard, self.plan, self.period = shard, plan, period
        self.k = actuator.kernels(shard.variant)
        wide = variant("cuda" if shard.variant.world_fastest else "scalar", "float64")
        self.value: dict[str, wp.array] = {
            name: rows.allocate(wide, shard.world_count, plan.count, shard.device).S for name in (*BOUNDS, *MAPS)
        }
        self.places = {kind: self._place(kind) for kind in (CABLE, CHAMBER, JOINT)}

    def _place(self, kind: int) -> list[wp.array]:
        chosen = self.plan.of(kind)
        device = self.shard.device
        return [wp.array(values, dtype=wp.int32, device=device) for values in (chosen, self.plan.item[chosen])]

    def measure(self) -> None:
        """Bounds at the present state; needs rows and multipliers."""
        for kind, launch in ((CABLE, self._cables), (CHAMBER, self._chambers), (JOINT, self._joints)):
            if self.places[kind][0].size:
                launch(self.places[kind])

    def _cables(self, places: list[wp.array]) -> None:
        s, i = self.shard, self.shard.input
        inputs = [s.world_count, self.period, *places, s.model.cable_force_control]
        names = ("min_displacement", "max_displacement", "min_tension", "max_tension", "max_rate")
        inputs += [i[f"cable_{name}"].real for name in names]
        inputs += [s.work.displacement.real, s.work.multiplier.real]
        s.each_real(self.k.cable_bounds, places[0].size, inputs, self._outputs("unit"))

    def _chambers(self, places: list[wp.array]) -> None:
        s, i, m = self.shard, self.shard.input, self.shard.model.cavities
        assert m is not None
        inputs = [s.world_count, self.period, s.model.first_row("cavity"), *places, m.cavity_control, m.cavity_area]
        names = ("min_pressure", "max_pressure", "max_pressure_rate", "min_volume", "max_volume", "max_flow")
        inputs += [i[f"cavity_{name}"].real for name in names]
        inputs += [s.work.displacement.real, s.work.multiplier.real]
        s.each_real(self.k.chamber_bounds, places[0].size, inputs, self._outputs("unit"))

    def _joints(self, places: list[wp.array]) -> None:
        s, i, m = self.shard, self.shard.input, self.shard.model.joints
        assert m is not None
        inputs = [s.world_count, self.period, *places, m.joint_control, m.joint_scale]
        names = ("stiffness", "max_force", "max_rate", "min_position", "max_position", "position")
        inputs += [i[f"joint_{name}"].real for name in names]
        inputs.append(i["command_joint_force"].real)
        s.each_real(self.k.joint_bounds, places[0].size, inputs, self._outputs(*MAPS))

    def _outputs(self, *maps: str) -> list[Any]:
        return [self.value[name] for name in (*BOUNDS, *maps)]
