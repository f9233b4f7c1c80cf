"""Rollouts through which gradients flow: T steps of every world, from actions to rewards and last values.

A window begins with a constant state and with all the noise of its actions. One that is left half way is begun anew by
whom it is carried over to, from the same state with the same noise: a graph cannot be saved, its bits can be found
again.

In a few worlds of some hundred the gradient grows on its way back through the steps, to a thousand or a hundred
thousand times that of the others, and alone would say where the sum of all points. So what an action of a world counts
is ``bounded`` by what those of all worlds do.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from softwarp.envs.gradients import EnvSteps, require_gradient
from softwarp.policies.actor_critic import ActorCritic
from softwarp.policies.policy import Policy
from softwarp.training.ranks import ALONE, Ranks
from softwarp.training.rollout import Rollout

MOST = 4.0  # medians: nine of ten gradients of single worlds stay below 3.4


@dataclass
class Window:
    """T steps of B worlds; what carries gradients is as long as there were steps.

    Attributes:
        noise: Of the actions, standard normal, (T, B, action).
        start: State of the rollout before the first step.
        now: What the next action starts from, (B, observation).
        seen: What each action started from, without gradients, (B, observation) each.
        led_to: Where it led, with gradients, (B, observation) each.
        reward: Shape (B,) each, with gradients.
        terminated: Bool (B,) each.
        done: Bool (B,) each.
    """

    noise: Tensor
    start: dict[str, Any]
    now: Tensor
    seen: list[Tensor] = field(default_factory=list)
    led_to: list[Tensor] = field(default_factory=list)
    reward: list[Tensor] = field(default_factory=list)
    terminated: list[Tensor] = field(default_factory=list)
    done: list[Tensor] = field(default_factory=list)


class GradientRollout(Rollout):
    """Runs a stochastic policy in all worlds and keeps the graph; see ``Rollout`` for the rest.

    Raises:
        ValueError: If the environment's steps have no gradient; the message names what, and the way out.
    """

    policy: ActorCritic

    def __init__(
        self,
        env: Any,
        policy: Policy,
        horizon: int,
        *,
        gamma: float = 0.99,
        stagger: bool = True,
        ranks: Ranks = ALONE,
    ) -> None:
        require_gradient(env)
        super().__init__(env, policy, horizon, gamma=gamma, stagger=stagger, ranks=ranks)
        self.env_steps = EnvSteps(env, horizon)
        self.window: Window | None = None
        self._noise: Tensor | None = None  # of a window that another has left

    def _allocate(self) -> TensorDict:
        """No storage: the graph is one."""
        return TensorDict({}, (self.horizon, self.worlds))

    def collect_window(self) -> Window:
        """T steps; after each ``pulse`` is called. If it raises, the next call goes on from there."""
        if self.window is None:
            self._open()
        window = self.window
        assert window is not None
        for t in range(self.taken, self.horizon):
            features, _ = self.policy.features(window.now)
            mean, std = self.policy.actor[0].module(features)
            sample = _Within.apply(mean + std * window.noise[t])
            if sample.requires_grad:
                sample.register_hook(bounded)
            cut = self.step_count + 1 >= self.step_limit
            step = self.env_steps.step(self.policy.to_env(sample), cut)
            window.seen.append(window.now.detach())
            window.led_to.append(step.observation.float())
            window.reward.append(step.reward.float())
            for name in ("terminated", "done"):
                getattr(window, name).append(step.after[name].squeeze(-1))
            window.now = step.now.float()
            self._note(t, step.after)
            self.taken = t + 1
            self.pulse()
        self._close()
        return window

    @torch.no_grad()
    def _open(self) -> None:
        start = super().state_dict()
        now = self.env_steps.begin().float()
        noise, self._noise = self._noise, None
        if noise is None:
            shape = (self.horizon, self.worlds, self.policy.spaces.action_size)
            noise = torch.randn(shape, device=self.device)
        self.window = Window(noise, start, now)

    @torch.no_grad()
    def _note(self, t: int, after: Any) -> None:
        self.discounted.mul_(self.gamma).add_(after["reward"].squeeze(-1))
        self._returns[t] = self.discounted
        self._end_episodes(t, after)

    def _close(self) -> None:
        self.window, self.taken = None, 0
        self.now = self.env._collect()
        self.episodes.extend(tuple(episode) for episode in self._ends[self._ended].tolist())
        self.env.raise_refused_actions()
        self.return_norm.update(self._returns, self.ranks.gather)
        self.steps += self.horizon * self.worlds * self.ranks.size

    def state_dict(self) -> dict[str, Any]:
        """All that is needed to continue; of a window that is open, its start."""
        if self.window is None:
            return super().state_dict()
        return self.window.start | {"begun": {"noise": self.window.noise}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where :meth:`state_dict` was taken, or begin its window anew."""
        begun = state.get("begun")
        super().load_state_dict({**state, "begun": {}})
        self.window = None
        self._noise = begun["noise"].to(self.device) if begun else None


def bounded(by: Tensor) -> Tensor:
    """Gradients by one action of every world, (B, action), with none longer than ``MOST`` times the median length.

    Worlds without a gradient, which begin anew, do not count in the median, and what is not finite becomes 0.
    """
    length = torch.linalg.vector_norm(by, dim=-1, keepdim=True)
    counted = torch.where(length.isfinite() & (length > 0.0), length, torch.nan)
    most = MOST * counted.nanmedian()
    return torch.where(counted.isnan(), 0.0, by * (most / counted).clamp(max=1.0))


class _Within(torch.autograd.Function):
    """Limits to [-1, 1] whose gradient holds beyond them where descent leads back inside."""

    @staticmethod
    def forward(ctx: Any, sample: Tensor) -> Tensor:
        """Clip."""
        ctx.save_for_backward(sample)
        return sample.clamp(-1.0, 1.0)

    @staticmethod
    def backward(ctx: Any, by: Tensor) -> Tensor:
        """Pass what leads inside; descent moves against ``by``."""
        (sample,) = ctx.saved_tensors
        outward = ((sample > 1.0) & (by < 0.0)) | ((sample < -1.0) & (by > 0.0))
        return by.masked_fill(outward, 0.0)
