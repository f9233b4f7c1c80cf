"""``softwarp view``: an environment live in the browser."""

from softwarp.envs import registry
from softwarp.policies.baselines import scripted
from softwarp.policies.baselines.table import RULES
from softwarp.policies.policy import Spaces
from softwarp.view import HAND, Viewer

from . import verbs
from .config import make_env_config
from .record import demonstrator


def main(arguments: list[str]) -> int:
    """Show an environment as the overrides say, until Ctrl-C; returns the exit code.

    Args:
        arguments: Hydra overrides of ViewConfig, for example ``["env=cart_stem", "worlds=4"]``.
    """
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
