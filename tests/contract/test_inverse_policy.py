"""Inverse control as a policy: every kind of action, demonstrations, evaluation from the command line, other tasks."""

import json
import math

import pytest
import torch

from softwarp import cli
from softwarp.control import InversePolicy
from softwarp.envs import registry
from softwarp.policies.policy import Spaces
from softwarp.training.demonstrations import Demonstrations
from softwarp.training.evaluation import run_episodes


@pytest.mark.parametrize(
    ("kind", "worst"),
    [("continuous", 5e-4), pytest.param("absolute", 5e-4, marks=pytest.mark.slow), ("discrete", 8e-3)],
)
def test_diamond(kind, worst):
    """At the end of an episode the top is within half a millimetre; discrete steps of 5 mm leave it swinging nearby."""
    env = registry.make("Diamond", num_worlds=6, seed=4, mesh="coarse", action_kind=kind, goals="list")
    episodes = run_episodes(env, InversePolicy(env), seed=4)
    assert episodes.distance.max() < worst
    assert not episodes.failed.any()


@pytest.mark.slow
def test_trunk():
    """Two goals that the coarse trunk was led to: within half a millimetre after five seconds."""
    env = registry.make("Trunk", num_worlds=2, seed=0, mesh="coarse", goals="list", max_episode_steps=120)
    env.reset()
    command = torch.zeros(2, 8)
    command[0, [0, 4]], command[1, [1, 5]] = torch.tensor([0.02, 0.008]), torch.tensor([0.02, 0.008])
    env.sim.control.cable_displacement.copy_(command)
    for _ in range(400):
        env.sim.step()
    goals = [[round(x, 5) for x in goal] for goal in env.tip().tolist()]
    distances = []
    for goal in goals:
        task = registry.make("Trunk", seed=0, mesh="coarse", goals="list", goal_list=[goal], max_episode_steps=120)
        distances.append(float(run_episodes(task, InversePolicy(task), seed=1).distance))
    assert max(distances) < 5e-4


def test_actions_ask_for_the_commands_that_are_wished():
    """With rates out of the way, an action takes the commands as near to the wish as its step allows."""
    for kind in ("continuous", "absolute"):
        env = registry.make("Diamond", num_worlds=2, mesh="coarse", action_kind=kind)
        env.reset()
        wish = torch.tensor([[0.003, 0.0, 0.001, 0.004], [0.020, 0.0, 0.002, 0.0]])
        action = env.action_for(wish)
        env.apply_action(action, 0)
        torch.testing.assert_close(env.command, wish.clamp(max=0.005), atol=1e-7, rtol=0)
    for name, expected in (("Diamond", [6, 3]), ("Trunk", [3, 9])):
        env = registry.make(name, num_worlds=2, mesh="coarse", action_kind="discrete", clamp_commands=False)
        env.reset()
        cables = env.command.shape[1]
        wish = torch.zeros(2, cables)
        wish[0, 3], wish[1, 1] = 0.02, -0.01
        assert env.action_for(wish).tolist() == expected


@pytest.mark.parametrize("kind", [pytest.param("absolute", marks=pytest.mark.slow), "continuous", "discrete"])
def test_cart_stem_contact(kind):
    """Goals that the upright stem can reach: met with every kind of action; the twin is where the environment is."""
    env = registry.make("CartStemContact", num_worlds=4, seed=2, action_kind=kind, goals="open")
    episodes = run_episodes(env, InversePolicy(env), seed=2)
    assert episodes.success.all() and not episodes.failed.any()
    twin = env.steered()
    torch.testing.assert_close(twin.frame_pose, env.sim.frame_pose, atol=1e-6, rtol=0.0)
    torch.testing.assert_close(twin.marker_x[:, 0], env.sim.rod_x[:, -1], atol=1e-6, rtol=0.0)


@pytest.mark.slow  # seconds; the evaluation from the command line below is short
@pytest.mark.parametrize(("kind", "worst"), [("continuous", 1e-3), ("discrete", 6e-3)])
def test_concentric_tubes(kind, worst):
    """Tubes in the passage come to goals with each kind of action; discrete steps of 10 mm leave them nearby."""
    goals = [[-0.002, 0.008, 0.028], [0.004, 0.011, 0.033]]
    env = registry.make("ConcentricTubeRobot", num_worlds=2, seed=3, action_kind=kind, goals="list", goal_list=goals)
    episodes = run_episodes(env, InversePolicy(env), seed=3)
    assert episodes.distance.max() < worst
    assert not episodes.failed.any()


def test_concentric_tubes_from_the_command_line(tmp_path, capsys):
    """``softwarp eval env=concentric_tube_robot policy=inverse``: three actions bring the tip some way to its goal."""
    file = tmp_path / "tubes.json"
    arguments = ["eval", "env=concentric_tube_robot", "policy=inverse", "episodes=2", "env.max_episode_steps=4"]
    assert cli.main([*arguments, "--json", str(file)]) == 0
    assert "inverse" in capsys.readouterr().out
    assert json.loads(file.read_text())["policies"]["inverse"]["episodes"] == 2
    env = registry.make("ConcentricTubeRobot", num_worlds=2, seed=5)
    data = env.reset()
    begun, policy = env.measure_distance(), InversePolicy(env)
    for _ in range(4):
        data = env.step(policy(data))["next"]
    assert (env.measure_distance() < begun - 5e-3).all()


def test_tasks_without_a_point_to_bring_to_a_goal_are_refused():
    with pytest.raises(ValueError, match="CartPole has no point that actuators bring to a goal"):
        InversePolicy(registry.make("CartPole", num_worlds=1))


def test_eval_and_record_from_the_command_line(tmp_path, capsys):
    """``softwarp eval env=diamond policy=inverse`` and demonstrations that behaviour cloning can read."""
    small = ["env.mesh=coarse", "env.goals=list"]
    arguments = ["eval", "env=diamond", "policy=inverse", "episodes=3", *small, "--json", str(tmp_path / "e.json")]
    assert cli.main(arguments) == 0
    assert "inverse" in capsys.readouterr().out
    summary = json.loads((tmp_path / "e.json").read_text())["policies"]["inverse"]
    assert summary["episodes"] == 3 and summary["success"] == 1.0
    file = tmp_path / "shown.npz"
    assert cli.main(["record", str(file), "env=diamond", "policy=inverse", "episodes=2", "noise=0.0", *small]) == 0
    shown = Demonstrations.load(file)
    shown.check_fit(Spaces.of(registry.make("Diamond", mesh="coarse", goals="list")))
    assert shown.success.all() and len(shown) == 100
    assert cli.main(["eval", "env=diamond", "policy=scripted", "episodes=2", *small]) == 0
    assert math.isfinite(float(capsys.readouterr().out.splitlines()[-1].split()[1]))
    assert cli.main(["eval", "env=cart_pole", "policy=nonsense"]) == 2
