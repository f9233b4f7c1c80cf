"""Contact of a scene: objects that can touch, the pairs between them, and how nodes and frames hang together."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks
from softwarp.model.codes import SLOTS, USUAL_SLOTS, CoupleColumn, Target
from softwarp.model.handles import Handle, SoftBody

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]
MOST_CONTACTS = 1_000_000  # of a world


def check_capacity(capacity: int) -> int:
    """A number of contacts that a world can hold; ValueError or TypeError for what is none."""
    advice = "it counts the contacts of a world"
    return checks.count(capacity, "contact_capacity", high=MOST_CONTACTS, advice=advice)


@dataclass
class Entity:
    """One object that can touch: ranges of its features, its targets, and its box.

    Attributes:
        name: What messages call it.
        frame: Frame, ``WORLD``, or ``SUM_OF_POINTS`` for soft bodies and rods.
        points, edges: First feature and the one after the last.
        target: Its target, -1 for none.
        kind: Kind of its target.
        convex: Whether the target is convex.
        centre, extent: Box in the frame [m].
        radius: Half of its smallest side [m]; the depth of an overlap is judged by it.
        clear: Distance at rest up to which its parts are neighbours, and no self-contact [m].
        choice: Which choice of a world says what its target is; -1 for none.
        choices: Targets to choose from, the first of which is ``target``; the others follow it.
        sheet: Triangle of a rigid mesh that lies on another one which faces the other way; -1 for none.
    """

    name: str
    frame: int
    points: tuple[int, int]
    edges: tuple[int, int]
    target: int
    kind: int
    convex: bool
    centre: FloatArray
    extent: FloatArray
    radius: float
    clear: float = 0.0
    choice: int = -1
    choices: int = 1
    sheet: int = -1


@dataclass(frozen=True)
class Couple:
    """Features of one object against the target of another.

    Attributes:
        a, b: Objects.
        pair: Contact pair.
        edges: Whether edges are meant, else points.
        mask: Parts of the target that count.
        width: Contacts that one feature can have.
        own: Whether a and b are the same object.
    """

    a: int
    b: int
    pair: int
    edges: bool
    mask: int
    width: int = 1
    own: bool = False


@dataclass
class Table:
    """Columns that grow row by row."""

    rows: dict[str, list[Any]] = field(default_factory=dict)

    def add(self, **values: Any) -> None:
        """Append one row."""
        for name, value in values.items():
            self.rows.setdefault(name, []).append(value)

    def __len__(self) -> int:
        return len(next(iter(self.rows.values()))) if self.rows else 0

    def array(self, name: str, dtype: Any, shape: tuple[int, ...] = ()) -> NDArray[Any]:
        """A column, at least one row long, as a device array may not be empty."""
        values = np.asarray(self.rows.get(name, []), dtype=dtype).reshape(-1, *shape)
        return values if len(values) else np.zeros((1, *shape), dtype=dtype)


@dataclass
class CollisionScene:
    """Objects that can touch and the pairs between them; ``plan.collision_scene`` fills it, a detector uploads it.

    Attributes:
        entities: Objects.
        couples: Features of one object against the target of another, enough for all pairs.
        pair_count: Contact pairs; a pair's number is the row of its parameters.
        choice_count: Objects of which a world has one of several.
        points, edges, faces, targets: Features, and what they are tested against.
        grid_values: Distances at the nodes of every grid [m], (node,).
    """

    entities: list[Entity] = field(default_factory=list)
    couples: list[Couple] = field(default_factory=list)
    pair_count: int = 0
    choice_count: int = 0
    points: Table = field(default_factory=Table)
    edges: Table = field(default_factory=Table)
    faces: Table = field(default_factory=Table)
    targets: Table = field(default_factory=Table)
    grid_values: list[NDArray[Any]] = field(default_factory=list)

    @property
    def key_count(self) -> int:
        """Contacts that could exist at the same time."""
        return sum(self.keys(couple) for couple in self.couples)

    def keys(self, couple: Couple) -> int:
        """Contacts that a couple could have at the same time."""
        first, last = self.features(couple)
        return couple.width * (last - first)

    def features(self, couple: Couple) -> tuple[int, int]:
        """First feature of a couple, and the one after its last."""
        entity = self.entities[couple.a]
        return entity.edges if couple.edges else entity.points

    def key_ranges(self) -> list[tuple[Couple, int]]:
        """Every couple with the number of its keys; keys count on from couple to couple."""
        return [(couple, self.keys(couple)) for couple in self.couples]

    def fans(self) -> tuple[IntArray, IntArray]:
        """Faces around every point: starts, shape (point + 1,), and faces in ascending order."""
        corner = self.faces.array("corner", np.int32, (3,))[: len(self.faces)].reshape(-1)
        used = np.flatnonzero(corner >= 0)
        count = np.bincount(corner[used], minlength=len(self.points))
        start = np.concatenate([[0], np.cumsum(count)])
        fan = used[np.argsort(corner[used], kind="stable")] // 3
        return start.astype(np.int32), (fan if fan.size else np.zeros(1)).astype(np.int32)

    def couple_table(self, *, patient: bool = False) -> IntArray:
        """Couples in the columns that kernels read, shape (couple, len(CoupleColumn)); soft ones may be patient."""
        table = np.zeros((max(len(self.couples), 1), len(CoupleColumn)), dtype=np.int32)
        key = 0
        for row, couple in zip(table, self.couples, strict=False):
            b = self.entities[couple.b]
            target, choice = b.target, (b.choice, b.choices)
            first, _ = self.features(couple)
            values = (couple.a, couple.b, target, couple.pair, couple.edges, couple.mask, couple.width, first, key)
            is_soft = {self.entities[couple.a].kind, b.kind} & {Target.SOFT, Target.POINTS}
            is_tracked = self.entities[couple.a].kind == b.kind == Target.SOFT and not couple.own
            row[:] = (*values, couple.own, *choice, patient and bool(is_soft), is_tracked)
            key += self.keys(couple)
        return table


@dataclass(frozen=True)
class Topology:
    """How nodes and frames hang together, as host arrays.

    Attributes:
        node_dof: Dof of a node, -1 if it is fixed or a frame carries it, shape (node,).
        node_frame: Frame that carries it, else -1, shape (node,).
        frame_dof: Dofs of translation and rotation of a frame's master, -1 for none, shape (2 frame,).
        frame_master: Frame that a frame moves with, itself unless it is welded, shape (frame,).
        frame_blend: Item of a frame that lies within a rod segment, else -1, shape (frame,); empty for none.
        blend_ends: Frames at the ends of its segment, shape (item, 2).
        blend_place: Place along the segment, 0 to 1, and its length [m], shape (item, 2).
        frame_free: Whether forces can move a frame, shape (frame,); empty if they can move all.
        carrier: Nodes that carry an embedded point, shape (point, 4); such points are numbered after all nodes.
        carrier_weight: Their weights, shape (point, 4).
    """

    node_dof: ArrayLike
    node_frame: ArrayLike
    frame_dof: ArrayLike
    frame_master: ArrayLike
    frame_blend: ArrayLike = ()
    blend_ends: ArrayLike = ()
    blend_place: ArrayLike = ()
    frame_free: ArrayLike = ()
    carrier: ArrayLike = ()
    carrier_weight: ArrayLike = ()

    @property
    def has_embedded(self) -> bool:
        """Whether there are embedded points."""
        return np.asarray(self.carrier).size > 0

    def places(self, nodes: ArrayLike) -> FloatArray:
        """Positions of nodes [m], shape (node, 3), and after them those of embedded points."""
        x = np.asarray(nodes, dtype=np.float64).reshape(-1, 3)
        if not len(np.asarray(self.carrier)):
            return x
        embedded = np.einsum("pk,pkc->pc", np.asarray(self.carrier_weight), x[np.asarray(self.carrier)])
        return np.concatenate([x, embedded])


@dataclass
class ContactModel:
    """Host description of contact; every shard builds its detector from it.

    Attributes:
        names: Name of every pair.
        parts: Parts (a, b) of every pair.
        capacity: Contacts that a world can hold.
        scene: Objects and pairs, collected by ``plan.collision_scene``.
        topology: How nodes and frames hang together.
        couple_sign: 1 where the feature side of a couple is part a of its pair, else -1, shape (couple,).
    """

    names: tuple[str, ...]
    parts: tuple[tuple[Handle, Handle], ...]
    capacity: int
    scene: CollisionScene
    topology: Topology
    couple_sign: IntArray

    @property
    def slots(self) -> int:
        """Dofs that one contact can touch."""
        return SLOTS if len(np.asarray(self.topology.carrier)) else USUAL_SLOTS

    @property
    def count(self) -> int:
        """Pairs."""
        return len(self.names)

    def find(self, a: Handle | int, b: Handle | int) -> tuple[int, float]:
        """Pair of two parts, and 1 if they stand in this order, -1 in the other. A plain index means a soft body.

        Raises:
            ValueError: If no such pair was added, or a part is no index; the message lists the pairs that were.
        """
        for part in (a, b):
            if not isinstance(part, Handle):
                advice = f"pairs are {', '.join(self.names)}"
                checks.count(part, "part of a contact pair, a handle from the builder,", low=0, advice=advice)
        a, b = (part if isinstance(part, Handle) else SoftBody(part) for part in (a, b))
        for number, (first, second) in enumerate(self.parts):
            for sign, one, two in ((1.0, first, second), (-1.0, second, first)):
                if (one.kind, int(one)) == (a.kind, int(a)) and (two.kind, int(two)) == (b.kind, int(b)):
                    return number, sign
        raise ValueError(f"{a!r} and {b!r} are no contact pair; pairs are {', '.join(self.names)}; use add_contact")
