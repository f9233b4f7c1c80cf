"""Tractions: loads per area on faces of soft bodies. Equations: docs/theory/traction.md."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks, meshing
from softwarp.model.handles import Handle
from softwarp.scene.checks import Box, corners, vector
from softwarp.scene.parts import BodySpec, FloatArray, IntArray, Scene, TractionSpec

Choice = Callable[[FloatArray], ArrayLike]  # positions (face, 3) [m] -> flags (face,)


def add_traction(
    scene: Scene,
    body: int,
    traction: Sequence[float],
    *,
    box: Box | None,
    where: Choice | None,
    triangles: ArrayLike | None,
    name: str | None,
) -> Handle:
    """Pull at faces of a soft body with a force per area at rest."""
    spec = scene.soft(body)
    label = checks.label(name, f"traction{len(scene.tractions)}", "name of a traction")
    if label in [other.name for other in scene.tractions]:
        raise ValueError(f"traction {label!r} exists already; give every traction its own name")
    value = vector(traction, f"traction {label!r}: traction [Pa]")
    if sum(choice is not None for choice in (box, where, triangles)) != 1:
        raise ValueError(f"traction {label!r}: give exactly one of box, where and triangles")
    faces = meshing.tet_surface(spec.mesh.tets if spec.elements is None else spec.elements[:, :4])
    if triangles is not None:
        chosen = _listed(spec, faces, triangles, label)
    else:
        chosen = faces[_flags(spec, faces, box, where, label)]
    if spec.hexes is not None:
        node, share = meshing.quad_shares(spec.mesh.nodes, spec.hexes, chosen)
    else:
        middles = None if spec.elements is None else meshing.face_middles(spec.elements, chosen)
        node, share = meshing.face_shares(spec.mesh.nodes, chosen, middles)
    scene.tractions.append(TractionSpec(name=label, body=int(body), node=node, share=share, value=value))
    return Handle(len(scene.tractions) - 1)


def _flags(spec: BodySpec, faces: IntArray, box: Box | None, where: Choice | None, label: str) -> NDArray[np.bool_]:
    """Boundary faces inside a box, or those that a function of their middles chooses."""
    corner = spec.mesh.nodes[faces]
    if box is not None:
        low, high = corners(box, f"traction {label!r}")
        flags = np.asarray(((corner >= low) & (corner <= high)).all(axis=(1, 2)))
        how = f"lies in box {box!r}"
    else:
        flags = _chosen(where, corner.mean(axis=1), label)
        how = "is chosen by where"
    if not flags.any():
        bounds = np.array2string(np.array([corner.min(axis=(0, 1)), corner.max(axis=(0, 1))]), precision=4)
        raise ValueError(
            f"traction {label!r}: no boundary face of body {spec.name!r} {how}; the body spans {bounds} m, and a face "
            "counts with all its corners in a box, with its middle for where"
        )
    return flags


def _chosen(where: Any, middle: FloatArray, label: str) -> NDArray[np.bool_]:
    if not callable(where):
        need = "be a function of the faces' middles (face, 3) [m] that returns flags (face,)"
        raise ValueError(checks.refusal(f"traction {label!r}: where", need, where))
    flags = checks.as_array(where(middle))
    if flags.dtype != bool or flags.shape != (len(middle),):
        raise ValueError(
            checks.refusal(f"traction {label!r}: what where returns", f"be flags of shape ({len(middle)},)", flags)
        )
    return flags


def _listed(spec: BodySpec, faces: IntArray, triangles: ArrayLike, label: str) -> IntArray:
    """Boundary faces by their corners, in any order of these.

    Raises:
        ValueError: For a node that does not exist, a triangle that is no boundary face, and one that is there twice.
    """
    count = len(spec.mesh.nodes)
    wanted = checks.integers(triangles, f"traction {label!r}: triangles", (None, 3), high=count - 1)
    if len(wanted) == 0:
        raise ValueError(f"traction {label!r}: triangles are empty; give at least one boundary face")
    number = {tuple(face): index for index, face in enumerate(np.sort(faces, axis=1).tolist())}
    found = [number.get(tuple(face), -1) for face in np.sort(wanted, axis=1).tolist()]
    if -1 in found:
        first = found.index(-1)
        kind = "corners of a quadratic element's face" if spec.elements is not None else "a face"
        raise ValueError(
            f"traction {label!r}: triangle {first}, {wanted[first].tolist()}, must be {kind} on the boundary of body "
            f"{spec.name!r}, got one inside it or none of its faces; choose by box or where, which take boundary faces "
            "only"
        )
    if len(set(found)) < len(found):
        first = next(i for i, face in enumerate(found) if face in found[:i])
        raise ValueError(
            f"traction {label!r}: triangle {first}, {wanted[first].tolist()}, is there twice; list each face once"
        )
    return faces[found]
