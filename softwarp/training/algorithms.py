"""The table of algorithms: name -> settings and class. AVEC is a setting of all (``critic_bias``)."""

from typing import Any

from softwarp.policies.options import NetworkConfig
from softwarp.training.algorithm import Algorithm
from softwarp.training.options import CONFIGS, AlgorithmConfig
from softwarp.training.options import config_class as config_class
from softwarp.training.ppo import PPO
from softwarp.training.ranks import ALONE, Ranks
from softwarp.training.sac import SAC
from softwarp.training.shac import SHAC

ALGORITHMS: dict[str, tuple[type[AlgorithmConfig], Any]] = {
    name: (CONFIGS[name], kind) for name, kind in {"ppo": PPO, "sac": SAC, "shac": SHAC}.items()
}


def make_algorithm(env: Any, network: NetworkConfig, config: AlgorithmConfig, ranks: Ranks = ALONE) -> Algorithm:
    """The algorithm whose settings ``config`` holds, on ``env``; all ranks begin with the networks of rank 0."""
    algorithm: Algorithm = ALGORITHMS[config.name][1](env, network, config, ranks)
    ranks.follow(algorithm.shared())
    return algorithm
