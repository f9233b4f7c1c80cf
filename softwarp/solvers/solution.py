"""What a step leaves behind of its solution, which its adjoint goes on with. Theory: docs/theory/adjoint.md."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.solvers.contact_adjoint import contact_solution
from softwarp.solvers.multipliers import BoundedMultipliers
from softwarp.solvers.system import System
from softwarp.solvers.workspace import rows
from softwarp.solvers.workspace.rows import Rows


def solution_of(system: System) -> list[wp.array]:
    """Arrays in which a system that has taken a step holds its solution, factors included."""
    w = system.shard.work
    kept = [w.dof_v.real, *system.linear.factors]
    if system.shard.model.row_count:
        kept += [w.row.real, w.multiplier.real]
    if system.model.reduction is not None and system.model.reduction.floating is not None:
        kept += [w.wide_drag.real, w.turning_drag.real]
    is_bounded, sides = isinstance(system.multipliers, BoundedMultipliers), half_sides(system)
    if is_bounded:
        kept.append(w.delassus.real)
    if sides is not None:
        kept.append(sides.real)
    elif is_bounded or system.options.refinement > 0:
        kept.append(w.a.real)
    if system.free is not None:
        kept.append(system.free.excess.real)
    return kept if system.contact is None else [*kept, *contact_solution(system.contact)]


def half_sides(system: System) -> Rows | None:
    """Sides L^-1 H' of bounded rows that a solve leaves, in whose place an adjoint needs no A; None if it goes by A.

    That is where A is shorter, on a GPU, where momentum of free bodies rests on refinement, and where more than the one
    pass is asked for that brings forces anyway.
    """
    linear, m = system.linear, system.shard.model
    size = 3 * m.dof_count
    is_bounded, on_gpu = isinstance(system.multipliers, BoundedMultipliers), system.shard.variant.world_fastest
    if not is_bounded or on_gpu or system.free is not None:
        return None
    if system.options.refinement > 1 or m.row_count * size > system.shard.work.a.real.shape[1]:
        return None
    last = (1 + m.row_count) * size
    return Rows(S=linear.y.S[:, size:last], real=linear.y.real[:, size:last, :])


@contextmanager
def lies_elsewhere(
    variant: Variant, holders: Sequence[tuple[Any, str]], parts: Sequence[tuple[wp.array, int]]
) -> Iterator[None]:
    """Launches have parts of a solution elsewhere meanwhile.

    Args:
        variant: Of the worlds whose solution it is.
        holders: What holds arrays of these parts, and under which names.
        parts: Arrays of a solution, and the addresses where what they had is kept; others are passed over.
    """
    held = [(holder, name, getattr(holder, name)) for holder, name in holders]
    kept = {array.ptr: (array, address) for array, address in parts}
    try:
        for holder, name, own in held:
            if own.real.ptr in kept:
                setattr(holder, name, rows.at_address(variant, *kept[own.real.ptr]))
        yield
    finally:
        for holder, name, own in held:
            setattr(holder, name, own)
