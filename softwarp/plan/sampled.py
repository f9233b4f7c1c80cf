"""Reduced bodies of quadratic elements: the Gauss points that count, as linear tets. Host only.

Each Gauss point of a quadratic element is a linear tetrahedron whose corners are sums of the ten nodes (kernels of
quadratic elements, docs/theory/quadratic.md). Node by node these corners are found anew in every step; of a body that
moves in modes they have modes of their own, the same sums of those of the nodes, and so are nodes like others: without
mass, behind the body's own. Half as large, which changes no gradient, the tetrahedra lie inside their elements, so that
no corner stands where the body's surface is looked for. Everything else of a reduced body then is as with linear tets.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.meshing import quadratic
from softwarp.scene.parts import BodySpec, PointTets, Scene


def with_points(scene: Scene) -> Scene:
    """The scene with linear tets in place of the quadratic elements of reduced bodies; as it is without such."""
    if not any(_is_sampled(body) for body in scene.bodies):
        return scene
    return replace(scene, bodies=[_sampled(body) if _is_sampled(body) else body for body in scene.bodies])


def _is_sampled(body: BodySpec) -> bool:
    return body.elements is not None and body.reduction is not None


def _sampled(body: BodySpec) -> BodySpec:
    """The body with a tet for every Gauss point whose weight is not 0."""
    given, elements, x = body.reduction, body.elements, body.mesh.nodes
    assert given is not None and elements is not None
    chosen = np.flatnonzero(given.tet_weight)
    element, point = np.divmod(chosen, quadratic.POINTS)
    weights, around = quadratic.inner_weights()[point], elements[element]
    corners = np.einsum("pka,pac->pkc", weights, x[around]).reshape(-1, 3)
    modes = np.einsum("pka,mpac->mpkc", weights, given.modes[:, around], optimize=True)
    more = len(corners)
    products = quadratic.shape_products(x, elements)
    lumped = quadratic.lumped(products).ravel()
    volume = np.bincount(elements.ravel(), lumped, minlength=len(x) + more).astype(np.float64)
    tets = (len(x) + np.arange(more)).astype(np.int32).reshape(-1, 4)
    return replace(
        body,
        elements=None,
        points=PointTets(corners, tets, volume, _inertia(elements, products, len(x) + more)),
        fixed=np.pad(body.fixed, (0, more)),
        locked=np.pad(body.locked, ((0, more), (0, 0))),
        load=np.pad(body.load, ((0, more), (0, 0))),
        reduction=replace(
            given,
            modes=np.concatenate([given.modes, modes.reshape(len(modes), -1, 3)], axis=1),
            tet_weight=given.tet_weight[chosen] / (quadratic.POINTS * quadratic.INNER**3),
        ),
    )


def _inertia(elements: NDArray[np.int32], products: NDArray[np.float64], count: int) -> Any:
    """Integrals of products of shape functions over the body, (node, node)."""
    from scipy.sparse import coo_array

    row, col = np.broadcast_arrays(elements[:, :, None], elements[:, None, :])
    return coo_array((products.ravel(), (row.ravel(), col.ravel())), shape=(count, count)).tocsr()
