"""``softwarp record``: demonstrations of a hand-written or trained policy, for behaviour cloning."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import MISSING

from softwarp.control import InversePolicy
from softwarp.envs import registry
from softwarp.io.atomic import prove_writable
from softwarp.policies.baselines import scripted
from softwarp.policies.baselines.scripted import Policy
from softwarp.policies.baselines.table import rule
from softwarp.policies.policy import Spaces
from softwarp.ranges import Seed, check_fields
from softwarp.training.checkpoints import CheckpointError, build_policy, load_policy
from softwarp.training.datasets import record_transitions, to_minari
from softwarp.training.demonstrations import record

from .config import compose, make_env_config

INVERSE = "inverse"  # name of inverse control among the policies
UNLEARNED = {"random": scripted.random, "nothing": scripted.nothing}  # of every environment
MINARI = "minari:"  # begins the name of a data set


@dataclass
class RecordConfig:
    """Settings of ``softwarp record``."""

    env: Any = MISSING  # group env: ``name`` and the options of that environment
    policy: str = "scripted"  # name of a hand-written policy, "inverse", or a run folder or checkpoint
    out: str = ""  # archive to write, .npz, or minari: and the name of a data set
    episodes: int = 100
    noise: float = 0.1  # part of the steps at which a random action is carried out instead of the policy's
    num_worlds: int = 50  # that step together
    seed: Seed = 3_000_017  # of starts and goals
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_fields(self, "record")
        for name in ("episodes", "num_worlds"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: must be at least 1, got {getattr(self, name)}")
        if not 0.0 <= self.noise < 1.0:
            raise ValueError(f"noise: must lie in [0, 1), got {self.noise:g}")


def main(arguments: list[str], given: dict[str, Any]) -> int:
    """Record as the overrides say; returns the exit code.

    Args:
        arguments: Hydra overrides of RecordConfig, for example ``["env=cart_stem", "episodes=200"]``.
        given: Fields of RecordConfig from the command line, taken literally.
    """
    config: RecordConfig = dataclasses.replace(compose("record", RecordConfig, arguments), **given)
    dataset = config.out.removeprefix(MINARI) if config.out.startswith(MINARI) else None
    if dataset is None:
        if Path(config.out).suffix != ".npz":
            raise ValueError(f"out={config.out}: demonstrations need the ending .npz")
        prove_writable(config.out)
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
