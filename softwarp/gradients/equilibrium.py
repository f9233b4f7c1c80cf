"""Equilibria as a function of torch tensors. How to use it: docs/gradients.md."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from softwarp import checks, interop
from softwarp.gradients.calls import highest_guard
from softwarp.gradients.carried_equilibrium import AtRestTogether, CarriedWorlds
from softwarp.gradients.frame_equilibrium import AtRest, FrameWorlds, after
from softwarp.gradients.refusals import Diverged, require_static_gradient
from softwarp.gradients.replayed import Replayed
from softwarp.gradients.rest import RestShape
from softwarp.gradients.rollout import Markers, fitted, tensors_of
from softwarp.gradients.soft_equilibrium import Corrections
from softwarp.model.gradients import COMMANDS, PARAMETERS, REST, Gradients
from softwarp.model.state import create, worlds_slice
from softwarp.simulation import Simulation
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.static_adjoint import StaticAdjoint
from softwarp.threads import Workers, alone

Tensors = Mapping[str, torch.Tensor]
MOVING = ("rayleigh_mass", "rayleigh_stiffness", "relaxation_ratio", "relaxation_time", "cable_damping", "pair_mu")
RESTING = tuple(name for name in PARAMETERS if name not in MOVING)  # what an equilibrium depends on
FRAME_COMMANDS = ("body_force", "rod_force", "cable_tension")  # what rods and rigid bodies at rest depend on
FRAME_PARAMETERS = ("rod_youngs", "rod_nu", "rod_density", "body_mass", "gravity")


@dataclass(frozen=True)
class Pose:
    """Worlds at rest; all of it carries gradients.

    Attributes:
        node_x: Positions of nodes [m], (world, node, 3).
        cable_tension: Tensions [N], (world, cable).
        cavity_pressure: Pressures of chambers [Pa], (world, chamber).
        marker_x: Positions of markers [m], (world, marker, 3).
        rod_x: Positions of the nodes of rods [m], (world, rod node, 3).
        rod_q: Their orientations, unit quaternions (x, y, z, w), (world, rod node, 4).
        body_pose: Positions [m] and quaternions of rigid bodies, (world, body, 7), where some move or carry.
    """

    node_x: torch.Tensor
    cable_tension: torch.Tensor
    cavity_pressure: torch.Tensor
    marker_x: torch.Tensor
    rod_x: torch.Tensor
    rod_q: torch.Tensor
    body_pose: torch.Tensor


class Equilibrium:
    """A function from commands and parameters to the equilibrium that ``sim.solve_static`` finds for them.

    A solve starts from the state of the simulation, which it leaves as it is. The backward pass costs one
    factorisation, whatever the number of unknowns, and has the exact tangent: its gradients are those of the
    equilibrium, not of the way to it. Further backward passes of the last pose have that factor, too.

    Rods and rigid bodies alone are brought to rest by Newton's method with the exact tangent, where ``solve_static``
    takes steps: first by steps of the simulation, damped as it is, which end in the equilibrium that the motion would.

    Args:
        sim: Soft bodies of linear or quadratic tetrahedra with cables and chambers; or rods and rigid bodies, perhaps
            beside soft bodies without chambers, with cables under force control.
        rest: Make ``rest_x`` one of the parameters: gradients by the rest shape, for design.
        warm: Whether a solve starts from the last one's poses, as of fits, whose parameters change little by little; a
            result depends on those before it within the tolerance then.

    Raises:
        ValueError: If a part of the scene has no gradient; the message names it and the way out.
        MemoryError: If the workspace of the adjoint does not fit on the device.
    """

    @alone
    def __init__(self, sim: Simulation, *, rest: bool = False, warm: bool = False) -> None:
        if not isinstance(sim, Simulation):
            raise TypeError(f"gradients.Equilibrium: sim must be a Simulation, got {checks.shown(sim)}")
        rest = checks.flag(rest, "gradients.Equilibrium: rest")
        self.warm = checks.flag(warm, "gradients.Equilibrium: warm")
        require_static_gradient(sim)
        model = sim.model
        self.sim, self.frames, self.carried, self.shape = sim, None, None, None
        self._markers, self._guard = Markers(model, sim.node_x), highest_guard(model)
        if model.has_moving_frames:
            if rest:
                raise ValueError("gradients.Equilibrium: rods and rigid bodies have no rest shape; leave rest=True out")
            if model.body_count:
                self.carried = CarriedWorlds(sim)
            else:
                self.frames = FrameWorlds(sim)
            return
        arrays = create(Gradients, model)
        self.gradients = interop.views(arrays, model)
        index, systems = AdjointIndex.of(model), sim.make_systems(0, exact=True)
        pulls = [
            StaticAdjoint(system, worlds_slice(arrays, each.start, each.stop), index, rest=rest)
            for each, system in systems
        ]
        workers = Workers(len(pulls)) if len(pulls) > 1 else None
        self._prepare, self._pull = (
            Replayed(model.device, [getattr(pull, name) for pull in pulls], workers) for name in ("prepare", "pull")
        )
        self._corrections = [Corrections(pull) for pull in pulls] if warm else []
        self._last: tuple[torch.Tensor, ...] | None = None  # positions, tensions and pressures
        self._solved, self._prepared = 0, 0  # numbers of equilibria: the last, and the one whose tangent is there
        self.shape = RestShape(model, sim.node_x) if rest else None

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
            controls: ``node_force`` [N], ``rod_force`` and ``body_force`` [N] with moments [N m], ``traction`` [Pa],
                ``cable_displacement`` [m], ``cable_tension`` [N], ``cavity_pressure`` [Pa], ``cavity_volume`` and
                ``cavity_gas`` [m^3], shaped as in ``sim.control`` or so that they broadcast to that; those of the
                simulation where left out.
            parameters: ``youngs``, ``nu``, ``density``, ``gravity``, ``law_parameter``, ``cable_stiffness``,
                ``rod_youngs``, ``rod_nu``, ``rod_density`` and ``body_mass``, likewise of ``sim.params``. With ``rest``
                also ``rest_x`` [m], the rest positions of the model, (node, 3).
            tolerance: As of ``solve_static``. With ``warm``, and of rods and rigid bodies, the last correction, or what
                may be left to go after it, in extents of the scene and rad, None taking 1e-5 in float32 and 1e-10 in
                float64. A gradient is as exact as the equilibrium is.
            max_iterations: As of ``solve_static``, or corrections.

        Returns:
            Positions and tensions at rest.

        Raises:
            ValueError: For names that have no gradient, and shapes that do not fit.
            Diverged: If a world is not in equilibrium afterwards, or has elements that only a guard holds upright;
                the message names the worlds.
        """
        given = {}
        for group, held, names, views in (
            ("control", controls, *self._commands()),
            ("params", parameters, *self._parameters()),
        ):
            said = "controls" if group == "control" else "parameters"
            for name, value in tensors_of(said, held).items():
                given[f"{group}.{name}"] = fitted(said, name, value, names, views)
        limits = {"tolerance": tolerance, "max_iterations": max_iterations}
        if self.carried is not None or self.frames is not None:
            return self._of_frames(given, limits)
        x, tension, pressure = _Rest.apply(self, tuple(given), limits, *given.values())
        none = x.new_zeros((len(x), 0, 7))
        return Pose(x, tension, pressure, self._markers(x), none[..., :3], none[..., 3:], none)

    def _of_frames(self, given: dict[str, torch.Tensor], limits: dict[str, Any]) -> Pose:
        """Rods and rigid bodies at rest, with what moves with others."""
        if limits["tolerance"] is not None:
            checks.number(limits["tolerance"], "equilibrium: tolerance", above=0.0)
        checks.count(limits["max_iterations"], "equilibrium: max_iterations")
        if self.carried is not None:
            worlds: CarriedWorlds | FrameWorlds = self.carried
            x, pose = AtRestTogether.apply(self, tuple(given), limits, *given.values())
        else:
            assert self.frames is not None
            worlds = self.frames
            pose = after(worlds, AtRest.apply(self, tuple(given), limits, *given.values()))
            x = worlds.state["node_x"].clone()
        tension = given.get("control.cable_tension", worlds.control["cable_tension"].clone())
        least, most = (worlds.parameters[f"cable_{name}_tension"].clone() for name in ("min", "max"))
        tension = tension.clamp(least.clamp(min=0.0), most)
        model = worlds.model
        rods = pose[:, model.rigid_count : model.rigid_count + model.rod_node_count]
        none = x.new_zeros((len(x), 0))
        return Pose(
            x, tension, none, self._markers(x, pose), rods[..., :3], rods[..., 3:], pose[:, : model.rigid_count]
        )

    def _commands(self) -> tuple[tuple[str, ...], Tensors]:
        """Names of commands, and what each must look like."""
        if self.carried is not None:
            return ("node_force", "traction", *FRAME_COMMANDS), self.carried.control
        if self.frames is not None:
            return FRAME_COMMANDS, self.frames.control
        return COMMANDS, self.sim.control.tensors()

    def _parameters(self) -> tuple[tuple[str, ...], Tensors]:
        """Names of parameters, and what each must look like."""
        views = self.sim.params.tensors()
        if self.carried is not None:
            return ("youngs", "nu", "density", "law_parameter", *FRAME_PARAMETERS), views
        if self.frames is not None:
            return FRAME_PARAMETERS, views
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

    def settle(self, limits: dict[str, Any]) -> tuple[int, tuple[torch.Tensor, ...]]:
        """Bring the worlds to rest; the number of this equilibrium, and positions, tensions and pressures.

        Raises:
            Diverged: If a world is not at rest.
        """
        sim = self.sim
        arrived = torch.zeros(sim.num_worlds, dtype=torch.bool, device=sim.node_x.device)
        near = tuple(view.clone() for view in self._places()) if self._last is None or not self.warm else self._last
        if self._corrections:
            self._put(near)
            is_near = self._solved > 0 and self._prepared == self._solved
            self._prepared = -1  # another tangent takes the place of that of a pose
            arrived = torch.cat([each.settle(limits["tolerance"], prepared=is_near) for each in self._corrections])
        if not arrived.all():
            held = [view.clone() for view in self._places()]
            masks = [arrived.reshape(-1, *[1] * (view.ndim - 1)) for view in held]
            self._put(tuple(map(torch.where, masks, held, near)))
            converged = sim.follow_static(**limits).converged.to(arrived.device)
            self.check(converged | arrived, sim.compression)
            self._put(tuple(map(torch.where, masks, held, self._places())))
        self.check(torch.ones_like(arrived), sim.compression)
        self._last = tuple(view.clone() for view in self._places())
        self._solved += 1
        return self._solved, self._last

    def _places(self) -> tuple[torch.Tensor, ...]:
        return self.sim.node_x, self.sim.cable_tension, self.sim.cavity_pressure

    def _put(self, held: tuple[torch.Tensor, ...]) -> None:
        for view, value in zip(self._places(), held, strict=True):
            view.copy_(value)
        self.sim.node_v.zero_()

    def pull(self, number: int, held: tuple[torch.Tensor, ...]) -> None:
        """Gradients by an equilibrium become those by commands and parameters, which are in place.

        Args:
            number: Of the equilibrium; the tangent of the last one that was asked for is kept.
            held: Its positions, tensions and pressures.
        """
        self._put(held)
        if number != self._prepared:
            self._prepare()
            self._prepared = number
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
        """Positions, tensions and pressures."""
        sim = owner.sim
        before = sim.snapshot()
        try:
            owner.place(dict(zip(names, tensors, strict=True)))
            held = [*sim.control.tensors().values(), *sim.params.tensors().values()]
            commands = [view.clone() for view in held]
            number, found = owner.settle(limits)
        finally:
            sim.restore(before)
        ctx.owner, ctx.names, ctx.number = owner, names, number
        ctx.save_for_backward(*found, *commands)
        return found

    @staticmethod
    def backward(
        ctx: Any, by_x: torch.Tensor, by_tension: torch.Tensor, by_pressure: torch.Tensor
    ) -> tuple[torch.Tensor | None, ...]:
        """Gradients by all tensors."""
        owner, sim, gradients = ctx.owner, ctx.owner.sim, ctx.owner.gradients
        x, tension, pressure, *commands = ctx.saved_tensors
        before = sim.snapshot()
        try:
            held = [*sim.control.tensors().values(), *sim.params.tensors().values()]
            for view, value in zip(held, commands, strict=True):
                view.copy_(value)
            for view in gradients.values():
                view.zero_()
            gradients["node_x"].copy_(by_x)
            gradients["cable_tension"].copy_(by_tension)
            gradients["cavity_pressure"].copy_(by_pressure)
            owner.pull(ctx.number, (x, tension, pressure))
        finally:
            sim.restore(before)
        if owner.shape is not None:
            held = gradients["node_x"] * owner.shape.held  # fixed nodes are where they are at rest
            found = owner.shape.gradient(*(gradients[name] for name in REST)) + held
            gradients = {**gradients, "rest_x": found}
        own = [name.replace("control.", "command_").replace("params.", "") for name in ctx.names]
        return (None, None, None, *(gradients[name].clone() for name in own))
