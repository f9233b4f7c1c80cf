"""Sizes of parts, and the refusal of scenes that stand where a precision does not resolve them. Host only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softwarp.meshing.tets import EDGES
from softwarp.model.codes import FAR
from softwarp.model.model import Model
from softwarp.model.resolution import resolved_sizes, spacing
from softwarp.plan.frames import FrameLayout
from softwarp.scene.parts import RigidSpec, RodSpec, Scene

FloatArray = NDArray[np.float64]


def node_size(scene: Scene) -> float:
    """Median edge [m] of the soft body with the shortest ones: single slivers in a mesh do not count."""
    medians = [FAR]
    for body in scene.bodies:
        ends = body.mesh.nodes[body.mesh.tets[:, EDGES]]  # (tet, edge, end, 3)
        medians.append(float(np.median(np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1))))
    return min(medians)


def frame_sizes(scene: Scene, frames: FrameLayout | None, extent: float) -> FloatArray:
    """Size [m] of the part of every frame, (frame,); frames that others carry have no limit of their own.

    Segments of telescopes grow with what is out, as does the distance from the port: their size is that of the longest.

    Args:
        scene: Rigid bodies and rods.
        frames: Their frames.
        extent: Size of rigid bodies without a bounded shape [m].
    """
    if frames is None:
        return np.empty(0)
    sizes = np.full(frames.count, FAR)
    sizes[: frames.rigid_count] = [_side(body, extent) for body in scene.rigids]
    for rod, (begin, end) in zip(
        scene.rods, zip(frames.rod_start[:-1], frames.rod_start[1:], strict=True), strict=True
    ):
        sizes[frames.rigid_count + begin : frames.rigid_count + end] = _segment(rod)
    return np.where(frames.master == np.arange(frames.count), sizes, FAR)


def _segment(rod: RodSpec) -> float:
    """Median length of the segments of a rod, of a telescope when all of it is out [m]."""
    if rod.telescope is None:
        return float(np.median(rod.geometry.length))
    return float(rod.telescope.table.length.max()) / len(rod.geometry.length)


def _side(body: RigidSpec, extent: float) -> float:
    """Longest side of a rigid body's box [m]."""
    sides = np.array([np.inf]) if body.shape is None else np.ptp(body.shape.bounds, axis=0)
    return float(sides.max()) if np.isfinite(sides).all() else extent


def refuse_far(model: Model) -> None:
    """Refuse a scene with a part that its precision does not resolve where it stands.

    Args:
        model: Scene before its arrays are uploaded.

    Raises:
        ValueError: The message names the part, its place, and how far from the origin it may stand.
    """
    ranges = zip(model.body_names, model.body_node_start[:-1], model.body_node_start[1:], strict=True)
    for name, begin, end in ranges:
        _check(f"soft body {name!r}", model.node_rest[begin:end], model.node_size, model.precision)
    if model.frames is None:
        return
    places, sizes = model.frames.rest_pose[:, :3], np.asarray(model.frames.frame_size)
    for number, name in enumerate(model.rigid_names):
        _check(f"rigid body {name!r}", places[number : number + 1], sizes[number], model.precision)
    for number, name in enumerate(model.rod_names):
        nodes = model.rod_nodes(number)
        nodes = slice(model.rigid_count + nodes.start, model.rigid_count + nodes.stop)
        apart = np.linalg.norm(np.diff(places[nodes], axis=0), axis=1)  # of telescopes: with what is out now
        _check(f"rod {name!r}", places[nodes], float(min(sizes[nodes].min(), np.median(apart))), model.precision)


def _check(part: str, places: FloatArray, size: float, precision: str) -> None:
    """Raise ValueError where a part stands too far from the origin."""
    farthest = places[np.abs(places).max(axis=1).argmax()]
    distance, limit = float(np.abs(farthest).max()), size * resolved_sizes(precision)
    if distance > limit:
        place = ", ".join(f"{x:g}" for x in farthest)
        raise ValueError(
            f"{part} stands at ({place}) m, where {precision} coordinates are {spacing(distance, precision):.2g} m "
            f"apart; a part of this size ({size:.3g} m) must stay within {limit:.3g} m of the origin: move the scene "
            "there, or use precision='float64'"
        )
