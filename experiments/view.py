"""``softwarp view``: an environment live in the browser, or a recording, a plan or a test episode of a run there."""

from pathlib import Path

from softwarp.envs import registry
from softwarp.io.trajectory import Trajectory
from softwarp.policies.baselines import scripted
from softwarp.policies.baselines.table import RULES
from softwarp.policies.policy import Spaces
from softwarp.view import HAND, Player, Viewer

from . import shown, verbs
from .config import make_env_config
from .record import demonstrator


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
    rules = list(RULES.get(name) or env.policies)
    driver = config.policy or ("scripted" if "scripted" in rules else HAND)
    policies = {} if driver == HAND else {driver: demonstrator(env, name, driver)}
    policies.setdefault("random", scripted.random(Spaces.of(env)))
    options = {"host": config.host, "port": config.port, "seed": config.seed}
    with Viewer(env, policies, speed=config.speed, fps=config.fps, **options) as viewer:
        print(f"{name} at {viewer.url}; Ctrl-C ends it", flush=True)
        viewer.run(config.seconds)
    return 0


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
