"""Quadratic tetrahedra: element level, mass and weight, invariances, and what else touches such a body.

Same-mesh numbers of statics and orders of convergence are in ``test_convergence_solids`` and ``test_convergence``.
"""

from typing import Any

import numpy as np
import pytest
import scipy.sparse.linalg
import torch

import softwarp as sw
from benchmarks import cantilever
from softwarp import meshing
from softwarp.solvers.workspace.workspace import declared
from tests import cases
from tests.contract.batch_checks import assert_same

SIZE, CELLS = (0.2, 0.1, 0.15), (3, 2, 2)  # m
SPACING = 0.05  # m, the shortest cell edge
YOUNGS, NU = 1.0e5, 0.4  # Pa
LARGE_F = np.array([[1.1, 0.3, -0.05], [0.02, 0.9, 0.15], [0.1, -0.2, 1.2]])
SMALL_F = np.eye(3) + 1e-3 * np.array([[1.0, 0.4, -0.2], [0.3, -0.5, 0.6], [0.1, -0.7, 0.8]])

each_law = pytest.mark.parametrize("law", cases.LAWS)
each_rotation = pytest.mark.parametrize("law", [*cases.LAWS, "large", "warped"])


def irregular(rng: np.random.Generator, cells: tuple[int, int, int] = CELLS) -> meshing.QuadraticMesh:
    """A block of irregular elements with straight edges."""
    return meshing.elevate(cases.jittered(meshing.box(SIZE, cells), 0.2 * SPACING, rng))


def bulged(points: np.ndarray) -> np.ndarray:
    """Moves points by up to a tenth of the spacing."""
    return points + 0.1 * SPACING * np.sin(40.0 * points[:, [1, 2, 0]])


def deformed_case(law: str, rng: np.random.Generator, *, curved: bool = False, **options: Any) -> cases.Case:
    """The block stretched by LARGE_F, each node moved by a further 3 % of the spacing."""
    mesh = irregular(rng)
    if curved:
        mesh = meshing.elevate(cases.jittered(meshing.box(SIZE, CELLS), 0.1 * SPACING, rng), project=bulged)
    case = cases.body(mesh, law, YOUNGS, NU, project_tangent=False, **options)
    case.move(mesh.nodes @ LARGE_F.T + rng.uniform(-0.03, 0.03, mesh.nodes.shape) * SPACING)
    return case


@each_law
@pytest.mark.parametrize("curved", [False, True], ids=["straight", "curved"])
def test_force_is_energy_gradient(law: str, curved: bool, rng: np.random.Generator) -> None:
    """f . d = dE/dx . d; central difference, step 1e-6 of the size: |difference| <= 1e-7 |f| (catalogue 1.1)."""
    case = deformed_case(law, rng, curved=curved)
    start, step = case.positions(), 1e-6 * max(SIZE)
    force = case.internal_force()
    for _ in range(3):
        direction = rng.standard_normal(start.shape)
        direction /= np.linalg.norm(direction)
        energy = []
        for sign in (1.0, -1.0):
            case.move(start + sign * step * direction)
            energy.append(float(case.sim.elastic_energy()[0]))
        assert abs((energy[0] - energy[1]) / (2.0 * step) - (force * direction).sum()) < 1e-7 * np.linalg.norm(force)


@pytest.mark.parametrize(
    ("law", "precision", "step", "tolerance"),
    cases.quick(
        [(law, *how) for law in cases.LAWS for how in (("float64", 1e-6, 1e-6), ("float32", 1e-3, 1e-2))],
        lambda law, precision, *_: precision == "float64" or law == "nh_log",
    ),
)
def test_tangent_is_force_gradient(
    law: str, precision: str, step: float, tolerance: float, rng: np.random.Generator
) -> None:
    """K d = df/dx . d; central difference, catalogue 1.1. K is symmetric to 1e-12 in float64."""
    case = deformed_case(law, rng, precision=precision)
    start = case.positions()
    direction = rng.standard_normal(start.shape)
    direction /= np.linalg.norm(direction)
    K = case.sim.stiffness_matrix()
    product = (K @ direction.ravel()).reshape(-1, 3)
    force = []
    for sign in (1.0, -1.0):
        case.move(start + sign * step * max(SIZE) * direction)
        force.append(case.internal_force())
    difference = (force[0] - force[1]) / (2.0 * step * max(SIZE))
    assert np.linalg.norm(difference - product) < tolerance * np.linalg.norm(product)
    assert abs(K - K.T).max() < (1e-12 if precision == "float64" else 1e-5) * abs(K).max()


@each_rotation
def test_projected_tangent_is_semidefinite(law: str, rng: np.random.Generator) -> None:
    """No eigenvalue of K below rounding, at a state that compresses some elements strongly."""
    mesh = irregular(rng, (2, 1, 1))
    case = cases.body(mesh, law, YOUNGS, NU)
    case.move(mesh.nodes @ np.diag([0.5, 1.1, 0.9]) + rng.uniform(-0.1, 0.1, mesh.nodes.shape) * SPACING)
    values = np.linalg.eigvalsh(case.sim.stiffness_matrix().toarray())
    assert values.min() > -1e-10 * values.max()


@pytest.mark.parametrize("law", ["stvk", "large"])
def test_stiffness_at_rest_is_that_of_linear_elasticity(law: str, rng: np.random.Generator) -> None:
    """E = u' K u / 2 of the quadratic field u = eps (x y, y z, x^2): the integral of its energy density, exactly.

    Gradient rows (y, x, 0), (0, z, y), (2 x, 0, 0); the density is of degree 2, as the rule integrates exactly.
    """
    mesh = irregular(rng)
    case = cases.body(mesh, law, YOUNGS, NU)
    x, y, z = mesh.nodes.T
    u = np.stack([x * y, y * z, x * x], axis=1).ravel()
    mu, lam = cases.lame(YOUNGS, NU)
    a, b, c = SIZE

    def mean(i: int, j: int, k: int) -> float:
        return a ** (i + 1) / (i + 1) * b ** (j + 1) / (j + 1) * c ** (k + 1) / (k + 1)

    # strains xx = y, yy = z, zz = 0, 2 xy = x, 2 yz = y, 2 xz = 2 x
    diagonal = mean(0, 2, 0) + mean(0, 0, 2)
    shear = mean(2, 0, 0) + mean(0, 2, 0) + 4.0 * mean(2, 0, 0)
    trace = mean(0, 2, 0) + 2.0 * mean(0, 1, 1) + mean(0, 0, 2)
    expected = mu * (diagonal + 0.5 * shear) + 0.5 * lam * trace
    assert 0.5 * u @ case.sim.stiffness_matrix() @ u == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("law", "precision", "tolerance"), cases.in_both_precisions([*cases.LAWS, "large", "warped"], 1e-10, 3e-4)
)
def test_rigid_motion_is_force_free(law: str, precision: str, tolerance: float, rng: np.random.Generator) -> None:
    """A body at Q X + c has |f| <= tolerance E h^2 (catalogue 1.5); in float32 also at 1 m from the origin."""
    mesh = irregular(rng)
    case = cases.body(mesh, law, YOUNGS, NU, precision=precision)
    for Q in (cases.random_rotation(rng), np.diag([-1.0, -1.0, 1.0])):
        case.move(mesh.nodes @ Q.T + np.array([0.1, -0.2, 0.3]))
        assert np.abs(case.internal_force()).max() < tolerance * YOUNGS * SPACING**2
        assert float(case.sim.elastic_energy()[0]) < tolerance * YOUNGS * SPACING**3


@pytest.mark.parametrize(("law", "precision", "tolerance"), cases.in_both_precisions(cases.LAWS, 1e-12, 1e-5))
@pytest.mark.parametrize("F", [SMALL_F, LARGE_F], ids=["small", "large"])
def test_patch(law: str, F: np.ndarray, precision: str, tolerance: float, rng: np.random.Generator) -> None:
    """Surface nodes at F X: the inner nodes of an irregular mesh land on F X, to tolerance L (catalogue 1.4).

    The resultant on each face of the block is P(F) times its area vector.
    """
    mesh = irregular(rng, (4, 3, 3))
    skin = np.unique(mesh.linear().surface())
    case = cases.body(mesh, law, YOUNGS, NU, fixed=skin, precision=precision)
    target = mesh.nodes @ F.T
    case.move(target + case.free[:, None] * rng.uniform(-0.02, 0.02, target.shape) * SPACING)
    case.sim.solve_static(tolerance=1e-13 if precision == "float64" else 1e-6)
    assert np.abs(case.positions() - target).max() < tolerance * max(SIZE)
    pulled = np.abs(case.internal_force()[case.free]).max()
    assert pulled < 10.0 * tolerance * YOUNGS * SPACING**2
    # sum f X' = P V for a constant stress
    virial = case.internal_force().T @ mesh.nodes
    expected = cases.material(law, YOUNGS, NU).stress(F) * np.prod(SIZE)
    np.testing.assert_allclose(virial, expected, atol=10.0 * tolerance * YOUNGS * np.prod(SIZE))


@pytest.mark.parametrize("law", ["large", "nh_log"])
@pytest.mark.parametrize("curved", [False, True], ids=["straight", "curved"])
def test_free_fall_is_rigid(law: str, curved: bool, rng: np.random.Generator) -> None:
    """Weight and inertia agree: v = -g t at all nodes, no stress, energies as of a point mass at the centre."""
    mesh = meshing.elevate(meshing.box(SIZE, CELLS), project=bulged if curved else None)
    case = cases.body(mesh, law, YOUNGS, NU, gravity=(0.0, 0.0, -9.81), dt=0.01)
    for _ in range(10):
        case.sim.step()
    mass, fallen = 1000.0 * mesh.volume, 9.81 * 0.01**2 * 55
    np.testing.assert_allclose(case.displacements(), [[0.0, 0.0, -fallen]] * len(mesh.nodes), atol=1e-13)
    assert float(case.sim.elastic_energy()[0]) < 1e-13
    assert float(case.sim.kinetic_energy()[0]) == pytest.approx(0.5 * mass * 0.981**2, rel=1e-12)
    linear, _ = case.sim.momentum()
    np.testing.assert_allclose(linear[0], [0.0, 0.0, -0.981 * mass], atol=1e-12)


def test_spin_keeps_the_moment_of_inertia() -> None:
    """A block in rigid spin has the kinetic energy and the angular momentum of the solid, not of point masses."""
    mesh = meshing.elevate(meshing.box(SIZE, (1, 1, 1)))
    case = cases.body(mesh, "large", YOUNGS, NU)
    centre, omega = 0.5 * np.array(SIZE), np.array([0.0, 0.0, 2.0])
    case.sim.node_v.copy_(cases.tensor(case.sim, np.cross(omega, mesh.nodes - centre))[None])
    inertia = 1000.0 * np.prod(SIZE) * (SIZE[0] ** 2 + SIZE[1] ** 2) / 12.0
    assert float(case.sim.kinetic_energy()[0]) == pytest.approx(0.5 * inertia * 4.0, rel=1e-12)
    linear, angular = case.sim.momentum()
    np.testing.assert_allclose(linear[0], 0.0, atol=1e-14)
    np.testing.assert_allclose(angular[0], [0.0, 0.0, 2.0 * inertia], atol=1e-12)


def test_momentum_is_kept() -> None:
    """A free block that is thrown, spun and stretched keeps both momenta to the tolerance of Newton's method."""
    mesh = meshing.elevate(meshing.box(SIZE, CELLS))
    case = cases.body(mesh, "nh_log", YOUNGS, NU, dt=0.002, newton_iterations=12, rayleigh=(0.0, 0.002))
    wave = np.stack([np.sin(20.0 * mesh.nodes[:, 0]), np.cos(15.0 * mesh.nodes[:, 2]), mesh.nodes[:, 1]], axis=1)
    case.sim.node_v.copy_(cases.tensor(case.sim, 0.3 * wave)[None])
    start = case.sim.momentum()
    for _ in range(20):
        case.sim.step()
    end = case.sim.momentum()
    np.testing.assert_allclose(end[0], start[0], atol=1e-9 * float(start[0].abs().max()))
    # backward Euler keeps the sum of x x p up to h^2 per step
    np.testing.assert_allclose(end[1], start[1], rtol=0.02, atol=0.02 * float(start[1].abs().max()))


def test_lowest_frequency() -> None:
    """First bending mode of the cantilever 1 x 0.1 x 0.1 m: omega = 1.8751^2 sqrt(E I / (rho A L^4)).

    The beam formula lacks rotary inertia and shear, which lower it by 0.9 % at this slenderness (Timoshenko).
    """
    mesh = meshing.elevate(meshing.box((1.0, 0.1, 0.1), (10, 1, 1)))
    case = cases.body(mesh, "corot", 1e6, 0.0, fixed=cases.on_plane(mesh, 0, 0.0), dt=1e-3)
    system = case.sim._systems[0]
    free = np.repeat(case.free, 3)
    K = case.sim.stiffness_matrix()[free][:, free]
    system.load()
    system.scale(1e-30)  # A = M + h^2 K
    system.forces()
    system.tangent()
    M = scattered(case.sim)[free][:, free]
    value = scipy.sparse.linalg.eigsh(K.tocsc(), k=1, M=M.tocsc(), sigma=0.0, return_eigenvectors=False)[0]
    expected = 1.8751041**2 * np.sqrt(1e6 * 0.1**2 / 12.0 / 1000.0)
    assert np.sqrt(value) == pytest.approx(expected * 0.991, rel=5e-3)


def scattered(sim: sw.Simulation) -> Any:
    """The matrix A of the first shard as SciPy CSR over node scalars."""
    from scipy.sparse import coo_array

    symbolic, node = sim.model.symbolic, sim.model.dof_node.numpy()
    blocks = sim._systems[0].work.a.real.numpy()[0, :, 0].reshape(-1, 3, 3)
    lower = slice(symbolic.size, None)
    row, col = node[symbolic.a_row], node[symbolic.a_col]
    blocks = np.concatenate([blocks, blocks[lower].transpose(0, 2, 1)])
    row, col = np.concatenate([row, col[lower]]), np.concatenate([col, row[lower]])
    i = np.broadcast_to(3 * row[:, None, None] + np.arange(3)[None, :, None], blocks.shape)
    j = np.broadcast_to(3 * col[:, None, None] + np.arange(3)[None, None, :], blocks.shape)
    size = 3 * sim.model.node_count
    return coo_array((blocks.ravel(), (i.ravel(), j.ravel())), shape=(size, size)).tocsr()


# Silicone cantilever of ``benchmarks.cantilever``: 525 nodes of linear tetrahedra sag 59.4 mm, the truth is 73.4 mm.
@pytest.mark.parametrize("law", ["stvk", "nh_log", "corot"])
@pytest.mark.parametrize(
    ("cells", "grading", "nodes"), [((17, 1, 2), 1.0, 491), ((12, 1, 1), 1.4, 213)], ids=["even", "graded"]
)
def test_silicone_cantilever(law: str, cells: tuple[int, int, int], grading: float, nodes: int) -> None:
    """Within 2.5 % of the converged sag with fewer unknowns than the linear mesh; cells even or finer at the root.

    The clamp of a nearly incompressible solid is a singularity, so elements there gain most.
    """
    coarse = cantilever.mesh(cells)
    x = coarse.nodes.copy()
    x[:, 0] = cantilever.SIZE[0] * (x[:, 0] / cantilever.SIZE[0]) ** grading
    mesh = meshing.elevate(meshing.TetMesh(x, coarse.tets))
    assert len(mesh.nodes) == nodes
    fixed = cantilever.clamped(mesh.nodes)
    options: dict[str, Any] = {"density": cantilever.DENSITY, "gravity": (0.0, 0.0, -cantilever.GRAVITY)}
    case = cases.body(mesh, law, cantilever.YOUNGS, cantilever.NU, fixed=fixed, **options)
    assert case.sim.model.dof_count <= 500  # free nodes of the linear mesh
    assert bool(case.sim.solve_static().converged.all())
    assert cantilever.sag(mesh.nodes, case.positions()) == pytest.approx(cantilever.CONVERGED, rel=0.025)


# Invariances


def beam(
    num_worlds: int, law: str = "large", precision: str = "float32", device: str = "cpu", **options: Any
) -> sw.Simulation:
    """A clamped beam with a cable, a marker and a floor to fall on; worlds differ in modulus."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    mesh = meshing.box((0.2, 0.03, 0.03), (5, 1, 1))
    body = builder.add_tets(
        mesh, material=cases.material(law, 2e5, 0.4), density=1000.0, rayleigh=(0.5, 0.01), element="p2"
    )
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    x = np.linspace(0.0, 0.2, 5)
    builder.add_cable(body, np.stack([x, np.full(5, 0.015), np.full(5, 0.025)], axis=1), max_rate=0.2)
    builder.add_marker(body, (0.2, 0.015, 0.015))
    floor = builder.add_rigid(sw.Plane(), kinematic=True, pose=(0.0, 0.0, -0.01))
    builder.add_contact(body, floor, mu=0.4)
    sim = sw.Simulation(builder.finalize(num_worlds, device, precision), dt=0.01, **options)
    sim.params.youngs.copy_(torch.linspace(1e5, 3e5, 9)[:num_worlds, None].to(sim.params.youngs))
    return sim


def run(sim: sw.Simulation, steps: int) -> dict[str, torch.Tensor]:
    """Steps with a moving cable, then what a user sees."""
    for step in range(steps):
        sim.control.cable_displacement.fill_(0.004 * (1.0 + np.sin(0.2 * step)))
        sim.step()
    names = ("node_x", "node_v", "marker_x", "cable_tension", "cable_x", "status", "contact_load")
    return {name: getattr(sim, name).clone() for name in names}


@pytest.mark.parametrize("law", [pytest.param("large", marks=pytest.mark.slow), "nh_log"])
@pytest.mark.parametrize("path", ["scalar", "lanes"])
def test_world_does_not_depend_on_its_batch(law: str, path: str) -> None:
    """World i alone, in a batch of 2 and in one of 9: the same bits."""
    full = run(beam(9, law, solver_path=path), 40)
    assert bool((full["status"] <= sw.Status.MAX_ITERATIONS).all())
    assert float(full["contact_load"].abs().max()) > 0.0
    for world in (0, 4):
        few = beam(2, law, solver_path=path)
        few.params.youngs.copy_(torch.linspace(1e5, 3e5, 9)[[7, world], None])
        assert_same(run(few, 40), full, [0, 1], [7, world])


@pytest.mark.parametrize("law", [pytest.param("large", marks=pytest.mark.slow), "nh_log"])
@pytest.mark.parametrize("path", ["scalar", "lanes"])
def test_static_world_does_not_depend_on_its_batch(law: str, path: str) -> None:
    """``solve_static`` of world i alone and in a batch of 5: the same bits, and an equilibrium."""

    def solved(count: int, moduli: list[float]) -> dict[str, torch.Tensor]:
        sim = arm(count, law, solver_path=path)
        sim.params.youngs.copy_(torch.tensor(moduli)[:, None])
        assert bool(sim.solve_static(tolerance=1e-4).converged.all())
        return {"node_x": sim.node_x.clone()}

    moduli = [1e5, 1.5e5, 2e5, 2.5e5, 3e5]
    assert_same(solved(1, moduli[3:4]), solved(5, moduli), [0], [3])


def arm(num_worlds: int, law: str, **options: Any) -> sw.Simulation:
    """A clamped beam that hangs."""
    mesh = meshing.box((0.2, 0.03, 0.03), (5, 1, 1))
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    body = builder.add_tets(mesh, material=cases.material(law, 2e5, 0.4), density=1000.0, element="p2")
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    return sw.Simulation(builder.finalize(num_worlds), **options)


@pytest.mark.parametrize("law", ["large", "nh_log"])
def test_snapshot_goes_on_with_the_same_bits(law: str) -> None:
    """Save, go on, restore, go on again."""
    sim = beam(3, law)
    run(sim, 20)
    saved = sim.snapshot()
    first = run(sim, 20)
    sim.restore(saved)
    assert_same(first, run(sim, 20), [0, 1, 2], [0, 1, 2])


@pytest.mark.parametrize("law", ["large", "warped", "nh_log"])
def test_workspace_carries_nothing_over(law: str) -> None:
    """What the elements keep between steps may be anything: the same bits."""
    first, second = beam(2, law), beam(2, law)
    for sim in (first, second):
        run(sim, 8)
    for system in second._systems:
        for name, about in declared().items():
            if name.startswith(("gauss_", "element_")):
                assert about.keeps is None
                getattr(system.work, name).real.fill_(float("nan"))
    assert_same(run(first, 4), run(second, 4), [0, 1], [0, 1])


@pytest.mark.parametrize(
    "law", ["large", *(pytest.param(law, marks=pytest.mark.slow) for law in ("stvk", "warped", "corot"))]
)
def test_paths_and_precisions_agree(law: str) -> None:
    """Lanes and scalars differ by rounding of float32, which differs from float64 as far as it may."""
    reference = run(beam(2, law, precision="float64", newton_iterations=3), 15)["node_x"]
    moved = float((reference - beam(2, law, precision="float64").node_x).abs().max())
    for path in ("scalar", "lanes"):
        found = run(beam(2, law, solver_path=path, newton_iterations=3), 15)["node_x"]
        assert float((found - reference).abs().max()) < 2e-3 * moved


@pytest.mark.cuda
@pytest.mark.parametrize("law", ["large", "nh_log"])
def test_gpu_moves_like_the_cpu(law: str) -> None:
    """The motion of float64 on the CPU to rounding; on the GPU a world does not depend on its batch."""
    reference = run(beam(3, law, precision="float64", newton_iterations=3), 15)["node_x"]
    moved = float((reference - beam(3, law, precision="float64").node_x).abs().max())
    full = run(beam(3, law, device="cuda:0", newton_iterations=3), 15)
    assert float((full["node_x"].cpu() - reference).abs().max()) < 2e-3 * moved
    assert_same(run(beam(1, law, device="cuda:0", newton_iterations=3), 15), full, [0], [0])
