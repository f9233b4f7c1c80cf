"""Launches of the per-world Newton control: accept, reject, advance. Theory: docs/theory/newton.md."""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from softwarp.kernels.collision.geometry import DISTANCE, TOUCH_ROWS
from softwarp.kernels.step import newton
from softwarp.model import memory
from softwarp.model.model import Model
from softwarp.scene.materials import lame
from softwarp.solvers.system import System
from softwarp.solvers.workspace import rows
from softwarp.solvers.workspace.rows import Rows

ROUNDING_FLOAT32 = 1e-3  # relative imbalance that coordinates of this precision can cause in stiff, thin bodies
ROUNDING_FLOAT64 = 1e-10


class NewtonControl:
    """Keeps the last accepted iterate of every world and moves on from it.

    Args:
        system: Worlds to iterate.
        still: Keep the forces of contacts of worlds that have converged, too, and what their sweeps left, so that
            iterations of others change nothing there; their contacts are not worked on. Worlds that have not converged
            get the contacts and forces of their best iterate, if ``find_best_contacts`` ends their iterations.
        deepest: How deep [m] contacts of each pair may lie at no cost to an iterate's merit, unless the start lies
            deeper, (pair,); contacts with compliance, and with None all, may lie anywhere.
        steadies: Whether worlds that got stuck take further iterations, in which contacts of earlier ones stay.

    Attributes:
        left: 1 while worlds have not converged; of ``look_for_others``.
        spare: Not 0 in worlds that nobody asks for, which need not converge, where there are any; int, 1 row.
    """

    def __init__(
        self, system: System, *, still: bool = False, deepest: ArrayLike | None = None, steadies: bool = False
    ) -> None:
        self.system, self.shard = system, system.shard
        self.kernels = newton.kernels(system.variant)
        self.rounding = ROUNDING_FLOAT64 if system.model.precision == "float64" else ROUNDING_FLOAT32
        self.rounding_force = rounding_force(system.model)
        allocate, dofs = self.shard.rows, self.shard.dof_rows
        self.reference, self.best, self.direction = (allocate(dofs) for _ in range(3))
        real = system.variant.real
        self.deepest = None if deepest is None else wp.array(deepest, dtype=real, device=self.shard.device)
        self.left = memory.zeros((1,), wp.int32, self.shard.device)
        self.detector = system.contact.detector if steadies and system.contact is not None else None
        self.holds = still  # whether worlds that stay as they are are given back what they had
        held_rows = still or self.detector is not None
        still_rows = (*system.multipliers.contact_forces, system.work.residual) if held_rows else ()
        self.still = [(values, allocate(values.real.shape[1])) for values in still_rows]
        worlds = (self.shard.variant, self.shard.world_count, 1, self.shard.device, wp.int32)
        self.spare = rows.allocate(*worlds)
        self.best_contacts: list[tuple[rows.Rows, rows.Rows]] = []
        if still and system.contact is not None:
            d = system.contact.detector
            for values in (d.known_count, d.known_key, d.known_force):
                size, dtype = values.real.shape[1], values.real.dtype
                best = rows.allocate(self.shard.variant, self.shard.world_count, size, self.shard.device, dtype)
                self.best_contacts.append((values, best))
        self.idle = rows.allocate(*worlds) if system.contact is None else system.contact.contacts.idle
        count = max(system.rows.count, 1)
        self.multiplier, self.best_multiplier = allocate(count), allocate(count)
        self.returns = rows.allocate(*worlds)
        self.before: list[tuple[Rows, Rows]] = []
        if self.detector is not None:
            w, forces = system.work, (*system.multipliers.contact_forces, system.work.residual)
            changed = (w.control, w.dof_v, w.multiplier, self.best, self.best_multiplier, *forces)
            self.before = [(values, allocate(values.real.shape[1])) for values in changed]

    def begin(self) -> None:
        """Reset the control rows of all worlds, whose contacts all are worked on."""
        if self.holds:
            self.idle.zero()
        self.shard.each_real(self.kernels.begin, None, [], [self.system.work.control.real])
        self.multiplier.copy_from(self.system.work.multiplier)
        if self.detector is not None:
            self.detector.stuck.zero()

    def begin_further(self) -> None:
        """Worlds with contacts that got stuck, and have not converged, go on; others halt and keep what they have."""
        assert self.detector is not None
        for values, before in self.before:
            before.copy_from(values)
        self.holds = True
        outputs = [self.system.work.control.real, self.detector.stuck.real]
        self.shard.each_real(self.kernels.begin_further, None, [self.detector.contacts.count.real], outputs)
        self.look_for_others()

    def count_further(self, most: int) -> None:
        """Worlds that have converged, or gone on ``most`` times, halt."""
        self.shard.each_real(self.kernels.count_further, None, [most], [self.system.work.control.real])
        self.look_for_others()

    def give_up(self) -> None:
        """Worlds that have not converged go back to where they were before, with the contacts of there."""
        assert self.detector is not None
        inputs, outputs = [self.system.work.control.real], [self.detector.stuck.real, self.returns.real]
        self.shard.each_real(self.kernels.end_further, None, inputs, outputs)
        self.give_back()

    def give_back(self) -> None:
        """What worlds had that go back; once more after their contacts have been found again."""
        for values, before in self.before:
            inputs = [self.returns.real, before.real]
            self.shard.each_real(self.kernels.give_back, values.real.shape[1], inputs, [values.real])

    def end_further(self) -> None:
        """All worlds count again; those that have not converged get their best iterate."""
        self.holds = False
        self.idle.zero()
        self.keep(last=True)

    def judge(self, *, first: bool, tolerance: float, f_scale: float) -> None:
        """Accept or reject the present iterate; needs ``System.imbalance`` with the same ``f_scale``.

        Forces that are not finite at the first one raise a flag, because no step could mend them.
        """
        s, w, m = self.shard, self.system.work, self.system.model
        if first:
            s.check_finite(w.norm, 2)
        self.system.rows.measure_gaps()
        contact = self.system.contact
        if contact is not None and self.deepest is not None:
            c = contact.contacts
            inputs = [TOUCH_ROWS, DISTANCE, self.deepest, c.count.real, c.pair.real, c.compliance.real]
            inputs += [contact.pairs.distance.real, contact.detector.touch.real]
            s.each_real(self.kernels.measure_depth, None, inputs, [w.control.real])
        inputs = [first, tolerance, self.rounding, self.rounding_force * f_scale]
        inputs += [m.segment_count == 0, self.system.rows.count]
        inputs += [m.row_size, w.norm.real, w.gap.real]
        inputs += [w.multiplier.real, w.lower_bound.real, w.upper_bound.real]
        s.each_real(self.kernels.judge, None, inputs, [w.control.real])

    def keep(self, *, last: bool) -> None:
        """Store accepted and best iterates; after the ``last`` one, worlds that have not converged get their best."""
        s, k, w, count = self.shard, self.kernels, self.system.work, self.system.rows.count
        control = w.control.real
        s.each_real(k.keep, s.dof_rows, [control, w.dof_v.real], [self.reference.real])
        s.each_real(k.keep_best, s.dof_rows, [last, control], [w.dof_v.real, self.best.real])
        s.each_real(k.keep_best, count, [last, control], [w.multiplier.real, self.best_multiplier.real])
        if self.best_contacts and self.system.contact is not None:
            known, best = zip(*self.best_contacts, strict=True)
            outputs = [values.real for values in (*known, *best)]
            s.each_real(k.keep_best_contacts, self.system.contact.contacts.capacity, [last, control], outputs)

    def find_best_contacts(self, h: float, look: float) -> None:
        """After the last iterate: contacts where worlds got their best, with the forces that it was judged with."""
        assert self.system.contact is not None
        self.system.move(h)
        self.system.contact.find_kept(h, look)
        self.hold_still()

    def look_for_others(self) -> None:
        """Whether there are worlds that have not converged, for ``left``; what converged ones are to keep."""
        self.left.zero_()
        inputs = [self.system.work.control.real, self.spare.real]
        self.shard.each_real(self.kernels.look_for_others, None, inputs, [self.idle.real, self.left])
        for values, held in self.still:
            held.copy_from(values)

    def hold_still(self) -> None:
        """Give converged worlds back what they had: others' iterations, and to carry forces to new axes, change it."""
        for values, held in self.still if self.holds else ():
            inputs = [self.system.work.control.real, held.real]
            self.shard.each_real(self.kernels.hold_still, values.real.shape[1], inputs, [values.real])

    def advance(self, h: float) -> None:
        """Move on from the last accepted iterate of every world that has not converged."""
        s, k, w, count = self.shard, self.kernels, self.system.work, self.system.rows.count
        control = w.control.real
        s.each_real(k.check_direction, None, [s.dof_rows, w.u.real], [control, w.pressure_share.real])
        s.each_real(k.hold, count, [control], [w.multiplier.real, self.multiplier.real])
        for force in self.system.multipliers.contact_forces:
            s.each_real(k.drop_failed, force.real.shape[1], [control], [force.real])
        self.hold_still()
        if self.system.multipliers.exist:
            self.system.imbalance(h, inertia=True)
            s.each_real(k.refer, None, [w.norm.real], [control])
        inputs = [control, w.u.real, self.reference.real]
        s.each_real(k.advance, s.dof_rows, inputs, [self.direction.real, w.dof_v.real])
        s.each_real(k.go_back, s.dof_rows, [control, self.best.real], [w.dof_v.real, self.reference.real])
        inputs = [control, self.best_multiplier.real]
        s.each_real(k.go_back, count, inputs, [w.multiplier.real, self.multiplier.real])


def rounding_force(model: Model) -> float:
    """Force imbalance [N] that rounding of the coordinates to the model's precision causes in tets and rod segments."""
    epsilon = 2.2e-16 if model.precision == "float64" else 1.2e-7
    square = 0.0
    volumes = [model.tet_volume]
    if model.quadratic is not None:
        volumes.append(model.quadratic.point_volume)
    if model.hexes is not None:
        volumes.append(model.hexes.piece_size)
    for array in volumes:
        if array.size == 0:
            continue
        mu, lam = lame(model.defaults["youngs"].max(), model.defaults["nu"].max())
        sizes = np.abs(array.numpy()).astype(np.float64)
        square += float(((2.0 * mu + lam) ** 2 * 12.0 * sizes ** (2.0 / 3.0)).sum())
    if model.frames is not None and model.segment_count:
        f = model.frames
        area, length = f.seg_section.numpy()[:, 0].astype(np.float64), f.seg_length.numpy().astype(np.float64)
        square += float(2.0 * ((model.defaults["rod_youngs"].max() * area / length) ** 2).sum())
    return float(epsilon * model.extent * np.sqrt(square))
