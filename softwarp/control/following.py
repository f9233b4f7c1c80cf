"""Following: targets over time become commands over time, by any inverse control, for all worlds at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from softwarp import checks
from softwarp.control.inverse import InverseController, Solution
from softwarp.control.tilt import TiltController
from softwarp.model.codes import Outcome

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TargetPath:
    """Targets over time, straight between moments, the last one afterwards.

    Attributes:
        times: Moments [s], rising, the first at 0, shape (row,).
        targets: Points [m], normals and heights, or whatever the control takes that follows, shape (row, n).

    Raises:
        ValueError: If shapes do not fit, times do not rise from 0, or a number is not finite.
    """

    times: FloatArray
    targets: FloatArray

    def __post_init__(self) -> None:
        """Check shapes and times."""
        times = checks.array(self.times, "target path: times [s]", (None,))
        targets = checks.array(self.targets, "target path: targets", (None, None))
        if not len(times) or len(targets) != len(times):
            raise ValueError(
                f"target path: times must have shape (row,) and targets (row, n), got {times.shape} and {targets.shape}"
            )
        if times[0] != 0.0 or (np.diff(times) <= 0.0).any():
            raise ValueError("target path: times must rise from 0")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "targets", targets)

    @property
    def seconds(self) -> float:
        """Length [s]."""
        return float(self.times[-1])

    def at(self, seconds: float) -> FloatArray:
        """Targets at a time [s], (n,)."""
        return np.array([np.interp(seconds, self.times, column) for column in self.targets.T])


@dataclass(frozen=True, eq=False)
class Followed:
    """What came of following a path.

    Attributes:
        times: Moments [s] at which commands stand, the start among them, (tick + 1,).
        commands: In the order of the actuators, in their units, (tick + 1, world, actuator).
        errors: Predicted distances to the targets, as ``Solution.error``, (tick, world, effector).
        outcomes: ``Outcome`` of every solution, (tick, world).
    """

    times: FloatArray
    commands: FloatArray
    errors: FloatArray
    outcomes: NDArray[np.int32]

    @property
    def unreached(self) -> FloatArray:
        """Share of the ticks at which the targets were out of reach or the program failed, (world,)."""
        refused = (Outcome.UNREACHABLE, Outcome.CONFLICT, Outcome.FAILED)
        share: FloatArray = np.isin(self.outcomes, [int(o) for o in refused]).mean(axis=0)
        return share


def follow(steering: InverseController | TiltController, path: TargetPath, *, settle: float = 0.0) -> Followed:
    """Let a simulation follow a path, all worlds alike, from its present state.

    At every control period the commands for its end are found, and stand there after a straight change over the
    steps of the period: what a player of a command file does between its rows.

    Args:
        steering: Inverse control; its period is that of the commands.
        path: Targets.
        settle: Time [s] for which the first targets are held before the path begins, which is not recorded.

    Raises:
        ValueError: If the period is not a whole number of steps, or the targets do not fit the control.
    """
    controller = steering.controller if isinstance(steering, TiltController) else steering
    sim, period = controller.sim, controller.options.period
    substeps = round(period / sim.dt)
    if substeps < 1 or abs(substeps * sim.dt - period) > 1.0e-6 * period:
        raise ValueError(f"following: the period must be a whole number of steps of {sim.dt:g} s, got {period:g} s")

    def tick(seconds: float) -> Solution:
        row = torch.as_tensor(path.at(seconds), device=sim.device).expand(sim.num_worlds, -1)
        start, solution = controller.present(), steering.solve(row, apply=False)
        for step in range(substeps):
            controller.write(torch.lerp(start, solution.command.to(start), (step + 1) / substeps))
            sim.step()
        return solution

    for _ in range(round(settle / period)):
        tick(0.0)
    count = max(1, int(np.ceil(path.seconds / period - 1.0e-9)))
    commands, errors, outcomes = [controller.present().cpu().numpy()], [], []
    for step in range(count):
        solution = tick((step + 1) * period)
        commands.append(solution.command.double().cpu().numpy())
        errors.append(solution.error.double().cpu().numpy())
        outcomes.append(solution.outcome.cpu().numpy())
    times = period * np.arange(count + 1, dtype=np.float64)
    return Followed(times, np.array(commands), np.array(errors), np.array(outcomes))
