"""Modes for contact: how a body gives where something presses on it. Theory: docs/theory/reduction.md.

What contact forces do to a body stands in recorded motion, but with so little mass moved that modes ordered by it leave
it out. Here the forces themselves count: each recorded state's go through the body's stiffness at rest, with those of
inertia that a free body answers them with, and modes come from what they bring about.

Reference:
    Attachment modes and inertia relief of component mode synthesis: Craig & Kurdila (2006), Fundamentals of structural
    dynamics, chapter 17.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp import notices

FloatArray = NDArray[np.float64]
# From nodes (state, node, 3) [m] to forces of elements on their corners (state, element, 12) [N].
Forces = Callable[[FloatArray], FloatArray]
STEP = 1e-4  # of an element's size: displacement for differences of forces
SOFTEST = 1e-8  # of the largest stiffness per mass: shift that keeps a free body's stiffness regular


def stiffness(forces: Forces, rest: FloatArray, corners: NDArray[Any], told: str = "") -> Any:
    """Stiffness of some elements about the rest from differences of their forces, symmetric, as SciPy CSC [N/m].

    Nodes that share no element are moved together.

    Args:
        forces: Elastic forces at corners for positions of nodes, (state, element, 3 corners) [N].
        rest: Nodes [m], (node, 3).
        corners: Nodes of the elements, (element, corner).
        told: What is being done, for people.
    """
    from scipy.sparse import coo_array

    count, size = len(rest), corners.shape[1]
    colour = _colours(corners, count)
    length = STEP * float(np.median(np.linalg.norm(rest[corners[:, 1]] - rest[corners[:, 0]], axis=1)))
    rows, cols, values = [], [], []
    dof = (3 * corners[:, :, None] + np.arange(3)).reshape(len(corners), -1)
    for c in range(int(colour.max()) + 1):
        own = colour[corners] == c  # at most one corner of an element
        element, corner = np.nonzero(own)
        states = np.repeat(rest[None], 6, axis=0)
        for axis in range(3):
            states[2 * axis, colour == c, axis] += length
            states[2 * axis + 1, colour == c, axis] -= length
        f = forces(states)
        for axis in range(3):
            slope = (f[2 * axis, element] - f[2 * axis + 1, element]) / (2.0 * length)
            rows.append(dof[element].ravel())
            cols.append(np.repeat(3 * corners[element, corner] + axis, 3 * size))
            values.append(slope[:, : 3 * size].ravel())
        notices.progress(told or "stiffness at rest", f"{c + 1} of {int(colour.max()) + 1}")
    notices.progress_ends()
    shape = (3 * count, 3 * count)
    K = coo_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))), shape=shape).tocsr()
    return (0.5 * (K + K.T)).tocsc()


def responses(K: Any, mass: FloatArray, rest: FloatArray, held: NDArray[np.bool_], loads: FloatArray) -> FloatArray:
    """Displacements [m] that loads bring about, without rigid motion where nothing holds the body, (load, node, 3).

    Args:
        K: Stiffness at rest [N/m].
        mass: Of the nodes [kg].
        rest: Nodes [m], (node, 3).
        held: Nodes that do not move.
        loads: Forces on nodes [N], (load, node, 3).
    """
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    weight, flat = np.repeat(mass, 3), loads.reshape(len(loads), -1)
    rigid = np.zeros((0, weight.size))
    if not held.any():
        arm = rest - (mass @ rest) / mass.sum()
        moves = [np.broadcast_to(axis, arm.shape) for axis in np.eye(3)] + [np.cross(axis, arm) for axis in np.eye(3)]
        half = np.array([(np.sqrt(weight) * move.ravel()) for move in moves])
        rigid = np.linalg.qr(half.T)[0].T / np.sqrt(weight)
        flat = flat - (flat @ rigid.T) @ (rigid * weight)
    free = np.flatnonzero(~np.repeat(held, 3))
    shift = SOFTEST * float((K.diagonal()[free] / weight[free]).max())
    A = (K + diags_array(shift * weight)).tocsc()[free][:, free]
    u = np.zeros_like(flat)
    symmetric = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    u[:, free] = splu(A.tocsc(), **symmetric).solve(np.ascontiguousarray(flat[:, free].T)).T
    u -= (u * weight) @ rigid.T @ rigid
    return u.reshape(loads.shape)


def _colours(corners: NDArray[Any], count: int) -> NDArray[np.int32]:
    """A number for every node, different for nodes of one element, few in all."""
    touching: list[list[int]] = [[] for _ in range(count)]
    for element, nodes in enumerate(corners):
        for node in nodes:
            touching[int(node)].append(element)
    colour = np.full(count, -1, dtype=np.int32)
    for node in range(count):
        taken = {int(c) for c in colour[corners[touching[node]]].ravel()} if touching[node] else set()
        colour[node] = next(c for c in range(count + 1) if c not in taken)
    return colour
