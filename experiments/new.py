"""``softwarp new``: a package with a robot, a task, a test and settings of one's own, which runs as it is."""

import argparse
import importlib.util
import keyword
import re
from collections.abc import Sequence
from pathlib import Path

from softwarp.envs import registry
from softwarp.io.atomic import write_text

TEMPLATE = Path(__file__).resolve().parent / "new_robot"  # a package that works under its own names
SUFFIXES = (".md", ".py", ".toml", ".yaml")


def main(arguments: Sequence[str]) -> int:
    """Write the package; returns the exit code."""
    parser = argparse.ArgumentParser(prog="softwarp new", description=__doc__, allow_abbrev=False)
    parser.add_argument("name", metavar="NAME", help="of the package, such as soft_finger; the class is SoftFinger")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="where to; NAME in this folder if left out")
    args = parser.parse_args(arguments)
    package, kind = names(args.name)
    folder = args.out or Path(package)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder} exists already and is left alone; choose another name, or --out FOLDER")
    for path in sorted(TEMPLATE.rglob("*")):
        if path.suffix in SUFFIXES:
            place = named(path.relative_to(TEMPLATE).as_posix(), package, kind)
            write_text(folder / place, named(path.read_text(encoding="utf-8"), package, kind))
    print(f"{folder}: written; README.md there says what is what. Next:")
    print(f"  cd {folder}\n  softwarp render env={package}:{kind} policy=scripted {package}.png")
    print(f"  softwarp train env={package}:{kind} experiment={package}")
    return 0


def names(given: str) -> tuple[str, str]:
    """Names of package and class for one name in any spelling: ``my_robot`` and ``MyRobot``.

    Raises:
        ValueError: If it makes no name of a package, or one that is taken.
    """
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+", given)
    package, kind = "_".join(words).lower(), "".join(word[:1].upper() + word[1:] for word in words)
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_ -]*", given) or keyword.iskeyword(package):
        raise ValueError(f"name {given!r}: letters, digits and underscores make a package, such as soft_finger")
    if kind in registry.names():
        raise ValueError(f"name {given!r}: there is an environment {kind} already; choose another name")
    if importlib.util.find_spec(package) is not None:
        raise ValueError(f"name {given!r}: there is a package {package} already; choose another name")
    return package, kind


def named(text: str, package: str, kind: str) -> str:
    """The template's text under other names."""
    title = package.replace("_", " ").capitalize()
    return text.replace("My robot", title).replace("MyRobot", kind).replace("my_robot", package)
