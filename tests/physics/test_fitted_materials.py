"""Yeoh, Mooney-Rivlin and Ogden in the simulator: a block in tension, tangents, parameters per world."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.optimize
import torch

import softwarp as sw
from softwarp import meshing
from tests import cases

YOUNGS, NU, STRETCH = 6e4, 0.45, 1.5
CUBE = meshing.box((1.0, 1.0, 1.0), (1, 1, 1))

each_law = pytest.mark.parametrize("law", cases.FITTED)
yeoh_first = pytest.mark.parametrize(
    "law", ["yeoh", *(pytest.param(law, marks=pytest.mark.slow) for law in ("mooney_rivlin", "ogden"))]
)
each_element = pytest.mark.parametrize("element", ["p1", "p2"])


def cube(law: str, element: str = "p1", fixed: Any = None, **options: Any) -> cases.Case:
    """A cube of 1 m without gravity."""
    mesh = CUBE if element == "p1" else meshing.elevate(CUBE.nodes, CUBE.tets)
    return cases.body(mesh, law, YOUNGS, NU, fixed=fixed, **options)


def uniaxial(law: str) -> tuple[float, float]:
    """Nominal stress [Pa] and lateral stretch at ``STRETCH`` with free sides, from the law at one point."""
    solid = cases.material(law, YOUNGS, NU)
    free = lambda side: float(solid.stress(np.diag([STRETCH, side, side]))[1, 1])  # noqa: E731
    side = float(scipy.optimize.brentq(free, 0.5, 1.2, xtol=1e-14))
    return float(solid.stress(np.diag([STRETCH, side, side]))[0, 0]), side


@yeoh_first
@each_element
def test_block_in_uniaxial_tension(law: str, element: str) -> None:
    """A cube that three corners hold is pulled by P A = P [N]; it takes the stretch and sides of the closed form.

    The corners are held where uniform stretch brings them, so that they carry nothing.
    """
    pull, side = uniaxial(law)
    held = [int(np.argmin(np.linalg.norm(CUBE.nodes - at, axis=1))) for at in ((0, 0, 0), (0, 1, 0), (0, 0, 1))]
    case = cube(law, element, np.array(held))
    expected = case.mesh.nodes * [STRETCH, side, side]
    case.move(expected)
    force = case.internal_force()
    ends = cases.on_plane(case.mesh, 0, 1.0)
    np.testing.assert_allclose(force[ends].sum(axis=0), [pull, 0.0, 0.0], atol=1e-9 * pull)
    np.testing.assert_allclose(force[~(ends | cases.on_plane(case.mesh, 0, 0.0))], 0.0, atol=1e-9 * pull)

    case.load(np.where(np.arange(3) == 0, force, 0.0))
    start = case.mesh.nodes.copy()
    start[held] = expected[held]
    case.move(start)
    result = case.sim.solve_static()
    assert result.converged.all()
    np.testing.assert_allclose(case.positions(), expected, atol=1e-7)


@each_law
@each_element
def test_stiffness_is_the_derivative_of_the_force(law: str, element: str, rng: np.random.Generator) -> None:
    """K by central differences of dE/dx with step 1e-6, without projection; energy against force likewise."""
    case = cube(law, element, project_tangent=False)
    x = case.mesh.nodes * [1.2, 0.9, 1.05] + 0.02 * rng.standard_normal(case.mesh.nodes.shape)
    direction = rng.standard_normal(x.shape)
    case.move(x)
    product = (case.sim.stiffness_matrix() @ direction.ravel()).reshape(x.shape)
    force = case.internal_force()
    sides = []
    for sign in (1.0, -1.0):
        case.move(x + sign * 1e-6 * direction)
        sides.append((case.internal_force(), float(case.sim.elastic_energy()[0])))
    difference = (sides[0][0] - sides[1][0]) / 2e-6
    np.testing.assert_allclose(product, difference, atol=1e-6 * np.abs(product).max())
    assert (sides[0][1] - sides[1][1]) / 2e-6 == pytest.approx((force * direction).sum(), rel=1e-6)


@yeoh_first
def test_float32_and_lanes(law: str, rng: np.random.Generator) -> None:
    """Forces of one world and of nine in float32 against float64: 1e-5 of the bulk modulus times a face."""
    x = CUBE.nodes * [1.3, 0.9, 0.95] + 0.02 * rng.standard_normal(CUBE.nodes.shape)
    exact = cube(law)
    exact.move(x)
    bulk = cases.material(law, YOUNGS, NU).bulk
    for worlds in (1, 9):
        single = cube(law, precision="float32", num_worlds=worlds)
        single.move(x)
        force = single.sim.internal_force().double().numpy()
        np.testing.assert_allclose(force, np.broadcast_to(exact.internal_force(), force.shape), atol=1e-5 * bulk)


@pytest.mark.cuda
@each_law
@each_element
def test_motion_on_a_gpu(law: str, element: str) -> None:
    """Ten steps of a clamped cube in float32 on a GPU against float64 on a CPU: 1e-4 of its size."""
    clamped = cases.on_plane(CUBE, 0, 0.0)
    options = {"dt": 0.01, "newton_iterations": 4, "gravity": (0.0, 0.0, -9.81), "num_worlds": 3}
    runs = []
    for device, precision in (("cuda:0", "float32"), ("cpu", "float64")):
        case = cube(law, element, np.flatnonzero(clamped), device=device, precision=precision, **options)
        for _ in range(10):
            case.sim.step()
        assert (case.sim.status == 0).all()
        runs.append(case.sim.node_x.double().cpu().numpy())
    np.testing.assert_allclose(runs[0], runs[1], atol=1e-4)


def bouncing(law: str, num_worlds: int, **options: Any) -> cases.Case:
    """A cube clamped at one face under its weight."""
    clamped = np.flatnonzero(cases.on_plane(CUBE, 0, 0.0))
    given = {"gravity": (0.0, 0.0, -9.81), "precision": "float32", "dt": 0.01, "newton_iterations": 4}
    return cube(law, "p1", clamped, num_worlds=num_worlds, **(given | options))


@yeoh_first
def test_parameters_per_world(law: str) -> None:
    """Worlds with different parameters equal, to the bit, these worlds of a batch in which others differ.

    The parameters of one world change nothing in the others.
    """
    names = list(cases.material(law, YOUNGS, NU).law_parameters)
    factors = torch.linspace(0.8, 1.6, 5)

    def run(of_world: torch.Tensor) -> torch.Tensor:
        case = bouncing(law, len(of_world))
        for name in names:
            if not name.startswith("alpha"):
                case.sim.law_parameter(0, name).mul_(of_world)
        for _ in range(4):
            case.sim.step()
        assert (case.sim.status == 0).all()
        return case.sim.node_x.clone()

    together = run(factors)
    assert torch.unique(together[:, -1, 2]).numel() == 5
    other = factors.clone()
    other[2] = 1.25
    changed = run(other)
    kept = torch.tensor([0, 1, 3, 4])
    assert torch.equal(changed[kept], together[kept])
    assert not torch.equal(changed[2], together[2])


@yeoh_first
def test_parameter_changes_hold_from_the_next_step(law: str) -> None:
    """A world whose parameters are written equals one that was built with them, to the bit."""
    stiff = cases.FITTED[law](2.0 * YOUNGS, NU)
    builder = sw.ModelBuilder()
    clamped = np.flatnonzero(cases.on_plane(CUBE, 0, 0.0))
    builder.fix(builder.add_tets(CUBE, material=stiff, density=1000.0), nodes=clamped)
    built = sw.Simulation(builder.finalize(), dt=0.01, newton_iterations=4)
    written = bouncing(law, 1)
    for name, value in stiff.law_parameters.items():
        written.sim.law_parameter(0, name)[:] = value
    written.sim.params.youngs.fill_(stiff.youngs)  # the scale of rounding
    for sim in (built, written.sim):
        sim.step()
    assert torch.equal(built.node_x, written.sim.node_x)


def two_bodies() -> tuple[sw.Simulation, list[Any]]:
    """Bodies with different laws side by side; the second is neo-Hookean."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    laws = [cases.FITTED["yeoh"](YOUNGS, NU), sw.NeoHookean(YOUNGS, NU), cases.FITTED["ogden"](YOUNGS, NU)]
    for i, solid in enumerate(laws):
        builder.add_tets(
            replace(CUBE, nodes=CUBE.nodes + [2.0 * i, 0, 0]), material=solid, density=1e3, name=f"part{i}"
        )
    return sw.Simulation(builder.finalize(num_worlds=2, precision="float64")), laws


def test_bodies_with_different_laws() -> None:
    """Energy is the sum of V psi(F) of each law with its own parameters."""
    sim, laws = two_bodies()
    F = np.array([[1.1, 0.2, 0.0], [0.0, 0.9, 0.1], [0.0, 0.0, 1.05]])
    sim.node_x.copy_(cases.tensor(sim, np.asarray(sim.model.node_rest) @ F.T).expand_as(sim.node_x))
    total = sum(float(solid.energy(F)) for solid in laws)
    np.testing.assert_allclose(sim.elastic_energy().numpy(), total, rtol=1e-12)
    sim.law_parameter(2, "bulk")[1] *= 2.0
    more = 0.5 * laws[2].bulk * (np.linalg.det(F) - 1.0) ** 2
    np.testing.assert_allclose(sim.elastic_energy().numpy(), [total, total + more], rtol=1e-12)


def test_names_of_parameters() -> None:
    """Views of single parameters; a wrong name tells the nearest, a law in moduli where these are."""
    sim, laws = two_bodies()
    assert sim.params.law_parameter.shape == (2, 4 + 7)
    np.testing.assert_array_equal(sim.law_parameter(2, "alpha_3").numpy(), laws[2].alpha_3)
    np.testing.assert_allclose(sim.params.youngs[0].numpy(), YOUNGS)
    with pytest.raises(
        ValueError, match="the law of body 'part0' has no parameter 'c11' of its own; did you mean 'c10'"
    ):
        sim.law_parameter(0, "c11")
    with pytest.raises(ValueError, match="'part1' has no parameter 'c10' of its own; it has youngs and nu"):
        sim.law_parameter(1, "c10")
    with pytest.raises(ValueError, match="soft body 3 does not exist"):
        sim.law_parameter(3, "c10")


def test_snapshots_hold_parameters() -> None:
    """Own parameters come back with a snapshot; one made before they existed serves scenes without them."""
    sim, _ = two_bodies()
    snapshot = sim.snapshot()
    sim.law_parameter(0, "c10")[:] = 1.0
    sim.restore(snapshot)
    assert (sim.law_parameter(0, "c10") > 1e3).all()
    case = cases.body(CUBE, "nh_log", YOUNGS, NU)
    snapshot = case.sim.snapshot()
    del snapshot.arrays["params.law_parameter"]
    case.sim.restore(snapshot)


@each_law
def test_a_flattening_step_keeps_volume_positive(law: str) -> None:
    """A blow of 1.2 m in one step, which would mirror a cube of 1 m, ends with positive volume."""
    case = cube(law, "p1", np.flatnonzero(cases.on_plane(CUBE, 2, 0.0)), newton_iterations=20, dt=0.02)
    case.sim.node_v[:, cases.on_plane(CUBE, 2, 1.0), 2] = -60.0
    case.sim.step()
    assert torch.isfinite(case.sim.node_x).all()
    corners = case.positions()[CUBE.tets]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1])
    assert (volume > 0.0).all()


def test_density_of_a_material() -> None:
    """A body without density takes that of its material; one that is given wins."""
    builder = sw.ModelBuilder()
    rubber = sw.Material.silicone("Ecoflex 00-30")
    builder.add_tets(CUBE, material=rubber)
    builder.add_tets(CUBE, material=rubber, density=900.0)
    builder.add_tets(CUBE, material=rubber, total_mass=500.0)
    sim = sw.Simulation(builder.finalize(precision="float64"))
    np.testing.assert_allclose(sim.params.density[0].numpy(), [1070.0, 900.0, 500.0])
    with pytest.raises(ValueError, match="exactly one of density"):
        builder.add_tets(CUBE, material=sw.NeoHookean(YOUNGS, NU))
