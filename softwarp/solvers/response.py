"""Response of the worlds to multipliers: Delassus matrix of static rows and contacts, laws, and their effect.

Theory: docs/theory/contact.md (rows of contacts), docs/theory/delassus.md (multiplier problem, elimination of rows
without bounds), docs/theory/coulomb.md (Gauss-Seidel with friction).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.rows import (
    anderson,
    contact,
    contact_force,
    contact_lanes,
    coulomb,
    coulomb_tiers,
    coulomb_warp,
    delassus,
    warp_system,
)
from softwarp.model.codes import FAR, USUAL_SLOTS
from softwarp.model.structure import IntArray, Symbolic
from softwarp.solvers.collision.contact_list import ContactList
from softwarp.solvers.linear.cholesky import LinearSolver, PanelSolver
from softwarp.solvers.sides import sides_of
from softwarp.solvers.subspace import Subspace
from softwarp.solvers.workspace import rows
from softwarp.solvers.workspace.branches import Branches
from softwarp.solvers.workspace.rows import Rows

FEW_DOFS = 128  # of a world, up to which each looks through all contacts for those that touch it
FEW_TOUCHES = 512  # likewise where they are mostly nodes of reduced bodies, which a thread for all would sum as well


@dataclass(frozen=True)
class StaticLaws:
    """What of the laws of static rows is not an argument of ``ContactResponse.solve``.

    Attributes:
        compliance: Compliance of the rows [m/N]; (static_rows).
        floor: Least gap [m] that a row may end with, whatever its law says; (static_rows).
        ceiling: Largest one.
        residual: Largest correction [m] of the last sweep; (1).
    """

    compliance: Rows
    floor: Rows
    ceiling: Rows
    residual: Rows


class ContactResponse:
    """Multipliers of static rows and contacts for a factorised system.

    A step calls, in this order::

        response.sides(linear)                  # after linear.factor: Y_c = L^-1 P H_c'
        response.add_forces(y, f_scale)         # y += f H' multiplier of the contacts, as for static rows
        linear.forward(1 + static_rows)         # y = L^-1 b and the static sides
        response.delassus(y, f_scale * x_scale) # W, with unbounded rows eliminated
        ...                                     # static gaps into response.gap, rows 0 .. static_rows - 1
        response.gaps(y, u=u, v=dof_v, v0=v0, x_scale=x_scale, ...)
        response.solve(lower, upper, multiplier, sweeps=..., tolerance=...)
        response.add_change(y, f_scale)         # y += f Y change; then linear.backward()

    A pass of iterative refinement repeats ``add_forces`` on its residual, then everything from the gaps on. Rows of W,
    ``gap`` and ``change`` are the static rows, then three rows (normal, tangents) for each contact: ``order`` in all.

    Static row i ends with gap_i + compliance_i multiplier_i = 0, or at a bound with the sign that it allows; beyond
    its bounds it takes the multiplier that keeps the gap from leaving floor_i .. ceiling_i. Bounds
    of rows in ``unbounded`` are not looked at; these rows are eliminated exactly, and those that repeat others keep the
    multipliers they have. Contacts obey Signorini's law with compliance and Coulomb's law.

    Args:
        symbolic: Structure of the system.
        index: Its arrays on the device, with ``parent``.
        dof_free: 1 where a scalar is an unknown, else 0; real, shape (dof, 3).
        variant: Scalar type and memory order.
        world_count: Worlds.
        static_rows: Rows besides contacts; their right-hand sides are 1 .. static_rows of ``LinearSolver.y``.
        contacts: Contacts of the step; ``capacity`` may be 0.
        device: Warp device.
        unbounded: Static rows to eliminate, such as all rows of joints without motors and limits.
        panels: The linear solver's panels, where it has any.
        passes: Times that late contacts can join in a step.
        slots: Dofs that a contact can touch.
        touch: Modes at nodes of reduced bodies, from ``subspace.touch_struct``.
        subspace: Reduced bodies, where contacts can touch any.
        laws: Rows of the caller; without them the response has its own, with no compliance and unlimited gaps.

    Attributes:
        order: static_rows + 3 capacity.
        matrix: W [m/N], entry (i, j) at ``order i + j``; (order^2).
        gap: Free gaps [m]; (order). ``solve`` overwrites them.
        change: Change of the multipliers [N] in the last ``solve``; (order).
        compliance, floor, ceiling, residual: Those of ``laws``.
        skipped: 1 in worlds that a GPU does not solve for; none, unless somebody puts other rows here; (1).
    """

    def __init__(
        self,
        symbolic: Symbolic,
        index: dict[str, wp.array],
        dof_free: wp.array,
        variant: Variant,
        world_count: int,
        static_rows: int,
        contacts: ContactList,
        device: Any,
        *,
        unbounded: Sequence[int] | IntArray = (),
        panels: PanelSolver | None = None,
        laws: StaticLaws | None = None,
        passes: int = 1,
        slots: int = USUAL_SLOTS,
        touch: Any = None,
        subspace: Subspace | None = None,
    ) -> None:
        self.subspace = subspace
        self.size, self.index, self.dof_free = symbolic.size, index, dof_free
        self.variant, self.device, self.contacts = variant, device, contacts
        self.static_rows, self.capacity = static_rows, contacts.capacity
        self.order = static_rows + 3 * self.capacity
        self.packs, self.lanes = rows.shape(variant, world_count)
        self.width = self.packs * self.lanes if variant.world_fastest else self.packs
        self.k, self.k_force = contact.kernels(variant), contact_force.kernels(variant)
        self.k_row = delassus.kernels(variant)
        self.k_law = coulomb.kernels(variant)
        structure = (symbolic, index, dof_free, variant, world_count, static_rows, contacts, device)
        self.contact_sides = sides_of(*structure, panels, passes, slots, touch)
        self.pack_first, self.pack_count = self.contact_sides.pack_first, self.contact_sides.pack_count
        self._index_rows(np.unique(np.asarray(unbounded, dtype=np.int32)))
        self._allocate(world_count, laws)

    def _index_rows(self, unbounded: IntArray) -> None:
        count = self.static_rows
        if unbounded.size and (unbounded[0] < 0 or unbounded[-1] >= count):
            raise ValueError(f"unbounded rows must lie in 0 .. {count - 1}, got {unbounded[0]} .. {unbounded[-1]}")
        bounded = np.setdiff1d(np.arange(count, dtype=np.int32), unbounded)
        pairs = np.stack(np.tril_indices(count), axis=1).astype(np.int32)
        self.unbounded = wp.array(unbounded, dtype=wp.int32, device=self.device)
        self.bounded = wp.array(bounded, dtype=wp.int32, device=self.device)
        self.pairs = wp.array(pairs, dtype=wp.int32, device=self.device)
        self.free_items = bounded.size + 3 * self.capacity

    def _allocate(self, world_count: int, laws: StaticLaws | None) -> None:
        def real(count: int) -> Rows:
            return rows.allocate(self.variant, world_count, max(count, 1), self.device)

        def whole(count: int) -> Rows:
            return rows.allocate_whole(self.variant, world_count, max(count, 1), self.device)

        capacity = self.capacity
        self.matrix, self.gap, self.change = whole(self.order**2), whole(self.order), whole(self.order)
        self.value = whole(self.order if self.variant.world_fastest else 1)
        vectors = anderson.VECTORS if self.variant.world_fastest else anderson.HISTORY
        self.history, self.gram = whole(vectors * self.order), whole(anderson.GRAM)
        is_cuda = self.variant.world_fastest
        self.system = whole(warp_system.entries(self.order) if is_cuda else 1)
        if laws is None:
            laws = StaticLaws(*(real(count) for count in (*[self.static_rows] * 3, 1)))
            laws.floor.fill(-FAR)
            laws.ceiling.fill(FAR)
        self.compliance, self.residual = laws.compliance, laws.residual
        self.floor, self.ceiling = laws.floor, laws.ceiling
        self.inverse, self.curve = real(self.unbounded.size), real(capacity)
        self.everyone = rows.allocate(self.variant, world_count, 1, self.device, wp.int32)
        self.skipped = self.everyone
        self.branches = Branches(self.device) if wp.get_device(self.device).is_cuda else None

    # Stages

    def sides(self, linear: LinearSolver) -> None:
        """Half-solved right-hand sides of contacts, with the factor that ``linear`` holds.

        Those of ``ContactList.first`` and later ones, all of them at first.
        """
        self.contact_sides.solve(linear)

    def delassus(self, y: Rows, scale: float, *, late: bool = False, whole: bool = False) -> None:
        """W of all rows from ``sides`` and the static sides in ``y``; unbounded rows are eliminated from it.

        Args:
            y: Half-solved right-hand sides, ``LinearSolver.y`` after ``forward``.
            scale: x_scale f_scale.
            late: Only add the rows of contacts that came after those in W, for which ``sides`` was called again.
            whole: Eliminate none.
        """
        order = self.order
        if not late:
            inputs = [self.size, order, self.pairs, y.S, scale]
            self._each(self.k_row.delassus, len(self.pairs), inputs, [self.matrix.S])
        if self.capacity:
            self.contact_sides.delassus(y, scale, self.matrix)
        if self.unbounded.size and not whole:
            k = self.k_row
            if not late:
                inputs = [self.unbounded, order, self.compliance.S]
                self._each_world(k.factor_unbounded, inputs, [self.matrix.S, self.inverse.S])
            bounded, unbounded, rows, order, pack_count, inverse = self._elimination()
            inputs = [bounded, unbounded, rows, order, late, self.pack_first.S, pack_count, inverse]
            for kernel in (k.half_column, k.reduce_row):
                self._each(kernel, self.free_items, inputs, [self.matrix.S])

    def gaps(
        self,
        y: Rows,
        *,
        u: Rows,
        v: Rows,
        v0: Rows,
        x_scale: float,
        recovery: float,
        bounce_speed: float,
        share: float = 1.0,
        end: Rows | None = None,
    ) -> None:
        """Free gaps of the contacts, into their rows of ``gap``.

        The normal gap [m] is the distance of detection plus x_scale times the normal velocity without new multipliers,
        H (v + u) + Y' y; the tangential gaps are the slip in the step. Velocities include prescribed ones, which ``y``
        must not hold as well.

        Args:
            y: Half-solved right-hand side 0.
            u: Unknowns found so far in this solve; 3 entries per dof, as for the next two.
            v: Velocities that ``u`` is added to: those of the trial state relative to the state of detection.
            v0: Velocities at the start of the step, for restitution.
            x_scale: Factor from unknowns to positions: the step [s].
            recovery: Fastest separation [m/s] of what penetrates.
            bounce_speed: Approach [m/s] up to which a contact does not bounce.
            share: Part of a penetration that the step takes back.
            end: Distances less contact distances that were measured after a step with ``v + u``, where there are any.
        """
        if not self.capacity:
            return
        c = self.contacts
        inputs = [self.static_rows, self.pack_count.real, c.listed.real, c.count.real, *self._rows()]
        inputs += [c.gap.real, c.restitution.real]
        inputs.append(c.compliance.real)
        inputs += [v0.real, v.real, u.real, c.point.real, (c.gap if end is None else end).real, end is not None]
        inputs += [x_scale, share, recovery, bounce_speed]
        if self.variant.lanes > 1:
            dim = (self.packs, self.capacity)
            wp.launch(contact_lanes.kernels().known_gap, dim, inputs, [self.gap.real], device=self.device)
        else:
            self._each_real(self.k.known_gap, self.capacity, inputs, [self.gap.real])
        self.contact_sides.free_gap(y, x_scale, self.gap)

    def solve(
        self, lower: Rows, upper: Rows, multiplier: Rows, *, sweeps: int, tolerance: float, extent: float = FAR
    ) -> None:
        """Multipliers of all rows from ``gap``, starting from those in ``multiplier`` and in the contacts.

        Args:
            lower: Bounds of the static rows.
            upper: Likewise.
            multiplier: Multipliers of the static rows; those of contacts are ``contacts.multiplier``.
            sweeps: Largest number of sweeps.
            tolerance: A world is done when a sweep corrects no gap by more [m].
            extent: Size of the scene [m], beyond which Newton's method does not look for forces.
        """
        c, k = self.contacts, self.k_row
        self.eliminate_gaps(multiplier)
        structure, limits = [self.bounded, self.static_rows, self.order], [sweeps, tolerance]
        inputs = [self.pack_count.S, self.matrix.S, self.gap.S, self.compliance.S, lower.S, upper.S]
        inputs += [self.floor.S, self.ceiling.S, c.mu.S, c.compliance.S]
        outputs = [multiplier.S, c.multiplier.S, self.change.S]
        if self.variant.world_fastest:
            outputs += [self.history.S, self.system.S, self.residual.S]
            limits += [extent, warp_system.stride_of(self.order)]
            self._solve_by_warps(structure, [*limits, self.skipped.S, *inputs], outputs)
        else:
            outputs += [self.curve.S, self.history.S, self.gram.S, self.residual.S]
            self._each_world(self.k_law.gauss_seidel, [*structure, *limits, extent, *inputs], outputs)
        if self.unbounded.size:
            inputs = [*self._elimination(), self.matrix.S, self.gap.S]
            self._each_world(k.unbounded_change, inputs, [self.change.S, multiplier.S])

    def eliminate_gaps(self, multiplier: Rows) -> None:
        """What the other rows' gaps become once unbounded rows hold; ``solve`` begins with it."""
        if self.unbounded.size:
            inputs = [*self._elimination(), self.matrix.S, self.compliance.S, multiplier.S]
            self._each_world(self.k_row.reduce_gap, inputs, [self.gap.S])

    def add_change(self, y: Rows, f_scale: float) -> None:
        """y += f Y change for right-hand side 0 of ``y``, static rows and contacts alike."""
        if self.static_rows:
            inputs = [self.size, self.static_rows, self.change.S, f_scale]
            self._each(self.k_row.add_change, self.variant.parts(3 * self.size), inputs, [y.S])
        if self.capacity:
            self.contact_sides.add_change(self.change, f_scale, y)

    def add_forces(self, target: Rows, f_scale: float) -> None:
        """target += f H' multiplier of the contacts on unknown scalars; 3 entries per dof."""
        if not self.capacity:
            return
        modes = self.subspace
        if modes is None or modes.forces is None:
            self._push(self.size, self.size <= FEW_DOFS, f_scale, target)
            return
        self.push(f_scale, modes.forces)
        modes.project(modes.forces, target)

    def push(self, f_scale: float, target: Rows) -> None:
        """Forces of contacts, times f, on dofs and behind them on nodes of reduced bodies, in the world's axes."""
        assert self.subspace is not None
        target.zero()
        dofs = self.size + self.subspace.touches
        self._push(dofs, dofs <= FEW_TOUCHES, f_scale, target)

    def _push(self, dofs: int, are_few: bool, f_scale: float, target: Rows) -> None:
        """The same on dofs, and on nodes that touch something behind them."""
        c = self.contacts
        inputs = [self.dof_free, c.count.real, *self._rows(), c.multiplier.real, f_scale]
        if self.variant.world_fastest and are_few:
            inputs.insert(2, c.idle.real)
            if dofs > FEW_DOFS:
                threads = contact_force.SHARING
                dim, given = (self.packs, self.lanes, threads), [threads, *inputs]
                wp.launch(self.k_force.share_force, dim, given, [target.real], device=self.device)
            else:
                self._each_real(self.k_force.gather_force, dofs, inputs, [target.real])
        elif self.variant.lanes > 1:
            self._each_world(contact_lanes.kernels().add_force, inputs, [target.real])
        else:
            self._each_real(self.k_force.add_force, None, inputs, [target.real])

    # Launches

    def _solve_by_warps(self, structure: list[Any], inputs: list[Any], outputs: list[Any]) -> None:
        width = coulomb_tiers.WIDTH
        tiers = coulomb_tiers.tiers(self.variant, self.static_rows, self.capacity)
        aside = len(tiers) if self.branches is not None else 1  # each waits for its slowest world
        with nullcontext([None]) if self.branches is None else self.branches.side_by_side(aside) as streams:
            for number, tier in enumerate(tiers):
                own = -(-self.static_rows // width), tier.own_contacts, tier.near_rows, tier.near_unknowns
                kernel = coulomb_warp.kernels(self.variant, *own).gauss_seidel
                is_alone = max(tier.near_rows, tier.near_unknowns) > 0 or self.width <= coulomb_warp.FEW_WORLDS
                block, stream = width if is_alone else coulomb_warp.BLOCK, streams[number % aside]
                given, dim = [*structure, tier.above, tier.most, *inputs], (self.width, width)
                wp.launch(kernel, dim, given, outputs, device=self.device, stream=stream, block_dim=block)

    def _rows(self) -> list[wp.array]:
        c = self.contacts
        return [c.dof.real, c.weight.real, c.lever.real, c.axes.real]

    def _elimination(self) -> list[Any]:
        return [self.bounded, self.unbounded, self.static_rows, self.order, self.pack_count.S, self.inverse.S]

    def _each(self, kernel: Any, items: int, inputs: list[Any], outputs: list[Any]) -> None:
        if items:
            dim = self.variant.dim(self.width, items)
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def _each_world(self, kernel: Any, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=self.width, inputs=inputs, outputs=outputs, device=self.device)

    def _each_real(self, kernel: Any, items: int | None, inputs: list[Any], outputs: list[Any]) -> None:
        dim = (self.packs, self.lanes) if items is None else (self.packs, items, self.lanes)
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)
