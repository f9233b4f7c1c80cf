"""Baselines without learning keep to the action space."""

import pytest
import torch
from tensordict import TensorDict

from softwarp.policies.baselines import scripted
from softwarp.policies.policy import Spaces

VECTOR = Spaces(3, 2, (-1.0, -2.0), (1.0, 4.0))


def act(policy, worlds=500):
    return policy(TensorDict({"observation": torch.zeros(worlds, 3)}, [worlds]))["action"]


def test_nothing_is_zero():
    """Zeros of the action's shape."""
    action = act(scripted.nothing(VECTOR))
    assert action.shape == (500, 2)
    assert action.abs().max() == 0.0


def test_nothing_needs_an_action_that_holds_still():
    """A choice, or limits that leave zero out, have none."""
    with pytest.raises(ValueError, match="none of the 16 discrete actions holds still"):
        scripted.nothing(Spaces(3, 16))
    with pytest.raises(ValueError, match="zero lies outside"):
        scripted.nothing(Spaces(3, 1, (1.0,), (2.0,)))


def test_random_fills_its_limits():
    """Uniform between the limits of each entry; the same seed repeats, another differs."""
    action = act(scripted.random(VECTOR, seed=1))
    assert (action.amin(0) >= torch.tensor([-1.0, -2.0])).all()
    assert (action.amax(0) <= torch.tensor([1.0, 4.0])).all()
    torch.testing.assert_close(action.mean(0), torch.tensor([0.0, 1.0]), atol=0.25, rtol=0.0)
    assert torch.equal(action, act(scripted.random(VECTOR, seed=1)))
    assert not torch.equal(action, act(scripted.random(VECTOR, seed=2)))


def test_random_choices():
    """All choices occur, as an index or as a one-hot row."""
    assert act(scripted.random(Spaces(3, 4))).unique().tolist() == [0, 1, 2, 3]
    rows = act(scripted.random(Spaces(3, 4, is_one_hot=True)))
    assert rows.shape == (500, 4)
    assert (rows.sum(-1) == 1).all()
