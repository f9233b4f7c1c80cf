"""Soft bodies that move in modes only: what a builder is given of a reduction. Theory: docs/theory/reduction.md."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from softwarp import checks
from softwarp.meshing.quadratic import POINTS
from softwarp.scene.parts import BodySpec, FloatArray, ReductionSpec, Scene

FRAMES = ("fixed", "floating")
PARTS = ("modes", "tet_weight", "membrane_weight", "turns", "nodes", "tets")  # of ``Reduced``
HELD = 1e-9  # of the largest displacement in a mode: how far a held node may go in it


class Reduced(Protocol):
    """What ``reduce`` reads of a reduction, as ``softwarp.reduction.Reduction`` has it."""

    @property
    def modes(self) -> FloatArray:
        """Displacements of all nodes in every mode, (mode, node, 3)."""

    @property
    def tet_weight(self) -> FloatArray:
        """Weights of the tets, (tet,), or of the Gauss points of quadratic ones, four of each."""

    @property
    def membrane_weight(self) -> Mapping[str, FloatArray]:
        """Weights of the triangles of every membrane on the body, by the membrane's name."""

    @property
    def turns(self) -> bool:
        """Whether its modes live in a floating frame, which turns with the body."""

    @property
    def nodes(self) -> FloatArray:
        """Nodes of the mesh at rest [m], (node, 3)."""

    @property
    def tets(self) -> NDArray[np.int32]:
        """Its tetrahedra, (tet, 4)."""


def reduce(scene: Scene, body: int, reduction: Reduced, frame: str | None = None) -> None:
    """Let a soft body move in modes only."""
    spec = scene.soft(body)
    label = f"body {spec.name!r}"
    if not all(hasattr(reduction, name) for name in PARTS):
        advice = "Reduction.load(path) reads one from a file"
        raise TypeError(checks.refusal(f"{label}: reduction", "be a Reduction", reduction, advice))
    if spec.hexes is not None:
        raise ValueError(f"{label} has hexahedra, which cannot be reduced yet; take tetrahedra, or leave reduce out")
    made_of, ours = getattr(reduction, "element", "p1"), "p1" if spec.elements is None else "p2"
    if made_of != ours:
        raise ValueError(
            f"{label} has elements {ours!r}, and the reduction was made with {made_of!r}; train it with those of the "
            "scene"
        )
    if spec.reduction is not None:
        raise ValueError(f"{label} is reduced already; reduce every body once")
    if spec.relaxation[0] > 0.0:
        raise ValueError(f"{label}: relaxation and reduce do not go together; leave one of them out")
    if spec.stiffness is not None:
        raise ValueError(f"{label}: stiffness and reduce do not go together; leave one of them out")
    made = "floating" if reduction.turns else "fixed"
    if frame is not None and checks.choice(frame, f"{label}: frame", FRAMES) != made:
        raise ValueError(
            f"{label}: frame={frame!r} was asked for, and the reduction was trained in a {made} frame; train it with "
            f"frame={frame!r}, or leave frame out"
        )
    _check_mesh(spec, reduction, label)
    modes = np.asarray(reduction.modes, dtype=np.float64)
    tet_weight = np.asarray(reduction.tet_weight, dtype=np.float64)
    count = len(spec.mesh.nodes)
    if modes.ndim != 3 or modes.shape[1:] != (count, 3) or len(modes) == 0 or not np.isfinite(modes).all():
        need = f"be finite numbers of shape (modes, {count}, 3)"
        raise ValueError(checks.refusal(f"{label}: modes", need, modes.shape))
    if spec.elements is None:
        _check_weights(tet_weight, len(spec.mesh.tets), f"{label}: weights of tets")
    else:
        if reduction.turns:
            raise ValueError(f"{label}: quadratic elements ('p2') have no floating frame; train with frame='fixed'")
        _check_weights(tet_weight, POINTS * len(spec.elements), f"{label}: weights of Gauss points")
    thin = {name: np.asarray(w, dtype=np.float64) for name, w in reduction.membrane_weight.items()}
    spec.reduction = ReductionSpec(modes=modes, tet_weight=tet_weight, membrane_weight=thin, floating=reduction.turns)


def check_parts(scene: Scene) -> None:
    """Refuse what reduced bodies cannot have, once the scene is complete.

    Raises:
        ValueError: For held nodes that a mode moves, a free body whose modes hold nodes, locked axes, nodes attached to
            frames, and membranes that the reduction was not made with.
    """
    for number, spec in enumerate(scene.bodies):
        given = spec.reduction
        if given is None:
            continue
        label = f"body {spec.name!r}"
        if given.floating and spec.fixed.any():
            raise ValueError(
                f"{label}: its reduction has a floating frame, and {int(spec.fixed.sum())} of its nodes are fixed, so "
                "that it cannot move as a whole; train the reduction with frame='fixed'"
            )
        largest = np.abs(given.modes).max()
        moved = np.flatnonzero((np.abs(given.modes) > HELD * largest).any(axis=(0, 2)) & spec.fixed)
        if moved.size:
            raise ValueError(
                f"{label}: its modes move node {moved[0]}, which is fixed ({moved.size} such nodes); "
                "train the reduction with the supports that the scene has"
            )
        still = np.flatnonzero((np.abs(given.modes) <= HELD * largest).all(axis=(0, 2)))
        if still.size and not given.floating and not spec.fixed.any():
            raise ValueError(
                f"{label}: its modes hold {still.size} nodes in place, such as node {still[0]}, and nothing holds them "
                "in the scene; fix them, or train the reduction with the supports that the scene has"
            )
        if spec.locked.any():
            raise ValueError(f"{label}: single axes of its nodes are fixed, which a reduced body cannot have")
        if any(weld.kind == "nodes" and weld.part == number for weld in scene.welds):
            raise ValueError(
                f"{label}: nodes of a reduced body cannot be attached to frames; fix them, or do not reduce"
            )
        on_it = {m.name: len(m.triangles) for m in scene.membranes if m.body == number}
        if set(on_it) != set(given.membrane_weight):
            raise ValueError(
                f"{label} has the membranes {sorted(on_it)} and its reduction was made with "
                f"{sorted(given.membrane_weight)}; train it with those of the scene"
            )
        for name, triangles in on_it.items():
            _check_weights(given.membrane_weight[name], triangles, f"{label}: weights of membrane {name!r}")


def _check_mesh(spec: BodySpec, reduction: Reduced, label: str) -> None:
    """Refuse a reduction of another mesh."""
    nodes, tets = np.asarray(reduction.nodes), np.asarray(reduction.tets)
    ours = spec.mesh
    if nodes.shape != ours.nodes.shape or tets.shape != ours.tets.shape:
        raise ValueError(
            f"{label}: the reduction belongs to a mesh of {len(nodes)} nodes and {len(tets)} tets, and this one has "
            f"{len(ours.nodes)} and {len(ours.tets)}; train it for this mesh"
        )
    size = np.ptp(ours.nodes, axis=0).max()
    if not np.array_equal(tets, ours.tets) or np.abs(nodes - ours.nodes).max() > 1e-6 * size:
        raise ValueError(
            f"{label}: the reduction belongs to another mesh of as many nodes and tets; train it for this one"
        )


def _check_weights(weight: FloatArray, count: int, name: str) -> None:
    """Refuse weights that are no weights."""
    if weight.shape != (count,) or not np.isfinite(weight).all() or (weight < 0.0).any():
        raise ValueError(checks.refusal(name, f"be {count} finite numbers from 0 on", weight))
    if not weight.any():
        raise ValueError(f"{name}: all are 0, so that nothing resists; train with a smaller tolerance")
