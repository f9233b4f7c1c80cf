"""A recorded bending beam, made without the simulator: shared by the tests of files and pictures."""

from types import SimpleNamespace

import numpy as np
import torch

from softwarp.io.trajectory import Recorder

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
            tet_node=tets,
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
        self.params = SimpleNamespace(gravity=torch.tensor([gravity] * num_worlds))
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
