"""``import softwarp`` is light: what a command does not use is not loaded."""

import json
import subprocess
import sys

HEAVY = ("scipy", "torch", "torchrl", "tensordict", "pxr", "hydra", "omegaconf", "matplotlib", "trimesh", "meshio")
PROBE = """
import json, sys, time
import warp, numpy
start = time.process_time()
import softwarp
seconds = time.process_time() - start
print(json.dumps({"seconds": seconds, "loaded": [name for name in sys.argv[1:] if name in sys.modules]}))
"""


def probe() -> dict:
    """Import softwarp in a fresh interpreter; heavy modules it loaded, and processor seconds beyond Warp and NumPy."""
    done = subprocess.run([sys.executable, "-c", PROBE, *HEAVY], capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def test_import_loads_nothing_heavy():
    """Torch, TorchRL, USD, Hydra and Matplotlib load when first used, and quickly enough to be unnoticed."""
    result = probe()
    assert result["loaded"] == []
    assert result["seconds"] < 1.0
