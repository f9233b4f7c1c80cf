"""Recordings made without the simulator, of a bending beam and of all other parts: for tests of files and pictures."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import torch
import warp as wp

from softwarp import meshing, shapes
from softwarp.io.parts import Parts
from softwarp.io.trajectory import Recorder, Trajectory

LENGTH, WIDTH = 0.2, 0.03  # m


def kuhn_surface(cells: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes of a unit grid, tets (6 per cell) and outward surface triangles."""
    nx, ny, nz = cells
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, n + 1) for n in cells], indexing="ij"), axis=-1)
    number = np.arange(grid[..., 0].size).reshape(nx + 1, ny + 1, nz + 1)
    tets = []
    for corner in np.ndindex(nx, ny, nz):
        for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
            path = [np.array(corner)]
            for axis in order:
                path.append(path[-1] + np.eye(3, dtype=int)[axis])
            tets.append([number[tuple(p)] for p in path])
    nodes, tets = grid.reshape(-1, 3), np.array(tets)
    edge = nodes[tets[:, 1:]] - nodes[tets[:, :1]]
    flip = np.linalg.det(edge) < 0
    tets[flip, 2], tets[flip, 3] = tets[flip, 3].copy(), tets[flip, 2].copy()
    faces = np.concatenate([tets[:, f] for f in ([0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3])])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return nodes, tets, faces[first[count == 1]]


def bend(points: np.ndarray, angle: float, direction: float = 0.0) -> np.ndarray:
    """Bend points of a straight beam along z by ``angle`` [rad] towards the azimuth ``direction``."""
    x, y, z = np.moveaxis(points, -1, 0)
    c, s = np.cos(direction), np.sin(direction)
    u, v = c * x + s * y, -s * x + c * y
    if abs(angle) > 1e-9:
        radius = LENGTH / angle
        phi = z / radius
        u, z = radius - (radius - u) * np.cos(phi), (radius - u) * np.sin(phi)
    return np.stack([c * u - s * v, s * u + c * v, z], axis=-1)


class FakeSimulation:
    """Looks to a recorder like a simulation of one beam with four cables and a tip marker."""

    def __init__(self, num_worlds: int = 1, cells: tuple[int, int, int] = (3, 3, 12), gravity=(0.0, 0.0, -9.81)):
        unit, tets, surface = kuhn_surface(cells)
        self.rest = (unit - (0.5, 0.5, 0.0)) * (WIDTH, WIDTH, LENGTH)
        waypoints = [
            (0.01 * np.cos(a), 0.01 * np.sin(a), z) for a in np.arange(4) * np.pi / 2 for z in np.linspace(0, LENGTH, 8)
        ]
        self.waypoints = np.array(waypoints)
        self.model = SimpleNamespace(
            surface_tri=surface.astype(np.int32),
            tri_body=np.zeros(len(surface), np.int32),
            tet_node=wp.array(tets, dtype=wp.int32, device="cpu"),
            quadratic=None,
            hexes=None,
            node_rest=self.rest,
            node_fixed=self.rest[:, 2] < 1e-9,
            body_node_start=np.array([0, len(self.rest)]),
            cable_point_start=np.arange(5, dtype=np.int32) * 8,
            body_names=["beam"],
            cable_names=[f"cable {c}" for c in range(4)],
            marker_names=["tip"],
            rigid_names=(),
            rigid_shapes=(),
            rod_names=(),
            cavity_names=(),
            frames=None,
            cavities=None,
            membranes=None,
            contact=None,
            joints=None,
            joint_names=(),
            defaults={"gravity": np.array(gravity)},
            device="cpu",
        )
        self.num_worlds, self.dt, self.device = num_worlds, 0.01, "cpu"
        none = torch.zeros((num_worlds, 0), dtype=torch.int32)
        self.params = SimpleNamespace(gravity=torch.tensor([gravity] * num_worlds), body_choice=none)
        self.time = torch.zeros(num_worlds)
        self.body_pose = torch.zeros(num_worlds, 0, 7)
        self.rod_x, self.rod_q = torch.zeros(num_worlds, 0, 3), torch.zeros(num_worlds, 0, 4)
        self.cavity_pressure = self.cavity_volume = torch.zeros(num_worlds, 0)
        self.pose([0.0] * num_worlds)

    def pose(self, angles) -> None:
        """Bend world w by angles[w]."""
        ways = [(a, 0.4 * w) for w, a in enumerate(angles)]
        self.node_x = torch.tensor(np.stack([bend(self.rest, *way) for way in ways]), dtype=torch.float32)
        self.cable_x = torch.tensor(np.stack([bend(self.waypoints, *way) for way in ways]), dtype=torch.float32)
        tip = np.array([[0.0, 0.0, LENGTH]])
        self.marker_x = torch.tensor(np.stack([bend(tip, *way) for way in ways]), dtype=torch.float32)
        self.cable_tension = torch.tensor([[2.0 * abs(a), 0.0, 0.5, 1.0] for a in angles])
        depth = torch.tensor(self.rest[:, 0] / WIDTH, dtype=torch.float32).abs()
        self._stress = torch.stack([4e4 * abs(a) * depth for a in angles])

    def node_stress(self) -> torch.Tensor:
        return self._stress

    def step(self, angles) -> None:
        self.time += self.dt
        self.pose(angles)


def recording(frames: int = 5, worlds=(0, 2), *, goal: bool = True, stress: bool = True, gravity=(0.0, 0.0, -9.81)):
    """A trajectory of bending beams, 0.01 s from frame to frame."""
    sim = FakeSimulation(max(worlds) + 1, cells=(2, 2, 8), gravity=gravity)
    recorder = Recorder(sim, list(worlds), stress=stress, name="beam film")
    for k in range(frames):
        recorder.capture(goal=np.array([[0.05, 0.01 * w, 0.15 - 0.01 * k] for w in worlds]) if goal else None)
        sim.step([0.1 * (k + 1) * (w + 1) for w in range(sim.num_worlds)])
    return recorder.finish()


FLOOR, CRATE, BALL, TOOL, GEM, GHOST = range(6)  # rigid bodies of ``parts_film``
CUBE = shapes.Box((0.02, 0.02, 0.02))


def rigid_shapes() -> tuple[shapes.Shape | None, ...]:
    """A floor, a box and a ball, a tool of capsule and cylinder, a mesh, and a body without a shape."""
    up = (0.0, 0.0, 0.02)
    tool = shapes.Compound([shapes.Capsule(0.004, 0.02), (shapes.Cylinder(0.008, 0.01), up)])
    return (shapes.Plane(), CUBE, shapes.Sphere(0.01), tool, shapes.Mesh(*CUBE.surface(), name="gem"), None)


def parts_of(shape_list, **given) -> Parts:
    """Parts with rigid bodies of these shapes, the first one kinematic."""
    count = len(shape_list)
    frames = SimpleNamespace(
        is_kinematic=np.arange(count) == 0, rod_start=np.zeros(1, int), rod_radius=np.zeros(0), **given
    )
    model = SimpleNamespace(
        rigid_names=tuple(f"rigid {k}" for k in range(count)),
        rigid_shapes=tuple(shape_list),
        rod_names=(),
        frames=frames,
        cavities=None,
        joints=None,
    )
    return Parts.of_model(model)


def parts_film(frames: int = 4, worlds: int = 2, *, soft: bool = True) -> Trajectory:
    """Rigid bodies that fly and turn, a rod that bends, two chambers in a beam, contacts and three joints.

    In frame f, body b stands at (0.03 b, 0, 0.01 (f + 1)) turned by 0.2 f about z; the rod is an arc over 0.1 f rad.
    """
    base = recording(frames, range(worlds), goal=False, stress=False) if soft else None
    count = len(rigid_shapes())
    cube, corners = CUBE.surface()
    joints = np.tile([0.0, 0.0, 0.005, 0.0, 0.0, 0.0, 1.0], (4, 1))
    given = {f.name: getattr(parts_of(rigid_shapes()), f.name) for f in dataclasses.fields(Parts)}
    given |= {"rod_names": ("whip",), "rod_point_start": [0, 5], "rod_radius": np.linspace(0.004, 0.002, 5)}
    given |= {"joint_names": ("turn", "slide", "swivel", "glue"), "joint_kind": [0, 1, 2, 3], "joint_pose": joints}
    given |= {"joint_frame": [[-1, CRATE], [CRATE, BALL], [BALL, TOOL], [GEM, count + 4]]}
    if soft:
        given |= {"cavity_names": ("left", "right"), "cavity_point_start": [0, 8, 16], "cavity_body": [0, 0]}
        given |= {"cavity_tri": np.concatenate([corners, corners + 8])}
    f, w, b = np.meshgrid(np.arange(frames), np.arange(worlds), np.arange(count), indexing="ij")
    pose = np.stack([0.03 * b, 0.2 * w, 0.01 * (f + 1), 0 * f, 0 * f, np.sin(0.1 * f), np.cos(0.1 * f)], axis=-1)
    pose[:, :, FLOOR] = [0.0, 0.0, -0.01, 0.0, 0.0, 0.0, 1.0]
    arcs = [
        meshing.rod_geometry(meshing.arc(0.2 / (0.1 * k + 1e-6), 0.1 * k + 1e-6, 4), radius=0.004)
        for k in range(frames)
    ]
    pair = np.full((frames, worlds, 3), -1)
    pair[1:, :, 0], pair[2:, 0, 1] = 0, 1  # none, then one, then two in world 0
    force = np.where((pair >= 0)[..., None], [0.0, 0.0, 2.0], np.nan)
    moving = {
        "rigid_pose": pose,
        "rod_x": np.stack([[a.positions] * worlds for a in arcs]),
        "rod_q": np.stack([[a.quaternions] * worlds for a in arcs]),
        "contact_x": np.where((pair >= 0)[..., None], [0.03, 0.0, 0.01], np.nan),
        "contact_force": force,
        "contact_pair": pair,
        "pair_names": ("crate - floor", "ball - crate"),
    }
    if base is not None:
        inside = 0.4 * np.concatenate([cube - (0.006, 0.0, 0.0), cube + (0.006, 0.0, 0.0)]) + (0.0, 0.0, 0.1)
        moving["cavity_x"] = inside + np.linspace(0.0, 0.01, frames)[:, None, None, None] * np.ones((worlds, 1, 1))
        moving["cavity_pressure"] = np.linspace(0.0, 1e4, frames)[:, None, None] * [1.0, -0.5] * np.ones((worlds, 1))
        moving["cavity_volume"] = 1e-7 + np.zeros((frames, worlds, 2))
        return dataclasses.replace(base, parts=Parts(**given), **moving)
    none = np.zeros((frames, worlds, 0, 3))
    empty = {"triangles": np.zeros((0, 3)), "vertex_rest": np.zeros((0, 3)), "vertex_x": none, "cable_x": none}
    return Trajectory(
        name="parts",
        dt=0.01,
        time=0.01 * np.arange(frames),
        world=np.arange(worlds),
        up=[0.0, 0.0, 1.0],
        tri_body=np.zeros(0),
        vertex_node=np.zeros(0),
        vertex_fixed=np.zeros(0),
        cable_point_start=[0],
        cable_tension=none[..., 0],
        marker_x=none,
        goal=None,
        stress=None,
        body_names=(),
        cable_names=(),
        marker_names=(),
        parts=Parts(**given),
        **empty,
        **moving,
    )
