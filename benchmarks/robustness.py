"""Random play in a closed room: penetration, tunnelling, failed worlds and overflow over many world-steps.

    softwarp bench robustness --worlds 64 --steps 500
    softwarp bench robustness --worlds 4096 --steps 300 --device cuda:0 --json robustness.json

Balls and cubes of random sizes and masses fly through a room with a floor, walls and a lid; a soft finger on a wall
is pulled by two cables; everything touches everything with friction. Bodies start at random with random velocities and
are kicked by random wrenches. Every world starts anew after an episode. Depths are measured at the end of every step,
from exact geometry (``penetration.py``), relative to the size of the smaller body: a ball's diameter, a cube's edge,
the finger's thickness.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

import softwarp as sw
from softwarp import meshing
from softwarp.io.atomic import write_text

from . import penetration
from .timing import machine

PERCENTILES = (50.0, 99.0, 99.9, 99.99, 100.0)
PASSES = 3  # times that a step measures its contacts anew: bodies spin by up to half a radian in it
LIMIT = 0.5  # depth relative to the size of a body from which it counts as engulfed
KINDS = ("ball-ball", "ball-cube", "cube-cube", "ball-wall", "cube-wall", "finger-ball", "finger-cube", "finger-wall")


@dataclass(frozen=True)
class Scene:
    """What is in the room, and how wild it is."""

    seed: int = 0  # of sizes
    balls: int = 3
    cubes: int = 3
    cells: tuple[int, int, int] = (8, 2, 2)  # of the finger
    room: tuple[float, float, float] = (0.4, 0.4, 0.4)  # m
    radius: tuple[float, float] = (0.018, 0.035)  # of balls [m]
    edge: tuple[float, float] = (0.032, 0.06)  # of cubes [m]
    finger: tuple[float, float, float] = (0.12, 0.024, 0.024)  # m
    youngs: float = 3.0e5  # Pa
    tension: float = 6.0  # largest of a cable [N]
    density: float = 600.0  # of balls and cubes, before a random factor of 1/3 to 3 [kg/m^3]
    mu: float = 0.5
    speed: float = 3.0  # largest at the start, and that a kick adds [m/s]
    spin: float = 20.0  # likewise [rad/s]
    kicks: float = 0.02  # probability that a body is kicked, per step
    capacity: int = 160  # contacts of a world
    episode: int = 200  # steps until a world starts anew


KICK_STEPS = 4  # that a kick lasts
COMMAND_STEPS = 25  # between two commands of the cables
WALL = 0.2  # thickness of the walls [m]
GAIN_HEIGHT = 0.05  # gains of energy are compared with kinetic energy and what bodies have at this height [m]


class Room:
    """A simulation of the scene, with its random commands.

    Args:
        scene: What is in the room.
        worlds: Worlds.
        device: Warp device.
        seed: Of initial states and commands.
        options: For ``Simulation``.
    """

    def __init__(self, scene: Scene, worlds: int, device: str, seed: int = 0, **options: Any) -> None:
        self.scene = scene
        sizes = np.random.default_rng(scene.seed)
        self.rng = np.random.default_rng((seed, 1))
        radius, edge = sizes.uniform(*scene.radius, scene.balls), sizes.uniform(*scene.edge, scene.cubes)
        self.bound = np.concatenate([radius, 0.8661 * edge])
        self.low = np.array([-0.5, -0.5, 0.0]) * scene.room
        self.high = np.array([0.5, 0.5, 1.0]) * scene.room
        self.base = np.array([-0.5 * scene.room[0] + 0.01, -0.5 * scene.finger[1], 0.06])
        builder = sw.ModelBuilder()
        walls = self._add_room(builder)
        shapes = [*(sw.Sphere(r) for r in radius), *(sw.Box((a, a, a)) for a in edge)]
        places = self._places(1)[0]
        bodies = [builder.add_rigid(s, density=scene.density, pose=x) for s, x in zip(shapes, places, strict=True)]
        finger, mesh = self._add_finger(builder)
        for k, body in enumerate(bodies):
            for other in (*walls, *bodies[:k], finger):
                builder.add_contact(body, other, mu=scene.mu)
        for wall in walls:
            builder.add_contact(finger, wall, mu=scene.mu)
        model = builder.finalize(worlds, device, contact_capacity=scene.capacity)
        self.sim = sw.Simulation(model, **options)
        self.device = self.sim.time.device
        self.first = len(walls)
        self.soft = penetration.SoftBody(
            self._put(mesh.tets, torch.long), self._put(meshing.tet_surface(mesh.tets), torch.long)
        )
        self.radius, self.half = self._put(radius), self._put(0.5 * edge)
        self.corners = self._put(self.low), self._put(self.high)
        self.inertia = self._put(np.concatenate([0.4 * radius**2, edge**2 / 6.0]))  # per mass
        self.mass0 = self.sim.params.body_mass[0, self.first :].double().clone()
        self.kick = torch.zeros(worlds, len(bodies), 6, dtype=torch.float64, device=self.device)
        self.age = torch.from_numpy(self.rng.integers(0, scene.episode, worlds)).to(self.device)
        self.step_count = 0
        self.start(torch.ones(worlds, dtype=torch.bool, device=self.device))

    def _put(self, values: Any, dtype: torch.dtype = torch.float64) -> Tensor:
        return torch.as_tensor(np.asarray(values), dtype=dtype, device=self.device)

    def _add_room(self, builder: sw.ModelBuilder) -> list[int]:
        x, y, z = self.scene.room
        walls = [builder.add_rigid(sw.Plane(), kinematic=True)]
        for side in (-1.0, 1.0):
            place = (side * (0.5 * x + 0.5 * WALL), 0.0, 0.5 * z)
            walls.append(builder.add_rigid(sw.Box((WALL, y + 2 * WALL, z + 2 * WALL)), kinematic=True, pose=place))
            place = (0.0, side * (0.5 * y + 0.5 * WALL), 0.5 * z)
            walls.append(builder.add_rigid(sw.Box((x + 2 * WALL, WALL, z + 2 * WALL)), kinematic=True, pose=place))
        lid = sw.Box((x + 2 * WALL, y + 2 * WALL, WALL))
        return [*walls, builder.add_rigid(lid, kinematic=True, pose=(0.0, 0.0, z + 0.5 * WALL))]

    def _add_finger(self, builder: sw.ModelBuilder) -> tuple[Any, meshing.TetMesh]:
        """A finger along x, a little off the wall that it is fixed in front of, with a cable above and one below."""
        size = np.array(self.scene.finger)
        plain = meshing.box(tuple(size), self.scene.cells)
        mesh = meshing.TetMesh(plain.nodes + self.base, plain.tets, "finger")
        material = sw.Corotational(self.scene.youngs, 0.4)
        finger = builder.add_tets(mesh, material=material, density=1000.0, rayleigh=(0.1, 0.005))
        builder.fix(finger, nodes=np.flatnonzero(plain.nodes[:, 0] < 1e-6))
        along = np.linspace(0.02, 1.0, 7) * size[0]
        for height in (0.15, 0.85):
            points = np.stack([along, np.full(7, 0.5 * size[1]), np.full(7, height * size[2])], axis=1)
            builder.add_cable(finger, points + self.base, control="force")
        return finger, mesh

    # Random states and commands

    def start(self, mask: Tensor) -> None:
        """Put some worlds into new random states with new masses."""
        chosen = mask.nonzero().flatten()
        count = len(chosen)
        if not count:
            return
        self.sim.reset(mask)
        rng, bodies = self.rng, len(self.bound)
        x = self._places(count)
        q = rng.standard_normal((count, bodies, 4))
        pose = np.concatenate([x, q / np.linalg.norm(q, axis=-1, keepdims=True)], axis=-1)
        twist = self._changes(count)
        mass = self.mass0 * self._put(np.exp(rng.uniform(-math.log(3.0), math.log(3.0), (count, bodies))))
        for view, value in (
            (self.sim.body_pose, self._put(pose)),
            (self.sim.body_twist, self._put(twist)),
            (self.sim.params.body_mass, mass),
        ):
            view[chosen, self.first :] = value.to(view.dtype)
        self.kick[chosen] = 0.0

    def _places(self, count: int) -> np.ndarray:
        """Centres whose bounding balls overlap neither each other nor the finger, shape (count, body, 3)."""
        x = np.zeros((count, len(self.bound), 3))
        tip = self.base + self.scene.finger
        for k, r in enumerate(self.bound):
            wrong = np.arange(count)
            while wrong.size:
                p = self.rng.uniform(self.low + r + 1e-3, self.high - r - 1e-3, (wrong.size, 3))
                x[wrong, k] = p
                apart = np.linalg.norm(x[wrong, :k] - p[:, None], axis=-1) > self.bound[:k] + r + 1e-3
                off = np.linalg.norm(np.maximum(np.maximum(self.base - p, p - tip), 0.0), axis=-1) > r + 1e-3
                wrong = wrong[~(apart.all(axis=1) & off)]
        return x

    def _changes(self, count: int) -> np.ndarray:
        """Random velocities and spins, shape (count, body, 6)."""
        shape = (count, len(self.bound))
        parts = [_in_ball(self.rng, limit, *shape) for limit in (self.scene.speed, self.scene.spin)]
        return np.concatenate(parts, axis=-1)

    def command(self) -> None:
        """Kicks and cable tensions of the next step."""
        sim, scene, rng = self.sim, self.scene, self.rng
        worlds, bodies = self.kick.shape[:2]
        if self.step_count % KICK_STEPS == 0:
            hit = rng.random((worlds, bodies, 1)) < scene.kicks * KICK_STEPS
            self.kick = self._put(hit * self._changes(worlds) / (KICK_STEPS * sim.dt))
            self.kick *= sim.params.body_mass[:, self.first :, None]
            self.kick[..., 3:] *= self.inertia[:, None]
            sim.control.body_force[:, self.first :] = self.kick.to(sim.control.body_force.dtype)
        if self.step_count % COMMAND_STEPS == 0:
            pull = self._put(rng.uniform(-scene.tension, scene.tension, (worlds, 1)))
            tension = torch.cat([pull, -pull], dim=1).clamp(min=0.0)
            sim.control.cable_tension[:] = tension.to(sim.control.cable_tension.dtype)
        self.step_count += 1

    # Measurement

    def places(self) -> tuple[Tensor, Tensor, Tensor]:
        """Centres (world, body, 3), rotations of cubes (world, cube, 3, 3) and nodes (world, node, 3), in float64."""
        pose = self.sim.body_pose[:, self.first :].double()
        R = penetration.rotation(pose[:, len(self.radius) :, 3:])
        return pose[..., :3], R, self.sim.node_x.double()

    def depths(self) -> dict[str, Tensor]:
        """Deepest penetration of every kind of pair relative to the smaller body, shape (world,)."""
        x, R, y = self.places()
        count = len(self.radius)
        b, c, r, h = x[:, :count], x[:, count:], self.radius, self.half
        thick = min(self.scene.finger)
        i, j = torch.triu_indices(count, count, 1, device=x.device)
        k, m = torch.triu_indices(len(h), len(h), 1, device=x.device)
        corner = torch.einsum("wcij,ckj->wcki", R, penetration.corners(h)) + c[:, :, None]
        flat = corner.flatten(1, 2)
        in_finger = self.soft.depth(y, flat, torch.zeros_like(flat[0, :, 0])).unflatten(1, (len(h), 8)).amax(-1)
        in_cubes = self.soft.depth_in_cubes(y, c, R, h)
        outside, (low, high) = penetration.in_room, self.corners
        surface = y[:, self.soft.surface]
        values = {
            "ball-ball": penetration.ball_ball(b, r) / (2 * torch.minimum(r[i], r[j])),
            "ball-cube": penetration.ball_cube(b, r, c, R, h) / (2 * torch.minimum(r[:, None], h)),
            "cube-cube": penetration.cube_cube(c, R, h) / (2 * torch.minimum(h[k], h[m])),
            "ball-wall": (outside(b, low, high) + r) / (2 * r),
            "cube-wall": outside(corner, low, high).amax(-1) / (2 * h),
            "finger-ball": self.soft.depth(y, b, r) / torch.minimum(2 * r, torch.full_like(r, thick)),
            "finger-cube": torch.maximum(in_finger, in_cubes) / torch.minimum(2 * h, torch.full_like(h, thick)),
            "finger-wall": outside(surface, low, high) / thick,
        }
        return {kind: value.flatten(1).amax(dim=1).clamp(min=0.0) for kind, value in values.items()}


def _in_ball(rng: np.random.Generator, radius: float, *shape: int) -> np.ndarray:
    """Random vectors of length up to ``radius``, shape (*shape, 3)."""
    direction = rng.standard_normal((*shape, 3))
    return direction / np.linalg.norm(direction, axis=-1, keepdims=True) * rng.uniform(0.0, radius, (*shape, 1))


@dataclass
class Tally:
    """Counts over all world-steps."""

    world_steps: int = 0
    outside: int = 0  # bodies that left the room
    passed: int = 0  # pairs of bodies that went through each other within a step
    pierced: int = 0  # bodies that went through the finger within a step
    engulfed: int = 0  # world-steps in which a body was half inside another
    failed: dict[str, int] = field(default_factory=dict)
    overflow_steps: int = 0
    overflow_contacts: int = 0
    most_contacts: int = 0
    residual: float = 0.0  # largest correction of the last sweep [m]
    energy_gain: float = 0.0  # largest in a step beyond the work of kicks and cables [J]
    energy_gain_relative: float = 0.0  # and relative to the kinetic energy and the weights times 5 cm
    seconds: float = 0.0  # in ``Simulation.step``

    @property
    def tunnelled(self) -> int:
        """Bodies that went through something."""
        return self.outside + self.passed + self.pierced


class Watch:
    """Steps a room and measures after every step."""

    def __init__(self, room: Room, energy: bool = True) -> None:
        self.room, self.energy = room, energy
        self.tally = Tally(failed={status.name: 0 for status in sw.Status if status >= sw.Status.NONFINITE})
        self.depth: dict[str, list[Tensor]] = {kind: [] for kind in KINDS}

    def run(self, steps: int) -> None:
        """Advance all worlds, each from its own place in its episode."""
        for _ in range(steps):
            self._step()

    def _step(self) -> None:
        room, sim, tally = self.room, self.room.sim, self.tally
        room.command()
        x0, _, y0 = room.places()
        before = self._energies() if self.energy else None
        wp.synchronize_device(sim.device)
        begin = time.perf_counter()
        sim.step()
        wp.synchronize_device(sim.device)
        tally.seconds += time.perf_counter() - begin
        good = sim.status < sw.Status.NONFINITE
        x1, _, y1 = room.places()
        depths = room.depths()
        for kind, value in depths.items():
            self.depth[kind].append(value[good].float().cpu())
        out = (penetration.in_room(x1, *room.corners) > 0.0).sum(dim=1)
        inner = torch.cat([room.radius, room.half])
        tally.world_steps += int(good.sum())
        tally.outside += int(out.sum())
        tally.passed += int(penetration.passed(x0, x1, inner)[good].sum())
        tally.pierced += int(penetration.pierced(room.soft, y0, y1, x0, x1)[good].sum())
        worst = torch.stack(list(depths.values())).amax(dim=0)
        tally.engulfed += int((worst[good] > LIMIT).sum())
        for name in tally.failed:
            tally.failed[name] += int((sim.status == sw.Status[name]).sum())
        overflow = sim.contact_overflow.clamp(min=0)
        tally.overflow_steps += int((overflow > 0).sum())
        tally.overflow_contacts += int(overflow.sum())
        tally.most_contacts = max(tally.most_contacts, int((sim.contact_count + overflow).max()))
        tally.residual = max(tally.residual, float(sim.residual.max()))
        if before is not None:
            self._note_gain(before, x0, good)
        room.age += 1
        again = ~good | (out > 0) | (room.age >= room.scene.episode)
        room.age[again] = 0
        room.start(again)

    def _energies(self) -> tuple[Tensor, Tensor, Tensor]:
        """Energy [J], kinetic energy [J] and displacements of cables [m] of every world."""
        sim = self.room.sim
        kinetic = sim.kinetic_energy().double()
        return sim.energy().double(), kinetic, sim.cable_displacement.double().clone()

    def _note_gain(self, before: tuple[Tensor, Tensor, Tensor], x0: Tensor, good: Tensor) -> None:
        """Energy that a step adds beyond the work of kicks and cables."""
        room, sim, after = self.room, self.room.sim, self._energies()
        turn = sim.body_twist[:, room.first :, 3:].double() * sim.dt
        way = torch.cat([room.places()[0] - x0, turn], dim=-1)
        work = (room.kick * way).flatten(1).sum(dim=1)
        work += (sim.control.cable_tension.double() * (after[2] - before[2])).sum(dim=1)
        gain = (after[0] - before[0] - work)[good]
        weight = sim.params.body_mass[:, room.first :].double().sum(dim=1) * 9.81
        size = (torch.maximum(after[1], before[1]) + weight * GAIN_HEIGHT)[good]
        tally = self.tally
        tally.energy_gain = max(tally.energy_gain, float(gain.amax()))
        tally.energy_gain_relative = max(tally.energy_gain_relative, float((gain / size).amax()))

    def report(self) -> dict[str, Any]:
        """Everything that was counted, and percentiles of depths in percent of the body size."""
        values = {kind: torch.cat(parts).numpy() for kind, parts in self.depth.items()}
        values["any"] = np.maximum.reduce(list(values.values()))
        depth = {
            kind: {f"p{p:g}": 100.0 * float(np.percentile(value, p)) for p in PERCENTILES}
            | {"touching": float(np.mean(value > 0.0))}
            for kind, value in values.items()
        }
        tally = self.tally
        record = asdict(tally) | {"tunnelled": tally.tunnelled, "depth_percent": depth}
        record["world_steps_per_s"] = tally.world_steps / max(tally.seconds, 1e-9)
        return record


def show(record: dict[str, Any]) -> None:
    """Print a record as a table."""
    print(f"{'depth [% of size]':18s}" + "".join(f"{f'p{p:g}':>10s}" for p in PERCENTILES) + "  touching")
    for kind, row in record["depth_percent"].items():
        cells = "".join(f"{row[f'p{p:g}']:10.4f}" for p in PERCENTILES)
        print(f"{kind:18s}{cells}{100.0 * row['touching']:9.1f}%")
    names = ("world_steps", "outside", "passed", "pierced", "engulfed", "failed", "overflow_steps", "overflow_contacts")
    names += ("most_contacts", "residual", "energy_gain", "energy_gain_relative", "world_steps_per_s")
    for name in names:
        value = record[name]
        print(f"{name:22s}{value:.4g}" if isinstance(value, float) else f"{name:22s}{value}")


def main(arguments: Sequence[str]) -> int:
    """Measure, print and record."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench robustness", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--scenes", type=int, nargs="+", default=[0], help="seeds of body sizes, one run for each")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--dt", type=float, default=0.01)
    parser.add_argument("--newton", type=int, default=1)
    parser.add_argument("--integrator", choices=("euler", "bdf2"), default="euler")
    parser.add_argument("--passes", type=int, default=PASSES, help="contact_passes of the simulation")
    parser.add_argument("--cells", type=int, nargs=3, default=Scene.cells)
    parser.add_argument("--capacity", type=int, default=Scene.capacity)
    parser.add_argument("--no-energy", action="store_true")
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args(arguments)
    records = []
    for seed in args.scenes:
        scene = Scene(seed=seed, cells=tuple(args.cells), capacity=args.capacity)
        options = {"dt": args.dt, "newton_iterations": args.newton, "contact_passes": args.passes}
        options |= {"integrator": args.integrator}
        room = Room(scene, args.worlds, args.device, seed, **options)
        watch = Watch(room, energy=not args.no_energy)
        watch.run(args.steps)
        record = watch.report()
        show(record)
        settings = {"worlds": args.worlds, "steps": args.steps} | options
        records.append({"scene": asdict(scene)} | settings | record | machine(args.device))
        if args.json:
            write_text(args.json, json.dumps(records, indent=1))
    return 0
