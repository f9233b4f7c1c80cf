"""UCT on bandits and trees with known answers."""

import math

import numpy as np
import pytest

from softwarp.planning.uct import UCT, UCTConfig
from tests.planning_cases import TreeModel, scattered, table


def plan(model, **settings):
    return UCT(UCTConfig(**settings)).plan(model)


def test_bandit_by_hand():
    """Rewards 1 and 0, C = sqrt 2: after one pull each, arm 0 is pulled while 1 + C sqrt(ln n / n0) > C sqrt(ln n).

    n = 2: 2.18 > 1.18;  3: 2.05 > 1.48;  4: 1.96 > 1.67;  5: 1.90 > 1.79;  6: 1.85 < 1.89, so the seventh is arm 1.
    """
    model = TreeModel(table({(0,): 1.0}), horizon=1)
    visits = [plan(model, horizon=1, batch=1, expansions=n).tree.visits[1:] for n in (2, 3)]
    assert visits == [[3, 1], [5, 1]]
    found = plan(model, horizon=1, batch=1, expansions=4)  # 8 searches of one step
    assert found.tree.visits == [8, 6, 2]
    assert found.tree.total == [6.0, 6.0, 0.0]
    assert found.actions.tolist() == [0]
    assert found.value == 1.0


def test_tree_equals_its_definition():
    """Against a plain recursion; the last reward depends on the action before it alone, so nothing is random."""
    gamma, last = 0.8, {0: 0.9, 1: 0.4}
    first = {(0,): 0.2, (1,): 0.5}
    found = plan(
        TreeModel(lambda path: first[path] if len(path) == 1 else last[path[0]], horizon=2),
        gamma=gamma,
        horizon=2,
        batch=1,
        expansions=30,
    )
    visits: dict[tuple[int, ...], int] = {}
    total: dict[tuple[int, ...], float] = {}

    def search(path):
        """Return from ``path`` on."""
        visits[path] = visits.get(path, 0) + 1
        value = 0.0
        if len(path) < 2:
            children = [(*path, action) for action in range(2)]
            new = [child for child in children if child not in visits]
            log = math.log(max(visits[path], 1))
            child = (
                new[0] if new else max(children, key=lambda c: total[c] / visits[c] + math.sqrt(2 * log / visits[c]))
            )
            if new:
                visits[child] = 1
                rest = last[child[0]] if len(child) == 1 else 0.0
            else:
                rest = search(child)
            value = (first[child] if len(child) == 1 else last[child[0]]) + gamma * rest
            total[child] = total.get(child, 0.0) + value / (1.0 + gamma)
            total[()] = total.get((), 0.0) + (value / (1.0 + gamma) if path == () else 0.0)
        return value

    for _ in range(found.tree.visits[0]):
        search(())
    paths = [tuple(found.tree.path(node)) for node in range(len(found.tree))]
    assert set(paths) == set(visits)
    assert found.tree.visits == [visits[path] for path in paths]
    assert found.tree.total == pytest.approx([total[path] for path in paths])


def test_finds_the_best_branch_of_a_scattered_tree():
    """With enough searches the most visited plan is the best of all sequences."""
    model = TreeModel(scattered, count=2, horizon=4)
    found = plan(model, gamma=0.9, horizon=4, batch=4, expansions=4000)
    sequences = np.array(np.meshgrid(*[[0, 1]] * 4)).reshape(4, -1).T
    values = [sum(0.9**i * scattered(tuple(s[: i + 1])) for i in range(4)) for s in sequences.tolist()]
    assert found.value == pytest.approx(max(values))


def test_searches_of_a_batch_spread():
    """Virtual losses: four searches from an empty tree of four actions try four actions."""
    found = plan(TreeModel(scattered, count=4, horizon=2), horizon=2, batch=4, expansions=2)
    assert found.tree.visits[:5] == [4, 1, 1, 1, 1]


def test_ends_and_repeatability():
    """An end earns its rest until the horizon; equal seeds give equal trees."""
    ends = {(1,): 1.0}
    found = plan(TreeModel(table({(0,): 0.5}), ends=ends), horizon=5, expansions=60, until_success=True)
    assert found.actions.tolist() == [1]
    assert found.value == pytest.approx(0.95 / 0.05)
    model = TreeModel(table({(0,): 0.5}), ends=ends)
    found = plan(model, horizon=5, expansions=400)
    assert found.actions.tolist() == [1]
    assert found.success
    again = plan(TreeModel(table({(0,): 0.5}), ends=ends), horizon=5, expansions=400)
    assert again.tree.to_dict()["visits"] == found.tree.to_dict()["visits"]


def test_random_sequence_that_meets_the_goal_is_the_plan():
    """Deep in the tree, met by random actions below a node of depth 1: on request the search ends with that plan."""
    ends = {(0, 1, 1, 0): 1.0}
    model = TreeModel(table({(0, 1): 0.5}), ends=ends)
    found = plan(model, gamma=0.5, horizon=4, batch=2, expansions=500, until_success=True)
    assert found.actions.tolist() == [0, 1, 1, 0]
    assert found.success
    assert found.value == pytest.approx(0.25 + 0.125)
    assert found.nodes == found.tree.line(found.nodes[-1])
    assert len(found.tree) < 30
