"""Everything that hides what is behind it, soft bodies, rigid bodies and rods, as one triangle surface per world."""

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp.io import palette, tubes
from softwarp.io.colormap import srgb_to_linear
from softwarp.io.parts import Parts, posed
from softwarp.io.placement import Placement
from softwarp.io.trajectory import compact_surface
from softwarp.render import raycast
from softwarp.render.layer import Layer, upload

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

_SOFT_CREASE, _HARD_CREASE = 50.0, 32.0  # degrees between neighbouring faces that are shaded as an edge
_RESOLUTION = 48  # corners of a full circle
_SIDES = 24  # of a rod
_THIN = 0.5  # of the radius as it is drawn: thinner rods have a colour that is seen


class Solids:
    """Vertices of soft bodies, then of rigid bodies, then of rods.

    Args:
        triangles: Surface of soft bodies as node indices, shape (tri, 3).
        rest: Rest positions of the nodes [m], shape (node, 3).
        parts: Rigid bodies and rods.
        placed: Where these are at rest, n = 1.
        hidden: Piece that is left out because it is the floor, or None.
        twist: Whether rods carry a stripe that shows their twist.
        device: Warp device.
        least_radius: Of rods, as they are drawn [m].
    """

    def __init__(
        self,
        triangles: NDArray[np.int64],
        rest: Floats,
        parts: Parts,
        placed: Placement,
        *,
        hidden: int | None,
        twist: bool,
        device: str,
        least_radius: float = 0.0,
    ) -> None:
        self.parts, self.device = parts, device
        self._radius = np.maximum(parts.rod_radius, least_radius)
        self.vertex_node, soft = compact_surface(triangles)
        self.soft_tris = len(soft)
        local, rigid, rigid_tri = _rigid_surface(parts, hidden)
        self._fine = [tubes.pieces_per_segment(n - 1) for n in np.diff(parts.rod_point_start)]
        self._first_rigid = len(self.vertex_node)
        self._first_rod = self._first_rigid + len(local)
        rod_tri, rod_color = self._rod_surface(twist)
        number = np.array([palette.rigid_color(i, bool(k)) for i, k in enumerate(parts.rigid_kinematic)]).reshape(-1, 3)
        self._part_color = np.concatenate([srgb_to_linear(number)[rigid], srgb_to_linear(rod_color)])
        with wp.ScopedDevice(device):
            self._node = wp.array(self.vertex_node, dtype=int)
            self._local = wp.array(local.astype(np.float32), dtype=wp.vec3)
            self._rigid = wp.array(rigid, dtype=int)
        vertices = [rest[self.vertex_node]]
        vertices.append(np.zeros_like(local) if not len(local) else _at_rest(local, rigid, placed.rigid_pose[0]))
        vertices.append(self.tubes(placed.rod_x, placed.rod_q)[0])
        tri = np.concatenate([soft, rigid_tri + self._first_rigid, rod_tri + self._first_rod]).astype(np.int32)
        self.rest, self.triangles = np.concatenate(vertices), tri
        self.tri_owner = np.full(len(tri), -1)  # rigid body of each triangle, -1 for soft ones, their number for rods
        self.tri_owner[len(soft) :] = parts.rigid_count
        self.tri_owner[len(soft) : len(soft) + len(rigid_tri)] = rigid[rigid_tri[:, 0]]
        crease = np.repeat([_SOFT_CREASE, _HARD_CREASE], [len(soft), len(tri) - len(soft)])
        self.layer = Layer(tri, self.rest, crease, device)

    def tubes(self, rod_x: Any, rod_q: Any) -> Floats:
        """Vertices of all rods together [m], shape (n, v, 3)."""
        x, q = (np.asarray(a.detach().cpu() if hasattr(a, "detach") else a) for a in (rod_x, rod_q))
        each = [
            tubes.sweep(x[:, at], q[:, at], self._radius[at], _SIDES, fine)
            for at, fine in zip(map(self.parts.rod_points, range(self.parts.rod_count)), self._fine, strict=True)
        ]
        return np.concatenate([np.empty((len(x), 0, 3)), *each], axis=1)

    def place(self, count: int, node_x: Any, placed: Placement) -> None:
        """Move the vertices of ``count`` worlds; parts that have no place collapse into a point and are not seen."""
        self.layer.reserve(count).zero_()
        if len(self.vertex_node):
            self._launch(raycast._gather, count, self._node, [upload(node_x, self.device)])
        if placed.rigid_pose is not None and self._local.size:
            pose = upload(placed.rigid_pose, self.device, wp.transform)
            self._launch(raycast._carry, count, self._local, [self._rigid, pose, self._first_rigid])
        if placed.rod_x is not None and placed.rod_q is not None and self.parts.rod_count:
            self.layer.put(self.tubes(placed.rod_x, placed.rod_q), self._first_rod)

    def surface(self, count: int, node_color: Floats) -> Any:
        """The surface, with the soft nodes in linear-light colours, shape (1 or count, node, 3)."""
        soft = node_color[:, self.vertex_node]
        part = np.broadcast_to(self._part_color, (len(soft), *self._part_color.shape))
        return self.layer.surface(count, np.concatenate([soft, part], axis=1))

    def _rod_surface(self, twist: bool) -> tuple[Ints, Floats]:
        """Triangles and vertex colours (sRGB) of all rods."""
        triangles, colors, first = [np.empty((0, 3), dtype=np.int32)], [np.empty((0, 3))], 0
        for rod, fine in enumerate(self._fine):
            at = self.parts.rod_points(rod)
            nodes = at.stop - at.start
            marked = tubes.stripe(nodes, _SIDES, fine) & twist
            is_thin = (self.parts.rod_radius[at] < _THIN * self._radius[at]).all()
            own = palette.ROD_THIN if is_thin else palette.ROD
            triangles.append(tubes.tube_triangles(nodes, _SIDES, fine) + first)
            colors.append(np.where(marked[:, None], palette.ROD_STRIPE, own))
            first += len(marked)
        return np.concatenate(triangles), np.concatenate(colors)

    def _launch(self, kernel: Any, count: int, items: wp.array, inputs: list[Any]) -> None:
        dim, outputs = (count, items.size), [self.layer.vertex_x]
        wp.launch(kernel, dim=dim, inputs=[items, *inputs], outputs=outputs, device=self.device)


def _rigid_surface(parts: Parts, hidden: int | None) -> tuple[Floats, Ints, Ints]:
    """Vertices of all rigid bodies in their frames [m], the body of each, and triangles."""
    vertices, rigid, triangles = [np.empty((0, 3))], [np.empty(0, dtype=np.int32)], [np.empty((0, 3), dtype=np.int32)]
    first = 0
    for piece, body in enumerate(parts.piece_rigid):
        if piece == hidden:
            continue
        x, tri = parts.piece_surface(piece, _RESOLUTION)
        vertices.append(posed(parts.piece_pose[piece], x))
        rigid.append(np.full(len(x), body))
        triangles.append(tri + first)
        first += len(x)
    return np.concatenate(vertices), np.concatenate(rigid).astype(np.int32), np.concatenate(triangles).astype(np.int32)


def _at_rest(local: Floats, rigid: Ints, pose: Any) -> Floats:
    """Vertices of all rigid bodies where they start."""
    x = np.zeros_like(local)
    for body in np.unique(rigid):
        x[rigid == body] = posed(pose[body], local[rigid == body])
    return x
