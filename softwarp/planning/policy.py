"""A planner as a policy: at every step it looks ahead in exact copies of the environment's state."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from softwarp.envs.snapshot import EnvSnapshot
from softwarp.planning.env_model import EnvModel, choice_count
from softwarp.planning.options import ModelConfig, PlannerConfig
from softwarp.planning.planners import make_planner, pool_size


class PlannerPolicy:
    """A policy for one environment: plans from its state, not from observations, and takes the first action.

    It is called as TorchRL's policies are. Each world has a planner of its own. Planners of sequences go on from what
    the last plan left, as long as they are asked step after step; trees are grown anew.

    Args:
        env: An environment, bare or transformed.
        config: The planner and its budget, which is that of every step.
        model: How actions and rewards are presented to the planner.

    Raises:
        ValueError: If the planner does not take the environment's actions.
    """

    def __init__(self, env: Any, config: PlannerConfig, model: ModelConfig | None = None) -> None:
        self.env = getattr(env, "base_env", env)
        self._settings, self._config = model or ModelConfig(), config
        self._model: EnvModel | None = None
        self._planners = [make_planner(config) for _ in range(self.env.num_worlds)]
        self._next_step = [-1] * self.env.num_worlds  # step of the episode at which a plan goes on

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action for the present state of the environment; a world whose episode is over gets none."""
        action = self.env.action_spec.zero()
        for world in range(self.env.num_worlds):
            start = self.env.snapshot([world])
            step = int(start.tensors["step_count"])
            if bool(start.tensors["terminated"]) or step >= self.env.max_episode_steps:
                continue
            chosen = self._choose(world, step, start)
            if chosen is not None:
                action[world] = chosen.to(action.device)
        return tensordict.set("action", action)

    def _choose(self, world: int, step: int, start: EnvSnapshot) -> Tensor | None:
        """First action of a new plan for a world; None if the planner knows none."""
        if self._model is None:
            self._model = self._make_model()
        planner = self._planners[world]
        if step != self._next_step[world] or planner.expected_state is not None:
            planner.forget()  # trees, too: the pool of worlds serves all
        self._model.start(start)
        found = planner.plan(self._model)
        if not len(found.actions):
            return None
        planner.advance(1)
        self._next_step[world] = step + 1
        return self._model.commands(found.actions[:1])[0]

    def _make_model(self) -> EnvModel:
        """A pool of worlds as large as a round of the planner; on a CPU on the path of many worlds, which is faster."""
        on_cpu = torch.device(self.env.device or "cpu").type == "cpu"
        path = "lanes" if on_cpu and self.env.config.precision == "float32" else None
        worlds = pool_size(self._config, choice_count(self.env, self._settings.levels))
        return EnvModel(self.env, self._settings, worlds=worlds, solver_path=path)
