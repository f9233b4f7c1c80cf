"""What must not matter: numbering, units, reflections of the whole problem (catalogue 13.5, 13.6, 13.9)."""

from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from tests import cases

each_law = pytest.mark.parametrize("law", [*cases.LAWS, *cases.FITTED])


def pulled_beam(
    mesh: meshing.TetMesh,
    law: str,
    *,
    scale: float = 1.0,
    mirror: float = 1.0,
    precision: str = "float64",
    **options: Any,
) -> sw.Simulation:
    """A beam with a cable and gravity, in a length unit of 1/scale m (mass kg, time s), y times ``mirror``."""
    youngs, density = 2e5 / scale, 1000.0 / scale**3
    builder = sw.ModelBuilder(gravity=(0.0, mirror * 5.0 * scale, -9.81 * scale))
    body = builder.add_tets(mesh, material=cases.material(law, youngs, 0.3), density=density, rayleigh=(0.5, 0.01))
    builder.fix(body, nodes=np.flatnonzero(np.abs(mesh.nodes[:, 0]) < 1e-9))
    x = np.linspace(0.0, 0.2, 5)
    path = np.stack([x, np.full(5, 0.005), np.full(5, 0.02)], axis=1)
    builder.add_cable(body, path * scale * [1.0, mirror, 1.0])
    builder.add_marker(body, tuple(np.array([0.2, mirror * 0.015, 0.015]) * scale))
    sim = sw.Simulation(builder.finalize(precision=precision), dt=0.01, **options)
    sim.control.cable_displacement.fill_(0.004 * scale)
    return sim


def motion(sim: sw.Simulation, steps: int = 30) -> tuple[np.ndarray, np.ndarray]:
    """Positions of all nodes after every step, and the cable's tension."""
    nodes, tension = [], []
    for _ in range(steps):
        sim.step()
        nodes.append(sim.node_x[0].double().cpu().numpy().copy())
        tension.append(float(sim.cable_tension[0, 0]))
    return np.array(nodes), np.array(tension)


def beam() -> meshing.TetMesh:
    return meshing.box((0.2, 0.03, 0.03), (6, 2, 2))


@pytest.mark.parametrize(
    ("law", "precision", "tolerance"), cases.in_both_precisions([*cases.LAWS, *cases.FITTED], 1e-11, 2e-5)
)
def test_numbering_does_not_matter(law: str, precision: str, tolerance: float, rng: np.random.Generator) -> None:
    """Nodes and tets in another order, corners cyclically turned: the same motion to rounding (13.5)."""
    mesh = beam()
    order = rng.permutation(len(mesh.nodes))
    place = np.argsort(order)
    corners = np.array([[0, 1, 2, 3], [1, 2, 0, 3], [2, 0, 1, 3], [1, 0, 3, 2]])[rng.integers(4, size=len(mesh.tets))]
    tets = np.take_along_axis(place[mesh.tets], corners, axis=1)[rng.permutation(len(mesh.tets))]
    shuffled = meshing.TetMesh(mesh.nodes[order], tets.astype(np.int32))
    first, _ = motion(pulled_beam(mesh, law, precision=precision))
    second, _ = motion(pulled_beam(shuffled, law, precision=precision))
    assert np.abs(first[-1] - mesh.nodes).max() > 0.01
    assert np.abs(second[:, place] - first).max() < tolerance * 0.2


@pytest.mark.parametrize(
    ("law", "precision", "tolerance"), cases.in_both_precisions([*cases.LAWS, "large"], 1e-10, 1e-4)
)
@pytest.mark.parametrize("iterations", [1, 6])
def test_units_do_not_matter(law: str, precision: str, tolerance: float, iterations: int) -> None:
    """Millimetres instead of metres, with consistent units of stress, density and gravity: the same motion (13.6)."""
    mesh, scale = beam(), 1000.0
    large = meshing.TetMesh(mesh.nodes * scale, mesh.tets)
    options = {"precision": precision, "newton_iterations": iterations}
    first, tension = motion(pulled_beam(mesh, law, **options))
    second, scaled = motion(pulled_beam(large, law, scale=scale, **options))
    assert np.abs(second / scale - first).max() < tolerance * 0.2
    np.testing.assert_allclose(scaled / scale, tension, atol=10.0 * tolerance * tension.max())


@pytest.mark.parametrize("law", ["corot", "nh_log"])
def test_units_do_not_matter_for_statics(law: str) -> None:
    """The same for ``solve_static``: it must not hide a length or a time."""
    mesh, scale = beam(), 1000.0
    metres, millimetres = (
        pulled_beam(mesh, law),
        pulled_beam(meshing.TetMesh(mesh.nodes * scale, mesh.tets), law, scale=scale),
    )
    for sim in (metres, millimetres):
        assert bool(sim.solve_static(tolerance=1e-10).converged.all())
    assert float((millimetres.node_x / scale - metres.node_x).abs().max()) < 1e-8 * 0.2


@each_law
def test_mirrored_problem_gives_mirrored_motion(law: str) -> None:
    """Mesh, gravity and cable reflected in y = 0, two corners of every tet swapped (13.9)."""
    mesh = beam()
    reflected = meshing.TetMesh(mesh.nodes * [1.0, -1.0, 1.0], mesh.tets[:, [0, 2, 1, 3]])
    first, tension = motion(pulled_beam(mesh, law))
    second, mirrored = motion(pulled_beam(reflected, law, mirror=-1.0))
    assert np.abs(second * [1.0, -1.0, 1.0] - first).max() < 1e-11
    np.testing.assert_allclose(mirrored, tension, rtol=1e-8)


def test_dead_load_of_the_builder_equals_the_command() -> None:
    """``add_point_load(force=...)`` shares a total force equally; the same forces through ``control.node_force``."""
    mesh = beam()
    end = np.flatnonzero(cases.on_plane(mesh, 0, 0.2))
    positions = []
    for by_builder in (True, False):
        builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        body = builder.add_tets(mesh, material=sw.NeoHookean(2e5, 0.3), density=1000.0)
        builder.fix(body, nodes=np.flatnonzero(cases.on_plane(mesh, 0, 0.0)))
        if by_builder:
            builder.add_point_load(body, end, force=(0.0, 0.1, -0.2))
        sim = sw.Simulation(builder.finalize(precision="float64"))
        if not by_builder:
            sim.control.node_force[0, end] = torch.tensor([0.0, 0.1, -0.2], dtype=torch.float64) / len(end)
        sim.solve_static(tolerance=1e-11)
        positions.append(sim.node_x.clone())
    assert float((positions[0] - positions[1]).abs().max()) < 1e-12
    assert float((positions[0][0] - torch.tensor(mesh.nodes)).abs().max()) > 1e-3


def test_two_bodies_do_not_feel_each_other() -> None:
    """Two beams in one scene move as each alone, to rounding: bodies are coupled by nothing here."""
    mesh = beam()

    def scene(laws: list[str]) -> sw.Simulation:
        builder = sw.ModelBuilder()
        for law in laws:
            body = builder.add_tets(mesh, material=cases.material(law, 2e5, 0.3), density=1000.0, name=law)
            builder.fix(body, nodes=np.flatnonzero(cases.on_plane(mesh, 0, 0.0)))
        return sw.Simulation(builder.finalize(precision="float64"), dt=0.01)

    together, alone = scene(["nh_log", "large"]), [scene(["nh_log"]), scene(["large"])]
    for sim in (together, *alone):
        for _ in range(20):
            sim.step()
    start = together.model.body_node_start
    for i, sim in enumerate(alone):
        part = together.node_x[0, int(start[i]) : int(start[i + 1])]
        assert float((part - sim.node_x[0]).abs().max()) < 1e-12


def test_parameters_per_world_equal_the_builders() -> None:
    """A modulus, density, damping or gravity set in ``sim.params`` acts as if the scene had been built with it."""
    mesh = beam()

    def scene(
        youngs: float, density: float, rayleigh: tuple[float, float], gravity: float, worlds: int
    ) -> sw.Simulation:
        builder = sw.ModelBuilder(gravity=(0.0, 0.0, gravity))
        material = sw.NeoHookean(youngs, 0.3)
        body = builder.add_tets(mesh, material=material, density=density, rayleigh=rayleigh)
        builder.fix(body, nodes=np.flatnonzero(cases.on_plane(mesh, 0, 0.0)))
        return sw.Simulation(builder.finalize(num_worlds=worlds, precision="float64"), dt=0.01)

    varied = scene(2e5, 1000.0, (0.5, 0.01), -9.81, 5)
    reference = [scene(2e5, 1000.0, (0.5, 0.01), -9.81, 1)]
    varied.params.youngs[1] = 3e5
    reference.append(scene(3e5, 1000.0, (0.5, 0.01), -9.81, 1))
    varied.params.density[2] = 700.0
    reference.append(scene(2e5, 700.0, (0.5, 0.01), -9.81, 1))
    varied.params.rayleigh_mass[3], varied.params.rayleigh_stiffness[3] = 2.0, 0.05
    reference.append(scene(2e5, 1000.0, (2.0, 0.05), -9.81, 1))
    varied.params.gravity[4, 2] = -3.0
    reference.append(scene(2e5, 1000.0, (0.5, 0.01), -3.0, 1))
    for sim in (varied, *reference):
        for _ in range(15):
            sim.step()
    for world, sim in enumerate(reference):
        assert float((varied.node_x[world] - sim.node_x[0]).abs().max()) < 1e-12
        assert world == 0 or float((varied.node_x[world] - varied.node_x[0]).abs().max()) > 1e-5
