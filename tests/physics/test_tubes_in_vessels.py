"""Tubes that touch the walls of vessels: friction along a bend, and the balance of forces with the wall."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import Tube, TubeSection
from softwarp.shapes import Vessel

BEND = 0.04  # m


def elbow(spacing: float = 4e-4) -> Vessel:
    """A quarter turn with straight ends, of 3 mm radius."""
    a = np.linspace(0.0, 0.5 * np.pi, 60)
    bend = np.stack([0.0 * a, BEND * (1.0 - np.cos(a)), BEND * np.sin(a)], axis=1)
    inlet = np.array([(0.0, 0.0, z) for z in np.linspace(-0.02, 0.0, 5)[:-1]])
    outlet = np.array([(0.0, BEND + y, BEND) for y in np.linspace(0.0, 0.02, 5)[1:]])
    return Vessel.from_tubes([(np.concatenate([inlet, bend, outlet]), 0.003)], spacing)


@pytest.mark.slow  # four seconds; friction of cables and rods round bends is in test_capstan and test_rod_cables
@pytest.mark.parametrize("mu", [0.0, 0.2, 0.4])
def test_wire_pulled_round_a_bend(mu: float) -> None:
    """Withdrawn against a force at the tip, a soft wire carries exp(mu phi) of it behind the bend (Euler, Eytelwein).

    The angle phi is that between the wire's ends, which do not lie on the middle of the channel.
    """
    force = 0.05
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    wall = builder.add_rigid(elbow(), kinematic=True)
    wire = Tube([TubeSection(0.3)], radius=2e-4, youngs=1e8, density=2000.0, max_speed=0.1)
    options = {"segments": 60, "lengths": (0.002,), "rayleigh": (0.0, 0.02), "windup": False}
    telescope = builder.add_telescope([wire], port=(0.0, 0.0, -0.019), **options)
    builder.add_contact(telescope, wall, mu=mu)
    model = builder.finalize(precision="float64", contact_capacity=120)
    sim = sw.Simulation(model, dt=0.005)
    sim.control.tube_length[:] = 0.115
    sim.step(400)
    sim.params.tube_max_speed[:] = 0.004
    for share in np.linspace(0.0, 1.0, 200):
        sim.control.rod_force[0, -1, 1] = force * share
        sim.step()
    sim.control.tube_length[:] = 0.05
    sim.step(200)
    assert not sim.status.any()
    tension = sim.rod_resultants()[0, :, 2].numpy()
    line = sim.rod_x[0].numpy()
    way = np.diff(line, axis=0)
    away = way / np.linalg.norm(way, axis=1, keepdims=True)
    phi = np.arccos(away[4:8].mean(axis=0) @ away[-8:-4].mean(axis=0))
    assert 1.3 < phi < 1.6
    assert tension[4:8].mean() / tension[-8:-4].mean() == pytest.approx(np.exp(mu * phi), rel=0.03)
    inside = (line[:, 1] > 0.0) & (line[:, 1] < 0.058)
    assert elbow().clearance(line[inside]).min() > 2e-4 - 5e-5


def test_forces_of_the_wall_balance_the_base() -> None:
    """A pre-curved tube in a straight channel: the wall's forces and the reaction at the port add up to nothing."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    line = np.array([(0.0, 0.0, -0.02), (0.0, 0.0, 0.02), (0.0, 0.0, 0.06)])
    wall = builder.add_rigid(Vessel.from_tubes([(line, 0.004)], 5e-4), kinematic=True)
    tube = Tube([TubeSection(0.1, (40.0, 0.0, 0.0))], radius=5e-4, youngs=10e9, max_speed=0.05)
    telescope = builder.add_telescope([tube], segments=30, lengths=(0.002,), rayleigh=(0.0, 0.01))
    builder.add_contact(telescope, wall, mu=0.1)
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01)
    sim.control.tube_length[:] = 0.05
    sim.step(400)
    assert not sim.status.any()
    pushed = sim.contact_force(telescope, wall)[0]
    base = sim.rod_resultants()[0, 0, :3]
    middle = sim.rod_q[0, 0] + sim.rod_q[0, 1]
    turned = torch.as_tensor(_turned((middle / torch.linalg.vector_norm(middle)).numpy(), base.numpy()))
    assert float(torch.linalg.vector_norm(pushed)) > 0.01
    torch.testing.assert_close(pushed, turned, rtol=2e-3, atol=3e-3 * float(torch.linalg.vector_norm(pushed)))


def _turned(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A vector of a frame in the world."""
    t = 2.0 * np.cross(q[:3], v)
    return np.asarray(v + q[3] * t + np.cross(q[:3], t))


@pytest.mark.slow  # 20 s; test_forces_of_the_wall_balance_the_base and test_wire_in_bend press on such walls, too
def test_nothing_leaves_the_nasal_passage() -> None:
    """Random insertion and turns of ConcentricTubeRobot, 6400 steps: no node is nearer to the wall than its radius.

    Less 0.1 mm: what a step of 10 ms moves into the wall is pushed out by the next one. No world fails, and the wall
    is touched.
    """
    from tensordict import TensorDict

    from softwarp.envs import registry

    env = registry.make("ConcentricTubeRobot", num_worlds=16, seed=3)
    env.reset()
    torch.manual_seed(1)
    touched = torch.zeros(16)
    for number in range(40):
        lean = torch.tensor([0.5, 0.0, 0.4, 0.0, 0.3, 0.0]) * (1.0 if number < 30 else -1.2)
        action = (env.action_spec.rand() + lean).clamp(-1.0, 1.0)
        data = env.step(TensorDict({"action": action}, batch_size=[16]))["next"]
        assert not (data["world_status"] >= sw.Status.NONFINITE).any()
        clear = env.scene.vessel.clearance(env.sim.rod_x.double().numpy().reshape(-1, 3))
        assert clear.min() > env.config.contact_radius - 1e-4
        touched = torch.maximum(touched, data["wall_force"][:, 0])
    assert float((touched > 0.01).float().mean()) > 0.9
    assert float(touched.max()) < 20.0
    assert not env.sim.contact_overflow.any()
