"""The training loop: logs, checkpoints, best policy, stop on signal."""

import math
import os
import signal
import threading
import time

import pytest
import torch

from softwarp import compiling
from softwarp.policies.policy import NetworkConfig
from softwarp.training import logs
from softwarp.training.checkpoints import CheckpointError, CheckpointFolder, build_policy, load, load_policy
from softwarp.training.curve import draw_learning_curve
from softwarp.training.evaluation import Episodes, run_episodes, score
from softwarp.training.logs import LoggerConfig, read_csv
from softwarp.training.loop import RunConfig, StopSignals, train
from softwarp.training.ppo import PPO, PPOConfig
from tests.unit.training.conftest import QUIET
from tests.unit.training.reach import PointReach


def test_run_leaves_what_it_promises(start_run, tmp_path):
    """Tables, checkpoints, best policy and a picture; the run ends at its budget."""
    algorithm, outcome = start_run(2000, keep_checkpoints=2)
    assert outcome.signal is None
    assert outcome.counters.steps >= 2000
    rows = read_csv(tmp_path / "progress.csv")
    assert [row["update"] for row in rows] == list(range(1, len(rows) + 1))
    assert rows[-1]["steps"] == outcome.counters.steps == algorithm.rollout.steps
    assert len(read_csv(tmp_path / "evaluation.csv")) == 2
    assert len(list((tmp_path / "checkpoints").iterdir())) == 2
    best = load(tmp_path / "best.pt")
    largest = max(score(row) for row in read_csv(tmp_path / "evaluation.csv"))
    assert score(best["evaluation"]) == pytest.approx(largest, rel=1e-8)
    build_policy(load_policy(tmp_path))
    draw_learning_curve(tmp_path, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")


def test_best_policy_is_that_of_the_best_evaluation(tmp_path):
    """Success in 1, 3 and 2 of 4 episodes: the policy of the second evaluation is kept, not the last one."""
    torch.manual_seed(0)
    ppo = PPO(PointReach(8), NetworkConfig(hidden=[8]), PPOConfig(horizon=8, epochs=1))
    seen = []

    def evaluate(policy):
        seen.append({key: value.clone() for key, value in policy.state_dict().items()})
        success = torch.arange(4) < (1, 3, 2)[len(seen) - 1]
        none = torch.zeros(4)
        return Episodes(none, torch.ones(4), success, none, none.bool(), none.bool(), none)

    train(ppo, evaluate, tmp_path, RunConfig(total_steps=64 * 4, evaluations=3), logger=QUIET, settings={})
    best = load(tmp_path / "best.pt")
    assert len(seen) == 3
    assert best["evaluation"]["success"] == 0.75
    assert all(torch.equal(value, seen[1][key]) for key, value in best["policy"].items())
    assert not all(torch.equal(value, seen[2][key]) for key, value in best["policy"].items())


def test_untrained_policy_can_be_evaluated_too(start_run, tmp_path):
    """With ``evaluate_start`` the first row is that of step 0; a resumed run does not repeat it."""
    start_run(500, evaluate_start=True)
    resume = CheckpointFolder(tmp_path / "checkpoints", keep=1).load_latest()
    start_run(1000, evaluate_start=True, resume=resume)
    steps = [row["steps"] for row in read_csv(tmp_path / "evaluation.csv")]
    assert steps[0] == 0
    assert steps.count(0) == 1
    assert steps == sorted(set(steps))


def test_signal_saves_and_ends(start_run, tmp_path, monkeypatch):
    """SIGTERM in the middle of a long run: the run ends there and is saved, and the handler is put back."""
    previous = signal.getsignal(signal.SIGTERM)
    timer = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGTERM))
    update = PPO.update

    def start_timer_and_update(self, progress):
        if timer.ident is None:
            timer.start()
        return update(self, progress)

    monkeypatch.setattr(PPO, "update", start_timer_and_update)
    start = time.monotonic()
    _, outcome = start_run(10**9, checkpoint_seconds=1e9)
    assert time.monotonic() - start < 20.0
    assert outcome.signal == signal.SIGTERM
    saved = CheckpointFolder(tmp_path / "checkpoints", keep=1).load_latest()
    assert saved["counters"]["update"] == outcome.counters.update > 0
    assert signal.getsignal(signal.SIGTERM) is previous


class SlowReach(PointReach):
    """Its step takes long, as that of a large scene does."""

    def _step(self, tensordict):
        time.sleep(0.2)
        return super()._step(tensordict)


def train_slowly(folder, **config):
    """A run whose rollout of 100 steps takes 20 s."""
    torch.manual_seed(0)
    ppo = PPO(SlowReach(4), NetworkConfig(hidden=[8]), PPOConfig(horizon=100))
    held_out = SlowReach(4, seed=99)
    budget = RunConfig(**({"total_steps": 10**9, "evaluations": 1} | config))
    start = time.monotonic()
    told = LoggerConfig(tensorboard=False, picture=False)
    outcome = train(
        ppo, lambda policy: run_episodes(held_out, policy, seed=5), folder, budget, logger=told, settings={}
    )
    return ppo, outcome, time.monotonic() - start


def test_time_limit_is_looked_at_within_a_rollout(tmp_path, capfd, monkeypatch):
    """It ends in the middle, and the evaluation that has no time is left out; progress was told meanwhile."""
    monkeypatch.setattr(logs, "LINE_SECONDS", 0.0)
    ppo, outcome, seconds = train_slowly(tmp_path, time_limit=1.5)
    assert 1.5 <= seconds < 10.0
    assert outcome.counters.update == 0
    assert outcome.evaluation == {}
    assert 0 < ppo.rollout.taken < 100
    lines = capfd.readouterr().err.splitlines()
    assert lines[0].split("  ")[1:2] == ["4 steps"]
    assert len({line.partition("steps")[0] for line in lines}) > 2
    assert "the last evaluation does not fit into the time limit" in lines[-1]
    saved = CheckpointFolder(tmp_path / "checkpoints", keep=1).load_latest()
    assert len(saved["rollout"]["begun"]["returns"]) == ppo.rollout.taken


def test_signal_is_looked_at_within_a_rollout(tmp_path, capfd):
    """That it was heard is told at once."""
    timer = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    ppo, outcome, seconds = train_slowly(tmp_path)
    assert seconds < 10.0
    assert outcome.signal == signal.SIGINT
    assert 0 < ppo.rollout.taken < 100
    assert "stopping after this step" in capfd.readouterr().err


def test_compiling_does_not_count_as_training(start_run, monkeypatch):
    """A run whose kernels are compiled first has as much time to learn as one that finds them in the cache."""
    start = time.monotonic()
    monkeypatch.setattr(compiling, "spent", lambda: 0.9 * (time.monotonic() - start))
    _, outcome = start_run(10**9, time_limit=0.2, evaluations=0)
    assert 0.2 <= outcome.counters.seconds < 1.0
    assert time.monotonic() - start >= 2.0


def test_second_signal_interrupts(capfd):
    """Whoever asks twice does not want to wait; the answer to the first says so."""
    with StopSignals() as stop, pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.received == signal.SIGINT
        assert "once more ends at once" in capfd.readouterr().err
        os.kill(os.getpid(), signal.SIGINT)


def test_time_limit_ends_the_run(start_run):
    """The clock ends a run whose steps would take for ever."""
    _, outcome = start_run(10**9, time_limit=1.0, evaluations=0)
    assert 1.0 <= outcome.counters.seconds < 10.0


def test_diverged_training_stops_with_an_explanation(start_run, monkeypatch):
    """A loss that is not finite ends the run instead of filling the log with nan."""
    monkeypatch.setattr(PPO, "_optimise", lambda self, data: {"loss_objective": math.nan, "loss_critic": 0.0})
    with pytest.raises(FloatingPointError, match="diverged in update 1: the loss is not finite; lower"):
        start_run(1000)


@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("weight", [math.nan, 1e38])
def test_diverged_networks_stop_with_the_same_explanation(discrete, weight, tmp_path):
    """Weights beyond all bounds make distributions fail before a loss is seen; other errors stay as they are."""
    ppo = PPO(PointReach(8, discrete=discrete), NetworkConfig(hidden=[8]), PPOConfig(horizon=4))

    def train_on():
        train(ppo, lambda policy: None, tmp_path, RunConfig(evaluations=0), logger=QUIET, settings={})

    with pytest.raises(FloatingPointError, match="diverged in update 1: the loss is not finite; lower"):
        with torch.no_grad():
            for parameter in ppo.policy.actor.parameters():
                parameter.fill_(weight)
        train_on()
    with torch.no_grad():
        for parameter in ppo.policy.actor.parameters():
            parameter.fill_(0.0)
    ppo.rollout.env = None
    with pytest.raises(AttributeError):
        train_on()


def test_policy_checkpoint_cannot_be_resumed(start_run, tmp_path):
    """best.pt holds no optimiser."""
    start_run(300)
    with pytest.raises(CheckpointError, match="holds a policy only"):
        start_run(600, resume=load(tmp_path / "best.pt"))


def test_checkpoint_of_another_environment_is_refused(start_run, tmp_path):
    """The spaces are compared before anything is loaded."""
    start_run(300)
    content = CheckpointFolder(tmp_path / "checkpoints", keep=1).load_latest()
    content["spaces"] = {**content["spaces"], "observation_size": 66}
    with pytest.raises(CheckpointError, match=r"made for .*66.*but the environment has"):
        start_run(600, resume=content)


@pytest.mark.parametrize(
    ("name", "value"), [("total_steps", 0), ("keep_checkpoints", 0), ("time_limit", 0.0), ("evaluations", -1)]
)
def test_bad_budgets_are_refused(name, value):
    """The message names the setting."""
    with pytest.raises(ValueError, match=name):
        RunConfig(**{name: value})


def test_same_seed_same_weights(start_run, tmp_path):
    """Two runs of one seed are equal to the bit, another seed is not."""
    runs = [start_run(1000, tmp_path / str(i), seed=seed)[0] for i, seed in enumerate((0, 0, 1))]
    first, again, other = (run.policy.state_dict() for run in runs)
    assert all(torch.equal(first[key], again[key]) for key in first)
    assert not all(torch.equal(first[key], other[key]) for key in first)
