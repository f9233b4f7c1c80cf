"""Room for contacts that grows: the bits of a simulation that had it from the start, and everything else stays."""

from typing import Any

import pytest
import torch

import softwarp as sw
from softwarp.control import InverseController
from softwarp.planning.env_model import EnvModel
from tests.contract.test_batch_contact import PATHS, build, run, vary

each_path = pytest.mark.parametrize(("options", "precision", "device"), PATHS)
SCALAR: dict[str, Any] = {"solver_path": "scalar"}


def held(sim: sw.Simulation) -> dict[str, torch.Tensor]:
    """All that a snapshot has, contacts cut to those that exist in any world."""
    arrays = sim.snapshot().arrays
    most = int(arrays["state.contact_count"].max())
    return {key: value[:, :most] if key.startswith("state.contact_") and value.ndim > 1 else value
            for key, value in arrays.items()}  # fmt: skip


def assert_equal(a: sw.Simulation, b: sw.Simulation) -> None:
    first, second = held(a), held(b)
    different = [key for key, value in first.items() if not torch.equal(value, second[key])]
    assert not different


@each_path
@pytest.mark.parametrize("count", [1, pytest.param(5, marks=pytest.mark.slow)])
def test_grown_room_gives_the_bits_of_room_from_the_start(
    options: dict[str, Any], precision: str, device: str, count: int
) -> None:
    """From room for 2 contacts to more than 8: no step differs, and none is told to have left one out."""
    wide = build(9, options, precision, device)
    narrow = build(9, {**options, "contact_growth": True}, precision, device, capacity=2)
    for sim in (wide, narrow):
        vary(sim, list(range(9)))
    for _ in range(120 // count):
        for sim in (wide, narrow):
            sim.step(count)
    assert int(wide.contact_count.max()) > 8 and narrow.model.contact_capacity < 64
    assert int(narrow.contact_overflow.max()) == 0 and bool((narrow.status != sw.Status.CONTACT_OVERFLOW).all())
    assert_equal(wide, narrow)


def test_growing_by_hand_changes_nothing_else() -> None:
    """State, commands, initial state and time step are kept; views that do not count contacts are the same memory."""
    sim, twin = build(3, SCALAR, capacity=40), build(3, SCALAR, capacity=40)
    for each in (sim, twin):
        vary(each, [0, 1, 2])
        run(each, 60)
        each.set_initial()
        run(each, 5)
    node_x, revision = sim.node_x, sim.revision
    sim.grow_contacts(41)
    assert sim.contact_key.shape == (3, 41) and sim.node_x.data_ptr() == node_x.data_ptr() and sim.revision > revision
    assert bool((sim.contact_pair[:, 40] == -1).all())
    for each in (sim, twin):
        run(each, 30)
    assert_equal(sim, twin)
    for each in (sim, twin):
        each.reset(torch.tensor([True, False, True]))
        run(each, 3)
    assert_equal(sim, twin)
    result = sim.solve_static(max_iterations=3)
    assert result.iterations <= 3


def test_snapshots_pass_between_rooms_of_different_size() -> None:
    """Into more room always; into less where the contacts find place, else refused, or room is made."""
    wide, narrow = build(2, SCALAR, capacity=6), build(2, SCALAR, capacity=6)
    empty = wide.snapshot()
    wide.grow_contacts(64)
    narrow.restore(wide.snapshot())  # nothing touches yet
    wide.restore(empty)
    for sim in (wide, narrow):
        vary(sim, [0, 1])
    run(wide, 120)
    full = wide.snapshot()
    before = narrow.snapshot()
    with pytest.raises(ValueError, match=r"holds (\d+) contacts, .* room for 6; .*grow_contacts\(\1\)"):
        narrow.restore(full)
    assert all(torch.equal(value, before.arrays[key]) for key, value in narrow.snapshot().arrays.items())
    growing = build(2, {**SCALAR, "contact_growth": True}, capacity=6)
    growing.restore(full)
    narrow.grow_contacts(int(full.arrays["state.contact_count"].max()))
    narrow.restore(full)
    for sim in (wide, narrow, growing):
        run(sim, 20)
    assert_equal(wide, growing)


def test_overflow_that_was_told_stays_told() -> None:
    """Room that grows later does not hide what an earlier step left out."""
    sim = build(2, {**SCALAR, "contact_growth": True}, capacity=2)
    sim.contact_overflow[1] = 7
    run(sim, 60)
    assert sim.contact_overflow.tolist() == [0, 7] and sim.model.contact_capacity > 2


def test_memory_that_is_short_leaves_the_state_of_before(monkeypatch: pytest.MonkeyPatch) -> None:
    sim = build(2, {**SCALAR, "contact_growth": True}, capacity=2)

    def refuse(*_: Any) -> None:
        raise MemoryError("room for contacts takes 2 GiB, 1 is free")

    monkeypatch.setattr("softwarp.simulation.with_room", refuse)
    seen = sim.snapshot()
    with pytest.raises(MemoryError):
        for _ in range(60):
            seen = sim.snapshot()
            sim.step()
    assert all(torch.equal(value, seen.arrays[key]) for key, value in sim.snapshot().arrays.items())


@pytest.mark.slow
def test_inverse_control_follows_the_room() -> None:
    """A controller that was made before gives the commands of one that is made after."""
    builder = sw.ModelBuilder()
    floor = builder.add_rigid(sw.Plane(), kinematic=True)
    mesh = sw.meshing.box((0.1, 0.02, 0.02), (5, 1, 1))
    beam = builder.add_tets(
        mesh, material=sw.Corotational(1e5, 0.4, method="large"), density=1000.0, rayleigh=(1, 0.01)
    )
    builder.fix(beam, box=((-1, -1, -1), (1e-6, 1, 1)))
    builder.add_cable(beam, waypoints=[(0.1, 0.01, 0.018), (0.0, 0.01, 0.018)], max_displacement=0.01)
    tip = builder.add_marker(beam, (0.1, 0.01, 0.01))
    builder.add_contact(beam, floor, mu=0.5)
    sim = sw.Simulation(builder.finalize(contact_capacity=12), dt=0.01)
    run(sim, 20)
    old = InverseController(sim, [tip])
    target = sim.marker_x[:, tip] + torch.tensor([[0.0, 0.0, 0.005]])
    old.solve(target, apply=False)
    sim.grow_contacts(20)
    new = InverseController(sim, [tip])
    for _ in range(5):
        sim.step()
        first, second = old.solve(target, apply=False), new.solve(target)
        torch.testing.assert_close(first.command, second.command, rtol=0.0, atol=0.0)


def test_environment_that_grows() -> None:
    """Same bits as with room from the start, nothing overflows; an environment without growth tells that it lacks."""
    made = {
        "wide": sw.make("CatchTheObject", num_worlds=2, seed=3),
        "growing": sw.make("CatchTheObject", num_worlds=2, seed=3, contact_capacity=1, contact_growth=True),
        "narrow": sw.make("CatchTheObject", num_worlds=2, seed=3, contact_capacity=1),
    }
    ends = {}
    for name, env in made.items():
        ends[name] = env.rollout(env.max_episode_steps, lambda td: td.set("action", torch.ones(2, 1)))
    assert torch.equal(ends["wide"]["next", "observation"], ends["growing"]["next", "observation"])
    assert made["growing"].sim.model.contact_capacity > 1
    assert made["growing"].pop_episode_log()["overflowed"] == 0.0 < made["narrow"].pop_episode_log()["overflowed"]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: build(1, SCALAR).grow_contacts(3), "capacity must be at least 64"),
        (lambda: build(1, SCALAR).grow_contacts(64.5), "contact_capacity must be an integer"),
        (lambda: build(1, SCALAR).grow_contacts(10**9), "at most 1000000"),
        (lambda: sw.make("CartPole").sim.grow_contacts(3), "no contact pairs"),
        (lambda: build(1, {"contact_growth": "yes"}), "contact_growth must be True or False"),
        (lambda: sw.make("CatchTheObject", capture=True, contact_growth=True), "exclude each other"),
        (lambda: EnvModel(sw.make("CatchTheObject", contact_growth=True), worlds=2), "contact_capacity that it needs"),
    ],
)
def test_refusals(call: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()
