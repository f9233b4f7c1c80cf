"""Small scenes of every kind that threads and processes make and step at the same time; each tells its last bits."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.envs import registry

Bits = dict[str, torch.Tensor]
STEPS = 6


def _last(sim: sw.Simulation, command: Callable[[int], None] | None = None, steps: int = STEPS) -> Bits:
    for step in range(steps):
        if command is not None:
            command(step)
        sim.step()
    return {key: value.clone() for key, value in sim.snapshot().arrays.items()}


def trunk(law: str, worlds: int, **options: Any) -> Bits:
    """The coarse trunk, its cables pulled; ``law`` is ``large`` or ``neo_hookean``."""
    material = sw.NeoHookean(4e5, 0.45) if law == "neo_hookean" else sw.Corotational(4e5, 0.45, method="large")
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    body = builder.add_tets(meshing.trunk("coarse"), material=material, density=1100.0, rayleigh=(0.5, 0.01))
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1.0, 1.0, 1e-3)))
    z = np.linspace(0.02, 0.18, 5)
    for side in (-0.005, 0.005):
        builder.add_cable(body, np.stack([np.full(5, side), np.zeros(5), z], axis=1), tolerance=1e-3)
    sim = sw.Simulation(builder.finalize(worlds), dt=0.01, **options)
    return _last(sim, lambda step: sim.control.cable_displacement.fill_(1e-3 * step))


def rods(worlds: int, device: str = "cpu", **options: Any) -> Bits:
    """A clamped rod with a rigid body on its end, which falls."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    points = np.stack([np.linspace(0.0, 0.5, 9), np.zeros(9), np.zeros(9)], axis=1)
    rod = builder.add_rod(points, radius=0.01, youngs=1e6, nu=0.3, density=1000.0)
    builder.fix(rod, nodes=[0])
    weight = builder.add_rigid(sw.Sphere(0.02), density=500.0, pose=(0.5, 0.0, 0.0))
    builder.attach(weight, to=rod, node=-1)
    return _last(sw.Simulation(builder.finalize(worlds, device=device), dt=0.005, **options))


def contact(worlds: int, **options: Any) -> Bits:
    """A box that slides on a plane."""
    builder = sw.ModelBuilder()
    floor = builder.add_rigid(sw.Plane(), kinematic=True)
    box = builder.add_rigid(sw.Box((0.1, 0.1, 0.1)), density=1000.0, pose=(0.0, 0.0, 0.0501))
    builder.add_contact(box, floor, mu=0.3)
    sim = sw.Simulation(builder.finalize(worlds), dt=0.01, **options)
    sim.body_twist[:, box, 0] = 0.5
    return _last(sim)


def static(worlds: int) -> Bits:
    """The equilibrium of a soft beam, found without graphs."""
    mesh = meshing.box((0.2, 0.03, 0.03), (4, 2, 2))
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    body = builder.add_tets(mesh, material=sw.Corotational(2e5, 0.4), density=1000.0)
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    sim = sw.Simulation(builder.finalize(worlds), dt=0.01)
    sim.solve_static()
    bits = _last(sim, steps=2)
    return bits | {"energy": sim.energy(), "stress": sim.node_stress()}


def env(name: str, worlds: int, **options: Any) -> Bits:
    """Random actions in an environment, and an episode that ends."""
    made = registry.make(name, num_worlds=worlds, seed=3, **options)
    data = made.reset()
    random = torch.Generator().manual_seed(1)
    for _ in range(3):
        action = made.action_spec.zero()
        drawn = torch.rand(action.shape, generator=random)
        data["action"] = (2 * drawn - 1) if made.action_size else (drawn * made.action_count).long()
        _, data = made.step_and_maybe_reset(data)
    made.reset_where(torch.ones(worlds, dtype=torch.bool))
    saved = made.snapshot()
    return {key: value.clone() for key, value in {**saved.tensors, **saved.sim.arrays}.items()}


SCENES: dict[str, Callable[[], Bits]] = {
    "trunk, large": lambda: trunk("large", 1),
    "trunk, large, lanes on two threads": lambda: trunk("large", 16, threads=2),
    "trunk, neo-Hookean": lambda: trunk("neo_hookean", 1),
    "rods": lambda: rods(1),
    "rods, lanes": lambda: rods(8),
    "contact": lambda: contact(1),
    "contact, Newton": lambda: contact(1, newton_iterations=3),
    "static": lambda: static(1),
    "cart and pole": lambda: env("CartPole", 2, settle=False),
    "cart and stem": lambda: env("CartStem", 1, settle=False),
}


def differing(first: Bits, second: Bits) -> list[str]:
    """Names of the arrays whose bits are not the same."""
    return [key for key in first if not torch.equal(first[key], second[key])]
