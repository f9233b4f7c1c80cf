"""What the adjoint of a step needs to know of a scene's structure, on the device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from softwarp.kernels.elements.laws import LAWS
from softwarp.model.model import Model


@dataclass(frozen=True)
class AdjointIndex:
    """Which tets a body has, which points a node carries, and what row a point belongs to; on the device.

    Attributes:
        body_node_start: Ranges of nodes.
        body_tets: Ranges and indices of linear tets.
        body_points: Of Gauss points of quadratic ones.
        body_hexes: Of hexahedra.
        law_count: Parameters of a body's law of its own.
        node_heft: Volume whose weight a node bears [m^3].
        node_point_start, node_point, node_point_weight: Points of rows.
        point_row: Rows of these.
        row_pair: Pairs of rows, each once.
    """

    body_node_start: wp.array
    body_tets: tuple[wp.array, wp.array]
    body_points: tuple[wp.array, wp.array]
    body_hexes: tuple[wp.array, wp.array]
    law_count: wp.array
    node_heft: wp.array
    node_point_start: wp.array
    node_point: wp.array
    node_point_weight: wp.array
    point_row: wp.array
    row_pair: wp.array

    @classmethod
    def of(cls, model: Model) -> AdjointIndex:
        """From a model."""
        laws = _body_laws(model)
        tets = _by(model.tet_body.numpy(), model.body_count)
        quadratic, heft = model.quadratic, model.node_heft.numpy().copy()
        points = np.zeros(0, dtype=np.int64)
        hexes = np.zeros(0, dtype=np.int32) if model.hexes is None else model.hexes.layout.body
        if quadratic is not None:
            points = quadratic.point_body.numpy()
            np.add.at(heft, quadratic.weight_node.numpy(), quadratic.weight_volume.numpy())
        nodes, weights = model.point_node.numpy(), model.point_weight.numpy()
        point, slot = np.nonzero(nodes >= 0)
        point_start, order = _by(nodes[point, slot], model.node_count)
        owner = [*np.repeat(np.arange(model.cable_count), np.diff(model.cable_starts))]
        if model.cavities is not None:
            owner += [*(model.first_row("cavity") + model.cavities.point_cavity.numpy())]

        def send(values: Any, dtype: Any = wp.int32) -> wp.array:
            return wp.array(np.asarray(values), dtype=dtype, device=model.device)

        return cls(
            body_node_start=send(model.body_node_start),
            body_tets=(send(tets[0]), send(tets[1])),
            body_points=tuple(send(part) for part in _by(points, model.body_count)),
            body_hexes=tuple(send(part) for part in _by(hexes, model.body_count)),
            law_count=send([LAWS[law].own if law in LAWS else 0 for law in laws]),
            node_heft=send(heft, model.node_heft.dtype),
            node_point_start=send(point_start),
            node_point=send(point[order]),
            node_point_weight=send(weights[point, slot][order], model.point_weight.dtype),
            point_row=send(owner),
            row_pair=send(np.argwhere(np.tri(model.row_count, dtype=bool)).reshape(-1, 2)),
        )


def _by(owner: np.ndarray[Any, Any], count: int) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Ranges by owner, and the items in that order."""
    start = np.concatenate([[0], np.cumsum(np.bincount(owner, minlength=count))])
    return start, np.argsort(owner, kind="stable")


def _body_laws(model: Model) -> list[str]:
    """Kernel law of every soft body."""
    laws, held = [""] * model.body_count, [(model.law_tets, model.tet_body)]
    if model.quadratic is not None:
        held.append((model.quadratic.law_points, model.quadratic.point_body))
    for law_tets, tet_body in held:
        for law, tets in law_tets.items():
            for body in np.unique(tet_body.numpy()[tets.numpy()]):
                laws[body] = law
    return laws
