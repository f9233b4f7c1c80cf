"""Equilibria as a function of torch tensors. How to use it: docs/gradients.md."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from softwarp import checks, interop
from softwarp.gradients.calls import highest_guard
from softwarp.gradients.refusals import Diverged, require_static_gradient
from softwarp.gradients.rest import RestShape
from softwarp.gradients.rollout import Markers, fitted, tensors_of
from softwarp.gradients.worlds import Replayed
from softwarp.model.gradients import COMMANDS, PARAMETERS, REST, Gradients
from softwarp.model.state import create, worlds_slice
from softwarp.simulation import Simulation
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.static_adjoint import StaticAdjoint
from softwarp.threads import Workers, alone

Tensors = Mapping[str, torch.Tensor]
RESTING = tuple(
    name for name in PARAMETERS if name not in ("rayleigh_mass", "rayleigh_stiffness", "cable_damping", "pair_mu")
)  # what an equilibrium depends on


@dataclass(frozen=True)
class Pose:
    """Worlds at rest; all of it carries gradients.

    Attributes:
        node_x: Positions of nodes [m], (world, node, 3).
        cable_tension: Tensions [N], (world, cable).
        marker_x: Positions of markers [m], (world, marker, 3).
    """

    node_x: torch.Tensor
    cable_tension: torch.Tensor
    marker_x: torch.Tensor


class Equilibrium:
    """A function from commands and parameters to the equilibrium that ``sim.solve_static`` finds for them.

    A solve starts from the state of the simulation, which it leaves as it is. The backward pass costs one
    factorisation, whatever the number of unknowns, and has the exact tangent: its gradients are those of the
    equilibrium, not of the way to it.

    Args:
        sim: Soft bodies of linear or quadratic tetrahedra with cables and chambers under pressure control.
        rest: Make ``rest_x`` one of the parameters: gradients by the rest shape, for design.

    Raises:
        ValueError: If a part of the scene has no gradient; the message names it and the way out.
        MemoryError: If the workspace of the adjoint does not fit on the device.
    """

    @alone
    def __init__(self, sim: Simulation, *, rest: bool = False) -> None:
        if not isinstance(sim, Simulation):
            raise TypeError(f"gradients.Equilibrium: sim must be a Simulation, got {checks.shown(sim)}")
        rest = checks.flag(rest, "gradients.Equilibrium: rest")
        require_static_gradient(sim)
        model = sim.model
        self.sim = sim
        arrays = create(Gradients, model)
        self.gradients = interop.views(arrays, model)
        index, systems = AdjointIndex.of(model), sim.make_systems(0, exact=True)
        pulls = [
            StaticAdjoint(system, worlds_slice(arrays, each.start, each.stop), index, rest=rest)
            for each, system in systems
        ]
        workers = Workers(len(pulls)) if len(pulls) > 1 else None
        self._pull = Replayed(model.device, [pull.step for pull in pulls], workers)
        self._markers = Markers(model, sim.node_x)
        self.shape = RestShape(model, sim.node_x) if rest else None
        self._guard = highest_guard(model)

    def __call__(
        self,
        controls: Tensors | None = None,
        parameters: Tensors | None = None,
        *,
        tolerance: float | None = None,
        max_iterations: int = 200,
    ) -> Pose:
        """Find the equilibria of all worlds.

        Args:
            controls: ``node_force`` [N], ``traction`` [Pa], ``cable_displacement`` [m], ``cable_tension`` [N] and
                ``cavity_pressure`` [Pa], shaped as in ``sim.control`` or so that they broadcast to that; those of the
                simulation where left out.
            parameters: ``youngs``, ``nu``, ``density``, ``gravity``, ``law_parameter`` and ``cable_stiffness``,
                likewise of ``sim.params``. With ``rest`` also ``rest_x`` [m], the rest positions of the model,
                (node, 3).
            tolerance: As of ``solve_static``. A gradient is as exact as the equilibrium is.
            max_iterations: As of ``solve_static``.

        Returns:
            Positions and tensions at rest.

        Raises:
            ValueError: For names that have no gradient, and shapes that do not fit.
            Diverged: If a world is not in equilibrium afterwards, or has elements that only a guard holds upright;
                the message names the worlds.
        """
        given = {}
        for group, held, names, views in (
            ("control", controls, COMMANDS, self.sim.control.tensors()),
            ("params", parameters, *self._parameters()),
        ):
            said = "controls" if group == "control" else "parameters"
            for name, value in tensors_of(said, held).items():
                given[f"{group}.{name}"] = fitted(said, name, value, names, views)
        limits = {"tolerance": tolerance, "max_iterations": max_iterations}
        x, tension = _Rest.apply(self, tuple(given), limits, *given.values())
        return Pose(x, tension, self._markers(x))

    def _parameters(self) -> tuple[tuple[str, ...], Tensors]:
        """Names of parameters, and what each must look like."""
        views = self.sim.params.tensors()
        if self.shape is None:
            return RESTING, views
        shape = self.shape.x.expand(self.sim.num_worlds, *self.shape.x.shape)
        return (*RESTING, "rest_x"), {**views, "rest_x": shape}

    def place(self, given: Tensors) -> None:
        """Put commands and parameters in place."""
        groups = {"control": self.sim.control.tensors(), "params": self.sim.params.tensors()}
        for name, value in given.items():
            group, _, own = name.partition(".")
            if own == "rest_x" and self.shape is not None:
                self.shape.check(value)
            else:
                groups[group][own].copy_(value)

    def pull(self) -> None:
        """Gradients by the present state, an equilibrium, become those by commands and parameters."""
        self._pull()

    def check(self, converged: torch.Tensor, compression: torch.Tensor) -> None:
        """Refuse worlds whose gradient would mean nothing."""
        pressed = compression.cpu() > 1.0 - self._guard
        told = (
            (~converged, "did not come to rest: take milder commands, or more max_iterations"),
            (pressed, "have elements so flat that the guard of their law holds them, whose tangent is not exact"),
        )
        for found, reason in told:
            worlds = found.nonzero().flatten().tolist()
            if worlds:
                listed = ", ".join(map(str, worlds[:8])) + (" ..." if len(worlds) > 8 else "")
                raise Diverged(f"equilibrium: {len(worlds)} of {len(found)} worlds ({listed}) {reason}")


class _Rest(torch.autograd.Function):
    """One static solve as one operation."""

    @staticmethod
    def forward(
        ctx: Any, owner: Equilibrium, names: tuple[str, ...], limits: dict[str, Any], *tensors: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Positions and tensions."""
        sim = owner.sim
        before = sim.snapshot()
        try:
            owner.place(dict(zip(names, tensors, strict=True)))
            held = [*sim.control.tensors().values(), *sim.params.tensors().values()]
            commands = [view.clone() for view in held]
            found = sim.solve_static(**limits)
            owner.check(found.converged, sim.compression)
            x, tension, pressure = sim.node_x.clone(), sim.cable_tension.clone(), sim.cavity_pressure.clone()
        finally:
            sim.restore(before)
        ctx.owner, ctx.names = owner, names
        ctx.save_for_backward(x, tension, pressure, *commands)
        return x, tension

    @staticmethod
    def backward(ctx: Any, by_x: torch.Tensor, by_tension: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Gradients by all tensors."""
        owner, sim, gradients = ctx.owner, ctx.owner.sim, ctx.owner.gradients
        x, tension, pressure, *commands = ctx.saved_tensors
        before = sim.snapshot()
        try:
            held = [*sim.control.tensors().values(), *sim.params.tensors().values()]
            for view, value in zip(held, commands, strict=True):
                view.copy_(value)
            sim.node_x.copy_(x)
            sim.node_v.zero_()
            sim.cable_tension.copy_(tension)
            sim.cavity_pressure.copy_(pressure)
            for view in gradients.values():
                view.zero_()
            gradients["node_x"].copy_(by_x)
            gradients["cable_tension"].copy_(by_tension)
            owner.pull()
        finally:
            sim.restore(before)
        if owner.shape is not None:
            held = gradients["node_x"] * owner.shape.held  # fixed nodes are where they are at rest
            found = owner.shape.gradient(*(gradients[name] for name in REST)) + held
            gradients = {**gradients, "rest_x": found}
        own = [name.replace("control.", "command_").replace("params.", "") for name in ctx.names]
        return (None, None, None, *(gradients[name].clone() for name in own))
