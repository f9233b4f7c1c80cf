"""From demonstrations to a trained policy on the command line."""

import pytest

from softwarp import cli
from softwarp.training.checkpoints import load
from softwarp.training.demonstrations import Demonstrations


@pytest.mark.slow  # test_cloning and test_datasets have its parts
def test_recorded_cloned_and_trained_on(tmp_path, monkeypatch, capsys):
    """60 episodes of the hand-written policy are enough to balance; warm-up updates leave the clone as it is."""
    monkeypatch.chdir(tmp_path)
    assert cli.main(["record", "demos.npz", "env=cart_stem", "episodes=60", "num_worlds=60"]) == 0
    assert "4800 steps of 60 episodes, success 100%" in capsys.readouterr().out
    demos = Demonstrations.load(tmp_path / "demos.npz")
    assert demos.env["name"] == "CartStem"
    assert demos.observation.shape == (4800, 4)

    size = ["num_worlds=32", "algo.horizon=8", "total_steps=512", "evaluations=1", "evaluation_episodes=32"]
    cloning = ["cloning.path=demos.npz", "cloning.epochs=30", "algo.warmup_updates=2"]
    assert cli.main(["train", "env=cart_stem", "out=run", "logger=quiet", *size, *cloning]) == 0
    assert "cloned demos.npz: epochs" in capsys.readouterr().err
    assert load(tmp_path / "run" / "best.pt")["evaluation"]["return"] > 70.0

    assert (
        cli.main(["record", "again.npz", "env=cart_stem", "policy=run", "episodes=8", "num_worlds=8", "noise=0"]) == 0
    )
    assert Demonstrations.load(tmp_path / "again.npz").returns.mean() > 70.0
    assert cli.main(["record", "demos.txt", "env=cart_stem"]) == 2
    assert cli.main(["record", "demos.npz", "env=cart_stem", "policy=nobody"]) == 2
    assert (
        "has no hand-written policy 'nobody'; there is: scripted, random, nothing; 'inverse' is inverse control"
        in capsys.readouterr().err
    )
    short = [*size, "cloning.path=demos.npz", "logger=quiet"]
    for number, (other, message) in enumerate(
        {
            "env=cart_pole": "recorded with name=CartStem, which does not fit name=CartPole",
            "env.observation=paper": "recorded with observation=scaled, which does not fit observation=paper",
            "env.action_kind=continuous": "recorded with action_kind=discrete",
        }.items()
    ):
        assert cli.main(["train", "env=cart_stem", other, f"out=other{number}", *short]) == 2
        assert message in capsys.readouterr().err
    assert cli.main(["record", "wrong.npz", "env=cart_pole", "policy=run", "episodes=2"]) == 2
    assert "policy run: made for CartStem, not for CartPole" in capsys.readouterr().err
