"""Plans as files: what to do, what follows from it, and where it started, complete enough to be carried out again.

A plan file is JSON: the environment's name and options, the start state, the actions step by step, and for each step
what the model predicts (reward, distance, success, fingerprint of the state). ``replay`` carries a plan out in a fresh
environment and compares every state's fingerprint; on one kind of device and one solver path they are equal.
"""

from __future__ import annotations

import base64
import dataclasses
import io
import json
import math
import os
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from softwarp.envs import registry
from softwarp.envs.base import SoftEnv
from softwarp.envs.snapshot import EnvSnapshot
from softwarp.io.atomic import write_text
from softwarp.io.bounded import DamagedFileError, parse_json, read_tensors, unpack
from softwarp.planning.env_model import EnvModel
from softwarp.planning.search import Search
from softwarp.planning.state_store import digests

FORMAT = "softwarp-plan"
VERSION = 1
MOST_STATE = 64 * 2**20  # bytes that the start of a plan may take: one world, without what packs it
_INFINITE = ("inf", "-inf")


@dataclass(frozen=True)
class Step:
    """What follows from one environment step."""

    reward: float  # of the task, not scaled
    distance: float  # m, to the goal
    success: bool
    done: bool
    state: str  # fingerprint of the state reached


@dataclass
class Plan:
    """Actions from a start state, one per environment step.

    Attributes:
        env: ``name`` of the environment and its options, solver path included.
        planner: Settings of the planner and of its model.
        start: Where it starts, one world.
        actions: Of the environment, int or list of float.
        steps: Predictions, one per action.
        value: Discounted sum of scaled rewards that the planner found.
        cost: Expansions, model transitions and seconds spent.
        tree: Columns of the search tree, and its nodes along the plan; None where there is none.
        history: Progress of a planner of sequences.
    """

    env: dict[str, Any]
    planner: dict[str, Any]
    start: EnvSnapshot
    actions: list[Any]
    steps: list[Step]
    value: float
    cost: dict[str, float]
    tree: dict[str, Any] | None = None
    history: list[dict[str, float]] = field(default_factory=list)

    @property
    def success(self) -> bool:
        """Whether the goal is met after the last step."""
        return bool(self.steps) and self.steps[-1].success

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the plan as JSON; a file that stood there is replaced only by a complete one."""
        content = {
            "format": FORMAT,
            "version": VERSION,
            "env": _plain(self.env),
            "planner": _plain(self.planner),
            "value": self.value,
            "success": self.success,
            "cost": self.cost,
            "actions": self.actions,
            "steps": [dataclasses.asdict(step) for step in self.steps],
            "start": encode(self.start),
            "history": self.history,
            "tree": self.tree,
        }
        write_text(path, json.dumps(content, allow_nan=False) + "\n")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Plan:
        """Read a plan.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If it is no plan, or of another version.
        """
        target = Path(path)
        if not target.is_file():
            raise FileNotFoundError(f"plan {target} does not exist; make one with softwarp plan out={target}")
        try:
            content = parse_json(target.read_bytes())
        except (DamagedFileError, OSError) as error:
            raise ValueError(f"{target} is not a complete plan ({error}); make it again") from error
        if not isinstance(content, dict) or content.get("format") != FORMAT or content.get("version") != VERSION:
            raise ValueError(f"{target} is not a plan of version {VERSION}; make it again with softwarp plan")
        try:
            names = ("actions", "steps", "value", "cost", "tree", "history")
            actions, steps, *rest = (content[name] for name in names)
            start, predicted = decode(content["start"]), [Step(**step) for step in steps]
            _check(content["env"], content["planner"], actions, predicted)
            _check_search(*rest)
            return cls(content["env"], content["planner"], start, actions, predicted, *rest)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{target} is damaged ({type(error).__name__}: {error}); make it again") from error


def _check(env: Any, planner: Any, actions: Any, steps: list[Step]) -> None:
    """Refuse what names no environment, or does not hold one action per step, all numbers or all lists of as many.

    Raises:
        ValueError: Saying what is wrong.
    """
    if not isinstance(env, dict) or not isinstance(env.get("name"), str):
        raise ValueError("env holds no name")
    if not isinstance(planner, dict):
        raise ValueError("planner holds no settings")
    for step in steps:
        told = (step.reward, step.distance)
        flags = (step.success, step.done)
        if not (_are_numbers(told) and all(isinstance(flag, bool) for flag in flags) and isinstance(step.state, str)):
            raise ValueError("a step does not hold reward, distance, success, done and state")
    if not isinstance(actions, list) or len(actions) != len(steps):
        raise ValueError(f"there must be {len(steps)} actions, one per step")
    rows = [action if isinstance(action, list) else [action] for action in actions]
    kinds = {(type(action) is list, len(row)) for action, row in zip(actions, rows, strict=True)}
    if len(kinds) > 1 or not all(type(entry) in (int, float) for row in rows for entry in row):
        raise ValueError("actions must all be numbers, or lists of as many numbers")


def _check_search(value: Any, cost: Any, tree: Any, history: Any) -> None:
    """Refuse what a search cannot have told.

    Raises:
        ValueError: Saying what is wrong.
    """
    if not (_are_numbers([value]) and isinstance(cost, dict) and _are_numbers(cost.values())):
        raise ValueError("value and cost must be numbers")
    if not {"expansions", "seconds"} <= cost.keys():
        raise ValueError("cost must tell expansions and seconds")
    if not isinstance(history, list) or not all(isinstance(e, dict) and _are_numbers(e.values()) for e in history):
        raise ValueError("history must be a list of numbers by name")
    if tree is None:
        return
    columns = [tree[name] for name in ("parent", "depth", "value", "success", "distance")]
    if not all(isinstance(column, list) and len(column) == tree["nodes"] for column in columns):
        raise ValueError("the columns of the tree must be as long as it has nodes")
    if not (_are_numbers(tree["value"]) and all(isinstance(depth, int) for depth in tree["depth"])):
        raise ValueError("values and depths of the tree must be numbers")
    if not all(isinstance(at, int) and -1 <= at < node for node, at in enumerate(tree["parent"])):
        raise ValueError("a node of the tree has no parent before it")
    if not all(isinstance(at, int) and 0 <= at < tree["nodes"] for at in tree["plan"]):
        raise ValueError("the plan leaves the tree")


def _are_numbers(values: Iterable[Any]) -> bool:
    return all(type(value) in (int, float) for value in values)


def predict(search: Search, model: EnvModel) -> tuple[list[Any], list[Step]]:
    """Actions of a search's result, one per environment step, and what follows from them in the model's pool."""
    actions = model.schedule(search.actions)
    steps = follow(model.pool, _start(search, model), actions)
    return actions[: len(steps)].tolist(), steps


def write_down(
    search: Search,
    model: EnvModel,
    settings: dict[str, Any],
    *,
    start: EnvSnapshot | None = None,
    done: tuple[list[Any], list[Step]] | None = None,
) -> Plan:
    """A search's result as a plan.

    Args:
        search: What a planner found.
        model: The model that it searched.
        settings: Of planner and model, to be written down.
        start: State of one world that the actions start from; None takes the one that was planned from.
        done: Actions and what followed, where they were carried out; None takes what the model predicts.

    Raises:
        ValueError: If the environment's class cannot be imported, so that no file could name it.
    """
    actions, steps = done or predict(search, model)
    return Plan(
        {"name": registry.name_of(type(model.pool)), **dataclasses.asdict(model.pool.config), "check_actions": True},
        settings,
        start or _start(search, model),
        actions,
        steps,
        search.value,
        {"expansions": search.expansions, "transitions": search.transitions, "seconds": search.seconds},
        None if search.tree is None else search.tree.to_dict() | {"plan": search.nodes},
        search.history,
    )


def _start(search: Search, model: EnvModel) -> EnvSnapshot:
    """The state that a search began in: the model's root, or further on where a kept tree was used."""
    root = model.root if search.tree is None else search.tree.state[0]
    return model.snapshot if root == model.root else model.state(root)


def follow(env: SoftEnv, start: EnvSnapshot, actions: Tensor) -> list[Step]:
    """Carry actions out from ``start`` in world 0 of an environment, until the episode ends."""
    env.restore(start, [0])
    given = env.action_spec.zero()
    steps: list[Step] = []
    for action in actions:
        given[0] = action.to(given.device)
        data = env.step(TensorDict({"action": given}, batch_size=env.batch_size))["next"]
        state = digests(env.snapshot([0]))[0]
        numbers = (float(data["reward"][0]), float(data["distance"][0]))
        steps.append(Step(*numbers, bool(data["success"][0]), bool(data["done"][0]), state))
        if steps[-1].done:
            break
    return steps


def replay(plan: Plan, *, device: str = "cpu") -> list[Step]:
    """Carry a plan out in a fresh environment of one world."""
    env = make_env(plan.env, device=device)
    return follow(env, plan.start, as_actions(env, plan.actions))


def as_actions(env: SoftEnv, actions: list[Any]) -> Tensor:
    """Actions of a plan as a tensor that the environment takes one by one.

    Raises:
        ValueError: If the environment's actions are others.
    """
    given = torch.tensor(actions, dtype=env.action_spec.dtype)
    shape, wanted = tuple(given.shape[1:]), tuple(env.action_spec.shape[1:])
    if actions and shape != wanted:
        name = type(env).__name__
        raise ValueError(f"plan: {name} takes actions of shape {wanted}, the plan's have {shape}; make it again")
    return given


def make_env(settings: dict[str, Any], *, device: str = "cpu", seed: int | None = 0, num_worlds: int = 1) -> SoftEnv:
    """Environment of a plan file: ``name`` and options, lists becoming tuples again where the options are."""
    name = settings["name"]
    defaults = registry.spec(name).config_class()()
    options = {key: value for key, value in settings.items() if key != "name"}
    for key, value in options.items():
        options[key] = _restored(value, tuple if isinstance(getattr(defaults, key, None), tuple) else list)
    config = registry.make_config(name, None, options)
    return registry.make(name, num_worlds=num_worlds, device=device, seed=seed, config=config)


def encode(snapshot: EnvSnapshot) -> str:
    """A snapshot as text.

    Raises:
        ValueError: If it is larger than ``decode`` reads.
    """
    stream = io.BytesIO()
    torch.save(_on_host(snapshot.state_dict()), stream)
    if stream.tell() > MOST_STATE:
        raise ValueError(f"plan: a state of {stream.tell()} bytes is more than a plan file takes, {MOST_STATE}")
    return base64.b64encode(zlib.compress(stream.getvalue(), 9)).decode()


def decode(text: str) -> EnvSnapshot:
    """The snapshot that ``encode`` was given.

    Raises:
        ValueError: If it is damaged, or larger than any state of one world.
    """
    return EnvSnapshot.from_state_dict(read_tensors(unpack(base64.b64decode(text), MOST_STATE)))


def _on_host(value: Any) -> Any:
    if isinstance(value, Tensor):
        return value.cpu().contiguous().clone()
    return {key: _on_host(item) for key, item in value.items()} if isinstance(value, dict) else value


def _plain(value: Any) -> Any:
    """Infinite limits as text: JSON has no number for them."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _restored(value: Any, kind: type[tuple[Any, ...]] | type[list[Any]]) -> Any:
    """What ``_plain`` was given, lists as tuples where the option is one."""
    if isinstance(value, list):
        return kind(_restored(item, kind) for item in value)
    return float(value) if value in _INFINITE else value
