"""What counts as a line in the wall: nodes and what lies between them, step by step."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from benchmarks import walls
from softwarp.shapes import Vessel


@pytest.fixture
def env() -> SimpleNamespace:
    """A line in a tube of 6 mm that moves aside by 2 mm a step, in one of two worlds, and forces of its actions."""
    vessel = Vessel.from_tubes([([(0.0, 0.0, 0.0), (0.0, 0.0, 0.05)], 0.006)], 0.001)
    line = torch.zeros(2, 5, 3)
    line[:, :, 2] = torch.linspace(0.02, 0.03, 5)
    sim = SimpleNamespace(rod_x=line, body_pose=torch.zeros(2, 1, 7), _steppers=[])

    def step() -> None:
        line[1, :, 0] += 0.002

    def act(_: object) -> dict[str, dict[str, torch.Tensor]]:
        sim.step(2)
        force = torch.tensor([[0.1, 0.1], [0.3, 0.3]])
        return {"next": {"world_status": torch.zeros(2, 1), "wall_force": force}}

    sim.step = step
    scene, config = SimpleNamespace(vessel=vessel, wall=0), SimpleNamespace(contact_radius=0.001)
    parts = {"scene": scene, "sim": sim, "config": config, "full_action_spec": SimpleNamespace(zero=TensorDict)}
    return SimpleNamespace(**parts, num_worlds=2, device=torch.device("cpu"), _nodes=slice(0, 5), step=act)


def test_steps_in_the_wall_are_counted(env: SimpleNamespace) -> None:
    """After 2, 4, 6.6 and 8.6 mm: clear in the first action, in the wall of 6 mm in both steps of the second one."""
    watch = walls.Watch(env)
    watch.act(torch.zeros(2, 6))
    assert watch.tally.inside == watch.tally.actions_inside == 0
    np.testing.assert_allclose(1e3 * watch.deepest, [-6.0, -2.0], atol=0.3)
    env.sim.rod_x[1, :, 0] += 0.0006
    watch.act(torch.zeros(2, 6))
    assert (watch.tally.steps, watch.tally.inside, watch.tally.actions_inside) == (8, 2, 1)
    assert 1e3 * watch.tally.depth == pytest.approx(1.4, abs=0.3)  # beyond the middle of a wall of 4 mm
    both = walls.Tally()
    both.add(watch.tally)
    both.add(walls.Tally(steps=2, depth=-1.0, forces=[0.5]))
    record = both.record()
    assert (record["steps"], record["inside"], record["force"]) == (10, 2, 0.5)
    assert both.depth == watch.tally.depth
