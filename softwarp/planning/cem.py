"""Cross-entropy method: fit a Gaussian to the best of its samples, again and again.

Samples are drawn around a mean with a standard deviation per action and entry and cut to [-1, 1]; mean and deviation
move to those of the best ``elites`` of them, with some inertia. Elites of a round are run again in the next one, so the
best never gets lost. Noise may be correlated in time (``persistence``), which reaches farther than white noise.

References: Rubinstein (1999), The Cross-Entropy Method; Pinneri and others (2020), Sample-efficient Cross-Entropy
Method, for kept elites and correlated noise.
"""

from __future__ import annotations

import numpy as np

from softwarp.planning.model import Floats
from softwarp.planning.options import CEMConfig
from softwarp.planning.sequences import SequencePlanner


class CEM(SequencePlanner):
    """Cross-entropy planner."""

    config: CEMConfig

    def __init__(self, config: CEMConfig | None = None) -> None:
        super().__init__(config or CEMConfig())

    def begin(self, mean: Floats) -> None:
        """Wide around the mean, which is the first sample."""
        self._mean = mean
        self._spread = np.full_like(mean, self.config.spread)
        self._kept = mean[None]

    def sample(self, count: int, rng: np.random.Generator) -> Floats:
        """The elites of the last round and fresh samples."""
        noise = correlated_noise(rng, (count, *self._mean.shape), self.config.persistence)
        samples = self._mean + self._spread * noise
        kept = self._kept[:count]
        samples[: len(kept)] = kept
        return np.clip(samples, -1.0, 1.0)

    def refine(self, samples: Floats, values: Floats) -> Floats:
        """Fit to the elites, the first of equals."""
        elites = samples[np.argsort(-values, kind="stable")[: self.config.elites]]
        stay = self.config.inertia
        self._mean = stay * self._mean + (1.0 - stay) * elites.mean(axis=0)
        spread = stay * self._spread + (1.0 - stay) * elites.std(axis=0)
        self._spread = np.maximum(spread, self.config.least_spread)
        self._kept = elites
        return self._mean


def correlated_noise(rng: np.random.Generator, shape: tuple[int, ...], persistence: float) -> Floats:
    """Normal numbers of variance 1, shape (count, time, size); neighbours in time correlate by ``persistence``."""
    noise = rng.standard_normal(shape)
    fresh = np.sqrt(1.0 - persistence**2)
    for step in range(1, shape[1]):
        noise[:, step] = persistence * noise[:, step - 1] + fresh * noise[:, step]
    return noise
