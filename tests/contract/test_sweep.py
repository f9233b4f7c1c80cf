"""Sweeps: a grid on Ray ends as in sequence, and survives a worker that is killed; nothing outlives a command."""

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments import sweep
from softwarp.training import checkpoints
from tests.contract.test_kills import assert_equal, processes, runs
from tests.contract.test_processes import is_alive

SHORT = ["env=cart_pole", "num_worlds=4", "network.hidden=[8]", "algo.horizon=16", "algo.minibatches=2"]
SHORT += ["algo.epochs=2", "evaluations=1", "evaluation_episodes=2", "checkpoint_seconds=0"]
GRID = [*SHORT, "total_steps=512", "algo.learning_rate=1e-3,3e-4", "seed=0,1,2,3"]  # eight runs

PATIENCE = 900.0  # s, on a machine that does other things


def start(*arguments: object, folder: Path) -> subprocess.Popen[bytes]:
    """A command in a group of its own, which prints to a file."""
    with (folder / "printed.txt").open("ab") as log:
        words = [sys.executable, "-m", "softwarp", *map(str, arguments)]
        return subprocess.Popen(words, stdout=log, stderr=log, env=os.environ | {"OMP_NUM_THREADS": "1"})


def table(folder: Path) -> list[dict[str, str]]:
    """Rows of ``runs.csv`` without what depends on the clock."""
    with (folder / "runs.csv").open() as file:
        return [{key: value for key, value in row.items() if key != "seconds"} for row in csv.DictReader(file)]


def wait_for_checkpoint(folder: Path, process: subprocess.Popen[bytes], patience: float = PATIENCE) -> Path:
    """The first run below a folder that has saved what it has learned."""
    end = time.monotonic() + patience
    while time.monotonic() < end and process.poll() is None:
        for run in folder.rglob("checkpoints"):
            if any(run.glob("step_*[1-9]*.pt")):
                return run.parent
        time.sleep(0.02)
    raise AssertionError((folder.parent / "printed.txt").read_text())


def parent(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def descendants(pid: int) -> list[int]:
    """Processes that a process has started, and those that these have."""
    try:
        tasks = list(Path(f"/proc/{pid}/task").iterdir())
        children = [int(child) for task in tasks for child in (task / "children").read_text().split()]
    except OSError:
        return []
    return [found for child in children for found in (child, *descendants(child))]


@pytest.mark.slow
def test_a_sweep_on_ray_ends_as_in_sequence(tmp_path):
    """Eight runs on two local workers, one of which is killed while it trains: the bits of runs one after the other."""
    pytest.importorskip("ray")
    begun = start("sweep", tmp_path / "ray", *GRID, "--ray", "--jobs", 2, folder=tmp_path)
    run = wait_for_checkpoint(tmp_path / "ray", begun)
    (training,) = processes(run)
    worker = parent(training)
    assert b"ray::" in Path(f"/proc/{worker}/cmdline").read_bytes()
    os.kill(worker, signal.SIGKILL)
    assert begun.wait(PATIENCE) == 0, (tmp_path / "printed.txt").read_text()
    assert start("sweep", tmp_path / "plain", *GRID, "--jobs", 1, folder=tmp_path).wait(PATIENCE) == 0
    assert_equal(runs(tmp_path / "ray"), runs(tmp_path / "plain"))
    assert len(table(tmp_path / "ray")) == 8
    assert table(tmp_path / "ray") == table(tmp_path / "plain")
    assert not processes(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("more", [[], ["--ray"], ["distributed.ranks=2"]], ids=["here", "ray", "ranks"])
def test_kill_of_a_sweep_leaves_nothing(tmp_path, more):
    """kill -9 of the command ends its runs, those on Ray and the ranks of a launcher too; they save before."""
    if "--ray" in more:
        pytest.importorskip("ray")
    words = ["sweep", tmp_path / "runs", *SHORT, "total_steps=200_000", "seed=0,1", "--jobs", 2, *more]
    begun = start(*words, folder=tmp_path)
    run = wait_for_checkpoint(tmp_path / "runs", begun)
    started = descendants(begun.pid)
    assert len(started) >= 2
    begun.kill()
    begun.wait()
    end = time.monotonic() + PATIENCE
    while any(is_alive(pid) for pid in started) and time.monotonic() < end:
        time.sleep(0.05)
    assert [pid for pid in started if is_alive(pid)] == []
    saved = checkpoints.CheckpointFolder(run / "checkpoints", keep=1).load_latest()
    assert saved["counters"]["steps"] > 0
    assert not processes(tmp_path)


def test_grids_draws_and_seeds():
    """All combinations in order; draws within their intervals, evenly in the logarithm where asked; seeds of each."""
    words = ["env=cart_pole", "algo.gamma=0.9,0.95", "algo.epochs=range(1,3)", "seed=3,5"]
    fixed, settings, seeds = sweep.variations(words, None, 0)
    assert fixed == ["env=cart_pole"]
    assert seeds == ["3", "5"]
    assert [setting.name for setting in settings] == [
        f"gamma_{gamma}__epochs_{epochs}" for gamma in ("0.9", "0.95") for epochs in (1, 2)
    ]
    words = ["algo.learning_rate=tag(log,interval(1e-5,1e-1))", "algo.epochs=interval(2,8)", "algo.gamma=0.9,0.95"]
    _, settings, seeds = sweep.variations(words, 200, 1)
    assert seeds == ["0"]
    rates = [float(dict(setting.values)["algo.learning_rate"]) for setting in settings]
    assert len(settings) == 200
    assert all(1e-5 <= rate <= 1e-1 for rate in rates)
    assert 70 < sum(rate < 1e-3 for rate in rates) < 130  # half of the decades
    assert {dict(setting.values)["algo.gamma"] for setting in settings} == {"0.9", "0.95"}
    assert sweep.variations(words, 200, 1)[1] == settings
    with pytest.raises(ValueError, match="draw from it with --samples N"):
        sweep.variations(words, None, 0)
    with pytest.raises(ValueError, match="out: every run of a sweep has a folder of its own"):
        sweep.variations(["out=here"], None, 0)


def test_the_table_ranks_settings_over_seeds(tmp_path):
    """Means over seeds, the best success first; runs without an evaluation are left out."""
    _, settings, seeds = sweep.variations(["algo.gamma=0.9,0.95", "seed=0,1"], None, 0)
    jobs = {(s, seed): sweep.job_of(tmp_path, ["env=cart_pole"], s, seed) for s in settings for seed in seeds}
    success = {("0.9", "0"): 0.25, ("0.9", "1"): 0.75, ("0.95", "0"): 1.0}
    for (setting, seed), job in jobs.items():
        value = success.get((setting.values[0][1], seed))
        if value is not None:
            job.folder.mkdir(parents=True)
            row = f"1,100,2.5,10,1.0,0.1,5,{value},0,0,0.01\n"
            head = "update,steps,seconds,episodes,return,return_std,length,success,failed,lost,distance\n"
            (job.folder / "evaluation.csv").write_text(head + row)
    text = sweep.write_report(tmp_path, settings, jobs)
    lines = text.splitlines()
    assert lines[0] == "| algo.gamma | seeds | steps | seconds | return | success | distance |"
    assert lines[2].startswith("| 0.95 | 1 | 100 | 2 | 1 (1 to 1) | 1 (1 to 1) |")
    assert lines[3].startswith("| 0.9 | 2 | 100 | 2 | 1 (1 to 1) | 0.5 (0.25 to 0.75) |")
    assert "0 of 4 runs are complete" in text
    assert len(table(tmp_path)) == 3
