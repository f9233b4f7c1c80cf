"""Half-solved right-hand sides of contacts, Y = L^-1 P H', and their products with each other and with other rows.

``ContactSides`` holds them contact by contact. Where a GPU has a factor in panels, a world's sides stand together in
memory, ``PanelSides``. A single world on a CPU in float32 holds eight contacts in the lanes of SIMD registers,
``GroupSides``; eight worlds in lanes take all their contacts through strips of the factor, ``StripSides``. Theory:
docs/theory/contact.md.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from softwarp.kernels.algebra.lanes import Variant, variant
from softwarp.kernels.algebra.wide import is_wide
from softwarp.kernels.rows import contact, contact_lanes, contact_panel, contact_strips, contact_wide, looks
from softwarp.model.codes import USUAL_SLOTS
from softwarp.model.structure import IntArray, Symbolic
from softwarp.solvers.collision.contact_list import ContactList
from softwarp.solvers.linear import strips
from softwarp.solvers.linear.cholesky import LinearSolver, PanelSolver
from softwarp.solvers.subspace import nothing_touches
from softwarp.solvers.workspace import rows
from softwarp.solvers.workspace.rows import Rows

PARTS = 8  # threads that share the entries of one contact's rows of W on a GPU
PANEL_PARTS = 16  # the same where a world's sides stand together
FEW_WORLDS, FEW_PARTS = 128, 64  # and of so few worlds, which do not fill a GPU: a thread for nearly every entry


class ContactSides:
    """Sides of the contacts of the worlds, one after the other.

    Args:
        symbolic: Structure of the system.
        index: Its arrays on the device, with ``parent``.
        dof_free: 1 where a scalar is an unknown, else 0; real, shape (dof, 3).
        variant: Scalar type and memory order.
        world_count: Worlds.
        static_rows: Rows besides contacts; their right-hand sides are 1 .. static_rows of ``LinearSolver.y``.
        contacts: Contacts of the step.
        device: Warp device.
        passes: Times that late contacts can join in a step.
        slots: Dofs that a contact can touch.
        touch: Modes at nodes of reduced bodies, from ``subspace.touch_struct``; None without any.

    Attributes:
        pack_first, pack_count: First contact to be worked on, and the one after the last, of the worlds of a pack.
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
        passes: int = 1,
        slots: int = USUAL_SLOTS,
        touch: Any = None,
    ) -> None:
        self.touch = nothing_touches(variant, device) if touch is None else touch
        self.size, self.index, self.dof_free = symbolic.size, index, dof_free
        self.variant, self.device, self.contacts = variant, device, contacts
        self.static_rows, self.capacity = static_rows, contacts.capacity
        self.packs, self.lanes = rows.shape(variant, world_count)
        self.width = self.packs * self.lanes if variant.world_fastest else self.packs
        self.world_count, self.passes, self.slots = world_count, passes, slots
        self.k, self.k_looks = contact.kernels(variant), looks.kernels(variant)
        self.parts = PARTS if variant.world_fastest else 1
        self.pack_first, self.pack_count = self._integer(1), self._integer(1)
        self._allocate(symbolic)

    def _allocate(self, symbolic: Symbolic) -> None:
        capacity = self.capacity
        self.path_limit = longest_path(symbolic.parent, self.slots * self.variant.lanes)
        self.side = rows.allocate(self.variant, self.world_count, max(9 * capacity * self.path_limit, 1), self.device)
        self.path_size = self._integer(capacity)
        self.path, self.place = self._integer(capacity * self.path_limit), self._integer(capacity * self.size)

    def _integer(self, count: int) -> Rows:
        """Integers that the worlds of a pack share: one "lane", so that both views have an entry per pack."""
        shared = variant("scalar") if self.variant.lanes > 1 else self.variant
        return rows.allocate(shared, self.width, max(count, 1), self.device, wp.int32)

    def solve(self, linear: LinearSolver) -> None:
        """Paths and half-solved right-hand sides of contacts, with the factor that ``linear`` holds.

        Those of ``ContactList.first`` and later ones, all of them at first.
        """
        self.span()
        if self.capacity:
            self._solve(linear)

    def span(self) -> None:
        """Which contacts are worked on."""
        c = self.contacts
        inputs = [c.first.real, c.count.real, c.idle.real]
        self._each_world(self.k_looks.pack_count, inputs, [self.pack_first.S, self.pack_count.S])

    def _solve(self, linear: LinearSolver) -> None:
        self._find_paths()
        self._scatter()
        self._substitute(linear)

    def _find_paths(self) -> None:
        """Paths of contacts, and sides that are zero."""
        span = [self.pack_first.S, self.pack_count.S]
        inputs = [self.size, self.path_limit, self.index["parent"], self.dof_free, self.touch, *span]
        inputs.append(self.contacts.dof.real)
        outputs = [self.path_size.S, self.path.S, self.place.S, self.side.S]
        self._each(self.k.find_path, self.capacity, inputs, outputs)

    def _substitute(self, linear: LinearSolver) -> None:
        """Y <- L^-1 Y."""
        i, span = self.index, [self.pack_first.S, self.pack_count.S]
        inputs = [self.size, self.path_limit, i["l_row"], i["col_start"], *span]
        inputs += [self.path_size.S, self.path.S, self.place.S, linear.lower.S, linear.diagonal.S]
        self._each(self.k.substitute, self.capacity, inputs, [self.side.S])

    def _scatter(self) -> None:
        """Y = P H'."""
        c = self.contacts
        inputs = [self.size, self.path_limit, self.dof_free, self.touch, self.pack_first.real, c.count.real]
        inputs += [*self._rows(), self.place.real]
        self._each_real(self.k.scatter_rows, self.capacity, inputs, [self.side.real])

    def delassus(self, y: Rows, scale: float, matrix: Rows) -> None:
        """Rows of W of the contacts that ``solve`` was called for, and their mirror images.

        Args:
            y: Half-solved right-hand sides, those of static rows among them.
            scale: x_scale f_scale.
            matrix: W, row by row.
        """
        count, order = self.static_rows, self.static_rows + 3 * self.capacity
        found = [self.pack_first.S, self.pack_count.S, self.path_size.S, self.path.S]
        self._products([self.size, self.path_limit, count, order, self.parts, *found], scale, matrix)
        if count:
            parts = min(self.parts, 1 << (count - 1).bit_length())  # a thread without a row would only wait
            inputs = [self.size, self.path_limit, count, order, parts, *found, self.side.S, y.S, scale]
            self._each_part(self.k.delassus_rows, parts, inputs, [matrix.S])

    def _products(self, structure: list[Any], scale: float, matrix: Rows) -> None:
        inputs = [*structure, self.place.S, self.side.S, scale]
        self._each_part(self.k.delassus_contacts, self.parts, inputs, [matrix.S])

    def free_gap(self, y: Rows, x_scale: float, gap: Rows) -> None:
        """gap += x_scale Y' y for right-hand side 0 of ``y``."""
        inputs = [self.path_limit, self.static_rows, self.pack_count.S, self.path_size.S, self.path.S]
        inputs += [self.side.S, y.S, x_scale]
        self._each(self.k.free_gap, self.capacity, inputs, [gap.S])

    def add_change(self, change: Rows, f_scale: float, y: Rows) -> None:
        """y += f_scale Y change for right-hand side 0 of ``y``."""
        if self.variant.world_fastest:
            inputs = [self.size, self.path_limit, self.static_rows, self.pack_count.S, self.place.S]
            inputs += [self.side.S, change.S, f_scale]
            self._each(self.k.add_change, self.size, inputs, [y.S])
            return
        inputs = [self.path_limit, self.static_rows, self.pack_count.S, self.path_size.S, self.path.S]
        inputs += [self.side.S, change.S, f_scale]
        self._each_world(self.k.add_change_on_paths, inputs, [y.S])

    def _rows(self) -> list[wp.array]:
        c = self.contacts
        return [c.dof.real, c.weight.real, c.lever.real, c.axes.real]

    def _each(self, kernel: Any, items: int, inputs: list[Any], outputs: list[Any]) -> None:
        dim = self.variant.dim(self.width, items)
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def _each_part(self, kernel: Any, parts: int, inputs: list[Any], outputs: list[Any]) -> None:
        if parts:
            dim = (self.width, self.capacity, parts)
            if self.variant.world_fastest:
                dim = (self.capacity, parts, self.width)
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def _each_world(self, kernel: Any, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=self.width, inputs=inputs, outputs=outputs, device=self.device)

    def _each_real(self, kernel: Any, items: int, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=(self.packs, items, self.lanes), inputs=inputs, outputs=outputs, device=self.device)


class StripSides(ContactSides):
    """Sides of packs of eight worlds on a CPU, which run down the factor strip by strip."""

    def _allocate(self, symbolic: Symbolic) -> None:
        super()._allocate(symbolic)
        self.strip_start = wp.array(strips.starts(symbolic, contact_strips.WIDTH), dtype=wp.int32, device=self.device)

    def _find_paths(self) -> None:
        inputs = [self.size, self.path_limit, self.index["parent"], self.dof_free, self.touch.first]
        inputs += [self.pack_first.S, self.pack_count.S, self.contacts.dof.real]
        outputs = [self.path_size.S, self.path.S, self.place.S, self.side.S]
        self._each(contact_lanes.kernels().find_path, self.capacity, inputs, outputs)

    def _scatter(self) -> None:
        if self.touch.first.size:
            super()._scatter()
            return
        inputs = [self.size, self.path_limit, self.dof_free, self.pack_first.S, self.pack_count.S]
        inputs += [self.contacts.count.real, *self._rows(), self.place.S]
        self._each(contact_lanes.kernels().scatter_rows, self.capacity, inputs, [self.side.real])

    def _substitute(self, linear: LinearSolver) -> None:
        i = self.index
        structure = [self.strip_start.size - 1, self.strip_start, i["l_row"], i["col_start"]]
        inputs = [self.size, self.path_limit, *structure, self.pack_first.S, self.pack_count.S]
        inputs += [self.place.S, linear.lower.S, linear.diagonal.S]
        self._each_world(contact_strips.kernels().substitute, inputs, [self.side.S])

    def delassus(self, y: Rows, scale: float, matrix: Rows) -> None:
        """As for single contacts."""
        count, order = self.static_rows, self.static_rows + 3 * self.capacity
        inputs = [self.size, self.path_limit, count, order, self.pack_first.S, self.pack_count.S]
        inputs += [self.path_size.S, self.path.S, self.place.S, self.side.S, y.S, scale]
        self._each_world(contact_strips.kernels().delassus, inputs, [matrix.S])


class PanelSides(ContactSides):
    """Sides with a factor in panels: those of a world stand together, and neighbouring threads share a world.

    Args:
        panels: The linear solver's panels.
    """

    def __init__(self, *structure: Any, panels: PanelSolver, **options: Any) -> None:
        self.panels = panels
        super().__init__(*structure, **options)

    def _allocate(self, symbolic: Symbolic) -> None:
        capacity, panel = self.capacity, self.panels.plan.panel
        self.k, self.k_panel = (
            contact.kernels(self.variant, together=True),
            contact_panel.kernels(self.variant, wide=self.is_wide),
        )
        self.parts = 1
        if self.variant.world_fastest:
            self.parts = PANEL_PARTS if self.world_count > FEW_WORLDS else FEW_PARTS
        self.path_limit = longest_path(panel[:, 2], self.slots, panel[:, 1])
        self.side = self._whole(9 * capacity * self.path_limit)
        self.path_size = self._whole(capacity, wp.int32)
        self.path, self.place = (self._whole(capacity * n, wp.int32) for n in (self.path_limit, self.size))

    @property
    def is_wide(self) -> bool:
        """Whether contacts of a GPU touch bodies of many modes."""
        return self.variant.world_fastest and self.touch.first.size > 0

    def _whole(self, count: int, dtype: Any = None) -> Rows:
        return rows.allocate_whole(self.variant, self.world_count, max(count, 1), self.device, dtype)

    def _solve(self, linear: LinearSolver) -> None:
        i, panels = self.panels.index, self.panels
        span = [self.pack_first.S, self.pack_count.S]
        team, count = panels.team(contact_panel.THREADS), len(panels.plan.panel)
        structure = [i[name] for name in ("position", "column_panel", "column", "panel")]
        inputs = [self.size, self.path_limit, count, *structure, team, self.dof_free, self.touch, *span]
        inputs.append(self.contacts.dof.S)
        outputs = [self.path_size.S, self.path.S, self.place.S, self.side.S]
        panels.cooperate(self.k_panel.find_path, inputs, outputs, contact_panel.THREADS, self.capacity)
        self._scatter()
        structure = [i[name] for name in ("column", "column_lower", "row_index", "panel")]
        inputs = [self.size, self.path_limit, count, *structure, team, *span, self.place.S, panels.lower]
        groups = -(-self.capacity // self.k_panel.group)
        panels.cooperate(self.k_panel.substitute, inputs, [self.side.S], contact_panel.THREADS, groups)

    def _scatter(self) -> None:
        if not self.is_wide:
            super()._scatter()
            return
        span = [self.pack_first.S, self.pack_count.S]
        inputs = [self.size, self.path_limit, self.dof_free, self.touch, *span, self.contacts.dof.S]
        inputs += [*self._rows()[1:], self.place.S]
        dim = (self.width, self.capacity, contact_panel.SPREAD)
        wp.launch(self.k_panel.spread_rows, dim=dim, inputs=inputs, outputs=[self.side.S], device=self.device)

    def _products(self, structure: list[Any], scale: float, matrix: Rows) -> None:
        """Entries of W between contacts."""
        if not self.is_wide or self.capacity > contact_panel.NEAR:
            super()._products(structure, scale, matrix)
            return
        count, order = self.static_rows, self.static_rows + 3 * self.capacity
        inputs = [self.size, self.path_limit, count, order, self.panels.index["column"]]
        inputs += [self.pack_first.S, self.pack_count.S, self.place.S, self.side.S, scale]
        dim = (self.width, -(-self.capacity // contact_panel.NEAR_GROUP), contact_panel.THREADS)
        kernel, block = self.k_panel.delassus_near, contact_panel.THREADS
        wp.launch(kernel, dim, inputs, [matrix.S], device=self.device, block_dim=block)

    def _each(self, kernel: Any, items: int, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=(self.width, items), inputs=inputs, outputs=outputs, device=self.device)

    def _each_part(self, kernel: Any, parts: int, inputs: list[Any], outputs: list[Any]) -> None:
        if parts:
            dim = (self.width, self.capacity, parts)
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)


class GroupSides(ContactSides):
    """Sides of single worlds on a CPU in float32: groups of eight contacts, near each other in the elimination tree.

    Late contacts begin a new group in every pass.
    """

    def _allocate(self, symbolic: Symbolic) -> None:
        self.k_group = contact_wide.kernels()
        spare = (contact_wide.GROUP - 1) * (1 + min(self.passes, self.capacity))  # seats that stay empty
        self.groups = -(-(self.capacity + spare) // contact_wide.GROUP)
        seats = contact_wide.GROUP * self.groups
        self.path_limit = longest_path(symbolic.parent, self.slots * contact_wide.GROUP)
        entries = self.groups * self.path_limit
        self.side = rows.allocate(self.variant, self.world_count, contact_wide.BLOCK * entries, self.device)
        self.group_first, self.group_count, self.seat = self._integer(1), self._integer(1), self._integer(self.capacity)
        self.member, self.lowest, self.path_size = (
            self._integer(seats),
            self._integer(seats),
            self._integer(self.groups),
        )
        self.path, self.place = self._integer(entries), self._integer(self.groups * self.size)
        self.common = self._integer(2 * self.path_limit)

    def _solve(self, linear: LinearSolver) -> None:
        c, i, k = self.contacts, self.index, self.k_group
        inputs = [self.size, self.dof_free, self.touch, self.pack_first.S, self.pack_count.S, c.dof.S]
        outputs = [self.group_first.S, self.group_count.S, self.seat.S, self.member.S, self.lowest.S]
        self._each_world(k.fill_groups, inputs, outputs)
        span = [self.group_first.S, self.group_count.S]
        inputs = [self.size, self.path_limit, i["parent"], self.dof_free, self.touch, *span, self.member.S]
        inputs.append(c.dof.S)
        inputs += [c.weight.real, c.lever.real, c.axes.real]
        outputs = [self.path_size.S, self.path.S, self.place.S, self.side.S]
        self._each(k.find_path, self.groups, inputs, outputs)
        inputs = [self.size, self.path_limit, i["l_row"], i["col_start"], *span]
        inputs += [self.path_size.S, self.path.S, self.place.S, linear.lower.S, linear.diagonal.S]
        self._each(k.substitute, self.groups, inputs, [self.side.S])

    def delassus(self, y: Rows, scale: float, matrix: Rows) -> None:
        """As for single contacts."""
        count, order = self.static_rows, self.static_rows + 3 * self.capacity
        structure = [self.size, self.path_limit, count, order, self.group_first.S, self.group_count.S, self.member.S]
        structure += [self.path_size.S, self.path.S]
        inputs = [*structure, self.place.S, self.side.S, scale]
        outputs = [self.common.S, matrix.S]
        self._each_world(self.k_group.delassus_contacts, inputs, outputs)
        if count:
            self._each(self.k_group.delassus_rows, self.groups, [*structure, self.side.S, y.S, scale], [matrix.S])

    def free_gap(self, y: Rows, x_scale: float, gap: Rows) -> None:
        """As for single contacts."""
        inputs = [self.path_limit, self.static_rows, self.group_count.S, self.member.S]
        inputs += [self.path_size.S, self.path.S, self.side.S, y.S, x_scale]
        self._each(self.k_group.free_gap, self.groups, inputs, [gap.S])

    def add_change(self, change: Rows, f_scale: float, y: Rows) -> None:
        """As for single contacts."""
        inputs = [self.path_limit, self.static_rows, self.group_count.S, self.member.S]
        inputs += [self.path_size.S, self.path.S, self.side.S, change.S, f_scale]
        self._each_world(self.k_group.add_change, inputs, [y.S])


def sides_of(
    symbolic: Symbolic,
    index: dict[str, wp.array],
    dof_free: wp.array,
    variant: Variant,
    world_count: int,
    static_rows: int,
    contacts: ContactList,
    device: Any,
    panels: PanelSolver | None,
    passes: int,
    slots: int,
    touch: Any,
) -> ContactSides:
    """Sides for a variant; arguments are those of ``ContactSides``."""
    structure = (symbolic, index, dof_free, variant, world_count, static_rows, contacts, device)
    if panels is not None:
        return PanelSides(*structure, panels=panels, passes=passes, slots=slots, touch=touch)
    kind = StripSides if variant.lanes > 1 else GroupSides if is_wide(variant) else ContactSides
    return kind(*structure, passes=passes, slots=slots, touch=touch)


def longest_path(parent: IntArray, dofs: int, width: IntArray | None = None) -> int:
    """Most rows that some dofs and their ancestors can have together: the longest branches of the tree, added up.

    Args:
        parent: Node above each node of the tree, or -1.
        dofs: Nodes to start from, at most.
        width: Rows of each node; one if not given.
    """
    rows = np.ones(parent.size, dtype=np.int64) if width is None else width.astype(np.int64)
    height = rows.copy()  # rows from a node down to its deepest descendant
    deepest = np.full(parent.size, -1, dtype=np.int64)
    for node, above in enumerate(parent):  # children come before their parents
        if above >= 0 and height[node] + rows[above] > height[above]:
            height[above], deepest[above] = height[node] + rows[above], node
    is_continued = np.zeros(parent.size, dtype=bool)
    is_continued[deepest[deepest >= 0]] = True
    branches = np.sort(height[~is_continued])[::-1]
    return int(branches[:dofs].sum())
