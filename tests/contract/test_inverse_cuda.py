"""Inverse control on a GPU: the commands and distances of the CPU."""

import pytest
import torch
from tensordict import TensorDict

from softwarp.control import InversePolicy
from softwarp.envs import registry

N = 5
PERIODS = 40


def controlled(name, device, options):
    """Actions and distances to the goals of some periods, in float64; goals are those of the seed on every device."""
    env = registry.make(name, num_worlds=N, seed=3, device=device, precision="float64", **options)
    env.reset()
    policy = InversePolicy(env)
    rows = []
    for _ in range(PERIODS):
        data = TensorDict({}, batch_size=[N], device=env.device)
        policy(data)
        for substep in range(env.action_repeat):
            env.apply_action(data["action"], substep)
            env.sim.step()
        rows.append([data["action"].cpu(), env.measure_distance().cpu()])
    return [torch.stack(values) for values in zip(*rows, strict=True)]


@pytest.mark.cuda
@pytest.mark.parametrize(
    ("name", "options", "tolerance"),
    [
        ("Trunk", {"mesh": "coarse", "action_kind": "absolute"}, 1e-5),
        ("Diamond", {"mesh": "coarse"}, 1e-5),
        ("CartStemContact", {"action_kind": "continuous"}, 2e-4),  # forces of contact are found to a tolerance
    ],
)
def test_control_is_that_of_the_cpu(name, options, tolerance):
    """Five worlds with goals of their own; the trunk, a slender body, settles by the law that it has for that."""
    cpu, gpu = (controlled(name, device, options) for device in ("cpu", "cuda:0"))
    for one, two in zip(cpu, gpu, strict=True):
        torch.testing.assert_close(two, one, rtol=0, atol=tolerance)
