"""Worlds never influence each other: batch size and place, failures, resets, snapshots, time splitting.

Every comparison is of bits unless a tolerance is given. The scene is a small tendon-driven beam whose worlds differ in
modulus, gravity, damping and commands, stepped through large bending (catalogue section 13).
"""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

import softwarp as sw
from softwarp import meshing
from softwarp.model.model import Model
from softwarp.model.state import Control, Parameters, State
from softwarp.solvers.workspace.workspace import Workspace, declared
from tests.contract.batch_checks import assert_same

LENGTH, WIDTH = 0.2, 0.03  # m

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


def build(
    num_worlds: int, options: dict[str, Any], precision: str = "float32", device: str = "cpu", law: str = "large"
) -> sw.Simulation:
    """A beam clamped at x = 0 with three cables and a marker at its tip."""
    mesh = meshing.box((LENGTH, WIDTH, WIDTH), (6, 2, 2))
    material = sw.NeoHookean(2e5, 0.4) if law == "nh_log" else sw.Corotational(2e5, 0.4, method="large")
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    body = builder.add_tets(mesh, material=material, density=1000.0, rayleigh=(0.5, 0.01))
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    x = np.linspace(0.0, LENGTH, 5)
    for y, z in ((0.005, 0.015), (0.025, 0.015), (0.015, 0.025)):
        builder.add_cable(body, np.stack([x, np.full(5, y), np.full(5, z)], axis=1), max_rate=0.2)
    builder.add_marker(body, (LENGTH, WIDTH / 2, WIDTH / 2))
    return sw.Simulation(
        builder.finalize(num_worlds=num_worlds, device=device, precision=precision), dt=0.01, **options
    )


def characterise(sim: sw.Simulation, identity: list[int]) -> None:
    """Give world i of ``sim`` the parameters of individual ``identity[i]``."""
    rng = [np.random.default_rng(100 + i) for i in identity]
    factors = torch.tensor(np.array([r.uniform(0.7, 1.3, 3) for r in rng])).to(sim.params.youngs)
    sim.params.youngs.mul_(factors[:, :1])
    sim.params.rayleigh_stiffness.mul_(factors[:, 1:2])
    sim.params.gravity.mul_(factors[:, 2:3])


def command(sim: sw.Simulation, identity: list[int], step: int) -> None:
    """Smooth cable commands and forces that differ between individuals."""
    phase = torch.tensor([[0.7 * i + c for c in range(3)] for i in identity])
    displacement = 0.006 * (1.0 + torch.sin(0.2 * step + phase))
    sim.control.cable_displacement.copy_(displacement.to(sim.control.cable_displacement))
    push = torch.tensor([0.02 * np.cos(0.1 * step + i) for i in identity])
    sim.control.node_force[:, -1, 1] = push.to(sim.control.node_force)


def run(sim: sw.Simulation, identity: list[int], steps: int, start: int = 0) -> None:
    for step in range(start, start + steps):
        command(sim, identity, step)
        sim.step()


def state(sim: sw.Simulation) -> dict[str, torch.Tensor]:
    """Copies of everything a user sees of the worlds."""
    names = (
        "node_x",
        "node_v",
        "marker_x",
        "marker_v",
        "cable_length",
        "cable_displacement",
        "cable_tension",
        "cable_x",
    )
    return {name: getattr(sim, name).clone() for name in (*names, "status", "time")}


@each_path
def test_world_does_not_depend_on_its_batch(options: dict[str, Any], precision: str, device: str) -> None:
    """Individual 17 of 64 is the same alone, and at other places of batches of 3 and 9, after 60 steps."""
    everyone = list(range(64))
    sim = build(64, options, precision, device)
    characterise(sim, everyone)
    run(sim, everyone, 60)
    reference = state(sim)
    assert bool((reference["status"] <= sw.Status.MAX_ITERATIONS).all())
    assert float((reference["node_x"] - sim.node_x[:1]).abs().max()) > 0.005  # they do move differently
    for identity in ([17], [40, 17, 3], [9, 8, 7, 63, 17, 0, 17, 1, 2]):
        small = build(len(identity), options, precision, device)
        characterise(small, identity)
        run(small, identity, 60)
        assert_same(reference, state(small), identity, list(range(len(identity))))


@pytest.mark.slow
@each_path
def test_static_world_does_not_depend_on_its_batch(options: dict[str, Any], precision: str, device: str) -> None:
    """The same for ``solve_static``, although worlds need different numbers of iterations."""
    results = []
    for identity in (list(range(16)), [5], [11, 2, 5]):
        sim = build(len(identity), options, precision, device)
        characterise(sim, identity)
        command(sim, identity, 7)
        sim.solve_static()
        results.append((identity, state(sim)))
    everyone, reference = results[0]
    assert len(everyone) == 16
    for identity, small in results[1:]:
        assert_same(reference, small, identity, list(range(len(identity))))


@pytest.mark.parametrize("path", ["scalar", "lanes"])
def test_threads_do_not_matter(path: str) -> None:
    """Worlds spread over other numbers of threads give the same bits."""
    identity = list(range(19))
    sims = [build(19, {"solver_path": path, "threads": count}) for count in (1, 2, 3)]
    for sim in sims:
        characterise(sim, identity)
        run(sim, identity, 20)
    for sim in sims[1:]:
        assert_same(state(sims[0]), state(sim), identity, identity)


def test_run_to_run() -> None:
    """The same commands on a fresh simulation give the same bits."""
    tracks = []
    for _ in range(2):
        sim = build(8, {})
        run(sim, list(range(8)), 30)
        tracks.append(state(sim))
    assert_same(tracks[0], tracks[1], list(range(8)), list(range(8)))


def test_paths_agree_to_rounding() -> None:
    """Scalar and lanes differ by float32 rounding only: 1e-5 of the length after 60 steps; float64 is 1e-4 away."""
    identity = list(range(8))
    tracks = []
    for path, precision in (("scalar", "float64"), ("scalar", "float32"), ("lanes", "float32")):
        sim = build(8, {"solver_path": path}, precision)
        characterise(sim, identity)
        run(sim, identity, 60)
        tracks.append(sim.node_x.double().clone())
    assert float((tracks[1] - tracks[2]).abs().max()) < 2e-5 * LENGTH
    assert float((tracks[0] - tracks[1]).abs().max()) < 1e-4 * LENGTH


NAN_POISONS = ["node_x", "node_v", "displacement nan", "displacement inf", "force nan"]
ABSURD_POISONS = ["absurd displacement", "absurd force"]


def poison(sim: sw.Simulation, world: int, kind: str) -> None:
    """Spoil one world's state or command."""
    if kind == "node_x":
        sim.node_x[world, 20, 1] = float("nan")
    elif kind == "node_v":
        sim.node_v[world, 20, 1] = float("inf")
    elif kind.startswith("displacement"):
        sim.control.cable_displacement[world, 1] = float(kind.split()[1])
    elif kind == "absurd displacement":
        sim.params.cable_max_rate[world] = 1e30
        sim.control.cable_displacement[world] = 1e8
    elif kind == "force nan":
        sim.control.node_force[world, 30, 0] = float("nan")
    else:
        sim.control.node_force[world, 30] = 1e12


@cache
def at_work(options: tuple[tuple[str, Any], ...], precision: str, device: str) -> tuple[Any, ...]:
    """64 individuals after 5 steps: simulation, what takes it back there, and what is seen after each of 5 more."""
    everyone = list(range(64))
    sim = build(64, dict(options), precision, device)
    characterise(sim, everyone)
    run(sim, everyone, 5)
    start, given = sim.snapshot(), {name: value.clone() for name, value in sim.params.tensors().items()}
    track = []
    for step in range(5, 10):
        run(sim, everyone, 1, start=step)
        track.append(state(sim))
    return sim, start, given, track


@each_path
@pytest.mark.parametrize("kind", [*NAN_POISONS, *ABSURD_POISONS])
def test_poisoned_world_leaves_the_others_alone(
    kind: str, options: dict[str, Any], precision: str, device: str
) -> None:
    """NaN or an absurd command in one world: the other 63 keep their bits, the bad one is reported and stays finite."""
    bad, everyone = 21, list(range(64))
    others = [i for i in everyone if i != bad]
    spoiled, start, given, track = at_work(tuple(options.items()), precision, device)
    spoiled.restore(start)
    for name, value in given.items():
        spoiled.params.tensors()[name].copy_(value)
    for step, clean in enumerate(track, start=5):
        command(spoiled, everyone, step)
        if step == 6:
            poison(spoiled, bad, kind)
        spoiled.step()
        seen = state(spoiled)
        if step == 6:
            code = sw.Status(int(seen["status"][bad]))
            if kind in NAN_POISONS:
                assert code == sw.Status.NONFINITE
            else:  # Newton's step control may refuse to follow instead
                assert code != sw.Status.OK
                assert code.failed or "newton_iterations" in options
        for name in ("node_x", "node_v", "marker_x", "cable_length", "cable_tension", "cable_x"):
            assert bool(seen[name].isfinite().all()), f"{name} is not finite after step {step}"
        assert_same(clean, seen, others, others)


def test_failed_world_is_rolled_back() -> None:
    """A bad command leaves the world where it was before the step, its clock included; a good one moves it again."""
    sim = build(3, {})
    run(sim, [0, 1, 2], 10)
    before = state(sim)
    sim.control.cable_displacement[1, 0] = float("nan")
    sim.step()
    for name in ("node_x", "node_v", "cable_tension", "cable_displacement", "time"):
        assert torch.equal(getattr(sim, name)[1], before[name][1])
    assert float(sim.time[0]) > float(before["time"][0])
    sim.control.cable_displacement[1, 0] = 0.0
    sim.step()
    assert int(sim.status[1]) == sw.Status.OK
    assert float(sim.time[1]) > float(before["time"][1])


def test_reset_heals_a_poisoned_world() -> None:
    """After NaN in its state and commands, a masked reset brings a world back to its start, and it runs as before."""
    everyone = list(range(4))
    sim = build(4, {})
    run(sim, everyone, 10)
    first = state(sim)
    sim.node_x[2] = float("nan")
    sim.control.node_force[2] = float("nan")
    sim.step()
    sim.reset(torch.tensor([True] * 4))
    sim.control.node_force.zero_()
    run(sim, everyone, 10)
    assert_same(first, state(sim), everyone, everyone)


@each_path
def test_masked_reset_touches_only_its_worlds(options: dict[str, Any], precision: str, device: str) -> None:
    """Reset worlds are where they began, the others keep every bit and go on as if nothing had happened."""
    everyone = list(range(11))
    mask = torch.tensor([i in (0, 3, 9) for i in everyone])
    chosen, rest = mask.nonzero().flatten().tolist(), (~mask).nonzero().flatten().tolist()
    sim, untouched = (build(11, options, precision, device) for _ in range(2))
    start = state(sim)
    for each in (sim, untouched):
        run(each, everyone, 12)
    before = state(sim)
    sim.reset(mask.to(sim.node_x.device))
    after = state(sim)
    assert_same(after, before, rest, rest)
    for name in ("node_x", "node_v", "marker_x", "marker_v", "cable_length", "cable_displacement", "time", "cable_x"):
        assert torch.equal(after[name][chosen], start[name][chosen]), f"{name} was not reset"
    for each in (sim, untouched):
        run(each, everyone, 12, start=12)
    assert_same(state(sim), state(untouched), rest, rest)


def test_initial_state_can_be_settled() -> None:
    """After ``set_initial`` reset returns to the settled state, not to rest."""
    sim = build(2, {})
    sim.solve_static()
    settled = sim.node_x.clone()
    sim.set_initial()
    run(sim, [0, 1], 10)
    assert not torch.equal(sim.node_x, settled)
    sim.reset()
    assert torch.equal(sim.node_x, settled)
    assert float(sim.node_v.abs().max()) == 0.0


@each_path
def test_snapshot_restores_the_future(options: dict[str, Any], precision: str, device: str, tmp_path: Path) -> None:
    """Snapshot, 50 steps, restore, the same 50 steps: equal bits; from memory and from disk."""
    everyone = list(range(9))
    sim = build(9, options, precision, device)
    characterise(sim, everyone)
    run(sim, everyone, 7)
    saved = sim.snapshot()
    saved.save(tmp_path / "state.snapshot")
    run(sim, everyone, 50, start=7)
    future = state(sim)
    for snapshot in (saved, sw.Snapshot.load(tmp_path / "state.snapshot")):
        sim.restore(snapshot)
        run(sim, everyone, 50, start=7)
        assert_same(future, state(sim), everyone, everyone)
    fresh = build(9, options, precision, device)  # parameters come with the snapshot
    fresh.restore(saved)
    run(fresh, everyone, 50, start=7)
    assert_same(future, state(fresh), everyone, everyone)


@each_path
def test_any_world_restores_to_any_world(options: dict[str, Any], precision: str, device: str) -> None:
    """Worlds 3 and 5 of nine put into worlds of another batch, one world into many: the same future."""
    everyone = list(range(9))
    sim = build(9, options, precision, device)
    characterise(sim, everyone)
    run(sim, everyone, 10)
    pair, single = sim.snapshot(worlds=[5, 3]), sim.snapshot(worlds=[3])
    run(sim, everyone, 20, start=10)
    future = state(sim)

    other = build(4, options, precision, device)
    run(other, [50, 51, 52, 53], 3)
    other.restore(pair, worlds=[0, 2])
    run(other, [5, 51, 3, 53], 20, start=10)
    assert_same(future, state(other), [5, 3], [0, 2])
    other.restore(single)
    run(other, [3, 3, 3, 3], 20, start=10)
    assert_same(future, state(other), [3, 3, 3, 3], [0, 1, 2, 3])


def test_restore_leaves_other_worlds_alone() -> None:
    sim = build(5, {})
    run(sim, list(range(5)), 5)
    saved = sim.snapshot(worlds=[0])
    run(sim, list(range(5)), 5)
    before = state(sim)
    sim.restore(saved, worlds=[4])
    assert_same(state(sim), before, [0, 1, 2, 3], [0, 1, 2, 3])
    assert not torch.equal(sim.node_x[4], before["node_x"][4])


def test_foreign_snapshots_are_refused(tmp_path: Path) -> None:
    """Another law or precision, wrong numbers of worlds, a broken file: errors that say so; nothing changes."""
    sim = build(3, {})
    run(sim, [0, 1, 2], 3)
    before = state(sim)
    with pytest.raises(ValueError, match="scene"):
        sim.restore(build(3, {}, law="nh_log").snapshot())
    with pytest.raises(ValueError, match="float64"):
        sim.restore(build(3, {}, "float64").snapshot())
    with pytest.raises(ValueError, match="2 worlds"):
        sim.restore(sim.snapshot(worlds=[0, 1]))
    with pytest.raises(ValueError, match="world 3"):
        sim.restore(sim.snapshot(worlds=[0]), worlds=[3])
    with pytest.raises(ValueError, match="world 7"):
        sim.snapshot(worlds=[7])
    broken = tmp_path / "broken.snapshot"
    broken.write_bytes(b"not a snapshot")
    with pytest.raises(ValueError, match=r"broken\.snapshot"):
        sw.Snapshot.load(broken)
    sim.snapshot().save(tmp_path / "cut.snapshot")
    whole = (tmp_path / "cut.snapshot").read_bytes()
    (tmp_path / "cut.snapshot").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"cut\.snapshot"):
        sw.Snapshot.load(tmp_path / "cut.snapshot")
    with pytest.raises(FileNotFoundError, match="missing"):
        sw.Snapshot.load(tmp_path / "missing.snapshot")
    assert_same(state(sim), before, [0, 1, 2], [0, 1, 2])


def test_time_splitting() -> None:
    """100 steps at once equal 10 times 10 with reading, diagnostics, refreshing and saving in between."""
    straight, split = build(3, {}), build(3, {})
    run(straight, [0, 1, 2], 100)
    for part in range(10):
        run(split, [0, 1, 2], 10, start=10 * part)
        split.snapshot()
        split.internal_force()
        split.elastic_energy()
        split.node_stress()
        split.refresh()
    assert_same(state(straight), state(split), [0, 1, 2], [0, 1, 2])


KEPT = (Model, State, Control, Parameters)  # what a step may read; everything else is workspace


def held_arrays(owner: object, holder: object, seen: set[int]) -> Iterator[tuple[object, wp.array]]:
    """Every Warp array that hangs on an object of the package, with the object that holds it."""
    if isinstance(owner, wp.array):
        yield holder, owner
        return
    if id(owner) in seen:
        return
    seen.add(id(owner))
    if isinstance(owner, dict | list | tuple):
        children = owner.values() if isinstance(owner, dict) else owner
    elif type(owner).__module__.startswith("softwarp") and hasattr(owner, "__dict__"):
        children, holder = list(vars(owner).values()), owner
    else:
        return
    for child in children:
        yield from held_arrays(child, holder, seen)


def constants(work: Workspace) -> list[wp.array]:
    """Workspace arrays that are declared to keep a constant where no step writes them."""
    return [getattr(work, name).real for name, about in declared().items() if about.keeps is not None]


def workspace(sim: sw.Simulation) -> list[torch.Tensor]:
    """The float arrays of a simulation that are neither model nor state, commands or parameters."""
    pairs = list(held_arrays(sim, sim, set()))
    kept = {array.ptr for holder, array in pairs if isinstance(holder, KEPT)}
    systems = [*sim._systems, *(static.system for static in sim._statics or ())]
    kept |= {array.ptr for system in systems for array in constants(system.work)}
    rest = {array.ptr: array for _, array in pairs if array.ptr not in kept and array.size}
    tensors = [wp.to_torch(array) for array in rest.values()]
    return [tensor for tensor in tensors if tensor.is_floating_point()]


@each_path
def test_workspace_content_does_not_matter(options: dict[str, Any], precision: str, device: str) -> None:
    """Steps and statics rebuild the workspace: filling it with NaN before each of them changes no bit."""
    everyone = list(range(5))
    clean, dirty = (build(5, options, precision, device) for _ in range(2))
    for sim in (clean, dirty):
        sim.solve_static()
        run(sim, everyone, 3)
    for step in (3, 4, 5):
        arrays = workspace(dirty)
        assert len(arrays) > 20
        for array in arrays:
            array.fill_(float("nan"))
        for sim in (clean, dirty):
            command(sim, everyone, step)
            if step == 5:
                sim.solve_static()
            else:
                sim.step()
        assert_same(state(clean), state(dirty), everyone, everyone)
