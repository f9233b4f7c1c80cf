"""How deep balls, cubes, walls and a soft body overlap, from their exact geometry.

Independent of the simulator's own detection: separating axes between cubes, closest points on surface triangles, and
the deepest point of every surface edge in a cube. All functions take tensors with the world as first axis and return
depths [m] that are negative, or zero, where nothing overlaps.
"""

from __future__ import annotations

import torch
from torch import Tensor

BISECTIONS = 24  # of an edge, in the search for its deepest point
NONE = -1.0  # depth of what is far apart [m]


def rotation(q: Tensor) -> Tensor:
    """Rotation matrices of quaternions x y z w, shape (..., 3, 3)."""
    x, y, z, w = (q / q.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def corners(half: Tensor) -> Tensor:
    """Corners of cubes about the origin, shape (cube, 8, 3), from half edges (cube,)."""
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3).to(half)
    return half[:, None, None] * signs


def ball_ball(x: Tensor, radius: Tensor) -> Tensor:
    """Depths of all pairs of balls, shape (world, pair); x (world, ball, 3), radius (ball,)."""
    i, j = torch.triu_indices(len(radius), len(radius), 1, device=x.device)
    return radius[i] + radius[j] - (x[:, i] - x[:, j]).norm(dim=-1)


def ball_cube(x: Tensor, radius: Tensor, centre: Tensor, R: Tensor, half: Tensor) -> Tensor:
    """Depths of every ball in every cube, shape (world, ball, cube)."""
    local = torch.einsum("wcij,wbci->wbcj", R, x[:, :, None] - centre[:, None])
    excess = local.abs() - half[:, None]
    outside = excess.clamp(min=0.0).norm(dim=-1)
    distance = torch.where(outside > 0.0, outside, excess.amax(dim=-1))
    return radius[:, None] - distance


def cube_cube(centre: Tensor, R: Tensor, half: Tensor) -> Tensor:
    """Depths of all pairs of cubes by their 15 separating axes, shape (world, pair)."""
    i, j = torch.triu_indices(len(half), len(half), 1, device=centre.device)
    A, B = R[:, i], R[:, j]  # columns are the axes of a cube
    crossed = torch.linalg.cross(A.mT[..., :, None, :], B.mT[..., None, :, :]).flatten(-3, -2)
    length = crossed.norm(dim=-1, keepdim=True)
    axes = torch.cat([A.mT, B.mT, crossed / length.clamp(min=1e-9)], dim=-2)
    reach = half[i][:, None] * torch.einsum("wpki,wpij->wpkj", axes, A).abs().sum(-1)
    reach = reach + half[j][:, None] * torch.einsum("wpki,wpij->wpkj", axes, B).abs().sum(-1)
    apart = torch.einsum("wpki,wpi->wpk", axes, centre[:, i] - centre[:, j]).abs()
    depth = reach - apart
    parallel = torch.cat([torch.zeros_like(depth[..., :6]), (length[..., 0] < 1e-4).to(depth)], dim=-1)
    return torch.where(parallel > 0.0, torch.full_like(depth, torch.inf), depth).amin(dim=-1)


def in_room(points: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """How far points are outside a room, at most [m], shape of the points without their last axis."""
    return torch.maximum(low - points, points - high).amax(dim=-1)


def triangle_distance(p: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Distance of points from triangles (Ericson 2005), all of shape (..., 3)."""
    ab, ac, ap = b - a, c - a, p - a
    n = torch.linalg.cross(ab, ac)
    square = (n * n).sum(-1).clamp(min=1e-30)
    v = (torch.linalg.cross(ap, ac) * n).sum(-1) / square
    w = (torch.linalg.cross(ab, ap) * n).sum(-1) / square
    inside = (v >= 0.0) & (w >= 0.0) & (v + w <= 1.0)
    plane = (ap * n).sum(-1).abs() / square.sqrt()
    sides = torch.stack([segment_distance(p, *two) for two in ((a, b), (b, c), (c, a))]).amin(dim=0)
    return torch.where(inside, plane, sides)


def segment_distance(p: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Distance of points from segments."""
    e = b - a
    t = (((p - a) * e).sum(-1) / (e * e).sum(-1).clamp(min=1e-30)).clamp(0.0, 1.0)
    return (p - a - t[..., None] * e).norm(dim=-1)


def in_tets(p: Tensor, x: Tensor) -> Tensor:
    """Whether points (n, 3) lie in one of the tetrahedra x (n, tet, 4, 3)."""
    edges = (x[:, :, 1:] - x[:, :, :1]).mT
    volume = torch.linalg.det(edges)
    r = p[:, None] - x[:, :, 0]
    share = []
    for k in range(3):
        replaced = edges.clone()
        replaced[..., k] = r
        share.append(torch.linalg.det(replaced) / volume)
    share.append(1.0 - share[0] - share[1] - share[2])
    return (torch.stack(share) >= 0.0).all(dim=0).any(dim=1)


class SoftBody:
    """Exact overlaps of one soft body of tetrahedra with balls and cubes.

    Args:
        tets: Corners, shape (tet, 4).
        triangles: Outer surface, shape (triangle, 3).
    """

    def __init__(self, tets: Tensor, triangles: Tensor) -> None:
        self.tets, self.triangles = tets, triangles
        sides = torch.cat([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
        self.edges = torch.unique(sides.sort(dim=1).values, dim=0)
        self.surface = torch.unique(triangles)

    def signed(self, x: Tensor, world: Tensor, p: Tensor) -> Tensor:
        """Signed distance of points (n, 3) from the surface in their worlds (n,), negative inside."""
        corner = x[world][:, self.triangles]
        distance = triangle_distance(p[:, None], corner[:, :, 0], corner[:, :, 1], corner[:, :, 2]).amin(dim=1)
        inside = in_tets(p, x[world][:, self.tets])
        return torch.where(inside, -distance, distance)

    def depth(self, x: Tensor, p: Tensor, radius: Tensor) -> Tensor:
        """Depths of balls (or points, radius 0) in the body, shape (world, ball); x (world, node, 3)."""
        low, high = x[:, self.surface].amin(dim=1), x[:, self.surface].amax(dim=1)
        near = ((p > (low[:, None] - radius[:, None])) & (p < (high[:, None] + radius[:, None]))).all(dim=-1)
        result = torch.full_like(p[..., 0], NONE)
        world, item = near.nonzero(as_tuple=True)
        if world.numel():
            result[world, item] = radius[item] - self.signed(x, world, p[world, item])
        return result

    def depth_in_cubes(self, x: Tensor, centre: Tensor, R: Tensor, half: Tensor) -> Tensor:
        """Depths of the deepest point of all surface edges in every cube, shape (world, cube)."""
        ends = x[:, self.edges]
        middle, length = ends.mean(dim=2), (ends[:, :, 1] - ends[:, :, 0]).norm(dim=-1)
        away = (middle[:, None] - centre[:, :, None]).norm(dim=-1)
        near = away < 1.7321 * half[:, None] + 0.5 * length[:, None]
        result = torch.full_like(centre[..., 0], NONE)
        world, cube, edge = near.nonzero(as_tuple=True)
        if not world.numel():
            return result
        local = torch.einsum("nij,nki->nkj", R[world, cube], ends[world, edge] - centre[world, cube][:, None])
        a, b, size = local[:, 0], local[:, 1], half[cube]

        def inside(t: Tensor) -> Tensor:
            return (size[:, None] - (a + t[:, None] * (b - a)).abs()).amin(dim=-1)

        low, high = torch.zeros_like(size), torch.ones_like(size)
        for _ in range(BISECTIONS):  # the depth along a line is concave: keep two thirds around its maximum
            first, second = low + (high - low) / 3.0, high - (high - low) / 3.0
            rises = inside(first) < inside(second)
            low, high = torch.where(rises, first, low), torch.where(rises, high, second)
        deepest = torch.stack([inside(t) for t in (low, high, torch.zeros_like(low), torch.ones_like(low))]).amax(dim=0)
        flat = result.flatten()
        flat.scatter_reduce_(0, world * half.numel() + cube, deepest, "amax")
        return flat.reshape(result.shape)


def passed(x0: Tensor, x1: Tensor, radius: Tensor) -> Tensor:
    """Number of pairs of inscribed balls whose paths in a step come closer than half the sum of their radii, per world.

    Args:
        x0: Centres before the step, shape (world, body, 3).
        x1: Centres after it.
        radius: Radii of balls that fit into the bodies [m], shape (body,).
    """
    i, j = torch.triu_indices(len(radius), len(radius), 1, device=x0.device)
    a, b = x0[:, i] - x0[:, j], x1[:, i] - x1[:, j]
    return (segment_distance(torch.zeros_like(a), a, b) < 0.5 * (radius[i] + radius[j])).sum(dim=1)


def pierced(soft: SoftBody, y0: Tensor, y1: Tensor, x0: Tensor, x1: Tensor) -> Tensor:
    """Number of centres whose way in a step, relative to the body, leads in and out of its surface, per world.

    Args:
        soft: Body.
        y0: Its nodes before the step, shape (world, node, 3).
        y1: Its nodes after it.
        x0: Centres before the step, shape (world, body, 3).
        x1: Centres after it.
    """
    low = torch.minimum(y0, y1)[:, soft.surface].amin(dim=1)[:, None]
    high = torch.maximum(y0, y1)[:, soft.surface].amax(dim=1)[:, None]
    near = ((torch.maximum(x0, x1) > low) & (torch.minimum(x0, x1) < high)).all(dim=-1)
    count = torch.zeros(len(x0), dtype=torch.long, device=x0.device)
    world, item = near.nonzero(as_tuple=True)
    if world.numel():
        mean = 0.5 * (y0[world] + y1[world])[:, soft.triangles]
        p, d = x0[world, item][:, None], (x1 - x0)[world, item][:, None].expand(-1, mean.shape[1], -1)
        a, e, f = mean[:, :, 0], mean[:, :, 1] - mean[:, :, 0], mean[:, :, 2] - mean[:, :, 0]
        n = torch.linalg.cross(e, f)
        slope = (n * d).sum(-1)
        t = ((a - p) * n).sum(-1) / torch.where(slope.abs() > 1e-30, slope, torch.full_like(slope, 1e-30))
        r = p + t[..., None] * d - a
        square = (n * n).sum(-1).clamp(min=1e-30)
        v = (torch.linalg.cross(r, f) * n).sum(-1) / square
        w = (torch.linalg.cross(e, r) * n).sum(-1) / square
        hit = (t > 0.0) & (t < 1.0) & (v >= 0.0) & (w >= 0.0) & (v + w <= 1.0)
        count.index_add_(0, world, (hit.sum(dim=1) >= 2).long())
    return count
