"""Equilibrium of scenes with rods, rigid bodies, chambers or contact: implicit steps without momentum.

A step of length h from rest minimises the energy plus |change|^2_M / (2 h^2); after it velocities are dropped. A mode
of frequency w shrinks by 1 / (1 + h^2 w^2) a step, so h grows while Newton's method converges and shrinks where it does
not. Theory: docs/theory/statics.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softwarp.kernels.step import newton
from softwarp.model.codes import StaticEnd, Status
from softwarp.solvers.implicit_euler import ImplicitEuler
from softwarp.solvers.system import System

NEWTON_ITERATIONS = 25  # per step, at most
FIRST_STEP, LEAST_STEP, LAST_STEP = 0.05, 1.0e-3, 1.0e4  # s
CONTACT_STEP = 1.0  # s, last step with contact: what rests on friction alone weighs nothing in a longer one
GROWTH, REDUCTION = 8.0, 0.25
LONG_STEP = 0.5  # s, from which a step shows what is left of the way
NEAR_FLOAT32, NEAR_FLOAT64 = 5.0e-4, 1.0e-7  # of the scene's extent: ways that rounding can cause
PATIENCE = 8  # steps in which the shortest way has not become half as long


class Relaxation:
    """Moves the worlds of several shards to equilibrium with a common step length.

    Args:
        systems: Shards, with ``Options.newton_iterations`` of their own.
    """

    def __init__(self, systems: list[System]) -> None:
        self.systems = systems
        model = systems[0].model
        self.extent = model.extent
        self.last_step = LAST_STEP if model.contact is None else CONTACT_STEP
        self.near = (NEAR_FLOAT64 if model.precision == "float64" else NEAR_FLOAT32) * model.extent
        self.h = FIRST_STEP
        self.start()

    def start(self) -> None:
        """Begin anew, with the step that the last solve ended with: from one equilibrium the next is near."""
        count = sum(system.world_count for system in self.systems)
        self.ways = np.full(count, np.inf)  # m, of the last step; infinite where it failed
        self.ends = np.full(count, StaticEnd.ITERATIONS)
        self._shortest, self._stalled = np.full(count, np.inf), np.zeros(count, dtype=np.int64)

    def iterate(self, limit: float) -> None:
        """One step, and what it says of every world.

        A way below ``limit`` [m] counts only once the step is as long as it gets, because a short one hardly moves
        anything. A world whose Newton iterations were used up near the end has reached its rounding, or needs patience.
        """
        told = [self._step(system) for system in self.systems]
        self.ways, status = (np.concatenate(parts) for parts in zip(*told, strict=True))
        is_rough = (status == Status.MAX_ITERATIONS) & (self.ways <= self.near)
        is_bad = (status > Status.OK) & ~is_rough
        self.ways[status >= Status.NONFINITE] = np.inf
        is_shorter = self.ways < 0.5 * self._shortest
        self._stalled = np.where(is_shorter | is_bad | (self.h < LONG_STEP), 0, self._stalled + 1)
        self._shortest = np.where(is_shorter, self.ways, self._shortest)

        is_still = (self._stalled >= PATIENCE) & (self.ways <= self.near)
        is_there = (status <= Status.OK) & (self.ways <= limit) & (self.h >= self.last_step)
        self.ends[:] = StaticEnd.ITERATIONS
        self.ends[status > Status.MAX_ITERATIONS] = StaticEnd.FAILED
        self.ends[is_still] = StaticEnd.ROUNDING
        self.ends[is_there] = StaticEnd.CONVERGED
        if is_bad.any():
            self.h = max(self.h * REDUCTION, LEAST_STEP)
        elif not is_rough.any():
            self.h = min(self.h * GROWTH, self.last_step)

    def _step(self, system: System) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Ways [m] and status codes of a shard's worlds."""
        state = system.state
        names = ("node_x", "frame_pose")
        before = [getattr(state, name).numpy().copy() for name in names]
        time = state.time.numpy().copy()
        step = ImplicitEuler(system, self.h)
        step.is_over = lambda: self._is_still(system)
        step.step()
        for name in ("node_v", "frame_twist", "good_v", "good_twist"):
            getattr(state, name).zero_()
        state.time.assign(time)
        way = np.zeros(system.world_count)
        for name, old in zip(names, before, strict=True):
            change = np.abs(getattr(state, name).numpy() - old)
            way = np.maximum(way, change.max(axis=1, initial=0.0))
        return way, state.status.numpy()[:, 0].copy()

    @staticmethod
    def _is_still(system: System) -> bool:
        """Whether Newton's method has ended in every world."""
        frozen = system.work.control.real.numpy()[:, newton.FROZEN].reshape(-1)[: system.world_count]
        return bool((frozen > 0.5).all())
