"""How a step is solved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from softwarp.ranges import Range, check_fields

SolverPath = Literal["auto", "scalar", "lanes", "panels", "levels"]
Integrator = Literal["euler", "bdf2", "trapezoidal"]
MOST_ROUNDS = 1_000_000  # of an iteration
FULL_STEP = 0.01  # s, from which gaps have their full tolerance
LEAST_SHARE = 0.3  # of the tolerance, which float32 can still tell from the rounding of coordinates


@dataclass(frozen=True)
class Options:
    """How a step is solved.

    Attributes:
        integrator: Scheme of time stepping.
        newton_iterations: 1 is one linearisation per step (SOFA's scheme); more iterate with step halving.
        newton_tolerance: Relative force imbalance that ends the iterations.
        refinement: Passes of iterative refinement of every linear solve.
        contact_passes: Times that contacts are measured anew where the step leads to, with one Newton iteration.
        iterated_passes: The same in each of several Newton iterations.
        further_passes: Times that they are beyond these, in worlds that the last time has moved by more than ``skin``.
        skin: Way [m] up to which what a correction moves needs no further look.
        most_swing: Turn or stretch [rad] of a segment of a telescope in a step of one Newton iteration, beyond which
            its world goes only that much of its way.
        repeat_swing: Likewise, beyond which a world takes the step again, by Newton's method.
        gauss_seidel_iterations: Sweeps over the multiplier rows, at most.
        gauss_seidel_tolerance: Correction of a gap, in extents of the scene, that ends the sweeps of a world; shorter
            steps than 10 ms reduce it, because what is left of a gap is a velocity error times the step.
        recovery_speed: Speed [m/s] at which what penetrates is pushed apart.
        recovery_time: Time [s] in which penetration shrinks by half or more, so that its noise gives no speed.
        bounce_speed: Approach [m/s] up to which a contact with restitution does not bounce.
        project_tangent: Clamp element tangents of hyperelastic laws to positive semidefinite ones.
        pressure_tangent: Add the tangent of chamber pressures to A.
        turning_tangent: Add to A how the rotations of ``large`` and ``warped`` elements follow positions, by its
            symmetric part; for exact workspaces.
        reach: Distance in extents of the scene that a node may move in one step before its world counts as diverged.
        gpu_path: How a GPU factors A: ``panels``, ``levels``, or ``auto`` by the number of worlds.
    """

    integrator: Integrator = "euler"
    newton_iterations: Annotated[int, Range(low=1, high=MOST_ROUNDS)] = 1
    newton_tolerance: Annotated[float, Range(above=0.0, high=1.0)] = 1e-3
    refinement: Annotated[int, Range(low=0, high=100)] = 1
    contact_passes: Annotated[int, Range(low=0, high=100)] = 1
    iterated_passes: Annotated[int, Range(low=0, high=100)] = 0
    further_passes: Annotated[int, Range(low=0, high=100)] = 0
    skin: Annotated[float, Range(low=0.0)] = 0.0
    most_swing: Annotated[float, Range(above=0.0, infinite=True)] = 0.5
    repeat_swing: Annotated[float, Range(above=0.0, infinite=True)] = float("inf")
    gauss_seidel_iterations: Annotated[int, Range(low=1, high=MOST_ROUNDS)] = 100
    gauss_seidel_tolerance: Annotated[float, Range(above=0.0, high=1.0)] = 1e-7
    recovery_speed: Annotated[float, Range(low=0.0, high=1e6)] = 0.5
    recovery_time: Annotated[float, Range(low=0.0, high=1e6)] = 0.02
    bounce_speed: Annotated[float, Range(low=0.0, high=1e6)] = 0.01
    project_tangent: bool = True
    pressure_tangent: bool = False
    turning_tangent: bool = False
    reach: Annotated[float, Range(above=0.0, high=1e6)] = 1.0
    gpu_path: str = "auto"

    def __post_init__(self) -> None:
        """Refuse values outside the ranges above.

        Raises:
            ValueError: Naming the option, its value and what it must be.
        """
        check_fields(self, "Simulation")

    def gap_tolerance(self, extent: float, h: float) -> float:
        """Correction of a gap [m] that ends the sweeps, for a scene of some extent [m] and a step [s]."""
        return self.gauss_seidel_tolerance * extent * min(1.0, max(h / FULL_STEP, LEAST_SHARE))

    def recovery_share(self, h: float) -> float:
        """Part of a penetration that a step of length h [s] takes back, as a first-order lag does implicitly."""
        return h / (h + self.recovery_time)
