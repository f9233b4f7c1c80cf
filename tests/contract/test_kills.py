"""Kill -9 at random times: what is started again ends with the bits of what was never killed.

Training, a sweep, planning and recording are each killed KILLS times (environment variable, 25), in rounds; after every
kill all files there are can be read, and after the last run of a round no scratch file and no process is left.
"""

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch

from softwarp.planning.plans import Plan
from softwarp.training import checkpoints
from softwarp.training.demonstrations import Demonstrations
from softwarp.training.logs import read_csv

KILLS = int(os.environ.get("KILLS", "25"))  # of each activity
ROUND = 5  # kills before it may end
PATIENCE = 20.0  # s for processes to be gone
pytestmark = pytest.mark.slow

SMALL = ["num_worlds=4", "network.hidden=[8]", "evaluations=3", "evaluation_episodes=2", "logger.picture=false"]
PPO = ["algo=ppo", "algo.horizon=16", "algo.minibatches=2", "algo.epochs=2", "checkpoint_seconds=0"]
BATCH = ["--setting", "small", "--tasks", "cartstem", "--algorithms", "ppo", "ppo_avec", "--seeds", "1", "--jobs", "2"]
FEW = ["total_steps=1024", "num_worlds=4", "evaluation_episodes=2", "checkpoint_seconds=0", "algo.epochs=2"]
PLAN = ["env=cart_stem_contact", "env.max_episode_steps=4", "planner=cem", "planner.population=8", "planner.elites=2"]
PLAN += ["planner.expansions=64", "episodes=3", "progress=false"]
SHOWN = ["env=cart_stem", "env.action_kind=continuous", "env.max_episode_steps=40", "episodes=8", "num_worlds=4"]


def train(folder: Path) -> list[str]:
    run = folder / "run"
    if checkpoints.CheckpointFolder(run / "checkpoints", keep=1).files():
        return ["train", "--resume", str(run)]
    return ["train", "env=cart_pole", *PPO, *SMALL, "total_steps=2560", f"out={run}"]


@dataclass(frozen=True)
class Activity:
    """What is killed, and what it makes: numbers by name that must be those of a run that was left alone."""

    command: Callable[[Path], list[str]]
    result: Callable[[Path], Any]


def runs(folder: Path) -> dict[str, Any]:
    """Last checkpoint and tables of every run below a folder, without times and places."""
    told: dict[str, Any] = {}
    for run in sorted(path.parent for path in folder.rglob("checkpoints")):
        content = checkpoints.CheckpointFolder(run / "checkpoints", keep=1).load_latest()
        content["counters"].pop("seconds")
        content.pop("config")
        tables = {name: read_csv(run / f"{name}.csv") for name in ("progress", "evaluation")}
        for row in (row for rows in tables.values() for row in rows):
            row.pop("seconds")
            row.pop("steps_per_second", None)
        told[str(run.relative_to(folder))] = content | tables
    return told


def plan(folder: Path) -> Any:
    made = Plan.load(folder / "plan.json")
    return [made.actions, [vars(step) for step in made.steps], made.start.state_dict(), made.value, made.history]


ACTIVITIES = {
    "training": Activity(train, runs),
    "sweep": Activity(lambda folder: ["baselines", str(folder / "sweep"), *BATCH, "--set", *FEW], runs),
    "planning": Activity(
        lambda folder: ["plan", *PLAN, f"out={folder / 'plan.json'}", f"summary={folder / 'summary.json'}"], plan
    ),
    "recording": Activity(
        lambda folder: ["record", str(folder / "shown.npz"), *SHOWN],
        lambda folder: vars(Demonstrations.load(folder / "shown.npz")),
    ),
}


def start(arguments: list[str], folder: Path) -> subprocess.Popen[bytes]:
    log = (folder / "printed.txt").open("ab")
    with log:
        return subprocess.Popen([sys.executable, "-m", "softwarp", *arguments], stdout=log, stderr=subprocess.STDOUT)


def processes(folder: Path) -> list[int]:
    """Processes whose command names something in a folder."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                named = str(folder).encode() in (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if named:
                found.append(int(entry.name))
    return found


def gone(folder: Path) -> bool:
    """Whether all processes of a folder end within ``PATIENCE``."""
    end = time.monotonic() + PATIENCE
    while processes(folder) and time.monotonic() < end:
        time.sleep(0.05)
    return not processes(folder)


def check_files(folder: Path) -> None:
    """Everything with a name of its own can be read."""
    for path in folder.rglob("[!.]*"):
        if path.suffix == ".pt":
            checkpoints.load(path)
        elif path.suffix == ".csv" and path.name in ("progress.csv", "evaluation.csv"):
            read_csv(path)
        elif path.name == "plan.json":
            Plan.load(path)
        elif path.suffix == ".npz":
            Demonstrations.load(path)


def assert_equal(one: Any, other: Any, place: str = "") -> None:
    """Nested containers with the same bits."""
    if isinstance(one, dict):
        assert one.keys() == other.keys(), place
        for key in one:
            assert_equal(one[key], other[key], f"{place}/{key}")
    elif isinstance(one, list | tuple):
        assert len(one) == len(other), place
        for index, pair in enumerate(zip(one, other, strict=True)):
            assert_equal(*pair, f"{place}/{index}")
    elif isinstance(one, torch.Tensor):
        assert torch.equal(one.nan_to_num(), other.nan_to_num()), place
    else:
        assert one == other or (one != one and other != other), place


@pytest.mark.parametrize("name", ACTIVITIES)
def test_killed_and_started_again(name, tmp_path):
    """Kills at even random times between 0.2 and 1 of the duration of a run that is left alone."""
    activity = ACTIVITIES[name]
    alone = tmp_path / "alone"
    alone.mkdir()
    began = time.monotonic()
    assert start(activity.command(alone), alone).wait() == 0, (alone / "printed.txt").read_text()
    duration = time.monotonic() - began
    wanted = activity.result(alone)
    rng = random.Random(name)
    kills = 0
    while kills < KILLS:
        folder = Path(tempfile.mkdtemp(dir=tmp_path))
        for _ in range(ROUND):
            process, began = start(activity.command(folder), folder), time.monotonic()
            try:
                process.wait(duration * rng.uniform(0.2, 1.0))
                duration = min(duration, time.monotonic() - began)  # the machine is less busy by now
            except subprocess.TimeoutExpired:
                process.kill()
                kills += 1
            assert process.wait() in (0, -signal.SIGKILL), (folder / "printed.txt").read_text()
            assert gone(folder), f"left behind: {processes(folder)}"
            check_files(folder)
            if process.returncode == 0:
                break
        assert start(activity.command(folder), folder).wait() == 0, (folder / "printed.txt").read_text()
        assert_equal(activity.result(folder), wanted)
        scratch = [path for path in folder.rglob(".*") if path.name != checkpoints.LOCK]
        assert not scratch
        assert "Traceback" not in (folder / "printed.txt").read_text()
