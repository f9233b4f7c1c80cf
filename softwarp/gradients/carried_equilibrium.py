"""Soft bodies at rest that rigid bodies and rods carry or that carry these, and gradients of where they are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from softwarp.gradients.frame_equilibrium import by_turn
from softwarp.gradients.mixing import Mixing
from softwarp.gradients.refusals import Diverged
from softwarp.gradients.resting import RestingWorlds
from softwarp.simulation import Simulation

Tensors = Mapping[str, torch.Tensor]
LONG = 1.0e3  # s, of a step without momentum, whose matrix is the tangent of the forces to rounding
STEPS = 60  # such steps, at most
SLOW = (
    0.5  # share of a step, or of what an adjoint leaves, from which the next one goes on from combinations of the last
)
NEAR = 1.0e-3  # way of a step, up to which these are combined
CORRECTIONS = 100  # of an adjoint, at most
WAY = {"float32": 3.0e-6, "float64": 1.0e-11}  # extents, and rad, of the last step
LEFT = {"float32": 1.0e-4, "float64": 1.0e-12}  # of a gradient: what an adjoint may leave
PLACES = ("node_x", "frame_pose")


class CarriedWorlds(RestingWorlds):
    """As many worlds as a simulation has, at rest.

    Static solves of the simulation lead near, steps without momentum to rounding: each is a step of Newton's method
    with the matrix K of a step. The adjoint has the exact tangent R, with levers that turn and the stiffness of taut
    cables: products R' p are those of the adjoint of a step, and K's factor corrects what they leave,

        p += K^-1 (y + R' p).

    Where K is far from R, as under large loads, both go on from combinations of their last steps: ``mixing``.

    Args:
        sim: Soft bodies beside rods and rigid bodies; cables under force control.
    """

    def __init__(self, sim: Simulation) -> None:
        super().__init__(sim, LONG)
        self._find_unknowns()
        self._last: dict[str, torch.Tensor] | None = None
        self._measured = -1

    def _find_unknowns(self) -> None:
        """Where the unknowns of nodes and frames are, and which node moves with which frame."""
        model, frames, device = self.model, self.model.frames, self.state["node_x"].device
        assert frames is not None
        slot = torch.as_tensor(model.dof_node.numpy(), device=device).long()
        self._free = torch.as_tensor(model.dof_free.numpy().reshape(-1, 3) != 0.0, device=device)
        self._nodes = (slot < model.node_count).nonzero().flatten()
        self._node = slot[self._nodes]
        halves = (slot >= model.node_count).nonzero().flatten()
        half = slot[halves] - model.node_count
        inside = half < 2 * frames.count
        self._halves, self._half = halves[inside], half[inside]
        carrier = torch.as_tensor(frames.node_frame.numpy()[: model.node_count], device=device).long()
        self._carried = (carrier >= 0).nonzero().flatten()
        self._carrier = carrier[self._carried]

    def settle(self, given: Tensors, tolerance: float | None, most: int, *, warm: bool) -> torch.Tensor:
        """Bring all worlds to rest; which ones are there, (world,).

        Args:
            given: As of ``follow``.
            tolerance: Way of the last step, in extents and rad; None takes ``WAY``.
            most: Iterations of the static solve.
            warm: Whether to begin where the last equilibrium was.
        """
        limit = WAY[self.model.precision] if tolerance is None else tolerance
        self.follow(given)
        arrived = torch.zeros(self.model.num_worlds, dtype=torch.bool, device=self._free.device)
        if warm and self._last is not None:
            for name, value in self._last.items():
                self.state[name].copy_(value)
            arrived = self._polish(limit)
        if not arrived.all():
            held = {name: self.state[name].clone() for name in PLACES}
            found = self._solve(given, most)
            for name, value in found.items():
                mask = arrived.reshape(-1, *[1] * (value.ndim - 1))
                self.state[name].copy_(torch.where(mask, held[name], value))
            arrived = self._polish(limit)
        self._last = {name: self.state[name].clone() for name in PLACES}
        self.token += 1
        return arrived

    def _solve(self, given: Tensors, most: int) -> dict[str, torch.Tensor]:
        """Where the simulation's own solve leads, which leaves the simulation as it is."""
        sim = self.sim
        before = sim.snapshot()
        try:
            groups = {"control": sim.control.tensors(), "params": sim.params.tensors()}
            for name, value in given.items():
                group, _, own = name.partition(".")
                groups[group].get(own, getattr(getattr(sim, group), own)).copy_(value)
            sim.follow_static(max_iterations=most)
            return {name: value.clone() for name, value in sim.state_tensors().items() if name in PLACES}
        finally:
            sim.restore(before)

    def _rest(self) -> None:
        for name in ("node_v", "frame_twist", "node_memory", "frame_memory"):
            self.state[name].zero_()

    def _polish(self, limit: float) -> torch.Tensor:
        """Steps without momentum, of every world until one goes nowhere; which ones came to that."""
        arrived = torch.zeros(self.model.num_worlds, dtype=torch.bool, device=self._free.device)
        mixing, slow, last = Mixing(len(arrived)), arrived, torch.full_like(self.state["time"], torch.inf)
        for _ in range(STEPS):
            before = {name: self.state[name].clone() for name in PLACES}
            self._rest()
            self._step()
            way = (self.state["node_x"] - before["node_x"]).flatten(1).abs().amax(dim=1) / self.model.extent
            turn = (self.state["frame_pose"] - before["frame_pose"])[..., 3:].flatten(1).abs().amax(dim=1)
            for name, value in before.items():
                mask = arrived.reshape(-1, *[1] * (value.ndim - 1))
                self.state[name].copy_(torch.where(mask, value, self.state[name]))
            size = torch.maximum(way, turn)
            size = torch.where(self.state["status"] == 0, size, torch.inf)  # a step that fails goes nowhere either
            arrived |= size <= limit
            if arrived.all():
                break
            slow, last = slow | (size > SLOW * last), size
            going = slow & ~arrived & (size <= NEAR)
            if going.any():
                self._place(mixing.next(self._placed(before), self._placed(self.state), going), going)
        self._rest()
        return arrived

    def _placed(self, places: Tensors) -> torch.Tensor:
        """Positions in extents and poses of every world, in a row."""
        x, pose = places["node_x"], places["frame_pose"]
        return torch.cat([each.flatten(1) for each in (x / self.model.extent, pose)], dim=1)

    def _place(self, rows: torch.Tensor, going: torch.Tensor) -> None:
        """Put some worlds where ``_placed`` tells them to be."""
        mask = going[:, None, None]
        x, pose = self.state["node_x"], self.state["frame_pose"]
        moved, posed = (
            part.reshape(each.shape)
            for part, each in zip(rows.split([x[0].numel(), pose[0].numel()], dim=1), (x, pose), strict=True)
        )
        x.copy_(torch.where(mask, moved * self.model.extent, x))
        turned = torch.nn.functional.normalize(posed[..., 3:], dim=-1)
        pose.copy_(torch.where(mask, torch.cat([posed[..., :3], turned], dim=-1), pose))

    # Gradients

    def pull(
        self, number: int, given: Tensors, places: dict[str, torch.Tensor], by_x: torch.Tensor, by_pose: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """Gradients by what is given from those by positions of nodes and poses of frames, at an equilibrium.

        Args:
            number: Of the equilibrium; that of the last one stands.
            given: As of ``follow``.
            places: Its positions and poses.
            by_x: (world, node, 3).
            by_pose: (world, frame, 7).

        Raises:
            Diverged: If the adjoint of a world does not come to an end.
        """
        if number != self._measured:
            self.follow(given)
            for name, value in places.items():
                self.state[name].copy_(value)
            self._rest()
            self._measure()
            self._measured = number
        pose = places["frame_pose"]
        turn = by_turn(pose[..., 3:], by_pose[..., 3:])
        place = by_pose[..., :3].clone()
        lever = places["node_x"][:, self._carried] - pose[:, self._carrier, :3]
        push = by_x[:, self._carried]
        place.index_add_(1, self._carrier, push)
        turn = turn.index_add(1, self._carrier, torch.linalg.cross(lever, push))
        y = self._gathered(by_x, torch.stack([place, turn], dim=2))
        self._find_adjoint(y)
        for gradient in self.gradients.values():
            gradient.zero_()
        self._multiply_all()
        named = {n: n.replace("control.", "command_").replace("params.", "") for n in given}
        return {name: self.gradients[own] for name, own in named.items()}

    def _gathered(self, by_x: torch.Tensor, by_halves: torch.Tensor) -> torch.Tensor:
        """Unknowns, (world, 3 dof), from what nodes and both halves of frames have, (world, frame, 2, 3)."""
        found = by_x.new_zeros((len(by_x), *self._free.shape))
        found[:, self._nodes] = by_x[:, self._node]
        found[:, self._halves] = by_halves.flatten(1, 2)[:, self._half]
        return (found * self._free).flatten(1)

    def _find_adjoint(self, y: torch.Tensor) -> None:
        """p with y + h R' p = 0, into the shards."""
        for p in self._p:
            p.zero_()
        size = y.abs().amax(dim=1)
        left, going = y, size > 0.0
        limit, before = LEFT[self.model.precision], size
        mixing, slow = Mixing(len(y)), torch.zeros_like(going)
        for _ in range(CORRECTIONS):
            self._put(torch.where(going[:, None], self.h * left, 0.0), self._imbalance)
            start = self._taken()
            self._correct()
            if (slow & going).any():
                self._put(mixing.next(start, self._taken(), slow & going), self._p)
            for name in PLACES:
                self.gradients[name].zero_()
            self._multiply()
            pose = self.gradients["frame_pose"]
            turn = by_turn(self.state["frame_pose"][..., 3:], pose[..., 3:])
            halves = torch.stack([pose[..., :3], turn], dim=2)
            left = y + self._gathered(self.gradients["node_x"], halves)
            now = left.abs().amax(dim=1)
            going = going & (now > limit * size)
            if not going.any():
                return
            if bool((going & ~(now < 1.0e3 * size)).any()):
                break
            slow, before = slow | (now > SLOW * before), now
        worlds = (going & ~(before <= 1.0e2 * limit * size)).nonzero().flatten().tolist()
        if worlds:
            listed = ", ".join(map(str, worlds[:8])) + (" ..." if len(worlds) > 8 else "")
            raise Diverged(
                f"equilibrium: the gradient of {len(worlds)} worlds ({listed}) is not found by corrections, as near "
                "where something buckles; take milder commands, or a Rollout with damping that comes to rest"
            )

    def _put(self, rows: torch.Tensor, parts: list[torch.Tensor]) -> None:
        """Unknowns, (world, 3 dof), into arrays of the shards, (pack, row, lane)."""
        begin = 0
        for view, count in zip(parts, self._counts, strict=True):
            packs, _, lanes = view.shape
            part = rows.new_zeros((packs * lanes, rows.shape[1]))
            part[:count] = rows[begin : begin + count]
            view.zero_()
            view[:, : rows.shape[1]] = part.reshape(packs, lanes, -1).permute(0, 2, 1)
            begin += count

    def _taken(self) -> torch.Tensor:
        """p of all worlds, as ``_put`` takes it."""
        size = self._free.numel()
        parts = [
            view[:, :size].permute(0, 2, 1).flatten(0, 1)[:count]
            for view, count in zip(self._p, self._counts, strict=True)
        ]
        return torch.cat(parts)


class AtRestTogether(torch.autograd.Function):
    """One solve as one operation: positions of nodes and poses of frames."""

    @staticmethod
    def forward(
        ctx: Any, owner: Any, names: tuple[str, ...], limits: dict[str, Any], *tensors: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Where they are."""
        worlds: CarriedWorlds = owner.carried
        given = dict(zip(names, tensors, strict=True))
        arrived = worlds.settle(given, limits["tolerance"], limits["max_iterations"], warm=owner.warm)
        owner.check(arrived, torch.zeros(len(arrived)))
        places = tuple(worlds.state[name].clone() for name in PLACES)
        ctx.worlds, ctx.names, ctx.number = worlds, names, worlds.token
        ctx.save_for_backward(*places, *tensors)
        return places

    @staticmethod
    def backward(ctx: Any, by_x: torch.Tensor, by_pose: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Gradients by all tensors."""
        x, pose, *tensors = ctx.saved_tensors
        given = dict(zip(ctx.names, tensors, strict=True))
        found = ctx.worlds.pull(ctx.number, given, dict(zip(PLACES, (x, pose), strict=True)), by_x, by_pose)
        return (None, None, None, *(found[name].clone() for name in ctx.names))
