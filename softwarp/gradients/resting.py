"""Worlds of their own that equilibria with rods and rigid bodies are found in: views, products with the tangent, steps.

How they come to rest is said by ``FrameWorlds``, where nothing is soft, and by ``CarriedWorlds``.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
import warp as wp

from softwarp.gradients.replayed import Replayed
from softwarp.gradients.worlds import OwnArrays
from softwarp.simulation import Simulation
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.frame_tangent import FrameTangent
from softwarp.solvers.implicit_euler import ImplicitEuler
from softwarp.threads import Workers

Tensors = Mapping[str, torch.Tensor]


class RestingWorlds:
    """As many worlds as a simulation has.

    Args:
        sim: What to follow.
        h: Step of products with the tangent and of steps [s].

    Attributes:
        state, control, parameters: Views of these worlds' arrays.
        gradients: Views of ``Gradients``.
        token: Number of the equilibrium that the worlds are in.
    """

    def __init__(self, sim: Simulation, h: float) -> None:
        self.sim, self.model, self.h, self.token = sim, sim.model, h, 0
        model, room = sim.model, OwnArrays(sim.model)
        self.state, self.control, self.parameters, self.gradients = room.views
        twins, index = sim.make_twins(*room.worlds), AdjointIndex.of(model)
        tangents = [FrameTangent(system, h, room.part(each), index) for each, system in twins]
        steppers = [ImplicitEuler(system, h) for _, system in twins]
        workers = Workers(len(twins)) if len(twins) > 1 else None
        self._measure, self._multiply, self._multiply_all, self._correct = (
            Replayed(model.device, [getattr(tangent, name) for tangent in tangents], workers)
            for name in ("measure", "multiply", "multiply_all", "correct")
        )
        self._step = Replayed(model.device, [stepper.step for stepper in steppers], workers)
        self._refresh = Replayed(model.device, [system.refresh for _, system in twins], workers)
        self._counts = [each.stop - each.start for each, _ in twins]
        self._p, self._imbalance = (
            [wp.to_torch(getattr(tangent, name).real, requires_grad=False) for tangent in tangents]
            for name in ("p", "imbalance")
        )

    def follow(self, given: Tensors) -> None:
        """Take over what the simulation has, and what is given by names as ``control.cable_tension``."""
        sources = self.sim.state_tensors(), self.sim.control.tensors(), self.sim.params.tensors()
        for views, held in zip((self.state, self.control, self.parameters), sources, strict=True):
            for name, value in held.items():
                if name in views:
                    views[name].copy_(value)
        self.give(given)

    def give(self, given: Tensors) -> None:
        """Put what is given in place."""
        groups = {"control": self.control, "params": self.parameters}
        for name, value in given.items():
            group, _, own = name.partition(".")
            groups[group][own].copy_(value)
