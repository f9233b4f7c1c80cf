"""The response of tubes one in the other: without contact beside the closed form, in contact beside the simulation."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import softwarp as sw
from softwarp import Tube, TubeSection
from softwarp.control import Outcome, TubeController
from softwarp.control.tube_response import TubeResponse
from softwarp.envs.tube_line import TubeLine
from softwarp.envs.tube_torsion import TwistedLine
from softwarp.shapes import Box

CURVED, BEND, STRAIGHT = (0.025, 0.02, 0.015), (0.02, 0.018, 0.016), (0.1, 0.1, 0.1)  # m
RADIUS = (5.0e-4, 7.5e-4, 1.0e-3)  # m, of solid rods, whatever lies within
YOUNGS, RATIO = (2.0e8, 1.0e8, 5.0e7), 20.0  # Pa; G J / E I
LENGTH = ((0.04, 0.03, 0.02), (0.05, 0.021, 0.005))  # m
ANGLE = ((0.5, 0.2, -0.4), (0.4, -0.1, 0.3))  # rad


def tubes() -> list[Tube]:
    """Three tubes with curved ends, all but rigid in torsion."""
    inner = (0.0, RADIUS[0], RADIUS[1])
    return [
        Tube(
            [TubeSection(STRAIGHT[i]), TubeSection.arc(CURVED[i], BEND[i], 0.5 * math.pi)],
            radius=RADIUS[i],
            inner_radius=inner[i],
            youngs=YOUNGS[i],
            nu=1.0 / RATIO - 1.0,
            density=1500.0,
        )
        for i in range(3)
    ]


def closed_form() -> TwistedLine:
    """The same without loads."""
    inner = (0.0, RADIUS[0], RADIUS[1])
    stiff = [e * 0.25 * math.pi * (r**4 - hole**4) for e, r, hole in zip(YOUNGS, RADIUS, inner, strict=True)]
    parts = (CURVED, [1.0 / bend for bend in BEND], stiff, stiff)
    return TwistedLine(TubeLine(*(torch.tensor(part, dtype=torch.float64) for part in parts)), RATIO)


def free_tubes(actions: int) -> tuple[sw.Simulation, int]:
    """Two worlds whose tubes have been pushed out and turned within a second, then left alone for some steps."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    telescope = builder.add_telescope(
        tubes(), segments=24, lengths=(0.002, 0.0, 0.0), windup=False, rayleigh=(0.1, 0.02)
    )
    sim = sw.Simulation(builder.finalize(num_worlds=2, precision="float64"), dt=0.01)
    length, angle = torch.tensor(LENGTH, dtype=torch.float64), torch.tensor(ANGLE, dtype=torch.float64)
    for step in range(actions):
        share = min(1.0, (step + 1) / 60.0)
        sim.control.tube_length.copy_(share * length)
        sim.control.tube_angle.copy_(share * angle)
        sim.step()
    return sim, telescope


def tip_of(line: TwistedLine, q: Tensor, guess: Tensor) -> Tensor:
    """Tips of the closed form for commands q, (world, 6)."""
    return line.from_tips(q[:, :3], line.tips(q[:, :3], q[:, 3:], guess))[1]


def test_free_line_moves_as_the_closed_form_does() -> None:
    """Central differences of the closed form, which twists as the simulation's tubes do.

    While the line is still on its way, ``rest`` tells where to.
    """
    sim, telescope = free_tubes(90)
    line, response = closed_form(), TubeResponse(sim, telescope)
    q = torch.cat((torch.tensor(LENGTH), torch.tensor(ANGLE)), dim=1).double()
    tips = line.tips(q[:, :3], q[:, 3:])
    found = response.measure()
    away = torch.linalg.vector_norm(tip_of(line, q, tips) - found.tip, dim=1)
    left = torch.linalg.vector_norm(tip_of(line, q, tips) - found.rest, dim=1)
    assert (away > 3.0e-4).any() and (left < 0.1 * away + 1.0e-5).all()
    sim.step(500)
    found = response.measure()
    for place in range(6):
        step = torch.zeros(6, dtype=torch.float64)
        step[place] = 1.0e-5 if place < 3 else 1.0e-4
        rate = (tip_of(line, q + step, tips) - tip_of(line, q - step, tips)) / (2.0 * step[place])
        error = torch.linalg.vector_norm(rate - found.tip_rate[:, :, place], dim=1)
        assert (error < 0.01 * torch.linalg.vector_norm(rate, dim=1) + 1.0e-4).all(), place


def pressed(step: Tensor | None = None) -> tuple[sw.Simulation, int]:
    """A curved tube that presses a plane from the side, at rest; with a further change of commands."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    wall = builder.add_rigid(Box((0.05, 0.01, 0.05)), pose=(0.0, 0.013, 0.03, 0.0, 0.0, 0.0, 1.0), kinematic=True)
    telescope = builder.add_telescope(
        tubes()[:1], segments=20, lengths=(0.002,), windup=False, rayleigh=(0.1, 0.02), contact_radius=5.0e-4
    )
    builder.add_contact(telescope, wall, mu=0.0)
    sim = sw.Simulation(builder.finalize(precision="float64", contact_capacity=30), dt=0.01)
    goal = torch.tensor([0.035, 0.2], dtype=torch.float64)
    for k in range(400):
        command = min(1.0, (k + 1) / 60.0) * goal
        if step is not None and k > 100:
            command = command + min(1.0, (k - 100) / 20.0) * step
        sim.control.tube_length[:] = command[0]
        sim.control.tube_angle[:] = command[1]
        sim.step()
    return sim, telescope


@pytest.mark.slow  # seconds; the mechanism is in the program of the next test
@pytest.mark.parametrize("step", [(5.0e-4, 0.0), (0.0, 0.05)])
def test_line_in_contact_moves_along_the_wall(step: tuple[float, float]) -> None:
    """Tip and wall force after a small change, beside the simulation brought to rest there."""
    change = torch.tensor(step, dtype=torch.float64)
    before, after = (TubeResponse(sim, 0).measure() for sim, _ in (pressed(), pressed(change)))
    assert before.force.sum() > 0.005
    held = before.force[0] > 1.0e-6
    rate, compliance = before.rate[0][held], before.compliance[0][held][:, held]
    change_force = -torch.linalg.lstsq(compliance, (rate @ change)[:, None]).solution[:, 0]
    free = before.tip_rate[0] @ change
    way = free + before.tip_compliance[0][:, held] @ change_force
    moved = after.tip[0] - before.tip[0]
    assert torch.linalg.vector_norm(way - moved) < 0.1 * torch.linalg.vector_norm(moved)
    assert torch.linalg.vector_norm(free - moved) > 2.0 * torch.linalg.vector_norm(way - moved)


def steered(targets: Tensor, periods: int, **options: object) -> tuple[sw.Simulation, TubeController, Tensor]:
    """Free tubes under control from the start on; the simulation, the control and lengths after every period."""
    sim, telescope = free_tubes(30)
    controller = TubeController(
        sim, telescope, period=0.1, insertion=(0.004, 0.004, 0.004), turning=(0.3, 0.3, 0.3), **options
    )
    lengths = []
    for _ in range(periods):
        controller.solve(targets)
        sim.step(10)
        lengths.append(sim.control.tube_length.clone())
    return sim, controller, torch.stack(lengths)


@pytest.mark.slow  # seconds; the next one is short
def test_tips_come_to_targets_within_rates_and_leads() -> None:
    """Tips of the closed form, which both worlds reach; no tube overtakes the one within it, none is too fast."""
    line = closed_form()
    q = torch.tensor([[0.045, 0.02, 0.01, 0.5, 0.3, 0.0], [0.035, 0.025, 0.02, -0.4, 0.3, 0.4]], dtype=torch.float64)
    targets = tip_of(line, q, q[:, 3:])
    leads = ((0.0, math.inf), (0.0, 0.02))
    sim, controller, lengths = steered(targets, 40, leads=leads, most=(0.06, 0.05, 0.04))
    solution = controller.solve(targets, apply=False)
    assert (torch.linalg.vector_norm(controller.positions() - targets, dim=1) < 1.0e-4).all()
    assert solution.outcome.tolist() == [Outcome.REACHED, Outcome.REACHED]
    assert (lengths.diff(dim=0).abs() < 0.004 + 1e-12).all()
    lead = lengths[..., :-1] - lengths[..., 1:]
    assert (lead > -1e-12).all() and (lead[..., 1] < 0.02 + 1e-12).all()
    assert not sim.status.any()


def test_a_target_out_of_reach_is_told() -> None:
    """A straight wire that may not come out farther: no command leads nearer to what lies ahead of it."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    wire = Tube([TubeSection(0.1)], radius=5.0e-4, youngs=1.0e8, density=1500.0)
    telescope = builder.add_telescope([wire], segments=8, lengths=(0.01,), windup=False, rayleigh=(0.1, 0.02))
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01)
    controller = TubeController(sim, telescope, period=0.1, insertion=(0.005,), turning=(0.1,), most=(0.03,))
    told = []
    for _ in range(20):
        told.append(controller.solve(torch.tensor([[0.0, 0.0, 0.05]])).outcome.item())
        sim.step(10)
    assert told[0] == Outcome.MOVING and told[-1] == Outcome.UNREACHABLE
    assert controller.positions()[0, 2] == pytest.approx(0.03, abs=1.0e-5)
    failed = controller.solve(torch.tensor([[0.0, 0.0, math.nan]]))
    assert failed.outcome.item() == Outcome.FAILED and torch.equal(failed.command, controller.present())


@pytest.mark.slow  # seconds; the row of the program is one among others
@pytest.mark.parametrize("share", [0.4, math.inf])
def test_force_is_limited(share: float) -> None:
    """A target behind the wall that a tube presses: with a limit the wall comes to bear that, without one not less."""
    sim, telescope = pressed()
    options = {"period": 0.1, "insertion": (0.002,), "turning": (0.1,), "most": (0.05,), "calm": 1.0e-6}
    start = TubeResponse(sim, telescope).measure()
    limit = share * float(start.force.sum())
    controller = TubeController(sim, telescope, force_limit=limit, push=False, **options)
    for _ in range(55):
        controller.solve(start.tip + torch.tensor([0.0, 0.02, 0.0], dtype=torch.float64))
        sim.step(10)
    force = float(controller.response.measure().force.sum())
    if math.isinf(share):
        assert force > 0.9 * float(start.force.sum())
    else:
        assert 0.95 * limit < force < 1.05 * limit


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tip": 3}, "tip: must be one of the 3 tubes"),
        ({"share": 1.5}, "share must be at most 1"),
        ({"damping": 0.0}, "damping must be positive"),
        ({"force_limit": -1.0}, "force_limit must be positive"),
        ({"insertion": (0.1, 0.1)}, "insertion must be 3 numbers"),
        ({"leads": ((0.0, 0.1),)}, "leads must have 2 rows"),
        ({"leads": ((0.2, 0.1), (0.0, 0.1))}, "from <= to"),
    ],
)
def test_refusals(options: dict[str, object], message: str) -> None:
    """Settings outside their range, and targets of another shape."""
    sim, telescope = free_tubes(0)
    with pytest.raises(ValueError, match=message):
        TubeController(sim, telescope, **options)
    with pytest.raises(ValueError, match=r"targets must have shape \(2, 3\)"):
        TubeController(sim, telescope).solve(torch.zeros(3))
