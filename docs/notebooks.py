"""Tutorials as notebooks: a page of ``tutorials/`` is text and cells, and its cells, in order, are one program.

    python docs/notebooks.py write FOLDER             # a notebook, .ipynb, of every tutorial
    python docs/notebooks.py run PAGE.md [--short]    # carry a tutorial out, here, from top to bottom

Blocks of Python are cells that share their names; blocks of bash are cells of commands. A comment in the line before a
block makes it something else: ``<!-- file: NAME -->`` writes it to a file instead, ``<!-- not run -->`` leaves it as
text, and ``<!-- short: OLD => NEW; ... -->`` says what is replaced in it where the tutorial is only tested. The site
offers every tutorial as a notebook.
"""

import argparse
import json
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

TUTORIALS = Path(__file__).resolve().parent / "tutorials"
BLOCK = re.compile(
    r"^(?:<!-- (?P<note>[^\n]*?) -->\n)?```(?P<language>python|bash)\n(?P<body>.*?)^```$\n?", re.MULTILINE | re.DOTALL
)
LINK = re.compile(r"(\]\()(?!https?:|#)[^)]*/([^)/]+)\)")


@dataclass(frozen=True)
class Cell:
    """A piece of a page."""

    kind: Literal["text", "python", "bash", "file"]
    source: str
    file: str = ""  # to write
    short: tuple[tuple[str, str], ...] = ()  # what stands instead of what, where it is only tested

    def shortened(self) -> str:
        """The source for a test.

        Raises:
            ValueError: If what is to be replaced is not there.
        """
        source = self.source
        for old, new in self.short:
            if old not in source:
                raise ValueError(f"{old!r} is to be replaced by {new!r}, but is not in the block:\n{self.source}")
            source = source.replace(old, new)
        return source


def cells(page: str) -> list[Cell]:
    """The pieces of a page in Markdown."""
    found, end = [], 0
    for match in BLOCK.finditer(page):
        note = match["note"] or ""
        if note == "not run":
            continue
        found.append(Cell("text", page[end : match.start()].strip()))
        end = match.end()
        if note.startswith("file: "):
            found.append(Cell("file", match["body"], file=note.removeprefix("file: ")))
        else:
            pairs = note.removeprefix("short: ").split("; ") if note.startswith("short: ") else []
            short = tuple((old, new) for old, new in (pair.split(" => ") for pair in pairs))
            found.append(Cell("python" if match["language"] == "python" else "bash", match["body"], short=short))
    return [cell for cell in [*found, Cell("text", page[end:].strip())] if cell.source]


def notebook(page: str) -> dict[str, Any]:
    """The notebook of a page, as its file has it (nbformat 4.5)."""
    made = []
    for number, cell in enumerate(cells(page)):
        head = {"bash": "%%bash\n", "file": f"%%writefile {cell.file}\n"}.get(cell.kind, "")
        text = LINK.sub(r"\1\2)", cell.source) if cell.kind == "text" else cell.source
        lines = (head + text.rstrip("\n")).splitlines(keepends=True)
        part: dict[str, Any] = {"id": f"cell-{number}", "metadata": {}, "source": lines}
        part |= {"cell_type": "markdown"} if cell.kind == "text" else {"cell_type": "code"}
        made.append(part | ({} if cell.kind == "text" else {"execution_count": None, "outputs": []}))
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {"nbformat": 4, "nbformat_minor": 5, "metadata": {"kernelspec": kernel}, "cells": made}


def run(page: Path, *, short: bool) -> None:
    """Carry a page out in the working folder, its ``softwarp`` commands in this process.

    Raises:
        RuntimeError: If a command fails.
    """
    from softwarp import cli

    names: dict[str, Any] = {"__name__": "__main__"}
    sys.path.insert(0, "")  # files that the page writes
    for number, cell in enumerate(cells(page.read_text(encoding="utf-8"))):
        source = cell.shortened() if short else cell.source
        if cell.kind == "file":
            Path(cell.file).write_text(source, encoding="utf-8")
        elif cell.kind == "python":
            exec(compile(source, f"{page.name}, cell {number}", "exec"), names)
        elif cell.kind == "bash":
            for line in source.replace("\\\n", " ").splitlines():
                program, *words = shlex.split(line, comments=True) or [""]
                if program == "softwarp":
                    code = cli.main(words)
                else:
                    line = (
                        f"{shlex.quote(sys.executable)}{line.removeprefix('python')}" if program == "python" else line
                    )
                    code = subprocess.run(["bash", "-c", line], check=False).returncode
                if code:
                    raise RuntimeError(f"{page.name}: {line!r} ended with {code}")


def write(folder: Path) -> list[Path]:
    """Write all tutorials as notebooks; returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for page in sorted(TUTORIALS.glob("*.md")):
        path = folder / f"{page.stem}.ipynb"
        path.write_text(json.dumps(notebook(page.read_text(encoding="utf-8")), indent=1) + "\n", encoding="utf-8")
        paths.append(path)
    return paths


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    verbs.add_parser("write", help="notebooks of all tutorials").add_argument("folder", type=Path)
    running = verbs.add_parser("run", help="carry a tutorial out")
    running.add_argument("page", type=Path)
    running.add_argument("--short", action="store_true", help="with the settings of the tests")
    given = parser.parse_args()
    if given.verb == "write":
        for path in write(given.folder):
            print(path)
    else:
        run(given.page.resolve(), short=given.short)
