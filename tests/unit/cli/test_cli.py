"""Small parts of the command line, without starting a process."""

import os
import sys

import numpy as np
import pytest

from experiments.eval import table
from experiments.render import tile
from softwarp import cli


def test_experiments_are_found_in_a_checkout(monkeypatch):
    """Without an installed softwarp.experiments the folder beside the package is taken, with its relative imports."""
    for name in [name for name in sys.modules if name.startswith("softwarp.experiments")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(cli.importlib.util, "find_spec", lambda name: None)
    module = cli.experiment("catalogue")
    assert module.__name__ == "softwarp.experiments.catalogue"
    assert module.CONFIG_DIR == cli.ROOT / "hydra_configs"


def test_missing_experiments_say_so(monkeypatch, tmp_path):
    """Neither installed nor in a checkout: the message names the folder and the remedy."""
    for name in [name for name in sys.modules if name.startswith("softwarp.experiments")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(cli.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(cli, "ROOT", tmp_path)
    with pytest.raises(ModuleNotFoundError, match=r"found neither installed nor in .*; reinstall softwarp"):
        cli.experiment("train")


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (ValueError("a thing is wrong"), "a thing is wrong"),
        (PermissionError(13, "cannot write x; choose another"), "cannot write x; choose another"),
        (FileNotFoundError(2, "No such file or directory", "x.yaml"), "x.yaml: No such file or directory"),
    ],
)
def test_errors_are_told_without_numbers(error, text):
    """Numbers of the operating system's errors help nobody."""
    assert cli._reason(error) == text


def test_lack_of_memory_is_bad_input(monkeypatch, capsys):
    """A batch that does not fit ends in its sentence, not in a traceback."""

    def verb(arguments):
        raise MemoryError("this scene needs 61 GiB")

    monkeypatch.setitem(cli.VERBS, "list", verb)
    assert cli.main(["list"]) == cli.BAD_INPUT
    assert capsys.readouterr().err == "softwarp list: this scene needs 61 GiB\n"


@pytest.mark.parametrize(("count", "grid"), [(1, (1, 1)), (2, (1, 2)), (3, (2, 2)), (6, (2, 3)), (9, (3, 3))])
def test_pictures_are_tiled_in_reading_order(count, grid):
    """World i stands in row i // columns and column i % columns; free places are white."""
    pictures = np.stack([np.full((4, 5, 3), i, np.uint8) for i in range(count)])
    tiled = tile(pictures)
    assert tiled.shape == (4 * grid[0], 5 * grid[1], 3)
    for i in range(grid[0] * grid[1]):
        row, column = divmod(i, grid[1])
        assert (tiled[4 * row : 4 * row + 4, 5 * column : 5 * column + 5] == (i if i < count else 255)).all()


def test_table_is_aligned_and_in_millimetres():
    """Distances are told in mm, rates in percent; a column that a policy lacks is left out of all."""
    summary = {"return": 1.5, "success": 0.25, "distance": 0.0123, "failed": 0.0}
    lines = table({"trained": summary | {"distance_p25": 0.01}, "none": summary}).splitlines()
    assert len({len(line) for line in lines}) == 1
    assert lines[1].split() == ["trained", "1.50", "25", "12.3", "0"]


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["train", "--help"], ["bench", "--help"]])
def test_a_reader_that_goes_away_is_no_error(arguments, monkeypatch):
    """``softwarp --help | head -1``: no traceback, exit code 0."""
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as broken:
        monkeypatch.setattr(sys, "stdout", broken)
        assert cli.main(arguments) == 0
