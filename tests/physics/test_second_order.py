"""Steps of second order: order, period and damping, energy, impacts, commands, batches and failures. SI units."""

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from tests import pneumatic_cases

GRAVITY = (0.0, 0.0, -9.81)
GAMMA = 1.0 - np.sqrt(0.5)


def simulation(
    builder: sw.ModelBuilder, dt: float, integrator: str, worlds: int = 1, precision: str = "float64", **options
) -> sw.Simulation:
    """On a CPU."""
    return sw.Simulation(builder.finalize(worlds, "cpu", precision), dt, integrator=integrator, **options)


def beam(mesh=None, material=None, *, density: float = 1000.0, damping: float = 0.01, gravity=GRAVITY):
    """Builder and body of a beam of 10 cm, clamped at x = 0."""
    builder = sw.ModelBuilder(gravity=gravity)
    body = builder.add_tets(
        meshing.box((0.1, 0.02, 0.02), (6, 2, 2)) if mesh is None else mesh,
        material=material or sw.Corotational(youngs=2.0e5, nu=0.4),
        density=density,
        rayleigh=(0.0, damping),
    )
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1.0e-4, 1.0, 1.0)))
    return builder, body


def polar(dt, integrator):
    """A beam let go, of a law with an energy."""
    return simulation(beam(material=sw.Corotational(youngs=2.0e5, nu=0.4, method="polar"))[0], dt, integrator)


def quadratic(dt, integrator):
    """The same of quadratic elements and stable neo-Hookean silicone."""
    mesh = meshing.elevate(meshing.box((0.1, 0.02, 0.02), (3, 1, 1)))
    return simulation(beam(mesh, sw.StableNeoHookean(youngs=2.0e5, nu=0.4))[0], dt, integrator)


def rod(dt, integrator):
    """A rod with a rigid body on its end."""
    builder = sw.ModelBuilder(gravity=GRAVITY)
    points = np.linspace((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), 7)
    part = builder.add_rod(points, radius=0.01, youngs=1.0e6, rayleigh=(0.0, 5.0e-3))
    builder.fix(part, nodes=[0])
    builder.attach(builder.add_rigid(mass=0.02, inertia=(1e-5, 3e-5, 2e-5), pose=points[-1]), to=part, node=-1)
    return simulation(builder, dt, integrator)


def tension(dt, integrator):
    """A beam and a cable of given tension."""
    builder, body = beam()
    builder.add_cable(body, [(0.02, 0.01, 0.018), (0.1, 0.01, 0.018)], (0.0, 0.01, 0.018), control="force")
    sim = simulation(builder, dt, integrator)
    sim.control.cable_tension.fill_(0.3)
    return sim


def pressure(dt, integrator):
    """A bender whose chamber has a given pressure."""
    builder = pneumatic_cases.builder_of(
        pneumatic_cases.bender(1), "corot", 1.0e6, 0.4, rayleigh=(0.0, 0.01), control="pressure"
    )
    sim = simulation(builder, dt, integrator)
    sim.control.cavity_pressure.fill_(5.0e3)
    return sim


def tumbling(dt, integrator):
    """A free body that falls and tumbles."""
    builder = sw.ModelBuilder(gravity=GRAVITY)
    builder.add_rigid(mass=1.0, inertia=(1.0, 2.0, 3.0), velocity=(0.0, 1.0, 0.0, 2.0, 1.0, 0.5))
    return simulation(builder, dt, integrator)


def run(make, dt: float, integrator: str, time: float = 0.096) -> torch.Tensor:
    """Positions after some time."""
    sim = make(dt, integrator)
    for _ in range(round(time / dt)):
        sim.step()
        assert int(sim.status.max()) <= 0
    assert float(sim.time) == pytest.approx(time, rel=1e-12)
    return torch.cat((sim.node_x.flatten(), sim.frame_pose.flatten()))


@pytest.mark.parametrize(
    "make", [polar, quadratic, rod, tension, pytest.param(pressure, marks=pytest.mark.slow), tumbling]
)
def test_order(make):
    """Half the step, a quarter of the error; of Euler half. Bodies that tumble freely are exact to fourth order."""
    best = run(make, 5.0e-4, "bdf2")
    error = {}
    for integrator in ("euler", "bdf2"):
        coarse, fine = (float((run(make, dt, integrator) - best).norm()) for dt in (0.008, 0.004))
        error[integrator], slope = coarse, np.log2(coarse / fine)
        if integrator == "euler":
            assert 0.4 < slope < 1.8
        elif make is tumbling:
            assert slope > 3.5
        else:
            assert slope == pytest.approx(2.0, abs=0.3)
    assert error["bdf2"] < 0.2 * error["euler"]


def driven(dt, integrator):
    """A rod on a base that is led along a cosine."""
    builder = sw.ModelBuilder(gravity=GRAVITY)
    base = builder.add_rigid(mass=1.0, inertia=(1.0, 1.0, 1.0), kinematic=True)
    part = builder.add_rod(np.linspace((0, 0, 0), (0.3, 0, 0), 6), radius=0.01, youngs=1.0e6, rayleigh=(0.0, 5.0e-3))
    builder.attach(part, nodes=[0], to=base)
    return simulation(builder, dt, integrator)


def test_order_of_driven_bases():
    """Commanded poses are approached evenly over a step."""
    ends = []
    for dt in (0.008, 0.004, 0.001):
        sim = driven(dt, "bdf2")
        for n in range(1, round(0.096 / dt) + 1):
            sim.control.body_pose[0, 0, 2] = 0.02 * (1.0 - np.cos(25.0 * n * dt))
            sim.step()
            assert float(sim.frame_pose[0, 0, 2]) == pytest.approx(0.02 * (1.0 - np.cos(25.0 * n * dt)), abs=1e-12)
        ends.append(sim.frame_pose.clone())
    slope = float(torch.log2((ends[0] - ends[2]).norm() / (ends[1] - ends[2]).norm()))
    assert slope == pytest.approx(2.0, abs=0.3)


def ring(integrator: str, periods: float, amplitude: float, precision: str = "float64") -> tuple[np.ndarray, float]:
    """First mode's coordinate, steps of 10 ms, of a beam of 7.8 Hz without damping."""
    law = sw.Corotational(youngs=1.0e5, nu=0.4)
    builder, _ = beam(meshing.box((0.1, 0.03, 0.03), (6, 2, 2)), law, damping=0.0, gravity=(0.0, 0.0, 0.0))
    sim = sw.Simulation(builder.finalize(1, "cpu", precision), 0.01, integrator=integrator)
    modes = sim.modes(1, 0)
    sim.params.youngs *= (7.8 / float(modes.frequency[0])) ** 2
    rest, shape = sim.node_x[0].clone(), torch.as_tensor(np.asarray(modes.shape[0])).reshape(-1, 3).to(sim.node_x)
    shape = shape / shape.abs().max()
    sim.node_x[0] += amplitude * shape
    sim.refresh()
    values = []
    for _ in range(round(periods / 7.8 / 0.01)):
        values.append(float(((sim.node_x[0] - rest) * shape).sum() / (shape * shape).sum()))
        sim.step()
        assert int(sim.status[0]) <= 0
    return np.array(values), 7.8


@pytest.mark.parametrize(("integrator", "stages"), [("euler", 0), ("bdf2", 1), ("trapezoidal", 2)])
def test_period_and_damping(integrator, stages):
    """A mode of 7.8 Hz at 10 ms as the stability function says; within 1 % and 0.01 but for Euler."""
    q, frequency = ring(integrator, 12.0, 2.0e-4)
    fit = np.linalg.lstsq(np.stack([q[1:-1], q[:-2]], axis=1), q[2:], rcond=None)[0]
    root = np.roots([1.0, -fit[0], -fit[1]])
    measured = np.log(root[np.argmax(root.imag)]) / 0.01
    z = 2.0j * np.pi * frequency * 0.01
    bdf2 = (1.0 + (1.0 - 2.0 * GAMMA) * z) / (1.0 - GAMMA * z) ** 2
    known = np.log([1.0 / (1.0 - z), bdf2, ((1.0 + z / 4.0) / (1.0 - z / 4.0)) ** 2][stages]) / 0.01
    assert measured.imag == pytest.approx(known.imag, rel=5e-4)
    assert -measured.real / abs(measured) == pytest.approx(-known.real / abs(known), abs=2e-4)
    if stages:
        assert measured.imag / (2.0 * np.pi) == pytest.approx(frequency, rel=0.01)
        assert abs(measured.real / abs(measured)) < 0.01


@pytest.mark.parametrize("periods", [100, pytest.param(1000, marks=pytest.mark.slow)])
def test_trapezoidal_keeps_the_amplitude(periods):
    """A beam of 10 cm that swings by 5 mm keeps its amplitude to 2 % over 1000 periods, also in float32."""
    q, frequency = ring("trapezoidal", periods, 5.0e-3, "float32")
    some = round(4.0 / frequency / 0.01)
    assert np.abs(q[-some:]).max() == pytest.approx(np.abs(q[:some]).max(), rel=0.02)


def ball(integrator: str, restitution: float, heights=(0.05,), **options) -> sw.Simulation:
    """Balls of 2 cm over a floor, one in every world."""
    builder = sw.ModelBuilder(gravity=GRAVITY)
    body = builder.add_rigid(mass=0.1, shape=sw.Sphere(0.01), pose=(0.0, 0.0, heights[0] + 0.01))
    floor = builder.add_rigid(shape=sw.Plane(), kinematic=True)
    builder.add_contact(body, floor, mu=0.5, restitution=restitution)
    sim = simulation(builder, 0.01, integrator, len(heights), **options)
    sim.frame_pose[:, 0, 2] = torch.tensor(heights, dtype=torch.float64).to(sim.frame_pose) + 0.01
    sim.refresh()
    return sim


@pytest.mark.parametrize("restitution", [0.0, 0.6])
def test_impacts_gain_nothing(restitution):
    """A ball bounces no higher than its restitution allows, sinks in by less than 0.1 mm, and comes to rest."""
    sim = ball("bdf2", restitution)
    heights = []
    for _ in range(150):
        sim.step()
        heights.append(float(sim.frame_pose[0, 0, 2]) - 0.01)
    first = next(i for i, height in enumerate(heights) if height < 2.0e-3)
    assert min(heights) > -1.0e-4
    assert max(heights[first + 2 :]) <= restitution**2 * 0.05 + 5.0e-3
    assert heights[-1] == pytest.approx(0.0, abs=1.0e-4)
    assert sim.frame_twist.abs().max() < 1.0e-3


@pytest.mark.parametrize(("precision", "path"), [("float64", "scalar"), ("float32", "lanes")])
def test_worlds_alone_and_together(precision, path):
    """Worlds that touch, will touch and do not: each as if it were alone, to the bit."""
    heights = (0.0, 0.012, 0.3)
    options = {"precision": precision, "solver_path": path}
    together = ball("bdf2", 0.3, heights, **options)
    alone = [ball("bdf2", 0.3, (height,), **options) for height in heights]
    for _ in range(12):
        for sim in (together, *alone):
            sim.step()
    for world, sim in enumerate(alone):
        assert torch.equal(together.frame_pose[world], sim.frame_pose[0])
        assert torch.equal(together.frame_twist[world], sim.frame_twist[0])
    fall = 0.3 + 0.01 - 9.81 * 0.12**2 / 2.0  # second order: exact
    assert float(together.frame_pose[2, 0, 2]) == pytest.approx(fall, abs=1e-12 if precision == "float64" else 1e-6)


def test_a_failed_world_goes_back_to_the_start_of_its_step():
    """A command that is no number fails one world; it stands still, says so, and goes on when it is mended."""
    builder, _ = beam()
    sim, other = (simulation(builder, 0.01, "bdf2", 2) for _ in range(2))
    for each in (sim, other):
        each.step(3)
    before = {name: view[0].clone() for name, view in sim._views.items() if name not in ("status",)}
    sim.control.node_force[0, 5] = float("nan")
    sim.step()
    other.step()
    assert [sw.Status(int(code)) for code in sim.status] == [sw.Status.NONFINITE, sw.Status.OK]
    for name, value in before.items():
        assert torch.equal(sim._views[name][0], value), name
    assert torch.equal(sim.node_x[1], other.node_x[1])
    sim.control.node_force.zero_()
    sim.step()
    assert torch.equal(sim.node_x[0], other.node_x[0])
    assert float(sim.time[0]) == pytest.approx(0.04)


def test_restored_and_repeated_steps():
    """Several steps at once, and steps after a restored snapshot, are those that would have been."""
    builder, _ = beam()
    sim, other = (simulation(builder, 0.01, "bdf2") for _ in range(2))
    sim.step(4)
    saved = sim.snapshot()
    sim.step(5)
    other.restore(saved)
    for _ in range(5):
        other.step()
    assert torch.equal(sim.node_x, other.node_x)
    assert torch.equal(sim.time, other.time)


def test_servos_count_from_where_a_stage_starts():
    """A mass on a servo without damping is a spring's: with a quarter of the error for half the step."""
    errors = []
    for dt in (0.005, 0.0025):
        builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        link = builder.add_rigid(mass=0.05, inertia=(1e-4, 1e-4, 1e-4))
        builder.add_joint(
            None, link, "slider", anchor=(0.0,) * 3, axis=(1.0, 0.0, 0.0), control="position", stiffness=20.0
        )
        sim = simulation(builder, dt, "bdf2")
        sim.control.joint_target.fill_(0.02)
        sim.step(round(0.2 / dt))
        errors.append(abs(float(sim.joint_position) - 0.02 * (1.0 - np.cos(20.0 * 0.2))))
    assert errors[1] < 2e-5 and errors[1] < 0.27 * errors[0]


def test_rates():
    """Cables, pressures, servos and kinematic bodies move at their largest rate, no faster and no slower."""
    builder, body = beam()
    points = [(0.02, 0.01, 0.018), (0.1, 0.01, 0.018)]
    builder.add_cable(body, points, (0.0, 0.01, 0.018), max_rate=0.02)
    arm = builder.add_rigid(mass=0.1, inertia=(1e-4, 1e-4, 1e-4), pose=(1.0, 0.0, 0.0))
    builder.add_joint(None, arm, "hinge", anchor=(1.0, 0.0, 0.0), control="position", max_rate=2.0)
    carrier = builder.add_rigid(mass=0.1, inertia=(1e-4, 1e-4, 1e-4), pose=(2.0, 0.0, 0.0), kinematic=True)
    sim = simulation(builder, 0.01, "bdf2")
    sim.params.body_max_speed.fill_(0.5)
    sim.control.cable_displacement.fill_(0.01)
    sim.control.joint_target.fill_(1.0)
    sim.control.body_pose[0, int(carrier), 0] = 3.0
    sim.step(10)
    assert float(sim.cable_displacement) == pytest.approx(0.002, rel=0.02)  # rows are linear in a stage
    assert float(sim.joint_position) == pytest.approx(0.2, abs=1e-4)
    assert float(sim.frame_pose[0, int(carrier), 0]) == pytest.approx(2.05, abs=1e-9)
    sim.control.cable_displacement.fill_(0.0025)
    sim.step(10)
    assert float(sim.cable_displacement) == pytest.approx(0.0025, abs=1e-5)

    chamber = pneumatic_cases.builder_of(pneumatic_cases.bender(1), "corot", 1.0e6, 0.4, control="pressure")
    sim = simulation(chamber, 0.01, "bdf2")
    sim.params.cavity_max_pressure_rate.fill_(1.0e4)
    sim.control.cavity_pressure.fill_(5.0e3)
    sim.step(10)
    assert float(sim.cavity_pressure) == pytest.approx(1.0e3, rel=1e-9)


@pytest.mark.parametrize("integrator", ["bdf2", "trapezoidal"])
def test_velocity_commands(integrator):
    """A kinematic body moves with its commanded velocity, whatever the stages are, and has it at the end of a step."""
    sim = driven(0.01, integrator)
    sim.control.body_velocity[0, 0, :] = torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    sim.step(10)
    assert float(sim.frame_pose[0, 0, 0]) == pytest.approx(0.01, rel=1e-9)
    assert 2.0 * float(torch.atan2(sim.frame_pose[0, 0, 5], sim.frame_pose[0, 0, 6])) == pytest.approx(0.1, rel=1e-9)
    torch.testing.assert_close(sim.body_twist, sim.control.body_velocity, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("integrator", ["euler", "bdf2", "trapezoidal"])
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_velocities_along_held_axes_count_for_nothing(integrator, precision):
    """Of a node on a roller, a cart on rails and the clamped end of a rod; extrapolations once kept them for ever."""
    builder, body = beam()
    corner = builder.fix(body, box=((0.0999, -1.0, -1.0), (1.0, 1e-4, 1e-4)), axes="y")
    cart = builder.add_rigid(mass=0.1, inertia=(1e-5,) * 3, pose=(0.0, 0.1, 0.0), free_axes="x")
    line = builder.add_rod([(0.0, 0.2, 0.0), (0.05, 0.2, 0.0)], radius=0.01, youngs=1e6, rayleigh=(0.0, 0.005))
    builder.fix(line, nodes=[0])
    pushed, plain = (simulation(builder, 0.01, integrator, 4, precision) for _ in range(2))
    for sim in (pushed, plain):
        sim.body_twist[:, cart, 0] = 0.2
    pushed.node_v[:, corner, 1] = 0.3
    pushed.body_twist[:, cart, 1:] = 0.4
    pushed.rod_v[:, 0], pushed.rod_w[:, 0] = 0.5, 0.6
    for _ in range(3):
        pushed.step()
        plain.step()
        for name in ("node_x", "node_v", "body_pose", "body_twist", "rod_x", "rod_q", "rod_v", "rod_w"):
            if integrator != "euler":
                assert torch.equal(getattr(pushed, name), getattr(plain, name)), name
            tolerance = 1e-5 if precision == "float32" else 1e-13
            assert (getattr(pushed, name) - getattr(plain, name)).abs().max() < tolerance, name
    assert not pushed.node_v[:, corner, 1].any() and not pushed.body_twist[:, cart, 1:].any()


@pytest.mark.parametrize("integrator", ["bdf2", "trapezoidal"])
def test_a_clamped_rod_alone(integrator):
    """Its frames are its nodes, none of them a rigid body."""
    builder = sw.ModelBuilder()
    line = builder.add_rod(np.linspace((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), 5), radius=0.01, youngs=1e6)
    builder.fix(line, nodes=[0])
    sim = simulation(builder, 0.01, integrator)
    sim.rod_v[:, 0] = 0.5
    sim.step(3)
    assert not sim.rod_v[:, 0].any() and float(sim.rod_x[0, -1, 2]) < -1e-4


def test_trapezoidal_is_bdf2_with_rows():
    """Multipliers would ring."""
    a, b = (tension(0.01, name) for name in ("trapezoidal", "bdf2"))
    for sim in (a, b):
        sim.step(5)
    assert torch.equal(a.node_x, b.node_x)


def test_unknown_integrator():
    """Refused with those that there are."""
    with pytest.raises(ValueError, match=r"integrator.*euler.*bdf2.*trapezoidal.*rk4"):
        polar(0.01, "rk4")
