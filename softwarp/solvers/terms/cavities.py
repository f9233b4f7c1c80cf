"""Air chambers and membranes in the linear system of a shard. Equations: docs/theory/cavity.md and membrane.md."""

from __future__ import annotations

from typing import TYPE_CHECKING

from softwarp.kernels.elements import attachment, hyperelastic, membrane
from softwarp.kernels.frames import momentum
from softwarp.kernels.rows import cavity
from softwarp.model.cavities import CavityModel, MembraneModel
from softwarp.solvers.workspace.rows import Rows

if TYPE_CHECKING:
    from softwarp.solvers.system import System


class CavitySystem:
    """Workspace and launches for the chambers of one shard; their rows follow those of the cables.

    Args:
        system: Owner of the linear system.
        model: Chambers.
    """

    def __init__(self, system: System, model: CavityModel) -> None:
        self.system, self.model = system, model
        self.k = cavity.kernels(system.variant)
        self.first_row, self.first_point = system.model.cable_count, system.model.point_count
        self.points = int(model.starts[-1])
        names = ("volume", "pressure", "goal", "target", "lower", "upper", "compliance")
        self.rows = {name: system._rows(model.count) for name in names}  # per chamber, in m^3 and Pa
        self.edge = system._rows(3 * len(model.edge_cavity))
        self.share = system._rows(1)  # of the tangent that A gets: 1, and less where a solve with it has failed

    def load(self) -> None:
        """Pressures of the last step as multipliers; A gets their tangent whole."""
        s, m = self.system, self.model
        s.each_world(self.k.whole_share, [], [self.share.S])
        self.rows["pressure"].copy_from(s.input["pressure"])
        inputs = [self.first_row, m.cavity_area, self.rows["pressure"].S]
        s.each(self.k.row_of_pressure, m.count, inputs, [s.multiplier.S])

    def measure(self) -> None:
        """Points, volumes and the gradients of rows at the trial positions."""
        s, m = self.system, self.model
        inputs = [self.first_point, s.model.point_node, s.model.point_weight, s.model.point_anchor, s.x.S]
        s.each(self.k.cavity_points, self.points, inputs, [s.point_x.S])
        inputs = [self.first_point, m.ring_start, m.point_ring, s.point_x.S]
        s.each(self.k.cavity_gradient, self.points, inputs, [s.point_gradient.S])
        inputs = [0, m.cavity_point_start, s.point_x.S, s.point_gradient.S]
        s.each(self.k.cavity_volume, m.count, inputs, [self.rows["volume"].S])
        inputs = [self.first_point, m.cavity_area, m.point_cavity]
        s.each(self.k.scale_gradient, self.points, inputs, [s.point_gradient.S])

    def command(self, h: float) -> None:
        """Targets and bounds from commands and limits; needs ``measure``."""
        s, m, i, r = self.system, self.model, self.system.input, self.rows
        inputs = [0, m.cavity_control]
        inputs += [i[f"command_cavity_{name}"].S for name in ("pressure", "volume", "gas")]
        inputs += [i[f"cavity_{name}"].S for name in ("min_pressure", "max_pressure", "min_volume", "max_volume")]
        inputs += [i[f"cavity_{name}"].S for name in ("max_pressure_rate", "max_flow", "ambient", "exponent")]
        inputs += [r["pressure"].S, r["volume"].S, h]
        outputs = [r["goal"].S, r["lower"].S, r["upper"].S]
        s.each(self.k.cavity_command, m.count, inputs, outputs)

    def law(self) -> None:
        """Rows at the present volumes; needs ``command``."""
        s, m, i, r = self.system, self.model, self.system.input, self.rows
        inputs = [0, m.cavity_control, m.cavity_rest_volume, i["cavity_ambient"].S, i["cavity_exponent"].S]
        inputs += [r["goal"].S, r["volume"].S]
        s.each(self.k.cavity_law, m.count, inputs, [r["target"].S, r["compliance"].S])
        inputs = [r[name].S for name in ("volume", "target", "lower", "upper", "compliance")]
        outputs = [s.displacement.S, s.target.S, s.lower_bound.S, s.upper_bound.S, s.compliance.S]
        s.each(self.k.to_row, m.count, [self.first_row, m.cavity_area, *inputs], outputs)

    def tangent(self) -> None:
        """Add -p d2V/dx2 to A."""
        s, m = self.system, self.model
        self._measure_pressure()
        inputs = [0, m.edge_cavity, m.edge_opposite, s.point_x.S, self.rows["pressure"].S, self.share.S]
        inputs.append(s.tangent_scale)
        s.each(self.k.edge_stiffness, len(m.edge_cavity), inputs, [self.edge.S])
        inputs = [m.coupling_start, m.coupling_edge, m.coupling_weight, self.edge.S]
        s.each(self.k.block_stiffness, len(s.model.symbolic.a_row), inputs, [s.a.S])

    def write(self) -> None:
        """Volumes and pressures of good worlds into the state; measures them at the end of the step."""
        s = self.system
        self.measure()
        self._measure_pressure()
        inputs = [s.lanes, s.flag.real, self.rows["pressure"].real]
        s.each_real(s.k_state.commit_rows, self.model.count, inputs, [s.state.cavity_pressure])
        self.write_volume()

    def write_volume(self) -> None:
        """Volumes of ``measure`` into the state."""
        s, volume = self.system, self.system.state.cavity_volume
        kernel = momentum.kernels(s.variant).commit_state
        inputs = [s.lanes, s.flag.real, self.rows["volume"].real]
        s.each_real(kernel, s.variant.parts(self.model.count), inputs, [volume, volume])

    def _measure_pressure(self) -> None:
        s, m = self.system, self.model
        inputs = [self.first_row, m.cavity_area, s.multiplier.S]
        s.each(self.k.pressure_of_row, m.count, inputs, [self.rows["pressure"].S])


class MembraneSystem:
    """Workspace and launches for the membranes of one shard.

    Args:
        system: Owner of the linear system.
        model: Membranes.
    """

    def __init__(self, system: System, model: MembraneModel) -> None:
        self.system, self.model = system, model
        self.k = membrane.kernels(system.variant, system.options.project_tangent)
        self.count = len(model.triangles)
        self.stiffness = system._rows(90 * self.count)

    def forces(self) -> None:
        """Corner forces of every triangle, after those of the tets."""
        s = self.system
        s.each(self.k.triangle_force, self.count, self._inputs(s.model.tet_count), [s.tet_force.S])

    def tangent(self) -> None:
        """Add the stiffness of all triangles to A."""
        s, m, scale = self.system, self.model, self.system.body["stiffness"]
        s.each(self.k.triangle_stiffness, self.count, self._inputs(0), [self.stiffness.S])
        inputs = [m.element_body, m.membrane_entry_start, m.membrane_entry, scale.S, self.stiffness.S]
        blocks = len(s.model.symbolic.a_row)
        s.each(hyperelastic.gather_kernels(s.variant).block_stiffness, blocks, inputs, [s.a.S])
        if s.frames is not None:
            inputs = [m.element_body, m.carried_block, m.carried_start, m.carried_entry, m.carried_weight]
            inputs += [scale.S, self.stiffness.S]
            kernel = attachment.kernels(s.variant).stored_stiffness
            s.each(kernel, m.carried_block.size, [*inputs, s.frames.lever.S], [s.a.S])

    def damp(self, slot_v: Rows) -> None:
        """Add beta K v of triangles at nodes that frames carry to the internal forces there; needs ``tangent``."""
        s, m = self.system, self.model
        inputs = [m.element_body, m.tri_node, m.held_node, m.held_start, m.held_entry, m.held_weight]
        inputs += [s.input["rayleigh_stiffness"].S, self.stiffness.S, slot_v.S]
        s.each(attachment.kernels(s.variant).stored_damping, m.held_node.size, inputs, [s.node_internal.S])

    def _inputs(self, first: int) -> list[object]:
        m, i = self.model, self.system.input
        shared = [first, m.tri_node, m.tri_membrane, m.tri_gradient, m.tri_volume]
        return [*shared, i["membrane_youngs"].S, i["membrane_nu"].S, self.system.x.S]
