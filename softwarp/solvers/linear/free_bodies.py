"""Free soft bodies keep their mass in a float32 factor. Theory: docs/theory/cholesky.md, "Free bodies"."""

from __future__ import annotations

import numpy as np
import warp as wp

from softwarp.kernels.linear import free_bodies
from softwarp.model import memory
from softwarp.model.model import Model
from softwarp.solvers.linear.cholesky import LinearSolver, PanelSolver
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


class FreeBodies:
    """Bodies of one shard whose rows of A sum up to the masses of their nodes.

    Args:
        shard: Worlds, inputs and workspace.
        linear: Solver of ``A u = b``, with room for three right-hand sides.
        parts: Dofs of every body, ascending.

    Attributes:
        excess: By how much the largest entry of A exceeds what a body's mass can bear, 0 if it does not; (w, part).
    """

    def __init__(self, shard: Shard, linear: LinearSolver, parts: list[np.ndarray]) -> None:
        self.shard, self.linear, self.count = shard, linear, len(parts)
        m = shard.model
        self.k = free_bodies.kernels(shard.variant)
        self.excess, self.root = shard.rows(self.count), shard.rows(3 * self.count)
        self.share = shard.rows(2 * free_bodies.SHARES * self.count if shard.variant.world_fastest else 1)
        self.skipped = memory.zeros((shard.world_count, 1), wp.int32, m.device)
        part = np.full(m.dof_count, -1)
        for number, dofs in enumerate(parts):
            part[dofs] = number

        def send(values: np.ndarray) -> wp.array:
            return wp.array(values.astype(np.int32), dtype=wp.int32, device=m.device)

        self.part_start = send(np.cumsum([0, *(dofs.size for dofs in parts)]))
        self.part_dof, self.dof_part = send(np.concatenate(parts)), send(part)

    def mark(self, a: Rows) -> None:
        """Look which bodies need care; their last blocks get more, until ``mend``, so that a factor exists."""
        s, m, w = self.shard, self.shard.model, self.shard.work
        inputs = [self.part_start, self.part_dof, m.dof_node, m.node_body, w.body_mass.S, w.node_mass.S]
        if s.variant.world_fastest:
            s.each(self.k.gauge_shares, self.count * free_bodies.SHARES, [*inputs, a.S], [self.share.S])
        s.each(self.k.mark, self.count, [*inputs, self.share.S], [a.S, self.excess.S, self.root.S])

    def mend(self, a: Rows) -> None:
        """Give marked bodies the last pivots that their masses call for; right-hand sides are overwritten."""
        s, m, w, linear = self.shard, self.shard.model, self.shard.work, self.linear
        if linear.panels is not None:
            self._mend_panels(linear.panels, a)
            return
        i = linear.index
        inputs = [m.symbolic.size, self.part_start, self.part_dof, i["l_col"], i["row_start"], i["row_block"]]
        inputs += [m.dof_node, m.node_body, w.body_mass.real, w.node_mass.real]
        inputs += [self.excess.real, self.root.real, linear.lower.real]
        s.each_real(self.k.mend_root, self.count, inputs, [a.real, linear.y.real, linear.diagonal.real])

    def _mend_panels(self, panels: PanelSolver, a: Rows) -> None:
        s, m, w, y = self.shard, self.shard.model, self.shard.work, self.linear.y
        k = free_bodies.panel_kernels(s.variant)
        inputs = [m.symbolic.size, self.count, self.dof_part, m.dof_node, m.node_body]
        inputs += [w.body_mass.real, w.node_mass.real, self.excess.real]
        s.each_real(k.place_masses, m.dof_count, inputs, [self.skipped, y.real])
        skipped, panels.skipped = panels.skipped, self.skipped
        panels.forward(3)
        panels.skipped = skipped
        inputs = [m.symbolic.size, self.part_start, self.part_dof, panels.index["position"], panels.index["column"]]
        inputs += [self.excess.real, self.root.real, y.real]
        s.each_real(k.mend_panel, self.count, inputs, [a.real, panels.lower])

    def residual(self, a: Rows, b: Rows, u: Rows, y: Rows) -> None:
        """y = b - A u anew for the dofs of marked bodies."""
        s, m, w = self.shard, self.shard.model, self.shard.work
        inputs = [self.part_start, self.part_dof, self.dof_part, m.dof_node, m.node_body]
        inputs += [m.neighbour_start, m.neighbour, m.neighbour_block, w.body_mass.real, w.node_mass.real]
        inputs += [self.excess.real, a.real, b.real, u.real]
        s.each_real(self.k.residual, s.variant.parts(self.part_dof.size), inputs, [y.real])
        inputs = [self.part_start, self.part_dof, m.dof_node, m.node_body, w.body_mass.real, w.node_mass.real]
        inputs += [self.excess.real, b.real, u.real]
        s.each_real(self.k.balance, self.count, inputs, [y.real])


def free_parts(model: Model) -> list[np.ndarray]:
    """Dofs of each soft body that nothing holds and only linear tetrahedra stiffen, ascending.

    A part is a tree of the elimination, so that its last dof is the root.
    """
    others = (model.quadratic, model.hexes, model.membranes, model.reduction, model.cavities, model.tractions)
    if not model.tet_count or any(other is not None for other in others):
        return []
    node, root = model.dof_node.numpy(), roots(model.symbolic.parent)
    is_held = (node >= model.own_node_count) | ~model.dof_free.numpy().reshape(-1, 3).all(axis=1)
    body, own = model.node_body.numpy(), model.node_dof.numpy()[: model.own_node_count]
    soft = ~is_held
    is_held[soft] |= np.isin(body[node[soft]], body[: own.size][own < 0])
    return [np.flatnonzero(root == j) for j in np.setdiff1d(root, root[is_held])]


def roots(parent: np.ndarray) -> np.ndarray:
    """Last dof of the elimination tree of every dof, from the next one above it, -1 where there is none."""
    root = np.arange(parent.size)
    for j in np.flatnonzero(parent >= 0)[::-1]:
        root[j] = root[parent[j]]
    return root
