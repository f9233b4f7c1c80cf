"""Scenes for the tests of collision detection: one detector, filled by hand, and what it finds as NumPy arrays."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from softwarp import meshing, shapes
from softwarp.kernels.algebra import lanes
from softwarp.kernels.algebra.lanes import Variant
from softwarp.model.codes import SLOTS, WORLD
from softwarp.model.contact import CollisionScene, Topology
from softwarp.plan.collision_scene import CollisionBuilder
from softwarp.shapes.base import quaternion_product, rotation_matrix
from softwarp.solvers.collision.detector import Detector, PairParameters
from softwarp.solvers.workspace import rows
from softwarp.solvers.workspace.rows import Rows

EXACT = lanes.variant("scalar", "float64")
STILL = np.array([0.0, 0.0, 0.0, 1.0])


def device_of(variant: Variant) -> str:
    """Where a variant runs."""
    return "cuda:0" if variant.name == "cuda" else "cpu"


def filled(variant: Variant, values: Any) -> Rows:
    """Workspace array of values (world, row)."""
    table = np.atleast_2d(np.asarray(values, dtype=np.float64))
    table = table if table.shape[1] else np.zeros((len(table), 1))
    result = rows.allocate(variant, len(table), table.shape[1], device_of(variant))
    packs, _, count = result.real.shape
    padded = table[np.minimum(np.arange(packs * count), len(table) - 1)]
    result.real.assign(padded.reshape(packs, count, -1).swapaxes(1, 2))
    return result


def free(node_count: int, frame_count: int) -> Topology:
    """Every node and frame moves for itself: dofs are nodes, then translation and rotation of the frames."""
    dofs = node_count + np.arange(2 * frame_count)
    return Topology(np.arange(node_count), np.full(node_count, -1), dofs, np.arange(frame_count))


class Probe:
    """A detector with positions, velocities and laws that can be changed between searches.

    Args:
        scene: Objects and pairs.
        x: Node positions [m], (node, 3) or (world, node, 3).
        pose: Poses, (frame, 7) or (world, frame, 7).
        topology: By default everything is free.
        laws: Overrides of mu, restitution, distance, alarm, compliance.
    """

    def __init__(
        self,
        scene: CollisionScene,
        x: Any = (),
        pose: Any = (),
        *,
        topology: Topology | None = None,
        variant: Variant = EXACT,
        capacity: int = 400,
        slack: float = 0.0,
        patient: bool = False,
        **laws: float,
    ) -> None:
        x, pose = np.asarray(x, dtype=np.float64), np.asarray(pose, dtype=np.float64)
        self.worlds = max(len(a) if a.ndim == 3 else 1 for a in (x, pose))
        self.x, self.pose = self._per_world(x, 3), self._per_world(pose, 7)
        self.v, self.twist = np.zeros_like(self.x), np.zeros((*self.pose.shape[:2], 6))
        self.scene, self.variant = scene, variant
        self.laws = {"mu": 0.5, "restitution": 0.0, "distance": 0.0, "alarm": 0.01, "compliance": 0.0} | laws
        topology = topology or free(self.x.shape[1], self.pose.shape[1])
        device = device_of(variant)
        self.detector = Detector(variant, self.worlds, scene, topology, capacity, device, slack, patient=patient)

    def _per_world(self, values: np.ndarray, width: int) -> np.ndarray:
        """A copy of shape (world, item, width)."""
        count = values.shape[-2] if values.size else 0
        shared = values.reshape(-1, count, width) if count else np.zeros((1, 0, width))
        return np.broadcast_to(shared, (self.worlds, count, width)).copy()

    def parameters(self) -> PairParameters:
        """Laws of all pairs."""
        shape = (self.worlds, max(self.scene.pair_count, 1))
        return PairParameters(
            **{name: filled(self.variant, np.full(shape, value)) for name, value in self.laws.items()}
        )

    def find(self, h: float = 0.0, world: int = 0) -> SimpleNamespace:
        """Search, and the contacts of one world."""
        tables = (self.x, self.pose, self.v, self.twist)
        arrays = [filled(self.variant, a.reshape(self.worlds, -1)) for a in tables]
        self.detector.find(*arrays, h, self.parameters())
        return self.contacts(world)

    def contacts(self, world: int = 0) -> SimpleNamespace:
        """Contacts of one world as arrays with one row per contact."""
        c, at = self.detector.contacts, divmod(world, self.detector.lanes)
        count = int(c.count.real.numpy()[at[0], 0, at[1]])

        def column(array: Rows, *shape: int) -> np.ndarray:
            values = array.real.numpy()[at[0], :, at[1]]
            return values[: count * int(np.prod(shape))].reshape(count, *shape)

        return SimpleNamespace(
            count=count,
            overflow=int(c.overflow.real.numpy()[at[0], 0, at[1]]),
            key=column(c.key),
            pair=column(c.pair),
            dof=column(c.dof, SLOTS),
            weight=column(c.weight, SLOTS),
            lever=column(c.lever, SLOTS, 3),
            axes=column(c.axes, 3, 3),
            normal=column(c.axes, 3, 3)[:, 0],
            point=column(c.point, 3),
            gap=column(c.gap),
            mu=column(c.mu),
            multiplier=column(c.multiplier, 3),
        )

    def relative_velocity(self, found: SimpleNamespace, u: np.ndarray) -> np.ndarray:
        """Velocity of side a against side b at every contact, from the slots, for velocities u of dofs (dof, 3)."""
        own = np.where(found.dof[:, :, None] >= 0, u[np.maximum(found.dof, 0)], 0.0)
        return np.sum(found.weight[:, :, None] * own + np.cross(own, found.lever), axis=1)


def random_quaternion(rng: np.random.Generator) -> np.ndarray:
    """A turn, uniformly distributed."""
    q = rng.standard_normal(4)
    return q / np.linalg.norm(q)


def turned(pose: np.ndarray, twist: np.ndarray, h: float) -> np.ndarray:
    """Pose after a step with a linear and an angular velocity."""
    angle = float(np.linalg.norm(twist[3:]))
    axis = twist[3:] / angle if angle else twist[3:]
    e = np.array([*(np.sin(0.5 * h * angle) * axis), np.cos(0.5 * h * angle)])
    return np.concatenate([pose[:3] + h * twist[:3], quaternion_product(e, pose[3:])])


def hull_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Distance between the convex hulls of two point sets: the shortest vector of their difference."""
    from scipy.optimize import nnls

    d = (a[:, None] - b[None]).reshape(-1, 3)
    weight, _ = nnls(np.vstack([d.T, 1e4 * np.ones(len(d))]), np.array([0.0, 0.0, 0.0, 1e4]), maxiter=10000)
    return float(np.linalg.norm(weight @ d / weight.sum()))


def placed(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Local points in the world."""
    return points @ rotation_matrix(pose[3:]).T + pose[:3]


def pose_of(position, quaternion=STILL):
    return np.concatenate([position, quaternion])


def cube(cells=3, size=0.1, shift=(0.0, 0.0, 0.0)):
    """Nodes and outer triangles of a soft cube."""
    mesh = meshing.box((size,) * 3, (cells,) * 3)
    return mesh.nodes + np.asarray(shift), meshing.tet_surface(mesh.tets)


def two_cubes(shift, cells=3):
    """Two soft cubes, the second moved by ``shift``, with a pair."""
    nodes, triangles = cube(cells)
    x = np.concatenate([nodes, nodes + np.asarray(shift)])
    scene = CollisionBuilder()
    a = scene.add_soft_surface(triangles, x, name="a")
    b = scene.add_soft_surface(triangles + len(nodes), x, name="b")
    scene.pair(a, b)
    return scene, x


def box_on_box(shift, angle=0.0, capacity=100, **laws):
    """A box of 0.1 m on another one, moved and turned about z."""
    scene = CollisionBuilder()
    scene.pair(scene.add_shape(0, shapes.Box((0.1, 0.1, 0.1))), scene.add_shape(1, shapes.Box((0.1, 0.1, 0.1))))
    turn = np.array([0.0, 0.0, np.sin(0.5 * angle), np.cos(0.5 * angle)])
    poses = [pose_of([shift[0], shift[1], 0.1 + shift[2]], turn), pose_of(np.zeros(3))]
    return Probe(scene, pose=poses, capacity=capacity, **laws)


def mixed_scene(rng):
    """Soft cube with one face carried by a frame, welded rod node, rigid shapes, all near each other."""
    nodes, triangles = cube(2, 0.1)
    n = len(nodes)
    scene = CollisionBuilder()
    soft = scene.add_soft_surface(triangles, nodes)
    rod = scene.add_rod([0, 1, 2], 0.004, [[-0.02, 0.03, 0.106], [0.05, 0.04, 0.1055], [0.12, 0.08, 0.1058]])
    box = scene.add_shape(3, shapes.Box((0.06, 0.05, 0.07)), [0.002, 0.001, 0.0])
    ball = scene.add_shape(4, shapes.Sphere(0.03))
    mesh = scene.add_shape(5, shapes.Mesh(*shapes.Box((0.05, 0.05, 0.05)).surface()), quaternion=[0, 0, 0.6, 0.8])
    cap = scene.add_shape(6, shapes.Capsule(0.01, 0.06))
    floor = scene.add_shape(WORLD, shapes.Plane(), [0, 0, -0.002])
    for a, b in [
        (soft, rod),
        (soft, box),
        (soft, ball),
        (soft, mesh),
        (soft, floor),
        (rod, ball),
        (rod, cap),
        (box, mesh),
    ]:
        scene.pair(a, b)
    poses = [
        pose_of([-0.02, 0.03, 0.106], random_quaternion(rng)),
        pose_of([0.05, 0.04, 0.1055], random_quaternion(rng)),
        pose_of([0.12, 0.08, 0.1058], random_quaternion(rng)),
        pose_of([0.13, 0.05, 0.05], [0, 0, np.sin(0.02), np.cos(0.02)]),
        pose_of([0.05, -0.0315, 0.05], random_quaternion(rng)),
        pose_of([0.1225, 0.05, 0.11], [0.02, 0.01, 0.0, np.sqrt(1 - 0.0005)]),
        pose_of([0.05, 0.05, 0.122], [0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)]),
    ]
    node_frame = np.where(nodes[:, 2] > 0.099, 7, -1)
    node_dof = np.where(node_frame >= 0, -1, np.arange(n))
    node_dof[0] = -1  # fixed
    master = np.arange(8)
    master[2] = 4  # the rod's end is welded to the ball
    dofs = n + np.arange(16).reshape(8, 2)
    poses.append(pose_of([0.05, 0.05, 0.15], random_quaternion(rng)))
    topology = Topology(node_dof, node_frame, dofs[master].reshape(-1), master)
    return scene, nodes, np.array(poses), topology, n + 16
