"""A run that was stopped anywhere goes on as if it had not been."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest
import torch

from softwarp.policies.policy import NetworkConfig
from softwarp.training.algorithms import make_algorithm
from softwarp.training.checkpoints import CheckpointError, CheckpointFolder, load
from softwarp.training.evaluation import run_episodes
from softwarp.training.logs import LoggerConfig, read_csv
from softwarp.training.loop import RunConfig, _Session, train
from softwarp.training.ppo import PPO, PPOConfig
from softwarp.training.sac import SACConfig
from tests.unit.training.reach import PointReach

ROOT = Path(__file__).parents[2]


SHORT = {("ppo", 5), ("memory", 5)}  # kinds, and updates after which they are stopped
SMALL_SAC = {"horizon": 8, "batch": 32, "warmup_steps": 100, "capacity": 400}  # the ring wraps round
KINDS = {
    "ppo": (PPOConfig(horizon=8, epochs=2, minibatches=2, schedule="adaptive"), {}),
    "memory": (PPOConfig(horizon=8, epochs=2, minibatches=2, warmup_updates=3), {"recurrent": 4}),
    "sac": (SACConfig(**SMALL_SAC), {}),
    "prioritized": (SACConfig(**SMALL_SAC, prioritized=True, critic_bias=0.0), {}),
}


def run(folder, total_steps, resume=None, kind="ppo", **budget):
    """Train on the point until ``total_steps``; a resumed run is built with another seed, which must not matter."""
    seed = 0 if resume is None else 12345
    torch.manual_seed(seed)
    held_out = PointReach(8, seed=99)
    config, network = KINDS[kind]
    algorithm = make_algorithm(PointReach(8, seed=seed), NetworkConfig(hidden=[16], **network), config)
    settings = RunConfig(total_steps=total_steps, **({"checkpoint_seconds": 0.0, "evaluations": 3} | budget))
    train(
        algorithm,
        lambda policy: run_episodes(held_out, policy, seed=5),
        folder,
        settings,
        logger=LoggerConfig(tensorboard=False, progress=False),
        settings={},
        resume=resume,
    )
    return algorithm


def assert_equal(one, other):
    """Both algorithms hold the same bits: networks, statistics, optimiser."""
    for key, value in one.policy.state_dict().items():
        assert torch.equal(value, other.policy.state_dict()[key]), key
    states = one.optimizer.state_dict()["state"], other.optimizer.state_dict()["state"]
    for index, state in states[0].items():
        assert all(torch.equal(value, states[1][index][name]) for name, value in state.items())


@pytest.mark.parametrize(
    ("kind", "updates"),
    [
        pytest.param(kind, k, marks=pytest.mark.slow if (kind, k) not in SHORT else ())
        for kind, counts in {"ppo": (0, 1, 5, 9), "memory": (5,), "sac": (1, 9), "prioritized": (0, 9)}.items()
        for k in counts
    ],
)
def test_resumed_run_equals_uninterrupted_run(tmp_path, kind, updates):
    """Stop after k updates, go on to N: weights, optimiser and tables are those of N updates in one go."""
    whole = run(tmp_path / "whole", 64 * 13, kind=kind, evaluate_start=True)
    partly = run(tmp_path / "parts", 64 * 13, kind=kind, keep_checkpoints=100, evaluate_start=True)
    files = CheckpointFolder(tmp_path / "parts" / "checkpoints", keep=100).files()
    for later in files[updates + 1 :]:  # the first one stands before all updates
        later.unlink()  # as if killed during the update that followed
    content = CheckpointFolder(tmp_path / "parts" / "checkpoints", keep=100).load_latest()
    assert content["counters"]["update"] == updates
    resumed = run(tmp_path / "parts", 64 * 13, resume=content, kind=kind, keep_checkpoints=100, evaluate_start=True)
    assert_equal(whole, partly)
    assert_equal(whole, resumed)
    told = [read_csv(tmp_path / name / "progress.csv") for name in ("whole", "parts")]
    for rows in zip(*told, strict=True):
        one, other = ({key: row[key] for key in row if "second" not in key} for row in rows)
        assert one == other
    evaluations = [read_csv(tmp_path / name / "evaluation.csv") for name in ("whole", "parts")]
    assert [row["distance"] for row in evaluations[0]] == [row["distance"] for row in evaluations[1]]


PLACES = {  # looks at the clock after which a run is stopped
    "ppo": (3, 12, 16, 18, 20, 30, 40),  # rollout that scales, rollout, its end, minibatches, the last, evaluation
    "memory": (12, 18),
    "sac": (5, 19, 23),  # warm-up, first and last gradient steps
    "prioritized": (5, 19),
}


@pytest.mark.parametrize(
    ("kind", "looks"),
    [
        pytest.param(kind, k, marks=() if (kind, k) in (("ppo", 12), ("memory", 12), ("sac", 19)) else pytest.mark.slow)
        for kind, counts in PLACES.items()
        for k in counts
    ],
)
def test_run_stopped_within_an_update_goes_on_there(tmp_path, monkeypatch, kind, looks):
    """Stopped after a step of the environment, of the optimiser or of an evaluation; nothing is lost or done twice."""
    whole = run(tmp_path / "whole", 64 * 5, kind=kind)
    left, look = looks, _Session.pulse

    def stop_at_last(self, overtime=0.0):
        nonlocal left
        left -= 1
        if left == 0:
            self.stop.received = signal.SIGTERM
        look(self, overtime)

    monkeypatch.setattr(_Session, "pulse", stop_at_last)
    stopped = run(tmp_path / "parts", 64 * 5, kind=kind)
    assert left == 0
    assert stopped.rollout.steps < whole.rollout.steps
    monkeypatch.undo()
    content = CheckpointFolder(tmp_path / "parts" / "checkpoints", keep=1).load_latest()
    resumed = run(tmp_path / "parts", 64 * 5, resume=content, kind=kind)
    assert_equal(whole, resumed)
    for table in ("progress", "evaluation"):
        rows = [read_csv(tmp_path / name / f"{table}.csv") for name in ("whole", "parts")]
        plain = [[{key: row[key] for key in row if "second" not in key} for row in part] for part in rows]
        assert plain[0] == plain[1]


def test_run_killed_before_its_first_update_can_be_resumed(tmp_path, monkeypatch):
    """The checkpoint of the start is there before the first evaluation, which is done again."""
    monkeypatch.setattr(PPO, "update", lambda self, progress: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "run", 64 * 4, evaluate_start=True, checkpoint_seconds=1e9)
    monkeypatch.undo()
    content = CheckpointFolder(tmp_path / "run" / "checkpoints", keep=1).load_latest()
    assert content["counters"]["steps"] == 0
    resumed = run(tmp_path / "run", 64 * 4, resume=content, evaluate_start=True, checkpoint_seconds=1e9)
    assert_equal(resumed, run(tmp_path / "whole", 64 * 4, evaluate_start=True, checkpoint_seconds=1e9))
    assert [row["steps"] for row in read_csv(tmp_path / "run" / "evaluation.csv")].count(0) == 1


def test_later_checkpoints_go_when_an_earlier_one_is_resumed(tmp_path):
    """They stay when it does not fit: a mistyped setting must not cost what was learned."""
    whole = run(tmp_path / "run", 64 * 8, keep_checkpoints=100)
    folder = CheckpointFolder(tmp_path / "run" / "checkpoints", keep=100)
    files = folder.files()
    content = load(files[3])
    with pytest.raises(CheckpointError, match="does not fit this run's networks"):
        run(tmp_path / "run", 64 * 8, resume=content, kind="memory")
    assert folder.files() == files
    assert_equal(whole, run(tmp_path / "run", 64 * 8, resume=content, keep_checkpoints=100, checkpoint_seconds=1e9))
    assert folder.files() == [*files[:4], files[-1]]


@pytest.mark.slow
def test_replay_can_be_left_out_of_checkpoints(tmp_path):
    """Without it the checkpoint is small, and the resumed run first fills its replay again."""
    config = SACConfig(**SMALL_SAC, save_replay=False)
    sizes = []
    for settings in (config, KINDS["sac"][0]):
        torch.manual_seed(0)
        sac = make_algorithm(PointReach(8), NetworkConfig(hidden=[16]), settings)
        for _ in range(8):
            sac.update(0.0)
        sizes.append(sac.state_dict()["replay"]["data"]["observation"].numel())
        other = make_algorithm(PointReach(8), NetworkConfig(hidden=[16]), settings)
        other.load_state_dict(sac.state_dict())
        other.update(0.0)
        assert other.replay.size == (64 if settings is config else 400)
    assert sizes == [0, 400 * 4]


SCRIPT = textwrap.dedent(
    """
    import sys
    from pathlib import Path
    from tests.contract.test_resume import CheckpointFolder, run

    folder, total_steps, kind = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
    files = CheckpointFolder(folder / "checkpoints", keep=1).files()
    resume = CheckpointFolder(folder / "checkpoints", keep=1).load_latest() if files else None
    print("ready", flush=True)
    run(folder, total_steps, resume=resume, kind=kind)
    """
)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ppo", "sac"])
def test_killed_run_goes_on(tmp_path, kind):
    """kill -9 at some moment: the newest checkpoint is whole, and the resumed run ends like one never killed."""
    command = [sys.executable, "-c", SCRIPT, str(tmp_path / "killed"), str(10**9), kind]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, cwd=ROOT)
    process.stdout.readline()
    while not CheckpointFolder(tmp_path / "killed" / "checkpoints", keep=1).files():
        assert process.poll() is None, "ended before its first checkpoint"
        time.sleep(0.01)
    time.sleep(0.5)
    process.send_signal(signal.SIGKILL)
    process.wait()
    content = CheckpointFolder(tmp_path / "killed" / "checkpoints", keep=1).load_latest()
    written = [row["update"] for row in read_csv(tmp_path / "killed" / "progress.csv")]
    assert content["counters"]["update"] >= max(written, default=0) - 1
    total = content["counters"]["steps"] + 64 * 3
    resumed = run(tmp_path / "killed", total, resume=content, evaluations=0, kind=kind)
    whole = run(tmp_path / "whole", total, evaluations=0, kind=kind, checkpoint_seconds=1e9)
    assert_equal(whole, resumed)


@pytest.mark.slow
def test_trunk_goes_on_to_the_bit(tmp_path):
    """The simulator's own state is part of a checkpoint: a trunk run resumed after 2 of 5 updates ends alike."""
    from softwarp.envs import registry

    def train_trunk(folder, updates, resume=None):
        torch.manual_seed(0 if resume is None else 7)
        env = registry.make("Trunk", num_worlds=4, seed=0 if resume is None else 7, mesh="coarse", max_episode_steps=6)
        config = PPOConfig(horizon=4, epochs=2, minibatches=2, schedule="constant")
        algorithm = PPO(env, NetworkConfig(hidden=[8]), config)
        budget = RunConfig(total_steps=16 * (updates + 1), evaluations=0)  # one batch only scales observations
        quiet = LoggerConfig(csv=False, tensorboard=False, progress=False, picture=False)
        train(algorithm, run_episodes, folder, budget, logger=quiet, settings={}, resume=resume)
        return algorithm, CheckpointFolder(folder / "checkpoints", keep=1).load_latest()

    whole, _ = train_trunk(tmp_path / "whole", 5)
    _, content = train_trunk(tmp_path / "parts", 2)
    assert content["counters"]["update"] == 2
    resumed, _ = train_trunk(tmp_path / "parts", 5, resume=content)
    assert_equal(whole, resumed)
    assert torch.equal(whole.rollout.now["observation"], resumed.rollout.now["observation"])
