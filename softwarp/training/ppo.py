"""Proximal policy optimisation (Schulman et al. 2017) on a batched environment.

One update: roll the policy out for T steps in B worlds, estimate advantages, then a few epochs of minibatches of

    L = -mean min(rho A, clip(rho, 1 - eps, 1 + eps) A) + c_v mean (V - R)^2 - c_e H,    rho = pi(a|s) / pi_old(a|s)

with A from GAE: delta = r + gamma (1 - terminated) V(s') - V(s), A = delta + gamma lambda (1 - done) A'. A truncated
episode therefore bootstraps from the value of its last observation, a terminated one does not, and neither leaks into
the next. Observations and value targets are scaled by running statistics; the observation statistics are updated once
per batch, after the epochs, so that rho compares policies that see the same input.
"""

import math
from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from softwarp.policies.actor_critic import ActorCritic, NetworkConfig, Spaces
from softwarp.training.rollout import Rollout

SCHEDULES = ("constant", "linear", "adaptive")
ADAPTIVE_BOUNDS = (1e-5, 1e-2)  # learning rates that the adaptive schedule stays within
FINAL_RATE = 0.05  # of the first learning rate, where the linear schedule ends


@dataclass
class PPOConfig:
    """Settings of PPO."""

    horizon: int = 32  # steps per world and update, T
    epochs: int = 8
    minibatches: int = 4
    learning_rate: float = 1e-3
    schedule: str = "linear"  # constant; linear: falls over the run; adaptive: keeps the KL divergence near target_kl
    target_kl: float = 0.02  # per update; epochs stop at 1.5 times this; 0: never
    gamma: float = 0.95
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy: float = 0.0  # weight c_e
    value: float = 0.5  # weight c_v
    max_grad_norm: float = 1.0
    stagger: bool = True  # cut each world's first episode at random, so that resets are spread over time

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        for name in ("horizon", "epochs", "minibatches"):
            if getattr(self, name) < 1:
                raise ValueError(f"algo.{name}: must be at least 1, got {getattr(self, name)}")
        for name in ("learning_rate", "clip", "max_grad_norm"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise ValueError(f"algo.{name}: must be positive, got {getattr(self, name):g}")
        for name in ("gamma", "gae_lambda"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"algo.{name}: must lie in [0, 1], got {getattr(self, name):g}")
        for name in ("target_kl", "entropy", "value"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"algo.{name}: must not be negative, got {getattr(self, name):g}")
        if self.schedule not in SCHEDULES:
            raise ValueError(f"algo.schedule: {self.schedule!r} is unknown; choose from {', '.join(SCHEDULES)}")
        if self.schedule == "adaptive" and self.target_kl == 0.0:
            raise ValueError("algo.schedule: adaptive needs algo.target_kl > 0")


class PPO:
    """Policy, optimiser and rollout of one training run."""

    def __init__(self, env: Any, network: NetworkConfig, config: PPOConfig) -> None:
        self.config = config
        self.policy = ActorCritic(Spaces.of(env), network).to(env.device or "cpu")
        self.rollout = Rollout(env, self.policy, config.horizon, stagger=config.stagger)
        self.advantage = GAE(gamma=config.gamma, lmbda=config.gae_lambda, value_network=None)
        self.loss = ClipPPOLoss(
            self.policy.actor,
            self.policy.critic,
            clip_epsilon=config.clip,
            entropy_bonus=True,
            entropy_coeff=config.entropy,
            critic_coeff=config.value,
            loss_critic_type="l2",
        )
        self.loss.set_keys(sample_log_prob="action_log_prob")
        self.parameters = [*self.policy.actor.parameters(), *self.policy.critic.parameters()]
        self.optimizer = torch.optim.Adam(self.parameters, lr=config.learning_rate, eps=1e-5)

    def update(self, progress: float) -> dict[str, float]:
        """Collect one batch and learn from it.

        Args:
            progress: Part of the run that is over, in [0, 1]; drives the linear learning-rate schedule.

        Returns:
            Means over the minibatches, by name, for the log.
        """
        if self.policy.observation_norm.count == 0:  # the first batch only sets the scale of the observations
            self.policy.observation_norm.update(self.rollout.collect()["observation"])
        if self.config.schedule == "linear":
            self._set_learning_rate(self.config.learning_rate * (1.0 - (1.0 - FINAL_RATE) * min(progress, 1.0)))
        observation, data = self._collect()
        metrics = self._optimise(data)
        self.policy.observation_norm.update(observation)
        return metrics

    @torch.no_grad()
    def _collect(self) -> tuple[Tensor, TensorDict]:
        """Observations of a rollout, and its transitions (B * T,) scaled for the loss."""
        policy, batch = self.policy, self.rollout.collect()
        batch["state_value"] = policy.value(batch["observation"])
        batch["next", "state_value"] = policy.value(batch["next", "observation"])
        self.advantage(batch)
        flat = batch.reshape(-1)
        policy.value_norm.update(flat["value_target"])
        advantage = flat["advantage"]
        data = {
            "observation": policy.observation_norm(flat["observation"]),
            "action": flat["action"],
            "action_log_prob": flat["action_log_prob"],
            "advantage": (advantage - advantage.mean()) / advantage.std().clamp_min(1e-6),
            "value_target": policy.value_norm(flat["value_target"]),
        }
        return flat["observation"], TensorDict(data, flat.batch_size, device=advantage.device)

    def _optimise(self, data: TensorDict) -> dict[str, float]:
        """Epochs of minibatches; stops early where the policy has moved far enough."""
        sums: defaultdict[str, Tensor] = defaultdict(lambda: torch.zeros((), device=data.device))
        batches = epochs = 0
        for epochs in range(1, self.config.epochs + 1):  # noqa: B007 - counted for the log
            divergence = torch.zeros((), device=data.device)
            chunks = torch.randperm(len(data), device=data.device).tensor_split(self.config.minibatches)
            for indices in chunks:
                result = self.loss(data[indices])
                self.optimizer.zero_grad()
                (result["loss_objective"] + result["loss_critic"] + result["loss_entropy"]).backward()
                norm = nn.utils.clip_grad_norm_(self.parameters, self.config.max_grad_norm)
                self.optimizer.step()
                kl = result["mean_ratio"] - 1.0 + result["kl_approx"]  # mean (rho - 1 - log rho), never negative
                divergence += kl / len(chunks)
                batches += 1
                for key in ("loss_objective", "loss_critic", "entropy", "clip_fraction", "explained_variance"):
                    sums[key] += result[key].detach().squeeze()
                sums["kl"] += kl
                sums["grad_norm"] += norm
            if self._has_moved_enough(float(divergence)):
                break
        metrics = {key: float(total) / batches for key, total in sums.items()}
        metrics |= {"epochs": float(epochs), "learning_rate": self.optimizer.param_groups[0]["lr"]}
        if not self.policy.spaces.is_discrete:
            metrics["action_std"] = float(self.policy.actor[0].module.log_std.detach().exp().mean())
        return metrics

    def _has_moved_enough(self, divergence: float) -> bool:
        """Whether to end the epochs; with the adaptive schedule, correct the learning rate instead."""
        target = self.config.target_kl
        if self.config.schedule != "adaptive":
            return 0.0 < 1.5 * target < divergence
        rate = self.optimizer.param_groups[0]["lr"]
        if divergence > 2.0 * target:
            rate /= 1.5
        elif divergence < 0.5 * target:
            rate *= 1.5
        self._set_learning_rate(min(max(rate, ADAPTIVE_BOUNDS[0]), ADAPTIVE_BOUNDS[1]))
        return False

    def _set_learning_rate(self, rate: float) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = rate

    def state_dict(self) -> dict[str, Any]:
        """All that the next update depends on, but for the random generators."""
        return {
            "policy": self.policy.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "rollout": self.rollout.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where :meth:`state_dict` was taken."""
        self.policy.load_state_dict(state["policy"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.rollout.load_state_dict(state["rollout"])
