"""Nodes of reduced bodies as contacts see them: velocities, and forces at them. Theory: docs/theory/reduction.md."""

from __future__ import annotations

from typing import Any

import warp as wp

from softwarp.kernels.algebra import team
from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.elements import floating, mode_loads, mode_places, reduction
from softwarp.kernels.rows import touch
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


def nothing_touches(variant: Variant, device: Any) -> Any:
    """What kernels need of reduced bodies in scenes without any."""
    result = touch.functions(variant).Touch()
    none = wp.empty(0, dtype=wp.int32, device=device)
    for name in ("first", "begin", "end", "dof", "stride", "place", "floating"):
        setattr(result, name, none)
    result.basis = result.radius = wp.empty(0, dtype=variant.real, device=device)
    result.axes = result.arm = wp.empty((1, 0, 1), dtype=variant.real, device=device)
    return result


def touch_struct(shard: Shard) -> Any:
    """Modes at nodes that may touch something, for kernels."""
    device, r = shard.model.device, shard.model.reduction
    result = nothing_touches(shard.variant, device)
    if r is None:
        return result
    result.first, result.begin, result.end = r.touch_first, r.touch_begin, r.touch_end
    result.dof, result.stride, result.place, result.basis = r.mode_dof, r.touch_stride, r.touch_basis, r.basis
    result.axes, result.arm = shard.work.frame_axes.real, shard.work.touch_arm.real
    if r.floating is None:
        result.floating = wp.full(r.touch_listed.size, -1, dtype=wp.int32, device=device)
    else:
        result.floating, result.radius = r.floating.touch_body, r.floating.radius
    return result


class Subspace:
    """What contacts add to unknowns that are amplitudes of modes.

    Arrays of dofs have places behind the last one for the nodes that may touch something: ``Model.dof_room``.

    Args:
        shard: Worlds.
    """

    def __init__(self, shard: Shard) -> None:
        model = shard.model
        self.model, self.shard = model, shard
        self.k_loads = mode_loads.kernels(shard.variant)
        self.k, self.k_floating = reduction.kernels(shard.variant), floating.kernels(shard.variant)
        self.touches = model.dof_room - model.dof_count
        self.forces = shard.rows(3 * model.dof_room) if self.touches else None
        self.wide = shard.rows(0 if model.reduction is None else model.reduction.wide_count)
        self.frames = None if model.reduction is None else model.reduction.floating

    def expand(self, *velocities: Rows) -> None:
        """Velocities of the nodes, behind those of the dofs that they follow from."""
        r, s, f = self.model.reduction, self.shard, self.frames
        if self.touches and r is not None:
            bodies, items, k = [r.body_wide, r.body_stride, r.basis, self.wide.S], self.touches, self.k
            inputs = [self.model.dof_count, r.touch_listed, r.node_body, r.node_basis, *bodies]
            if s.variant.world_fastest:
                k, items = mode_places.kernels(s.variant), -(-self.touches // mode_places.NODES)
                inputs = [self.model.dof_count, r.touch_listed, r.touch_basis, r.node_body, *bodies]
            for v in velocities:
                s.each(self.k.widen_dofs, r.wide_count, [r.wide_mode, r.mode_dof, v.S], [self.wide.S])
                s.each(k.touch_velocities, items, inputs, [v.S])
                if f is not None:
                    given = [self.model.dof_count, f.touch, f.touch_body, f.block, r.mode_dof, f.radius]
                    given += [s.work.frame_axes.real, s.work.touch_arm.real]
                    s.each_real(self.k_floating.touch_velocities, int(f.touch.size), given, [v.real])

    def project(self, forces: Rows, target: Rows) -> None:
        """target += forces on dofs, and on modes those at the nodes.

        Args:
            forces: With places for the nodes.
            target: Rows of the dofs first.
        """
        r, s, f = self.model.reduction, self.shard, self.frames
        if r is not None:
            s.each(self.k.add_dof_forces, 3 * self.model.dof_count, [forces.S], [target.S])
            if f is not None:
                inputs = [self.model.dof_count, f.touch_range, f.block, r.mode_dof, f.radius]
                inputs += [s.work.touch_arm.real, forces.real]
                s.each_real(self.k_floating.rigid_forces, f.count, inputs, [target.real])
                inputs = [self.model.dof_count, f.touch, f.touch_body, s.work.frame_axes.real]
                s.each_real(self.k_floating.turn_forces, int(f.touch.size), inputs, [forces.real])
            if not s.variant.world_fastest:
                inputs = [self.model.dof_count, r.body_modes, r.body_stride, r.body_wide, r.mode_dof, r.block_touch]
                inputs += [r.touch_basis, r.basis, forces.S]
                s.each_world(self.k_loads.touch_loads, inputs, [self.wide.S, target.S])
                return
            inputs = [self.model.dof_count, r.mode_dof, r.block_touch, r.touch_begin, r.touch_stride, r.touch_basis]
            parts, threads = team.team(s.device, s.width, r.count // 3)
            inputs = [parts, *inputs, r.basis, forces.S]
            wp.launch(self.k_loads.touch_forces, threads, inputs, [target.S], device=s.device)


def each_load(shard: Shard, kernel: Any, modes: int, items: int, inputs: list[Any], outputs: list[Any]) -> None:
    """Launch a kernel of ``mode_loads`` for some modes on a GPU, for some bodies or rows on a CPU."""
    if not shard.variant.world_fastest:
        shard.each(kernel, items, inputs, outputs)
    elif modes:
        parts, threads = team.team(shard.device, shard.width, modes // mode_loads.GROUP)
        wp.launch(kernel, threads, [parts, *inputs], outputs, device=shard.device)
