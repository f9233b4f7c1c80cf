"""Behaviour cloning: a policy learns to do what demonstrations show, before it learns by itself.

    L = mean |u(s) - u*|^2 for continuous actions (u the policy's mean, u* the demonstrator's action in its units),
    L = -mean log pi(a*|s) for discrete ones.

Some whole episodes are held out; the policy that fits them best is kept. Observations stay scaled as in the
demonstrations: under other statistics a cloned network acts otherwise. The critic knows nothing afterwards: give PPO
some ``warmup_updates`` that fit the critic alone, or the first updates undo the cloning.

A policy with a memory learns from whole episodes, from their first step with an empty memory, and its memory is
fitted with the actor: gradients go back to the first step. A minibatch then is as many episodes as have about
``batch`` steps together.

A clone errs a little, gets where the demonstrator never was, and errs more. So in further *rounds* the clone acts and
the demonstrator says what it would have done; both together are learned from. Of several ranks each lets the clone act
in its own worlds, all learn from what any has seen, and each has its part of a minibatch. Ross, Gordon and Bagnell
(2011), A reduction of imitation learning and structured prediction to no-regret online learning (DAgger).
"""

import copy
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence
from torchrl.envs.utils import ExplorationType, set_exploration_type

from softwarp.policies.policy import Policy
from softwarp.training.demonstrations import Demonstrations, record
from softwarp.training.options import CloningConfig
from softwarp.training.ranks import ALONE, Ranks


@dataclass(frozen=True)
class _Lessons:
    """What is learned from: steps, or where a policy remembers whole episodes, filled up to the longest one."""

    observation: Tensor  # scaled, (step, k) or (episode, T, k)
    sample: Tensor  # of the demonstrator, (step, ...) or (episode, T, ...)
    counts: Tensor | None  # bool (episode, T), False where an episode is over
    is_held_out: Tensor  # bool (step,) or (episode,)

    def minibatches(self, steps: int, ranks: Ranks) -> Iterator[Tensor]:
        """Rows that are not held out, in a new order, about ``steps`` of the demonstrations at a time."""
        learned = torch.nonzero(~self.is_held_out).flatten()
        size = steps if self.counts is None else max(1, round(steps * len(self.counts) / float(self.counts.sum())))
        order = torch.randperm(len(learned), device=learned.device)
        ranks.follow([order])
        yield from learned[order].split(size)

    def differentiate(self, policy: Policy, rows: Tensor, learner: nn.Module, ranks: Ranks) -> None:
        """Gradient of the loss over the steps of some rows, of which every rank looks at its part."""
        if ranks.size == 1:
            self.loss(policy, rows).backward()
            return
        part = rows[ranks.rank :: ranks.size]
        if len(part):
            (self.loss(policy, part) * (ranks.size * self._steps(part) / self._steps(rows))).backward()
        gradients = []
        for weight in learner.parameters():
            weight.grad = torch.zeros_like(weight) if weight.grad is None else weight.grad
            gradients.append(weight.grad)
        ranks.average(gradients)

    def _steps(self, rows: Tensor) -> int:
        return len(rows) if self.counts is None else int(self.counts[rows].sum())

    def loss(self, policy: Policy, rows: Tensor) -> Tensor:
        """Mean over all steps of some rows: numbers of them, or a mask."""
        observation, sample = self.observation[rows], self.sample[rows]
        if self.counts is None:
            return _loss(policy, policy.digest(observation), sample)
        counts = self.counts[rows]
        features = policy.features_along(observation, policy.start(len(observation)))
        return _loss(policy, features[counts], sample[counts])


def clone(policy: Policy, shown: Demonstrations, config: CloningConfig, ranks: Ranks = ALONE) -> dict[str, float]:
    """Fit the actor and what comes before it; the scale of observations is taken from the demonstrations and frozen.

    Args:
        policy: Whose networks are the same on all ranks, and stay so.
        shown: The same on all ranks.
        config: Settings.
        ranks: That learn together.

    Returns:
        ``epochs`` taken, ``loss`` over the episodes learned from and ``held_out`` over the others.

    Raises:
        ValueError: If the demonstrations do not fit, or there are too few episodes.
    """
    shown.check_fit(policy.spaces)
    lessons = _prepare(policy, shown, config.held_out, ranks)
    parts = [part for part in (policy.memory, policy.shared, policy.actor) if part is not None]
    learner = nn.ModuleList(parts)
    optimizer = torch.optim.Adam(learner.parameters(), lr=config.learning_rate)

    best, best_loss, best_epoch, epoch = copy.deepcopy(learner.state_dict()), math.inf, 0, 0
    for epoch in range(1, config.epochs + 1):
        for rows in lessons.minibatches(config.batch, ranks):
            optimizer.zero_grad()
            lessons.differentiate(policy, rows, learner, ranks)
            optimizer.step()
        with torch.no_grad():
            loss = ranks.told(float(lessons.loss(policy, lessons.is_held_out)))
        if loss < best_loss:
            best, best_loss, best_epoch = copy.deepcopy(learner.state_dict()), loss, epoch
        elif epoch - best_epoch >= config.patience:
            break
    learner.load_state_dict(best)
    with torch.no_grad():
        fit = float(lessons.loss(policy, ~lessons.is_held_out))
    return {"epochs": float(epoch), "loss": fit, "held_out": best_loss}


def correct(
    policy: Policy,
    shown: Demonstrations | None,
    env: Any,
    demonstrator: Callable[[TensorDictBase], TensorDictBase],
    config: CloningConfig,
    *,
    seed: int,
    limit: float = math.inf,
    ranks: Ranks = ALONE,
) -> Iterator[dict[str, float]]:
    """Clone, then let the clone act and learn from the demonstrator's corrections, round by round.

    Args:
        policy: The clone.
        shown: Demonstrations to begin with; None: an episode of the demonstrator in every world.
        env: TorchRL environment of batch size (world,).
        demonstrator: Reads ``observation``, writes ``action``.
        config: Settings; a round has one episode in every world.
        seed: Of starts and goals; every rank has its own.
        limit: Time [s] after which no other round begins.
        ranks: That learn together.

    Yields:
        What ``clone`` returns, and ``success`` of the episodes that were learned from last; once per round and before
        the first.
    """
    begin = time.monotonic()
    (episodes,) = env.batch_size
    episodes = max(episodes, 2)
    if shown is None:
        shown = _joined(record(env, demonstrator, episodes=episodes, seed=seed), ranks)
    rounds = [shown]
    for turn in range(config.rounds + 1):
        learned = rounds[0]
        for more in rounds[1:][-config.window :]:
            learned = learned.extended(more)
        yield {**clone(policy, learned, config, ranks), "success": float(rounds[-1].success.float().mean())}
        if turn == config.rounds or ranks.told(time.monotonic() - begin > limit):
            return
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            at = seed + 1000 * (turn + 1)
            rounds.append(_joined(record(env, demonstrator, episodes=episodes, seed=at, actor=policy), ranks))


def _joined(own: Demonstrations, ranks: Ranks) -> Demonstrations:
    """What all ranks have recorded."""
    first, *others = [Demonstrations(**part) for part in ranks.exchange(dict(vars(own)))]
    for other in others:
        first = first.extended(other)
    return first


def _prepare(policy: Policy, shown: Demonstrations, held_out: float, ranks: Ranks) -> _Lessons:
    """Choose the episodes to hold out, set the scale of observations from the others, and freeze it."""
    device = policy.low.device
    numbers = shown.episode.unique()
    if len(numbers) < 2:
        raise ValueError(f"cloning: needs at least 2 episodes, one of them to check the fit, got {len(numbers)}")
    count = min(max(1, round(held_out * len(numbers))), len(numbers) - 1)
    order = torch.randperm(len(numbers))
    ranks.follow([order])
    chosen = numbers[order[:count]]
    is_held_out = torch.isin(shown.episode, chosen).to(device)
    observation, sample = shown.observation.to(device), policy.to_sample(shown.action.to(device))
    policy.observation_norm.update(observation[~is_held_out])
    policy.observation_norm.is_frozen = True
    scaled = policy.observation_norm(observation)
    if policy.memory is None:
        return _Lessons(scaled, sample, None, is_held_out)
    rows = shown.episode.argsort(stable=True).to(device)  # steps of an episode stay in their order
    lengths = torch.bincount(torch.searchsorted(numbers, shown.episode)).tolist()

    def by_episode(steps: Tensor) -> Tensor:
        return pad_sequence(list(steps[rows].split(lengths)), batch_first=True)

    counts = by_episode(torch.ones_like(is_held_out))
    return _Lessons(by_episode(scaled), by_episode(sample), counts, torch.isin(numbers, chosen).to(device))


def _loss(policy: Policy, features: Tensor, sample: Tensor) -> Tensor:
    distribution = policy.head(features)
    if policy.spaces.is_discrete:
        return -distribution.log_prob(sample).mean()
    return (policy.most_likely(distribution) - sample).square().sum(-1).mean()
