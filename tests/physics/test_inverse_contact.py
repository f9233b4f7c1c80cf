"""Inverse control beside laws: cables that are not asked, contact that sticks, slides, opens and closes, a wall."""

import math

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp.control import InverseController, Outcome, PointEffector
from softwarp.envs.scenes.cart_stem_contact import build_cart_stem_contact_scene
from softwarp.envs.tasks.cart_stem_contact import CartStemContactConfig
from softwarp.solvers.linear.cholesky import PanelSolver

PERIOD, SUBSTEPS = 0.05, 5


def beam(worlds=1, *, control="force", wall=None, mu=0.5, precision="float64", **options):
    """A silicone beam along x with a cable along each long edge, and a wall above it at a height; tip: marker 0."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    mesh = sw.meshing.box((0.10, 0.02, 0.02), (10, 2, 2))
    silicone = sw.Corotational(youngs=5.0e5, nu=0.4)
    body = builder.add_tets(mesh, material=silicone, density=1100.0, rayleigh=(0.1, 0.01))
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1.0e-9, 1.0, 1.0)))
    for y, z in ((0.002, 0.002), (0.018, 0.002), (0.018, 0.018), (0.002, 0.018)):
        points = [(0.02 * k + 0.01, y, z) for k in range(5)]
        builder.add_cable(body, points, (0.0, y, z), control=control, **options)
    builder.add_marker(body, (0.10, 0.01, 0.01))
    if wall is not None:
        upside_down = (0.0, 0.0, wall, 1.0, 0.0, 0.0, 0.0)  # its solid side is above
        plate = builder.add_rigid(sw.shapes.Plane(), kinematic=True, pose=upside_down)
        builder.add_contact(body, plate, mu=mu, contact_distance=0.0005, alarm_distance=0.004)
    model = builder.finalize(num_worlds=worlds, precision=precision)
    return sw.Simulation(model, dt=0.01, gauss_seidel_iterations=500)


def effect(controller):
    """E of world 0 [m/N]."""
    (_, system), *_ = controller._systems
    return system.problem.effect.numpy()[0].reshape(-1, controller.actuators.count)


def step_difference(sim, cable, change):
    """Change of the tip [m] per newton on a cable over one step, between the present tension and one more."""
    start, tension = sim.snapshot(), sim.control.cable_tension.clone()
    ends = []
    for more in (0.0, change):
        sim.restore(start)
        sim.control.cable_tension[:] = tension
        sim.control.cable_tension[:, cable] += more
        sim.step()
        ends.append(sim.marker_x[0, 0].clone())
    sim.restore(start)
    return ((ends[1] - ends[0]) / change).numpy()


@pytest.mark.parametrize("mu", [pytest.param(0.0, marks=pytest.mark.slow), 1.0])
def test_effect_under_contact_is_that_of_the_simulator(mu):
    """Tip pressed against a wall, without friction or sticking: differences of steps give E, within 0.1 % of its size.

    It comes to rest without friction, so that contacts that stick are inside of their cones.
    """
    sim = beam(wall=0.0215, mu=0.0)
    sim.control.cable_tension[:] = torch.tensor([0.5, 0.5, 2.5, 2.5], dtype=torch.float64)
    sim.step(60)
    sim.params.pair_mu.fill_(mu)
    sim.step(5)
    assert abs(float(sim.pair_force[0, 0, 2])) > 0.05
    controller = InverseController(sim, [0], horizon=0.01, period=0.01)
    controller.solve(sim.marker_x[:, 0].clone(), apply=False)
    pressed = effect(controller)
    for cable in range(4):
        for change in (1.0e-3, -1.0e-3):  # N
            difference = step_difference(sim, cable, change)
            np.testing.assert_allclose(pressed[:, cable], difference, atol=1e-3 * np.abs(pressed).max())


def test_wall_is_where_the_tip_stops():
    """A target behind the wall: the tip leans on it at the nearest point, and along the wall it is where it should."""
    sim = beam(control="length", wall=0.024, mu=0.0)
    controller = InverseController(sim, [0], period=PERIOD)
    goal = beam()
    goal.control.cable_tension[:] = torch.tensor([0.0, 0.0, 4.0, 2.0], dtype=torch.float64)
    assert goal.solve_static().converged.all()
    target = goal.marker_x[:, 0].clone()
    assert target[0, 2] > 0.016  # the wall keeps it below
    for _ in range(40):
        solution = controller.solve(target)
        sim.step(SUBSTEPS)
    tip = controller.positions()[0, 0]
    assert (sim.cable_tension >= -1e-12).all()
    assert abs(float(tip[1] - target[0, 1])) < 5e-4
    assert float(tip[2]) < float(target[0, 2])
    assert solution.outcome[0] in (Outcome.UNREACHABLE, Outcome.MOVING)
    assert sim.node_v.abs().max() < 5e-3


@pytest.mark.slow
def test_control_in_contact_is_the_same_with_a_factor_in_panels():
    """The factor that a GPU has in small batches, here on a CPU: two tips are led against a wall."""
    motions = []
    for in_panels in (False, True):
        sim = beam(2, control="length", wall=0.024, mu=0.3)
        controller = InverseController(sim, [0], period=PERIOD)
        (_, inverse), *_ = controller._systems
        if in_panels:
            system, linear = inverse.system, inverse.system.linear
            sides = 1 + system.rows.count + inverse.problem.effector_rows
            shape = (linear.symbolic, linear.variant, linear.world_count, sides, linear.y, "cpu")
            linear.panels = PanelSolver(*shape)
            inverse.problem.response = inverse.problem._make_response()
        change = torch.tensor([[0.0, 0.001, 0.012], [0.0, 0.0, 0.009]], dtype=torch.float64)
        target = sim.marker_x[:, 0] + change
        for _ in range(20):
            solution = controller.solve(target)
            sim.step(SUBSTEPS)
        assert (sim.pair_force[:, 0, 2] < -1e-3).all()
        motions.append((solution.command, sim.node_x.clone()))
    for one, two in zip(*motions, strict=True):
        torch.testing.assert_close(one, two, rtol=0.0, atol=1e-9)


def test_cables_that_are_not_asked_hold_their_length():
    """With two of four length-controlled cables the others keep their command; E is that with their lengths held."""
    sim = beam(control="length", min_tension=-math.inf)
    sim.control.cable_displacement[:] = torch.tensor([0.001, 0.0, 0.0, 0.001], dtype=torch.float64)
    sim.step(60)
    every = InverseController(sim, [0], horizon=0.05)
    every.solve(sim.marker_x[:, 0].clone(), apply=False)
    (_, system), *_ = every._systems
    e, d = effect(every), system.problem.compliance.numpy()[0].reshape(4, 4)
    some = InverseController(sim, [0], cables=[0, 2], horizon=0.05)
    some.solve(sim.marker_x[:, 0].clone(), apply=False)
    asked, held = [0, 2], [1, 3]
    expected = e[:, asked] - e[:, held] @ np.linalg.solve(d[np.ix_(held, held)], d[np.ix_(held, asked)])
    np.testing.assert_allclose(effect(some), expected, rtol=1e-6, atol=1e-9)
    before = sim.control.cable_displacement.clone()
    target = sim.marker_x[:, 0] + torch.tensor([[0.0, 0.001, 0.001]], dtype=torch.float64)
    controller = InverseController(sim, [PointEffector((0,), axes="yz")], cables=[0, 2], period=PERIOD)
    for _ in range(30):
        controller.solve(target)
        sim.step(SUBSTEPS)
    assert torch.equal(sim.control.cable_displacement[:, held], before[:, held])


def test_contact_closes_where_that_helps():
    """Leaning on a wall that is not yet touched: the first solve already knows that the wall will push back."""
    sim = beam(wall=0.0212, mu=0.0)
    controller = InverseController(sim, [0], horizon=0.05, period=PERIOD, share=1.0, max_step=1.0)
    target = sim.marker_x[:, 0] + torch.tensor([[0.0, 0.0, 0.02]], dtype=torch.float64)
    solution = controller.solve(target)
    (_, system), *_ = controller._systems
    assert system.laws is not None
    predicted = target[0] + torch.as_tensor(system.problem.predicted.numpy()[0, :3])
    assert float(predicted[2]) < 0.0125  # 1.2 mm to the wall, half of which is contact distance
    assert solution.outcome[0] == Outcome.UNREACHABLE


@pytest.mark.parametrize("worlds", [5])
def test_world_equals_alone(worlds):
    """A world in contact has the bits that it has alone."""
    runs = []
    for chosen in (range(worlds), [3]):
        sim = beam(len(chosen), control="length", wall=0.0215, mu=0.3, precision="float32")
        sim = sw.Simulation(sim.model, dt=0.01, solver_path="scalar")
        controller = InverseController(sim, [0], period=PERIOD)
        targets = torch.tensor([[0.099, 0.01 + 0.002 * k, 0.012 + 0.001 * k] for k in chosen])
        for _ in range(8):
            controller.solve(targets)
            sim.step(SUBSTEPS)
        runs.append(sim.node_x.clone())
    assert torch.equal(runs[0][3], runs[1][0])


def test_a_world_that_fails_holds_still():
    """Numbers that are not finite in one world's response: its cables are told to stay where they are measured."""
    sim = beam(2, control="length", max_rate=0.1)
    sim.control.cable_displacement[:, 2:] = 0.002
    sim.step(60)
    sim.params.youngs[1] = math.nan
    solution = InverseController(sim, [0], period=PERIOD).solve(sim.marker_x[:, 0] + 0.001)
    assert solution.outcome.tolist() == [Outcome.UNREACHABLE, Outcome.FAILED]  # a millimetre longer is too much
    torch.testing.assert_close(sim.control.cable_displacement[1], sim.cable_displacement[1], atol=1e-12, rtol=0.0)


def leaning_stem(capacity):
    """A cart with a motor whose stem an obstacle bends, at rest; tip: marker 0."""
    config = CartStemContactConfig()
    builder = sw.ModelBuilder(gravity=config.gravity)
    scene = build_cart_stem_contact_scene(config, builder, motor=True)
    builder.add_marker(scene.tip, (0.0, 0.0, config.length))
    sim = sw.Simulation(builder.finalize(precision="float64", contact_capacity=capacity), config.dt)
    sim.control.joint_target[:] = 0.034
    sim.step(300)
    return sim


@pytest.mark.slow
@pytest.mark.parametrize("period", [0.01, 0.3])
def test_long_periods_do_not_crowd_the_contact_out(period):
    """Tip against cart by the program and by a small move, within 1 %: -2.9, whatever the period; room for 8 contacts.

    In 0.3 s a stem would fall 0.4 m, but a robot that stands does not: it is not near everything in the scene.
    """
    sim = leaning_stem(8)
    controller = InverseController(sim, [PointEffector((0,), axes="x")], period=period)
    controller.solve(sim.marker_x[:, 0].clone(), apply=False)
    (_, system), *_ = controller._systems
    predicted = effect(controller)[0, 0] / system.problem.compliance.numpy()[0, 0]
    before = float(sim.marker_x[0, 0, 0])
    sim.control.joint_target[:] = 0.0341
    sim.step(300)
    assert (float(sim.marker_x[0, 0, 0]) - before) / 1.0e-4 == pytest.approx(predicted, rel=0.01)
    assert predicted == pytest.approx(-2.9, abs=0.05)


def test_contacts_without_a_place_are_told():
    """With room for one contact and a stem that is about to cross the gap, the program would not know of the second."""
    sim = leaning_stem(1)
    controller = InverseController(sim, [PointEffector((0,), axes="x")], period=0.3)
    assert controller.solve(sim.marker_x[:, 0].clone()).outcome[0] == Outcome.REACHED
    held = sim.control.joint_target.clone()
    sim.frame_twist[:, 4:, 0] = -0.2  # the stem's sections, towards the other obstacle
    solution = controller.solve(sim.marker_x[:, 0] + torch.tensor([[0.001, 0.0, 0.0]]))
    assert solution.outcome[0] == Outcome.FAILED
    assert (sim.control.joint_target - held).abs().max() < 2.0e-4
