"""What MkDocs does beyond its plugins: formulas as MathML, docstrings, and pages for files outside ``docs/``.

The pages are written for readers of the repository, too: formulas between dollars, links to source files. On the site
a formula becomes MathML, which browsers show without a script, and a linked file or folder becomes a page under
``source/``. Every public name has its docstring in ``reference/``, a page for each package. Nothing is fetched, neither
when the site is built nor when it is read.
"""

import ast
import functools
import html
import importlib
import importlib.metadata
import inspect
import json
import logging
import os
import pkgutil
import posixpath
import re
import runpy
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files, InclusionLevel

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
NOTEBOOKS = runpy.run_path(str(DOCS / "notebooks.py"))
LOG = logging.getLogger("mkdocs.hooks.softwarp")
FENCE = re.compile(r"^(?P<fence>```+).*?^(?P=fence)$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"(?P<open>\]\(|<img[^>]*?src=\")(?P<target>[^)\s\"]+)(?P<close>\)|\")")
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
FETCHED = re.compile(r"<(?:script|img|link rel=\"stylesheet\")[^>]*(?:src|href)=\"(https?:[^\"]+)")
BY_FILE = ("planning", "training", "policies")  # without names of their own: a task in each file
PACKAGES = (
    *(
        "envs",
        "scene",
        "view",
        "render",
        "control",
        "identification",
        "gradients",
        "reduction",
        "meshing",
        "shapes",
        "deploy",
    ),
    "",
)
LANGUAGES = {".py": "python", ".sh": "bash", ".yaml": "yaml", ".yml": "yaml", ".toml": "toml", ".json": "json"}
TEXTS = {*LANGUAGES, ".cff", ".txt", ".cu", ".h", ""}


def outside(fence_free: str, home: Path) -> set[Path]:
    """Files and folders of the repository outside ``docs/`` that a page in the folder ``home`` links to."""
    found = set()
    for match in LINK.finditer(fence_free):
        target = match["target"].partition("#")[0]
        if target and not re.match(r"[a-z]+:", target):
            path = (home / target).resolve()
            if path.exists() and path.is_relative_to(ROOT) and not path.is_relative_to(DOCS):
                found.add(path)
    return found


def address(path: Path) -> str:
    """Where a file or folder of the repository stands among the site's files."""
    if path.is_relative_to(DOCS):
        return path.relative_to(DOCS).as_posix()
    name = path.relative_to(ROOT).as_posix()
    return f"source/{name}.md" if path.is_dir() or path.suffix in TEXTS | {".md"} else f"source/{name}"


def relinked(markdown: str, home: Path, page: str) -> str:
    """A page's text with its links led to the site's files; ``home`` is its folder, ``page`` where it stands there."""

    def lead(match: re.Match[str]) -> str:
        target, mark, fragment = match["target"].partition("#")
        path = (home / target).resolve() if target and not re.match(r"[a-z]+:", target) else None
        if path is None or not path.exists() or not path.is_relative_to(ROOT):
            return match[0]
        if path.is_dir() and path.is_relative_to(DOCS):
            path = path / "README.md"
        led = posixpath.relpath(address(path), posixpath.dirname(page))
        return f"{match['open']}{led}{mark}{fragment}{match['close']}"

    parts, end = [], 0
    for fence in FENCE.finditer(markdown):
        parts += [LINK.sub(lead, markdown[end : fence.start()]), fence[0]]
        end = fence.end()
    return "".join([*parts, LINK.sub(lead, markdown[end:])])


def listing(folder: Path) -> str:
    """A page for a folder: its files, each with the first line of its docstring."""
    lines = [f"# {folder.relative_to(ROOT)}/", ""]
    for path in sorted(folder.iterdir()):
        if path.suffix in TEXTS | {".md"} and path.is_file():
            about = ""
            if path.suffix == ".py":
                about = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").partition("\n")[0]
            lines.append(f"- [{path.name}]({path.name}){': ' if about else ''}{about}")
    return "\n".join(lines) + "\n"


def written(path: Path) -> str:
    """Markdown of the page for a file or folder outside ``docs/``, with links as seen from where it lies."""
    if path.is_dir():
        return listing(path)
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        return text
    fence = "`" * (max((len(run) for run in re.findall(r"`+", text)), default=2) + 3)
    return f"# {path.relative_to(ROOT)}\n\n{fence}{LANGUAGES.get(path.suffix, 'text')}\n{text}\n{fence}\n"


@functools.cache
def public_classes() -> frozenset[type]:
    """Classes that have an entry of their own in the reference."""
    modules = [importlib.import_module(f"softwarp.{name}".rstrip(".")) for name in PACKAGES]
    things = (getattr(module, name) for module in modules for name in module.__all__)
    return frozenset(thing for thing in things if inspect.isclass(thing))


def inherited(thing: Any) -> list[str]:
    """Public names that a class has from classes of softwarp without an entry of their own, so told with it."""
    bases = thing.__mro__[1:] if inspect.isclass(thing) else ()
    hidden = [base for base in bases if base.__module__.startswith("softwarp") and base not in public_classes()]
    return sorted({name for base in hidden for name in vars(base) if not name.startswith("_")})


def reference(package: str, shown: dict[str, str]) -> str:
    """A page with the docstring of every public name of a package; ``shown`` tells which page has a thing already."""
    module = importlib.import_module(package)
    lines = [f"# {package}", "", inspect.getdoc(module) or "", ""]
    for name in sorted(module.__all__, key=str.lower):
        thing = getattr(module, name)
        home = getattr(thing, "__module__", "")
        if (inspect.isclass(thing) or inspect.isfunction(thing)) and home.startswith("softwarp"):
            where = shown.setdefault(f"{home}.{thing.__qualname__}", package)
            if where == package:
                lines += [f"::: {home}.{thing.__qualname__}", "    options:", f"      heading: {package}.{name}"]
                lines += [f"      inherited_members: {inherited(thing)}", ""]
            else:
                lines += [
                    f"## {package}.{name}",
                    "",
                    f"As [{where}.{name}]({where}.md#{home}.{thing.__qualname__}).",
                    "",
                ]
        elif not inspect.ismodule(thing):
            lines += [f"## {package}.{name}", "", f"`{thing}`", ""]
    return "\n".join(lines)


def reference_by_file(package: str) -> str:
    """A page with the docstring of what every file of a package defines, file after file."""
    module = importlib.import_module(package)
    lines = [f"# {package}", "", inspect.getdoc(module) or "", ""]
    for found in sorted(pkgutil.iter_modules(module.__path__), key=lambda one: one.name):
        name = f"{package}.{found.name}"
        file = importlib.import_module(name)
        lines += [f"## {name}", "", (inspect.getdoc(file) or "").partition("\n")[0], ""]
        for thing in vars(file).values():
            is_named = inspect.isclass(thing) or inspect.isfunction(thing)
            if is_named and thing.__module__ == name and not thing.__name__.startswith("_"):
                lines += [f"::: {name}.{thing.__qualname__}", "    options:", "      heading_level: 3", ""]
    return "\n".join(lines)


def on_config(config: Any) -> Any:
    """Tell the version that this site is of, beside its name and at the foot of every page."""
    version = importlib.metadata.version("softwarp")
    config.site_name = f"softwarp {version}"
    config.copyright = f"softwarp {version}, Apache-2.0"
    if os.environ.get("SOFTWARP_SITE_VERSIONS"):  # docs/publish.py: others lie beside it, and a list of all
        config.extra["version"] = {"provider": "mike"}
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add a page, or a copy, for everything outside ``docs/`` that pages lead to, and what those lead to in turn."""
    waiting: set[Path] = set()
    for file in files.documentation_pages():
        place = Path(file.abs_src_path)
        waiting |= outside(FENCE.sub("", place.read_text(encoding="utf-8")), place.parent)
    done: set[Path] = set()
    while waiting:
        path = waiting.pop()
        done.add(path)
        name = address(path)
        if not name.endswith(".md"):
            content: str | bytes = path.read_bytes()
        else:
            text = written(path)
            home = path if path.is_dir() else path.parent
            waiting |= outside(FENCE.sub("", text) if path.is_dir() or path.suffix == ".md" else "", home) - done
            content = relinked(text, home, name)
        files.append(File.generated(config, name, content=content, inclusion=InclusionLevel.NOT_IN_NAV))
    for cells in NOTEBOOKS["TUTORIALS"].glob("*.md"):
        made = json.dumps(NOTEBOOKS["notebook"](cells.read_text(encoding="utf-8")), indent=1)
        files.append(File.generated(config, f"tutorials/{cells.stem}.ipynb", content=made))
    shown: dict[str, str] = {}
    for name in PACKAGES:
        package = f"softwarp.{name}".rstrip(".")
        files.append(File.generated(config, f"reference/{package}.md", content=reference(package, shown)))
    for name in BY_FILE:
        page = reference_by_file(f"softwarp.{name}")
        files.append(File.generated(config, f"reference/softwarp.{name}.md", content=page))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Lead links out of ``docs/`` to the pages that stand for what they name; a search finds docs, no source."""
    if page.file.generated_by is not None:
        page.meta["search"] = {"exclude": page.file.src_uri.startswith("source/")}
        return markdown
    source = Path(page.file.abs_src_path)
    text = relinked(markdown, source.parent, page.file.src_uri)
    text = re.sub(r"\A<!--.*?-->\s*", "", text)  # MkDocs takes a page's title from a heading that comes first
    if source.parent == NOTEBOOKS["TUTORIALS"]:
        heading, _, rest = text.partition("\n")
        text = f"{heading}\n\n[This page as a notebook]({source.stem}.ipynb)\n{rest}"
    return text


def on_page_content(text: str, page: Any, config: Any, files: Files) -> str:
    """Formulas as MathML; one that the converter does not know is a warning, which fails a strict build."""

    def formula(match: re.Match[str]) -> str:
        told = html.unescape(match[3]).strip()
        try:
            return convert(told, display="block" if match[2] == "[" else "inline")
        except Exception as error:  # noqa: BLE001 - of the converter, of many kinds
            LOG.warning("%s: %s in the formula %s", page.file.src_uri, error or type(error).__name__, told)
            return match[0]

    return FORMULA.sub(formula, text)


def on_post_build(config: Any) -> None:
    """Fail on pages of the site that would fetch something from elsewhere."""
    for path in Path(config.site_dir).rglob("*.html"):
        for target in FETCHED.findall(path.read_text(encoding="utf-8")):
            LOG.warning("%s fetches %s", os.path.relpath(path, config.site_dir), target)
