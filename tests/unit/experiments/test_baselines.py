"""The report of the learning baselines, from tables written by hand."""

import math
import os
import signal
import subprocess
import threading

import numpy as np
import pytest

from experiments import baselines, pool
from experiments import baselines_grasp as grasp
from experiments.baselines import ALGORITHMS, Cell, cells
from experiments.baselines_report import bootstrap, load_curves, rows_of, write_report
from experiments.config import TrainConfig, compose
from experiments.verbs import RecordConfig
from softwarp.training.logs import EVALUATION_COLUMNS, CsvTable


def write_run(folder, returns, *, spacing=100, success=1.0):
    """A run evaluated every ``spacing`` steps."""
    folder.mkdir(parents=True)
    table = CsvTable(folder / "evaluation.csv", EVALUATION_COLUMNS)
    for k, value in enumerate(returns):
        table.append({"update": k, "steps": k * spacing, "seconds": 6.0 * k, "return": value, "success": success})
    return folder


def test_table_tells_final_return_and_steps(tmp_path):
    """The way from 0 to the best mean, 10, is come by 90 % at a return of 9; seeds that never are there are counted."""
    quick = [write_run(tmp_path / "q" / str(k), [0.0, 10.0, 10.0, 10.0, 10.0]) for k in range(2)]
    slow = [
        write_run(tmp_path / "s" / "0", [0.0, 2.5, 5.0, 7.5, 10.0]),
        write_run(tmp_path / "s" / "1", [0.0, 0.0, 0.0, 0.0, 0.0], success=0.0),
    ]
    rows, curves = rows_of({("cartstem", "ppo"): quick, ("cartstem", "ppo_avec"): slow})
    assert curves["cartstem", "ppo"].returns.shape == (2, 101)
    first, second = rows
    assert first["final return"] == 10.0
    assert first["steps to 90 %"] == pytest.approx(92.0, abs=4.1)  # on a grid of 4 steps
    assert (first["seeds"], first["reached"], first["success"]) == (2, 2, 1.0)
    assert first["minutes per seed"] == pytest.approx(24.0 / 60.0)
    assert (second["reached"], second["steps to 90 %"], second["success"]) == (1, math.inf, 0.5)
    assert "18 h" in first["SofaGym"]


def test_runs_of_different_length_share_the_shorter_axis(tmp_path):
    """A run that is still going does not make up evaluations."""
    runs = [write_run(tmp_path / "a", [0.0, 1.0, 2.0]), write_run(tmp_path / "b", [0.0, 1.0])]
    assert load_curves(runs).steps[-1] == 100.0
    assert load_curves([tmp_path / "none"]) is None


def test_bootstrap_interval_covers_the_mean():
    """For 40 normal samples the 95 % interval is about +-1.96 sigma / sqrt(40)."""
    samples = np.random.default_rng(0).normal(size=(40, 1))
    low, high = bootstrap(samples)
    assert low < samples.mean() < high
    assert high[0] - low[0] == pytest.approx(2 * 1.96 * samples.std() / math.sqrt(40), rel=0.1)


def test_report_writes_its_files(tmp_path):
    """Picture, curves and tables; without evaluations it says so."""
    assert "no run has been evaluated yet" in write_report(tmp_path, {("cartstem", "ppo"): [tmp_path / "x"]})
    run = write_run(tmp_path / "run", [-5.0, -3.0])
    text = write_report(tmp_path, {("catchtheobject", "sac"): [run]})
    assert "| catchtheobject | sac | 1 |" in text
    assert (tmp_path / "table.md").read_text() == text
    assert len((tmp_path / "curves.csv").read_text().splitlines()) == 102
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert "final return" in (tmp_path / "table.csv").read_text()


def test_discrete_task_is_left_to_ppo(tmp_path):
    """Three tasks, four algorithms, two seeds: 10 pairs, seeds outermost."""
    made = list(cells(tmp_path, ["cartstem", "cartstemcontact", "catchtheobject"], ALGORITHMS, [0, 10]))
    assert len(made) == 20
    assert {cell.algorithm for cell in made if cell.task == "cartstem"} == {"ppo", "ppo_avec"}
    assert [cell.seed for cell in made] == [0] * 10 + [10] * 10


def test_newest_checkpoint_tells_how_far_a_run_is(tmp_path):
    """Steps come from the file's name; a run without one has none."""
    cell = Cell(tmp_path, "cartstem", "ppo", 0)
    assert cell.steps() is None
    (cell.folder / "checkpoints").mkdir(parents=True)
    (cell.folder / "checkpoints" / "step_000000001234.pt").write_bytes(b"")
    assert cell.steps() == 1234


def test_stopping_the_study_stops_its_runs(tmp_path, monkeypatch):
    """SIGTERM ends the command as an interrupt does: every run is told to save, and is waited for."""
    begun = []

    def start(job):
        begun.append(subprocess.Popen(["sleep", "100"]))
        if len(begun) == 2:
            threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGTERM)).start()
        return begun[-1]

    monkeypatch.setattr(pool, "start", start)
    previous = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as stop:
        made = list(cells(tmp_path, ["cartstem"], ["ppo", "ppo_avec"], [0]))
        pool.run_here(baselines.jobs_of(made, "small", []), 2)
    assert stop.value.code == 128 + signal.SIGTERM
    assert [process.returncode for process in begun] == [-signal.SIGTERM] * 2
    assert signal.getsignal(signal.SIGTERM) is previous


@pytest.mark.slow
def test_gripper_is_two_panels_of_four_curves(tmp_path):
    """With and without pull; each with and without memory and cloning, of which the demonstrations are shared."""
    made = list(cells(tmp_path, ["gripper", "gripper_pull"], ["sac", *grasp.ALGORITHMS], [0]))
    assert [cell.algorithm for cell in made] == list(grasp.ALGORITHMS) * 2
    assert {cell.demonstrations for cell in made if cell.is_cloned} == {
        tmp_path / task / "demonstrations.npz" for task in grasp.TASKS
    }
    for setting in ("paper", "fast", "small"):
        configs = {(cell.task, cell.algorithm): compose("train", TrainConfig, cell.overrides(setting)) for cell in made}
        for (task, algorithm), config in configs.items():
            assert config.network.shared
            assert config.network.recurrent == (128 if "lstm" in algorithm else 0)
            assert (config.cloning.path is not None) == (config.algo.warmup_updates > 0) == ("cloned" in algorithm)
            assert config.env["pull"] == (0.5 if task == "gripper_pull" else 0.0)
        paper = configs["gripper", "ppo_lstm_cloned"]
        if setting == "paper":
            assert (paper.network.hidden, paper.algo.gamma) == ([512, 512, 512], 0.99)
            assert (paper.env["max_episode_steps"], paper.cloning.epochs) == (250, 3000)


def test_demonstrations_are_of_what_is_trained(tmp_path):
    """All options that training changes, those of the command line as well, reach the recording."""
    (cell,) = cells(tmp_path, ["gripper_pull"], ["ppo_cloned"], [0])
    told = [*cell.overrides("fast"), "env.object=sphere", "env.hand_x=[-0.05,0.05]", "env.capture=false"]
    arguments = grasp.recording(told, "fast", cell.demonstrations)
    assert arguments[0] == str(tmp_path / "gripper_pull" / "demonstrations.npz")
    recorded = compose("record", RecordConfig, arguments[1:])
    trained = compose("train", TrainConfig, told)
    assert recorded.env == trained.env
    assert recorded.env["pull"] == 0.5 and recorded.env["object"] == "sphere"
    assert recorded.policy == "scripted" and recorded.noise > 0.0


def test_cloned_starts_do_not_count_as_untrained(tmp_path):
    """The way to the best begins where a policy begins that was shown nothing: at -1, and 90 % of it ends at 0.8."""
    fresh = [write_run(tmp_path / "p", [-1.0, 0.0, 1.0])]
    cloned = [write_run(tmp_path / "c", [0.9, 0.95, 1.0])]
    rows, _ = rows_of({("gripper", "ppo"): fresh, ("gripper", "ppo_cloned"): cloned})
    assert [row["steps to 90 %"] for row in rows] == pytest.approx([180.0, 0.0], abs=2.1)
