"""Random play of balls, cubes and a soft finger: nothing sinks in, tunnels or fails (benchmarks/robustness.py)."""

from types import ModuleType

import pytest
import torch

from softwarp import cli


@pytest.fixture
def robustness() -> ModuleType:
    """The benchmark as a module."""
    return cli.script("benchmarks", "robustness")


@pytest.mark.parametrize(
    ("worlds", "steps", "device"),
    [
        (4, 60, "cpu"),
        pytest.param(16, 100, "cpu", marks=pytest.mark.slow),
        pytest.param(64, 500, "cpu", marks=pytest.mark.slow),
        pytest.param(1024, 100, "cuda:0", marks=[pytest.mark.slow, pytest.mark.cuda]),
    ],
)
def test_depths_of_random_play(robustness: ModuleType, worlds: int, steps: int, device: str) -> None:
    """Depth below 1 % of the smaller body in 99.9 % of world-steps, nobody leaves, every failure is counted."""
    room = robustness.Room(robustness.Scene(seed=3), worlds, device, seed=5, contact_passes=robustness.PASSES)
    watch = robustness.Watch(room)
    watch.run(steps)
    record = watch.report()
    assert record["world_steps"] + sum(record["failed"].values()) == worlds * steps
    assert record["depth_percent"]["any"]["p99.9"] < 1.0
    assert record["depth_percent"]["any"]["touching"] > 0.5
    assert record["tunnelled"] == record["engulfed"] == 0
    assert sum(record["failed"].values()) <= 1e-4 * worlds * steps
    assert torch.isfinite(room.sim.body_pose).all()
    assert torch.isfinite(room.sim.node_x).all()
