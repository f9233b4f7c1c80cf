"""Model predictive path integral: the mean of random sequences, weighted by exp(value / temperature).

Sequences are drawn around the mean u and cut to [-1, 1]; then

    u <- sum_k w_k u_k,    w_k proportional to exp(V_k / lambda).

The temperature lambda is found anew in every round so that the effective number of samples 1 / sum w^2 is a given part
of them: a fixed one would depend on the scale of the rewards. Noise may shrink from round to round. There is no cost of
effort beside the environment's own.

Reference: Williams and others (2017), Information Theoretic MPC for Model-Based Reinforcement Learning.
"""

from __future__ import annotations

import numpy as np

from softwarp.planning.cem import correlated_noise
from softwarp.planning.model import Floats
from softwarp.planning.options import MPPIConfig
from softwarp.planning.sequences import SequencePlanner

_BISECTIONS = 60
_COLDEST, _HOTTEST = 1e-9, 1e6  # temperatures, in the scale of discounted values


class MPPI(SequencePlanner):
    """Path integral planner."""

    config: MPPIConfig

    def __init__(self, config: MPPIConfig | None = None) -> None:
        super().__init__(config or MPPIConfig())

    def begin(self, mean: Floats) -> None:
        """Around the mean."""
        self._mean, self._spread = mean, self.config.spread

    def sample(self, count: int, rng: np.random.Generator) -> Floats:
        """The mean itself and noisy copies."""
        noise = correlated_noise(rng, (count, *self._mean.shape), self.config.persistence)
        noise[0] = 0.0
        return np.clip(self._mean + self._spread * noise, -1.0, 1.0)

    def refine(self, samples: Floats, values: Floats) -> Floats:
        """Weigh the samples as they were run, cut to their range."""
        weights = path_weights(values, self.config.effective)
        self._mean = np.tensordot(weights, samples, axes=1)
        self._spread *= self.config.decay
        return self._mean


def path_weights(values: Floats, effective: float) -> Floats:
    """Weights proportional to exp(value / lambda), lambda such that 1 / sum w^2 is a part of the number of values.

    Equal values give equal weights; where ties make so few effective samples impossible, the coldest weights.
    """
    wanted = max(1.0, effective * len(values))
    low, high = np.log(_COLDEST), np.log(_HOTTEST)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        weights = _softmax(values / np.exp(middle))
        low, high = (middle, high) if 1.0 / np.square(weights).sum() < wanted else (low, middle)
    return _softmax(values / np.exp(high))


def _softmax(scores: Floats) -> Floats:
    weights = np.exp(scores - scores.max())
    normalized: Floats = weights / weights.sum()
    return normalized
