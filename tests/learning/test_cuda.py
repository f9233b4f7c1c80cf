"""Training on a GPU: every tensor of an update lives on the environment's device."""

import pytest

from softwarp import cli


@pytest.mark.cuda
def test_training_runs_on_cuda(tmp_path, monkeypatch):
    """Two updates, an evaluation, a checkpoint, and a resumed run that goes on from it."""
    monkeypatch.chdir(tmp_path)
    size = ["num_worlds=64", "env.mesh=coarse", "evaluations=1", "evaluation_episodes=8", "logger=csv"]
    budget = ["algo.horizon=8", "total_steps=1024", "device=cuda:0"]
    assert cli.main(["train", "env=trunk", "algo=ppo", *size, *budget, "out=run"]) == 0
    assert (tmp_path / "run" / "best.pt").is_file()
    assert cli.main(["train", "--resume", "run", "total_steps=2048"]) == 0
