"""Steps that worlds take again: which do, that others keep their bits, and that it depends on no other world."""

from __future__ import annotations

import math

import pytest
import torch

import softwarp as sw
from softwarp.kernels.step.newton import BEST, MERIT
from softwarp.solvers import repeats
from softwarp.solvers.repeats import RepeatingEuler

THROWN = (2, 5)  # worlds
LARGE = (0.01, 0.0125, 0.075)  # ball that a tube stays at
SEEN = ("frame_pose", "frame_twist", "tube_length", "contact_key", "contact_force", "contact_load", "status", "time")


def scene(
    worlds: int,
    *,
    device: str = "cpu",
    path: str = "scalar",
    swing: float = 0.05,
    threads: int = 1,
    ball: tuple[float, float, float] = (0.005, 0.0075, 0.07),
) -> sw.Simulation:
    """A tube beside a ball: its radius, x and z [m]."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    tube = sw.Tube([sw.TubeSection(0.1)], radius=1e-3, youngs=1e8)
    line = builder.add_telescope([tube], segments=8, lengths=(0.08,), contact_radius=2e-4, rayleigh=(0.0, 0.02))
    radius, x, z = ball
    builder.add_contact(line, builder.add_rigid(sw.Sphere(radius), kinematic=True, pose=(x, 0.001, z)))
    model = builder.finalize(worlds, device)
    path = path if device == "cpu" else "auto"
    return sw.Simulation(model, dt=0.01, solver_path=path, threads=threads, repeat_swing=swing)  # type: ignore[arg-type]


def push(sim: sw.Simulation, worlds: tuple[int, ...]) -> None:
    """Bend some tubes hard, against the ball, and lengthen them."""
    for world in worlds:
        sim.control.rod_force[world, -1, 0] = 0.05
        sim.control.tube_length[world] = 0.0802


def repeated(sim: sw.Simulation) -> list[int]:
    """Worlds that took the last step again, in the order in which they did."""
    (stepper,) = sim._steppers
    assert isinstance(stepper, RepeatingEuler)
    return stepper.order.numpy()[: stepper.progress.numpy()[0]].tolist()


@pytest.mark.parametrize(
    ("device", "path"),
    [
        ("cpu", "scalar"),
        pytest.param("cpu", "lanes", marks=pytest.mark.slow),
        pytest.param("cuda:0", "auto", marks=pytest.mark.cuda),
    ],
)
def test_a_world_repeats_a_step_by_its_own_need(device: str, path: str) -> None:
    """Those that are pushed do so in the midst of others at rest, and all have the bits that they have alone."""
    batch, *alone = (scene(worlds, device=device, path=path, ball=LARGE) for worlds in (9, 1, 1, 1))
    plain = scene(9, device=device, path=path, swing=math.inf, ball=LARGE)
    for sim, worlds in zip((batch, plain, alone[0], alone[1]), (THROWN, THROWN, (0,), (0,)), strict=True):
        push(sim, worlds)
    told, contacts = [], 0
    for _ in range(3):
        for sim in (batch, plain, *alone):
            sim.step()
        alone[1]._steppers[0].always = True  # from the second step on it asks nobody, as in a recording of Torch
        told.append(repeated(batch))
        contacts += int(batch.contact_count[2])
        assert repeated(alone[0]) == ([0] if told[-1] else [])
    assert told.count(list(THROWN)) > 1 and contacts > 0
    for name in SEEN:
        state = batch.state_tensors()[name]
        for world in range(9):
            same = (alone[0], alone[1]) if world in THROWN else (alone[2],)
            for sim in same:
                assert torch.equal(state[world], sim.state_tensors()[name][0]), (name, world)
            if world not in THROWN:
                assert torch.equal(state[world], plain.state_tensors()[name][world]), (name, world)
    assert not torch.equal(batch.frame_pose[2], plain.frame_pose[2])


@pytest.mark.parametrize("iterations", [3, 6])
def test_contacts_and_forces_are_those_of_the_iterate_that_stands(
    monkeypatch: pytest.MonkeyPatch, iterations: int
) -> None:
    """A world whose iterations end without convergence has, with the contacts that it tells, its best imbalance."""
    monkeypatch.setattr(repeats, "ITERATIONS", iterations)
    monkeypatch.setattr(repeats, "TOLERANCE", 1e-12)
    monkeypatch.setattr(repeats, "DEEP", 1e6)
    sim = scene(1, ball=LARGE)
    push(sim, (0,))
    differ = touching = 0
    for _ in range(4):
        sim.step()
        newton, control = sim._steppers[0].places[0].newton, sim._steppers[0].places[0].control
        newton.advance()
        system, rows = control.system, control.system.work.control.real.numpy()[0, :, 0]
        last = float(rows[MERIT])
        assert system.contact is not None
        touching += int(system.contact.contacts.count.real.numpy().max() > 0)
        system.measure_rows()
        system.forces()
        system.tangent()
        system.right_hand_side(newton.h, inertia=True, moving=True)
        system.imbalance(newton.h, inertia=True)
        found, scale = system.work.norm.real.numpy()[0, :2, 0]
        assert found / scale == pytest.approx(float(rows[BEST]), rel=1e-6)
        differ += last > 1.01 * float(rows[BEST])
    assert differ > 0 and touching > 0


def test_worlds_that_repeat_side_by_side_keep_their_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    """One whose iterations have ended waits for the others, and has then what it has alone, forces of contacts too."""
    forces = (0.03, 0.05, 0.06)
    alone = [scene(1) for _ in forces]
    monkeypatch.setattr(repeats, "_places", lambda _: [len(forces)])
    batch = scene(len(forces))
    contacts = 0
    for world, force in enumerate(forces):
        for sim, row in ((batch, world), (alone[world], 0)):
            push(sim, (row,))
            sim.control.rod_force[row, -1, 0] = force
    for _ in range(3):
        for sim in (batch, *alone):
            sim.step()
        contacts += int((batch.contact_count > 0).sum())
        for name in (*SEEN, "residual"):
            for world, sim in enumerate(alone):
                assert torch.equal(batch.state_tensors()[name][world], sim.state_tensors()[name][0]), (name, world)
    assert contacts > 3 and len(repeated(batch)) == len(forces)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.cuda)])
def test_what_is_left_takes_fewer_places(monkeypatch: pytest.MonkeyPatch, device: str) -> None:
    """Six worlds in places for four, then for two: what they come to is what they come to alone."""
    forces = (0.03, 0.04, 0.05, 0.06, 0.05, 0.045)
    alone = [scene(1, device=device) for _ in forces]
    monkeypatch.setattr(repeats, "_places", lambda _: [4, 2])
    batch, taken = scene(len(forces), device=device), []
    stepper = batch._steppers[0]
    assert isinstance(stepper, RepeatingEuler)
    for places in stepper.places:
        step = places.step
        monkeypatch.setattr(places, "step", lambda *a, c=places.count, s=step: (taken.append(c), s(*a)))
    for world, force in enumerate(forces):
        for sim, row in ((batch, world), (alone[world], 0)):
            push(sim, (row,))
            sim.control.rod_force[row, -1, 0] = force
    for step in range(3):
        for sim in (batch, *alone):
            sim.step()
        if step == 0:
            assert len(repeated(batch)) == len(forces) and taken == [4, 2]
        for name in SEEN:
            for world, sim in enumerate(alone):
                assert torch.equal(batch.state_tensors()[name][world], sim.state_tensors()[name][0]), (name, world)
    assert len(repeated(batch)) > 2


def test_threads_take_what_is_left_with_the_same_bits() -> None:
    """Seventeen worlds in four shards of two threads, some of which repeat steps, are what one thread makes of them."""
    one, two = scene(17), scene(17, threads=2)
    assert len(one._bounds) == 1 and len(two._bounds) == 4 and len({id(s.work.x.real) for s in two.systems}) == 4
    for sim in (one, two):
        push(sim, (0, 1, 2, 9))
        sim.step()
        sim.step(4)
        sim.step()
    for name in SEEN:
        assert torch.equal(one.state_tensors()[name], two.state_tensors()[name]), name
    assert any(stepper.progress.numpy()[0] for stepper in two._steppers)


def test_a_world_that_cannot_be_stepped_says_so() -> None:
    """A command that is not finite fails in its world, whose step cannot be taken again; another goes on."""
    sim = scene(2)
    push(sim, (0, 1))
    sim.control.rod_force[0, -1, 0] = math.nan
    sim.step()
    assert sim.status.tolist() == [sw.Status.NONFINITE, sw.Status.OK]
    assert sim.frame_pose.isfinite().all()
    sim.control.rod_force[0, -1, 0] = 0.2
    sim.step()
    assert (sim.status == sw.Status.OK).all()
    assert sim.time[0] < sim.time[1]


def test_nothing_is_repeated_unless_asked_for() -> None:
    """Neither without a limit, nor without a line, nor by steps that iterate anyway."""
    assert isinstance(scene(1)._steppers[0], RepeatingEuler)
    assert not isinstance(scene(1, swing=math.inf)._steppers[0], RepeatingEuler)
    builder = sw.ModelBuilder()
    builder.add_rigid(sw.Sphere(0.01), density=1e3)
    assert not isinstance(sw.Simulation(builder.finalize(1), repeat_swing=0.05)._steppers[0], RepeatingEuler)
    builder.add_telescope([sw.Tube([sw.TubeSection(0.1)], radius=1e-3, youngs=1e9)], segments=4, lengths=(0.08,))
    model = builder.finalize(1)
    assert isinstance(sw.Simulation(model, repeat_swing=0.05)._steppers[0], RepeatingEuler)
    assert not isinstance(sw.Simulation(model, newton_iterations=3, repeat_swing=0.05)._steppers[0], RepeatingEuler)
