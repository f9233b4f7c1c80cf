"""Surfaces coloured by a number per triangle, in a browser whose meshes have one colour each.

The triangles of each of a dozen colours are one mesh. A mesh keeps the room it once needed, filled with triangles
without area, so that vertices and faces that arrive one after the other always fit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.io import colormap

Floats = NDArray[np.float64]

COLORS = 12
_LEAST = 64  # triangles that a mesh has room for


class Painted:
    """Triangles in the colours of a scale.

    Args:
        server: A ``viser.ViserServer``.
        name: Of the meshes.
    """

    def __init__(self, server: Any, name: str) -> None:
        middle = (np.arange(COLORS) + 0.5) / COLORS
        shades = np.round(255.0 * colormap.colors(middle, 0.0, 1.0)).astype(int)
        self._room = [_LEAST] * COLORS
        self.handles = [
            server.scene.add_mesh_simple(
                f"/{name}/{number}",
                np.zeros((3 * _LEAST, 3), dtype=np.float32),
                np.arange(3 * _LEAST, dtype=np.uint32).reshape(-1, 3),
                color=tuple(int(v) for v in shade),
                side="double",
                flat_shading=True,
                visible=False,
            )
            for number, shade in enumerate(shades)
        ]

    def show(self, corners: Any, values: Any, limit: float) -> None:
        """Draw triangles.

        Args:
            corners: Their corners [m], shape (tri, 3, 3).
            values: A number each, shape (tri,); what is not finite counts as 0.
            limit: Value of the last colour; the first one is that of 0.
        """
        part = np.nan_to_num(np.asarray(values, dtype=np.float64)) / max(limit, 1e-30)
        color = np.clip((COLORS * part).astype(int), 0, COLORS - 1)
        for number, handle in enumerate(self.handles):
            mine = np.asarray(corners)[color == number]
            handle.visible = bool(len(mine))
            if not len(mine):
                continue
            has_grown = len(mine) > self._room[number]
            while len(mine) > self._room[number]:
                self._room[number] *= 2
            vertices = np.repeat(mine[:1, :1], self._room[number], axis=0).repeat(3, axis=1)
            vertices[: len(mine)] = mine
            handle.vertices = vertices.reshape(-1, 3).astype(np.float32)
            if has_grown:
                handle.faces = np.arange(3 * self._room[number], dtype=np.uint32).reshape(-1, 3)

    def hide(self) -> None:
        """Show nothing."""
        for handle in self.handles:
            handle.visible = False


def surface_strain(rest: Any, now: Any) -> Floats:
    """Largest principal Green-Lagrange strain in the plane of triangles, by magnitude, shape (..., tri).

    With edges e of a triangle at rest and f now, the metrics are A = e e' and B = f f', and the strain has the
    eigenvalues of (inv(A) B - 1) / 2.

    Args:
        rest: Corners at rest [m], shape (tri, 3, 3).
        now: Corners [m], shape (..., tri, 3, 3).
    """

    def metric(corners: Any) -> Floats:
        x = np.asarray(corners, dtype=np.float64)
        edges = x[..., 1:, :] - x[..., :1, :]
        return np.asarray(edges @ np.swapaxes(edges, -1, -2))

    at_rest = metric(rest)
    flat = np.linalg.det(at_rest) <= 0.0
    at_rest[flat] = np.eye(2)
    mixed = np.linalg.solve(np.broadcast_to(at_rest, metric(now).shape), metric(now))
    half_trace = 0.5 * (mixed[..., 0, 0] + mixed[..., 1, 1])
    root = np.sqrt(np.maximum(half_trace**2 - np.linalg.det(mixed), 0.0))
    largest = np.maximum(np.abs(half_trace + root - 1.0), np.abs(half_trace - root - 1.0)) / 2.0
    return np.asarray(np.where(flat, 0.0, largest))
