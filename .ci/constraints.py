"""Write ``constraints.txt``: the versions that this environment's tests run with. ``python .ci/constraints.py``.

Run it where the tests have passed, with nothing installed from elsewhere than the package index. Extras in ``HELD``
that are not installed keep the lines they have; ``--report FILE`` takes those from what ``pip install --dry-run
--report FILE`` has found for them.
"""

import argparse
import json
import platform
from pathlib import Path
from typing import Any

from packaging.utils import canonicalize_name
from supply import PROJECT, ROOT, installed

HEAD = """\
# Versions that softwarp's tests have passed with, made by .ci/constraints.py on Python {python}, {system}:
#     pip install -c constraints.txt .
# Without it pip takes the newest versions that pyproject.toml allows; .ci/newest tests those.
"""


def text(others: dict[str, str]) -> str:
    """The file: a line for each package, direct or not; ``others`` are versions of those that are not installed."""
    head = HEAD.format(python=platform.python_version(), system=f"{platform.system()} {platform.machine()}")
    lines = {name: f"{package.name}=={package.version}\n" for name, package in installed().items()}
    lines |= {key: f"{name}=={others[name]}\n" for name in others if (key := canonicalize_name(name)) not in lines}
    return head + "".join(lines[key] for key in sorted(lines))


def written() -> dict[str, str]:
    """Versions of the file that there is."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    return dict(line.split("==") for line in lines if not line.startswith("#"))


def reported(report: dict[str, Any]) -> dict[str, str]:
    """Versions that pip has found."""
    found = {item["metadata"]["name"]: item["metadata"]["version"] for item in report["install"]}
    return {name: version for name, version in found.items() if name != PROJECT["name"]}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--report", type=Path, metavar="FILE", help="of pip, for extras that are not installed")
    given = parser.parse_args().report
    others = reported(json.loads(given.read_text(encoding="utf-8"))) if given else written()
    (ROOT / "constraints.txt").write_text(text(others), encoding="utf-8")
    print(f"constraints.txt: {len(text(others).splitlines()) - HEAD.count(chr(10))} packages")
