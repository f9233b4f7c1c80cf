"""From quadratic elements of a scene to their arrays. Host only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.meshing import quadratic
from softwarp.meshing.tets import rest_geometry
from softwarp.model.codes import TURNED
from softwarp.model.quadratic import QuadraticLayout, QuadraticModel
from softwarp.model.structure import GatherLists
from softwarp.plan.structure import Elements, Structure, block_of
from softwarp.scene.parts import Scene

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]
NODES, POINTS = quadratic.NODES, quadratic.POINTS


def quadratic_layout(scene: Scene, node_start: IntArray) -> QuadraticLayout:
    """Number the elements body after body."""
    found = [(i, b.mesh.nodes, b.elements) for i, b in enumerate(scene.bodies) if b.elements is not None]
    nodes, products = [np.empty((0, NODES), dtype=np.int32)], [np.empty((0, NODES, NODES))]
    stiffness = [np.empty((0, POINTS))]
    for i, x, elements in found:
        nodes.append(elements + node_start[i])
        products.append(quadratic.shape_products(x, elements))
        given = scene.bodies[i].stiffness
        stiffness.append(np.ones((len(elements), POINTS)) if given is None else given)
    body = np.repeat([i for i, _, _ in found], [len(part) for part in nodes[1:]]).astype(np.int32)
    laws = np.array([spec.material.kernel_law for spec in scene.bodies], dtype=object)
    together = np.concatenate(products)
    return QuadraticLayout(
        nodes=np.concatenate(nodes).astype(np.int32),
        body=body,
        laws=laws[body] if len(body) else np.empty(0, dtype=object),
        products=together,
        lumped=quadratic.lumped(together),
        stiffness=np.concatenate(stiffness),
    )


def by_law(laws: NDArray[Any]) -> dict[str, IntArray]:
    """Indices of the elements of every kernel law."""
    return {str(law): np.flatnonzero(laws == law).astype(np.int32) for law in np.unique(laws)}


def quadratic_elements(layout: QuadraticLayout) -> list[Elements]:
    """Elements by how their stiffness is kept; nothing without any."""
    if len(layout.nodes) == 0:
        return []
    is_turned = np.isin(layout.laws, TURNED)
    return [
        Elements("quadraticlarge", layout.nodes[is_turned], np.flatnonzero(is_turned)),
        Elements("quadraticstored", layout.nodes[~is_turned], np.flatnonzero(~is_turned)),
    ]


def quadratic_model(layout: QuadraticLayout, nodes: FloatArray, found: Structure) -> QuadraticModel | None:
    """Elements and the linear tetrahedra at their Gauss points; None without any."""
    if len(layout.nodes) == 0:
        return None
    corners = quadratic.point_corners(nodes, layout.nodes).reshape(-1, 3)
    tets = np.arange(len(corners), dtype=np.int32).reshape(-1, 4)
    gradient, volume, frame = rest_geometry(corners, tets)
    return QuadraticModel(
        layout=layout,
        law_points=by_law(np.repeat(layout.laws, POINTS)),
        element_node=layout.nodes,
        point_tet=tets,
        point_body=np.repeat(layout.body, POINTS),
        point_gradient=gradient,
        point_volume=layout.stiffness.ravel() * volume / POINTS,
        point_size=volume,
        point_frame=frame,
        **vars(entry_lists(found)),
        **vars(inertia_lists(layout, found, len(nodes))),
    )


@dataclass(frozen=True)
class EntryLists:
    """Where element blocks go, under the names that ``QuadraticModel`` declares."""

    large_entry_start: IntArray
    large_entry: IntArray
    stored_entry_start: IntArray
    stored_entry: IntArray
    stored_weight: FloatArray


def entry_lists(found: Structure) -> EntryLists:
    """Points' blocks in every block of A, from the blocks of elements."""
    large, stored = found.lists["quadraticlarge"], found.lists["quadraticstored"]
    element, pair = np.divmod(large.entry, NODES * NODES)
    rows, codes, weights = at_corners(stored.entry)
    return EntryLists(
        large_entry_start=large.start,
        large_entry=256 * element + 16 * (pair // NODES) + pair % NODES,
        stored_entry_start=_counted(stored.start, rows),
        stored_entry=codes,
        stored_weight=weights,
    )


def carried_blocks(elements: GatherLists) -> GatherLists:
    """Blocks of A with elements that frames carry nodes of, with the blocks of the points' corners as entries."""
    rows, codes, weights = at_corners(elements.entry[:, 0])
    entry = np.column_stack([codes, elements.entry[rows, 1:]])
    return GatherLists(elements.target, _counted(elements.start, rows), entry, weights)


def held_nodes(elements: GatherLists) -> GatherLists:
    """Carried nodes with the corners of points as entries."""
    element, node = np.divmod(elements.entry, NODES)
    share = quadratic.gradient_weights().reshape(POINTS * 4, NODES).T[node]
    rows, part = np.nonzero(share)
    entry = (POINTS * 4 * element[rows] + part).astype(np.int32)
    return GatherLists(elements.target, _counted(elements.start, rows), entry, share[rows, part])


def _counted(start: NDArray[Any], rows: NDArray[Any]) -> IntArray:
    """Ranges after every entry has become several; ``rows`` is the ascending number of the entry of each."""
    return np.searchsorted(rows, start).astype(np.int32)


def at_corners(entry: NDArray[Any]) -> tuple[NDArray[Any], IntArray, FloatArray]:
    """Number of the entry, code 16 point + 4 k + m and weight of all parts of element blocks 100 element + 10 a + b."""
    D = quadratic.gradient_weights()  # (q, k, a)
    weight = np.einsum("qka,qmb->abqkm", D, D).reshape(NODES * NODES, -1)
    used = np.einsum("ka,mb->abkm", *2 * [(D != 0.0).any(axis=0)])  # the same corners at all points
    used = np.repeat(used[:, :, None], POINTS, axis=2).reshape(NODES * NODES, -1)
    q, k, m = np.unravel_index(np.arange(POINTS * 16), (POINTS, 4, 4))
    element, pair = np.divmod(np.asarray(entry, dtype=np.int64), NODES * NODES)
    row, part = np.nonzero(used[pair])
    code = 16 * (POINTS * element[row] + q[part]) + 4 * k[part] + m[part]
    return row, code.astype(np.int32), weight[pair[row], part]


@dataclass(frozen=True)
class InertiaLists:
    """Consistent less lumped mass, under the names that ``QuadraticModel`` declares."""

    weight_node: IntArray
    weight_volume: FloatArray
    mass_body: IntArray
    mass_volume: FloatArray
    mass_row: NDArray[Any]
    mass_row_start: NDArray[Any]
    mass_row_body: IntArray
    mass_column: NDArray[Any]
    mass_column_node: NDArray[Any]
    mass_column_volume: FloatArray


def inertia_lists(layout: QuadraticLayout, found: Structure, node_count: int) -> InertiaLists:
    """Consistent less lumped mass per density: on blocks of A, by rows, and what gravity finds of it at every node.

    Elements with nodes that frames carry keep their lumped mass.
    """
    symbolic, slots = found.symbolic, found.slots
    keep = ~slots.borrowed[layout.nodes].any(axis=1)
    nodes, more = layout.nodes[keep], layout.products[keep].copy()
    local = np.arange(NODES)
    more[:, local, local] -= layout.lumped[keep]
    weight = np.bincount(nodes.ravel(), more.sum(axis=2).ravel(), minlength=node_count)
    loaded = np.unique(nodes)
    body = np.zeros(node_count, dtype=np.int32)
    body[layout.nodes] = layout.body[:, None]

    dof = slots.unknown[nodes]
    i, j = np.repeat(dof, NODES, axis=1).ravel(), np.tile(dof, (1, NODES)).ravel()
    value = more.reshape(-1)
    free = (i >= 0) & (j >= 0)
    key, inverse = np.unique(i[free] * max(symbolic.size, 1) + j[free], return_inverse=True)
    total = np.bincount(inverse.ravel(), value[free], minlength=key.size)
    row, column = np.divmod(key, max(symbolic.size, 1))
    lower = row >= column
    rows, start = np.unique(row, return_index=True)
    node = slots.slot[symbolic.order]
    block = block_of(symbolic, row[lower], column[lower])
    block_body = np.zeros(len(symbolic.a_row), dtype=np.int32)
    block_body[block] = body[node[row[lower]]]
    block_volume = np.zeros(len(symbolic.a_row))
    block_volume[block] = total[lower]
    return InertiaLists(
        weight_node=loaded,
        weight_volume=weight[loaded].astype(np.float64),
        mass_body=block_body,
        mass_volume=block_volume,
        mass_row=rows,
        mass_row_start=np.append(start, len(column)),
        mass_row_body=body[node[rows]],
        mass_column=column,
        mass_column_node=node[column],
        mass_column_volume=total.astype(np.float64),
    )
