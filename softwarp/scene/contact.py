"""Pairs of parts that may touch."""

from __future__ import annotations

import math

from softwarp.model.handles import ContactPair
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
    label = name or f"{scene.name_of(first)} - {scene.name_of(second)}"
    key = {(p.kind, int(p)) for p in (first, second)}
    if any(key == {(s.a.kind, int(s.a)), (s.b.kind, int(s.b))} for s in scene.pairs):
        raise ValueError(f"contact {label!r} exists already; add every pair once")
    for what, value, high in (("mu", mu, math.inf), ("restitution", restitution, 1.0)):
        if not 0.0 <= value <= high or not math.isfinite(value):
            raise ValueError(f"contact {label!r}: {what} must lie in [0, {high:g}], got {value!r}")
    for what, value in (("contact_distance", contact_distance), ("compliance", compliance)):
        if not (math.isfinite(value) and value >= 0.0):
            raise ValueError(f"contact {label!r}: {what} must be finite and at least 0, got {value!r}")
    if alarm_distance is not None and not contact_distance <= alarm_distance < math.inf:
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
