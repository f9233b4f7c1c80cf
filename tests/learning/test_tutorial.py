"""The tutorial does what it says: its files, its commands, as a reader types them."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = (Path(__file__).parents[2] / "docs" / "tutorials" / "own_finger.md").read_text(encoding="utf-8")
FILES = dict(re.findall(r"^<!-- file: (\S+) -->\n```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL))
COMMANDS = "".join(re.findall(r"^<!-- commands -->\n```bash\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)).splitlines()
SHORT = {
    "train": ["total_steps=32", "num_worlds=2", "algo.horizon=8", "algo.minibatches=2", "evaluations=1"],
    "eval": ["episodes=2"],
    "render": ["width=64", "height=48"],
}


def follow(folder: Path, short: bool) -> None:
    """Write the files and type the commands in a folder."""
    for name, text in FILES.items():
        (folder / name).write_text(text, encoding="utf-8")
    for line in COMMANDS:
        program, *words = shlex.split(line, comments=True)
        more = SHORT.get(words[0], []) if short and "--help" not in words else []
        more = [*more, "evaluation_episodes=2"] if more and words[0] == "train" else more
        module = ["-m", "softwarp"] if program == "softwarp" else []
        subprocess.run([sys.executable, *module, *words, *more], cwd=folder, check=True, timeout=900)


def test_commands_work(tmp_path):
    assert sum(bool(line.strip()) for line in FILES["finger.py"].splitlines()) < 60, "lines of own code"
    follow(tmp_path, short=True)
    assert all((tmp_path / name).stat().st_size > 1000 for name in ("finger.png", "finger.gif", "finger.usdc"))


@pytest.mark.slow
def test_finger_reaches_heights(tmp_path):
    follow(tmp_path, short=False)
    told = tmp_path / "told.json"
    command = [sys.executable, "-m", "softwarp", "eval", "run", f"--json={told}", "--baselines"]
    subprocess.run(command, cwd=tmp_path, check=True)
    policies = json.loads(told.read_text())["policies"]
    assert policies["trained"]["distance"] < min(0.001, 0.25 * policies["nothing"]["distance"]), "m, medians"
