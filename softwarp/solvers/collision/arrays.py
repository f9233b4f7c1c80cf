"""A collision scene on a device: the struct that kernels read, its trees, and the work cut into pieces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.collision import geometry
from softwarp.model.codes import Carrier, CoupleColumn, Target
from softwarp.model.contact import CollisionScene
from softwarp.shapes.base import Kind
from softwarp.solvers.collision.trees import Trees

CHUNK_CPU, CHUNK_GPU = 64, 4  # keys that one thread searches
FEW_KEYS, CHUNK_FEW = 256, 2  # on a GPU, and of scenes with few keys, where a thread then has but one feature


@dataclass(frozen=True)
class SceneArrays:
    """Device arrays of a scene, shared by all worlds.

    Attributes:
        scene: Struct that kernels read.
        object_frame, object_point, object_centre, object_extent: Objects.
        object_round: Whether it is a ball about its frame's origin.
        moving_nodes: Tree nodes that are refitted in every step.
        corner_start, corner_row, corner_radius: Corners of the leaves among them, ``_corners``.
        task_start, task_node: Tree nodes by thread.
        tasks: Threads of the first launch of a refit, and of the second.
        chunk_key, chunk_couple: First key and couple of every chunk.
        shape_chunks, surface_chunks: Chunks against shapes, and against surfaces and rods.
        node_chunks: Those against shapes whose features move with nodes.
        box_chunks, other_chunks: Those among them against boxes, and all others against shapes.
        object_start, object_couple: One couple with every other object that an object can touch.
        tracked: Objects of couples whose features remember how far they were.
        tracked_chunks: Chunks of those couples.
    """

    scene: Any
    object_frame: wp.array
    object_point: wp.array
    object_centre: wp.array
    object_extent: wp.array
    moving_nodes: int
    corner_start: wp.array
    corner_row: wp.array
    corner_radius: wp.array
    task_start: wp.array
    task_node: wp.array
    tasks: tuple[int, int]
    chunk_key: wp.array
    chunk_couple: wp.array
    shape_chunks: wp.array
    surface_chunks: wp.array
    node_chunks: wp.array
    box_chunks: wp.array
    other_chunks: wp.array
    object_start: wp.array
    object_couple: wp.array
    object_round: wp.array
    tracked: wp.array
    tracked_chunks: wp.array


class _Packer:
    """Copies host values to a device in the types of a variant."""

    def __init__(self, variant: Variant, device: Any) -> None:
        self.variant, self.device = variant, device
        self.types = geometry.structures(variant.real)
        self.real = np.float64 if variant.real is wp.float64 else np.float32

    def __call__(self, values: Any, dtype: Any) -> wp.array:
        plain = np.int32 if dtype is wp.int32 else self.real
        return wp.array(np.ascontiguousarray(values, dtype=plain), dtype=dtype, device=self.device)

    def integers(self, values: Any) -> wp.array:
        """A list of integers, possibly empty."""
        return wp.array(np.asarray(values, dtype=np.int32).reshape(-1), dtype=wp.int32, device=self.device)


def pack(scene: CollisionScene, variant: Variant, device: Any, *, patient: bool = False) -> SceneArrays:
    """Put a scene on a device; couples of soft bodies may be patient."""
    put = _Packer(variant, device)
    t = put.types
    packed = t.Scene()
    for prefix, table, columns in (
        ("point", scene.points, {"kind": 0, "index": 0, "quarter": 0, "radius": 1, "local": 3, "inset": 3}),
        ("point", scene.points, {"axis": 3, "rest": 3}),
        ("edge", scene.edges, {"point": -2, "face": -2, "radius": 1, "inset": 3}),
        ("face", scene.faces, {"corner": -3, "beside": -3, "edge": -3, "radius": 1}),
        ("target", scene.targets, {"kind": 0, "frame": 0, "x": 3, "q": 4, "size": 3, "depth": 1, "grid": -4}),
    ):
        for name, form in columns.items():  # 0 integers, 1 reals, 3 and 4 vectors, -n rows of n integers
            dtype = {0: wp.int32, 1: variant.real, 3: t.vec3, 4: t.vec4}.get(form, wp.int32)
            shape = () if form in (0, 1) else (abs(form),)
            values = table.array(name, np.int32 if dtype is wp.int32 else np.float64, shape)
            setattr(packed, f"{prefix}_{name}", put(values, dtype))
    packed.grid_origin = put(scene.targets.array("origin", np.float64, (3,)), t.vec3)
    packed.grid_spacing = put(scene.targets.array("spacing", np.float64), variant.real)
    packed.grid_value = put(np.concatenate([*scene.grid_values, np.zeros(1)]), variant.real)
    start, fan = scene.fans()
    packed.fan_start, packed.fan = put(start, wp.int32), put(fan, wp.int32)
    packed.couple = put(scene.couple_table(patient=patient), wp.int32)
    packed.couple_clear = put([scene.entities[c.b].clear for c in scene.couples] or [0.0], variant.real)
    moving, corners, tasks = _trees(scene, packed, put)
    e, chunks = scene.entities, _chunks(scene, put)
    tracked = np.flatnonzero(scene.couple_table()[:, CoupleColumn.TRACKED])
    return SceneArrays(
        packed,
        put([o.frame for o in e] or [-1], wp.int32),
        put([o.points for o in e] or [(0, 0)], wp.int32),
        put([o.centre for o in e] or [np.zeros(3)], t.vec3),
        put([o.extent for o in e] or [np.zeros(3)], t.vec3),
        moving,
        *corners,
        put(np.cumsum([0, *(len(task) for group in tasks for task in group)]), wp.int32),
        put([node for group in tasks for task in group for node in task] or [0], wp.int32),
        (len(tasks[0]), len(tasks[1])),
        *chunks,
        *_partners(scene, put),
        put([o.kind == Kind.SPHERE and not np.any(o.centre) for o in e] or [False], wp.int32),
        put.integers(sorted({number for k in tracked for number in (scene.couples[k].a, scene.couples[k].b)})),
        put.integers(np.flatnonzero(np.isin(chunks[1].numpy(), tracked))),
    )


def _trees(
    scene: CollisionScene, packed: Any, put: _Packer
) -> tuple[int, tuple[wp.array, wp.array, wp.array], tuple[list[list[int]], list[list[int]]]]:
    """Trees over the faces of those targets that couples search; those that move come first."""
    trees = Trees.empty()
    against = [scene.entities[couple.b] for couple in scene.couples]
    searched = sorted({target for b in against for target in range(b.target, b.target + b.choices)})
    kinds = scene.targets.array("kind", np.int32)
    ranges: NDArray[Any] = scene.targets.array("faces", np.int64, (2,))
    corner = scene.faces.array("corner", np.int64, (3,))
    radius = scene.faces.array("radius", np.float64)
    root_of = np.zeros((max(len(scene.targets), 1), 2), dtype=np.int32)

    def build(chosen: list[int], column: str) -> list[tuple[int, int]]:
        place = scene.points.array(column, np.float64, (3,))
        built = []
        for target in chosen:
            faces = np.arange(*ranges[target])
            corners = corner[faces]
            x = place[np.where(corners < 0, corners[:, :1], corners)]
            grown = radius[faces, None]
            built.append(trees.add(faces, x.min(axis=1) - grown, x.max(axis=1) + grown))
            root_of[target] = built[-1]
        return built

    moving = build([target for target in searched if kinds[target] in (Target.SOFT, Target.CHAIN)], "rest")
    moving_nodes = len(trees.skip)
    corners = _corners(trees, scene, put)
    build([target for target in searched if kinds[target] == Target.MESH], "local")
    packed.target_tree = put(root_of, wp.int32)
    packed.tree_skip, packed.tree_face = put(trees.skip or [0], wp.int32), put(trees.face or [0], wp.int32)
    packed.tree_first, packed.tree_last = put(trees.first or [-1], wp.int32), put(trees.last or [-1], wp.int32)
    packed.tree_box = put(np.array(trees.box) if trees.box else np.zeros((1, 6)), put.variant.real)
    packed.moving_nodes = moving_nodes
    return moving_nodes, corners, trees.refit_tasks(moving)


def _corners(trees: Trees, scene: CollisionScene, put: _Packer) -> tuple[wp.array, wp.array, wp.array]:
    """Corners of the faces of every leaf, each once: first one of every tree node, rows and radii.

    A row is that of a node's x, or -1 minus that of a frame's; the radius is the largest of the leaf's faces there.
    Inner nodes have none.
    """
    corner = scene.faces.array("corner", np.int64, (3,))
    radius = scene.faces.array("radius", np.float64)
    kind, index = scene.points.array("kind", np.int32), scene.points.array("index", np.int64)
    row = np.where(kind == Carrier.NODE, 3 * index, -1 - 7 * index)
    start, rows, radii = [0], list[int](), list[float]()
    for first, last in zip(trees.first, trees.last, strict=True):
        reach: dict[int, float] = {}
        for face in trees.face[first:last] if first >= 0 else []:
            for point in corner[face][corner[face] >= 0]:
                reach[int(row[point])] = max(reach.get(int(row[point]), 0.0), float(radius[face]))
        rows += list(reach)
        radii += list(reach.values())
        start.append(len(rows))
    return put(start, wp.int32), put(rows or [0], wp.int32), put(radii or [0.0], put.variant.real)


def _partners(scene: CollisionScene, put: _Packer) -> tuple[wp.array, wp.array]:
    """For every object its first couple with each of the others."""
    found: list[dict[int, int]] = [{} for _ in scene.entities]
    for number, couple in enumerate(scene.couples):
        if couple.a != couple.b:
            found[couple.a].setdefault(couple.b, number)
            found[couple.b].setdefault(couple.a, number)
    start = np.cumsum([0, *(len(partners) for partners in found)])
    couples = [number for partners in found for number in partners.values()]
    return put(start, wp.int32), put(couples or [0], wp.int32)


def _chunks(
    scene: CollisionScene, put: _Packer
) -> tuple[wp.array, wp.array, wp.array, wp.array, wp.array, wp.array, wp.array]:
    """Cut the keys of every couple into pieces for one thread each; keys of one feature stay together."""
    size = CHUNK_CPU
    if put.variant.world_fastest:
        size = CHUNK_FEW if scene.key_count <= FEW_KEYS else CHUNK_GPU
    key: list[int] = []
    owner: list[int] = []
    kinds: tuple[list[int], list[int]] = ([], [])
    on_nodes: list[int] = []
    on_boxes: list[int] = []
    is_node = scene.points.array("kind", np.int32) == Carrier.NODE
    end = 0
    for number, (couple, count) in enumerate(scene.key_ranges()):
        kind = scene.entities[couple.b].kind
        is_surface = kind == Target.MESH or kind >= Target.SOFT
        moves = not is_surface and bool(is_node[slice(*scene.entities[couple.a].points)].all())
        for begin in range(0, count, max(size // couple.width, 1) * couple.width):
            kinds[int(is_surface)].append(len(key))
            on_nodes += [len(key)] if moves else []
            on_boxes += [len(key)] if moves and kind == Target.BOX else []
            key.append(end + begin)
            owner.append(number)
        end += count
    return (
        put([*key, end], wp.int32),
        put.integers(owner),
        put.integers(kinds[0]),
        put.integers(kinds[1]),
        put.integers(on_nodes),
        put.integers(on_boxes),
        put.integers(np.setdiff1d(kinds[0], on_boxes)),
    )
