"""From the builder's lists to the arrays of a model: numbering, incidence lists and the structure of A. Host only."""

from __future__ import annotations

import hashlib
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
    numpy_real = np.float64 if precision == "float64" else np.float32
    arrays = {
        name: wp.array(
            np.ascontiguousarray(value, dtype=numpy_real if value.dtype.kind == "f" else np.int32),
            dtype=real if value.dtype.kind == "f" else wp.int32,
            device=device,
        )
        for name, value in host.pop("device").items()
    }
    law_tets = {law: wp.array(tets, dtype=wp.int32, device=device) for law, tets in host.pop("law_tets").items()}
    return Model(
        num_worlds=int(num_worlds), device=device, precision=precision, law_tets=law_tets, **host, **arrays
    )


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

    free = np.flatnonzero(~fixed)
    index = np.full(len(nodes), -1, dtype=np.int64)
    index[free] = np.arange(free.size)
    edges = np.concatenate([tets[:, [a, b]] for a, b in CORNER_PAIRS])
    edges = index[edges]
    symbolic = analyze(edges[(edges >= 0).all(axis=1)].astype(np.int32), free.size, nodes[free])
    dof_node = free[symbolic.order].astype(np.int32)
    node_dof = np.full(len(nodes), -1, dtype=np.int32)
    node_dof[dof_node] = np.arange(free.size, dtype=np.int32)

    laws = np.array([b.material.kernel_law for b in bodies])[tet_body]
    is_large = laws == "large"
    large_start, large_entry = _block_entries(symbolic, node_dof, tets, np.flatnonzero(is_large))
    stored_start, stored_entry = _block_entries(symbolic, node_dof, tets, np.flatnonzero(~is_large))
    corner_start, corner = _lists(tets.ravel(), np.arange(tets.size), len(nodes))
    neighbour_start, neighbour, neighbour_block = _neighbours(symbolic)
    cable_host, cable_device = _cables(builder, node_start, tet_start, tets, node_dof, free.size)
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
        "node_dof": node_dof,
        "dof_node": dof_node,
        "corner_start": corner_start,
        "corner": corner,
        "large_entry_start": large_start,
        "large_entry": large_entry,
        "stored_entry_start": stored_start,
        "stored_entry": stored_entry,
        "neighbour_start": neighbour_start,
        "neighbour": neighbour,
        "neighbour_block": neighbour_block,
        "marker_node": marker_node,
        "marker_weight": marker_weight,
        "marker_anchor": np.zeros((len(builder.markers), 3)),
        **cable_device,
    }
    host["fingerprint"] = _fingerprint(builder, host)
    return host


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
    return gradient.reshape(-1, 9), volume, frame.reshape(-1, 9)


def _ranges(items: list[Any], start: IntArray) -> list[tuple[Any, int, int]]:
    return [(item, int(start[i]), int(start[i + 1])) for i, item in enumerate(items)]


def _lumped_volume(body: Any, volume: FloatArray) -> FloatArray:
    count = len(body.mesh.nodes)
    if body.lumping == "uniform":
        return np.full(count, volume.sum() / count)
    return np.bincount(body.mesh.tets.ravel(), np.repeat(volume / 4.0, 4), minlength=count)


def _lists(keys: NDArray[Any], values: NDArray[Any], count: int) -> tuple[IntArray, IntArray]:
    """Group ``values`` by ``keys`` into (start, list); values keep their order within a key."""
    order = np.argsort(keys, kind="stable")
    start = np.searchsorted(keys[order], np.arange(count + 1))
    return start.astype(np.int32), values[order].astype(np.int32)


def _block_entries(symbolic: Symbolic, node_dof: IntArray, tets: IntArray, chosen: NDArray[Any]) -> Any:
    """For every stored block (i, j) of A the element blocks ``16 tet + 4 a + b`` whose corners are i and j."""
    n = symbolic.size
    block_key = symbolic.a_col.astype(np.int64) * n + symbolic.a_row
    lower = block_key[n:]
    keys, codes = [], []
    dof = node_dof[tets[chosen]].astype(np.int64)
    for a in range(4):
        for b in range(4):
            i, j = dof[:, a], dof[:, b]
            keep = (i >= 0) & (j >= 0) & (i >= j)
            block = i[keep].copy()
            off = i[keep] != j[keep]
            block[off] = n + np.searchsorted(lower, j[keep][off] * n + i[keep][off])
            keys.append(block)
            codes.append(16 * chosen[keep] + 4 * a + b)
    return _lists(np.concatenate(keys), np.concatenate(codes), len(block_key))


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


def _cables(
    builder: ModelBuilder, node_start: IntArray, tet_start: IntArray, tets: IntArray, node_dof: IntArray, dofs: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Points, rest lengths and the sparsity of H."""
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

    # H has one entry per (cable, free node); each sums the points that the node carries
    point = np.repeat(np.arange(len(point_node)), 4)
    cable_of_point = np.repeat(np.arange(len(builder.cables)), np.diff(cable_starts))
    carrier = point_node.ravel()
    keep = (carrier >= 0) & (point_weight.ravel() != 0.0)
    keep[keep] &= node_dof[carrier[keep]] >= 0
    point, weight = point[keep], point_weight.ravel()[keep]
    key = cable_of_point[point].astype(np.int64) * max(dofs, 1) + node_dof[carrier[keep]]
    unique, inverse = np.unique(key, return_inverse=True)
    entry_start, contribution = _lists(inverse, np.arange(inverse.size), unique.size)
    entry_row = (unique // max(dofs, 1)).astype(np.int32)
    entry_dof = (unique % max(dofs, 1)).astype(np.int32)
    row_entry_start = np.searchsorted(entry_row, np.arange(len(builder.cables) + 1)).astype(np.int32)
    dof_entry_start, dof_entry = _lists(entry_dof, np.arange(unique.size), dofs)
    pairs = [(i, j) for i in range(len(builder.cables)) for j in range(i, len(builder.cables))]
    force = np.array([c.force_control for c in builder.cables], dtype=bool)
    host = {"cable_starts": cable_starts, "cable_force_controlled": force, "cable_rest": np.array(rest)}
    device = {
        "cable_point_start_device": cable_starts,
        "cable_rest_length": np.array(rest, dtype=np.float64),
        "cable_force_control": force.astype(np.int32),
        "point_node": point_node,
        "point_weight": point_weight,
        "point_anchor": np.empty((0, 3)) if empty else np.concatenate(anchors),
        "entry_dof": entry_dof,
        "entry_row": entry_row,
        "entry_start": entry_start,
        "entry_point": point[contribution].astype(np.int32),
        "entry_weight": weight[contribution],
        "row_entry_start": row_entry_start,
        "dof_entry_start": dof_entry_start,
        "dof_entry": dof_entry,
        "delassus_pair": np.array(pairs, dtype=np.int32).reshape(-1, 2),
    }
    return host, device


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
