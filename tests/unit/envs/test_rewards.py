"""Reward terms against their formulas, and finite where a quotient could be 0 / 0."""

import pytest
import torch

from softwarp.envs import rewards


def test_progress_telescopes():
    """The sum over a path is (first - last) / scale, whatever the detours."""
    path = torch.tensor([3.0, 1.0, 2.0, 0.5])
    assert rewards.progress(path[:-1], path[1:], 0.5).sum().item() == pytest.approx((3.0 - 0.5) / 0.5)


@pytest.mark.parametrize("kernel", [rewards.gaussian, rewards.cauchy])
def test_kernels(kernel):
    """1 at the goal, falling, and at one scale exp(-1) or 1/2."""
    values = kernel(torch.tensor([0.0, 0.01, 0.05]), 0.01)
    assert values[0] == 1.0
    assert values[1].item() == pytest.approx({"gaussian": 0.36788, "cauchy": 0.5}[kernel.__name__], rel=1e-4)
    assert 0.0 <= values[2] < values[1]


def test_effort_is_a_mean_square():
    """-(1 + 0.25) / 2."""
    assert rewards.effort(torch.tensor([[1.0, -0.5]])).item() == -0.625


def test_relative_progress():
    """Sqrt of the relative gain: 0 when moving away, 1 on arrival, and finite when already there."""
    previous, distance = torch.tensor([4.0, 4.0, 4.0, 0.0, 0.0]), torch.tensor([3.0, 5.0, 0.0, 0.0, 1.0])
    torch.testing.assert_close(rewards.relative_progress(previous, distance), torch.tensor([0.5, 0.0, 1.0, 0.0, 0.0]))
