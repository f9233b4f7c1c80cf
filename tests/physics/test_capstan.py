"""A rope around a drum: tension grows by exp(mu phi), Euler and Eytelwein (catalogue 8.3)."""

import numpy as np
import pytest
import torch

import softwarp as sw
from tests.contact_cases import LYING, array

DRUM, LOAD = 0.05, 0.1  # radius [m], tension of the loose end [N]
ROPES = {"float64": 0.0002, "float32": 0.0005}  # radius [m]; float32 lacks the digits for the thinner one


def pulled(mu: float, angle: float, precision: str, segments: int = 30) -> tuple[np.ndarray, np.ndarray]:
    """Tension of the pulled end over that of the loose one, and how far its direction is off, per step.

    A thin rod lies on ``angle`` of a fixed drum without stress, with straight legs of 5 cm. The loose end carries a
    dead load, the other one is drawn away at 2 cm/s; its tension is what balances the load and the contact forces.
    """
    rope_radius = ROPES[precision]
    r = DRUM + rope_radius
    turn = np.linspace(0.0, angle, segments + 1)
    arc = np.stack([-r * np.cos(turn), 0.0 * turn, r * np.sin(turn)], axis=1)
    length = r * angle / segments
    legs = length * np.arange(1, int(0.05 / length) + 1)[:, None]
    away = np.array([np.sin(angle), 0.0, np.cos(angle)])
    points = np.concatenate([arc[0] - legs[::-1] * (0.0, 0.0, 1.0), arc, arc[-1] + legs * away])
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    drum = builder.add_rigid(sw.Cylinder(DRUM, 0.1), kinematic=True, pose=(0.0, 0.0, 0.0, *LYING))
    rope = builder.add_rod(
        points, radius=rope_radius, youngs=12.0 / rope_radius**2, nu=0.3, density=1000.0, rayleigh=(0.0, 0.002)
    )
    hand = builder.add_rigid(kinematic=True, pose=tuple(points[-1]))
    builder.attach(rope, nodes=[len(points) - 1], to=hand)
    builder.add_contact(rope, drum, mu=mu)
    sim = sw.Simulation(builder.finalize(1, precision=precision, contact_capacity=100), dt=0.002)
    load = np.array([0.0, 0.0, -LOAD])
    sim.control.rod_force[:, 0, :3] = torch.as_tensor(load).to(sim.control.rod_force)
    sim.control.body_velocity[:, hand, :3] = torch.as_tensor(0.02 * away).to(sim.control.body_velocity)
    ratios, errors = [], []
    for _ in range(400):
        sim.step()
        assert (sim.status == sw.Status.OK).all()
        pull = -(array(sim.contact_force(rope, drum))[0] + load)
        ratios.append(np.linalg.norm(pull) / LOAD)
        errors.append(np.linalg.norm(pull / np.linalg.norm(pull) - away))
    return np.array(ratios), np.array(errors)


def slipping(mu: float, angle: float, precision: str) -> np.ndarray:
    """Ratios of tension over what theory says, from when the whole rope slips.

    Friction acts below the centre line of a rope of radius r on a drum of radius R: phi counts as phi R / (R + r).
    """
    ratios, errors = pulled(mu, angle, precision)
    assert errors[250:].max() < 0.005
    return np.asarray(ratios[250:] / np.exp(mu * angle * DRUM / (DRUM + ROPES[precision])))


@pytest.mark.parametrize(
    ("mu", "angle"),
    [
        (0.3, np.pi),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((0.0, np.pi), (0.3, np.pi / 2), (0.5, np.pi))),
    ],
)
def test_tension_grows_with_the_angle(mu: float, angle: float) -> None:
    """exp(mu phi), 2.566332 for mu = 0.3 and half a turn: within 1 % all the time."""
    ratios = slipping(mu, angle, "float64")
    assert ratios.mean() == pytest.approx(1.0, abs=0.008)
    assert np.abs(ratios - 1.0).max() < 0.01


@pytest.mark.slow
def test_tension_grows_with_the_angle_in_float32() -> None:
    """A thicker rope, whose bending stiffness alone takes E I / R^2, 0.6 % of the load: within 2 %."""
    ratios = slipping(0.3, np.pi, "float32")
    assert ratios.mean() == pytest.approx(1.0, abs=0.015)
    assert np.abs(ratios - 1.0).max() < 0.02
