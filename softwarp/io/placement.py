"""Where the parts of a scene are: of one moment of a simulation, or of frames of a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from softwarp.io.inversions import InvertedElements, padded
from softwarp.io.parts import ChamberPoints

if TYPE_CHECKING:
    from softwarp.io.trajectory import Trajectory
    from softwarp.model.model import Model
    from softwarp.simulation import Simulation


@dataclass(kw_only=True)
class Placement:
    """Poses of rigid bodies, rods and chambers and their contacts; numpy or torch, None where there are none.

    Attributes:
        rigid_pose: Position [m] and quaternion x y z w, shape (n, rigid, 7).
        rod_x: Nodes of all rods in order [m], shape (n, rod_point, 3).
        rod_q: Quaternions x y z w of their sections, shape (n, rod_point, 4).
        cavity_x: Points of the chambers' surfaces [m], shape (n, cavity_point, 3).
        cavity_pressure: Gauge pressure [Pa], shape (n, cavity).
        contact_x: Contact points [m], NaN for none, shape (n, contact, 3).
        contact_force: Forces there [N], shape (n, contact, 3).
        inverted_x: Centroids of elements inside out [m], NaN for none, shape (n, inverted, 3).
    """

    rigid_pose: Any = None
    rod_x: Any = None
    rod_q: Any = None
    cavity_x: Any = None
    cavity_pressure: Any = None
    contact_x: Any = None
    contact_force: Any = None
    inverted_x: Any = None

    def part(self, chosen: Any) -> Placement:
        """Some of its worlds or frames."""
        given = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return Placement(**{name: None if value is None else value[chosen] for name, value in given.items()})

    def frame_pose(self) -> NDArray[np.float64] | None:
        """Poses of all rigid bodies, then of all rod nodes, shape (n, frame, 7); None if some are not known."""
        known = [array for array in (self.rigid_pose, self.rod_x, self.rod_q) if array is not None]
        if len(known) < 3:
            return None
        rigid, x, q = (np.asarray(a.detach().cpu() if hasattr(a, "detach") else a, dtype=np.float64) for a in known)
        return np.concatenate([rigid, np.concatenate([x, q], axis=-1)], axis=1)

    @classmethod
    def at_rest(cls, model: Model) -> Placement:
        """Where a model's parts start, n = 1."""
        placed = cls(cavity_x=ChamberPoints(model)(model.node_rest[None]))
        if model.frames is not None:
            rods = slice(model.rigid_count, model.rigid_count + model.rod_node_count)
            pose = model.frames.rest_pose[None]
            placed.rigid_pose = pose[:, : model.rigid_count]
            placed.rod_x, placed.rod_q = pose[:, rods, :3], pose[:, rods, 3:]
        return placed

    @classmethod
    def of_simulation(
        cls,
        sim: Simulation,
        chamber_points: ChamberPoints,
        worlds: Sequence[int],
        *,
        contacts: bool = False,
        inversions: bool = False,
    ) -> Placement:
        """Where the parts of some worlds are now."""
        chosen = list(worlds)
        placed = cls(rigid_pose=sim.body_pose[chosen], rod_x=sim.rod_x[chosen], rod_q=sim.rod_q[chosen])
        if sim.model.cavities is not None:
            placed.cavity_x = chamber_points(sim.node_x[chosen].cpu().numpy())
            placed.cavity_pressure = sim.cavity_pressure[chosen]
        if contacts and sim.model.contact is not None:
            there = sim.contact_pair[chosen] >= 0
            placed.contact_x = sim.contact_point[chosen].masked_fill(~there[..., None], np.nan)
            placed.contact_force = sim.contact_load[chosen]
        if inversions:
            placed.inverted_x = padded(InvertedElements(sim.model)(sim.node_x[chosen].cpu().numpy()))
        return placed

    @classmethod
    def of_trajectory(cls, trajectory: Trajectory, frames: Any, row: int) -> Placement:
        """Where the parts of one recorded world are in some frames."""
        names = [entry.name for entry in fields(cls)]
        given = {name: getattr(trajectory, name) for name in names}
        return cls(**{name: None if value is None else value[frames, row] for name, value in given.items()})
