"""Rods and rigid bodies at rest by Newton's method with the exact tangent, and gradients of where they are."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from softwarp.gradients.resting import RestingWorlds
from softwarp.simulation import Simulation
from softwarp.solvers.frame_tangent import groups_of, neighbours_of

Tensors = Mapping[str, torch.Tensor]
STEPS = 25  # of a round
CORRECTIONS = 12  # of a round
LARGEST = 0.5  # extents, and rad, that a frame goes at once
SMALLER, CHORD = 0.75, 0.3  # share of a correction that the next one may have, and up to which the tangent stays
ROUNDING = 10.0  # limits within which a correction may be rounding
UNHURRIED = 1.0e20  # N/s, a rate that bounds nothing
TOLERANCE = {"float32": 3.0e-5, "float64": 1.0e-10}  # extents, and rad, of the last correction


class FrameWorlds(RestingWorlds):
    """As many worlds as a simulation has, which Newton's method brings to rest.

    With the imbalance r of forces and its exact tangent R by places and turns, a correction is -R^-1 r. The tangent
    stays while corrections become small quickly. Worlds whose corrections do not become smaller are led on by steps of
    the simulation, damped as it is. Each world goes its own way, with the bits that it has alone.

    Args:
        sim: Rods and rigid bodies; cables under force control.
    """

    def __init__(self, sim: Simulation) -> None:
        super().__init__(sim, sim.dt)
        self._find_unknowns()
        self._fresh, self._solved = -1, 0
        self._factor: tuple[torch.Tensor, torch.Tensor] | None = None
        self._last: torch.Tensor | None = None

    def _find_unknowns(self) -> None:
        """Masters that move, the rows of their dofs, and groups whose products tell rows of the tangent."""
        frames, device = self.model.frames, self.state["frame_pose"].device
        assert frames is not None
        dof = frames.frame_dof.numpy().reshape(-1, 2)
        free = self.model.dof_free.numpy().reshape(-1, 3) != 0.0
        is_free = np.concatenate([free[dof[:, 0]], free[dof[:, 1]]], axis=1)
        masters = np.flatnonzero((frames.master == np.arange(frames.count)) & is_free.any(axis=1))
        near = neighbours_of(self.model)
        rows = 3 * np.repeat(dof[masters], 3, axis=1) + np.tile(np.arange(3), 2)
        place = {int(frame): number for number, frame in enumerate(masters)}
        self.masters = torch.as_tensor(masters, device=device).long()
        self._rows = torch.as_tensor(rows, device=device).long()  # (master, 6)
        self._held = torch.as_tensor(~is_free[masters].ravel(), device=device)
        self._some_held = not is_free[masters].all()
        self._groups = []
        for group in groups_of(masters.tolist(), near):
            pairs = [(place[a], place[int(b)]) for a in group for b in np.flatnonzero(near[a]) if int(b) in place]
            numbers = torch.tensor([place[frame] for frame in group], device=device)
            self._groups.append((numbers, *torch.tensor(pairs, device=device).T))
        places = [self._rows[group, axis] for group, _, _ in self._groups for axis in range(6)]
        self._ones = self._p[0].new_zeros((len(places), self._p[0].shape[1], 1))  # p of every product
        for ones, rows_of_one in zip(self._ones, places, strict=True):
            ones[rows_of_one] = 1.0

    def start(self, given: Tensors, *, warm: bool) -> None:
        """Take over what the simulation has, and what is given by names as ``control.cable_tension``.

        Args:
            given: Tensors.
            warm: Whether poses are those of the last equilibrium.
        """
        self.follow({})
        self.parameters["cable_max_rate"].fill_(UNHURRIED)
        self.give(given)
        if warm and self._last is not None:
            self.state["frame_pose"].copy_(self._last)
        self._rest()

    def _rest(self) -> None:
        for name in ("node_v", "frame_twist"):
            self.state[name].zero_()

    # Newton's method

    def settle(self, tolerance: float | None, most: int, *, lead: bool) -> torch.Tensor:
        """Bring all worlds to rest; which ones are there, (world,).

        Args:
            tolerance: Of the last correction, in extents of the scene and rad; None takes ``TOLERANCE``.
            most: Rounds of steps where Newton's method alone does not come to rest.
            lead: Whether such steps come first.
        """
        limit = TOLERANCE[self.model.precision] if tolerance is None else tolerance
        arrived = torch.zeros(self.model.num_worlds, dtype=torch.bool, device=self.masters.device)
        speed = torch.zeros_like(self.state["frame_twist"])
        for number in range(most):
            if lead or number:
                speed = self._lead(~arrived, speed)
            arrived |= self._newton(limit, ~arrived, fresh=lead or number > 0)
            if arrived.all():
                break
        self._refresh()
        self._last = self.state["frame_pose"].clone()
        self._solved += 1
        self.token = self._solved
        return arrived

    def _lead(self, worlds: torch.Tensor, speed: torch.Tensor) -> torch.Tensor:
        """Some steps of some worlds from a speed, and the speed that they come to; all rest afterwards."""
        held, mask = self.state["frame_pose"].clone(), worlds[:, None, None]
        self.state["frame_twist"].copy_(speed)
        for _ in range(STEPS):
            self._step()
        reached = torch.where(mask, self.state["frame_twist"], 0.0)
        self.state["frame_pose"].copy_(torch.where(mask, self.state["frame_pose"], held))
        self._rest()
        return reached

    def _newton(self, limit: float, going: torch.Tensor, *, fresh: bool) -> torch.Tensor:
        """Corrections of some worlds while each is smaller than the one before: who comes to rest.

        Those of the last equilibrium's tangent come first, unless a ``fresh`` one is asked for.
        """
        arrived = torch.zeros_like(going)
        pose, r = self.state["frame_pose"].clone(), self._forces()
        is_fresh = going
        if fresh or self._factor is None:
            self._factorise(going)
        else:
            is_fresh = torch.zeros_like(going)
        way = self._correction(r)
        for _ in range(CORRECTIONS):
            size = self._size(way)
            going = going & (size <= LARGEST)
            if not going.any():
                break
            self._move(pose, way, going)
            r_new = self._forces()
            after = self._correction(r_new)
            ratio = self._size(after) / size
            is_better = going & (ratio <= SMALLER)
            is_rounding = going & is_fresh & ~is_better & (size <= ROUNDING * limit)
            is_there = (is_better & (ratio * size <= limit)) | is_rounding
            pose = torch.where(is_better[:, None, None], self.state["frame_pose"], pose)
            r = torch.where(is_better[:, None], r_new, r)
            arrived |= is_there
            going &= is_better & ~is_there | ~is_fresh & ~is_better
            is_fresh = going & ~(is_better & (ratio <= CHORD))
            if is_fresh.any():
                self.state["frame_pose"].copy_(pose)
                self._forces()
                self._factorise(is_fresh)
                after = torch.where(is_fresh[:, None], self._correction(r), after)
            way = after
        self.state["frame_pose"].copy_(pose)
        return arrived

    def _size(self, way: torch.Tensor) -> torch.Tensor:
        """Largest part of a correction, in extents and rad, (world,)."""
        parts = way.reshape(len(way), -1, 2, 3).norm(dim=-1).amax(dim=1)
        found = torch.maximum(parts[:, 0] / self.model.extent, parts[:, 1])
        return found.nan_to_num(nan=torch.inf).clamp(min=1e-300)

    def _forces(self) -> torch.Tensor:
        """Imbalance r of the masters that move, (world, 6 master); nothing of held axes."""
        self._measure()
        found = torch.cat([_by_world(part)[:count] for part, count in zip(self._imbalance, self._counts, strict=True)])
        r = found[:, self._rows.flatten()].double() / -self.h
        return r.masked_fill(self._held, 0.0)

    def _correction(self, r: torch.Tensor) -> torch.Tensor:
        assert self._factor is not None
        found: torch.Tensor = -torch.linalg.lu_solve(*self._factor, r[..., None])[..., 0]
        return found

    def _factorise(self, worlds: torch.Tensor) -> None:
        """Factors of the tangent where some worlds are; needs ``_forces``."""
        R = self._tangent()
        if self._factor is None or worlds.all():
            self._factor = torch.linalg.lu_factor_ex(R)[:2]  # one that is singular has endless corrections
            return
        chosen = worlds.nonzero()[:, 0]
        for held, new in zip(self._factor, torch.linalg.lu_factor_ex(R[chosen])[:2], strict=True):
            held[chosen] = new

    def _tangent(self) -> torch.Tensor:
        """R by places and turns of masters, (world, 6 master, 6 master)."""
        count = len(self.masters)
        worlds = self.model.num_worlds
        R = torch.zeros((worlds, count, 6, count, 6), dtype=torch.float64, device=self.masters.device)
        bars = []
        for number in range(6 * len(self._groups)):
            for p in self._p:
                p.copy_(self._ones[number])
            self._multiply()
            bars.append(self.gradients["frame_pose"].index_select(1, self.masters))
        found = torch.stack(bars).double() / self.h
        turns = by_turn(self.state["frame_pose"][:, self.masters, 3:].double(), found[..., 3:])
        found = torch.cat([found[..., :3], turns], dim=-1).reshape(-1, 6, worlds, count, 6)
        for (_, forces, places), held in zip(self._groups, found, strict=True):
            R[:, forces, :, places] = held[:, :, places].permute(2, 1, 0, 3)
        R = R.reshape(worlds, 6 * count, 6 * count)
        if self._some_held:
            R[:, self._held] = 0.0
            R[:, :, self._held] = 0.0
            R[:, self._held, self._held] = 1.0
        return R

    def _move(self, pose: torch.Tensor, way: torch.Tensor, worlds: torch.Tensor) -> None:
        """Poses moved and turned in some worlds, else as they are.

        Segments of rods turn by what their ends do, which a sum of ways would stretch.
        """
        assert self.model.frames is not None
        held = pose.double()
        moved = torch.zeros((*pose.shape[:2], 6), dtype=torch.float64, device=pose.device)
        moved[:, self.masters] = torch.where(worlds[:, None], way, 0.0).nan_to_num().reshape(len(way), -1, 6)
        x, (shift, angle) = held[..., :3], moved.split(3, dim=-1)
        placed = x + shift
        first = self.model.rigid_count
        for begin, end in itertools.pairwise((first + self.model.frames.rod_start).tolist()):
            middle = 0.5 * (angle[:, begin + 1 : end] + angle[:, begin : end - 1])
            span = x[:, begin:end].diff(dim=1)
            longer = span + shift[:, begin:end].diff(dim=1) - torch.linalg.cross(middle, span)
            spans = _turned(_exponential(middle), longer)
            placed[:, begin + 1 : end] = placed[:, begin : begin + 1] + spans.cumsum(dim=1)
        q = _product(_exponential(angle), held[..., 3:])
        found = torch.cat([placed, q / q.norm(dim=-1, keepdim=True)], dim=-1)[:, self.masters]
        self.state["frame_pose"].copy_(pose)
        self.state["frame_pose"][:, self.masters] = torch.where(
            worlds[:, None, None], found.to(pose), pose[:, self.masters]
        )

    # Gradients

    def pull(self, given: Tensors, pose: torch.Tensor, by_pose: torch.Tensor, token: int) -> dict[str, torch.Tensor]:
        """Gradients by what is given from those by the poses of masters at an equilibrium, of many losses at once.

        Args:
            given: As of ``start``.
            pose: Of all frames.
            by_pose: Gradients, (loss, world, master, 7).
            token: Of the equilibrium.

        Returns:
            By name, (loss, world, ...).
        """
        if token != self.token:
            self.give(given)
            self.state["frame_pose"].copy_(pose)
            self._rest()
            self.token = token
        if token != self._fresh:
            self._forces()
            self._factorise(torch.ones(self.model.num_worlds, dtype=torch.bool, device=pose.device))
            self._fresh = token
        assert self._factor is not None
        turns = by_turn(pose[:, self.masters, 3:], by_pose[..., 3:])
        y = torch.cat([by_pose[..., :3], turns], dim=-1).flatten(2).double().masked_fill(self._held, 0.0)
        p = -torch.linalg.lu_solve(*self._factor, y.permute(1, 2, 0), adjoint=True).permute(2, 0, 1)
        p = p.masked_fill(self._held, 0.0)
        own = {name: self.gradients[name.replace("control.", "command_").replace("params.", "")] for name in given}
        found: dict[str, list[torch.Tensor]] = {name: [] for name in given}
        placed, gradients, rows = self._placed(p), list(self.gradients.values()), self._rows.flatten()
        for view in self._p:
            view.zero_()
        for number in range(len(p)):
            for view, each in zip(self._p, placed, strict=True):
                view[:, rows] = each[number]
            torch._foreach_zero_(gradients)
            self._multiply_all()
            for name, gradient in own.items():
                found[name].append(gradient / self.h)
        return {name: torch.stack(parts) for name, parts in found.items()}

    def _placed(self, p: torch.Tensor) -> list[torch.Tensor]:
        """Vectors (loss, world, row of masters) as each system has them, (loss, pack, row, lane)."""
        found = []
        for view, part in zip(self._p, p.split(self._counts, dim=1), strict=True):
            packs, _, lanes = view.shape
            full = torch.nn.functional.pad(part, (0, 0, 0, packs * lanes - part.shape[1]))
            found.append(full.unflatten(1, (packs, lanes)).transpose(2, 3).to(view))
        return found


def _by_world(rows: torch.Tensor) -> torch.Tensor:
    """(pack, row, lane) as (world, row)."""
    return rows.permute(0, 2, 1).reshape(-1, rows.shape[1])


def by_turn(q: torch.Tensor, by_q: torch.Tensor) -> torch.Tensor:
    """Gradients by turns from those by quaternions."""
    u, by_u = torch.broadcast_tensors(q[..., :3], by_q[..., :3])
    found: torch.Tensor = 0.5 * (q[..., 3:] * by_u + torch.linalg.cross(u, by_u) - by_q[..., 3:] * u)
    return found


def _exponential(turn: torch.Tensor) -> torch.Tensor:
    """Quaternion of a rotation vector."""
    half = 0.5 * turn.norm(dim=-1, keepdim=True)
    return torch.cat([0.5 * turn * torch.sinc(half / torch.pi), torch.cos(half)], dim=-1)


def _turned(q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """A vector turned by a quaternion."""
    twice = 2.0 * torch.linalg.cross(q[..., :3], v)
    found: torch.Tensor = v + q[..., 3:] * twice + torch.linalg.cross(q[..., :3], twice)
    return found


def _product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Quaternion a after b, x y z w."""
    u, v, s, t = a[..., :3], b[..., :3], a[..., 3:], b[..., 3:]
    return torch.cat([s * v + t * u + torch.linalg.cross(u, v), s * t - (u * v).sum(-1, keepdim=True)], dim=-1)


def after(worlds: FrameWorlds, masters: torch.Tensor) -> torch.Tensor:
    """Poses of all frames, (world, frame, 7), from those of masters that move: others move with these, or stand."""
    frames = worlds.model.frames
    assert frames is not None
    pose = worlds.state["frame_pose"].clone().index_copy(1, worlds.masters, masters)
    welded = torch.as_tensor(frames.welded_frame.numpy(), device=pose.device).long()
    carrier = pose[:, torch.as_tensor(frames.master, device=pose.device).long()[welded]]
    offset = torch.as_tensor(frames.frame_offset.numpy().reshape(-1, 7)).to(pose)[welded].expand_as(carrier)
    q = carrier[..., 3:]
    x = carrier[..., :3] + _turned(q, offset[..., :3])
    return pose.index_copy(1, welded, torch.cat([x, _product(q, offset[..., 3:])], dim=-1))


class AtRest(torch.autograd.Function):
    """One solve as one operation: poses of masters that move, (world, master, 7)."""

    @staticmethod
    def forward(
        ctx: Any, owner: Any, names: tuple[str, ...], limits: dict[str, Any], *tensors: torch.Tensor
    ) -> torch.Tensor:
        """Where they are."""
        worlds: FrameWorlds = owner.frames
        given = dict(zip(names, tensors, strict=True))
        warm = owner.warm and worlds.token > 0
        worlds.start(given, warm=warm)
        arrived = worlds.settle(limits["tolerance"], limits["max_iterations"], lead=not warm)
        owner.check(arrived, torch.zeros(len(arrived)))
        pose = worlds.state["frame_pose"].clone()
        ctx.worlds, ctx.names, ctx.token = worlds, names, worlds.token
        ctx.save_for_backward(pose, *tensors)
        return pose[:, worlds.masters]

    @staticmethod
    def backward(ctx: Any, by_pose: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Gradients by all tensors."""
        return (None, None, None, *_Pull.apply(ctx.worlds, ctx.names, ctx.token, by_pose, *ctx.saved_tensors))


class _Pull(torch.autograd.Function):
    """Gradients by all that was given, of one loss, or of many where torch batches a backward pass."""

    @staticmethod
    def forward(
        worlds: FrameWorlds, names: tuple[str, ...], token: int, by_pose: torch.Tensor, *held: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Of one loss."""
        found = _Pull.of_many(worlds, names, token, by_pose[None], held)
        return tuple(gradient[0] for gradient in found)

    @staticmethod
    def of_many(
        worlds: FrameWorlds, names: tuple[str, ...], token: int, by_pose: torch.Tensor, held: tuple[torch.Tensor, ...]
    ) -> tuple[torch.Tensor, ...]:
        """(loss, world, ...) each."""
        pose, *tensors = held
        return tuple(worlds.pull(dict(zip(names, tensors, strict=True)), pose, by_pose, token).values())

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[torch.Tensor, ...]) -> None:
        """Nothing is kept: there are no second derivatives."""

    @staticmethod
    def vmap(
        info: Any,
        in_dims: tuple[Any, ...],
        worlds: FrameWorlds,
        names: tuple[str, ...],
        token: int,
        by_pose: torch.Tensor,
        *held: torch.Tensor,
    ) -> tuple[tuple[torch.Tensor, ...], tuple[int, ...]]:
        """Of many losses at the same poses."""
        found = _Pull.of_many(worlds, names, token, by_pose.movedim(in_dims[3], 0), held)
        return found, (0,) * len(found)
