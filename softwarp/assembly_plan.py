"""From the builder's lists to the arrays of a model: numbering, incidence lists and the structure of A. Host only."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp import meshing
from softwarp.cavity_model import CavityModel, MembraneModel
from softwarp.cavity_plan import cavity_arrays, cavity_points, membrane_arrays
from softwarp.contact_plan import contact_model, pair_defaults
from softwarp.fields import real_of
from softwarp.frame_model import FrameModel
from softwarp.frame_plan import FrameLayout, guide_points, layout
from softwarp.joint_model import JointModel
from softwarp.joint_plan import joint_arrays, joint_defaults, joint_layout
from softwarp.kernels.cable import UNBOUNDED
from softwarp.model import Model
from softwarp.scene import Rod
from softwarp.structure_plan import Slots, block_of, lists, structure

if TYPE_CHECKING:
    from softwarp.builder import ModelBuilder

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]
CAVITY_LIMITS = (
    "cavity_min_pressure",
    "cavity_max_pressure",
    "cavity_min_volume",
    "cavity_max_volume",
    "cavity_max_pressure_rate",
    "cavity_max_flow",
)


def plan(
    builder: ModelBuilder, num_worlds: int, device: str, precision: str, contact_capacity: int | None = None
) -> Model:
    """Build the model of a scene on a device.

    Raises:
        ValueError: For an empty scene, a body without free nodes, a world count below 1, an unknown precision or a
            device that this machine does not have.
    """
    if isinstance(num_worlds, bool) or not isinstance(num_worlds, (int, np.integer)) or num_worlds < 1:
        raise ValueError(f"num_worlds must be an integer of at least 1, got {num_worlds!r}")
    real = real_of(precision)
    device = checked_device(device)
    if not (builder.bodies or builder.rigids or builder.rods):
        raise ValueError("the scene is empty: add a body with add_tets, add_rod or add_rigid before finalize")
    host = _host_arrays(builder, contact_capacity)
    arrays = _upload(host.pop("device"), device, real)
    frames = host.pop("frames")
    for name, cls in (("cavities", CavityModel), ("membranes", MembraneModel), ("joints", JointModel)):
        part = host.pop(name)
        host[name] = None if part is None else cls(**part[0], **_upload(part[1], device, real))
    host["frames"] = None
    if frames is not None:
        host["frames"] = _upload_frames(frames[0], frames[1], frames[2], frames[3], device, real)
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
    symbolic, arrays, _ = structure(
        model.node_rest,
        model.node_fixed,
        model.node_locked,
        _tet_elements(model.tet_corners, is_large),
        model.cable_starts,
        points,
        np.empty((0, 2), dtype=np.int32),
        with_segments=model.cable_count,
    )
    kept = {name: value for name, value in arrays.items() if hasattr(model, name)}
    return replace(model, symbolic=symbolic, **_upload(kept, model.device, real_of(model.precision)))


def _tet_elements(tets: IntArray, is_large: NDArray[np.bool_]) -> dict[str, tuple[IntArray, NDArray[Any]]]:
    """Tets by how their stiffness is kept."""
    return {
        name: (tets[chosen], np.flatnonzero(chosen)) for name, chosen in (("large", is_large), ("stored", ~is_large))
    }


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


def _host_arrays(builder: ModelBuilder, contact_capacity: int | None) -> dict[str, Any]:
    bodies = builder.bodies
    node_start = np.concatenate([[0], np.cumsum([len(b.mesh.nodes) for b in bodies])]).astype(np.int32)
    tet_start = np.concatenate([[0], np.cumsum([len(b.mesh.tets) for b in bodies])]).astype(np.int32)
    guides = guide_points(builder)
    nodes = _stacked([b.mesh.nodes for b in bodies] + [guides], (0, 3), np.float64)
    tets = _stacked([b.mesh.tets + s for b, s in zip(bodies, node_start[:-1], strict=True)], (0, 4), np.int32)
    tet_body = np.repeat(np.arange(len(bodies)), np.diff(tet_start)).astype(np.int32)
    node_body = np.repeat(np.arange(len(bodies)), np.diff(node_start)).astype(np.int32)
    node_body = np.pad(node_body, (0, len(guides)))
    fixed = np.pad(_stacked([b.fixed for b in bodies], (0,), bool), (0, len(guides)))
    frames = layout(builder, node_start, nodes) if builder.rigids or builder.rods else None
    if fixed.all() and frames is None:
        raise ValueError("every node of the scene is fixed, so nothing can move; fix fewer nodes")
    gradient, volume, frame = rest_geometry(nodes, tets)
    volumes = [_lumped_volume(b, volume[s:e]) for b, s, e in _ranges(bodies, tet_start)]

    laws = np.array([b.material.kernel_law for b in bodies], dtype=object)[tet_body]
    cable_host, cable_device = _cables(builder, tet_start, tets, int(node_start[-1]))
    elements = _tet_elements(tets, laws == "large")
    cavity_starts, chamber_points = cavity_points(builder, tet_start, tets)
    first_point = len(cable_device["point_node"])
    points = {key: np.concatenate([cable_device[key], value]) for key, value in chamber_points.items()}
    row_starts = np.concatenate([cable_host["cable_starts"], first_point + cavity_starts[1:]])
    membrane_host, membrane_device, membrane_volume = membrane_arrays(builder, node_start)
    if builder.membranes:
        corners = np.pad(membrane_device["tri_node"], ((0, 0), (0, 1)), constant_values=-1)
        elements["membrane"] = (corners, np.arange(len(corners)))
    if frames is not None:
        elements["segment"] = (frames.corners, np.arange(len(frames.corners)))
    locked = np.pad(_stacked([b.locked for b in bodies], (0, 3), bool), ((0, len(guides)), (0, 0)))
    joints = joint_layout(builder, frames)
    symbolic, arrays, slots = structure(
        nodes,
        fixed,
        locked,
        elements,
        row_starts,
        points,
        joints.row_frames,
        frames,
    )
    arrays["segment_body_count"] = np.array([len(bodies)])
    names = ("membrane_entry_start", "membrane_entry")
    membrane_device |= {name: arrays.pop(name) for name in names if name in arrays}
    membrane_device |= {
        key.removeprefix("membrane_"): arrays.pop(key)
        for key in list(arrays)
        if key.startswith(("membrane_carried_", "membrane_held_"))
    }
    frame_arrays = {
        key: arrays.pop(key)
        for key in list(arrays)
        if "_carried_" in key or "_held_" in key or key.startswith("segment")
    }
    elements_of_node = np.concatenate([tets, np.pad(membrane_host["triangles"], ((0, 0), (0, 1)), constant_values=-1)])
    used = np.flatnonzero(elements_of_node.ravel() >= 0)
    corner_start, corner = lists(elements_of_node.ravel()[used], used, len(nodes))
    marker_node, marker_weight = _markers(builder, tet_start, tets)

    surfaces = [meshing.tet_surface(b.mesh.tets) for b in bodies]
    host: dict[str, Any] = {
        "body_names": tuple(b.name for b in bodies),
        "rigid_names": tuple(b.name for b in builder.rigids),
        "rigid_shapes": tuple(b.shape for b in builder.rigids),
        "rod_names": tuple(b.name for b in builder.rods),
        "cavity_names": tuple(c.name for c in builder.cavities),
        "cable_names": tuple(c.name for c in builder.cables),
        "joint_names": tuple(j.name for j in builder.joints),
        "marker_names": tuple(m.name for m in builder.markers),
        "node_rest": nodes,
        "tet_corners": tets,
        "body_node_start": node_start,
        "node_fixed": fixed,
        "node_locked": locked,
        "surface_tri": _stacked([s + n for s, n in zip(surfaces, node_start[:-1], strict=True)], (0, 3), np.int32),
        "tri_body": np.repeat(np.arange(len(bodies)), [len(s) for s in surfaces]).astype(np.int32),
        **cable_host,
        "defaults": _defaults(builder),
        "law_tets": {str(law): np.flatnonzero(laws == law).astype(np.int32) for law in np.unique(laws)},
        "symbolic": symbolic,
        "extent": _extent(nodes, frames),
        "frames": None if frames is None else (frames, slots, symbolic, frame_arrays),
        "cavities": cavity_arrays(builder, cavity_starts, chamber_points, first_point, symbolic, slots)
        if builder.cavities
        else None,
        "membranes": (membrane_host, membrane_device) if builder.membranes else None,
        "joints": joint_arrays(builder, joints, frames) if builder.joints and frames is not None else None,
    }
    sizes = [cable_host["cable_rest"]]
    if builder.cavities:
        sizes.append(host["cavities"][0]["rest_volume"] / host["cavities"][1]["cavity_area"])
    sizes.append(joints.row_size)
    host["device"] = {
        "row_size": np.concatenate(sizes),
        "tet_node": tets,
        "tet_body": tet_body,
        "tet_gradient": gradient,
        "tet_volume": volume,
        "tet_frame": frame,
        "node_body": node_body,
        "node_volume": np.pad(_stacked(volumes, (0,), np.float64) + membrane_volume, (0, len(guides))),
        "node_load": np.pad(_stacked([b.load for b in bodies], (0, 3), np.float64), ((0, len(guides)), (0, 0))),
        "corner_start": corner_start,
        "corner": corner,
        "marker_node": marker_node,
        "marker_weight": marker_weight,
        "marker_anchor": np.zeros((len(builder.markers), 3)),
        **_marker_frames(builder, frames),
        **cable_device,
        **points,
        **arrays,
    }
    frame_dof = np.empty(0, dtype=np.int32) if frames is None else _master_dof(frames, slots).ravel()
    host["contact"] = contact_model(
        builder, nodes, node_start, arrays["node_dof"], frames, frame_dof, contact_capacity
    )
    host["fingerprint"] = _fingerprint(builder, host)
    return host


def _stacked(parts: list[NDArray[Any]], empty: tuple[int, ...], dtype: Any) -> NDArray[Any]:
    """Parts one after the other, or an array of shape ``empty`` without any."""
    return np.concatenate([np.empty(empty, dtype=dtype), *parts]).astype(dtype)


def _extent(nodes: FloatArray, frames: FrameLayout | None) -> float:
    """Diagonal of the box around all nodes and frames [m]; at least 1 m where rigid bodies may fly far."""
    if frames is None:
        return float(np.linalg.norm(np.ptp(nodes, axis=0)))
    points = np.concatenate([nodes, frames.pose[:, :3]])
    return max(float(np.linalg.norm(np.ptp(points, axis=0))), 1.0)


def _upload_frames(
    f: FrameLayout, slots: Slots, symbolic: Any, arrays: dict[str, NDArray[Any]], device: str, real: Any
) -> FrameModel:
    """Frames in elimination order on a device."""
    base = f.node_count
    dof = slots.unknown[: f.slot_count]
    master_dof = _master_dof(f, slots)
    sources, source_start = _sources(f)
    is_bare = sources[:, 2] < 0
    lever = np.where(is_bare[:, None], 0.0, f.carried_offset[sources[:, 2]] if len(f.carried_offset) else 0.0)
    inertia = np.where((sources[:, 0] == 1)[:, None], _six(f.inertia_in_master())[sources[:, 1] % f.count], 0.0)
    bodies = int(arrays.pop("segment_body_count")[0])
    owner_body = np.concatenate([bodies + f.rod_count + np.arange(f.rigid_count), bodies + np.arange(f.rod_count)])
    segment_slots = f.corners - base
    corner_start, corner = lists(segment_slots.ravel(), np.arange(segment_slots.size), 2 * f.count)
    own: dict[str, NDArray[Any]] = {
        "frame_master": f.master,
        "frame_dof": master_dof.ravel(),
        "frame_offset": f.offset,
        "frame_owner": f.owner,
        "owner_body": owner_body,
        "frame_volume": f.volume,
        "frame_inertia": _six(f.inertia),
        "frame_spin": f.spin,
        "turning_frame": f.turning,
        "welded_frame": np.flatnonzero(f.master != np.arange(f.count)),
        "frame_block": _frame_blocks(symbolic, master_dof),
        "source_start": source_start,
        "source": sources,
        "source_lever": lever,
        "source_inertia": inertia,
        "carried_slot": f.carried_slot,
        "carried_frame": f.carried_frame,
        "carried_dof": master_dof[f.carried_frame].ravel(),
        "carried_offset": f.carried_offset,
        "slot_dof": dof,
        "slot_carried": slots.item[: f.slot_count],
        "node_frame": f.node_frame,
        "corner_start": corner_start,
        "corner": corner,
        "seg_frame": f.segment_frames,
        "seg_rod": f.segment_rod,
        "seg_body": bodies + f.segment_rod,
        **f.segments,
        "seg_entry_start": arrays.pop("segment_entry_start"),
        "seg_entry": arrays.pop("segment_entry"),
        "kinematic_frame": np.flatnonzero(f.is_kinematic),
    }
    kinds = {key.split("_")[0] for key in arrays}

    def of_kinds(what: str, first: str) -> dict[str, Any]:
        parts = _upload({key: value for key, value in arrays.items() if f"_{what}_" in key}, device, real)
        names = [f"{what}_{part}" for part in (first, "start", "entry")]
        return {
            kind: tuple(parts[f"{kind}_{name}"] for name in names) for kind in kinds if parts[f"{kind}_{names[0]}"].size
        }

    return FrameModel(
        rigid_count=f.rigid_count,
        rod_count=f.rod_count,
        count=f.count,
        rod_start=f.rod_start,
        rest_pose=f.pose,
        rest_twist=f.twist,
        master=f.master,
        is_kinematic=f.is_kinematic,
        segment_frames=f.segment_frames,
        rod_radius=f.radius,
        carried_blocks=of_kinds("carried", "block"),
        held_nodes=of_kinds("held", "node"),
        **_upload(own, device, real),
    )


def _master_dof(f: FrameLayout, slots: Slots) -> IntArray:
    """Dofs of translation and rotation of every frame's master, (frame, 2)."""
    first = f.node_count + 2 * f.master
    return np.stack([slots.unknown[first], slots.unknown[first + 1]], axis=1).astype(np.int32)


def _six(matrices: FloatArray) -> FloatArray:
    """xx yy zz xy xz yz of symmetric matrices (n, 3, 3)."""
    row, column = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    return matrices[:, row, column]


def _sources(f: FrameLayout) -> tuple[IntArray, IntArray]:
    """Sources of every master, itself first, and their ranges."""
    found: list[list[tuple[int, int, int]]] = [[] for _ in range(f.count)]
    for frame in np.flatnonzero(f.master == np.arange(f.count)):
        found[frame].append((1, int(frame), -1))
    for item, (slot, frame) in enumerate(zip(f.carried_slot, f.carried_frame, strict=True)):
        is_node = slot < f.node_count
        if f.body_node_count <= slot < f.node_count:
            continue  # guides have neither mass nor force of their own
        index = int(slot) if is_node else (int(slot) - f.node_count) // 2
        found[frame].append((0 if is_node else 1, index, item))
    start = np.concatenate([[0], np.cumsum([len(part) for part in found])])
    flat = [source for part in found for source in part]
    return np.array(flat, dtype=np.int32).reshape(-1, 3), start.astype(np.int32)


def _frame_blocks(symbolic: Any, master_dof: NDArray[Any]) -> IntArray:
    """Blocks of A of every frame's master: tt, rr, the one between, and whether that one is stored as (t, r)."""
    t, r = master_dof[:, 0], master_dof[:, 1]
    between = block_of(symbolic, np.maximum(t, r), np.minimum(t, r))
    return np.stack([t, r, between, t > r], axis=1).astype(np.int32)


def rest_geometry(nodes: FloatArray, tets: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Shape gradients of corners 1 to 3 (tet, 9), volumes (tet,) and rest frames by rows (tet, 9)."""
    x = nodes[tets].reshape(-1, 4, 3)
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


def _cables(builder: ModelBuilder, tet_start: IntArray, tets: IntArray, guide: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Points and rest lengths of all cables; guides are the nodes from ``guide`` on, in the order of waypoints."""
    starts, nodes, weights, anchors, rest = [0], [], [], [], []
    for cable in builder.cables:
        path = cable.waypoints
        if cable.pull_point is not None:
            path = np.vstack([cable.pull_point, path])
            nodes.append(np.full((1, 4), -1))
            weights.append(np.zeros((1, 4)))
            anchors.append(cable.pull_point[None])
        corners, shares = np.full((len(cable.waypoints), 4), -1), cable.weights.copy()
        for i, (part, tet) in enumerate(zip(cable.carriers, cable.tets, strict=True)):
            if tet >= 0:
                corners[i] = tets[tet_start[part] + tet]
            else:
                corners[i, 0], shares[i, 0], guide = guide, 1.0, guide + 1
        nodes.append(corners)
        weights.append(shares)
        anchors.append(np.zeros((len(corners), 3)))
        starts.append(starts[-1] + len(path))
        rest.append(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    empty = not builder.cables
    point_node = np.empty((0, 4), dtype=np.int32) if empty else np.concatenate(nodes).astype(np.int32)
    point_weight = np.empty((0, 4)) if empty else np.concatenate(weights)
    cable_starts = np.array(starts, dtype=np.int32)

    count = len(builder.cables)
    pairs = [(i, j) for i in range(count) for j in range(i, count)]
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


def _markers(builder: ModelBuilder, tet_start: IntArray, tets: IntArray) -> tuple[IntArray, FloatArray]:
    weights = np.array([m.weights for m in builder.markers], dtype=np.float64).reshape(-1, 4)
    node = np.full((len(builder.markers), 4), -1, dtype=np.int32)
    for i, marker in enumerate(builder.markers):
        if marker.frame is None:
            node[i] = tets[tet_start[marker.body] + marker.tet]
    return node, weights


def _marker_frames(builder: ModelBuilder, frames: FrameLayout | None) -> dict[str, NDArray[Any]]:
    """Frames that carry markers, -1 for none, and their places in them."""
    frame = np.full(len(builder.markers), -1, dtype=np.int32)
    for i, marker in enumerate(builder.markers):
        if marker.frame is not None and frames is not None:
            part, node = marker.frame
            is_rod = isinstance(part, Rod)
            frame[i] = frames.rigid_count + frames.rod_start[part] + node if is_rod else int(part)
    local = np.array([marker.local for marker in builder.markers], dtype=np.float64).reshape(-1, 3)
    return {"marker_frame": frame, "marker_local": local}


def _defaults(builder: ModelBuilder) -> dict[str, FloatArray]:
    bodies, cables = builder.bodies, builder.cables
    values = {
        "youngs": np.array([b.material.youngs for b in bodies]),
        "nu": np.array([b.material.nu for b in bodies]),
        "density": np.array([b.density for b in bodies]),
        "rayleigh_mass": np.array([b.rayleigh[0] for b in bodies]),
        "rayleigh_stiffness": np.array([b.rayleigh[1] for b in bodies]),
        "gravity": builder.gravity,
        **pair_defaults(builder),
        **joint_defaults(builder),
        "membrane_youngs": np.array([m.youngs for m in builder.membranes]),
        "membrane_nu": np.array([m.nu for m in builder.membranes]),
        "cavity_ambient": np.array([c.ambient for c in builder.cavities]),
        "cavity_exponent": np.array([c.exponent for c in builder.cavities]),
        "body_mass": np.array([b.mass for b in builder.rigids]),
        "body_damping": np.array([b.damping for b in builder.rigids]),
        "body_max_speed": np.minimum([b.max_speed for b in builder.rigids], UNBOUNDED),
        "body_max_spin": np.minimum([b.max_spin for b in builder.rigids], UNBOUNDED),
        "rod_youngs": np.array([b.youngs for b in builder.rods]),
        "rod_nu": np.array([b.nu for b in builder.rods]),
        "rod_density": np.array([b.density for b in builder.rods]),
        "rod_rayleigh_mass": np.array([b.rayleigh[0] for b in builder.rods]),
        "rod_rayleigh_stiffness": np.array([b.rayleigh[1] for b in builder.rods]),
    }
    for key in (
        "cable_min_displacement",
        "cable_max_displacement",
        "cable_min_tension",
        "cable_max_tension",
        "cable_max_rate",
    ):
        values[key] = np.clip(np.array([c.limits[key] for c in cables]), -UNBOUNDED, UNBOUNDED)
    for key in CAVITY_LIMITS:
        values[key] = np.clip(np.array([c.limits[key] for c in builder.cavities]), -UNBOUNDED, UNBOUNDED)
    return {key: np.asarray(value, dtype=np.float64) for key, value in values.items()}


def _fingerprint(builder: ModelBuilder, host: dict[str, Any]) -> str:
    """Digest of everything that gives a state its meaning; equal for equal scenes on any device and batch size."""
    digest = hashlib.sha256()
    for key in (
        "node_rest",
        "tet_corners",
        "node_fixed",
        "node_locked",
        "body_node_start",
        "cable_starts",
        "cable_force_controlled",
    ):
        digest.update(np.ascontiguousarray(host[key]).tobytes())
    names = ("point_node", "point_weight", "point_anchor", "marker_node", "marker_weight", "marker_frame", "node_load")
    for key in (*names, "marker_local"):
        digest.update(np.ascontiguousarray(host["device"][key]).tobytes())
    laws = ",".join(b.material.kernel_law for b in builder.bodies)
    digest.update(f"{laws};{host['body_names']};{host['cable_names']};{host['marker_names']}".encode())
    if host["contact"] is not None:
        pairs = [(a.kind, int(a), b.kind, int(b)) for a, b in host["contact"].parts]
        digest.update(f"{pairs};{host['contact'].capacity};{host['contact'].scene.key_count}".encode())
    for part in (host["cavities"], host["membranes"], host["joints"]):
        for array in () if part is None else part[1].values():
            digest.update(np.ascontiguousarray(array).tobytes())
    if host["frames"] is not None:
        f = host["frames"][0]
        for part in (f.pose, f.master, f.offset, f.volume, f.inertia, f.free, f.carried_slot, *f.segments.values()):
            digest.update(np.ascontiguousarray(part).tobytes())
        digest.update(f"{host['rigid_names']};{host['rod_names']}".encode())
    return digest.hexdigest()
