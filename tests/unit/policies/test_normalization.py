"""Running statistics equal those of all samples at once."""

import copy

import torch

from softwarp.policies.normalization import RunningNormalizer


def test_statistics_of_parts_are_those_of_the_whole():
    """Mean and variance after several updates equal those of the concatenation, far from zero too."""
    torch.manual_seed(0)
    parts = [1e4 + torch.randn(n, 3, dtype=torch.float64) * torch.tensor([1.0, 5.0, 0.1]) for n in (7, 100, 1)]
    norm = RunningNormalizer(3)
    for part in parts:
        norm.update(part)
    whole = torch.cat(parts)
    torch.testing.assert_close(norm.mean, whole.mean(0))
    torch.testing.assert_close(norm.var, whole.var(0, unbiased=False))
    assert norm.count == 108


def test_starts_as_identity_and_inverts():
    """Without samples nothing is scaled; ``inverse`` undoes the scaling."""
    norm = RunningNormalizer(2)
    values = torch.tensor([[1.0, -3.0]])
    assert torch.equal(norm(values), values)
    norm.update(5.0 + 3.0 * torch.randn(100, 2))
    torch.testing.assert_close(norm.inverse(norm(values)), values)


def test_constant_feature_becomes_zero_and_outliers_are_clipped():
    """A feature that never changed scales to 0, one far outside to the limit."""
    norm = RunningNormalizer(2, clip=10.0)
    norm.update(torch.stack([torch.full((50,), 7.0), torch.randn(50)], dim=-1))
    assert torch.equal(norm(torch.tensor([[7.0, 1e6]])), torch.tensor([[0.0, 10.0]]))


def test_batch_shape_does_not_matter():
    """(world, time, feature) counts like (world * time, feature)."""
    values = torch.randn(4, 5, 3)
    one, other = RunningNormalizer(3), RunningNormalizer(3)
    one.update(values)
    other.update(values.reshape(-1, 3))
    assert torch.equal(one.mean, other.mean)


def test_using_it_does_not_change_it():
    """Only ``update`` changes the statistics, and they travel in the state dict."""
    norm = RunningNormalizer(3)
    norm.update(torch.randn(10, 3))
    before = copy.deepcopy(norm.state_dict())
    norm.train()(torch.randn(10, 3))
    assert all(torch.equal(before[key], value) for key, value in norm.state_dict().items())
    again = RunningNormalizer(3)
    again.load_state_dict(before)
    assert torch.equal(again.var, norm.var)
