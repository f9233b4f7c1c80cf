"""Demonstrations and behaviour cloning on a point that moves to a goal."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torchrl.data import Bounded

from softwarp.policies.actor_critic import ActorCritic
from softwarp.policies.baselines import scripted
from softwarp.policies.policy import NetworkConfig, Spaces
from softwarp.policies.soft_actor import SoftActor
from softwarp.training.cloning import CloningConfig, clone, correct
from softwarp.training.demonstrations import DemonstrationError, Demonstrations, record
from softwarp.training.evaluation import run_episodes
from softwarp.training.ppo import PPO, PPOConfig
from tests.unit.training.reach import STEP, HiddenGoal, PointReach

MOVES = torch.tensor([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


def straight(tensordict):
    """Go straight to the goal."""
    way = tensordict["observation"][:, 2:] - tensordict["observation"][:, :2]
    return tensordict.set("action", (way / STEP).clamp(-1.0, 1.0))


def stepwise(tensordict):
    """The same with the five discrete moves."""
    way = tensordict["observation"][:, 2:] - tensordict["observation"][:, :2]
    return tensordict.set("action", ((way - STEP * MOVES[:, None]).norm(dim=-1)).argmin(dim=0))


def shown(discrete=False, episodes=60, noise=0.1):
    env = PointReach(16, discrete=discrete)
    return record(
        env, stepwise if discrete else straight, episodes=episodes, seed=4, noise=noise, settings={"name": "P"}
    )


@pytest.mark.parametrize("discrete", [False, True])
def test_what_is_recorded_is_what_the_demonstrator_would_do(discrete):
    """Whole episodes, the demonstrator's actions also where noise was carried out."""
    demos = shown(discrete, episodes=20, noise=0.3)
    from tensordict import TensorDict

    again = (stepwise if discrete else straight)(TensorDict({"observation": demos.observation}, [len(demos)]))["action"]
    assert torch.equal(demos.action, again)
    assert demos.episode.unique().tolist() == list(range(20))
    assert len(demos.returns) == len(demos.success) == 20
    for episode in range(20):  # positions follow each other; noise leaves the demonstrator's way somewhere
        x = demos.observation[demos.episode == episode]
        assert x[0, :2].abs().max() == 0.0
        assert (x[:, 2:] == x[0, 2:]).all()
    moved = demos.observation[1:, :2] - demos.observation[:-1, :2]
    within = demos.episode[1:] == demos.episode[:-1]
    meant = STEP * (MOVES[demos.action] if discrete else demos.action)[:-1]
    strays = ((moved - meant).abs().amax(-1) > 1e-5)[within].float().mean()
    assert 0.1 < strays < 0.4


def test_archive_gives_back_the_same(tmp_path):
    """Saved and loaded; other files are refused with the reason."""
    demos = shown(episodes=5)
    demos.save(tmp_path / "demos.npz")
    loaded = Demonstrations.load(tmp_path / "demos.npz")
    assert loaded.env == {"name": "P"}
    for key, value in vars(demos).items():
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(getattr(loaded, key), value, rtol=0.0, atol=0.0, equal_nan=True)
    with pytest.raises(DemonstrationError, match=r"no such file; softwarp record makes one"):
        Demonstrations.load(tmp_path / "other.npz")
    (tmp_path / "text.npz").write_text("hello")
    np.save(tmp_path / "one.npy", np.ones(3))
    for name in ("text.npz", "one.npy"):
        with pytest.raises(DemonstrationError, match="not an archive of arrays"):
            Demonstrations.load(tmp_path / name)


@pytest.mark.parametrize("policy_class", [ActorCritic, SoftActor])
@pytest.mark.parametrize("discrete", [False, True])
def test_clone_does_what_it_was_shown(policy_class, discrete):
    """The cloned policy reaches nearly every unseen goal."""
    torch.manual_seed(0)
    env = PointReach(64, seed=7, discrete=discrete)
    policy = policy_class(Spaces.of(env), NetworkConfig(hidden=[64, 64]))
    fit = clone(policy, shown(discrete), CloningConfig(epochs=100, batch=64))
    assert fit["loss"] <= fit["held_out"] * 1.5
    assert run_episodes(env, policy, seed=7).summary()["success"] > 0.9


def test_clone_is_the_best_fit_of_what_it_did_not_learn():
    """Of two episodes one is learned and sets the scale, the other one judges: the policy is that of the best epoch.

    With steps much too long every epoch overshoots, and the last one is not the best.
    """
    torch.manual_seed(0)
    two = shown(episodes=2)
    policy = ActorCritic(Spaces.of(PointReach(16)), NetworkConfig(hidden=[16]))
    fit = clone(policy, two, CloningConfig(epochs=12, patience=12, held_out=0.5, learning_rate=0.3))

    def loss(episode):
        chosen = two.episode == episode
        features = policy.observation_norm(two.observation[chosen])
        error = policy.most_likely(policy.head(features)) - policy.to_sample(two.action[chosen])
        return float(error.square().sum(-1).mean())

    judged = min((0, 1), key=lambda episode: abs(loss(episode) - fit["held_out"]))
    learned = two.episode == 1 - judged
    assert loss(judged) == pytest.approx(fit["held_out"], rel=1e-4)
    assert loss(1 - judged) == pytest.approx(fit["loss"], rel=1e-4)
    assert policy.observation_norm.count == learned.sum()
    torch.testing.assert_close(policy.observation_norm.mean.float(), two.observation[learned].mean(0))


def test_ppo_goes_on_from_a_clone():
    """With warm-up updates the cloned policy is kept while the critic is fitted, and is not worse afterwards."""
    torch.manual_seed(0)
    config = PPOConfig(horizon=16, warmup_updates=4, learning_rate=5e-4)
    ppo = PPO(PointReach(64), NetworkConfig(hidden=[64, 64], initial_std=0.2), config)
    clone(ppo.policy, shown(), CloningConfig(epochs=60, batch=64))
    actor = [parameter.clone() for parameter in ppo.policy.actor.parameters()]
    observation = torch.rand(100, 4) - 0.5
    actions = ppo.policy.act(observation)
    for _ in range(4):
        before = ppo.update(0.0)
    assert torch.equal(ppo.policy.act(observation), actions)  # the scale of observations stays as well
    assert all(torch.equal(old, new) for old, new in zip(actor, ppo.policy.actor.parameters(), strict=True))
    assert before["explained_variance"] > 0.5
    for _ in range(4):
        ppo.update(0.0)
    assert not torch.equal(actor[0], next(ppo.policy.actor.parameters()))
    assert run_episodes(PointReach(64, seed=7), ppo.policy, seed=7).summary()["success"] > 0.8


def shown_once(discrete=False, terminate=True):
    """Demonstrations by one who knows the goal, for a learner who sees it at the first step only."""
    env = HiddenGoal(60, seed=1, discrete=discrete, terminate=terminate)

    def knowing(tensordict):
        way = env.goal - tensordict["observation"][:, :2]
        away = (way - STEP * MOVES[:, None]).norm(dim=-1)
        return tensordict.set("action", away.argmin(dim=0) if discrete else (way / STEP).clamp(-1.0, 1.0))

    return record(env, knowing, episodes=180, seed=4, noise=0.1)


@pytest.mark.parametrize(("discrete", "is_shared"), [pytest.param(False, True, marks=pytest.mark.slow), (True, False)])
def test_a_memory_is_cloned_from_whole_episodes(discrete, is_shared):
    """It takes the goal of the first step along; without a memory, nobody can know where to stop."""
    demos, success = shown_once(discrete, terminate=False), {}
    for units in (24, 0):
        torch.manual_seed(0)
        env = HiddenGoal(64, seed=7, discrete=discrete, terminate=False)
        policy = ActorCritic(Spaces.of(env), NetworkConfig(hidden=[64], recurrent=units, shared=is_shared))
        clone(policy, demos, CloningConfig(epochs=120, batch=256, learning_rate=5e-3))
        success[units] = run_episodes(env, policy, seed=7).summary()["success"]
    assert success[24] > 0.7, success
    assert success[0] < 0.4, success


def test_episodes_of_different_length_are_fitted_as_they_are_lived():
    """The loss told is that of a policy that is shown the episodes step by step, from an empty memory each."""
    torch.manual_seed(0)
    demos = shown_once()
    lengths = demos.episode.bincount()
    assert lengths.min() < lengths.max()
    policy = ActorCritic(Spaces.of(PointReach(2)), NetworkConfig(hidden=[8], recurrent=4, shared=True))
    fit = clone(policy, demos, CloningConfig(epochs=2, batch=64, held_out=0.5))
    sums = []
    for episode in demos.episode.unique():
        chosen, memory, total = demos.episode == episode, None, 0.0
        for seen, action in zip(demos.observation[chosen], demos.action[chosen], strict=True):
            features, memory = policy.features(seen[None], memory)
            error = policy.most_likely(policy.head(features)) - policy.to_sample(action)
            total += float(error.detach().square().sum())
        sums.append((total, int(chosen.sum())))
    total, steps = np.array(sums).sum(axis=0)
    learned = float(policy.observation_norm.count)
    assert fit["loss"] * learned + fit["held_out"] * (steps - learned) == pytest.approx(total, rel=1e-4)


@pytest.mark.parametrize("network", [{"shared": True}, {"recurrent": 8}, {"recurrent": 8, "shared": True}])
def test_what_actor_and_critic_have_in_common_stands_still_in_the_warm_up(network):
    """The critic is fitted, the policy does what it did; afterwards both learn, and with them what they share."""
    torch.manual_seed(0)
    ppo = PPO(PointReach(32), NetworkConfig(hidden=[32], **network), PPOConfig(horizon=16, warmup_updates=2))
    clone(ppo.policy, shown(episodes=8), CloningConfig(epochs=2))
    kept = {name: value.clone() for name, value in ppo.policy.named_parameters()}

    def changed():
        now = ppo.policy.named_parameters()
        return {name.split(".")[0] for name, value in now if not torch.equal(value, kept[name])}

    for _ in range(2):
        ppo.update(0.0)
    assert changed() == {"critic"}
    ppo.update(0.0)
    common = {"recurrent": "memory", "shared": "shared"}
    assert changed() == {"actor", "critic", *(common[name] for name in network)}


def test_what_does_not_fit_is_refused():
    """Other spaces, too few episodes, bad settings."""
    spaces = Spaces.of(PointReach(2, discrete=True))
    with pytest.raises(DemonstrationError, match="actions that are vectors do not fit"):
        clone(ActorCritic(spaces, NetworkConfig()), shown(episodes=2), CloningConfig())
    spaces = Spaces.of(PointReach(2))
    with pytest.raises(ValueError, match="at least 2 episodes"):
        clone(ActorCritic(spaces, NetworkConfig()), shown(episodes=1), CloningConfig())
    with pytest.raises(ValueError, match=r"cloning\.held_out: must lie in \(0, 1\), got 1"):
        CloningConfig(held_out=1.0)


class Line(PointReach):
    """One action, along x; keeps what was carried out."""

    def __init__(self, num_worlds):
        super().__init__(num_worlds, terminate=False)
        self.action_spec = Bounded(-1.0, 1.0, (num_worlds, 1))
        self.taken = []

    def _step(self, tensordict):
        self.taken.append(tensordict["action"].clone())
        sideways = torch.zeros_like(tensordict["action"])
        return super()._step(tensordict.clone().set("action", torch.cat((tensordict["action"], sideways), dim=-1)))


def test_stray_actions_are_drawn_apart_from_when_they_are_taken():
    """A tenth of the actions strays, to either side alike: 2000 steps, uniform numbers to 4 standard errors."""
    env = Line(100)
    recorded = record(env, scripted.nothing(Spaces.of(env)), episodes=100, seed=3, noise=0.1)
    assert not recorded.action.any()  # what the demonstrator would do is kept
    taken = torch.cat(env.taken).flatten()
    strays = taken[taken != 0.0]
    assert len(strays) / len(taken) == pytest.approx(0.1, abs=4.0 * (0.09 / len(taken)) ** 0.5)
    assert abs(float(strays.mean())) < 4.0 * (1.0 / 3.0 / len(strays)) ** 0.5
    assert float(strays.min()) < -0.9 and float(strays.max()) > 0.9


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"env": None}, "do not tell of which environment"),
        ({"env": np.array("[1]")}, "do not tell of which environment"),
        ({"env": np.array("{")}, "do not tell of which environment"),
        ({"action": None}, "they lack action"),
        ({"more": np.zeros(3)}, "they hold besides more"),
        ({"observation": "nan"}, "observation is not finite in row 2"),
        ({"returns": "nan"}, "returns is not finite in row 2"),
        ({"episode": np.zeros(3, dtype=np.int64)}, "episode must be numbers with"),
        ({"action": np.zeros((2, 2, 2))}, "action must be numbers with"),
        ({"observation": np.array("a")}, "observation must be numbers with|action must be numbers with"),
    ],
)
def test_archives_that_lack_something_are_refused(change, message, tmp_path):
    """What an archive must hold is checked when it is read, not by the first update that meets it."""
    shown(episodes=4).save(tmp_path / "good.npz")
    with np.load(tmp_path / "good.npz") as archive:
        arrays = {key: archive[key] for key in archive.files}
    for key, value in change.items():
        if value is None:
            del arrays[key]
        elif isinstance(value, str):
            arrays[key][2] = np.nan
        else:
            arrays[key] = value
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(DemonstrationError, match=message):
        Demonstrations.load(tmp_path / "bad.npz")


def bent(tensordict):
    """Go to the goal along one axis and then along the other: where it turns is seen nowhere but on its way."""
    way = tensordict["observation"][:, 2:] - tensordict["observation"][:, :2]
    first = way[:, :1].abs() > 0.5 * STEP
    wish = torch.cat([way[:, :1], torch.where(first, 0.0, way[:, 1:])], dim=-1)
    return tensordict.set("action", (wish / STEP).clamp(-1.0, 1.0))


def test_a_clone_that_is_corrected_where_it_gets_succeeds_more_often():
    """Few demonstrations without noise, then rounds in which the clone acts and is told better."""
    config = CloningConfig(rounds=4, epochs=40, patience=40, batch=64)
    fits, policies = [], []
    for rounds in (0, 4):
        torch.manual_seed(5)
        env = PointReach(16, seed=7)
        policy = ActorCritic(Spaces.of(env), NetworkConfig(hidden=[32, 32]))
        fits.append(list(correct(policy, None, env, bent, replace(config, rounds=rounds), seed=11)))
        policies.append(policy)
    assert [len(told) for told in fits] == [1, 5]
    assert fits[1][0]["success"] == 1.0  # the demonstrator's own
    assert fits[0][0]["loss"] == fits[1][0]["loss"]  # the same before the first round
    goals = PointReach(256, seed=99)
    plain, corrected = (float(run_episodes(goals, each, seed=3).success.float().mean()) for each in policies)
    assert corrected > plain + 0.1
    assert corrected > 0.9


def test_rounds_end_at_the_time_limit_and_keep_to_their_window(monkeypatch):
    """No round begins after the limit; of old rounds the demonstrations stay."""
    from softwarp.training import cloning

    counts = []
    monkeypatch.setattr(cloning, "clone", lambda policy, shown, *_: counts.append(len(shown.returns)) or {})
    env = PointReach(4)
    policy = ActorCritic(Spaces.of(env), NetworkConfig(hidden=[8]))
    config = CloningConfig(rounds=4, window=2)
    assert len(list(correct(policy, None, env, straight, config, seed=0))) == 5
    assert counts == [4, 8, 12, 12, 12]
    assert len(list(correct(policy, None, env, straight, config, seed=0, limit=0.0))) == 1
