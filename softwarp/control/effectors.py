"""What control brings to targets: points of bodies, and orientations of rigid bodies and rod sections."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softwarp import checks
from softwarp.model.codes import EffectorKind
from softwarp.model.model import Model
from softwarp.model.reduction import ReductionModel
from softwarp.solvers.inverse.problem import EffectorPlan

AXES = "xyz"


@dataclass(frozen=True)
class PointEffector:
    """The mean of some markers, to be brought to a point.

    Attributes:
        markers: From ``ModelBuilder.add_marker``.
        axes: Axes of the world along which the target counts.
        weight: Of its distance against that of other effectors.

    Raises:
        ValueError: For what are no numbers of markers, other axes, and a weight that is not positive and finite.
    """

    markers: tuple[int, ...]
    axes: str = AXES
    weight: float = 1.0

    def __post_init__(self) -> None:
        """Refuse what no scene can have."""
        need = "be the number of one marker or more"
        markers = checks.integers(self.markers, "point effector: markers", (None,), need=need)
        if not len(markers):
            raise ValueError(checks.refusal("point effector: markers", need, self.markers))
        object.__setattr__(self, "markers", tuple(markers.tolist()))
        _check_axes(self.axes, "point effector")
        checks.number(self.weight, "point effector: weight", above=0.0)


@dataclass(frozen=True)
class OrientationEffector:
    """The orientation of a rigid body or of a rod's section, to be turned to a quaternion.

    Attributes:
        frame: Index in ``Simulation.frame_pose``: rigid bodies, then rod nodes.
        length: Metres that a radian is worth against other effectors' distances.
        axes: Axes of the world about which the target counts.

    Raises:
        ValueError: For what is no number of a frame, other axes, and a length that is not positive and finite.
    """

    frame: int
    length: float = 0.1
    axes: str = AXES

    def __post_init__(self) -> None:
        """Refuse what no scene can have."""
        checks.count(self.frame, "orientation effector: frame", low=0)
        _check_axes(self.axes, "orientation effector")
        checks.number(self.length, "orientation effector: length [m]", above=0.0)


Effector = PointEffector | OrientationEffector


def check_effectors(effectors: Sequence[Effector | int], model: Model) -> list[Effector]:
    """Effectors of a model; a number stands for a marker.

    Raises:
        TypeError: For what is no effector.
        ValueError: For none at all, and an unknown marker or frame.
    """
    given = list(effectors) if isinstance(effectors, Iterable) else []
    result = [PointEffector((e,)) if isinstance(e, int | np.integer) else e for e in given]
    if not result:
        advice = "give the markers that have targets"
        raise ValueError(checks.refusal("inverse control: effectors", "hold at least one effector", effectors, advice))
    for effector in result:
        if not isinstance(effector, PointEffector | OrientationEffector):
            raise TypeError(
                f"inverse control: effectors: {effector!r} is no effector; give a marker, PointEffector or "
                "OrientationEffector"
            )
        if isinstance(effector, PointEffector):
            unknown = [marker for marker in effector.markers if not 0 <= marker < model.marker_count]
            if unknown:
                raise ValueError(
                    f"{effector}: markers must be among the {model.marker_count} of the scene, got {effector.markers}"
                )
        elif not 0 <= effector.frame < model.frame_count:
            raise ValueError(
                f"{effector}: frame must be one of the scene's {model.frame_count} rigid bodies and rod nodes"
            )
    return result


def _check_axes(axes: str, what: str) -> None:
    if not isinstance(axes, str) or not axes or not set(axes) <= set(AXES):
        raise ValueError(checks.refusal(f"{what}: axes", "be letters of 'xyz'", axes))


def plan_effectors(effectors: Sequence[Effector], model: Model) -> EffectorPlan:
    """Rows of the effectors.

    Raises:
        ValueError: If nothing that an effector consists of can move.
    """
    values: list[list[tuple[int, float]]] = []
    entries: list[dict[tuple[int, int], _Entry]] = []
    for effector in effectors:
        if isinstance(effector, PointEffector):
            share = 1.0 / len(effector.markers)
            values.append([(marker, share) for marker in effector.markers])
            entries.append(_point_entries(effector.markers, share, model))
        else:
            values.append([])
            entries.append(_orientation_entries(effector, model))
        if not entries[-1]:
            raise ValueError(f"{effector}: nothing that it depends on can move; choose other markers or frames")
    flat = [(key, entry) for found in entries for key, entry in sorted(found.items())]
    parts = [part for _, entry in flat for part in entry.parts]
    points = [part for value in values for part in value]
    weights = [[_weight(effector) * (axis in effector.axes) for axis in AXES] for effector in effectors]
    turning = [effector if isinstance(effector, OrientationEffector) else None for effector in effectors]
    return EffectorPlan(
        kind=_integers([EffectorKind.POINT if effector is None else EffectorKind.ORIENTATION for effector in turning]),
        frame=_integers([0 if effector is None else effector.frame for effector in turning]),
        length=np.array([1.0 if effector is None else effector.length for effector in turning]),
        value_start=_starts([len(value) for value in values]),
        value_marker=_integers([marker for marker, _ in points]),
        value_weight=np.array([weight for _, weight in points]),
        entry_start=_starts([len(found) for found in entries]),
        entry_dof=_integers([dof for (dof, _), _ in flat]),
        entry_block=np.array([entry.block.ravel() for _, entry in flat]),
        entry_frame=_integers([frame for (_, frame), _ in flat]),
        part_start=_starts([len(entry.parts) for _, entry in flat]),
        part_item=_integers([item for item, _ in parts]),
        part_weight=np.array([weight for _, weight in parts]),
        row_weight=np.array(weights, dtype=np.float64).ravel(),
    )


class _Entry:
    """What an effector has of a dof, its block of H, and what its rotation carries."""

    def __init__(self) -> None:
        self.block = np.zeros((3, 3))
        self.parts: list[tuple[int, float]] = []


def _point_entries(markers: Sequence[int], share: float, model: Model) -> dict[tuple[int, int], _Entry]:
    """Entries by dof and by the master whose rotation it is, -1 for a translation."""
    found: dict[tuple[int, int], _Entry] = {}
    node_dof, modes = model.node_dof.numpy(), model.reduction
    nodes, weights, carriers = model.marker_node.numpy(), model.marker_weight.numpy(), model.marker_frame.numpy()
    for marker in markers:
        if carriers[marker] >= 0:
            _carry(found, int(carriers[marker]), marker, share, model)
            continue
        for node, weight in zip(nodes[marker], weights[marker], strict=True):
            if node < 0 or weight == 0.0:
                continue
            if node_dof[node] >= 0:
                found.setdefault((int(node_dof[node]), -1), _Entry()).block += share * float(weight) * np.eye(3)
            elif modes is not None and (listed := np.flatnonzero(modes.node.numpy() == node)).size:
                _follow(found, int(listed[0]), share * float(weight), modes)
            elif model.frames is not None and model.frames.node_frame.numpy()[node] >= 0:
                _carry(found, int(model.frames.node_frame.numpy()[node]), -1 - int(node), share * float(weight), model)
    return found


def _follow(found: dict[tuple[int, int], _Entry], listed: int, weight: float, modes: ReductionModel) -> None:
    """Add a node of a reduced body, which modes move; ``listed`` is its number among such nodes."""
    body = int(modes.node_body.numpy()[listed])
    stride, first = int(modes.stride[body]), int(modes.node_basis.numpy()[listed])
    basis = modes.basis.numpy()[first : first + 3 * stride].reshape(3, stride)
    dofs = modes.mode_dof.numpy()[modes.start[body] // 3 : modes.start[body + 1] // 3]
    for block, dof in enumerate(dofs):
        found.setdefault((int(dof), -1), _Entry()).block += weight * basis[:, 3 * block : 3 * block + 3]


def _carry(found: dict[tuple[int, int], _Entry], frame: int, item: int, weight: float, model: Model) -> None:
    """Add a marker or node that a frame carries."""
    assert model.frames is not None
    dofs, master = model.frames.frame_dof.numpy(), int(model.frames.master[frame])
    translation, rotation = int(dofs[2 * frame]), int(dofs[2 * frame + 1])
    if translation >= 0:
        found.setdefault((translation, -1), _Entry()).block += weight * np.eye(3)
    if rotation >= 0:
        found.setdefault((rotation, master), _Entry()).parts.append((item, weight))


def _orientation_entries(effector: OrientationEffector, model: Model) -> dict[tuple[int, int], _Entry]:
    assert model.frames is not None
    rotation = int(model.frames.frame_dof.numpy()[2 * effector.frame + 1])
    if rotation < 0:
        return {}
    entry = _Entry()
    entry.block = effector.length * np.eye(3)
    return {(rotation, -1): entry}


def _weight(effector: Effector) -> float:
    return effector.weight if isinstance(effector, PointEffector) else 1.0


def _integers(values: Sequence[int]) -> NDArray[np.int32]:
    return np.asarray(values, dtype=np.int32)


def _starts(counts: Sequence[int]) -> NDArray[np.int32]:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
