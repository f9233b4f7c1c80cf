"""Reactions of supports and carriers: they balance weight and loads at rest, as forces and as moments."""

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from tests import cases

G = 9.81


def end(x: np.ndarray) -> np.ndarray:
    """Faces at the far end of a beam of 0.1 m."""
    return x[:, 0] > 0.0999


def moment(x: torch.Tensor, force: torch.Tensor, about: torch.Tensor) -> torch.Tensor:
    """Moment [N m] of forces at points, (point, 3) each, about a place."""
    return torch.linalg.cross(x - about, force).sum(dim=0)


@pytest.mark.parametrize("element", ["p1", "p2"])
def test_clamped_beam_with_traction_and_cable(element):
    """Sum of forces -(weight + t A + T u), u the cable's pull at its way out; of moments likewise, at large deflection.

    A cable that passes a fixed node pulls at that node too, so all of its pull comes back.
    """
    builder = sw.ModelBuilder()
    mesh = meshing.box((0.1, 0.02, 0.02), (5, 2, 2))
    body = builder.add_tets(mesh, material=sw.NeoHookean(1e5, 0.3), density=1000.0, element=element)
    builder.fix(body, box=((-1e-9, -1.0, -1.0), (1e-9, 1.0, 1.0)))
    builder.add_traction(body, (20.0, 10.0, 50.0), where=end)
    points = [(x, 0.011, 0.015) for x in (0.0, 0.03, 0.07)]
    builder.add_cable(body, points, (-0.02, 0.01, 0.03), control="force")
    sim = sw.Simulation(builder.finalize(2, precision="float64"))
    sim.control.cable_tension[1] = 0.2
    assert bool(sim.solve_static().converged.all())
    reactions = sim.reactions()
    weight = -0.04 * G
    for world, tension in enumerate((0.0, 0.2)):
        pull = sim.cable_x[world, 0] - sim.cable_x[world, 1]
        pull = tension * pull / pull.norm()
        expected = -(np.array([20.0, 10.0, 50.0]) * 4e-4 + [0.0, 0.0, weight] + pull.numpy())
        np.testing.assert_allclose(reactions.total()[world], expected, atol=1e-9)
    assert not reactions.node[:, torch.from_numpy(~sim.model.node_fixed)].any()

    x, origin = sim.node_x[0], torch.zeros(3, dtype=torch.float64)
    outer = sim.internal_force()[0] - reactions.node[0]  # all loads of world 0, by equilibrium
    balance = moment(x, reactions.node[0], origin) + moment(x, outer, origin)
    np.testing.assert_allclose(balance, 0.0, atol=1e-9)
    np.testing.assert_allclose(outer.sum(dim=0), -reactions.total()[0], atol=1e-9)


def test_locked_axes_and_chamber():
    """An eighth of a cube in tension: planes of symmetry carry p A each and nothing along them; a chamber adds nothing.

    The chamber's wall lies on fixed nodes as well, whose share of the pressure sums to zero with all others.
    """
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    mesh = meshing.box((0.1, 0.1, 0.1), (2, 2, 2))
    body = builder.add_tets(mesh, material=sw.StableNeoHookean(1e5, 0.3), density=1000.0)
    for axis in range(3):
        builder.fix(body, nodes=np.flatnonzero(mesh.nodes[:, axis] < 1e-9), axes="xyz"[axis])
    builder.add_traction(body, (1e3, 0.0, 0.0), where=lambda x: x[:, 0] > 0.0999)
    sim = sw.Simulation(builder.finalize(precision="float64"))
    sim.solve_static()
    reactions = sim.reactions()
    np.testing.assert_allclose(reactions.total()[0], [-10.0, 0.0, 0.0], atol=1e-9)
    assert not reactions.node[0, torch.from_numpy(mesh.nodes[:, 0] > 1e-9), 0].any()

    hollow = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = hollow.add_tets(mesh, material=sw.NeoHookean(1e5, 0.3), density=1000.0)
    hollow.fix(body, nodes=np.flatnonzero(mesh.nodes[:, 2] < 0.06))
    hollow.add_cavity(body, *meshing.compact(mesh.nodes, mesh.surface()))
    sim = sw.Simulation(hollow.finalize(precision="float64"))
    sim.control.cavity_pressure[:] = 1e3
    assert bool(sim.solve_static().converged.all())
    reaction = sim.reactions()
    np.testing.assert_allclose(reaction.total()[0], 0.0, atol=1e-6)
    assert float(reaction.node.abs().max()) > 0.5


def test_carriers_rods_and_joints():
    """A kinematic body that carries a block and a hinged rod: weight of all of it, and its moment about the body."""
    builder = sw.ModelBuilder()
    carrier = builder.add_rigid(sw.Box((0.02, 0.02, 0.02)), kinematic=True, pose=(0.0, 0.0, 0.1))
    mesh = meshing.box((0.04, 0.02, 0.02), (2, 1, 1))
    mesh = meshing.TetMesh(mesh.nodes + (0.02, -0.01, 0.09), mesh.tets)
    body = builder.add_tets(mesh, material=sw.Corotational(1e5, 0.3), density=1000.0)
    builder.attach(body, nodes=np.flatnonzero(mesh.nodes[:, 0] < 0.0201), to=carrier)
    hanging = builder.add_rigid(mass=0.05, inertia=(1e-5,) * 3, pose=(-0.03, 0.0, 0.1))
    builder.add_joint(carrier, hanging, "weld", anchor=(-0.03, 0.0, 0.1))
    rod = builder.add_rod(np.linspace((0.3, 0.0, 0.0), (0.4, 0.0, 0.0), 5), radius=0.004, youngs=1e8, density=1000.0)
    builder.fix(rod, nodes=[0])
    cart = builder.add_rigid(mass=0.2, inertia=(1e-4,) * 3, pose=(1.0, 0.0, 0.0), free_axes="x")
    sim = sw.Simulation(builder.finalize(precision="float64"))
    sim.control.body_force[:, int(cart), 1] = 0.7
    assert bool(sim.solve_static().converged.all())
    reactions = sim.reactions()
    block = 1000.0 * 0.04 * 0.02 * 0.02
    np.testing.assert_allclose(reactions.body[0, 0, :3], [0.0, 0.0, (block + 0.05) * G], atol=1e-6)
    centre = (sim.mass[0, :, None] * sim.node_x[0]).sum(dim=0) / block
    lever = (block * centre + 0.05 * sim.body_pose[0, int(hanging), :3]) * G  # the body stands at x = y = 0
    np.testing.assert_allclose(reactions.body[0, 0, 3:], [lever[1], -lever[0], 0.0], atol=1e-8)
    mass = 1000.0 * np.pi * 0.004**2 * 0.1
    np.testing.assert_allclose(reactions.rod[0, 0, :3], [0.0, 0.0, mass * G], rtol=1e-5, atol=1e-9)
    x = sim.rod_x[0, :, 0] - sim.rod_x[0, 0, 0]
    sag = mass * G * float(torch.trapezoid(x, dx=0.25))
    np.testing.assert_allclose(reactions.rod[0, 0, 4], -sag, rtol=1e-4)
    assert not reactions.rod[0, 1:].any() and not reactions.body[0, int(hanging)].any()
    np.testing.assert_allclose(reactions.body[0, int(cart), :3], [0.0, -0.7, 0.2 * G], atol=1e-6)


def test_floor_bears_what_rests_on_it():
    """A kinematic floor under a soft cube, and a kinematic shelf under a box: weights, at their centres."""
    builder = sw.ModelBuilder()
    floor = builder.add_rigid(sw.Plane(), kinematic=True)
    shelf = builder.add_rigid(sw.Box((0.2, 0.2, 0.02)), kinematic=True, pose=(1.0, 0.0, 0.5))
    box = builder.add_rigid(sw.Box((0.04, 0.04, 0.04)), mass=0.3, pose=(1.05, 0.0, 0.53))
    mesh, damped = meshing.box((0.05,) * 3, (2, 2, 2)), {"density": 1000.0, "rayleigh": (20.0, 0.0)}
    cube = builder.add_tets(mesh, material=sw.Corotational(1e5, 0.3), **damped)
    builder.add_contact(cube, floor, mu=0.5)
    builder.add_contact(box, shelf, mu=0.5)
    sim = sw.Simulation(builder.finalize(precision="float64"))
    sim.step(100)
    reactions = sim.reactions().body[0]
    np.testing.assert_allclose(reactions[0, :3], [0.0, 0.0, 0.125 * G], atol=1e-5)
    np.testing.assert_allclose(reactions[1, :3], [0.0, 0.0, 0.3 * G], atol=1e-5)
    np.testing.assert_allclose(reactions[1, 4], -0.05 * 0.3 * G, atol=1e-5)


@pytest.mark.parametrize("path", ["scalar", "lanes"])
def test_batches_and_steps(path):
    """World i of a batch has the bits of it alone; in motion the workspace of the steps is left as they need it."""

    def swinging(worlds: int) -> sw.Simulation:
        mesh = meshing.box((0.1, 0.02, 0.02), (4, 1, 1))
        options = {"gravity": (0.0, 0.0, -G), "fixed": cases.on_plane(mesh, 0, 0.0), "precision": "float32"}
        return cases.body(mesh, "large", 1e5, 0.3, num_worlds=worlds, solver_path=path, **options).sim

    several, alone, plain = swinging(9), swinging(1), swinging(9)
    several.control.node_force[1, -1, 0] = 0.1
    plain.control.node_force[1, -1, 0] = 0.1
    for _ in range(3):
        for sim in (several, alone, plain):
            sim.step()
        seen = several.reactions()
    assert torch.equal(seen.node[8], alone.reactions().node[0])
    assert not torch.equal(seen.node[8], seen.node[1])
    assert torch.equal(several.node_x, plain.node_x)
