"""What inverse control may use: cables, air chambers and motors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from softwarp import checks
from softwarp.model.codes import CavityControl, JointControl, JointRow
from softwarp.model.model import Model
from softwarp.solvers.inverse.actuators import CABLE, CHAMBER, JOINT, ActuatorPlan

IntArray = NDArray[np.int32]


def plan_actuators(
    model: Model, cables: Sequence[int] | None, chambers: Sequence[int] | None, joints: Sequence[int] | None
) -> ActuatorPlan:
    """Rows of the actuators; None takes all of a kind that can be commanded.

    Raises:
        ValueError: For an actuator that does not exist, is named twice, or that no command of control reaches.
    """
    parts = [_cables(model, cables), _chambers(model, chambers), _joints(model, joints)]
    row, item, is_effort = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    kind = np.repeat([CABLE, CHAMBER, JOINT], [len(part[0]) for part in parts])
    if row.size == 0:
        raise ValueError(
            "inverse control: nothing to act with; the scene needs cables, chambers or motors, or the lists name none"
        )
    return ActuatorPlan(_integers(row), _integers(kind), _integers(item), is_effort.astype(bool))


def _cables(model: Model, named: Sequence[int] | None) -> tuple[IntArray, IntArray, NDArray[np.bool_]]:
    chosen = _chosen(named, np.flatnonzero(~model.cable_elastic), model.cable_count, "cables")
    if model.cable_elastic[chosen].any():
        name = model.cable_names[chosen[model.cable_elastic[chosen]][0]]
        raise ValueError(f"inverse control: cable {name!r} is elastic or a spring; name cables that do not stretch")
    return chosen, chosen, model.cable_force_controlled[chosen]


def _chambers(model: Model, named: Sequence[int] | None) -> tuple[IntArray, IntArray, NDArray[np.bool_]]:
    control = np.zeros(0, dtype=np.int32) if model.cavities is None else model.cavities.cavity_control.numpy()
    chosen = _chosen(named, np.flatnonzero(control != CavityControl.GAS), model.cavity_count, "chambers")
    if (control[chosen] == CavityControl.GAS).any():
        name = model.cavity_names[chosen[control[chosen] == CavityControl.GAS][0]]
        raise ValueError(
            f"inverse control: chamber {name!r} is under gas control; it commands chambers under control='pressure' or "
            "'volume'"
        )
    return _integers(model.first_row("cavity") + chosen), chosen, control[chosen] == CavityControl.PRESSURE


def _joints(model: Model, named: Sequence[int] | None) -> tuple[IntArray, IntArray, NDArray[np.bool_]]:
    if model.joints is None:
        chosen = _chosen(named, np.zeros(0, dtype=np.int32), 0, "joints")
        return chosen, chosen, chosen.astype(bool)
    control = model.joints.joint_control.numpy()
    chosen = _chosen(named, np.flatnonzero(control != JointControl.NONE), model.joint_count, "joints")
    if (control[chosen] == JointControl.NONE).any():
        name = model.joint_names[chosen[control[chosen] == JointControl.NONE][0]]
        raise ValueError(f"inverse control: joint {name!r} has no motor; give add_joint control='position' or 'force'")
    is_free = model.joints.row_kind.numpy() == JointRow.FREE
    rows = np.flatnonzero(is_free)
    row_of = dict(zip(model.joints.row_joint.numpy()[rows].tolist(), rows.tolist(), strict=True))
    first = model.first_row("joint row")
    return _integers([first + row_of[int(joint)] for joint in chosen]), chosen, control[chosen] == JointControl.FORCE


def _chosen(named: Sequence[int] | None, all_of_them: NDArray[np.integer], count: int, kind: str) -> IntArray:
    """Numbers that were named, or all."""
    chosen = np.asarray(all_of_them, dtype=np.int64)
    if named is not None:
        given = checks.as_array(list(named) if isinstance(named, Iterable) else named)
        if given.ndim != 1 or (given.size and given.dtype.kind not in "iu"):
            raise ValueError(checks.refusal(f"inverse control: {kind}", "be a list of numbers", named))
        chosen = given.astype(np.int64)
    if chosen.size and not count:
        raise ValueError(f"inverse control: the scene has no {kind}, got {chosen.tolist()}; name what it has")
    if chosen.size and (chosen.min() < 0 or chosen.max() >= count or len(np.unique(chosen)) != len(chosen)):
        raise ValueError(f"inverse control: {kind} must be different ones of 0 .. {count - 1}, got {chosen.tolist()}")
    return _integers(chosen)


def _integers(values: Sequence[int] | NDArray[np.integer]) -> IntArray:
    return np.asarray(values, dtype=np.int32)
