"""``softwarp view``: an environment live in the browser, or a recording, a plan or a test episode of a run there."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase

from softwarp.control.policy import Steerable
from softwarp.envs import registry
from softwarp.io.trajectory import Trajectory
from softwarp.planning.options import CONFIGS, SequencesConfig
from softwarp.planning.policy import PlannerPolicy
from softwarp.policies.baselines.names import UNLEARNED
from softwarp.policies.baselines.scripted import Policy
from softwarp.policies.baselines.table import RULES
from softwarp.view import Player, Viewer

from . import shown, verbs
from .config import make_env_config
from .record import demonstrator
from .verbs import INVERSE

THOUGHT = 0.25  # s, that a planner may take for an action, after its first round


def main(arguments: list[str], path: str = "") -> int:
    """Show an environment as the overrides say, until Ctrl-C; returns the exit code.

    Args:
        arguments: Hydra overrides of ViewConfig, for example ``["env=cart_stem", "worlds=4"]``.
        path: Recording, plan, run folder or checkpoint to be shown instead.
    """
    if path:
        return play(path, arguments)
    config = verbs.viewing(arguments)
    device = registry.check_device(config.device)
    name, env_config = make_env_config(config.env)
    env = registry.make(name, num_worlds=config.worlds, device=device, seed=config.seed, config=env_config)
    policies = drivers(env, name, config.policy)
    options = {"host": config.host, "port": config.port, "seed": config.seed}
    with Viewer(env, policies, speed=config.speed, fps=config.fps, **options) as viewer:
        if not config.policy and "scripted" not in policies:
            viewer.panel.take_over()
        print(f"{name} at {viewer.url}; Ctrl-C ends it", flush=True)
        viewer.run(config.seconds)
    return 0


def drivers(env: Any, name: str, asked: str) -> dict[str, Policy]:
    """Who can act in an environment besides the user, who was asked for first; each is made when it first acts."""
    rules = list(RULES.get(name) or env.policies)
    names = [*([INVERSE] if can_be_steered(env) else []), "cem" if env.action_size else "opd", *UNLEARNED]
    names = [*([asked] if asked else []), *sorted(rules, key=lambda rule: rule != "scripted"), *names]
    found: dict[str, Policy] = {each: Late(functools.partial(make_driver, env, name, each)) for each in names}
    if asked and asked not in CONFIGS:
        found[asked] = demonstrator(env, name, asked)  # what is wrong with it is told before anything is shown
    return found


def can_be_steered(env: Any) -> bool:
    """Whether there is a point that inverse control can bring to a goal."""
    return isinstance(env, Steerable) and env.goal_points() is not None


def make_driver(env: Any, name: str, driver: str) -> Policy:
    """A policy by its name; planners think for as long as makes them bearable to watch."""
    if driver not in CONFIGS:
        return demonstrator(env, name, driver)
    kind = CONFIGS[driver]
    short = {"horizon": 10, "population": 32, "seed": 0} if issubclass(kind, SequencesConfig) else {}
    return PlannerPolicy(env, kind(seconds=THOUGHT, **short))


class Late:
    """A policy that is made when it first acts.

    Args:
        make: Makes it.
    """

    def __init__(self, make: Callable[[], Policy]) -> None:
        self._make = make
        self._made: Policy | None = None

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act as it does."""
        self._made = self._made or self._make()
        return self._made(tensordict)


def play(path: str, arguments: list[str]) -> int:
    """Show what was recorded; of a run or a plan an episode is recorded first. Returns the exit code."""
    config, of_env = verbs.playing(path, arguments)
    if Path(path).suffix == verbs.RECORDING:
        trajectory = Trajectory.load(path)
    else:
        device = registry.check_device(config.device)
        episode = verbs.ExportConfig(run=path, worlds=config.worlds, contacts=True, seed=config.seed, device=device)
        trajectory = shown.record(episode, of_env, stress=True)[1]
    options = {"host": config.host, "port": config.port}
    with Player(trajectory, speed=config.speed, fps=config.fps, **options) as player:
        print(f"{trajectory.name}, {trajectory.frame_count} frames, at {player.url}; Ctrl-C ends it", flush=True)
        player.run(config.seconds)
    return 0
