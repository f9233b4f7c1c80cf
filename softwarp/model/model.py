"""What a step reads and never writes: topology, rest geometry, embeddings and the structure of the linear system."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp.advice import nearest
from softwarp.model.cavities import CavityModel, MembraneModel
from softwarp.model.codes import ROW_ITEMS
from softwarp.model.contact import ContactModel, check_capacity
from softwarp.model.fields import shared
from softwarp.model.frames import FrameModel
from softwarp.model.hexes import HexModel
from softwarp.model.joints import JointModel
from softwarp.model.quadratic import QuadraticModel
from softwarp.model.reduction import ReductionModel
from softwarp.model.structure import Symbolic
from softwarp.model.telescopes import TelescopeModel
from softwarp.model.tractions import TractionModel
from softwarp.shapes import OneOf, Shape
from softwarp.unpicklable import Unpicklable

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]


@dataclass
class Model(Unpicklable, instead="send the ModelBuilder that made it, and call finalize there"):
    """Constants of a scene, shared by its worlds; made by ``ModelBuilder.finalize``.

    Host arrays are NumPy, device arrays Warp. Nodes are numbered body after body in the order of ``add_tets``; ``dof``
    counts free nodes in elimination order.
    """

    num_worlds: int
    device: str
    precision: str
    fingerprint: str  # of everything that a state's meaning depends on

    body_names: tuple[str, ...]
    rigid_names: tuple[str, ...]
    rod_names: tuple[str, ...]
    cavity_names: tuple[str, ...]
    cable_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    marker_names: tuple[str, ...]

    # Host
    rigid_shapes: tuple[Shape | None, ...]  # of every rigid body, for pictures and files
    node_rest: FloatArray  # (node, 3) rest positions [m]
    tet_corners: IntArray  # (tet, 4) linear elements
    body_node_start: IntArray  # (body + 1,)
    node_fixed: NDArray[np.bool_]  # (node,) held in all directions
    node_locked: NDArray[np.bool_]  # (node, 3) held along single axes
    law_parameters: tuple[tuple[str, ...], ...]  # (body,) names of parameters of the law's own, in order
    surface_tri: IntArray  # (tri, 3) outward boundary triangles, node indices
    tri_body: IntArray  # (tri,)
    cable_starts: IntArray  # (cable + 1,) ranges of the points of each cable
    cable_force_controlled: NDArray[np.bool_]  # (cable,)
    cable_elastic: NDArray[np.bool_]  # (cable,) whether it stretches
    cable_rest: FloatArray  # (cable,) rest length [m]
    defaults: dict[str, FloatArray]  # initial value of every per-world parameter, without the world axis
    symbolic: Symbolic
    extent: float  # diagonal of the bounding box of all nodes and frames [m]
    node_size: float  # median edge of the soft body with the shortest ones [m]; model.resolution
    frames: FrameModel | None  # rigid bodies and rods
    cavities: CavityModel | None
    membranes: MembraneModel | None
    tractions: TractionModel | None
    joints: JointModel | None
    contact: ContactModel | None
    quadratic: QuadraticModel | None
    hexes: HexModel | None
    reduction: ReductionModel | None
    telescopes: TelescopeModel | None

    # Device
    law_tets: dict[str, wp.array] = shared("tet", doc="element kernel -> indices of its tets")
    tet_node: wp.array = shared("tet", doc="corner nodes, (tet, 4)")
    tet_body: wp.array = shared("tet", doc="body of the tet")
    tet_gradient: wp.array = shared("tet", unit="1/m", doc="rest gradients of shape functions 1 to 3, (tet, 9)")
    tet_volume: wp.array = shared("tet", unit="m^3", doc="rest volume, times the weight or factor of the tet")
    tet_size: wp.array = shared("tet", unit="m^3", doc="rest volume")
    tet_frame: wp.array = shared("tet", doc="rest frame of the edges by rows, for the large rotation, (tet, 9)")
    body_law_start: wp.array = shared("body", doc="first of the body's rows in law_parameter")
    body_guard: wp.array = shared("body", doc="volume ratio below which its elements are held upright; -1e15: none")
    node_body: wp.array = shared("node", doc="body of the node")
    node_volume: wp.array = shared("node", unit="m^3", doc="share of the body's volume that gives the lumped mass")
    node_heft: wp.array = shared("node", unit="m^3", doc="the same where gravity pulls at nodes, 0 where at modes")
    node_load: wp.array = shared("node", unit="N", doc="dead load, (node, 3)")
    node_dof: wp.array = shared("node", doc="elimination position of a free node, -1 for a fixed one")
    dof_node: wp.array = shared("dof", doc="slot of an elimination position: a node, or one half of a frame")
    dof_free: wp.array = shared("dof", doc="1 for unknown, 0 for prescribed scalars, (dof, 3)")
    prescribed_dof: wp.array = shared("prescribed", doc="dofs with prescribed scalars")
    touched_dof: wp.array = shared("touched", doc="those and their neighbours in A")
    masked_block: wp.array = shared("masked", doc="blocks of A in their rows or columns")
    block_row: wp.array = shared("block", doc="row of every block of A")
    block_col: wp.array = shared("block", doc="column of every block of A")
    corner_start: wp.array = shared("node", doc="ranges in corner, (node + 1,)")
    corner: wp.array = shared("corner", doc="4 tet + corner of every tet around a node")
    large_entry_start: wp.array = shared("block", doc="ranges in large_entry, (block + 1,)")
    large_entry: wp.array = shared("entry", doc="16 tet + 4 a + b: element blocks in a block of A, large rotation")
    stored_entry_start: wp.array = shared("block", doc="ranges in stored_entry, (block + 1,)")
    stored_entry: wp.array = shared("entry", doc="the same for tets that store their stiffness")
    stored_block: wp.array = shared("tet", doc="where K_ab, a >= b, goes: 2 block, + 1 transposed, (tet, 10)")
    neighbour_start: wp.array = shared("dof", doc="ranges in neighbour, (dof + 1,)")
    neighbour: wp.array = shared("neighbour", doc="columns of a full row of A, the diagonal included")
    neighbour_block: wp.array = shared("neighbour", doc="stored block of A, or its bitwise not if transposed")
    coupling_start: wp.array = shared("block", doc="ranges in coupling_point, (block + 1,); empty unless coupled")
    coupling_point: wp.array = shared(
        "coupling", doc="second point of a cable segment whose stiffness a block receives"
    )
    coupling_weight: wp.array = shared("coupling", doc="product of the two nodes' shares in the segment's vector")
    row_size: wp.array = shared("row", unit="m", doc="length that the gap of a multiplier row is measured by")
    cable_point_start_device: wp.array = shared("cable", doc="ranges of points, (cable + 1,)")
    cable_rest_length: wp.array = shared("cable", unit="m", doc="length at rest")
    cable_closing_length: wp.array = shared("cable", unit="m", doc="of a segment: below, it pulls in proportion to it")
    cable_force_control: wp.array = shared("cable", doc="1 if the tension is imposed, 0 if the displacement is")
    point_cable: wp.array = shared("point", doc="cable of a point")
    point_node: wp.array = shared("point", doc="nodes that carry a cable point, -1 for none, (point, 4)")
    point_weight: wp.array = shared("point", doc="their weights, (point, 4)")
    point_anchor: wp.array = shared("point", unit="m", doc="position of a point fixed in space, else 0, (point, 3)")
    marker_node: wp.array = shared("marker", doc="nodes that carry a marker, (marker, 4)")
    marker_weight: wp.array = shared("marker", doc="their weights, (marker, 4)")
    marker_frame: wp.array = shared("marker", doc="frame that carries a marker instead of nodes, -1 for none")
    marker_local: wp.array = shared("marker", unit="m", doc="its place in that frame, (marker, 3)")
    marker_anchor: wp.array = shared("marker", unit="m", doc="zeros, (marker, 3)")
    entry_dof: wp.array = shared("row entry", doc="free node of an entry of H")
    entry_row: wp.array = shared("row entry", doc="row (cable) of an entry of H")
    entry_start: wp.array = shared("row entry", doc="ranges in entry_point, (entry + 1,)")
    entry_point: wp.array = shared("contribution", doc="cable point")
    entry_weight: wp.array = shared("contribution", doc="weight of the node at that point")
    entry_item: wp.array = shared("contribution", doc="carried item whose lever turns the force into a moment, or -1")
    row_entry_start: wp.array = shared("row", doc="ranges of entries per row, (row + 1,)")
    dof_entry_start: wp.array = shared("dof", doc="ranges in dof_entry, (dof + 1,)")
    dof_entry: wp.array = shared("row entry", doc="entries of H that touch a free node")
    delassus_pair: wp.array = shared("pair", doc="row pairs i <= j, (pair, 2)")

    @property
    def node_count(self) -> int:
        """Nodes of all soft bodies, then guides: waypoints of cables on rods and rigid bodies."""
        return len(self.node_rest)

    @property
    def own_node_count(self) -> int:
        """``node_count``, or 0 where every node belongs to a reduced body, which moves all of its own."""
        reduced = 0 if self.reduction is None else int(self.reduction.node.size)
        return 0 if reduced == self.node_count else self.node_count

    @property
    def body_node_count(self) -> int:
        """Nodes of all soft bodies; guides of cables on rods and rigid bodies follow them."""
        return int(self.body_node_start[-1])

    @property
    def relaxes(self) -> bool:
        """Whether a soft body has a Maxwell branch."""
        return bool(self.defaults["relaxation_ratio"].any())

    @property
    def tet_count(self) -> int:
        """Linear tets of all bodies."""
        return len(self.tet_corners)

    @property
    def quadratic_count(self) -> int:
        """Quadratic tets of all bodies."""
        return 0 if self.quadratic is None else self.quadratic.count

    @property
    def hex_count(self) -> int:
        """Hexahedra of all bodies."""
        return 0 if self.hexes is None else self.hexes.count

    @property
    def body_count(self) -> int:
        """Soft bodies."""
        return len(self.body_names)

    @property
    def rigid_count(self) -> int:
        """Rigid bodies."""
        return len(self.rigid_names)

    @property
    def rod_count(self) -> int:
        """Rods."""
        return len(self.rod_names)

    @property
    def floating_count(self) -> int:
        """Reduced bodies with a floating frame."""
        r = self.reduction
        return 0 if r is None or r.floating is None else r.floating.count

    @property
    def turn_rest(self) -> NDArray[np.float64]:
        """Quaternions x y z w of floating frames at rest, (floating, 4)."""
        return np.tile([0.0, 0.0, 0.0, 1.0], (self.floating_count, 1))

    @property
    def mode_count(self) -> int:
        """Modes of reduced bodies, with those that fill their last block of three."""
        return 0 if self.reduction is None else self.reduction.count

    @property
    def frame_count(self) -> int:
        """Rigid bodies, rod nodes and off-centre masses."""
        return 0 if self.frames is None else self.frames.count

    @property
    def has_kinematic(self) -> bool:
        """Whether there are kinematic bodies."""
        return self.frames is not None and bool(self.frames.is_kinematic.any())

    @property
    def has_moving_frames(self) -> bool:
        """Whether there are rods, or rigid bodies that move freely or carry something, markers too."""
        f = self.frames
        if f is None:
            return False
        carries = bool(f.carried_count) or bool((self.marker_frame.numpy() >= 0).any())
        return carries or self.rod_count > 0 or not bool(f.is_kinematic.all())

    @property
    def rod_node_count(self) -> int:
        """Nodes of all rods."""
        return 0 if self.frames is None else self.frames.rod_node_count

    @property
    def segment_count(self) -> int:
        """Segments of all rods."""
        return 0 if self.frames is None else len(self.frames.segment_frames)

    def rod_nodes(self, rod: int) -> slice:
        """Nodes of a rod in ``Simulation.rod_x``."""
        if self.frames is None or not 0 <= rod < self.rod_count:
            raise ValueError(f"rod {rod!r} does not exist; the scene has {self.rod_count} rods")
        return slice(int(self.frames.rod_start[rod]), int(self.frames.rod_start[rod + 1]))

    def tubes_of(self, telescope: int) -> slice:
        """Tubes of a telescope in ``Simulation.tube_length``, innermost first."""
        rods = [] if self.telescopes is None else self.telescopes.rod.tolist()
        if self.telescopes is None or telescope not in rods:
            raise ValueError(f"telescope {telescope!r} does not exist; the scene has {len(rods)} telescopes")
        start, number = self.telescopes.tube_start, rods.index(int(telescope))
        return slice(int(start[number]), int(start[number + 1]))

    @property
    def cable_count(self) -> int:
        """Cables."""
        return len(self.cable_names)

    @property
    def point_count(self) -> int:
        """Points of all cables."""
        return int(self.cable_starts[-1])

    @property
    def row_count(self) -> int:
        """Multiplier rows besides contacts: those of ``codes.ROW_ITEMS``."""
        return len(self.row_size)

    def first_row(self, item: str) -> int:
        """First multiplier row of an item of ``codes.ROW_ITEMS``; its rows lie side by side."""
        return sum(self.items(before) for before in ROW_ITEMS[: ROW_ITEMS.index(item)])

    @property
    def cavity_count(self) -> int:
        """Air chambers."""
        return len(self.cavity_names)

    @property
    def joint_count(self) -> int:
        """Joints."""
        return len(self.joint_names)

    @property
    def pair_count(self) -> int:
        """Contact pairs."""
        return 0 if self.contact is None else self.contact.count

    @property
    def contact_capacity(self) -> int:
        """Contacts that a world can hold."""
        return 0 if self.contact is None else self.contact.capacity

    def with_contact_capacity(self, capacity: int) -> Model:
        """The same scene with another number of contacts that a world can hold.

        Raises:
            ValueError: Without contact pairs, or for a number outside 1 .. ``MOST_CONTACTS``.
        """
        if self.contact is None:
            raise ValueError("the scene has no contact pairs; use ModelBuilder.add_contact")
        count = check_capacity(capacity)
        return self if count == self.contact.capacity else replace(self, contact=replace(self.contact, capacity=count))

    def as_chosen(self, choice: Sequence[float]) -> Model:
        """The scene as pictures show it in a world that has chosen among several meshes.

        Args:
            choice: Row of ``Parameters.body_choice``; empty for a scene without choices, which stays as it is.
        """
        chosen = list(choice)
        if not chosen:
            return self
        shapes: list[Shape | None] = []
        for shape in self.rigid_shapes:
            if isinstance(shape, OneOf):
                number = min(max(int(chosen.pop(0)), 0), len(shape.alternatives) - 1)
                shapes.append(shape.alternatives[number])
            else:
                shapes.append(shape)
        return replace(self, rigid_shapes=tuple(shapes))

    @property
    def membrane_count(self) -> int:
        """Membranes."""
        return 0 if self.membranes is None else self.membranes.count

    @property
    def marker_count(self) -> int:
        """Markers."""
        return len(self.marker_names)

    @property
    def dof_count(self) -> int:
        """Unknown 3-blocks: free nodes, then two per rigid body and rod node."""
        return int(self.symbolic.size)

    @property
    def dof_room(self) -> int:
        """Unknown 3-blocks, then places for the velocities of nodes of reduced bodies that may touch something."""
        return self.dof_count + (0 if self.reduction is None else int(self.reduction.touch_listed.size))

    @property
    def cable_point_start(self) -> IntArray:
        """Ranges of every cable's points in ``Simulation.cable_x``, shape (cable + 1,)."""
        return self.cable_starts

    def law_row(self, body: int, name: str) -> int:
        """Row of ``Parameters.law_parameter`` that holds a parameter of a soft body's law.

        Raises:
            ValueError: If there is no such body, or its law has no such parameter; the message lists the nearest.
        """
        if not 0 <= body < self.body_count:
            raise ValueError(f"soft body {body!r} does not exist; the scene has {self.body_count}")
        names = self.law_parameters[body]
        if name not in names:
            advice = nearest(name, names) if names else "it has youngs and nu, in sim.params"
            raise ValueError(
                f"the law of body {self.body_names[body]!r} has no parameter {name!r} of its own; {advice}"
            )
        return sum(map(len, self.law_parameters[:body])) + names.index(name)

    def start_commands(self) -> dict[str, FloatArray]:
        """Commands that are not zero at the start, by their names in ``Control``, without the world axis."""
        commands = {} if self.frames is None else {"body_pose": self.frames.rest_pose[: self.rigid_count]}
        if self.tractions is not None:
            commands["traction"] = self.tractions.start
        if self.telescopes is not None:
            commands |= {"tube_length": self.telescopes.start_length, "tube_angle": self.telescopes.start_angle}
        if self.cavities is not None:
            commands |= dict.fromkeys(("cavity_volume", "cavity_gas"), self.cavities.rest_volume)
        return commands

    def items(self, name: str) -> int:
        """Number of items of a declared kind, such as ``node`` or ``cable``."""
        return COUNTS[name](self)


def _of(part: str, count: str) -> Callable[[Model], int]:
    """Counts something of a part of the scene; 0 in scenes without that part."""

    def counted(model: Model) -> int:
        held = getattr(model, part)
        return 0 if held is None else int(getattr(held, count))

    return counted


COUNTS: dict[str, Callable[[Model], int]] = {  # items of each declared kind
    "node": lambda model: model.node_count,
    "body": lambda model: model.body_count,
    "law parameter": lambda model: sum(map(len, model.law_parameters)),
    "cable": lambda model: model.cable_count,
    "relaxing body": lambda model: model.body_count if model.relaxes else 0,
    "relaxing node": lambda model: model.node_count if model.relaxes else 0,
    "relaxing frame": lambda model: model.frame_count if model.relaxes else 0,
    "elastic cable": lambda model: model.cable_count if model.cable_elastic.any() else 0,
    "point": lambda model: model.point_count,
    "marker": lambda model: model.marker_count,
    "rigid": lambda model: model.rigid_count,
    "choice": lambda model: sum(isinstance(shape, OneOf) for shape in model.rigid_shapes),
    "rod": lambda model: model.rod_count,
    "cavity": lambda model: model.cavity_count,
    "membrane": lambda model: model.membrane_count,
    "traction": _of("tractions", "count"),
    "joint": lambda model: model.joint_count,
    "joint row": _of("joints", "rows"),
    "pair": lambda model: model.pair_count,
    "contact": lambda model: model.contact_capacity,
    "frame": lambda model: model.frame_count,
    "mode": lambda model: model.mode_count,
    "floating": lambda model: model.floating_count,
    "telescope": _of("telescopes", "count"),
    "tube": _of("telescopes", "tube_count"),
    "windup": _of("telescopes", "windup_count"),
    "telescope segment": _of("telescopes", "piece_count"),
    "telescope node": _of("telescopes", "node_count"),
    "varying segment": lambda model: 0 if model.telescopes is None else model.segment_count,
    "world": lambda model: 1,
}
