"""Tables that survive a kill and a resume, and the words of the progress line."""

import math

import pytest

from softwarp.training.logs import CsvTable, LoggerConfig, RunLog, clock, describe, read_csv


def test_rows_come_back(tmp_path):
    """Missing columns stay empty and are left out on reading."""
    table = CsvTable(tmp_path / "t.csv", ("update", "a", "b"))
    table.append({"update": 1, "a": 0.1})
    table.append({"update": 2, "b": -3.0})
    assert read_csv(tmp_path / "t.csv") == [{"update": 1.0, "a": 0.1}, {"update": 2.0, "b": -3.0}]


def test_resume_drops_later_and_torn_rows(tmp_path):
    """After a resume at update 2 the table holds updates 1 and 2 once, whatever was written after."""
    path = tmp_path / "t.csv"
    table = CsvTable(path, ("update", "a"))
    for update in (1, 2, 3):
        table.append({"update": update, "a": 0.5})
    path.write_text(path.read_text() + "4,0.")
    table = CsvTable(path, ("update", "a"), resume_update=2)
    table.append({"update": 3, "a": 0.7})
    assert [(row["update"], row["a"]) for row in read_csv(path)] == [(1, 0.5), (2, 0.5), (3, 0.7)]


def test_unknown_column_is_refused(tmp_path):
    """A metric without a column would otherwise be lost."""
    with pytest.raises(ValueError, match="has no column oops"):
        CsvTable(tmp_path / "t.csv", ("update",)).append({"update": 1, "oops": 2.0})


def test_run_log_writes_what_it_is_told_to(tmp_path):
    """CSV and TensorBoard each can be switched off."""
    for csv, tensorboard in ((True, False), (False, True)):
        folder = tmp_path / f"{csv}"
        folder.mkdir()
        log = RunLog(folder, LoggerConfig(csv=csv, tensorboard=tensorboard, picture=False), ["loss_critic"])
        log.add("progress", {"update": 1, "return": 2.0})
        log.close()
        assert (folder / "progress.csv").exists() == csv
        assert (folder / "tensorboard").exists() == tensorboard


def test_progress_in_words():
    """Return, success rate, final distance, speed and time left, each only if known."""
    row = {"steps": 12345.0, "steps_per_second": 678.0}
    assert describe(row, 61.0) == "12,345 steps  678/s  1:01 left"
    full = row | {"return": 1.234, "success": 0.5, "distance": 0.0123}
    assert describe(full, math.inf) == "12,345 steps  678/s  return 1.23  success 50%  distance 12.3 mm  --:-- left"
    assert clock(3723.4) == "1:02:03"
