"""``ContactBuilder``: the builder's method for contact."""

from __future__ import annotations

import math

from softwarp.scene.cavities import ChamberBuilder
from softwarp.scene.parts import ContactPair, Handle, PairSpec, RigidBody, Rod, SoftBody


class ContactBuilder(ChamberBuilder):
    """Contact pairs; part of ``ModelBuilder``."""

    def __init__(self) -> None:
        super().__init__()
        self.pairs: list[PairSpec] = []

    def add_contact(
        self,
        a: int,
        b: int,
        mu: float = 0.0,
        *,
        restitution: float = 0.0,
        contact_distance: float = 0.0,
        alarm_distance: float | None = None,
        compliance: float = 0.0,
        name: str | None = None,
    ) -> ContactPair:
        """Let two parts touch by the laws of Signorini and Coulomb; ``a = b`` is self-contact.

        Walls of closed chambers take part in self-contact only: nothing else can reach them.

        Args:
            a: Soft body, rigid body or rod.
            b: The other part.
            mu: Friction coefficient.
            restitution: Coefficient of restitution in [0, 1].
            contact_distance: Distance at which the surfaces rest on each other [m]; SOFA's ``contactDistance``.
            alarm_distance: Distance from which they are looked at [m]; SOFA's ``alarmDistance``. None takes the contact
                distance plus 1 % of the smaller part. What moves fast is seen from farther away in any case.
            compliance: Compliance of the normal law [m/N]; 0 is hard contact.
            name: For messages.

        Returns:
            Handle; ``Simulation.contact_force(a, b)`` gives the force on a.

        Raises:
            ValueError: For a part that does not exist, a pair that exists, or a value outside its range.
        """
        first, second = self._part(a), self._part(b)
        label = name or f"{self._part_name(first)} - {self._part_name(second)}"
        key = {(p.kind, int(p)) for p in (first, second)}
        if any(key == {(s.a.kind, int(s.a)), (s.b.kind, int(s.b))} for s in self.pairs):
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
        self.pairs.append(PairSpec(label, first, second, values))
        return ContactPair(len(self.pairs) - 1)

    def _part(self, part: int) -> Handle:
        if isinstance(part, (RigidBody, Rod)):
            count = len(self.rigids) if isinstance(part, RigidBody) else len(self.rods)
            if not 0 <= part < count:
                raise ValueError(f"contact: {part!r} does not exist; the builder has {count}")
            return part
        self._soft(part)
        return SoftBody(part)

    def _part_name(self, part: Handle) -> str:
        if isinstance(part, RigidBody):
            return self.rigids[part].name
        return self.rods[part].name if isinstance(part, Rod) else self.bodies[part].name
