"""How deep parts of an environment's scene lie in each other, from their surfaces as they are after a step.

Independent of the simulator's own detection: corners and middles of edges of one closed surface are looked for in the
other one through Warp's trees of triangles, inside where the winding number is (Barill et al. 2018, Fast winding
numbers for soups and clouds; pseudo-normals are wrong at creases that soft bodies fold). A ball is its centre and a
radius. Depths [m] are positive where parts overlap and never below zero.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from softwarp import Compound, Sphere
from softwarp.envs.base import SoftEnv
from softwarp.meshing.cup_geometry import RIM_RADIUS

from .penetration import rotation

REACH = wp.constant(0.05)  # m, from a surface, within which points are looked at; nothing here is so thick
MEASURED = 64  # worlds at most; their trees are built one after the other


@wp.kernel(enable_backward=False)
def _deepest(mesh: wp.uint64, point: wp.array(dtype=wp.vec3), radius: float, depth: wp.array(dtype=float)):
    """Raise ``depth[0]`` to the deepest of balls about points in a closed surface."""
    p = point[wp.tid()]
    found = wp.mesh_query_point_sign_winding_number(mesh, p, radius + REACH)
    if found.result:
        near = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
        wp.atomic_max(depth, 0, radius - found.sign * wp.length(p - near))


@dataclass
class Part:
    """One body: where its corners and the middles of its edges are in a world.

    Attributes:
        corners: Positions of the surface's corners in all worlds, shape (world, corner, 3).
        triangles: Outward, shape (triangle, 3).
        radius: Of a ball [m], whose only point is its centre; 0 for all else.
    """

    corners: Callable[[], Tensor]
    triangles: Tensor
    radius: float = 0.0
    edges: Tensor = field(init=False)
    tree: wp.Mesh | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        t = self.triangles
        sides = torch.cat([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])
        self.edges = torch.unique(sides.sort(dim=1).values, dim=0)

    def points(self, corners: Tensor) -> Tensor:
        """What is looked for in other parts: shape (point, 3), from the corners in one world."""
        return corners if self.radius else torch.cat((corners, corners[self.edges].mean(dim=1)))

    def surface(self, corners: Tensor) -> wp.Mesh:
        """The tree of triangles, moved to the corners in one world."""
        x = wp.from_torch(corners.contiguous(), dtype=wp.vec3)
        if self.tree is None:
            indices = wp.from_torch(self.triangles.to(torch.int32).flatten().contiguous())
            self.tree = wp.Mesh(wp.clone(x), indices, support_winding_number=True)
        else:
            wp.copy(self.tree.points, x)
            self.tree.refit()
        return self.tree


@dataclass(frozen=True)
class Gauge:
    """The deepest overlap in every world, of the first ``MEASURED`` ones.

    Attributes:
        size: Of what is moved [m]: the edge of a cube, the diameter of a ball or of the cup's rim.
        pairs: Parts of which neither may enter the other one.
        above: Parts that may not lie below z = 0.
    """

    size: float
    pairs: tuple[tuple[Part, Part], ...]
    above: tuple[Part, ...] = ()

    def __call__(self) -> Tensor:
        """Depths [m], shape (world,), on the host."""
        parts = {id(part): part for pair in self.pairs for part in pair} | {id(part): part for part in self.above}
        x = {key: part.corners()[:MEASURED].float() for key, part in parts.items()}
        worlds = len(next(iter(x.values())))
        depth = torch.zeros(worlds, device=next(iter(x.values())).device)
        for part in self.above:
            depth = torch.maximum(depth, part.radius - x[id(part)][..., 2].amin(dim=1))
        for one, other in self.pairs:
            near = _are_near(x[id(one)], x[id(other)], one.radius + other.radius).nonzero().flatten().tolist()
            for world in near:
                here = depth[world : world + 1]
                for inner, outer in ((one, other), (other, one)):
                    if outer.radius:
                        continue
                    points = inner.points(x[id(inner)][world]).contiguous()
                    mesh = outer.surface(x[id(outer)][world])
                    wp.launch(
                        _deepest,
                        dim=len(points),
                        inputs=[mesh.id, wp.from_torch(points, dtype=wp.vec3), inner.radius],
                        outputs=[wp.from_torch(here)],
                        device=mesh.points.device,
                    )
        return depth.clamp(min=0.0).cpu()


def _are_near(a: Tensor, b: Tensor, margin: float) -> Tensor:
    """Whether the boxes around points overlap, per world."""
    low, high = torch.maximum(a.amin(dim=1), b.amin(dim=1)), torch.minimum(a.amax(dim=1), b.amax(dim=1))
    return (low <= high + margin).all(dim=1)


def gauge(env: SoftEnv) -> Gauge | VesselGauge | None:
    """What measures the overlaps of an environment; None of those that have nothing to measure here."""
    made = GAUGES.get(type(env).__name__)
    return None if made is None else made(env)


def _gripper(env: Any) -> Gauge:
    scene = env.scene
    right, left = soft(env, scene.fingers[0]), soft(env, scene.fingers[1])
    (thing,) = (soft(env, scene.object),) if scene.is_soft else rigid(env, scene.object)
    return Gauge(env.config.object_size, ((right, thing), (left, thing), (right, left)), (right, left, thing))


def _trunk_cup(env: Any) -> Gauge:
    return Gauge(2.0 * RIM_RADIUS, ((soft(env, env.scene.trunk.body), soft(env, env.scene.cup)),))


def _bubble_motion(env: Any) -> Gauge:
    (ball,) = rigid(env, env.scene.ball)
    others = (soft(env, env.scene.board), *rigid(env, env.scene.rim))
    return Gauge(2.0 * env.config.ball_radius, tuple((ball, other) for other in others))


@dataclass
class VesselGauge:
    """How deep the line of instruments lies in the wall of a vessel: its nodes and the middles between them.

    Attributes:
        env: A task with instruments in a vessel.
        size: Radius of the line [m], what depths are told in.
    """

    env: Any
    size: float = field(init=False)
    values: Tensor = field(init=False)

    def __post_init__(self) -> None:
        env, vessel = self.env, self.env.scene.vessel
        self.size = float(env.config.contact_radius)
        self.values = torch.tensor(vessel.values, dtype=torch.float32, device=env.device).permute(2, 1, 0)[None, None]
        self.origin = torch.tensor(vessel.origin, device=env.device)
        self.extent = vessel.spacing * (torch.tensor(vessel.values.shape, device=env.device) - 1)

    def __call__(self) -> Tensor:
        """Depth [m] of the deepest point in each world, 0 for a line that is clear of the wall, (world,)."""
        return self.signed().clamp_min(0.0)

    def signed(self) -> Tensor:
        """The same, negative by the least distance from the wall where a line is clear of it, (world,)."""
        env = self.env
        line = env.sim.rod_x[:, env._nodes].to(torch.float32)
        line = line - env.sim.body_pose[:, env.scene.wall, None, :3].to(torch.float32)
        points = torch.cat((line[:, 1:], 0.5 * (line[:, 1:] + line[:, :-1])), dim=1)
        place = 2.0 * (points - self.origin) / self.extent - 1.0
        grid = place[None, None]  # (1, 1, world, point, 3), trilinear as the wall itself
        found = torch.nn.functional.grid_sample(self.values, grid, padding_mode="border", align_corners=True)
        return (-found[0, 0, 0]).amax(dim=1)


GAUGES: dict[str, Callable[[Any], Gauge | VesselGauge]] = {
    "Gripper": _gripper,
    "TrunkCup": _trunk_cup,
    "BubbleMotion": _bubble_motion,
    "CatheterBeam": VesselGauge,
    "ConcentricTubeRobot": VesselGauge,
}


def soft(env: SoftEnv, body: int) -> Part:
    """A soft body's boundary."""
    sim = env.sim
    triangles = sim.model.surface_tri[sim.model.tri_body == int(body)]
    nodes, numbers = np.unique(triangles, return_inverse=True)
    index = torch.as_tensor(nodes, dtype=torch.int64, device=env.device)
    return Part(lambda: sim.node_x[:, index], torch.as_tensor(numbers.reshape(-1, 3), device=env.device))


def rigid(env: SoftEnv, body: int) -> tuple[Part, ...]:
    """A rigid body's surface, or those of its members, closed each; a ball is its centre."""
    sim, shape = env.sim, env.sim.model.rigid_shapes[int(body)]
    assert shape is not None
    pose = sim.body_pose[:, body]
    if isinstance(shape, Sphere):
        none = torch.zeros((0, 3), dtype=torch.int64, device=env.device)
        return (Part(lambda: pose[:, None, :3], none, shape.radius),)
    if isinstance(shape, Compound):
        pieces = [(member.shape.surface(), member.position, member.quaternion) for member in shape.members]
    else:
        pieces = [(shape.surface(), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))]
    return tuple(_posed(env, pose, *piece) for piece in pieces)


def _posed(env: SoftEnv, pose: Tensor, surface: Any, position: Any, quaternion: Any) -> Part:
    """A surface at a place in a frame that moves."""
    vertices, triangles = (torch.as_tensor(part, device=env.device) for part in surface)
    turn = rotation(torch.as_tensor(quaternion, dtype=torch.float32, device=env.device))
    place = torch.as_tensor(position, dtype=torch.float32, device=env.device)
    local = vertices.float() @ turn.mT + place

    def corners() -> Tensor:
        now = pose.float()
        return torch.einsum("wij,vj->wvi", rotation(now[:, 3:]), local) + now[:, None, :3]

    return Part(corners, triangles.long())
