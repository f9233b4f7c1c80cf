"""Rollouts: rows follow each other, finished worlds are reset, the last observation of an episode is kept."""

import re

import pytest
import torch

from softwarp.model import memory
from softwarp.policies.actor_critic import ActorCritic
from softwarp.policies.policy import NetworkConfig, Spaces
from softwarp.training.rollout import Rollout
from tests.unit.envs.fake import PointConfig, PointEnv
from tests.unit.training.reach import STEP, PointReach


def make(env, horizon, **options):
    torch.manual_seed(0)
    return Rollout(env, ActorCritic(Spaces.of(env), NetworkConfig(hidden=[8])), horizon, **options)


def test_rollout_that_does_not_fit_is_refused(monkeypatch):
    """Before it is allocated, with the horizon that fits."""
    monkeypatch.setattr(memory, "free_bytes", lambda device: 2**20)
    with pytest.raises(
        MemoryError, match=r"a rollout needs .* for 1000000000 steps of every world, 1 MiB are free"
    ) as e:
        make(PointReach(5), 10**9)
    fitting = int(re.search(r"(\d+) steps", str(e.value).split(";")[1])[1])
    rollout = make(PointReach(5), fitting)
    held = [*rollout.buffer.values(True, True), rollout._returns, rollout._ended, rollout._ends]
    assert 0.95 * 2**20 < sum(part.nbytes for part in held) <= 2**20


def test_rows_are_the_steps_of_the_environment():
    """The next position is the position plus the clipped action; the next row starts there while the episode lasts."""
    batch = make(PointReach(5, max_episode_steps=4, terminate=False), 12, stagger=False).collect()
    assert batch.shape == (5, 12)
    position, after = batch["observation"][..., :2], batch["next", "observation"][..., :2]
    torch.testing.assert_close(after, position + STEP * batch["action"].clamp(-1.0, 1.0))
    done = batch["next", "done"][..., 0]
    assert done.sum() == 5 * 3
    torch.testing.assert_close(position[:, 1:][~done[:, :-1]], after[:, :-1][~done[:, :-1]])


def test_last_observation_is_not_the_one_after_the_reset():
    """At the end of an episode the next observation is where the point was; the next row starts at the origin."""
    batch = make(PointReach(5, max_episode_steps=3, terminate=False), 7, stagger=False).collect()
    ends = batch["next", "done"][:, :-1, 0]
    assert ends.any()
    assert batch["next", "observation"][:, :-1][ends][:, :2].abs().amax(-1).min() > 0.0
    assert batch["observation"][:, 1:][ends][:, :2].abs().max() == 0.0


def test_truncated_is_not_terminated():
    """Steps that run out end an episode without terminating it."""
    batch = make(PointReach(5, max_episode_steps=3, terminate=False), 6, stagger=False).collect()
    assert batch["next", "done"].any()
    assert not batch["next", "terminated"].any()


def test_stagger_spreads_first_resets_only():
    """Staggered worlds end at different steps once, then last as long as all; cut episodes are not counted."""
    env = PointReach(32, max_episode_steps=10, terminate=False)
    rollout = make(env, 10)
    first = rollout.collect()["next", "done"][..., 0].clone()
    ends = [torch.nonzero(row).flatten().tolist() for row in first]
    assert len({row[0] for row in ends}) > 3
    second = rollout.collect()["next", "done"][..., 0]
    assert (second.sum(-1) == 1).all()
    assert all(length == 10.0 for _, length, *_ in rollout.episodes)
    assert rollout.steps == 2 * 10 * 32


def test_statistics_are_those_of_the_episodes():
    """Return and length are sums over an episode, distance its last one; the second episode starts from nothing.

    So does the sum of discounted rewards, G = r + gamma G, whose spread scales rewards.
    """
    env = PointReach(1, max_episode_steps=4, terminate=False)
    rollout = make(env, 8, stagger=False)
    reward = rollout.collect()["next", "reward"].flatten()
    told = rollout.statistics()
    first, second = reward[:4].sum(), reward[4:].sum()
    assert not torch.isclose(first, second)
    assert [episode[0] for episode in rollout.episodes] == pytest.approx([float(first), float(second)], abs=1e-5)
    assert told["length"] == 4.0
    assert told["return"] == pytest.approx(float(first + second) / 2.0, abs=1e-5)
    assert told["distance"] == pytest.approx(float(-reward[[3, 7]].mean()) / 10.0, abs=1e-6)
    discounted, sums = 0.0, []
    for step, r in enumerate(reward.tolist()):
        discounted = r + rollout.gamma * (discounted if step % 4 else 0.0)
        sums.append(discounted)
    assert float(rollout.return_norm.mean) == pytest.approx(sum(sums) / 8.0, rel=1e-5)


def test_log_probability_is_of_the_stored_action():
    """Under the policy that acted, the ratio of probabilities is 1."""
    for discrete in (False, True):
        rollout = make(PointReach(4, discrete=discrete), 5)
        batch = rollout.collect()
        again = rollout.policy.distribution(batch["observation"]).log_prob(batch["action"])
        torch.testing.assert_close(again, batch["action_log_prob"])


def test_captured_steps_resume_from_a_file_with_the_same_bits(tmp_path):
    """Staggered rollouts of captured and launched steps are equal; both go on from a file as if nothing had been."""
    batches, episodes = [], []
    for captured in (True, False):
        env = PointEnv(PointConfig(max_episode_steps=6), num_worlds=8, seed=3)
        env.captures.are_on = captured
        rollout = make(env, 7)
        parts = [rollout.collect().clone()]
        torch.save(rollout.state_dict(), tmp_path / "rollout.pt")
        torch.manual_seed(1)
        parts.append(rollout.collect().clone())
        rollout.load_state_dict(torch.load(tmp_path / "rollout.pt", weights_only=True))
        torch.manual_seed(1)
        again = rollout.collect()
        assert all(torch.equal(again[key], parts[1][key]) for key in again.keys(True, True))
        batches.append(parts)
        episodes.append(list(rollout.episodes))
    assert episodes[0] == episodes[1] and episodes[0]
    for one, two in zip(*batches, strict=True):
        assert all(torch.equal(one[key], two[key]) for key in one.keys(True, True))


def test_a_refused_action_is_an_error_of_the_rollout():
    """It ends with the error that names the world, although no step of it has waited."""
    env = PointEnv(PointConfig(), num_worlds=3)
    env.captures.are_on = True
    rollout = make(env, 4)

    def explore(features):
        sample = rollout.policy.explore(features)
        sample["action"][1] = torch.nan
        return sample

    with pytest.raises(ValueError, match="PointEnv: every action must be finite; world 1 got something else"):
        rollout.collect(explore)
