"""Further looks at contacts, beyond those of every step, in worlds that still move. Theory: docs/theory/contact.md.

A look measures the contacts where the step leads to, and corrects the step. Where the correction moves something by
more than a skin, or ran out of sweeps, contacts lie elsewhere again, and the world looks once more; all others keep
what they have, to the bit, whatever the worlds beside them do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp.kernels.rows import looks
from softwarp.model import memory
from softwarp.model.codes import FAR, CoupleColumn
from softwarp.model.model import Model
from softwarp.solvers.linear.cholesky import PanelSolver
from softwarp.solvers.response import ContactResponse
from softwarp.solvers.terms.contact import ContactTerm
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard

SKIN = 0.1  # radii of a line that a correction may move it by without a further look
MOST = 3  # looks of a step in scenes with telescopes
SOFT_SKIN = 0.25  # edges of a usual element that a correction may move soft bodies by that touch each other


def chosen_looks(model: Model) -> dict[str, Any]:
    """Looks at contacts that a scene needs: ``Options`` by name.

    One, and up to three for lines of telescopes, which snap across a lumen within a step. Beside joints and reduced
    bodies, which are corrected in every pass, all worlds take all three. Two where soft bodies meet each other: a look
    may give way to what the one before held back, and a wall be thinner than that.
    """
    if model.contact is None:
        return {"contact_passes": 1}
    if model.telescopes is None or model.frames is None:
        soft = model.contact.scene.couple_table()[:, CoupleColumn.TRACKED].any()
        if not soft or model.joints is not None or model.reduction is not None:
            return {"contact_passes": 1}
        return {"contact_passes": 1, "further_passes": 1, "skin": SOFT_SKIN * usual_edge(model)}
    if model.joints is not None or model.reduction is not None:
        return {"contact_passes": MOST}
    skin = SKIN * least_radius(model)
    return {"contact_passes": 1, "further_passes": MOST - 1, "skin": skin}


def least_radius(model: Model) -> float:
    """The smallest contact radius of the lines of telescopes [m]; there must be some."""
    assert model.telescopes is not None and model.frames is not None
    return min(float(model.frames.rod_radius[model.rod_nodes(rod)].min()) for rod in model.telescopes.rod)


def usual_edge(model: Model) -> float:
    """Edge of a regular tetrahedron with the median volume of the model's elements [m]."""
    whole = [] if model.quadratic is None else [model.quadratic.point_volume.numpy()]
    if model.hexes is not None:
        whole.append(model.hexes.piece_size.numpy())
    volume = np.abs(np.concatenate([model.tet_volume.numpy(), *whole]))
    return float(np.cbrt(6.0 * np.sqrt(2.0) * np.median(volume)))


class FurtherLooks:
    """Which worlds look again, and what the others keep.

    Args:
        shard: Worlds; ``Options.further_passes`` and ``Options.skin`` are theirs.
        contact: Contacts.
        response: Their response.
        panels: The linear solver's panels, where it has any.
    """

    def __init__(
        self, shard: Shard, contact: ContactTerm, response: ContactResponse, panels: PanelSolver | None
    ) -> None:
        self.shard, self.contact, self.response, self.panels = shard, contact, response, panels
        self.k = looks.kernels(shard.variant)
        self.arm = wp.array(dof_arms(shard.model), dtype=shard.variant.real, device=shard.device)
        self.any = memory.zeros((1,), wp.int32, shard.device)
        w = shard.work
        self.kept: list[tuple[Rows, Rows]] = [
            (values, shard.rows(values.real.shape[1]))
            for values in (w.u, w.multiplier, w.residual, contact.contacts.multiplier)
        ]

    def mark(self) -> None:
        """Keep what the next look changes."""
        for values, before in self.kept:
            before.copy_from(values)

    def watch(self, x_scale: float) -> None:
        """Idle are worlds that the last look moved by no more than the skin, and whose contacts it has solved."""
        s, contacts = self.shard, self.contact.contacts
        now, before = self.kept[0]
        self.any.zero_()
        inputs = [s.model.dof_count, x_scale, s.options.skin, self.arm, before.real, now.real, s.work.residual.real]
        s.each_real(self.k.watch, None, inputs, [contacts.idle.real, self.any])

    def take(self, look: Callable[[], None], *, always: bool) -> None:
        """Take one more look in worlds that are not idle, if there are any.

        Args:
            look: What it is.
            always: Do so without asking whether there are any, as where a recording cannot branch.
        """

        def act() -> None:
            self.mark()
            self._skip(self.contact.contacts.idle)
            try:
                look()
            finally:
                self._skip(None)
            for values, before in self.kept:
                inputs = [self.contact.contacts.idle.real, before.real]
                self.shard.each_real(self.k.hold, values.real.shape[1], inputs, [values.real])

        if always:
            act()
        else:
            wp.capture_if(self.any, act)

    def _skip(self, idle: Rows | None) -> None:
        """Leave idle worlds out of what takes long where each has threads of its own; None leaves out nobody."""
        response, panels = self.response, self.panels
        response.skipped = idle or response.everyone
        if panels is not None:
            panels.skipped = idle.S if idle is not None else panels.everyone

    def end(self) -> None:
        """All worlds count again."""
        self.contact.contacts.idle.zero()
        self.response.contact_sides.span()


def dof_arms(model: Model) -> NDArray[np.float64]:
    """Way of what a dof moves, per unit of it: 1, or the longest lever [m] of a rotation, (dof,)."""
    arms = np.ones(model.dof_count)
    f = model.frames
    if f is not None:
        size, dofs = f.frame_size.numpy().astype(np.float64), f.frame_dof.numpy().reshape(-1, 2)
        size[len(size) - len(f.rod_radius) :] = f.rod_radius
        for arm, rotation in zip(size, dofs[:, 1], strict=True):
            if rotation >= 0:
                arms[rotation] = arm if arm < FAR else model.extent
    return arms
