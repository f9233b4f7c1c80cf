"""Measured silicone: the figures, how they are read, and what a case of ``softwarp validate real`` hands back.

The figures of ``measured_silicone.json`` come from published data sets; each has its source and licence beside it.
A file of the same form adds poses or pressures of one's own: what it names beyond the fitted ones is predicted.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from softwarp.advice import nearest
from softwarp.identification import Fit
from softwarp.io.bounded import parse_json

MEASURED = Path(__file__).resolve().parent / "measured_silicone.json"


@dataclass(frozen=True)
class Row:
    """A figure of a case.

    Attributes:
        what: Such as ``marker 1, mean error``.
        unit: Of the figures.
        ours: What the simulation gives.
        measured: What was measured; None where the figure is an error already.
        published: What another simulator gives; None where none did.
        bar: Largest error that is asked for; None for figures that are only told.
        note: What has to be known about the figure.
    """

    what: str
    unit: str
    ours: float
    measured: float | None = None
    published: float | None = None
    bar: float | None = None
    note: str = ""

    @property
    def error(self) -> float:
        """Distance from the measurement [unit]; the figure itself where it is an error."""
        return abs(self.ours) if self.measured is None else abs(self.ours - self.measured)

    @property
    def passed(self) -> bool:
        """Whether it is within its bar; so is what has none."""
        return self.bar is None or self.error <= self.bar


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came of a case.

    Attributes:
        title: Of the table.
        source: Of the measurements.
        rows: Figures.
        fit: Parameters that were found first, if any were.
        seconds: Time of the whole [s].
        notes: Sentences for the page, such as dimensions that were assumed.
        more: A further table, as Markdown.
        draw: Draws a picture of the case into a file.
        details: Further results, for JSON.
    """

    title: str
    source: str
    rows: list[Row]
    seconds: float
    fit: Fit | None = None
    notes: tuple[str, ...] = ()
    more: str = ""
    draw: Callable[[Path], None] | None = None
    details: dict[str, Any] = field(default_factory=dict)

    def table(self) -> str:
        """The figures, as Markdown."""
        lines = ["| figure | measured | softwarp | published simulator | error | asked for | |", "|" + "---|" * 7]
        for row in self.rows:
            told = (f"{value:.4g} {row.unit}" if value is not None else "" for value in (row.measured, row.ours))
            other = "" if row.published is None else f"{row.published:.4g} {row.unit}"
            bar = "" if row.bar is None else f"{row.bar:.4g} {row.unit}"
            mark = "" if row.bar is None else ("met" if row.passed else "missed")
            lines.append(
                f"| {row.what} | {' | '.join(told)} | {other} | {row.error:.3g} {row.unit} | {bar} "
                f"| {' '.join(filter(None, (mark, row.note)))} |"
            )
        return "\n".join(lines)


def measured(case: str, extra: Path | None = None) -> dict[str, Any]:
    """Measurements of a case.

    Args:
        case: Key of ``measured_silicone.json``.
        extra: A file of the same form, whose entries are added to those that are shipped.

    Raises:
        ValueError: If there is no such case, or the file is no JSON with cases.
    """
    shipped = json.loads(MEASURED.read_text(encoding="utf-8"))
    if case not in shipped:
        raise ValueError(f"no measurements of {case!r}; {nearest(case, shipped)}")
    found: dict[str, Any] = shipped[case]
    if extra is not None:
        try:
            added = parse_json(extra.read_bytes()).get(case, {})
        except (ValueError, AttributeError) as error:
            raise ValueError(f"{extra}: must be JSON of the form of {MEASURED.name}: {error}") from error
        for key, value in added.items():
            found[key] = {**found[key], **value} if isinstance(found.get(key), dict) else value
    return found
