"""Names of resolutions: what the generators of meshes know, and what they say about other names."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from softwarp.advice import close_to, did_you_mean
from softwarp.meshing.tets import MeshError


def check_name(name: Any, known: Collection[str], owner: str, what: str = "resolution", *, more: str = "") -> str:
    """The name, one of those that are known.

    Args:
        name: What was given.
        known: Names there are.
        owner: Generator, for the message.
        what: Its argument, likewise.
        more: What else it takes, likewise.

    Raises:
        MeshError: For anything else, with the nearest name.
    """
    if isinstance(name, str) and name in known:
        return name
    near = close_to(str(name), known, count=1, cutoff=0.3)
    hint = f"; {did_you_mean(near)}" if near else ""
    raise MeshError(f"{owner}: unknown {what} {name!r}; known: {', '.join(known)}{more}{hint}")
