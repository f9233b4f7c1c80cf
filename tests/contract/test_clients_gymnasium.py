"""Gymnasium's and TorchRL's ways to make environments: modes of automatic reset, wrappers, GymEnv, refusals."""

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from gymnasium.error import Error, ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import vector
from torchrl.envs import GymEnv, GymWrapper
from torchrl.envs.utils import check_env_specs

import softwarp.gym
from softwarp.envs import registry
from tests.env_cases import FAST, NAMES

ID = "softwarp/CartPole-v0"  # falls within a few pushes to one side: episodes end apart from each other
ALIKE: dict[str, Any] = {
    "max_episode_steps": 6,
    "solver_path": "scalar",
    "max_angle": 0.3,
}  # one world's bits in any batch
MODES = [mode.value for mode in AutoresetMode]


def native(mode: str = "SameStep", num_envs: int = 4, **options: Any) -> gymnasium.vector.VectorEnv:
    return gymnasium.make_vec(ID, num_envs=num_envs, autoreset_mode=mode, **(ALIKE | options))


def one_by_one(mode: str, num_envs: int = 4) -> SyncVectorEnv:
    """Gymnasium's own vector environment around single ones, which keep their limit of steps themselves."""
    return SyncVectorEnv([lambda: softwarp.gym.SingleEnv("CartPole", **ALIKE)] * num_envs, autoreset_mode=mode)


def assert_same(ours: Any, theirs: Any) -> None:
    """Equal but for the precision of numbers, infos with their masks included."""
    if isinstance(theirs, dict):
        assert set(ours) == set(theirs)
        for key in theirs:
            assert_same(ours[key], theirs[key])
    elif isinstance(theirs, tuple):
        for mine, other in zip(ours, theirs, strict=True):
            assert_same(mine, other)
    elif theirs.dtype == object:
        assert [entry is None for entry in ours] == [entry is None for entry in theirs]
        for mine, other in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(mine, other)
    else:
        np.testing.assert_array_equal(ours, np.asarray(theirs, dtype=ours.dtype))


@pytest.mark.parametrize(
    "mode", [pytest.param(mode, marks=pytest.mark.slow if mode == "NextStep" else ()) for mode in MODES]
)
def test_automatic_reset_is_that_of_gymnasium(mode):
    """Step by step what SyncVectorEnv makes of single environments, with falls and time limits, and after resets."""
    ours, theirs = native(mode), one_by_one(mode)
    assert ours.metadata["autoreset_mode"] is theirs.metadata["autoreset_mode"]
    assert_same(ours.reset(seed=2), theirs.reset(seed=2))
    theirs.action_space.seed(1)
    ends = np.zeros(2, dtype=int)
    for step in range(20):
        actions = theirs.action_space.sample()
        actions[:2] = step % 2 == 0, 1  # one that stays up, one that falls
        found, wanted = ours.step(actions), theirs.step(actions)
        assert_same(found, wanted)
        done = found[2] | found[3]
        ends += found[2].sum(), found[3].sum()
        if mode == "Disabled" and done.any():
            options = {"reset_mask": done}
            assert_same(ours.reset(options=dict(options)), theirs.reset(options=dict(options)))
        if step == 11:
            assert_same(ours.reset(), theirs.reset())
    assert ends.min() > 2  # both kinds were seen


@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
def test_seeds_for_some_worlds(mode):
    """With a mask or with None among the seeds, other worlds go on with their own draws, as Gymnasium's do."""
    ours, theirs = native(mode, 3), one_by_one(mode, 3)
    assert_same(ours.reset(seed=[5, 6, 7]), theirs.reset(seed=[5, 6, 7]))
    assert_same(ours.reset(seed=[9, None, 8]), theirs.reset(seed=[9, None, 8]))
    mask = np.array([False, True, True])
    for seed in (3, [1, None, 2], None):
        ours_again = ours.reset(seed=seed, options={"reset_mask": mask})
        assert_same(ours_again, theirs.reset(seed=seed, options={"reset_mask": mask}))
    assert_same(ours.reset(), theirs.reset())


def test_a_world_that_begins_waits_for_the_next_step():
    """While others are simulated, a world that NextStep resets is where ``reset`` put it, and counts no step."""
    envs = native("NextStep", 2)
    envs.reset(seed=0)
    left = np.array([1, 0])
    while not (ended := envs.step(left)[2]).any():
        left[1] = 1 - left[1]
    world = int(np.flatnonzero(ended)[0])
    observation, reward, *_, info = envs.step(np.full(2, -7) * ended + left * ~ended)  # what it would do is not asked
    assert reward[world] == 0.0 and reward[1 - world] != 0.0 and info["_distance"].all()
    assert envs.env.step_count[world] == 0 and envs.env.step_count[1 - world] > 0
    np.testing.assert_array_equal(observation[world], envs.env.observe()["observation"][world].numpy())


@pytest.mark.parametrize("mode", MODES)
def test_steps_without_an_episode_are_refused(mode):
    envs = native(mode, 2, max_episode_steps=1)
    with pytest.raises(ResetNeeded, match="no episode yet"):
        envs.step(np.zeros(2, dtype=np.int64))
    with pytest.raises(ResetNeeded, match="all of them first"):
        envs.reset(options={"reset_mask": np.array([True, False])})
    envs.reset(seed=0)
    envs.step(np.zeros(2, dtype=np.int64))
    if mode == "Disabled":
        with pytest.raises(ResetNeeded, match=r"worlds \[0, 1\] have ended"):
            envs.step(np.zeros(2, dtype=np.int64))
        envs.reset(options={"reset_mask": np.array([True, True])})
    envs.step(np.zeros(2, dtype=np.int64))


def test_unknown_options_are_unexpected_keywords():
    """A TypeError as of any constructor, which names what is near; Gymnasium refuses vector_kwargs by itself."""
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(TypeError, match=r"unexpected keyword argument 'max_angel'.*did you mean 'max_angle'"):
            make(ID, max_angel=0.3)
    with pytest.raises(Error, match="only through kwargs"):
        gymnasium.make_vec(ID, vector_kwargs={"autoreset_mode": "NextStep"})
    with pytest.raises(ValueError, match=r"autoreset_mode.*NextStep"):
        native("Never")


WRAPPERS = {
    "NormalizeObservation": lambda envs: vector.NormalizeObservation(envs),
    "NormalizeReward": lambda envs: vector.NormalizeReward(envs),
    "RecordEpisodeStatistics": lambda envs: vector.RecordEpisodeStatistics(envs),
}


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
@pytest.mark.parametrize("name", WRAPPERS)
def test_vector_wrappers(name, mode):
    """Around our environment they say what they say around Gymnasium's; what one refuses, it refuses in both."""
    told = []
    for make in (native, one_by_one):
        try:
            envs = WRAPPERS[name](make(mode, 2))
        except (ValueError, AssertionError) as error:
            told.append(type(error))
            continue
        seen = [envs.reset(seed=0)[0]]
        for _ in range(6):
            observation, reward, terminated, truncated, _ = envs.step(np.zeros(2, dtype=np.int64))
            seen += [observation, reward, terminated, truncated]
        told.append(seen)
    if isinstance(told[1], type):
        assert told[0] is told[1] and (name, mode) != ("NormalizeObservation", "NextStep")
    else:
        for mine, other in zip(*told, strict=True):
            np.testing.assert_allclose(mine, other, rtol=1e-6, atol=1e-9)


def test_single_wrappers():
    """Statistics, scaling, flattening, time limits and pictures of one world."""
    env = gymnasium.make(ID, max_episode_steps=5, render_mode="rgb_array", render_width=32, render_height=24)
    env = wrappers.NormalizeReward(wrappers.NormalizeObservation(wrappers.FlattenObservation(env)))
    env = wrappers.RecordEpisodeStatistics(wrappers.TimeLimit(env, 3))
    env = wrappers.AddRenderObservation(env, render_only=False, render_key="pixels", obs_key="state")
    observation, _ = env.reset(seed=0)
    assert observation["pixels"].shape == (24, 32, 3) and env.observation_space.contains(observation)
    for _ in range(3):
        observation, _, _, truncated, info = env.step(env.action_space.sample())
    assert truncated and info["episode"]["l"] == 3


@pytest.mark.parametrize("vector_of", [False, True])
def test_record_video(tmp_path, vector_of):
    """Gymnasium's films need moviepy, which the extra ``recordvideo`` brings."""
    pytest.importorskip("moviepy")
    size = {"render_mode": "rgb_array", "render_width": 32, "render_height": 24, "max_episode_steps": 3}
    env = native(**size) if vector_of else gymnasium.make(ID, **size)
    filmed = (vector if vector_of else wrappers).RecordVideo(env, str(tmp_path), disable_logger=True)
    filmed.reset(seed=0)
    for _ in range(3):
        filmed.step(filmed.action_space.sample())
    filmed.close()
    assert {path.suffix for path in tmp_path.iterdir()} == {".mp4"}


LARGE = (
    "CatheterBeam",
    "SimpleMaze",
    "TrunkCup",
    "MultiGaitFull",
    "ConcentricTubeRobot",
)  # made elsewhere in CI, and slow to make


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in LARGE else n for n in NAMES])
def test_torchrl_makes_every_id(name):
    """``GymEnv`` asks for ``frameskip`` first, is told that there is none, and goes on without."""
    env = GymEnv(registry.spec(name).gym_id, **FAST.get(name, {}))
    check_env_specs(env)
    data = env.rollout(3)
    assert data["next", "reward"].shape == (data.shape[0], 1) and data["observation"].isfinite().all()


def test_torchrl_repeats_actions_itself():
    """A frame skip is TorchRL's business: the sub-steps of an action are ours."""
    once, twice = GymEnv(ID), GymEnv(ID, frame_skip=2)
    rewards = []
    for env, steps in ((once, 2), (twice, 1)):
        env.set_seed(0)
        data = env.rollout(steps, policy=lambda td: td.set("action", torch.tensor([1, 0])))
        rewards.append(float(data["next", "reward"].sum()))
    assert rewards[0] == pytest.approx(rewards[1])


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_torchrl_wraps_vector_environments(mode):
    """With the true last observation of episodes under ``next``; NextStep is refused by TorchRL, in words."""
    envs = native(mode, 3)
    env = GymWrapper(envs)
    check_env_specs(env, seed=0)
    data = env.rollout(14, break_when_any_done=False)
    done = data["next", "done"][..., 0]
    assert done.any() and data["next", "observation"].isfinite().all()
    apart = (data["next", "observation"][:, :-1] != data["observation"][:, 1:]).any(dim=-1)
    assert torch.equal(apart, done[:, :-1])
    with pytest.raises(RuntimeError, match="SAME_STEP or DISABLED"):
        GymWrapper(native("NextStep", 2))


@pytest.mark.slow
@pytest.mark.parametrize("how", [{"num_envs": 2}, {"num_workers": 2}])
def test_torchrl_makes_processes(how):
    """Processes that are spawned know the ids if the name says which module brings them."""
    env = GymEnv(f"softwarp:{ID}", **how)
    assert env.rollout(3).shape == (2, 3)
    env.close()


def test_gymnasium_vectorizes_single_environments():
    """With ``vector_kwargs`` and wrappers of single environments, as our own vector environment takes neither."""
    kwargs = {"autoreset_mode": AutoresetMode.SAME_STEP}
    envs = gymnasium.make_vec(ID, 2, "sync", kwargs, [wrappers.RecordEpisodeStatistics], **ALIKE)
    envs.reset(seed=0)
    for _ in range(6):
        *_, info = envs.step(np.array([0, 0]))
        if "final_info" in info:
            break
    assert 1 <= info["final_info"]["episode"]["l"][info["_final_info"]].min() <= 6


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
def test_processes_of_gymnasium_are_alike(mode):
    """AsyncVectorEnv, in processes of its own, after an environment was used in this one."""
    given = {"vectorization_mode": "async", "vector_kwargs": {"autoreset_mode": mode}}
    ours, theirs = native(mode, 2), gymnasium.make_vec(ID, 2, **given, **ALIKE)
    assert_same(ours.reset(seed=2), theirs.reset(seed=2))
    for _ in range(3):
        assert_same(ours.step(np.zeros(2, dtype=np.int64)), theirs.step(np.zeros(2, dtype=np.int64)))
    theirs.close()


def test_made_environments_tell_how_they_were_made():
    """The spec of an environment makes the same again, as ``gymnasium.make(env.spec)`` does."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(ID, max_angle=0.2)
        again = gymnasium.make(env.spec)
        envs = native("NextStep", 2)
        twins = gymnasium.make_vec(envs.spec)
    assert again.unwrapped.env.config == env.unwrapped.env.config
    assert isinstance(twins, softwarp.gym.VectorEnv)
    assert (twins.num_envs, twins.autoreset_mode) == (2, AutoresetMode.NEXT_STEP)
