"""Gradients of membranes in a step: by corners of triangles and by moduli. Theory: docs/theory/adjoint.md."""

from __future__ import annotations

from softwarp.kernels.elements import membrane_adjoint
from softwarp.model.cavities import MembraneModel
from softwarp.model.gradients import Gradients
from softwarp.solvers.frame_adjoint import lists
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


class MembraneAdjoint:
    """Gradients of all triangles of one shard.

    Args:
        shard: Worlds.
        model: Membranes.
    """

    def __init__(self, shard: Shard, model: MembraneModel) -> None:
        self.shard, self.model, self.count = shard, model, len(model.triangles)
        self.k = membrane_adjoint.kernels(shard.variant, shard.options.project_tangent)
        self.parameter = shard.rows(membrane_adjoint.PARAMETERS * self.count)
        self.of_membrane = lists(model.tri_membrane.numpy(), model.count, shard.device)
        self.of_body = lists(model.element_body.numpy(), shard.model.body_count, shard.device)

    def pull(self, v: Rows, p: Rows, stiffness: Rows, h: float, corner: Rows) -> None:
        """Gradients by corners, 12 a triangle behind those of linear tets, and by constants.

        Args:
            v: Velocities that elements feel, of nodes.
            p: Adjoint of velocities.
            stiffness: Factor of the stiffness in A, of every body.
            h: Step [s].
            corner: Receives the gradients by corners.
        """
        s, m, i = self.shard, self.model, self.shard.input
        inputs = [s.model.tet_count, h, m.tri_node, m.tri_membrane, m.tri_gradient, m.tri_volume, m.element_body]
        inputs += [i["membrane_youngs"].real, i["membrane_nu"].real, stiffness.real, s.work.x.real, v.real, p.real]
        s.each_real(self.k.triangle_adjoint, self.count, inputs, [corner.real, self.parameter.real])

    def to_parameters(self, h: float, gradients: Gradients) -> None:
        """Add the gradients by moduli, and by the damping of the bodies that membranes are on."""
        s, m, i, g = self.shard, self.model, self.shard.input, gradients
        inputs = [s.lanes, *self.of_membrane, i["membrane_youngs"].real, i["membrane_nu"].real, self.parameter.real]
        s.each_real(self.k.moduli, m.count, inputs, [g.membrane_youngs, g.membrane_nu])
        inputs = [h, s.lanes, *self.of_body, self.parameter.real]
        s.each_real(self.k.damping, s.model.body_count, inputs, [g.rayleigh_stiffness])
