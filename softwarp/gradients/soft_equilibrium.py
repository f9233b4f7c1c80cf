"""Soft bodies at rest from poses near by: corrections with a tangent that is kept while they become small quickly."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp

from softwarp import interop
from softwarp.solvers.static_adjoint import StaticAdjoint
from softwarp.solvers.static_newton import StaticNewton
from softwarp.solvers.workspace.rows import Rows

CORRECTIONS, TANGENTS = 32, 12  # at most, of a solve
LARGEST = 0.3  # extents, a correction
STRIDE = 0.01  # extents that a new tangent may take a world: further on, a wall that bulges has another one
STILL = 0.01  # least share of a correction that is taken to be left to go after it
SMALLER, CHORD = 0.8, 0.35  # share of a correction that the next one may have, and up to which the tangent stays
LARGER = 4.0  # the first one with a new tangent, as rows go slack and taut; up to ``STRIDE`` any
TOLERANCE = {"float32": 1.0e-5, "float64": 1.0e-10}  # extents, what is left to go


class Corrections:
    """Brings the worlds of one shard to rest from near by, or tells which are not.

    Args:
        adjoint: Of these worlds.
    """

    def __init__(self, adjoint: StaticAdjoint) -> None:
        self.newton, self.model = StaticNewton(adjoint), adjoint.model
        self.worlds = adjoint.system.world_count
        work, newton = adjoint.shard.work, self.newton
        held = {"b": work.b, "y": adjoint.system.linear.y, "v": work.dof_v, "multiplier": work.multiplier}
        held |= {"u": newton.u, "value": newton.value, "change": newton.change, "gap": newton.gap}
        held |= {"W": newton.compliance, "sides": newton.sides, "pivot": adjoint.lu.pivot, "negative": newton.negative}
        self.v: dict[str, Any] = {name: _view(rows) for name, rows in held.items()}

    def settle(self, tolerance: float | None, *, prepared: bool) -> torch.Tensor:
        """Which worlds are at rest, (world,); these are written to the state, others are left as they come.

        Args:
            tolerance: What may be left to go, in extents; None takes ``TOLERANCE``.
            prepared: Whether the adjoint has a factor near by.
        """
        limit = TOLERANCE[self.model.precision] if tolerance is None else tolerance
        with interop.on_torch_stream(self.model.device):
            return self._settle(limit, prepared=prepared)

    def _settle(self, limit: float, *, prepared: bool) -> torch.Tensor:
        newton, v = self.newton, self.v
        newton.begin()
        if prepared:
            newton.keep_sides()
        start = v["multiplier"].clone()
        newton.measure()
        arrived = torch.zeros(self.worlds, dtype=torch.bool, device=v["u"].device)
        going, is_fresh, tangents = ~arrived, arrived, torch.zeros_like(arrived, dtype=torch.int32)
        before = torch.full_like(arrived, torch.inf, dtype=v["u"].dtype)
        if not prepared:
            is_fresh, tangents = self._linearise(going), tangents + 1
        for _ in range(CORRECTIONS):
            size = self._correct()
            ratio = size / before
            grows = torch.where(is_fresh, (ratio > LARGER) & (size > STRIDE), ratio > SMALLER)
            fails = going & ((size > LARGEST) | grows)
            takes = going & ~fails
            share = torch.where(is_fresh, torch.clamp(STRIDE / size, max=1.0), 1.0)
            is_whole = share == 1.0
            is_there = takes & is_whole & (ratio < 1.0)
            is_there &= size * torch.clamp(ratio / (1.0 - ratio), min=STILL) <= limit
            self._advance(torch.where(takes, share, 0.0))
            arrived = arrived | is_there
            before = torch.where(takes, size, before)
            is_slow = takes & (~is_whole | torch.isfinite(ratio) & (ratio > CHORD))
            far = fails & ~is_fresh & (tangents == 0)  # the tangent was of too different a pose: from the start anew
            self._go_back(far, start)
            before = torch.where(far, torch.inf, before)
            linearised = going & ~is_there & (is_slow | fails & ~is_fresh) & (tangents < TANGENTS)
            going = going & ~is_there & (linearised | ~fails)
            if not going.any():
                break
            newton.measure()
            is_fresh = self._linearise(linearised) if linearised.any() else linearised
            tangents = tangents + is_fresh
        newton.finish()
        return arrived

    def _linearise(self, worlds: torch.Tensor) -> torch.Tensor:
        """Tangents of some worlds anew where they are; which worlds have one now, all where worlds go in packs."""
        lu, v = self.newton.adjoint.lu, self.v
        if lu.is_kept is None:
            self.newton.linearise()
            self.newton.keep_sides()
            return torch.ones_like(worlds)
        is_kept = wp.to_torch(lu.is_kept)
        is_kept.copy_(~worlds)
        self.newton.linearise()
        is_kept.zero_()
        v["sides"].copy_(torch.where(self._by_lane(worlds), v["y"], v["sides"]))
        return worlds

    def _correct(self) -> torch.Tensor:
        """A correction ``u`` and multipliers ``value``; its largest part in extents, infinite where there is none."""
        newton, v = self.newton, self.v
        rows, count = v["b"].shape[1], newton.count
        v["y"].copy_(v["sides"])
        v["y"][:, :rows] = v["b"]
        newton.respond()
        unstable = v["pivot"].sum(dim=1)
        if count:
            packs, lanes = v["W"].shape[0], v["W"].shape[2]
            W, held = v["W"].reshape(packs, count, count, lanes), v["multiplier"][:, :count]
            v["gap"][:, :count] -= (W * held[:, None]).sum(dim=2)
            newton.choose()
            v["change"][:, :count] = v["value"][:, :count] - held
            unstable = unstable - v["negative"][:, 0]
        newton.combine()
        size = v["u"].reshape(v["u"].shape[0], -1, 3, v["u"].shape[2]).norm(dim=2).amax(dim=1) / self.model.extent
        size = torch.where(unstable.abs() < 0.5, size, torch.inf).nan_to_num(nan=torch.inf)
        return size.reshape(-1)[: self.worlds].clamp(min=1e-300)

    def _by_lane(self, values: torch.Tensor) -> torch.Tensor:
        """Values of worlds, False or 0 of lanes beyond, (pack, 1, lane)."""
        packs, lanes = self.v["u"].shape[0], self.v["u"].shape[2]
        held = values.new_zeros(packs * lanes)
        held[: self.worlds] = values
        return held.reshape(packs, 1, lanes)

    def _go_back(self, worlds: torch.Tensor, multiplier: torch.Tensor) -> None:
        """Some worlds to where they started."""
        v, mask = self.v, self._by_lane(worlds)
        v["v"].copy_(torch.where(mask, 0.0, v["v"]))
        v["multiplier"].copy_(torch.where(mask, multiplier, v["multiplier"]))

    def _advance(self, share: torch.Tensor) -> None:
        """Positions and multipliers, by a share of the correction of each world."""
        v, count, part = self.v, self.newton.count, self._by_lane(share)
        v["v"] += torch.where(part > 0.0, part * v["u"], 0.0)
        if count:
            held = v["multiplier"][:, :count]
            held += torch.where(part > 0.0, part * (v["value"][:, :count] - held), 0.0)


def _view(rows: Rows) -> torch.Tensor:
    found: torch.Tensor = wp.to_torch(rows.real, requires_grad=False)
    return found
