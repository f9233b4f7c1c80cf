"""Inverse control of chambers and motors: pressures, volumes, servos, torques, orientations, rates, mistakes."""

import math

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.control import InverseController, OrientationEffector, Outcome, PointEffector

PERIOD, SUBSTEPS = 0.05, 5


def pad(control, worlds=1, **options):
    """A pad whose back is held, its front facing +z; the middle of the front is marker 0."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    source = meshing.pad("coarse")
    silicone = sw.Corotational(youngs=3.0e6, nu=0.3)
    body = builder.add_tets(source.mesh, material=silicone, density=1000.0, rayleigh=(0.0, 0.02))
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1.0, 1.0, -0.0279)))
    builder.add_cavity(body, source.cavity_vertices, source.cavity_triangles, control, **options)
    builder.add_marker(body, (0.0, 0.0, -0.0005))
    return sw.Simulation(builder.finalize(num_worlds=worlds), dt=0.01)


def arm(control="position", worlds=1, *, gravity=-9.81, **options):
    """Two links of 0.2 m in the xz plane with motors at both hinges; the tip is marker 0."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, gravity))
    link = sw.shapes.Box((0.20, 0.02, 0.02))
    upper = builder.add_rigid(link, mass=0.2, pose=(0.10, 0.0, 0.0))
    lower = builder.add_rigid(link, mass=0.2, pose=(0.30, 0.0, 0.0))
    axis = (0.0, -1.0, 0.0)  # positive angles lift
    builder.add_joint(None, upper, anchor=(0.0, 0.0, 0.0), axis=axis, control=control, name="shoulder", **options)
    builder.add_joint(upper, lower, anchor=(0.2, 0.0, 0.0), axis=axis, control=control, name="elbow", **options)
    builder.add_marker(lower, (0.40, 0.0, 0.0))
    return sw.Simulation(builder.finalize(num_worlds=worlds), dt=0.01)


def run(sim, controller, target, calls, substeps=SUBSTEPS):
    """Control for some calls; the last distance [m] and solution."""
    for _ in range(calls):
        solution = controller.solve(target)
        sim.step(substeps)
    return (controller.positions() - target.reshape(len(target), -1, 3)).norm(dim=-1).max(), solution


@pytest.mark.parametrize("control", ["pressure", "volume"])
def test_pressure_of_a_forward_run_is_found(control):
    """The front where 60 kPa take it: reached to 0.02 mm, by 60 kPa to 1 % or the volume that goes with them."""
    forward = pad("pressure")
    forward.control.cavity_pressure[:] = 60.0e3
    for _ in range(150):
        forward.step()
    target, volume = forward.marker_x[:, 0].clone(), forward.cavity_volume.clone()
    assert target[0, 2] > 0.002
    sim = pad(control)
    controller = InverseController(sim, [PointEffector((0,), axes="z")], period=PERIOD)
    target[:, :2] = sim.marker_x[:, 0, :2]
    for _ in range(30):
        solution = controller.solve(target)
        sim.step(SUBSTEPS)
    assert abs(float(sim.marker_x[0, 0, 2] - target[0, 2])) < 2e-5
    wished = 60.0e3 if control == "pressure" else float(volume)
    assert float(solution.command) == pytest.approx(wished, rel=0.01)
    assert float(sim.cavity_pressure) == pytest.approx(60.0e3, rel=0.01)
    assert solution.outcome[0] == Outcome.REACHED


def test_limits_and_rates_of_chambers():
    """30 kPa at most, reached at 100 kPa/s: 5 kPa more per call, then the nearest point, and it is told."""
    sim = pad("pressure", min_pressure=0.0, max_pressure=30.0e3, max_pressure_rate=100.0e3)
    controller = InverseController(sim, [PointEffector((0,), axes="z")], period=PERIOD, share=1.0)
    target = torch.tensor([[0.0, 0.0, 0.05]])
    commands, outcomes = [], []
    for _ in range(12):
        solution = controller.solve(target)
        commands.append(float(solution.command))
        outcomes.append(int(solution.outcome[0]))
        sim.step(SUBSTEPS)
    assert commands[:3] == pytest.approx([5.0e3, 10.0e3, 15.0e3], rel=1e-3)
    assert commands[-1] == pytest.approx(30.0e3, rel=1e-6) and max(commands) <= 30.0e3 * (1.0 + 1e-6)
    assert outcomes[0] == Outcome.MOVING and outcomes[-1] == Outcome.UNREACHABLE
    sim = pad("volume", max_flow=2.0e-5)
    controller = InverseController(sim, [PointEffector((0,), axes="z")], period=PERIOD, share=1.0)
    before = float(sim.cavity_volume)
    command = float(controller.solve(target).command)
    assert command - before == pytest.approx(1.0e-6, rel=1e-3)


@pytest.mark.parametrize("stiffness", [math.inf, 40.0])
def test_servos_bring_the_tip_to_a_point(stiffness):
    """Rigid servos, and soft ones that sag under gravity by 4 degrees unless told: 0.1 mm, at rest, in the plane."""
    sim = arm(worlds=2, stiffness=stiffness, damping=0.0 if stiffness == math.inf else 1.0, max_rate=6.0)
    controller = InverseController(sim, [PointEffector((0,), axes="xz")], period=PERIOD)
    assert controller.command_names == ["shoulder", "elbow"]
    sim.control.joint_target[:, 1] = 0.3
    sim.step(50)
    target = torch.tensor([[0.25, 0.0, 0.20], [0.30, 0.0, -0.10]])
    distance, solution = run(sim, controller, target, 60)
    assert distance < 1e-4
    assert (solution.outcome == Outcome.REACHED).all()
    assert sim.frame_twist.abs().max() < 0.02
    angles = sim.joint_position
    reached = 0.2 * torch.stack((angles[:, 0].cos(), angles[:, 0].sin()), dim=1)
    both = angles.sum(dim=1)
    reached += 0.2 * torch.stack((both.cos(), both.sin()), dim=1)
    torch.testing.assert_close(reached, target[:, [0, 2]], atol=3e-4, rtol=0)


def test_torques_hold_what_gravity_asks_for():
    """Force-controlled motors, commanded every step: at rest the torques are those of the weight, sum of m g x."""
    sim = arm("force", max_force=5.0)
    controller = InverseController(sim, [PointEffector((0,), axes="xz")], horizon=0.1)
    start = sim.marker_x[:, 0].clone()
    target = torch.tensor([[0.36, 0.0, 0.10]])
    for k in range(400):
        share = min(1.0, k / 100.0)
        controller.solve(torch.lerp(start, target, share))
        sim.step()
    assert (controller.positions()[0, 0] - target[0]).norm() < 2e-3
    x = sim.frame_pose[0, :, 0]
    elbow = 0.2 * sim.joint_position[0, 0].cos()
    weight = 0.2 * 9.81
    expected = torch.stack((weight * (x[0] + x[1]), weight * (x[1] - elbow)))
    torch.testing.assert_close(sim.joint_force[0], expected, rtol=0.03, atol=0.01)


def test_orientation_of_a_link():
    """One servo turns a link to a quaternion, whatever way its origin goes."""
    sim = arm(gravity=0.0, max_rate=4.0)
    controller = InverseController(sim, [OrientationEffector(1, axes="y")], joints=[1], period=PERIOD)
    assert controller.positions().shape == (1, 0, 3)  # no point
    angle = 0.8
    target = torch.tensor([[[0.0, -math.sin(angle / 2), 0.0, math.cos(angle / 2)]]])
    for _ in range(40):
        solution = controller.solve(target)
        sim.step(SUBSTEPS)
    assert float(sim.joint_position[0, 1]) == pytest.approx(angle, abs=2e-4)
    assert float(sim.joint_position[0, 0]) == pytest.approx(0.0, abs=1e-4)
    assert solution.error.max() < 1e-4


def test_position_and_orientation_together():
    """Tip height and direction of the last link determine both angles."""
    sim = arm(gravity=0.0, max_rate=4.0)
    sim.control.joint_target[:] = torch.tensor([[0.5, 0.4]])
    sim.step(60)
    pose, tip = sim.frame_pose[0, 1].clone(), sim.marker_x[0, 0].clone()
    sim.reset()
    effectors = [PointEffector((0,), axes="z"), OrientationEffector(1, axes="y")]
    controller = InverseController(sim, effectors, period=PERIOD)
    target = torch.zeros(1, 2, 4)
    target[0, 0, :3], target[0, 1] = tip, pose[3:]
    for _ in range(60):
        controller.solve(target)
        sim.step(SUBSTEPS)
    np.testing.assert_allclose(sim.joint_position[0].numpy(), [0.5, 0.4], atol=1e-3)


def test_world_equals_alone():
    """World 3 of 5 arms has the bits of the same arm alone."""
    target = torch.tensor([[0.25 + 0.02 * k, 0.0, 0.2 - 0.03 * k] for k in range(5)])
    tips = []
    for worlds in ([0, 1, 2, 3, 4], [3]):
        builder_worlds = len(worlds)
        sim = arm(worlds=builder_worlds, stiffness=40.0, damping=1.0)
        sim = sw.Simulation(sim.model, dt=0.01, solver_path="scalar")
        controller = InverseController(sim, [PointEffector((0,), axes="xz")], period=PERIOD)
        run(sim, controller, target[worlds], 10)
        tips.append(sim.marker_x.clone())
    assert torch.equal(tips[0][3], tips[1][0])


def test_mistakes_are_named():
    sim = pad("gas")
    with pytest.raises(ValueError, match="chamber 'cavity0' is under gas control"):
        InverseController(sim, [0], chambers=[0])
    with pytest.raises(ValueError, match="nothing to act with"):
        InverseController(sim, [0])
    sim = arm("none")
    with pytest.raises(ValueError, match="joint 'elbow' has no motor"):
        InverseController(sim, [0], joints=[1])
    with pytest.raises(ValueError, match=r"joints must be different ones of 0 \.\. 1, got \[2\]"):
        InverseController(arm(), [0], joints=[2])
    with pytest.raises(ValueError, match="frame must be one of the scene's"):
        InverseController(arm(), [OrientationEffector(9)])
    with pytest.raises(ValueError, match="joint 'shoulder' does not hold without its motor"):
        InverseController(arm(), [0], horizon=math.inf)
