"""Energies, forces, tangents and stresses at the present positions. These allocate; steps do not.

Functions of ``model, state, parameters`` read these alone. What a step assembles (elastic forces, stiffness, lumped
mass) comes from the ``systems`` that step the worlds, in the order of their worlds, and overwrites their workspace.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from softwarp import checks, hex_tensors, interop
from softwarp.kernels.algebra.lanes import Variant, variant
from softwarp.kernels.elements import energy, quadratic, rod
from softwarp.model.codes import TURNED
from softwarp.model.model import Model
from softwarp.model.state import Parameters, State
from softwarp.solvers.system import System
from softwarp.solvers.workspace.rows import Rows
from softwarp.threads import alone

if TYPE_CHECKING:
    import torch

# Nodes of a quadratic tet that each of its Gauss points counts for
AROUND_CORNERS = [[0, 4, 5, 6], [1, 4, 7, 8], [2, 5, 7, 9], [3, 6, 8, 9]]


def plain_variant(model: Model) -> Variant:
    """The variant whose elements hold one world each, as arrays of the state do."""
    return variant("cuda" if wp.get_device(model.device).is_cuda else "scalar", model.precision)


def _none(model: Model, *shape: int) -> torch.Tensor:
    """Zeros of a shape for every world; torch has the memory, so that they may be made within a recorded step."""
    import torch

    real = torch.float64 if model.precision == "float64" else torch.float32
    return torch.zeros(model.num_worlds, *shape, dtype=real, device=wp.device_to_torch(model.device))


def _per_tet(model: Model, state: State, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
    """Energy and von Mises stress per linear tet, shape (world, tet)."""
    with interop.on_torch_stream(model.device):
        arrays = [model.tet_node, model.tet_body, model.tet_gradient, model.tet_volume]
        return _of_laws(model, parameters, model.law_tets, arrays, state.node_x)


def _per_point(model: Model, state: State, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
    """Energy and von Mises stress per Gauss point of the quadratic tets, shape (world, point)."""
    m = model.quadratic
    if m is None:
        return _none(model, 0), _none(model, 0)
    scalar = plain_variant(model)
    corner = wp.from_torch(_none(model, 12 * m.point_tet.shape[0]))
    with interop.on_torch_stream(model.device):
        inputs = [m.element_node, state.node_x]
        kernel = quadratic.kernels(scalar).point_corners
        wp.launch(kernel, scalar.dim(model.num_worlds, m.count), inputs, [corner], device=model.device)
        arrays = [m.point_tet, m.point_body, m.point_gradient, m.point_volume]
        return _of_laws(model, parameters, m.law_points, arrays, corner)


def _of_laws(
    model: Model, parameters: Parameters, laws: dict[str, wp.array], arrays: list[wp.array], x: wp.array
) -> tuple[torch.Tensor, torch.Tensor]:
    """Energy and von Mises stress of tets given by their arrays, law by law."""
    scalar, worlds, device = plain_variant(model), model.num_worlds, model.device
    found = [_none(model, arrays[0].shape[0]) for _ in range(2)]
    outputs = [wp.from_torch(value) for value in found]
    for law, tets in laws.items():
        kernel = energy.kernels(scalar, "corotational" if law in TURNED else law).evaluate
        inputs = [tets, *arrays, model.body_law_start, model.body_guard]
        inputs += [parameters.youngs, parameters.nu, parameters.law_parameter, x]
        wp.launch(kernel, scalar.dim(worlds, tets.size), inputs, outputs, device=device)
    return found[0], found[1]


@alone
def elastic_energy(model: Model, state: State, parameters: Parameters) -> torch.Tensor:
    """Elastic energy of tets, hexahedra, rods and membranes [J], shape (world,)."""
    of_tets, _ = _per_tet(model, state, parameters)
    of_points, _ = _per_point(model, state, parameters)
    total: torch.Tensor = of_tets.sum(dim=1) + of_points.sum(dim=1)
    if model.hexes is not None:
        total = total + hex_tensors.energy(model, state, parameters).sum(dim=1)
    return total + segment_energy(model, state, parameters).sum(dim=1) + _membrane_energy(model, state, parameters)


@alone
def segment_energy(model: Model, state: State, parameters: Parameters) -> torch.Tensor:
    """Elastic energy of every rod segment [J], shape (world, segment)."""
    return _segments(model, state, parameters)[1]


@alone
def segment_resultants(model: Model, state: State, parameters: Parameters) -> torch.Tensor:
    """Force [N] and moment [N m] that every rod segment transmits, in its material axes, shape (world, segment, 6)."""
    resultants: torch.Tensor = _segments(model, state, parameters)[0].unflatten(1, (-1, 6))
    return resultants


def _segments(model: Model, state: State, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
    f, p, count, worlds, device = model.frames, parameters, model.segment_count, model.num_worlds, model.device
    if f is None or count == 0:
        return _none(model, 0), _none(model, 0)
    scalar = plain_variant(model)
    kernels, law = rod.kernels(scalar, varying=model.telescopes is not None), state.segment_law
    resultant, stored = _none(model, 6 * count), _none(model, count)
    strain, outputs = wp.from_torch(_none(model, 6 * count)), [wp.from_torch(value) for value in (resultant, stored)]
    dim = scalar.dim(worlds, count)
    with interop.on_torch_stream(device):
        inputs = [f.seg_frame, f.seg_length, law, state.frame_pose]
        wp.launch(kernels.strain, dim=dim, inputs=inputs, outputs=[strain], device=device)
        inputs = [f.seg_rod, f.seg_length, f.seg_section, f.seg_scale, f.seg_rest, p.rod_youngs, p.rod_nu, law, strain]
        wp.launch(kernels.resultant, dim=dim, inputs=inputs, outputs=outputs, device=device)
    return resultant, stored


def _membrane_energy(model: Model, state: State, parameters: Parameters) -> torch.Tensor:
    """Plane-stress St. Venant-Kirchhoff energy of all membranes [J], shape (world,)."""
    import torch

    m = model.membranes
    if m is None:
        return _none(model)
    x, p = interop.named_view(state, model, "node_x"), interop.views(parameters, model)
    tri = wp.to_torch(m.tri_node).long()
    edges = x[:, tri[:, 1:]] - x[:, tri[:, :1]]  # (world, tri, 2, 3)
    gradient = wp.to_torch(m.tri_gradient).unflatten(1, (2, 2))  # (tri, corner, axis)
    F = torch.einsum("wtac,tab->wtcb", edges, gradient.to(x))
    E = 0.5 * (torch.einsum("wtca,wtcb->wtab", F, F) - torch.eye(2, dtype=x.dtype, device=x.device))
    member = wp.to_torch(m.tri_membrane).long()
    youngs, nu = p["membrane_youngs"][:, member], p["membrane_nu"][:, member]
    mu, lam = youngs / (2.0 * (1.0 + nu)), youngs * nu / (1.0 - nu * nu)
    trace = E.diagonal(dim1=-2, dim2=-1).sum(dim=-1)
    density = mu * E.square().sum(dim=(-2, -1)) + 0.5 * lam * trace.square()
    total: torch.Tensor = (density * wp.to_torch(m.tri_volume).to(x)).sum(dim=1)
    return total


@alone
def frame_mass(model: Model, parameters: Parameters) -> torch.Tensor:
    """Mass of every frame [kg], shape (world, frame); nodes that frames carry have their own."""
    if model.frames is None:
        return _none(model, 0)
    mass: torch.Tensor = _frame_density(model, parameters) * wp.to_torch(model.frames.frame_volume)
    return mass


def _frame_density(model: Model, parameters: Parameters) -> torch.Tensor:
    """What the volume and inertia of every frame are multiplied by, shape (world, frame)."""
    import torch

    assert model.frames is not None
    held = [interop.named_view(parameters, model, name) for name in ("body_mass", "rod_density")]
    density = torch.cat(held, dim=1)
    return density[:, wp.to_torch(model.frames.frame_owner).long()]


@alone
def kinetic_energy(model: Model, state: State, parameters: Parameters, mass: torch.Tensor) -> torch.Tensor:
    """Kinetic energy of nodes and frames [J], shape (world,); ``mass`` is that of nodes, see ``node_mass``."""
    s = interop.views(state, model)
    total: torch.Tensor = 0.5 * (_node_momentum(model, state, parameters, mass) * s["node_v"]).sum(dim=(1, 2))
    if model.frames is None:
        return total
    v, spin = s["frame_twist"][..., :3], s["frame_twist"][..., 3:]
    total = total + 0.5 * (frame_mass(model, parameters) * v.square().sum(dim=2)).sum(dim=1)
    return total + 0.5 * (spin * _spin_momentum(model, state, parameters)).sum(dim=(1, 2))


@alone
def potential_energy(model: Model, state: State, parameters: Parameters, mass: torch.Tensor) -> torch.Tensor:
    """Energy of nodes and frames in the field of gravity, zero at the origin [J], shape (world,).

    ``mass`` is that of nodes, see ``node_mass``.
    """
    import torch

    s, p = interop.views(state, model), interop.views(parameters, model)
    weight = torch.einsum("wn,wnc->wc", _node_weight(model, parameters, mass), s["node_x"])
    weight = weight + torch.einsum("wf,wfc->wc", frame_mass(model, parameters), s["frame_pose"][..., :3])
    total: torch.Tensor = -(weight * p["gravity"]).sum(dim=1)
    return total


@alone
def momentum(
    model: Model, state: State, parameters: Parameters, mass: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Linear [N s] and angular momentum about the origin [N m s] of everything, each of shape (world, 3).

    ``mass`` is that of nodes, see ``node_mass``.
    """
    import torch

    s = interop.views(state, model)
    node = _node_momentum(model, state, parameters, mass)
    frame = frame_mass(model, parameters)[..., None] * s["frame_twist"][..., :3]
    linear: torch.Tensor = node.sum(dim=1) + frame.sum(dim=1)
    angular: torch.Tensor = torch.linalg.cross(s["node_x"], node).sum(dim=1)
    angular = angular + torch.linalg.cross(s["frame_pose"][..., :3], frame).sum(dim=1)
    if model.frames is not None:
        angular = angular + _spin_momentum(model, state, parameters).sum(dim=1)
    return linear, angular


def _node_momentum(model: Model, state: State, parameters: Parameters, mass: torch.Tensor) -> torch.Tensor:
    """M v of all nodes [N s], shape (world, node, 3); the mass of quadratic tets is not diagonal."""
    import torch

    q, v = model.quadratic, interop.named_view(state, model, "node_v")
    result: torch.Tensor = mass[..., None] * v
    if q is None:
        return result
    dof_node = wp.to_torch(model.dof_node).long()
    count = wp.to_torch(q.mass_row_start).long().diff()
    row = dof_node[wp.to_torch(q.mass_row).long().repeat_interleave(count, output_size=q.mass_column.size)]
    column = dof_node[wp.to_torch(q.mass_column).long()]
    entry = _node_density(model, parameters, row) * wp.to_torch(q.mass_column_volume)
    return torch.index_add(result, 1, row, entry[..., None] * v[:, column])


def _node_weight(model: Model, parameters: Parameters, mass: torch.Tensor) -> torch.Tensor:
    """Mass that gravity finds at every node [kg], shape (world, node)."""
    import torch

    q = model.quadratic
    if q is None:
        return mass
    node = wp.to_torch(q.weight_node).long()
    return torch.index_add(mass, 1, node, _node_density(model, parameters, node) * wp.to_torch(q.weight_volume))


def _node_density(model: Model, parameters: Parameters, node: torch.Tensor) -> torch.Tensor:
    """Density of the bodies that some nodes belong to [kg/m^3], shape (world, node)."""
    density = interop.named_view(parameters, model, "density")
    return density[:, wp.to_torch(model.node_body).long()[node]]


def _spin_momentum(model: Model, state: State, parameters: Parameters) -> torch.Tensor:
    """R I R' w of every frame about its origin, shape (world, frame, 3)."""
    import torch

    assert model.frames is not None
    pose, twist = (interop.named_view(state, model, name) for name in ("frame_pose", "frame_twist"))
    six = wp.to_torch(model.frames.frame_inertia)
    inertia = torch.stack([six[:, k] for k in (0, 3, 4, 3, 1, 5, 4, 5, 2)], dim=1).unflatten(1, (3, 3))
    u, s = pose[..., 3:6], pose[..., 6:]

    def turned(v: torch.Tensor, sign: float) -> torch.Tensor:
        twice = 2.0 * torch.linalg.cross(sign * u, v)
        result: torch.Tensor = v + s * twice + torch.linalg.cross(sign * u, twice)
        return result

    body = torch.einsum("fij,wfj->wfi", inertia, turned(twist[..., 3:], -1.0))
    return turned(_frame_density(model, parameters)[..., None] * body, 1.0)


@alone
def node_stress(model: Model, state: State, parameters: Parameters) -> torch.Tensor:
    """Von Mises stress [Pa] averaged to nodes with the volumes of elements, or of Gauss points, shape (world, node).

    A Gauss point of a quadratic tet counts for the corner that it is near and for the nodes of that corner's edges.
    """
    import torch

    m, q = model, model.quadratic
    _, stress = _per_tet(model, state, parameters)
    weight = torch.zeros(m.node_count, dtype=stress.dtype, device=stress.device)
    total = torch.zeros(m.num_worlds, m.node_count, dtype=stress.dtype, device=stress.device)
    parts = [(m.tet_corners, m.tet_volume, stress)]
    if q is not None:
        near = q.nodes[:, AROUND_CORNERS].reshape(-1, 4)
        parts.append((near, q.point_volume, _per_point(model, state, parameters)[1]))
    if m.hexes is not None:
        cauchy, _ = hex_tensors.stress_and_strain(m, state, parameters)
        deviator = cauchy - torch.einsum("...cc,ij->...ij", cauchy, torch.eye(3).to(cauchy) / 3.0)
        parts.append((m.hexes.nodes, m.hexes.hex_volume, (1.5 * deviator.square().sum(dim=(-2, -1))).sqrt()))
    for node, size, value in parts:
        corners = torch.as_tensor(node.astype(np.int64), device=stress.device)
        volume = wp.to_torch(size).to(stress.dtype)
        for corner in range(node.shape[1]):
            weight.index_add_(0, corners[:, corner], volume)
            total.index_add_(1, corners[:, corner], value * volume)
    average: torch.Tensor = total / weight
    return average


def _evaluated(systems: Sequence[System], *wanted: tuple[str, int], tangent: bool = False) -> list[torch.Tensor]:
    """The first rows of inputs and workspace arrays, as (world, row), after forces at the present positions.

    Args:
        systems: Of all worlds, in their order; they may share a workspace.
        wanted: Names and numbers of rows.
        tangent: Evaluate A as well, which is the stiffness.
    """
    import torch

    parts: list[list[torch.Tensor]] = [[] for _ in wanted]
    with interop.on_torch_stream(systems[0].model.device):
        for system in systems:
            system.load()
            system.scale(0.0, inertia=False)
            system.forces()
            if tangent:
                system.tangent()
            held = system.shard.input | vars(system.work)
            for part, (name, count) in zip(parts, wanted, strict=True):
                part.append(by_world(system, held[name], count))
    return [torch.cat(part) for part in parts]


def by_world(system: System, rows: Rows, count: int) -> torch.Tensor:
    """Copy of the first rows of a workspace array as (world, row)."""
    value: Any = wp.to_torch(rows.real)
    copy: torch.Tensor = value.permute(0, 2, 1).flatten(0, 1)[: system.world_count, :count].clone()
    return copy


@alone
def internal_force(systems: Sequence[System]) -> torch.Tensor:
    """Elastic force dE/dx [N], shape (world, node, 3)."""
    count = systems[0].model.node_count
    (rows,) = _evaluated(systems, ("node_internal", 3 * count))
    force: torch.Tensor = rows.unflatten(1, (count, 3))
    return force


@alone
def element_forces(systems: Sequence[System]) -> torch.Tensor:
    """Elastic forces of corners [N], (world, row): 12 a tet or membrane triangle, 30 a quadratic tet, 24 a hex."""
    return _evaluated(systems, ("element_force", int(systems[0].work.element_force.real.shape[1])))[0]


@alone
def point_forces(systems: Sequence[System]) -> torch.Tensor:
    """Elastic forces of the tets at Gauss points of quadratic elements [N], (world, 48 an element): 12 a point."""
    return _evaluated(systems, ("gauss_force", int(systems[0].work.gauss_force.real.shape[1])))[0]


@alone
def node_mass(systems: Sequence[System]) -> torch.Tensor:
    """Lumped mass [kg], shape (world, node); that of quadratic tets is consistent in a step, and only here lumped."""
    return _evaluated(systems, ("node_mass", systems[0].model.node_count))[0]


def refuse_frames(model: Model, what: str) -> None:
    """Refuse scenes whose unknowns are no node scalars."""
    if model.frames is not None:
        raise ValueError(
            f"{what}: the scene has {model.rod_count} rods and {model.rigid_count} rigid bodies, which turn "
            "and carry nodes, so that K is none over node scalars alone; build the soft bodies in a scene of their own"
        )


def _assembled(model: Model, stored: torch.Tensor, upper: Any = None) -> Any:
    """A over all node scalars from its stored blocks; ``upper`` has transposes of others above the diagonal."""
    from scipy.sparse import coo_array

    symbolic, dof_node = model.symbolic, model.dof_node.numpy()
    blocks = stored.cpu().numpy().reshape(-1, 3, 3)
    row, col = dof_node[symbolic.a_row], dof_node[symbolic.a_col]
    lower = slice(symbolic.size, None)
    above = blocks if upper is None else upper.reshape(-1, 3, 3)
    blocks = np.concatenate([blocks, above[lower].transpose(0, 2, 1)])
    row, col = np.concatenate([row, col[lower]]), np.concatenate([col, row[lower]])
    c = np.arange(3)
    rows = np.broadcast_to(3 * row[:, None, None] + c[None, :, None], blocks.shape)
    cols = np.broadcast_to(3 * col[:, None, None] + c[None, None, :], blocks.shape)
    size = 3 * model.node_count
    return coo_array((blocks.ravel(), (rows.ravel(), cols.ravel())), shape=(size, size)).tocsr()


@alone
def stiffness_matrix(systems: Sequence[System], world: int = 0) -> Any:
    """K of one world over all node scalars, rows and columns of fixed nodes empty, as SciPy CSR.

    Raises:
        ValueError: If the scene has rods or rigid bodies, whose unknowns are no node scalars, or no such world.
    """
    model = systems[0].model
    refuse_frames(model, "stiffness_matrix")
    world = checks.count(world, f"world of {model.num_worlds}", low=0, high=model.num_worlds - 1)
    (stored,) = _evaluated(systems, ("a", 9 * len(model.symbolic.a_row)), tangent=True)
    return _assembled(model, stored[world])


@alone
def exact_stiffness(system: System, world: int) -> Any:
    """The same with the turning of rotations and the tangent of cables, of a system with room for them."""
    upper = system.shard.rows(9 * system.shard.blocks)
    with interop.on_torch_stream(system.model.device):
        system.load()
        system.scale(0.0, inertia=False)
        system.move(1.0)
        system.measure_rows()
        system.forces()
        system.tangent()
        system.exact_tangent(upper)
    pack, lane = divmod(world, system.shard.lanes)
    stored = by_world(system, system.work.a, 9 * system.shard.blocks)[world]
    return _assembled(system.model, stored, upper.real.numpy()[pack, :, lane])


@alone
def mass_matrix(systems: Sequence[System], world: int = 0) -> Any:
    """M of one world over all node scalars [kg], as SciPy CSR: lumped, and of quadratic tets consistent.

    Rows and columns of fixed nodes are empty.

    Raises:
        ValueError: If the scene has rods or rigid bodies, or no such world.
    """
    from scipy.sparse import coo_array, diags_array, kron

    model, q = systems[0].model, systems[0].model.quadratic
    refuse_frames(model, "mass_matrix")
    world = checks.count(world, f"world of {model.num_worlds}", low=0, high=model.num_worlds - 1)
    found = _evaluated(systems, ("node_mass", model.node_count), ("density", model.body_count))
    mass, density = (rows[world].double().cpu().numpy() for rows in found)
    M = diags_array(mass).tocsr()
    if q is not None:
        start, dof_node = q.mass_row_start.numpy(), model.dof_node.numpy()
        item = np.repeat(np.arange(len(start) - 1), np.diff(start))
        row, col = dof_node[q.mass_row.numpy()[item]], q.mass_column_node.numpy()
        value = density[q.mass_row_body.numpy()[item]] * q.mass_column_volume.numpy()
        M = M + coo_array((value, (row, col)), shape=M.shape).tocsr()
    free = diags_array((~model.node_fixed).astype(np.float64))
    return kron(free @ M @ free, np.eye(3)).tocsr()


@alone
def tangent_product(systems: Sequence[System], direction: torch.Tensor) -> torch.Tensor:
    """K d [N], shape (world, node, 3); entries of fixed nodes count as zero.

    Raises:
        ValueError: If ``direction`` has another shape, or the scene has rods or rigid bodies.
    """
    import torch

    model = systems[0].model
    expected = (model.num_worlds, model.node_count, 3)
    if not isinstance(direction, torch.Tensor) or tuple(direction.shape) != expected:
        raise ValueError(checks.refusal("direction", f"be a tensor of shape {expected}", direction))
    flat = direction.detach().cpu().double().numpy().reshape(model.num_worlds, -1)
    product = np.stack([stiffness_matrix(systems, world) @ flat[world] for world in range(model.num_worlds)])
    result: torch.Tensor = torch.from_numpy(product).to(direction).reshape(direction.shape)
    return result
