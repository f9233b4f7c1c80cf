"""Bodies on rods and rods on bodies: what rods carry and what drives them.

Numbers are those of the validation catalogue, sections 4 and 5, unless a formula is given.
"""

from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from tests import rod_cases as rods

EI = rods.bending()
X = (1.0, 0.0, 0.0)


@pytest.mark.parametrize("lever", [0.0, 0.1])
def test_weight_on_the_tip(lever: float) -> None:
    """A rigid body on the end bends the rod like a dead force m g at its centre: with a lever, also by its moment."""
    options: dict[str, Any] = {"radius": rods.RADIUS, "youngs": rods.YOUNGS, "nu": rods.NU, "density": 0.0}
    points = meshing.straight(1.0, 20, direction=X)
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    rod = builder.add_rod(points, **options)
    builder.fix(rod, nodes=[0])
    weight = EI
    body = builder.add_rigid(mass=weight / 9.81, inertia=(1e-8, 1e-8, 1e-8), pose=(1.0 + lever, 0.0, 0.0))
    builder.attach(body, to=rod, node=-1)
    loaded = sw.Simulation(builder.finalize(precision="float64"))
    rods.settle(loaded)
    arm = float(loaded.body_pose[0, 0, 0] - loaded.rod_x[0, -1, 0])
    assert arm == pytest.approx(lever * rods.rotations(loaded)[-1].apply([0.0, 0.0, 1.0])[0], abs=1e-12)
    sim = rods.scene(points, **options)
    rods.pull(sim, -1, (0.0, 0.0, -weight), (0.0, weight * arm, 0.0))
    rods.settle(sim)
    assert np.abs(rods.positions(loaded) - rods.positions(sim)).max() < 1e-6


def driven(segments: int = 12, **simulation: Any) -> sw.Simulation:
    """A rod along x on a kinematic body at the origin."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    rod = builder.add_rod(
        meshing.straight(0.5, segments, direction=X),
        radius=rods.RADIUS,
        youngs=rods.YOUNGS,
        nu=rods.NU,
        density=rods.DENSITY,
        rayleigh=(0.0, 0.5),
    )
    base = builder.add_rigid(kinematic=True, pose=(-0.1, 0.0, 0.0))
    builder.attach(rod, nodes=[0], to=base)
    return sw.Simulation(builder.finalize(precision="float64"), **simulation)


@pytest.mark.parametrize("iterations", [1, 8])
def test_body_at_rest_clamps_a_rod(iterations: int) -> None:
    """A kinematic body that stays where it is equals a clamp, to rounding."""
    options = {"dt": 0.01, "newton_iterations": iterations}
    held = driven(**options)
    clamped = rods.scene(meshing.straight(0.5, 12, direction=X), rayleigh=(0.0, 0.5), simulation=options)
    for sim in (held, clamped):
        rods.pull(sim, -1, (0.0, 0.003, -0.01), (0.002, 0.0, 0.0))
        for _ in range(30):
            sim.step()
    assert float(clamped.rod_x[0, -1, 2]) < -0.005
    assert float((held.rod_x - clamped.rod_x).abs().max()) < 1e-11
    assert float((held.rod_q - clamped.rod_q).abs().max()) < 1e-11
    assert float((held.rod_w - clamped.rod_w).abs().max()) < 1e-8


def test_base_turns_a_rod() -> None:
    """A base that moves and turns by 90 degrees takes the rod along, which comes to rest unbent."""
    sim = driven(dt=0.01)
    for step in range(60):
        share = min(1.0, step / 50.0)
        half = 0.25 * np.pi * share
        sim.control.body_pose[0, 0] = torch.tensor([-0.1, 0.2 * share, 0.0, 0.0, 0.0, np.sin(half), np.cos(half)])
        sim.step()
    turned = [-0.1, 0.2, 0.0, 0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]
    assert sim.body_pose[0, 0].tolist() == pytest.approx(turned, abs=1e-12)
    assert rods.positions(sim)[0] == pytest.approx([-0.1, 0.3, 0.0], abs=1e-12)
    y = 0.3 + np.linspace(0.0, 0.5, 13)
    straight = np.stack([0.0 * y - 0.1, y, 0.0 * y], axis=1)
    assert np.abs(rods.positions(sim) - straight).max() > 0.01  # it swings
    rods.settle(sim)
    assert np.abs(rods.positions(sim) - straight).max() < 1e-7


def test_base_that_accelerates() -> None:
    """In a frame that accelerates with a, a rod hangs as under the gravity -a. Backward Euler keeps a exactly."""
    acceleration, h = 1.0, 0.03
    sim = driven(dt=h, newton_iterations=10)
    position, speed = 0.0, 0.0
    for _ in range(600):
        speed += h * acceleration
        position += h * speed
        sim.control.body_pose[0, 0, 2] = position
        sim.step()
    hung = rods.scene(meshing.straight(0.5, 12, direction=X), gravity=(0.0, 0.0, -acceleration))
    rods.settle(hung)
    assert rods.positions(hung)[-1, 2] < -0.1
    assert np.abs(rods.positions(sim) - [0.0, 0.0, position] - rods.positions(hung)).max() < 1e-6


def test_commanded_jump_is_no_divergence() -> None:
    """A kinematic base that is commanded far away in one step takes its rod along; the world stays good."""
    sim = driven(dt=0.01, newton_iterations=8)
    sim.control.body_pose[0, 0, :3] = torch.tensor([49.9, -20.0, 3.0])
    sim.step()
    assert int(sim.status[0]) <= sw.Status.MAX_ITERATIONS
    assert sim.body_pose[0, 0, :3].tolist() == pytest.approx([49.9, -20.0, 3.0])
    assert sim.rod_x[0, 0].tolist() == pytest.approx([50.0, -20.0, 3.0])
