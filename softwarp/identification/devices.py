"""Candidates divided among several simulations, such as one on each GPU, behind one function of residuals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from softwarp import checks
from softwarp.identification.candidates import Residuals
from softwarp.identification.parameters import FloatArray
from softwarp.threads import Workers


def side_by_side(parts: Sequence[tuple[Residuals, int]]) -> tuple[Residuals, int]:
    """One function of residuals out of several, which are evaluated at the same time, a thread each.

        models = [Robot(device=device, candidates=32) for device in ("cuda:0", "cuda:1")]
        residuals, batch = side_by_side([(model.residuals, 32) for model in models])
        found = fit(parameters, residuals, batch=batch)

    Candidates keep their order, so that a fit is the one of a single simulation, to the bit where the devices are alike
    and take the same solver path.

    Args:
        parts: A function (candidate, parameter) -> (candidate, measurement), and how many candidates it takes at once.

    Returns:
        The function, and the ``batch`` that ``fit`` is to call it with: the sum of all.

    Raises:
        ValueError: If there are no parts, or one has no candidates; the function raises it for another batch.
    """
    if not parts:
        raise ValueError("side_by_side: needs one part at least, (residuals, candidates)")
    counts = [checks.count(count, "side_by_side: candidates of a part") for _, count in parts]
    batch = sum(counts)
    ends = np.cumsum(counts)
    workers = Workers(len(parts))

    def residuals(values: FloatArray) -> FloatArray:
        if len(values) != batch:
            raise ValueError(f"side_by_side: {len(values)} candidates for {batch}; call fit with batch={batch}")
        found: list[FloatArray] = [np.empty(0)] * len(parts)

        def one(place: int) -> None:
            found[place] = np.asarray(parts[place][0](values[ends[place] - counts[place] : ends[place]]))

        workers.run(one, range(len(parts)), helping=True)
        return np.concatenate(found)

    return residuals, batch
