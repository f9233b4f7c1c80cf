"""Short-horizon actor-critic (Xu et al. 2022): a policy that learns from gradients of the simulation.

One update: roll the policy out for T steps in B worlds with reparametrised actions u = mean(s) + std eps, and descend

    L = -1/(T B) sum over worlds and pieces [sum_t gamma^t r_t + gamma^k (1 - terminated) V'(s_k)]

where a piece ends with its episode or with the rollout, k steps after it began. The gradient runs through rewards,
dynamics and observations to all earlier actions of the piece; V' is a slow copy of the critic, which makes up for what
comes later and keeps the horizon short. Then the critic is fitted to TD(lambda) targets by V' in a few epochs of
minibatches:

    G_t = r_t + gamma (1 - terminated) [(1 - lambda) V'(s_t+1) + lambda G_t+1],   V'(s_t+1) alone where a piece ends

and V' moves by a part of the way to it. Statistics of the observations are updated once per rollout, at its end.

Actions are clipped to [-1, 1] as PPO's are, and policies are of the same kind; beyond the limits the gradient passes
where it leads back inside. Of several ranks each has worlds of its own; gradients and statistics are those of all.

Reference: J. Xu, V. Makoviychuk, Y. Narang, F. Ramos, W. Matusik, A. Garg, M. Macklin (2022), Accelerated Policy
Learning with Parallel Differentiable Simulation.
"""

import copy
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from softwarp.envs.gradients import require_gradient
from softwarp.policies.actor_critic import ActorCritic
from softwarp.policies.policy import NetworkConfig, Spaces
from softwarp.training.algorithm import Algorithm, recentre, shift_output
from softwarp.training.gradient_rollout import GradientRollout, Window
from softwarp.training.options import SHACConfig
from softwarp.training.ranks import ALONE, Ranks

BETAS = (0.7, 0.95)  # of Adam, the paper's: gradients of a short horizon have little noise


@dataclass
class Lesson:
    """How far fitting the critic to a rollout has come."""

    data: TensorDictBase
    told: dict[str, float]  # of the actor, for the log
    epochs: int = 0  # that are over
    order: Tensor | None = None  # of the data in the present epoch
    chunk: int = 0  # minibatches of it that are over
    batches: int = 0
    sums: dict[str, Tensor] = field(default_factory=dict)  # of the numbers for the log, over batches


class SHAC(Algorithm):
    """Policy, slow critic, optimiser and rollout of one training run."""

    metrics = ("loss_actor", "loss_critic", "value", "grad_norm", "learning_rate", "action_std")
    own = ("rollout", "lesson")
    rollout_class = GradientRollout
    config: SHACConfig
    policy: ActorCritic
    rollout: GradientRollout

    def __init__(self, env: Any, network: NetworkConfig, config: SHACConfig, ranks: Ranks = ALONE) -> None:
        require_gradient(env)
        for name in ("recurrent", "shared"):
            if getattr(network, name):
                raise ValueError(f"network.{name}: algo=shac has networks of its own, which learn apart; leave it out")
        super().__init__(env, ActorCritic(Spaces.of(env), network).to(env.device or "cpu"), config, ranks)
        self.slow_critic = copy.deepcopy(self.policy.critic).requires_grad_(False)
        self.actor_parameters = list(self.policy.actor.parameters())
        self.critic_parameters = list(self.policy.critic.parameters())
        groups: list[dict[str, Any]] = [
            {"params": self.actor_parameters},
            {"params": self.critic_parameters, "lr": config.critic_rate},
        ]
        self.optimizer = torch.optim.Adam(groups, lr=config.learning_rate, betas=BETAS)
        self.lesson: Lesson | None = None  # that was left half way

    @property
    def is_learning(self) -> bool:
        """Whether the last update was left while it learned."""
        return self.lesson is not None

    def set_learning_rate(self, rate: float) -> None:
        """Set the rate of the actor, and the critic's by as much."""
        super().set_learning_rate(rate)
        self.optimizer.param_groups[1]["lr"] = self.config.critic_rate * rate / self.config.learning_rate

    def collect(self) -> TensorDictBase:
        """A rollout and the actor's step; what the critic is fitted to, (T * B,).

        The first rollout of a run only sets the scale of the observations.
        """
        norm = self.policy.observation_norm
        if norm.count == 0:
            with torch.no_grad():
                norm.update(torch.stack(self.rollout.collect_window().seen), self.ranks.gather)
        window = self.rollout.collect_window()
        told = self._improve(window)
        with torch.no_grad():
            seen = torch.stack(window.seen)
            target = self._targets(window)
            self.policy.value_norm.update(target[..., None], self.ranks.gather)
            data = {
                "observation": norm(seen),
                "value_target": self.policy.value_norm(target[..., None]),
            }
            packed = TensorDict(data, target.shape, device=self.device).reshape(-1)
            norm.update(seen, self.ranks.gather)
        self._told = told
        return packed

    def _values(self, window: Window) -> tuple[Tensor, Tensor]:
        """Slow values of where steps led, with gradients, and rewards, (T, B) each."""
        features, _ = self.policy.features(torch.stack(window.led_to))
        values = self.policy.value_norm.inverse(self.slow_critic.module(features)).squeeze(-1)
        scale = self.rollout.reward_scale if self.config.scale_rewards else 1.0
        return values, torch.stack(window.reward) * scale

    def _improve(self, window: Window) -> dict[str, float]:
        """The actor's step; numbers for the log."""
        values, rewards = self._values(window)
        discount, total = torch.ones_like(rewards[0]), torch.zeros_like(rewards[0])
        last = len(rewards) - 1
        for t, (reward, value) in enumerate(zip(rewards, values, strict=True)):
            done, terminated = window.done[t], window.terminated[t]
            total = total + discount * reward
            discount = discount * self.config.gamma
            ends = done | (t == last)
            total = total + torch.where(ends & ~terminated, discount * value, 0.0)
            discount = torch.where(done, 1.0, discount)
        loss = -total.mean() / len(rewards)
        self.optimizer.zero_grad()
        loss.backward()
        told = self.average(self.actor_parameters, {"loss_actor": loss.detach()})
        norm = nn.utils.clip_grad_norm_(self.actor_parameters, self.config.max_grad_norm)
        if bool(torch.isfinite(norm)):  # a batch with one bad world must not end the run
            self.optimizer.step()
        return {"loss_actor": float(told["loss_actor"]), "grad_norm": float(norm)}

    @torch.no_grad()
    def _targets(self, window: Window) -> Tensor:
        """TD(lambda) targets of the values of what actions started from, (T, B)."""
        values, rewards = self._values(window)
        targets = torch.empty_like(rewards)
        mix, following = self.config.td_lambda, values[-1]
        for t in reversed(range(len(rewards))):
            blended = torch.where(window.done[t], values[t], (1.0 - mix) * values[t] + mix * following)
            following = rewards[t] + self.config.gamma * torch.where(window.terminated[t], 0.0, blended)
            targets[t] = following
        return targets

    def learn(self, data: TensorDictBase | None) -> dict[str, float]:
        """Fit the critic."""
        if data is not None:
            self.lesson = Lesson(data, self._told)
        lesson = self.lesson
        assert lesson is not None
        while lesson.epochs < self.config.critic_epochs:
            if lesson.order is None:
                lesson.order, lesson.chunk = torch.randperm(len(lesson.data), device=self.device), 0
            chunks = [chunk for chunk in lesson.order.tensor_split(self.config.minibatches) if len(chunk)]
            for indices in chunks[lesson.chunk :]:
                for key, number in self._fit(lesson.data[indices]).items():
                    lesson.sums[key] = lesson.sums.get(key, torch.zeros((), device=self.device)) + number
                lesson.batches += 1
                lesson.chunk += 1
                self.pulse()
            lesson.order = None
            lesson.epochs += 1
        self.lesson = None
        self._shift(lesson.data)
        self._move_slow_critic()
        metrics = lesson.told | {key: float(total) / lesson.batches for key, total in lesson.sums.items()}
        spread = self.policy.actor[0].module.log_std.detach().exp().mean()
        return metrics | {"learning_rate": self.learning_rate, "action_std": float(spread)}

    def _fit(self, data: TensorDictBase) -> dict[str, Tensor]:
        """One step of the critic; numbers for the log."""
        told = self.differentiate(data)
        nn.utils.clip_grad_norm_(self.critic_parameters, self.config.max_grad_norm)
        self.optimizer.step()
        return told

    def differentiate(self, data: TensorDictBase) -> dict[str, Tensor]:
        """Gradient of the critic's loss on a minibatch, of which every rank has a part; numbers for the log."""
        values, targets = self.policy.critic.module(data["observation"]).flatten(), data["value_target"].flatten()
        aim = recentre(values, targets, self.config.critic_bias, mean_of=self.ranks.mean)
        loss = (values - aim).square().mean()
        self.optimizer.zero_grad()
        loss.backward()
        value = self.policy.value_norm.inverse(values.detach().mean().reshape(1)).squeeze()
        return self.average(self.critic_parameters, {"loss_critic": loss.detach(), "value": value})

    @torch.no_grad()
    def _shift(self, data: TensorDictBase) -> None:
        if self.config.critic_bias < 1.0 and self.config.shift_critic:
            error = data["value_target"] - self.policy.critic.module(data["observation"])
            shift_output(self.policy.critic, self.ranks.mean(error.mean()))

    @torch.no_grad()
    def _move_slow_critic(self) -> None:
        for slow, quick in zip(self.slow_critic.parameters(), self.critic_parameters, strict=True):
            slow.lerp_(quick, self.config.tau)

    def shared(self) -> list[Tensor]:
        """Weights and statistics that all ranks begin with alike."""
        return [*super().shared(), *self.slow_critic.state_dict().values()]

    def state_dict(self) -> dict[str, Any]:
        """All that the next update depends on, but for the random generators."""
        lesson = {} if self.lesson is None else vars(self.lesson) | {"data": self.lesson.data.to_dict()}
        return {**super().state_dict(), "slow_critic": self.slow_critic.state_dict(), "lesson": lesson}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where :meth:`state_dict` was taken."""
        super().load_state_dict(state)
        self.slow_critic.load_state_dict(state["slow_critic"])
        left = state["lesson"]
        self.lesson = None
        if left:
            moved = {key: part.to(self.device) for key, part in left.items() if isinstance(part, Tensor)}
            sums = {key: part.to(self.device) for key, part in left["sums"].items()}
            data = TensorDict(left["data"], left["data"]["value_target"].shape[:1], device=self.device)
            self.lesson = Lesson(**left | moved | {"data": data, "sums": sums})

    def regroup(self, state: dict[str, Any], *, is_new: bool) -> None:
        """Continue what other ranks, of another number, have saved; an update that they had begun is begun anew."""
        super().regroup({**state, "lesson": {}}, is_new=is_new)
