"""Modes of a body from how it moves: proper orthogonal decomposition, with its mass or its stiffness.

Theory: docs/theory/reduction.md.

Reference:
    Goury & Duriez (2018), Fast, generic, and reliable control and simulation of soft robots using model order
    reduction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from softwarp import checks

FloatArray = NDArray[np.float64]
Rigid = Literal["none", "translations", "motions"]
Norm = Literal["mass", "step"]
NORMS: tuple[Norm, ...] = ("step", "mass")
RIGID: dict[str, int] = {"none": 0, "translations": 3, "motions": 6}
NEGLIGIBLE = 1e-12  # of the largest singular value: what the snapshots do not hold
ROUNDED = 1e-7  # of the largest singular value: what squares of lengths do not hold
RIGIDLY = 0.05  # of a mode: one with less of deformation is a rigid motion
STILL = 1e-6  # of the body's size: mean displacement that rounding of recorded positions may bring about


@dataclass(frozen=True)
class Basis:
    """Modes and what the motion that they come from holds of each.

    Attributes:
        modes: Displacements of all nodes, (mode, node, 3). With the mass matrix M and the total mass m, Phi' M Phi is
            m times the identity, so that an amplitude is the root mean square displacement of the mass [m].
        singular_values: Of the motion besides rigid modes, largest first, those of modes left out among them [m], in
            the lengths that the modes were chosen by.
        rigid: Rigid modes among the first ones.
        contact: Modes for contact, the last ones.
    """

    modes: FloatArray
    singular_values: FloatArray
    rigid: int
    contact: int = 0

    @property
    def missing(self) -> float:
        """Part of the motion that the modes leave out: root of the sum of squares, relative to all of it."""
        return float(_missing(self.singular_values)[len(self.modes) - self.rigid - self.contact])


def pod(
    displacements: FloatArray,
    mass: FloatArray,
    positions: FloatArray,
    *,
    count: int | None = None,
    tolerance: float = 1e-3,
    rigid: Rigid = "none",
    contact: FloatArray | None = None,
    contact_count: int = 0,
    metric: Any = None,
) -> Basis:
    """Proper orthogonal decomposition of displacements.

    Args:
        displacements: From rest, (snapshot, node, 3) [m]; zero at nodes that are held.
        mass: Lumped mass of the nodes, (node,) [kg].
        positions: Nodes at rest, (node, 3) [m].
        count: Modes besides rigid ones; None takes as few as ``tolerance`` allows.
        tolerance: Largest part of the motion that the modes may leave out, as ``Basis.missing``.
        rigid: Modes that come first whatever the snapshots hold: three ``translations``, or all six infinitesimal rigid
            ``motions``; finite rotations need more modes of deformation. ``none`` for a body that is held.
        contact: Further displacements [m], (load, node, 3), what forces of contact bring about: ``contact.responses``.
        contact_count: Modes that hold as much as possible of what the others leave out of them.
        metric: Matrix whose product u' A u is the square of a displacement's length [m^2], sparse, (3 node, 3 node);
            None takes the mass per whole mass. Modes are orthonormal in mass with any.

    Raises:
        ValueError: If nothing moves, more modes are asked for than there is motion, or a value lies outside its range.
    """
    checks.choice(rigid, "rigid", tuple(RIGID))
    x = np.asarray(displacements, dtype=np.float64)
    if x.ndim != 3 or x.shape[1:] != (len(mass), 3) or not np.isfinite(x).all():
        raise ValueError(checks.refusal("displacements", f"be finite, of shape (snapshot, {len(mass)}, 3)", x.shape))
    weight = np.sqrt(np.asarray(mass, dtype=np.float64) / np.sum(mass))[:, None]
    first = _rigid_modes(np.asarray(positions, dtype=np.float64), weight, rigid)
    flat = (weight * x).reshape(len(x), -1)
    flat = flat - (flat @ first.T) @ first
    values, right = _directions(flat, weight, metric)
    held = int((values > NEGLIGIBLE * max(float(values.max(initial=0.0)), 1e-300)).sum())
    if held == 0 or np.linalg.norm(flat) <= STILL * np.ptp(positions, axis=0).max() * np.sqrt(len(x)):
        raise ValueError("displacements: nothing moves in them besides rigid motion; excite the actuators")
    if count is None:
        checks.number(tolerance, "tolerance", above=0.0, below=1.0)
        count = int(np.argmax(_missing(values) <= tolerance))
    checks.count(count, f"modes (the motion holds {held})", low=0 if len(first) else 1, high=held)
    modes = np.concatenate([first, right[:count]])
    if contact is not None and contact_count:
        modes = np.concatenate([modes, _contact_modes(modes, weight, contact, contact_count)])
    result = orthonormal(modes).reshape(len(modes), -1, 3) / weight
    if len(first) == 0:
        result[:, ~x.any(axis=(0, 2))] = 0.0  # what is held, or never moves, to the last bit
    return Basis(result, values, len(first), contact_count)


def _directions(flat: FloatArray, weight: FloatArray, metric: Any) -> tuple[FloatArray, FloatArray]:
    """Singular values of weighted displacements, and the directions that hold most of them, (direction, 3 node)."""
    if metric is None:
        _, values, right = np.linalg.svd(flat, full_matrices=False)
        return values, right
    moved = flat / np.repeat(weight[:, 0], 3)
    squares, mixing = np.linalg.eigh(moved @ np.asarray(metric @ moved.T))
    values = np.sqrt(squares[::-1].clip(min=0.0))
    values[values <= ROUNDED * values.max(initial=0.0)] = 0.0
    held = values > 0.0
    return values, (mixing[:, ::-1][:, held] / values[held]).T @ flat


def orthonormal(rows: FloatArray) -> FloatArray:
    """Rows that span the same, orthonormal to rounding: Gram and Schmidt, twice. Changes ``rows``."""
    for _ in range(2):
        for k in range(len(rows)):
            rows[k] -= (rows[:k] @ rows[k]) @ rows[:k]
            rows[k] /= np.linalg.norm(rows[k])
    return rows


def deforming(modes: FloatArray, positions: FloatArray, share: FloatArray) -> tuple[FloatArray, list[int]]:
    """Modes free of rigid motion and orthonormal in mass, and which of those given they come from, one after the other.

    Args:
        modes: (mode, node, 3), orthonormal in mass.
        positions: Nodes at rest [m], (node, 3).
        share: Part of the mass at every node, (node,).
    """
    weight = np.sqrt(share)[:, None]
    done = _rigid_modes(positions, weight, "motions")
    kept: list[int] = []
    for k, mode in enumerate(modes):
        row = (weight * mode).ravel()
        for _ in range(2):
            row = row - (done @ row) @ done
        if (size := float(np.linalg.norm(row))) > RIGIDLY:
            done, kept = np.concatenate([done, row[None] / size]), [*kept, k]
    return done[RIGID["motions"] :].reshape(-1, *positions.shape) / weight, kept


def _contact_modes(modes: FloatArray, weight: FloatArray, contact: FloatArray, count: int) -> FloatArray:
    """Leading directions of displacements under contact beside some modes, weighted, (mode, 3 node)."""
    flat = (weight * contact).reshape(len(contact), -1)
    for _ in range(2):
        flat = flat - (flat @ modes.T) @ modes
    _, values, right = np.linalg.svd(flat, full_matrices=False)
    held = int((values > NEGLIGIBLE * max(float(values.max(initial=0.0)), 1e-300)).sum())
    checks.count(count, f"contact modes (contact in the motion holds {held})", high=held)
    return right[:count]


def _missing(values: FloatArray) -> FloatArray:
    """What is left out by the first 0, 1, 2 ... modes."""
    squares = np.concatenate([values**2, [0.0]])
    left: FloatArray = np.sqrt(np.cumsum(squares[::-1])[::-1] / max(float(squares.sum()), 1e-300))
    return left


def _rigid_modes(positions: FloatArray, weight: FloatArray, rigid: Rigid) -> FloatArray:
    """Orthonormal rigid motions, weighted, (mode, 3 node)."""
    centre = (weight**2 * positions).sum(axis=0)
    arm = positions - centre
    moves = [np.broadcast_to(axis, arm.shape) for axis in np.eye(3)]
    moves += [np.cross(axis, arm) for axis in np.eye(3)]
    chosen = [(weight * move).ravel() for move in moves[: RIGID[rigid]]]
    if not chosen:
        return np.empty((0, 3 * len(positions)))
    q, _ = np.linalg.qr(np.array(chosen).T)
    return np.ascontiguousarray(q.T)
