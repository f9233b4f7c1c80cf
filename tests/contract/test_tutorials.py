"""Tutorials keep their word: each one works from top to bottom, and opens as a notebook."""

import json
import runpy
import sys
from pathlib import Path

import pytest

from tests import forked

ROOT = Path(__file__).parents[2]
NOTEBOOKS = runpy.run_path(str(ROOT / "docs" / "notebooks.py"))
PAGES = sorted(path for path in NOTEBOOKS["TUTORIALS"].glob("*.md") if path.stem != "own_finger")  # has its own test


@pytest.mark.slow  # .ci/docs.sh runs them
@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_tutorials_work(page, tmp_path):
    """All their cells, one after the other, in an empty folder, with small settings."""
    done = forked.run([ROOT / "docs" / "notebooks.py", "run", page, "--short"], tmp_path)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]


@pytest.mark.parametrize("page", sorted(NOTEBOOKS["TUTORIALS"].glob("*.md")), ids=lambda path: path.stem)
def test_short_forms_fit(page):
    """What a short form replaces is there."""
    cells = NOTEBOOKS["cells"](page.read_text(encoding="utf-8"))
    assert [cell.shortened() for cell in cells if cell.kind != "text"]


def test_notebooks(tmp_path):
    """A notebook has the page's text and blocks, in order, and files and commands as magics."""
    paths = {path.stem: json.loads(path.read_text()) for path in NOTEBOOKS["write"](tmp_path)}
    assert len(paths) == len(PAGES) + 1
    made = paths["own_finger"]
    sources = ["".join(cell["source"]) for cell in made["cells"]]
    assert sources[0].startswith("# Your own robot")
    assert any(source.startswith("%%writefile finger.py\n") for source in sources)
    assert any(source.startswith("%%bash\n") for source in sources)
    assert len({cell["id"] for cell in made["cells"]}) == len(sources)
    nbformat = pytest.importorskip("nbformat", reason="the package nbformat is not installed")
    for notebook in paths.values():
        nbformat.validate(notebook)


def test_what_cannot_be_shortened_is_told():
    """A page that has changed under its short form fails, and says where."""
    (cell,) = NOTEBOOKS["cells"]("<!-- short: episodes=64 => episodes=2 -->\n```bash\nsoftwarp list\n```\n")
    with pytest.raises(ValueError, match="'episodes=64' is to be replaced"):
        cell.shortened()


def test_a_command_that_fails_is_told(tmp_path, monkeypatch):
    """A tutorial whose command fails ends there."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    page = tmp_path / "page.md"
    page.write_text("```bash\nfalse\n```\n")
    with pytest.raises(RuntimeError, match="'false' ended with 1"):
        NOTEBOOKS["run"](page, short=False)
