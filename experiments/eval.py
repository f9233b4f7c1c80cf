"""``softwarp eval``: whole episodes of a trained policy on unseen goals, beside baselines without learning."""

import dataclasses
import functools
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softwarp.envs import registry
from softwarp.envs.split import SplitEnv
from softwarp.io.atomic import write_text
from softwarp.policies.baselines import scripted
from softwarp.policies.baselines.names import UNLEARNED
from softwarp.policies.baselines.table import RULES
from softwarp.policies.policy import Policy, Spaces
from softwarp.solvers.partition import LANES_FROM
from softwarp.training.checkpoints import CheckpointError, build_policy, load_policy
from softwarp.training.evaluation import run_episodes

from . import verbs
from .config import TrainConfig, make_env_config, restore
from .record import demonstrator
from .train import held_out_env
from .verbs import EvalConfig, PolicyEvalConfig, split

COLUMNS = (  # heading, key of the summary, factor, digits
    ("return", "return", 1.0, 2),
    ("success [%]", "success", 100.0, 0),
    ("median [mm]", "distance", 1e3, 1),
    ("25% [mm]", "distance_p25", 1e3, 1),
    ("75% [mm]", "distance_p75", 1e3, 1),
    ("90% [mm]", "distance_p90", 1e3, 1),
    ("force [N]", "force", 1.0, 2),
    ("most [N]", "force_max", 1.0, 2),
    ("failed [%]", "failed", 100.0, 0),
    ("lost [%]", "lost", 100.0, 0),
)


@dataclass(frozen=True)
class TrainedRun:
    """A policy and the settings it was trained with."""

    policy: Policy
    config: TrainConfig
    steps: int  # environment steps that it was trained for


def load_run(path: str, *, device: str, overrides: list[str]) -> TrainedRun:
    """Read a run folder or a checkpoint.

    Args:
        path: Run folder (its best policy is taken) or checkpoint file.
        device: Where to evaluate.
        overrides: Changes of the environment, such as ``env.youngs=300e3``.

    Raises:
        CheckpointError: If there is no policy to read.
        ConfigError: If an override names nothing.
    """
    content = load_policy(Path(path))
    config = restore(content["config"], overrides)
    config.device = registry.check_device(device)
    steps = content["steps"] if content["kind"] == "policy" else content["counters"]["steps"]
    return TrainedRun(build_policy(content).to(config.device), config, steps)


def check_fit(run: TrainedRun, env: Any) -> Policy:
    """The run's policy.

    Raises:
        CheckpointError: If the changed environment no longer fits it.
    """
    if Spaces.of(env) != run.policy.spaces:
        raise CheckpointError(f"policy: made for {run.policy.spaces}, but this environment has {Spaces.of(env)}")
    return run.policy


def main(arguments: list[str], given: dict[str, Any]) -> int:
    """Evaluate as the overrides say; returns the exit code.

    Args:
        arguments: Hydra overrides of EvalConfig, and of the run's environment (``env.youngs=300e3``).
        given: Fields of EvalConfig from the command line, taken literally. Without ``run`` the settings are those of
            PolicyEvalConfig.
    """
    config = verbs.evaluation(arguments, given)
    config.devices = [registry.check_device(device) for device in config.devices or [config.device]]
    config.device = config.devices[0]  # where policies act
    if isinstance(config, PolicyEvalConfig):
        return untrained(config)
    report(load_run(config.run, device=config.device, overrides=split(arguments)[0]), config)
    return 0


def untrained(config: PolicyEvalConfig) -> int:
    """Evaluate inverse control or a hand-written policy; returns the exit code."""
    options = dict(config.env)
    if "goal_split" in options:
        options["goal_split"] = "eval"
    name, _ = make_env_config(options)

    def make(device: str, worlds: int) -> Any:
        _, env_config = make_env_config(one_path(options, config))
        return registry.make(name, num_worlds=worlds, device=device, seed=config.seed, config=env_config)

    env = together(make, config)
    is_rule = config.policy not in UNLEARNED and not Path(config.policy).exists()  # which looks at its environment
    policy = acting(env, lambda part: demonstrator(part, name, config.policy), is_rule=is_rule)
    summary = run_episodes(env, policy, seed=config.seed, episodes=config.episodes).summary()
    write({"seed": config.seed, "env": options, "policies": {config.policy: summary}}, config.json)
    return 0


def report(run: TrainedRun, config: EvalConfig) -> None:
    """Evaluate, write the JSON file and print the table."""
    summaries = {"trained": evaluate(run.config, functools.partial(check_fit, run), config)}
    if config.baselines:
        summaries |= evaluate_baselines(run.config, config)
    result = {
        "run": config.run,
        "steps": run.steps,
        "seed": config.seed,
        "env": run.config.env,
        "policies": summaries,
    }
    write(result, config.json)


def write(result: dict[str, Any], file: str | None) -> None:
    """Print the table of the policies, or write JSON to a file or to standard output ("-")."""
    text = json.dumps(result, indent=2) + "\n"
    if file == "-":
        sys.stdout.write(text)
        return
    if file is not None:
        write_text(file, text)
    print(table(result["policies"]))


def evaluate(
    config: TrainConfig, policy_of: Callable[[Any], scripted.Policy], settings: EvalConfig, *, is_rule: bool = False
) -> dict[str, float]:
    """Summary of the episodes of the policy that ``policy_of`` makes for the run's environment.

    Args:
        config: Of the run.
        policy_of: Makes the policy.
        settings: Episodes, devices and seed.
        is_rule: Whether the policy looks at its environment, so that each device has one.
    """
    of_env = one_path(config.env, settings)

    def make(device: str, worlds: int) -> Any:
        return held_out_env(dataclasses.replace(config, device=device, env=of_env), num_worlds=worlds)

    env = together(make, settings)
    policy = acting(env, policy_of, is_rule=is_rule)
    return run_episodes(env, policy, seed=settings.seed, episodes=settings.episodes).summary()


def together(make: Callable[[str, int], Any], settings: EvalConfig | PolicyEvalConfig) -> Any:
    """The environment of the episodes, which ``make`` makes for a device and a number of worlds, or for several."""
    worlds = min(settings.episodes, settings.num_worlds)
    if len(settings.devices) < 2:
        return make((settings.devices or [settings.device])[0], worlds)
    return SplitEnv(make, settings.devices, worlds)


def acting(env: Any, policy_of: Callable[[Any], scripted.Policy], *, is_rule: bool) -> scripted.Policy:
    """A policy for an environment on one or several devices."""
    if not isinstance(env, SplitEnv):
        return policy_of(env)
    policy: scripted.Policy = env.split(policy_of) if is_rule else policy_of(env.parts[0])
    return policy


def one_path(options: dict[str, Any], settings: EvalConfig | PolicyEvalConfig) -> dict[str, Any]:
    """Options of an environment with which parts of its worlds on a CPU take the path that all would take together."""
    worlds = min(settings.episodes, settings.num_worlds)
    is_free = options.get("solver_path") == "auto" and options.get("precision") == "float32"
    if len(settings.devices) < 2 or not is_free or set(settings.devices) != {"cpu"}:
        return options
    return {**options, "solver_path": "lanes" if worlds >= LANES_FROM else "scalar"}


def evaluate_baselines(config: TrainConfig, settings: EvalConfig) -> dict[str, dict[str, float]]:
    """Doing nothing, random actions and the hand-written rules, on the same goals.

    Holding still and the rules need actions that change commands, so they run with ``action_kind=continuous``.
    """
    stepwise = config
    if "action_kind" in config.env:
        stepwise = dataclasses.replace(config, env={**config.env, "action_kind": "continuous"})
    summaries = {
        "nothing": evaluate(stepwise, lambda env: scripted.nothing(Spaces.of(env)), settings),
        "random": evaluate(config, lambda env: scripted.random(Spaces.of(env), settings.seed), settings),
    }
    name = config.env["name"]
    for kind, rule in (RULES.get(name) or registry.spec(name).env_class().policies).items():
        summaries[kind] = evaluate(stepwise, rule, settings, is_rule=True)
    return summaries


def table(summaries: dict[str, dict[str, float]]) -> str:
    """Summaries as aligned text, a row per policy."""
    columns = [column for column in COLUMNS if all(column[1] in row for row in summaries.values())]
    rows = [["policy", *(heading for heading, *_ in columns)]]
    for name, summary in summaries.items():
        rows.append([name, *(f"{factor * summary[key]:.{digits}f}" for _, key, factor, digits in columns)])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ([cell.rjust(width) for cell, width in zip(row, widths, strict=True)] for row in rows)
    return "\n".join("  ".join(line) for line in lines)
