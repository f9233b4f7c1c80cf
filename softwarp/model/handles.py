"""Handles: the indices that the builder's methods return, each of the kind of part that it counts."""

from __future__ import annotations


class Handle(int):
    """Index of a part among the parts of its kind; indexes the views of a simulation directly."""

    kind = "part"

    def __repr__(self) -> str:
        """For messages, such as ``rigid body 2``."""
        return f"{self.kind} {int(self)}"


class SoftBody(Handle):
    """A body of tetrahedra, from ``add_tets``."""

    kind = "soft body"


class RigidBody(Handle):
    """A rigid body, from ``add_rigid``; index of ``body_pose``."""

    kind = "rigid body"


class Rod(Handle):
    """A rod, from ``add_rod``; ``Model.rod_nodes`` gives its nodes in ``rod_x``."""

    kind = "rod"


class Telescope(Rod):
    """Tubes one in the other, from ``add_telescope``; ``Model.tubes_of`` gives them, ``rod_nodes`` their line."""


class Cavity(Handle):
    """An air chamber, from ``add_cavity``."""

    kind = "cavity"


class Joint(Handle):
    """A joint, from ``add_joint``."""

    kind = "joint"


class ContactPair(Handle):
    """Two parts that may touch, from ``add_contact``."""

    kind = "contact pair"
