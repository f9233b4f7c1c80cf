"""The tangent of pressures in the adjoint of a step, which has the pressure that the step started with.

Equations: docs/theory/adjoint.md.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from softwarp.kernels.elements import directional_sums
from softwarp.kernels.rows import cavity_adjoint
from softwarp.model.cavities import CavityModel
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


class SurfaceAdjoint:
    """Gradients by the points and the pressures that ``CavityTerm.load_tangent`` makes blocks of A from.

    Args:
        shard: Worlds.
        model: Chambers.
        h: Step [s].

    Attributes:
        rest_v: Velocities that a step is linearised with at its start, 0.
    """

    def __init__(self, shard: Shard, model: CavityModel, h: float) -> None:
        self.shard, self.model, self.square = shard, model, h * h
        self.k = cavity_adjoint.kernels(shard.variant)
        real, device = model.coupling_weight.dtype, shard.device
        edges = len(model.edge_cavity)
        start, edge = model.coupling_start.numpy(), model.coupling_edge.numpy()
        block = np.repeat(np.arange(len(start) - 1), np.diff(start))
        order = np.argsort(edge, kind="stable")
        self.edges = edges
        self.edge_start = wp.array(_starts(edge, edges), dtype=wp.int32, device=device)
        self.edge_block = wp.array(block[order], dtype=wp.int32, device=device)
        self.edge_weight = wp.array(model.coupling_weight.numpy()[order], dtype=real, device=device)
        count = int(model.starts[-1])
        ends = (model.edge_opposite.numpy() - shard.model.point_count).ravel()  # sides 0 and 1 by turns
        order = np.argsort(ends, kind="stable")
        self.point_edge_start = wp.array(_starts(ends, count), dtype=wp.int32, device=device)
        self.point_edge = wp.array(order // 2, dtype=wp.int32, device=device)
        self.point_side = wp.array(1.0 - 2.0 * (order % 2), dtype=real, device=device)
        self.bar = shard.rows(3 * edges)
        self.rest_v, self.held_x = shard.rows(shard.dof_room), shard.rows(shard.work.point_x.real.shape[1])  # 0
        self.k_sums = directional_sums.kernels(shard.variant)
        rows, columns = shard.model.block_row.numpy(), shard.model.block_col.numpy()
        of_block, weight = block, model.coupling_weight.numpy()
        dofs = np.concatenate([rows[of_block], columns[of_block]])  # a block and its transpose
        others = np.concatenate([columns[of_block], rows[of_block]])
        signed = np.concatenate([weight, -weight])
        order = np.argsort(dofs, kind="stable")
        self.dof_start = wp.array(_starts(dofs, shard.model.dof_count), dtype=wp.int32, device=device)
        self.pressed_edge = wp.array(np.tile(edge, 2)[order], dtype=wp.int32, device=device)
        self.pressed_dof = wp.array(others[order], dtype=wp.int32, device=device)
        self.pressed_weight = wp.array(signed[order], dtype=real, device=device)

    def pull(self, p: Rows, start_v: Rows, point: Rows, by_pressure: wp.array) -> None:
        """Add gradients.

        Args:
            p: Adjoint of the velocities of dofs.
            start_v: Velocities of dofs that the step is linearised with.
            point: Gradients by points.
            by_pressure: Those by pressures at the start of the step, (world, chamber).
        """
        s, m, w, k = self.shard, self.model, self.shard.work, self.k
        inputs = [self.edge_start, self.edge_block, self.edge_weight, s.model.block_row, s.model.block_col]
        s.each_real(k.tangent_edges, self.edges, [*inputs, w.dof_v.real, start_v.real, p.real], [self.bar.real])
        inputs = [self.square, s.model.point_count, self.point_edge_start, self.point_edge, self.point_side]
        inputs += [m.point_cavity, self.bar.real, s.input["pressure"].real]
        s.each_real(k.tangent_points, int(m.starts[-1]), inputs, [point.real])
        inputs = [self.square, s.lanes, m.edge_cavity, m.edge_opposite, w.point_x.real, self.bar.real]
        s.each_real(k.tangent_pressure, m.count, inputs, [by_pressure])

    def push(self, point_x: Rows, pressure: Rows, side: Rows) -> None:
        """Take what the tangent gains from a right-hand side of dofs.

        Args:
            point_x: Slopes of points.
            pressure: Slopes of pressures at the start of the step.
            side: The right-hand side.
        """
        self._press(point_x, pressure, self.shard.work.dof_v, side)

    def take(self, p: Rows, pushed: Rows) -> None:
        """Take the tangent times ``p`` from A p."""
        self._press(self.held_x, self.shard.input["pressure"], p, pushed)

    def _press(self, point_x: Rows, pressure: Rows, v: Rows, side: Rows) -> None:
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [self.square, self.dof_start, self.pressed_edge, self.pressed_dof, self.pressed_weight]
        inputs += [m.edge_cavity, m.edge_opposite, s.model.dof_free, w.point_x.real, point_x.real]
        inputs += [s.input["pressure"].real, pressure.real, v.real]
        s.each_real(self.k_sums.pressed_dofs, s.model.dof_count, inputs, [side.real])


def _starts(owner: np.ndarray, count: int) -> np.ndarray:
    """Ranges of items by owner."""
    return np.concatenate([[0], np.cumsum(np.bincount(owner, minlength=count))])
