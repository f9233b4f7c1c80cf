"""Natural modes of soft bodies about the present state. Theory: docs/theory/modes.md."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp import checks, diagnostics
from softwarp.model.model import Model
from softwarp.solvers.system import System

FloatArray = NDArray[np.float64]
BELOW_ZERO = 1.0e-7  # of the stiffest node's K / M: shift that keeps bodies which can move freely regular
RESTING = 1.0e-4  # of the highest frequency found: below, a mode moves without strain


@dataclass(frozen=True)
class Modes:
    """Natural modes, slowest first.

    Attributes:
        frequency: [Hz], shape (mode,); 0 for motion without strain, not a number where the state is not stable.
        shape: Displacements of nodes, shape (mode, node, 3) [kg^-1/2]: orthonormal with the mass, zero at held nodes.
        ratio: Damping ratio by the bodies' Rayleigh factors, shape (mode,); 0 where the frequency is not positive.
    """

    frequency: FloatArray
    shape: FloatArray
    ratio: FloatArray

    def damping(self, dt: float) -> FloatArray:
        """Damping ratios in steps of ``dt`` [s]: those of the material and omega dt / 2 of backward Euler."""
        dt = checks.number(dt, "Modes.damping: dt [s]", low=0.0)
        result: FloatArray = self.ratio + np.pi * np.nan_to_num(self.frequency) * dt
        return result


def natural_modes(system: System, world: int, count: int, rayleigh: tuple[FloatArray, FloatArray]) -> Modes:
    """The slowest modes of one world of a system, from K and M as ``diagnostics`` assembles them.

    Args:
        system: Its workspace is written to; one with room for the exact tangent.
        world: Of the system.
        count: Number of modes.
        rayleigh: alpha [1/s] and beta [s] of every body.

    Raises:
        ValueError: If fewer scalars are free, or the scene has rods or rigid bodies.
    """
    from scipy.sparse.linalg import LinearOperator, eigsh, splu

    model = system.model
    free = _free(model)
    count = checks.count(count, f"modes: count, of {free.size} free coordinates,", low=1, high=free.size)
    K, M = diagnostics.exact_stiffness(system, world), diagnostics.mass_matrix([system], world)
    K, M = ((0.5 * (A + A.T))[free][:, free].tocsc().astype(np.float64) for A in (K, M))
    shift = -BELOW_ZERO * float((K.diagonal() / M.diagonal()).max())
    if count >= free.size - 1:  # Lanczos' method wants more room
        from scipy.linalg import eigh

        value, vector = eigh(K.toarray(), M.toarray(), subset_by_index=(0, count - 1))
    else:
        solve = splu(K - shift * M).solve
        start = np.random.default_rng(0).standard_normal(free.size)
        value, vector = eigsh(K, count, M, sigma=shift, OPinv=LinearOperator((free.size,) * 2, matvec=solve), v0=start)
        order = np.argsort(value)
        value, vector = value[order], vector[:, order]
    highest = max(float(np.abs(value).max()), -shift)
    value = np.where(np.abs(value) < RESTING**2 * highest, 0.0, value)
    omega = np.sqrt(np.where(value >= 0.0, value, np.nan))
    shape = np.zeros((count, 3 * model.node_count))
    shape[:, free] = vector.T
    return Modes(omega / (2.0 * np.pi), shape.reshape(count, -1, 3), _ratios(model, rayleigh, K, M, vector, omega))


def _free(model: Model) -> NDArray[Any]:
    """Scalars that no node holds."""
    return np.flatnonzero(np.repeat(~model.node_fixed, 3) & ~model.node_locked.ravel())


def _ratios(
    model: Model, rayleigh: tuple[FloatArray, FloatArray], K: Any, M: Any, vector: FloatArray, omega: FloatArray
) -> FloatArray:
    """(alpha / omega + beta omega) / 2, factors averaged over bodies by their part in inertia and stiffness."""
    body = model.node_body.numpy()[_free(model) // 3]
    alpha, beta = (values[body][:, None] for values in rayleigh)
    drag = (vector * (M @ (alpha * vector))).sum(axis=0)
    viscous = (vector * (K @ (beta * vector))).sum(axis=0)
    moving = omega > 0.0
    ratio: FloatArray = np.where(moving, 0.5 * (drag + viscous) / np.where(moving, omega, 1.0), 0.0)
    return ratio
