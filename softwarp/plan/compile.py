"""From the builder's lists to the arrays of a model: numbering, incidence lists and the structure of A. Host only."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp import meshing
from softwarp.model.cavities import CavityModel, MembraneModel
from softwarp.model.codes import TURNED, UNBOUNDED
from softwarp.model.fields import real_of
from softwarp.model.joints import JointModel
from softwarp.model.model import Model
from softwarp.model.quadratic import QuadraticLayout, QuadraticModel
from softwarp.plan.cavities import cavity_arrays, cavity_points, membrane_arrays
from softwarp.plan.contact import contact_model, expected_contacts, pair_defaults
from softwarp.plan.frame_arrays import master_dof_of, upload_frames
from softwarp.plan.frames import FrameLayout, layout
from softwarp.plan.joints import joint_arrays, joint_defaults, joint_layout
from softwarp.plan.quadratic import POINTS, carried_arrays, element_kinds, entry_arrays, inertia_arrays, point_arrays
from softwarp.plan.soft import SoftLayout, cables, marker_frames, markers, soft_layout, stacked
from softwarp.plan.structure import lists, structure
from softwarp.plan.upload import checked_device, upload

if TYPE_CHECKING:
    from softwarp.builder import ModelBuilder

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]
USUAL_CONTACTS = 24  # for which elimination orders are compared, or half of what may occur; benchmarks/contact.py
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
    arrays = upload(host.pop("device"), device, real)
    frames = host.pop("frames")
    for name, cls in (("cavities", CavityModel), ("membranes", MembraneModel), ("joints", JointModel)):
        part = host.pop(name)
        host[name] = None if part is None else cls(**part[0], **upload(part[1], device, real))
    if host["quadratic"] is not None:
        host["quadratic"] = _quadratic_model(host["quadratic"][0], host["quadratic"][1], device, real)
    host["frames"] = None
    if frames is not None:
        host["frames"] = upload_frames(frames[0], frames[1], frames[2], frames[3], device, real)
    law_tets = {law: wp.array(tets, dtype=wp.int32, device=device) for law, tets in host.pop("law_tets").items()}
    return Model(num_worlds=int(num_worlds), device=device, precision=precision, law_tets=law_tets, **host, **arrays)


def coupled(model: Model) -> Model:
    """The same scene with room in A for the stiffness of taut cables, which ties the ends of each segment together.

    Only the order of ``dof`` and what follows from it differ; states and commands serve both models.
    """
    if model.cable_count == 0:
        return model
    is_large = np.zeros(model.tet_count, dtype=bool)
    for law in TURNED:
        if law in model.law_tets:
            is_large[model.law_tets[law].numpy()] = True
    elements = _tet_elements(model.tet_corners, is_large)
    if model.quadratic is not None:
        elements |= element_kinds(model.quadratic.layout)
    points = {name: getattr(model, name).numpy() for name in ("point_node", "point_weight")}
    symbolic, arrays, slots = structure(
        model.node_rest,
        model.node_fixed,
        model.node_locked,
        elements,
        model.cable_starts,
        points,
        np.empty((0, 2), dtype=np.int32),
        with_segments=model.cable_count,
    )
    real, quadratic = real_of(model.precision), model.quadratic
    if quadratic is not None:
        lists_of = _quadratic_lists(quadratic.layout, arrays, symbolic, slots, model.node_count)
        quadratic = replace(quadratic, **upload(lists_of, model.device, real))
    kept = {name: value for name, value in arrays.items() if hasattr(model, name)}
    return replace(model, symbolic=symbolic, quadratic=quadratic, **upload(kept, model.device, real))


def _quadratic_lists(
    layout: QuadraticLayout, arrays: dict[str, NDArray[Any]], symbolic: Any, slots: Any, node_count: int
) -> dict[str, NDArray[Any]]:
    """What of the quadratic elements depends on the structure of A; takes their entries out of ``arrays``."""
    entries = entry_arrays(arrays, len(symbolic.a_row))
    return entries | inertia_arrays(layout, symbolic, slots, node_count)


def _host_quadratic(
    soft: SoftLayout, arrays: dict[str, NDArray[Any]], symbolic: Any, slots: Any
) -> tuple[QuadraticLayout, dict[str, NDArray[Any]]] | None:
    """Layout and arrays of the quadratic elements, and their part of the lists of frames."""
    layout = soft.quadratic
    if len(layout.nodes) == 0:
        return None
    carried_arrays(arrays)
    lists_of = _quadratic_lists(layout, arrays, symbolic, slots, len(soft.nodes))
    return layout, point_arrays(layout, soft.nodes) | lists_of


def _quadratic_model(
    layout: QuadraticLayout, arrays: dict[str, NDArray[Any]], device: str, real: Any
) -> QuadraticModel:
    points = np.repeat(layout.laws, POINTS)
    law_points = {str(law): np.flatnonzero(points == law).astype(np.int32) for law in np.unique(layout.laws)}
    return QuadraticModel(
        layout=layout,
        law_points={law: wp.array(index, dtype=wp.int32, device=device) for law, index in law_points.items()},
        **upload(arrays, device, real),
    )


def _tet_elements(tets: IntArray, is_large: NDArray[np.bool_]) -> dict[str, tuple[IntArray, NDArray[Any]]]:
    """Tets by how their stiffness is kept."""
    return {
        name: (tets[chosen], np.flatnonzero(chosen)) for name, chosen in (("large", is_large), ("stored", ~is_large))
    }


def _host_arrays(builder: ModelBuilder, contact_capacity: int | None) -> dict[str, Any]:
    soft = soft_layout(builder)
    frames = layout(builder, soft.node_start, soft.nodes) if builder.rigids or builder.rods else None
    if soft.fixed.all() and frames is None:
        raise ValueError("every node of the scene is fixed, so nothing can move; fix fewer nodes")
    cable_host, cable_device = cables(builder, soft)
    cavity_starts, chamber_points = cavity_points(builder, soft.carrier_start, soft.carriers)
    first_point = len(cable_device["point_node"])
    points = {key: np.concatenate([cable_device[key], value]) for key, value in chamber_points.items()}
    row_starts = np.concatenate([cable_host["cable_starts"], first_point + cavity_starts[1:]])
    membranes = membrane_arrays(builder, soft.node_start)
    joints = joint_layout(builder, frames)
    elements = _elements(soft, membranes[1], frames)
    symbolic, arrays, slots = structure(
        soft.nodes,
        soft.fixed,
        soft.locked,
        elements,
        row_starts,
        points,
        joints.row_frames,
        frames,
        contacts=min(expected_contacts(builder) // 2, USUAL_CONTACTS),
    )
    arrays["segment_body_count"] = np.array([len(builder.bodies)])
    quadratic = _host_quadratic(soft, arrays, symbolic, slots)
    membrane_device = membranes[1] | _taken(arrays, lambda key: key.startswith("membrane_"), "membrane_")
    frame_arrays = _taken(arrays, lambda key: "_carried_" in key or "_held_" in key or key.startswith("segment"), "")
    cavities = None
    sizes = [cable_host["cable_rest"]]
    if builder.cavities:
        cavities = cavity_arrays(builder, cavity_starts, chamber_points, first_point, symbolic, slots)
        sizes.append(cavities[0]["rest_volume"] / cavities[1]["cavity_area"])
    sizes.append(joints.row_size)
    frame_dof = np.empty(0, dtype=np.int32) if frames is None else master_dof_of(frames, slots).ravel()
    host: dict[str, Any] = {
        **_host_soft(builder, soft),
        **cable_host,
        "defaults": _defaults(builder),
        "symbolic": symbolic,
        "extent": _extent(soft.nodes, frames),
        "frames": None if frames is None else (frames, slots, symbolic, frame_arrays),
        "cavities": cavities,
        "quadratic": quadratic,
        "membranes": (membranes[0], membrane_device) if builder.membranes else None,
        "joints": joint_arrays(builder, joints, frames) if builder.joints and frames is not None else None,
        "contact": contact_model(
            builder, soft.nodes, soft.node_start, arrays["node_dof"], frames, frame_dof, contact_capacity
        ),
    }
    host["device"] = {
        "row_size": np.concatenate(sizes),
        **_device_soft(builder, soft, membranes, frames),
        **cable_device,
        **points,
        **arrays,
    }
    host["fingerprint"] = _fingerprint(builder, host)
    return host


def _elements(
    soft: SoftLayout, membrane: dict[str, NDArray[Any]], frames: FrameLayout | None
) -> dict[str, tuple[IntArray, NDArray[Any]]]:
    """Corners of all elements by how their stiffness is kept."""
    elements = _tet_elements(soft.tets, np.isin(soft.laws, TURNED)) | element_kinds(soft.quadratic)
    if len(membrane["tri_node"]):
        corners = np.pad(membrane["tri_node"], ((0, 0), (0, 1)), constant_values=-1)
        elements["membrane"] = (corners, np.arange(len(corners)))
    if frames is not None:
        elements["segment"] = (frames.corners, np.arange(len(frames.corners)))
    return elements


def _taken(arrays: dict[str, NDArray[Any]], is_wanted: Callable[[str], bool], prefix: str) -> dict[str, NDArray[Any]]:
    """Move arrays with wanted names out; of ``membrane_carried_block`` the prefix goes, of ``membrane_entry`` not."""
    found = {key: arrays.pop(key) for key in list(arrays) if is_wanted(key)}
    return {
        key.removeprefix(prefix) if "_carried_" in key or "_held_" in key else key: value
        for key, value in found.items()
    }


def _host_soft(builder: ModelBuilder, soft: SoftLayout) -> dict[str, Any]:
    """Names of all parts and host arrays of the soft bodies."""
    bodies, laws = builder.bodies, soft.laws
    surfaces = [meshing.tet_surface(b.mesh.tets) for b in bodies]
    outer = [s + n for s, n in zip(surfaces, soft.node_start[:-1], strict=True)]
    return {
        "body_names": tuple(b.name for b in bodies),
        "rigid_names": tuple(b.name for b in builder.rigids),
        "rigid_shapes": tuple(b.shape for b in builder.rigids),
        "rod_names": tuple(b.name for b in builder.rods),
        "cavity_names": tuple(c.name for c in builder.cavities),
        "cable_names": tuple(c.name for c in builder.cables),
        "joint_names": tuple(j.name for j in builder.joints),
        "marker_names": tuple(m.name for m in builder.markers),
        "node_rest": soft.nodes,
        "tet_corners": soft.tets,
        "body_node_start": soft.node_start,
        "node_fixed": soft.fixed,
        "node_locked": soft.locked,
        "law_parameters": tuple(tuple(b.material.law_parameters) for b in bodies),
        "surface_tri": stacked(outer, (0, 3), np.int32),
        "tri_body": np.repeat(np.arange(len(bodies)), [len(s) for s in surfaces]).astype(np.int32),
        "law_tets": {str(law): np.flatnonzero(laws == law).astype(np.int32) for law in np.unique(laws)},
    }


def _device_soft(
    builder: ModelBuilder,
    soft: SoftLayout,
    membranes: tuple[dict[str, Any], dict[str, NDArray[Any]], FloatArray],
    frames: FrameLayout | None,
) -> dict[str, NDArray[Any]]:
    """Device arrays of the soft bodies and markers."""
    triangles = np.pad(membranes[0]["triangles"], ((0, 0), (0, 1)), constant_values=-1)
    corners = np.concatenate([soft.tets, triangles]).ravel()
    used = np.flatnonzero(corners >= 0)
    of_node = np.concatenate([corners[used], soft.quadratic.nodes.ravel()])
    place = np.concatenate([used, corners.size + np.arange(soft.quadratic.nodes.size)])
    corner_start, corner = lists(of_node, place, len(soft.nodes))
    marker_node, marker_weight = markers(builder, soft)
    guides = len(soft.nodes) - int(soft.node_start[-1])
    return {
        "tet_node": soft.tets,
        "tet_body": soft.tet_body,
        "tet_gradient": soft.gradient,
        "tet_volume": soft.volume,
        "tet_frame": soft.frame,
        "body_law_start": np.cumsum([0, *(len(b.material.law_parameters) for b in builder.bodies)])[:-1],
        "node_body": soft.node_body,
        "node_volume": soft.node_volume + np.pad(membranes[2], (0, guides)),
        "node_load": soft.node_load,
        "corner_start": corner_start,
        "corner": corner,
        "marker_node": marker_node,
        "marker_weight": marker_weight,
        "marker_anchor": np.zeros((len(builder.markers), 3)),
        **marker_frames(builder, frames),
    }


def _extent(nodes: FloatArray, frames: FrameLayout | None) -> float:
    """Diagonal of the box around all nodes and frames [m]; at least 1 m where rigid bodies may fly far."""
    if frames is None:
        return float(np.linalg.norm(np.ptp(nodes, axis=0)))
    points = np.concatenate([nodes, frames.pose[:, :3]])
    return max(float(np.linalg.norm(np.ptp(points, axis=0))), 1.0)


def _defaults(builder: ModelBuilder) -> dict[str, FloatArray]:
    bodies, cables = builder.bodies, builder.cables
    values = {
        "youngs": np.array([b.material.youngs for b in bodies]),
        "nu": np.array([b.material.nu for b in bodies]),
        "law_parameter": np.array([value for b in bodies for value in b.material.law_parameters.values()]),
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
    for key in (*names, "marker_local", "cable_closing_length"):
        digest.update(np.ascontiguousarray(host["device"][key]).tobytes())
    if host["quadratic"] is not None:
        digest.update(np.ascontiguousarray(host["quadratic"][0].nodes).tobytes())
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
