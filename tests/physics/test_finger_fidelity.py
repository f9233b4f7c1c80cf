"""The Gripper of fidelity "accurate": bricks with fitted moduli move as converged fingers do."""

from pathlib import Path

import numpy as np
import pytest
import torch

import softwarp
from softwarp import cli, meshing
from softwarp.envs import registry
from softwarp.envs.options.gripper import GripperConfig

PULLED = Path(__file__).parents[2] / "assets" / "gripper" / "pulled.csv"


def test_ways_under_small_loads():
    """Within 2 % of the limit of finer meshes, in the finger's plane and out of it; the default is far off."""
    robot = cli.script("benchmarks", "fidelity_robots").ROBOTS["Gripper"]
    way = np.linalg.norm(robot.truth, axis=1)
    for fidelity, least, most in (("accurate", 0.0, 0.02), ("fast", 0.5, 1.0)):
        places, start = robot.rest({"fidelity": fidelity})
        off = np.linalg.norm(places - start - robot.truth, axis=1) / way
        assert off.min() >= least and off.max() < most


@pytest.mark.slow
def test_pulls_of_the_cable():
    """Travel of the tip under lengths of the cable up to 20 mm, against the limit, and the tension that it takes."""
    limit = np.loadtxt(PULLED, delimiter=",")
    made = meshing.finger_bricks()
    builder = softwarp.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    law = softwarp.Corotational(20.0e6, 0.48)
    finger = builder.add_hexes(made.mesh, material=law, total_mass=0.1, stiffness=made.stiffness)
    builder.fix(finger, nodes=made.base)
    builder.add_cable(finger, made.cable, tuple(made.pull_point), control="length", tolerance=0.001)
    builder.add_marker(finger, (0.0865, 0.003, 0.0), tolerance=0.001)
    sim = softwarp.Simulation(builder.finalize(len(limit), "cpu", "float64"))
    start = sim.marker_x[0, 0].numpy().copy()
    sim.control.cable_displacement[:, 0] = torch.tensor(1e-3 * limit[:, 1])
    assert sim.solve_static().converged.all()
    way = 1e3 * (sim.marker_x[:, 0].numpy() - start)
    off = np.linalg.norm(way[:, :2] - limit[:, 2:4], axis=1) / np.linalg.norm(limit[:, 2:4], axis=1)

    assert off.max() < 0.02
    tension = sim.cable_tension[:, 0].numpy() / limit[:, 0]
    assert 1.0 < tension[0] < 1.03 and np.all(np.diff(tension) > 0.0) and tension[-1] < 1.27
    assert np.abs(way[:, 2]).max() < 0.2  # it stays in its plane


def test_environment_takes_it_and_refuses_contradictions():
    env = registry.make("Gripper", num_worlds=2, seed=0, fidelity="accurate", touch=True)
    assert (env.config.element, env.sim.model.hex_count) == ("bricks", 2 * 231)
    assert not torch.isnan(env.rollout(2)["next", "reward"]).any()
    assert GripperConfig.paper(fidelity="accurate").element == "bricks"
    with pytest.raises(ValueError, match=r"fidelity='accurate' means element='bricks', got element='p2'; leave one"):
        GripperConfig(fidelity="accurate", element="p2")
    with pytest.raises(ValueError, match=r"element='bricks' has a mesh of its own .* nu=0.48, got .*0.3\)"):
        GripperConfig(fidelity="accurate", nu=0.3)
    with pytest.raises(ValueError, match="needs finger='cavities'"):
        GripperConfig(element="bricks", finger="plain")
