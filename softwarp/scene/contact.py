"""Pairs of parts that may touch."""

from __future__ import annotations

import math

from softwarp import checks
from softwarp.model.handles import ContactPair
from softwarp.scene.checks import distance
from softwarp.scene.parts import PairSpec, Scene


def add_contact(
    scene: Scene,
    a: int,
    b: int,
    mu: float,
    *,
    restitution: float,
    contact_distance: float,
    alarm_distance: float | None,
    compliance: float,
    name: str | None,
) -> ContactPair:
    """Let two parts touch by the laws of Signorini and Coulomb; ``a = b`` is self-contact."""
    first, second = scene.part(a), scene.part(b)
    label = checks.label(name, f"{scene.name_of(first)} - {scene.name_of(second)}", "name of a contact")
    key = {(p.kind, int(p)) for p in (first, second)}
    if any(key == {(s.a.kind, int(s.a)), (s.b.kind, int(s.b))} for s in scene.pairs):
        raise ValueError(f"contact {label!r} exists already; add every pair once")
    given = (("mu", mu), ("restitution", restitution), ("contact_distance", contact_distance))
    for what, value in (*given, ("compliance", compliance)):
        high = {"restitution": 1.0, "contact_distance": checks.FARTHEST}.get(what, checks.LARGEST)
        checks.number(value, f"contact {label!r}: {what}", low=0.0, high=high)
    alarm_distance = distance(alarm_distance, f"contact {label!r}: alarm_distance")
    if alarm_distance is not None and not contact_distance <= alarm_distance:
        raise ValueError(
            f"contact {label!r}: alarm_distance must be at least contact_distance ({contact_distance:g} m), "
            f"got {alarm_distance!r}"
        )
    values = {
        "mu": float(mu),
        "restitution": float(restitution),
        "contact_distance": float(contact_distance),
        "alarm_distance": math.nan if alarm_distance is None else float(alarm_distance),
        "compliance": float(compliance),
    }
    scene.pairs.append(PairSpec(label, first, second, values))
    return ContactPair(len(scene.pairs) - 1)
