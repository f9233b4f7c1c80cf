"""Depths of overlaps against places that are known: a cube in the floor and in itself, a ball in floor and rim."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from benchmarks import overlap
from benchmarks.soak import Soak
from softwarp.envs import registry
from softwarp.envs.options.bubble_motion import RECESS_HALF
from softwarp.envs.snapshot import EnvSnapshot
from softwarp.model.codes import Status
from softwarp.shapes import Vessel


def test_a_cube_in_the_floor_and_in_a_finger():
    """Nothing overlaps at the start; lowered by 3 mm, a cube on a gap of 0.5 mm is 2.5 mm deep, in one world alone."""
    env = registry.make("Gripper", num_worlds=2, finger="plain", settle=False)
    env.reset()
    gauge = overlap.gauge(env)
    assert gauge.size == 0.040
    assert gauge().tolist() == [0.0, 0.0]
    x, nodes = env.sim.node_x, env._nodes
    x[1, nodes, 2] -= 0.003
    torch.testing.assert_close(gauge(), torch.tensor([0.0, 0.0025]), rtol=0.0, atol=1e-6)
    first, last = env.sim.model.body_node_start[env.scene.fingers[0] : env.scene.fingers[0] + 2]
    x[:, int(first) : int(last)] = x[:, :1]  # out of the way, all in a point
    tip = env.tips()[0, 1]
    x[0, nodes] += tip - env.object_position()[0]
    assert float(gauge()[0]) > 0.004  # the other finger's end, 23 mm wide, is in the cube's middle


@pytest.mark.parametrize("depth", [0.0, 0.0005, 0.002])
def test_a_ball_in_the_floor_and_in_the_rim(depth):
    """The floor at rest is the plane z = 10 mm, the rim's walls are planes: depths are those of a ball in a plane."""
    env = registry.make("BubbleMotion", num_worlds=2, settle=False)
    env.reset()
    gauge, radius = overlap.gauge(env), env.config.ball_radius
    pose = env.sim.body_pose[:, env.scene.ball]
    pose[:, :3] = torch.tensor([[0.002, 0.001, 0.010 + radius - depth], [RECESS_HALF - radius + depth, 0.003, 0.021]])
    torch.testing.assert_close(gauge(), torch.full((2,), depth), rtol=0.0, atol=1e-6)


def test_others_have_no_gauge():
    """Environments without one are soaked all the same, and a limit of time ends that."""
    env = registry.make("CartPole", num_worlds=1)
    assert overlap.gauge(env) is None
    tally = Soak(env, "random", 0).run(1e9, time_limit=0.0)
    assert tally.world_steps == env.action_repeat
    assert tally.status == {"OK": 1}


def test_a_line_in_the_wall_of_a_vessel():
    """In a tube of 6 mm, 5 mm beside the axis clear and 7.5 mm about 1.5 mm deep, as the wall's distance tells."""
    vessel = Vessel.from_tubes([([(0.0, 0.0, 0.0), (0.0, 0.0, 0.05)], 0.006)], 0.001)
    line = torch.zeros(2, 5, 3)
    line[:, :, 2] = torch.linspace(0.02, 0.03, 5)
    line[:, :, 0] += 0.1 + torch.tensor([0.005, 0.0075])[:, None]
    pose = torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]).expand(2, 1, 7)
    scene, sim = SimpleNamespace(vessel=vessel, wall=0), SimpleNamespace(rod_x=line, body_pose=pose)
    config = SimpleNamespace(contact_radius=0.001)
    env = SimpleNamespace(config=config, scene=scene, sim=sim, _nodes=slice(0, 5), device=torch.device("cpu"))
    found = overlap.VesselGauge(env)()
    points = (line[1] - pose[1, :, :3]).double().numpy()
    expected = -vessel.clearance(np.concatenate([points, 0.5 * (points[1:] + points[:-1])])).min()
    torch.testing.assert_close(found, torch.tensor([0.0, float(expected)]), rtol=0.0, atol=1e-6)
    assert 0.0013 < expected < 0.0017


def test_what_failed_is_kept(tmp_path):
    """A soak writes the state and the action that a world failed with; alone it fails again."""

    class Poisoned(Soak):
        def _choose(self) -> None:
            super()._choose()
            self.env.sim.frame_twist[1] = float("nan")

    file = tmp_path / "failed.pt"
    env = registry.make("CartPole", num_worlds=2)
    tally = Poisoned(env, "random", 0, keep=file).run(1)
    assert tally.status == {"OK": 1, "NONFINITE": 1}
    (kept,) = torch.load(file)
    alone = registry.make("CartPole", num_worlds=1)
    alone.restore(EnvSnapshot.from_state_dict(kept["snapshot"]))
    after, _ = alone.step_and_reset(kept["action"][None])
    assert int(after["world_status"]) == kept["status"] == Status.NONFINITE
