"""Contacts, limits and whatever else obeys a law beside the actuators of inverse control.

Equations: docs/theory/laws.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.inverse import labels, laws
from softwarp.solvers.workspace import rows

if TYPE_CHECKING:
    from softwarp.solvers.inverse.system import InverseSystem

PIVOTS = 8  # changes of labels that are tried in one solve
SWEEPS = 60  # of Gauss-Seidel, for the labels to start from


class Laws:
    """Labels of the rows with a law, and the inequalities that follow.

    Args:
        owner: Inverse problem; its response exists.
        passive: Static rows that are neither actuators nor eliminated.

    Attributes:
        count: Inequalities, rows of the quadratic program after those of the actuators.
    """

    def __init__(self, owner: InverseSystem, passive: list[int]) -> None:
        self.owner, self.rows = owner, len(passive)
        system, n = owner.system, owner.actuators.count
        self.contacts = owner.response.contacts
        capacity = self.contacts.capacity
        self.k = laws.kernels(system.variant)
        self.k_labels = labels.kernels(system.variant)
        self.count = self.rows + labels.CONTACT_LAWS * capacity
        items = self.rows + 3 * capacity
        self.width = items + n + 1
        self.passive_row = wp.array(np.array(passive, dtype=np.int32), dtype=wp.int32, device=system.device)
        wide = variant("cuda" if system.variant.world_fastest else "scalar", "float64")

        def allocate(count: int, dtype: Any = wp.float64) -> wp.array:
            return rows.allocate(wide, system.world_count, max(count, 1), system.device, dtype).S

        self.start, self.value = allocate(items), allocate(items)
        self.label, self.direction = allocate(self.rows + capacity, wp.int32), allocate(2 * capacity)
        self.free, self.free_count = allocate(items, wp.int32), allocate(1, wp.int32)
        self.matrix, self.gradient = allocate(items * self.width), allocate(items * (n + 1))
        self.best, self.best_multiplier = allocate(1), allocate(self.count)
        self.best_label, self.best_direction = allocate(self.rows + capacity, wp.int32), allocate(2 * capacity)
        self.best_gradient, self.best_x = allocate(items * (n + 1)), allocate(n)
        self.tried = allocate(self.count, wp.int32)

    def begin(self) -> None:
        """Labels under the present efforts."""
        o, s, c = self.owner, self.owner.system, self.contacts
        inputs = [self.rows, o.first_contact, o.response.order, SWEEPS, self.passive_row, c.count.real]
        inputs += [o.response.matrix.real, o.response.gap.real, s.multiplier.real, c.multiplier.real]
        inputs += [s.lower_bound.real, s.upper_bound.real, s.compliance.real, c.compliance.real, c.mu.real]
        self._each(self.k_labels.present_labels, inputs, [self.start, self.value, self.label, self.direction])

    def respond(self) -> None:
        """Blocks of the quadratic program for the present labels."""
        o, s, c, r = self.owner, self.owner.system, self.contacts, self.owner.response
        n, b = o.actuators.count, o.bound.value
        inputs = [self.rows, o.first_contact, self.passive_row, c.count.real]
        inputs += [s.lower_bound.real, s.upper_bound.real, self.label]
        self._each(self.k.free_rows, inputs, [self.value, self.free, self.free_count])
        lists = [self.passive_row, o.actuator_row, c.count.real, r.matrix.real, r.gap.real]
        labels = [self.start, self.value, self.label, self.direction, o.effort, self.free, self.free_count]
        inputs = [n, self.rows, o.first_contact, r.order, self.width, *lists]
        inputs += [s.compliance.real, c.compliance.real, c.mu.real, *labels]
        self._each(self.k.eliminate, inputs, [self.matrix])
        inputs = [n, self.rows, o.effector_rows, o.first_effector, o.first_contact, r.order, self.width, *lists]
        inputs += [s.target.real, c.mu.real, *labels, self.matrix, b["way_low"], b["way_high"]]
        outputs = [o.effect, o.compliance, o.way, o.gap, o.low, o.high, self.gradient]
        self._each(self.k.respond, inputs, outputs)
        inputs = [n, self.rows, 2 * n, self.count, self.width, self.passive_row, c.count.real]
        inputs += [s.lower_bound.real, s.upper_bound.real, c.mu.real]
        inputs += [self.label, self.free, self.free_count, self.matrix, self.gradient]
        self._each(self.k.inequalities, inputs, [o.normal, o.low, o.high])

    def pivot(self, *, first: bool, last: bool) -> None:
        """Keep or take back the last change of labels, and try another one."""
        o, c = self.owner, self.contacts
        n = o.actuators.count
        inputs = [n, self.rows, 2 * n, self.count, o.effector_rows, first, last, o.row_weight, c.count.real]
        inputs += [o.outcome, o.multiplier, o.effect, o.gap, self.gradient, o.x]
        outputs = [self.label, self.direction, self.best, self.best_label, self.best_direction]
        outputs += [self.best_multiplier, self.best_gradient, self.best_x, self.tried]
        self._each(self.k_labels.pivot, inputs, outputs)

    def _each(self, kernel: Any, inputs: list[Any], outputs: list[Any]) -> None:
        s = self.owner.system
        wp.launch(kernel, dim=s.world_count, inputs=inputs, outputs=outputs, device=s.device)
