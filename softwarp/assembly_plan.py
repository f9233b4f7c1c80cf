"""From the builder's lists to the arrays of a model: numbering, incidence lists and the structure of A. Host only."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp import meshing
from softwarp.fields import real_of
from softwarp.kernels.cable import UNBOUNDED
from softwarp.model import Model
from softwarp.solvers.symbolic import Symbolic, analyze

if TYPE_CHECKING:
    from softwarp.builder import ModelBuilder

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]
CORNER_PAIRS = [(a, b) for a in range(4) for b in range(a)]


def plan(builder: ModelBuilder, num_worlds: int, device: str, precision: str) -> Model:
    """Build the model of a scene on a device.

    Raises:
        ValueError: For an empty scene, a body without free nodes, a world count below 1, an unknown precision or a
            device that this machine does not have.
    """
    if isinstance(num_worlds, bool) or not isinstance(num_worlds, (int, np.integer)) or num_worlds < 1:
        raise ValueError(f"num_worlds must be an integer of at least 1, got {num_worlds!r}")
    real = real_of(precision)
    device = checked_device(device)
    if not builder.bodies:
        raise ValueError("the scene is empty: add a body with add_tets before finalize")
    host = _host_arrays(builder)
    arrays = _upload(host.pop("device"), device, real)
    law_tets = {law: wp.array(tets, dtype=wp.int32, device=device) for law, tets in host.pop("law_tets").items()}
    return Model(num_worlds=int(num_worlds), device=device, precision=precision, law_tets=law_tets, **host, **arrays)


def coupled(model: Model) -> Model:
    """The same scene with room in A for the stiffness of taut cables, which ties the ends of each segment together.

    Only the order of ``dof`` and what follows from it differ; states and commands serve both models.
    """
    if model.cable_count == 0:
        return model
    is_large = np.zeros(model.tet_count, dtype=bool)
    if "large" in model.law_tets:
        is_large[model.law_tets["large"].numpy()] = True
    points = {name: getattr(model, name).numpy() for name in ("point_node", "point_weight")}
    starts = model.cable_starts
    symbolic, structure = _structure(
        model.node_rest, model.tet_corners, model.node_fixed, is_large, starts, points, with_segments=True
    )
    return replace(model, symbolic=symbolic, **_upload(structure, model.device, real_of(model.precision)))


def _upload(arrays: dict[str, NDArray[Any]], device: str, real: Any) -> dict[str, wp.array]:
    """Copy arrays to a device, floating point ones as ``real``."""
    return {
        name: wp.array(
            np.ascontiguousarray(value, dtype=wp.dtype_to_numpy(real) if value.dtype.kind == "f" else np.int32),
            dtype=real if value.dtype.kind == "f" else wp.int32,
            device=device,
        )
        for name, value in arrays.items()
    }


def checked_device(device: str) -> str:
    """Name of an existing Warp device.

    Raises:
        ValueError: If there is no such device; the message lists those that exist.
    """
    wp.init()
    names = [str(d) for d in wp.get_devices()]
    wanted = "cuda:0" if str(device) == "cuda" else str(device)
    if wanted not in names:
        raise ValueError(f"device {device!r} is not available on this machine; available: {', '.join(names)}")
    return wanted


def _host_arrays(builder: ModelBuilder) -> dict[str, Any]:
    bodies = builder.bodies
    node_start = np.concatenate([[0], np.cumsum([len(b.mesh.nodes) for b in bodies])]).astype(np.int32)
    tet_start = np.concatenate([[0], np.cumsum([len(b.mesh.tets) for b in bodies])]).astype(np.int32)
    nodes = np.concatenate([b.mesh.nodes for b in bodies])
    tets = np.concatenate([b.mesh.tets + s for b, s in zip(bodies, node_start[:-1], strict=True)]).astype(np.int32)
    tet_body = np.repeat(np.arange(len(bodies)), np.diff(tet_start)).astype(np.int32)
    node_body = np.repeat(np.arange(len(bodies)), np.diff(node_start)).astype(np.int32)
    fixed = np.concatenate([b.fixed for b in bodies])
    if fixed.all():
        raise ValueError("every node of the scene is fixed, so nothing can move; fix fewer nodes")
    gradient, volume, frame = rest_geometry(nodes, tets)
    node_volume = np.concatenate([_lumped_volume(b, volume[s:e]) for b, s, e in _ranges(bodies, tet_start)])

    laws = np.array([b.material.kernel_law for b in bodies])[tet_body]
    cable_host, cable_device = _cables(builder, tet_start, tets)
    symbolic, structure = _structure(nodes, tets, fixed, laws == "large", cable_host["cable_starts"], cable_device)
    corner_start, corner = _lists(tets.ravel(), np.arange(tets.size), len(nodes))
    marker_node, marker_weight = _markers(builder, tet_start, tets)

    surfaces = [meshing.tet_surface(b.mesh.tets) for b in bodies]
    host: dict[str, Any] = {
        "body_names": tuple(b.name for b in bodies),
        "cable_names": tuple(c.name for c in builder.cables),
        "marker_names": tuple(m.name for m in builder.markers),
        "node_rest": nodes,
        "tet_corners": tets,
        "body_node_start": node_start,
        "node_fixed": fixed,
        "surface_tri": np.concatenate([s + n for s, n in zip(surfaces, node_start[:-1], strict=True)]).astype(np.int32),
        "tri_body": np.repeat(np.arange(len(bodies)), [len(s) for s in surfaces]).astype(np.int32),
        **cable_host,
        "defaults": _defaults(builder),
        "law_tets": {str(law): np.flatnonzero(laws == law).astype(np.int32) for law in np.unique(laws)},
        "symbolic": symbolic,
        "extent": float(np.linalg.norm(np.ptp(nodes, axis=0))),
    }
    host["device"] = {
        "tet_node": tets,
        "tet_body": tet_body,
        "tet_gradient": gradient,
        "tet_volume": volume,
        "tet_frame": frame,
        "node_body": node_body,
        "node_volume": node_volume,
        "node_load": np.concatenate([b.load for b in bodies]),
        "corner_start": corner_start,
        "corner": corner,
        "marker_node": marker_node,
        "marker_weight": marker_weight,
        "marker_anchor": np.zeros((len(builder.markers), 3)),
        **cable_device,
        **structure,
    }
    host["fingerprint"] = _fingerprint(builder, host)
    return host


def _structure(
    nodes: FloatArray,
    tets: IntArray,
    fixed: NDArray[np.bool_],
    is_large: NDArray[np.bool_],
    cable_starts: IntArray,
    points: dict[str, NDArray[Any]],
    with_segments: bool = False,
) -> tuple[Symbolic, dict[str, NDArray[Any]]]:
    """Elimination order and all index lists that follow from it; ``with_segments`` couples the ends of each segment."""
    free = np.flatnonzero(~fixed)
    index = np.full(len(nodes), -1, dtype=np.int64)
    index[free] = np.arange(free.size)
    edges = np.concatenate([tets[:, [a, b]] for a, b in CORNER_PAIRS])
    segment, carrier, share = _segments(cable_starts, points)
    if with_segments:
        low, high = np.tril_indices(8, -1)
        used = (share[:, low] != 0.0) & (share[:, high] != 0.0)
        edges = np.concatenate([edges, np.stack([carrier[:, low][used], carrier[:, high][used]], axis=1)])
    edges = index[edges]
    symbolic = analyze(edges[(edges >= 0).all(axis=1)].astype(np.int32), free.size, nodes[free])
    dof_node = free[symbolic.order].astype(np.int32)
    node_dof = np.full(len(nodes), -1, dtype=np.int32)
    node_dof[dof_node] = np.arange(free.size, dtype=np.int32)
    large_start, large_entry = _block_entries(symbolic, node_dof, tets, np.flatnonzero(is_large))
    stored_start, stored_entry = _block_entries(symbolic, node_dof, tets, np.flatnonzero(~is_large))
    neighbour_start, neighbour, neighbour_block = _neighbours(symbolic)
    couplings = _couplings(symbolic, node_dof, segment, carrier, share if with_segments else share[:0])
    arrays: dict[str, NDArray[Any]] = {
        "node_dof": node_dof,
        "dof_node": dof_node,
        "large_entry_start": large_start,
        "large_entry": large_entry,
        "stored_entry_start": stored_start,
        "stored_entry": stored_entry,
        "neighbour_start": neighbour_start,
        "neighbour": neighbour,
        "neighbour_block": neighbour_block,
        **couplings,
        **_row_entries(cable_starts, points, node_dof, free.size),
    }
    return symbolic, arrays


def rest_geometry(nodes: FloatArray, tets: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Shape gradients of corners 1 to 3 (tet, 9), volumes (tet,) and rest frames by rows (tet, 9)."""
    x = nodes[tets]
    edges = x[:, 1:] - x[:, :1]  # rows are edges
    volume = np.linalg.det(edges) / 6.0
    gradient = np.linalg.inv(edges).transpose(0, 2, 1)  # row b is grad N_b
    e1 = edges[:, 0] / np.linalg.norm(edges[:, 0], axis=1, keepdims=True)
    e3 = np.cross(e1, edges[:, 1])
    e3 /= np.linalg.norm(e3, axis=1, keepdims=True)
    frame = np.stack([e1, np.cross(e3, e1), e3], axis=2)  # columns are axes
    return (
        gradient.reshape(-1, 9).astype(np.float64),
        np.asarray(volume),
        np.asarray(frame.reshape(-1, 9), dtype=np.float64),
    )


def _ranges(items: list[Any], start: IntArray) -> list[tuple[Any, int, int]]:
    return [(item, int(start[i]), int(start[i + 1])) for i, item in enumerate(items)]


def _lumped_volume(body: Any, volume: FloatArray) -> FloatArray:
    count = len(body.mesh.nodes)
    if body.lumping == "uniform":
        return np.full(count, volume.sum() / count)
    shares = np.bincount(body.mesh.tets.ravel(), np.repeat(volume / 4.0, 4), minlength=count)
    return shares.astype(np.float64)


def _lists(keys: NDArray[Any], values: NDArray[Any], count: int) -> tuple[IntArray, IntArray]:
    """Group ``values`` by ``keys`` into (start, list); values keep their order within a key."""
    order = np.argsort(keys, kind="stable")
    start = np.searchsorted(keys[order], np.arange(count + 1))
    return start.astype(np.int32), values[order].astype(np.int32)


def _block_entries(symbolic: Symbolic, node_dof: IntArray, tets: IntArray, chosen: NDArray[Any]) -> Any:
    """For every stored block (i, j) of A the element blocks ``16 tet + 4 a + b`` whose corners are i and j."""
    keys, codes = [], []
    dof = node_dof[tets[chosen]].astype(np.int64)
    for a in range(4):
        for b in range(4):
            i, j = dof[:, a], dof[:, b]
            keep = (i >= 0) & (j >= 0) & (i >= j)
            keys.append(_block_of(symbolic, i[keep], j[keep]))
            codes.append(16 * chosen[keep] + 4 * a + b)
    return _lists(np.concatenate(keys), np.concatenate(codes), len(symbolic.a_row))


def _block_of(symbolic: Symbolic, i: NDArray[Any], j: NDArray[Any]) -> NDArray[np.int64]:
    """Stored blocks of A at rows i and columns j, i >= j."""
    n = symbolic.size
    lower = symbolic.a_col[n:].astype(np.int64) * n + symbolic.a_row[n:]
    block = i.astype(np.int64)
    off = i != j
    block[off] = n + np.searchsorted(lower, j[off].astype(np.int64) * n + i[off])
    return block


def _segments(cable_starts: IntArray, points: dict[str, NDArray[Any]]) -> tuple[IntArray, NDArray[Any], FloatArray]:
    """For every cable segment its second point, the nodes of both ends (segment, 8) and their shares in its vector."""
    node, weight = points["point_node"].reshape(-1, 4), points["point_weight"].reshape(-1, 4)
    second = np.setdiff1d(np.arange(len(node)), cable_starts).astype(np.int32)
    carrier = np.concatenate([node[second - 1], node[second]], axis=1)
    share = np.concatenate([-weight[second - 1], weight[second]], axis=1).astype(np.float64)
    return second, carrier, np.where(carrier >= 0, share, 0.0)


def _couplings(
    symbolic: Symbolic, node_dof: IntArray, segment: IntArray, carrier: NDArray[Any], share: FloatArray
) -> dict[str, NDArray[Any]]:
    """For every stored block (i, j) of A the segments whose stiffness it receives, with the weights s_i s_j."""
    names = ("coupling_start", "coupling_point", "coupling_weight")
    if len(share) == 0:
        return dict(zip(names, (np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros(0)), strict=True))
    dof = np.where(share != 0.0, node_dof[carrier], -1).astype(np.int64)
    i, j = np.repeat(dof, 8, axis=1), np.tile(dof, (1, 8))
    weight = (share[:, :, None] * share[:, None, :]).reshape(len(share), 64)
    point = np.broadcast_to(segment[:, None], i.shape)
    keep = (i >= 0) & (j >= 0) & (i >= j)
    size = int(segment.max()) + 1
    unique, inverse = np.unique(_block_of(symbolic, i[keep], j[keep]) * size + point[keep], return_inverse=True)
    start = np.searchsorted(unique // size, np.arange(len(symbolic.a_row) + 1)).astype(np.int32)
    total = np.bincount(inverse, weight[keep])
    return dict(zip(names, (start, (unique % size).astype(np.int32), total), strict=True))


def _neighbours(symbolic: Symbolic) -> tuple[IntArray, IntArray, IntArray]:
    """Full rows of A from its stored lower triangle."""
    n = symbolic.size
    block = np.arange(len(symbolic.a_row))
    row = np.concatenate([symbolic.a_row, symbolic.a_col[n:]])
    col = np.concatenate([symbolic.a_col, symbolic.a_row[n:]])
    code = np.concatenate([block, ~block[n:]])
    order = np.lexsort((col, row))
    start = np.searchsorted(row[order], np.arange(n + 1))
    return start.astype(np.int32), col[order].astype(np.int32), code[order].astype(np.int32)


def _cables(builder: ModelBuilder, tet_start: IntArray, tets: IntArray) -> tuple[dict[str, Any], dict[str, Any]]:
    """Points and rest lengths of all cables."""
    starts, nodes, weights, anchors, rest = [0], [], [], [], []
    for cable in builder.cables:
        path = cable.waypoints
        if cable.pull_point is not None:
            path = np.vstack([cable.pull_point, path])
            nodes.append(np.full((1, 4), -1))
            weights.append(np.zeros((1, 4)))
            anchors.append(cable.pull_point[None])
        corners = tets[tet_start[cable.body] + cable.tets]
        nodes.append(corners)
        weights.append(cable.weights)
        anchors.append(np.zeros((len(corners), 3)))
        starts.append(starts[-1] + len(path))
        rest.append(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    empty = not builder.cables
    point_node = np.empty((0, 4), dtype=np.int32) if empty else np.concatenate(nodes).astype(np.int32)
    point_weight = np.empty((0, 4)) if empty else np.concatenate(weights)
    cable_starts = np.array(starts, dtype=np.int32)

    pairs = [(i, j) for i in range(len(builder.cables)) for j in range(i, len(builder.cables))]
    force = np.array([c.force_control for c in builder.cables], dtype=bool)
    host = {"cable_starts": cable_starts, "cable_force_controlled": force, "cable_rest": np.array(rest)}
    device = {
        "cable_point_start_device": cable_starts,
        "cable_rest_length": np.array(rest, dtype=np.float64),
        "cable_force_control": force.astype(np.int32),
        "point_cable": np.repeat(np.arange(len(builder.cables), dtype=np.int32), np.diff(cable_starts)),
        "point_node": point_node,
        "point_weight": point_weight,
        "point_anchor": np.empty((0, 3)) if empty else np.concatenate(anchors),
        "delassus_pair": np.array(pairs, dtype=np.int32).reshape(-1, 2),
    }
    return host, device


def _row_entries(
    cable_starts: IntArray, points: dict[str, NDArray[Any]], node_dof: IntArray, dofs: int
) -> dict[str, NDArray[Any]]:
    """Sparsity of H: one entry per cable and free node, which sums the points that the node carries."""
    count = len(cable_starts) - 1
    point = np.repeat(np.arange(len(points["point_node"])), 4)
    cable_of_point = np.repeat(np.arange(count), np.diff(cable_starts))
    carrier, weights = points["point_node"].ravel(), points["point_weight"].ravel()
    keep = (carrier >= 0) & (weights != 0.0)
    keep[keep] &= node_dof[carrier[keep]] >= 0
    point, weight = point[keep], weights[keep]
    key = cable_of_point[point].astype(np.int64) * max(dofs, 1) + node_dof[carrier[keep]]
    unique, inverse = np.unique(key, return_inverse=True)
    entry_start, contribution = _lists(inverse, np.arange(inverse.size), unique.size)
    entry_row = (unique // max(dofs, 1)).astype(np.int32)
    entry_dof = (unique % max(dofs, 1)).astype(np.int32)
    dof_entry_start, dof_entry = _lists(entry_dof, np.arange(unique.size), dofs)
    return {
        "entry_dof": entry_dof,
        "entry_row": entry_row,
        "entry_start": entry_start,
        "entry_point": point[contribution].astype(np.int32),
        "entry_weight": weight[contribution],
        "row_entry_start": np.searchsorted(entry_row, np.arange(count + 1)).astype(np.int32),
        "dof_entry_start": dof_entry_start,
        "dof_entry": dof_entry,
    }


def _markers(builder: ModelBuilder, tet_start: IntArray, tets: IntArray) -> tuple[IntArray, FloatArray]:
    chosen = [int(tet_start[m.body]) + m.tet for m in builder.markers]
    weights = np.array([m.weights for m in builder.markers], dtype=np.float64).reshape(-1, 4)
    return tets[chosen].reshape(-1, 4).astype(np.int32), weights


def _defaults(builder: ModelBuilder) -> dict[str, FloatArray]:
    bodies, cables = builder.bodies, builder.cables
    values = {
        "youngs": np.array([b.material.youngs for b in bodies]),
        "nu": np.array([b.material.nu for b in bodies]),
        "density": np.array([b.density for b in bodies]),
        "rayleigh_mass": np.array([b.rayleigh[0] for b in bodies]),
        "rayleigh_stiffness": np.array([b.rayleigh[1] for b in bodies]),
        "gravity": builder.gravity,
    }
    for key in (
        "cable_min_displacement",
        "cable_max_displacement",
        "cable_min_tension",
        "cable_max_tension",
        "cable_max_rate",
    ):
        values[key] = np.clip(np.array([c.limits[key] for c in cables]), -UNBOUNDED, UNBOUNDED)
    return {key: np.asarray(value, dtype=np.float64) for key, value in values.items()}


def _fingerprint(builder: ModelBuilder, host: dict[str, Any]) -> str:
    """Digest of everything that gives a state its meaning; equal for equal scenes on any device and batch size."""
    digest = hashlib.sha256()
    for key in ("node_rest", "tet_corners", "node_fixed", "body_node_start", "cable_starts", "cable_force_controlled"):
        digest.update(np.ascontiguousarray(host[key]).tobytes())
    for key in ("point_node", "point_weight", "point_anchor", "marker_node", "marker_weight", "node_load"):
        digest.update(np.ascontiguousarray(host["device"][key]).tobytes())
    laws = ",".join(b.material.kernel_law for b in builder.bodies)
    digest.update(f"{laws};{host['body_names']};{host['cable_names']};{host['marker_names']}".encode())
    return digest.hexdigest()
