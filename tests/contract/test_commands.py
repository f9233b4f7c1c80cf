"""Commands of the documentation: each is run in a short form, or says how long it takes; settings of all are accepted.

The cells of tutorials are run by ``test_tutorials``, the README's installations by CI itself.
"""

import importlib.util
import json
import re
import shlex
from dataclasses import dataclass
from pathlib import Path

import pytest

from softwarp import cli
from tests import forked

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    path
    for path in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    if path.parent.name != "tutorials"  # test_tutorials
)
BLOCK = re.compile(r"^(?P<before>[^\n]*)\n+(?:<!-- (?P<note>[^\n]*?) -->\n)?^```bash\n(?P<body>.*?)^```$", re.M | re.S)
TIME = re.compile(r"\b(seconds?|minutes?|hours?|days?|\d+ (s|min|h))\b")
INSTALLS = re.compile(r"(python3 -m venv|pip install)\b")

FEW = "env.max_episode_steps=4"
SMALL = f"num_worlds=4 total_steps=64 evaluations=1 evaluation_episodes=2 {FEW}"
PICTURE = f"width=64 height=48 {FEW}"
FILES = (
    "trunk.mp4",
    "diamond.png",
    "trunk.usdc",
    "arm.pt2",
    "plan.json",
    "demos.npz",
    "film.npz",
    "film.usdc",
    "page.html",
)
# Beginning of a command, what is added to it, a package that it needs: carried out page by page, in this order.
SHORT: dict[str, tuple[tuple[str, str, str], ...]] = {
    "README.md": (
        ("softwarp train env=trunk", f"out=runs/NAME env.mesh=coarse algo.horizon=8 algo.minibatches=2 {SMALL}", ""),
        ("softwarp train experiment=fast/cartstem", f"out=runs/arm {SMALL}", ""),
        ("softwarp train --resume runs/NAME", "", ""),
        ("softwarp eval runs/NAME", f"episodes=2 {FEW}", ""),
        ("softwarp view env=trunk", "env.mesh=coarse seconds=0.5 port=8400", "viser"),
        ("softwarp render runs/NAME", PICTURE, "av"),
        ("softwarp render env=diamond", f"env.mesh=coarse {PICTURE}", ""),
        ("softwarp export runs/NAME", FEW, ""),
        ("softwarp list", "", ""),
    ),
    "docs/README.md": ((".venv/bin/softwarp view env=trunk", "env.mesh=coarse seconds=0.5 port=8400", "viser"),),
    "docs/deploy.md": (
        ("softwarp policy export runs/arm arm.onnx", "", "onnxscript"),
        ("softwarp policy export runs/arm arm.pt2", "", ""),
    ),
    "docs/paper.md": (("softwarp paper FOLDER --report-only", "", ""),),
    "docs/planning.md": (
        ("softwarp plan env=cart_stem_contact", "planner.expansions=50 progress=false episodes=1", ""),
        ("softwarp plan env=diamond", "env.mesh=coarse planner.expansions=4 progress=false", ""),
        ("softwarp plan --replay plan.json", "", ""),
    ),
    "docs/training.md": (
        ("softwarp train env=cart_stem ", f"out=runs/stem {SMALL}", ""),
        ("softwarp train experiment=fast/cartstem", f"out=runs/arm {SMALL}", ""),
        ("softwarp train --resume runs/NAME", "", ""),
        ("softwarp train --cfg job", "", ""),
        ("softwarp record demos.npz", f"episodes=4 num_worlds=4 {FEW}", ""),
        ("softwarp train env=cart_stem_contact", f"out=runs/contact cloning.epochs=1 {SMALL}", ""),
    ),
    "docs/view.md": (
        ("softwarp view env=trunk", "env.mesh=coarse seconds=0.5 port=8400", "viser"),
        ("softwarp view env=gripper", "env.finger=plain seconds=0.5 port=8400", "viser"),
        ("softwarp view env=diamond", "env.mesh=coarse seconds=0.5 port=8400", "viser"),
        ("softwarp export runs/NAME film.npz", FEW, ""),
        ("softwarp view film.npz", "seconds=0.3 port=8400", "viser"),
        ("softwarp view runs/NAME", f"{FEW} seconds=0.3 port=8400", "viser"),
        ("softwarp view plan.json", "seconds=0.3 port=8400", "viser"),
        ("softwarp export env=gripper", f"env.finger=plain {FEW}", "viser"),
        ("softwarp export film.npz film.usdc", "", ""),
    ),
}


@dataclass(frozen=True)
class Command:
    """A line that a reader may copy, with what is said about it."""

    page: str
    line: str
    told: str  # its comment, and the line before its block

    @property
    def is_long(self) -> bool:
        return TIME.search(self.told) is not None

    @property
    def short(self) -> tuple[str, str, str] | None:
        """How it is carried out here."""
        return next((entry for entry in SHORT.get(self.page, ()) if self.line.startswith(entry[0])), None)


def commands(path: Path) -> list[Command]:
    """All commands of a page."""
    found = []
    for block in BLOCK.finditer(path.read_text(encoding="utf-8")):
        if block["note"] in ("main", "test"):
            continue
        for line in block["body"].replace("\\\n", " ").splitlines():
            command, _, comment = line.partition(" #")
            if command.strip() and not command.startswith("#"):
                name = path.relative_to(ROOT).as_posix()
                found.append(Command(name, " ".join(command.split()), f"{comment} {block['before']}"))
    return found


ALL = [command for page in PAGES for command in commands(page)]


def test_every_command_is_run_or_says_how_long_it_takes():
    """A new line in a page of the documentation belongs into ``SHORT``, or says its time in its comment or above."""
    for command in ALL:
        if INSTALLS.search(command.line):
            continue
        assert command.short or command.is_long, f"{command.page}: {command.line!r} is neither run nor says its time"
    for page, entries in SHORT.items():
        lines = [command.line for command in ALL if command.page == page]
        for start, *_ in entries:
            assert any(line.startswith(start) for line in lines), f"{page} has no command {start!r} any more"


@pytest.mark.parametrize("page", ["docs/training.md", pytest.param("", marks=pytest.mark.slow)])
def test_settings_of_trainings_are_accepted(capsys, page):
    """Long trainings, too, begin: their settings compose; of one page, or of all."""
    lines = [c.line for c in ALL if c.line.startswith("softwarp train ") and c.page.startswith(page)]
    assert len(lines) > (3 if page else 10)
    for line in lines:
        words = shlex.split(line)[2:]
        if words[0] in ("--resume", "--cfg", "-m"):  # runs of before, and sweeps, which Hydra does not print
            continue
        assert cli.main(["train", "--cfg", "job", *words]) == 0, f"{line}: {capsys.readouterr().err}"


ONE_AFTER_THE_OTHER = """
import json, sys
from softwarp import cli
for words in json.loads(sys.argv[1]):
    code = cli.main(words)
    if code:
        sys.exit(f"softwarp {' '.join(words)} ended with {code}")
"""


def short_commands() -> dict[tuple[str, ...], str]:
    """What is carried out, in order, with the page that it was first found on."""
    found: dict[tuple[str, ...], str] = {}
    for page in SHORT:
        for command in ALL:
            if command.page == page and command.short:
                _, further, needed = command.short
                if not needed or importlib.util.find_spec(needed) is not None:
                    words = [*shlex.split(command.line.removeprefix(".venv/bin/"))[1:], *further.split()]
                    found.setdefault(tuple(words), page)
    return found


def test_commands_work(tmp_path):
    """The commands of all pages, one after the other, in an empty folder, with small settings.

    In one process, which loads packages and kernels once; what two pages tell is run once, and a run or a plan that one
    page makes the others use, as a reader would.
    """
    typed = short_commands()
    done = forked.run(["-c", ONE_AFTER_THE_OTHER, json.dumps(list(typed))], tmp_path, patience=900.0)
    assert done.returncode == 0, f"{done.stdout[-1500:]}{done.stderr[-3000:]}"
    for name in FILES:
        assert not any(name in words for words in typed) or (tmp_path / name).stat().st_size > 500, name
