"""From ``add_contact`` to the collision scene: which object stands for which part. Host only."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp import meshing
from softwarp.model.contact import ContactModel, Topology, check_capacity
from softwarp.model.handles import Handle, RigidBody, Rod
from softwarp.plan.collision_scene import CollisionBuilder
from softwarp.plan.frames import FrameLayout
from softwarp.scene.parts import Scene
from softwarp.shapes import OneOf

RIGID_CONTACTS = 16  # per pair of rigid bodies, unless the user gives the capacity of a world
SOFT_CONTACTS = 48  # per pair with a soft body or a rod
ALARM = 0.01  # of the smaller part's size: how near a pair becomes a contact, besides what motion adds
PAIR_VALUES = ("mu", "restitution", "contact_distance", "alarm_distance", "compliance")


def contact_model(
    scene: Scene,
    nodes: NDArray[Any],
    node_start: NDArray[Any],
    node_dof: NDArray[Any],
    frames: FrameLayout | None,
    frame_dof: NDArray[Any],
    capacity: int | None,
) -> ContactModel | None:
    """Objects and pairs of a scene, or None without pairs.

    Raises:
        ValueError: If a pair cannot touch, or the capacity is below 1.
    """
    if capacity is not None:
        check_capacity(capacity)
    if not scene.pairs:
        return None
    touching = CollisionBuilder()
    topology = _topology(scene, node_start, node_dof, frames, frame_dof)
    places = topology.places(nodes)
    surfaces = [body.contact_surface for body in scene.bodies]
    first_point = np.cumsum([len(nodes), *(0 if s is None else len(s.points) for s in surfaces)])
    objects: dict[tuple[str, int], list[int]] = {}

    def of(part: Handle) -> list[int]:
        key = (part.kind, int(part))
        if key not in objects:
            if isinstance(part, RigidBody | Rod):
                objects[key] = _add(touching, scene, part, frames)
            else:
                objects[key] = [_add_soft(touching, scene, part, places, int(node_start[part]), int(first_point[part]))]
        return objects[key]

    signs: list[int] = []
    for spec in scene.pairs:
        a, b = of(spec.a), of(spec.b)
        touching.pair(a, b)
        signs += [1 if couple.a in a else -1 for couple in touching.couples[len(signs) :]]
    return ContactModel(
        names=tuple(spec.name for spec in scene.pairs),
        parts=tuple((spec.a, spec.b) for spec in scene.pairs),
        capacity=min(touching.key_count, expected_contacts(scene)) if capacity is None else int(capacity),
        scene=touching,
        topology=topology,
        couple_sign=np.array(signs, dtype=np.int32),
    )


def _topology(
    scene: Scene,
    node_start: NDArray[Any],
    node_dof: NDArray[Any],
    frames: FrameLayout | None,
    frame_dof: NDArray[Any],
) -> Topology:
    """How nodes, frames and embedded points hang together."""
    skins = [(start, b.contact_surface) for start, b in zip(node_start, scene.bodies, strict=False)]
    embedded = [(start + skin.node, skin.weight) for start, skin in skins if skin is not None]
    carrier = np.concatenate([node for node, _ in embedded]) if embedded else np.empty((0, 4), dtype=np.int32)
    weight = np.concatenate([share for _, share in embedded]) if embedded else np.empty((0, 4))
    tied = {"carrier": carrier, "carrier_weight": weight}
    if frames is None:
        none = np.empty(0, dtype=np.int32)
        return Topology(node_dof, np.full(len(node_dof), -1), frame_dof, frame_master=none, **tied)
    is_free = frames.free[frames.master].any(axis=1)
    if len(frames.blend_ends) == 0:
        return Topology(node_dof, frames.node_frame, frame_dof, frames.master, frame_free=is_free, **tied)
    blend = np.full(frames.count, -1, dtype=np.int32)
    blend[frames.first_blend :] = np.arange(len(frames.blend_ends))
    return Topology(
        node_dof,
        frames.node_frame,
        frame_dof,
        frames.master,
        frame_blend=blend,
        blend_ends=frames.blend_ends,
        blend_place=frames.blend_place,
        frame_free=is_free,
        **tied,
    )


def expected_contacts(scene: Scene) -> int:
    """Contacts that a world of this scene will hardly exceed."""
    rigid = [isinstance(spec.a, RigidBody) and isinstance(spec.b, RigidBody) for spec in scene.pairs]
    return sum(RIGID_CONTACTS if both else SOFT_CONTACTS for both in rigid)


def _add(touching: CollisionBuilder, scene: Scene, part: RigidBody | Rod, frames: FrameLayout | None) -> list[int]:
    """Objects of a rigid body or a rod."""
    if isinstance(part, RigidBody):
        rigid = scene.rigids[part]
        if rigid.shape is None:
            raise ValueError(f"rigid body {rigid.name!r} has no shape and cannot touch anything; give it one")
        if isinstance(rigid.shape, OneOf):
            number = sum(isinstance(other.shape, OneOf) for other in scene.rigids[:part])
            return [touching.add_shape(int(part), rigid.shape, name=rigid.name, number=number)]
        if any(isinstance(piece.shape, OneOf) for piece in rigid.shape.parts()):
            raise ValueError(
                f"rigid body {rigid.name!r}: one of several meshes cannot be part of a compound; give it a body "
                "of its own"
            )
        return [
            touching.add_shape(int(part), piece.shape, piece.position, piece.quaternion, name=rigid.name)
            for piece in rigid.shape.parts()
        ]
    assert frames is not None
    rod = scene.rods[part]
    chain = frames.rod_chain(int(part))
    radius = np.repeat(np.broadcast_to(rod.geometry.radius, len(rod.geometry.length)), rod.contact_pieces)
    return [touching.add_rod(chain, radius, frames.pose[chain, :3], name=rod.name)]


def _add_soft(
    touching: CollisionBuilder, scene: Scene, part: Handle, places: NDArray[Any], first_node: int, first_point: int
) -> int:
    """Object of a soft body: its skin, or the contact surface that it was given."""
    body = scene.bodies[part]
    surface = body.contact_surface
    if surface is None:
        return touching.add_soft_surface(outer_skin(scene, part) + first_node, places, name=body.name)
    if len(surface.triangles):
        return touching.add_soft_surface(surface.triangles + first_point, places, name=body.name)
    return touching.add_soft_points(np.arange(len(surface.points)) + first_point, places, name=body.name)


def outer_skin(scene: Scene, part: Handle) -> NDArray[np.int32]:
    """Triangles of a soft body that something can reach, shape (tri, 3).

    Only the body itself reaches the walls of its closed chambers: nothing else may start inside them.
    """
    mesh, key = scene.bodies[part].mesh, (part.kind, int(part))
    skin = meshing.tet_surface(mesh.tets)
    if any((s.a.kind, int(s.a)) == key == (s.b.kind, int(s.b)) for s in scene.pairs):
        return skin
    number = meshing.surface_parts(skin)
    outside = [meshing.surface_volume(mesh.nodes, skin[number == i]) > 0.0 for i in range(int(number.max()) + 1)]
    return np.asarray(skin[np.array(outside)[number]])


def pair_defaults(scene: Scene) -> dict[str, NDArray[Any]]:
    """Initial values of the laws of all pairs."""
    values = {f"pair_{key}": np.array([spec.values[key] for spec in scene.pairs]) for key in PAIR_VALUES}
    for i, spec in enumerate(scene.pairs):
        if math.isnan(values["pair_alarm_distance"][i]):
            size = min(part_size(scene, spec.a), part_size(scene, spec.b))
            values["pair_alarm_distance"][i] = spec.values["contact_distance"] + ALARM * size
    return values


def part_size(scene: Scene, part: Handle) -> float:
    """Largest extent of a part [m]; a rod counts with its diameter."""
    if isinstance(part, RigidBody):
        shape = scene.rigids[part].shape
        bounds = np.zeros((2, 3)) if shape is None else shape.bounds
        extent = bounds[1] - bounds[0]
        return float(extent[np.isfinite(extent)].max(initial=0.0)) if np.isfinite(extent).all() else math.inf
    if isinstance(part, Rod):
        return 2.0 * float(np.max(scene.rods[part].geometry.radius))
    return float(np.ptp(scene.bodies[part].mesh.nodes, axis=0).max())
