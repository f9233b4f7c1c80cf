"""Hexahedra with incompatible modes: patch test, forces, bending, the elastica, and what else touches such a body."""

from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.meshing import hexes
from softwarp.plan.hexes import own_corners, shape_arrays, stiffness
from softwarp.solvers.workspace.workspace import declared
from tests import cases
from tests.contract.batch_checks import assert_same

SIZE, CELLS, SPACING = (0.2, 0.1, 0.15), (3, 2, 2), 0.05  # m
YOUNGS, NU = 1.0e5, 0.4
ELASTICA = (0.6124, 0.7138)  # x / L and z / L of the tip under F L^2 / E I = 5 (Bisshopp and Drucker, 1945)


def irregular(rng: np.random.Generator) -> meshing.HexMesh:
    """A block of irregular elements, whose faces are not flat."""
    mesh = meshing.brick(SIZE, CELLS)
    return meshing.HexMesh(mesh.nodes + 0.1 * SPACING * rng.uniform(-1.0, 1.0, mesh.nodes.shape), mesh.hexes)


def block(mesh: Any, *, nu: float = NU, held: Any = None, **options: Any) -> sw.Simulation:
    """A body without weight, perhaps with nodes held."""
    named = {key: options.pop(key) for key in ("num_worlds", "precision") if key in options}
    given = {key: options.pop(key) for key in ("rayleigh", "stiffness", "lumping") if key in options}
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_hexes(mesh, material=sw.Corotational(YOUNGS, nu), density=1000.0, **given)
    if held is not None:
        builder.fix(body, nodes=held)
    return sw.Simulation(builder.finalize(**{"precision": "float64"} | named), **{"dt": 0.01} | options)


def move(sim: sw.Simulation, x: np.ndarray) -> None:
    sim.node_x[:] = torch.as_tensor(x).to(sim.node_x)
    sim.refresh()


def test_pieces_fill_a_shuffled_brick(rng: np.random.Generator) -> None:
    """Tets between corners fill every element, and none of their faces inside is free, whatever the numbers."""
    mesh = meshing.brick((0.3, 0.2, 0.1), (3, 2, 2))
    place = rng.permutation(len(mesh.nodes))
    shuffled = meshing.HexMesh(mesh.nodes[place], np.argsort(place)[mesh.hexes])
    assert shuffled.linear().volume == pytest.approx(0.3 * 0.2 * 0.1)
    assert len(shuffled.linear().surface()) == 2 * 2 * (3 * 2 + 2 * 2 + 3 * 2)


def test_broken_meshes_are_refused() -> None:
    """Elements inside out or there twice, and nodes of none."""
    mesh = meshing.brick(SIZE, CELLS)
    for nodes, elements, told in (
        (mesh.nodes, mesh.hexes[:, [4, 5, 6, 7, 0, 1, 2, 3]], "12 of 12 hexahedra are flat or inside out at a corner"),
        (mesh.nodes, mesh.hexes[[*range(12), 3]], "1 hexahedron rows repeat the corners of another .first: 12"),
        (np.vstack([mesh.nodes, [1.0, 1.0, 1.0]]), mesh.hexes, "belong to no hexahedron .first: 36"),
    ):
        with pytest.raises(meshing.MeshError, match=told):
            meshing.HexMesh(nodes, elements)


def test_equal_bricks_share_a_shape() -> None:
    """Of a brick and a turned one, whose elements differ by place and direction alone."""
    builder = sw.ModelBuilder()
    mesh, turn = meshing.brick(SIZE, CELLS), cases.random_rotation(np.random.default_rng(1))
    nodes = np.concatenate([mesh.nodes, mesh.nodes @ turn.T + 1.0])
    both = meshing.HexMesh(nodes, np.concatenate([mesh.hexes, mesh.hexes + len(mesh.nodes)]))
    builder.add_hexes(both, material=sw.Corotational(YOUNGS, NU), density=1000.0)
    model = builder.finalize()
    assert model.hexes is not None
    assert model.hexes.count == 24
    assert model.hexes.shape_body.size == 1


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.49])
def test_stiffness_condenses_the_modes(nu: float, rng: np.random.Generator) -> None:
    """K in Lame constants is K_uu - K_ui K_ii^-1 K_iu, positive with six rigid motions, and exact for linear fields."""
    x = own_corners(irregular(rng).nodes[irregular(rng).hexes[:1]])
    arrays, (mu, lam) = shape_arrays(x), cases.lame(1.0, nu)
    K = stiffness(arrays, mu, lam)[0]
    values = np.linalg.eigvalsh(K)
    assert np.abs(values[:6]).max() < 1e-12 * values[-1]
    assert values[6] > 1e-3 * values[-1] * (1.0 - 2.0 * nu)
    A = rng.standard_normal((3, 3))
    stress = mu * (A + A.T) + lam * np.trace(A) * np.eye(3)
    volume = hexes.node_volumes(x[0], np.arange(8)[None]).sum()
    wanted = volume * arrays.shape_gradient[0].reshape(8, 3) @ stress
    np.testing.assert_allclose((K @ (x[0] @ A.T).ravel()).reshape(8, 3), wanted, atol=1e-12)


@pytest.mark.parametrize("nu", [0.3, 0.49])
def test_patch(nu: float, rng: np.random.Generator) -> None:
    """Boundary nodes that follow a small linear field take those inside with them, on distorted elements."""
    mesh = irregular(rng)
    held = np.unique(mesh.linear().surface())
    inside = np.setdiff1d(np.arange(len(mesh.nodes)), held)
    A = np.array([[1.0, 0.3, -0.2], [-0.1, 0.5, 0.4], [0.2, -0.6, -0.8]])
    sim = block(mesh, nu=nu, held=held)
    wanted = mesh.nodes @ (np.eye(3) + 1e-8 * A).T
    move(sim, np.where(np.isin(np.arange(len(wanted)), held)[:, None], wanted, mesh.nodes))
    sim.solve_static(1e-12)
    move_of = np.abs(mesh.nodes @ A.T).max() * 1e-8
    assert len(inside) == 2
    assert np.abs(sim.node_x[0, inside].numpy() - wanted[inside]).max() < 1e-6 * move_of


@pytest.mark.parametrize(("precision", "tolerance"), [("float64", 1e-12), ("float32", 2e-5)])
def test_turning_takes_no_force(precision: str, tolerance: float, rng: np.random.Generator) -> None:
    mesh = irregular(rng)
    sim = block(mesh, precision=precision)
    move(sim, mesh.nodes @ cases.random_rotation(rng).T + 0.1)
    assert float(sim.internal_force().abs().max()) < tolerance * YOUNGS * SPACING**2


def test_forces_are_those_of_an_energy_and_balance(rng: np.random.Generator) -> None:
    """Central differences along directions; no resultant and no moment, however far nodes are moved."""
    mesh = irregular(rng)
    sim = block(mesh)
    x = (mesh.nodes + 0.2 * SPACING * rng.uniform(-1.0, 1.0, mesh.nodes.shape)) @ cases.random_rotation(rng).T
    move(sim, x)
    force = sim.internal_force()[0].numpy().copy()
    size = np.linalg.norm(force)
    assert np.abs(force.sum(axis=0)).max() < 1e-12 * size
    assert np.abs(np.cross(x, force).sum(axis=0)).max() < 1e-12 * size
    for _ in range(3):
        direction, step = rng.standard_normal(x.shape), 1e-7
        energy = []
        for sign in (-1.0, 1.0):
            move(sim, x + sign * step * direction)
            energy.append(float(sim.elastic_energy()[0]))
        slope = (energy[1] - energy[0]) / (2.0 * step)
        assert slope == pytest.approx(float((force * direction).sum()), abs=1e-6 * size)


def test_the_guard_has_an_energy_and_holds_elements_up(rng: np.random.Generator) -> None:
    """Forces of crushed elements against differences; a confined brick under more than its modulus stays upright."""
    mesh = irregular(rng)
    sim = block(mesh)
    x = mesh.nodes * [1.0, 1.0, 0.25] + 0.02 * SPACING * rng.uniform(-1.0, 1.0, mesh.nodes.shape)
    move(sim, x)
    force = sim.internal_force()[0].numpy().copy()
    size = np.linalg.norm(force)
    assert np.abs(np.cross(x, force).sum(axis=0)).max() < 1e-12 * size
    direction, step, energy = rng.standard_normal(x.shape), 1e-7, []
    for sign in (-1.0, 1.0):
        move(sim, x + sign * step * direction)
        energy.append(float(sim.elastic_energy()[0]))
    assert (energy[1] - energy[0]) / (2.0 * step) == pytest.approx(float((force * direction).sum()), abs=1e-6 * size)

    cube = meshing.brick((0.02, 0.02, 0.02), (1, 1, 1))
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_hexes(cube, material=sw.Corotational(YOUNGS, 0.45), density=1000.0, rayleigh=(5.0, 0.01))
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1.0, 1.0, 1e-9)))
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), axes="xy")
    builder.add_traction(body, box=((-1.0, -1.0, 0.02 - 1e-9), (1.0, 1.0, 1.0)))
    sim = sw.Simulation(builder.finalize(), dt=0.01)
    for step in range(300):
        sim.control.traction[:, 0, 2] = -180.0 / 0.02**2 * min(step / 200, 1.0)
        sim.step()
    assert int(sim.status[0]) == 0
    assert int(sim.inverted_count[0]) == 0
    assert float(sim.node_v.abs().max()) < 1e-2


def test_tangent_is_that_of_held_rotations(rng: np.random.Generator) -> None:
    """At rest, turned: A is the derivative of the forces by differences, as nothing is left out without stress."""
    mesh = irregular(rng)
    held = [0, 4, 8, 12]
    factors = rng.uniform(0.5, 2.0, len(mesh.hexes))
    sim, x = block(mesh, held=held, stiffness=factors), mesh.nodes @ cases.random_rotation(rng).T
    move(sim, x)
    K = sim.stiffness_matrix().toarray()
    free = ~np.isin(np.arange(len(x)), held)
    for _ in range(3):
        direction, step = rng.standard_normal(x.shape) * free[:, None], 1e-7
        force = []
        for sign in (-1.0, 1.0):
            move(sim, x + sign * step * direction)
            force.append(sim.internal_force()[0].numpy().copy())
        slope = (force[1] - force[0]) / (2.0 * step)
        found = (K @ direction.ravel()).reshape(-1, 3)
        assert np.abs(slope - found)[free].max() < 1e-6 * np.abs(found).max()


def beam(nu: float, *, width: float, moment: float = 0.0, force: float = 0.0, clamped: bool = False) -> sw.Simulation:
    """A cantilever 0.1 m long and 0.01 m thick, half of it beside a plane of symmetry: ten bricks, one through."""
    length, thick = 0.1, 0.01
    mesh = meshing.brick((length, width / 2, thick), (10, 1, 1))
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_hexes(mesh, material=sw.Corotational(YOUNGS, nu), density=1000.0)
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1.0, 1e-9, 1.0)), axes="y")
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-9, 1.0, 1.0)), axes="xyz" if clamped else "x")
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-9, 1e-9, 1.0)), axes="z")
    upper = mesh.nodes[:, 2] > thick / 2
    tip = mesh.nodes[:, 0] > length - 1e-9
    builder.add_point_load(body, np.flatnonzero(tip), (0.0, 0.0, force / 2))
    for side, sign in ((upper, -1.0), (~upper, 1.0)):
        builder.add_point_load(body, np.flatnonzero(tip & side), (sign * moment / 2 / thick, 0.0, 0.0))
    sim = sw.Simulation(builder.finalize(precision="float64"))
    sim.solve_static()
    return sim


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.49, 0.499])
def test_bricks_bend_as_beams_do(nu: float) -> None:
    """A moment at the end of ten bricks: M L^2 / 2 E I within 0.1 %, whatever Poisson's ratio."""
    sim = beam(nu, width=0.01, moment=1e-6)
    sag = float(sim.node_x[0, :, 2].max()) - 0.01
    assert sag == pytest.approx(1e-6 * 0.1**2 / (2.0 * YOUNGS * 0.01**4 / 12.0), rel=1e-3)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45, 0.49])
def test_a_force_bends_bricks(nu: float) -> None:
    """F L^3 / 3 E I + F L / (5/6 G A) within 1 % up to nu = 0.45 and within 1.5 % at 0.49, one brick through."""
    sim = beam(nu, width=0.01, force=1e-5)
    sag = float(sim.node_x[0, :, 2].max()) - 0.01
    timoshenko = 1e-5 * (0.1**3 / (3.0 * YOUNGS * 0.01**4 / 12.0) + 0.1 * 2.0 * (1.0 + nu) / (5 / 6 * YOUNGS * 1e-4))
    assert sag == pytest.approx(timoshenko, rel=0.01 if nu < 0.46 else 0.015)


def slender(cells: int, *, precision: str = "float64") -> sw.Simulation:
    """A strip under the load of the elastica F L^2 / E I = 5."""
    length, width, thick, youngs = 0.1, 0.004, 0.002, 1e6
    mesh = meshing.brick((length, width, thick), (cells, 1, 1))
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_hexes(mesh, material=sw.Corotational(youngs, 0.0), density=1000.0, rayleigh=(2.0, 0.02))
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-9, 1.0, 1.0)))
    force = 5.0 * youngs * width * thick**3 / 12.0 / length**2
    builder.add_point_load(body, np.flatnonzero(mesh.nodes[:, 0] > length - 1e-9), (0.0, 0.0, force))
    return sw.Simulation(builder.finalize(precision=precision), dt=0.02)


def tip(sim: sw.Simulation) -> np.ndarray:
    """Middle of the end, from its place over the clamp, per length."""
    end = torch.as_tensor(sim.model.node_rest[:, 0] > 0.1 - 1e-9)
    return (sim.node_x[0, end].double().mean(dim=0).numpy()[[0, 2]] - [0.0, 0.001]) / 0.1


def test_elastica_in_statics() -> None:
    """Twenty bricks that turn by 65 degrees: the tip within 0.5 % of the length, by ``solve_static``."""
    sim = slender(20)
    assert sim.solve_static().reason[0].is_equilibrium
    np.testing.assert_allclose(tip(sim), ELASTICA, atol=5e-3)


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_elastica_in_steps(precision: str) -> None:
    """The same by steps that come to rest."""
    sim = slender(20, precision=precision)
    for _ in range(400):
        sim.step()
    assert float(sim.node_v.abs().max()) < 1e-4
    np.testing.assert_allclose(tip(sim), ELASTICA, atol=5e-3)


def test_momentum_is_kept(rng: np.random.Generator) -> None:
    """A tumbling, ringing block: linear momentum to rounding and angular momentum as steps keep it."""
    mesh = irregular(rng)
    sim = block(mesh, dt=1e-3, newton_iterations=20)
    v = 0.3 * rng.standard_normal(mesh.nodes.shape) + np.cross([3.0, -2.0, 4.0], mesh.nodes)
    sim.node_v[:] = torch.as_tensor(v)
    before = [value.clone() for value in sim.momentum()]
    for _ in range(50):
        sim.step()
    linear, angular = sim.momentum()
    assert float((linear - before[0]).abs().max()) < 1e-10 * float(before[0].abs().max())
    assert float(angular.norm()) == pytest.approx(float(before[1].norm()), rel=0.05)


def moving(num_worlds: int, path: str, precision: str = "float32", device: str = "cpu") -> sw.Simulation:
    """A beam with a cable and a rigid body on its end, whose worlds differ in moduli."""
    mesh = meshing.brick((0.12, 0.02, 0.02), (6, 2, 1))
    builder = sw.ModelBuilder()
    body = builder.add_hexes(mesh, material=sw.Corotational(3e5, 0.45), density=1000.0, rayleigh=(0.5, 5e-3))
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-9, 1.0, 1.0)))
    tool = builder.add_rigid(sw.Box((0.02, 0.02, 0.02)), mass=0.01, pose=(0.13, 0.01, 0.01))
    builder.attach(body, np.flatnonzero(mesh.nodes[:, 0] > 0.12 - 1e-9), to=tool)
    builder.add_cable(body, [(x, 0.01, 0.018) for x in np.linspace(0.01, 0.1, 6)], (-0.01, 0.01, 0.018))
    builder.add_marker(body, (0.1, 0.01, 0.02))
    model = builder.finalize(num_worlds, device, precision)
    return sw.Simulation(model, dt=0.01, **({"solver_path": path} if device == "cpu" else {}))


def play(sim: sw.Simulation, worlds: list[int], steps: int = 20) -> dict[str, torch.Tensor]:
    """Worlds take the moduli and commands of some individuals."""
    factor = torch.tensor([0.7 + 0.1 * i for i in worlds]).to(sim.params.youngs)[:, None]
    sim.params.youngs[:] = 3e5 * factor
    sim.params.nu[:] = 0.4 + 0.01 * torch.tensor(worlds).to(factor)[:, None]
    sim.control.cable_displacement[:] = 0.004 * factor
    for _ in range(steps):
        sim.step()
    assert int(sim.status.max()) == 0
    return {name: getattr(sim, name).clone() for name in ("node_x", "node_v", "body_pose", "marker_x")}


@pytest.mark.parametrize("path", ["scalar", "lanes"])
def test_batches_snapshots_and_workspaces(path: str) -> None:
    """A world is the same alone, in another place, after a snapshot, and whatever the workspace held; bit for bit."""
    sim = moving(9, path)
    whole = play(sim, list(range(9)))
    assert_same(play(moving(1, path), [7]), whole, [0], [7])
    saved = sim.snapshot()
    first = play(sim, list(range(9)), 5)
    sim.restore(saved)
    for name, about in declared().items():
        if about.keeps is None and not about.integer:
            getattr(sim._systems[0].work, name).fill(float("nan"))
    assert_same(play(sim, list(range(9)), 5), first, list(range(9)), list(range(9)))


def test_lanes_and_precisions_agree() -> None:
    """Paths and precisions differ by rounding."""
    exact = play(moving(1, "scalar", "float64"), [3])["node_x"]
    for path in ("scalar", "lanes"):
        found = play(moving(1, path), [3])["node_x"]
        assert float((found - exact).abs().max()) < 2e-6


@pytest.mark.cuda
@pytest.mark.parametrize(("precision", "tolerance"), [("float32", 5e-6), ("float64", 1e-12)])
def test_a_gpu_agrees(precision: str, tolerance: float) -> None:
    """With a CPU to rounding, and worlds with themselves alone to the bit."""
    whole = play(moving(9, "", precision, "cuda:0"), list(range(9)))
    exact = play(moving(9, "scalar", precision), list(range(9)))["node_x"]
    assert float((whole["node_x"].cpu() - exact).abs().max()) < tolerance
    assert_same(play(moving(4, "", precision, "cuda:0"), [7, 1, 2, 3]), whole, [0], [7])


def test_a_carried_end_moves_as_a_light_one(rng: np.random.Generator) -> None:
    """A light rigid body on the end: what it carries is stiff, and momentum and weight go through it."""
    sim = moving(1, "scalar", "float64")
    sim.params.gravity[:] = 0.0
    move(sim, sim.model.node_rest)
    for _ in range(5):
        sim.step()
    assert float((sim.node_x[0] - torch.as_tensor(sim.model.node_rest)).abs().max()) < 1e-9


def test_stress_strain_and_mass() -> None:
    """Of a block in uniaxial stretch, turned; masses of both lumpings add up."""
    mesh, turn = meshing.brick(SIZE, CELLS), cases.random_rotation(np.random.default_rng(0))
    sim = block(mesh, nu=0.0)
    move(sim, mesh.nodes * [1.01, 1.0, 1.0] @ turn.T)
    axis = np.outer(turn[:, 0], turn[:, 0])
    np.testing.assert_allclose(sim.element_stress()[0, 3], YOUNGS * 0.01 * axis, rtol=1e-9, atol=1e-6)
    strain = np.zeros((3, 3))
    strain[0, 0] = 0.5 * (1.01**2 - 1.0)
    np.testing.assert_allclose(sim.element_strain()[0, 3], strain, atol=1e-12)
    assert float(sim.node_stress()[0, 0]) == pytest.approx(YOUNGS * 0.01, rel=2e-2)
    mass = 1000.0 * np.prod(SIZE)
    assert float(sim.elastic_energy()[0]) == pytest.approx(0.5 * YOUNGS * 0.01**2 * np.prod(SIZE), rel=1e-9)
    assert float(sim.mass.sum()) == pytest.approx(mass)
    even = block(mesh, lumping="uniform").mass[0]
    assert float(even.sum()) == pytest.approx(mass)
    assert float(even.max() - even.min()) < 1e-12


def test_hexes_say_what_they_do_not_know() -> None:
    """Other laws, rest shapes as inputs, exact tangents and wrong flags: each names the body and the way out."""
    mesh, builder = meshing.brick(SIZE, CELLS), sw.ModelBuilder()
    for law in (sw.NeoHookean(1e5, 0.4), sw.Corotational(1e5, 0.4, method="large")):
        with pytest.raises(ValueError, match="body 'leg': hexahedra know the law Corotational of method 'warped'"):
            builder.add_hexes(mesh, material=law, density=1000.0, name="leg")
    with pytest.raises(ValueError, match="hexes are missing"):
        builder.add_hexes(mesh.nodes, material=sw.Corotational(1e5, 0.4), density=1000.0)
    with pytest.raises(ValueError, match="hexes are given twice"):
        builder.add_hexes(mesh, mesh.hexes, material=sw.Corotational(1e5, 0.4), density=1000.0)
    for thin in ("yes", [True], np.ones(len(mesh.hexes))):
        with pytest.raises(ValueError, match=r"thin must be True, False, or one of the two for each .* shape \(\d+,\)"):
            builder.add_hexes(mesh, material=sw.Corotational(1e5, 0.4), density=1000.0, thin=thin)
    sim = block(mesh, held=[0, 1, 2])
    with pytest.raises(ValueError, match="rest shapes have no gradient beside hexahedra"):
        sw.gradients.Rollout(sim, rest=True)
    with pytest.raises(ValueError, match=r"^modes: .*mesh hexahedra with add_tets"):
        sim.modes(1)


def test_a_chamber_blows_a_hollow_brick_up() -> None:
    """Clapeyron: half of pressure times the change of volume is stored, where 26 bricks enclose air."""
    mesh = meshing.brick((0.03, 0.03, 0.03), (3, 3, 3))
    hollow = meshing.HexMesh(*meshing.compact(mesh.nodes, np.delete(mesh.hexes, 13, axis=0)))
    faces = hollow.linear().surface()
    wall = faces[((hollow.nodes[faces] > 1e-9) & (hollow.nodes[faces] < 0.03 - 1e-9)).all(axis=(1, 2))]
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_hexes(hollow, material=sw.Corotational(YOUNGS, 0.45), density=1000.0, rayleigh=(50.0, 0.01))
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1.0, 1.0, 1e-9)))
    used, corner = np.unique(wall, return_inverse=True)
    builder.add_cavity(body, hollow.nodes[used], corner.reshape(-1, 3)[:, ::-1])
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01)
    rest = float(sim.cavity_volume[0, 0])
    sim.control.cavity_pressure[:] = 10.0
    assert sim.solve_static(1e-10).reason[0].is_equilibrium
    grown = float(sim.cavity_volume[0, 0]) - rest
    assert rest == pytest.approx(1e-6)
    assert grown > 0.0
    assert float(sim.elastic_energy()[0]) == pytest.approx(0.5 * 10.0 * grown, rel=2e-3)


def test_a_brick_rests_on_the_floor() -> None:
    """Contact through the triangles of the boundary carries the weight."""
    mesh = meshing.brick((0.04, 0.04, 0.02), (2, 2, 1))
    builder = sw.ModelBuilder()
    body = builder.add_hexes(mesh, material=sw.Corotational(YOUNGS, 0.45), density=1000.0, rayleigh=(20.0, 0.01))
    floor = builder.add_rigid(sw.Plane(), kinematic=True, pose=(0.0, 0.0, -0.001))
    builder.add_contact(body, floor, mu=0.5)
    sim = sw.Simulation(builder.finalize(), dt=0.01)
    for _ in range(100):
        sim.step()
    assert int(sim.status[0]) == 0
    assert float(sim.contact_force(body, floor)[0, 2]) == pytest.approx(1000.0 * 3.2e-5 * 9.81, rel=1e-3)


def test_tractions_and_membranes_go_with_hexahedra() -> None:
    """A pulled bar is longer by the load per modulus; glued skins on both sides bear their share of it."""
    size, skin = (0.1, 0.02, 0.01), 1e-4
    mesh = meshing.brick(size, (10, 2, 1))
    stretch = []
    for youngs in (0.0, 2e6):
        builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        body = builder.add_hexes(mesh, material=sw.Corotational(YOUNGS, 0.0), density=1000.0, rayleigh=(5.0, 0.01))
        builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-9, 1.0, 1.0)))
        builder.add_traction(body, (100.0, 0.0, 0.0), box=((0.1 - 1e-9, -1.0, -1.0), (1.0, 1.0, 1.0)))
        if youngs:
            faces = mesh.linear().surface()
            for height in (0.0, size[2]):
                side = faces[np.abs(mesh.nodes[faces, 2] - height).max(axis=1) < 1e-9]
                builder.add_membrane(body, side, thickness=skin, youngs=youngs, nu=0.0)
        sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01)
        assert sim.solve_static().reason[0].is_equilibrium
        stretch.append(float(sim.node_x[0, :, 0].max()) / size[0] - 1.0)
    alone = 100.0 / YOUNGS
    assert stretch[0] == pytest.approx(alone, rel=2e-3)
    assert stretch[1] == pytest.approx(alone / (1.0 + 2.0 * skin * 2e6 / (YOUNGS * size[2])), rel=0.02)
