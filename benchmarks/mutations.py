"""Do the tests notice? Applies small wrong changes one by one and runs the tests that should fail.

    softwarp bench mutations                     # all of ``benchmarks/mutants.py``, tens of minutes
    softwarp bench mutations --filter SAC        # those with SAC in their name or file
    softwarp bench mutations --json FILE         # also write the outcome of each

Works on a copy of the checkout in a scratch folder, never on the checkout itself, with a kernel cache of its own. The
tests are first run without a change: only where they pass then does a failure say anything. A mutant is *killed* when
one of its tests fails, or does not end within the limit; one that *survives* asks for a test. Exit code 1 if any does.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from .mutants import MUTANTS, Mutant
from .timing import save

ROOT = Path(__file__).resolve().parents[1]
COPIED = ("assets", "benchmarks", "docs", "experiments", "hydra_configs", "softwarp", "tests", ".ci")
LIMIT = 300.0  # s, for the tests of one mutant
SETTLING = 3600.0  # s, for the unchanged tests, which compile every kernel
# With Python's own finders only: those of an editable installation would lead from the copy back to the checkout.
PYTEST = """
import sys
sys.meta_path[:] = [finder for finder in sys.meta_path if finder.__module__.startswith("_frozen_importlib")]
import pytest
import softwarp
if not softwarp.__file__.startswith(sys.argv[1]):
    sys.exit(f"softwarp comes from {softwarp.__file__}")
sys.exit(pytest.main(["-x", "-q", "--no-header", "--tb=no", "-p", "no:cacheprovider", *sys.argv[2:]]))
"""
FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)


@dataclass(frozen=True)
class Outcome:
    """What became of a mutant.

    Attributes:
        name: Of the mutant.
        file: That was changed.
        verdict: ``killed``, ``timed out`` (killed too) or ``survived``.
        by: The first test that failed; empty where none did.
        seconds: That its tests took.
    """

    name: str
    file: str
    verdict: str
    by: str
    seconds: float


class Copy:
    """A scratch copy of the checkout in which files are changed and tests are run.

    Args:
        folder: Empty folder to make it in.
        root: The checkout.
    """

    def __init__(self, folder: Path, root: Path = ROOT) -> None:
        self.root = folder / "checkout"
        self.root.mkdir()
        for name in COPIED:
            if (root / name).is_dir():
                shutil.copytree(root / name, self.root / name, ignore=shutil.ignore_patterns("__pycache__"))
        for path in [*root.glob("*.md"), *root.glob("*.toml"), *root.glob("*.txt"), *root.glob("*.cff")]:
            shutil.copy(path, self.root)
        self.environment = os.environ | {"PYTHONPATH": str(self.root), "WARP_CACHE_PATH": str(folder / "kernels")}
        self.environment.pop("PYTEST_ADDOPTS", None)  # of a run of tests that this one is part of
        self.environment |= {"PYTHONDONTWRITEBYTECODE": "1"}  # of a change within a second, the old code would be run

    def run(self, tests: Sequence[str], limit: float) -> tuple[int | None, str]:
        """Exit code of pytest, None past the limit [s], and what it told."""
        command = [sys.executable, "-c", PYTEST, str(self.root), *tests]
        with subprocess.Popen(
            command,
            cwd=self.root,
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        ) as process:
            try:
                told, _ = process.communicate(timeout=limit)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, 9)  # and what the tests had started
                process.communicate()
                return None, ""
            return process.returncode, told

    def try_out(self, mutant: Mutant, limit: float) -> Outcome:
        """Change the file, run the tests, put the file back.

        Raises:
            ValueError: If ``old`` does not stand in the file exactly once.
            RuntimeError: If pytest could not run the tests at all.
        """
        path = self.root / mutant.file
        text = path.read_text(encoding="utf-8")
        start = time.monotonic()
        path.write_text(changed(mutant, text), encoding="utf-8")
        try:
            code, told = self.run(mutant.tests, limit)
        finally:
            path.write_text(text, encoding="utf-8")
        found = FAILED.search(told)
        if code not in (None, 0) and not found:
            raise RuntimeError(f"mutant {mutant.name!r}: pytest ended with code {code}; it told\n{told[-2000:]}")
        verdict = {None: "timed out", 0: "survived"}.get(code, "killed")
        return Outcome(mutant.name, mutant.file, verdict, found[1] if found else "", time.monotonic() - start)


def changed(mutant: Mutant, text: str) -> str:
    """The text of a file with the mutant in it.

    Raises:
        ValueError: If ``old`` does not stand in it exactly once.
    """
    count = text.count(mutant.old)
    if count != 1:
        raise ValueError(
            f"mutant {mutant.name!r}: {mutant.file} holds {mutant.old!r} {count} times, not once; "
            "bring benchmarks/mutants.py up to date"
        )
    return text.replace(mutant.old, mutant.new)


def table(outcomes: Sequence[Outcome]) -> str:
    """Outcomes as a Markdown table, survivors first."""
    ordered = sorted(outcomes, key=lambda outcome: outcome.verdict != "survived")
    rows = [f"| {o.name} | `{o.file}` | {o.verdict} | {o.by.rpartition('::')[2] or '-'} |" for o in ordered]
    return "\n".join(["| change | file | outcome | noticed by |", "|---|---|---|---|", *rows])


def main(arguments: Sequence[str]) -> int:
    """Try the mutants; exit code 1 if one survives."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench mutations", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--filter", default="", metavar="TEXT", help="only mutants with TEXT in their name or file")
    parser.add_argument("--limit", type=float, default=LIMIT, metavar="SECONDS", help="for the tests of one mutant")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the outcome of each mutant")
    args = parser.parse_args(arguments)
    chosen = [mutant for mutant in MUTANTS if args.filter in mutant.name or args.filter in mutant.file]
    if not chosen:
        raise ValueError(f"no mutant has {args.filter!r} in its name or file; benchmarks/mutants.py lists them")
    if not (ROOT / "tests").is_dir():
        raise ValueError(f"{ROOT} has no tests, which belong to a checkout of softwarp; run this in one")
    outcomes = []
    with tempfile.TemporaryDirectory(prefix="softwarp_mutations_") as folder:
        copy = Copy(Path(folder))
        tests = list(dict.fromkeys(test for mutant in chosen for test in mutant.tests))
        print(f"unchanged: {len(tests)} selections of tests", flush=True)
        code, told = copy.run(tests, SETTLING)
        if code != 0:
            raise RuntimeError(f"the unchanged tests do not pass, so failures would say nothing:\n{told[-2000:]}")
        for mutant in chosen:
            outcomes.append(copy.try_out(mutant, args.limit))
            print(f"{outcomes[-1].verdict:<10}{outcomes[-1].seconds:6.0f} s  {mutant.name}", flush=True)
    survivors = sum(outcome.verdict == "survived" for outcome in outcomes)
    print(f"\n{table(outcomes)}\n\n{len(outcomes) - survivors} of {len(outcomes)} were noticed")
    save([asdict(outcome) for outcome in outcomes], args.json)
    return 1 if survivors else 0
