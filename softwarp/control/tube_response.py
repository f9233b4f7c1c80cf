"""How the line of a telescope answers to its tubes, linearised where it is: tip, places of contact, and forces there.

A segment k of the line, turned by R_k, bends without load by theta_k. Where it lies still, what is bent beyond that
balances loads. Commands change theta, forces change the bending by their moments m over the stiffness D, and a point p
goes where all segments before it take it:

    dx_p = sum_k  (R_k dtheta_k) x (x_p - x_k),     dtheta_k = d(theta_k)/dq dq + (h / D_k) R_k' dm_k.

Both are exact to first order for a line at rest under loads that stay where they are along it, and one that is pushed
on in a bent lumen follows itself: what is bent by loads stays in its place, only the tip goes on. theta depends on the
tubes' angles along the line, which are in balance of torsion: they are those that the simulation has, and their changes
solve its equations, linearised. Theory of both: docs/theory/telescope.md; of this control: docs/control.md.

Reference: Rucker, Webster (2011), Computing Jacobians and compliance matrices for externally loaded continuum robots.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from softwarp.model.handles import Telescope
from softwarp.simulation import Simulation

SHIFT = 1.0e-5  # m, for differences in lengths
HELD = 1.0e-6  # torsion stiffness of tubes beyond their tips, per the largest one
FAR = 1.0  # m, gap where there is no contact
RIGID = 1.0e-4  # of a segment: shortest length behind the port, as the simulation's


@dataclass(frozen=True)
class Response:
    """A line in its present state and what moves it; n tubes, c places of contact; float64.

    Commands q are n lengths [m], then n angles at the bases [rad].

    Attributes:
        tip: Where the tip is [m], (world, 3).
        rest: Where it comes to rest under present commands, if contacts bear what they bear [m], (world, 3).
        tip_rate: Its change with commands while no force changes, (world, 3, 2 n).
        tip_compliance: Its change with the normal forces [m/N], (world, 3, c).
        rate: Change of the gaps with commands, (world, c, 2 n).
        compliance: Change of the gaps with the normal forces [m/N], (world, c, c).
        gap: Distances of surfaces [m], (world, c); ``FAR`` where there is no contact.
        closing: By how much they grow until the line is at rest [m], (world, c).
        force: Normal forces of now [N], (world, c).
    """

    tip: Tensor
    rest: Tensor
    tip_rate: Tensor
    tip_compliance: Tensor
    rate: Tensor
    compliance: Tensor
    gap: Tensor
    closing: Tensor
    force: Tensor


@dataclass(frozen=True)
class _Line:
    """Nodes and segments of now, float64; batch axis ``world``."""

    x: Tensor  # (world, node, 3)
    axes: Tensor  # of segments, (world, segment, 3, 3)
    ahead: Tensor  # directions at nodes, (world, node, 3)
    turn: Tensor  # from node to node, in these [rad], (world, segment, 3)
    load: Tensor  # bending moment of loads, (world, segment, 2)
    stiffness: Tensor  # of bending [N m^2], (world, segment, 2)
    piece: Tensor  # length of a segment [m], (world,)
    psi: Tensor  # angles of tubes to the carrier, (world, tube, node)
    base: Tensor  # angle of the frame at the port, (world,)
    length: Tensor  # (world, tube)
    angle: Tensor  # (world, tube)
    bending: Tensor  # E I of the tubes' own modulus, (world, tube)
    torsion: Tensor  # G J of it
    factor: Tensor  # on stress-free curvature
    mass: Tensor  # of tubes per length [kg/m]


@dataclass(frozen=True)
class _Parts:
    """Pieces of lines between ends of segments, tubes and sections; (k, part) and (k, part, tube)."""

    step: Tensor  # [m]
    segment: Tensor
    share: Tensor  # place within the segment, in [0, 1]
    bending: Tensor  # E I, 0 where a tube does not reach
    torsion: Tensor  # G J
    bend: Tensor  # E I k, in axes of the carrier, (k, part, tube, 2)
    twist: Tensor  # stress-free [1/m]
    mass: Tensor  # per length [kg/m], (k, part, 1)


@dataclass(frozen=True)
class _Contacts:
    """Places along the line [m], normals towards it, gaps [m], normal and whole forces [N]; (world, contact, ...)."""

    place: Tensor
    normal: Tensor
    gap: Tensor
    force: Tensor
    load: Tensor


class TubeResponse:
    """Measures the response of a telescope of a simulation, all worlds at once.

    Args:
        sim: The simulation.
        telescope: From ``ModelBuilder.add_telescope``.
        tip: Tube whose tip is meant, 0 the innermost; None takes the one that reaches farthest.

    Raises:
        ValueError: If there is no such telescope or tube.
    """

    def __init__(self, sim: Simulation, telescope: Telescope | int, tip: int | None = None) -> None:
        model = sim.model
        self.sim, self.nodes, self.tubes = sim, model.rod_nodes(int(telescope)), model.tubes_of(int(telescope))
        assert model.telescopes is not None
        table, device = model.telescopes, torch.device(sim.device)
        number = table.rod.tolist().index(int(telescope))
        self.count, self.pieces = self.tubes.stop - self.tubes.start, int(table.pieces.numpy()[number])
        if tip is not None and not 0 <= tip < self.count:
            raise ValueError(f"tip: must be one of the {self.count} tubes, 0 the innermost, or None, got {tip!r}")
        self.number, self.tip = number, tip
        chosen = np.flatnonzero(table.piece_telescope.numpy() == number)
        self._segments = torch.as_tensor(table.piece_segment.numpy()[chosen], dtype=torch.int64, device=device)
        first = int(table.first_windup.numpy()[number])
        self._windup = slice(first, first + self.count * (self.pieces + 1))
        self._hidden_twists = bool(table.hidden_twists.numpy()[number])

        def numbers(values: object) -> Tensor:
            return torch.as_tensor(np.asarray(values), dtype=torch.float64, device=device)

        starts = table.section_start.numpy()[self.tubes.start : self.tubes.stop + 1]
        most = int(np.diff(starts).max())
        end, ratio = np.full((self.count, most), np.inf), np.ones((self.count, most))
        curvature = np.zeros((self.count, most, 3))
        for tube in range(self.count):
            part, size = slice(starts[tube], starts[tube + 1]), starts[tube + 1] - starts[tube]
            end[tube, :size] = table.section_end.numpy()[part]
            ratio[tube, :size] = table.section_ratio.numpy()[part]
            curvature[tube, :size] = table.section_curvature.numpy().reshape(-1, 3)[part]
            end[tube, size - 1] = np.inf  # the last one has no end but the tube's
        self._end, self._ratio, self._curvature = numbers(end), numbers(ratio), numbers(curvature)
        area = table.tube_area.numpy().reshape(-1, 4)[self.tubes]
        self._area, self._inertia, self._polar = numbers(area[:, 0]), numbers(area[:, 2]), numbers(area[:, 3])
        self.whole = numbers(table.tube_whole.numpy()[self.tubes])
        self._side = self._sides(telescope, device)

    def _sides(self, telescope: Telescope | int, device: torch.device) -> Tensor:
        """By pair, and in the end for no pair: 1 where normals point to the telescope, -1 away from it, else 0."""
        parts = () if self.sim.model.contact is None else self.sim.model.contact.parts
        sides = [
            [isinstance(part, Telescope) and int(part) == int(telescope) for part in (pair[0], pair[1])]
            for pair in parts
        ]
        found = [0.0 if a == b else 1.0 if a else -1.0 for a, b in sides]
        return torch.tensor([*found, 0.0], dtype=torch.float64, device=device)

    def measure(self, *, stops: bool = True) -> Response:
        """Where tip and contacts are, and what moves them.

        Args:
            stops: Whether contacts at the tip go on with it where the line is pushed out. Without, they stay where they
                are, as contacts of the line behind it do.
        """
        line = self._read()
        bent, off = self._bent(line)
        point, weight = self._contacts(line)
        tip_place = line.length.amax(dim=1) if self.tip is None else line.length[:, self.tip]
        tip, ahead = self._tip(line, tip_place)
        place = torch.cat((point.place, tip_place[:, None].expand(-1, 3)), dim=1)
        way = torch.cat((weight[..., None] * point.normal, torch.eye(3).to(tip).expand(len(tip), 3, 3)), dim=1)
        levers = _levers(line, place, way)  # (world, row, segment, 2)
        rate = torch.einsum("wrkc,wkcq->wrq", levers, bent)
        rate[..., : self.count] += torch.einsum("wrkc,wkcq->wrq", _offsets(line, levers, way), off)
        soft = (line.piece[:, None, None] / line.stiffness)[:, None]
        compliance = torch.einsum("wrkc,wskc->wrs", levers * soft, levers)
        unbalanced = soft[:, 0] * (self._moment(line, point) - line.load)  # bending that is to come [rad]
        coming = torch.einsum("wrkc,wkc->wr", levers, unbalanced)
        contacts, worlds = point.place.shape[1], torch.arange(len(tip), device=tip.device)
        carrier = line.length.argmax(dim=1) if self.tip is None else torch.full_like(tip_place, self.tip).long()
        # What lies at the tip goes on with it; all else stays where it is along the line.
        is_end = (place - tip_place[:, None]).abs() < 1.0e-6 * line.piece[:, None]
        is_end[:, :contacts] &= stops
        rate[worlds, :, carrier] += torch.where(is_end, (way * ahead[:, None]).sum(dim=-1), torch.zeros_like(place))
        return Response(
            tip=tip,
            rest=tip + coming[:, contacts:],
            tip_rate=rate[:, contacts:],
            tip_compliance=compliance[:, contacts:, :contacts],
            rate=rate[:, :contacts],
            compliance=compliance[:, :contacts, :contacts],
            gap=point.gap,
            closing=coming[:, :contacts],
            force=point.force,
        )

    def _read(self) -> _Line:
        """The simulation's state."""
        sim, tubes = self.sim, self.tubes
        x, q = sim.rod_x[:, self.nodes].double(), sim.rod_q[:, self.nodes].double()
        law = sim.segment_law[:, self._segments].double()
        before, after = q[:, :-1], q[:, 1:]
        after = torch.where((before * after).sum(dim=-1, keepdim=True) < 0.0, -after, after)
        axes = _matrices(torch.nn.functional.normalize(before + after, dim=-1))
        turn = _difference(before, after)
        piece = law[:, 0, 0]
        load = law[..., 4:6] * (turn[..., :2] / piece[:, None, None] - law[..., 10:12])
        params = sim.params
        youngs, nu, factor, density = (
            getattr(params, name)[:, tubes].double().expand(len(x), -1)
            for name in ("tube_youngs", "tube_nu", "tube_curvature", "tube_density")
        )
        return _Line(
            x=x,
            axes=axes,
            ahead=_matrices(q)[..., 2],
            turn=turn,
            load=load,
            stiffness=law[..., 4:6],
            piece=piece,
            psi=sim.windup[:, self._windup].double().unflatten(1, (self.count, self.pieces + 1)),
            base=sim.base_angle[:, self.number].double(),
            length=sim.tube_length[:, tubes].double(),
            angle=sim.tube_angle[:, tubes].double(),
            bending=youngs * self._inertia,
            torsion=youngs * self._polar / (2.0 * (1.0 + nu)),
            factor=factor,
            mass=density * self._area,
        )

    def _parts(self, line: _Line, length: Tensor) -> _Parts:
        """What the line consists of with these lengths [m], (world, k, tube); batch axes (world, k)."""
        grid = line.piece[:, None] * torch.arange(self.pieces + 1).to(line.piece)
        most = grid[:, -1, None, None]
        ends = (self._end - self.whole[:, None] + length[..., None]).flatten(2)
        stops = torch.cat((grid[:, None].expand(-1, length.shape[1], -1), length, ends), dim=2)
        stops = torch.minimum(stops.clamp_min(0.0), most).sort(dim=2).values
        step, middle = stops.diff(dim=2), 0.5 * (stops[..., 1:] + stops[..., :-1])
        along = middle / line.piece[:, None, None]
        segment = along.long().clamp_max(self.pieces - 1)
        own = middle[..., None] + self.whole - length[:, :, None]  # place on each tube, from its base
        section = (own[..., None] >= self._end).sum(dim=-1).clamp_max(self._end.shape[1] - 1)
        tube = torch.arange(self.count, device=own.device)
        is_here = middle[..., None] < length[:, :, None]
        ratio = self._ratio[tube, section] * is_here
        curvature = self._curvature[tube, section] * line.factor[:, None, None, :, None]
        share = along - segment
        worlds = torch.arange(len(length), device=own.device)[:, None, None]
        angles = line.psi.transpose(1, 2)
        psi = torch.lerp(angles[worlds, segment], angles[worlds, segment + 1], share[..., None])
        bending = ratio * line.bending[:, None, None]
        cos, sin = psi.cos(), psi.sin()
        bend = torch.stack(
            (cos * curvature[..., 0] - sin * curvature[..., 1], sin * curvature[..., 0] + cos * curvature[..., 1]),
            dim=-1,
        )
        torsion = ratio * line.torsion[:, None, None]
        mass = (is_here * line.mass[:, None, None]).sum(dim=-1, keepdim=True)
        return _Parts(step, segment, share, bending, torsion, bending[..., None] * bend, curvature[..., 2], mass)

    def _bent(self, line: _Line) -> tuple[Tensor, Tensor]:
        """Change of the bending of segments with commands, in their axes, (world, segment, 2, 2 n).

        Also, of what comes of lengths, the first moment about the middle of the segment [m], (world, segment, 2, n):
        where a section begins or ends, a segment bends anywhere else.
        """
        count = self.count
        now = self._parts(line, line.length[:, None])
        eye = SHIFT * torch.eye(count).to(line.length)
        is_inside = (line.length > SHIFT) & (line.length < line.length.amax(dim=1, keepdim=True) - SHIFT)
        back = torch.where(is_inside, 1.0, 0.0)[:, :, None].double()  # else ends of tubes come onto the line, or off it
        shifted = torch.cat((line.length[:, None] + eye, line.length[:, None] - back * eye), dim=1)
        parts = self._parts(line, shifted)
        span = SHIFT * (1.0 + back[..., 0])
        theta, torque = self._theta(line, parts), self._torque(line, parts, shifted)
        by_length = (theta[:, :count] - theta[:, count:]) / span[..., None, None]  # (world, tube, segment, 4)
        pull = (torque[:, :count] - torque[:, count:]) / span[..., None]  # (world, tube, angle)
        hold = self._hold(line, line.length[:, None])[:, 0]
        push = torch.zeros((len(pull), count, pull.shape[2])).to(pull)
        for tube in range(count):
            push[:, tube, tube * (self.pieces + 1)] = hold[:, tube]
        matrix = self._torsion_matrix(line, now, hold)
        angles = _solve(matrix, torch.cat((-pull, push), dim=1).transpose(1, 2))  # (world, angle, 2 n)
        angles = angles.unflatten(1, (count, self.pieces + 1))
        by_angle = self._by_angle(now)  # (world, segment, 2, tube, end)
        found = torch.einsum("wkct,wtkq->wkcq", by_angle[..., 0], angles[:, :, :-1])
        found = found + torch.einsum("wkct,wtkq->wkcq", by_angle[..., 1], angles[:, :, 1:])
        bend, off = by_length.permute(0, 2, 3, 1).split(2, dim=2)
        found[..., :count] += bend
        return found, off

    def _theta(self, line: _Line, parts: _Parts) -> Tensor:
        """Bending of segments without load [rad], and its first moment [m], (world, k, segment, 4)."""
        bend = parts.step[..., None] * parts.bend.sum(dim=-2) / parts.bending.sum(dim=-1).clamp_min(1e-15)[..., None]
        off = line.piece[:, None, None] * (parts.share - 0.5)
        return self._sum(parts, torch.cat((bend, off[..., None] * bend), dim=-1))

    def _by_angle(self, parts: _Parts) -> Tensor:
        """Its change with the angles of tubes at both ends of segments, (world, segment, 2, tube, 2)."""
        across = _across(parts.bend) / parts.bending.sum(dim=-1).clamp_min(1.0e-15)[..., None, None]
        change = (parts.step[..., None, None] * across).transpose(-1, -2)  # (world, 1, part, 2, tube)
        ends = torch.stack((1.0 - parts.share, parts.share), dim=-1)[..., None, None, :]
        sums = self._sum(parts, (change[..., None] * ends).flatten(3))[:, 0]
        return sums.reshape(len(sums), self.pieces, 2, self.count, 2)

    def _sum(self, parts: _Parts, values: Tensor) -> Tensor:
        """Sums over the parts of each segment, (world, k, part, m) -> (world, k, segment, m)."""
        out = torch.zeros((*values.shape[:2], self.pieces, values.shape[3])).to(values)
        return out.scatter_add_(2, parts.segment[..., None].expand_as(values), values)

    def _hold(self, line: _Line, length: Tensor) -> Tensor:
        """Torsion springs between bases and port [N m/rad], (world, k, tube)."""
        hidden = torch.zeros_like(length)
        if self._hidden_twists:
            behind = (self.whole - length)[..., None].clamp_min(0.0)
            ends = torch.minimum(self._end, behind)
            starts = torch.cat((torch.zeros_like(ends[..., :1]), ends[..., :-1]), dim=-1)
            hidden = ((ends - starts) / self._ratio).sum(dim=-1)
        return line.torsion[:, None] / torch.maximum(hidden, RIGID * line.piece[:, None, None])

    def _twisted(self, line: _Line) -> Tensor:
        """How far angles of tubes change along segments [rad], (world, segment, tube)."""
        return line.psi.diff(dim=2).transpose(1, 2) + line.turn[..., 2:]

    def _torque(self, line: _Line, parts: _Parts, length: Tensor) -> Tensor:
        """Derivatives of the tubes' energy by their angles at nodes [N m], (world, k, tube node)."""
        k = (parts.bend.sum(dim=-2) + self._of(line.load, parts)) / parts.bending.sum(dim=-1).clamp_min(1e-15)[
            ..., None
        ]
        bent = -parts.step[..., None] * (_across(parts.bend) * k[..., None, :]).sum(dim=-1)  # (world, k, part, tube)
        twisted = self._of(self._twisted(line), parts) / line.piece[:, None, None, None] - parts.twist
        wound = parts.torsion * twisted * (parts.step / line.piece[:, None, None])[..., None]
        low = self._sum(parts, bent * (1.0 - parts.share)[..., None] - wound)
        high = self._sum(parts, bent * parts.share[..., None] + wound)
        zero = torch.zeros_like(low[:, :, :1])
        total = torch.cat((low, zero), dim=2) + torch.cat((zero, high), dim=2)
        hold = self._hold(line, length)
        total[:, :, 0] += hold * (line.psi[:, :, 0] + line.base[:, None] - line.angle)[:, None]
        return total.transpose(2, 3).flatten(2)

    def _of(self, values: Tensor, parts: _Parts) -> Tensor:
        """Values of segments at parts, (world, segment, m) -> (world, k, part, m)."""
        worlds = torch.arange(len(values), device=values.device)[:, None, None]
        return values[worlds, parts.segment]

    def _torsion_matrix(self, line: _Line, parts: _Parts, hold: Tensor) -> Tensor:
        """Second derivatives by angles at nodes, positive definite, (world, tube node, tube node)."""
        tubes, nodes = self.count, self.pieces + 1
        total = parts.bending.sum(dim=-1).clamp_min(1.0e-15)[..., None, None]
        weight = parts.bend @ parts.bend.transpose(-1, -2) / total  # (world, 1, part, tube, tube)
        laplace = torch.diag_embed(weight.sum(dim=-1)) - weight
        ends = torch.stack((1.0 - parts.share, parts.share), dim=-1)
        both = ends[..., :, None] * ends[..., None, :]  # (world, 1, part, 2, 2)
        bent = (parts.step[..., None, None] * laplace)[..., None, None] * both[..., None, None, :, :]
        bent = self._sum(parts, bent.flatten(3))[:, 0].unflatten(2, (tubes, tubes, 2, 2))
        wound = self._sum(parts, parts.step[..., None] * parts.torsion)[:, 0] / line.piece[:, None, None] ** 2
        wound = torch.maximum(wound, HELD * line.torsion.amax(dim=1)[:, None, None] / line.piece[:, None, None])
        matrix = torch.zeros((len(hold), tubes, nodes, tubes, nodes)).to(hold)
        k = torch.arange(self.pieces, device=hold.device)
        for a in range(2):
            for b in range(2):
                matrix[:, :, k + a, :, k + b] += bent[..., a, b].permute(1, 0, 2, 3)
        for tube in range(tubes):
            spring, own = wound[:, :, tube], matrix[:, tube, :, tube]
            own[:, k, k] += spring
            own[:, k + 1, k + 1] += spring
            own[:, k, k + 1] -= spring
            own[:, k + 1, k] -= spring
            own[:, 0, 0] += hold[:, tube]
        return matrix.flatten(3).flatten(1, 2)

    def _contacts(self, line: _Line) -> tuple[_Contacts, Tensor]:
        """Contacts of the line, and 1 for those there are, (world, contact)."""
        sim = self.sim
        if sim.model.contact is None:
            none = line.x.new_zeros((len(line.x), 0))
            vectors = line.x.new_zeros((len(line.x), 0, 3))
            return _Contacts(none, vectors, none, none, vectors), none
        side = self._side[sim.contact_pair.long()]  # -1 is the last one
        weight = side.abs()
        normal = side[..., None] * sim.contact_normal.double() * weight[..., None]
        point = sim.contact_point.double()
        start, way = line.x[:, None, :-1], line.x.diff(dim=1)[:, None]
        share = ((point[:, :, None] - start) * way).sum(dim=-1) / way.square().sum(dim=-1).clamp_min(1.0e-18)
        share = share.clamp(0.0, 1.0)
        nearest = (start + share[..., None] * way - point[:, :, None]).square().sum(dim=-1).argmin(dim=2)
        place = (nearest + torch.gather(share, 2, nearest[..., None])[..., 0]) * line.piece[:, None]
        force = (side[..., None] * sim.contact_load.double() * sim.contact_normal.double()).sum(dim=-1)
        force = (weight * side * force).clamp_min(0.0)
        gap = torch.where(weight > 0.0, sim.contact_gap.double(), torch.full_like(weight, FAR))
        load = side[..., None] * sim.contact_load.double()
        return _Contacts(place, normal, gap, force, load), weight

    def _moment(self, line: _Line, point: _Contacts) -> Tensor:
        """Bending moment of all that acts on the line, contacts and weight [N m], (world, segment, 2)."""
        parts = self._parts(line, line.length[:, None])
        mass = self._sum(parts, (parts.step[..., None] * parts.mass))[:, 0, :, 0]
        place = line.piece[:, None] * (0.5 + torch.arange(self.pieces)).to(line.piece)
        weight = mass[..., None] * self.sim.params.gravity.double()[:, None]
        places, forces = torch.cat((place, point.place), dim=1), torch.cat((weight, point.load), dim=1)
        return _levers(line, places, forces).sum(dim=1)

    def _tip(self, line: _Line, place: Tensor) -> tuple[Tensor, Tensor]:
        """Position [m] and direction of the tip, (world, 3) each."""
        along = (place / line.piece).clamp(0.0, self.pieces)
        segment = along.long().clamp_max(self.pieces - 1)
        share, rows = (along - segment)[:, None], torch.arange(len(place), device=place.device)
        x = torch.lerp(line.x[rows, segment], line.x[rows, segment + 1], share)
        ahead = torch.lerp(line.ahead[rows, segment], line.ahead[rows, segment + 1], share)
        return x, ahead


def _levers(line: _Line, place: Tensor, way: Tensor) -> Tensor:
    """How far places of the line go along given ways per bending of segments, (world, row, segment, 2).

    Args:
        line: The line.
        place: Along it [m], (world, row).
        way: Unit vectors, (world, row, 3).
    """
    count = line.axes.shape[1]
    along = (place / line.piece[:, None]).clamp(0.0, count)
    covered = (along[..., None] - torch.arange(count).to(along)).clamp(0.0, 1.0)  # (world, row, segment)
    segment = along.long().clamp_max(count - 1)
    rows = torch.arange(len(place), device=place.device)[:, None]
    x = torch.lerp(line.x[rows, segment], line.x[rows, segment + 1], (along - segment)[..., None])
    middle = line.x[:, None, :-1] + 0.5 * covered[..., None] * line.x.diff(dim=1)[:, None]
    arm = torch.linalg.cross(x[:, :, None] - middle, way[:, :, None].expand_as(middle))
    return covered[..., None] * torch.einsum("wrki,wkic->wrkc", arm, line.axes[..., :2])


def _offsets(line: _Line, levers: Tensor, way: Tensor) -> Tensor:
    """How places go along given ways per first moment of the bending of segments, (world, row, segment, 2)."""
    ahead = torch.nn.functional.normalize(line.x.diff(dim=1), dim=2)[:, None]
    arm = torch.linalg.cross(ahead.expand(-1, way.shape[1], -1, -1), way[:, :, None].expand(-1, -1, ahead.shape[2], -1))
    is_before = (levers != 0.0).any(dim=-1, keepdim=True)
    return torch.where(is_before, -1.0, 0.0).to(arm) * torch.einsum("wrki,wkic->wrkc", arm, line.axes[..., :2])


def _across(bend: Tensor) -> Tensor:
    """Vectors turned by a right angle: their change with the tubes' angles."""
    return torch.stack((-bend[..., 1], bend[..., 0]), dim=-1)


def _solve(matrix: Tensor, sides: Tensor) -> Tensor:
    """Solutions of scaled equations; stiffnesses lie far apart."""
    scale = torch.diagonal(matrix, dim1=1, dim2=2).clamp_min(1.0e-30).rsqrt()
    found: Tensor = torch.linalg.solve(scale[:, :, None] * matrix * scale[:, None], scale[:, :, None] * sides)
    return scale[:, :, None] * found


def _matrices(q: Tensor) -> Tensor:
    """Rotation matrices of unit quaternions x y z w, (..., 3, 3)."""
    x, y, z, w = q.unbind(dim=-1)
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
        (2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
        (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def _difference(before: Tensor, after: Tensor) -> Tensor:
    """Turns from one quaternion to the next, in axes of the first [rad], (..., 3)."""
    u, w, p, r = before[..., :3], before[..., 3:], after[..., :3], after[..., 3:]
    vector = w * p - r * u - torch.linalg.cross(u, p)
    real = w * r + (u * p).sum(dim=-1, keepdim=True)
    size = torch.linalg.vector_norm(vector, dim=-1, keepdim=True)
    factor = torch.where(
        size < 1.0e-9, 2.0 / real.clamp_min(0.5), 2.0 * torch.atan2(size, real) / size.clamp_min(1e-12)
    )
    turn: Tensor = factor * vector
    return turn
