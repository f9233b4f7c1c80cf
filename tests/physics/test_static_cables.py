"""Static equilibrium of bodies on taut cables: exact tangent, convergence, stability, agreement with damped steps."""

from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.envs.scenes.trunk import TrunkSceneConfig, build_trunk_scene
from softwarp.plan.compile import coupled
from softwarp.solvers.linear.cholesky import upload
from softwarp.solvers.quasi_static import QuasiStatic
from softwarp.solvers.system import Options

# Shortening of the eight cables [m]: four long, four short
PULLS = {
    "none": [0.0] * 8,
    "one": [0.01] + [0.0] * 7,
    "two": [0.008, 0.004] + [0.0] * 6,
    "below": [0.0, 0.0, 0.02] + [0.0] * 5,
    "short": [0.0] * 4 + [0.008] + [0.0] * 3,
    "many": [0.003, 0.006, 0.001, 0.002, 0.004, 0.0, 0.002, 0.005],
}


def trunk(
    pulls: list[list[float]],
    precision: str = "float64",
    mesh: str = "coarse",
    rotation: str = "large",
    closing_length: float = 0.0,
    **options: Any,
) -> sw.Simulation:
    """One trunk per command, at rest, in gravity across its axis."""
    builder = sw.ModelBuilder(gravity=(0.0, -9.81, 0.0))
    build_trunk_scene(TrunkSceneConfig(mesh=mesh, rotation=rotation, closing_length=closing_length), builder)
    sim = sw.Simulation(builder.finalize(len(pulls), precision=precision), **options)  # type: ignore[arg-type]
    sim.control.cable_displacement.copy_(torch.tensor(pulls))
    return sim


def dense(static: QuasiStatic) -> np.ndarray:
    """A of world 0 over the free nodes in elimination order."""
    symbolic = static.system.model.symbolic
    n = symbolic.size
    below, above = (rows.real.numpy()[0, :, 0].reshape(-1, 3, 3) for rows in (static.work.a, static.a_upper))
    matrix = np.zeros((n, 3, n, 3))
    matrix[symbolic.a_col, :, symbolic.a_row] = above.transpose(0, 2, 1)
    matrix[symbolic.a_row, :, symbolic.a_col] = below
    return matrix.reshape(3 * n, 3 * n)


@pytest.mark.parametrize("rotation", ["large", "polar"])
@pytest.mark.parametrize("closing_length", [0.0, 0.0055])
def test_tangent_is_the_derivative_of_the_imbalance(
    closing_length: float, rotation: str, rng: np.random.Generator
) -> None:
    """A d = -(r(x + e d) - r(x - e d)) / 2e for r = f_ext - f_int + H' T at a bent pose with all cables taut."""
    sim = trunk([PULLS["many"]], rotation=rotation, closing_length=closing_length)
    sim.solve_static()
    model = coupled(sim.model)
    system = sim._systems[0].with_options(
        Options(project_tangent=False), model, upload(model.symbolic, "cpu"), exact=True
    )
    static = QuasiStatic(system)
    tension = rng.uniform(0.5, 2.0, (1, 8, 1))
    start = sim.node_x.clone()
    free = torch.from_numpy(~sim.model.node_fixed)
    order = model.dof_node.numpy()

    def imbalance(positions: torch.Tensor) -> np.ndarray:
        sim.node_x.copy_(positions)
        system.load()
        system.scale(0.0)
        system.work.multiplier.real.assign(tension)
        static._load()
        system.imbalance(1.0, inertia=False)
        return system.linear.y.real.numpy()[0, : system.shard.dof_rows, 0].copy()

    for _ in range(3):
        direction = torch.from_numpy(rng.standard_normal(start.shape)) * free[:, None]
        step = 1e-7
        difference = (imbalance(start - step * direction) - imbalance(start + step * direction)) / (2.0 * step)
        imbalance(start)
        static._tangent()
        product = dense(static) @ direction[0].numpy()[order].ravel()
        np.testing.assert_allclose(product, difference, atol=1e-5 * np.abs(difference).max())


@pytest.mark.parametrize("rotation", ["large", pytest.param("polar", marks=pytest.mark.slow)])
@pytest.mark.parametrize("mesh", ["coarse", pytest.param("medium", marks=pytest.mark.slow)])
def test_trunk_converges_quickly(mesh: str, rotation: str) -> None:
    """Every moderate pull to 1e-9 from rest; float32 ends within 0.1 mm of the same poses.

    A short cable alone may buckle the trunk to either side, which rounding chooses: the pose or its mirror image.
    """
    sim = trunk(list(PULLS.values()), mesh=mesh, rotation=rotation)
    result = sim.solve_static()
    assert bool(result.converged.all())
    assert result.iterations <= 120
    assert float(result.residual.max()) < 1e-9
    command = sim.control.cable_displacement
    gap = sim.cable_displacement - command
    assert float(gap.min()) > -1e-9  # as short as commanded, or shorter and slack
    assert float((gap * sim.cable_tension).abs().max()) < 1e-9
    assert float(sim.cable_tension.min()) >= 0.0

    single = trunk(list(PULLS.values()), "float32", mesh, rotation)
    assert bool(single.solve_static().converged.all())
    apart = (single.node_x - sim.node_x).abs().amax(dim=(1, 2))
    middle, single_middle = (held.node_x.double().mean(dim=1) for held in (sim, single))
    short = list(PULLS).index("short")
    if apart[short] > 1e-4:
        apart[short] = (single_middle - middle * torch.tensor([-1.0, 1.0, 1.0]))[short].abs().max()
    assert float(apart.max()) < 1e-4


@pytest.mark.slow
def test_end_phase_is_quadratic() -> None:
    """The last corrections square the residual: from 1e-3 to 1e-9 in two or three."""
    sim, history = trunk([PULLS["below"]]), []
    for limit in range(5, 60, 1):
        sim.reset()
        sim.control.cable_displacement.copy_(torch.tensor([PULLS["below"]]))
        result = sim.solve_static(max_iterations=limit)
        history.append(float(result.residual[0]))
        if bool(result.converged.all()):
            break
    tail = [value for value in history if value < 1e-2]
    assert len(tail) <= 5, history


def test_steps_reach_and_keep_the_equilibrium() -> None:
    """Damped steps of 0.05 s from rest end within 0.1 mm; steps of 0.01 s from there do not leave."""
    pulls = [PULLS[name] for name in ("none", "below", "many")]
    static = trunk(pulls)
    assert bool(static.solve_static().converged.all())
    stepped = trunk(pulls, dt=0.05)
    for _ in range(300):
        stepped.step()
    assert float((stepped.node_x - static.node_x).abs().max()) < 1e-4
    kept = trunk(pulls, dt=0.01)
    kept.node_x.copy_(static.node_x)
    kept.cable_tension.copy_(static.cable_tension)
    for _ in range(50):
        kept.step()
    assert float((kept.node_x - static.node_x).abs().max()) < 1e-8


def test_settled_state_is_a_fixed_point() -> None:
    """A second solve from the equilibrium takes one look."""
    sim = trunk([PULLS["many"]])
    sim.solve_static()
    before = sim.node_x.clone()
    result = sim.solve_static()
    assert bool(result.converged.all())
    assert result.iterations <= 5
    assert float((sim.node_x - before).abs().max()) < 1e-10


def test_equilibrium_from_another_pose() -> None:
    """From the pose of another command the same equilibrium as from rest, though cables go slack on the way."""
    sim = trunk([PULLS["below"]])
    sim.solve_static()
    reference = sim.node_x.clone()
    sim.control.cable_displacement.copy_(torch.tensor([PULLS["many"]]))
    sim.solve_static()
    sim.control.cable_displacement.copy_(torch.tensor([PULLS["below"]]))
    assert bool(sim.solve_static().converged.all())
    assert float((sim.node_x - reference).abs().max()) < 1e-7


def test_impossible_command_is_reported() -> None:
    """All cables shorter by 50 mm would fold the trunk: not converged, MAX_ITERATIONS, and a sane pose is left."""
    sim = trunk([[0.05] * 8, PULLS["none"]])
    result = sim.solve_static(max_iterations=60)
    assert result.converged.tolist() == [False, True]
    assert sim.status.tolist() == [sw.Status.MAX_ITERATIONS, sw.Status.OK]
    assert bool(torch.isfinite(sim.node_x).all())
    assert float((sim.node_x - torch.from_numpy(sim.model.node_rest)).abs().max()) < 0.25


def test_unstable_equilibrium_is_left() -> None:
    """A column six times heavier than it can carry, started upright, ends bent over and stable (K positive definite).

    Self-buckling at rho A g L^3 = 7.837 E I (Greenhill, 1881); the upright column is an equilibrium too.
    """
    length, width, youngs = 0.2, 0.01, 2e5
    mesh = meshing.box((width, width, length), (2, 2, 12))
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    density = 6.0 * 7.837 * youngs * width**2 / (12.0 * 9.81 * length**3)
    body = builder.add_tets(mesh, material=sw.Corotational(youngs, 0.3), density=density)
    builder.fix(body, nodes=np.flatnonzero(mesh.nodes[:, 2] < 1e-9))
    sim = sw.Simulation(builder.finalize(precision="float64"))
    assert bool(sim.solve_static().converged.all())
    tip = sim.node_x[0, -1].numpy() - mesh.nodes[-1]
    assert np.hypot(tip[0], tip[1]) > 0.25 * length
    free = np.repeat(~sim.model.node_fixed, 3)
    assert np.linalg.eigvalsh(sim.stiffness_matrix().toarray()[free][:, free])[0] > 0.0


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_a_cable_alone_holds_a_hinged_body(precision: str) -> None:
    """A bar that turns about its lower edge hangs on a cable at its far end: T = m g x / (lever arm of the cable).

    Its own stiffness is singular, and in float32 what rounding of it leaves never falls below the tolerance; worlds
    that come no nearer on the path are settled by steps, whatever their neighbours do.
    """
    density, size = 1000.0, (0.1, 0.02, 0.02)
    mesh = meshing.box(size, (5, 1, 1))
    anchor = np.array([0.1, 0.01, 0.15])
    lengths, alone = [0.0, 0.01, 0.03], []
    for pulls in (lengths, *([pull] for pull in lengths)):
        builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
        bar = builder.add_tets(mesh, material=sw.NeoHookean(1e6, 0.3), density=density)
        builder.fix(bar, nodes=np.flatnonzero((mesh.nodes[:, 0] < 1e-9) & (mesh.nodes[:, 2] < 1e-9)))
        builder.add_cable(bar, [(0.1, 0.01, 0.01)], pull_point=anchor)
        builder.add_marker(bar, (0.1, 0.01, 0.01))
        sim = sw.Simulation(builder.finalize(len(pulls), precision=precision))
        sim.control.cable_displacement[:, 0] = torch.tensor(pulls)
        result = sim.solve_static()
        assert result.converged.all() and result.iterations < 60, result
        alone.append(
            (sim.node_x.double(), sim.cable_tension.double(), sim.marker_x[:, 0].double(), sim.mass[0].double())
        )
    batch, tension, tip, mass = alone[0]
    for world, (pose, force, *_) in enumerate(alone[1:]):
        assert torch.equal(pose[0], batch[world]) and torch.equal(force[0], tension[world])
    middle = (mass[:, None] * batch).sum(dim=1) / mass.sum()
    way = torch.as_tensor(anchor) - tip
    way /= way.norm(dim=1, keepdim=True)
    arm = tip[:, 0] * way[:, 2] - tip[:, 2] * way[:, 0]
    expected = density * np.prod(size) * 9.81 * middle[:, 0] / arm
    np.testing.assert_allclose(tension[:, 0], expected, rtol=1e-8 if precision == "float64" else 1e-4)
