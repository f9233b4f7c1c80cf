"""Arrays that every step fills anew: declared with what they hold, allocated for the worlds of one shard.

A step must not depend on what it finds here. The tests fill all declared arrays with NaN before a step and compare
bits; only those with ``keeps`` hold constants, where no step writes them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.elements import corotational, grip, hexahedral, norms, quadratic, samples, tensor_sums, turning
from softwarp.kernels.frames.inertia import COMPOUND_ROWS
from softwarp.kernels.frames.tube_section import LAW_ROWS, PLAN_ROWS
from softwarp.kernels.frames.windup import SYSTEM_ROWS
from softwarp.kernels.step import newton, statics
from softwarp.model.codes import CHUNK_ROWS, FAR, TURNED
from softwarp.model.model import Model
from softwarp.solvers.workspace import rows
from softwarp.solvers.workspace.rows import Rows


@dataclass(frozen=True)
class Scratch:
    """What is declared of a workspace array.

    Attributes:
        item: What its rows count; a key of ``counts``.
        width: Rows of an item.
        unit: SI unit.
        doc: What it holds.
        keeps: Constant that it is filled with once and holds wherever no step writes, or None.
        integer: Whether it holds integers.
    """

    item: str
    width: int
    unit: str
    doc: str
    keeps: float | None
    integer: bool


def scratch(
    item: str, width: int = 1, *, unit: str = "1", doc: str = "", keeps: float | None = None, integer: bool = False
) -> Any:
    """Declare a workspace array with ``width`` rows for every ``item``."""
    return field(metadata={"scratch": Scratch(item, width, unit, doc, keeps, integer)})


@dataclass
class Workspace:
    """What terms and solvers of one shard write and read within a step.

    ``body`` counts soft bodies, then rods, then rigid bodies; ``dof`` unknown 3-blocks in elimination order; ``row``
    the static multiplier rows: of cables, then chambers, then joints; ``row point`` the points of cables, then of
    chambers.
    """

    # Trial state
    x: Rows = scratch("node", 3, unit="m", doc="positions")
    pose: Rows = scratch("frame", 7, unit="m", doc="position and quaternion x y z w of frames")
    twist: Rows = scratch("frame", 6, unit="m/s", doc="velocity and angular velocity [rad/s] of frames")
    lever: Rows = scratch("carried", 3, unit="m", doc="from a master to the slots that it carries")
    dof_v: Rows = scratch("dof", 3, unit="m/s", doc="velocities, of rotations [rad/s]; behind them of touching nodes")
    dof_v0: Rows = scratch("dof", 3, unit="m/s", doc="velocities at the start of the step")
    slot_v: Rows = scratch("slot", 3, unit="m/s", doc="velocities of nodes and of frames' translation and rotation")

    # Bodies and nodes
    body_mu: Rows = scratch("body", unit="Pa", doc="first Lame constant, the shear modulus")
    body_lam: Rows = scratch("body", unit="Pa", doc="second Lame constant")
    body_mass: Rows = scratch("body", doc="factor of M in A")
    body_stiffness: Rows = scratch("body", doc="factor of K in A")
    body_damping: Rows = scratch("body", doc="share of K's factor that damps")
    node_mass: Rows = scratch("node", unit="kg", doc="lumped mass")
    node_internal: Rows = scratch("node", 3, unit="N", doc="dE/dx")
    node_external: Rows = scratch("node", 3, unit="N", doc="loads and weight")

    # Elements
    element_force: Rows = scratch(
        "element force",
        unit="N",
        doc="dE/dx of corners: 12 a tet, then 12 a membrane triangle, 30 a quadratic tet, 24 a hexahedron",
    )
    tet_gradient: Rows = scratch("turned tet", corotational.TURNED_ROWS, doc="turned gradients of the corners")
    tet_stiffness: Rows = scratch("stored tet", 90, unit="N/m", doc="ten blocks K_ab, a >= b")
    membrane_stiffness: Rows = scratch("membrane tri", 90, unit="N/m", doc="blocks as of a tet")
    gauss_corner: Rows = scratch("Gauss point", 12, unit="m", doc="corners of its linear tet")
    gauss_corner_v: Rows = scratch("carried Gauss point", 12, unit="m/s", doc="their velocities")
    gauss_force: Rows = scratch("Gauss point", 12, unit="N", doc="dE/dx of these corners")
    gauss_gradient: Rows = scratch("turned Gauss point", corotational.TURNED_ROWS, doc="their turned gradients")
    gauss_shape: Rows = scratch("turned Gauss point", 30, doc="turned gradients of the ten nodes' shape functions")
    grip: Rows = scratch("grip", grip.ROWS, doc="sums of these and of their moments over nodes that a frame carries")
    gauss_stiffness: Rows = scratch("stored Gauss point", 90, unit="N/m", doc="ten blocks of its linear tet")
    hex_moduli: Rows = scratch("hex shape", 2, unit="Pa", doc="Lame constants of hex_stiffness")
    hex_stiffness: Rows = scratch("hex shape", hexahedral.STORED_ROWS, unit="N/m", doc="K of a shape by rows")
    hex_rotation: Rows = scratch(
        "hex", 9, doc="rotation Q from the axes of the shape, times the root of the guard's factor"
    )
    hex_strain: Rows = scratch("hex", 24, unit="m", doc="displacements of corners in these axes, from the first")
    segment_force: Rows = scratch("segment", 12, unit="N", doc="force and moment [N m] of a rod segment on its ends")
    segment_damping: Rows = scratch("segment", 12, unit="N", doc="the same from beta K v")
    segment_stiffness: Rows = scratch("segment", 90, unit="N/m", doc="blocks as of a tet")

    segment_law: Rows = scratch("varying segment", LAW_ROWS, doc="length [m], C [N], D [N m^2], rest strain")

    # Exact tangent
    tet_turning: Rows = scratch("exact tet", turning.TURNING_ROWS, doc="how the rotations of tets follow positions")
    gauss_turning: Rows = scratch("exact Gauss point", turning.TURNING_ROWS, doc="the same of Gauss points")
    gauss_node_turning: Rows = scratch("exact Gauss point", quadratic.TURNING_ROWS, doc="and of their elements' nodes")
    cable_segment: Rows = scratch("coupled point", 6, unit="N/m", doc="stiffness of the segment that ends at a point")

    # Frames
    compound: Rows = scratch(
        "frame", COMPOUND_ROWS, doc="mass, first moment and inertia of a master and what it carries"
    )
    owner_density: Rows = scratch("owner", unit="kg/m^3", doc="of rigid bodies (their mass [kg]), then rods")
    frame_internal: Rows = scratch("frame", 6, unit="N", doc="elastic force and moment [N m]")
    frame_external: Rows = scratch("frame", 6, unit="N", doc="loads and weight")
    frame_momentum: Rows = scratch("frame", 6, unit="N s", doc="momentum and angular momentum [N m s] in b")
    held_pose: Rows = scratch("rigid", 7, unit="m", doc="pose that a kinematic body is held at")
    seen_pose: Rows = scratch("rigid", 7, unit="m", doc="pose command of this step")
    lag: Rows = scratch("world", doc="part of commanded ways left to later stages of the step", keeps=0.0)
    commanded: Rows = scratch("world", unit="m", doc="how far commands carry kinematic bodies in a step", keeps=0.0)

    # Telescopes
    tube_length: Rows = scratch("tube", unit="m", doc="deployed")
    tube_angle: Rows = scratch("tube", unit="rad", doc="at the base")
    telescope_plan: Rows = scratch("telescope", PLAN_ROWS, doc="how nodes slide: kernels.frames.tube_section")
    slid_windup: Rows = scratch("windup", unit="rad", doc="angles of tubes where the nodes have slid to")
    balanced_windup: Rows = scratch("windup", unit="rad", doc="angles that balance the torsion of the tubes")
    windup: Rows = scratch("windup", unit="rad", doc="the same to the carrier, whom the nodes have followed")
    windup_system: Rows = scratch("telescope node", SYSTEM_ROWS, doc="their equations, factorised")
    base_angle: Rows = scratch("telescope", unit="rad", doc="angle of the frame at the port")
    telescope_load: Rows = scratch("telescope segment", 2, unit="N m", doc="bending by loads, smoothed")
    swing: Rows = scratch("world", unit="rad", doc="largest swing of a segment of a telescope in the step")
    segment_swing: Rows = scratch("telescope segment", doc="square of how far each of them swings, on a GPU")
    share_of_way: Rows = scratch("world", doc="part of its way in the step that a world goes")
    telescope_twist: Rows = scratch("telescope segment", unit="1/m", doc="twist of the frames")

    # Reduced bodies
    mode_q: Rows = scratch("mode", unit="m", doc="amplitudes")
    mode_v: Rows = scratch("mode", unit="m/s", doc="their velocities")
    mode_turn: Rows = scratch("floating", 4, doc="quaternion of a floating frame")
    frame_centre: Rows = scratch("floating", 3, unit="m", doc="centre of mass that it is at")
    frame_axes: Rows = scratch("floating", 9, doc="its matrix R, as forces and rows see it")
    touch_arm: Rows = scratch("floating touch", 3, unit="m", doc="from the centre of mass to touching nodes, likewise")
    start_moment: Rows = scratch("moment", 9, unit="m^4", doc="G of a mode at the start of the step")
    moment: Rows = scratch("moment", 9, unit="m^4", doc="G at its end")
    moment_rate: Rows = scratch("moment", 9, unit="m^4/s", doc="the same from velocities of modes")
    drag_row: Rows = scratch(
        "turning sample", 36, unit="N/m", doc="k_scale K of an element on turning: rows, and in it"
    )
    wide_drag: Rows = scratch("turning mode", 3, unit="N/m", doc="the same on modes, axis after axis")
    turning_drag: Rows = scratch("floating", 9, unit="N/m", doc="the same on turning itself")
    turned_gradient: Rows = scratch("turned point", 3, doc="point_gradient in the axes of the body that carries it")
    mode_force: Rows = scratch("mode", unit="N", doc="Phi' (f_ext - f_int)")
    wide_q: Rows = scratch("wide mode", unit="m", doc="amplitudes, each body's up to its stride")
    wide_v: Rows = scratch("wide mode", unit="m/s", doc="their velocities")
    wide_force: Rows = scratch("wide mode", unit="N", doc="forces on them")
    wide_row: Rows = scratch("wide row mode", doc="rows of H on them")
    mode_sum: Rows = scratch("mode pair", unit="N/m", doc="k_scale K in modes, lower triangle")
    mode_strip: Rows = scratch("mode strip", doc="K E and sums of a chunk, or on a GPU K E of all samples")
    mode_strip_thin: Rows = scratch("thin mode strip", doc="likewise of triangles, on a GPU")
    sample_stiffness: Rows = scratch("tet sample", samples.TET**2, unit="N/m", doc="k_scale K of tets that count")
    thin_stiffness: Rows = scratch("tri sample", samples.TRI**2, unit="N/m", doc="likewise of triangles")
    reduced_v: Rows = scratch("reduced", 3, unit="m/s", doc="velocities of nodes of reduced bodies, at their numbers")
    listed_force: Rows = scratch("listed", 3, unit="N", doc="f_ext - f_int at them, without weight")

    # Linear system
    a: Rows = scratch("block", 9, doc="stored blocks of A")
    b: Rows = scratch("dof", 3, doc="right-hand side")
    u: Rows = scratch("dof", 3, unit="m/s", doc="solution")
    prescribed_v: Rows = scratch("dof", 3, unit="m/s", doc="velocities of prescribed scalars", keeps=0.0)
    prescribed_change: Rows = scratch("dof", 3, unit="m/s", doc="what u has of them; 0 elsewhere", keeps=0.0)

    # Multiplier rows
    point_x: Rows = scratch("row point", 3, unit="m", doc="points of cables and chambers")
    point_gradient: Rows = scratch("row point", 3, doc="gradient of a row by its points")
    row: Rows = scratch("entry", 3, doc="entries of H")
    displacement: Rows = scratch("row", unit="m", doc="what a row measures")
    target: Rows = scratch("row", unit="m", doc="where its law wants it")
    lower_bound: Rows = scratch("row", unit="N", doc="of the multiplier")
    upper_bound: Rows = scratch("row", unit="N", doc="of the multiplier")
    floor: Rows = scratch("row", unit="m", doc="least gap, whatever the law says", keeps=-FAR)
    ceiling: Rows = scratch("row", unit="m", doc="largest gap", keeps=FAR)
    compliance: Rows = scratch("row", unit="m/N", doc="of the law")
    multiplier: Rows = scratch("row", unit="N", doc="force of the row")
    change: Rows = scratch("row", unit="N", doc="its change in a solve")
    gap: Rows = scratch("row", unit="m", doc="free gap, then gap")
    delassus: Rows = scratch("row pair", unit="m/N", doc="W of the static rows, where no contact is")
    residual: Rows = scratch("world", unit="m", doc="largest correction of a gap in the last sweep")

    # Chambers
    cavity_volume: Rows = scratch("cavity", unit="m^3", doc="enclosed volume")
    cavity_pressure: Rows = scratch("cavity", unit="Pa", doc="gauge pressure")
    cavity_goal: Rows = scratch("cavity", doc="pressure, volume or gas that is commanded, within limits and rates")
    cavity_target: Rows = scratch("cavity", unit="m^3", doc="volume of the law")
    cavity_lower: Rows = scratch("cavity", unit="Pa", doc="bound of the pressure")
    cavity_upper: Rows = scratch("cavity", unit="Pa", doc="bound of the pressure")
    cavity_compliance: Rows = scratch("cavity", unit="m^3/Pa", doc="of the law")
    cavity_edge: Rows = scratch("cavity edge", 3, unit="N/m", doc="tangent of pressure along an edge")
    pressure_share: Rows = scratch("world", doc="of the tangent that A gets: 1, and less where a solve with it failed")

    # Joints
    joint_travel: Rows = scratch("joint", unit="m", doc="way in the step, angle [rad] of a hinge")
    joint_position: Rows = scratch("joint", unit="m", doc="coordinate [rad]")
    joint_velocity: Rows = scratch("joint", unit="m/s", doc="its mean velocity [rad/s]")
    joint_force: Rows = scratch("joint", unit="N", doc="of the motor [N m]")
    joint_reference: Rows = scratch("joint", unit="m", doc="position [rad] that a servo steers to")
    joint_reaction: Rows = scratch("joint", 6, unit="N", doc="force and moment [N m] at the anchor on the child")
    joint_multiplier: Rows = scratch("joint row", unit="N", doc="multipliers of the rows")
    joint_speed: Rows = scratch("joint row", unit="m/s", doc="of a gap, at the velocities of the start")
    joint_other_speed: Rows = scratch("joint row", unit="m/s", doc="of a gap, at those of the last pass")
    joint_gap: Rows = scratch("joint row", unit="m", doc="at the end of the step")
    joint_correction: Rows = scratch("eliminated row", unit="N", doc="multipliers that only close gaps")
    joint_share: Rows = scratch("world", doc="of them that is kept from momentum")
    joint_twist: Rows = scratch("joint frame", 6, unit="m/s", doc="twists of all frames")
    joint_pose: Rows = scratch("joint frame", 7, unit="m", doc="poses that they lead to")
    gyration: Rows = scratch("gyrating", 6, unit="m/s", doc="what free turning adds to a body's velocities")

    # Contact
    contact_end: Rows = scratch("contact", unit="m", doc="distance less contact distance where the step leads to")

    # Control
    norm: Rows = scratch("world", 2, doc="of the imbalance, of the forces in it")
    norm_part: Rows = scratch("world", 2 * norms.PARTS, doc="squares of parts of them, on a GPU")
    control: Rows = scratch("control", doc="Newton's control: kernels.step.newton and statics")
    compression: Rows = scratch("world", doc="largest 1 - J of an element", keeps=0.0)
    inverted: Rows = scratch("world", doc="elements with J <= 0", keeps=0.0, integer=True)
    flag: Rows = scratch("world", 2, doc="why a world has failed", integer=True)


def declared() -> dict[str, Scratch]:
    """Declarations of all workspace arrays, in order."""
    return {entry.name: entry.metadata["scratch"] for entry in fields(Workspace)}


def allocate(model: Model, variant: Variant, world_count: int, exact: bool) -> Workspace:
    """Zeroed arrays for some worlds of a model; ``exact`` gives room for the exact tangent of statics."""
    items = counts(model, exact)
    arrays = {}
    for name, about in declared().items():
        count = max(items[about.item] * about.width, 1)
        dtype = wp.int32 if about.integer else None
        arrays[name] = rows.allocate(variant, world_count, count, model.device, dtype)
        if about.keeps:
            arrays[name].fill(about.keeps)
    return Workspace(**arrays)


def _mode_counts(model: Model) -> dict[str, int]:
    """The same of reduced bodies."""
    r, on_gpu = model.reduction, model.device != "cpu"
    if r is None:
        items = ("mode", "wide mode", "wide row mode", "mode pair", "mode strip", "thin mode strip")
        turning = ("floating", "floating touch", "moment", "turned point", "turning sample", "turning mode")
        return dict.fromkeys((*items, *turning, "tet sample", "tri sample", "listed", "reduced"), 0)
    f, strip, thin = r.floating, int(r.tet_basis.size), int(r.tri_basis.size)
    if tensor_sums.serves(model.device, model.precision, r.widest):
        strip = thin = 0
    return {
        "floating": model.floating_count,
        "floating touch": 0 if f is None else int(f.touch_body.size),
        "moment": 0 if f is None else int(f.moment_body.size),
        "turning sample": 0 if f is None else int(r.tet_samples[-1] + r.tri_samples[-1]),
        "turning mode": 0 if f is None else r.wide_count,
        "turned point": 0 if f is None else len(model.point_node),
        "mode": r.count,
        "wide mode": r.wide_count,
        "wide row mode": int(r.wide_row.size),
        "mode pair": r.pair_room,
        "mode strip": strip if on_gpu else 32 * (CHUNK_ROWS + 3) + r.chunk_room + r.widest**2,
        "thin mode strip": thin if on_gpu else 0,
        "tet sample": int(r.tet_samples[-1]),
        "tri sample": int(r.tri_samples[-1]),
        "listed": int(r.node.size),
        "reduced": model.node_count,
    }


def counts(model: Model, exact: bool) -> dict[str, int]:
    """How many there are of every item that workspace arrays count."""
    frames, cavities, joints, second = model.frames, model.cavities, model.joints, model.quadratic
    triangles = 0 if model.membranes is None else len(model.membranes.triangles)
    points = quadratic.POINTS * model.quadratic_count
    laws = {
        "tet": (model.law_tets, model.tet_count),
        "Gauss point": ({} if second is None else second.law_points, points),
    }
    result = {"control": statics.ROWS if exact else newton.ROWS, "world": 1}
    for item, (held, count) in laws.items():
        is_turned = [law in TURNED for law in held]
        result[f"turned {item}"] = count + 1 if any(is_turned) else 0  # SIMD registers read past the last one
        result[f"stored {item}"] = 0 if all(is_turned) else count
        result[f"exact {item}"] = result[f"turned {item}"] if exact else 0
    result |= _mode_counts(model)
    return result | {
        "node": model.node_count,
        "body": model.body_count + model.rod_count + model.rigid_count,
        "dof": model.dof_room,
        "block": len(model.symbolic.a_row),
        "element force": 12 * (model.tet_count + triangles)
        + 3 * quadratic.NODES * model.quadratic_count
        + 3 * hexahedral.CORNERS * model.hex_count,
        "hex": model.hex_count,
        "hex shape": 0 if model.hexes is None else int(model.hexes.shape_body.size),
        "membrane tri": triangles,
        "Gauss point": points,
        "carried Gauss point": 0 if frames is None else points,
        "segment": model.segment_count,
        "frame": model.frame_count,
        "rigid": model.rigid_count,
        "owner": model.rigid_count + model.rod_count + model.items("telescope node"),
        "varying segment": model.items("varying segment"),
        "tube": model.items("tube"),
        "windup": model.items("windup"),
        "telescope node": model.items("telescope node"),
        "telescope": model.items("telescope"),
        "telescope segment": model.items("telescope segment"),
        "slot": 0 if frames is None else int(frames.slot_dof.size),
        "carried": 0 if frames is None else frames.carried_count,
        "grip": 0 if frames is None else frames.grip_count,
        "row point": len(model.point_node),
        "coupled point": model.point_count if model.coupling_point.size else 0,
        "entry": int(model.entry_dof.size),
        "row": model.row_count,
        "row pair": model.row_count**2,
        "cavity": model.cavity_count,
        "cavity edge": 0 if cavities is None else len(cavities.edge_cavity),
        "joint": model.joint_count,
        "joint row": 0 if joints is None else joints.rows,
        "joint frame": 0 if joints is None else model.frame_count,
        "eliminated row": 0 if joints is None else int(joints.unbounded.size),
        "gyrating": 0 if joints is None else int(joints.gyrating_frame.size),
        "contact": model.contact_capacity,
    }
