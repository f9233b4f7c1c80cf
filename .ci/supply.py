"""What softwarp is installed with: the packages it declares and all that these need, as far as they are installed.

Read from pyproject.toml and from the metadata of the environment that runs this; ``constraints.py``, ``licences.py``
and ``sbom.py`` write it down. Needs the package ``packaging``, which pytest brings.
"""

import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = ("dev", "sb3", "video", "view")  # what tests run with; simulators to compare with (peers) are users' choice
# Extras whose tests run where they are installed, and whose versions constraints.txt holds as well. Others do not go
# with these versions (recordvideo, mlflow, rllib) or with tests (wandb).
HELD = ("mesh", "dae", "tetwild", "onnx", "minari", "skrl")


@dataclass(frozen=True)
class Package:
    """An installed package.

    Attributes:
        name: As its metadata write it.
        version: That is installed.
        about: Its metadata.
        needs: Canonical names of what it needs here.
    """

    name: str
    version: str
    about: metadata.Distribution
    needs: tuple[str, ...]


def declared(extras: Iterable[str] = ()) -> list[Requirement]:
    """Requirements of softwarp itself and of some of its extras; extras of softwarp in extras are opened up."""
    found = [Requirement(text) for text in PROJECT["dependencies"]]
    for extra in extras:
        told = (Requirement(text) for text in PROJECT["optional-dependencies"][extra])
        found += [requirement for requirement in told if canonicalize_name(requirement.name) != PROJECT["name"]]
    return found


def direct() -> set[str]:
    """Canonical names of all that pyproject.toml declares, but for the peers."""
    return {canonicalize_name(requirement.name) for requirement in declared(EXTRAS)}


def installed(extras: Iterable[str] = EXTRAS) -> dict[str, Package]:
    """Packages by canonical name, sorted: what is declared and what that needs.

    Raises:
        ModuleNotFoundError: If something declared is not installed; the message says how to get it.
    """
    found: dict[str, metadata.Distribution] = {}
    needs: dict[str, set[str]] = {}
    waiting = list(declared(extras))
    seen: set[tuple[str, str]] = set()
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        try:
            found[name] = metadata.distribution(requirement.name)
        except metadata.PackageNotFoundError as error:
            raise ModuleNotFoundError(f"{requirement.name} is not installed; pip install -e '.[dev]'") from error
        for extra in ("", *requirement.extras):
            if (name, extra) not in seen:
                seen.add((name, extra))
                more = list(needed(found[name], extra))
                needs.setdefault(name, set()).update(canonicalize_name(r.name) for r in more)
                waiting += more
    return {
        name: Package(about.metadata["Name"], about.version, about, tuple(sorted(needs[name])))
        for name, about in sorted(found.items())
    }


def needed(about: metadata.Distribution, extra: str) -> Iterator[Requirement]:
    """Requirements of a package that hold on this machine, those of an extra among them."""
    for text in about.requires or ():
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
            yield requirement
