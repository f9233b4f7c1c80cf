"""Motion as a body sees it in a frame that moves and turns with it. Theory: docs/theory/reduction.md.

The frame is at the centre of mass, turned as it brings the nodes nearest to their places at rest, in mass: then the
displacements left hold no rigid motion, sum m u = 0 and sum m X x u = 0, to which a floating frame leaves its modes.

Reference:
    Kabsch (1976), A solution for the best rotation to relate two sets of vectors, Acta Crystallographica A 32.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.reduction.motion import Motion

FloatArray = NDArray[np.float64]


def frames(positions: FloatArray, rest: FloatArray, mass: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Frames of some states: centres of mass [m], (state, 3), and rotations from rest, (state, 3, 3).

    Args:
        positions: Nodes [m], (state, node, 3).
        rest: Nodes at rest [m], (node, 3).
        mass: Of the nodes, (node,).
    """
    share = mass / mass.sum()
    centre = np.einsum("n,snc->sc", share, positions)
    place = share[:, None] * (rest - share @ rest)
    left, _, right = np.linalg.svd(np.einsum("snc,nd->scd", positions - centre[:, None], place))
    sign = np.ones((len(positions), 3))
    sign[:, 2] = np.sign(np.linalg.det(left @ right))
    return centre, (left * sign[:, None, :]) @ right


def unturned(motion: Motion, nodes: slice, rest: FloatArray, mass: FloatArray) -> Motion:
    """The motion with the nodes of one body, and the forces on them, turned and moved back to rest.

    Args:
        motion: Of the scene.
        nodes: Those of the body.
        rest: They at rest [m], (node, 3).
        mass: Of them, (node,).
    """
    own = motion.positions[:, nodes].astype(np.float64)
    centre, R = frames(own, rest, mass)
    home = (mass @ rest) / mass.sum()
    back = np.einsum("snc,scd->snd", own - centre[:, None], R) + home
    changed: dict[str, Any] = {"positions": motion.positions.astype(np.float64)}
    changed["positions"][:, nodes] = back
    if motion.touch is not None:
        changed["touch"] = motion.touch.astype(np.float64)
        changed["touch"][:, nodes] = np.einsum("snc,scd->snd", changed["touch"][:, nodes], R)
    return replace(motion, **changed)
