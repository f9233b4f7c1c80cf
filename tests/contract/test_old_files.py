"""Files that softwarp 0.1.0 wrote before its source was rearranged load for ever and mean what they meant.

``tests/data/before_the_move`` holds snapshots, a recording, run folders, plans and demonstrations, and in
``expected.npz`` what followed from them in the program that wrote them. Numbers may differ by another machine's
rounding.
"""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from pxr import Usd, UsdGeom
from tensordict import TensorDict

import softwarp as sw
from softwarp import cli
from softwarp.io.trajectory import Trajectory
from softwarp.io.usd import export_usd
from softwarp.planning import plans
from softwarp.render import render_trajectory
from softwarp.training.checkpoints import build_policy, load_policy
from softwarp.training.demonstrations import Demonstrations

DATA = Path(__file__).parents[1] / "data" / "before_the_move"
RUNS = ("ppo", "sac", "memory")
PLANS = ("plan_tree", "plan_sequence")
RESUMED = 96  # environment steps after which a resumed run ends
MACHINE_VIEWS = (
    *("node_x", "node_v", "body_pose", "body_twist", "rod_x", "rod_q", "rod_v", "cable_tension", "cable_length"),
    *("cavity_pressure", "cavity_volume", "joint_position", "joint_force", "joint_reaction", "contact_count"),
    *("pair_force", "marker_x", "time", "status"),
)
ENV_VIEWS = ("frame_pose", "frame_twist", "joint_position", "time", "status")


def machine(worlds: int = 1) -> sw.Simulation:
    """A carriage with a soft finger on a ball, beside a rod: chamber, cables, joint, attachments and contact.

    Measures are sums of few powers of two, so that no rounding, which may differ between machines, enters what tells
    one scene from another.
    """
    builder = sw.ModelBuilder()
    floor = builder.add_rigid(sw.Plane(), kinematic=True, pose=(0.0, 0.0, 55 / 512), name="floor")
    cart = builder.add_rigid(sw.Box((1 / 16, 1 / 16, 1 / 32)), mass=0.25, pose=(0.0, 0.0, 1 / 4), free_axes="x")
    motor = {"control": "position", "stiffness": 80.0, "damping": 4.0, "limits": (-0.125, 0.125)}
    builder.add_joint(None, cart, "slider", axis=(1.0, 0.0, 0.0), **motor)
    box = sw.meshing.box((1 / 32, 1 / 32, 1 / 16), (2, 2, 2))
    mesh = sw.meshing.TetMesh(box.nodes + (-1 / 64, -1 / 64, 11 / 64), box.tets)
    finger = builder.add_tets(mesh, material=sw.NeoHookean(1e5, 0.375), density=1024.0, rayleigh=(0.5, 0.01))
    builder.attach(finger, nodes=np.flatnonzero(mesh.nodes[:, 2] > 0.23), to=cart)
    air = sw.meshing.box((1 / 64, 1 / 64, 1 / 32), (1, 1, 1))
    builder.add_cavity(finger, air.nodes + (-1 / 128, -1 / 128, 12 / 64), air.surface())
    line = np.array([(0.0, 0.0, z / 64) for z in (14, 13, 12)])
    builder.add_cable(finger, line + (3 / 256, 0.0, 0.0), (3 / 256, 0.0, 1 / 4), max_rate=0.25)
    builder.add_cable(finger, line - (3 / 256, 0.0, 0.0), (-3 / 256, 0.0, 1 / 4), control="force")
    ball = builder.add_rigid(sw.Sphere(1 / 32), density=512.0, pose=(0.0, 0.0, 143 / 1024), name="ball")
    points = np.array([(5 / 128, 0.0, (2 + i) / 32) for i in range(5)])
    rod = builder.add_rod(points, radius=1 / 128, youngs=1e6, nu=0.375, density=1024.0, rayleigh=(0.5, 0.01))
    builder.fix(rod, nodes=[0])
    weight = builder.add_rigid(sw.Sphere(1 / 64), mass=1 / 64, pose=(5 / 128, 0.0, 6 / 32), name="weight")
    builder.attach(weight, to=rod, node=-1)
    for a, b in ((finger, ball), (ball, floor), (ball, rod)):
        builder.add_contact(a, b, mu=0.5, alarm_distance=1 / 256)
    builder.add_marker(finger, (0.0, 0.0, 12 / 64))
    builder.add_marker(weight, (5 / 128, 0.0, 7 / 32))
    return sw.Simulation(builder.finalize(worlds, contact_capacity=12), dt=0.01, solver_path="scalar")


def command(sim: sw.Simulation) -> None:
    """Commands of the machine, the same in every step."""
    sim.control.cable_displacement[:] = 0.002
    sim.control.cable_tension[:] = 0.25
    sim.control.cavity_pressure[:] = 2e3
    sim.control.joint_target[:] = 0.01


def cart_stem():
    """The environment whose simulation was saved."""
    return sw.make("CartStem", seed=0, action_kind="continuous", solver_path="scalar")


def seen(sim: sw.Simulation, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Copies of views of the last world."""
    return {name: getattr(sim, name)[-1:].cpu().numpy().copy() for name in names}


def acted(content: dict) -> np.ndarray:
    """Actions of a checkpoint's policy in three steps of eight worlds, with its memory if it has one."""
    policy, size = build_policy(content), content["spaces"]["observation_size"]
    data = TensorDict({"observation": torch.zeros(8, size)}, batch_size=[8])
    actions = []
    for step in range(3):
        grid = torch.arange(8 * size, dtype=torch.float32).reshape(8, size)
        data["observation"] = 0.1 * torch.sin(grid + step)
        actions.append(policy(data)["action"].float().numpy().copy())
    return np.stack(actions)


def chances(content: dict) -> np.ndarray:
    """At the start of an episode: logarithms of the chances of choices, or the most likely sample."""
    policy, size = build_policy(content), content["spaces"]["observation_size"]
    observation = 0.1 * torch.sin(torch.arange(8.0 * size)).reshape(8, size)
    with torch.no_grad():
        found = policy.distribution(observation)
        numbers = found.logits if policy.spaces.is_discrete else policy.most_likely(found)
    return numbers.float().numpy().copy()


def weights(run: Path) -> dict[str, np.ndarray]:
    """Numbers of the networks and scales in the newest checkpoint of a run."""
    content = load_policy(max((run / "checkpoints").glob("step_*.pt")))
    return {name: value.numpy().copy() for name, value in content["policy"].items()}


def go_on(run: Path) -> None:
    """Resume a run until ``RESUMED`` environment steps."""
    assert cli.main(["train", "--resume", str(run), f"total_steps={RESUMED}"]) == 0


def evaluate(run: Path, out: Path) -> dict[str, float]:
    """Summary of four episodes of a run's policy, as the command tells it."""
    assert cli.main(["eval", str(run), "episodes=4", "--json", str(out)]) == 0
    summary: dict[str, float] = json.loads(out.read_text())["policies"]["trained"]
    return summary


@pytest.fixture(scope="module")
def expected() -> dict[str, np.ndarray]:
    with np.load(DATA / "expected.npz") as archive:
        return dict(archive)


def assert_near(found: dict[str, np.ndarray], expected: dict[str, np.ndarray], prefix: str, share: float) -> None:
    """Integers are equal; the others agree to a share of the largest number of their array."""
    for name, value in found.items():
        wanted = expected[f"{prefix}/{name}"]
        assert value.shape == wanted.shape and value.dtype == wanted.dtype, name
        if np.issubdtype(wanted.dtype, np.integer):
            np.testing.assert_array_equal(value, wanted, err_msg=name)
        else:
            largest = float(np.abs(wanted).max(initial=0.0))
            np.testing.assert_allclose(value, wanted, rtol=0.0, atol=share * largest + 1e-9, err_msg=name)


@pytest.mark.parametrize("worlds", [1, 2])
def test_snapshot_of_a_scene(worlds, expected):
    """Restored into the same scene, alone or as a world of a batch, three steps lead to the same state."""
    sim = machine(worlds)
    snapshot = sw.Snapshot.load(DATA / "machine.npz")
    assert (snapshot.num_worlds, snapshot.precision) == (1, "float32")
    assert snapshot.fingerprint == sim.model.fingerprint
    sim.restore(snapshot, [worlds - 1])
    assert_near(seen(sim, MACHINE_VIEWS), expected, "machine", 0.0)
    assert int(sim.contact_count[-1]) > 2
    for _ in range(3):
        sim.step()
    later = [name for name in MACHINE_VIEWS if name != "contact_count"]  # those that bear nothing wait in reserve today
    assert_near(seen(sim, later), expected, "machine later", 1e-3)


def test_snapshot_of_an_environment(expected):
    """The simulation of CartStem goes on from a file."""
    sim = cart_stem().sim
    sim.restore(sw.Snapshot.load(DATA / "cart_stem.npz"))
    assert_near(seen(sim, ENV_VIEWS), expected, "cart_stem", 0.0)
    sim.step(5)
    assert_near(seen(sim, ENV_VIEWS), expected, "cart_stem later", 1e-3)


def test_recording(tmp_path, expected):
    """Four frames of the machine hold what was seen; they are drawn, and come back from a USD scene."""
    film = Trajectory.load(DATA / "film.npz")
    assert (film.name, film.frame_count, film.world_count) == ("machine", 4, 1)
    np.testing.assert_allclose(film.time, [0.06, 0.07, 0.08, 0.09], rtol=1e-5)
    for frame, prefix in ((0, "machine"), (3, "machine later")):
        held = {name: expected[f"{prefix}/{name}"] for name in MACHINE_VIEWS}
        np.testing.assert_array_equal(film.vertex_x[frame], held["node_x"][:, film.vertex_node])
        np.testing.assert_array_equal(film.rigid_pose[frame], held["body_pose"])
        np.testing.assert_array_equal(film.rod_x[frame], held["rod_x"])
        for name in ("cable_tension", "cavity_pressure", "cavity_volume", "marker_x"):
            np.testing.assert_array_equal(getattr(film, name)[frame], held[name], err_msg=name)
        assert (film.contact_pair[frame] >= 0).sum() == held["contact_count"]
    assert film.pair_names == ("body0 - ball", "ball - floor", "ball - rod0")
    assert float(film.stress.max()) > 100.0
    pictures = render_trajectory(film, width=96, height=72)
    assert pictures.shape == (4, 72, 96, 3)
    assert len(np.unique(pictures[0].reshape(-1, 3), axis=0)) > 50
    assert (pictures[0] != pictures[3]).any()
    stage = Usd.Stage.Open(str(export_usd(film, tmp_path / "film.usdc")))
    mesh = UsdGeom.Mesh.Get(stage, "/World/world_0/body0")
    for frame in range(4):
        np.testing.assert_array_equal(np.array(mesh.GetPointsAttr().Get(frame)), film.vertex_x[frame, 0])
    Trajectory.load(DATA / "film.npz").save(tmp_path / "again.npz")
    np.testing.assert_array_equal(Trajectory.load(tmp_path / "again.npz").vertex_x, film.vertex_x)


@pytest.mark.parametrize("run", RUNS)
def test_policy_acts_as_it_did(run, expected):
    """The best policy of a run and its newest checkpoint rebuild their networks and act alike."""
    newest = max((DATA / run / "checkpoints").glob("step_*.pt"))
    for place, path, kind in (("best", DATA / run, "policy"), ("newest", newest, "training")):
        content = load_policy(path)
        assert content["kind"] == kind
        found = {"chances": chances(content), "actions": acted(content)}
        assert_near(found, expected, f"{run}/{place}", 1e-4)
    assert bool(load_policy(DATA / run)["network"]["recurrent"]) == (run == "memory")


@pytest.mark.parametrize("run", RUNS)
def test_run_is_evaluated(run, tmp_path, expected):
    """``softwarp eval RUN`` finds returns and lengths of episodes; an end may come a step sooner or later."""
    summary = evaluate(DATA / run, tmp_path / "summary.json")
    for name in ("episodes", "return", "length", "failed"):
        assert summary[name] == pytest.approx(float(expected[f"{run}/evaluation/{name}"]), rel=0.03), name


@pytest.mark.parametrize("run", [pytest.param(run, marks=() if run == "ppo" else pytest.mark.slow) for run in RUNS])
def test_run_goes_on(run, tmp_path, expected):
    """``softwarp train --resume RUN`` ends with the networks of the program that began it; its tables go on too."""
    folder = shutil.copytree(DATA / run, tmp_path / run)
    with (folder / "progress.csv").open() as file:
        before = list(csv.DictReader(file))
    go_on(folder)
    assert_near(weights(folder), expected, f"{run}/resumed", 2e-3)
    with (folder / "progress.csv").open() as file:
        after = list(csv.DictReader(file))
    assert after[: len(before)] == before
    assert (len(after) > len(before), int(after[-1]["steps"])) == (True, RESUMED)


@pytest.mark.parametrize("name", PLANS)
def test_plan_replays(name):
    """The actions of a plan lead to the rewards and distances in its file.

    Fingerprints of states are not compared: they are equal on one kind of machine only.
    """
    plan = plans.Plan.load(DATA / f"{name}.json")
    assert len(plan.steps) == 2 and plan.success
    assert (plan.tree is None) == (name == "plan_sequence")
    steps = plans.replay(plan)
    assert [(step.success, step.done) for step in steps] == [(step.success, step.done) for step in plan.steps]
    for found, held in zip(steps, plan.steps, strict=True):
        assert found.reward == pytest.approx(held.reward, abs=1e-3)
        assert found.distance == pytest.approx(held.distance, abs=1e-5)  # m


def test_demonstrations(tmp_path, monkeypatch, expected):
    """Two episodes on CartStem are read, and a policy is cloned from them by the command."""
    shown = Demonstrations.load(DATA / "demonstrations.npz")
    assert (len(shown), shown.episode.max().item(), shown.env["name"]) == (len(expected["shown/action"]), 1, "CartStem")
    for name in ("observation", "action", "returns", "success"):
        np.testing.assert_array_equal(getattr(shown, name).numpy(), expected[f"shown/{name}"], err_msg=name)
    monkeypatch.chdir(tmp_path)
    small = ["num_worlds=2", "algo.horizon=4", "algo.minibatches=1", "algo.epochs=1", "total_steps=8"]
    small += ["evaluations=0", "network.hidden=[4]", "logger=quiet", "out=cloned"]
    learned = [f"cloning.path={DATA / 'demonstrations.npz'}", "cloning.epochs=3"]
    assert cli.main(["train", "env=cart_stem", "env.action_kind=continuous", *small, *learned]) == 0
    assert load_policy(next((tmp_path / "cloned" / "checkpoints").glob("*8.pt")))["counters"]["steps"] == 8
