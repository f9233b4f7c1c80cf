"""Gymnasium: registration, its checkers and Stable-Baselines3's without a warning, the native vector environment."""

import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

import softwarp.gym
from softwarp.envs import registry
from tests.env_cases import FAST, some, some_cases

ID = "softwarp/Trunk-v0"
SMALL = {"mesh": "coarse", "render_width": 64, "render_height": 48}


def make_vec(num_envs=3, **options):
    return gymnasium.make_vec(ID, num_envs=num_envs, **(SMALL | options))


@pytest.mark.parametrize("name", some(2))  # the checker begins dozens of episodes
def test_check_env(name):
    options = FAST.get(name, {}) | {"render_width": 64, "render_height": 48}
    env = gymnasium.make(registry.spec(name).gym_id, render_mode="rgb_array", **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


@some_cases(0)
def test_checkers_with_every_action_kind(case):
    """Gymnasium's and Stable-Baselines3's checkers have nothing to warn about."""
    from stable_baselines3.common.env_checker import check_env as check_for_stable_baselines

    name, options = case
    size = {"render_width": 64, "render_height": 48}
    env = softwarp.gym.SingleEnv(name, render_mode="rgb_array", **(FAST.get(name, {}) | size | options))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=True)
        check_for_stable_baselines(env)


@some_cases(1)
def test_vector_env_of_every_action_kind(case):
    """Spaces hold what comes out, worlds are those of single environments, and ends reset within the step."""
    name, options = case
    options = FAST.get(name, {}) | {"max_episode_steps": 2, "solver_path": "scalar"} | options
    envs = gymnasium.make_vec(registry.spec(name).gym_id, num_envs=3, **options)
    single = softwarp.gym.SingleEnv(name, **options)
    observation, _ = envs.reset(seed=3)
    np.testing.assert_array_equal(observation[1], single.reset(seed=4)[0])
    envs.action_space.seed(0)
    for _ in range(2):
        actions = envs.action_space.sample()
        observation, reward, terminated, truncated, info = envs.step(actions)
        alone = single.step(actions[1])
        assert envs.observation_space.contains(observation) and reward.dtype == np.float32
        assert (reward[1], terminated[1], truncated[1]) == alone[1:4]
        ended = terminated | truncated
        np.testing.assert_array_equal(info["final_obs"][1] if ended[1] else observation[1], alone[0])
        if ended[1]:
            break
    assert ended[1]


@pytest.mark.parametrize(
    ("kind", "observation"),
    [
        ("absolute", "compact"),
        ("discrete", "paper"),
        *(pytest.param(*pair, marks=pytest.mark.slow) for pair in (("absolute", "paper"), ("discrete", "compact"))),
    ],
)
def test_check_env_without_warnings(kind, observation):
    env = gymnasium.make(ID, render_mode="rgb_array", action_kind=kind, observation=observation, **SMALL)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


def test_importing_softwarp_registers():
    """``import softwarp`` is enough, and so is Gymnasium's module prefix; neither loads Torch."""
    for code in (
        "import softwarp, gymnasium as g; s = g.spec('softwarp/Trunk-v0')",
        "import gymnasium as g; import importlib; importlib.import_module('softwarp'); s = g.spec('softwarp/Trunk-v0')",
    ):
        probe = f"import sys; {code}; print(s.max_episode_steps, 'torch' in sys.modules)"
        done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)
        assert done.stdout.split() == ["250", "False"]


def test_single_env_renders_and_reports():
    env = gymnasium.make(ID, render_mode="rgb_array", **SMALL)
    observation, info = env.reset(seed=4)
    assert observation.dtype == np.float32 and env.observation_space.contains(observation)
    assert set(info) == {"success", "distance", "world_status"}
    frame = env.render()
    assert frame.shape == (48, 64, 3) and frame.dtype == np.uint8 and frame.std() > 1.0
    _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
    assert type(reward) is float and terminated is False and truncated is False
    env.close(), env.close()


@pytest.mark.parametrize("limit", [3, 7])
def test_gymnasium_keeps_the_time_limit(limit):
    """Shorter or longer than the environment's own: the limit given to make holds; made directly, the option does."""
    made = gymnasium.make(ID, max_episode_steps=limit, **SMALL)
    made.unwrapped.env.max_episode_steps = 5
    direct = softwarp.gym.SingleEnv("Trunk", max_episode_steps=limit, **SMALL)
    for env in (made, direct):
        env.reset()
        flags = [env.step(np.zeros(8, dtype=np.float32))[3] for _ in range(limit)]
        assert flags == [False] * (limit - 1) + [True]


@pytest.mark.parametrize(("limit", "succeeds"), [(None, [80]), (20, []), (-1, [80, 81, 82])])
def test_surviving_is_success_whoever_keeps_the_limit(limit, succeeds):
    """CartStem asks for 80 actions: success from there on, also where Gymnasium or nobody keeps the limit."""
    from tensordict import TensorDict

    from softwarp.policies.baselines.table import rule

    env = gymnasium.make("softwarp/CartStem-v0", max_episode_steps=limit)
    balance = rule(env.unwrapped.env, "CartStem")
    observation, _ = env.reset(seed=0)
    steps, truncated = [], False
    for step in range(1, 83):
        told = balance(TensorDict({"observation": torch.as_tensor(observation)[None]}, [1]))
        observation, _, terminated, truncated, info = env.step(told["action"][0].item())
        assert not terminated
        steps += [step] * info["success"]
        if truncated:
            break
    assert (steps, truncated) == (succeeds, limit != -1)


def test_render_mode_is_checked():
    with pytest.raises(ValueError, match="render_mode 'ansi' is not offered"):
        softwarp.gym.SingleEnv("Trunk", render_mode="ansi", **SMALL)


def test_vector_spaces_and_types():
    envs = make_vec()
    assert isinstance(envs, softwarp.gym.VectorEnv)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    observation, _ = envs.reset(seed=0)
    assert envs.observation_space.contains(observation)
    observation, reward, terminated, truncated, info = envs.step(envs.action_space.sample())
    assert envs.observation_space.contains(observation)
    assert reward.dtype == np.float32 and reward.shape == (3,)
    assert terminated.dtype == np.bool_ and truncated.dtype == np.bool_
    assert info["distance"].shape == (3,) and info["_distance"].all()
    envs.close()


def test_same_step_autoreset():
    """The last observation of the episode is in final_obs, the returned one begins the next."""
    envs = make_vec(max_episode_steps=3)
    twin = make_vec(max_episode_steps=3, autoreset_mode="Disabled")
    start, _ = envs.reset(seed=1)
    twin.reset(seed=1)
    envs.action_space.seed(0)
    for step in range(3):
        action = envs.action_space.sample()
        observation, reward, terminated, truncated, info = envs.step(action)
        expected = twin.step(action)
        np.testing.assert_array_equal(reward, expected[1])
        assert ("final_obs" in info) == (step == 2)
    assert truncated.all() and not terminated.any()
    assert info["_final_obs"].all() and info["final_obs"].dtype == object
    for world in range(3):
        np.testing.assert_array_equal(info["final_obs"][world], expected[0][world])
    np.testing.assert_array_equal(info["final_info"]["distance"], expected[4]["distance"])
    again, first_info = twin.reset(options={"reset_mask": np.ones(3, dtype=np.bool_)})
    np.testing.assert_array_equal(observation, again)
    np.testing.assert_array_equal(info["distance"], first_info["distance"])
    layout = envs.env.observation_layout
    np.testing.assert_array_equal(observation[:, layout["tip"]], start[:, layout["tip"]])
    assert not np.array_equal(observation[:, layout["goal"]], start[:, layout["goal"]])


def test_disabled_autoreset_with_masks():
    envs = make_vec(autoreset_mode="Disabled", max_episode_steps=2)
    envs.reset(seed=1)
    for _ in range(2):
        observation, *_, truncated, info = envs.step(np.zeros((3, 8), dtype=np.float32))
    assert truncated.all() and "final_obs" not in info
    after, _ = envs.reset(options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal(after[[0, 2]], observation[[0, 2]])
    assert not np.array_equal(after[1], observation[1])
    with pytest.raises(ValueError, match=r"reset_mask must be bool of shape \(3,\)"):
        envs.reset(options={"reset_mask": np.zeros(3, dtype=np.bool_)})


def test_seeds_match_the_single_environment():
    """World i of reset(seed=5) is reset(seed=5 + i) alone; a list gives each world its own."""
    envs = make_vec(2)
    together, _ = envs.reset(seed=5)
    single = softwarp.gym.SingleEnv("Trunk", **SMALL)
    for world in range(2):
        np.testing.assert_array_equal(single.reset(seed=5 + world)[0], together[world])
    np.testing.assert_array_equal(envs.reset(seed=np.int64(5))[0], together)
    swapped, _ = envs.reset(seed=[6, 5])
    np.testing.assert_array_equal(swapped, together[::-1])


def test_actions_are_checked():
    envs = make_vec()
    envs.reset(seed=0)
    with pytest.raises(ValueError, match="must be finite; world 1 got"):
        envs.step(np.array([[0.0] * 8, [np.nan] * 8, [0.0] * 8], dtype=np.float32))
    with pytest.raises(ValueError, match=r"must have shape \(3, 8\), got \(2, 8\)"):
        envs.step(np.zeros((2, 8), dtype=np.float32))
    with pytest.raises(ValueError, match="action must be floating, got int64"):
        envs.step(np.zeros((3, 8), dtype=np.int64))


def test_vector_rendering_and_wrappers():
    envs = RecordEpisodeStatistics(DictInfoToList(make_vec(2, render_mode="rgb_array", max_episode_steps=2)).env)
    envs.reset(seed=0)
    frames = envs.render()
    assert len(frames) == 2 and frames[0].shape == (48, 64, 3)
    for _ in range(2):
        *_, info = envs.step(envs.action_space.sample())
    assert info["episode"]["l"].tolist() == [2, 2]
