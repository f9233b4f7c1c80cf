"""Stress and strain tensors of elements at the present positions. Theory: docs/theory/hyperelastic.md."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from softwarp import checks, diagnostics, hex_tensors, interop
from softwarp.kernels.elements import quadratic, tensors
from softwarp.model.codes import TURNED
from softwarp.model.fields import allocate
from softwarp.model.model import Model
from softwarp.model.state import Parameters, State
from softwarp.threads import alone

if TYPE_CHECKING:
    import torch


def von_mises(tensor: torch.Tensor) -> torch.Tensor:
    """Von Mises' measure sqrt(3/2 dev s : dev s) of symmetric tensors [their unit], (..., 3, 3) -> (...).

    Raises:
        ValueError: For anything but a tensor whose last two axes are 3 long.
    """
    if getattr(tensor, "shape", ())[-2:] != (3, 3):
        raise ValueError(checks.refusal("von_mises: tensor", "be a tensor of shape (..., 3, 3)", tensor))
    mean = tensor.diagonal(dim1=-2, dim2=-1).mean(dim=-1, keepdim=True)
    deviator = tensor - mean.expand(*mean.shape[:-1], 3).diag_embed()
    result: torch.Tensor = (1.5 * deviator.square().sum(dim=(-2, -1))).sqrt()
    return result


class ElementTensors:
    """Measures Cauchy stress and Green-Lagrange strain of all elements of a model; allocates once.

    Those of a quadratic tet are the means of its four Gauss points, weighted with their volumes at rest, those of a
    hexahedron that of its mean deformation gradient.

    Args:
        model: Soft bodies.

    Attributes:
        body: Soft body of every element, body after body, (element,), on the host.
        volume: Rest volume of every element [m^3], (element,).
    """

    @alone
    def __init__(self, model: Model) -> None:
        import torch

        q, worlds, device = model.quadratic, model.num_worlds, model.device
        self.model, self.variant = model, diagnostics.plain_variant(model)
        real = self.variant.real
        self._tets = [allocate(worlds, 9 * model.tet_count, real, device) for _ in range(2)]
        points = 0 if q is None else quadratic.POINTS * q.count
        self._points = [allocate(worlds, 9 * points, real, device) for _ in range(2)]
        self._corner = allocate(worlds, 12 * points, real, device)
        body = model.tet_body.numpy()
        volume = wp.to_torch(model.tet_size if model.reduction is None else model.tet_volume)
        if q is not None:
            body = np.concatenate([body, q.layout.body])
            of_points = 0.25 * wp.to_torch(q.point_size).reshape(-1, quadratic.POINTS)
            whole = of_points.sum(dim=1)
            self._share = (of_points / whole[:, None])[None, :, :, None]
            volume = torch.cat([volume, whole])
        if model.hexes is not None:
            body = np.concatenate([body, model.hexes.layout.body])
            volume = torch.cat([volume, wp.to_torch(model.hexes.hex_volume)])
        order = np.argsort(body, kind="stable")
        self.body = body[order]
        self._order = torch.as_tensor(order, device=wp.device_to_torch(device))
        self.volume = volume[self._order]

    def slice(self, body: int | None) -> slice:
        """Elements of one soft body, or of all for None.

        Raises:
            ValueError: If there is no such body.
        """
        if body is None:
            return slice(None)
        body = checks.count(body, f"soft body of {self.model.body_count}", low=0, high=self.model.body_count - 1)
        first, last = np.searchsorted(self.body, [body, body + 1])
        return slice(int(first), int(last))

    @alone
    def measure(self, state: State, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
        """Stress [Pa] and strain of all elements, body after body, each of shape (world, element, 3, 3)."""
        import torch

        m, q = self.model, self.model.quadratic
        with interop.on_torch_stream(m.device):
            arrays = [m.tet_node, m.tet_body, m.tet_gradient]
            self._evaluate(m.law_tets, arrays, state.node_x, parameters, self._tets)
            if q is not None:
                dim = self.variant.dim(m.num_worlds, q.count)
                kernel = quadratic.kernels(self.variant).point_corners
                wp.launch(kernel, dim, [q.element_node, state.node_x], [self._corner], device=m.device)
                arrays = [q.point_tet, q.point_body, q.point_gradient]
                self._evaluate(q.law_points, arrays, self._corner, parameters, self._points)
            of_hexes = [] if m.hexes is None else hex_tensors.stress_and_strain(m, state, parameters)
        found: list[torch.Tensor] = []
        for of_tets, of_points in zip(self._tets, self._points, strict=True):
            value = wp.to_torch(of_tets).unflatten(1, (m.tet_count, 9))
            if q is not None:
                points = wp.to_torch(of_points).unflatten(1, (q.count, quadratic.POINTS, 9))
                value = torch.cat([value, (points * self._share).sum(dim=2)], dim=1)
            if of_hexes:
                value = torch.cat([value, of_hexes[len(found)].flatten(2)], dim=1)
            found.append(value.index_select(1, self._order).unflatten(2, (3, 3)))
        return found[0], found[1]

    def _evaluate(
        self,
        laws: dict[str, wp.array],
        arrays: list[wp.array],
        x: wp.array,
        parameters: Parameters,
        outputs: list[wp.array],
    ) -> None:
        m, p = self.model, parameters
        for law, tets in laws.items():
            kernel = tensors.kernels(self.variant, "corotational" if law in TURNED else law).evaluate
            inputs = [tets, *arrays, m.body_law_start, p.youngs, p.nu, p.law_parameter, x]
            wp.launch(kernel, self.variant.dim(m.num_worlds, tets.size), inputs, outputs, device=m.device)
