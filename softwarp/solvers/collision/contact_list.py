"""The contacts of a step, of which a world can hold a fixed number: detection writes them, the response reads them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.model.codes import SLOTS
from softwarp.solvers.workspace import rows
from softwarp.solvers.workspace.rows import Rows


@dataclass(frozen=True)
class ContactList:
    """Contacts of every world in ascending order of their keys; entries at and past ``count`` are neutral.

    That holds up to the largest ``count`` of the worlds that share a register (on a GPU, all); nothing beyond is read.

    With slots k of contact c the relative velocity of side a (the feature) against side b (the target) at the contact
    is ``sum_k weight_k u_k + u_k x lever_k``, u_k the velocity of dof k: a translation has a weight and no lever, a
    rotation a lever and no weight. Sides enter with their sign, so that H' multiplier pushes a along +n and b along -n.
    A neutral entry has dofs -1, weight, lever, axes, mu and multiplier 0 and a gap of 1 m.

    Attributes:
        capacity: Contacts that a world can hold.
        listed: Contacts in ascending order of their keys; late ones follow; int, 1 row.
        first: First contact that is new since the response last saw the list; int, 1 row.
        count: Contacts found, at most ``capacity``; int, 1 row.
        overflow: Contacts that found no place; int, 1 row.
        idle: 1 in worlds that take no part in a further look, see ``solvers.looks``; int, 1 row.
        key: Candidate of a contact, the same feature and target in every step; int, (c).
        pair: Contact pair of a contact; int, (c).
        dof: Dofs it touches, -1 for an unused slot; int, (SLOTS c + k).
        weight: Translation weights; (SLOTS c + k).
        lever: Levers of rotations [m]; (3 (SLOTS c + k) + component).
        axes: Normal from b to a and two tangents in world axes, row by row; (9 c + 3 axis + component).
        point: Contact point [m]; (3 c + component).
        gap: Signed distance minus the pair's contact distance [m]; (c).
        mu: Friction coefficient; (c).
        restitution: Coefficient of restitution; (c).
        compliance: Compliance of the normal law [m/N]; (c).
        multiplier: Forces [N] along the axes; (3 c + axis).
    """

    capacity: int
    listed: Rows
    first: Rows
    count: Rows
    overflow: Rows
    idle: Rows
    key: Rows
    pair: Rows
    dof: Rows
    weight: Rows
    lever: Rows
    axes: Rows
    point: Rows
    gap: Rows
    mu: Rows
    restitution: Rows
    compliance: Rows
    multiplier: Rows


def allocate(variant: Variant, world_count: int, capacity: int, device: Any) -> ContactList:
    """Empty list for some worlds."""

    def real(count: int) -> Rows:
        return rows.allocate(variant, world_count, count, device)

    def integer(count: int) -> Rows:
        return rows.allocate(variant, world_count, count, device, wp.int32)

    return ContactList(
        capacity=capacity,
        listed=integer(1),
        first=integer(1),
        count=integer(1),
        overflow=integer(1),
        idle=integer(1),
        key=integer(capacity),
        pair=integer(capacity),
        dof=integer(SLOTS * capacity),
        weight=real(SLOTS * capacity),
        lever=real(3 * SLOTS * capacity),
        axes=real(9 * capacity),
        point=real(3 * capacity),
        gap=real(capacity),
        mu=real(capacity),
        restitution=real(capacity),
        compliance=real(capacity),
        multiplier=real(3 * capacity),
    )
