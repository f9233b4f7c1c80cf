"""Surfaces coloured by a number per triangle, in a browser whose meshes have one colour each.

The triangles of each of a dozen colours are one mesh. A mesh keeps the room it once needed, filled with triangles
without area, so that vertices and faces that arrive one after the other always fit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softwarp.io import colormap, palette

Floats = NDArray[np.float64]

COLORS = 12
UNITS = {"stress": "Pa", "strain": "", "contact": "Pa"}  # what triangles are coloured by
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


class Arrows:
    """Contact forces: an arrow each, made with the first force that there is.

    Args:
        server: A ``viser.ViserServer``.
        size: Of the scene [m].
    """

    def __init__(self, server: Any, size: float) -> None:
        self._server, self._size = server, size
        self.handle: Any = None

    def show(self, at: Any, force: Any, strongest: float) -> None:
        """Draw forces; those that are not finite are left out, as are those too weak to have a head.

        Args:
            at: Where they act on the stage [m], shape (..., 3).
            force: Forces [N], shape (..., 3).
            strongest: Force whose arrow is ``palette.ARROW_LENGTH`` sizes of the scene long [N].
        """
        at, force = np.asarray(at, dtype=np.float64), np.asarray(force, dtype=np.float64)
        radius = palette.ARROW_RADIUS * self._size
        vector = force * (palette.ARROW_LENGTH * self._size / (strongest or 1.0))
        length = np.linalg.norm(np.nan_to_num(vector), axis=-1)
        there = np.isfinite(at).all(axis=-1) & np.isfinite(force).all(axis=-1) & (length > 2.0 * radius)
        excess = np.maximum(length[there] / (palette.ARROW_EXCESS * palette.ARROW_LENGTH * self._size), 1.0)
        ends = np.stack([at[there], at[there] + vector[there] / excess[:, None]], axis=1).astype(np.float32)
        if self.handle is None:
            if not len(ends):
                return
            color = tuple(round(255.0 * float(v)) for v in palette.FORCE)
            shape = {"shaft_radius": radius, "head_radius": 2.5 * radius, "head_length": 5.0 * radius}
            self.handle = self._server.scene.add_arrows("/contact forces", ends, color, **shape)
        self.handle.visible = bool(len(ends))
        if len(ends):
            self.handle.points = ends

    def hide(self) -> None:
        """Show none."""
        if self.handle is not None:
            self.handle.visible = False


class ContactPressure:
    """Contact forces spread over the surfaces that they press on.

    Every force goes to the nearest vertex of each closed surface that it touches, and over that vertex' share of the
    surface: the sum of pressure times area of a surface's triangles is the sum of the forces' magnitudes.

    Args:
        triangles: Vertex indices, shape (tri, 3).
    """

    def __init__(self, triangles: Any) -> None:
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        tri = np.asarray(triangles, dtype=np.int64)
        self._vertices, self._tri = np.unique(tri, return_inverse=True)
        self._tri = self._tri.reshape(tri.shape)
        count = len(self._vertices)
        edge = np.concatenate([self._tri[:, [0, 1]], self._tri[:, [1, 2]]])
        graph = coo_array((np.ones(len(edge)), (edge[:, 0], edge[:, 1])), shape=(count, count))
        surfaces, of_vertex = connected_components(graph, directed=False)
        self._surfaces = [np.flatnonzero(of_vertex == number) for number in range(surfaces)]

    def __call__(self, x: Any, at: Any, force: Any) -> Floats:
        """Pressure on every triangle [Pa], shape (tri,).

        Args:
            x: All vertices [m], shape (vertex, 3).
            at: Contact points [m], NaN for none, shape (contact, 3).
            force: Forces there [N], shape (contact, 3).
        """
        x = np.asarray(x, dtype=np.float64)[self._vertices]
        at, size = np.asarray(at, dtype=np.float64), np.linalg.norm(np.asarray(force, dtype=np.float64), axis=-1)
        there = np.isfinite(at).all(axis=-1) & np.isfinite(size)
        at, size = at[there], size[there]
        a, b, c = (x[self._tri[:, corner]] for corner in range(3))
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1)
        longest = np.maximum(np.linalg.norm(b - a, axis=-1), np.linalg.norm(c - b, axis=-1))
        share, reach, load = np.zeros(len(x)), np.zeros(len(x)), np.zeros(len(x))
        for corner in range(3):
            np.add.at(share, self._tri[:, corner], area / 3.0)
            np.maximum.at(reach, self._tri[:, corner], longest)
        if len(at):
            for mine in self._surfaces:
                away, nearest = cKDTree(x[mine]).query(at)
                near = away <= reach[mine][nearest]
                np.add.at(load, mine[nearest[near]], size[near])
        pressure = np.divide(load, share, out=np.zeros(len(x)), where=share > 0.0)
        return np.asarray(pressure[self._tri].mean(axis=1))
