"""``Corotational(method="warped")``: the polar rotation by iteration, linear and quadratic elements."""

from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from tests import cases
from tests.contract.batch_checks import assert_same

SIZE, CELLS, SPACING = (0.2, 0.1, 0.15), (3, 2, 2), 0.05  # m

each_element = pytest.mark.parametrize("element", ["p1", "p2"])


def block(element: str, law: str, rng: np.random.Generator, strain: float, **options: Any) -> cases.Case:
    """An irregular block, turned, with every node moved by a share of the spacing."""
    mesh: Any = cases.jittered(meshing.box(SIZE, CELLS), 0.2 * SPACING, rng)
    if element == "p2":
        mesh = meshing.elevate(mesh)
    case = cases.body(mesh, law, 1e5, 0.4, **options)
    step = strain * SPACING * (1.0 if element == "p1" else 0.3)
    case.move((mesh.nodes + rng.uniform(-step, step, mesh.nodes.shape)) @ cases.random_rotation(rng).T)
    return case


@each_element
@pytest.mark.parametrize("strain", [0.02, 0.2])
@pytest.mark.parametrize(
    ("precision", "tolerance"), [("float64", 1e-12), pytest.param("float32", 1e-4, marks=pytest.mark.slow)]
)
def test_forces_are_those_of_polar(element: str, strain: float, precision: str, tolerance: float) -> None:
    """The same rotation as the singular value decomposition gives, to rounding."""
    force = [
        block(element, law, np.random.default_rng(3), strain, precision=precision).internal_force()
        for law in ("warped", "corot")
    ]
    assert np.abs(force[0] - force[1]).max() < tolerance * max(np.abs(force[1]).max(), 1e5 * SPACING**2 * 0.02)


def test_lanes_are_scalars() -> None:
    """Eight worlds in lanes and one by one, to rounding; worlds do not depend on each other, to the bit."""

    def run(count: int, path: str) -> dict[str, torch.Tensor]:
        builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
        mesh = meshing.box((0.2, 0.03, 0.03), (5, 1, 1))
        body = builder.add_tets(mesh, material=sw.Corotational(1e5, 0.4, method="warped"), density=1000.0, element="p2")
        builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
        sim = sw.Simulation(builder.finalize(count), dt=0.01, solver_path=path)
        sim.params.gravity[:, 2] = -torch.linspace(2.0, 10.0, 9)[:count]
        for _ in range(30):
            sim.step()
        return {"node_x": sim.node_x.clone()}

    lanes, scalar = run(9, "lanes"), run(9, "scalar")
    assert float((lanes["node_x"] - scalar["node_x"]).abs().max()) < 1e-5
    assert_same(run(2, "lanes"), lanes, [0, 1], [0, 1])
    assert_same(run(2, "scalar"), scalar, [0, 1], [0, 1])


def test_an_inverted_element_comes_back() -> None:
    """A tet pushed through its base has a finite force, a rotation, and recovers in free motion."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    nodes = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    body = builder.add_tets(
        nodes, [[0, 1, 2, 3]], material=sw.Corotational(1e4, 0.3, method="warped"), density=1e3, rayleigh=(5.0, 0.0)
    )
    builder.fix(body, nodes=[0, 1, 2])
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01)
    sim.node_x[0, 3, 2] = -0.05
    sim.refresh()
    for _ in range(300):
        sim.step()
    assert int(sim.status[0]) == sw.Status.OK
    np.testing.assert_allclose(sim.node_x[0, 3], nodes[3], atol=1e-4)


@pytest.mark.parametrize("element", ["p1", pytest.param("p2", marks=pytest.mark.slow)])
def test_statics_are_those_of_polar(element: str) -> None:
    """The exact tangent of the static solve: the same equilibrium as polar in as many iterations, large bending."""
    mesh: Any = meshing.box((1.0, 0.1, 0.1), (10, 1, 1))
    if element == "p2":
        mesh = meshing.elevate(mesh)
    found = []
    for law in ("warped", "corot"):
        case = cases.body(mesh, law, 1e6, 0.3, fixed=cases.on_plane(mesh, 0, 0.0))
        end = cases.on_plane(mesh, 0, 1.0)
        case.load(np.outer(end / end.sum(), (0.0, 0.0, -25.0)))
        result = case.sim.solve_static(tolerance=1e-9)
        assert bool(result.converged.all())
        found.append((case.positions(), result.iterations))
    np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-8)
    assert found[0][1] <= found[1][1] + 2
    assert (mesh.nodes - found[0][0])[:, 2].max() > 0.2


@each_element
def test_energy_and_tangent_of_a_step(element: str, rng: np.random.Generator) -> None:
    """The energy is polar's; the tangent of steps is semidefinite and exact at rest."""
    energy = [
        float(block(element, law, np.random.default_rng(5), 0.1).sim.elastic_energy()[0]) for law in ("warped", "corot")
    ]
    assert energy[0] == pytest.approx(energy[1], rel=1e-13)
    bent = block(element, "warped", rng, 0.2)
    values = np.linalg.eigvalsh(bent.sim.stiffness_matrix().toarray())
    assert values.min() > -1e-10 * values.max()
    rest = [block(element, law, np.random.default_rng(7), 0.0) for law in ("warped", "corot")]
    K = [case.sim.stiffness_matrix() for case in rest]
    assert abs(K[0] - K[1]).max() < 1e-10 * abs(K[1]).max()
