"""Forces of the single elements of a body, which its reduction chooses from."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from softwarp import diagnostics
from softwarp.meshing import quadratic
from softwarp.reduction import contact
from softwarp.simulation import Simulation

FloatArray = NDArray[np.float64]


class Elements:
    """Linear tets of a body, and triangles of the membranes on it.

    Args:
        sim: The full model.
        number: Body.
        nodes: Its nodes.

    Attributes:
        tets: Nodes of its linear tets, counted in the body, (tet, 4).
        thin: Triangles of every membrane on it by name: their numbers, and their nodes, (triangle, 3).
    """

    def __init__(self, sim: Simulation, number: int, nodes: slice) -> None:
        model = sim.model
        self.sim, self.nodes = sim, nodes
        self.systems = [system for _, system in sim.make_systems(0)]
        self.own = np.flatnonzero(model.tet_body.numpy() == number)
        self.tets = model.tet_corners[self.own] - nodes.start
        self.thin: dict[str, tuple[NDArray[Any], NDArray[Any]]] = {}
        m = model.membranes
        if m is not None:
            member = m.tri_membrane.numpy()
            for k, name in enumerate(m.names):
                if int(m.body[k]) == number:
                    triangles = np.flatnonzero(member == k)
                    self.thin[name] = (triangles, m.triangles[triangles] - nodes.start)

    @property
    def at_rest(self) -> FloatArray:
        """Nodes at rest [m], (node, 3)."""
        return np.asarray(self.sim.model.node_rest[self.nodes])

    @property
    def corners(self) -> NDArray[Any]:
        """Nodes of what has forces of its own in ``whole``, (element, corner)."""
        return np.asarray(self.tets)

    def at(self, positions: FloatArray) -> Iterator[list[FloatArray]]:
        """Forces of the tets, and of every membrane's triangles, at one state after the other, (element, 3 corners).

        Args:
            positions: Of the body's nodes [m], (state, node, 3).
        """
        tets = 12 * self.sim.model.tet_count
        for row in self._rows(positions):
            yield [row[:tets].reshape(-1, 12)[self.own], *self._thin(row[tets:])]

    def whole(self, positions: FloatArray) -> Iterator[list[FloatArray]]:
        """Likewise, of elements with the nodes ``corners``."""
        return self.at(positions)

    def stiffness(self) -> Any:
        """That of all of them at rest, as SciPy CSC [N/m]."""
        K: Any = 0.0
        for kind, corners in enumerate((self.corners, *(c for _, c in self.thin.values()))):

            def forces(x: FloatArray, kind: int = kind) -> FloatArray:
                return np.stack([parts[kind] for parts in self.whole(x)])

            K = K + contact.stiffness(forces, self.at_rest, corners)
        return K.tocsc()

    def tables(self, modes: FloatArray) -> list[NDArray[np.float32]]:
        """Displacements in every mode where ``at`` has forces, of every kind, (element, mode, 3 corners)."""
        return [_table(modes[:, corners]) for corners in (self.tets, *(c for _, c in self.thin.values()))]

    def _thin(self, rows: FloatArray) -> list[FloatArray]:
        """Forces of the membranes' triangles."""
        triangles = 12 * (0 if self.sim.model.membranes is None else len(self.sim.model.membranes.triangles))
        thin = rows[:triangles].reshape(-1, 12)
        return [thin[numbers, :9] for numbers, _ in self.thin.values()]

    def _rows(self, positions: FloatArray, points: bool = False) -> Iterator[FloatArray]:
        """Forces of all elements, or those at their Gauss points, at one state after the other, (row,)."""
        sim = self.sim
        worlds = sim.model.num_worlds
        evaluate = diagnostics.point_forces if points else diagnostics.element_forces
        for begin in range(0, len(positions), worlds):
            now = positions[begin : begin + worlds]
            sim.node_x.copy_(torch.as_tensor(sim.model.node_rest))
            sim.node_x[: len(now), self.nodes] = torch.as_tensor(now).to(sim.node_x)
            yield from evaluate(self.systems).double().cpu().numpy()[: len(now)]


class QuadraticElements(Elements):
    """Quadratic tets of a body, whose Gauss points are elements to choose from; no membranes beside them.

    Attributes:
        tets: Eight linear tets between the nodes of every element, which say what mesh it is.
    """

    def __init__(self, sim: Simulation, number: int, nodes: slice) -> None:
        super().__init__(sim, number, nodes)
        model = sim.model.quadratic
        assert model is not None
        self.own = np.flatnonzero(model.layout.body == number)
        self.ten = model.layout.nodes[self.own] - nodes.start
        self.tets = quadratic.split(self.at_rest, self.ten)
        self.thin = {}

    @property
    def corners(self) -> NDArray[Any]:
        """Nodes of the elements, (element, 10)."""
        return np.asarray(self.ten)

    def at(self, positions: FloatArray) -> Iterator[list[FloatArray]]:
        """Forces at the corners of the tets of the Gauss points, (4 element, 12)."""
        for row in self._rows(positions, points=True):
            yield [row.reshape(-1, quadratic.POINTS, 12)[self.own].reshape(-1, 12)]

    def whole(self, positions: FloatArray) -> Iterator[list[FloatArray]]:
        """Forces of the ten nodes of every element, (element, 30)."""
        model = self.sim.model.quadratic
        assert model is not None
        first = 3 * quadratic.NODES * model.count
        for row in self._rows(positions):
            yield [row[-first:].reshape(-1, 3 * quadratic.NODES)[self.own]]

    def tables(self, modes: FloatArray) -> list[NDArray[np.float32]]:
        """Displacements of the corners of the Gauss points' tets in every mode."""
        weights, found = quadratic.corner_weights(), []
        for part in np.array_split(self.ten, 1 + len(self.ten) // 500):
            at = np.einsum("qka,mpac->mpqkc", weights, modes[:, part], optimize=True)
            found.append(_table(at.reshape(len(modes), -1, 4, 3)))
        return [np.concatenate(found)]


def elements_of(sim: Simulation, number: int, nodes: slice) -> Elements:
    """Elements of a body, of the order that it has."""
    linear = bool((sim.model.tet_body.numpy() == number).any())
    return (Elements if linear else QuadraticElements)(sim, number, nodes)


def _table(displacements: FloatArray) -> NDArray[np.float32]:
    """From (mode, element, corner, 3) to (element, mode, 3 corners)."""
    table = np.moveaxis(displacements, 0, 1)
    return np.ascontiguousarray(table.reshape(*table.shape[:2], -1), dtype=np.float32)
