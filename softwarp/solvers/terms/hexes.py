"""Corotational hexahedra with incompatible modes. Equations: docs/theory/hexahedral.md."""

from __future__ import annotations

import warp as wp

from softwarp.kernels.elements import hexahedral
from softwarp.model.hexes import HexModel
from softwarp.solvers.terms.term import Term
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


class HexTerm(Term):
    """Hexahedra of soft bodies, those whose corners frames carry among them.

    Args:
        shard: Worlds.
        model: Hexahedra; their forces are the last ones of elements.
    """

    def __init__(self, shard: Shard, model: HexModel) -> None:
        super().__init__(shard)
        self.model = model
        self.k = hexahedral.kernels(shard.variant)
        self.first = shard.work.element_force.real.shape[1] - 3 * hexahedral.CORNERS * model.count
        self.elements = [model.hex_body, model.hex_shape, model.hex_factor]

    def scale(self, h: float) -> None:
        """Stiffness of every shape, where moduli have changed."""
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [hexahedral.CORNERS, m.mode_ratio.shape[1], m.shape_body, m.shape_mu, m.shape_lam]
        inputs += [m.mode_mu, m.mode_lam, m.mode_ratio, w.body_mu.S, w.body_lam.S]
        s.each(self.k.shape_stiffness, m.shape_body.size, inputs, [w.hex_moduli.S, w.hex_stiffness.S])

    def forces(self) -> None:
        """Forces and rotations of all hexahedra."""
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [self.first, hexahedral.CORNERS, m.hex_node, *self.elements, m.hex_volume]
        inputs += [m.shape_x, m.shape_gradient, s.model.body_guard]
        inputs += [w.body_mu.S, w.body_lam.S, w.hex_stiffness.S, w.x.S]
        s.each(self.k.hex_force, m.count, inputs, [w.hex_rotation.S, w.hex_strain.S, w.element_force.S])

    def tangent(self, h: float) -> None:
        """Stiffness of all hexahedra."""
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [*self.elements, m.hex_block, m.entry_start, m.entry]
        inputs += [w.body_stiffness.S, w.hex_stiffness.S, w.hex_rotation.S]
        s.each(self.k.block_stiffness, s.variant.parts(s.blocks), inputs, [w.a.S])
        inputs = [*self.elements, m.carried_block, m.carried_start, m.carried_entry]
        inputs += [w.body_stiffness.S, w.hex_stiffness.S, w.hex_rotation.S, w.lever.S]
        s.each(self.k.carried_stiffness, m.carried_block.size, inputs, [w.a.S])

    def right_hand_side(self, f_scale: float, inertia: bool, moving: bool) -> None:
        """Beta K v at carried nodes as internal forces; needs the velocities of slots."""
        if not moving and not (self.shard.leaning and inertia):
            return
        self.add_products(self.shard.felt["beta"].S, self.shard.work.slot_v, self.shard.work.node_internal)

    def add_products(self, factor: wp.array, velocity: Rows, out: Rows) -> None:
        """Add a factor of every body times K v, as of the last ``forces``, at the nodes that frames carry."""
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [hexahedral.CORNERS, m.hex_node, *self.elements, m.held_node, m.held_start, m.held_entry]
        inputs += [factor, w.hex_stiffness.S, w.hex_rotation.S, velocity.S]
        s.each(self.k.held_damping, m.held_node.size, inputs, [out.S])
