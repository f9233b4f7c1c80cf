"""Soft actor-critic (Haarnoja et al. 2018) on a batched environment, with continuous or discrete actions.

    y = r + gamma (1 - terminated) (min_i Q'_i(s', a') - alpha log pi(a'|s')),   a' ~ pi(.|s'),  Q' a slow copy of Q
    L_Q = sum_i [Var(Q_i - y) + beta mean(Q_i - y)^2],   beta = 1: mean squared error, beta = 0: AVEC
    L_pi = mean [alpha log pi(a|s) - min_i Q_i(s, a)],   L_alpha = -log alpha mean [log pi(a|s) + H]

For discrete actions expectations over the action are sums. Each update rolls the policy out for T steps in B worlds,
then takes ``update_ratio`` gradient steps per transition collected, each on ``batch`` replayed ones; keep the ratio
when the number of worlds changes. A transition stores ``terminated``, so that time limits bootstrap. Observations and
rewards are kept as they came and scaled when they are replayed, by statistics of everything seen so far.

Of several ranks each has a replay of its own, and takes ``update_ratio`` gradient steps per transition that it collects
itself; a gradient step sees ``batch`` transitions of every rank, so that each is replayed as often as in one process.

AVEC's authors apply its loss to a separate state value; here there is none, and it applies to both Q-functions.
"""

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import DiscreteSACLoss, SACLoss, SoftUpdate

from softwarp.policies.policy import NetworkConfig, Spaces
from softwarp.policies.soft_actor import SoftActor
from softwarp.training.algorithm import Algorithm, recentre
from softwarp.training.options import SACConfig
from softwarp.training.ranks import ALONE, Ranks
from softwarp.training.replay import Replay


class ResidualSACLoss(SACLoss):
    """TorchRL's loss with the error of the Q-functions split into its variance and its mean."""

    critic_bias: float = 1.0
    ranks: Ranks = ALONE
    mean_error: Tensor  # of each Q-function over the last batch, (net,)

    def qvalue_v2_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Both Q-functions against the common target."""
        target = self._compute_target_v2(tensordict)
        inputs = tensordict.select(*self.qvalue_network.in_keys)
        values = self._vmap_qnetworkN0(inputs, self.qvalue_network_params)["state_action_value"].squeeze(-1)
        return residual_loss(self, values, target, tensordict.get("priority_weight", None))


class ResidualDiscreteSACLoss(DiscreteSACLoss):
    """The same for discrete actions."""

    critic_bias: float = 1.0
    ranks: Ranks = ALONE
    mean_error: Tensor

    def qvalue_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Both Q-functions, at the choice taken, against the common target."""
        target = self._compute_target(tensordict)
        inputs = tensordict.select(*self.qvalue_network.in_keys)
        values = self._vmap_qnetworkN0(inputs, self.qvalue_network_params)["action_value"]
        choice = tensordict["action"].expand(values.shape[:-1]).unsqueeze(-1)
        values = values.gather(-1, choice).squeeze(-1)
        return residual_loss(self, values, target, tensordict.get("priority_weight", None))


def residual_loss(
    loss: ResidualSACLoss | ResidualDiscreteSACLoss, values: Tensor, target: Tensor, weight: Tensor | None
) -> tuple[Tensor, dict[str, Tensor]]:
    """Loss of Q-functions (net, n) against targets (n,), and errors (n,) by which to replay; keeps their mean."""
    error = values - recentre(values, target.expand_as(values), loss.critic_bias, weight, loss.ranks.mean)
    square = error.square() if weight is None else weight * error.square()
    raw = (values - target).detach()
    loss.mean_error = raw.mean(-1)
    return square.sum(0).mean(), {"td_error": raw.abs().amax(0)}


class SAC(Algorithm):
    """Policy, Q-functions, temperature, replay, optimiser and rollout of one training run."""

    metrics = ("loss_actor", "loss_critic", "loss_alpha", "alpha", "entropy", "td_error", "learning_rate", "replay")
    own = ("rollout", "replay")
    config: SACConfig
    policy: SoftActor

    def __init__(self, env: Any, network: NetworkConfig, config: SACConfig, ranks: Ranks = ALONE) -> None:
        super().__init__(env, SoftActor(Spaces.of(env), network).to(env.device or "cpu"), config, ranks)
        self.loss = self._make_loss()
        self.slow_copy = SoftUpdate(self.loss, tau=config.tau)
        named = {name: item for name, item in self.loss.named_parameters() if item.requires_grad}
        temperature = [named.pop("log_alpha")] if config.tune_alpha else []
        self.trained = list(named.values())
        self.last_bias = [item for name, item in named.items() if "qvalue" in name and name.endswith("bias")][-1]
        self.averaged = self.trained + temperature
        groups: list[dict[str, Any]] = [{"params": self.trained}, {"params": temperature, "lr": config.alpha_rate}]
        self.optimizer = torch.optim.Adam(groups[: 1 + len(temperature)], lr=config.learning_rate)
        example = self._transitions(self.rollout.buffer.transpose(0, 1))
        self.replay = Replay(config.capacity, example, prioritized=config.prioritized)
        self.owed = 0.0  # gradient steps that the ratio asks for and that were not taken yet
        self.left = 0  # of those, the ones that this update still takes
        self.sums: dict[str, Tensor] = {}  # of the numbers for the log, over the ``batches`` of this update
        self.batches = 0

    @property
    def is_learning(self) -> bool:
        """Whether the last update was left while it learned."""
        return self.left > 0

    def _make_loss(self) -> Any:
        """TorchRL's loss for the kind of action, with two independent Q-functions."""
        config, spaces = self.config, self.policy.spaces
        critics = [self.policy.make_critic().to(self.device) for _ in range(2)]
        entropy = config.target_entropy
        common: dict[str, Any] = {"loss_function": "l2", "alpha_init": config.initial_alpha}
        common |= {"fixed_alpha": not config.tune_alpha, "delay_qvalue": True}
        if spaces.is_discrete:
            entropy = 0.3 * math.log(spaces.action_size) if entropy is None else entropy
            loss: Any = ResidualDiscreteSACLoss(
                self.policy.actor,
                critics,
                action_space="categorical",
                num_actions=spaces.action_size,
                target_entropy=entropy,
                **common,
            )
        else:
            entropy = -float(spaces.action_size) if entropy is None else entropy
            loss = ResidualSACLoss(self.policy.actor, critics, target_entropy=entropy, **common)
        loss.critic_bias, loss.ranks = config.critic_bias, self.ranks
        loss.make_value_estimator(gamma=config.gamma)
        return loss.to(self.device)

    @torch.no_grad()
    def _transitions(self, batch: TensorDictBase) -> TensorDictBase:
        """What is replayed, (B * T,)."""
        keys = ("observation", "action", ("next", "observation"), ("next", "reward"), ("next", "terminated"))
        return batch.select(*keys).reshape(-1)

    @torch.no_grad()
    def collect(self) -> TensorDictBase:
        """Transitions of one rollout, kept for replay; random ones until the warm-up is over."""
        warming = self.rollout.steps < self.config.warmup_steps
        batch = self.rollout.collect(self.policy.explore_uniformly if warming else None)
        data = self._transitions(batch)
        self.policy.observation_norm.update(data["observation"], self.ranks.gather)
        self.replay.add(data)
        return data

    def learn(self, data: TensorDictBase | None) -> dict[str, float]:
        """Gradient steps in proportion to the transitions that came in."""
        if data is not None:
            self.sums, self.batches = {}, 0
            if self.rollout.steps >= self.config.warmup_steps:
                self.owed += self.config.update_ratio * len(data)
                self.left = math.floor(self.owed)
                self.owed -= self.left
        while self.left:
            for key, number in self._step().items():
                self.sums[key] = self.sums.get(key, torch.zeros((), device=self.device)) + number
            self.left -= 1
            self.batches += 1
            if self.left:  # the last one ends the update
                self.pulse()
        told = {key: float(total) / self.batches for key, total in self.sums.items()}
        return told | {"learning_rate": self.learning_rate, "replay": float(self.replay.size)}

    def _step(self) -> dict[str, Tensor]:
        """One gradient step on replayed transitions; numbers for the log."""
        config, data = self.config, self._replayed()
        told = self.differentiate(data)
        nn.utils.clip_grad_norm_(self.trained, config.max_grad_norm)
        self.optimizer.step()
        if config.critic_bias < 1.0 and config.shift_critic:
            with torch.no_grad():
                self.last_bias.sub_(config.tau * self.loss.mean_error.unsqueeze(-1))
        self.slow_copy.step()
        self.replay.prioritize(data["index"], data["td_error"])
        return told

    def differentiate(self, data: TensorDictBase) -> dict[str, Tensor]:
        """Gradients of the losses of replayed transitions, of which every rank has its own; numbers for the log."""
        result = self.loss(data)
        self.optimizer.zero_grad()
        (result["loss_actor"] + result["loss_qvalue"] + result["loss_alpha"]).backward()
        told = {"loss_actor": result["loss_actor"], "loss_critic": result["loss_qvalue"]}
        told |= {"loss_alpha": result["loss_alpha"], "alpha": result["alpha"], "entropy": result["entropy"]}
        told |= {"td_error": data["td_error"].mean()}
        if self.config.critic_bias < 1.0:
            self.loss.mean_error = self.ranks.mean(self.loss.mean_error)
        return self.average(self.averaged, {name: number.detach().squeeze() for name, number in told.items()})

    def shared(self) -> list[Tensor]:
        """Weights and statistics that all ranks begin with alike."""
        return [*super().shared(), *self.loss.state_dict().values()]

    @torch.no_grad()
    def _replayed(self) -> TensorDictBase:
        """A batch as the loss sees it: observations and rewards scaled."""
        data = self.replay.sample(self.config.batch)
        norm = self.policy.observation_norm
        data["observation"] = norm(data["observation"])
        data["next", "observation"] = norm(data["next", "observation"])
        data["next", "done"] = data["next", "terminated"]  # nothing else ends the sum of rewards
        if self.config.scale_rewards:
            data["next", "reward"] = data["next", "reward"] * self.rollout.reward_scale
        return data

    def state_dict(self) -> dict[str, Any]:
        """All that the next update depends on, but for the random generators."""
        replay = self.replay.state_dict(transitions=self.config.save_replay)
        lesson = {"left": self.left, "sums": self.sums, "batches": self.batches}
        more = {"loss": self.loss.state_dict(), "replay": replay, "owed": self.owed, "lesson": lesson}
        return {**super().state_dict(), **more}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where :meth:`state_dict` was taken."""
        super().load_state_dict(state)
        self.loss.load_state_dict(state["loss"])
        self.replay.load_state_dict(state["replay"])
        self.owed = state["owed"]
        lesson = state.get("lesson", {"left": 0, "sums": {}, "batches": 0})
        self.left, self.batches = lesson["left"], lesson["batches"]
        self.sums = {key: part.to(self.device) for key, part in lesson["sums"].items()}
