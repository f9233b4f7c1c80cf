"""Floating frames of reduced bodies at rest, and the arrays of what turns. Theory: docs/theory/reduction.md."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from softwarp.model.floating import RIGID, FloatingModel
from softwarp.plan.structure import ModeBlocks, Points

FloatArray = NDArray[np.float64]
BLOCK = 3  # modes
TURNING = slice(3, RIGID)  # rigid modes that turn
LEFT = 1e-6  # of a mode: what must be left without rigid motion and the modes before it


@dataclass(frozen=True)
class Frame:
    """Where the frame of one body is at rest: centre of mass [m], (3,); radius of gyration [m]; mass per density."""

    centre: FloatArray
    radius: float
    volume: float


class Body(Protocol):
    """What is read of a reduced body, as ``plan.reduction`` has it."""

    @property
    def number(self) -> int:
        """Among reduced bodies."""

    @property
    def body(self) -> int:
        """Among soft bodies."""

    @property
    def first(self) -> int:
        """First mode."""

    @property
    def modes(self) -> FloatArray:
        """Places at rest and displacements, (mode, node, 3)."""

    @property
    def first_node(self) -> int:
        """First node."""

    @property
    def frame(self) -> Frame | None:
        """Floating frame; None for a fixed one."""

    @property
    def count(self) -> int:
        """Modes, up to a multiple of three."""

    @property
    def stride(self) -> int:
        """Modes, up to a multiple of 16."""


def floating_frame(nodes: FloatArray, volume: FloatArray, modes: FloatArray, label: str) -> tuple[Frame, FloatArray]:
    """Frame of a body, and its modes behind six rigid ones, free of rigid motion and orthonormal in mass.

    Args:
        nodes: At rest [m], (node, 3).
        volume: Mass per density of the nodes [m^3], (node,).
        modes: Of deformation, (mode, node, 3).
        label: The body's, for messages.

    Returns:
        The frame, and (6 + mode, node, 3): places at rest in the first, which the state turns, none in five more.

    Raises:
        ValueError: For a mode that is a rigid motion or repeats others.
    """
    whole = float(volume.sum())
    share = np.sqrt(volume / whole)[:, None]
    centre = (volume @ nodes) / whole
    place = nodes - centre
    moves = [np.broadcast_to(axis, place.shape) for axis in np.eye(3)] + [np.cross(axis, place) for axis in np.eye(3)]
    done = np.linalg.qr(np.array([(share * move).ravel() for move in moves]).T)[0].T
    flat = (share * modes).reshape(len(modes), -1)
    for k, row in enumerate(flat):
        size = float(np.linalg.norm(row))
        for _ in range(2):
            row = row - (done @ row) @ done
        left = float(np.linalg.norm(row))
        if not left > LEFT * size:
            raise ValueError(
                f"{label}: mode {k} is a rigid motion or a combination of other modes; a floating frame moves the "
                "body rigidly itself, so train the reduction with frame='floating'"
            )
        done = np.concatenate([done, row[None] / left])
    clean = done[RIGID:].reshape(modes.shape) / share
    frame = Frame(centre, float(np.sqrt((volume @ (place**2).sum(axis=1)) / whole)), whole)
    return frame, np.concatenate([place[None], np.zeros((RIGID - 1, *place.shape)), clean])


def floating_model(
    bodies: Sequence[Body],
    node_volume: FloatArray,
    modes: ModeBlocks,
    points: Points,
    touching: NDArray[Any],
    arrays: Mapping[str, Any],
) -> FloatingModel | None:
    """All bodies with a floating frame; None without any.

    Args:
        bodies: Reduced ones.
        node_volume: Mass per density of all nodes [m^3].
        modes: Their blocks.
        points: Of rows of multipliers.
        touching: Nodes of reduced bodies that may touch something.
        arrays: Those of ``ReductionModel`` by name.
    """
    own = [(b, b.frame) for b in bodies if b.frame is not None]
    if not own:
        return None
    number = np.full(len(bodies) + 1, -1, dtype=np.int32)  # the last one of nodes that no body has
    number[[b.number for b, _ in own]] = np.arange(len(own))
    wide = np.concatenate([[0], np.cumsum([b.stride for b in bodies])])
    strides = np.array([b.stride for b, _ in own])
    listed = [np.flatnonzero(arrays["node_body"] == b.number) for b, _ in own]
    touch_body = number[modes.node_body[touching]]
    ranges = [np.flatnonzero(touch_body == f) for f in range(len(own))]
    moments = [_moments(b, node_volume) for b, _ in own]
    first = np.concatenate([[0], np.cumsum([m.size for m in moments])])
    of = np.repeat(np.arange(len(own)), strides)
    start = np.cumsum(strides) - strides
    row_body = number[arrays["row_body"]]
    carrier = np.append(modes.node_body, -1)[np.where(points.point_weight != 0.0, points.point_node, -1)]
    return FloatingModel(
        count=len(own),
        body=np.array([b.body for b, _ in own]),
        number=np.array([b.number for b, _ in own]),
        first=np.array([b.first for b, _ in own]),
        modes=np.array([b.count for b, _ in own]),
        first_wide=np.array([wide[b.number] for b, _ in own]),
        block=np.array([modes.start[b.number] for b, _ in own]),
        centre=np.array([f.centre for _, f in own]),
        radius=np.array([f.radius for _, f in own]),
        volume=np.array([f.volume for _, f in own]),
        listed_start=np.concatenate([[0], np.cumsum([len(part) for part in listed])]),
        listed=np.concatenate(listed),
        listed_body=np.repeat(np.arange(len(own)), [len(part) for part in listed]),
        touch=np.flatnonzero(touch_body >= 0),
        touch_range=np.array([(r[0], r[-1] + 1) if r.size else (0, 0) for r in ranges]),
        touch_body=touch_body,
        touch_node=touching,
        moment_start=start,
        moment_body=of,
        moment_first=first[of] + 9 * strides[of] * (np.arange(len(of)) - start[of]),
        moment_wide=np.array([wide[b.number] for b, _ in own])[of],
        moment_stride=strides[of],
        moments=np.concatenate([m.ravel() for m in moments]),
        **_pairs(own, modes, arrays),
        tet_body=np.repeat(number[:-1], np.diff(arrays["tet_samples"])),
        tri_body=np.repeat(number[:-1], np.diff(arrays["tri_samples"])),
        point_body=number[carrier].max(axis=1, initial=-1),
        row=np.flatnonzero(row_body >= 0),
        row_body=row_body[row_body >= 0],
    )


def _moments(b: Body, node_volume: FloatArray) -> FloatArray:
    """Sums of volume phi_l phi_k', (mode k, 3, 3, stride of l); zero for what fills a stride."""
    volume = node_volume[b.first_node :][: b.modes.shape[1]]
    found = np.zeros((b.stride, 3, 3, b.stride))
    flat = b.modes.transpose(1, 0, 2).reshape(len(volume), -1)  # (node, 3 mode)
    sums = (flat.T @ (volume[:, None] * flat)).reshape(b.count, 3, b.count, 3)  # (l, c, k, d)
    found[: b.count, :, :, : b.count] = sums.transpose(2, 1, 3, 0)
    return found


def _pairs(own: Sequence[tuple[Body, Any]], modes: ModeBlocks, arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Pairs of blocks whose mass the state changes: of what turns a body with itself, and with its modes."""
    pair, body, mode = [], [], []
    row, col = arrays["pair_row"], arrays["pair_col"]
    for f, (b, _) in enumerate(own):
        turns = int(modes.start[b.number]) + TURNING.start // BLOCK
        found = np.flatnonzero((col == turns) & (row >= turns))
        pair.append(found)
        body.append(np.full(len(found), f))
        mode.append(BLOCK * (row[found] - modes.start[b.number]))
    return {"pair": np.concatenate(pair), "pair_body": np.concatenate(body), "pair_mode": np.concatenate(mode)}
