"""``softwarp plan``: search for a plan, carry it out, and write it down; or carry a saved plan out again."""

import dataclasses
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from statistics import mean, median
from typing import Any

from omegaconf import OmegaConf

from softwarp.envs import registry
from softwarp.envs.tasks.tubes import TubeTask
from softwarp.io.atomic import write_text
from softwarp.planning import picture, plans
from softwarp.planning.env_model import EnvModel, choice_count
from softwarp.planning.execution import Execution, execute
from softwarp.planning.planners import make_planner, pool_size
from softwarp.planning.sequences import SequencesConfig
from softwarp.training.logs import ProgressLine

from . import verbs
from .config import compose, make_env_config
from .verbs import PlanConfig


@dataclass(frozen=True)
class Outcome:
    """One episode."""

    success: bool
    steps: int
    distance: float  # m, at the end; NaN if nothing was carried out
    seconds: float  # spent planning
    transitions: int  # actions that the planner's worlds took
    plans: int
    force: float | None = None  # N, the largest sum of forces on a wall; None where the task measures none


def main(arguments: list[str], replay: str | None = None) -> int:
    """Plan as the overrides say, or carry a saved plan out; returns the exit code.

    Args:
        arguments: Hydra overrides of PlanConfig, for example ``["env=cart_stem_contact", "planner=cem"]``.
        replay: Plan file to carry out instead; ``device=...`` is the only setting then.
    """
    if replay is not None:
        return check_replay(replay, arguments)
    config = verbs.planning(arguments)
    for preset in verbs.preset_of(arguments):
        print(f"{preset}: settings that suit environment and planner; preset=none takes the defaults")
    config.devices = [registry.check_device(device) for device in config.devices or [config.device]]
    config.device = config.devices[0]
    name = config.env["name"]
    env = make_env(config, arguments)
    model, planner = make_model(env, config), make_planner(config.planner)
    settings = dataclasses.asdict(config.planner) | dataclasses.asdict(config.model)
    line = ProgressLine(enabled=config.progress)
    outcomes = []
    try:
        for episode in range(config.episodes):
            env.reset()
            start = env.snapshot(0)
            done = execute(env, model, planner, replan=config.replan, progress=show(line, episode, config.episodes))
            outcomes.append(outcome(done, env))
            if episode == 0:
                first = plans.write_down(
                    done.searches[0], model, settings, start=start, done=(done.actions, done.steps)
                )
                write_first(first, config)
            if config.summary:  # after each: an interrupted run has what it came to
                told = {"env": first.env, "planner": settings, "episodes": [dataclasses.asdict(o) for o in outcomes]}
                write_text(config.summary, json.dumps(plain(told), indent=1) + "\n")
    finally:
        line.close()
    print(report(name, config, outcomes, model))
    return 0


def describe(arguments: list[str]) -> str:
    """All settings with their values, as YAML."""
    return OmegaConf.to_yaml(
        OmegaConf.create(dataclasses.asdict(compose("plan", PlanConfig, [*verbs.preset_of(arguments), *arguments])))
    )


def write_first(plan: plans.Plan, config: PlanConfig) -> None:
    """The files of the first episode."""
    if config.out:
        plan.save(config.out)
    if config.picture:
        picture.draw(plan, config.picture)


def make_env(config: PlanConfig, arguments: list[str]) -> Any:
    """The environment; with discrete actions if a planner of trees would have too many commands to choose from.

    That is, where the environment has such actions and no setting asks for others.
    """
    name, env_config = make_env_config(config.env)
    env = registry.make(name, seed=config.seed, device=config.device, config=exact(env_config, config.device))
    is_asked = any(argument.startswith(("env.action_kind=", "model.levels=")) for argument in arguments)
    has_kinds = hasattr(env_config, "action_kind") and not is_asked
    if isinstance(config.planner, SequencesConfig) or choice_count(env, config.model.levels) or not has_kinds:
        return env
    env_config = dataclasses.replace(env.config, action_kind="discrete")
    print(f"{name}: env.action_kind=discrete, as {config.planner.name} chooses from a list of actions")
    return registry.make(name, seed=config.seed, device=config.device, config=env_config)


def exact(env_config: Any, device: str) -> Any:
    """On a CPU the one world runs on the path of the planner's many, so that predictions hold to the bit."""
    is_free = env_config.solver_path == "auto" and env_config.precision == "float32"
    return dataclasses.replace(env_config, solver_path="lanes") if is_free and device == "cpu" else env_config


def make_model(env: Any, config: PlanConfig) -> EnvModel:
    """The planner's pool, of the size of its rounds unless the settings give one."""
    count = choice_count(env, config.model.levels)
    worlds = config.num_worlds or pool_size(config.planner, count)
    return EnvModel(env, config.model, worlds=worlds, devices=config.devices)


def show(line: ProgressLine, episode: int, episodes: int) -> Callable[[float, str], None]:
    """Progress of one of the searches on the line of all."""

    def progress(part: float, text: str) -> None:
        line.show((episode + part) / episodes, f"episode {episode + 1}/{episodes}  {text}" if episodes > 1 else text)

    return progress


def outcome(done: Execution, env: Any) -> Outcome:
    """What counts of an episode that has been carried out in the one world of an environment."""
    distance = done.steps[-1].distance if done.steps else math.nan
    transitions = sum(search.transitions for search in done.searches)
    force = float(env.peak_force) if isinstance(env, TubeTask) else None
    return Outcome(done.success, len(done.steps), distance, done.seconds, transitions, len(done.searches), force)


def report(name: str, config: PlanConfig, outcomes: list[Outcome], model: EnvModel) -> str:
    """A few lines on all episodes."""
    count, met = len(outcomes), sum(entry.success for entry in outcomes)
    seconds = [entry.seconds for entry in outcomes]
    distances = [1e3 * entry.distance for entry in outcomes]
    forces = [entry.force for entry in outcomes if entry.force is not None]
    borne = [f"  force on the wall    median {median(forces):.2f} N, largest {max(forces):.2f} N"] if forces else []
    return "\n".join(
        (
            f"{config.planner.name} on {name}: goal met in {met} of {count} episodes ({100.0 * met / count:.0f} %)",
            f"  distance at the end  mean {mean(distances):.2f} mm, median {median(distances):.2f} mm",
            f"  planning             mean {mean(seconds):.2f} s, longest {max(seconds):.2f} s, "
            f"{mean(entry.transitions for entry in outcomes):.0f} model steps, "
            f"{mean(entry.plans for entry in outcomes):.1f} plans per episode",
            *borne,
            f"  pool                 {model.worlds} worlds, {model.state_bytes} bytes per kept state",
        )
    )


def check_replay(path: str, arguments: list[str]) -> int:
    """Carry a plan out and compare every state with the prediction; exit code 1 where one differs."""
    device = registry.check_device(verbs.replaying(path, arguments))
    plan = plans.Plan.load(path)
    steps = plans.replay(plan, device=device)
    differing = [i for i, (old, new) in enumerate(zip(plan.steps, steps, strict=False)) if old.state != new.state]
    end = f"goal {'met' if steps and steps[-1].success else 'not met'} after {len(steps)} steps"
    if len(steps) == len(plan.steps) and not differing:
        print(f"{path}: {end}; all states are those of the plan, to the bit")
        return 0
    first = f"state {differing[0] + 1} is the first that differs" if differing else "the episode ended elsewhere"
    print(f"{path}: {end}; {first} from the plan, which was made with other hardware, options or versions")
    return 1


def plain(value: Any) -> Any:
    """Numbers that JSON lacks as text or null."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
