"""Rigid bodies, rods, and what they carry."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks, meshing, shapes
from softwarp.model.handles import RigidBody, Rod
from softwarp.scene.checks import Box, as_pose, corners, factors, node_indices
from softwarp.scene.parts import AXES, FloatArray, IntArray, RigidSpec, RodSpec, Scene, Weld

MOST_PIECES = 10_000  # of a segment


def add_rigid(
    scene: Scene,
    shape: Any,
    *,
    mass: float | None,
    density: float | None,
    inertia: ArrayLike | None,
    pose: ArrayLike,
    kinematic: bool,
    free_axes: str | Iterable[Any],
    velocity: ArrayLike,
    damping: float,
    max_speed: float,
    max_spin: float,
    name: str | None,
) -> RigidBody:
    """Add a rigid body."""
    label = scene.new_name(name, f"rigid{len(scene.rigids)}")
    solid = None if shape is None else shapes.as_shape(shape, name=f"rigid body {label!r}: shape")
    where = as_pose(pose, f"rigid body {label!r}: pose")
    twist = checks.array(velocity, f"rigid body {label!r}: velocity", (6,))
    kinematic = checks.flag(kinematic, f"rigid body {label!r}: kinematic")
    if not kinematic or mass is not None or density is not None:
        value, centre, tensor = _mass_properties(label, solid, mass, density, inertia)
    else:
        value, centre, tensor = 0.0, np.zeros(3), np.zeros((3, 3))
    free = _free_axes(free_axes, label)
    if kinematic:
        free = np.zeros(6, dtype=bool)
    for what, number in (("damping", damping), ("max_speed", max_speed), ("max_spin", max_spin)):
        checks.number(number, f"rigid body {label!r}: {what}", low=0.0, infinite=what != "damping")
    scene.rigids.append(
        RigidSpec(
            name=label,
            shape=solid,
            mass=value,
            centre=centre,
            inertia=tensor,
            pose=where,
            free=free,
            kinematic=kinematic,
            max_speed=float(max_speed),
            max_spin=float(max_spin),
            damping=float(damping),
            twist=twist,
        )
    )
    return RigidBody(len(scene.rigids) - 1)


def add_rod(
    scene: Scene,
    points: ArrayLike,
    *,
    radius: float | ArrayLike,
    youngs: float,
    nu: float,
    density: float,
    curvature: ArrayLike | None,
    inner_radius: float | ArrayLike,
    normal: Sequence[float] | None,
    section: ArrayLike | None,
    stiffness: float | ArrayLike,
    rayleigh: tuple[float, float],
    contact_pieces: int,
    name: str | None,
) -> Rod:
    """Add a rod that stretches, shears, bends and twists, by default with circular or annular sections."""
    label = scene.new_name(name, f"rod{len(scene.rods)}")
    checks.number(youngs, f"rod {label!r}: youngs", above=0.0)
    checks.number(density, f"rod {label!r}: density", low=0.0)
    checks.number(nu, f"rod {label!r}: Poisson's ratio", above=-1.0, high=0.5)
    pieces = checks.count(contact_pieces, f"rod {label!r}: contact_pieces", high=MOST_PIECES)
    damping = factors(rayleigh, f"rod {label!r}: rayleigh")
    try:
        geometry = meshing.rod_geometry(
            points,
            radius=radius,
            inner_radius=inner_radius,
            curvature=curvature,
            normal=normal,
            nu=nu,
            section=section,
        )
    except ValueError as error:
        raise ValueError(f"rod {label!r}: {error}") from error
    segments = len(geometry.length)
    need = f"be positive and finite, one or one per segment ({segments})"
    given = checks.array(stiffness, f"rod {label!r}: stiffness factors", (), (1,), (segments,), above=0.0, need=need)
    scale = np.broadcast_to(given, geometry.length.shape).copy()
    scene.rods.append(
        RodSpec(
            name=label,
            geometry=geometry,
            youngs=float(youngs),
            nu=float(nu),
            density=float(density),
            rayleigh=damping,
            scale=scale,
            clamped=np.zeros(len(geometry.positions), dtype=bool),
            contact_pieces=pieces,
        )
    )
    return Rod(len(scene.rods) - 1)


def attach(
    scene: Scene,
    body: int,
    nodes: ArrayLike | None,
    to: int | None,
    *,
    box: Box | None,
    within: float | None,
    node: int,
) -> IntArray:
    """Let a rigid body or a rod carry nodes of a soft body or a rod, or a whole rigid body."""
    to_rod = isinstance(to, Rod)
    if not isinstance(to, (Rod, RigidBody)):
        raise ValueError(
            f"attach: to must be a rigid body or a rod, got {to!r}; pass what add_rigid or add_rod returned"
        )
    count = len(scene.rods if to_rod else scene.rigids)
    if not 0 <= to < count:
        raise ValueError(f"attach: {to!r} does not exist; the builder has {count}")
    to_node = np.array([-1], dtype=np.int32)
    if to_rod:
        to_node = node_indices([node], len(scene.rods[to].geometry.positions), f"rod {scene.rods[to].name!r}: node")
    if isinstance(body, RigidBody):
        _check_carried(scene, body)
        chosen = np.empty(0, dtype=np.int32)
        scene.welds.append(Weld("rigid", int(body), chosen, to_rod, int(to), to_node))
        return chosen
    is_rod = isinstance(body, Rod)
    spec, where, held = scene.nodes_of(body)
    label = f"{'rod' if is_rod else 'body'} {spec.name!r}"
    chosen = _chosen(scene, label, where, nodes, box, within, to)
    if held[chosen].any():
        first = int(chosen[held[chosen]][0])
        raise ValueError(f"{label}: node {first} is fixed and cannot be attached as well; do one of both")
    scene.welds.append(Weld("rod" if is_rod else "nodes", int(body), chosen, to_rod, int(to), to_node))
    return chosen


def _check_carried(scene: Scene, body: RigidBody) -> None:
    """Refuse a rigid body that nothing can carry."""
    if not 0 <= body < len(scene.rigids):
        raise ValueError(f"attach: {body!r} does not exist; the builder has {len(scene.rigids)}")
    if scene.rigids[body].kinematic:
        name = scene.rigids[body].name
        raise ValueError(f"rigid body {name!r} is kinematic and cannot be carried; attach its carrier to it instead")


def _chosen(
    scene: Scene, label: str, where: FloatArray, nodes: ArrayLike | None, box: Box | None, within: float | None, to: int
) -> IntArray:
    """Nodes that a call of ``attach`` means."""
    if sum(value is not None for value in (nodes, box, within)) != 1:
        raise ValueError(f"{label}: attach takes exactly one of nodes, box and within")
    if nodes is not None:
        return node_indices(nodes, len(where), f"{label}: attached nodes")
    if box is not None:
        low, high = corners(box, label)
        inside = ((where >= low) & (where <= high)).all(axis=1)
        if not inside.any():
            bounds = np.array2string(np.array([where.min(axis=0), where.max(axis=0)]), precision=4)
            raise ValueError(f"{label}: no node lies in box {box!r}; the body spans {bounds} m")
        return np.flatnonzero(inside).astype(np.int32)
    if isinstance(to, Rod) or scene.rigids[to].shape is None:
        raise ValueError(f"{label}: within needs a rigid body with a shape to measure from; pass nodes or box")
    rigid = scene.rigids[to]
    assert rigid.shape is not None
    reach = checks.number(within, f"{label}: within", low=0.0, high=checks.FARTHEST)
    distance = shapes.distances(rigid.shape, rigid.pose, where)
    near = np.flatnonzero(distance <= reach).astype(np.int32)
    if near.size == 0:
        raise ValueError(
            f"{label}: no node lies within {within:g} m of rigid body {rigid.name!r}; the nearest is node "
            f"{int(distance.argmin())} at {distance.min():.4g} m"
        )
    return near


def _free_axes(value: str | Iterable[Any], label: str) -> NDArray[np.bool_]:
    if not isinstance(value, Iterable):
        raise ValueError(checks.refusal(f"rigid body {label!r}: free_axes", "be names of axes or six flags", value))
    items = [value] if isinstance(value, str) else list(value)
    if len(items) == 6 and all(isinstance(item, (bool, np.bool_, int)) and item in (0, 1) for item in items):
        return np.array(items, dtype=bool)
    wrong = [item for item in items if not isinstance(item, str) or item not in AXES]
    if wrong:
        raise ValueError(f"rigid body {label!r}: free axis {wrong[0]!r} is none of {', '.join(AXES)}")
    return np.array([axis in items for axis in AXES])


def _mass_properties(
    label: str, shape: shapes.Shape | None, mass: float | None, density: float | None, inertia: ArrayLike | None
) -> tuple[float, FloatArray, FloatArray]:
    """Mass [kg], centre (3,) and inertia (3, 3) about it."""
    if (mass is None) == (density is None):
        raise ValueError(f"rigid body {label!r}: give exactly one of mass [kg] and density [kg/m^3]")
    given = mass if mass is not None else density
    checks.number(given, f"rigid body {label!r}: mass and density", above=0.0)
    if shape is None and (mass is None or inertia is None):
        raise ValueError(f"rigid body {label!r} has no shape: give its mass [kg] and its inertia [kg m^2]")
    value, centre, tensor = (float(given or 0.0), np.zeros(3), np.zeros((3, 3)))
    if shape is not None and (inertia is None or mass is None):
        value, centre, tensor = shape.inertia(mass=mass, density=density)
    if inertia is not None:
        need = "be finite with shape (3,) or (3, 3)"
        array = checks.array(inertia, f"rigid body {label!r}: inertia", (3,), (3, 3), need=need)
        tensor = np.diag(array) if array.shape == (3,) else array
        if shape is not None:
            centre = shape.centre
    principal = np.linalg.eigvalsh(0.5 * (tensor + tensor.T))
    if not (principal > 0.0).all() or not np.allclose(tensor, tensor.T, rtol=1e-6):
        raise ValueError(
            f"rigid body {label!r}: the inertia must be symmetric with positive moments, got {principal} kg m^2; "
            "give the body an extent in all directions"
        )
    if principal[2] > (principal[0] + principal[1]) * (1.0 + 1e-6):
        raise ValueError(f"rigid body {label!r}: moments {principal} kg m^2 break the triangle inequality")
    return value, np.asarray(centre, dtype=np.float64), tensor
