"""The study of the obstacle: inverse control stops where the stem touches, a planner goes round; files and requests."""

import json

import pytest

from experiments import obstacle_study as study
from softwarp.envs import registry


def test_inverse_control_stops_at_the_obstacle():
    """Goal 5 mm inwards of the right obstacle's centre: cart and tip end at most 1 mm short of touching it, told."""
    inverse, planned = study.compare(1, 1, goals="benchmark")
    env = registry.make("CartStemContact", goals="benchmark")
    stop = 0.05 - env.config.reach
    cart, tip = inverse.way[-1]
    assert inverse.behind and not inverse.success and inverse.outcome == "UNREACHABLE" and inverse.actions == 30
    assert stop - 0.001 < cart < stop + 0.0005 and abs(tip - cart) < 0.001
    assert inverse.distance == pytest.approx(0.045 - tip, abs=1e-6)
    assert planned.behind and planned.success and planned.distance < env.config.success_tolerance
    assert min(cart for cart, _ in planned.way) < -0.02  # away from the goal first


def test_inverse_control_reaches_goals_in_the_open():
    runs = study.compare(3, 0, goals="open")
    assert all(run.success and not run.behind for run in runs)
    assert {run.outcome for run in runs} <= {"REACHED", "MOVING"}  # the height of the goal does not count
    assert "| QP | 3 of 3 | 0 of 0 |  | 0 of 0 |" in study.table(runs)


def test_files_and_requests(tmp_path, capsys):
    runs = study.main([str(tmp_path), "--starts", "1", "--planned", "0"])
    assert [run["start"] for run in json.loads((tmp_path / "obstacle.json").read_text())] == [run.start for run in runs]
    assert (tmp_path / "obstacle.md").read_text() == study.table(runs)
    assert (tmp_path / "obstacle.png").stat().st_size > 10_000
    with pytest.raises(SystemExit, match="2"):
        study.main([str(tmp_path), "--starts", "2", "--planned", "3"])
    assert "--planned in 0 ... --starts; got 2 and 3" in capsys.readouterr().err
