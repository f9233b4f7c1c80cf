"""Evaluation counts each world's first episode and nothing after it."""

import pytest
import torch
from torchrl.data import Unbounded

from softwarp.policies.actor_critic import ActorCritic
from softwarp.policies.baselines import scripted
from softwarp.policies.policy import NetworkConfig, Spaces
from softwarp.training.evaluation import Episodes, run_episodes, score
from tests.unit.training.reach import STEP, PointReach


def straight(tensordict):
    """Go straight to the goal."""
    position, goal = tensordict["observation"].split(2, dim=-1)
    return tensordict.set("action", ((goal - position) / STEP).clamp(-1.0, 1.0))


def test_straight_policy_reaches_every_goal():
    """It ends within the tolerance in as many steps as the longer coordinate needs."""
    env = PointReach(32)
    episodes = run_episodes(env, straight, seed=3)
    assert episodes.count == 32
    assert episodes.success.all()
    assert (episodes.distance < 0.03).all()
    assert episodes.lengths.max() <= 4
    assert episodes.summary()["failed"] == episodes.summary()["lost"] == 0.0


class Dropping(PointReach):
    """Worlds 1 and 2 drop what they hold in their second step; 2 is at its goal then, which is no loss."""

    def _step(self, tensordict):
        after = super()._step(tensordict)
        dropped = torch.tensor([False, True, True, False])[:, None] & (self.steps == 2)[:, None]
        after["success"] = after["success"] | dropped & torch.tensor([False, False, True, False])[:, None]
        after["terminated"], after["done"] = after["terminated"] | dropped, after["done"] | dropped
        return after


def test_what_ends_without_success_is_lost():
    """Of four episodes one is dropped, one dropped at the goal, two last until their time is over."""
    env = Dropping(4, max_episode_steps=3, terminate=False)
    episodes = run_episodes(env, scripted.nothing(Spaces.of(env)), seed=3)
    assert episodes.lost.tolist() == [False, True, False, False]
    assert episodes.lengths.tolist() == [3, 2, 2, 3]
    assert episodes.summary()["lost"] == 0.25


def test_what_comes_after_an_end_does_not_count():
    """Worlds end after one to four steps and go on with new goals: returns and last distances, by walking there."""
    env = PointReach(32)
    env.set_seed(3)
    goal = env.reset()["observation"][:, 2:]
    episodes = run_episodes(env, straight, seed=3)
    assert len(set(episodes.lengths.tolist())) > 2
    for world in range(32):
        place, told = torch.zeros(2), []
        while not told or told[-1] >= 0.03:
            place = place + (goal[world] - place).clamp(-STEP, STEP)
            told.append(float((goal[world] - place).norm()))
        assert int(episodes.lengths[world]) == len(told)
        assert float(episodes.returns[world]) == pytest.approx(-10.0 * sum(told), abs=1e-5)
        assert float(episodes.distance[world]) == pytest.approx(told[-1], abs=1e-6)


class Failing(PointReach):
    """World 1 fails in its first step, world 2 in its second episode; both tell so until they are reset."""

    def __init__(self, num_worlds):
        super().__init__(num_worlds, max_episode_steps=3, terminate=False)
        self.observation_spec["world_status"] = Unbounded((num_worlds, 1), dtype=torch.int32)
        self.episode = torch.zeros(num_worlds)

    def _observe(self):
        failed = torch.tensor([False, True, False, False]) & (self.steps == 1)
        failed |= torch.tensor([False, False, True, False]) & (self.episode == 2)
        return super()._observe() | {"world_status": 3 * failed.to(torch.int32)[:, None]}

    def _reset(self, tensordict=None, **options):
        mask = torch.ones(4, dtype=torch.bool) if tensordict is None else tensordict["_reset"].flatten()
        self.episode += mask
        return super()._reset(tensordict, **options)

    def _step(self, tensordict):
        data = super()._step(tensordict)
        data["terminated"] = data["world_status"] > 0
        data["done"] = (
            data["terminated"] | data["truncated"] | (torch.arange(4)[:, None] == 2) & (self.steps == 1)[:, None]
        )
        return data


def test_failures_of_later_episodes_do_not_count():
    """World 1 fails in the episode that counts; world 2, whose episode was over, in the one after it."""
    env = Failing(4)
    episodes = run_episodes(env, scripted.nothing(Spaces.of(env)), seed=3)
    assert episodes.failed.tolist() == [False, True, False, False]
    assert episodes.lengths.tolist() == [3, 1, 1, 3]


def test_standing_still_returns_minus_the_distance():
    """Return = -10 distance * steps, exactly, for a point that never moves."""
    env = PointReach(16, max_episode_steps=6, terminate=False)
    episodes = run_episodes(env, scripted.nothing(Spaces.of(env)), seed=3)
    torch.testing.assert_close(episodes.returns, -60.0 * episodes.distance)
    assert (episodes.lengths == 6).all()


def test_median_of_an_even_number_lies_between_the_quartiles():
    """Of 1, 2, 4 and 9 mm: (2 + 4) / 2, not the lower one of the middle two."""
    distance = torch.tensor([0.009, 0.001, 0.004, 0.002])
    no = torch.zeros(4, dtype=torch.bool)
    told = Episodes(torch.zeros(4), torch.ones(4), no, distance, no, no, distance).summary()
    assert abs(told["distance"] - 0.003) < 1e-8
    assert told["distance_p25"] < told["distance"] < told["distance_p75"]


class Pressing(PointReach):
    """World k presses a wall with k + 1 N in its second step, with nothing in others."""

    def __init__(self, num_worlds):
        super().__init__(num_worlds, max_episode_steps=3, terminate=False)
        self.peak = torch.zeros(num_worlds)
        self.observation_spec["wall_force"] = Unbounded((num_worlds, 2))

    def _observe(self):
        now = (self.steps == 2) * torch.arange(1.0, 1.0 + len(self.peak))
        self.peak = torch.where(self.steps == 0, now, torch.maximum(self.peak, now))
        return super()._observe() | {"wall_force": torch.stack((now, self.peak), dim=1)}


def test_force_is_the_largest_of_an_episode():
    """Told where the environment tells forces on a wall, median and worst; else left out."""
    env = Pressing(4)
    episodes = run_episodes(env, scripted.nothing(Spaces.of(env)), seed=3)
    assert episodes.force.tolist() == [1.0, 2.0, 3.0, 4.0]
    assert {key: episodes.summary()[key] for key in ("force", "force_max")} == {"force": 2.5, "force_max": 4.0}
    assert "force" not in run_episodes(PointReach(4), straight, seed=3).summary()


def test_same_seed_same_goals():
    """Policies are compared on the same starts; more episodes than worlds begin with the same ones."""
    env = PointReach(8)
    first = run_episodes(env, straight, seed=3)
    again = run_episodes(env, straight, seed=3, episodes=20)
    assert torch.equal(first.returns, again.returns[:8])
    assert again.count == 20
    assert not torch.equal(first.returns, run_episodes(env, straight, seed=4).returns)


class Watched(PointReach):
    """Keeps the goals with which whole batches begin."""

    def __init__(self, num_worlds):
        super().__init__(num_worlds)
        self.begun = []

    def _reset(self, tensordict=None, **options):
        data = super()._reset(tensordict, **options)
        if tensordict is None or "_reset" not in tensordict:
            self.begun.append(self.goal.clone())
        return data


def test_every_batch_starts_alike_for_every_policy():
    """Policies that come to their goals, and are reset often, meet the same ones later as those that never do.

    A batch of standing still takes two resets, one before it and one after its last step; before batch k there are 2 k.
    """
    env = Watched(4)
    run_episodes(env, scripted.nothing(Spaces.of(env)), seed=3, episodes=12)
    patient, env.begun = env.begun, []
    run_episodes(env, straight, seed=3, episodes=12)
    assert len(patient) == 1 + 3 + 5
    assert all(torch.equal(one, other) for one, other in zip(patient, env.begun, strict=True))
    env.set_seed(3)
    stayed = [env.rollout(21, scripted.nothing(Spaces.of(env)), break_when_any_done=False) for _ in range(3)]
    for batch, first in zip((0, 3, 8), (0, 1, 2), strict=True):
        assert torch.equal(patient[batch], stayed[first]["observation"][:, 0, 2:])


def test_random_stream_of_training_is_untouched():
    """Evaluating draws nothing from Torch's generator."""
    env = PointReach(8)
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    run_episodes(env, lambda td: td.set("action", torch.rand(8, 2)), seed=3)
    assert torch.equal(torch.rand(3), expected)


def test_score_prefers_success_then_small_distances():
    """Success decides, then distance; without distances the return."""
    assert score({"distance": 0.02, "success": 0.6, "return": 0.0}) > score({"distance": 0.01, "success": 0.5})
    assert score({"distance": 0.01, "success": 0.5, "return": 0.0}) > score({"distance": 0.02, "success": 0.5})
    assert score({"return": 2.0}) > score({"return": 1.0})


def test_stochastic_evaluation_draws_and_repeats():
    """Drawn actions differ from the most likely ones, and are the same again for the same seed; those need none."""
    env = PointReach(8, terminate=False)
    torch.manual_seed(0)
    policy = ActorCritic(Spaces.of(env), NetworkConfig(hidden=[8], initial_std=1.0))
    sure, drawn, again = (run_episodes(env, policy, seed=3, deterministic=kind) for kind in (True, False, False))
    assert torch.equal(drawn.returns, again.returns)
    assert not torch.equal(drawn.returns, sure.returns)

    def likely(tensordict):
        return tensordict.set("action", policy.act(tensordict["observation"]))

    assert torch.equal(sure.returns, run_episodes(env, likely, seed=3).returns)
