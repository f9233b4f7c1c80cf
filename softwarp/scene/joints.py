"""``JointBuilder``: the builder's method for joints and motors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from softwarp.model.codes import JOINT_CONTROLS
from softwarp.scene.contact import ContactBuilder
from softwarp.scene.frames import node_indices
from softwarp.scene.parts import FloatArray, Handle, Joint, JointSpec, RigidBody, Rod

KINDS = ("hinge", "slider", "ball", "weld")
Part = RigidBody | tuple[Rod, int]


class JointBuilder(ContactBuilder):
    """Joints; part of ``ModelBuilder``."""

    def __init__(self) -> None:
        super().__init__()
        self.joints: list[JointSpec] = []

    def add_joint(
        self,
        parent: Part | None,
        child: Part,
        kind: Literal["hinge", "slider", "ball", "weld"] = "hinge",
        *,
        anchor: Sequence[float] | None = None,
        axis: Sequence[float] = (0.0, 0.0, 1.0),
        limits: tuple[float, float] = (-math.inf, math.inf),
        control: Literal["none", "position", "velocity", "force"] = "none",
        stiffness: float = math.inf,
        damping: float = 0.0,
        max_force: float = math.inf,
        max_rate: float = math.inf,
        name: str | None = None,
    ) -> Joint:
        """Join two rigid bodies or rod nodes, or one of them to the world, perhaps with limits and a motor.

        Positions are angles [rad] of hinges, counted over any number of turns, and ways [m] of sliders; both are 0 at
        the start and grow when the child turns about, or moves along, the axis relative to the parent. A rod node
        joins with its section. The motor of a body with ``free_axes`` is that of a joint to the world along the free
        axis, such as ``add_joint(None, cart, "slider", axis=(1, 0, 0), control="force")`` for ``free_axes="x"``.

        Args:
            parent: Rigid body, or rod and node; None is the world.
            child: Rigid body, or rod and node.
            kind: ``hinge`` turns about the axis, ``slider`` moves along it, ``ball`` turns about the anchor, ``weld``
                does neither and reports the load that it carries.
            anchor: Point of the joint at the start [m], in the world; None takes the child's origin.
            axis: Axis at the start, in the world.
            limits: Lowest and highest position, around 0.
            control: Motor of a hinge or slider: ``position`` steers to ``control.joint_target``, ``velocity`` moves at
                it, ``force`` exerts ``control.joint_force``.
            stiffness: Of a position servo, with force = stiffness (reference - position) - damping velocity +
                ``control.joint_force``; infinite for one that is where its reference is [N m/rad, N/m].
            damping: Likewise [N m s/rad, N s/m]. A spring with a damper is a position servo whose target stays 0.
            max_force: Largest force of the motor [N m, N]. A motor built without a limit has none in any world.
            max_rate: Largest speed of the servo's reference, or of a velocity command [rad/s, m/s].
            name: For messages and exports.

        Returns:
            Handle, index of ``Simulation.joint_position``, ``joint_velocity``, ``joint_force`` (of the motor) and
            ``joint_reaction`` (force and moment about the anchor on the child).

        Raises:
            ValueError: For a part that does not exist, a value outside its range, or a motor that the joint cannot
                have.
        """
        label = name or f"joint{len(self.joints)}"
        if label in [spec.name for spec in self.joints]:
            raise ValueError(f"joint {label!r} exists already; give every joint its own name")
        for what, value, allowed in (("kind", kind, KINDS), ("control", control, JOINT_CONTROLS)):
            if value not in allowed:
                raise ValueError(f"joint {label!r}: {what} must be one of {', '.join(allowed)}, got {value!r}")
        first = None if parent is None else self._joint_part(parent, label, "parent")
        second = self._joint_part(child, label, "child")
        if first is not None and (first[0].kind, *first) == (second[0].kind, *second):
            raise ValueError(f"joint {label!r} connects {second[0]!r} to itself; give it another parent")
        direction = _triple(axis, f"joint {label!r}: axis")
        length = float(np.linalg.norm(direction))
        if length < 1e-12:
            raise ValueError(f"joint {label!r}: the axis must not be zero, got {axis!r}")
        where = self._part_origin(second) if anchor is None else _triple(anchor, f"joint {label!r}: anchor")
        spec = JointSpec(
            name=label,
            kind=kind,
            parent=first,
            child=second,
            anchor=where,
            axis=direction / length,
            limits=(float(limits[0]), float(limits[1])),
            control=control,
            stiffness=float(stiffness),
            damping=float(damping),
            max_force=float(max_force),
            max_rate=float(max_rate),
        )
        _check_motor(spec)
        self.joints.append(spec)
        return Joint(len(self.joints) - 1)

    def _joint_part(self, part: Any, label: str, what: str) -> tuple[Handle, int]:
        if isinstance(part, RigidBody):
            if not 0 <= part < len(self.rigids):
                raise ValueError(f"joint {label!r}: {part!r} does not exist; the builder has {len(self.rigids)}")
            return part, -1
        if isinstance(part, tuple) and len(part) == 2 and isinstance(part[0], Rod):
            rod, node = part
            if not 0 <= rod < len(self.rods):
                raise ValueError(f"joint {label!r}: {rod!r} does not exist; the builder has {len(self.rods)}")
            count = len(self.rods[rod].geometry.positions)
            return rod, int(node_indices([node], count, f"joint {label!r}: node of {rod!r}")[0])
        raise ValueError(
            f"joint {label!r}: {what} must be what add_rigid returned, or a rod and one of its nodes as (rod, node), "
            f"got {part!r}"
        )

    def _part_origin(self, part: tuple[Handle, int]) -> FloatArray:
        handle, node = part
        if isinstance(handle, RigidBody):
            return self.rigids[handle].pose[:3].copy()
        return np.array(self.rods[handle].geometry.positions[node], dtype=np.float64)


def _check_motor(spec: JointSpec) -> None:
    label, (low, high) = f"joint {spec.name!r}", spec.limits
    if not low < high or not low <= 0.0 <= high:
        raise ValueError(f"{label}: limits must be ordered around 0, the position at the start, got {spec.limits}")
    is_limited = math.isfinite(low) or math.isfinite(high)
    if spec.kind in ("ball", "weld") and (is_limited or spec.control != "none"):
        raise ValueError(f"{label}: a {spec.kind} has no axis to limit or drive; use a hinge or a slider")
    for what, value in (("stiffness", spec.stiffness), ("damping", spec.damping)):
        if math.isnan(value) or value < 0.0:
            raise ValueError(f"{label}: {what} must be at least 0, got {value!r}")
    for what, value in (("max_force", spec.max_force), ("max_rate", spec.max_rate)):
        if math.isnan(value) or value < 0.0:
            raise ValueError(f"{label}: {what} must be at least 0, got {value!r}")
        if spec.control == "none" and value != math.inf:
            raise ValueError(f"{label}: {what} belongs to a motor; pass control as well")
    if spec.control != "position" and (spec.stiffness != math.inf or spec.damping != 0.0):
        raise ValueError(f"{label}: stiffness and damping belong to control='position', got control={spec.control!r}")
    if not math.isfinite(spec.damping) or (spec.stiffness == math.inf and spec.damping != 0.0):
        raise ValueError(f"{label}: damping must be finite, and needs a finite stiffness, got {spec.damping!r}")
    if spec.control == "position" and spec.stiffness == 0.0 and spec.damping == 0.0:
        raise ValueError(f"{label}: a servo needs stiffness or damping; control='force' imposes a force instead")


def _triple(value: Sequence[float], name: str) -> FloatArray:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ValueError(f"{name} must be three finite numbers, got {value!r}")
    return array
