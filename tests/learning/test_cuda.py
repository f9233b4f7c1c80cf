"""Training on a GPU: every tensor of an update lives on the environment's device."""

import pytest

from softwarp import cli

ALGORITHMS = {
    "ppo": ["algo.horizon=8"],
    "memory": ["algo.horizon=8", "network.recurrent=16"],
    "sac": ["algo.horizon=2", "algo.warmup_steps=256", "algo.update_ratio=0.02"],
    "sac_avec": ["algo.horizon=2", "algo.warmup_steps=256", "algo.update_ratio=0.02", "algo.prioritized=true"],
}


@pytest.mark.cuda
@pytest.mark.parametrize("kind", ALGORITHMS)
@pytest.mark.parametrize("env", ["cart_stem", "trunk"])
def test_training_runs_on_cuda(tmp_path, monkeypatch, kind, env):
    """Some updates, an evaluation, a checkpoint, and a resumed run that goes on from it."""
    monkeypatch.chdir(tmp_path)
    size = [
        "num_worlds=64",
        "evaluations=1",
        "evaluation_episodes=8",
        "logger=csv",
        "device=cuda:0",
        "total_steps=1024",
    ]
    mesh = ["env.mesh=coarse"] if env == "trunk" else []
    algo = kind if "_" in kind or kind == "sac" else "ppo"
    assert cli.main(["train", f"env={env}", f"algo={algo}", *size, *mesh, *ALGORITHMS[kind], "out=run"]) == 0
    assert (tmp_path / "run" / "best.pt").is_file()
    assert cli.main(["train", "--resume", "run", "total_steps=2048"]) == 0
