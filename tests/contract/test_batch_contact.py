"""Worlds with contacts on never influence each other and resume to the bit (catalogue 13.1 to 13.4, 13.7, 13.8).

A soft block, a second one that falls on it, a ball, a cube and a rod fall on a plane and on each other; worlds differ
in velocities and friction.
"""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

import softwarp as sw
from softwarp import meshing
from softwarp.model.contact import ContactModel
from softwarp.model.frames import FrameModel
from softwarp.solvers.collision.arrays import SceneArrays
from tests.contract.batch_checks import assert_same
from tests.contract.test_batch import KEPT, constants, held_arrays

PATHS = [
    pytest.param({"solver_path": "scalar"}, "float32", "cpu", id="scalar"),
    pytest.param({"solver_path": "lanes"}, "float32", "cpu", id="lanes"),
    pytest.param({"solver_path": "scalar"}, "float64", "cpu", id="float64", marks=pytest.mark.slow),
    pytest.param(
        {"solver_path": "lanes", "newton_iterations": 4}, "float32", "cpu", id="lanes, Newton", marks=pytest.mark.slow
    ),
    pytest.param({}, "float32", "cuda:0", id="cuda", marks=pytest.mark.cuda),
]
each_path = pytest.mark.parametrize(("options", "precision", "device"), PATHS)
FLOOR, BALL, CUBE = range(3)
GOOD = (sw.Status.OK, sw.Status.MAX_ITERATIONS)


def build(
    worlds: int, options: dict[str, Any], precision: str = "float32", device: str = "cpu", capacity: int = 64
) -> sw.Simulation:
    """The scene of the module docstring."""
    builder = sw.ModelBuilder()
    floor = builder.add_rigid(sw.Plane(), kinematic=True)
    soft: dict[str, Any] = {"material": sw.NeoHookean(5e4, 0.3), "density": 1000, "rayleigh": (1.0, 0.01)}
    block = builder.add_tets(meshing.box((0.1, 0.1, 0.05), (2, 2, 1)), **soft)
    upper = meshing.box((0.04, 0.03, 0.03), (1, 1, 1))
    crumb = builder.add_tets(meshing.TetMesh(upper.nodes + (0.011, 0.013, 0.055), upper.tets), **soft)
    ball = builder.add_rigid(sw.Sphere(0.03), density=1000, pose=(0.07, 0.07, 0.1))
    cube = builder.add_rigid(sw.Box((0.05,) * 3), density=1000, pose=(0.2, 0.05, 0.06))
    points = np.linspace((-0.05, 0.15, 0.03), (0.25, 0.15, 0.05), 6)
    rod = builder.add_rod(points, radius=0.005, youngs=1e6, density=1000)
    for part in (block, crumb, ball, cube, rod):
        builder.add_contact(part, floor, mu=0.4)
    builder.add_contact(ball, block, mu=0.4, restitution=0.3)
    builder.add_contact(crumb, block, mu=0.4)
    model = builder.finalize(worlds, device, precision, contact_capacity=capacity)
    return sw.Simulation(model, dt=0.01, **options)


def vary(sim: sw.Simulation, identity: list[int]) -> None:
    """Give world i of ``sim`` the velocities and the friction of individual ``identity[i]``."""
    for i, number in enumerate(identity):
        generator = np.random.default_rng(number)
        sim.body_twist[i, BALL:, :3] = torch.as_tensor(generator.uniform(-0.4, 0.4, (2, 3))).to(sim.body_twist)
        sim.params.pair_mu[i] = float(generator.uniform(0.1, 0.8))


def run(sim: sw.Simulation, steps: int) -> None:
    for _ in range(steps):
        sim.step()


def state(sim: sw.Simulation) -> dict[str, torch.Tensor]:
    """Copies of everything a user sees of the worlds, and of the forces that the next step starts from."""
    names = ["node_x", "node_v", "body_pose", "body_twist", "rod_x", "rod_q", "rod_v", "contact_count", "contact_key"]
    names += ["contact_load", "contact_gap", "pair_force", "status", "time"]
    values = {name: getattr(sim, name).clone() for name in names}
    return values | {"memory": sim.snapshot().arrays["state.contact_force"]}


@each_path
def test_world_does_not_depend_on_its_batch(options: dict[str, Any], precision: str, device: str) -> None:
    """Any place in batches of 11 and 2 gives the bits of the world alone, 150 steps (13.1)."""
    everyone = list(range(11))
    batch = build(11, options, precision, device)
    vary(batch, everyone)
    run(batch, 150)
    assert int(batch.contact_count.min()) > 8
    seen = state(batch)
    assert all(status in GOOD for status in seen["status"].flatten().tolist())
    for identity in ([7], [10, 3]):
        alone = build(len(identity), options, precision, device)
        vary(alone, identity)
        run(alone, 150)
        assert_same(seen, state(alone), identity, list(range(len(identity))))


@pytest.mark.slow
@pytest.mark.parametrize("path", ["scalar", "lanes"])
def test_thousand_steps_in_any_batch(path: str) -> None:
    """World 5 of 9 and the same alone after 1000 steps (13.1)."""
    batch, alone = build(9, {"solver_path": path}), build(1, {"solver_path": path})
    vary(batch, list(range(9)))
    vary(alone, [5])
    for sim in (batch, alone):
        run(sim, 1000)
    assert_same(state(batch), state(alone), [5], [0])


@pytest.mark.parametrize("path", ["scalar", "lanes"])
def test_threads_do_not_matter(path: str) -> None:
    """Worlds spread over other numbers of threads give the same bits."""
    everyone = list(range(19))
    sims = [build(19, {"solver_path": path, "threads": count}) for count in (1, 3)]
    for sim in sims:
        vary(sim, everyone)
        run(sim, 60)
    assert_same(state(sims[0]), state(sims[1]), everyone, everyone)


@each_path
def test_nan_and_explosion_stay_in_their_world(options: dict[str, Any], precision: str, device: str) -> None:
    """A NaN position, then an absurd speed in world 4: reported, and no bit of the others changes (13.2)."""
    clean, spoiled = (build(9, options, precision, device) for _ in range(2))
    for sim in (clean, spoiled):
        vary(sim, list(range(9)))
        run(sim, 30)
    others = [i for i in range(9) if i != 4]
    spoiled.body_pose[4, BALL, 1] = float("nan")
    for _ in range(2):
        for sim in (clean, spoiled):
            run(sim, 1)
        assert int(spoiled.status[4]) != sw.Status.OK
        for sim in (clean, spoiled):
            run(sim, 20)
        assert_same(state(clean), state(spoiled), others, others)
        spoiled.body_twist[4, BALL, 2] = 1e12


def spoil_memory(sim: sw.Simulation) -> None:
    """Make the forces that world 1 starts from NaN."""
    saved = sim.snapshot(worlds=[1])
    saved.arrays["state.contact_force"].fill_(np.nan)
    sim.restore(saved, worlds=[1])


POISON = {
    "pose": lambda sim: sim.body_pose[1, BALL].fill_(np.nan),
    "twist": lambda sim: sim.body_twist[1, CUBE].fill_(np.inf),
    "node": lambda sim: sim.node_x[1, 3].fill_(np.nan),
    "warm start": spoil_memory,
    "friction": lambda sim: sim.params.pair_mu[1].fill_(np.nan),
    "negative friction": lambda sim: sim.params.pair_mu[1].fill_(-0.1),
    "distance": lambda sim: sim.params.pair_contact_distance[1].fill_(np.nan),
    "compliance": lambda sim: sim.params.pair_compliance[1].fill_(np.inf),
}


LAWS = ("pair_mu", "pair_contact_distance", "pair_compliance")


@cache
def at_work(path: str, iterations: int) -> tuple[list[sw.Simulation], sw.Snapshot]:
    """Two equal simulations of nine individuals after 40 steps, and what takes them back there."""
    sims = [build(9, {"solver_path": path, "newton_iterations": iterations}) for _ in range(2)]
    for sim in sims:
        vary(sim, list(range(9)))
        run(sim, 40)
    assert_same(state(sims[0]), state(sims[1]), list(range(9)), list(range(9)))
    return sims, sims[1].snapshot()


@pytest.mark.parametrize(
    ("path", "iterations", "poison"),
    [
        pytest.param(path, n, key, marks=() if key == "node" or (path, n) == ("lanes", 1) else pytest.mark.slow)
        for path in ("scalar", "lanes")
        for n in (1, 4)
        for key in POISON
    ],
)
def test_failed_world_is_rolled_back_and_isolated(path: str, iterations: int, poison: str) -> None:
    """A world with a NaN or an absurd law reports NONFINITE and keeps its last good state; others keep their bits.

    A reset, and parameters that are numbers, heal it.
    """
    sims, start = at_work(path, iterations)
    for sim in sims:
        sim.restore(start)
    for name in LAWS:
        getattr(sims[0].params, name).copy_(getattr(sims[1].params, name))
    before = state(sims[0])
    POISON[poison](sims[0])
    for sim in sims:
        sim.step()
    others = [0, *range(2, 9)]
    assert_same(state(sims[0]), state(sims[1]), others, others)
    now = state(sims[0])
    assert int(now["status"][1]) == sw.Status.NONFINITE
    for name in ("node_x", "body_pose", "body_twist", "rod_x", "time"):
        assert torch.equal(now[name][1], before[name][1]), name
    assert bool(torch.isfinite(now["memory"]).all())
    for name in LAWS:
        getattr(sims[0].params, name)[1] = getattr(sims[1].params, name)[1]
    sims[0].reset(torch.tensor([i == 1 for i in range(9)]))
    run(sims[0], 20)
    assert int(sims[0].status[1]) in GOOD
    assert all(bool(torch.isfinite(value[1]).all()) for value in state(sims[0]).values())


@each_path
def test_same_bits_again_and_in_parts(options: dict[str, Any], precision: str, device: str) -> None:
    """A second run, and 10 x 10 steps with reading in between, equal 100 steps (13.3, 13.7)."""
    first, second = (build(5, options, precision, device) for _ in range(2))
    for sim in (first, second):
        vary(sim, list(range(5)))
    run(first, 100)
    for _ in range(10):
        run(second, 10)
        second.snapshot()
        second.contact_force(sw.scene.RigidBody(BALL), sw.scene.RigidBody(FLOOR))
    assert_same(state(first), state(second), list(range(5)), list(range(5)))


@each_path
def test_snapshot_holds_warm_starts(options: dict[str, Any], precision: str, device: str, tmp_path: Path) -> None:
    """Restored from memory, from disk, and into other places of another batch: the same 60 steps (13.4)."""
    everyone = list(range(6))
    sim = build(6, options, precision, device)
    vary(sim, everyone)
    run(sim, 40)
    saved, two = sim.snapshot(), sim.snapshot(worlds=[5, 2])
    saved.save(tmp_path / "contact.snapshot")
    run(sim, 60)
    future = state(sim)
    for snapshot in (saved, sw.Snapshot.load(tmp_path / "contact.snapshot")):
        sim.restore(snapshot)
        run(sim, 60)
        assert_same(future, state(sim), everyone, everyone)
    other = build(4, options, precision, device)
    run(other, 10)
    other.restore(two, worlds=[0, 3])
    run(other, 60)
    assert_same(future, state(other), [5, 2], [0, 3])


@each_path
def test_masked_reset(options: dict[str, Any], precision: str, device: str) -> None:
    """Reset worlds are back at their start, contacts forgotten; the others keep every bit and go on (13.8)."""
    sim, untouched = (build(9, options, precision, device) for _ in range(2))
    start = state(sim)
    for each in (sim, untouched):
        vary(each, list(range(9)))
        run(each, 60)
    mask = torch.tensor([i in (1, 8) for i in range(9)], device=sim.status.device)
    rest = [i for i in range(9) if i not in (1, 8)]
    sim.reset(mask)
    assert_same(state(sim), start, [1, 8], [1, 8])
    for each in (sim, untouched):
        run(each, 60)
    assert_same(state(sim), state(untouched), rest, rest)


@each_path
def test_overflow_is_counted_and_stays_in_its_world(options: dict[str, Any], precision: str, device: str) -> None:
    """World 1 needs more contacts than there is room for: its status says so, the others keep their bits.

    The count of those without a place stays, whatever the following steps need, until it is set to 0.
    """
    full, lifted = (build(3, options, precision, device, capacity=12) for _ in range(2))
    for sim in (full, lifted):
        for world in (0, 1, 2):
            if not (sim is full and world == 1):
                sim.node_x[world, :, 2] += 5.0
                sim.body_pose[world, CUBE, 2] += 5.0
        run(sim, 20)
    assert int(full.contact_overflow[1]) > 0
    assert int(full.status[1]) == sw.Status.CONTACT_OVERFLOW
    assert int(full.contact_count[1]) == 12
    assert int(full.contact_overflow[0]) == 0
    assert_same(state(full), state(lifted), [0, 2], [0, 2])
    full.restore(lifted.snapshot([0]), worlds=[1])  # where all contacts have a place
    full.contact_overflow[1] = 3
    run(full, 1)
    assert int(full.status[1]) != sw.Status.CONTACT_OVERFLOW and int(full.contact_overflow[1]) == 3
    full.contact_overflow.zero_()
    run(full, 1)
    assert int(full.contact_overflow[1]) == 0


@each_path
def test_workspace_content_does_not_matter(options: dict[str, Any], precision: str, device: str) -> None:
    """Steps rebuild the workspace: filling it with NaN before each of them changes no bit.

    Tables of the scene are no workspace, nor are the zeros that unprescribed unknowns start from.
    """
    constant = (*KEPT, ContactModel, FrameModel, SceneArrays)
    everyone = list(range(5))
    clean, dirty = (build(5, options, precision, device) for _ in range(2))
    for sim in (clean, dirty):
        vary(sim, everyone)
        run(sim, 30)
    for _ in range(4):
        pairs = list(held_arrays(dirty, dirty, set()))
        kept = {array.ptr for holder, array in pairs if isinstance(holder, constant)}
        kept |= {array.ptr for system in dirty._systems for array in constants(system.work)}
        tensors = [wp.to_torch(array) for _, array in pairs if array.ptr not in kept and array.size]
        floats = [tensor for tensor in tensors if tensor.is_floating_point()]
        assert len(floats) > 30
        for tensor in floats:
            tensor.fill_(float("nan"))
        for sim in (clean, dirty):
            run(sim, 1)
        assert_same(state(clean), state(dirty), everyone, everyone)
