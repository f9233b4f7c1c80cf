"""Inverse control of cable robots: sensitivities, convergence, bounds, targets out of reach, batches."""

import math

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp.control import InverseController, Outcome, PointEffector
from softwarp.envs.scenes.diamond import DiamondSceneConfig, build_diamond_scene

PERIOD, SUBSTEPS = 0.05, 5


def diamond(worlds=1, *, precision="float32", path="auto", **options):
    """Simulation of the coarse diamond; the top is marker 0."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    build_diamond_scene(DiamondSceneConfig(**({"mesh": "coarse"} | options)), builder)
    return sw.Simulation(builder.finalize(num_worlds=worlds, precision=precision), dt=0.01, solver_path=path)


def beam(worlds=1, *, control="force", max_rate=math.inf, max_tension=math.inf, precision="float64"):
    """A silicone beam along x, clamped at x = 0, with a cable along each long edge; the tip is marker 0."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    mesh = sw.meshing.box((0.10, 0.02, 0.02), (10, 2, 2))
    silicone = sw.Corotational(youngs=5.0e5, nu=0.4)
    body = builder.add_tets(mesh, material=silicone, density=1100.0, rayleigh=(0.1, 0.01))
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1.0e-9, 1.0, 1.0)))
    for y, z in ((0.002, 0.002), (0.018, 0.002), (0.018, 0.018), (0.002, 0.018)):
        points = [(0.02 * k + 0.01, y, z) for k in range(5)]
        builder.add_cable(body, points, (0.0, y, z), control=control, max_rate=max_rate, max_tension=max_tension)
    builder.add_marker(body, (0.10, 0.01, 0.01))
    return sw.Simulation(builder.finalize(num_worlds=worlds, precision=precision), dt=0.01)


def end_of(tensions):
    """Tip [m] of the beam in equilibrium under tensions [N], shape (1, 3)."""
    forward = beam()
    forward.control.cable_tension[:] = torch.tensor(tensions, dtype=torch.float64)
    assert forward.solve_static().converged.all()
    return forward.marker_x[:, 0].clone()


def run(sim, controller, target, calls):
    """Control for some calls; distances [m], shape (call, world)."""
    distances = []
    for _ in range(calls):
        solution = controller.solve(target)
        sim.step(SUBSTEPS)
        distances.append((controller.positions()[:, 0] - target).norm(dim=-1))
    return torch.stack(distances), solution


def blocks(controller):
    """E and D of every world [m/N]."""
    (_, system), *_ = controller._systems
    n = controller.actuators.count
    worlds = controller.sim.num_worlds
    return system.problem.effect.numpy().reshape(worlds, -1, n), system.problem.compliance.numpy().reshape(worlds, n, n)


@pytest.mark.slow
def test_effect_of_a_step_is_that_of_the_simulator():
    """A linearly implicit step is linear in the tensions: differences of two steps give E and D, here in a bent state.

    Central difference of +-1 mN; agreement to 1e-6, the rest being rounding in the difference.
    """
    sim = beam()
    sim.control.cable_tension[:] = torch.tensor([0.8, 0.3, 0.0, 0.2], dtype=torch.float64)
    for _ in range(30):
        sim.step()
    controller = InverseController(sim, [0], horizon=0.01)
    controller.solve(sim.marker_x[:, 0].clone(), apply=False)
    effect, compliance = blocks(controller)
    start, tension = sim.snapshot(), sim.control.cable_tension.clone()
    for cable in range(4):
        ends = []
        for sign in (1.0, -1.0):
            sim.restore(start)
            sim.control.cable_tension[:] = tension
            sim.control.cable_tension[:, cable] += sign * 1.0e-3 + 1.0e-3
            sim.step()
            ends.append((sim.marker_x[0, 0].clone(), sim.cable_displacement[0].clone()))
        difference = [((a - b) / 2.0e-3).numpy() for a, b in zip(*ends, strict=True)]
        scale = np.abs(effect).max()
        np.testing.assert_allclose(effect[0, :, cable], difference[0], atol=1e-6 * scale)
        # displacements are measured on the moved cable, whose direction has changed: first order in the step's motion
        np.testing.assert_allclose(compliance[0, :, cable], difference[1], atol=2e-2 * np.abs(compliance).max())


def test_effect_at_equilibrium_is_that_of_the_nonlinear_model():
    """Near rest, tensions of 0 to 2 mN: equilibria by ``solve_static`` differ by E and D times the change, to 1e-3."""
    sim = beam()
    controller = InverseController(sim, [0], horizon=math.inf)
    controller.solve(sim.marker_x[:, 0].clone(), apply=False)
    effect, compliance = blocks(controller)
    for cable in range(4):
        ends = []
        for tension in (0.0, 2.0e-3):
            sim.reset()
            sim.control.cable_tension[:, cable] = tension
            assert sim.solve_static().converged.all()
            ends.append((sim.marker_x[0, 0].clone(), sim.cable_displacement[0].clone()))
        difference = [((b - a) / 2.0e-3).numpy() for a, b in zip(*ends, strict=True)]
        np.testing.assert_allclose(effect[0, :, cable], difference[0], atol=1e-3 * np.abs(effect).max())
        np.testing.assert_allclose(compliance[0, :, cable], difference[1], atol=1e-3 * np.abs(compliance).max())
    eigenvalues = np.linalg.eigvalsh(compliance[0])
    np.testing.assert_allclose(compliance[0], compliance[0].T, rtol=1e-9, atol=1e-15)
    assert eigenvalues.min() > 0.0


@pytest.mark.parametrize("control", ["force", "length"])
def test_target_of_a_forward_run_is_reached(control):
    """Where known tensions lead, control arrives: within 1e-3 of the length in 20 calls, with tensions >= 0."""
    target = end_of([4.0, 0.0, 0.0, 1.5])
    assert (target - torch.tensor([[0.10, 0.01, 0.01]])).norm() > 0.01
    sim = beam(control=control)
    controller = InverseController(sim, [0], period=PERIOD)
    distance, solution = run(sim, controller, target, 20)
    assert distance[-1] < 1.0e-4
    assert (solution.effort >= 0.0).all() and (sim.cable_tension >= 0.0).all()
    torch.testing.assert_close(sim.cable_tension, solution.effort, atol=2e-2, rtol=0)


def test_rates_are_kept_and_told():
    """At 20 mm/s a cable's command moves by at most 1 mm in 50 ms; until the target is near, worlds are MOVING."""
    sim = beam(control="length", max_rate=0.02)
    controller = InverseController(sim, [0], period=PERIOD)
    target = end_of([4.0, 0.0, 0.0, 1.5])
    outcomes = []
    for _ in range(25):
        before = sim.cable_displacement.clone()
        solution = controller.solve(target)
        outcomes.append(int(solution.outcome[0]))
        taut = solution.effort > 1e-9
        assert ((solution.command - before).abs()[taut] <= 0.001 + 1e-9).all()
        sim.step(SUBSTEPS)
    assert outcomes[0] == Outcome.MOVING and outcomes[-1] == Outcome.REACHED


def test_bounds_on_tension_are_kept_and_what_is_out_of_reach_told():
    """With at most 0.3 N a far target is answered by the nearest point: no tension beyond, UNREACHABLE, and at rest."""
    sim = beam(max_tension=0.3)
    controller = InverseController(sim, [0], period=PERIOD)
    target = torch.tensor([[0.08, 0.06, 0.01]], dtype=torch.float64)
    distance, solution = run(sim, controller, target, 40)
    assert solution.outcome[0] == Outcome.UNREACHABLE
    assert (solution.effort <= 0.3 + 1e-9).all() and (solution.effort >= -1e-9).all()
    assert solution.effort.max() == pytest.approx(0.3, abs=1e-6)
    assert abs(distance[-1] - distance[-5]) < 1e-5
    nearest = controller.positions()[:, 0].clone()
    for change in ([0.02, 0, 0, 0], [0, 0.02, 0, 0], [0, 0, 0.02, 0], [0, 0, 0, 0.02]):
        for sign in (1.0, -1.0):
            sim.control.cable_tension[:] = (solution.effort + sign * torch.tensor(change)).clamp(0.0, 0.3)
            sim.solve_static()
            assert (sim.marker_x[0, 0] - target[0]).norm() > (nearest[0] - target[0]).norm() - 2e-5


def test_diamond_reaches_what_cables_can_reach():
    """Eight equilibria of known displacements as targets: below 0.05 mm after 40 calls, commands in 0 to 25 mm."""
    rng = np.random.default_rng(0)
    sim = diamond(8)
    known = torch.as_tensor(0.02 * rng.uniform(size=(8, 4)) + 0.003, dtype=torch.float32)
    sim.control.cable_displacement.copy_(known)
    assert sim.solve_static().converged.all()
    target = sim.marker_x[:, 0].clone()
    sim.reset()
    controller = InverseController(sim, [0], period=PERIOD)
    distance, solution = run(sim, controller, target, 40)
    assert distance[-1].max() < 5.0e-5
    assert (solution.outcome == Outcome.REACHED).all()
    assert (solution.command >= -1e-9).all() and (solution.command <= 0.025 + 1e-9).all()
    assert (sim.cable_tension >= 0.0).all()


def test_circle_is_followed():
    """Radius 6 mm in 10 s, 4 mm/s: the top lags by about two periods of 50 ms, less than 0.5 mm from 3 s on."""
    sim = diamond()
    controller = InverseController(sim, [0], period=PERIOD)
    start, worst = controller.positions()[0, 0].clone(), 0.0
    for k in range(160):
        now = PERIOD * (k + 1)
        phase = 0.2 * math.pi * now
        target = torch.tensor([0.006 * math.cos(phase), 0.006 * math.sin(phase), 0.138])
        target = torch.lerp(start, target, min(1.0, now / 2.0))
        controller.solve(target[None])
        sim.step(SUBSTEPS)
        if now > 3.0:
            worst = max(worst, float((controller.positions()[0, 0] - target).norm()))
    assert worst < 5e-4


def test_free_axes_are_not_looked_at():
    """With only the height as target, the top rises straight up, as all four cables share the work."""
    sim = diamond(rotation="polar")
    controller = InverseController(sim, [PointEffector((0,), axes="z")], period=PERIOD)
    target = torch.tensor([[0.5, -0.5, 0.138]])
    for _ in range(40):
        solution = controller.solve(target)
        sim.step(SUBSTEPS)
    assert float(solution.error) < 1e-4  # half a metre along x and y does not count
    top = controller.positions()[0, 0]
    assert abs(float(top[2]) - 0.138) < 1e-4 and top[:2].abs().max() < 2e-4
    assert sim.cable_tension.max() - sim.cable_tension.min() < 0.02 * sim.cable_tension.max()


@pytest.mark.parametrize("path", ["scalar", "lanes"])
def test_world_equals_alone(path):
    """World 5 of 11 has the bits of the same world alone on the same solver path, through ten controlled calls."""
    rng = np.random.default_rng(3)
    targets = torch.as_tensor([0.0, 0.0, 0.138] + 0.008 * rng.uniform(-1.0, 1.0, (11, 3)), dtype=torch.float32)
    runs = []
    for chosen in (range(11), [5]):
        sim = diamond(len(chosen), path=path)
        controller = InverseController(sim, [0], period=PERIOD)
        commands = []
        for _ in range(10):
            commands.append(controller.solve(targets[list(chosen)]).command.clone())
            sim.step(SUBSTEPS)
        runs.append((torch.stack(commands), sim.node_x.clone()))
    (batch, positions), (alone, position) = runs
    assert torch.equal(batch[:, 5], alone[:, 0]) and torch.equal(positions[5], position[0])


def test_world_that_is_not_finite_keeps_its_efforts():
    """NaN in one world: FAILED there, the others have the bits they have without."""
    targets = torch.tensor([[0.0, 0.005, 0.135]] * 3)
    outcomes = []
    for poison in (False, True):
        sim = diamond(3)
        controller = InverseController(sim, [0], period=PERIOD)
        controller.solve(targets)
        sim.step(SUBSTEPS)
        if poison:
            sim.node_x[1] = torch.nan
        outcomes.append(controller.solve(targets))
    whole, found = outcomes
    assert found.outcome[1] == Outcome.FAILED
    assert torch.equal(found.command[[0, 2]], whole.command[[0, 2]])


def test_mistakes_are_named():
    sim = beam()
    with pytest.raises(ValueError, match=r"markers must be among the 1 of the scene, got \(3,\)"):
        InverseController(sim, [3])
    with pytest.raises(ValueError, match="effectors must hold at least one effector"):
        InverseController(sim, [])
    with pytest.raises(TypeError, match="'tip' is no effector; give a marker"):
        InverseController(sim, ["tip"])
    with pytest.raises(ValueError, match="weight must be positive and finite, got inf"):
        InverseController(sim, [PointEffector((0,), weight=math.inf)])
    with pytest.raises(ValueError, match="the scene has no chambers, got"):
        InverseController(sim, [0], chambers=[0])
    with pytest.raises(ValueError, match="axes must be letters of 'xyz', got 'xw'"):
        InverseController(sim, [PointEffector((0,), axes="xw")])
    with pytest.raises(ValueError, match=r"cables must be different ones of 0 \.\. 3, got \[0, 0\]"):
        InverseController(sim, [0], cables=[0, 0])
    with pytest.raises(ValueError, match=r"period must be positive and finite, got -1\.0"):
        InverseController(sim, [0], period=-1.0)
    with pytest.raises(ValueError, match=r"targets must have shape \(1, 1, 3\), got \(2, 1, 3\)"):
        InverseController(sim, [0]).solve(torch.zeros(2, 3))
