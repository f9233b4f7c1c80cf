"""Write ``locked.txt``: constraints.txt with the checksum of every file that pip fetches: ``python .ci/lock.py``.

For the platform and Python that run this; pip refuses a file with another checksum:
    pip install --require-hashes -r locked.txt && pip install --no-deps --no-build-isolation .
Needs network access; ``--report FILE`` reads what ``pip install --dry-run --report FILE`` has found instead.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from supply import EXTRAS, HELD, PROJECT, ROOT

HEAD = """\
# constraints.txt with checksums, for {system} and Python {python}; made by .ci/lock.py:
#     pip install --require-hashes -r locked.txt && pip install --no-deps --no-build-isolation .
"""


def resolved() -> dict[str, Any]:
    """What pip would install for softwarp and its extras under constraints.txt; installs nothing."""
    wanted = f"{ROOT}[{','.join((*EXTRAS, *HELD))}]"
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed", "--report", "-"]
    done = subprocess.run(
        [*command, "-c", str(ROOT / "constraints.txt"), wanted], check=True, stdout=subprocess.PIPE, text=True
    )
    report: dict[str, Any] = json.loads(done.stdout)
    return report


def text(report: dict[str, Any]) -> str:
    """The file for one of pip's reports."""
    lines = []
    for item in report["install"]:
        name, version = item["metadata"]["name"], item["metadata"]["version"]
        if name != PROJECT["name"]:
            checksum = item["download_info"]["archive_info"]["hashes"]["sha256"]
            lines.append(f"{name}=={version} --hash=sha256:{checksum}\n")
    about = report["environment"]
    system = f"{about['platform_system']} {about['platform_machine']}"
    head = HEAD.format(system=system, python=about["python_version"])
    return head + "".join(sorted(lines, key=str.lower))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--report", type=Path, metavar="FILE", help="of pip, instead of asking it")
    given = parser.parse_args().report
    found = json.loads(given.read_text(encoding="utf-8")) if given else resolved()
    (ROOT / "locked.txt").write_text(text(found), encoding="utf-8")
    print(f"locked.txt: {len(found['install']) - 1} packages")
