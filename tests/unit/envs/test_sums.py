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
