"""Joints between rigid bodies, rod nodes and the world, and their motors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from softwarp import checks
from softwarp.model.codes import JOINT_CONTROLS, JOINT_KINDS
from softwarp.model.handles import Handle, Joint, RigidBody, Rod
from softwarp.scene.checks import limits as bounds
from softwarp.scene.checks import node_indices, vector
from softwarp.scene.parts import FloatArray, JointSpec, Scene

Part = RigidBody | tuple[Rod, int]


def add_joint(
    scene: Scene,
    parent: Part | None,
    child: Part,
    kind: Literal["hinge", "slider", "ball", "weld"],
    *,
    anchor: Sequence[float] | None,
    axis: Sequence[float],
    limits: tuple[float, float],
    control: Literal["none", "position", "velocity", "force"],
    stiffness: float,
    damping: float,
    max_force: float,
    max_rate: float,
    name: str | None,
) -> Joint:
    """Join two rigid bodies or rod nodes, or one of them to the world, perhaps with limits and a motor."""
    label = checks.label(name, f"joint{len(scene.joints)}", "name of a joint")
    if label in [spec.name for spec in scene.joints]:
        raise ValueError(f"joint {label!r} exists already; give every joint its own name")
    checks.choice(kind, f"joint {label!r}: kind", JOINT_KINDS)
    checks.choice(control, f"joint {label!r}: control", JOINT_CONTROLS)
    first = None if parent is None else _part(scene, parent, label, "parent")
    second = _part(scene, child, label, "child")
    if first is not None and (first[0].kind, *first) == (second[0].kind, *second):
        raise ValueError(f"joint {label!r} connects {second[0]!r} to itself; give it another parent")
    direction = vector(axis, f"joint {label!r}: axis")
    length = float(np.linalg.norm(direction))
    if length < 1e-12:
        raise ValueError(f"joint {label!r}: the axis must not be zero, got {axis!r}")
    where = _origin(scene, second) if anchor is None else vector(anchor, f"joint {label!r}: anchor")
    if not isinstance(limits, (Sequence, np.ndarray)) or isinstance(limits, str) or len(limits) != 2:
        raise ValueError(checks.refusal(f"joint {label!r}: limits", "be two numbers (lowest, highest)", limits))
    motor = {"stiffness": stiffness, "damping": damping, "max_force": max_force, "max_rate": max_rate}
    given = bounds({"lower limit": limits[0], "upper limit": limits[1], **motor}, f"joint {label!r}")
    spec = JointSpec(
        name=label,
        kind=kind,
        parent=first,
        child=second,
        anchor=where,
        axis=direction / length,
        limits=(given["lower limit"], given["upper limit"]),
        control=control,
        stiffness=given["stiffness"],
        damping=given["damping"],
        max_force=given["max_force"],
        max_rate=given["max_rate"],
    )
    _check_motor(spec)
    scene.joints.append(spec)
    return Joint(len(scene.joints) - 1)


def _part(scene: Scene, part: Any, label: str, what: str) -> tuple[Handle, int]:
    """Rigid body and -1, or rod and node."""
    if isinstance(part, RigidBody):
        if not 0 <= part < len(scene.rigids):
            raise ValueError(f"joint {label!r}: {part!r} does not exist; the builder has {len(scene.rigids)}")
        return part, -1
    if isinstance(part, tuple) and len(part) == 2 and isinstance(part[0], Rod):
        rod, node = part
        if not 0 <= rod < len(scene.rods):
            raise ValueError(f"joint {label!r}: {rod!r} does not exist; the builder has {len(scene.rods)}")
        count = len(scene.rods[rod].geometry.positions)
        return rod, int(node_indices([node], count, f"joint {label!r}: node of {rod!r}")[0])
    raise ValueError(
        f"joint {label!r}: {what} must be what add_rigid returned, or a rod and one of its nodes as (rod, node), "
        f"got {part!r}"
    )


def _origin(scene: Scene, part: tuple[Handle, int]) -> FloatArray:
    """Where a rigid body or a rod node is at the start [m]."""
    handle, node = part
    if isinstance(handle, RigidBody):
        return scene.rigids[handle].pose[:3].copy()
    return np.array(scene.rods[handle].geometry.positions[node], dtype=np.float64)


def _check_motor(spec: JointSpec) -> None:
    """Refuse limits and motors that the joint cannot have."""
    label, (low, high) = f"joint {spec.name!r}", spec.limits
    if not low < high or not low <= 0.0 <= high:
        raise ValueError(f"{label}: limits must be ordered around 0, the position at the start, got {spec.limits}")
    is_limited = math.isfinite(low) or math.isfinite(high)
    if spec.kind in ("ball", "weld") and (is_limited or spec.control != "none"):
        raise ValueError(f"{label}: a {spec.kind} has no axis to limit or drive; use a hinge or a slider")
    for what, value in (("stiffness", spec.stiffness), ("damping", spec.damping)):
        if value < 0.0:
            raise ValueError(f"{label}: {what} must be at least 0, got {value!r}")
    for what, value in (("max_force", spec.max_force), ("max_rate", spec.max_rate)):
        if value < 0.0:
            raise ValueError(f"{label}: {what} must be at least 0, got {value!r}")
        if spec.control == "none" and value != math.inf:
            raise ValueError(f"{label}: {what} belongs to a motor; pass control as well")
    if spec.control != "position" and (spec.stiffness != math.inf or spec.damping != 0.0):
        raise ValueError(f"{label}: stiffness and damping belong to control='position', got control={spec.control!r}")
    if not math.isfinite(spec.damping) or (spec.stiffness == math.inf and spec.damping != 0.0):
        raise ValueError(f"{label}: damping must be finite, and needs a finite stiffness, got {spec.damping!r}")
    if spec.control == "position" and spec.stiffness == 0.0 and spec.damping == 0.0:
        raise ValueError(f"{label}: a servo needs stiffness or damping; control='force' imposes a force instead")
