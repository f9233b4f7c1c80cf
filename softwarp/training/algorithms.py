"""The table of algorithms: name -> settings and class. AVEC is a setting of both (``critic_bias``)."""

from typing import Any

from softwarp.policies.policy import NetworkConfig
from softwarp.training.algorithm import Algorithm, AlgorithmConfig
from softwarp.training.ppo import PPO, PPOConfig
from softwarp.training.sac import SAC, SACConfig

ALGORITHMS: dict[str, tuple[type[AlgorithmConfig], Any]] = {"ppo": (PPOConfig, PPO), "sac": (SACConfig, SAC)}


def make_algorithm(env: Any, network: NetworkConfig, config: AlgorithmConfig) -> Algorithm:
    """The algorithm whose settings ``config`` holds, on ``env``."""
    algorithm: Algorithm = ALGORITHMS[config.name][1](env, network, config)
    return algorithm


def config_class(name: str) -> type[AlgorithmConfig]:
    """Dataclass of the settings of algorithm ``name``.

    Raises:
        ValueError: If there is no such algorithm.
    """
    if name not in ALGORITHMS:
        raise ValueError(f"algo.name: {name!r} is unknown; choose from {', '.join(ALGORITHMS)}")
    return ALGORITHMS[name][0]
