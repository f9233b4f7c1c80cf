"""The examples run on every registered environment, and learn on one."""

import pytest

from experiments import cleanrl_ppo, sb3_ppo
from softwarp.envs import registry


@pytest.mark.slow
def test_single_file_ppo_learns_to_balance():
    """45 000 steps of the CleanRL-style file hold the sphere up far longer than random pushes (about 44 of 80)."""
    assert cleanrl_ppo.main(["softwarp/CartStem-v0", "--steps", "45000"]) > 55.0


@pytest.mark.parametrize("example", [cleanrl_ppo, sb3_ppo])
def test_batches_too_small_to_learn_from_are_refused(example, capsys):
    """Each minibatch needs two transitions."""
    with pytest.raises(SystemExit):
        example.main(["--worlds", "1", "--horizon", "7"])
    assert "--worlds times --horizon must be at least 8, got 7" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("name", registry.names())
def test_examples_take_every_environment(name, capsys):
    """A few updates of both, discrete and continuous actions alike."""
    options = ["--set", "mesh=coarse"] if name == "Trunk" else []
    sb3_ppo.main([name, "--steps", "128", "--worlds", "4", "--horizon", "16", *options])
    cleanrl_ppo.main([registry.spec(name).gym_id, "--steps", "128", "--worlds", "4", "--horizon", "16"])
    assert "128 steps" in capsys.readouterr().out


@pytest.mark.slow
def test_stable_baselines_learns_to_balance(capsys):
    """Stable-Baselines3's PPO comes close to 80 in 120 000 steps."""
    sb3_ppo.main(["CartStem", "--steps", "120000", "--worlds", "64", "--gamma", "0.99"])
    told = capsys.readouterr().out.splitlines()[-1]
    assert float(told.split("return ")[1].split(",")[0]) > 70.0
