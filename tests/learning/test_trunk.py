"""PPO learns to reach with the trunk, clearly better than policies that learned nothing."""

import json

import pytest

from softwarp import cli

STEPS = 150_000  # per seed, summed over worlds


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_ppo_beats_policies_that_learned_nothing(tmp_path, monkeypatch, seed):
    """On 64 unseen goals the median final distance is below 10 mm and below half of every baseline's."""
    monkeypatch.chdir(tmp_path)
    budget = ["env.mesh=coarse", f"total_steps={STEPS}", "evaluations=3", f"seed={seed}", "out=run", "logger=csv"]
    assert cli.main(["train", "env=trunk", "algo=ppo", *budget]) == 0
    assert cli.main(["eval", "run", "episodes=64", "--baselines", "--json", "evaluation.json"]) == 0
    policies = json.loads((tmp_path / "evaluation.json").read_text())["policies"]
    trained = policies.pop("trained")
    assert set(policies) == {"nothing", "random", "scripted"}
    assert trained["episodes"] == 64
    assert trained["distance"] < 0.010
    for name, baseline in policies.items():
        assert trained["distance"] < 0.5 * baseline["distance"], name
        assert trained["return"] > baseline["return"], name
    assert trained["failed"] == 0.0
