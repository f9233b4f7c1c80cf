"""Cables: rows that shorten. Equations: docs/theory/cable.md."""

from __future__ import annotations

import warp as wp

from softwarp.kernels.rows import cable
from softwarp.solvers.terms.term import Pace, Term
from softwarp.solvers.workspace.shard import Shard


class CableTerm(Term):
    """Cables of one shard; theirs are the first rows."""

    has_exact_tangent = True

    def __init__(self, shard: Shard) -> None:
        super().__init__(shard)
        self.is_elastic = bool(shard.model.cable_elastic.any())
        self.follows_paths, self.responds = not self.is_elastic, self.is_elastic
        self.k = cable.kernels(shard.variant)
        self.count = shard.model.cable_count
        self.stretches = wp.array(shard.model.cable_elastic, dtype=wp.int32, device=shard.device)

    def load(self) -> None:
        """Tensions of the last step; flags for commands that are not finite."""
        s, i = self.shard, self.shard.input
        s.place(i["tension"], self.count, s.work.multiplier, 0)
        for name in ("command_cable_displacement", "command_cable_tension"):
            s.check_finite(i[name], self.count)

    def measure(self) -> None:
        """Points, displacements and gradients at the trial positions."""
        s, m, w = self.shard, self.shard.model, self.shard.work
        inputs = [m.cable_point_start_device, m.point_node, m.point_weight, m.point_anchor]
        inputs += [m.cable_rest_length, m.cable_closing_length, w.x.S]
        outputs = [w.point_x.S, w.point_gradient.S, w.displacement.S]
        s.each(self.k.cable_geometry, self.count, inputs, outputs)

    def command(self, h: float, pace: Pace) -> None:
        """Targets, bounds and compliance from commands, limits and measured displacements."""
        s, i, w = self.shard, self.shard.input, self.shard.work
        names = ("min_displacement", "max_displacement", "min_tension", "max_tension", "max_rate")
        inputs = [s.model.cable_force_control, self.stretches]
        inputs += [i["command_cable_displacement"].S, i["command_cable_tension"].S]
        inputs += [*(i[f"cable_{name}"].S for name in names), w.displacement.S, w.lag.S, h]
        outputs = [w.target.S, w.lower_bound.S, w.upper_bound.S]
        s.each(self.k.cable_command, self.count, inputs, outputs)
        w.compliance.zero()
        if self.is_elastic:
            inputs = [s.model.cable_force_control, i["cable_stiffness"].S, i["cable_damping"].S, w.displacement.S, h]
            s.each(self.k.stretch, self.count, inputs, [w.target.S, w.compliance.S])

    def stiffen(self) -> None:
        """Stiffness of taut cables, where A has room for it."""
        s, m, w = self.shard, self.shard.model, self.shard.work
        if not m.coupling_point.size:
            return
        inputs = [m.cable_point_start_device, m.point_cable, m.cable_closing_length]
        inputs += [w.point_x.S, w.multiplier.S]
        s.each(self.k.segment_stiffness, m.point_count, inputs, [w.cable_segment.S])
        inputs = [m.coupling_start, m.coupling_point, m.coupling_weight, w.cable_segment.S]
        s.each(self.k.block_stiffness, s.blocks, inputs, [w.a.S])

    def write(self) -> None:
        """Tensions of good worlds."""
        s, w = self.shard, self.shard.work
        inputs = [s.lanes, w.flag.real, w.multiplier.real]
        s.each_real(s.k_state.commit_rows, self.count, inputs, [s.state.cable_tension])
