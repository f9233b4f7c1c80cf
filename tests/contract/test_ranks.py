"""Several ranks train like one process with all their worlds, stop and go on together, and survive the death of one."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from softwarp.training.checkpoints import CheckpointFolder
from softwarp.training.logs import read_csv
from softwarp.training.ranks import rank_seed
from tests.rank_cases import UPDATE, finish, start


def test_two_ranks_have_the_gradients_and_statistics_of_one_process():
    """For the same worlds and minibatches: gradients to 1e-6, merged moments to 1e-12, the same on both ranks."""
    told = finish(start("compare", 2))
    for found in told:
        for kind, gaps in found.items():
            assert gaps.get("gradient", 0.0) < 1e-6, (kind, gaps)
            assert gaps.get("norm", 0.0) < 1e-12, (kind, gaps)
            assert gaps.get("kl", 0.0) < 1e-6, (kind, gaps)
            assert gaps.get("shift", 0.0) < 1e-6, (kind, gaps)
            assert gaps.get("weights", 0.0) < 1e-4, (kind, gaps)  # after some twenty steps of Adam


def same(one, other):
    """Whether ranks hold the same bits, their own worlds and generators included."""
    keys = ("weights", "norm", "worlds", "draw", "steps", "rate")
    return all(a[key] == b[key] for a, b in zip(one, other, strict=True) for key in keys)


def test_a_killed_rank_ends_the_run_and_resume_is_the_same_run(tmp_path):
    """kill -9 of rank 1 in its fifth update: rank 0 says so at once; what resumes ends with the bits of a whole run."""
    whole = start("run", 2, tmp_path / "whole", "ppo", 6)
    killed = start("run_until_lost", 2, tmp_path / "parts", "ppo", 6, json.dumps({"kill": [1, 60]}))
    lost = killed[0].finish()
    assert "rank 0 of 2: another rank is gone" in lost["lost"]
    killed[1].process.join()
    assert killed[1].process.exitcode == -signal.SIGKILL
    held = CheckpointFolder(tmp_path / "parts" / "checkpoints", keep=3).steps()[-1]
    told = read_csv(tmp_path / "parts" / "progress.csv")[-1]["steps"]
    assert 0 < told - 2 * UPDATE <= held  # a checkpoint after every update: at most the last one is lost
    resumed = finish(start("run", 2, tmp_path / "parts", "ppo", 6))
    expected = finish(whole)
    assert resumed[0]["resumed_at"] == held
    assert same(resumed, expected)
    assert expected[0]["weights"] == expected[1]["weights"]
    assert expected[0]["worlds"] != expected[1]["worlds"]
    rows = [read_csv(tmp_path / name / "progress.csv") for name in ("whole", "parts")]
    plain = [[{key: row[key] for key in row if "second" not in key} for row in part] for part in rows]
    assert plain[0] == plain[1]


@pytest.mark.parametrize("kind", [*(pytest.param(kind, marks=pytest.mark.slow) for kind in ("ppo", "memory")), "sac"])
def test_a_signal_to_one_rank_stops_all_at_the_same_step(tmp_path, kind):
    """Rank 1 alone is told: both leave the update one step later, and go on there with the bits of a whole run."""
    whole = start("run", 2, tmp_path / "whole", kind, 5)
    stopped = finish(start("run", 2, tmp_path / "parts", kind, 5, json.dumps({"stop": [1, 21]})))
    assert [part["signal"] for part in stopped] == [signal.SIGTERM] * 2
    assert stopped[0]["begun"] == stopped[1]["begun"]
    assert stopped[0]["looks"] == stopped[1]["looks"] == 22
    assert stopped[0]["steps"] < 5 * 2 * UPDATE
    assert same(finish(start("run", 2, tmp_path / "parts", kind, 5)), finish(whole))


@pytest.mark.parametrize("kind", ["ppo", pytest.param("sac", marks=pytest.mark.slow)])
def test_another_number_of_ranks_goes_on(tmp_path, kind):
    """Two ranks, stopped half way, then one, then three: steps are counted on, and all ranks have the same weights."""
    (first, _) = finish(start("run", 2, tmp_path, kind, 4, json.dumps({"stop": [0, 50]})))
    (one,) = finish(start("run", 1, tmp_path, kind, 0, json.dumps({"total": 2000})))
    assert one["resumed_at"] == first["steps"] > 0
    three = finish(start("run", 3, tmp_path, kind, 0, json.dumps({"total": 3000})))
    assert three[0]["resumed_at"] == one["steps"] >= 2000
    assert three[0]["steps"] >= 3000
    assert three[0]["weights"] == three[1]["weights"] == three[2]["weights"]
    assert len({json.dumps(rank["worlds"]) for rank in three}) == 3


def test_seeds_of_ranks():
    """Rank 0 has the run's own; others are none of the small seeds that sweeps count up."""
    seeds = {rank_seed(seed, rank) for seed in range(20) for rank in range(64)}
    assert len(seeds) == 20 * 64
    assert [rank_seed(seed, 0) for seed in range(20)] == list(range(20))
    assert all(rank_seed(seed, rank) > 10**4 for seed in range(20) for rank in range(1, 64))


CARTS = ["env=cart_pole", "num_worlds=4", "network.hidden=[8]", "algo.horizon=16", "algo.epochs=2", "total_steps=2560"]
QUIET = ["evaluations=1", "evaluation_episodes=2", "logger.picture=false", "checkpoint_seconds=0"]


def ranks_of(process):
    """Processes that a launcher has started."""
    return [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]


@pytest.mark.slow
def test_the_launcher_starts_ranks_again(tmp_path):
    """softwarp train distributed.ranks=2 distributed.restarts=1, and kill -9 of a rank: it ends as it would have."""
    command = [sys.executable, "-m", "softwarp", "train", *CARTS, *QUIET, "distributed.ranks=2"]
    for name in ("killed", "whole"):
        told = [f"out={tmp_path / name}", f"distributed.restarts={int(name == 'killed')}"]
        with (tmp_path / f"{name}.log").open("w") as log:
            process = subprocess.Popen([*command, *told], stdout=log, stderr=log, env=os.environ.copy())
            while name == "killed" and len(CheckpointFolder(tmp_path / name / "checkpoints", keep=3).steps()) < 2:
                assert process.poll() is None, (tmp_path / "killed.log").read_text()
                time.sleep(0.05)
            if name == "killed":
                os.kill(ranks_of(process)[1], signal.SIGKILL)
            assert process.wait(120) == 0, (tmp_path / f"{name}.log").read_text()
    assert "going on with" in (tmp_path / "killed.log").read_text()
    rows = [read_csv(tmp_path / name / "progress.csv") for name in ("whole", "killed")]
    plain = [[{key: row[key] for key in row if "second" not in key} for row in part] for part in rows]
    assert plain[0] == plain[1]
