"""Equilibrium without inertia: f_int(x) = f_ext + H' multiplier. Theory: docs/theory/newton.md."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softwarp.kernels import newton
from softwarp.solvers.newton_control import NewtonControl
from softwarp.solvers.system import System

PSEUDO_STEP = 0.05  # [s] first pseudo-time step; it grows as the iteration converges
STATIC_REACH = 0.05  # of the scene's extent: how far a cable target is approached per iteration


class QuasiStatic:
    """Newton's method with pseudo-transient continuation: A = K + c M with c falling to zero.

    Reference: Kelley and Keyes (1998), Convergence analysis of pseudo-transient continuation.
    """

    def __init__(self, system: System) -> None:
        self.system = system
        self.control = NewtonControl(system, static=True)

    def start(self) -> None:
        """Load the state as the first iterate."""
        self.system.load()
        self.system.scale(0.0)
        self.control.begin(1.0 / PSEUDO_STEP**2)

    def iterate(self, first: bool, tolerance: float) -> None:
        """Evaluate the present iterate and take one step from it."""
        self.evaluate(first, tolerance)
        self.control.keep(restore=False)
        self.control.pseudo_mass()
        self.system.tangent()
        self.system.solve(1.0, 1.0)
        self.control.advance()

    def evaluate(self, first: bool, tolerance: float) -> None:
        """Imbalance and verdict at the present iterate."""
        system = self.system
        system.move(1.0)
        system.measure_cables()
        system.command(0.0, STATIC_REACH * system.model.extent)
        system.forces()
        system.right_hand_side(1.0, inertia=False, moving=False)
        system.imbalance(1.0, inertia=False)
        self.control.judge(first=first, tolerance=tolerance)

    def finish(self, tolerance: float) -> None:
        """Judge the last iterate and commit it with zero velocity."""
        self.evaluate(False, tolerance)
        self.control.keep(restore=True)
        self.system.move(1.0)
        self.system.commit(0.0, 0.0, tolerance)

    def merit(self) -> NDArray[np.float64]:
        """Relative residual per world (reads back to the host)."""
        values = self.system.newton.real.numpy()[:, newton.MERIT, :]
        return np.asarray(values.reshape(-1)[: self.system.world_count], dtype=np.float64)
