"""Pictures of what is simulated: ``python -m experiments.gallery FOLDER`` writes a PNG and a USD file of every scene.

Every scene is a function that describes what is simulated, what is commanded meanwhile and how to look at it. All of
them take about a minute on two cores.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

import softwarp as sw
from softwarp import meshing
from softwarp.io.atomic import prove_writable
from softwarp.io.trajectory import Recorder, Trajectory
from softwarp.io.usd import export_usd
from softwarp.render import Camera, contact_sheet, render_trajectory, write_png

Frames = NDArray[np.uint8]

FRAMES = 60  # recorded per scene, at least


@dataclass
class Scene:
    """What to simulate and how to look at it.

    Attributes:
        sim: One world.
        duration: Simulated time [s].
        command: Writes ``sim.control`` for a time since the start [s].
        camera: Point of view of the picture.
        stress: Whether soft bodies are coloured by von Mises stress; a pair sets the range [Pa].
    """

    sim: sw.Simulation
    duration: float
    command: Callable[[float], None]
    camera: Camera
    stress: bool | tuple[float, float] = False


def finger() -> Scene:
    """A silicone finger on a moving plate, bent by a tendon, presses on a cube; arrows show the contact forces."""
    builder = sw.ModelBuilder()
    mesh = _round_column(0.011, 0.075, 4, 16)
    nodes = np.array((0.0, 0.0, 0.108)) - mesh.nodes * (-1.0, 1.0, 1.0)  # turned about x: the tip points down
    material = sw.Corotational(2.0e5, 0.45, method="large")
    body = builder.add_tets(nodes, mesh.tets, material=material, density=1100.0, rayleigh=(0.1, 0.02))
    path = [(-0.0075, 0.0, z) for z in np.linspace(0.107, 0.042, 12)]
    tendon = builder.add_cable(body, path, control="length")
    plate = builder.add_rigid(sw.Box((0.036, 0.036, 0.008)), kinematic=True, pose=(0.0, 0.0, 0.112), name="plate")
    builder.attach(body, to=plate, within=1e-4)
    floor = builder.add_rigid(sw.Plane(), kinematic=True, name="floor")
    cube = builder.add_rigid(sw.Box((0.03, 0.03, 0.03)), density=1200.0, pose=(0.0, 0.0, 0.015), name="cube")
    builder.add_contact(body, cube, mu=0.8)
    builder.add_contact(cube, floor, mu=0.8)
    sim = sw.Simulation(builder.finalize(), dt=0.005)

    def press(time: float) -> None:
        sim.control.cable_displacement[:, tendon] = 0.004 * min(time / 0.5, 1.0)
        sim.control.body_velocity[:, plate, 2] = -0.012 if 0.5 <= time < 1.5 else 0.0

    return Scene(sim, 1.7, press, Camera((0.11, -0.25, 0.14), (0.0, 0.0, 0.053), fov=27.0), stress=(0.0, 4e4))


def rod() -> Scene:
    """A soft rod with a steel ball at its end hangs over a cylinder; stripes show that it is made with a twist."""
    builder = sw.ModelBuilder()
    points = np.linspace((-0.16, 0.0, 0.20), (0.24, 0.0, 0.20), 41)
    twist = (0.0, 0.0, 18.0)  # 1/m, about one turn in all
    line = builder.add_rod(points, radius=0.006, youngs=1.5e6, density=1100.0, curvature=twist, rayleigh=(0.5, 0.01))
    ball = builder.add_rigid(sw.Sphere(0.016), density=7800.0, pose=(0.24, 0.0, 0.20), name="ball")
    builder.attach(ball, to=line, node=-1)
    grip = builder.add_rigid(sw.Box((0.03, 0.03, 0.03)), kinematic=True, pose=(-0.16, 0.0, 0.20), name="grip")
    builder.attach(line, nodes=[0], to=grip)
    turn = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    drum = builder.add_rigid(sw.Cylinder(0.05, 0.12), kinematic=True, pose=(0.02, 0.0, 0.13, *turn), name="drum")
    builder.add_contact(line, drum, mu=0.05)
    sim = sw.Simulation(builder.finalize(), dt=0.004)
    return Scene(sim, 3.0, lambda _: None, Camera((0.20, -0.62, 0.30), (0.0, 0.0, 0.11), fov=28.0))


def bender() -> Scene:
    """A block curls up: air chambers below its middle, inflated one after the other, against a stiff skin on top."""
    builder = sw.ModelBuilder()
    cell, chambers = 0.004, 7
    cells = (4 * chambers + 1, 6, 5)
    block = meshing.box(np.array(cells) * cell, cells)
    k, j, i = (index.ravel() for index in np.indices(cells[::-1]))
    air = (i % 4 > 0) & (j >= 1) & (j < 5) & (k >= 1) & (k < 3)
    nodes, tets = meshing.compact(block.nodes, block.tets[np.repeat(~air, 6)])
    nodes = nodes + (0.0, -0.012, 0.03)
    body = builder.add_tets(nodes, tets, material=sw.NeoHookean(9e4, 0.45), density=1100.0, rayleigh=(0.2, 0.02))
    builder.fix(body, nodes=np.flatnonzero(nodes[:, 0] < 1e-6))
    for void in sorted(meshing.voids(nodes, tets), key=lambda void: float(nodes[void, 0].mean())):
        wall, triangles = np.unique(void, return_inverse=True)
        builder.add_cavity(body, nodes[wall], meshing.orient_surface(triangles.reshape(-1, 3)), control="pressure")
    skin = meshing.tet_surface(tets)
    skin = skin[(nodes[skin, 2] > nodes[:, 2].max() - 1e-6).all(axis=1)]
    builder.add_membrane(body, skin, thickness=3e-4, youngs=2e7, nu=0.4, name="skin")
    sim = sw.Simulation(builder.finalize(), dt=0.01, newton_iterations=3)
    late = 0.12 * torch.arange(chambers)  # s

    def inflate(time: float) -> None:
        sim.control.cavity_pressure[:] = 2.2e4 * ((time - late) / 0.8).clamp(0.0, 1.0)

    return Scene(sim, 1.2, inflate, Camera((0.12, -0.24, 0.14), (0.055, 0.0, 0.045), fov=27.0))


def pile() -> Scene:
    """Rigid shapes of all kinds, poured into a tray."""
    builder = sw.ModelBuilder()
    floor = builder.add_rigid(sw.Plane(), kinematic=True, name="floor")
    side, height, wall = 0.34, 0.06, 0.012
    long, short = sw.Box((side + 2.0 * wall, wall, height)), sw.Box((wall, side, height))
    reach, up = 0.5 * (side + wall), 0.5 * height
    walls = [(long, (0, -reach, up)), (long, (0, reach, up)), (short, (-reach, 0, up)), (short, (reach, 0, up))]
    tray = builder.add_rigid(sw.Compound(walls), kinematic=True, name="tray")
    kinds = [
        sw.Box((0.09, 0.06, 0.05)),
        sw.Sphere(0.036),
        sw.Capsule(0.024, 0.07),
        sw.Cylinder(0.036, 0.05),
        sw.RigidMesh.hull(0.05 * _fibonacci(14)),
        sw.Compound([(sw.Box((0.11, 0.03, 0.03)), (0, 0, 0)), (sw.Box((0.03, 0.11, 0.03)), (0, 0, 0))]),
    ]
    rng = np.random.default_rng(5)
    bodies = []
    for number in range(24):
        q, angle = rng.standard_normal(4), 2.4 * number
        where = (0.06 * np.cos(angle), 0.06 * np.sin(angle), 0.06 + 0.045 * number)
        bodies.append(builder.add_rigid(kinds[number % 6], density=500.0, pose=(*where, *(q / np.linalg.norm(q)))))
    for a, body in enumerate(bodies):
        builder.add_contact(body, floor, mu=0.6)
        builder.add_contact(body, tray, mu=0.4)
        for other in bodies[:a]:
            builder.add_contact(body, other, mu=0.5)
    sim = sw.Simulation(builder.finalize(contact_capacity=400), dt=0.005)
    return Scene(sim, 2.5, lambda _: None, Camera((0.40, -0.80, 0.58), (0.0, 0.0, 0.045), fov=29.0))


SCENES: dict[str, Callable[[], Scene]] = {"finger": finger, "rod": rod, "bender": bender, "pile": pile}


def record(scene: Scene, name: str) -> Trajectory:
    """Run a scene and record it with its contacts.

    Raises:
        RuntimeError: If a step fails.
    """
    sim = scene.sim
    recorder = Recorder(sim, contacts=True, stress=scene.stress is not False, name=name)
    steps = round(scene.duration / sim.dt)
    for step in range(steps + 1):
        if step % max(1, steps // FRAMES) == 0:
            recorder.capture()
        scene.command(step * sim.dt)
        sim.step()
        if sw.Status(int(sim.status[0])).failed:
            raise RuntimeError(f"{name}: step {step} ended as {sw.Status(int(sim.status[0])).name}")
    return recorder.finish()


def picture(scene: Scene, recorded: Trajectory, width: int) -> Frames:
    """The last frame of a recording."""
    shown = render_trajectory(
        recorded,
        frames=[-1],
        camera=scene.camera,
        stress=scene.stress,
        contacts=recorded.name == "finger",
        twist=True,
        width=width,
        height=3 * width // 4,
    )
    return shown[0]


def main() -> None:
    """Write the scenes that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", choices=SCENES, nargs="*", default=list(SCENES))
    parser.add_argument("--width", type=int, default=960, help="of a picture [pixels]")
    given = parser.parse_args()
    prove_writable(given.folder / "gallery.png")
    pictures = []
    for name in given.only:
        scene = SCENES[name]()
        recorded = record(scene, name)
        pictures.append(picture(scene, recorded, given.width))
        write_png(given.folder / f"{name}.png", pictures[-1])
        export_usd(recorded, given.folder / f"{name}.usdc", twist=True)
        print(f"{name}: {recorded.frame_count} frames")
    if len(pictures) > 1:
        write_png(given.folder / "gallery.png", contact_sheet(pictures))


def _round_column(radius: float, height: float, across: int, along: int) -> meshing.TetMesh:
    """A round column along z, a little thinner at its rounded top."""
    block = meshing.box((2.0, 2.0, height), (across, across, along))
    x, y, z = (block.nodes - (1.0, 1.0, 0.0)).T
    part = z / height
    square = np.maximum(np.abs(x), np.abs(y))
    onto_disc = np.where(square > 0.0, square / np.maximum(np.hypot(x, y), 1e-12), 1.0) ** 0.94
    dome = np.sqrt(1.0 - np.clip((part - 0.88) / 0.13, 0.0, 1.0) ** 2)
    r = radius * (1.0 - 0.2 * part) * dome * onto_disc
    return meshing.TetMesh(np.column_stack([x * r, y * r, z]), block.tets, "finger")


def _fibonacci(count: int) -> NDArray[np.float64]:
    """Points spread evenly over the unit sphere, shape (count, 3)."""
    k = np.arange(count)
    z, turn = 1.0 - (2.0 * k + 1.0) / count, np.pi * (3.0 - np.sqrt(5.0)) * k
    r = np.sqrt(1.0 - z**2)
    return np.column_stack([r * np.cos(turn), r * np.sin(turn), z])


if __name__ == "__main__":
    main()
