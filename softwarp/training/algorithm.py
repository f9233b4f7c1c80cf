"""What the training loop asks of an algorithm: collect, update, save and load.

An algorithm owns a policy, a rollout that runs it, and the optimisers that change it. The loop calls ``update`` until
the budget is spent; everything that a later update depends on, but for the random generators, is in ``state_dict``.

Of several ranks each collects and learns from its own part of a batch. Networks and optimiser stay the same bits on
all, because they begin alike and every rank steps with the same averaged gradient.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from softwarp.policies.policy import Policy
from softwarp.training.options import SCHEDULES as SCHEDULES
from softwarp.training.options import AlgorithmConfig
from softwarp.training.ranks import ALONE, Ranks
from softwarp.training.rollout import Pulse, Rollout, nothing

FINAL_RATE = 0.05  # of the first learning rate, where the linear schedule ends


class Algorithm(ABC):
    """Policy, rollout and optimiser of one training run."""

    metrics: ClassVar[tuple[str, ...]]  # names of the numbers that ``update`` returns
    own: ClassVar[tuple[str, ...]] = ("rollout",)  # keys of ``state_dict`` that every rank has for itself
    rollout_class: ClassVar[type[Rollout]] = Rollout
    policy: Policy
    rollout: Rollout
    optimizer: torch.optim.Optimizer
    pulse: Pulse = staticmethod(nothing)  # called after each step of the environment and of the optimiser

    def __init__(self, env: Any, policy: Policy, config: AlgorithmConfig, ranks: Ranks = ALONE) -> None:
        self.config = config
        self.policy = policy
        self.ranks = ranks
        options: dict[str, Any] = {"gamma": config.gamma, "stagger": config.stagger, "ranks": ranks}
        self.rollout = self.rollout_class(env, policy, config.horizon, **options)

    @property
    def device(self) -> torch.device:
        """Where simulation, networks and data live."""
        return self.rollout.device

    @abstractmethod
    def collect(self) -> TensorDictBase:
        """Run one rollout and prepare its transitions for :meth:`learn`."""

    @abstractmethod
    def learn(self, data: TensorDictBase | None) -> dict[str, float]:
        """Improve the policy; means over the minibatches, by name.

        Args:
            data: What ``collect`` returned; None goes on with what was left.
        """

    @property
    @abstractmethod
    def is_learning(self) -> bool:
        """Whether the last update was left while it learned."""

    def feel(self, pulse: Pulse) -> None:
        """Have ``pulse`` called after each step of the environment and of the optimiser.

        What it raises leaves the update; the next one goes on from there, also that of an algorithm to which
        ``state_dict`` was carried over.
        """
        self.pulse = self.rollout.pulse = pulse

    def update(self, progress: float) -> dict[str, float]:
        """Collect one batch and learn from it.

        Args:
            progress: Part of the run that is over, in [0, 1]; drives the linear learning-rate schedule.

        Returns:
            Numbers for the log, by the names in ``metrics``.
        """
        if self.config.schedule == "linear":
            self.set_learning_rate(self.config.learning_rate * (1.0 - (1.0 - FINAL_RATE) * min(progress, 1.0)))
        return self.learn(None if self.is_learning else self.collect())

    def shared(self) -> list[Tensor]:
        """Weights and statistics that all ranks begin with alike."""
        return list(self.policy.state_dict().values())

    def average(self, parameters: Sequence[nn.Parameter], told: dict[str, Tensor]) -> dict[str, Tensor]:
        """Average over ranks the gradients of ``parameters``, in place, and numbers (), with one all-reduce.

        Returns:
            The numbers, averaged.
        """
        if self.ranks.size == 1:
            return told
        numbers = torch.stack([number.detach().float() for number in told.values()])
        self.ranks.average([*(item.grad for item in parameters if item.grad is not None), numbers])
        return dict(zip(told, numbers.unbind(), strict=True))

    def set_learning_rate(self, rate: float) -> None:
        """Set the rate of the first group of parameters: the networks."""
        self.optimizer.param_groups[0]["lr"] = rate

    @property
    def learning_rate(self) -> float:
        """The rate of the networks in use."""
        return float(self.optimizer.param_groups[0]["lr"])

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

    def regroup(self, state: dict[str, Any], *, is_new: bool) -> None:
        """Continue what other ranks, of another number, have saved; a rollout that they had begun is begun anew.

        Args:
            state: Of :meth:`state_dict`, of another rank if this one is new.
            is_new: Whether no rank has saved this one's worlds: they stay as they are.
        """
        rollout = state["rollout"]
        if is_new:
            rollout = self.rollout.state_dict() | {key: rollout[key] for key in ("steps", "return_norm")}
        self.load_state_dict({**state, "rollout": rollout | {"begun": {}}})


def as_it_is(mean: Tensor) -> Tensor:
    """A mean of which there are no others."""
    return mean


def recentre(
    prediction: Tensor,
    target: Tensor,
    bias: float,
    weight: Tensor | None = None,
    mean_of: Callable[[Tensor], Tensor] = as_it_is,
) -> Tensor:
    """Targets whose mean squared error has the gradient of Var(e) + bias mean(e)^2, e = prediction - target.

    d/de_i [Var(e) + b mean(e)^2] = 2/n (e_i - (1 - b) mean(e)), which is the gradient of mean (e - c)^2 with the
    number c = (1 - b) mean(e) held fixed. Bias 1 leaves the targets alone; bias 0 is AVEC's residual variance.
    Reference: Flet-Berliac, Ouhamma, Maillard and Preux (2021), Learning Value Functions in Deep Policy Gradients using
    Residual Variance.

    Args:
        prediction: Of the critic, means are taken over the last axis.
        target: Of the same shape.
        bias: Weight of the squared mean.
        weight: Importance of each sample, of the same shape or one that broadcasts; None: all alike.
        mean_of: The mean over all ranks of what is a mean over this one's samples.
    """
    if bias == 1.0:
        return target
    error = (prediction - target).detach()
    if weight is None:
        mean = mean_of(error.mean(-1, keepdim=True))
    else:
        mean = mean_of((weight * error).sum(-1, keepdim=True)) / mean_of(weight.sum())
    return target + (1.0 - bias) * mean


@torch.no_grad()
def shift_output(body: nn.Module, shift: Tensor) -> None:
    """Add ``shift`` to what a network gives, through the bias of its last layer."""
    last = [layer for layer in body.modules() if isinstance(layer, nn.Linear)][-1]
    last.bias.add_(shift)
