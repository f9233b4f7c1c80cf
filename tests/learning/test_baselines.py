"""``softwarp baselines`` in its small setting: every pair trains, a second call has nothing left to do."""

import pytest

from experiments.baselines import main


@pytest.mark.slow
def test_small_setting_runs_and_goes_on(tmp_path, capsys):
    """Ten pairs of task and algorithm, one seed; the table has a row for each, and a repeated call trains nothing."""
    arguments = [str(tmp_path / "study"), "--setting", "small", "--seeds", "1", "--jobs", "2"]
    assert main(arguments) == 0
    first = capsys.readouterr()
    assert first.err.count("starts") == 10
    rows = [line for line in first.out.splitlines() if line.startswith(("| cart", "| catch"))]
    assert len(rows) == 10
    for name in ("curves.csv", "curves.png", "table.csv", "table.md"):
        assert (tmp_path / "study" / name).is_file()
    assert main(arguments) == 0
    again = capsys.readouterr()
    assert "starts" not in again.err
    assert "goes on" not in again.err
    assert again.out == first.out


@pytest.mark.slow
def test_gripper_records_clones_and_goes_on(tmp_path, capsys):
    """Two curves in both panels: demonstrations are recorded before they are cloned, and only once."""
    arguments = [str(tmp_path), "--setting", "small", "--tasks", "gripper", "--seeds", "1", "--jobs", "2"]
    arguments += ["--algorithms", "ppo", "ppo_lstm_cloned"]
    assert main(arguments) == 0
    first = capsys.readouterr()
    assert (first.err.count("recorded, before"), first.err.count("starts")) == (2, 4)
    assert len([line for line in first.out.splitlines() if line.startswith("| gripper")]) == 4
    log = (tmp_path / "gripper_pull" / "ppo_lstm_cloned" / "seed_0" / "train.log").read_text()
    assert "demonstrations.npz: epochs" in log
    assert main(arguments) == 0
    again = capsys.readouterr()
    assert not any(word in again.err for word in ("recorded", "starts", "goes on"))
    assert again.out == first.out
