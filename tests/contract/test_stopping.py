"""Commands on a terminal with an environment whose step takes long: they tell how far they are, and end soon."""

import time
from pathlib import Path

import pytest

from tests.contract.terminal import Terminal

SLOW = """
import sys, time
from softwarp import cli
from softwarp.envs.tasks.cart_pole import CartPole

simulate = CartPole._simulate

def slowly(self, action):
    time.sleep(1.0)
    simulate(self, action)

CartPole._simulate = slowly
sys.exit(cli.main(sys.argv[1:]))
"""
SMALL = ["num_worlds=2", "algo.horizon=64", "logger.picture=false", "env=cart_pole"]
SOON = 15.0  # s: a step of one second, a checkpoint, the end of a process, and a machine that does other things


@pytest.fixture
def program(tmp_path: Path) -> str:
    """A softwarp command in which a step of 64 that a rollout takes lasts a second."""
    (tmp_path / "slow.py").write_text(SLOW)
    return str(tmp_path / "slow.py")


@pytest.mark.slow
def test_training_stops_within_a_step(program: str, tmp_path: Path) -> None:
    """Ctrl-C is answered at once, the run ends with what it has begun, and goes on with that."""
    terminal = Terminal(program, "train", *SMALL, "out=run", cwd=tmp_path)
    terminal.read(r" [46] steps +\d")
    pressed = terminal.interrupt()
    terminal.read("stopping after this step")
    assert terminal.wait() == 130
    assert time.monotonic() - pressed < SOON
    assert "of a rollout that was begun" in terminal.text
    assert "go on with: softwarp train --resume run" in terminal.text
    terminal = Terminal(program, "train", "--resume", "run", "time_limit=4", cwd=tmp_path)
    begun = int(terminal.read(r" (\d+) steps +\d").split(" steps")[0].split()[-1])
    assert begun >= 6
    assert terminal.wait() == 0
    assert "0:0" in terminal.text


@pytest.mark.slow
def test_other_verbs_tell_and_stop(program: str, tmp_path: Path) -> None:
    """An evaluation tells which step it is at; Ctrl-C ends it after that."""
    terminal = Terminal(program, "eval", "env=cart_pole", "policy=scripted", "episodes=2", cwd=tmp_path)
    terminal.read("running episodes: 0 of 2 are over, step [34]")
    pressed = terminal.interrupt()
    assert terminal.wait() == 130
    assert time.monotonic() - pressed < SOON
    assert "softwarp eval: interrupted" in terminal.text
