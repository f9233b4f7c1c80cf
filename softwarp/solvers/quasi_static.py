"""Equilibrium without inertia: f_int(x) = f_ext + H' multiplier. Theory: docs/theory/newton.md."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softwarp.kernels import newton
from softwarp.solvers.newton_control import NewtonControl
from softwarp.solvers.system import System

PSEUDO_MASS = 0.1  # first factor of M in units of E / (rho extent^2); it falls as the iteration converges
STATIC_REACH = 0.05  # of the scene's extent: how far a cable target is approached per iteration


class QuasiStatic:
    """Newton's method with bounded steps and a vanishing pseudo-mass c: A = K + c M.

    K is the exact tangent, not clamped, so the last iterations converge quadratically; where it is indefinite the
    factorisation fails for that world and c grows until it does not. A step is accepted unless the force imbalance
    explodes: turning parts first stretch by the square of their rotation, which the next iteration removes, so a
    monotone imbalance would crawl.
    """

    def __init__(self, system: System) -> None:
        self.system = system
        self.control = NewtonControl(system, static=True)

    def start(self) -> None:
        """Load the state as the first iterate."""
        self.system.load()
        self.system.scale(0.0)
        self.control.begin(PSEUDO_MASS)

    def iterate(self, first: bool, tolerance: float) -> None:
        """Evaluate the present iterate and take one step from it."""
        self.evaluate(first, tolerance)
        self.control.keep(restore=False)
        self.control.pseudo_mass()
        self.system.tangent()
        if self.system.is_coupled:
            self.system.cable_tangent()
        self.system.solve(1.0, 1.0)
        self.control.advance()

    def evaluate(self, first: bool, tolerance: float) -> None:
        """Imbalance and verdict at the present iterate."""
        system = self.system
        system.move(1.0)
        system.measure_cables()
        system.command(0.0, STATIC_REACH * system.model.extent)
        system.clamp_multipliers()
        system.forces()
        system.right_hand_side(1.0, inertia=False, moving=False)
        system.imbalance(1.0, inertia=False)
        self.control.judge(first=first, tolerance=tolerance)

    def finish(self, tolerance: float) -> None:
        """Judge the last iterate and commit it with zero velocity."""
        self.evaluate(False, tolerance)
        self.control.keep(restore=True)
        self.system.move(1.0)
        self.system.commit(0.0, 0.0, iterated=True)

    def verdict(self) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Relative residual and whether it converged, per world (reads back to the host)."""
        values = self.system.newton.real.numpy()
        merit, frozen = (
            values[:, row, :].reshape(-1)[: self.system.world_count] for row in (newton.MERIT, newton.FROZEN)
        )
        return merit.astype(np.float64), frozen > 0.5
