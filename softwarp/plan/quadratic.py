"""From quadratic elements of the builder to their arrays. Host only."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from softwarp.meshing import quadratic
from softwarp.meshing.tets import rest_geometry
from softwarp.model.codes import TURNED
from softwarp.model.quadratic import QuadraticLayout
from softwarp.plan.structure import Slots, block_of

if TYPE_CHECKING:
    from softwarp.builder import ModelBuilder
    from softwarp.plan.ordering import Symbolic

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]
Arrays = dict[str, NDArray[Any]]
NODES, POINTS = quadratic.NODES, quadratic.POINTS


def quadratic_layout(builder: ModelBuilder, node_start: IntArray) -> QuadraticLayout:
    """Number the elements body after body."""
    found = [(i, b.mesh.nodes, b.elements) for i, b in enumerate(builder.bodies) if b.elements is not None]
    nodes, products = [np.empty((0, NODES), dtype=np.int32)], [np.empty((0, NODES, NODES))]
    for i, x, elements in found:
        nodes.append(elements + node_start[i])
        products.append(quadratic.shape_products(x, elements))
    body = np.repeat([i for i, _, _ in found], [len(part) for part in nodes[1:]]).astype(np.int32)
    laws = np.array([spec.material.kernel_law for spec in builder.bodies], dtype=object)
    together = np.concatenate(products)
    return QuadraticLayout(
        nodes=np.concatenate(nodes).astype(np.int32),
        body=body,
        laws=laws[body] if len(body) else np.empty(0, dtype=object),
        products=together,
        lumped=quadratic.lumped(together),
    )


def element_kinds(layout: QuadraticLayout) -> dict[str, tuple[IntArray, NDArray[Any]]]:
    """Corners and numbers of the elements by how their stiffness is kept."""
    is_turned = np.isin(layout.laws, TURNED)
    return {
        f"quadratic{name}": (layout.nodes[chosen], np.flatnonzero(chosen))
        for name, chosen in (("large", is_turned), ("stored", ~is_turned))
        if len(layout.nodes)
    }


def point_arrays(layout: QuadraticLayout, nodes: FloatArray) -> Arrays:
    """The linear tetrahedra at the Gauss points."""
    corners = quadratic.point_corners(nodes, layout.nodes).reshape(-1, 3)
    tets = np.arange(len(corners), dtype=np.int32).reshape(-1, 4)
    gradient, volume, frame = rest_geometry(corners, tets)
    return {
        "element_node": layout.nodes,
        "point_tet": tets,
        "point_body": np.repeat(layout.body, POINTS),
        "point_gradient": gradient,
        "point_volume": volume / POINTS,
        "point_frame": frame,
    }


def entry_arrays(arrays: Arrays, blocks: int) -> Arrays:
    """Lists of the element blocks in every block of A, from those of ``structure_plan``, which are taken out."""
    result: Arrays = {}
    for kind in ("large", "stored"):
        start = arrays.pop(f"quadratic{kind}_entry_start", np.zeros(blocks + 1, dtype=np.int32))
        entry = arrays.pop(f"quadratic{kind}_entry", np.empty(0, dtype=np.int32))
        if kind == "large":
            element, pair = np.divmod(entry, NODES * NODES)
            points = POINTS * element[:, None] + np.arange(POINTS)
            result["large_entry_start"] = POINTS * start
            result["large_entry"] = (256 * points + (16 * (pair // NODES) + pair % NODES)[:, None]).ravel()
        else:
            rows, codes, weights = at_corners(entry)
            result["stored_entry_start"] = _counted(start, rows)
            result |= {"stored_entry": codes, "stored_weight": weights}
    return result


def carried_arrays(arrays: Arrays) -> None:
    """Turn the lists of elements with carried nodes into those of the points' corners, in place."""
    for kind in ("quadraticlarge", "quadraticstored"):
        name = f"{kind}_carried"
        if f"{name}_entry" in arrays:
            entry = arrays[f"{name}_entry"]
            rows, codes, weights = at_corners(entry[:, 0])
            arrays[f"{name}_entry"] = np.column_stack([codes, entry[rows, 1:]])
            arrays[f"{name}_start"], arrays[f"{name}_weight"] = _counted(arrays[f"{name}_start"], rows), weights
        name = f"{kind}_held"
        if f"{name}_entry" in arrays:
            element, node = np.divmod(arrays[f"{name}_entry"], NODES)
            share = quadratic.gradient_weights().reshape(POINTS * 4, NODES).T[node]
            rows, part = np.nonzero(share)
            arrays[f"{name}_entry"] = (POINTS * 4 * element[rows] + part).astype(np.int32)
            arrays[f"{name}_start"] = _counted(arrays[f"{name}_start"], rows)
            arrays[f"{name}_weight"] = share[rows, part]


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


def inertia_arrays(layout: QuadraticLayout, symbolic: Symbolic, slots: Slots, node_count: int) -> Arrays:
    """Consistent less lumped mass per density: on blocks of A, by rows, and what gravity finds of it at every node.

    Elements with nodes that frames carry keep their lumped mass.
    """
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
    return {
        "weight_node": loaded,
        "weight_volume": weight[loaded],
        "mass_block": block_of(symbolic, row[lower], column[lower]),
        "mass_body": body[node[row[lower]]],
        "mass_volume": total[lower],
        "mass_row": rows,
        "mass_row_start": np.append(start, len(column)),
        "mass_row_body": body[node[rows]],
        "mass_column": column,
        "mass_column_node": node[column],
        "mass_column_volume": total,
    }
