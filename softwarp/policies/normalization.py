"""Running mean and variance, kept inside a network so that they are saved, moved and frozen with it."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

Gather = Callable[[Tensor], Tensor]  # numbers (n,) of one process to those of all, (process, n)


def alone(own: Tensor) -> Tensor:
    """The numbers of the only process."""
    return own.unsqueeze(0)


class RunningNormalizer(nn.Module):
    """Scales each feature to zero mean and unit variance by statistics of all samples seen so far.

    The statistics change only in :meth:`update`; evaluation leaves them as training left them. Nothing changes them
    while ``is_frozen``: networks that have learned from other samples than those that follow would lose what they know.

    mean' = mean + d n_b / n,   M2' = M2 + M2_b + d^2 n_a n_b / n,   d = mean_b - mean,   n = n_a + n_b

    Where several processes see samples, each gathers the moments (n_b, mean_b, var_b) of all and takes them in, one
    process after the other: all then hold the same bits, which are those of all samples together but for rounding.
    Reference: Chan, Golub and LeVeque (1983), Algorithms for computing the sample variance.
    """

    mean: Tensor  # (size,) float64
    var: Tensor  # (size,) float64
    count: Tensor  # () float64, samples seen

    def __init__(self, size: int, *, clip: float = 10.0, floor: float = 1e-5) -> None:
        """Start as the identity.

        Args:
            size: Number of features.
            clip: Scaled values are limited to [-clip, clip].
            floor: Smallest standard deviation divided by; a constant feature becomes 0.
        """
        super().__init__()
        self.clip = clip
        self.floor = floor
        self.is_frozen = False
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("var", torch.ones(size, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    @torch.no_grad()
    def update(self, samples: Tensor, gather: Gather = alone) -> None:
        """Take samples, shape (..., size), into the statistics, unless they are frozen.

        Args:
            samples: Of this process.
            gather: Of processes that keep the same statistics: gives the numbers of all of them.
        """
        if self.is_frozen:
            return
        flat = samples.reshape(-1, self.mean.numel()).double()
        own = torch.cat((self.count.new_full((1,), len(flat)), flat.mean(0), flat.var(0, unbiased=False)))
        for moments in gather(own):
            self._take(moments[0], *moments[1:].chunk(2))

    def _take(self, added: Tensor, mean: Tensor, var: Tensor) -> None:
        """Merge the moments of ``added`` further samples."""
        total = self.count + added
        shift = mean - self.mean
        squares = self.var * self.count + var * added
        squares += shift.square() * self.count * added / total
        self.mean += shift * added / total
        self.var.copy_(squares / total)
        self.count.copy_(total)

    @property
    def std(self) -> Tensor:
        """Standard deviation of each feature, at least ``floor``, float32."""
        return self.var.sqrt().clamp_min(self.floor).float()

    def forward(self, values: Tensor) -> Tensor:
        """Scale values, shape (..., size)."""
        return ((values - self.mean.float()) / self.std).clamp(-self.clip, self.clip)

    def inverse(self, scaled: Tensor) -> Tensor:
        """Undo :meth:`forward` (but for the clipping)."""
        return scaled * self.std + self.mean.float()
