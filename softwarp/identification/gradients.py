"""Residuals with derivatives: functions of torch tensors that ``softwarp.gradients`` differentiates."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from softwarp import checks
from softwarp.identification.parameters import FloatArray

if TYPE_CHECKING:
    from torch import Tensor


class Differentiable:
    """Residuals of a model that torch differentiates, for ``fit``.

        equilibrium = gradients.Equilibrium(sim)          # a world for each of three loads

        def model(values):                                # (experiment, parameter) -> (experiment, measurement)
            pose = equilibrium(parameters={"youngs": values[:, :1]})
            return pose.marker_x[:, tip] - measured

        found = fit(parameters, Differentiable(model, experiments=3))

    ``fit`` takes exact derivatives then: by all parameters from one backward pass for every measurement of an
    experiment, as experiments do not influence each other; with ``method="gradient"`` from a single one, however many
    measurements and parameters there are.

    Args:
        model: Values of the parameters, a float64 tensor (experiment, parameter) whose rows are equal, to model minus
            measurement, (experiment, ...). What it tells of an experiment may depend on that row alone, as what a world
            does depends on its own parameters.
        experiments: Rows.
        batched: Have torch take the backward passes of a Jacobian together (``torch.vmap``), as it can where all
            of the model is its own functions and equilibria of rods and rigid bodies.
    """

    def __init__(self, model: Callable[[Tensor], Tensor], experiments: int = 1, *, batched: bool = False) -> None:
        self.model, self.experiments = model, checks.count(experiments, "Differentiable: experiments")
        self.batched = checks.flag(batched, "Differentiable: batched")
        self._last: tuple[bytes, Tensor, Tensor] | None = None  # values, the leaf made of them, what the model said
        self._size = 0  # of a candidate's residuals

    def __call__(self, values: FloatArray) -> FloatArray:
        """Residuals of candidates one after another; nan for those that diverged.

        Args:
            values: Shape (candidate, parameter).

        Returns:
            Shape (candidate, experiment * measurement).

        Raises:
            Diverged: As the model says, if the first candidate that is ever asked for does.
        """
        return np.stack([self._residuals(row) for row in values])

    def _residuals(self, values: FloatArray) -> FloatArray:
        from softwarp.gradients import Diverged

        try:
            out = self._evaluate(values).detach().cpu().double().numpy().reshape(-1)
        except Diverged:
            if not self._size:
                raise
            return np.full(self._size, np.nan)
        self._size = len(out)
        return np.asarray(out)

    def jacobian(self, values: FloatArray) -> FloatArray:
        """Derivatives at one candidate that has not diverged.

        Args:
            values: Shape (parameter,).

        Returns:
            Shape (experiment * measurement, parameter).
        """
        import torch

        leaf, out = self._at(values)
        columns = out.reshape(self.experiments, -1).sum(dim=0)
        if self.batched:
            each = torch.eye(len(columns), dtype=columns.dtype, device=columns.device)
            rows = torch.vmap(lambda by: torch.autograd.grad(columns, leaf, by, retain_graph=True)[0])(each)
        else:
            rows = torch.stack([torch.autograd.grad(part, leaf, retain_graph=True)[0] for part in columns])
        return np.asarray(rows.transpose(0, 1).reshape(-1, leaf.shape[1]).cpu().numpy())

    def pull(self, values: FloatArray, by: FloatArray) -> FloatArray:
        """Gradient of a loss at one candidate.

        Args:
            values: Shape (parameter,).
            by: Its gradient by the residuals, shape (experiment * measurement,).

        Returns:
            Shape (parameter,).
        """
        import torch

        leaf, out = self._at(values)
        (found,) = torch.autograd.grad(out, leaf, torch.as_tensor(by).to(out).reshape(out.shape), retain_graph=True)
        return np.asarray(found.sum(dim=0).cpu().numpy())

    def _at(self, values: FloatArray) -> tuple[Tensor, Tensor]:
        """Leaf and residuals at one candidate, with the graph between them."""
        if self._last is None or self._last[0] != values.tobytes():
            self._evaluate(values)
        assert self._last is not None
        return self._last[1:]

    def _evaluate(self, values: FloatArray) -> Tensor:
        import torch

        self._last = None
        leaf = torch.tensor(np.tile(values, (self.experiments, 1)), dtype=torch.float64, requires_grad=True)
        out = self.model(leaf)
        if not isinstance(out, torch.Tensor) or out.ndim == 0 or len(out) != self.experiments or not out.requires_grad:
            need = f"return a tensor of shape ({self.experiments}, ...) that carries gradients"
            raise ValueError(checks.refusal("Differentiable: model", need, out))
        self._last = (values.tobytes(), leaf, out)
        return out
