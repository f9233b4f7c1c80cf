"""Policies are chosen and judged on goals that training does not see, and judged by other draws than chosen by."""

import pytest

from experiments import eval as evaluation
from experiments import train
from experiments.config import TrainConfig, compose
from experiments.verbs import EvalConfig, ExportConfig, PolicyEvalConfig, RecordConfig, RenderConfig
from softwarp.envs import registry
from softwarp.policies.baselines.table import RULES
from softwarp.training.loop import RunConfig
from tests.unit.training.reach import PointReach

SMALL = ["total_steps=64", "evaluations=1", "evaluation_episodes=4", "num_worlds=4", "logger=quiet"]
SMALL += ["algo.horizon=8", "algo.epochs=1", "network.hidden=[8]", "seed=5"]


class Watched(PointReach):
    """A point in place of the environment that was asked for; keeps how it was asked for and the seeds it was given."""

    def __init__(self, num_worlds, asked):
        super().__init__(num_worlds)
        self.asked, self.seeds = asked, []

    def _set_seed(self, seed):
        super()._set_seed(seed)
        self.seeds.append(seed)


@pytest.fixture
def made(monkeypatch):
    """Environments in the order in which the verbs make them."""
    environments = []

    def make(name, *, num_worlds, device, seed, config):
        environments.append(Watched(num_worlds, {"name": name, "seed": seed, "config": config}))
        return environments[-1]

    monkeypatch.setattr(registry, "make", make)
    return environments


def still(env):
    """A policy that does nothing."""
    return lambda tensordict: tensordict.set("action", env.action_spec.zero())


def splits(made):
    return [env.asked["config"].goal_split for env in made]


def test_goals_of_training_and_judging_are_apart(made, tmp_path, monkeypatch, capsys):
    """Training on its split with its seed; its evaluations, and ``eval``, on the other with seeds of their own."""
    folder = tmp_path / "run"
    train.run(compose("train", TrainConfig, ["env=trunk", *SMALL, f"out={folder}"]))
    assert splits(made) == ["train", "eval"]
    training, chosen = made
    assert training.asked["seed"] == 5
    assert set(chosen.seeds) == {RunConfig().evaluation_seed}

    made.clear()
    monkeypatch.setitem(RULES, "Trunk", {"scripted": still})
    assert evaluation.main(["episodes=4"], {"run": str(folder), "baselines": True}) == 0
    assert splits(made) == ["eval"] * 4  # trained, nothing, random, scripted
    assert {seed for env in made for seed in env.seeds} == {EvalConfig().seed}
    assert "trained" in capsys.readouterr().out


def test_policies_without_training_are_judged_on_the_same_goals(made, monkeypatch, capsys):
    """``eval env=... policy=...``: the split and the seed of ``eval RUN``."""
    monkeypatch.setattr(evaluation, "demonstrator", lambda env, name, policy: still(env))
    assert evaluation.main(["env=trunk", "policy=scripted", "episodes=4"], {}) == 0
    assert splits(made) == ["eval"]
    assert set(made[0].seeds) == {EvalConfig().seed}


def test_seeds_are_apart():
    """The best checkpoint is chosen by draws that neither training, nor judging, nor demonstrations use."""
    judged = EvalConfig().seed
    assert PolicyEvalConfig(env={}).seed == RenderConfig().seed == ExportConfig().seed == judged
    seeds = [TrainConfig(env={}, algo={}).seed, RunConfig().evaluation_seed, judged, RecordConfig(env={}).seed]
    assert len(set(seeds)) == len(seeds)
    assert min(abs(a - b) for a in seeds for b in seeds if a != b) > 100_000  # room for the seeds of runs, 0, 1, ...
