"""Transitions of whole episodes, and Minari's data sets of them where Minari is installed."""

import sys

import pytest
import torch

from softwarp.policies.baselines.scripted import random
from softwarp.policies.policy import Spaces
from softwarp.training.datasets import Transitions, from_minari, record_transitions, to_minari
from softwarp.training.demonstrations import DemonstrationError, record
from tests.unit.training.reach import PointReach


def transitions(discrete=False, episodes=5, noise=0.0):
    env = PointReach(3, discrete=discrete, max_episode_steps=7)
    return record_transitions(env, random(Spaces.of(env), 3), episodes=episodes, seed=1, noise=noise)


@pytest.mark.parametrize("discrete", [False, True])
def test_rows_are_whole_episodes(discrete):
    """As many as asked for, each ends once and at its end; what follows a step is the next row's observation."""
    data = transitions(discrete)
    done = data.terminated | data.truncated
    is_last = torch.cat((data.episode[1:] != data.episode[:-1], torch.tensor([True])))
    assert data.episode.unique().tolist() == list(range(5)) and torch.equal(done, is_last)
    torch.testing.assert_close(data.after[~is_last], data.observation[1:][~is_last[:-1]])
    assert data.action.is_floating_point() != discrete and data.reward.shape == (len(data),)
    rows = data.tensordict()
    assert rows["next", "done"].shape == (len(data), 1) and rows.batch_size == (len(data),)


def test_actions_are_those_carried_out():
    """With noise, what is kept is what moved the point: in an environment where positions follow actions."""
    calm, stray = transitions(noise=0.0), transitions(noise=0.9)
    assert not torch.equal(calm.action[:5], stray.action[:5])
    again = transitions(noise=0.9)
    assert torch.equal(stray.action, again.action) and torch.equal(stray.after, again.after)


def test_demonstrations_and_back():
    """Observations, actions and outcomes survive; rewards become their sum at the end."""
    env = PointReach(3, max_episode_steps=7)
    shown = record(env, random(Spaces.of(env), 3), episodes=5, seed=1)
    as_rows = Transitions.of(shown)
    back = as_rows.demonstrations()
    for name in ("observation", "action", "episode", "success"):
        assert torch.equal(getattr(back, name), getattr(shown, name)), name
    torch.testing.assert_close(back.returns, shown.returns.float())
    torch.testing.assert_close(back.distance, shown.distance, equal_nan=True)
    assert as_rows.truncated.sum() == 5 and not as_rows.terminated.any()


def test_without_minari_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(ImportError, match=r"pip install 'softwarp\[minari\]'"):
        from_minari("softwarp/any-v0")


def test_minari_keeps_everything(tmp_path, monkeypatch):
    """What comes out is what went in, and the environment can be made again with its options."""
    minari = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    import softwarp

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    settings = {"name": "CartPole", "max_angle": 0.3, "max_episode_steps": 6}
    env = softwarp.make(**settings, num_worlds=2, seed=0)
    data = record_transitions(env, random(Spaces.of(env), 0), episodes=3, seed=0, settings=settings)
    dataset = to_minari(data, "softwarp/cart-pole/random-v0", description="pushes")
    assert dataset.total_episodes == 3 and dataset.total_steps == len(data)
    again = from_minari("softwarp/cart-pole/random-v0")
    for name, value in vars(data).items():
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(getattr(again, name), value, equal_nan=True, check_dtype=False, msg=name)
    assert again.env == settings
    made = dataset.recover_environment()
    assert made.unwrapped.env.config.max_angle == 0.3 and made.spec.max_episode_steps == 6
    episode = minari.load_dataset("softwarp/cart-pole/random-v0")[0]
    assert made.observation_space.contains(episode.observations[0]) and made.action_space.contains(episode.actions[0])
    with pytest.raises(DemonstrationError, match="does not have it here"):
        from_minari("softwarp/cart-pole/other-v0")


@pytest.mark.slow
def test_offline_example(tmp_path, monkeypatch, capsys):
    """Recorded by the command, learned from by the example."""
    pytest.importorskip("minari")
    pytest.importorskip("h5py")
    from experiments import offline_iql, record

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    name = "softwarp/stem-pendulum/scripted-v0"
    assert record.main(["env=stem_pendulum", "episodes=8", "noise=0.3"], {"out": f"minari:{name}"}) == 0
    summary = offline_iql.main([name, "--updates", "20", "--batch", "32", "--episodes", "4"])
    assert summary["episodes"] == 4.0 and "learned: return" in capsys.readouterr().out
