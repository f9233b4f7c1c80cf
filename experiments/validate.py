"""``softwarp validate real``: simulations beside measured silicone and beside published simulators.

    softwarp validate real                              # all cases
    softwarp validate real tentacle --json -            # one case, as JSON
    softwarp validate real --page docs/validation_real.md   # renew its tables and pictures
    softwarp validate real tentacle --measured more.json    # predict poses of one's own as well

The exit code is 1 if a figure misses what is asked for.
"""

import argparse
import importlib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from softwarp import advice, notices
from softwarp.io.atomic import prove_writable, write_text

from .real import Outcome

KINDS = ("real",)
CASES = {  # module of this folder with ``run(extra) -> Outcome``
    "beam": "real_beam",
    "segment": "real_segment",
    "tentacle": "real_tentacle",
}


def main(arguments: Sequence[str]) -> int:
    """Run cases, print their tables, write what is asked for; returns 1 if a bar is missed."""
    args = parse(arguments)
    names = args.cases or list(CASES)
    for path in (args.page, None if args.json == "-" else args.json):
        if path:
            prove_writable(str(path))
    outcomes: dict[str, Outcome] = {}
    for name in names:
        outcomes[name] = importlib.import_module(f".{CASES[name]}", __package__).run(args.measured)
        if args.json != "-":
            print(section(outcomes[name]), flush=True)
    if args.page:
        renew(args.page, outcomes)
    if args.json:
        text = json.dumps({name: as_dict(outcome) for name, outcome in outcomes.items()}, indent=1)
        if args.json == "-":
            print(text)
        else:
            write_text(Path(args.json), text + "\n")
    missed = [f"{name}: {row.what}" for name, outcome in outcomes.items() for row in outcome.rows if not row.passed]
    for text in missed:
        notices.note(f"missed: {text}")
    return 1 if missed else 0


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Arguments, with names checked.

    Raises:
        ValueError: For a kind or case that there is not; the message lists the nearest.
    """
    parser = argparse.ArgumentParser(
        prog="softwarp validate",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("kind", metavar="real", help="what to compare with: measured silicone")
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"one of {', '.join(CASES)}; all without")
    parser.add_argument("--json", metavar="FILE", help="write figures and fits (-: print them instead of tables)")
    parser.add_argument("--page", type=Path, metavar="FILE.md", help="renew the tables of a page, and its pictures")
    parser.add_argument("--measured", type=Path, metavar="FILE.json", help="further measurements, to be predicted")
    args = parser.parse_args(arguments)
    for given, known, what in ((args.kind, KINDS, "kind"), *((name, CASES, "case") for name in args.cases)):
        if given not in known:
            raise ValueError(f"there is no {what} {given!r}; {advice.nearest(given, known)}")
    return args


def section(outcome: Outcome) -> str:
    """A case as Markdown: figures, parameters, notes, source."""
    parts = [f"### {outcome.title}", outcome.table()]
    if outcome.fit is not None:
        parts.append(outcome.fit.table())
    if outcome.more:
        parts.append(outcome.more)
    parts += [*outcome.notes, f"Time of fits and figures: {outcome.seconds:.0f} s.", f"Measured by: {outcome.source}."]
    return "\n\n".join(parts) + "\n"


def as_dict(outcome: Outcome) -> dict[str, Any]:
    """A case for JSON."""
    rows = [
        {"what": row.what, "unit": row.unit, "ours": row.ours, "measured": row.measured, "published": row.published}
        | {"error": row.error, "bar": row.bar, "passed": row.passed, "note": row.note}
        for row in outcome.rows
    ]
    fit = None if outcome.fit is None else outcome.fit.as_dict()
    return {"rows": finite(rows), "fit": fit, "seconds": round(outcome.seconds, 1), **finite(outcome.details)}


def finite(value: Any) -> Any:
    """The same with None for numbers that JSON does not have."""
    if isinstance(value, dict):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def renew(page: Path, outcomes: dict[str, Outcome]) -> None:
    """Put tables between the marks of a page, and pictures into ``images/`` beside it.

    Raises:
        ValueError: If the page has no marks of a case.
    """
    text = page.read_text(encoding="utf-8")
    for name, outcome in outcomes.items():
        marks = re.compile(rf"(<!-- {name}: made by softwarp validate real -->\n).*?(<!-- end {name} -->)", re.DOTALL)
        if not marks.search(text):
            raise ValueError(f"{page}: has no line '<!-- {name}: made by softwarp validate real -->' and no end of it")
        body = section(outcome).split("\n", 2)[2]
        if outcome.draw is not None:
            picture = f"images/real_{name}.png"
            outcome.draw(page.parent / picture)
            body = f"![{outcome.title}: softwarp and measurement]({picture})\n\n{body}"
        text = marks.sub(lambda found, body=body: f"{found[1]}\n{body}\n{found[2]}", text)
    write_text(page, text)
