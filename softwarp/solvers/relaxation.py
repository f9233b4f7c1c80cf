"""Equilibrium of scenes with rods, rigid bodies, chambers or contact: implicit steps without momentum.

A step of length h from rest minimises the energy plus |change|^2_M / (2 h^2); after it velocities are dropped. A mode
of frequency w shrinks by 1 / (1 + h^2 w^2) a step, so h grows while Newton's method converges and shrinks where it does
not. Theory: docs/theory/statics.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softwarp.model.codes import Status
from softwarp.solvers.implicit_euler import ImplicitEuler
from softwarp.solvers.system import System

NEWTON_ITERATIONS = 25  # per step
FIRST_STEP, LEAST_STEP, LAST_STEP = 0.05, 1.0e-3, 1.0e4  # s
GROWTH, REDUCTION = 3.0, 0.25


class Relaxation:
    """Moves the worlds of several shards to equilibrium with a common step length.

    Args:
        systems: Shards, with ``Options.newton_iterations`` of their own.
    """

    def __init__(self, systems: list[System]) -> None:
        self.systems = systems
        self.h = FIRST_STEP

    def iterate(self) -> NDArray[np.float64]:
        """One step; largest way of a node or frame [m] in every world, infinite where the step has to be repeated.

        A way counts only once the step is as long as it gets, because a short one hardly moves anything.
        """
        ways = np.concatenate([self._step(system) for system in self.systems])
        is_bad = ~np.isfinite(ways)
        is_last = self.h >= LAST_STEP
        if is_bad.any():
            self.h = max(self.h * REDUCTION, LEAST_STEP)
        else:
            self.h = min(self.h * GROWTH, LAST_STEP)
        return ways if is_last else np.full_like(ways, np.inf)

    def _step(self, system: System) -> NDArray[np.float64]:
        state = system.state
        names = ("node_x", "frame_pose")
        before = [getattr(state, name).numpy().copy() for name in names]
        time = state.time.numpy().copy()
        ImplicitEuler(system, self.h).step()
        for name in ("node_v", "frame_twist", "good_v", "good_twist"):
            getattr(state, name).zero_()
        state.time.assign(time)
        way = np.zeros(system.world_count)
        for name, old in zip(names, before, strict=True):
            change = np.abs(getattr(state, name).numpy() - old)
            way = np.maximum(way, change.max(axis=1, initial=0.0))
        way[state.status.numpy()[:, 0] > Status.OK] = np.inf
        return np.asarray(way)
