"""Put this version of the site beside earlier ones: ``python docs/publish.py FOLDER``.

Builds the site, strictly, into ``FOLDER/<version>``, lists all versions there are in ``FOLDER/versions.json``, newest
first, which the selector beside the site's name reads, and leads ``FOLDER/index.html`` to the newest one. FOLDER is all
that a web server needs. A version that is published again replaces itself; others are left as they are.
"""

import argparse
import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VERSION = re.compile(r"\d+(\.\d+)*\w*")
INDEX = '<!doctype html><meta charset="utf-8"><title>softwarp</title><meta http-equiv="refresh" content="0; url={0}/">'


def order(version: str) -> tuple[tuple[int, int], ...]:
    """Sorts versions, those before a release (0.2.0rc1) below it."""
    parts = re.findall(r"\d+|[a-z]+", version)
    numbers = [(1, int(part)) if part.isdigit() else (-1, 0) for part in parts]
    return (*numbers, (0, 0))


def listed(folder: Path) -> list[str]:
    """Versions that a folder has, newest first."""
    found = [path.parent.name for path in folder.glob("*/index.html") if VERSION.fullmatch(path.parent.name)]
    return sorted(found, key=order, reverse=True)


def write_list(folder: Path) -> list[str]:
    """Write ``versions.json`` and ``index.html``; returns the versions, newest first."""
    versions = listed(folder)
    told = [{"version": name, "title": name, "aliases": ["latest"] if name == versions[0] else []} for name in versions]
    (folder / "versions.json").write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    (folder / "index.html").write_text(INDEX.format(versions[0]) + "\n", encoding="utf-8")
    return versions


def main(argv: Sequence[str] | None = None) -> int:
    """Build, list, and tell what there is; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args(argv).folder.resolve()
    place = folder / importlib.metadata.version("softwarp")
    scratch = folder / f".{place.name}"
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(scratch)]
    built = subprocess.run(command, cwd=ROOT, env=os.environ | {"SOFTWARP_SITE_VERSIONS": "1"}, check=False)
    if built.returncode:
        return built.returncode
    if place.exists():
        shutil.rmtree(place)
    scratch.rename(place)
    print(f"{folder}: {', '.join(write_list(folder))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
