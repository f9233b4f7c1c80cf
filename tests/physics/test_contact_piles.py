"""Piles of rigid bodies: stacks, many solutions or none, energy of what is left alone (catalogue 7.8, 7.13)."""

import itertools
from typing import Any

import numpy as np
import pytest

import softwarp as sw
from softwarp import meshing
from tests import contact_cases as cases
from tests.cases import in_float64, quick
from tests.contact_cases import G, array, contacts, pair, run

both = pytest.mark.parametrize("precision", ["float64", "float32"])


@pytest.mark.parametrize(
    ("precision", "worlds", "dt"),
    quick(
        [(*kind, dt) for kind in (("float64", 1), ("float32", 1), ("float32", 9)) for dt in (0.01, 0.002)],
        lambda *case: case == ("float32", 1, 0.01),
    ),
)
def test_stack_of_ten(precision: str, worlds: int, dt: float) -> None:
    """10 s: penetration < 1e-4 of the size, drift < 1e-3 of it, the floor carries 10 m g (7.8)."""
    size = 0.1
    model, cubes, floor = cases.pile(10, size, precision=precision, worlds=worlds)
    sim = sw.Simulation(model, dt=dt)
    deepest, weight = 0.0, []
    for step in range(int(10.0 / dt)):
        run(sim, 1)
        if step % 10 == 0:
            deepest = min(deepest, float(np.diff(array(sim.body_pose[:, :, 2]), axis=1)[:, 1:].min()) - size)
            weight.append(array(sim.contact_force(cubes[0], floor)))
    assert deepest > -1e-4 * size
    pose = array(sim.body_pose[:, 1:])
    assert np.abs(pose[:, :, :2]).max() < 1e-3 * size
    assert np.abs(pose[:, :, 2] - size * (np.arange(10) + 0.5)).max() < 1e-4 * size
    np.testing.assert_allclose(np.mean(weight, axis=(0, 1)), (0, 0, 98.1), atol=0.1)


def test_stack_does_not_rock() -> None:
    """Ten boxes in float32 at 2 ms: rounding taken for motion would be speeds beyond 1.5 mm/s or mrad/s.

    A metre up coordinates round by 6e-8 m, in 2 ms and at a lever of 50 mm by 0.6 mrad/s. In float64 it is 1e-6 in all.
    """
    model, _, _ = cases.pile(10, 0.1, precision="float32")
    sim = sw.Simulation(model, dt=0.002)
    fastest = 0.0
    for _ in range(300):
        run(sim, 1)
        fastest = max(fastest, float(sim.body_twist[0, 1:].abs().max()))
    assert fastest < 1.5e-3


@in_float64("count", [2, 3], single=1)
def test_heavy_on_light(count: int, precision: str) -> None:
    """A cube of hundredfold mass on light ones: they stand, hardly penetrate and carry it (7.8)."""
    size = 0.1
    model, cubes, floor = cases.pile(count, size, heavy=100.0, precision=precision)
    sim = sw.Simulation(model, dt=0.01)
    run(sim, 500)
    pose = array(sim.body_pose[0, 1:])
    assert np.abs(pose[:, :2]).max() < 1e-3 * size
    assert np.abs(pose[:, 2] - size * (np.arange(count) + 0.5)).max() < 1e-4 * size
    assert float(sim.contact_force(cubes[0], floor)[0, 2]) == pytest.approx((99 + count) * G, rel=2e-3)


@both
def test_chair_on_four_legs(precision: str) -> None:
    """16 corners under four legs carry m g in one of many ways: finite, inside the cone, right in sum (7.13)."""
    legs = [(sw.Box((0.04, 0.04, 0.4)), (x, y, 0.2)) for x in (-0.2, 0.2) for y in (-0.2, 0.2)]
    chair = sw.Compound([(sw.Box((0.5, 0.5, 0.04)), (0, 0, 0.42)), *legs])
    for mu in (0.0, 0.5, 5.0):
        sim, body, ground = pair(sw.Plane(), chair, (0, 0, 0.02), mu=mu, precision=precision, rigid={"density": 600})
        run(sim, 200)
        weight = chair.inertia(density=600.0).mass * G
        seen = contacts(sim)
        normal, tangent = seen["load"][:, 2], np.linalg.norm(seen["load"][:, :2], axis=1)
        assert (normal >= 0.0).all()
        assert (tangent <= mu * normal * (1 + 1e-5) + 1e-9).all()
        np.testing.assert_allclose(array(sim.contact_force(body, ground))[0], (0, 0, weight), atol=1e-5 * weight)
        moment = np.cross(seen["point"] - array(sim.body_pose[0, body, :3]), seen["load"]).sum(axis=0)
        np.testing.assert_allclose(moment[:2], 0.0, atol=2e-4 * weight)
        assert np.abs(array(sim.body_twist[0, body])).max() < 1e-6


@pytest.mark.parametrize(
    ("lean", "mu", "precision"),
    quick(
        itertools.product((-0.6, 0.6, 1.0), (0.5, 1.4, 3.0), ("float64", "float32")),
        lambda lean, mu, precision: precision == "float64" or (lean, mu) == (0.6, 1.4),
    ),
)
def test_painleve_rod(lean: float, mu: float, precision: str) -> None:
    """A rod slides on its end, also where accelerations have no solution: finite, in the cone, no energy gained (7.13).

    An implicit step has a solution in any case: the rod's end takes an impulse and jams.
    """
    shape, start = sw.Box((0.01, 0.01, 1.0)), 1.0
    turn = (0.0, np.sin(lean / 2), 0.0, np.cos(lean / 2))
    lift = -cases.turned(turn, shape.surface()[0])[:, 2].min()
    rigid = {"velocity": (start, 0, 0, 0, 0, 0)}
    sim, body, _ = pair(
        sw.Plane(), shape, (0, 0, lift, *turn), mu=mu, precision=precision, options={"dt": 0.002}, rigid=rigid
    )
    properties = shape.inertia(density=1000.0)
    bodies = {int(body): (properties.mass, properties.inertia)}
    first = last = cases.energy(sim, bodies)
    for _ in range(600):
        run(sim, 1)
        seen = contacts(sim)
        normal = np.einsum("ij,ij->i", seen["load"], seen["normal"])
        tangent = np.linalg.norm(seen["load"] - normal[:, None] * seen["normal"], axis=1)
        assert (tangent <= mu * normal * (1 + 1e-5) + 1e-6).all()
        now = cases.energy(sim, bodies)
        assert now < last + 1e-3 * first
        last = now
    assert float(sim.body_pose[0, body, 2]) == pytest.approx(0.005, abs=1e-6)
    # Coordinates of half a metre round by 3e-8 m in float32: in 2 ms at a lever of 5 mm, 3e-3 rad/s of rolling.
    assert np.abs(array(sim.body_twist[0, body])).max() < (1e-3 if precision == "float64" else 5e-3)


@pytest.mark.slow
@both
@pytest.mark.parametrize("passes", [0, 1])
@pytest.mark.parametrize("seed", [2, 3])
@pytest.mark.parametrize("mu", [0.0, 0.5])
def test_passive_pile_gains_no_energy(mu: float, seed: int, passes: int, precision: str) -> None:
    """Twelve bodies of all shapes fall into a bin: kinetic plus potential energy never rises, and nothing leaves.

    A step without ``contact_passes`` gains 1e-7 of the first energy at most in float64. A pass brings bodies out of
    what the step would end in: single impacts gain up to 1.4e-4 by that, and 1.1e-3 in the worst of 24 other piles; in
    float32 up to 1.5e-4 without it too.
    """
    generator = np.random.default_rng(seed)
    makers: list[Any] = [sw.Box((0.08, 0.06, 0.05)), sw.Sphere(0.035), sw.Capsule(0.025, 0.06), sw.Cylinder(0.03, 0.06)]
    builder = sw.ModelBuilder()
    ground = [builder.add_rigid(sw.Plane(), kinematic=True)]
    for axis in (0, 1):
        for side in (-1, 1):
            angle = side * np.pi / 2
            turn = (
                (0, -np.sin(angle / 2), 0, np.cos(angle / 2))
                if axis == 0
                else (np.sin(angle / 2), 0, 0, np.cos(angle / 2))
            )
            place = np.zeros(3)
            place[axis] = 0.15 * side
            ground.append(builder.add_rigid(sw.Plane(), kinematic=True, pose=(*place, *turn)))
    bodies: dict[int, tuple[float, np.ndarray]] = {}
    for i in range(12):
        q = generator.standard_normal(4)
        place = (*generator.uniform(-0.06, 0.06, 2), 0.1 + 0.11 * i)
        shape = makers[i % 4]
        body = builder.add_rigid(shape, density=1000, pose=(*place, *(q / np.linalg.norm(q))))
        properties = shape.inertia(density=1000.0)
        for other in (*ground, *bodies):
            builder.add_contact(body, other, mu=mu)
        bodies[body] = (properties.mass, properties.inertia)
    sim = sw.Simulation(builder.finalize(1, precision=precision, contact_capacity=200), dt=0.005, contact_passes=passes)
    first = last = cases.energy(sim, bodies)
    rise = 0.0
    for _ in range(600):
        run(sim, 1)
        now = cases.energy(sim, bodies)
        rise, last = max(rise, now - last), now
        pose = array(sim.body_pose[0, 5:])
        assert (np.abs(pose[:, :2]) < 0.15).all()
        assert (pose[:, 2] > 0.0).all()
    assert rise < (1e-6 if passes == 0 and precision == "float64" else 2e-4) * first
    assert last < 0.3 * first


@pytest.mark.slow
def test_passive_pile_never_gains_energy() -> None:
    """Boxes, balls, a rod and a soft cube fall on each other: the total energy only falls."""
    builder = sw.ModelBuilder()
    cube = cases.placed(meshing.box((0.1,) * 3, (2,) * 3), (-0.05, -0.05, 0.45))
    floor = builder.add_rigid(sw.Plane(), kinematic=True)
    parts = [builder.add_rigid(sw.Box((0.1, 0.08, 0.06)), mass=0.5, pose=(0.0, 0.0, 0.2))]
    parts.append(builder.add_rigid(sw.Sphere(0.05), mass=0.5, pose=(0.03, 0.02, 0.35)))
    parts.append(builder.add_tets(cube, material=sw.NeoHookean(5e4, 0.3), density=1000.0))
    points = np.linspace((-0.2, 0.0, 0.65), (0.2, 0.0, 0.65), 9)
    parts.append(builder.add_rod(points, radius=0.01, youngs=1e6, density=1000.0))
    for i, part in enumerate(parts):
        builder.add_contact(part, floor, mu=0.5)
        for other in parts[:i]:
            builder.add_contact(part, other, mu=0.5)
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.002)
    energy = start = sim.energy().item()
    for _ in range(400):
        sim.step()
        assert sim.energy().item() <= energy + 1e-4 * start
        energy = sim.energy().item()
    assert energy < 0.5 * start
    assert (sim.status == 0).all()
