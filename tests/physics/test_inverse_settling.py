"""Inverse control of the trunk near targets: exact sensitivities, goals that it used to circle or to miss, batches."""

import math

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp.control import InverseController, InversePolicy, Outcome, PointEffector
from softwarp.envs import registry
from softwarp.envs.scenes.trunk import TrunkSceneConfig, build_trunk_scene
from softwarp.envs.tasks.trunk import Trunk, reachable_points

PERIOD, SUBSTEPS = 0.05, 5
REACHED = 0.5e-3  # m
BENT = (0.01444, 0.00283, -0.00007, 0.0123, 0.01107, -0.00406, -0.00505, 0.01083)  # m, sideways by a right angle
HARD = (99, 278, 404, 440, 888)  # goals of the evaluation split near crushed poses
LATE = (-0.04531, -0.09254, 0.04146)  # m, another


def trunk(worlds=1, *, precision="float32", path="auto", mesh="medium"):
    """Simulation of the trunk and its tip."""
    builder = sw.ModelBuilder(gravity=(0.0, -9.81, 0.0))
    scene = build_trunk_scene(TrunkSceneConfig(mesh=mesh), builder)
    sim = sw.Simulation(builder.finalize(num_worlds=worlds, precision=precision), dt=0.01, solver_path=path)
    return sim, PointEffector(scene.tip_markers)


def tip(sim):
    """Mean of the markers [m], (world, 3)."""
    return sim.marker_x.mean(dim=1)


def distances(goals, seconds=12.5):
    """At the end of an episode through the task's own actions, and the largest of its last second [m], (goal,) each."""
    env = registry.make("Trunk", num_worlds=len(goals), seed=0)
    policy = InversePolicy(env)
    state = env.reset()
    env.goal.copy_(torch.as_tensor(goals))
    last = []
    for _ in range(round(seconds / PERIOD)):
        state = env.step_mdp(env.step(policy(state)))
        last.append((env.tip() - env.goal).norm(dim=-1))
    return last[-1], torch.stack(last[-20:]).amax(dim=0)


@pytest.mark.slow
def test_sensitivity_where_lengths_hold_what_tensions_would_let_buckle():
    """Central differences of the simulator's equilibria by +-20 um give J of all taut cables, within 3 % of its size.

    D, the compliance of the cables, has a negative eigenvalue there: under the same tensions the trunk would buckle.
    """
    sim, effector = trunk(precision="float64")
    command = torch.tensor([BENT], dtype=torch.float64)
    sim.control.cable_displacement.copy_(command)
    sim.step(600)
    controller = InverseController(sim, [effector], period=PERIOD, settle=0.003)
    controller.solve(tip(sim), apply=False)
    (_, system), *_ = controller._systems
    settling = system.settling
    compliance = settling.static.compliance.real.numpy()[0].reshape(8, 8)
    taut = np.flatnonzero(sim.cable_tension[0].numpy() > 0.05)
    assert len(taut) >= 4
    assert np.linalg.eigvals(compliance[np.ix_(taut, taut)]).real.min() < -0.005  # m/N
    found = settling.motion.numpy().reshape(8, 3).T[:, taut]
    start, ends = sim.snapshot(), []
    for cable in taut:
        for sign in (1.0, -1.0):
            sim.restore(start)
            sim.control.cable_displacement[:, cable] = command[:, cable] + sign * 2.0e-5
            sim.step(300)
            ends.append(tip(sim)[0].numpy())
    difference = (np.array(ends[::2]) - np.array(ends[1::2])).T / 4.0e-5
    np.testing.assert_allclose(found, difference, atol=0.03 * np.abs(difference).max())


@pytest.mark.slow
def test_goals_near_crushed_poses():
    """At rest there at the end of an episode; when cables chattered, such goals were circled at 0.5 to 3 mm."""
    table = reachable_points()
    end, _ = distances(table[int(0.8 * len(table)) :][list(HARD)])
    assert end.max() < REACHED, end


@pytest.mark.slow
def test_goal_that_asks_for_letting_go():
    """A pose that is nearly crushed, with all cables taut: the tip stayed 1 mm away, at rest."""
    end, worst = distances(np.array([LATE], dtype=np.float32), seconds=25.0)
    assert worst.max() < REACHED, end


def test_what_is_let_go():
    """After eight seconds taut cables change by -rho d |e| / r (T - J' (J J' + mu)^-1 J T) too."""
    sim, effector = trunk(mesh="coarse", precision="float64")
    sim.control.cable_displacement.fill_(0.004)  # all eight
    sim.step(400)
    target, radius = tip(sim) + torch.tensor([[0.001, 0.0, 0.001]]), 0.004
    controller = InverseController(sim, [effector], period=PERIOD, settle=radius, max_step=1.0)
    commands = [controller.solve(target, apply=False).command[0].numpy().copy() for _ in range(162)]
    assert all(np.array_equal(command, commands[21]) for command in commands[21:160])
    (_, system), *_ = controller._systems
    motion, tension = system.settling.motion.numpy()[0].reshape(8, 3), sim.cable_tension[0].numpy()
    compliance = system.problem.compliance.numpy()[0].reshape(8, 8).diagonal().mean()
    taut = tension > 0.01
    assert 4 <= taut.sum() < 8
    spanned = motion @ np.linalg.solve(motion.T @ motion + 0.05 * np.eye(3), motion.T @ tension)
    share = float((tip(sim) - target).norm()) / radius
    expected = np.where(taut, -0.05 * compliance * share * (tension - spanned), 0.0)
    np.testing.assert_allclose(commands[161] - commands[159], expected, rtol=1e-6, atol=1e-9)
    assert expected @ tension < 0.0
    assert np.linalg.norm(expected @ motion) < 0.3 * np.linalg.norm(expected)


@pytest.mark.slow
def test_every_goal_of_a_quarter_of_the_evaluation_split():
    """All rest within 0.5 mm after 25 s, all but a few after an episode. With cables that chatter 4 % never did."""
    table = reachable_points()
    _, worst = distances(table[int(0.8 * len(table)) :][:225], seconds=25.0)
    assert (worst < REACHED).all(), worst[worst >= REACHED]
    assert worst.median() < 1.0e-6


@pytest.mark.slow
def test_robot_at_its_target_is_left_alone():
    """Within the radius of a target that stands still, after its patience: the commands approach a limit, at rest."""
    sim, effector = trunk(mesh="coarse")
    sim.step(200)
    target = tip(sim) + torch.tensor([[0.0005, 0.0004, 0.0]])
    controller = InverseController(sim, [effector], period=PERIOD, settle=0.003)
    commands = []
    for _ in range(120):
        solution = controller.solve(target)
        commands.append(solution.command.clone())
        sim.step(SUBSTEPS)
    assert (tip(sim) - target).norm() < 2e-5
    assert (commands[-1] - commands[-2]).abs().max() < 2e-6
    assert sim.node_v.abs().max() < 1e-3
    assert solution.outcome[0] == Outcome.REACHED


def test_targets_that_move_are_left_to_the_program():
    """The patience starts anew whenever the target moves: commands are those of a controller that never settles."""
    sim, effector = trunk(mesh="coarse")
    sim.step(100)
    start = tip(sim)
    settling = InverseController(sim, [effector], period=PERIOD, settle=0.003)
    never = InverseController(sim, [effector], period=PERIOD, settle=1.0e-9)
    differ = []
    for k in range(50):
        target = start + torch.tensor([[1.0e-6 * min(k, 29), 0.0, 0.0]])
        solution = settling.solve(target, apply=False)
        differ.append(not torch.equal(solution.command, never.solve(target, apply=False).command))
        settling.apply(solution)
        sim.step(SUBSTEPS)
    assert differ == [False] * 49 + [True]  # 20 calls after the last motion


@pytest.mark.slow
@pytest.mark.parametrize("path", ["scalar", "lanes"])
def test_world_equals_alone(path):
    """World 5 of 11 has the bits of the same world alone, on its way and settling."""
    rng = np.random.default_rng(3)
    shifts = torch.as_tensor(0.002 * rng.uniform(-1.0, 1.0, (11, 3)), dtype=torch.float32)
    shifts[::2] *= 10.0
    runs = []
    for chosen in (range(11), [5]):
        sim, effector = trunk(len(chosen), path=path, mesh="coarse")
        sim.step(100)
        controller = InverseController(sim, [effector], period=PERIOD, settle=0.003)
        target, commands = tip(sim) + shifts[list(chosen)], []
        for _ in range(26):
            commands.append(controller.solve(target).command.clone())
            sim.step(SUBSTEPS)
        (_, system), *_ = controller._systems
        assert system.settling.still.numpy().min() >= system.settling.patience
        runs.append((torch.stack(commands), sim.node_x.clone()))
    (batch, positions), (alone, position) = runs
    assert torch.equal(batch[:, 5], alone[:, 0]) and torch.equal(positions[5], position[0])


def test_mistakes_are_named():
    sim, effector = trunk(mesh="coarse")
    with pytest.raises(ValueError, match=r"settle must be positive and finite, got -0\.1"):
        InverseController(sim, [effector], settle=-0.1)
    with pytest.raises(ValueError, match="settle goes with a finite horizon"):
        InverseController(sim, [effector], settle=0.003, horizon=math.inf)
    builder = sw.ModelBuilder()
    body = builder.add_tets(
        sw.meshing.box((0.1, 0.02, 0.02), (5, 1, 1)), material=sw.Corotational(1.0e5, 0.3), total_mass=0.1
    )
    builder.add_cable(body, [(0.05, 0.01, 0.01)], (0.0, 0.01, 0.01), control="force", name="pull")
    builder.add_marker(body, (0.1, 0.01, 0.01))
    with pytest.raises(ValueError, match="settle needs cables under length control; 'pull' is not"):
        InverseController(sw.Simulation(builder.finalize()), [0], settle=0.003)
    builder.add_rigid(sw.shapes.Sphere(0.01), mass=0.1)
    with pytest.raises(ValueError, match="settle needs a scene of soft bodies and cables; this one has rigid bodies"):
        InverseController(sw.Simulation(builder.finalize()), [0], settle=0.003)


def test_trunk_asks_for_it():
    """The task's advice reaches the policy, and may be overruled."""
    env = registry.make("Trunk", num_worlds=1, seed=0, mesh="coarse")
    assert InversePolicy(env).controller.options.settle == Trunk.steering["settle"]
    assert InversePolicy(env, settle=None).controller.options.settle == 0.0
