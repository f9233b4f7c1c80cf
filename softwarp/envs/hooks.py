"""What a task tells and does: the hooks that ``SoftEnv`` calls, with what holds where a task says nothing."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softwarp.builder import ModelBuilder
from softwarp.envs.options.base import EnvConfig
from softwarp.render import Camera


class Hooks(ABC):
    """All worlds at once; tensors have the world axis first."""

    config: EnvConfig
    world_state: dict[str, Tensor]  # of add_world_state

    @abstractmethod
    def build_scene(self, builder: ModelBuilder) -> None:
        """Add bodies, cables and markers; called once per simulation that is made."""

    def setup(self) -> None:  # noqa: B027 - a task may have nothing to do here
        """Allocate what the task needs; ``self.sim`` exists and is settled."""

    @property
    def action_size(self) -> int:
        """Length of a continuous action; each entry lies in [-1, 1]."""
        return 0

    @property
    def action_count(self) -> int:
        """Number of discrete actions; 0 when actions are continuous."""
        return 0

    def action_names(self) -> Sequence[str]:
        """Names of an action's entries, or of the choices, for people; none: cables, chambers, or numbers."""
        return ()

    @abstractmethod
    def apply_action(self, action: Tensor, substep: int) -> None:
        """Write ``sim.control`` for sub-step 0 ... action_repeat - 1; must not keep or change ``action``."""

    @abstractmethod
    def observation_bounds(self) -> dict[str, tuple[Tensor, Tensor]]:
        """Finite lower and upper bounds per observation, each of shape (k,)."""

    @abstractmethod
    def observe(self) -> dict[str, Tensor]:
        """Fresh observations (world, k), scaled; the base class clips them to the bounds."""

    @abstractmethod
    def measure_distance(self) -> Tensor:
        """Distance to the goal [m], shape (world,)."""

    @abstractmethod
    def reward_terms(self, action: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """Named terms (world,), same names always; ``self.distance`` still holds the previous step's distance."""

    def action_mask(self) -> Tensor | None:
        """Discrete actions that are legal now, bool (world, action_count); advice only. None: all are, always."""
        return None

    def likeness(self) -> Tensor | None:
        """What makes states alike to planners, int64 (world, k); equal rows are taken as one state. None: no two are.

        For robots that come to rest where their commands hold them, these: turns and insertions in another order end
        at one place.
        """
        return None

    def is_success(self, distance: Tensor) -> Tensor:
        """Whether the goal is met, bool (world,)."""
        return torch.zeros_like(distance, dtype=torch.bool)

    def is_terminated(self, distance: Tensor) -> Tensor:
        """Whether the task ends here, bool (world,): a fall, a goal met; failed worlds end in any case."""
        return torch.zeros_like(distance, dtype=torch.bool)

    def reset_worlds(self, mask: Tensor) -> None:  # noqa: B027 - likewise
        """Draw goals and parameters where ``mask`` (world,) holds; the simulator has been reset there."""

    def camera(self) -> Camera | None:
        """Point of view of ``render``; None fits the robot and its goals, and stays for the episode (pictures.py)."""
        return None

    def shown_region(self) -> NDArray[np.float64] | None:
        """Positions [m] that pictures show, the lowest of them on the floor, (k, 3); None lets the renderer choose."""
        return None

    def shown_goals(self) -> Tensor | None:
        """Goals [m] that the first picture has room for, (k, 3); a task with a list of goals returns the list."""
        return self.goal_points()

    def goal_points(self) -> Tensor | None:
        """Goal positions [m] that pictures and files show, (world, 3); None if the task's goal is no point."""
        goal = self.world_state.get("goal")
        return goal if goal is not None and goal.shape[1:] == (3,) else None

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Acceleration of the scene [m/s^2]."""
        return (0.0, 0.0, -9.81)

    @property
    def contact_capacity(self) -> int | None:
        """Contacts that a world can hold; steps take time for all of them. None leaves it to the builder."""
        return None

    @property
    def turns(self) -> bool:
        """Whether the task asks a robot that may be reduced to turn as a whole."""
        return False

    @property
    def reduced_file(self) -> str | None:
        """File with the modes that a body moves in; None where all move node by node."""
        return self.config.reduced
