"""Contacts, limits and whatever else obeys a law beside the actuators of inverse control.

Equations: docs/theory/laws.md.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from softwarp.kernels.inverse import labels, laws
from softwarp.model.codes import FAR
from softwarp.solvers.inverse.problem import InverseProblem

PIVOTS = 8  # changes of labels that are tried in one solve
SWEEPS = 60  # of Gauss-Seidel, for the labels to start from


class Laws:
    """Labels of the rows with a law, and the inequalities that follow.

    Args:
        problem: Inverse problem with passive rows or contacts.
    """

    def __init__(self, problem: InverseProblem) -> None:
        self.problem, self.rows = problem, len(problem.passive)
        system, n, allocate = problem.system, problem.actuators.count, problem.doubles
        self.contacts = problem.response.contacts
        capacity = self.contacts.capacity
        self.k = laws.kernels(system.variant)
        self.k_labels = labels.kernels(system.variant)
        items = self.rows + 3 * capacity
        self.width = items + n + 1
        passive = np.array(problem.passive, dtype=np.int32)
        self.passive_row = wp.array(passive, dtype=wp.int32, device=system.model.device)
        self.start, self.value = allocate(items), allocate(items)
        self.label, self.direction = allocate(self.rows + capacity, wp.int32), allocate(2 * capacity)
        self.free, self.free_count = allocate(items, wp.int32), allocate(1, wp.int32)
        self.matrix, self.gradient = allocate(items * self.width), allocate(items * (n + 1))
        self.best, self.best_multiplier = allocate(1), allocate(problem.laws)
        self.best_label, self.best_direction = allocate(self.rows + capacity, wp.int32), allocate(2 * capacity)
        self.best_gradient, self.best_x = allocate(items * (n + 1)), allocate(n)
        self.tried = allocate(problem.laws, wp.int32)

    def begin(self) -> None:
        """Labels under the present efforts."""
        p, w, c = self.problem, self.problem.system.work, self.contacts
        inputs = [self.rows, p.first_contact, p.response.order, SWEEPS, self.passive_row, c.count.real]
        inputs += [p.response.matrix.real, p.response.gap.real, w.multiplier.real, c.multiplier.real]
        inputs += [w.lower_bound.real, w.upper_bound.real, w.compliance.real, c.compliance.real, c.mu.real]
        p.each_world(self.k_labels.present_labels, inputs, [self.start, self.value, self.label, self.direction])

    def respond(self) -> None:
        """Blocks of the quadratic program for the present labels."""
        p, w, c, r = self.problem, self.problem.system.work, self.contacts, self.problem.response
        n, b = p.actuators.count, p.bound.value
        inputs = [self.rows, p.first_contact, self.passive_row, c.count.real]
        inputs += [w.lower_bound.real, w.upper_bound.real, self.label]
        p.each_world(self.k.free_rows, inputs, [self.value, self.free, self.free_count])
        lists = [self.passive_row, p.actuator_row, c.count.real, r.matrix.real, r.gap.real]
        labels = [self.start, self.value, self.label, self.direction, p.effort, self.free, self.free_count]
        inputs = [n, self.rows, p.first_contact, r.order, self.width, *lists]
        inputs += [w.compliance.real, c.compliance.real, c.mu.real, *labels]
        p.each_world(self.k.eliminate, inputs, [self.matrix])
        inputs = [n, self.rows, p.effector_rows, p.first_effector, p.first_contact, r.order, self.width, *lists]
        inputs += [w.target.real, c.mu.real, *labels, self.matrix, b["way_low"], b["way_high"]]
        outputs = [p.effect, p.compliance, p.way, p.gap, p.low, p.high, self.gradient]
        p.each_world(self.k.respond, inputs, outputs)
        inputs = [n, self.rows, 2 * n, p.laws, self.width, self.passive_row, c.count.real]
        inputs += [w.lower_bound.real, w.upper_bound.real, c.mu.real]
        inputs += [self.label, self.free, self.free_count, self.matrix, self.gradient]
        p.each_world(self.k.inequalities, inputs, [p.normal, p.low, p.high])
        if (grip := p.options.grip) is not None:
            inputs = [
                n,
                self.rows,
                self.width,
                grip.pair,
                grip.least,
                min(grip.most, FAR),
                2 * n + p.laws,
                c.count.real,
                c.pair.real,
            ]
            inputs += [self.free, self.free_count, self.matrix]
            p.each_world(self.k.grip, inputs, [p.normal, p.low, p.high])

    def pivot(self, *, first: bool, last: bool) -> None:
        """Keep or take back the last change of labels, and try another one."""
        p, c = self.problem, self.contacts
        n = p.actuators.count
        inputs = [n, self.rows, 2 * n, p.laws, p.effector_rows, first, last, p.row_weight, c.count.real]
        inputs += [p.outcome, p.multiplier, p.effect, p.gap, self.gradient, p.x]
        outputs = [self.label, self.direction, self.best, self.best_label, self.best_direction]
        outputs += [self.best_multiplier, self.best_gradient, self.best_x, self.tried]
        p.each_world(self.k_labels.pivot, inputs, outputs)
