"""Motion of the full model that a reduction learns from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from softwarp import checks, notices
from softwarp.model.codes import CavityControl, Status
from softwarp.reduction.packing import images
from softwarp.simulation import Simulation

FloatArray = NDArray[np.float64]
Drive = Callable[[Simulation, int], None]
TOGETHER = 2_000_000  # distances that are looked at together


@dataclass(frozen=True)
class Motion:
    """States of a batch of worlds, one after the other.

    Attributes:
        positions: All nodes of the scene [m], (snapshot, node, 3).
        travel: How far every actuator went in it, by the actuator's name: the range of a cable's displacement [m], of a
            chamber's volume [m^3]; 0 where a commanded tension or pressure never changed, whatever others moved.
        touch: Forces of contacts at the nodes of soft bodies nearest to them [N], like positions; None without contact.
    """

    positions: NDArray[np.floating[Any]]
    travel: Mapping[str, float] = field(default_factory=dict)
    touch: NDArray[np.floating[Any]] | None = None

    def __len__(self) -> int:
        """Snapshots."""
        return len(self.positions)

    def chosen(self, count: int, seed: int = 0) -> Motion:
        """Some of the snapshots, drawn without replacement; all where there are fewer."""
        if count >= len(self):
            return self
        return self._at(np.sort(np.random.default_rng(seed).choice(len(self), count, replace=False)))

    def split(self, share: float = 0.2, seed: int = 0) -> tuple[Motion, Motion]:
        """Snapshots to learn from, and others, a ``share`` of all, to test with."""
        order = np.random.default_rng(seed).permutation(len(self))
        cut = len(self) - max(round(share * len(self)), 1)
        return self._at(np.sort(order[:cut])), self._at(np.sort(order[cut:]))

    def _at(self, index: NDArray[Any]) -> Motion:
        return Motion(self.positions[index], self.travel, None if self.touch is None else self.touch[index])

    def symmetric(self, rest: NDArray[np.floating], axis: int = 1) -> Motion:
        """Every state averaged with its mirror image in the plane where a coordinate is 0.

        For robots and commands that are mirror images of themselves: modes then are too, and hold no sideways motion
        that rounding brought into the states.

        Args:
            rest: Nodes at rest [m], (node, 3); the mirror must map them to themselves.
            axis: Coordinate that the mirror turns round.

        Raises:
            ValueError: If a node has no mirror image.
        """
        sign = np.where(np.arange(3) == axis, -1.0, 1.0)
        image = images(rest, sign)

        def averaged(values: NDArray[np.float32]) -> NDArray[np.float32]:
            return (0.5 * (values + values[:, image] * sign)).astype(np.float32)

        touch = None if self.touch is None else averaged(self.touch)
        return Motion(averaged(self.positions), self.travel, touch)

    def joined(self, *others: Motion) -> Motion:
        """These snapshots, then others."""
        travel = dict(self.travel)
        for other in others:
            for name, way in other.travel.items():
                travel[name] = max(travel.get(name, 0.0), way)
        parts = (self, *others)
        touch = None
        if any(part.touch is not None for part in parts):
            none = [np.zeros_like(part.positions) if part.touch is None else part.touch for part in parts]
            touch = np.concatenate(none)
        return Motion(np.concatenate([part.positions for part in parts]), travel, touch)


class Watch:
    """Collects states of a simulation as it runs.

    Args:
        sim: The full model.
    """

    def __init__(self, sim: Simulation) -> None:
        self.sim = sim
        self.parts: list[NDArray[np.float32]] = []
        self.touch: list[NDArray[np.float32]] = []
        self.low: dict[str | tuple[str, str], float] = {}  # by the name of an actuator, and by that of its effort
        self.high: dict[str | tuple[str, str], float] = {}

    def look(self) -> None:
        """Keep the present state of all worlds that have not failed."""
        sim = self.sim
        good = sim.status < int(Status.NONFINITE)
        self.parts.append(sim.node_x[good].float().cpu().numpy())
        if sim.model.contact is not None:
            self.touch.append(_touch(sim)[good].float().cpu().numpy())
        m = sim.model
        seen = ("cable", m.cable_names, sim.cable_displacement), ("chamber", m.cavity_names, sim.cavity_volume)
        for kind, names, values in seen:
            for k, name in enumerate(names):
                self._stretch(name, values[good, k])
                if (effort := _effort(sim, kind, k)) is not None:
                    self._stretch((name, "effort"), effort[good])

    def _stretch(self, key: str | tuple[str, str], column: torch.Tensor) -> None:
        """Widen the range of what goes by a key."""
        if column.numel():
            self.low[key] = min(self.low.get(key, np.inf), float(column.min()))
            self.high[key] = max(self.high.get(key, -np.inf), float(column.max()))

    def finish(self) -> Motion:
        """What was seen.

        Raises:
            ValueError: If there is nothing.
        """
        if not self.parts:
            raise ValueError("no state was recorded; look() at a running simulation first")
        way = {key: self.high[key] - self.low[key] for key in self.low}
        travel = {key: way[key] if way.get((key, "effort"), 1.0) else 0.0 for key in way if isinstance(key, str)}
        return Motion(np.concatenate(self.parts), travel, np.concatenate(self.touch) if self.touch else None)


def _touch(sim: Simulation) -> torch.Tensor:
    """Forces of the last contacts [N], (world, node, 3), each at the nearest node of a soft body that it acts on."""
    contact, start = sim.model.contact, sim.model.body_node_start
    assert contact is not None
    found = torch.zeros_like(sim.node_x)
    for number, parts in enumerate(contact.parts):
        world, place = torch.nonzero(sim.contact_pair == number, as_tuple=True)
        for part, sign in zip(parts, (1.0, -1.0), strict=True):
            if part.kind != "soft body" or world.numel() == 0:
                continue
            first, end = int(start[int(part)]), int(start[int(part) + 1])
            near = _nearest(sim.node_x[:, first:end], world, sim.contact_point[world, place])
            load = sign * sim.contact_load[world, place].to(found)
            found.index_put_((world, first + near), load, accumulate=True)
    return found


def _nearest(nodes: torch.Tensor, world: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Numbers of the nodes, (world, node, 3), next to points that lie in some worlds, (point,)."""
    together = max(TOGETHER // max(nodes.shape[1], 1), 1)
    parts = zip(world.split(together), points.to(nodes).split(together), strict=True)
    return torch.cat([(nodes[w] - p[:, None]).square().sum(dim=2).argmin(dim=1) for w, p in parts])


def record(sim: Simulation, drive: Drive, steps: int, *, every: int = 10) -> Motion:
    """Run a simulation under commands and keep its states.

    Args:
        sim: The full model, of any number of worlds; all of them count.
        drive: Called before each step with the simulation and the step's number; writes ``sim.control``.
        steps: Steps to take.
        every: Steps from one state that is kept to the next.

    Raises:
        TypeError: If ``drive`` cannot be called.
        ValueError: For counts below 1, or if every world failed at all times.
    """
    if not callable(drive):
        raise TypeError(checks.refusal("record: drive", "be a function of the simulation and the step's number", drive))
    checks.count(steps, "steps")
    checks.count(every, "every")
    watch = Watch(sim)
    for step in range(steps):
        drive(sim, step)
        sim.step()
        if (step + 1) % every == 0 or step + 1 == steps:
            watch.look()
        notices.progress("recording motion", f"step {step + 1} of {steps}, {sim.num_worlds} worlds")
    notices.progress_ends()
    motion = watch.finish()
    if len(motion) == 0:
        raise ValueError("every world failed while motion was recorded; ask for less, or take smaller steps")
    return motion


def sweep(
    sim: Simulation,
    *,
    cables: Mapping[str, tuple[float, float]] | None = None,
    cavities: Mapping[str, tuple[float, float]] | None = None,
    hold: int = 50,
    seed: int = 0,
) -> Drive:
    """Commands that take the named actuators through their ranges, each world on a way of its own.

    Every ``hold`` steps each actuator is given another target, drawn evenly from its range, and goes there in a line.

    Args:
        sim: The simulation to be driven.
        cables: Least and largest displacement [m] (under force control: tension [N]) of cables, by their names.
        cavities: Least and largest pressure [Pa], or volume or gas [m^3], of chambers, by their names.
        hold: Steps from one target to the next.
        seed: Of the draws.

    Raises:
        ValueError: For a name that the scene does not have, or without any actuator.
    """
    checks.count(hold, "hold")
    generator = torch.Generator().manual_seed(checks.seed(seed, "sweep: seed"))
    model = sim.model
    found: list[tuple[torch.Tensor, int, tuple[float, float]]] = []
    for kind, given, names in (("cable", cables, model.cable_names), ("chamber", cavities, model.cavity_names)):
        for name, limits in _ranges(kind, given).items():
            if name not in names:
                raise ValueError(f"sweep: there is no {kind} {name!r}; the scene has {', '.join(names) or 'none'}")
            number = names.index(name)
            found.append((_command(sim, kind, number), number, limits))
    if not found:
        raise ValueError(
            f"sweep: name at least one cable or chamber with its range, got cables {cables!r}, cavities {cavities!r}"
        )
    goals = _targets(found, sim.num_worlds, generator)
    starts = [values[:, number].clone() for values, number, _ in found]

    def drive(_: Simulation, step: int) -> None:
        nonlocal goals, starts
        if step % hold == 0 and step > 0:
            starts, goals = goals, _targets(found, sim.num_worlds, generator)
        part = (step % hold + 1) / hold
        for (values, number, _range), start, goal in zip(found, starts, goals, strict=True):
            values[:, number] = start + part * (goal - start)

    return drive


def _ranges(kind: str, given: Any) -> dict[str, tuple[float, float]]:
    """Names and ranges of actuators, checked."""
    what = {"cable": "cables", "chamber": "cavities"}[kind]
    if given is not None and not isinstance(given, Mapping):
        raise ValueError(checks.refusal(f"sweep: {what}", "give a (low, high) for each name", given))
    found = {}
    for name, limits in (given or {}).items():
        low, high = checks.array(limits, f"sweep: {what}, (low, high) of {name!r},", (2,)).tolist()
        if low > high:
            raise ValueError(checks.refusal(f"sweep: {what}, range of {name!r},", "be (low, high), low first", limits))
        found[name] = (low, high)
    return found


def _command(sim: Simulation, kind: str, number: int) -> torch.Tensor:
    """Command that moves an actuator."""
    commands = sim.control.tensors()
    if kind == "cable":
        is_force = bool(sim.model.cable_force_controlled[number])
        return commands["cable_tension" if is_force else "cable_displacement"]
    assert sim.model.cavities is not None
    control = int(sim.model.cavities.cavity_control.numpy()[number])
    return commands[("cavity_pressure", "cavity_volume", "cavity_gas")[control]]


def _effort(sim: Simulation, kind: str, number: int) -> torch.Tensor | None:
    """Commanded tension or pressure, (world,), which moves nothing while it stays; None where a way is commanded."""
    m = sim.model
    if kind == "cable":
        commands_effort = bool(m.cable_force_controlled[number])
    else:
        assert m.cavities is not None
        commands_effort = int(m.cavities.cavity_control.numpy()[number]) == CavityControl.PRESSURE
    return _command(sim, kind, number)[:, number] if commands_effort else None


def _targets(
    found: Sequence[tuple[torch.Tensor, int, tuple[float, float]]], worlds: int, generator: torch.Generator
) -> list[torch.Tensor]:
    return [low + (high - low) * torch.rand(worlds, generator=generator).to(v) for v, _, (low, high) in found]
