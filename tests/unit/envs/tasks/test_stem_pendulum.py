"""StemPendulum: equilibria and swings against theory, starts, torques, observations, reward, success, options."""

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from softwarp.envs import registry
from softwarp.envs.tasks.stem_pendulum import AVERAGED, StemPendulumConfig
from softwarp.policies.baselines.stem_pendulum import pendulum_baseline

LENGTH, WEIGHT = 0.10, 1.0e4 * math.pi * 0.02**2 * 0.10 * 9.81  # m, N


def make(num_worlds=4, seed=1, **options):
    return registry.make("StemPendulum", num_worlds=num_worlds, seed=seed, **options)


def act(env, action):
    value = torch.full((env.num_worlds, 1), float(action))
    return env.step(TensorDict({"action": value}, batch_size=env.batch_size))["next"]


@pytest.fixture(scope="module")
def env():
    """One environment shared by the tests that reset it themselves."""
    return make()


def test_starts_at_any_angle_straight_and_at_rest():
    env = make(num_worlds=256, seed=3)
    env.reset()
    angle = env.sim.joint_position[:, env.scene.hinge]
    assert angle.min() > -math.pi and angle.max() < math.pi
    assert abs(float(angle.mean())) < 0.5 and abs(float(angle.std()) - math.pi / math.sqrt(3.0)) < 0.2
    tip = env.sim.rod_x[:, -1]
    zero = torch.zeros_like(angle)
    np.testing.assert_allclose(tip, LENGTH * torch.stack((-angle.sin(), zero, angle.cos()), dim=1), atol=1e-7)
    assert (env.sim.frame_twist == 0.0).all()
    np.testing.assert_allclose(env.sim.control.joint_target[:, 0], angle)


def test_it_comes_to_rest_hanging_and_stretched():
    """All motion dies; then the spring's moment k (start - angle) is that of the weight, m g times its arm.

    For the same reason the tip hangs beside the root, on the side of the start.
    """
    env = make(num_worlds=2, seed=0, dt=0.02, action_repeat=20, max_episode_steps=500, precision="float64")
    env.reset()
    start = env.sim.control.joint_target[:, 0].clone()
    for _ in range(60):
        act(env, 0.0)
    assert env.sim.rod_v.abs().max() < 1e-6
    x = env.sim.rod_x[..., 0]
    centre = 0.5 * (x[:, 1:] + x[:, :-1]).mean(dim=1)
    moment = 0.03 * (start - env.sim.joint_position[:, 0])
    np.testing.assert_allclose(moment, WEIGHT * centre, rtol=1e-3)  # a moment about -y turns towards -x
    assert (env.sim.rod_x[:, -1, 2] < -1.01 * LENGTH).all()  # stretched by its weight


def test_energy_only_falls_without_torque():
    """Backward Euler takes energy: kinetic, elastic and potential, the spring's included, never grow."""
    env = make(num_worlds=3, seed=2, precision="float64")
    env.reset()
    start = env.sim.control.joint_target[:, 0].clone()
    before = None
    for _ in range(10):
        act(env, 0.0)
        turned = env.sim.joint_position[:, 0] - start
        total = env.sim.energy() + 0.5 * 0.03 * turned.square()
        assert before is None or (total <= before + 1e-9).all()
        before = total


def test_torque_is_reached_in_equal_increments(env):
    env.reset()
    act(env, -1.0)
    seen = []
    for substep in range(20):
        env.apply_action(torch.full((4, 1), 0.6), substep)
        seen.append(env.sim.control.joint_force[0, 0].item())
    np.testing.assert_allclose(seen, -0.25 + 0.02 * np.arange(1, 21), atol=1e-6)


def test_observation_and_reward(env):
    """Entries against the simulation; -d / 2 L with d from the tip to the top."""
    env.reset()
    for action in (1.0, -0.5, 0.3):
        data = act(env, action)
    angle, tip, speed = env.sim.joint_position[:, 0], env.sim.rod_x[:, -1], env.sim.rod_v[:, -1]
    spin = env.sim.joint_velocity[:, 0]
    expected = (angle.cos(), angle.sin(), spin / 30, tip[:, 0] / 0.1, tip[:, 2] / 0.1, speed[:, 0] / 3, speed[:, 2] / 3)
    observation = data["observation"]
    np.testing.assert_allclose(observation[:, :7], torch.stack(expected, dim=1), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(observation[:, 7], 0.3, rtol=1e-6)
    moment = 0.03 * (env.sim.control.joint_target[:, 0] - angle)
    np.testing.assert_allclose(observation[:, 8], moment / 0.25, rtol=1e-5, atol=1e-6)
    distance = (tip - torch.tensor([0.0, 0.0, LENGTH])).norm(dim=1)
    np.testing.assert_allclose(data["distance"][:, 0], distance, rtol=1e-5)
    np.testing.assert_allclose(data["reward"][:, 0], -distance / (2.0 * LENGTH), rtol=1e-5)
    state = env.decode(observation)
    np.testing.assert_allclose(state[:, 0], torch.atan2(-tip[:, 0], tip[:, 2]), atol=1e-5)
    dt, (x, z) = 1e-4, (tip[:, 0] + 1e-4 * speed[:, 0], tip[:, 2] + 1e-4 * speed[:, 2])
    turned = torch.remainder(torch.atan2(-x, z) - state[:, 0] + math.pi, 2.0 * math.pi) - math.pi
    np.testing.assert_allclose(turned / dt, state[:, 1], rtol=0.02, atol=0.02)


def test_success_is_the_mean_height_of_ten_actions():
    env = make(start_angle=(0.0, 0.0), success_height=0.5, root_stiffness=10.0)
    env.reset()
    succeeded = [bool(act(env, 0.0)["success"].all()) for _ in range(AVERAGED + 1)]
    # Heights before the start count as hanging: k of 10 near +0.97 L (stiff spring) and the others at -L.
    assert succeeded == [0.97 * k - (10 - k) > 5.0 for k in range(1, 11)] + [True]


def test_episode_ends_by_time_alone(env):
    env.reset()
    for k in range(50):
        data = act(env, (-1.0) ** k)
        assert bool(data["truncated"].all()) == (k == 49) and not data["terminated"].any()
    assert (data["world_status"] == 0).all()


def test_paper_options():
    """Half angles of the pose in SofaGym's axes, its motor and time step."""
    env = make(config=StemPendulumConfig.paper())
    data = env.reset()
    angle = env.sim.joint_position[:, 0] + 0.5 * math.pi
    tip = env.sim.rod_x[:, -1] / LENGTH
    zero = torch.zeros_like(angle)
    expected = torch.stack(((0.5 * angle).sin(), (0.5 * angle).cos(), zero, tip[:, 0], tip[:, 2]), dim=1)
    np.testing.assert_allclose(data["observation"], expected, atol=1e-6)
    act(env, 1.0)
    np.testing.assert_allclose(env.sim.control.joint_force, 0.05, rtol=1e-6)
    assert env.control_dt == pytest.approx(0.1)
    with pytest.raises(ValueError, match="decode needs observation='state'"):
        env.decode(data["observation"])


def test_policy_swings_up_and_balances():
    """At least two of three of 32 random starts end upright; doing nothing never does."""
    env = make(num_worlds=32, seed=9)
    data = env.rollout(50, pendulum_baseline(env))
    assert data["next", "success"][:, -1].float().mean() >= 0.66
    idle = env.rollout(50, lambda td: td.set("action", torch.zeros(32, 1)))
    assert not idle["next", "success"][:, -1].any()


def test_picture_and_scene_file(tmp_path):
    """The picture changes as the rod moves; the USD file holds rod, goal and motion."""
    from pxr import Usd

    from softwarp.io.trajectory import Recorder
    from softwarp.io.usd import export_usd

    env = make(num_worlds=1, render_width=80, render_height=60)
    env.reset()
    first = env.render()[0]
    recorder = Recorder(env.sim, worlds=[0])
    for _ in range(3):
        recorder.capture(env.goal_points())
        act(env, 1.0)
    assert first.shape == (60, 80, 3) and (first != env.render()[0]).any()
    np.testing.assert_allclose(env.goal_points(), [[0.0, 0.0, LENGTH]])
    file = tmp_path / "pendulum.usda"
    export_usd(recorder.finish(), file)
    stage = Usd.Stage.Open(str(file))
    assert {"rod", "goal"} <= {prim.GetName().lower() for prim in stage.Traverse()}
    assert stage.GetEndTimeCode() > stage.GetStartTimeCode()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observation": "sate"}, r"unknown observation 'sate'; did you mean 'state'"),
        ({"segments": 0}, r"segments must be an integer of at least 1, got 0"),
        ({"youngs": -1.0}, r"youngs must lie in .*, got -1.0"),
        ({"max_torque": 0.0}, r"max_torque must lie in .*, got 0.0"),
        ({"start_angle": (0.0, 4.0)}, r"start_angle must lie in \[-pi, pi\]"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)
