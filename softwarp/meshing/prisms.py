"""Prisms of structured meshes cut into tetrahedra, so that neighbours cut their common face alike.

Every node has a rank. A quadrangle is cut by the diagonal from its corner of lowest rank, a side of a prism by the
diagonal from the lower rank below to the higher one above. With ranks that mirror images share, and the two ends of an
edge do not, meshes are as symmetric as their outline.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from softwarp.meshing.tets import IntArray


def split_quads(quads: Iterable[tuple[int, int, int, int]], rank: NDArray[np.int64]) -> NDArray[np.int64]:
    """Two triangles of each quadrangle, on both sides of the diagonal from its corner of lowest rank."""
    triangles = []
    for quad in quads:
        first = min(range(4), key=lambda corner: rank[quad[corner]])
        a, b, c, d = (quad[(first + n) % 4] for n in range(4))
        triangles += [(a, b, c), (a, c, d)]
    return np.array(triangles)


def cut_prisms(triangles: NDArray[np.int64], rank: NDArray[np.int64], nodes: NDArray[np.int64]) -> IntArray:
    """Three tetrahedra per triangle between two layers of nodes.

    Args:
        triangles: Corners, places in a layer, shape (tri, 3).
        rank: Rank of every place, shape (place,).
        nodes: Nodes of the lower layer, then those of the upper one, shape (2 place,).
    """
    low, high = nodes.reshape(2, -1)
    order = np.take_along_axis(triangles, np.argsort(rank[triangles], axis=1), axis=1)
    (a, b, c), (d, e, f) = low[order].T, high[order].T
    tets = [(a, b, c, f), (a, b, e, f), (a, d, e, f)]
    return np.concatenate([np.stack(corners, axis=1) for corners in tets]).astype(np.int32)
