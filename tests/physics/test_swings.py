"""Lines of telescopes that swing by more than a linearisation holds: calm, at rest as before, quiet ones to the bit."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import Tube, TubeSection
from softwarp.shapes import Vessel
from softwarp.solvers import repeats

RADIUS = 0.0065  # m, of a channel
PUSH = 0.002  # m a step


def crumpling(most_swing: float, repeat_swing: float) -> tuple[sw.Simulation, Vessel]:
    """A soft wire in a channel that a block closes 15 cm from the port."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    vessel = Vessel.from_tubes([(np.array([(0.0, 0.0, z) for z in (-0.02, 0.1, 0.22)]), RADIUS)], 2e-3)
    wire = Tube([TubeSection(0.4, (1.0, 0.3, 0.0))], radius=9e-4, youngs=1e7, density=1550.0)
    line = builder.add_telescope(
        [wire], segments=24, lengths=(0.1,), windup=False, rayleigh=(0.1, 0.02), contact_radius=1e-3
    )
    builder.add_contact(line, builder.add_rigid(vessel, kinematic=True), mu=0.1)
    block = sw.Box((0.02, 0.02, 0.005))
    builder.add_contact(line, builder.add_rigid(block, kinematic=True, pose=(0.0, 0.0, 0.155)), mu=0.1)
    model = builder.finalize(precision="float64", contact_capacity=96)
    return sw.Simulation(model, dt=0.01, most_swing=most_swing, repeat_swing=repeat_swing), vessel


def push(most_swing: float, steps: int, repeat_swing: float = math.inf) -> tuple[float, float, int]:
    """Largest way of a node in a step [m], least clearance of the middle of the line [m], worst status."""
    sim, vessel = crumpling(most_swing, repeat_swing)
    way, clear, status = 0.0, math.inf, 0
    for step in range(steps):
        before = sim.rod_x.clone()
        sim.control.tube_length[:] = 0.1 + PUSH * (step + 1)
        sim.step()
        way = max(way, float((sim.rod_x - before).norm(dim=2).max()))
        clear = min(clear, float(vessel.clearance(sim.rod_x[0, 1:].numpy()).min()))
        status = max(status, int(sim.status[0]))
    return way, clear, status


def test_a_wire_that_crumples_stays_in_its_channel() -> None:
    """Pushed on by 8 cm against a block, in folds, no node goes farther than 1 cm in a step of 2 mm, nor into the wall.

    Without a limit it goes by more than 10 cm, as long as the channel is.
    """
    way, clear, status = push(0.3, 60)
    assert way < 0.010 and clear > 0.0 and status == sw.Status.OK
    way, clear, status = push(math.inf, 60)
    assert way > 0.1 and clear < 0.0


def test_steps_taken_again_leave_a_wire_that_crumples_inside() -> None:
    """The same, without another limit: its middle is never nearer to the wall than three quarters of its radius."""
    way, clear, status = push(math.inf, 60, 0.05)
    assert way < 0.006 and clear > 0.75e-3 and status == sw.Status.OK


def slid(monkeypatch: pytest.MonkeyPatch, looks: int) -> tuple[float, float]:
    """Least clearance of a wire that its tip is pulled round a vessel's wall with [m], and how far round [rad]."""
    monkeypatch.setattr(repeats, "LOOKS", looks)
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    line = np.array([(0.0, 0.0, z) for z in (-0.02, 0.04, 0.12)])
    vessel = Vessel.from_tubes([(line, 0.006)], 1e-3, wall=0.02)
    wire = Tube([TubeSection(0.1)], radius=9e-4, youngs=1e7, density=1550.0)
    telescope = builder.add_telescope(
        [wire], segments=8, lengths=(0.08,), windup=False, rayleigh=(0.1, 0.02), contact_radius=1e-3
    )
    builder.add_contact(telescope, builder.add_rigid(vessel, kinematic=True), mu=0.1)
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01, repeat_swing=0.05, solver_path="scalar")
    clear = math.inf
    for step in range(10):
        sim.control.rod_force[0, -1, 0] = 0.0 if step < 5 else 0.02
        sim.control.rod_force[0, -1, 1] = -0.01 if step < 5 else 0.0
        sim.step()
        assert sim.status[0] == sw.Status.OK
        clear = min(clear, float(vessel.clearance(sim.rod_x[0, 1:].numpy()).min()))
    x, y = sim.rod_x[0, -1, :2].tolist()
    return clear, math.atan2(y, x) + 0.5 * math.pi


def test_a_wire_slides_round_a_wall_that_curves_away(monkeypatch: pytest.MonkeyPatch) -> None:
    """Thrown to a lumen's next side, a quarter turn, it is nowhere deeper in its wall than a hundredth of its radius.

    Planes of contacts let it slide on into the wall; without looks there iterates end 0.15 of the radius deep.
    """
    clear, turn = slid(monkeypatch, repeats.LOOKS)
    assert clear > 0.99e-3 and 1.0 < turn < 2.2
    clear, _ = slid(monkeypatch, 0)
    assert clear < 0.9e-3


def stretched(repeat_swing: float) -> float:
    """Largest stretch of a segment, from end to end, after steps in which a force swings a wire in the open."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    tube = Tube([TubeSection(0.1)], radius=9e-4, youngs=1e7, density=1550.0)
    builder.add_telescope([tube], segments=8, lengths=(0.08,), rayleigh=(0.0, 0.01))
    sim = sw.Simulation(builder.finalize(1, precision="float64"), dt=0.01, repeat_swing=repeat_swing)
    sim.control.rod_force[:, -1, 0] = 6e-3
    largest = 0.0
    for _ in range(4):
        sim.step()
        lengths = (sim.rod_x[0, 1:] - sim.rod_x[0, :-1]).norm(dim=1)
        largest = max(largest, float((lengths * 8 / 0.08 - 1.0).max()))
    return largest


def test_steps_taken_again_stretch_nothing() -> None:
    """A linear step lengthens what it turns by several percent, one that is taken again hardly, as it bends."""
    left, taken = stretched(math.inf), stretched(0.05)
    assert left > 0.02
    assert 0.0 < taken < 1e-4


def swinging(most_swing: float, forces: tuple[float, ...]) -> sw.Simulation:
    """Free tubes of 8 cm, one in each world, that forces [N] at their tips begin to bend."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    tube = Tube([TubeSection(0.1)], radius=1e-3, youngs=1e8, density=1550.0)
    builder.add_telescope([tube], segments=8, lengths=(0.08,), rayleigh=(0.0, 0.02))
    sim = sw.Simulation(
        builder.finalize(len(forces), precision="float64"), dt=0.01, most_swing=most_swing, solver_path="scalar"
    )
    sim.control.rod_force[:, -1, 0] = torch.tensor(forces, dtype=torch.float64)
    return sim


def turned(most_swing: float) -> float:
    """By what a moment turns the tip against the next node in one step [rad], of a tube too heavy to go anywhere."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    tube = Tube([TubeSection(0.1)], radius=1e-3, youngs=1e8, density=1e9)
    builder.add_telescope([tube], segments=8, lengths=(0.08,))
    sim = sw.Simulation(builder.finalize(1, precision="float64"), dt=0.01, most_swing=most_swing)
    sim.control.rod_force[:, -1, 3] = 2.5
    sim.step()
    return 2.0 * math.acos(float((sim.frame_pose[0, -1, 3:] * sim.frame_pose[0, -2, 3:]).sum()))


def test_a_tip_that_turns_swings_its_segment() -> None:
    """By half of its turn: what contacts hold in place, a step may spin all the same until it crumples."""
    assert turned(math.inf) > 1.5
    assert turned(0.5) == pytest.approx(1.0, rel=1e-3)
    assert turned(0.3) == pytest.approx(0.6, rel=1e-3)


@pytest.mark.parametrize("repeat_swing", [math.inf, 0.1])
def test_ends_of_a_segment_do_not_turn_over(repeat_swing: float) -> None:
    """A moment that would wind up the tip of a heavy tube stops 2.8 rad from the next node, on the side it came from.

    Beyond half a turn a segment's strain is that of the other way round, which throws its end to the other side.
    """
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    tube = Tube([TubeSection(0.1)], radius=1e-3, youngs=1e8, density=1e9)
    builder.add_telescope([tube], segments=8, lengths=(0.08,))
    sim = sw.Simulation(builder.finalize(1, precision="float64"), dt=0.01, repeat_swing=repeat_swing)
    sim.control.rod_force[:, -1, 3] = 2.5
    angles = []
    for _ in range(12):
        sim.step()
        p, q = sim.frame_pose[0, -2, 3:].numpy(), sim.frame_pose[0, -1, 3:].numpy()
        same = math.copysign(1.0, float(p @ q))
        angles.append(2.0 * math.atan2(same * float(q[0] * p[3] - p[0] * q[3] + p[1] * q[2] - p[2] * q[1]), abs(p @ q)))
    assert angles[0] > 0.9 and min(angles) > 0.0
    assert 2.5 < angles[-1] < 2.8 + 1e-6
    assert int(sim.status[0]) == sw.Status.OK


def test_a_limit_changes_no_state_of_rest() -> None:
    """A tip under a force that bends the tube by a radian comes to the same place, if later."""
    free, held = swinging(math.inf, (0.02,)), swinging(0.02, (0.02,))
    free.step(3)
    held.step(3)
    tips = free.rod_x[0, -1, 0], held.rod_x[0, -1, 0]
    assert tips[1] < 0.5 * tips[0]
    free.step(400)
    held.step(400)
    assert float(free.rod_x[0, -1, 0]) > 0.03
    torch.testing.assert_close(held.rod_x, free.rod_x, atol=1e-7, rtol=0.0)
    assert float(held.rod_v.abs().max()) < 1e-6


def test_a_world_below_the_limit_keeps_its_bits() -> None:
    """Beside one that is held back, and as without any limit."""
    pair, alone = swinging(0.05, (0.02, 1e-4)), swinging(math.inf, (0.02, 1e-4))
    pair.step(20)
    alone.step(20)
    assert torch.equal(pair.frame_pose[1], alone.frame_pose[1])
    assert not torch.equal(pair.frame_pose[0], alone.frame_pose[0])
