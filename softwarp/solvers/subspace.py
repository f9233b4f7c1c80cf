"""Nodes of reduced bodies as contacts see them: velocities, and forces at them. Theory: docs/theory/reduction.md."""

from __future__ import annotations

from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.elements import reduction
from softwarp.kernels.rows import touch
from softwarp.model.model import Model
from softwarp.solvers.workspace.launches import Launches
from softwarp.solvers.workspace.rows import Rows


def nothing_touches(variant: Variant, device: Any) -> Any:
    """What kernels need of reduced bodies in scenes without any."""
    result = touch.functions(variant).Touch()
    none = wp.empty(0, dtype=wp.int32, device=device)
    for name in ("first", "begin", "end", "dof", "stride", "place"):
        setattr(result, name, none)
    result.basis = wp.empty(0, dtype=variant.real, device=device)
    return result


def touch_struct(model: Model, variant: Variant) -> Any:
    """Modes at nodes that may touch something, for kernels."""
    result, r = nothing_touches(variant, model.device), model.reduction
    if r is not None:
        result.first, result.begin, result.end = r.touch_first, r.touch_begin, r.touch_end
        result.dof, result.stride, result.place, result.basis = r.mode_dof, r.touch_stride, r.touch_basis, r.basis
    return result


class Subspace:
    """What contacts add to unknowns that are amplitudes of modes.

    Arrays of dofs have places behind the last one for the nodes that may touch something: ``Model.dof_room``.

    Args:
        model: Scene.
        launches: Worlds.
    """

    def __init__(self, model: Model, launches: Launches) -> None:
        self.model, self.launches = model, launches
        self.k = reduction.kernels(launches.variant)
        self.touches = model.dof_room - model.dof_count
        self.forces = launches.rows(3 * model.dof_room) if self.touches else None
        self.wide = launches.rows(0 if model.reduction is None else model.reduction.wide_count)

    def expand(self, *velocities: Rows) -> None:
        """Velocities of the nodes, behind those of the dofs that they follow from."""
        r, each = self.model.reduction, self.launches.each
        if self.touches and r is not None:
            inputs = [self.model.dof_count, r.touch_listed, r.node_body, r.node_basis, r.body_wide, r.body_stride]
            inputs += [r.basis, self.wide.S]
            for v in velocities:
                each(self.k.widen_dofs, r.wide_count, [r.wide_mode, r.mode_dof, v.S], [self.wide.S])
                each(self.k.touch_velocities, self.touches, inputs, [v.S])

    def project(self, forces: Rows, target: Rows) -> None:
        """target += forces on dofs, and on modes those at the nodes.

        Args:
            forces: With places for the nodes.
            target: Rows of the dofs first.
        """
        r = self.model.reduction
        if r is not None:
            inputs = [self.model.dof_count, r.mode_dof, r.block_touch, r.touch_begin, r.touch_stride, r.touch_basis]
            self.launches.each(self.k.touch_forces, r.count // 3, [*inputs, r.basis, forces.S], [target.S])
