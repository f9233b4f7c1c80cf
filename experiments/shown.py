"""What ``softwarp render`` and ``softwarp export`` show: an episode of a policy, a plan carried out, or a recording."""

from collections.abc import Callable
from typing import Any

from tensordict import TensorDict

from softwarp.envs import registry
from softwarp.io.trajectory import Recorder, Trajectory
from softwarp.planning import plans
from softwarp.training.evaluation import run_episodes

from . import verbs
from .config import ConfigError, make_env_config
from .eval import check_fit, load_run
from .record import demonstrator
from .train import held_out_env
from .verbs import PLAN, RECORDING, split


def settings(verb: str, arguments: list[str], given: dict[str, Any]) -> Any:
    """Settings of a verb, and whether its file can be written.

    Args:
        verb: ``"render"`` or ``"export"``; without a run, settings are those of ``<verb>_policy``.
        arguments: Hydra overrides, and of the environment (``env.youngs=300e3``).
        given: Fields from the command line, taken literally.
    """
    config = verbs.film(verb, arguments, given)
    config.device = registry.check_device(config.device)
    return config


def record(config: Any, arguments: list[str], *, stress: bool) -> tuple[Any, Trajectory]:
    """The environment, and one episode in it, a frame per action; a recording has none, and the frames that it has."""
    if config.run.endswith(RECORDING):
        return None, Trajectory.load(config.run)
    if config.run.endswith(PLAN):
        env, play = _planned(config)
    elif config.run:
        env, play = _trained(config, split(arguments)[0])
    else:
        env, play = _untrained(config)
    recorder = Recorder(env.sim, worlds=list(range(env.num_worlds)), stress=stress, contacts=config.contacts)

    def look(_: object) -> None:
        recorder.capture(goal=env.goal_points(), time=recorder.frame_count * env.control_dt)

    play(look)
    return env, recorder.finish()


Play = Callable[
    [Callable[[object], None]], object
]  # carries an episode out, and calls at its start and after each action


def _trained(config: Any, overrides: list[str]) -> tuple[Any, Play]:
    run = load_run(config.run, device=config.device, overrides=overrides)
    env = held_out_env(run.config, num_worlds=config.worlds)
    policy = check_fit(run, env)
    return env, lambda look: run_episodes(env, policy, seed=config.seed, on_step=look)


def _untrained(config: Any) -> tuple[Any, Play]:
    options = dict(config.env)
    if "goal_split" in options:
        options["goal_split"] = "eval"
    name, env_config = make_env_config(options)
    env = registry.make(name, num_worlds=config.worlds, device=config.device, seed=config.seed, config=env_config)
    policy = demonstrator(env, name, config.policy)
    return env, lambda look: run_episodes(env, policy, seed=config.seed, on_step=look)


def _planned(config: Any) -> tuple[Any, Play]:
    if config.worlds != 1:
        raise ConfigError(f"worlds={config.worlds}: a plan is carried out in one world")
    plan = plans.Plan.load(config.run)
    env = plans.make_env(plan.env, device=config.device)
    actions = plans.as_actions(env, plan.actions)

    def play(look: Callable[[object], None]) -> None:
        env.reset()
        env.restore(plan.start, [0])
        look(None)
        for action in actions:
            stepped = env.step(TensorDict({"action": action[None].to(env.device)}, batch_size=env.batch_size))["next"]
            look(stepped)
            if stepped["done"].any():
                break

    return env, play
