"""Elements at nodes and rod ends that frames carry. Equations: docs/theory/attachment.md."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from softwarp.kernels.elements import attachment, grip, quadratic
from softwarp.model.frames import FrameModel
from softwarp.solvers.terms.term import Term
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


@dataclass(frozen=True)
class Carried:
    """Elements of one kind.

    Attributes:
        body: Body of every element.
        corner: Nodes of its four corners.
        kept: What the element keeps for its stiffness: turned gradients, or ten blocks.
        velocity: Velocities that ``corner`` refers to.
        turned: Whether gradients are kept.
        lists: Blocks of A, or carried nodes; and for each the start, entries and weights of what it sums up.
    """

    body: wp.array
    corner: wp.array
    kept: Rows
    velocity: Rows
    turned: bool
    lists: tuple[wp.array, ...]


class Products:
    """K v of elements at the nodes that frames carry.

    Args:
        shard: Worlds; their elements have the stiffness of the last ``forces``.
    """

    def __init__(self, shard: Shard) -> None:
        self.shard, self.k = shard, attachment.kernels(shard.variant)

    def add(self, kind: Carried, factor: wp.array, velocity: Rows, out: Rows) -> None:
        """Add them for one kind of elements.

        Args:
            kind: Elements, and the nodes that are carried.
            factor: Of every body.
            velocity: Of what the elements' corners refer to.
            out: Of nodes.
        """
        s, w = self.shard, self.shard.work
        inputs, kernel = [kind.body, kind.corner, *kind.lists], self.k.stored_damping
        if kind.turned:
            inputs, kernel = [*inputs, w.body_mu.S, w.body_lam.S], self.k.turned_damping
        s.each(kernel, kind.lists[0].size, [*inputs, factor, kind.kept.S, velocity.S], [out.S])

    def add_skin(self, factor: wp.array, velocity: Rows, out: Rows) -> None:
        """The same of membranes, if there are any; their corners are nodes."""
        s, w, skin = self.shard, self.shard.work, self.shard.model.membranes
        if skin is not None:
            inputs = [skin.element_body, skin.tri_node, skin.held_node, skin.held_start, skin.held_entry]
            inputs += [skin.held_weight, factor, w.membrane_stiffness.S, velocity.S]
            s.each(self.k.stored_damping, skin.held_node.size, inputs, [out.S])


class AttachmentTerm(Term):
    """Stiffness and damping of elements whose corners frames carry.

    Args:
        shard: Worlds.
        model: Frames and what they carry.
    """

    def __init__(self, shard: Shard, model: FrameModel) -> None:
        super().__init__(shard)
        self.model = model
        self.k = attachment.kernels(shard.variant)
        self.k_grip = grip.kernels(shard.variant)
        self.k_quadratic = quadratic.kernels(shard.variant)
        self.blocks = [self._kind(kind, lists) for kind, lists in model.carried_blocks.items()]
        self.held = [self._kind(kind, lists) for kind, lists in model.held_nodes.items()]
        self.products = Products(shard)

    def _kind(self, kind: str, lists: tuple[wp.array, ...]) -> Carried:
        m, w, second = self.shard.model, self.shard.work, self.shard.model.quadratic
        turned = kind.endswith("large")
        if second is not None and kind.startswith("quadratic"):
            kept = w.gauss_gradient if turned else w.gauss_stiffness
            return Carried(second.point_body, second.point_tet, kept, w.gauss_corner_v, turned, lists)
        if kind == "segment":
            return Carried(self.model.seg_body, self.model.seg_frame, w.segment_stiffness, w.slot_v, turned, lists)
        kept = w.tet_gradient if turned else w.tet_stiffness
        return Carried(m.tet_body, m.tet_node, kept, w.slot_v, turned, lists)

    def tangent(self, h: float) -> None:
        """Stiffness of carried elements, but for membranes, which add theirs."""
        s, w = self.shard, self.shard.work
        for kind in self.blocks:
            inputs, kernel = [kind.body, *kind.lists], self.k.stored_stiffness
            if kind.turned:
                inputs, kernel = [*inputs, w.body_mu.S, w.body_lam.S], self.k.turned_stiffness
            inputs += [w.body_stiffness.S, kind.kept.S, w.lever.S]
            s.each(kernel, kind.lists[0].size, inputs, [w.a.S])
        self._add_grips()

    def _add_grips(self) -> None:
        """Stiffness of turned quadratic elements whose nodes frames carry; needs their shape gradients."""
        s, m, w, second = self.shard, self.model, self.shard.work, self.shard.model.quadratic
        if second is None or m.grip_count == 0:
            return
        inputs = [m.grip_start, m.grip_corner, m.grip_item, w.gauss_shape.S, w.lever.S]
        s.each(self.k_grip.gather, m.grip_count, inputs, [w.grip.S])
        inputs = [second.point_body, m.gripped_block, m.gripped_start, m.gripped_entry, w.body_mu.S, w.body_lam.S]
        inputs += [w.body_stiffness.S, w.gauss_shape.S, w.grip.S]
        s.each(self.k_grip.stiffness, m.gripped_block.size, inputs, [w.a.S])

    def right_hand_side(self, f_scale: float, inertia: bool, moving: bool) -> None:
        """Beta K v at carried nodes as internal forces; needs the velocities of slots.

        Nodes that no frame carries have theirs from the product with A.
        """
        if not moving and not (self.shard.leaning and inertia):
            return
        s, w, second = self.shard, self.shard.work, self.shard.model.quadratic
        if second is not None and any(kind.velocity is w.gauss_corner_v for kind in self.held):
            s.each(
                self.k_quadratic.point_corners, second.count, [second.element_node, w.slot_v.S], [w.gauss_corner_v.S]
            )
        beta = s.felt["beta"].S
        for kind in self.held:
            self.products.add(kind, beta, kind.velocity, w.node_internal)
        self.products.add_skin(beta, w.slot_v, w.node_internal)
