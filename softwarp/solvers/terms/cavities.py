"""Air chambers: rows that measure volumes. Equations: docs/theory/cavity.md."""

from __future__ import annotations

import warp as wp

from softwarp.kernels.algebra import team
from softwarp.kernels.frames import momentum
from softwarp.kernels.rows import cavity, cavity_surface
from softwarp.model.cavities import CavityModel
from softwarp.solvers.terms.term import Pace, Term, load_factor
from softwarp.solvers.workspace.shard import Shard


class CavityTerm(Term):
    """Chambers of one shard; their rows follow those of the cables.

    Args:
        shard: Worlds.
        model: Chambers.
    """

    refreshes = True
    responds = True
    has_exact_tangent = True

    def __init__(self, shard: Shard, model: CavityModel) -> None:
        super().__init__(shard)
        self.model = model
        self.k = cavity.kernels(shard.variant)
        self.k_surface = None if shard.variant.world_fastest else cavity_surface.kernels(shard.variant)
        self.k_state = momentum.kernels(shard.variant)
        self.first_row, self.first_point = shard.model.first_row("cavity"), shard.model.point_count
        self.points = int(model.starts[-1])

    def load(self) -> None:
        """Pressures of the last step as multipliers; A gets their tangent whole."""
        s, m, w = self.shard, self.model, self.shard.work
        s.each_world(self.k.whole_share, [], [w.pressure_share.S])
        w.cavity_pressure.copy_from(s.input["pressure"])
        inputs = [self.first_row, m.cavity_area, w.cavity_pressure.S]
        s.each(self.k.row_of_pressure, m.count, inputs, [w.multiplier.S])
        for name in ("command_cavity_pressure", "command_cavity_volume", "command_cavity_gas"):
            s.check_finite(s.input[name], m.count)

    def measure(self) -> None:
        """Points, volumes and the gradients of rows at the trial positions."""
        self._measure_volume(scaled=True)

    def _measure_volume(self, *, scaled: bool) -> None:
        """The same; gradients as rows have them, per metre of a chamber's area, or [m^2]."""
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [self.first_point, s.model.point_node, s.model.point_weight, s.model.point_anchor, w.x.S]
        s.each(self.k.cavity_points, self.points, inputs, [w.point_x.S])
        if self.k_surface is not None:
            inputs = [scaled, m.cavity_point_start, m.cavity_tri_start, m.cavity_tri, m.cavity_area, w.point_x.S]
            s.each(self.k_surface.measure_cavity, m.count, inputs, [w.point_gradient.S, w.cavity_volume.S])
            return
        inputs = [self.first_point, m.ring_start, m.point_ring, w.point_x.S]
        s.each(self.k.cavity_gradient, self.points, inputs, [w.point_gradient.S])
        inputs = [0, m.cavity_point_start, w.point_x.S, w.point_gradient.S]
        if s.variant.world_fastest:
            parts, threads = team.team(s.device, s.width, m.count)
            wp.launch(self.k.share_volume, threads, [parts, *inputs], [w.cavity_volume.S], device=s.device)
        else:
            s.each(self.k.cavity_volume, m.count, inputs, [w.cavity_volume.S])
        if scaled:
            inputs = [self.first_point, m.cavity_area, m.point_cavity]
            s.each(self.k.scale_gradient, self.points, inputs, [w.point_gradient.S])

    def command(self, h: float, pace: Pace) -> None:
        """Targets and bounds from commands and limits; needs ``measure``."""
        s, m, i, w = self.shard, self.model, self.shard.input, self.shard.work
        inputs = [0, m.cavity_control]
        inputs += [i[f"command_cavity_{name}"].S for name in ("pressure", "volume", "gas")]
        inputs += [i[f"cavity_{name}"].S for name in ("min_pressure", "max_pressure", "min_volume", "max_volume")]
        inputs += [i[f"cavity_{name}"].S for name in ("max_pressure_rate", "max_flow", "ambient", "exponent")]
        inputs += [w.cavity_pressure.S, w.cavity_volume.S, w.lag.S, h, pace.lapse]
        outputs = [w.cavity_goal.S, w.cavity_lower.S, w.cavity_upper.S]
        s.each(self.k.cavity_command, m.count, inputs, outputs)

    def law(self) -> None:
        """Rows at the present volumes; needs ``command``."""
        s, m, i, w = self.shard, self.model, self.shard.input, self.shard.work
        inputs = [0, m.cavity_control, m.cavity_rest_volume, i["cavity_ambient"].S, i["cavity_exponent"].S]
        inputs += [w.cavity_goal.S, w.cavity_volume.S]
        s.each(self.k.cavity_law, m.count, inputs, [w.cavity_target.S, w.cavity_compliance.S])
        inputs = [self.first_row, m.cavity_area, w.cavity_volume.S, w.cavity_target.S]
        inputs += [w.cavity_lower.S, w.cavity_upper.S, w.cavity_compliance.S]
        outputs = [w.displacement.S, w.target.S, w.lower_bound.S, w.upper_bound.S, w.compliance.S]
        s.each(self.k.to_row, m.count, inputs, outputs)

    def load_tangent(self, h: float) -> None:
        """-p d2V/dx2, if asked for."""
        if self.shard.options.pressure_tangent:
            self._add_tangent(load_factor(h))

    def stiffen(self) -> None:
        """The same in statics."""
        self._add_tangent(1.0)

    def _add_tangent(self, factor: float) -> None:
        s, m, w = self.shard, self.model, self.shard.work
        self._measure_pressure()
        inputs = [0, m.edge_cavity, m.edge_opposite, w.point_x.S, w.cavity_pressure.S, w.pressure_share.S]
        s.each(self.k.edge_stiffness, len(m.edge_cavity), [*inputs, factor], [w.cavity_edge.S])
        inputs = [m.coupling_start, m.coupling_edge, m.coupling_weight, w.cavity_edge.S]
        s.each(self.k.block_stiffness, s.blocks, inputs, [w.a.S])

    def check(self, h: float) -> None:
        """Volumes and pressures at the end of the step."""
        self._measure_volume(scaled=False)
        self._measure_pressure()

    def write(self) -> None:
        """Volumes and pressures of good worlds."""
        s, w = self.shard, self.shard.work
        inputs = [s.lanes, w.flag.real, w.cavity_pressure.real]
        s.each_real(s.k_state.commit_rows, self.model.count, inputs, [s.state.cavity_pressure])
        self.refresh()

    def refresh(self) -> None:
        """Volumes of ``measure``."""
        s, w, volume = self.shard, self.shard.work, self.shard.state.cavity_volume
        inputs = [s.lanes, w.flag.real, w.cavity_volume.real]
        s.each_real(self.k_state.commit_state, s.variant.parts(self.model.count), inputs, [volume, volume])

    def _measure_pressure(self) -> None:
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [self.first_row, m.cavity_area, w.multiplier.S]
        s.each(self.k.pressure_of_row, m.count, inputs, [w.cavity_pressure.S])
