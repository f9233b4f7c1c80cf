"""No kernel reads or writes past the end of an array: environments in Warp's debug mode, which checks indices."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

import softwarp as sw
from softwarp import interop, meshing
from softwarp.envs import registry

# Not done after minutes in this mode, whose code is not optimised; SimpleMaze and MultiGaitReduced have their parts.
TOO_SLOW = {"Maze", "MultiGaitFull"}
ROOT = Path(__file__).parents[2]


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Steps in a process of its own, which an index out of bounds ends."""
    command = [sys.executable, "-m", "tests.debug_steps", str(folder), *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """For the kernels of that mode."""
    return tmp_path_factory.mktemp("debug")


@pytest.mark.slow
def test_a_read_past_the_end_is_found(folder: Path) -> None:
    """Else the other tests would prove nothing."""
    done = run(folder)
    assert done.returncode != 0
    assert "Assertion failed" in done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in registry.names() if name not in TOO_SLOW])
def test_environments_stay_within_their_arrays(name: str, folder: Path) -> None:
    """One world, and nine, which fill more than a pack of lanes; steps by random actions, and a reset of one world."""
    done = run(folder, name, "1", "9")
    assert done.returncode == 0, (done.stdout + done.stderr)[-2000:]
    assert f"{name} with 9 worlds: fine" in done.stdout


def falling() -> sw.Simulation:
    """A cube of a cell, held on one side."""
    builder = sw.ModelBuilder()
    size = (0.1, 0.1, 0.1)
    body = builder.add_tets(meshing.box(size, (1, 1, 1)), material=sw.Corotational(1e5, 0.4), density=1000.0)
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    return sw.Simulation(builder.finalize(num_worlds=1), dt=0.01)


def test_steps_that_are_not_recorded_have_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in debug mode on a CPU."""
    recorded, launched = falling(), falling()
    recorded.step(3)
    for _ in range(3):
        recorded.step()
    monkeypatch.setattr(interop, "records", lambda device: False)
    for _ in range(6):
        launched.step()
    assert launched._graphs is None
    assert recorded._graphs is not None
    assert torch.equal(recorded.node_x, launched.node_x)


def test_debug_mode_records_on_a_gpu_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replays of that mode crash on a CPU."""
    assert interop.records("cpu")
    monkeypatch.setattr("warp.config.mode", "debug")
    assert not interop.records("cpu")
