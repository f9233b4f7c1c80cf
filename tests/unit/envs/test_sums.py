"""Sums whose order does not depend on the number of worlds."""

import pytest
import torch

from softwarp.envs import sums


@pytest.mark.parametrize("count", [1, 2, 3, 7, 24])
def test_total_is_the_sum(count):
    """Of any number of entries; exact in integers, and a row has the bits it has alone."""
    values = torch.arange(5 * count, dtype=torch.float64).reshape(5, count)
    assert torch.equal(sums.total(values), values.sum(dim=1))
    drawn = torch.rand(33, count)
    assert torch.equal(sums.total(drawn)[4:5], sums.total(drawn[4:5]))


def test_length_is_the_norm():
    """Of vectors along the last axis."""
    vector = torch.randn(4, 6, 3, dtype=torch.float64)
    torch.testing.assert_close(sums.length_of(vector), torch.linalg.vector_norm(vector, dim=-1), rtol=1e-14, atol=0.0)


def test_length_of_nothing_has_no_gradient():
    """Other rows keep theirs."""
    vector = torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 4.0]], requires_grad=True)
    sums.length_of(vector).sum().backward()
    assert vector.grad is not None
    assert vector.grad.tolist() == [[0.0, 0.0, 0.0], pytest.approx([0.6, 0.0, 0.8])]
