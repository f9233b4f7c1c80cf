"""Replay: a ring that forgets the oldest, even or by priority, saved and restored to the bit."""

import logging

import pytest
import torch
from tensordict import TensorDict

from softwarp.training import replay
from softwarp.training.replay import Replay, has_priority_trees


def numbered(first, count):
    value = torch.arange(first, first + count, dtype=torch.float32)
    return TensorDict({"x": value, "next": TensorDict({"y": -value[:, None]}, [count])}, [count])


@pytest.mark.parametrize("prioritized", [False, True])
def test_ring_keeps_the_last(prioritized):
    """Of 25 transitions the last 10 are left, each whole."""
    ring = Replay(10, numbered(0, 1), prioritized=prioritized)
    for first in (0, 4, 11, 18):
        ring.add(numbered(first, 7))
    drawn = ring.sample(500)
    assert set(drawn["x"].tolist()) == set(range(15, 25))
    assert torch.equal(drawn["next", "y"][:, 0], -drawn["x"])
    assert torch.equal(drawn["x"], ring.data["x"][drawn["index"]])


@pytest.mark.parametrize("prioritized", [False, True])
def test_one_at_a_time(prioritized):
    """A ring, a batch and an update of a single transition, saved and restored."""
    ring, other = (Replay(1, numbered(0, 1), prioritized=prioritized) for _ in range(2))
    ring.add(numbered(7, 1))
    drawn = ring.sample(1)
    assert drawn.shape == (1,) and drawn["x"].tolist() == [7.0]
    ring.prioritize(drawn["index"], torch.ones(1))
    other.load_state_dict(ring.state_dict())
    assert other.sample(1)["x"].tolist() == [7.0]


def test_more_than_fits_at_once():
    """Only the end of a batch larger than the ring is kept."""
    ring = Replay(5, numbered(0, 1))
    ring.add(numbered(0, 12))
    assert sorted(ring.data["x"].tolist()) == [7.0, 8.0, 9.0, 10.0, 11.0]


def test_priorities_are_frequencies():
    """Draws follow (|error| + eps)^0.6, weights their inverse to the power 0.4; evenly without the extension."""
    torch.manual_seed(0)
    ring = Replay(4, numbered(0, 1), prioritized=True)
    ring.add(numbered(0, 4))
    error = torch.tensor([1.0, 2.0, 4.0, 8.0])
    ring.prioritize(torch.arange(4), error)
    drawn = ring.sample(40_000)
    priority = error.pow(0.6) if has_priority_trees() else torch.ones(4)
    expected = priority / priority.sum()
    torch.testing.assert_close(torch.bincount(drawn["index"]) / 40_000.0, expected, atol=0.01, rtol=0.0)
    assert ("priority_weight" in drawn) == has_priority_trees()
    if not has_priority_trees():
        return
    weight = torch.stack([drawn["priority_weight"][drawn["index"] == i][0] for i in range(4)])
    torch.testing.assert_close(weight, (expected / expected.min()).pow(-0.4), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("prioritized", [False, True])
def test_restored_ring_draws_the_same(prioritized):
    """Same contents, same priorities, same draws."""
    ring, other = (Replay(50, numbered(0, 1), prioritized=prioritized) for _ in range(2))
    ring.add(numbered(0, 70))
    ring.prioritize(torch.arange(50), torch.rand(50))
    other.load_state_dict(ring.state_dict())
    ring.add(numbered(70, 3)), other.add(numbered(70, 3))
    for generator in (ring, other):
        torch.manual_seed(1)
        generator.drawn = generator.sample(64)
    for key in ring.drawn.keys(True, True):
        assert torch.equal(ring.drawn[key], other.drawn[key])


def test_without_the_extension_sampling_is_even_and_says_so(monkeypatch, caplog):
    """The fall-back is told in the log and works."""
    monkeypatch.setattr(replay, "has_priority_trees", lambda: False)
    with caplog.at_level(logging.WARNING):
        ring = Replay(10, numbered(0, 1), prioritized=True)
    assert "drawn evenly and not by priority" in caplog.text
    ring.add(numbered(0, 10))
    drawn = ring.sample(100)
    assert "priority_weight" not in drawn
    ring.prioritize(drawn["index"], torch.ones(100))


def test_what_does_not_fit_is_refused():
    """A larger ring, or one with priorities, cannot be restored into a smaller one, or one without."""
    large, small = Replay(10, numbered(0, 1)), Replay(5, numbered(0, 1))
    large.add(numbered(0, 10))
    with pytest.raises(ValueError, match="10 transitions do not fit a capacity of 5"):
        small.load_state_dict(large.state_dict())
    with pytest.raises(ValueError, match="priorities"):
        small.load_state_dict({**small.state_dict(), "priority": torch.zeros(0)})
    small.load_state_dict(large.state_dict(transitions=False))
    assert small.size == 0
