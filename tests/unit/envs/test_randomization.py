"""Random draws: the published generator, independence of the batch, and the distributions."""

import math

import pytest
import torch

from softwarp.envs import randomization

WORD = 2**32 - 1


def words(counter: list[int], key: list[int]) -> list[int]:
    """Philox-4x32-10 by the formulas of docs/theory/philox.md, in Python's integers."""
    (c0, c1, c2, c3), (k0, k1) = counter, key
    for _ in range(10):
        first, second = 0xD2511F53 * c0, 0xCD9E8D57 * c2
        c0, c1, c2, c3 = second >> 32 ^ c1 ^ k0, second & WORD, first >> 32 ^ c3 ^ k1, first & WORD
        k0, k1 = k0 + 0x9E3779B9 & WORD, k1 + 0xBB67AE85 & WORD
    return [c0, c1, c2, c3]


def test_philox_known_answers():
    """Random123's known-answer vectors for philox4x32-10: all counter and key words 0, then all 2^32 - 1."""
    assert words([0] * 4, [0] * 2) == [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]
    assert words([WORD] * 4, [WORD] * 2) == [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]


@pytest.mark.parametrize("count", [1, 4, 9])
def test_uniform_is_philox(count):
    """Numbers are the first 24 bits of the words, for all sizes of seeds, owners, episodes and streams."""
    seed, owner, episode = [0, 7, 2**62 - 5, -1], [0, 2**32 + 3, 5, -1], [0, -1, 2**31, 2**40 + 1]
    for stream in (0, 3, 2**31 + 7, WORD):
        u = randomization.uniform(*map(torch.tensor, (seed, owner, episode)), stream, count)
        assert u.shape == (4, count) and u.dtype == torch.float32
        for row, (s, o, e) in enumerate(zip(seed, owner, episode, strict=True)):
            counters = [[block, stream, e & WORD, o & WORD] for block in range(3)]
            told = [word for counter in counters for word in words(counter, [s & WORD, s >> 32 & WORD])]
            assert u[row].tolist() == [(word >> 8) * 2.0**-24 for word in told[:count]]


def draw(worlds, episodes, stream=0, count=5, seed=7):
    world = torch.as_tensor(worlds)
    return randomization.uniform(torch.full_like(world, seed), world, torch.as_tensor(episodes), stream, count)


def test_uniform_depends_on_its_own_row_only():
    """Row i of a batch equals the same (world, episode) drawn alone."""
    batch = draw([0, 5, 9], [2, 0, 7])
    for row, (world, episode) in enumerate([(0, 2), (5, 0), (9, 7)]):
        torch.testing.assert_close(batch[row], draw([world], [episode])[0], rtol=0, atol=0)


def test_uniform_streams_differ():
    """Seed, world, episode and stream each change every number."""
    base = draw([1], [1])
    for other in (draw([2], [1]), draw([1], [2]), draw([1], [1], stream=1), draw([1], [1], seed=8)):
        assert (base != other).all()


def test_uniform_is_uniform():
    """Mean 1/2 and variance 1/12 of 200 000 numbers, within 5 standard errors; none outside [0, 1)."""
    u = draw(torch.arange(50_000), torch.zeros(50_000, dtype=torch.int64), count=4).double().flatten()
    n = len(u)
    assert u.min() >= 0.0 and u.max() < 1.0
    assert abs(u.mean() - 0.5) < 5 * math.sqrt(1 / 12 / n)
    assert abs(u.var() - 1 / 12) < 5 * math.sqrt(1 / 180 / n)


def test_direction_in_cone():
    """Unit vectors within the half angle; on a cap, cos is uniform, so its mean is (1 + cos a) / 2."""
    u = draw(torch.arange(20_000), torch.zeros(20_000, dtype=torch.int64), count=2)
    for axis in ((0.0, -9.81, 0.0), (1.0, 2.0, -3.0)):
        direction = randomization.direction_in_cone(u, axis, 0.4).double()
        centre = torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64), dim=0)
        cos = direction @ centre
        torch.testing.assert_close(direction.norm(dim=1), torch.ones(20_000, dtype=torch.float64))
        assert cos.min() >= math.cos(0.4) - 1e-6
        assert abs(cos.mean() - (1 + math.cos(0.4)) / 2) < 1e-3
        sideways = direction - cos[:, None] * centre
        assert sideways.mean(dim=0).norm() < 5e-3


def test_in_range():
    """0 maps to low, 1 to high."""
    torch.testing.assert_close(
        randomization.in_range(torch.tensor([0.0, 0.25, 1.0]), (2.0, 6.0)), torch.tensor([2.0, 3.0, 6.0])
    )
