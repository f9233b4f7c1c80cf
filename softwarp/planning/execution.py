"""Carrying plans out: all at once, or some steps before planning anew (receding horizon)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDict

from softwarp.envs.base import SoftEnv
from softwarp.planning.env_model import EnvModel
from softwarp.planning.plans import Step
from softwarp.planning.search import Planner, Progress, Search
from softwarp.planning.state_store import digests


@dataclass
class Execution:
    """What happened to the world that was planned for.

    Attributes:
        actions: Carried out, one per environment step, int or list of float.
        steps: What followed.
        searches: All plans that were made.
        reused: How many of them went on with what the one before had left.
    """

    actions: list[Any] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)
    searches: list[Search] = field(default_factory=list)
    reused: int = 0

    @property
    def success(self) -> bool:
        """Whether the goal is met at the end."""
        return bool(self.steps) and self.steps[-1].success

    @property
    def seconds(self) -> float:
        """Time spent planning [s]."""
        return sum(search.seconds for search in self.searches)


def execute(
    env: SoftEnv,
    model: EnvModel,
    planner: Planner,
    *,
    replan: int = 0,
    world: int = 0,
    progress: Progress | None = None,
) -> Execution:
    """Plan for a world of ``env`` and carry the plan out there, until its episode ends or no plan goes on.

    Other worlds of ``env`` are put back after each step, so that they keep their state.

    Args:
        env: Environment; it is stepped.
        model: Planning model of the same environment.
        planner: Search method; what it kept from earlier plans is dropped first.
        replan: Actions of a plan that are carried out before the next one is made; 0: all.
        world: World of ``env``.
        progress: Called while planning.

    Raises:
        ValueError: If ``replan`` is negative.
    """
    if replan < 0:
        raise ValueError(f"replan: must be at least 0 actions, got {replan}")
    planner.forget()
    done = Execution()
    others = [index for index in range(env.num_worlds) if index != world]
    while not (done.steps and done.steps[-1].done):
        done.reused += _start(env, model, planner, world)
        search = planner.plan(model, progress=progress and _from_step(progress, done, env.max_episode_steps))
        done.searches.append(search)
        carried = search.actions[: replan or len(search.actions)]
        if len(carried) == 0:
            break
        for action in model.schedule(carried):
            done.actions.append(action.tolist())
            done.steps.append(_step(env, action, world, others))
            if done.steps[-1].done:
                break
        planner.advance(len(carried))
    return done


def _start(env: SoftEnv, model: EnvModel, planner: Planner, world: int) -> bool:
    """Begin a plan where the world is now; whether it goes on with what the planner kept.

    A kept tree is only as good as its root: it is used if that is the world's state to the bit.
    """
    snapshot = env.snapshot([world])
    expected = planner.expected_state
    if expected is not None:
        if digests(model.state(expected)) == digests(snapshot):
            return True
        planner.forget()
    model.start(snapshot)
    return False


def _from_step(progress: Progress, done: Execution, last: int) -> Progress:
    """Progress of the next plan, which says where in the episode it is made."""
    where = f"plan {len(done.searches) + 1}, step {len(done.steps)}/{last}"

    def show(part: float, text: str) -> None:
        progress(part, f"{where}  {text}")

    return show


def _step(env: SoftEnv, action: torch.Tensor, world: int, others: list[int]) -> Step:
    saved = env.snapshot(others) if others else None
    given = env.action_spec.zero()
    given[world] = action.to(given.device)
    data = env.step(TensorDict({"action": given}, batch_size=env.batch_size))["next"]
    if saved is not None:
        env.restore(saved, others)
    numbers = (float(data["reward"][world]), float(data["distance"][world]))
    flags = (bool(data["success"][world]), bool(data["done"][world]))
    return Step(*numbers, *flags, digests(env.snapshot([world]))[0])
