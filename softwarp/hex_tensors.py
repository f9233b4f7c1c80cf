"""Energy, stress and strain of hexahedra at the present positions. Theory: docs/theory/hexahedral.md."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from softwarp import interop
from softwarp.kernels.elements.corotational import GUARD, GUARD_GROWTH
from softwarp.model.hexes import HexModel
from softwarp.model.model import Model
from softwarp.model.state import Parameters, State

if TYPE_CHECKING:
    import torch


def mean_gradient(m: HexModel, x: torch.Tensor) -> torch.Tensor:
    """F from the axes of the shape to those of the world at positions ``x`` (..., node, 3), (..., hex, 3, 3)."""
    import torch

    shape = wp.to_torch(m.hex_shape).long()
    g = wp.to_torch(m.shape_gradient).unflatten(1, (8, 3)).to(x)[shape]
    corner = x[..., wp.to_torch(m.hex_node).long(), :]
    found: torch.Tensor = torch.einsum("...hac,hak->...hck", corner - corner[..., :1, :], g)
    return found


def rotation(F: torch.Tensor) -> torch.Tensor:
    """The rotation nearest to every F, (..., 3, 3)."""
    import torch

    u, _, vh = torch.linalg.svd(F)
    sign = torch.linalg.det(u @ vh).sign()
    last = torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], dim=-1)
    found: torch.Tensor = (u * last[..., None, :]) @ vh
    return found


def moduli(m: HexModel, model: Model, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
    """Lame constants of every hexahedron without its factor [Pa], each (world, hex)."""
    p, body = interop.views(parameters, model), wp.to_torch(m.hex_body).long()
    youngs, nu = p["youngs"][:, body], p["nu"][:, body]
    return youngs / (2.0 * (1.0 + nu)), youngs * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


def stress_and_strain(model: Model, state: State, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
    """Cauchy stress [Pa] and Green-Lagrange strain of mean deformation gradients, each (world, hex, 3, 3)."""
    import torch

    m = model.hexes
    assert m is not None
    x = interop.named_view(state, model, "node_x")
    F, rest = mean_gradient(m, x), mean_gradient(m, torch.as_tensor(model.node_rest).to(x))
    mu, lam = moduli(m, model, parameters)
    one = torch.eye(3, dtype=x.dtype, device=x.device)
    Q = rotation(F)
    strain = Q.mT @ F - one
    trace = strain.diagonal(dim1=-2, dim2=-1).sum(dim=-1)
    P = Q @ (mu[..., None, None] * (strain + strain.mT) + (lam * trace)[..., None, None] * one)
    stress = P @ F.mT / torch.linalg.det(F).clamp(min=1.0e-6)[..., None, None]
    whole = F @ rest.mT  # rest turns the axes of the shape to those at rest
    return 0.5 * (stress + stress.mT), 0.5 * (whole.mT @ whole - one)


def energy(model: Model, state: State, parameters: Parameters) -> torch.Tensor:
    """Energy u' K u / 2 of every hexahedron [J], (world, hex)."""
    import torch

    m = model.hexes
    assert m is not None
    x = interop.named_view(state, model, "node_x")
    shape = wp.to_torch(m.hex_shape).long()
    corner = x[:, wp.to_torch(m.hex_node).long()]
    y = torch.einsum("whac,whck->whak", corner - corner[:, :, :1], rotation(mean_gradient(m, x)))
    u = (y - wp.to_torch(m.shape_x).unflatten(1, (8, 3)).to(x)[shape]).flatten(2)
    mu, lam = (value.double() for value in moduli(m, model, parameters))
    u = u.double()
    total = mu * _product(m.shape_mu, shape, u) + lam * _product(m.shape_lam, shape, u)
    kept = [wp.to_torch(values).unflatten(1, (-1, 24)).double()[shape] for values in (m.mode_mu, m.mode_lam)]
    a, b = (torch.einsum("hmk,whk->whm", values, u) for values in kept)
    ratio = wp.to_torch(m.mode_ratio).double()[shape]
    mu, lam = mu[..., None], lam[..., None]
    total = total - ((mu * a + lam * b).square() / (mu + lam * ratio)).sum(dim=-1)
    total = 0.5 * total + wp.to_torch(m.hex_volume).double() * _guard_density(model, m, x, mu[..., 0], lam[..., 0])
    found: torch.Tensor = (total * wp.to_torch(m.hex_factor).double()).to(x.dtype)
    return found


def _guard_density(model: Model, m: HexModel, x: torch.Tensor, mu: torch.Tensor, lam: torch.Tensor) -> torch.Tensor:
    """Energy of the guard per volume at rest [J/m^3], (world, hex); ``kernels.elements.energy`` has its terms."""
    import torch

    guard = wp.to_torch(model.body_guard).double()[wp.to_torch(m.hex_body).long()]
    depth = (guard - torch.linalg.det(mean_gradient(m, x)).double()).clamp(min=0.0)
    inner = torch.minimum(depth, guard.clamp(min=0.0))
    square = 0.5 * inner.square() + 0.25 * GUARD_GROWTH * (inner / guard).square() * inner.square()
    square = square + 0.5 * (1.0 + GUARD_GROWTH) * (depth.square() - inner.square())
    found: torch.Tensor = GUARD * (lam + 2.0 * mu) * square
    return found


def _product(blocks: wp.array, shape: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    """u' K u with the 36 blocks of every shape, (world, hex)."""
    import torch

    low, high = torch.tril_indices(8, 8)
    K = wp.to_torch(blocks).unflatten(1, (36, 3, 3)).double()[shape]
    u = u.unflatten(2, (8, 3))
    twice = torch.where(low == high, 1.0, 2.0).to(u)
    found: torch.Tensor = torch.einsum("whpc,hpcd,whpd,p->wh", u[:, :, low], K, u[:, :, high], twice)
    return found
