"""Advice for messages: which names may have been meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def close_to(name: str, valid: Iterable[str], *, count: int = 3, cutoff: float = 0.6) -> list[str]:
    """Valid names that resemble a misspelt one, the likest first, at most ``count``; case does not count.

    Args:
        name: What was written.
        valid: What could have been.
        count: How many are wanted.
        cutoff: Likeness from which a name is told, 1 for equality.
    """
    lower: dict[str, list[str]] = {}
    for entry in valid:
        lower.setdefault(entry.lower(), []).append(entry)
    matches = difflib.get_close_matches(str(name).lower(), lower, n=count, cutoff=cutoff)
    return [entry for match in matches for entry in lower[match]][:count]


def did_you_mean(names: Iterable[str]) -> str:
    """The question that names what may have been meant."""
    return f"did you mean {' or '.join(map(repr, names))}?"


def nearest(name: str, valid: Iterable[str]) -> str:
    """Advice for a misspelt name: the nearest valid ones, or all of them when none is near."""
    known = list(valid)
    close = close_to(name, known, cutoff=0.5)
    return did_you_mean(close) if close else f"valid names are {', '.join(map(repr, sorted(known)))}"
