"""Inverse control as a policy: it sees the simulated state, not the observation, and acts towards the goal."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

from tensordict import TensorDictBase
from torch import Tensor

from softwarp.control.effectors import PointEffector
from softwarp.control.inverse import InverseController, Solution
from softwarp.simulation import Simulation


@runtime_checkable
class Steerable(Protocol):
    """What an environment offers to inverse control."""

    sim: Simulation
    control_dt: float  # s, between two actions

    @property
    def tip_markers(self) -> tuple[int, ...]:
        """Markers whose mean is to come to the goal."""

    def goal_points(self) -> Tensor | None:
        """Goals [m], (world, 3)."""

    def action_for(self, command: Tensor) -> Tensor:
        """The action that takes the actuators' commands, (world, actuator), nearest to the wished ones."""


class InversePolicy:
    """A policy for one environment: reads its state, writes ``action``.

    It is called as TorchRL's policies are, so that evaluation, demonstrations and films take it like any other.

    Args:
        env: An environment, bare or transformed, whose task is to bring a point of the robot to a goal.
        **options: Of ``InverseController``.

    Raises:
        ValueError: If the environment's task is of another kind.
    """

    def __init__(self, env: Any, **options: Any) -> None:
        base = getattr(env, "base_env", env)
        if not isinstance(base, Steerable):
            raise ValueError(
                f"inverse control: {type(base).__name__} has no point that actuators bring to a goal; environments "
                "that have one offer tip_markers, goal_points and action_for, as Diamond and Trunk do"
            )
        self.env = base
        settings = {"period": base.control_dt} | options
        self.controller = InverseController(base.sim, [PointEffector(base.tip_markers)], **settings)
        self.solution: Solution | None = None  # of the last call

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action for the present state of the environment."""
        goal = self.env.goal_points()
        assert goal is not None
        self.solution = self.controller.solve(goal, apply=False)
        return tensordict.set("action", self.env.action_for(self.solution.command))
