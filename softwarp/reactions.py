"""Forces that hold what is fixed or moved as commanded. Equations: docs/theory/reaction.md."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp import interop
from softwarp.diagnostics import by_world, plain_variant
from softwarp.kernels.rows import reaction
from softwarp.model.fields import allocate
from softwarp.model.handles import RigidBody
from softwarp.model.model import Model
from softwarp.model.state import State
from softwarp.solvers.system import System
from softwarp.solvers.workspace.rows import Rows
from softwarp.threads import alone

if TYPE_CHECKING:
    import torch

IntArray = NDArray[np.int32]


@dataclass(frozen=True)
class Reactions:
    """Forces that supports and carriers exert on the scene, in world axes; zero where motion is free.

    Attributes:
        node: On fixed nodes of soft bodies, along locked axes only where single axes are [N], (world, node, 3).
        body: On rigid bodies that are kinematic or have axes that are not free, with all that they carry: force [N] and
            moment about the body's origin [N m], (world, rigid body, 6).
        rod: Likewise on clamped rod nodes, about them, (world, rod node, 6).
    """

    node: torch.Tensor
    body: torch.Tensor
    rod: torch.Tensor

    def total(self) -> torch.Tensor:
        """Sum of all forces [N], shape (world, 3)."""
        result: torch.Tensor = self.node.sum(dim=1) + self.body[..., :3].sum(dim=1) + self.rod[..., :3].sum(dim=1)
        return result


@dataclass(frozen=True)
class _Held:
    """Nodes without unknowns, and which rows pull at them by which points."""

    node: IntArray  # (held,)
    start: IntArray  # (held + 1,) ranges of what follows
    point: IntArray
    row: IntArray
    weight: NDArray[np.float64]


class ReactionMeter:
    """Measures reactions in the workspaces of the systems that step some worlds; allocates once.

    Args:
        model: Scene.
        systems: Systems of all worlds, in their order; later ones may be others with the same worlds.
    """

    @alone
    def __init__(self, model: Model, systems: Sequence[System]) -> None:
        import torch

        self.model, self.variant = model, plain_variant(model)
        device, real = model.device, self.variant.real
        held = _held(model)
        self._lists = [_array(values, device, wp.int32) for values in (held.node, held.start, held.point, held.row)]
        self._lists.append(_array(held.weight, device, real))
        self._held = [system.shard.rows(max(3 * len(held.node), 1)) for system in systems]
        self._everything = wp.full((max(model.dof_count, 1), 3), 1.0, dtype=real, device=device)
        torch_device = wp.device_to_torch(device)
        self._held_node = torch.as_tensor(held.node, dtype=torch.int64, device=torch_device)
        free = wp.to_torch(model.dof_free)
        dof = wp.to_torch(model.node_dof)[: model.node_count].long()
        self._node_dof = dof.clamp(min=0)
        self._node_share = torch.where(dof[:, None] >= 0, 1.0 - free[self._node_dof], torch.zeros_like(free[:1]))
        self._wrench, self._pair_frame = None, None
        if model.frames is None:
            return
        is_master = model.frames.master == np.arange(model.frame_count)
        own = torch.as_tensor(is_master, device=torch_device).to(free)
        self._frame_dof = wp.to_torch(model.frames.frame_dof).long()
        self._frame_share = ((1.0 - free[self._frame_dof]).unflatten(0, (-1, 2)) * own[:, None, None]).flatten(1)
        if model.contact is not None:
            parts = [[int(part) if isinstance(part, RigidBody) else -1 for part in ab] for ab in model.contact.parts]
            self._pair_frame = wp.array(np.array(parts, dtype=np.int32), dtype=wp.int32, device=device)
            self._wrench = allocate(model.num_worlds, 6 * model.frame_count, real, device)

    @alone
    def measure(self, systems: Sequence[System], state: State) -> Reactions:
        """Reactions at the present positions, in the workspaces of the systems of all worlds, which may be one."""
        import torch

        m = self.model
        with interop.on_torch_stream(m.device):
            found = [self._evaluate(system, out) for system, out in zip(systems, self._held, strict=True)]
            if self._wrench is not None and m.frames is not None:
                inputs = [m.frames.frame_master, self._pair_frame, state.frame_pose]
                inputs += [state.contact_pair, state.contact_point, state.contact_load]
                kernel, dim = reaction.kernels(self.variant).contact_wrenches, (m.num_worlds, m.frame_count)
                wp.launch(kernel, self.variant.dim(*dim), inputs, [self._wrench], device=m.device)
        unheld, held = (torch.cat(parts) for parts in zip(*found, strict=True))
        node = 0.0 - unheld[:, self._node_dof] * self._node_share
        node = torch.index_copy(node, 1, self._held_node, held)
        none = node.new_zeros(m.num_worlds, 0, 6)
        if m.frames is None:
            return Reactions(node, none, none)
        load = unheld[:, self._frame_dof].unflatten(1, (-1, 2)).flatten(2)
        if self._wrench is not None:
            load = load + wp.to_torch(self._wrench).unflatten(1, (-1, 6))
        frame = 0.0 - load * self._frame_share
        rigid, rods = m.rigid_count, m.rod_node_count
        return Reactions(node, frame[:, :rigid], frame[:, rigid : rigid + rods])

    def _evaluate(self, system: System, out: Rows) -> tuple[torch.Tensor, torch.Tensor]:
        """Loads on unknowns and on held nodes, (world, dof, 3) and (world, held, 3)."""
        w, s = system.work, system.shard
        system.unheld_forces(self._everything)
        inputs = [*self._lists, w.node_internal.S, w.node_external.S, w.point_gradient.S, w.multiplier.S]
        s.each(reaction.kernels(s.variant).held_nodes, len(self._held_node), inputs, [out.S])
        unheld, held = by_world(system, w.b, 3 * self.model.dof_count), by_world(system, out, 3 * len(self._held_node))
        return unheld.unflatten(1, (self.model.dof_count, 3)), held.unflatten(1, (len(self._held_node), 3))


def _held(model: Model) -> _Held:
    """Fixed nodes that no frame carries; cables come before chambers among points and rows."""
    is_held = model.node_fixed.copy()
    if model.frames is not None:
        is_held &= model.frames.node_frame.numpy() < 0
    held = np.flatnonzero(is_held[: model.body_node_count])
    place = np.full(model.node_count, -1)
    place[held] = np.arange(len(held))
    count = np.diff(model.cable_starts)
    if model.cavities is not None:
        count = np.concatenate([count, np.diff(model.cavities.starts)])
    point_row = np.repeat(np.arange(len(count)), count)
    carrier = model.point_node.numpy().reshape(-1, 4)
    item = np.where(carrier >= 0, place[carrier], -1)
    point, k = np.nonzero(item >= 0)
    order = np.argsort(item[point, k], kind="stable")
    point, k = point[order], k[order]
    return _Held(
        node=held.astype(np.int32),
        start=np.searchsorted(item[point, k], np.arange(len(held) + 1)).astype(np.int32),
        point=point.astype(np.int32),
        row=point_row[point].astype(np.int32),
        weight=model.point_weight.numpy().reshape(-1, 4)[point, k].astype(np.float64),
    )


def _array(values: Any, device: str, dtype: Any) -> wp.array:
    """On a device, at least one entry long."""
    whole = values if len(values) else np.zeros(1)
    return wp.array(np.ascontiguousarray(whole, dtype=wp.dtype_to_numpy(dtype)), dtype=dtype, device=device)
