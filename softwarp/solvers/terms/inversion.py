"""What a step tells of compressed and inverted elements; no forces. Equations: docs/theory/corotational.md."""

from __future__ import annotations

import warp as wp

from softwarp.kernels.elements import inversion, quadratic
from softwarp.model import memory
from softwarp.solvers.linear.dashpots import Dashpots
from softwarp.solvers.terms.term import Term
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


class InversionTerm(Term):
    """Volume ratios where a step has led to: of linear tets, Gauss points of quadratic ones, pieces of hexahedra.

    Attributes:
        held: Not 0 in worlds where a step was held back or dampened, until somebody clears it; None where none ever is.
        dashpots: What dampens, in float32.
    """

    follows_paths = has_exact_tangent = True

    def __init__(self, shard: Shard) -> None:
        super().__init__(shard)
        self.k = inversion.kernels(shard.variant)
        self.k_quadratic = quadratic.kernels(shard.variant)
        m = shard.model
        is_alone = bool(m.tet_count) and m.hexes is None and not m.frame_count and m.reduction is None
        is_guarded = bool((m.body_guard.numpy() > 0.0).any())
        self.restrains = is_alone and is_guarded and shard.options.newton_iterations == 1 and not shard.exact
        self.parts = inversion.PARTS if shard.variant.world_fastest else 1
        self.stride = shard.rows(self.parts if self.restrains else 1)
        flags = (shard.packs, 1, shard.lanes)
        with memory.lasting():  # whoever reads it does so after all shards
            self.held = memory.zeros(flags, wp.int32, shard.device) if self.restrains else None
        self.dashpots: Dashpots | None = None
        if self.held is not None and shard.variant.real == wp.float32:
            self.dashpots = Dashpots(shard, self.held)

    def load(self) -> None:
        """Nothing is compressed yet."""
        self.shard.work.compression.zero()
        self.shard.work.inverted.zero()

    def load_tangent(self, h: float) -> None:
        """Dashpots in worlds with flat or inverted elements, whose stiffness would bury all else in rounding."""
        if self.dashpots is not None and h > 0.0:
            self.dashpots.dampen(self.shard.work.a)

    def restrain(self, h: float, part: float) -> None:
        """Worlds with inverted elements go a share of their way where elements would be torn."""
        if not self.restrains:
            return
        s, m, u = self.shard, self.shard.model, self.shard.work.u
        inputs = [s.lanes, h, m.tet_node, m.tet_size, m.node_dof, s.state.compression, u.real]
        s.each_real(self.k.strides, self.parts, inputs, [self.stride.real])
        inputs = [self.parts, m.dof_free, self.stride.real]
        s.each_real(self.k.hold_back, s.variant.parts(m.dof_count), inputs, [u.real, self.held])

    def check(self, h: float) -> None:
        """Largest compression of each world, and how many of its elements are inverted."""
        s, m, w = self.shard, self.shard.model, self.shard.work
        if m.tet_count:
            self._look(m.tet_count, m.tet_node, m.tet_size, w.x)
        if m.quadratic is not None:
            q = m.quadratic
            s.each(self.k_quadratic.point_corners, q.count, [q.element_node, w.x.S], [w.gauss_corner.S])
            self._look(quadratic.POINTS * q.count, q.point_tet, q.point_size, w.gauss_corner)
        if m.hexes is not None:
            self._look(m.hexes.piece_size.size, m.hexes.piece_node, m.hexes.piece_size, w.x)

    def _look(self, count: int, tet_node: wp.array, tet_size: wp.array, x: Rows) -> None:
        s, w = self.shard, self.shard.work
        on_gpu = s.variant.world_fastest
        parts = -(-count // inversion.CHUNK) if on_gpu else 1
        s.each(self.k.compression, parts, [tet_node, tet_size, x.S], [w.compression.S, w.inverted.S])
        if not on_gpu:
            s.each_real(self.k.count, None, [tet_node, x.real, w.compression.real], [w.inverted.real])
