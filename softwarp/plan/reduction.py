"""From reduced bodies of a scene to their arrays. Host only. Theory: docs/theory/reduction.md."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.model.codes import TURNED
from softwarp.model.floating import RIGID
from softwarp.model.reduction import ReductionModel
from softwarp.plan.cavities import MembraneLayout
from softwarp.plan.contact import outer_skin
from softwarp.plan.floating import TURNING, Frame, floating_frame, floating_model
from softwarp.plan.patches import chunks
from softwarp.plan.soft import SoftArrays, SoftLayout
from softwarp.plan.structure import ModeBlocks, Points, Structure, block_of
from softwarp.remembered import Remembered
from softwarp.scene.parts import ReductionSpec, Scene

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]
BLOCK = 3  # modes
TET, TRI = 5, 4  # numbers of an element of a chunk: itself, and its corners
_masses: Remembered[FloatArray] = Remembered(4)
LANE = 16  # numbers that registers of a CPU hold; strides are multiples of it


def _up(count: int, unit: int) -> int:
    return -(-count // unit) * unit


def _reduced(scene: Scene) -> list[tuple[int, ReductionSpec]]:
    """Reduced bodies with what they were given."""
    return [(i, b.reduction) for i, b in enumerate(scene.bodies) if b.reduction is not None]


def mode_blocks(scene: Scene, node_start: IntArray, node_count: int) -> ModeBlocks | None:
    """Blocks of modes before the elimination order is known; None without reduced bodies."""
    found = _reduced(scene)
    if not found:
        return None
    node_body = np.full(node_count, -1, dtype=np.int32)
    for number, (body, _) in enumerate(found):
        node_body[node_start[body] : node_start[body + 1]] = number
    blocks = [_up(given.count, BLOCK) // BLOCK for _, given in found]
    return ModeBlocks(
        node_body=node_body,
        start=np.concatenate([[0], np.cumsum(blocks)]).astype(np.int32),
        centre=np.array([scene.bodies[body].mesh.nodes.mean(axis=0) for body, _ in found]),
    )


def touch_dofs(scene: Scene, soft: SoftLayout, node_dof: IntArray, dof_count: int) -> IntArray:
    """Dofs of nodes as contacts see them: those of reduced bodies have places for velocities behind all dofs."""
    result = node_dof.copy()
    touching = _touching(scene, soft)
    result[touching] = dof_count + np.arange(len(touching))
    return result


def _touching(scene: Scene, soft: SoftLayout) -> NDArray[Any]:
    """Nodes of reduced bodies that a contact may find, ascending; none in scenes without contact."""
    parts = {int(part): part for pair in scene.pairs for part in (pair.a, pair.b) if part.kind == "soft body"}
    chosen = [np.empty(0, dtype=np.int64)]
    for body, _ in _reduced(scene):
        if body not in parts:
            continue
        spec, start = scene.bodies[body], soft.node_start[body]
        skin = spec.contact_surface
        if skin is None:
            chosen.append(start + np.unique(outer_skin(scene, parts[body])))
        else:
            chosen.append(start + np.unique(skin.node[skin.weight != 0.0]))
    nodes = np.unique(np.concatenate(chosen))
    return nodes[~soft.fixed[nodes]]


@dataclass(frozen=True)
class _Body:
    """One reduced body, its modes filled up to a multiple of three."""

    number: int
    body: int
    first: int  # mode
    modes: FloatArray  # (mode, node, 3); of rigid ones of a floating frame only places at rest, in the first
    first_node: int
    frame: Frame | None
    inertia: Any = None  # (node, node) consistent mass per density of quadratic elements; None for lumped mass

    @property
    def count(self) -> int:
        return len(self.modes)

    @property
    def stride(self) -> int:
        return _up(self.count, LANE)

    @property
    def moving(self) -> FloatArray:
        """Modes without what stands at rigid ones of a floating frame."""
        if self.frame is None:
            return self.modes
        return np.concatenate([np.zeros_like(self.modes[:RIGID]), self.modes[RIGID:]])

    def heft(self, volume: FloatArray) -> FloatArray:
        """What gravity pulls at in every mode per density, (mode, 3)."""
        own = self._lumped(volume) if self.inertia is None else self.inertia.sum(axis=1)
        return np.asarray(np.einsum("knc,n->kc", self.moving, own))

    def mass(self, volume: FloatArray) -> FloatArray:
        """Mass per density of the modes, (mode, mode)."""
        if self.inertia is None:
            u, own = self.moving, self._lumped(volume)
            return _masses(lambda: np.einsum("inc,n,jnc->ij", u, own, u, optimize=True), u, own).copy()
        return np.asarray(sum(u @ (self.inertia @ u.T) for u in np.moveaxis(self.moving, 2, 0)))

    def volume(self, volume: FloatArray) -> float:
        """Of the body [m^3]."""
        return float(self._lumped(volume).sum())

    def _lumped(self, volume: FloatArray) -> FloatArray:
        return volume[self.first_node :][: self.modes.shape[1]]

    def corners(self, nodes: IntArray) -> FloatArray:
        """Displacements of later corners of elements against their first ones, (element, 3 (corners - 1), stride)."""
        local = nodes - self.first_node
        modes = self.moving
        relative = modes[:, local[:, 1:]] - modes[:, local[:, :1]]  # (mode, element, corner, 3)
        result = np.moveaxis(relative, 0, -1).reshape(len(nodes), 3 * (nodes.shape[1] - 1), self.count)
        return np.pad(result, ((0, 0), (0, 0), (0, self.stride - self.count)))

    def rows(self, modes: FloatArray) -> FloatArray:
        """Modes at some points, (mode, point, 3), as (point, component, stride)."""
        return np.pad(np.moveaxis(modes, 0, -1), ((0, 0), (0, 0), (0, self.stride - self.count)))


def _body(
    scene: Scene, number: int, body: int, given: ReductionSpec, first: int, first_node: int, arrays: SoftArrays
) -> _Body:
    modes, frame = given.modes, None
    if given.floating:
        spec = scene.bodies[body]
        volume = arrays.node_volume[first_node : first_node + len(spec.mesh.nodes)]
        frame, modes = floating_frame(spec.mesh.nodes, volume, modes, f"body {spec.name!r}")
    modes = np.pad(modes, ((0, -len(modes) % BLOCK), (0, 0), (0, 0)))
    points = scene.bodies[body].points
    return _Body(number, body, first, modes, first_node, frame, None if points is None else points.inertia)


def reduction_model(
    scene: Scene,
    soft: SoftLayout,
    arrays: SoftArrays,
    membranes: MembraneLayout,
    points: Points,
    row_starts: IntArray,
    modes: ModeBlocks | None,
    found: Structure,
    touch_dof: IntArray,
) -> ReductionModel | None:
    """All reduced bodies; None without any."""
    if modes is None:
        return None
    bodies = [
        _body(scene, number, body, given, BLOCK * int(modes.start[number]), int(soft.node_start[body]), arrays)
        for number, (body, given) in enumerate(_reduced(scene))
    ]
    slots = found.slots
    mode_dof = slots.unknown[slots.first_mode + np.arange(modes.count)]
    by_block = np.repeat(np.arange(len(bodies)), np.diff(modes.start))
    stride = np.array([b.stride for b in bodies], dtype=np.int32)
    wide = np.concatenate([[0], np.cumsum(stride)])
    touching = np.flatnonzero((modes.node_body >= 0) & (touch_dof >= found.symbolic.size))
    mode_wide = np.concatenate([wide[b.number] + np.arange(b.count) for b in bodies])
    wide_mode = np.full(int(wide[-1]), -1)
    wide_mode[mode_wide] = np.arange(len(mode_wide))
    for b in bodies:
        if b.frame is not None:
            wide_mode[wide[b.number] :][:RIGID] = -1  # ``floating`` has them
    nodes = _nodes(bodies, soft, membranes, points, touching, by_block, modes, mode_dof)
    pairs = _pairs(bodies, arrays.node_volume, mode_dof, modes, found)
    samples = _samples(bodies, soft, membranes, modes) | _chunks(bodies, soft, membranes, modes)
    rows = _rows(bodies, points, row_starts, mode_dof, modes, found)
    parts = {**nodes, **pairs, **samples, **rows}
    return ReductionModel(
        body=np.array([b.body for b in bodies], dtype=np.int32),
        start=(BLOCK * modes.start).astype(np.int32),
        modes=np.array([given.count for _, given in _reduced(scene)], dtype=np.int32),
        stride=stride,
        mode_dof=mode_dof,
        block_body=np.array([bodies[k].body for k in by_block]),
        block_first=np.array([bodies[k].first for k in by_block]),
        block_modes=np.array([bodies[k].count for k in by_block]),
        heft=np.concatenate([b.heft(arrays.node_volume) for b in bodies]),
        mode_wide=mode_wide,
        wide_mode=wide_mode,
        wide_body=np.repeat(np.arange(len(bodies)), stride),
        body_number=np.array([b.body for b in bodies]),
        body_begin=np.array([b.first_node for b in bodies]),
        body_end=np.array([b.first_node + b.modes.shape[1] for b in bodies]),
        body_modes=np.array([b.count for b in bodies]),
        body_stride=stride,
        body_wide=wide[:-1],
        floating=floating_model(bodies, arrays.node_volume, modes, points, touching, parts),
        **parts,
    )


def _nodes(
    bodies: list[_Body],
    soft: SoftLayout,
    membranes: MembraneLayout,
    points: Points,
    touching: NDArray[Any],
    by_block: NDArray[Any],
    modes: ModeBlocks,
    mode_dof: NDArray[Any],
) -> dict[str, Any]:
    """Nodes with their modes, those that a step needs within it first; which of them may touch something."""
    is_active = np.zeros(len(soft.nodes) + 1, dtype=bool)
    is_active[soft.tets] = is_active[membranes.triangles] = is_active[touching] = True
    is_active[points.point_node[points.point_weight != 0.0]] = True
    nodes = np.flatnonzero(modes.node_body >= 0)
    nodes = np.concatenate([nodes[is_active[nodes]], nodes[~is_active[nodes]]])
    of = modes.node_body[nodes]
    parts = [b.rows(b.modes) for b in bodies]
    basis = [parts[b][n - bodies[b].first_node].ravel() for n, b in zip(nodes, of, strict=True)]
    start, basis = _kept(basis)
    place = np.full(len(soft.nodes), -1)
    place[nodes] = np.arange(len(nodes))
    order = np.argsort(of, kind="stable")
    touched = modes.node_body[touching]
    ends = [np.flatnonzero(touched == k) for k in by_block]
    for block, k in enumerate(by_block):
        if bodies[k].frame is not None and block < modes.start[k] + RIGID // BLOCK:
            ends[block] = ends[block][:0]
    rest = soft.nodes[nodes].copy()
    rest[[bodies[k].frame is not None for k in of]] = 0.0  # their bases have it
    first_dof = [int(mode_dof[modes.start[b.number] : modes.start[b.number + 1]].min()) for b in bodies]
    return {
        "active_count": int(is_active[nodes].sum()),
        "node": nodes,
        "node_body": of,
        "node_rest": rest,
        "node_basis": start,
        "basis": np.concatenate(basis),
        "order": order,
        "body_node": np.searchsorted(of[order], np.arange(len(bodies) + 1)),
        "touch_listed": place[touching],
        "touch_first": np.array([first_dof[k] for k in touched], dtype=np.int32),
        "touch_begin": modes.start[touched],
        "touch_end": modes.start[touched + 1],
        "touch_stride": np.array([bodies[k].stride for k in touched], dtype=np.int32),
        "touch_basis": start[place[touching]],
        "block_touch": np.array([(t[0], t[-1] + 1) if t.size else (0, 0) for t in ends]),
    }


def _kept(basis: list[FloatArray]) -> tuple[NDArray[Any], list[FloatArray]]:
    """Where the modes of nodes start, and those that are kept: nodes that no mode moves share one place of zeros."""
    rests = np.array([not part.any() for part in basis])
    size = np.where(rests, 0, [part.size for part in basis])
    start = np.cumsum(size) - size
    start[rests] = size.sum()
    zeros = max((part.size for part, at_rest in zip(basis, rests, strict=True) if at_rest), default=0)
    return start, [part for part, at_rest in zip(basis, rests, strict=True) if not at_rest] + [np.zeros(zeros)]


def _pairs(
    bodies: list[_Body], node_volume: FloatArray, mode_dof: NDArray[Any], modes: ModeBlocks, found: Structure
) -> dict[str, Any]:
    """Blocks of A that modes share: where they are, their mass per density, and where their stiffness is summed."""
    rows, cols, volumes, places, strides, whole = [], [], [], [], [], []
    first_pair = 0
    for b in bodies:
        mass = b.mass(node_volume)
        filler = np.flatnonzero(np.abs(b.moving).max(axis=(1, 2)) == 0.0)
        mass[filler, filler] = b.volume(node_volume)  # modes that only fill the last block rest
        if b.frame is not None:
            mass[TURNING, TURNING] = 0.0  # what the state changes
        low, high = np.tril_indices(b.count // BLOCK)
        blocks = mass.reshape(b.count // BLOCK, BLOCK, -1, BLOCK).transpose(0, 2, 1, 3)
        rows.append(modes.start[b.number] + low)
        cols.append(modes.start[b.number] + high)
        volumes.append(blocks[low, high].reshape(-1, 9))
        places.append(first_pair + BLOCK * (low * b.stride + high))
        strides.append(np.full(len(low), b.stride))
        whole.append(mass.ravel())
        first_pair += b.stride**2
    row, col = np.concatenate(rows), np.concatenate(cols)
    size = np.array([m.size for m in whole])
    block_volume = [
        start + BLOCK * b.count * np.arange(b.count // BLOCK)
        for start, b in zip(np.cumsum(size) - size, bodies, strict=True)
    ]
    i, j = mode_dof[row], mode_dof[col]
    block = block_of(found.symbolic, np.maximum(i, j), np.minimum(i, j))
    return {
        "pair_block": 2 * block + (i < j),
        "pair_row": row,
        "pair_col": col,
        "pair_volume": np.concatenate(volumes),
        "pair_stiffness": np.concatenate(places),
        "pair_stride": np.concatenate(strides),
        "block_volume": np.concatenate(block_volume),
        "volume": np.concatenate(whole),
    }


def _elements(
    bodies: list[_Body], soft: SoftLayout, membranes: MembraneLayout, modes: ModeBlocks
) -> tuple[list[NDArray[Any]], list[NDArray[Any]]]:
    """Tets and membrane triangles of every body."""
    member = modes.node_body[membranes.triangles[:, 0]] if len(membranes.triangles) else np.empty(0, dtype=np.int32)
    tets = [np.flatnonzero(soft.tet_body == b.body) for b in bodies]
    return tets, [np.flatnonzero(member == b.number) for b in bodies]


def _chunks(bodies: list[_Body], soft: SoftLayout, membranes: MembraneLayout, modes: ModeBlocks) -> dict[str, Any]:
    """The same elements by the nodes that they share, for a CPU."""
    bounds, rows, places = [0], [], []
    basis: list[FloatArray] = [np.empty(0)]
    lists: tuple[list[NDArray[Any]], ...] = ([np.empty((0, TET), dtype=np.int64)], [np.empty((0, TRI), dtype=np.int64)])
    ends: tuple[list[int], ...] = ([0], [0])
    done = [0, 0]  # elements of the bodies before
    for b, tets, tris in zip(bodies, *_elements(bodies, soft, membranes, modes), strict=True):
        at = b.rows(b.moving)
        for chunk in chunks((soft.tets[tets], membranes.triangles[tris].reshape(-1, TRI - 1))):
            places.append(sum(part.size for part in basis))
            modes_there = at[chunk.node - b.first_node] - at[chunk.against - b.first_node]
            basis.append(np.concatenate([modes_there.ravel(), np.zeros(3 * b.stride)]))
            rows.append(3 * len(chunk.node))
            for kind in range(2):
                own = chunk.elements[kind] + done[kind]
                lists[kind].append(np.column_stack([own, chunk.corners[kind]]))
                ends[kind].append(ends[kind][-1] + len(own))
        bounds.append(len(rows))
        done = [done[0] + len(tets), done[1] + len(tris)]
    size = (3 * (TET - 2)) ** 2 * np.diff(ends[0]) + (3 * (TRI - 2)) ** 2 * np.diff(ends[1])
    return {
        "chunk_room": int(size.max(initial=0)),
        "body_chunk": np.array(bounds),
        "chunk_rows": np.array(rows, dtype=np.int64),
        "chunk_basis": np.array(places, dtype=np.int64),
        "chunk_tets": np.array(ends[0]),
        "chunk_tris": np.array(ends[1]),
        "tet_list": np.concatenate(lists[0]).ravel(),
        "tri_list": np.concatenate(lists[1]).ravel(),
        "chunk_modes": np.concatenate(basis),
    }


def _samples(bodies: list[_Body], soft: SoftLayout, membranes: MembraneLayout, modes: ModeBlocks) -> dict[str, Any]:
    """Elements that count, body after body."""
    tets, tris = _elements(bodies, soft, membranes, modes)
    result: dict[str, Any] = {"tet_turned": np.isin(soft.laws[np.concatenate(tets)], TURNED).astype(np.int32)}
    for kind, chosen, corners in (("tet", tets, soft.tets), ("tri", tris, membranes.triangles)):
        count = np.array([len(c) for c in chosen])
        basis = [b.corners(corners[c]).ravel() for b, c in zip(bodies, chosen, strict=True)]
        size = np.array([part.size for part in basis])
        each = np.repeat(size // np.maximum(count, 1), count)
        starts = np.concatenate([[0], np.cumsum(count)]).astype(np.int32)
        result |= {
            f"{kind}_samples": starts,
            f"body_{kind}s": starts,
            f"body_{kind}_basis": np.cumsum(size) - size,
            f"{kind}_sample": np.concatenate(chosen),
            f"{kind}_stride": np.repeat([b.stride for b in bodies], count),
            f"{kind}_first": np.cumsum(each) - each,
            f"{kind}_basis": np.concatenate([np.empty(0), *basis]),
        }
    return result


def _rows(
    bodies: list[_Body],
    points: Points,
    row_starts: IntArray,
    mode_dof: NDArray[Any],
    modes: ModeBlocks,
    found: Structure,
) -> dict[str, Any]:
    """Rows of H that act on modes: displacements at their points, and the entries that belong to modes."""
    block_of_dof = np.full(found.symbolic.size, -1)
    block_of_dof[mode_dof] = np.arange(modes.count)
    block = block_of_dof[found.rows.entry_dof]
    entry = np.flatnonzero(block >= 0)
    row, block = found.rows.entry_row[entry], block[entry]
    body = np.searchsorted(modes.start, block, side="right") - 1
    pairs, which = np.unique(np.stack([row, body], axis=1).reshape(-1, 2), axis=0, return_inverse=True)
    basis: list[FloatArray] = [np.empty(0)]
    for r, k in pairs:
        b, span = bodies[k], slice(row_starts[r], row_starts[r + 1])
        node, weight = points.point_node[span], points.point_weight[span]
        share = np.where((node >= 0) & (modes.node_body[node] == k), weight, 0.0)
        local = np.where(share != 0.0, node - b.first_node, 0)
        basis.append(b.rows(np.einsum("kpic,pi->kpc", b.modes[:, local], share, optimize=True)).ravel())
    size = np.array([part.size for part in basis[1:]], dtype=np.int64)
    stride = np.array([bodies[k].stride for k in pairs[:, 1]], dtype=np.int64)
    wide = np.cumsum(stride) - stride
    return {
        "row_body": pairs[:, 1],
        "row_point": row_starts[pairs[:, 0]],
        "row_points": row_starts[pairs[:, 0] + 1] - row_starts[pairs[:, 0]],
        "row_basis": np.cumsum(size) - size,
        "row_wide": wide,
        "point_basis": np.concatenate(basis),
        "wide_row": np.repeat(np.arange(len(pairs)), stride),
        "entry": entry,
        "entry_wide": wide[which.ravel()] + BLOCK * (block - modes.start[body]),
    }
