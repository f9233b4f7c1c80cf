"""Inverse control of tubes one in the other: insertions and turns that bring a tip to a target, contact or not.

At every call the line is linearised where it is (tube_response.py), and a quadratic program over the changes x of
lengths and angles, in units of what a period allows, looks for

    min |target - tip - J x - C mu|^2 + damping^2 |x|^2 + calm^2 |force|^2,

where ``tip`` is where the line comes to rest if nothing changes, and mu is the change of the wall's forces. These keep
touching surfaces together where they press, and keep others apart: 0 <= force, 0 <= gap, one of them 0. Which contacts
press is first taken from the state; those whose force would become negative are let go, those that would be closed
press, and the program is solved again, a few times. So it is from no contact at all, since a tip that presses a wall
has to take back a force before it comes off. Rates, lengths, the order of the tubes and the sum of the wall's forces
are limits of the program. It finds a local minimum, and says so.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from softwarp import checks
from softwarp.control.program import minimise
from softwarp.control.tube_response import FAR, Response, TubeResponse
from softwarp.model.codes import Outcome, Status
from softwarp.model.handles import Telescope
from softwarp.simulation import Simulation
from softwarp.threads import alone

ROUNDS = 3  # programs per call, with other contacts that press
SOFT = 1.0e-3  # of the compliance of contacts, added to its diagonal: neighbours share what they bear
LEAST = 1.0e-9  # m/N, likewise
PRESSES = 1.0e-6  # N, from which on a contact presses
AHEAD = 6.0  # periods that a program looks ahead: a wall is left only where its force has been taken back
LAG = 0.005  # m between the tip and where it comes to rest, from which on a call waits for it
CLOSED = 1.0e-6  # m, gap below which it is closed
STRICT = 10.0  # weight of limits that a program could not keep, where programs are compared
RELIEF = 0.9  # of a sum of forces beyond its limit, what a call asks it to fall to
UNLIMITED = 1.0  # m and rad, of what tubes without limits of speed change by in a period
STALLED = 0.02  # of the way to the target: where no more is won in a period, a tip does not come nearer

Leads = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class TubeSolution:
    """What ``TubeController.solve`` found; one row per world.

    Attributes:
        command: Lengths [m], then angles [rad] of the tubes, (world, 2 tube).
        error: Distance of tip and target that is predicted [m], (world,).
        force: Sum of the normal forces on the wall that is predicted [N], (world,).
        outcome: ``Outcome``, int32, (world,): MOVING towards the target, UNREACHABLE where no way leads nearer from
            here, CONFLICT where more force than the limit is borne.
    """

    command: Tensor
    error: Tensor
    force: Tensor
    outcome: Tensor


class TubeController:
    """Finds at every call the lengths and angles of tubes that bring a tip as near to a target as limits allow.

    Args:
        sim: Simulation; its commands are written by ``apply``.
        telescope: Tubes, from ``ModelBuilder.add_telescope``.
        tip: Tube whose tip is steered, 0 the innermost; None takes the one that reaches farthest.
        period: Time between two calls [s]; None takes one step.
        insertion: Largest changes of lengths in a period [m], for each tube; None takes those of the simulation. Tubes
            with 0 stay.
        turning: Likewise of angles [rad].
        most: Largest lengths [m]; None takes those of the tubes.
        leads: For each tube but the outermost, how far it may reach beyond the next one, from and to [m]; None: any.
        force_limit: Largest sum of the normal forces on the wall [N].
        damping: Distance [m] that is worth the largest change of one command.
        calm: Distance [m] that is worth a newton on the wall: forces that do not help are taken back.
        push: A tip that touches a wall is taken to touch it as the line behind does, which follows itself: it is pushed
            on and finds its way along the wall. False foresees that it stops there: it presses less, and stalls more.
        share: Part of the change that is commanded at once, up to 1.
        max_step: Longest way [m] that the tip is asked to go at once.
        tolerance: Distance [m] from a target that counts as reached.

    Raises:
        ValueError: For tubes that do not exist, lists of another length, or a setting outside its range.
    """

    @alone
    def __init__(
        self,
        sim: Simulation,
        telescope: Telescope | int,
        *,
        tip: int | None = None,
        period: float | None = None,
        insertion: Sequence[float] | None = None,
        turning: Sequence[float] | None = None,
        most: Sequence[float] | None = None,
        leads: Leads | None = None,
        force_limit: float = math.inf,
        damping: float = 3.0e-4,
        calm: float = 2.0e-3,
        push: bool = True,
        share: float = 0.7,
        max_step: float = 0.01,
        tolerance: float = 1.0e-4,
    ) -> None:
        self.sim, self.response = sim, TubeResponse(sim, telescope, tip)
        self.push = checks.flag(push, "tube control: push")
        self.period = sim.dt if period is None else period
        self.damping, self.calm, self.share = damping, calm, share
        self.max_step, self.tolerance, self.force_limit = max_step, tolerance, force_limit
        for name in ("period", "damping", "calm", "share", "max_step", "tolerance"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(f"tube control: {name} must be positive and finite, got {value!r}")
        if share > 1.0:
            raise ValueError(f"tube control: share must be at most 1, got {share!r}")
        if not force_limit > 0.0:
            raise ValueError(f"tube control: force_limit must be positive, inf for none, got {force_limit!r} N")
        tubes = self.response.tubes
        speed, spin = (getattr(sim.params, name)[:, tubes] for name in ("tube_max_speed", "tube_max_spin"))
        self._unit = torch.cat(
            (self._numbers("insertion", insertion, speed), self._numbers("turning", turning, spin)), dim=1
        )
        whole = self.response.whole[None] / self.period
        self._most = self._numbers("most", most, whole)
        count = self.response.count
        if leads is not None and len(leads) != count - 1:
            raise ValueError(f"tube control: leads must have {count - 1} rows, one less than tubes, got {len(leads)}")
        rows = [(-math.inf, math.inf)] * (count - 1) if leads is None else leads
        if any(not low <= high for low, high in rows):
            raise ValueError(f"tube control: leads must be (from, to) with from <= to, got {list(rows)}")
        self._leads = torch.tensor([list(row) for row in rows]).to(self._unit).reshape(count - 1, 2)

    def _numbers(self, name: str, given: Sequence[float] | None, rate: Tensor) -> Tensor:
        """What is given for each tube, or what a rate comes to in a period, float64 (1 or world, tube)."""
        if given is None:
            return (rate.double() * self.period).clamp_max(UNLIMITED)
        values = torch.tensor([float(value) for value in given], dtype=torch.float64, device=rate.device)
        if len(values) != self.response.count or not (values >= 0.0).all() or not torch.isfinite(values).all():
            raise ValueError(
                f"tube control: {name} must be {self.response.count} numbers, finite and not negative, got {given!r}"
            )
        return values[None]

    def present(self) -> Tensor:
        """Commands that stand in ``sim.control``, lengths, then angles, float64 (world, 2 tube)."""
        control, tubes = self.sim.control, self.response.tubes
        return torch.cat((control.tube_length[:, tubes], control.tube_angle[:, tubes]), dim=1).double()

    def write(self, command: Tensor) -> None:
        """Write commands (world, 2 tube) to ``sim.control``."""
        control, tubes, count = self.sim.control, self.response.tubes, self.response.count
        control.tube_length[:, tubes] = command[:, :count].to(control.tube_length.dtype)
        control.tube_angle[:, tubes] = command[:, count:].to(control.tube_angle.dtype)

    def apply(self, solution: TubeSolution) -> None:
        """Write commands to ``sim.control``."""
        self.write(solution.command)

    def towards(self, present: Tensor, command: Tensor) -> Tensor:
        """Commands a period on the way from the present ones to others, (world, 2 tube), lengths and leads kept."""
        return self._limited(present, present + (command - present).clamp(-self._unit, self._unit))

    def apart(self, first: Tensor, second: Tensor) -> Tensor:
        """Largest difference of commands, in what a period allows, (world,); tubes that stay do not count."""
        return ((first - second).abs() / self._unit.clamp_min(1.0e-12) * (self._unit > 0.0)).amax(dim=1)

    def positions(self) -> Tensor:
        """Where the tip is [m], float64 (world, 3)."""
        return self.response.measure().tip

    def solve(self, targets: Tensor, *, apply: bool = True) -> TubeSolution:
        """Commands towards targets, from the present state.

        Args:
            targets: Where the tip is to come [m], (world, 3).
            apply: Write the commands to ``sim.control``.

        Raises:
            ValueError: If the targets have another shape.
        """
        given, worlds = torch.as_tensor(targets).to(self._unit), self.sim.num_worlds
        if given.shape != (worlds, 3):
            raise ValueError(f"tube control: targets must have shape ({worlds}, 3), got {tuple(given.shape)}")
        found, present = self.response.measure(stops=not self.push), self.present()
        missing = given - found.rest
        length = torch.linalg.vector_norm(missing, dim=1, keepdim=True)
        asked = missing * (self.max_step / length.clamp_min(self.max_step))
        x, won, force = self._search(found, present, asked)
        is_sound = torch.isfinite(x).all(dim=1) & torch.isfinite(length[:, 0]) & (self.sim.status < Status.NONFINITE)
        lag = torch.linalg.vector_norm(found.rest - found.tip, dim=1, keepdim=True)
        x = self.share / (1.0 + (lag / LAG) ** 2) * x
        x = torch.where(is_sound[:, None], x, torch.zeros_like(x))
        x = x / x.abs().amax(dim=1, keepdim=True).clamp_min(1.0)
        command = self._limited(present, present + x * self._unit)
        solution = TubeSolution(
            command=command,
            error=torch.linalg.vector_norm(missing - won, dim=1),
            force=force,
            outcome=self._outcome(is_sound, length[:, 0], won, asked, force),
        )
        if apply:
            self.apply(solution)
        return solution

    def _outcome(self, is_sound: Tensor, distance: Tensor, won: Tensor, asked: Tensor, force: Tensor) -> Tensor:
        """``Outcome`` of each world, int32 (world,)."""
        gain = (won * asked).sum(dim=1) / asked.square().sum(dim=1).clamp_min(1.0e-18)
        outcome = torch.full(distance.shape, int(Outcome.MOVING), dtype=torch.int32, device=distance.device)
        outcome = outcome.masked_fill(gain < STALLED, int(Outcome.UNREACHABLE))
        outcome = outcome.masked_fill(force > 1.01 * self.force_limit, int(Outcome.CONFLICT))
        outcome = outcome.masked_fill(distance <= self.tolerance, int(Outcome.REACHED))
        return outcome.masked_fill(~is_sound, int(Outcome.FAILED))

    def _search(self, found: Response, present: Tensor, asked: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Changes in units of a period, how far they bring the tip [m], and the sum of forces then [N]."""
        soft = SOFT * torch.diagonal(found.compliance, dim1=1, dim2=2) + LEAST
        compliance = found.compliance + torch.diag_embed(soft)
        is_listed = found.gap < FAR
        pressing = is_listed & (found.force > PRESSES)
        gap = torch.where(pressing, torch.zeros_like(found.gap), found.gap.clamp_min(0.0)) + found.closing
        best = (torch.zeros_like(present), torch.zeros_like(asked), found.force.sum(dim=1))
        least = torch.full_like(asked[:, 0], math.inf)
        for start in (pressing, torch.zeros_like(pressing)):
            presses = start
            for _ in range(ROUNDS):
                law = _Law.of(found, compliance, gap, presses, self._unit)
                x = self._program(found, law, is_listed & ~presses, presses, present, asked)
                won, force, gaps = law.tip(x), found.force + law.force_change(x), law.gaps(x)
                closed = is_listed & ~presses & (gaps < CLOSED)
                loose = presses & (force < PRESSES)
                cost = self._cost(asked - won, x, force * presses, (-gaps * (is_listed & ~presses)).clamp_min(0.0))
                is_better = cost < least
                total = force.clamp_min(0.0).sum(dim=1)
                best = (
                    _chosen(is_better, x, best[0]),
                    _chosen(is_better, won, best[1]),
                    _chosen(is_better, total, best[2]),
                )
                least, presses = torch.minimum(cost, least), (presses & ~loose) | closed
        return best

    def _cost(self, left: Tensor, x: Tensor, force: Tensor, inside: Tensor) -> Tensor:
        """What the program minimises [m^2], and limits that it could not keep, (world,)."""
        pulls = (-force).clamp_min(0.0).sum(dim=1) * STRICT
        cost: Tensor = left.square().sum(dim=1) + (self.damping * x).square().sum(dim=1)
        cost = cost + (self.calm * force).square().sum(dim=1)
        return cost + (STRICT * inside).square().sum(dim=1) + (self.max_step * pulls).square()

    def _program(
        self, found: Response, law: _Law, is_apart: Tensor, presses: Tensor, present: Tensor, asked: Tensor
    ) -> Tensor:
        """The best changes while these contacts press and those stay apart, (world, 2 tube)."""
        count, worlds = self.response.count, len(asked)
        rate = law.tip_rate
        bears = self.calm * law.force_rate * presses[..., None]
        borne = self.calm * (found.force + law.force_shift) * presses
        p = rate.transpose(1, 2) @ rate + bears.transpose(1, 2) @ bears
        p = p + self.damping**2 * torch.eye(2 * count).to(rate)
        shifts = (law.tip_shift - asked)[..., None], borne[..., None]
        q = (rate.transpose(1, 2) @ shifts[0] + bears.transpose(1, 2) @ shifts[1])[..., 0]
        bounds, least, most = self._bounds(present)
        presses_now = presses[..., None]
        total = (found.force * presses).sum(dim=1, keepdim=True)
        limit = torch.maximum(torch.full_like(total, self.force_limit), RELIEF * total)
        left = limit - total - (law.force_shift * presses).sum(dim=1, keepdim=True)
        any_size = torch.full_like(found.gap, math.inf)
        # Limits of commands, forces of contacts that press, gaps of the others, and the sum of forces.
        rows = (
            bounds.expand(worlds, -1, -1),
            law.force_rate * presses_now,
            law.gap_rate * is_apart[..., None],
            (law.force_rate * presses_now).sum(dim=1, keepdim=True),
        )
        low = torch.cat(
            (least, -found.force - law.force_shift, -law.gap_shift, torch.full_like(left, -math.inf)), dim=1
        )
        high = torch.cat((most, any_size, any_size, left), dim=1)
        return minimise(p, q, torch.cat(rows, dim=1), torch.minimum(low, high), high).clamp(-AHEAD, AHEAD)

    def _bounds(self, present: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Rows of rates, lengths and leads with their limits; a state beyond these need not come back at once."""
        count = self.response.count
        unit = self._unit.expand_as(present)
        length = present[:, :count]
        eye = torch.eye(2 * count).to(unit)
        most = torch.where(unit > 0.0, AHEAD, 0.0)
        into = torch.diag_embed(unit)[:, :count]
        lead = length[:, :-1] - length[:, 1:]
        rows = torch.cat((eye.expand(len(unit), -1, -1), into, into[:, :-1] - into[:, 1:]), dim=1)
        low = torch.cat((-most, (-length).clamp_max(0.0), (self._leads[:, 0] - lead).clamp_max(0.0)), dim=1)
        high = torch.cat((most, (self._most - length).clamp_min(0.0), (self._leads[:, 1] - lead).clamp_min(0.0)), dim=1)
        return rows, low, high

    def _limited(self, present: Tensor, command: Tensor) -> Tensor:
        """Commands within lengths and leads exactly, which the program meets to its tolerance."""
        count = self.response.count
        length = torch.minimum(command[:, :count].clamp_min(0.0), torch.maximum(self._most, present[:, :count]))
        held = length.unbind(dim=1)
        found = [held[0]]
        for tube in range(1, count):  # from the innermost on
            lead = (present[:, tube - 1] - present[:, tube])[:, None]
            low = torch.minimum(self._leads[tube - 1, 0], lead[:, 0])
            high = torch.maximum(self._leads[tube - 1, 1], lead[:, 0])
            found.append(torch.minimum(torch.maximum(held[tube], found[-1] - high), found[-1] - low).clamp_min(0.0))
        return torch.cat((torch.stack(found, dim=1), command[:, count:]), dim=1)


def _chosen(is_first: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """Rows of one tensor or the other."""
    return torch.where(is_first if first.ndim == 1 else is_first[:, None], first, second)


@dataclass(frozen=True)
class _Law:
    """Tip, gaps and forces as affine functions of the changes, while certain contacts press.

    ``rate`` is per unit of a change, ``shift`` what comes of contacts that are closed or let go.
    """

    tip_rate: Tensor
    tip_shift: Tensor
    gap_rate: Tensor
    gap_shift: Tensor
    force_rate: Tensor
    force_shift: Tensor

    @classmethod
    def of(cls, found: Response, compliance: Tensor, gap: Tensor, presses: Tensor, unit: Tensor) -> _Law:
        """Eliminate the forces: gaps of contacts that press stay closed, forces of the others vanish."""
        own = presses[:, :, None] & presses[:, None, :]
        eye = torch.eye(presses.shape[1]).to(compliance)
        matrix = torch.where(own, compliance, torch.where(eye > 0.0, eye, torch.zeros_like(eye)))
        rate = found.rate * unit[:, None]
        gone = torch.where(presses, torch.zeros_like(gap), -found.force)
        shift = gap + (compliance @ gone[..., None])[..., 0]
        sides = torch.cat((rate, shift[..., None]), dim=2) * presses[..., None]
        solved = -torch.linalg.solve(matrix, sides)
        force_rate, force_shift = solved[..., :-1], solved[..., -1] + gone
        return cls(
            tip_rate=found.tip_rate * unit[:, None] + found.tip_compliance @ force_rate,
            tip_shift=(found.tip_compliance @ force_shift[..., None])[..., 0],
            gap_rate=rate + compliance @ force_rate,
            gap_shift=gap + (compliance @ force_shift[..., None])[..., 0],
            force_rate=force_rate,
            force_shift=force_shift,
        )

    def tip(self, x: Tensor) -> Tensor:
        """Way of the tip [m]."""
        return self.tip_shift + (self.tip_rate @ x[..., None])[..., 0]

    def gaps(self, x: Tensor) -> Tensor:
        """Gaps afterwards [m]."""
        return self.gap_shift + (self.gap_rate @ x[..., None])[..., 0]

    def force_change(self, x: Tensor) -> Tensor:
        """Change of forces [N]."""
        return self.force_shift + (self.force_rate @ x[..., None])[..., 0]
