"""Behaviour cloning: a policy learns to do what demonstrations show, before it learns by itself.

    L = mean |u(s) - u*|^2 for continuous actions (u the policy's mean, u* the demonstrator's action in its units),
    L = -mean log pi(a*|s) for discrete ones.

Some whole episodes are held out; the policy that fits them best is kept. Observations stay scaled as in the
demonstrations: under other statistics a cloned network acts otherwise. The critic knows nothing afterwards: give PPO
some ``warmup_updates`` that fit the critic alone, or the first updates undo the cloning.
"""

import copy
import math

import torch
from torch import Tensor

from softwarp.policies.policy import Policy
from softwarp.training.demonstrations import Demonstrations
from softwarp.training.options import CloningConfig


def clone(policy: Policy, shown: Demonstrations, config: CloningConfig) -> dict[str, float]:
    """Fit the actor; the scale of observations is taken from the demonstrations and frozen.

    Returns:
        ``epochs`` taken, ``loss`` over the episodes learned from and ``held_out`` over the others.

    Raises:
        ValueError: If the policy has a memory, the demonstrations do not fit, or there are too few episodes.
    """
    if policy.memory is not None:
        raise ValueError("cloning: demonstrations are single steps, which a recurrent policy cannot learn from")
    shown.check_fit(policy.spaces)
    device = policy.low.device
    numbers = shown.episode.unique()
    if len(numbers) < 2:
        raise ValueError(f"cloning: needs at least 2 episodes, one of them to check the fit, got {len(numbers)}")
    count = min(max(1, round(config.held_out * len(numbers))), len(numbers) - 1)
    is_held_out = torch.isin(shown.episode, numbers[torch.randperm(len(numbers))[:count]]).to(device)
    observation, sample = shown.observation.to(device), policy.to_sample(shown.action.to(device))
    policy.observation_norm.update(observation[~is_held_out])
    policy.observation_norm.is_frozen = True
    scaled = policy.observation_norm(observation)
    optimizer = torch.optim.Adam(policy.actor.parameters(), lr=config.learning_rate)

    best, best_loss, best_epoch, epoch = copy.deepcopy(policy.actor.state_dict()), math.inf, 0, 0
    learned = torch.nonzero(~is_held_out).flatten()
    for epoch in range(1, config.epochs + 1):
        for indices in learned[torch.randperm(len(learned), device=device)].split(config.batch):
            optimizer.zero_grad()
            _loss(policy, scaled[indices], sample[indices]).backward()
            optimizer.step()
        with torch.no_grad():
            loss = float(_loss(policy, scaled[is_held_out], sample[is_held_out]))
        if loss < best_loss:
            best, best_loss, best_epoch = copy.deepcopy(policy.actor.state_dict()), loss, epoch
        elif epoch - best_epoch >= config.patience:
            break
    policy.actor.load_state_dict(best)
    with torch.no_grad():
        fit = float(_loss(policy, scaled[~is_held_out], sample[~is_held_out]))
    return {"epochs": float(epoch), "loss": fit, "held_out": best_loss}


def _loss(policy: Policy, features: Tensor, sample: Tensor) -> Tensor:
    distribution = policy.head(features)
    if policy.spaces.is_discrete:
        return -distribution.log_prob(sample).mean()
    return (policy.most_likely(distribution) - sample).square().sum(-1).mean()
