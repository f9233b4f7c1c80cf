"""Cables through bodies, rods and rigid bodies, and markers on them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from softwarp import checks, meshing
from softwarp.model.handles import Handle, RigidBody, Rod, SoftBody
from softwarp.scene.checks import distance, limits, to_local, vector
from softwarp.scene.parts import CableSpec, FloatArray, IntArray, MarkerSpec, Scene

PATCH = 4  # nodes of one, as many as carry a point


def add_cable(
    scene: Scene,
    body: int | Sequence[int],
    waypoints: ArrayLike,
    pull_point: Sequence[float] | None,
    *,
    control: Literal["length", "force"],
    min_tension: float,
    max_tension: float,
    min_displacement: float,
    max_displacement: float,
    max_rate: float,
    closing_length: float,
    stiffness: float = math.inf,
    damping: float = 0.0,
    pull_on: int | None = None,
    patches: Mapping[int, tuple[ArrayLike, ArrayLike]] | None = None,
    tolerance: float | None,
    name: str | None,
) -> int:
    """Add a frictionless cable through soft bodies, rods and rigid bodies."""
    label = checks.label(name, f"cable{len(scene.cables)}", "name of a cable")
    points = checks.array(waypoints, f"{label}: waypoints", (None, 3), need="be finite with shape (p, 3)")
    anchor = None if pull_point is None else vector(pull_point, f"{label}: pull_point")
    carriers = _carriers(scene, body, len(points), label)
    shared = _checked_patches(scene, carriers, points, {} if patches is None else patches, label)
    if pull_on is not None:
        if anchor is None:
            raise ValueError(f"{label}: pull_on needs a pull_point, the place [m] that part {pull_on!r} carries")
        shared = {i + 1: patch for i, patch in shared.items()}
        carriers, points, anchor = [scene.part(pull_on), *carriers], np.vstack([anchor, points]), None
    elastic = _elastic(stiffness, damping, control, label)
    _check_path(points if anchor is None else np.vstack([anchor, points]), closing_length, label)
    checks.choice(control, f"{label}: control", ("length", "force"))
    given = {
        "min_tension": min_tension,
        "max_tension": max_tension,
        "min_displacement": min_displacement,
        "max_displacement": max_displacement,
        "max_rate": max_rate,
    }
    bounds = {f"cable_{key}": value for key, value in limits(given, label).items()}
    _check_limits(bounds, label)
    tolerance = distance(tolerance, f"{label}: tolerance")
    tets, weights = _embedded(scene, carriers, points, tolerance, label)
    for i, (nodes, shares) in shared.items():
        weights[i] = 0.0
        weights[i, : len(nodes)] = shares
    bounds |= elastic
    patch_nodes = {i: nodes for i, (nodes, _) in shared.items()}
    is_forced, closing = control == "force", float(closing_length)
    scene.cables.append(
        CableSpec(label, carriers, points, anchor, is_forced, bounds, tets, weights, closing, patch_nodes)
    )
    return len(scene.cables) - 1


def add_spring(
    scene: Scene,
    a: int,
    b: int,
    points: ArrayLike,
    *,
    stiffness: float,
    damping: float,
    rest_length: float | None,
    only_pulls: bool,
    tolerance: float | None,
    name: str | None,
) -> int:
    """Add a spring with a damper between points of two parts, or of one."""
    label = checks.label(name, f"spring{len(scene.cables)}", "name of a spring")
    ends = checks.array(points, f"{label}: points", (2, 3), need="be finite with shape (2, 3)")
    checks.number(stiffness, f"{label}: stiffness [N/m]", above=0.0)
    length = float(np.linalg.norm(ends[1] - ends[0]))
    if rest_length is not None:
        checks.number(rest_length, f"{label}: rest_length [m]", low=0.0)
    shortened = 0.0 if rest_length is None else length - rest_length
    return add_cable(
        scene,
        [a, b],
        ends,
        None,
        control="length",
        min_tension=0.0 if checks.flag(only_pulls, f"{label}: only_pulls") else -math.inf,
        max_tension=math.inf,
        min_displacement=shortened,
        max_displacement=shortened,
        max_rate=math.inf,
        closing_length=0.0,
        stiffness=stiffness,
        damping=damping,
        tolerance=tolerance,
        name=label,
    )


def _checked_patches(
    scene: Scene, carriers: list[Handle], points: FloatArray, patches: Mapping[int, Any], label: str
) -> dict[int, tuple[IntArray, FloatArray]]:
    """Nodes and shares of every patch.

    Raises:
        ValueError: For a waypoint that does not exist or that no soft body carries, nodes that do not exist or occur
            twice, more than four, shares that are none or do not add up to 1, and a waypoint that is not their mean.
    """
    checked = {}
    if not isinstance(patches, Mapping):
        raise ValueError(checks.refusal(f"{label}: patches", "map waypoints to nodes and their shares", patches))
    for i, patch in patches.items():
        if i not in range(len(points)) or not isinstance(carriers[i], SoftBody):
            raise ValueError(f"{label}: patches: {i!r} must be the number of a waypoint that a soft body carries")
        what = f"{label}: patch of waypoint {i}"
        if not isinstance(patch, tuple) or len(patch) != 2:
            raise ValueError(checks.refusal(what, "be nodes and their shares", patch))
        rest = scene.bodies[carriers[i]].mesh.nodes
        nodes = checks.integers(patch[0], f"{what}: nodes", (None,), high=len(rest) - 1)
        shares = checks.array(patch[1], f"{what}: shares", (len(nodes),), need=f"be finite, {len(nodes)} of them")
        if not 1 <= len(nodes) <= PATCH or len(set(nodes.tolist())) < len(nodes):
            raise ValueError(f"{what}: give 1 to {PATCH} different nodes, got {nodes.tolist()}")
        if abs(shares.sum() - 1.0) > 1e-6 or shares.min() <= 0.0:
            raise ValueError(f"{what}: shares must be positive and add up to 1, got {shares.tolist()}")
        mean = shares @ rest[nodes]
        if np.linalg.norm(mean - points[i]) > 1e-6 * np.ptp(rest, axis=0).max():
            raise ValueError(f"{what}: waypoint {points[i].tolist()} must be the mean of the patch, {mean.tolist()}")
        checked[i] = nodes, shares / shares.sum()
    return checked


def _elastic(stiffness: float, damping: float, control: str, label: str) -> dict[str, float]:
    """Stiffness and damping of a cable, by their names in ``Parameters``."""
    stiffness = checks.number(stiffness, f"{label}: stiffness [N/m]", above=0.0, infinite=True)
    if stiffness != math.inf:
        if control != "length":
            raise ValueError(
                f"{label}: stiffness needs control='length', got {control!r}: an imposed tension is the same whether "
                "the cable stretches or not; leave stiffness out"
            )
    checks.number(damping, f"{label}: damping [N s/m]", low=0.0)
    if damping and stiffness == math.inf:
        raise ValueError(f"{label}: damping needs a stiffness: what does not stretch has no speed of stretching")
    return {"cable_stiffness": stiffness, "cable_damping": damping}


def _check_path(path: FloatArray, closing_length: float, label: str) -> None:
    """Refuse a cable that is too short, has points in the same place, or closes before it is pulled."""
    if len(path) < 2:
        raise ValueError(f"{label}: a cable needs two points, got {len(path)}; add a waypoint or a pull_point")
    segments = np.linalg.norm(np.diff(path, axis=0), axis=1)
    short = np.flatnonzero(segments < 1e-9 * max(1.0, np.ptp(path)))
    if short.size:
        raise ValueError(f"{label}: points {short[0]} and {short[0] + 1} coincide; remove one")
    checks.number(closing_length, f"{label}: closing_length", low=0.0)
    if not closing_length < segments.min():
        raise ValueError(
            f"{label}: closing_length must be at least 0 and below its shortest segment at rest, "
            f"{segments.min():.6g} m, got {closing_length!r}"
        )


def _check_limits(bounds: dict[str, float], label: str) -> None:
    """Refuse limits that are not ordered, or that nothing can keep."""
    is_ordered = bounds["cable_min_tension"] <= bounds["cable_max_tension"]
    is_ordered &= bounds["cable_min_displacement"] <= bounds["cable_max_displacement"]
    is_ordered &= bounds["cable_min_tension"] < math.inf and bounds["cable_max_tension"] > -math.inf
    is_ordered &= bounds["cable_min_displacement"] < math.inf and bounds["cable_max_displacement"] > -math.inf
    if not is_ordered or bounds["cable_max_rate"] < 0.0:
        raise ValueError(f"{label}: limits must be ordered and max_rate >= 0, got {bounds}")


def _embedded(
    scene: Scene, carriers: list[Handle], points: FloatArray, tolerance: float | None, label: str
) -> tuple[IntArray, FloatArray]:
    """Tet and weights of every waypoint in a soft body; -1 and zeros on other parts."""
    tets, weights = np.full(len(points), -1, dtype=np.int32), np.zeros((len(points), 4))
    for part in {int(c) for c in carriers if isinstance(c, SoftBody)}:
        mesh = scene.bodies[part].mesh
        on = np.array([isinstance(c, SoftBody) and int(c) == part for c in carriers])
        tets[on], weights[on] = meshing.embed(
            mesh.nodes, mesh.tets, points[on], name=f"{label}: waypoint", tolerance=tolerance
        )
    return tets, weights


def add_marker(scene: Scene, body: int, point: Sequence[float], *, tolerance: float | None, name: str | None) -> int:
    """Follow a material point."""
    label = checks.label(name, f"marker{len(scene.markers)}", "name of a marker")
    where = vector(point, f"{label}: point")[None]
    tolerance = distance(tolerance, f"{label}: tolerance")
    if isinstance(body, (RigidBody, Rod)):
        part = scene.part(body)
        if isinstance(body, RigidBody):
            node, pose = 0, scene.rigids[body].pose
        else:
            g = scene.rods[body].geometry
            node = int(np.argmin(np.linalg.norm(g.positions - where, axis=1)))
            pose = np.concatenate([g.positions[node], g.quaternions[node]])
        scene.markers.append(MarkerSpec(label, -1, -1, np.zeros(4), (part, node), to_local(pose, where[0])))
        return len(scene.markers) - 1
    spec = scene.soft(body)
    tets, weights = meshing.embed(spec.mesh.nodes, spec.mesh.tets, where, name=label, tolerance=tolerance)
    scene.markers.append(MarkerSpec(label, body, int(tets[0]), weights[0]))
    return len(scene.markers) - 1


def _carriers(scene: Scene, body: int | Sequence[int], count: int, label: str) -> list[Handle]:
    """Part of every waypoint."""
    if not isinstance(body, (int, np.integer, Sequence, np.ndarray)) or isinstance(body, str):
        raise ValueError(checks.refusal(f"{label}: body", "be a part, or a list with one per waypoint", body))
    parts: list[int] = [body] * count if isinstance(body, (int, np.integer)) else list(body)
    if len(parts) != count:
        raise ValueError(f"{label}: give one body, or one per waypoint ({count}), got {len(parts)}")
    return [scene.part(part) for part in parts]
