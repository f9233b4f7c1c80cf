"""From a scene to its model: numbering, structure of A, arrays, and their upload to a device."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp import checks
from softwarp.model.codes import TURNED
from softwarp.model.fields import real_of
from softwarp.model.model import Model
from softwarp.plan.cables import CableArrays, cable_arrays, cable_points, marker_arrays
from softwarp.plan.cavities import (
    CavityPoints,
    MembraneLayout,
    cavity_model,
    cavity_points,
    membrane_elements,
    membrane_layout,
    membrane_model,
    tied_nodes,
    with_tangent,
)
from softwarp.plan.contact import contact_model, expected_contacts
from softwarp.plan.fingerprint import fingerprint
from softwarp.plan.frame_arrays import frame_model, master_dof_of, segment_elements
from softwarp.plan.frames import FrameLayout, layout
from softwarp.plan.hexes import hex_elements, hex_lists, hex_model
from softwarp.plan.joints import JointLayout, joint_layout, joint_model
from softwarp.plan.parameters import parameter_defaults
from softwarp.plan.quadratic import entry_lists, inertia_lists, quadratic_elements, quadratic_model
from softwarp.plan.reduction import mode_blocks, reduction_model, touch_dofs
from softwarp.plan.resolution import frame_sizes, node_size, refuse_far
from softwarp.plan.sampled import with_points
from softwarp.plan.soft import SoftLayout, soft_arrays, soft_elements, soft_layout, tet_elements
from softwarp.plan.structure import Elements, ModeBlocks, Points, Structure, structure
from softwarp.plan.telescopes import check_telescopes, telescope_model
from softwarp.plan.touching import expected_touch
from softwarp.plan.tractions import traction_model
from softwarp.plan.upload import checked_device, upload
from softwarp.scene.parts import Scene
from softwarp.scene.reduction import check_parts

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]
USUAL_CONTACTS = 24  # for which elimination orders are compared, or half of what may occur; benchmarks/contact.py


def plan(scene: Scene, num_worlds: int, device: str, precision: str, contact_capacity: int | None = None) -> Model:
    """Build the model of a scene on a device.

    Raises:
        ValueError: For an empty scene, a body without free nodes, a part too far from the origin for the precision, a
            world count below 1, an unknown precision or a device that this machine does not have.
    """
    checks.count(num_worlds, "num_worlds")
    real = real_of(precision)
    device = checked_device(device)
    if not (scene.bodies or scene.rigids or scene.rods):
        raise ValueError("the scene is empty: add a body with add_tets, add_rod or add_rigid before finalize")
    relaxing = next((body.name for body in scene.bodies if body.relaxation[0] > 0.0), None)
    damped = next((rod.name for rod in scene.rods if rod.rayleigh[1] > 0.0), None)
    check_parts(scene)
    check_telescopes(scene)
    if relaxing is not None and damped is not None:
        raise ValueError(
            f"body {relaxing!r} has relaxation and rod {damped!r} a Rayleigh factor of stiffness, which one scene "
            "cannot have both; leave one out"
        )
    scene = with_points(scene)
    parts = _layouts(scene)
    found = _structure(scene, parts, is_cpu=device == "cpu")
    model = _model(scene, parts, found, contact_capacity)
    given = replace(model, num_worlds=int(num_worlds), device=device, precision=precision)
    refuse_far(given)
    return upload(replace(given, fingerprint=fingerprint(scene, model, parts.frames)), device, real)


@dataclass(frozen=True)
class _Layouts:
    """All parts of a scene, numbered, before the elimination order is known."""

    soft: SoftLayout
    frames: FrameLayout | None
    membranes: MembraneLayout
    joints: JointLayout
    cables: CableArrays
    chambers: CavityPoints
    first_point: int  # of the chambers
    points: Points  # of cables, then of chambers
    modes: ModeBlocks | None

    @property
    def thin(self) -> list[Elements]:
        """Elements with up to four corners besides linear tets, in the order of their forces."""
        return membrane_elements(self.membranes)

    @property
    def row_starts(self) -> IntArray:
        """Ranges of the points of all cables and chambers."""
        return np.concatenate([self.cables.cable_starts, self.first_point + self.chambers.starts[1:]])


def _layouts(scene: Scene) -> _Layouts:
    soft = soft_layout(scene)
    frames = layout(scene, soft.node_start, soft.nodes) if scene.rigids or scene.rods else None
    if soft.fixed.all() and frames is None:
        raise ValueError("every node of the scene is fixed, so nothing can move; fix fewer nodes")
    cables = cable_points(scene, soft)
    chambers = cavity_points(scene, soft.node_start, soft.carrier_start, soft.carriers)
    return _Layouts(
        soft=soft,
        frames=frames,
        membranes=membrane_layout(scene, soft.node_start),
        joints=joint_layout(scene, frames),
        cables=cable_arrays(scene),
        chambers=chambers,
        first_point=len(cables.point_node),
        points=cables.followed_by(chambers.points),
        modes=mode_blocks(scene, soft.node_start, len(soft.nodes)),
    )


def _structure(scene: Scene, parts: _Layouts, *, is_cpu: bool) -> Structure:
    soft, frames = parts.soft, parts.frames
    is_turned = scene.pairs and is_cpu and not _is_order_in_digest(scene, parts)
    return structure(
        soft.nodes,
        soft.fixed,
        soft.locked,
        [*soft_elements(soft, frames), *parts.thin, *segment_elements(frames)],
        parts.row_starts,
        parts.points,
        parts.joints.row_frames,
        frames,
        contacts=min(expected_contacts(scene) // 2, USUAL_CONTACTS),
        modes=parts.modes,
        touch=expected_touch(scene, soft, frames) if is_turned else None,
    )


def _is_order_in_digest(scene: Scene, parts: _Layouts) -> bool:
    """Whether a part's digest has lists in elimination order, which may not change and are the same on every device."""
    has_tangent = any(scene.bodies[c.body].material.kernel_law not in TURNED for c in scene.cavities)
    return has_tangent or bool(parts.thin) or parts.modes is not None or bool(scene.telescopes)


def _model(scene: Scene, parts: _Layouts, found: Structure, contact_capacity: int | None) -> Model:
    """The model of one world with NumPy's arrays, without its fingerprint."""
    soft, frames = parts.soft, parts.frames
    cavities = cavity_model(scene, parts.chambers, parts.first_point, found)
    sizes = [parts.cables.cable_rest]
    if cavities is not None:
        sizes.append(cavities.rest_volume / cavities.cavity_area)
    arrays = soft_arrays(scene, soft, parts.thin, parts.membranes.node_volume)
    frame_dof = np.empty(0, dtype=np.int32) if frames is None else master_dof_of(frames, found.slots).ravel()
    extent = _extent(soft.nodes, frames)
    touch_dof = touch_dofs(scene, soft, found.unknowns.node_dof, found.symbolic.size)
    return Model(
        num_worlds=1,
        device="cpu",
        precision="float64",
        fingerprint="",
        body_names=tuple(b.name for b in scene.bodies),
        rigid_names=tuple(b.name for b in scene.rigids),
        rod_names=tuple(b.name for b in scene.rods),
        cavity_names=tuple(c.name for c in scene.cavities),
        cable_names=tuple(c.name for c in scene.cables),
        joint_names=tuple(j.name for j in scene.joints),
        marker_names=tuple(m.name for m in scene.markers),
        rigid_shapes=tuple(b.shape for b in scene.rigids),
        defaults=parameter_defaults(scene),
        symbolic=found.symbolic,
        extent=extent,
        node_size=node_size(scene),
        frames=frame_model(frames, found, len(scene.bodies), frame_sizes(scene, frames, extent), soft.quadratic.nodes),
        cavities=cavities,
        membranes=membrane_model(scene, parts.membranes, found),
        tractions=traction_model(scene, soft.node_start),
        joints=joint_model(scene, parts.joints, frames),
        contact=contact_model(scene, soft.nodes, soft.node_start, touch_dof, frames, frame_dof, contact_capacity),
        quadratic=quadratic_model(soft.quadratic, soft.nodes, found),
        hexes=hex_model(soft.hexes, soft.nodes, found),
        reduction=reduction_model(
            scene, soft, arrays, parts.membranes, parts.points, parts.row_starts, parts.modes, found, touch_dof
        ),
        telescopes=telescope_model(scene, frames, frame_dof),
        row_size=np.concatenate([*sizes, parts.joints.row_size]),
        **vars(arrays),
        **vars(parts.cables),
        **vars(parts.points),
        **vars(marker_arrays(scene, soft, frames)),
        **found.model_arrays(),
    )


def _extent(nodes: FloatArray, frames: FrameLayout | None) -> float:
    """Diagonal of the box around all nodes and frames [m]; at least 1 m where rigid bodies may fly far."""
    if frames is None:
        return float(np.linalg.norm(np.ptp(nodes, axis=0)))
    points = np.concatenate([nodes, frames.pose[:, :3]])
    return max(float(np.linalg.norm(np.ptp(points, axis=0))), 1.0)


def coupled(model: Model) -> Model:
    """The same scene with room in A for the exact tangent of cables and chambers.

    The stiffness of taut cables ties the ends of each segment together, pressure the ends of each edge of a surface.

    Only the order of ``dof`` and what follows from it differ; states and commands serve both models.
    """
    if model.cable_count == 0 and model.cavities is None:
        return model
    is_turned = np.zeros(model.tet_count, dtype=bool)
    for law in TURNED:
        if law in model.law_tets:
            is_turned[model.law_tets[law].numpy()] = True
    elements = tet_elements(model.tet_corners, is_turned)
    quadratic, hexes = model.quadratic, model.hexes
    if quadratic is not None:
        elements += quadratic_elements(quadratic.layout)
    if hexes is not None:
        elements += hex_elements(hexes.layout)
    points = Points(model.point_node.numpy(), model.point_weight.numpy(), model.point_anchor.numpy())
    chambers, starts, ties = model.cavities, model.cable_starts, np.empty((0, 2), dtype=np.int32)
    if chambers is not None:
        starts = np.concatenate([starts, model.point_count + chambers.starts[1:]]).astype(np.int32)
        ties = tied_nodes(chambers, model.point_count, points)
    found = structure(
        model.node_rest,
        model.node_fixed,
        model.node_locked,
        elements,
        starts,
        points,
        np.empty((0, 2), dtype=np.int32),
        with_segments=model.cable_count,
        ties=ties,
    )
    chambers = None if chambers is None else with_tangent(chambers, model.point_count, points, found)
    if quadratic is not None:
        inertia = inertia_lists(quadratic.layout, found, model.node_count)
        quadratic = replace(quadratic, **vars(entry_lists(found)), **vars(inertia))
    if hexes is not None:
        hexes = replace(hexes, **vars(hex_lists(hexes.layout, found)))
    parts: dict[str, Any] = {"quadratic": quadratic, "hexes": hexes, "cavities": chambers}
    other = replace(model, symbolic=found.symbolic, **parts, **found.model_arrays())
    return upload(other, model.device, real_of(model.precision))
