"""Scenes of contact that several tests share: slopes, piles of boxes, blocks of tets. SI units, z up."""

import functools
from typing import Any

import numpy as np
import torch

import softwarp as sw
from softwarp import meshing

G = 9.81
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
LYING = (np.sin(np.pi / 4), 0.0, 0.0, np.cos(np.pi / 4))  # turns the z axis to -y


def slope(angle: float, azimuth: float = 0.0) -> tuple[tuple[float, ...], np.ndarray]:
    """Quaternion of a plane that falls towards ``azimuth``, and its normal."""
    c, s = np.cos(azimuth), np.sin(azimuth)
    half = np.sin(angle / 2)
    normal = np.array([np.sin(angle) * c, np.sin(angle) * s, np.cos(angle)])
    return (-half * s, half * c, 0.0, np.cos(angle / 2)), normal


def turned(quaternion: tuple[float, ...], points: np.ndarray) -> np.ndarray:
    """Points (n, 3) turned by a unit quaternion x y z w."""
    u, w = np.asarray(quaternion[:3]), quaternion[3]
    twice = 2.0 * np.cross(u, points)
    return np.asarray(points + w * twice + np.cross(u, twice))


@functools.cache
def grid(size: tuple[float, float, float], spacing: float) -> sw.SDF:
    """A box by distances on a grid, which take half a second: made by the first test that needs them."""
    return sw.SDF.from_mesh(*sw.Box(size).surface(), spacing)


def made(shape: Any) -> Any:
    """A shape of a table, where those that take long are functions that make them."""
    return shape() if callable(shape) else shape


def pair(
    target: Any,
    body: Any,
    pose: Any,
    *,
    target_pose: Any = (0.0, 0.0, 0.0),
    gravity: tuple[float, float, float] = (0.0, 0.0, -G),
    precision: str = "float64",
    worlds: int = 1,
    options: dict[str, Any] | None = None,
    rigid: dict[str, Any] | None = None,
    **contact: Any,
) -> tuple[sw.Simulation, Any, Any]:
    """A free rigid body of 1000 kg/m^3 and a kinematic one that it may touch: simulation, body, target."""
    builder = sw.ModelBuilder(gravity=gravity)
    ground = builder.add_rigid(target, kinematic=True, pose=target_pose)
    values: dict[str, Any] = {"density": 1000.0} | (rigid or {})
    free = builder.add_rigid(body, pose=pose, **values)
    builder.add_contact(free, ground, **contact)
    model = builder.finalize(worlds, precision=precision)
    return sw.Simulation(model, **({"dt": 0.01} | (options or {}))), free, ground


def on_slope(shape: Any, angle: float, mu: float, lift: float, *, azimuth: float = 0.0, **more: Any) -> Any:
    """A body that lies on an inclined plane in the plane's axes, its origin ``lift`` above it."""
    turn, normal = slope(angle, azimuth)
    return pair(sw.Plane(), shape, (*(lift * normal), *turn), target_pose=(0.0, 0.0, 0.0, *turn), mu=mu, **more)


def pile(
    count: int, size: float = 0.1, *, heavy: float = 1.0, mu: float = 0.5, worlds: int = 1, precision: str = "float64"
) -> tuple[sw.Model, list[Any], Any]:
    """Equal cubes on each other on a plane; the topmost is ``heavy`` times as dense. Model, cubes, plane."""
    builder = sw.ModelBuilder()
    floor = builder.add_rigid(sw.Plane(), kinematic=True)
    cubes = []
    for i in range(count):
        density = 1000.0 * (heavy if i == count - 1 else 1.0)
        cubes.append(builder.add_rigid(sw.Box((size,) * 3), density=density, pose=(0.0, 0.0, size * (i + 0.5))))
        builder.add_contact(cubes[i], cubes[i - 1] if i else floor, mu=mu)
    return builder.finalize(worlds, precision=precision), cubes, floor


def placed(mesh: meshing.TetMesh, offset: Any = (0.0, 0.0, 0.0), quaternion: tuple[float, ...] = UPRIGHT) -> Any:
    """A mesh turned about the origin, then moved."""
    return meshing.TetMesh(turned(quaternion, mesh.nodes) + np.asarray(offset), mesh.tets)


def run(sim: sw.Simulation, steps: int) -> None:
    """Steps that must all succeed."""
    for _ in range(steps):
        sim.step()
        assert (sim.status == sw.Status.OK).all(), sim.status


def array(view: torch.Tensor) -> np.ndarray:
    """A float64 copy of a view."""
    return view.double().cpu().numpy().copy()


def contacts(sim: sw.Simulation, world: int = 0) -> dict[str, np.ndarray]:
    """Point, normal, load and gap of the contacts of one world."""
    count = int(sim.contact_count[world])
    values = {"pair": array(sim.contact_pair[world]).reshape(-1)[:count].astype(int)}
    for name in ("point", "normal", "load"):
        values[name] = array(getattr(sim, f"contact_{name}")[world]).reshape(-1, 3)[:count]
    return values | {"gap": array(sim.contact_gap[world]).reshape(-1)[:count]}


def energy(sim: sw.Simulation, bodies: dict[int, tuple[float, np.ndarray]] | None = None) -> float:
    """Elastic, kinetic and gravitational energy of world 0 [J].

    Args:
        sim: Simulation without rods.
        bodies: Mass [kg] and inertia about the centre [kg m^2], (3, 3), of the free rigid bodies; their origins must be
            their centres.
    """
    gravity = array(sim.params.gravity[0]).reshape(3)
    total = 0.0
    if sim.model.node_count:
        mass = array(sim.mass[0]).reshape(-1, 1)
        total += float(sim.elastic_energy()[0])
        total += float((mass * (0.5 * array(sim.node_v[0]) ** 2 - array(sim.node_x[0]) * gravity)).sum())
    for body, (m, inertia) in (bodies or {}).items():
        pose, twist = array(sim.body_pose[0, body]), array(sim.body_twist[0, body])
        x, y, z, w = pose[3:]
        local = turned((-x, -y, -z, w), twist[3:])
        total += (
            0.5 * m * float(twist[:3] @ twist[:3])
            + 0.5 * float(local @ inertia @ local)
            - m * float(gravity @ pose[:3])
        )
    return total
