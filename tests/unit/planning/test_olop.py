"""OLOP and KL-OLOP: bounds in closed form, bandits by hand, and the recursion against the definition."""

import itertools
import math

import numpy as np
import pytest

from softwarp.planning.olop import OLOP, OLOPConfig, bernoulli_divergence, episodes_and_length, kl_bound
from tests.planning_cases import TreeModel, scattered, table


def test_episodes_and_length_by_hand():
    """gamma 1/2: L = ceil(ln M / 1.386). M = 4 has L = 1, M = 5 ... 16 has L = 2, so 20 steps hold 10 episodes of 2."""
    assert episodes_and_length(20, 0.5) == (10, 2)
    assert episodes_and_length(5, 0.5) == (4, 1)
    assert episodes_and_length(1, 0.5) == (1, 1)


def test_divergence_and_bound_in_closed_form():
    """d(0, q) = -ln(1 - q), so the bound of a mean of 0 is 1 - exp(-f / T); a mean of 1 is bounded by 1."""
    assert bernoulli_divergence(0.5, 0.25) == pytest.approx(0.5 * math.log(2.0) + 0.5 * math.log(2.0 / 3.0))
    assert kl_bound(0.0, 4, 2.0) == pytest.approx(1.0 - math.exp(-0.5))
    assert kl_bound(1.0, 3, 2.0) == 1.0
    q = kl_bound(0.3, 10, 2.0)
    assert 10 * bernoulli_divergence(0.3, q) == pytest.approx(2.0)


@pytest.mark.parametrize(("bound", "visits"), [("hoeffding", [8, 6, 2]), ("kl", [8, 7, 1])])
def test_bandit_by_hand(bound, visits):
    """Rewards 1 and 0, M = 8, L = 1.

    OLOP, c = sqrt(2 ln 8) = 2.039: arm 0 while 1 + c / sqrt(T0) > c, for T0 = 1, 2, 3; at T0 = 4 it is 2.02 < 2.04, so
    arm 1 is taken once more, after which its bound is 1.44.
    KL-OLOP: the bound of arm 0 stays 1, that of arm 1 is 1 - exp(-f) with f = 2 ln 8 + 2 ln ln 8, below 1.
    """
    planner = OLOP(OLOPConfig(bound=bound, gamma=0.3, expansions=4, batch=1))
    found = planner.plan(TreeModel(table({(0,): 1.0})))
    assert found.tree.visits == visits
    assert found.actions.tolist() == [0]
    assert found.value == 1.0


@pytest.mark.parametrize("bound", ["hoeffding", "kl"])
def test_sequences_have_the_greatest_bound_of_all(bound):
    """In every episode B of the sequence that is run is the maximum over all sequences, by the definition."""
    gamma, length, count = 0.7, 3, 2
    model = TreeModel(scattered, count=count)
    planner = OLOP(OLOPConfig(bound=bound, gamma=gamma, expansions=45, batch=1, length=length))
    episodes = 90 // length
    runs: dict[tuple[int, ...], list[float]] = {}

    def upper(path):
        rewards = runs.get(path)
        if rewards is None:
            return math.inf if bound == "hoeffding" else 1.0
        mean, log = sum(rewards) / len(rewards), math.log(episodes)
        if bound == "hoeffding":
            return mean + math.sqrt(2.0 * log / len(rewards))
        return kl_bound(mean, len(rewards), 2.0 * log + 2.0 * math.log(log))

    def b_value(sequence):
        sums = itertools.accumulate(gamma**h * upper(sequence[: h + 1]) for h in range(length))
        return min(s + gamma ** (h + 1) / (1.0 - gamma) for h, s in enumerate(sums))

    rolled, seen = model.roll_out, []

    def watch(states, actions):
        sequence = tuple(actions[0].tolist())
        best = max(b_value(s) for s in itertools.product(range(count), repeat=length))
        assert b_value(sequence) == pytest.approx(best) or (math.isinf(best) and math.isinf(b_value(sequence)))
        result = rolled(states, actions)
        for h in range(length):
            runs.setdefault(sequence[: h + 1], []).append(float(result.rewards[0, h]))
        seen.append(sequence)
        return result

    model.roll_out = watch
    found = planner.plan(model)
    assert len(seen) == 30
    visits = {path: len(entries) for path, entries in runs.items()}
    assert {tuple(found.tree.path(n)): found.tree.visits[n] for n in range(1, len(found.tree))} == visits


def test_kl_finds_the_best_sequence_and_batches_spread():
    """All eight sequences of a small tree: the plan is the best; eight sequences of the first batch are not one."""
    model = TreeModel(scattered, count=2, horizon=3)
    found = OLOP(OLOPConfig(bound="kl", gamma=0.9, expansions=3000, batch=8, length=3)).plan(model)
    sequences = list(itertools.product([0, 1], repeat=3))
    values = {s: sum(0.9**i * scattered(s[: i + 1]) for i in range(3)) for s in sequences}
    assert tuple(found.actions) == max(values, key=values.get)
    assert found.value == pytest.approx(max(values.values()))
    first = OLOP(OLOPConfig(bound="kl", gamma=0.9, expansions=12, batch=8, length=3)).plan(TreeModel(scattered))
    assert np.array(first.tree.visits)[[n for n in range(len(first.tree)) if first.tree.depth[n] == 1]].min() >= 2


def test_ends_are_told():
    """A sequence that meets the goal stops the search on request; the plan ends there and its value counts the rest."""
    model = TreeModel(table({}), ends={(1, 0): 1.0})
    found = OLOP(OLOPConfig(bound="kl", gamma=0.5, expansions=500, batch=4, length=4)).plan(model)
    assert found.actions.tolist() == [1, 0]
    assert found.success
    assert found.value == pytest.approx(0.25 / 0.5)
    model = TreeModel(table({}), ends={(1, 0): 1.0})
    found = OLOP(OLOPConfig(gamma=0.5, expansions=500, batch=4, length=4, until_success=True)).plan(model)
    assert found.actions.tolist() == [1, 0]
    assert found.expansions < 100
