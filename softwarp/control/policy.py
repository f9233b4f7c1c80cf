"""Inverse control as a policy: it sees the simulated state, not the observation, and acts towards the goal."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

from tensordict import TensorDictBase
from torch import Tensor

from softwarp.control.effectors import AXES, PointEffector
from softwarp.control.inverse import InverseController, Solution
from softwarp.control.regrasp import Regrasp
from softwarp.control.tubes import TubeController, TubeSolution
from softwarp.model.handles import Telescope
from softwarp.simulation import Simulation

RESTARTS = 4  # of tubes, in a row


@runtime_checkable
class Steerable(Protocol):
    """What an environment offers to inverse control.

    It may also have ``steered()``: the simulation whose actuators are commanded, in the environment's present state,
    where its own has none; ``goal_axes``: axes of the world along which the goal counts; ``steering``: options of
    ``InverseController`` that suit the task; and, where an axis has to be met as well as a place, ``point_markers``, a
    tuple of markers for each of several points, with ``point_goals()``, where these are to come [m], (world, point, 3).
    """

    sim: Simulation
    control_dt: float  # s, between two actions

    @property
    def tip_markers(self) -> tuple[int, ...]:
        """Markers whose mean is to come to the goal."""

    def goal_points(self) -> Tensor | None:
        """Goals [m], (world, 3)."""

    def action_for(self, command: Tensor) -> Tensor:
        """The action that takes the actuators' commands, (world, actuator), nearest to the wished ones."""


@runtime_checkable
class SteerableTubes(Protocol):
    """What an environment of tubes one in the other offers to inverse control; ``steering`` are options of it."""

    sim: Simulation
    control_dt: float  # s, between two actions

    @property
    def telescope(self) -> Telescope:
        """The tubes."""

    @property
    def steering(self) -> dict[str, Any]:
        """Options of ``TubeController`` that suit the task."""

    def goal_points(self) -> Tensor:
        """Where the tip is to come [m], (world, 3)."""

    def action_for(self, command: Tensor) -> Tensor:
        """The action that takes lengths and angles, (world, 2 tube), nearest to the wished ones."""


class InversePolicy:
    """A policy for one environment: reads its state, writes ``action``.

    It is called as TorchRL's policies are, so that evaluation, demonstrations and films take it like any other.

    Args:
        env: An environment, bare or transformed, whose task is to bring a point of the robot, or several, to goals.
        **options: Of ``InverseController``, or of ``TubeController`` where the robot consists of tubes; these have
            ``restarts`` too, how often in a row to start over where the control stalls (regrasp.py), 4 by default.

    Raises:
        ValueError: If the environment's task is of another kind.
    """

    def __init__(self, env: Any, **options: Any) -> None:
        base = getattr(env, "base_env", env)
        self.env, self._steered = base, getattr(base, "steered", None)
        self._goals: Callable[[], Tensor | None]
        self.solution: Solution | TubeSolution | None = None  # of the last call
        self.controller: InverseController | TubeController
        self.regrasp: Regrasp | None = None
        if isinstance(base, SteerableTubes):
            settings = {"period": base.control_dt, **base.steering, **options}
            restarts = settings.pop("restarts", RESTARTS)
            self.controller, self._goals = TubeController(base.sim, base.telescope, **settings), base.goal_points
            self.regrasp = Regrasp(self.controller, restarts=restarts)
            return
        if not isinstance(base, Steerable):
            raise ValueError(
                f"inverse control: {type(base).__name__} has no point that actuators bring to a goal; environments "
                "that have one offer tip_markers, goal_points and action_for, as Diamond, Trunk and CartStemContact do"
            )
        settings = {"period": base.control_dt, **getattr(base, "steering", {}), **options}
        several = getattr(base, "point_markers", None)
        axes = getattr(base, "goal_axes", AXES)
        effectors = [PointEffector(markers, axes=axes) for markers in several or (base.tip_markers,)]
        self._goals = getattr(base, "point_goals", base.goal_points)
        sim = base.sim if self._steered is None else self._steered()
        self.controller = InverseController(sim, effectors, **settings)

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action for the present state of the environment."""
        if self._steered is not None:
            self._steered()
        goal = self._goals()
        assert goal is not None
        self.solution = self.controller.solve(goal, apply=False)
        command = self.solution.command
        if self.regrasp is not None and isinstance(self.solution, TubeSolution):
            self.regrasp.begin(self.env.step_count == 0)
            command = self.regrasp.command(self.solution, goal)
        return tensordict.set("action", self.env.action_for(command))
