"""Energies, forces, tangents and stresses of a simulation at its present positions. These allocate; steps do not."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from softwarp import interop
from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.elements import corotational, quadratic, rod
from softwarp.kernels.elements.materials import LAWS
from softwarp.model.fields import allocate

if TYPE_CHECKING:
    import torch

    from softwarp.simulation import Simulation


@cache
def _kernels(real: Any, law: str) -> SimpleNamespace:
    module = wp.get_module(f"softwarp.diagnostics.{law}.{real.__name__}")
    vec3 = wp.types.vector(3, real)
    mat33 = wp.types.matrix((3, 3), real)
    vec2 = wp.types.vector(2, real)
    energy_of, stress_of = LAWS[law].energy, LAWS[law].stress

    @wp.kernel(module=module, enable_backward=False)
    def evaluate(
        tet_index: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet_volume: wp.array(dtype=real),
        youngs_in: wp.array2d(dtype=real),
        nu_in: wp.array2d(dtype=real),
        node_x_in: wp.array2d(dtype=real),
        energy_out: wp.array2d(dtype=real),
        stress_out: wp.array2d(dtype=real),
    ):
        """Elastic energy [J] and von Mises Cauchy stress [Pa] of one tet."""
        world, item = wp.tid()
        tet = tet_index[item]
        body = tet_body[tet]
        nu = nu_in[world, body]
        one = real(1.0)
        two = real(2.0)
        mu = youngs_in[world, body] / (two * (one + nu))
        p = vec2(mu, two * mu * nu / (one - two * nu))
        a = tet_node[tet, 0] * 3
        F = mat33()
        for b in range(3):
            n = tet_node[tet, b + 1] * 3
            edge = vec3()
            for c in range(3):
                edge[c] = node_x_in[world, n + c] - node_x_in[world, a + c]
            g = vec3(tet_gradient[tet, 3 * b], tet_gradient[tet, 3 * b + 1], tet_gradient[tet, 3 * b + 2])
            F += wp.outer(edge, g)
        energy_out[world, tet] = tet_volume[tet] * energy_of(F, p)
        J = wp.max(wp.determinant(F), real(1.0e-6))
        s = stress_of(F, p) * wp.transpose(F) * (one / J)
        deviator = s - (wp.trace(s) / real(3.0)) * wp.identity(n=3, dtype=real)
        stress_out[world, tet] = wp.sqrt(real(1.5) * wp.ddot(deviator, deviator))

    return SimpleNamespace(evaluate=evaluate)


def _per_tet(sim: Simulation) -> tuple[torch.Tensor, torch.Tensor]:
    """Energy and von Mises stress per linear tet, shape (world, tet)."""
    m = sim.model
    with interop.on_torch_stream(m.device):
        arrays = [m.tet_node, m.tet_body, m.tet_gradient, m.tet_volume]
        return _of_laws(sim, m.law_tets, arrays, sim._state.node_x)


def _per_point(sim: Simulation) -> tuple[torch.Tensor, torch.Tensor]:
    """Energy and von Mises stress per Gauss point of the quadratic tets, shape (world, point)."""
    m = sim.model.quadratic
    if m is None:
        return sim.time.new_zeros(sim.num_worlds, 0), sim.time.new_zeros(sim.num_worlds, 0)
    scalar = variant("cuda" if sim.variant.world_fastest else "scalar", sim.model.precision)
    corner = allocate(sim.num_worlds, 12 * m.point_tet.shape[0], scalar.real, sim.device)
    with interop.on_torch_stream(sim.device):
        inputs = [m.element_node, sim._state.node_x]
        kernel = quadratic.kernels(scalar).point_corners
        wp.launch(kernel, scalar.dim(sim.num_worlds, m.count), inputs, [corner], device=sim.device)
        arrays = [m.point_tet, m.point_body, m.point_gradient, m.point_volume]
        return _of_laws(sim, m.law_points, arrays, corner)


def _of_laws(
    sim: Simulation, laws: dict[str, wp.array], arrays: list[wp.array], x: wp.array
) -> tuple[torch.Tensor, torch.Tensor]:
    """Energy and von Mises stress of tets given by their arrays, law by law."""
    m, real = sim.model, sim.variant.real
    shape = (m.num_worlds, arrays[0].shape[0])
    energy, stress = (wp.zeros(shape, dtype=real, device=m.device) for _ in range(2))
    for law, tets in laws.items():
        kernel = _kernels(real, "corotational" if law in corotational.TURNED else law).evaluate
        inputs = [tets, *arrays, sim._parameters.youngs, sim._parameters.nu, x]
        wp.launch(kernel, dim=(m.num_worlds, tets.size), inputs=inputs, outputs=[energy, stress], device=m.device)
    return wp.to_torch(energy), wp.to_torch(stress)


def elastic_energy(sim: Simulation) -> torch.Tensor:
    """Elastic energy of tets, rods and membranes [J], shape (world,)."""
    energy: torch.Tensor = _per_tet(sim)[0].sum(dim=1) + _per_point(sim)[0].sum(dim=1)
    return energy + segment_energy(sim).sum(dim=1) + _membrane_energy(sim)


def segment_energy(sim: Simulation) -> torch.Tensor:
    """Elastic energy of every rod segment [J], shape (world, segment)."""
    return _segments(sim)[1]


def segment_resultants(sim: Simulation) -> torch.Tensor:
    """Force [N] and moment [N m] that every rod segment transmits, in its material axes, shape (world, segment, 6)."""
    resultants: torch.Tensor = _segments(sim)[0].unflatten(1, (-1, 6))
    return resultants


def _segments(sim: Simulation) -> tuple[torch.Tensor, torch.Tensor]:
    import torch

    m, f, count = sim.model, sim.model.frames, sim.model.segment_count
    if f is None or count == 0:
        none = torch.zeros(m.num_worlds, 0, dtype=sim.time.dtype, device=sim.time.device)
        return none, none
    scalar = variant("cuda" if sim.variant.world_fastest else "scalar", m.precision)
    kernels, p = rod.kernels(scalar), sim._parameters
    strain, resultant = (allocate(m.num_worlds, 6 * count, scalar.real, m.device) for _ in range(2))
    energy = allocate(m.num_worlds, count, scalar.real, m.device)
    dim = scalar.dim(m.num_worlds, count)
    with interop.on_torch_stream(m.device):
        inputs = [f.seg_frame, f.seg_length, sim._state.frame_pose]
        wp.launch(kernels.strain, dim=dim, inputs=inputs, outputs=[strain], device=m.device)
        inputs = [f.seg_rod, f.seg_length, f.seg_section, f.seg_scale, f.seg_rest, p.rod_youngs, p.rod_nu, strain]
        wp.launch(kernels.resultant, dim=dim, inputs=inputs, outputs=[resultant, energy], device=m.device)
    return wp.to_torch(resultant), wp.to_torch(energy)


def _membrane_energy(sim: Simulation) -> torch.Tensor:
    """Plane-stress St. Venant-Kirchhoff energy of all membranes [J], shape (world,)."""
    import torch

    m, x = sim.model.membranes, sim.node_x
    if m is None:
        return torch.zeros_like(sim.time)
    tri = torch.as_tensor(m.triangles.astype(np.int64), device=x.device)
    edges = x[:, tri[:, 1:]] - x[:, tri[:, :1]]  # (world, tri, 2, 3)
    gradient = wp.to_torch(m.tri_gradient).unflatten(1, (2, 2))  # (tri, corner, axis)
    F = torch.einsum("wtac,tab->wtcb", edges, gradient.to(x))
    E = 0.5 * (torch.einsum("wtca,wtcb->wtab", F, F) - torch.eye(2).to(x))
    member = wp.to_torch(m.tri_membrane).long()
    youngs, nu = sim.params.membrane_youngs[:, member], sim.params.membrane_nu[:, member]
    mu, lam = youngs / (2.0 * (1.0 + nu)), youngs * nu / (1.0 - nu * nu)
    trace = E.diagonal(dim1=-2, dim2=-1).sum(dim=-1)
    density = mu * E.square().sum(dim=(-2, -1)) + 0.5 * lam * trace.square()
    energy: torch.Tensor = (density * wp.to_torch(m.tri_volume).to(x)).sum(dim=1)
    return energy


def frame_mass(sim: Simulation) -> torch.Tensor:
    """Mass of every frame [kg], shape (world, frame); nodes that frames carry have their own."""
    import torch

    f, p = sim.model.frames, sim.params
    if f is None:
        return torch.zeros(sim.num_worlds, 0, dtype=sim.time.dtype, device=sim.time.device)
    density = torch.cat([p.body_mass, p.rod_density], dim=1)
    mass: torch.Tensor = density[:, wp.to_torch(f.frame_owner).long()] * wp.to_torch(f.frame_volume)
    return mass


def kinetic_energy(sim: Simulation) -> torch.Tensor:
    """Kinetic energy of nodes and frames [J], shape (world,)."""
    energy: torch.Tensor = 0.5 * (_node_momentum(sim) * sim.node_v).sum(dim=(1, 2))
    if sim.model.frames is None:
        return energy
    spin = sim.frame_twist[..., 3:]
    energy = energy + 0.5 * (frame_mass(sim) * sim.frame_twist[..., :3].square().sum(dim=2)).sum(dim=1)
    return energy + 0.5 * (spin * _spin_momentum(sim)).sum(dim=(1, 2))


def potential_energy(sim: Simulation) -> torch.Tensor:
    """Energy of nodes and frames in the field of gravity, zero at the origin [J], shape (world,)."""
    import torch

    weight = torch.einsum("wn,wnc->wc", _node_weight(sim), sim.node_x)
    weight = weight + torch.einsum("wf,wfc->wc", frame_mass(sim), sim.frame_pose[..., :3])
    energy: torch.Tensor = -(weight * sim.params.gravity).sum(dim=1)
    return energy


def momentum(sim: Simulation) -> tuple[torch.Tensor, torch.Tensor]:
    """Linear [N s] and angular momentum about the origin [N m s] of everything, each of shape (world, 3)."""
    import torch

    node, frame = _node_momentum(sim), frame_mass(sim)[..., None] * sim.frame_twist[..., :3]
    linear: torch.Tensor = node.sum(dim=1) + frame.sum(dim=1)
    angular: torch.Tensor = torch.linalg.cross(sim.node_x, node).sum(dim=1)
    angular = angular + torch.linalg.cross(sim.frame_pose[..., :3], frame).sum(dim=1)
    if sim.model.frames is not None:
        angular = angular + _spin_momentum(sim).sum(dim=1)
    return linear, angular


def _node_momentum(sim: Simulation) -> torch.Tensor:
    """M v of all nodes [N s], shape (world, node, 3); the mass of quadratic tets is not diagonal."""
    import torch

    m, q, v = sim.model, sim.model.quadratic, sim.node_v
    momentum: torch.Tensor = node_mass(sim)[..., None] * v
    if q is None:
        return momentum
    dof_node = wp.to_torch(m.dof_node).long()
    count = wp.to_torch(q.mass_row_start).long().diff()
    row = dof_node[wp.to_torch(q.mass_row).long().repeat_interleave(count)]
    column = dof_node[wp.to_torch(q.mass_column).long()]
    mass = sim.params.density[:, wp.to_torch(m.node_body).long()[row]] * wp.to_torch(q.mass_column_volume)
    return torch.index_add(momentum, 1, row, mass[..., None] * v[:, column])


def _node_weight(sim: Simulation) -> torch.Tensor:
    """Mass that gravity finds at every node [kg], shape (world, node)."""
    import torch

    q, mass = sim.model.quadratic, node_mass(sim)
    if q is None:
        return mass
    node = wp.to_torch(q.weight_node).long()
    density = sim.params.density[:, wp.to_torch(sim.model.node_body).long()[node]]
    return torch.index_add(mass, 1, node, density * wp.to_torch(q.weight_volume))


def _spin_momentum(sim: Simulation) -> torch.Tensor:
    """R I R' w of every frame about its origin, shape (world, frame, 3)."""
    import torch

    f, p = sim.model.frames, sim.params
    assert f is not None
    density = torch.cat([p.body_mass, p.rod_density], dim=1)[:, wp.to_torch(f.frame_owner).long()]
    six = wp.to_torch(f.frame_inertia)
    inertia = six[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].unflatten(1, (3, 3))
    u, s = sim.frame_pose[..., 3:6], sim.frame_pose[..., 6:]

    def turned(v: torch.Tensor, sign: float) -> torch.Tensor:
        twice = 2.0 * torch.linalg.cross(sign * u, v)
        result: torch.Tensor = v + s * twice + torch.linalg.cross(sign * u, twice)
        return result

    body = torch.einsum("fij,wfj->wfi", inertia, turned(sim.frame_twist[..., 3:], -1.0))
    return turned(density[..., None] * body, 1.0)


def node_stress(sim: Simulation) -> torch.Tensor:
    """Von Mises stress [Pa] averaged to nodes with the volumes of tets, or of Gauss points, shape (world, node).

    A Gauss point of a quadratic tet counts for the corner that it is near and for the nodes of that corner's edges.
    """
    import torch

    m, stress = sim.model, _per_tet(sim)[1]
    weight = torch.zeros(m.node_count, dtype=stress.dtype, device=stress.device)
    total = torch.zeros(m.num_worlds, m.node_count, dtype=stress.dtype, device=stress.device)
    parts = [(m.tet_corners, m.tet_volume, stress)]
    if m.quadratic is not None:
        near = m.quadratic.nodes[:, [[0, 4, 5, 6], [1, 4, 7, 8], [2, 5, 7, 9], [3, 6, 8, 9]]].reshape(-1, 4)
        parts.append((near, m.quadratic.point_volume, _per_point(sim)[1]))
    for node, size, value in parts:
        corners = torch.as_tensor(node.astype(np.int64), device=stress.device)
        volume = wp.to_torch(size).to(stress.dtype)
        for corner in range(4):
            weight.index_add_(0, corners[:, corner], volume)
            total.index_add_(1, corners[:, corner], value * volume)
    average: torch.Tensor = total / weight
    return average


def _gather(sim: Simulation, name: str, rows: int) -> torch.Tensor:
    """A workspace array of all shards as (world, row)."""
    import torch

    parts = []
    for system in sim._systems:
        value: Any = wp.to_torch(getattr(system, name).real)
        parts.append(value.permute(0, 2, 1).flatten(0, 1)[: system.world_count])
    gathered: torch.Tensor = torch.cat(parts).clone()
    return gathered


def _evaluate(sim: Simulation, tangent: bool) -> None:
    with interop.on_torch_stream(sim.device):
        for system in sim._systems:
            system.load()
            system.scale(0.0)
            system.body["mass"].zero()
            system.forces()
            if tangent:
                system.tangent()


def internal_force(sim: Simulation) -> torch.Tensor:
    """Elastic force dE/dx [N], shape (world, node, 3)."""
    _evaluate(sim, tangent=False)
    count = sim.model.node_count
    force: torch.Tensor = _gather(sim, "node_internal", 3 * count).unflatten(1, (count, 3))
    return force


def node_mass(sim: Simulation) -> torch.Tensor:
    """Lumped mass [kg], shape (world, node); that of quadratic tets is consistent in a step, and only here lumped."""
    _evaluate(sim, tangent=False)
    return _gather(sim, "node_mass", sim.model.node_count)


def stiffness_matrix(sim: Simulation, world: int = 0) -> Any:
    """K of one world over all node scalars, rows and columns of fixed nodes empty, as SciPy CSR."""
    from scipy.sparse import coo_array

    _evaluate(sim, tangent=True)
    symbolic, dof_node = sim.model.symbolic, sim.model.dof_node.numpy()
    blocks = _gather(sim, "a", 9 * len(symbolic.a_row))[world].cpu().numpy().reshape(-1, 3, 3)
    row, col = dof_node[symbolic.a_row], dof_node[symbolic.a_col]
    lower = slice(symbolic.size, None)
    blocks = np.concatenate([blocks, blocks[lower].transpose(0, 2, 1)])
    row, col = np.concatenate([row, col[lower]]), np.concatenate([col, row[lower]])
    c = np.arange(3)
    rows = np.broadcast_to(3 * row[:, None, None] + c[None, :, None], blocks.shape)
    cols = np.broadcast_to(3 * col[:, None, None] + c[None, None, :], blocks.shape)
    size = 3 * sim.model.node_count
    return coo_array((blocks.ravel(), (rows.ravel(), cols.ravel())), shape=(size, size)).tocsr()


def tangent_product(sim: Simulation, direction: torch.Tensor) -> torch.Tensor:
    """K d [N], shape (world, node, 3); entries of fixed nodes count as zero."""
    import torch

    if tuple(direction.shape) != (sim.num_worlds, sim.model.node_count, 3):
        raise ValueError(
            f"direction must have shape ({sim.num_worlds}, {sim.model.node_count}, 3), got {tuple(direction.shape)}"
        )
    flat = direction.detach().cpu().double().numpy().reshape(sim.num_worlds, -1)
    product = np.stack([stiffness_matrix(sim, world) @ flat[world] for world in range(sim.num_worlds)])
    result: torch.Tensor = torch.from_numpy(product).to(direction).reshape(direction.shape)
    return result
