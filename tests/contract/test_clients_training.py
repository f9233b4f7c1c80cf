"""Libraries that train: Stable-Baselines3's adapter, and the examples of skrl and RLlib where these are installed."""

import importlib
import sys

import gymnasium
import numpy as np
import pytest
import torch

import softwarp.gym

SMALL = {"max_episode_steps": 5, "max_angle": 0.3}


@pytest.fixture
def env():
    from softwarp import sb3

    return sb3.make("CartPole", 4, seed=0, **SMALL)


def test_stable_baselines_sees_every_end(env):
    """Ends carry the last observation and whether time was up; the observation returned begins the next episode."""
    native = gymnasium.make_vec("softwarp/CartPole-v0", num_envs=4, **SMALL)
    np.testing.assert_array_equal(env.reset(), native.reset(seed=0)[0])
    seen = set()
    for step in range(12):
        actions = np.array([step % 2, 0, 1, 1 - step % 2])  # two that stay up, two that fall
        observation, _, done, infos = env.step(actions)
        expected, _, terminated, truncated, info = native.step(actions)
        np.testing.assert_array_equal(observation, expected)
        for world in np.flatnonzero(done):
            assert infos[world]["TimeLimit.truncated"] == (truncated[world] and not terminated[world])
            np.testing.assert_array_equal(infos[world]["terminal_observation"], info["final_obs"][world])
            seen.add(infos[world]["TimeLimit.truncated"])
        assert all(infos[world] == {} for world in np.flatnonzero(~done))
    assert seen == {True, False}


def test_stable_baselines_trains(env):
    """Two updates of PPO through a monitor."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecMonitor

    monitored = VecMonitor(env, info_keywords=("is_success", "distance"))
    model = PPO("MlpPolicy", monitored, n_steps=8, batch_size=16, n_epochs=1, seed=0, device="cpu")
    model.learn(64)
    assert model.num_timesteps == 64 and set(model.ep_info_buffer[0]) >= {"r", "l", "is_success", "distance"}


def test_what_stable_baselines_cannot_do_is_refused(env):
    from softwarp import sb3

    with pytest.raises(ValueError, match="leave out autoreset_mode"):
        sb3.VecEnv(softwarp.gym.VectorEnv(2, "CartPole", autoreset_mode="NextStep"))
    with pytest.raises(ValueError, match="share one environment"):
        env.set_attr("num_envs", 3, indices=[0])


def test_without_stable_baselines_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.vec_env", None)
    monkeypatch.delitem(sys.modules, "softwarp.sb3", raising=False)
    with pytest.raises(ImportError, match=r"needs Stable-Baselines3: pip install 'softwarp\[sb3\]'"):
        importlib.import_module("softwarp.sb3")


@pytest.mark.parametrize("name", ["CartPole", "StemPendulum"])
def test_skrl_example(name, capsys):
    """Two updates with choices and with continuous actions."""
    pytest.importorskip("skrl")
    from experiments import skrl_ppo

    torch.manual_seed(0)
    skrl_ppo.main([f"softwarp/{name}-v0", "--steps", "128", "--worlds", "8", "--horizon", "8"])
    assert "128 steps" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("name", ["CartPole", "StemPendulum"])
def test_rllib_example(name, capsys):
    """One iteration of PPO on environments of a batch in this process."""
    pytest.importorskip("ray.rllib")
    from experiments import rllib_ppo

    rllib_ppo.main([f"softwarp/{name}-v0", "--steps", "128", "--worlds", "8", "--horizon", "16"])
    assert "128 steps" in capsys.readouterr().out
