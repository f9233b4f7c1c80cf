"""From soft bodies of a scene to nodes and elements, body after body. Host only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp import meshing
from softwarp.meshing.tets import rest_geometry
from softwarp.model.codes import TURNED
from softwarp.model.hexes import HexLayout
from softwarp.model.quadratic import QuadraticLayout
from softwarp.plan.frames import FrameLayout, guide_points
from softwarp.plan.hexes import hex_elements, hex_layout
from softwarp.plan.quadratic import by_law, quadratic_elements, quadratic_layout
from softwarp.plan.structure import Elements, lists
from softwarp.scene.parts import BodySpec, Scene

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class SoftLayout:
    """Nodes and elements of all soft bodies. The last nodes are guides: waypoints of cables on rods and rigid bodies.

    Points are embedded in ``carriers``: the linear tets, or those between the nodes of other elements.
    """

    nodes: FloatArray  # (node, 3)
    carriers: IntArray  # (carrier, 4)
    carrier_start: IntArray  # (body + 1,)
    node_start: IntArray  # (body + 1,)
    tets: IntArray  # (tet, 4) linear elements
    tet_body: IntArray
    node_body: IntArray
    fixed: NDArray[np.bool_]
    locked: NDArray[np.bool_]  # (node, 3)
    laws: NDArray[Any]  # kernel law of every tet
    gradient: FloatArray
    volume: FloatArray  # with weights of reduced bodies, and factors of the modulus
    size: FloatArray  # without
    frame: FloatArray
    node_volume: FloatArray
    node_load: FloatArray
    quadratic: QuadraticLayout
    hexes: HexLayout
    reduced: NDArray[np.bool_]  # (node,) nodes that move in modes


def soft_layout(scene: Scene) -> SoftLayout:
    """Number nodes and elements body after body."""
    bodies, guides = scene.bodies, guide_points(scene)
    node_start = np.concatenate([[0], np.cumsum([len(b.nodes) for b in bodies])]).astype(np.int32)
    carrier_start = np.concatenate([[0], np.cumsum([len(b.mesh.tets) for b in bodies])]).astype(np.int32)
    nodes = stacked([*(b.nodes for b in bodies), guides], (0, 3), np.float64)
    carriers = stacked([b.mesh.tets + s for b, s in zip(bodies, node_start[:-1], strict=True)], (0, 4), np.int32)
    own = [(i, b) for i, b in enumerate(bodies) if b.is_linear]
    tets = stacked([b.tets + node_start[i] for i, b in own], (0, 4), np.int32)
    tet_body = np.repeat([i for i, _ in own], [len(b.tets) for _, b in own]).astype(np.int32)
    gradient, volume, frame = rest_geometry(nodes, tets)
    quadratic, hexes = quadratic_layout(scene, node_start), hex_layout(scene, node_start)
    volumes = [_lumped_volume(b, volume[tet_body == i]) for i, b in enumerate(bodies)]
    given = [_weights(b) for _, b in own]
    weight = stacked(given, (0,), np.float64)
    counts = weight > 0.0
    end = (0, len(guides))
    node_volume = np.pad(stacked(volumes, (0,), np.float64), end)
    node_volume += np.bincount(quadratic.nodes.ravel(), quadratic.lumped.ravel(), minlength=len(nodes))
    node_volume += np.bincount(hexes.nodes.ravel(), hexes.lumped.ravel(), minlength=len(nodes))
    return SoftLayout(
        nodes=nodes,
        carriers=carriers,
        carrier_start=carrier_start,
        node_start=node_start,
        tets=tets[counts],
        tet_body=tet_body[counts],
        node_body=np.pad(np.repeat(np.arange(len(bodies)), np.diff(node_start)), end).astype(np.int32),
        fixed=np.pad(stacked([b.fixed for b in bodies], (0,), bool), end),
        locked=np.pad(stacked([b.locked for b in bodies], (0, 3), bool), (end, (0, 0))),
        laws=np.array([b.material.kernel_law for b in bodies], dtype=object)[tet_body[counts]],
        gradient=gradient[counts],
        volume=(volume * weight)[counts],
        size=volume[counts],
        frame=frame[counts],
        node_volume=node_volume,
        node_load=np.pad(stacked([b.load for b in bodies], (0, 3), np.float64), (end, (0, 0))),
        quadratic=quadratic,
        hexes=hexes,
        reduced=np.pad(np.repeat([b.reduction is not None for b in bodies], np.diff(node_start)), end).astype(bool),
    )


def _weights(body: BodySpec) -> FloatArray:
    """How often elements count, (tet,)."""
    if body.reduction is not None:
        return body.reduction.tet_weight
    return np.ones(len(body.tets)) if body.stiffness is None else body.stiffness


def _lumped_volume(body: BodySpec, volume: FloatArray) -> FloatArray:
    count = len(body.mesh.nodes)
    if body.points is not None:
        return body.points.node_volume
    if not body.is_linear:
        return np.zeros(count)  # other elements bring theirs
    if body.lumping == "uniform":
        return np.full(count, volume.sum() / count)
    shares = np.bincount(body.mesh.tets.ravel(), np.repeat(volume / 4.0, 4), minlength=count)
    return shares.astype(np.float64)


def tet_elements(tets: IntArray, is_turned: NDArray[np.bool_]) -> list[Elements]:
    """Linear tets by how their stiffness is kept."""
    return [
        Elements("large", tets[is_turned], np.flatnonzero(is_turned)),
        Elements("stored", tets[~is_turned], np.flatnonzero(~is_turned)),
    ]


def soft_elements(soft: SoftLayout, frames: FrameLayout | None) -> list[Elements]:
    """Elements of all bodies, less those that one frame carries whole.

    These move as rigid bodies, against which an element has no stiffness: what they would add to A is zero. Forces,
    energies, stresses and masses are theirs as before.
    """
    parts = tet_elements(soft.tets, np.isin(soft.laws, TURNED)) + quadratic_elements(soft.quadratic)
    parts += hex_elements(soft.hexes)
    return parts if frames is None else [part.chosen(~frames.carries_whole(part.corners)) for part in parts]


def stacked(parts: list[NDArray[Any]], empty: tuple[int, ...], dtype: Any) -> NDArray[Any]:
    """Parts one after the other, or an array of shape ``empty`` without any."""
    return np.concatenate([np.empty(empty, dtype=dtype), *parts]).astype(dtype)


@dataclass(frozen=True)
class SoftArrays:
    """Arrays of all soft bodies, under the names that ``Model`` declares."""

    node_rest: FloatArray
    tet_corners: IntArray
    body_node_start: IntArray
    node_fixed: NDArray[np.bool_]
    node_locked: NDArray[np.bool_]
    law_parameters: tuple[tuple[str, ...], ...]
    surface_tri: IntArray
    tri_body: IntArray
    law_tets: dict[str, IntArray]
    tet_node: IntArray
    tet_body: IntArray
    tet_gradient: FloatArray
    tet_volume: FloatArray
    tet_size: FloatArray
    tet_frame: FloatArray
    body_law_start: IntArray
    body_guard: FloatArray
    node_body: IntArray
    node_volume: FloatArray
    node_heft: FloatArray
    node_load: FloatArray
    corner_start: IntArray
    corner: IntArray


def soft_arrays(scene: Scene, soft: SoftLayout, thin: Sequence[Elements], node_volume: FloatArray) -> SoftArrays:
    """Arrays of all soft bodies.

    Args:
        scene: Soft bodies.
        soft: Their nodes and tets.
        thin: Elements with up to four corners besides; their forces follow those of the linear tets.
        node_volume: What they add to that of the nodes of all bodies [m^3], (node,).
    """
    surfaces = [meshing.tet_surface(b.mesh.tets) for b in scene.bodies]
    outer = [s + n for s, n in zip(surfaces, soft.node_start[:-1], strict=True)]
    corners = np.concatenate([soft.tets, *(part.corners for part in thin)]).ravel()
    used = np.flatnonzero(corners >= 0)
    others = np.concatenate([soft.quadratic.nodes.ravel(), soft.hexes.nodes.ravel()])
    of_node = np.concatenate([corners[used], others])
    place = np.concatenate([used, corners.size + np.arange(others.size)])
    corner_start, corner = lists(of_node, place, len(soft.nodes))
    guides = len(soft.nodes) - int(soft.node_start[-1])
    own = tuple(tuple(b.material.law_parameters) for b in scene.bodies)
    volume = soft.node_volume + np.pad(node_volume, (0, guides))
    return SoftArrays(
        node_rest=soft.nodes,
        tet_corners=soft.tets,
        body_node_start=soft.node_start,
        node_fixed=soft.fixed,
        node_locked=soft.locked,
        law_parameters=own,
        surface_tri=stacked(outer, (0, 3), np.int32),
        tri_body=np.repeat(np.arange(len(scene.bodies)), [len(s) for s in surfaces]).astype(np.int32),
        law_tets=by_law(soft.laws),
        tet_node=soft.tets,
        tet_body=soft.tet_body,
        tet_gradient=soft.gradient,
        tet_volume=soft.volume,
        tet_size=soft.size,
        tet_frame=soft.frame,
        body_law_start=np.cumsum([0, *map(len, own)])[:-1].astype(np.int32),
        body_guard=np.array([b.material.guard for b in scene.bodies], dtype=np.float64),
        node_body=soft.node_body,
        node_volume=volume,
        node_heft=np.where(soft.reduced, 0.0, volume),
        node_load=soft.node_load,
        corner_start=corner_start,
        corner=corner,
    )
