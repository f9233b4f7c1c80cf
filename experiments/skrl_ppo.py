"""skrl's PPO on a batched softwarp environment. Needs the extra ``skrl``.

    python -m experiments.skrl_ppo softwarp/CartStem-v0 --steps 200000 --gamma 0.99

skrl wraps Gymnasium's vector environments as they are and takes them for resetting themselves within the step.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import CategoricalMixin, DeterministicMixin, GaussianMixin, Model
from skrl.resources.preprocessors.torch import RunningStandardScaler
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from torch import Tensor, nn

import softwarp.gym  # noqa: F401 - registers the ids

MINIBATCHES = 4


def network(inputs: int, outputs: int) -> nn.Sequential:
    """Two hidden layers of 64."""
    return nn.Sequential(nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs))


class Choice(CategoricalMixin, Model):
    """Policy of discrete actions."""

    def __init__(self, **spaces: Any) -> None:
        Model.__init__(self, **spaces)
        CategoricalMixin.__init__(self)
        self.net = network(self.num_observations, self.num_actions)

    def compute(self, inputs: dict[str, Tensor], role: str) -> tuple[Tensor, dict[str, Any]]:
        """Logits."""
        return self.net(inputs["observations"]), {}


class Normal(GaussianMixin, Model):
    """Policy of continuous actions, clipped to their space."""

    def __init__(self, **spaces: Any) -> None:
        Model.__init__(self, **spaces)
        GaussianMixin.__init__(self, clip_actions=True)
        self.net = network(self.num_observations, self.num_actions)
        self.log_std = nn.Parameter(torch.full((self.num_actions,), -0.7))

    def compute(self, inputs: dict[str, Tensor], role: str) -> tuple[Tensor, dict[str, Any]]:
        """Mean and standard deviation."""
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    """Expected return."""

    def __init__(self, **spaces: Any) -> None:
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.net = network(self.num_observations, 1)

    def compute(self, inputs: dict[str, Tensor], role: str) -> tuple[Tensor, dict[str, Any]]:
        """Shape (n, 1)."""
        return self.net(inputs["observations"]), {}


def train(args: argparse.Namespace) -> int:
    """Train for ``args.steps`` environment steps or one update more; returns how many were taken."""
    set_seed(args.seed)
    watched = RecordEpisodeStatistics(gymnasium.make_vec(args.id, num_envs=args.worlds))
    env = wrap_env(watched, wrapper="gymnasium")
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space, "device": env.device}
    is_discrete = isinstance(env.action_space, gymnasium.spaces.Discrete)
    models = {"policy": (Choice if is_discrete else Normal)(**spaces), "value": Value(**spaces)}
    config = PPO_CFG(
        rollouts=args.horizon,
        learning_epochs=5,
        mini_batches=MINIBATCHES,
        discount_factor=args.gamma,
        learning_rate=args.learning_rate,
        observation_preprocessor=RunningStandardScaler,
        observation_preprocessor_kwargs={"size": env.observation_space, "device": env.device},
        value_preprocessor=RunningStandardScaler,
        value_preprocessor_kwargs={"size": 1, "device": env.device},
        value_loss_scale=1.0,
    )
    config.experiment.write_interval = config.experiment.checkpoint_interval = 0  # no files
    memory = RandomMemory(memory_size=args.horizon, num_envs=env.num_envs, device=env.device)
    agent = PPO(models=models, memory=memory, cfg=config, **spaces)
    rows = args.horizon * max(1, -(-args.steps // (args.horizon * args.worlds)))
    quiet = {"headless": True, "disable_progressbar": True, "close_environment_at_exit": False}
    trainer = SequentialTrainer(env=env, agents=agent, cfg={"timesteps": rows} | quiet)
    begun = time.perf_counter()
    trainer.train()
    steps, seconds = rows * args.worlds, time.perf_counter() - begun
    returned = f", return {np.mean(watched.return_queue):.2f}" if watched.return_queue else ""  # of the last 100
    env.close()
    print(f"{steps} steps in {seconds:.1f} s, {steps / seconds:.0f} steps/s{returned}")
    return steps


def main(argv: Sequence[str] | None = None) -> int:
    """Read the command line and train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("id", nargs="?", default="softwarp/CartStem-v0", help="Gymnasium id")
    parser.add_argument("--steps", type=int, default=200_000, help="environment steps over all worlds")
    parser.add_argument("--worlds", type=int, default=64, help="worlds that step together")
    parser.add_argument("--horizon", type=int, default=32, help="steps per world between updates")
    parser.add_argument("--gamma", type=float, default=0.99, help="discount")
    parser.add_argument("--learning-rate", type=float, default=1e-3)
    parser.add_argument("--seed", type=int, default=0)
    return train(parser.parse_args(argv))


if __name__ == "__main__":
    main()
