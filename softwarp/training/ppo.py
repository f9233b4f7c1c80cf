"""Proximal policy optimisation (Schulman et al. 2017) on a batched environment.

One update: roll the policy out for T steps in B worlds, estimate advantages, then a few epochs of minibatches of

    L = -mean min(rho A, clip(rho, 1 - eps, 1 + eps) A) + c_v L_V - c_e H,    rho = pi(a|s) / pi_old(a|s)
    L_V = Var(V - R) + beta mean(V - R)^2,    beta = 1: mean squared error, beta = 0: AVEC

with A from GAE: delta = r + gamma (1 - terminated) V(s') - V(s), A = delta + gamma lambda (1 - done) A'. A truncated
episode therefore bootstraps from the value of its last observation, a terminated one does not, and neither leaks into
the next. With ``bootstrap=False`` both are over: so for a task that is a walk of some actions and nothing after it.
Observations and value targets are scaled by running statistics; the observation statistics are updated once per batch,
after the epochs, so that rho compares policies that see the same input.

Of several ranks each has its part of every minibatch; statistics, and what decides on further epochs and on the
learning rate, are those of all.

A recurrent policy learns on whole sequences: a minibatch is some of the worlds, the LSTM starts from the memory that
the rollout kept and is cleared where an episode begins. What actor and critic have in common, memory and shared layers,
stands still with the actor while the critic is fitted alone.
"""

from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from softwarp.policies.actor_critic import ActorCritic
from softwarp.policies.policy import NetworkConfig, Spaces
from softwarp.training.algorithm import Algorithm, recentre, shift_output
from softwarp.training.options import PPOConfig
from softwarp.training.ranks import ALONE, Ranks

ADAPTIVE_BOUNDS = (1e-5, 1e-2)  # learning rates that the adaptive schedule stays within


class ResidualPPOLoss(ClipPPOLoss):
    """TorchRL's loss with the critic's error split into its variance and its mean."""

    critic_bias: float = 1.0
    ranks: Ranks = ALONE

    def _critic_loss_inputs(
        self, target_return: Tensor, state_value: Tensor, old_state_value: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        values, targets = state_value.flatten(), target_return.flatten()
        target = recentre(values, targets, self.critic_bias, mean_of=self.ranks.mean).view_as(target_return)
        return target, state_value, old_state_value


@dataclass
class Lesson:
    """How far learning from a batch has come."""

    data: TensorDictBase
    epochs: int = 0  # that are over
    order: Tensor | None = None  # of the data in the present epoch
    chunk: int = 0  # minibatches of it that are over
    divergence: Tensor = field(default_factory=lambda: torch.zeros(()))
    batches: int = 0
    sums: dict[str, Tensor] = field(default_factory=dict)  # of the numbers for the log, over batches


class PPO(Algorithm):
    """Policy, optimiser and rollout of one training run."""

    metrics = (
        *("loss_objective", "loss_critic", "entropy", "kl", "clip_fraction", "explained_variance"),
        *("grad_norm", "epochs", "learning_rate", "action_std"),
    )
    own = ("rollout", "lesson")
    config: PPOConfig
    policy: ActorCritic

    def __init__(self, env: Any, network: NetworkConfig, config: PPOConfig, ranks: Ranks = ALONE) -> None:
        super().__init__(env, ActorCritic(Spaces.of(env), network).to(env.device or "cpu"), config, ranks)
        self.advantage = GAE(gamma=config.gamma, lmbda=config.gae_lambda, value_network=None)
        self.loss = ResidualPPOLoss(
            self.policy.actor,
            self.policy.critic,
            clip_epsilon=config.clip,
            entropy_bonus=True,
            entropy_coeff=config.entropy,
            critic_coeff=config.value,
            loss_critic_type="l2",
        )
        self.loss.critic_bias, self.loss.ranks = config.critic_bias, ranks
        self.loss.set_keys(sample_log_prob="action_log_prob")
        self.parameters = list(self.policy.parameters())
        self.optimizer = torch.optim.Adam(self.parameters, lr=config.learning_rate, eps=1e-5)
        self.updates = 0
        self.lesson: Lesson | None = None  # that was left half way

    @property
    def is_learning(self) -> bool:
        """Whether the last update was left while it learned."""
        return self.lesson is not None

    @property
    def is_warming(self) -> bool:
        """Whether the critic is fitted alone; the policy stands still then, which says nothing of the learning rate."""
        return self.updates < self.config.warmup_updates

    @torch.no_grad()
    def collect(self) -> TensorDictBase:
        """Transitions (B, T) with scaled observations, advantages and value targets.

        The first batch of a run only sets the scale of the observations.
        """
        norm = self.policy.observation_norm
        if norm.count == 0:
            norm.update(self.rollout.collect()["observation"], self.ranks.gather)
        return self.prepare(self.rollout.collect())

    @torch.no_grad()
    def prepare(self, batch: TensorDictBase) -> TensorDictBase:
        """What is learned from, made of a rollout (B, T)."""
        policy = self.policy
        if self.config.scale_rewards:
            batch["next", "reward"] *= self.rollout.reward_scale
        batch["state_value"] = policy.value(batch["observation"], batch.get("memory", None))
        batch["next", "state_value"] = policy.value(batch["next", "observation"], batch["next"].get("memory", None))
        if not self.config.bootstrap:
            batch["next", "terminated"] = batch["next", "done"].clone()
        self.advantage(batch)
        policy.value_norm.update(batch["value_target"], self.ranks.gather)
        advantage = batch["advantage"]
        mean, spread = self.ranks.mean_and_spread(advantage)
        data = {
            "raw": batch["observation"].clone(),
            "observation": policy.observation_norm(batch["observation"]),
            "action": batch["action"],
            "action_log_prob": batch["action_log_prob"],
            "advantage": (advantage - mean) / spread.clamp_min(1e-6),
            "value_target": policy.value_norm(batch["value_target"]),
        }
        if policy.memory is None:
            return TensorDict(data, batch.shape, device=self.device).reshape(-1)
        done = batch["next", "done"].squeeze(-1)
        data["is_first"] = torch.cat((torch.zeros_like(done[:, :1]), done[:, :-1]), dim=1)
        data["memory"] = batch["memory"].clone()
        return TensorDict(data, batch.shape, device=self.device)

    def _with_features(self, data: TensorDictBase) -> TensorDictBase:
        """What the losses see: features in place of scaled observations, sequences laid end to end."""
        policy = self.policy
        if policy.memory is None and policy.shared is None:
            return data
        if policy.memory is None:
            features = policy.digest(data["observation"])
        else:
            features = policy.features_along(data["observation"], data["memory"][:, 0], data["is_first"])
        if self.is_warming:
            features = features.detach()
        data = data.select("action", "action_log_prob", "advantage", "value_target")
        return data.set("observation", features).reshape(-1)

    def learn(self, data: TensorDictBase | None) -> dict[str, float]:
        """Epochs of minibatches, then new statistics of the observations."""
        if data is not None:
            self.lesson = Lesson(data)
        assert self.lesson is not None
        data = self.lesson.data
        metrics = self._optimise(self.lesson)
        self.lesson = None
        if self.config.critic_bias < 1.0 and self.config.shift_critic:
            with torch.no_grad():
                seen = self._with_features(data)
                error = seen["value_target"] - self.policy.critic.module(seen["observation"])
                shift_output(self.policy.critic, self.ranks.mean(error.mean()))
        self.policy.observation_norm.update(data["raw"], self.ranks.gather)
        self.updates += 1
        return metrics

    def _optimise(self, lesson: "Lesson") -> dict[str, float]:
        """Epochs of minibatches; stops early where the policy has moved far enough."""
        data, sums = lesson.data, lesson.sums
        while lesson.epochs < self.config.epochs:
            if lesson.order is None:
                lesson.order = torch.randperm(len(data), device=data.device)
                lesson.chunk, lesson.divergence = 0, torch.zeros((), device=data.device)
            chunks = [chunk for chunk in lesson.order.tensor_split(self.config.minibatches) if len(chunk)]
            for indices in chunks[lesson.chunk :]:
                told = self._step(self._with_features(data[indices]))
                lesson.batches += 1
                lesson.chunk += 1
                lesson.divergence += told["kl"] / len(chunks)
                for key, number in told.items():
                    sums[key] = sums.get(key, torch.zeros((), device=data.device)) + number
                self.pulse()
            lesson.order = None
            lesson.epochs += 1
            if not self.is_warming and self._has_moved_enough(float(lesson.divergence)):
                break
        metrics = {key: float(total) / lesson.batches for key, total in sums.items()}
        metrics |= {"epochs": float(lesson.epochs), "learning_rate": self.learning_rate}
        if not self.policy.spaces.is_discrete:
            metrics["action_std"] = float(self.policy.actor[0].module.log_std.detach().exp().mean())
        return metrics

    def _step(self, data: TensorDictBase) -> dict[str, Tensor]:
        """One step of the optimiser; numbers for the log."""
        told = self.differentiate(data)
        norm = nn.utils.clip_grad_norm_(self.parameters, self.config.max_grad_norm)
        self.optimizer.step()
        return told | {"grad_norm": norm}

    def differentiate(self, data: TensorDictBase) -> dict[str, Tensor]:
        """Gradient of the loss of a minibatch, of which every rank has a part; numbers for the log."""
        result = self.loss(data)
        self.optimizer.zero_grad()
        total = result["loss_critic"]
        if not self.is_warming:
            total = total + result["loss_objective"] + result["loss_entropy"]
        total.backward()
        names = ("loss_objective", "loss_critic", "entropy", "clip_fraction", "explained_variance")
        told = {name: result[name].detach().squeeze() for name in names}
        kl = result["mean_ratio"] - 1.0 + result["kl_approx"]  # mean (rho - 1 - log rho), never negative
        return self.average(self.parameters, told | {"kl": kl})

    def _has_moved_enough(self, divergence: float) -> bool:
        """Whether to end the epochs; with the adaptive schedule, correct the learning rate instead."""
        target = self.config.target_kl
        if self.config.schedule != "adaptive":
            return 0.0 < 1.5 * target < divergence
        rate = self.learning_rate
        if divergence > 2.0 * target:
            rate /= 1.5
        elif divergence < 0.5 * target:
            rate *= 1.5
        self.set_learning_rate(self.ranks.told(min(max(rate, ADAPTIVE_BOUNDS[0]), ADAPTIVE_BOUNDS[1])))
        return False

    def state_dict(self) -> dict[str, Any]:
        """All that the next update depends on, but for the random generators."""
        lesson = {} if self.lesson is None else vars(self.lesson) | {"data": self.lesson.data.to_dict()}
        return {**super().state_dict(), "updates": self.updates, "lesson": lesson}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where :meth:`state_dict` was taken."""
        super().load_state_dict(state)
        self.updates = state["updates"]
        left = state.get("lesson")
        if left:
            shape = left["data"]["action_log_prob"].shape
            moved = {key: part.to(self.device) for key, part in left.items() if isinstance(part, Tensor)}
            sums = {key: part.to(self.device) for key, part in left["sums"].items()}
            data = TensorDict(left["data"], shape, device=self.device)
            self.lesson = Lesson(**left | moved | {"data": data, "sums": sums})

    def regroup(self, state: dict[str, Any], *, is_new: bool) -> None:
        """Continue what other ranks, of another number, have saved; an update that they had begun is begun anew."""
        super().regroup({**state, "lesson": {}}, is_new=is_new)
