"""Imbalance and exact tangent of frames at rest, for equilibria of rods and bodies. Theory: docs/theory/adjoint.md.

With velocities 0 the adjoint of a step is a product with the transposed tangent of the forces r = f_ext - f + H' T,

    gradient by poses = h (dr/dx)' p,   by parameters and commands likewise,

exact in what the matrix of a step leaves out: cables' stiffness by tension, levers that turn. As a frame's forces
depend on few others, one product tells the rows of many frames at once.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from softwarp.model.gradients import Gradients
from softwarp.model.model import Model
from softwarp.solvers.adjoint import StepAdjoint
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.system import System


class FrameTangent(StepAdjoint):
    """Imbalance and products with the transposed tangent, of the worlds of one system.

    Args:
        system: Worlds, whose velocities are 0.
        h: Step [s].
        gradients: Arrays of these worlds, written.
        index: Of the model.

    Attributes:
        imbalance: Receives -h r of all dofs.
    """

    def __init__(self, system: System, h: float, gradients: Gradients, index: AdjointIndex) -> None:
        super().__init__(system, h, gradients, index)
        self.imbalance, self.nothing = (self.shard.rows(3 * self.model.dof_count) for _ in range(2))

    def measure(self) -> None:
        """Imbalance of all dofs where the state is, by the velocities that it would lead to: -h r = -A v."""
        s, m, w = self.shard, self.model, self.shard.work
        self.solve_again()
        inputs = [m.neighbour_start, m.neighbour, m.neighbour_block, w.a.S, self.nothing.S, w.dof_v.S]
        s.each(self.system.k.residual, m.dof_count, inputs, [self.imbalance.S])
        w.dof_v.zero()
        if m.row_count:
            self.find_activity()

    def correct(self) -> None:
        """Add to ``p`` what A answers to ``imbalance`` with; needs ``measure``."""
        y = self.system.linear.y
        y.zero()
        self.shard.add(self.imbalance, y, self.shard.dof_rows)
        self.system.linear.forward(1)
        self.add_solution()

    def multiply(self) -> None:
        """Products with ``p``: h p . dr by poses; needs ``measure``."""
        self._pull(parameters=False)

    def multiply_all(self) -> None:
        """By commands and parameters, too."""
        self._pull(parameters=True)

    def _pull(self, *, parameters: bool) -> None:
        assert self.frames is not None
        for rows in (self.q, self.force, self.measured):
            rows.zero()
        for rows in (self.frames.start, self.frames.moved, self.frames.bare, self.frames.share):
            rows.zero()
        if parameters:
            self.to_commands()
        self.to_start(parameters=parameters)


def neighbours_of(model: Model) -> NDArray[np.bool_]:
    """Whether the forces on a frame depend on where another one is, (frame, frame): by segments and cables.

    The force of a cable on a point depends on the points before and behind it, which do not feel each other.
    """
    frames = model.frames
    assert frames is not None
    near = np.eye(frames.count, dtype=bool)
    for pair in frames.master[frames.segment_frames]:
        near[np.ix_(pair, pair)] = True
    start, carrier = model.cable_point_start_device.numpy(), frames.node_frame.numpy()
    node, weight = model.point_node.numpy().reshape(-1, 4), model.point_weight.numpy().reshape(-1, 4)
    for begin, end in itertools.pairwise(start):
        held = [carrier[node[k][(weight[k] != 0.0) & (node[k] >= 0)]] for k in range(begin, end)]
        held = [frame[frame >= 0] for frame in held]
        for k, pulled in enumerate(held):
            around = np.concatenate(held[max(k - 1, 0) : k + 2])
            near[np.ix_(pulled, around)] = near[np.ix_(around, pulled)] = True
    return near


def groups_of(masters: list[int], near: NDArray[np.bool_]) -> list[list[int]]:
    """Masters by groups whose forces depend on different ones each, so that one product tells the rows of all."""
    reach = near.astype(np.int32) @ near > 0
    groups: list[list[int]] = []
    for frame in masters:
        fitting = [group for group in groups if not reach[frame, group].any()]
        if fitting:
            fitting[0].append(frame)
        else:
            groups.append([frame])
    return groups
