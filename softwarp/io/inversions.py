"""Where elements of soft bodies are inside out, for pictures and files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from softwarp import meshing
from softwarp.meshing.quadratic import point_corners

if TYPE_CHECKING:
    from softwarp.model.model import Model

Floats = NDArray[np.float64]


class InvertedElements:
    """Finds the elements of a model with J <= 0, a quadratic one if any of its Gauss points, a hexahedron by pieces."""

    def __init__(self, model: Model) -> None:
        self._tets = model.tet_node.numpy()
        if model.hexes is not None:
            self._tets = np.concatenate([self._tets, model.hexes.piece_node.numpy()])
        self._elements = np.zeros((0, 10), dtype=np.int32)
        if model.quadratic is not None:
            self._elements = model.quadratic.element_node.numpy()

    def __call__(self, node_x: NDArray[Any]) -> list[Floats]:
        """Centroids of the elements inside out [m], one array (inverted, 3) per world.

        Args:
            node_x: Positions of nodes [m], shape (world, node, 3).
        """
        return [self._of_one(x.astype(np.float64)) for x in node_x]

    def _of_one(self, x: Floats) -> Floats:
        tets = self._tets
        if len(tets):
            tets = tets[meshing.tet_volumes(x, tets) <= 0.0]
        folded = (_volumes(point_corners(x, self._elements)) <= 0.0).any(axis=1)
        return np.concatenate([x[tets].mean(axis=1), x[self._elements[folded, :4]].mean(axis=1)])


def padded(found: list[Floats]) -> NDArray[np.float32]:
    """Points of several worlds or frames as one array (n, most, 3), NaN for none."""
    points = np.full((len(found), max(map(len, found)), 3), np.nan, dtype=np.float32)
    for row, x in zip(points, found, strict=True):
        row[: len(x)] = x
    return points


def _volumes(corners: Floats) -> Floats:
    """Six times the signed volumes of tetrahedra of shape (..., 4, 3)."""
    edges = corners[..., 1:, :] - corners[..., :1, :]
    return np.asarray(np.linalg.det(edges))
