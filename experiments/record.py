"""``softwarp record``: demonstrations of a hand-written or trained policy, for behaviour cloning."""

from pathlib import Path
from typing import Any

from softwarp.control import InversePolicy
from softwarp.envs import registry
from softwarp.policies.baselines import scripted
from softwarp.policies.baselines.scripted import Policy
from softwarp.policies.baselines.table import rule
from softwarp.policies.policy import Spaces
from softwarp.training.checkpoints import CheckpointError, build_policy, load_policy
from softwarp.training.datasets import record_transitions, to_minari
from softwarp.training.demonstrations import record

from . import verbs
from .config import make_env_config
from .verbs import INVERSE, MINARI

UNLEARNED = {"random": scripted.random, "nothing": scripted.nothing}  # of every environment


def main(arguments: list[str], given: dict[str, Any]) -> int:
    """Record as the overrides say; returns the exit code.

    Args:
        arguments: Hydra overrides of RecordConfig, for example ``["env=cart_stem", "episodes=200"]``.
        given: Fields of RecordConfig from the command line, taken literally.
    """
    config = verbs.recording(arguments, given)
    config.device = registry.check_device(config.device)
    dataset = config.out.removeprefix(MINARI) if config.out.startswith(MINARI) else None
    name, env_config = make_env_config(config.env)
    worlds = registry.check_num_worlds(min(config.num_worlds, config.episodes))
    env = registry.make(name, num_worlds=worlds, device=config.device, seed=config.seed, config=env_config)
    policy = demonstrator(env, name, config.policy)
    given: dict[str, Any] = {"episodes": config.episodes, "seed": config.seed, "noise": config.noise}
    if dataset is None:
        shown = record(env, policy, settings=config.env, **given)
        shown.save(Path(config.out))
    else:
        done = record_transitions(env, policy, settings=config.env, **given)
        told = f"{name}, policy {config.policy}, noise {config.noise:g}, seed {config.seed}"
        to_minari(done, dataset, description=told)
        shown = done.demonstrations()
    success = float(shown.success.float().mean())
    print(f"{config.out}: {len(shown)} steps of {config.episodes} episodes, success {100.0 * success:.0f}%")
    return 0


def demonstrator(env: Any, name: str, policy: str) -> Policy:
    """Inverse control, random actions, none, a hand-written policy by its name, or a trained one by its folder.

    Raises:
        CheckpointError: If a trained policy is of another environment, or of other spaces.
        ValueError: If there is no such policy.
    """
    if policy == INVERSE:
        return InversePolicy(env)
    if policy in UNLEARNED:
        return UNLEARNED[policy](Spaces.of(env))
    if not Path(policy).exists():
        return rule(env, name, policy)
    content = load_policy(Path(policy))
    if content["config"]["env"]["name"] != name:
        raise CheckpointError(f"policy {policy}: made for {content['config']['env']['name']}, not for {name}")
    trained = build_policy(content)
    if trained.spaces != Spaces.of(env):
        raise CheckpointError(f"policy: made for {trained.spaces}, but this environment has {Spaces.of(env)}")
    return trained.to(env.device)
