"""``import softwarp`` is light: what a command does not use is not loaded, nor what a mistaken one would have used."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from experiments import record, verbs
from experiments.config import ConfigError, TrainConfig, compose, to_plain
from softwarp.policies.baselines.names import NAMES, UNLEARNED
from softwarp.policies.baselines.table import RULES

ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}

HEAVY = (
    "warp",
    "scipy",
    "torch",
    "torchrl",
    "tensordict",
    "pxr",
    "hydra",
    "omegaconf",
    "matplotlib",
    "trimesh",
    "meshio",
)
PROBE = """
import json, sys, time
import numpy
start = time.process_time()
import softwarp
seconds = time.process_time() - start
print(json.dumps({"seconds": seconds, "loaded": [name for name in sys.argv[1:] if name in sys.modules]}))
"""


def probe() -> dict:
    """Import softwarp in a fresh interpreter; heavy modules it loaded, and processor seconds beyond NumPy."""
    done = subprocess.run([sys.executable, "-c", PROBE, *HEAVY], capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def test_import_loads_nothing_heavy():
    """Torch, TorchRL, USD, Hydra and Matplotlib load when first used, and quickly enough to be unnoticed."""
    result = probe()
    assert result["loaded"] == []
    assert result["seconds"] < 1.0


MISTAKES = """
import json, sys
from softwarp import cli

codes = [cli.main(arguments) for arguments in json.loads(sys.argv[1])]
print(json.dumps({"codes": codes, "loaded": [name for name in ("torch", "warp") if name in sys.modules]}))
"""


@pytest.mark.parametrize("every", [3, pytest.param(1, marks=pytest.mark.slow)])
def test_mistakes_are_told_before_anything_slow_is_loaded(tmp_path, every):
    """A mistyped verb, choice, setting, value, run, ending of a file: neither Torch nor Warp is waited for."""
    mistakes = (
        "trian",
        "train env=trnk",
        "train env=trunk algo.learning_rte=1",
        "train env=trunk env.yungs=1",
        "train env=diamond env.youngs=soft",
        "train experiment=fast/cartstm",
        "train seed=-1",
        "train --resume no/such/run",
        "eval no/such/run",
        "render runs/x out.xyz",
        "export runs/x out.usdx",
        "demo here algo.gama=0.9",
        "demo here device=gpu",
        "train env=trunk device=cuda1",
        "train --resume run env.yungs=1",
        "train --resume run device=gpu",
        "eval env=trnk policy=inverse",
        "eval env=trunk policy=scriptd",
        "eval env=trunk episodes=soft",
        "eval env=trunk device=gpu",
        "eval env=trunk --baselines",
        "eval run env.yungs=300e3",
        "eval run episods=3",
        "eval empty",
        "render run out.png env.youngs=soft",
        "render run out.png env.youngs=-1",
        "render env=trunk policy=inverse out.png wdth=3",
        "render env=trunk policy=inverse out.png width=0",
        "render policy=no.json out.png",
        "render env=trnk policy=inverse out.png",
        "export env=trunk policy=inverse out.usda stres=false",
        "export env=trunk policy=invers out.usda",
        "export env=trunk policy=inverse device=cuda:x out.usda",
        "record out.foo env=cart_stem",
        "record out.npz env=cart_stem episodes=0",
        "record out.npz env=cart_stem policy=scripte",
        "record out.npz env=cart_stem noise=2",
        "plan env=cart_stem_contact planner=cme",
        "plan env=cart_stem_contact planner=cem out=plan.txt",
        "plan env=cart_stem_contact planner=cem device=gpu",
        "plan env=cart_stem_contact planner=cem planner.iteratons=3",
        "plan --replay no.json",
        "policy export nowhere out.onnx",
        "policy export run out.xyz",
        "policy time nowhere",
    )[::every]
    saved_run(tmp_path / "run")
    (tmp_path / "empty").mkdir()
    before = sorted(tmp_path.rglob("*"))
    arguments = json.dumps([text.split() for text in mistakes])
    command = [sys.executable, "-c", MISTAKES, arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path, env=ENVIRONMENT)
    result = json.loads(done.stdout.splitlines()[-1])
    assert result == {"codes": [2] * len(mistakes), "loaded": []}, done.stderr
    assert len(done.stderr.splitlines()) >= len(mistakes)
    assert sorted(tmp_path.rglob("*")) == before


def saved_run(folder: Path) -> None:
    """What a run looks like to those who do not read its checkpoint."""
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "checkpoints" / "step_0.pt").write_bytes(b"")
    settings = to_plain(compose("train", TrainConfig, ["env=trunk", "algo=ppo"]))
    OmegaConf.save(OmegaConf.create(settings), folder / "config.yaml")


def test_settings_for_a_run_are_looked_at_by_the_file_beside_it(tmp_path):
    """By its folder or a checkpoint in it; where the file cannot be read, the checkpoint tells later."""
    saved_run(tmp_path)
    for run in (tmp_path, tmp_path / "checkpoints" / "step_0.pt"):
        verbs.check_of_run(str(run), ["env.youngs=300e3"])
        with pytest.raises(ConfigError, match=r"there is no 'env.yungs'; did you mean 'env.youngs'"):
            verbs.check_of_run(str(run), ["env.yungs=300e3"])
    (tmp_path / "config.yaml").write_text("env: [")
    verbs.check_of_run(str(tmp_path), ["env.yungs=300e3"])


@pytest.mark.parametrize("known", [True, False])
def test_gpus_are_refused_at_once_without_a_driver(monkeypatch, known):
    """With one it is Torch that knows how many there are."""
    monkeypatch.setattr(verbs, "has_driver", lambda: known)
    verbs.check_device("cpu")
    if known:
        verbs.check_device("cuda:7")
    else:
        with pytest.raises(ConfigError, match=r"device 'cuda:7' is not available; this machine has cpu"):
            verbs.check_device("cuda:7")


def test_names_of_policies_are_those_of_the_table():
    """Commands know the names before the functions are loaded."""
    assert {name: tuple(rules) for name, rules in RULES.items()} == NAMES
    assert set(UNLEARNED) == set(record.UNLEARNED)


def test_names_are_loaded_when_they_are_used():
    """Every public name is there, listed by ``dir``, and the files too."""
    import softwarp

    for name in softwarp.__all__:
        assert getattr(softwarp, name) is not None
        assert name in dir(softwarp)
    assert softwarp.RigidMesh is softwarp.shapes.Mesh
    assert softwarp.threads.alone is not None
    assert softwarp.envs.registry.names()
    with pytest.raises(AttributeError, match="has no attribute 'Simulaton'; it has SDF, Box"):
        _ = softwarp.Simulaton
