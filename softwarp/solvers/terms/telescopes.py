"""Telescopes: tubes that slide and turn in each other on a common line. Equations: docs/theory/telescope.md."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from softwarp.kernels.elements import rod
from softwarp.kernels.frames import momentum, restraint, telescope, tube_section, windup
from softwarp.model.frames import FrameModel
from softwarp.model.telescopes import TelescopeModel
from softwarp.solvers.terms.term import Pace, Term
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard

READ = ("command_tube_length", "command_tube_angle", "tube_length0", "tube_angle0", "base_angle0", "windup0")
GOOD = {"tube_length": "good_length", "tube_angle": "good_angle", "base_angle": "good_base", "windup": "good_windup"}


class TelescopeTerm(Term):
    """Telescopes of one shard; their segments are those of ``RodTerm``, their nodes those of ``FrameTerm``.

    Args:
        shard: Worlds.
        model: Telescopes.
        frames: Frames of all rods.
    """

    refreshes = True

    def __init__(self, shard: Shard, model: TelescopeModel, frames: FrameModel) -> None:
        super().__init__(shard)
        self.model, self.frames = model, frames
        types = tube_section.structures(shard.variant.real)
        self.k, self.k_windup = telescope.kernels(shard.variant), windup.kernels(shard.variant)
        self.k_state = momentum.kernels(shard.variant)
        self.k_restraint = restraint.kernels(shard.variant)
        self.k_section = tube_section.kernels(shard.variant)
        self.k_rod = rod.kernels(shard.variant, shard.options.project_tangent, True)
        self.tubes = types.Tubes()
        for name in ("first_tube", "pieces", "first_windup", "hidden_twists", "section_start", "section_end"):
            setattr(self.tubes, name, getattr(model, name))
        self.tubes.whole, self.tubes.area = model.tube_whole, model.tube_area
        self.tubes.section_ratio, self.tubes.section_curvature = model.section_ratio, model.section_curvature
        self.materials = types.Materials()
        for name, source in (("youngs", "tube_youngs"), ("nu", "tube_nu"), ("factor", "tube_curvature")):
            setattr(self.materials, name, shard.input[source].real)
        pieces = np.diff(frames.rod_start)[model.rod]
        first = np.concatenate([[0], np.cumsum(pieces)])[:-1]
        self.first_piece = wp.array(first.astype(np.int32), dtype=wp.int32, device=shard.device)
        radius = [frames.rod_radius[shard.model.rod_nodes(rod)].min() for rod in model.rod]
        self.radius = wp.array(radius, dtype=shard.variant.real, device=shard.device)
        self.side_by_side = shard.variant.world_fastest  # whether segments find their equations each by itself
        segments = model.piece_place.size if self.side_by_side else 0
        self.equations = shard.rows(windup.EQUATION_ROWS * segments)

    def load(self) -> None:
        """Flags for lengths and angles that are not finite."""
        for name in READ:
            rows = self.shard.input[name]
            self.shard.check_finite(rows, rows.real.shape[1])

    def scale(self, h: float) -> None:
        """Where the tubes are at the end of the step, where nodes slide to, and the sections of all segments."""
        s, i, w, m = self.shard, self.shard.input, self.shard.work, self.model
        inputs: list[Any] = [self.tubes, m.floor, i["tube_length0"].real, i["tube_angle0"].real]
        inputs += [i["base_angle0"].real, i["windup0"].real]
        inputs += [i[name].real for name in (*READ[:2], "tube_max_speed", "tube_max_spin")]
        outputs = [w.tube_length.real, w.tube_angle.real, w.telescope_plan.real]
        s.each_real(self.k.advance, m.count, [*inputs, h], outputs)
        inputs = [self.tubes, m.node_telescope, m.node_place, m.base_frame, m.port]
        inputs += [w.telescope_plan.real, w.pose.real, w.twist.real, i["windup0"].real]
        outputs = [i["pose0"].real, i["twist0"].real, w.slid_windup.real]
        s.each_real(self.k.slide, m.node_count, inputs, outputs)
        w.pose.copy_from(i["pose0"])
        w.twist.copy_from(i["twist0"])
        self._sections()
        inputs = [self.tubes, m.node_telescope, m.node_place, m.first_owner]
        inputs += [w.telescope_plan.real, w.tube_length.real, i["tube_density"].real]
        s.each_real(self.k.weigh, m.node_count, inputs, [w.owner_density.real])

    def _sections(self) -> None:
        """Sections of all segments, with the angles that balance the torsion of the tubes."""
        s, i, w, m, f = self.shard, self.shard.input, self.shard.work, self.model, self.frames
        inputs = [m.plain_segment, f.seg_rod, f.seg_length, f.seg_section, f.seg_scale, f.seg_rest]
        inputs += [i["rod_youngs"].S, i["rod_nu"].S]
        s.each(self.k_rod.plain_law, m.plain_segment.size, inputs, [w.segment_law.S])
        self._compose(w.slid_windup)
        inputs = [
            m.piece_segment,
            f.seg_frame,
            s.lanes,
            s.state.contact_count,
            w.segment_law.real,
            w.pose.real,
            i["telescope_load0"].real,
        ]
        s.each_real(self.k_section.bend, m.piece_place.size, inputs, [w.telescope_load.real, w.telescope_twist.real])
        self._wind()
        inputs = [self.tubes, m.node_telescope, m.node_place, m.base_frame]
        inputs += [w.telescope_plan.real, w.balanced_windup.real, w.pose.real, w.twist.real]
        outputs = [i["pose0"].real, i["twist0"].real, w.windup.real, w.base_angle.real]
        s.each_real(self.k.follow, m.node_count, inputs, outputs)
        w.pose.copy_from(i["pose0"])
        w.twist.copy_from(i["twist0"])
        self._compose(w.windup)

    def _wind(self) -> None:
        """Angles of the tubes that balance their torsion."""
        s, w, m = self.shard, self.shard.work, self.model
        w.balanced_windup.copy_from(w.slid_windup)
        known = [self.materials, w.telescope_plan.real, w.tube_length.real]
        angles, bent = w.balanced_windup.real, [w.telescope_load.real, w.telescope_twist.real]
        held = [s.lanes, s.state.contact_count, *known]
        inputs = [self.tubes, self.first_piece, m.base_frame, *held, w.tube_angle.real, w.slid_windup.real, *bent]
        inputs += [self.equations.real, w.pose.real, s.input["command_frame_force"].real]
        outputs = [w.windup_system.real, angles]
        if not self.side_by_side:
            s.each_real(self.k_windup.wind, m.count, inputs, outputs)
            return
        places = [self.tubes, m.piece_telescope, m.piece_place]
        for _ in range(windup.ITERATIONS):
            given = [*places, *held, w.slid_windup.real, angles, *bent]
            s.each_real(self.k_windup.equate, m.piece_place.size, given, [self.equations.real])
            s.each_real(self.k_windup.wind, m.count, inputs, outputs)

    def _compose(self, angles: Rows) -> None:
        s, w, m = self.shard, self.shard.work, self.model
        inputs = [self.tubes, m.piece_telescope, m.piece_place, m.piece_segment, self.materials]
        inputs += [w.telescope_plan.real, w.tube_length.real, angles.real]
        s.each_real(self.k_section.compose, m.piece_place.size, inputs, [w.segment_law.real])

    def command(self, h: float, pace: Pace) -> None:
        """Velocities of the bases."""
        s, w, m = self.shard, self.shard.work, self.model
        inputs = [m.base_frame, m.base_dof, m.port, w.base_angle.real, s.input["pose0"].real, h]
        s.each_real(self.k.drive, m.count, inputs, [w.prescribed_v.real])

    def measure_way(self, h: float, part: float) -> None:
        """Part of their way in which no segment of a line swings by more than a linearisation holds."""
        s, w, m, f, most = self.shard, self.shard.work, self.model, self.frames, part * self.shard.options.most_swing
        k, found = self.k_restraint, [w.share_of_way.real, w.swing.real]
        inputs = [m.pieces, m.base_frame, f.frame_dof, self.radius, w.telescope_plan.real, w.u.real]
        if s.variant.world_fastest:
            inputs = [h, m.piece_telescope, m.piece_place, *inputs]
            s.each_real(k.swing_of_segment, m.piece_count, inputs, [w.segment_swing.real])
            s.each_real(k.share_of_segments, None, [most, m.piece_count, w.segment_swing.real], found)
        else:
            s.each_real(k.share_of_way, None, [h, most, *inputs], found)

    def restrain(self, h: float, part: float) -> None:
        """Worlds whose lines swing more than a linearisation holds go a part of their way; no segment turns over."""
        s, w, m, f, k = self.shard, self.shard.work, self.model, self.frames, self.k_restraint
        if math.isinf(s.options.most_swing) and math.isinf(s.options.repeat_swing):
            return
        self.measure_way(h, part)
        inputs = [s.model.dof_free, w.share_of_way.real]
        s.each_real(k.hold_back, s.variant.parts(s.model.dof_count), inputs, [w.u.real])
        linear = s.options.newton_iterations == 1  # looks at contacts have moved the poses since
        pose, near = s.input["pose0"].real if linear else w.pose.real, w.segment_swing.real
        if s.variant.world_fastest:
            inputs = [h, m.piece_telescope, m.piece_place, m.base_frame, f.frame_dof, pose, w.u.real]
            s.each_real(k.turn_of_segment, m.piece_count, inputs, [near])
        inputs = [h, m.pieces, m.base_frame, f.frame_dof, s.model.dof_free, pose, near]
        s.each_real(k.hold_turns, None, inputs, [w.u.real])

    def write(self) -> None:
        """Lengths, angles and sections of good worlds."""
        s, w, state = self.shard, self.shard.work, self.shard.state
        for name, good in GOOD.items():
            value, target = getattr(w, name), getattr(state, name)
            parts, outputs = s.variant.parts(target.shape[1]), [target, getattr(state, good)]
            s.each_real(self.k_state.commit_state, parts, [s.lanes, w.flag.real, value.real], outputs)
        for name in ("telescope_load", "segment_law"):
            target, value = getattr(state, name), getattr(w, name)
            inputs = [s.lanes, w.flag.real, value.real]
            s.each_real(s.k_state.commit_rows, target.shape[1], inputs, [target])

    def refresh(self) -> None:
        """Sections, where lengths, angles or poses were written by hand."""
        self.scale(0.0)
        s, w, state = self.shard, self.shard.work, self.shard.state
        inputs = [s.lanes, w.flag.real, w.segment_law.real]
        s.each_real(s.k_state.commit_rows, state.segment_law.shape[1], inputs, [state.segment_law])
