"""Digest of everything that gives a state its meaning; equal for equal scenes on any device and batch size.

Snapshots carry it, so it may never change for a scene: the arrays below are hashed in this order and with these types.
Records that are not named below are hashed as they are declared, so that no part can be forgotten.
"""

from __future__ import annotations

import hashlib
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from softwarp.model.fields import declarations
from softwarp.model.model import Model
from softwarp.plan.frames import FrameLayout
from softwarp.scene.parts import Scene

BOOL, INT, LONG, FLOAT = np.bool_, np.int32, np.int64, np.float64
SOFT = {
    "node_rest": FLOAT,
    "tet_corners": INT,
    "node_fixed": BOOL,
    "node_locked": BOOL,
    "body_node_start": INT,
    "cable_starts": INT,
    "cable_force_controlled": BOOL,
    "point_node": INT,
    "point_weight": FLOAT,
    "point_anchor": FLOAT,
    "marker_node": INT,
    "marker_weight": FLOAT,
    "marker_frame": INT,
    "node_load": FLOAT,
    "marker_local": FLOAT,
    "cable_closing_length": FLOAT,
}
CAVITIES = {
    "cavity_point_start": INT,
    "cavity_area": FLOAT,
    "cavity_rest_volume": FLOAT,
    "point_cavity": LONG,
    "cavity_control": LONG,
    "ring_start": INT,
    "point_ring": INT,
    "edge_cavity": LONG,
    "edge_opposite": INT,
    "coupling_start": INT,
    "coupling_edge": INT,
    "coupling_weight": FLOAT,
}
MEMBRANES = {
    "tri_node": INT,
    "tri_membrane": INT,
    "tri_gradient": FLOAT,
    "tri_volume": FLOAT,
    "element_body": INT,
    "membrane_entry_start": INT,
    "membrane_entry": INT,
    "carried_block": INT,
    "carried_start": INT,
    "carried_entry": INT,
    "carried_weight": FLOAT,
    "held_node": INT,
    "held_start": INT,
    "held_entry": INT,
    "held_weight": FLOAT,
}
JOINTS = {
    "joint_frame": INT,
    "joint_place": FLOAT,
    "joint_free": LONG,
    "joint_control": LONG,
    "joint_length": FLOAT,
    "joint_scale": FLOAT,
    "joint_row_start": INT,
    "row_joint": INT,
    "row_kind": INT,
    "row_axis": INT,
    "gyrating_frame": INT,
    "turned_frame": INT,
    "turned_start": INT,
    "turned_side": INT,
}
FRAMES = {
    "pose": FLOAT,
    "master": INT,
    "offset": FLOAT,
    "volume": FLOAT,
    "inertia": FLOAT,
    "free": BOOL,
    "carried_slot": INT,
}
SURFACE = {"points": FLOAT, "triangles": INT, "node": INT, "weight": FLOAT}
# Records hashed by name
NAMED = ("frames", "cavities", "membranes", "joints", "contact", "quadratic", "hexes", "symbolic")
SEGMENTS = {"seg_length": FLOAT, "seg_section": FLOAT, "seg_scale": FLOAT, "seg_rest": FLOAT}


def fingerprint(scene: Scene, model: Model, frames: FrameLayout | None) -> str:
    """Digest of a scene, of its model before the upload and of its frames."""
    digest = hashlib.sha256()

    def add(record: Any, arrays: dict[str, Any]) -> None:
        for name, dtype in arrays.items():
            digest.update(np.ascontiguousarray(getattr(record, name), dtype=dtype).tobytes())

    add(model, SOFT)
    if model.quadratic is not None:
        add(model.quadratic, {"nodes": INT})
    if model.hexes is not None:
        digest.update(b"hexes")
        add(model.hexes, {"nodes": INT})
        add(model.hexes.layout, {"thin": BOOL})
    for body in scene.bodies:
        if body.stiffness is not None:
            digest.update(body.stiffness.tobytes())
    if model.cable_elastic.any():
        digest.update(model.cable_elastic.tobytes())
    if model.relaxes:
        digest.update(b"relaxation")
    laws = ",".join(b.material.kernel_law for b in scene.bodies)
    digest.update(f"{laws};{model.body_names};{model.cable_names};{model.marker_names}".encode())
    if model.contact is not None:
        pairs = [(a.kind, int(a), b.kind, int(b)) for a, b in model.contact.parts]
        digest.update(f"{pairs};{model.contact.capacity};{model.contact.scene.key_count}".encode())
        for surface in (body.contact_surface for body in scene.bodies if body.contact_surface is not None):
            add(surface, SURFACE)
    for part, arrays in ((model.cavities, CAVITIES), (model.membranes, MEMBRANES), (model.joints, JOINTS)):
        if part is not None:
            add(part, arrays)
    if frames is not None:
        add(frames, FRAMES)
        add(frames.segments, SEGMENTS)
        digest.update(f"{model.rigid_names};{model.rod_names}".encode())
    for name in (entry.name for entry in fields(model) if entry.name not in NAMED):
        record = getattr(model, name)
        if is_dataclass(record):
            digest.update(name.encode())
            values = {key: np.asarray(getattr(record, key)) for key in declarations(record)}
            add(record, {key: FLOAT if value.dtype.kind == "f" else LONG for key, value in values.items()})
    return digest.hexdigest()
