"""What a plan makes its robot do, step by step: what another robot, or one that is simulated better, is to follow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from softwarp.planning import plans

FloatArray = NDArray[np.float64]

KINDS = ("normal", "point")  # of targets: where the normal of a plate points, and where a point is [m]


@runtime_checkable
class Traceable(Protocol):
    """What an environment offers, besides being one, whose plans others can follow."""

    target_kind: str  # one of ``KINDS``; normals stand from the beginning of an action, points come at its end

    def plan_target(self) -> Tensor:
        """Targets that follow from the last action, (world, 3)."""

    def tracked(self) -> Tensor:
        """Where that is which the task is about [m], (world, k), in the frame in which its goal stands still."""

    def task_options(self, world: int) -> dict[str, Any]:
        """Options by which another environment poses the task of a world."""


@dataclass(frozen=True, eq=False)
class Trace:
    """A plan carried out in its own environment.

    Attributes:
        kind: Of the targets, one of ``KINDS``.
        times: Ends of the actions [s], the start among them, (action + 1,).
        targets: At these times, (action + 1, 3).
        step: Simulation step [s].
        places: What the task is about, at every simulation step, the start among them [m], (step + 1, k).
        options: Which pose the same task elsewhere.
        success: Whether the plan meets the goal where it was made.
    """

    kind: str
    times: FloatArray
    targets: FloatArray
    step: float
    places: FloatArray
    options: dict[str, Any]
    success: bool

    def path(self, ramp: float) -> tuple[FloatArray, FloatArray]:
        """Moments [s] and targets between which another robot goes straight.

        Args:
            ramp: Time [s] that it takes for a normal to turn to its new direction at the beginning of an action.
        """
        if self.kind == "point":
            return self.times, self.targets
        moments, rows = [0.0], [self.targets[0]]
        for begin, end, target in zip(self.times, self.times[1:], self.targets[1:], strict=False):
            for moment in (min(begin + ramp, end), end):
                if moment > moments[-1] + 1.0e-9:
                    moments.append(float(moment))
                    rows.append(target)
        return np.array(moments), np.array(rows)


def trace(plan: plans.Plan, *, device: str = "cpu") -> Trace:
    """Carry a plan out in a fresh environment of one world, and watch it.

    Raises:
        ValueError: If its environment offers nothing to follow.
    """
    env: Any = plans.make_env(plan.env, device=device)
    is_traceable = isinstance(env, Traceable)
    if not is_traceable:
        raise ValueError(
            f"plan: {type(env).__name__} tells nothing that another robot could follow; environments that do offer "
            "target_kind, plan_target, tracked and task_options, as SimpleMaze, Trunk and Diamond do"
        )
    env.restore(plan.start, [0])

    def row(values: Tensor) -> FloatArray:
        return np.asarray(values[0].double().cpu().numpy())

    options, targets, places = env.task_options(0), [row(env.plan_target())], [row(env.tracked())]
    for action in plans.as_actions(env, plan.actions):
        given = env.action_spec.zero()
        given[0] = action.to(given.device)
        for substep in range(env.action_repeat):  # what ``SoftEnv`` does, and looks on
            if substep == 0 or not env.holds_commands:
                env.apply_action(given, substep)
            env.sim.step()
            places.append(row(env.tracked()))
        targets.append(row(env.plan_target()))
    success = bool(env.is_success(env.measure_distance())[0])
    times = env.control_dt * np.arange(len(targets), dtype=np.float64)
    return Trace(env.target_kind, times, np.array(targets), env.sim.dt, np.array(places), options, success)
