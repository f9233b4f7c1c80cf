"""The tutorial does what it says: its files, its commands, as a reader types them."""

import json
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from experiments import config
from softwarp import cli

PAGE = (Path(__file__).parents[2] / "docs" / "tutorials" / "own_finger.md").read_text(encoding="utf-8")
FILES = dict(re.findall(r"^<!-- file: (\S+) -->\n```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL))
COMMANDS = "".join(re.findall(r"^<!-- commands -->\n```bash\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)).splitlines()
SHORT = {
    "train": [
        "total_steps=32",
        "num_worlds=2",
        "algo.horizon=8",
        "algo.minibatches=2",
        "evaluations=1",
        "evaluation_episodes=2",
    ],
    "eval": ["episodes=2"],
    "render": ["width=64", "height=48"],
}


def write_files(folder: Path) -> None:
    for name, text in FILES.items():
        (folder / name).write_text(text, encoding="utf-8")


def test_own_code_is_short():
    assert sum(bool(line.strip()) for line in FILES["finger.py"].splitlines()) < 60, "lines of own code"


@pytest.mark.slow
def test_commands_work(tmp_path, monkeypatch):
    """All of them with small settings, in this process."""
    write_files(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(config, "OWN", {})
    for line in COMMANDS:
        program, *words = shlex.split(line, comments=True)
        if program == "python":
            runpy.run_path(words[0], run_name="__main__")
        else:
            small = [] if "--help" in words else SHORT.get(words[0], [])
            assert cli.main([*words, *small]) == 0, line
    assert all((tmp_path / name).stat().st_size > 1000 for name in ("finger.png", "finger.gif", "finger.usdc"))
    del sys.modules["finger"]


@pytest.mark.slow
def test_finger_reaches_heights(tmp_path):
    write_files(tmp_path)
    for line in COMMANDS:
        program, *words = shlex.split(line, comments=True)
        module = ["-m", "softwarp"] if program == "softwarp" else []
        subprocess.run([sys.executable, *module, *words], cwd=tmp_path, check=True, timeout=900)
    told = tmp_path / "told.json"
    command = [sys.executable, "-m", "softwarp", "eval", "run", f"--json={told}", "--baselines"]
    subprocess.run(command, cwd=tmp_path, check=True)
    policies = json.loads(told.read_text())["policies"]
    assert policies["trained"]["distance"] < min(0.001, 0.25 * policies["nothing"]["distance"]), "m, medians"
