"""Stress relaxation of soft bodies. Equations: docs/theory/relaxation.md."""

from __future__ import annotations

import warp as wp

from softwarp.kernels.frames import relaxation
from softwarp.solvers.terms.term import Term
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


class RelaxationTerm(Term):
    """Maxwell branches of the soft bodies of one shard, and what nodes and frames remember for them.

    While it is there, forces are found with velocities that lean, ``Shard.felt``.

    Args:
        shard: Worlds.
    """

    def __init__(self, shard: Shard) -> None:
        super().__init__(shard)
        m = shard.model
        self.k = relaxation.kernels(shard.variant)
        self.bodies, self.frames = m.body_count, m.frame_count
        self.beta = shard.rows(self.bodies)
        self.keep, self.lean_share = shard.rows(self.bodies + 1), shard.rows(self.bodies + 1)
        self.node_memory, self.frame_memory = shard.rows(3 * m.node_count), shard.rows(6 * max(self.frames, 1))
        shard.felt["v0"] = shard.rows(3 * m.node_count)
        shard.felt["twist0"] = shard.rows(6 * max(self.frames, 1))
        shard.felt["dof_v"] = shard.rows(shard.dof_rows)
        shard.felt["beta"] = self.beta
        shard.leaning = True

    def scale(self, h: float) -> None:
        """Factors of K, after those of all bodies."""
        s, i, w = self.shard, self.shard.input, self.shard.work
        inputs = [self.bodies, h, i["relaxation_ratio"].real, i["relaxation_time"].real, i["rayleigh_stiffness"].real]
        outputs = [w.body_stiffness.real, w.body_damping.real, self.beta.real, self.keep.real, self.lean_share.real]
        s.each_real(self.k.scales, None, inputs, outputs)

    def lean(self) -> None:
        """Velocities of the start and of now, with the memories that act beside them; needs those of ``scale``."""
        s, m, i, w, felt = self.shard, self.shard.model, self.shard.input, self.shard.work, self.shard.felt
        share, memory = self.lean_share.real, (i["node_memory"].real, i["frame_memory"].real)
        inputs = [m.node_body, share, w.body_mass.real, i["v0"].real, memory[0]]
        s.each_real(self.k.lean_nodes, m.body_node_count, inputs, [felt["v0"].real])
        inputs = [self.bodies, share, w.compound.real, i["twist0"].real, memory[1]]
        s.each_real(self.k.lean_frames, self.frames, inputs, [felt["twist0"].real])
        self.lean_dofs(w.dof_v, felt["dof_v"])

    def lean_dofs(self, dof_v: Rows, leaning: Rows) -> None:
        """Velocities of dofs with the memories that act beside them."""
        s, m, i = self.shard, self.shard.model, self.shard.input
        inputs = [m.node_count, self.bodies, m.dof_node, m.node_body, self.lean_share.real]
        inputs += [i["node_memory"].real, i["frame_memory"].real, dof_v.real]
        s.each_real(self.k.lean_dofs, m.dof_count, inputs, [leaning.real])

    def check(self, h: float) -> None:
        """Memories at the end of the step."""
        s, m, i, w = self.shard, self.shard.model, self.shard.input, self.shard.work
        inputs = [m.node_body, self.keep.real, i["node_memory"].real, i["x0"].real, w.x.real]
        s.each_real(self.k.remember_nodes, m.body_node_count, inputs, [self.node_memory.real])
        inputs = [self.bodies, self.keep.real, i["frame_memory"].real, i["pose0"].real, w.pose.real]
        s.each_real(self.k.remember_frames, self.frames, inputs, [self.frame_memory.real])

    def write(self) -> None:
        """Memories of good worlds."""
        self._write(self.node_memory, self.shard.state.node_memory)
        self._write(self.frame_memory, self.shard.state.frame_memory)

    def _write(self, value: Rows, target: wp.array) -> None:
        s = self.shard
        inputs = [s.lanes, s.work.flag.real, value.real]
        s.each_real(s.k_state.commit_rows, target.shape[1], inputs, [target])
