"""How a step is solved."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Options:
    """How a step is solved.

    Attributes:
        newton_iterations: 1 is one linearisation per step (SOFA's scheme); more iterate with step halving.
        newton_tolerance: Relative force imbalance that ends the iterations.
        refinement: Passes of iterative refinement of every linear solve.
        gauss_seidel_iterations: Sweeps over the multiplier rows, at most.
        gauss_seidel_tolerance: Correction of a gap, in extents of the scene, that ends the sweeps of a world.
        recovery_speed: Speed [m/s] at which what penetrates is pushed apart.
        bounce_speed: Approach [m/s] up to which a contact with restitution does not bounce.
        project_tangent: Clamp element tangents of hyperelastic laws to positive semidefinite ones.
        pressure_tangent: Add the tangent of chamber pressures to A.
        reach: Distance in extents of the scene that a node may move in one step before its world counts as diverged.
    """

    newton_iterations: int = 1
    newton_tolerance: float = 1e-3
    refinement: int = 1
    gauss_seidel_iterations: int = 100
    gauss_seidel_tolerance: float = 1e-7
    recovery_speed: float = 0.5
    bounce_speed: float = 0.01
    project_tangent: bool = True
    pressure_tangent: bool = False
    reach: float = 1.0
