"""Documentation keeps its word: links, code blocks, the README's commands and example, generated pages."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests import forked

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "assets").rglob("*.md")])
SOURCES = sorted(
    path
    for folder in ("softwarp", "experiments", "benchmarks", "tests", ".ci")
    for path in (ROOT / folder).rglob("*.py")
)
FENCE = re.compile(r"^(?P<fence>```+)(?P<language>\w*)[^\n]*\n(?P<body>.*?)^(?P=fence)$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"!?\[[^\]]*\]\((?P<target>[^)\s]+)\)|<img[^>]*src=\"(?P<image>[^\"]+)\"")


def page_id(path: Path) -> str:
    return str(path.relative_to(ROOT))


def anchors(path: Path) -> set[str]:
    """Fragments that the headings of a page answer to, as GitHub forms them."""
    text = FENCE.sub("", path.read_text(encoding="utf-8"))
    titles = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def blocks(path: Path, language: str) -> list[str]:
    return [
        match["body"] for match in FENCE.finditer(path.read_text(encoding="utf-8")) if match["language"] == language
    ]


@pytest.mark.parametrize("path", PAGES, ids=page_id)
def test_links_lead_somewhere(path):
    """Relative links name files of the repository, fragments name headings of them."""
    text = FENCE.sub("", path.read_text(encoding="utf-8"))
    for match in LINK.finditer(text):
        target = match["target"] or match["image"]
        if re.match(r"[a-z]+:", target):
            continue
        name, _, fragment = target.partition("#")
        linked = (path.parent / name).resolve() if name else path
        assert linked.exists(), f"{page_id(path)} links to {target}, which does not exist"
        assert linked.is_relative_to(ROOT), f"{page_id(path)} links to {target}, outside the repository"
        if fragment and linked.suffix == ".md":
            assert fragment in anchors(linked), f"{page_id(path)} links to {target}, which has no such heading"


@pytest.mark.parametrize("path", PAGES, ids=page_id)
def test_code_fits(path):
    """Python blocks are Python, and what they import or read from softwarp exists; shell blocks are shell."""
    import importlib

    for body in blocks(path, "python"):
        for node in ast.walk(ast.parse(body, page_id(path))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "softwarp":
                module = importlib.import_module(node.module)
                for alias in node.names:
                    if not hasattr(module, alias.name):
                        importlib.import_module(f"{node.module}.{alias.name}")
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "sw":
                assert hasattr(importlib.import_module("softwarp"), node.attr), f"{page_id(path)}: sw.{node.attr}"
    commands = blocks(path, "bash")
    if commands:
        subprocess.run(["bash", "-n"], input="\n".join(commands), text=True, check=True)


def test_pages_named_in_source_exist():
    """Docstrings and comments that send the reader to a page send them to one that is there."""
    own = {"test_kernel_rules.py", Path(__file__).name}
    for path in SOURCES:
        for name in re.findall(r"\bdocs/[\w/]+\.md\b", path.read_text(encoding="utf-8")):
            assert path.name in own or (ROOT / name).exists(), f"{page_id(path)} names {name}, which does not exist"


LONG_PAGES = {"README.md", *(f"docs/concepts/{name}.md" for name in ("elements", "meshes", "parts", "pictures"))}
LONG_PAGES |= {f"docs/{name}.md" for name in ("clients", "gradients", "identification", "transfer")}


def runnable() -> list[object]:
    """Pages with Python blocks under a line ``<!-- run -->``, and these."""
    marked = re.compile(r"^<!-- run -->\n```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
    found = [(path, marked.findall(path.read_text(encoding="utf-8"))) for path in PAGES]
    return [
        pytest.param(bodies, id=page_id(path), marks=pytest.mark.slow if page_id(path) in LONG_PAGES else ())
        for path, bodies in found
        if bodies
    ]


RUN_EACH = """
import os, runpy, sys
for number, program in enumerate(sys.argv[1:]):
    os.mkdir(f"block_{number}")
    os.chdir(f"block_{number}")
    runpy.run_path(program, run_name="__main__")
    os.chdir("..")
"""


@pytest.mark.parametrize("bodies", runnable())
def test_marked_code_runs(bodies, tmp_path):
    """Blocks that claim to run do, each as a program in an empty folder; those of a page share a process."""
    programs = [tmp_path / f"block_{number}.py" for number in range(len(bodies))]
    for program, body in zip(programs, bodies, strict=True):
        program.write_text(body, encoding="utf-8")
    done = forked.run(["-c", RUN_EACH, *programs], tmp_path)
    assert done.returncode == 0, done.stderr


def test_every_page_is_linked():
    """The index of the documentation leads to every page."""
    index = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in PAGES if path.is_relative_to(ROOT / "docs")}
    missing = {
        page for page in pages - {"README.md"} if f"]({page})" not in index and not page.startswith("environments/")
    }
    assert not missing, f"docs/README.md does not link {sorted(missing)}"


def test_generated_pages_are_up_to_date():
    """Running the generator would change nothing."""
    subprocess.run([sys.executable, str(ROOT / "docs" / "generate.py"), "--check"], check=True)


def readme_block(name: str) -> str:
    command = [sys.executable, str(ROOT / ".ci" / "readme.py"), name]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def test_readme_commands_are_the_documented_two():
    """One line installs and runs the main job, one installs and runs the tests."""
    assert len(readme_block("main").splitlines()) == 1
    assert readme_block("test").strip().endswith(".venv/bin/python -m pytest")


def test_readme_example_runs(tmp_path):
    """The example of the README works as printed, in an empty folder."""
    done = forked.run(["-c", readme_block("example")], tmp_path)
    assert done.returncode == 0, done.stderr


def test_every_status_has_its_cure():
    """The page for trouble has a row, with what helps, for all that steps, static solves and inverse control report."""
    from softwarp.model.codes import Outcome, StaticReason, Status

    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    rows = [line for line in page.splitlines() if line.startswith("| `")]
    for code in (*Status, *StaticReason, *Outcome):
        if code.name not in ("OK", "CONVERGED", "REACHED"):
            cells = [row.strip("| ").split(" | ") for row in rows if f"`{code.name}`" in row.split(" | ")[0]]
            assert cells and all(len(cell) >= 10 for row in cells for cell in row[1:]), f"{code!r} has no cure there"


def test_every_public_name_is_in_the_reference():
    """Packages with public names have a page on the site, with the docstring of every one of them."""
    import importlib
    import pkgutil
    import runpy

    pytest.importorskip("mkdocs", reason="the extra 'docs' is not installed")
    pytest.importorskip("latex2mathml", reason="the extra 'docs' is not installed")
    import softwarp

    site = runpy.run_path(str(ROOT / "docs" / "site.py"))
    named = {f"softwarp.{name}".rstrip(".") for name in (*site["PACKAGES"], *site["BY_FILE"])}
    for found in pkgutil.iter_modules(softwarp.__path__, "softwarp."):
        public = getattr(importlib.import_module(found.name), "__all__", []) if found.ispkg else []
        if not set(public) <= set(softwarp.__all__):
            assert found.name in named, f"{found.name} has public names, but no page in docs/site.py"
    shown: dict[str, str] = {}
    for name in site["PACKAGES"]:
        package = f"softwarp.{name}".rstrip(".")
        page, module = site["reference"](package, shown), importlib.import_module(package)
        for name in module.__all__:
            thing = getattr(module, name)
            assert f"{package}.{name}" in page or type(thing) is type(softwarp), f"{package}.{name} is on no page"
            assert getattr(thing, "__doc__", None), f"{package}.{name} has no docstring"
            if name in ("ModelBuilder", "Simulation"):  # most of what they do is defined in bases that nobody is shown
                method = {"ModelBuilder": "add_cable", "Simulation": "solve_static"}[name]
                assert method not in vars(thing) and method in site["inherited"](thing) and f"'{method}'" in page


def test_versions_of_the_site(tmp_path):
    """Versions that lie beside each other are listed newest first, and the start page leads to the newest release."""
    import json
    import runpy

    publish = runpy.run_path(str(ROOT / "docs" / "publish.py"))
    for name in ("0.9.0", "0.10.0", "0.10.0rc1", "images"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "index.html").write_text(name)
    assert publish["write_list"](tmp_path) == ["0.10.0", "0.10.0rc1", "0.9.0"]
    told = json.loads((tmp_path / "versions.json").read_text())
    assert [entry["version"] for entry in told if "latest" in entry["aliases"]] == ["0.10.0"]
    assert "url=0.10.0/" in (tmp_path / "index.html").read_text()
