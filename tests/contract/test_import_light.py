"""``import softwarp`` is light: what a command does not use is not loaded, nor what a mistaken one would have used."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

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


def test_mistakes_are_told_before_anything_slow_is_loaded(tmp_path):
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
    )
    arguments = json.dumps([text.split() for text in mistakes])
    command = [sys.executable, "-c", MISTAKES, arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path, env=ENVIRONMENT)
    result = json.loads(done.stdout.splitlines()[-1])
    assert result == {"codes": [2] * len(mistakes), "loaded": []}, done.stderr
    assert len(done.stderr.splitlines()) >= len(mistakes)
    assert not list(tmp_path.iterdir())


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
