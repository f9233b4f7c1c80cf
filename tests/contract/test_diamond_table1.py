"""Table 1 on Diamond: its targets, its bookkeeping, and a small run of all methods."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from experiments import diamond_table1 as study
from experiments.diamond_table1_report import COLUMNS, PAPER, Trial, markdown, rows
from softwarp.envs import registry
from softwarp.envs.tasks.diamond import reachable_points
from softwarp.planning.execution import Execution
from softwarp.planning.search import Search

TRIAL = Trial(
    target=[0.0, 0.0, 0.14],
    end=[0.0, 0.0, 0.141],
    error=0.001,
    seconds=2.0,
    processor_seconds=1.0,
    control_seconds=0.5,
    simulated_seconds=2.5,
    outcome="REACHED",
    method="QP",
)


def test_rows_are_means_of_their_trials():
    """Two reachable targets and one unreachable one: errors in mm, the share within half a millimetre, the excess."""
    far = replace(TRIAL, is_reachable=False, error=0.012, least=0.010, outcome="UNREACHABLE")
    near, other = rows([TRIAL, replace(TRIAL, error=0.0002, seconds=4.0, outcome="MOVING"), far])
    assert (near["targets"], near["count"], near["within 0.5 mm [%]"], near["told [%]"]) == ("reachable", 2, 50.0, 50.0)
    assert near["mean error [mm]"] == pytest.approx(0.6) and near["worst error [mm]"] == pytest.approx(1.0)
    assert (near["time [s]"], near["processor time [s]"], near["mean excess [mm]"]) == (3.0, 1.0, "")
    assert (near["SofaGym: error [mm]"], near["SofaGym: time [s]"]) == PAPER["QP"]
    assert (other["targets"], other["told [%]"], other["within 0.5 mm [%]"]) == ("unreachable", 100.0, "")
    assert other["mean excess [mm]"] == pytest.approx(2.0)
    assert len(markdown([near, other]).splitlines()) == 4


def test_a_method_that_tells_nothing_has_no_share():
    (row,) = rows([replace(TRIAL, method="PPO", outcome="")])
    assert row["told [%]"] == row["SofaGym: error [mm]"] == row["model steps"] == ""


def test_targets():
    """Reachable ones are of the part that training does not see; unreachable ones are far from all that was seen."""
    seen = reachable_points()
    env = registry.make("Diamond", num_worlds=1, mesh="coarse", goal_split="train")
    env.reset()
    assert len(study.reachable_targets(20)) == 20 <= 0.2 * len(seen)
    np.testing.assert_array_equal(study.reachable_targets(3), seen[-3:].astype(np.float64))
    far = study.unreachable_targets(10)
    assert np.linalg.norm(far[:, None] - seen, axis=-1).min() > study.OUTSIDE
    assert (np.abs(far[:, :2]) <= 0.03).all() and (far[:, 2] >= 0.125).all() and (far[:, 2] <= 0.145).all()
    np.testing.assert_array_equal(far[:4], study.unreachable_targets(4))
    assert study.reachable_targets(0).shape == study.unreachable_targets(0).shape == (0, 3)


def test_an_episode_can_be_aimed():
    """The goal is the given one, and what an episode keeps of its distance is that to it."""
    env = registry.make("Diamond", mesh="coarse", seed=1)
    target = np.array([0.01, 0.0, 0.135])
    study.aim(env, target)
    assert float(env.distance) == float(env.best) == pytest.approx(np.hypot(0.01, 0.135 - float(env.tip()[0, 2])), 1e-4)
    trial = study.hold(env, study.InversePolicy(env), target)
    assert trial.error < 5e-4 and trial.outcome == "REACHED" and trial.simulated_seconds == pytest.approx(2.5)


def test_held_actions_count_as_steps_and_the_other_scene_has_its_own_reach(monkeypatch):
    """Model steps are environment steps; what inverse control finds is no bound where cables also push."""
    done = Execution(searches=[Search(np.zeros(1), 0.0, None, 1.0, transitions, 0.1) for transitions in (7, 3)])
    monkeypatch.setattr(study, "execute", lambda *arguments: done)
    setting = study.Setting("coarse", reachable=1, unreachable=1)
    run = study.planned(study.MPPI, study.COMMANDS, setting)
    assert run(np.array([0.0, 0.0, 0.135])).model_steps == 5 * 10
    monkeypatch.setattr(study, "least_distances", lambda *arguments: np.array([[0.004], [0.003]]))
    trials = study.compare(setting, {name: lambda setting: lambda target: TRIAL for name in ("QP", study.OTHER_SCENE)})
    assert [(trial.method, trial.least) for trial in trials if not trial.is_reachable] == [
        ("QP", 0.003),
        (study.OTHER_SCENE, 0.0),
    ]


def test_wrong_requests_are_refused(tmp_path, capsys):
    for arguments, told in (
        (
            ["--methods", "PPO"],
            "PPO is none of QP, OPD, OPD/SofaGym, MPPI, CEM (PPO needs --policy or --train)",
        ),
        (["--reachable", "-1"], "--reachable must not be negative, got -1"),
        (["--reachable", "0", "--unreachable", "0"], "nothing to do without targets"),
        (["--train", "--policy", "run"], "give one of them"),
    ):
        with pytest.raises(SystemExit, match="2"):
            study.main([str(tmp_path), *arguments])
        assert told in capsys.readouterr().err


@pytest.mark.slow
def test_small_study(tmp_path):
    """All methods on the coarse mesh, a policy trained for a moment: files, and what the table says of QP and OPD."""
    trials = study.main([str(tmp_path), "--setting", "small", "--train"])
    names = ["QP", "OPD", "OPD/SofaGym", "PPO", "MPPI", "CEM"]
    assert list(dict.fromkeys(trial.method for trial in trials)) == names and len(trials) == 18
    for trial in trials:
        if trial.method == "QP":
            assert trial.outcome == ("REACHED" if trial.is_reachable else "UNREACHABLE")
            assert trial.error - trial.least < 5e-4
        if trial.method == "OPD" and trial.is_reachable:
            assert trial.error < study.TOLERANCE and trial.model_steps > 0
    with (tmp_path / "table.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [row["method"] for row in table] == [name for name in names for _ in range(2)]
    assert tuple(table[0]) == COLUMNS
    assert len(json.loads((tmp_path / "table1.json").read_text())["trials"]) == 18
    assert len((tmp_path / "table.md").read_text().splitlines()) == 14
    assert (tmp_path / "table1.png").stat().st_size > 10_000
