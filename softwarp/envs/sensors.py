"""Sensors: what of a simulation an environment tells besides its observation, one key each.

Every sensor is a function of a simulation that returns numbers (world, k). They run within captured steps: they neither
read the device back nor make tensors of Python's numbers.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Sequence
from functools import partial

import torch
from torch import Tensor

from softwarp.envs.options.base import SENSORS
from softwarp.envs.sums import total
from softwarp.simulation import Simulation
from softwarp.stresses import von_mises

LIMIT = 1.0e30  # of what is told, in the sensor's unit: float32 holds it


def _by_body(sim: Simulation, value: Tensor) -> Tensor:
    """Largest value and volume mean of every soft body, (world, element) -> (world, body, 2)."""
    meter = sim.element_meter
    columns = []
    for body in range(sim.model.body_count):
        part = meter.slice(body)
        share = meter.volume[part]
        mean = total(value[:, part] * share) / share.sum()
        columns.append(torch.stack([value[:, part].amax(dim=1), mean], dim=1))
    return torch.stack(columns, dim=1)


def _stress(sim: Simulation) -> Tensor:
    return _by_body(sim, von_mises(sim.element_stress()))


def _strain(sim: Simulation) -> Tensor:
    return _by_body(sim, total(sim.element_strain().square().flatten(2)).sqrt())


def _reaction(sim: Simulation) -> Tensor:
    found = sim.reactions()
    starts = sim.model.body_node_start.tolist()
    parts = [total(found.node[:, a:b].movedim(1, -1)) for a, b in itertools.pairwise(starts)]
    if sim.model.rod_count:
        parts.append(total(found.rod[..., :3].movedim(1, -1)))
    return torch.cat([*parts, found.body.flatten(1)], dim=1)


def _energy(sim: Simulation) -> Tensor:
    return torch.stack([sim.elastic_energy(), sim.kinetic_energy()], dim=1)


READ: dict[str, Callable[[Simulation], Tensor]] = {
    "stress": _stress,
    "strain": _strain,
    "reaction": _reaction,
    "energy": _energy,
    "contact_force": lambda sim: sim.pair_force,
    "cable_tension": lambda sim: sim.cable_tension,
    "cable_length": lambda sim: sim.cable_length,
    "cavity_pressure": lambda sim: sim.cavity_pressure,
    "cavity_volume": lambda sim: sim.cavity_volume,
    "joint_position": lambda sim: sim.joint_position,
    "joint_force": lambda sim: sim.joint_force,
    "joint_reaction": lambda sim: sim.joint_reaction,
}


def readable(sim: Simulation) -> dict[str, Callable[[], Tensor]]:
    """All sensors that a scene can have, whether its environment tells them or not: name -> reads (world, k, ...)."""
    return {name: partial(READ[name], sim) for name, needs in SENSORS.items() if sim.model.items(needs)}


class Sensors:
    """The sensors that an environment was asked for.

    Args:
        owner: Of whom messages speak.
        sim: Simulation.
        names: Keys of ``envs.options.base.SENSORS``.
        taken: Keys that observations have already.

    Raises:
        ValueError: For a sensor of parts that the scene does not have, or with the name of an observation.
    """

    def __init__(self, owner: str, sim: Simulation, names: Sequence[str], taken: Collection[str] = ()) -> None:
        self.sim = sim
        if double := [name for name in names if name in taken]:
            raise ValueError(f"{owner}: sensors: {double[0]!r} is a key of the observation already; leave it out")
        absent = [name for name in names if not sim.model.items(SENSORS[name])]
        if absent:
            possible = [name for name, needs in SENSORS.items() if sim.model.items(needs)]
            raise ValueError(
                f"{owner}: sensors: {absent[0]!r} has nothing to tell, as the scene has no {SENSORS[absent[0]]}; "
                f"it can have {', '.join(possible)}"
            )
        self._read = {name: READ[name] for name in names}

    def read(self) -> dict[str, Tensor]:
        """What all sensors tell now, float32, name -> (world, k)."""
        return {name: read(self.sim).flatten(1).to(torch.float32) for name, read in self._read.items()}

    def bounds(self) -> dict[str, tuple[Tensor, Tensor]]:
        """Finite lower and upper bounds per sensor, each of shape (k,)."""
        highest = {name: torch.full_like(value[0], LIMIT) for name, value in self.read().items()}
        return {name: (-high, high) for name, high in highest.items()}
