"""Labels of contacts and rows in inverse control: what is predicted after they change is where a nonlinear step lands.

All in float64, with efforts as commands and a horizon of one step: the simulator's step, whose Gauss-Seidel sweeps know
nothing of labels, has to end where the labelled linear problem says, and its central differences have to be E.
"""

import math

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp.control import InverseController
from softwarp.model.codes import ContactLabel, RowLabel

DT = 0.01  # s
MU = 0.5
LOWER, UPPER = (0, 1), (2, 3)  # cables


def beam(*, ball=None, upper="force", **options):
    """A beam along x with a cable along each edge, perhaps under a ball, at a distance [m] above the tip's top node."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    mesh = sw.meshing.box((0.10, 0.02, 0.02), (10, 2, 2))
    silicone = sw.Corotational(youngs=5.0e5, nu=0.4, method="polar")
    body = builder.add_tets(mesh, material=silicone, density=1100.0, rayleigh=(0.1, 0.01))
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1.0e-9, 1.0, 1.0)))
    for k, (y, z) in enumerate(((0.002, 0.002), (0.018, 0.002), (0.018, 0.018), (0.002, 0.018))):
        points = [(0.02 * i + 0.01, y, z) for i in range(5)]
        more = options if k in UPPER else {}
        builder.add_cable(body, points, (0.0, y, z), control=upper if k in UPPER else "force", **more)
    builder.add_marker(body, (0.10, 0.01, 0.01))
    if ball is not None:
        radius = 0.05
        above = (0.099, 0.01, 0.02 + ball + radius, 0.0, 0.0, 0.0, 1.0)
        obstacle = builder.add_rigid(sw.shapes.Sphere(radius), kinematic=True, pose=above)
        builder.add_contact(body, obstacle, mu=0.0, contact_distance=0.0003, alarm_distance=0.004)
    model = builder.finalize(precision="float64")
    return sw.Simulation(model, dt=DT, gauss_seidel_iterations=3000, gauss_seidel_tolerance=1.0e-16)


def pressed():
    """Pressed against the ball without friction and at rest; then there is some, so that the contact sticks at zero."""
    sim = beam(ball=0.0008)
    sim.control.cable_tension[:] = torch.tensor([0.5, 0.5, 3.0, 3.0], dtype=torch.float64)
    sim.step(80)
    sim.params.pair_mu[:] = MU
    return sim


def controller_of(sim, cables=None):
    """One that looks one step ahead and commands all of it."""
    options = {"horizon": DT, "period": DT, "share": 1.0, "max_step": 1.0, "energy": 1.0e-6}
    controller = InverseController(sim, [0], cables=cables, **options)
    (_, system), *_ = controller._systems
    return controller, system


def land(sim, tension, cables):
    """Tip [m] after one step with other tensions; the state is left as it was."""
    start = sim.snapshot()
    sim.control.cable_tension[:, list(cables)] = tension
    sim.step()
    tip = sim.marker_x[0, 0].clone().numpy()
    sim.restore(start)
    return tip


def compare(sim, controller, system, way, *, landing, effect, along=None):
    """Solve for a target that lies ``way`` from the tip; prediction and E against steps, to parts of their size.

    ``along`` is the direction in which E is compared: friction of a contact that slides turns with its slip, so that
    across the slip it holds a contact back as well, which a direction that is kept does not know.
    """
    start = sim.marker_x[0, 0].clone().numpy()
    target = start + way
    cables = controller.actuators.item
    solution = controller.solve(torch.as_tensor(target)[None], apply=False)
    predicted = target + system.problem.predicted.numpy()[0, :3]
    tension = solution.command[0]
    np.testing.assert_allclose(land(sim, tension, cables), predicted, atol=landing * np.linalg.norm(way))
    found = system.problem.effect.numpy()[0].reshape(-1, len(cables))
    part = np.eye(3) if along is None else along[None]
    for column in range(len(cables)):
        change = torch.zeros_like(tension)
        change[column] = 1.0e-4
        less = tension - change * (tension > change)  # cables do not push
        difference = land(sim, tension + change, cables) - land(sim, less, cables)
        difference /= float((tension + change - less).sum())
        np.testing.assert_allclose(part @ found[:, column], part @ difference, atol=effect * np.abs(found).max())


@pytest.mark.parametrize(
    ("axis", "sign", "way"),
    [
        (0, 1, 1e-3),
        (1, -1, 2e-4),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((0, -1, 1e-3), (1, 1, 2e-4))),
    ],
)
def test_contact_that_sticks_begins_to_slide(axis, sign, way):
    """Asked to go along a tangent, the contact slides that way, and friction mu N = 0.27 N holds against it.

    Its wrong sign would be worth 0.3 to 3 mm; what is left is the turn of the slip from the tangent.
    """
    sim = pressed()
    controller, system = controller_of(sim)
    controller.solve(sim.marker_x[:, 0].clone(), apply=False)
    assert system.laws.label.numpy()[0, 0] == ContactLabel.STICK
    axes = system.problem.response.contacts.axes.real.numpy()[0, :9, 0].reshape(3, 3)
    along = axes[1 + axis]
    compare(sim, controller, system, sign * way * along, landing=0.04, effect=0.08, along=along)
    assert system.laws.label.numpy()[0, 0] == ContactLabel.SLIDE
    expected = np.zeros(2)
    expected[axis] = -sign * np.sign(-axes[0, 2])  # the normal points at the body on which the force acts
    np.testing.assert_array_equal(system.laws.direction.numpy()[0, :2], expected)


@pytest.mark.parametrize("way", [(0.0, 0.0, -0.004), pytest.param((0.0, 0.0005, -0.004), marks=pytest.mark.slow)])
def test_contact_opens(way):
    """Asked to leave the ball, the contact opens; nothing holds the tip any longer."""
    sim = pressed()
    controller, system = controller_of(sim)
    compare(sim, controller, system, np.array(way), landing=0.01, effect=0.01)
    assert system.laws.label.numpy()[0, 0] == ContactLabel.OPEN


@pytest.mark.parametrize("known", [(6.0, 4.0), (20.0, 14.0), (4.0, 12.0)])
def test_contact_closes(known):
    """Asked to be where known tensions lead, against a ball that is not yet touched, it finds these tensions."""
    sim = beam(ball=0.0008)
    tension = torch.tensor(known, dtype=torch.float64)
    controller, system = controller_of(sim, UPPER)
    way = land(sim, tension, UPPER) - sim.marker_x[0, 0].numpy()
    assert (system.laws.label.numpy()[0, 2:] == ContactLabel.OPEN).all()
    compare(sim, controller, system, way, landing=1e-4, effect=1e-3)
    assert (system.laws.label.numpy()[0, 2:] == ContactLabel.SLIDE).any()
    np.testing.assert_allclose(system.problem.command.numpy()[0], known, rtol=1e-4)


@pytest.mark.parametrize("known", [(6.0, 4.0), (4.0, 12.0)])
def test_contact_that_closes_has_friction_against_its_slip(known):
    """The same with friction: the contact slides from where it closes, and friction holds the tip back.

    The direction is kept from there: it is within 60 degrees against the way that the tip goes in the end.
    """
    sim = beam(ball=0.0008)
    sim.params.pair_mu[:] = 0.2
    tension = torch.tensor(known, dtype=torch.float64)
    controller, system = controller_of(sim, UPPER)
    way = land(sim, tension, UPPER) - sim.marker_x[0, 0].numpy()
    solution = controller.solve(torch.as_tensor(sim.marker_x[0, 0].numpy() + way)[None], apply=False)
    assert float(solution.error) < 0.02 * np.linalg.norm(way)
    (closed,) = np.flatnonzero(system.laws.label.numpy()[0, 2:] == ContactLabel.SLIDE)
    axes = system.problem.response.contacts.axes.real.numpy()[0, 9 * closed : 9 * closed + 9, 0].reshape(3, 3)
    drag = system.laws.direction.numpy()[0, 2 * closed : 2 * closed + 2] @ axes[1:]
    on_beam = -np.sign(axes[0, 2]) * drag  # the normal points at the body on which the force acts
    assert on_beam[:2] @ way[:2] < -math.cos(math.pi / 3.0) * np.linalg.norm(way[:2])


@pytest.mark.parametrize(
    ("tension", "limit", "way", "before", "after"),
    [
        (0.0, math.inf, (0.0, 0.0, 0.004), RowLabel.LOW, (RowLabel.FREE, RowLabel.FREE)),  # slack cables become taut
        (0.5, math.inf, (0.0, 0.0, -0.004), RowLabel.FREE, (RowLabel.LOW, RowLabel.LOW)),  # taut ones slacken
        (
            0.5,
            0.52,
            (0.0, 0.0, 0.001),
            RowLabel.FREE,
            (RowLabel.HIGH, RowLabel.HIGH),
        ),  # they pull no harder than they can
        (0.5, 0.52, (0.0, 0.002, 0.0), RowLabel.FREE, (RowLabel.LOW, RowLabel.HIGH)),
    ],
)
def test_cables_that_hold_their_lengths(tension, limit, way, before, after):
    """The lower cables are asked, the upper ones hold their lengths, which the labels know exactly."""
    sim = beam(upper="length", max_tension=limit)
    free = beam()
    free.control.cable_tension[:, list(UPPER)] = tension
    free.control.cable_tension[:, list(LOWER)] = 2.0
    free.step(80)
    sim.control.cable_tension[:] = 2.0
    sim.control.cable_displacement[:] = free.cable_displacement - (0.0001 if tension == 0.0 else 0.0)
    sim.step(80)
    controller, system = controller_of(sim, LOWER)
    controller.solve(sim.marker_x[:, 0].clone(), apply=False)
    assert (system.laws.label.numpy()[0, :2] == before).all()
    compare(sim, controller, system, np.array(way), landing=1e-6, effect=1e-5)
    assert tuple(system.laws.label.numpy()[0, :2]) == after
