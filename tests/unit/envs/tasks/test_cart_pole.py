"""CartPole: starts, actions, ends; a scripted feedback that always survives; the moves of Gymnasium's CartPole-v1."""

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from softwarp.envs import registry
from softwarp.envs.tasks.cart_pole import CartPoleConfig
from softwarp.policies.baselines.cart import cart_pole_feedback


def make(num_worlds=4, seed=1, **options):
    return registry.make("CartPole", num_worlds=num_worlds, seed=seed, **options)


def act(env, action):
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]


def test_starts_agree_at_the_hinge():
    """Four uniform numbers; poses and velocities of the pole follow from them."""
    env = make(num_worlds=1000, precision="float64")
    x, v, angle, spin = env.reset()["observation"].double().unbind(dim=1)
    for value, limit in ((x, 0.0005), (v, 0.0005), (angle, 0.05), (spin, 0.05)):
        assert value.abs().max() <= limit and float(value.std()) == pytest.approx(limit / math.sqrt(3.0), rel=0.06)
    pole, d = env.scene.pole, env.config.hinge_distance
    pose, twist = env.sim.body_pose[:, pole], env.sim.body_twist[:, pole]
    torch.testing.assert_close(pose[:, 0], x + d * angle.sin(), atol=1e-8, rtol=0.0)
    torch.testing.assert_close(pose[:, 2], 0.01 + d * angle.cos(), atol=1e-8, rtol=0.0)
    torch.testing.assert_close(twist[:, 0], v + d * spin * angle.cos(), atol=1e-8, rtol=0.0)
    env.sim.refresh()
    torch.testing.assert_close(env.sim.joint_position[:, 0], angle, atol=1e-6, rtol=0.0)


def test_actions_push_the_cart():
    """0 is +50 N, 1 is -50 N, a continuous 0.5 is 25 N; with the pole upright and still, x'' is F over what resists."""
    config = CartPoleConfig(start_angle=0.0, start_spin=0.0, start_x=0.0, start_v=0.0)
    m, d = config.pole_mass, config.hinge_distance
    inertia = m * (config.pole_size[0] ** 2 + config.pole_size[2] ** 2) / 12.0
    mass = config.cart_mass + m - (m * d) ** 2 / (inertia + m * d * d)
    env = registry.make("CartPole", num_worlds=2, config=config)
    env.reset()
    v = act(env, torch.tensor([0, 1]))["observation"][:, 1]
    torch.testing.assert_close(v, torch.tensor([0.5, -0.5]) / mass, rtol=0.01, atol=0.0)
    env = make(num_worlds=1, action_kind="continuous", start_angle=0.0, start_spin=0.0)
    env.reset()
    assert float(act(env, torch.tensor([[0.5]]))["observation"][0, 1]) == pytest.approx(0.25 / mass, rel=0.01)


def test_ends():
    """One per step; over beyond 12 degrees, SofaGym's 24 being a slip, or beyond the rails."""
    env = make(num_worlds=2)
    env.reset()
    data = act(env, torch.zeros(2, dtype=torch.int64))
    while not data["terminated"].any():
        assert (data["reward"] == 1.0).all()
        data = act(env, torch.zeros(2, dtype=torch.int64))
    angle = data["observation"][:, 2].abs()
    assert ((angle > math.radians(12.0)) == data["terminated"][:, 0]).all() and (angle < math.radians(24.0)).all()
    assert (data["reward"] == 1.0).all() and not data["success"].any()
    torch.testing.assert_close(data["distance"][:, 0], 0.11 * angle.sin())


@pytest.mark.parametrize("kind", [pytest.param("discrete", marks=pytest.mark.slow), "continuous"])
@pytest.mark.parametrize("make_config", [CartPoleConfig, pytest.param(CartPoleConfig.classic, marks=pytest.mark.slow)])
def test_feedback_survives(kind, make_config):
    """Every action of every episode, 500 of them in the classic's measures."""
    env = registry.make("CartPole", num_worlds=64, seed=3, config=make_config(action_kind=kind))
    policy, data = cart_pole_feedback(env), env.reset()
    for _ in range(env.max_episode_steps):
        data = env.step(policy(data))["next"]
        assert not data["terminated"].any()
    assert data["truncated"].all() and data["success"].all()


def test_classic_is_gymnasium_s():
    """The same start and the same actions end in the same state, but for Gymnasium's explicit steps of 20 ms."""
    from gymnasium.envs.classic_control.cartpole import CartPoleEnv

    env, other = registry.make("CartPole", seed=2, config=CartPoleConfig.classic()), CartPoleEnv()
    other.reset(seed=0)
    other.state = env.reset()["observation"][0].numpy()
    for action in (0, 1, 1, 0, 1, 0, 0, 1, 0, 1):
        mine = act(env, torch.tensor([action]))["observation"][0].numpy()
        theirs, reward, *_ = other.step(action)
        assert reward == 1.0
    np.testing.assert_allclose(mine[[1, 3]], theirs[[1, 3]], atol=0.02)
    np.testing.assert_allclose(mine[[0, 2]], theirs[[0, 2]], atol=0.01)
    assert env.max_episode_steps == 500 and env.control_dt == pytest.approx(other.tau)
    assert env.config.max_x == other.x_threshold
    assert env.config.max_angle == pytest.approx(other.theta_threshold_radians)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"force": 0.0}, "force must be finite and not 0, got 0.0"),
        ({"pole_mass": -1.0}, "pole_mass must lie in .*, got -1.0"),
        ({"max_angle": 0.0}, "max_angle must lie in .*, got 0.0"),
        ({"action_kind": "binary"}, "unknown action_kind 'binary'"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_a_start_that_is_not_finite_stays_in_the_scenes_initial_state():
    """Poses that are not finite never reach the simulation: the world starts upright, says so, and goes on."""
    env, healthy = make(num_worlds=3), make(num_worlds=3)
    draw = env.draw
    env.draw = lambda stream, count: torch.where(
        torch.tensor([[False], [True], [False]]), math.nan, draw(stream, count)
    )
    data, good = env.reset(), healthy.reset()
    assert data["world_status"].flatten().tolist() == [0, 3, 0]
    assert torch.equal(env.sim.frame_pose[1], env._rest[0]) and torch.equal(
        data["observation"][::2], good["observation"][::2]
    )
    data, good = act(env, torch.zeros(3, dtype=torch.int64)), act(healthy, torch.zeros(3, dtype=torch.int64))
    assert data["world_status"].flatten().tolist() == [0, 0, 0] and torch.isfinite(data["observation"]).all()
    assert torch.equal(data["observation"][::2], good["observation"][::2])
