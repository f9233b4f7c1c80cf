"""Forward mode by rows: a step's Jacobian, one adjoint for each number that the step finds, times directions.

What has an adjoint has this forward mode: rods, rigid bodies, joints and their motors, and what touches them. All
directions share the rows of a step, so that it pays where results are many and the state is small; soft bodies alone
have a tangent of their own, ``solvers.directional``. Theory: docs/theory/adjoint.md.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np
import torch

from softwarp.gradients.kept import KeptSolutions
from softwarp.model.floating import RIGID, FloatingModel
from softwarp.model.gradients import FRAMES, PARAMETERS, REST
from softwarp.model.model import Model
from softwarp.model.reduction import ReductionModel
from softwarp.simulation import Simulation

Slopes = dict[str, torch.Tensor]


class Worlds(Protocol):
    """What ``DifferentiableWorlds`` gives to take a step and to pull gradients back through it."""

    sim: Simulation
    model: Model
    h: float
    arrays: tuple[str, ...]
    names: Sequence[str]
    state: Slopes
    gradients: Slopes
    kept_solutions: KeptSolutions

    @property
    def solution_bytes(self) -> int:
        """What the solution of one step takes [B]."""
        ...

    def take(self) -> None:
        """Take a step."""
        ...

    def kept(self) -> Slopes:
        """Copies of the state."""
        ...

    def place(self, state: Slopes) -> None:
        """Put these in place."""
        ...

    def pull(self, solution: Sequence[torch.Tensor] | None = None, *, parameters: bool = True) -> None:
        """Gradients by the end of a step become those by its start."""
        ...


class Shapes:
    """Displacements of the nodes of reduced bodies in their modes.

    Args:
        model: Scene.
        like: Precision and device.

    Attributes:
        node: Nodes of reduced bodies.
    """

    def __init__(self, model: Model, like: torch.Tensor) -> None:
        r = model.reduction
        assert r is not None
        node, body, start, basis = (part.numpy() for part in (r.node, r.node_body, r.node_basis, r.basis))
        modes = np.zeros((len(node), 3, r.count))
        for i, (k, at) in enumerate(zip(body, start, strict=True)):
            first, end = r.start[k], r.start[k + 1]
            skip = 0 if r.floating is None else RIGID * int(k in r.floating.number.numpy())  # rigid modes come apart
            modes[i, :, first + skip : end] = basis[at : at + 3 * r.stride[k]].reshape(3, -1)[:, skip : end - first]
        self.node, self._modes = torch.as_tensor(node, device=like.device).long(), torch.as_tensor(modes).to(like)

    def __call__(self, amplitudes: torch.Tensor) -> torch.Tensor:
        """Displacements (..., node, 3) from (..., mode); sums one after the other: the same bits in every batch."""
        total: torch.Tensor = amplitudes[..., 0, None, None] * self._modes[..., 0]
        for mode in range(1, self._modes.shape[-1]):
            total += amplitudes[..., mode, None, None] * self._modes[..., mode]
        return total


class FrameSlopes:
    """Nodes of bodies with a floating frame, along directions.

    Args:
        modes: Reduced bodies.
        model: Those with such a frame.
        like: Precision and device.
    """

    def __init__(self, modes: ReductionModel, model: FloatingModel, like: torch.Tensor) -> None:
        start, listed, node = (part.numpy() for part in (model.listed_start, model.listed, modes.node))
        self.first, self.radius = model.first.numpy().tolist(), model.radius.numpy().tolist()
        self._node = [
            torch.as_tensor(node[listed[a:b]], device=like.device).long() for a, b in itertools.pairwise(start.tolist())
        ]
        self._centre = torch.as_tensor(model.centre.numpy()).to(like)

    def turn(self, state: Slopes, found: Slopes) -> None:
        """Slopes of nodes, (direction, world, node, 3), from those of frames and what modes add in their axes."""
        for f, node in enumerate(self._node):
            q, rate = state["mode_turn"][:, f], found["mode_turn"][:, :, f]
            imaginary = (
                q[:, 3:] * rate[..., :3]
                - rate[..., 3:] * q[:, :3]
                + torch.linalg.cross(q[:, :3].expand_as(rate[..., :3]), rate[..., :3])
            )
            turned = 2.0 * imaginary[:, :, None]  # of q' q*, twice
            along, about = slice(self.first[f], self.first[f] + 3), slice(self.first[f] + 3, self.first[f] + 6)
            V, spin = state["mode_v"][:, None, along], state["mode_v"][:, None, about] / self.radius[f]
            r = state["node_x"][:, node] - (self._centre[f] + state["mode_q"][:, along])[:, None]
            u = state["node_v"][:, node] - V - _cross(spin, r)
            by_spin = found["mode_v"][:, :, None, about] / self.radius[f]
            arm = _cross(turned, r) + _rotated(q[:, None], found["node_x"][:, :, node])
            found["node_x"][:, :, node] = found["mode_q"][:, :, None, along] + arm
            own = _cross(turned, u) + _rotated(q[:, None], found["node_v"][:, :, node])
            own += _cross(by_spin, r) + _cross(spin, arm)
            found["node_v"][:, :, node] = found["mode_v"][:, :, None, along] + own


def _cross(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    a, b = torch.broadcast_tensors(a, b)
    found: torch.Tensor = torch.linalg.cross(a, b)
    return found


def _rotated(q: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Vectors turned by unit quaternions."""
    t = 2.0 * _cross(q[..., :3], x)
    return x + q[..., 3:] * t + _cross(q[..., :3], t)


class RowDirections:
    """Slopes of worlds through a step, by one adjoint for every number of the state at its end.

    Args:
        worlds: Step and pull gradients back.
    """

    def __init__(self, worlds: Worlds) -> None:
        self.worlds = worlds
        model, device = worlds.model, worlds.gradients[worlds.names[0]].device
        places, count = model.node_dof.numpy(), model.node_count
        self._follows = torch.zeros(count, dtype=torch.bool, device=device)  # whose places follow from their velocities
        if worlds.sim.options.integrator == "euler" and model.joints is None:  # which keep a part of momentum only
            carrier = torch.full((count,), -1)
            if model.frames is not None:
                carrier = torch.as_tensor(model.frames.node_frame.numpy()[:count]).long()
            self._follows |= (carrier < 0).to(device)
        self._moves = torch.as_tensor(places[:count] >= 0).to(device)
        self._shapes = None if model.reduction is None else Shapes(model, worlds.gradients["node_x"])
        self._frames: FrameSlopes | None = None
        self._is_plain = False  # whether amplitudes follow from their velocities
        if self._shapes is not None:
            if model.reduction is not None and model.reduction.floating is not None:
                self._frames = FrameSlopes(model.reduction, model.reduction.floating, worlds.gradients["node_x"])
            self._is_plain = self._frames is None and worlds.sim.options.integrator == "euler"
            self._follows[self._shapes.node] = True
            self._moves[self._shapes.node] = False

    def step(self, slopes: Sequence[Slopes]) -> list[Slopes]:
        """As ``DifferentiableWorlds.step_along``, without watching."""
        worlds = self.worlds
        held = self._stacked(slopes)
        start = worlds.kept()
        worlds.take()
        end = worlds.kept()
        room = worlds.kept_solutions.room(1) if worlds.solution_bytes else None
        if room is not None:
            worlds.kept_solutions.keep(room[0])
        worlds.place(start)
        parameters = any(name in (*PARAMETERS, *REST) for name in held)
        found = {
            name: worlds.gradients[name].new_zeros((len(slopes), *worlds.gradients[name].shape))
            for name in worlds.names
        }
        for name, row in self._rows():
            for view in worlds.gradients.values():
                view.zero_()
            worlds.gradients[name].flatten(1)[:, row] = 1.0
            worlds.pull(None if room is None else room[0], parameters=parameters)
            total = found[name].flatten(2)[..., row]  # sums one after the other: the same bits in every batch
            for each, directions in held.items():
                total += (worlds.gradients[each].flatten(1) * directions).cumsum(dim=-1)[..., -1]
        if room is not None:
            worlds.kept_solutions.give_back(room)
        worlds.place(end)
        x, v = found["node_x"], found["node_v"]
        before = held["node_x"].reshape(x.shape) if "node_x" in held else torch.zeros_like(x)
        found["node_x"] = torch.where(self._follows[:, None], before + worlds.h * v, x)
        if self._shapes is not None:
            if self._is_plain:
                found["mode_q"] = worlds.h * found["mode_v"]
                if "mode_q" in held:
                    found["mode_q"] += held["mode_q"].reshape(found["mode_q"].shape)
            for nodes, modes in (("node_x", "mode_q"), ("node_v", "mode_v")):
                found[nodes][..., self._shapes.node, :] = self._shapes(found[modes])
            if self._frames is not None:
                self._frames.turn(worlds.state, found)
        return [{name: values[number] for name, values in found.items()} for number in range(len(slopes))]

    def _stacked(self, slopes: Sequence[Slopes]) -> Slopes:
        """All directions by the names of the worlds' own arrays, (direction, world, ...), without those that are 0."""
        gradients, arrays = self.worlds.gradients, self.worlds.arrays
        held = {
            name: gradients[name].flatten(1).new_zeros((len(slopes), *gradients[name].flatten(1).shape))
            for name in arrays
        }
        for number, direction in enumerate(slopes):
            for view in gradients.values():
                view.zero_()
            for name, slope in direction.items():
                gradients[name].copy_(slope)
            for name in arrays:
                held[name][number].copy_(gradients[name].flatten(1))
        return {name: values for name, values in held.items() if bool(values.any())}

    def _rows(self) -> Iterator[tuple[str, int]]:
        """Numbers of the state that a step finds and that others do not follow from."""
        for name in self.worlds.names:
            view = self.worlds.gradients[name][0]
            counts = torch.ones_like(view, dtype=torch.bool)
            if name == "node_x":
                counts &= ~self._follows[:, None]
            elif name == "node_v":
                counts &= (self._moves | ~self._follows)[:, None]
            elif name == "mode_q":  # follow from their velocities, but for momentum that frames have turned, and stages
                counts[:] = not self._is_plain
            elif name in FRAMES:  # centres of mass follow from their bodies, and nobody asks for them
                counts[self.worlds.model.rigid_count + self.worlds.model.rod_node_count :] = False
            for row in counts.flatten().nonzero().flatten().tolist():
                yield name, row
