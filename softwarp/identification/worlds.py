"""Candidates as worlds of one simulation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from softwarp import checks
from softwarp.advice import nearest
from softwarp.identification.parameters import FloatArray, Parameter, Space
from softwarp.simulation import Simulation

LAW = "law."  # begins the target of a material's own parameter


class Worlds:
    """Writes candidates into the worlds of a simulation, and reads their measurements.

    With several experiments, as poses under different commands, candidate c has the worlds ``c * experiments`` to
    ``(c + 1) * experiments - 1``, one for each of them.

    Args:
        sim: Its worlds are divided among candidates.
        parameters: Those of the fit, in its order; ``write`` writes those with a ``target``.
        experiments: Worlds of a candidate.

    Attributes:
        candidates: How many there is room for: the ``batch`` of ``fit``.

    Raises:
        ValueError: If there are fewer worlds than experiments, or a target that ``sim.params`` does not have.
    """

    def __init__(self, sim: Simulation, parameters: Sequence[Parameter], *, experiments: int = 1) -> None:
        if not isinstance(sim, Simulation):
            raise TypeError(checks.refusal("Worlds: sim", "be a Simulation", sim))
        self.sim, self.space = sim, Space(parameters)
        self.experiments = checks.count(experiments, "Worlds: experiments", high=sim.num_worlds)
        self.candidates = sim.num_worlds // self.experiments
        self._views = [(i, self._view(p)) for i, p in enumerate(self.space.parameters) if p.target]

    def _view(self, parameter: Parameter) -> Any:
        label = f"parameter {parameter.name!r}"
        if parameter.target.startswith(LAW):
            body = checks.count(parameter.item, f"{label}: item, the body of {parameter.target!r},", low=0)
            return self.sim.law_parameter(body, parameter.target.removeprefix(LAW))[:, None]
        views = self.sim.params.tensors()
        if parameter.target not in views:
            raise ValueError(
                f"{label}: target {parameter.target!r} is no array of sim.params; {nearest(parameter.target, views)}"
            )
        view = views[parameter.target]
        view = view.reshape(len(view), -1)
        if not view.shape[1]:
            raise ValueError(f"{label}: this scene has nothing that target {parameter.target!r} belongs to")
        if parameter.item is None:
            return view
        item = checks.count(
            int(parameter.item), f"{label}: item of {parameter.target!r}", low=0, high=view.shape[1] - 1
        )
        return view[:, item : item + 1]

    def write(self, values: FloatArray) -> None:
        """Write the parameters that have a target.

        Args:
            values: Of exactly ``candidates`` candidates, shape (candidate, parameter).

        Raises:
            ValueError: For another shape, or values that are not finite; nothing is written then.
        """
        array = self._values(values, "write")
        spread = self.spread(array)
        for i, view in self._views:
            view[...] = view.new_tensor(spread[:, i])[:, None]

    def column(self, values: FloatArray, name: str) -> FloatArray:
        """One parameter's value in every world, shape (world,), for what ``write`` does not reach.

        Raises:
            ValueError: If no parameter has the name, or values have another shape.
        """
        if name not in self.space.names:
            raise ValueError(f"Worlds.column: {name!r} is no parameter; {nearest(name, self.space.names)}")
        return self.spread(self._values(values, "column")[:, self.space.names.index(name)])

    def _values(self, values: Any, method: str) -> FloatArray:
        """Values of candidates, (candidate, parameter); how many there are is for ``spread`` to say."""
        return checks.array(values, f"Worlds.{method}: values", (None, len(self.space)))

    def spread(self, per_candidate: FloatArray) -> FloatArray:
        """An array (candidate, ...) as (world, ...); worlds that are left over repeat the last candidate."""
        array = np.asarray(per_candidate, dtype=np.float64)
        if len(array) != self.candidates:
            raise ValueError(
                f"Worlds: {len(array)} candidates for {self.candidates} of {self.sim.num_worlds} worlds; call fit with "
                f"batch={self.candidates}"
            )
        every = np.repeat(array, self.experiments, axis=0)
        rest = np.repeat(every[-1:], self.sim.num_worlds - len(every), axis=0)
        return np.concatenate([every, rest])

    def commands(self, per_experiment: Any) -> FloatArray:
        """Commands (experiment, ...) repeated for every candidate, shape (world, ...)."""
        array = np.asarray(per_experiment, dtype=np.float64)
        if array.ndim == 0 or len(array) != self.experiments:
            need = f"have one row per experiment ({self.experiments})"
            raise ValueError(checks.refusal("Worlds.commands: commands", need, per_experiment))
        return np.resize(array, (self.sim.num_worlds, *array.shape[1:]))

    def gather(self, per_world: Any) -> FloatArray:
        """What was read from the worlds by candidate, shape (candidate, measurement).

        Worlds that failed in their last step become nan, so that a fit leaves their candidate out.

        Args:
            per_world: Array or tensor of any device, shape (world, ...).

        Raises:
            ValueError: If it has no row for every world.
        """
        on_host = per_world.detach().cpu() if hasattr(per_world, "cpu") else per_world
        array = np.asarray(on_host).astype(np.float64)
        if array.ndim == 0 or len(array) != self.sim.num_worlds:
            need = f"have one row per world ({self.sim.num_worlds})"
            raise ValueError(checks.refusal("Worlds.gather: per_world", need, per_world))
        array[self.sim.status.cpu().numpy().reshape(-1) > 0] = np.nan
        used = array[: self.candidates * self.experiments]
        return used.reshape(self.candidates, -1)
