"""Optimistic planning on trees with known answers, and batches against one leaf after the other."""

import numpy as np
import pytest

from softwarp.planning.opd import OPD, OPDConfig
from tests.planning_cases import CommutingModel, TreeModel, scattered, table

SMALL = table({(0,): 0.6, (1,): 0.4, (0, 1): 0.2, (1, 0): 1.0, (1, 0, 0): 0.8})


def plan(model, planner=None, **settings):
    planner = planner or OPD(OPDConfig(**settings))
    return planner.plan(model)


def one_by_one(model, *, gamma, batch, expansions):
    """The rule of OPD by its definition, without a queue: again and again the ``batch`` leaves of greatest bound."""
    nodes = [((), 0, 0.0)]  # path, state, discounted rewards
    leaves, order = {0}, []
    while len(order) < expansions:
        ranked = sorted(leaves, key=lambda i: (-(nodes[i][2] + gamma ** len(nodes[i][0]) / (1.0 - gamma)), i))
        for leaf in ranked[: min(batch, expansions - len(order))]:
            leaves.remove(leaf)
            path, state, value = nodes[leaf]
            order.append(path)
            for action in range(model.action_count):
                told = model.step_many(np.array([state]), np.array([action]))
                leaves.add(len(nodes))
                nodes.append(
                    ((*path, action), int(told.states[0]), value + gamma ** len(path) * float(told.rewards[0]))
                )
    return order, nodes


def test_small_tree_by_hand():
    """gamma 1/2, bounds: 0 1.6, 1 1.4 | 00 1.1, 01 1.2 | 10 1.4, 11 0.9 | 100 1.35, 101 1.15; 100: 1.1."""
    model = TreeModel(SMALL)
    found = plan(model, gamma=0.5, expansions=4, batch=1)
    assert model.paths == [(), (0,), (1,), (0, 0), (0, 1), (1, 0), (1, 1), (1, 0, 0), (1, 0, 1)]
    np.testing.assert_allclose(found.tree.value, [0.0, 0.6, 0.4, 0.6, 0.7, 0.9, 0.4, 1.1, 0.9])
    assert found.actions.tolist() == [1, 0, 0]
    assert found.value == pytest.approx(1.1)
    assert (found.expansions, found.transitions) == (4, 8)


def test_ties_and_an_end_by_hand():
    """gamma 0.8, so the root's bound is 5; 0 and 1 both earn 0.5, and 01 ends with 0.25 per step for ever.

    b: 0 4.5, 1 4.5, the first is expanded | 00 0.9 + 3.2 = 4.1, 01 1.1 + 0.64 0.25 / 0.2 = 1.9, done | then 1: 10 4.5,
    11 3.7 | 10: 100 1.46 + 2.56 = 4.02, 101 3.86 | 00 comes before them: 000, 001 3.46. The end is worth the most.
    """
    rewards = {(0,): 0.5, (1,): 0.5, (0, 0): 0.5, (0, 1): 0.75, (1, 0): 1.0, (1, 0, 0): 0.25}
    model = TreeModel(table(rewards), ends={(0, 1): 0.25})
    found = plan(model, gamma=0.8, expansions=5, batch=1)
    assert model.paths[1::2] == [(0,), (0, 0), (1, 0), (1, 0, 0), (0, 0, 0)]
    np.testing.assert_allclose(found.tree.value, [0.0, 0.5, 0.5, 0.9, 1.9, 1.3, 0.5, 1.46, 1.3, 0.9, 0.9])
    assert found.actions.tolist() == [0, 1]
    assert found.value == pytest.approx(1.9)


def test_one_good_branch_is_followed_and_equal_ones_are_searched_in_breadth():
    """Reward 1 for action 0 alone: as deep as expansions go. Equal rewards: all nodes of a depth before the next."""
    found = plan(TreeModel(lambda path: 1.0 - path[-1]), gamma=0.9, expansions=12, batch=1)
    assert max(found.tree.depth) == 12 and found.actions.tolist() == [0] * 12
    found = plan(TreeModel(lambda path: 0.5), gamma=0.9, expansions=15, batch=1)
    assert found.tree.depth == sorted(found.tree.depth)
    assert [found.tree.depth.count(d) for d in range(5)] == [1, 2, 4, 8, 16]


@pytest.mark.parametrize("batch", [1, 2, 5])
def test_batches_give_the_tree_of_the_same_rule_one_by_one(batch):
    """All leaves of a batch in one step: same nodes in the same order, same values, whatever the size of the pool."""
    reference = TreeModel(scattered, count=3)
    order, nodes = one_by_one(reference, gamma=0.9, batch=batch, expansions=40)
    for worlds in (1, 4, 100):
        model = TreeModel(scattered, count=3, worlds=worlds)
        found = plan(model, gamma=0.9, batch=batch, expansions=40)
        assert [tuple(found.tree.path(node)) for node in range(len(found.tree))] == [path for path, _, _ in nodes]
        assert found.tree.value == [value for _, _, value in nodes]
        assert sum(found.tree.visits) == len(order)
        assert max(model.batches) == min(worlds, 3 * batch)
    assert found.value == max(value for _, _, value in nodes)


def test_batch_of_one_leaf_is_the_sequential_algorithm():
    """Every leaf expanded had the greatest bound of all leaves at its time."""
    order, _ = one_by_one(TreeModel(scattered, count=3), gamma=0.9, batch=1, expansions=40)
    model = TreeModel(scattered, count=3)
    plan(model, gamma=0.9, batch=1, expansions=40)
    expanded = [path[:-1] for path in model.paths[1::3]]
    assert expanded == order


def test_ends_are_leaves_of_exact_value():
    """An end that earns 1 for ever is worth 0.2 + 0.5 * 2 = 1.2 and is never expanded; one that earns nothing 0.6."""
    model = TreeModel(table({(0,): 0.6, (1,): 0.2}), ends={(0,): 0.0, (1,): 1.0})
    found = plan(model, gamma=0.5, expansions=10, batch=4)
    assert len(found.tree) == 3  # nothing is left to expand
    assert found.tree.value[1:] == pytest.approx([0.6, 1.2])
    assert found.actions.tolist() == [1]
    assert found.success


def test_stops_at_success_and_at_the_horizon():
    """The first plan that meets the goal ends the search, though others are worth more; episodes end at the horizon."""
    model = TreeModel(lambda path: 1.0 - path[-1], ends={(1, 1): 1.0})
    found = plan(model, gamma=0.5, expansions=100, batch=2, until_success=True)
    assert found.actions.tolist() == [1, 1]
    assert found.expansions < 100
    model = TreeModel(scattered, horizon=3)
    found = plan(model, expansions=100)
    assert max(found.tree.depth) == 3
    assert found.expansions == 7  # 1 + 2 + 4 nodes can be expanded
    assert plan(TreeModel(scattered, horizon=0)).actions.size == 0


def test_tree_is_kept_below_the_actions_carried_out():
    """The rest of the tree keeps its order of bounds: nu' = (nu - nu_1) / gamma, so it is what was there before."""
    model = TreeModel(scattered, count=3)
    planner = OPD(OPDConfig(gamma=0.9, expansions=30, batch=4))
    first = planner.plan(model)
    planner.advance(2)
    assert model.paths[planner.expected_state] == tuple(first.actions[:2])
    nodes = len(first.tree)
    second = planner.plan(model)
    assert all(path[:2] == tuple(first.actions[:2]) for path in model.paths[nodes:])
    rewards = [scattered(tuple(first.actions[:2]) + tuple(second.actions[: i + 1])) for i in range(len(second.actions))]
    assert second.value == pytest.approx(sum(0.9**i * reward for i, reward in enumerate(rewards)))
    assert len(first.tree) == nodes == 91  # a search keeps the tree that it ended with
    assert second.tree.state[0] == first.tree.state[first.nodes[1]]
    before = (first.value - sum(0.9**i * scattered(tuple(first.actions[: i + 1])) for i in range(2))) / 0.81
    assert second.value >= before - 1e-12


def test_every_leaf_of_a_kept_tree_can_still_be_expanded():
    """Horizon 4, one action carried out: with enough budget the kept tree becomes complete, 1 + 2 + 4 + 8 nodes."""
    model = TreeModel(scattered, horizon=4)
    planner = OPD(OPDConfig(gamma=0.9, expansions=6, batch=2))
    planner.plan(model)
    planner.advance(1)
    planner.config.expansions = 100
    assert len(planner.plan(model).tree) == 15


class Detour(TreeModel):
    """Actions move by one to either side; distances and rewards tell of two ways, of which the short one ends."""

    def __init__(self):
        super().__init__(lambda path: 0.5 / (0.5 + self.distance(path)), horizon=40)

    @staticmethod
    def distance(path):
        """From 1 on: to the right 0.5 away is as near as it gets, to the left it is farther before it is nearer."""
        place = sum(1 if action else -1 for action in path)
        return {0: 1.0, 1: 0.5, -1: 0.9, -2: 0.8}.get(place, 0.6 if place > 0 else 0.1)

    def step_many(self, states, actions):
        told = super().step_many(states, actions)
        told.distance[:] = [self.distance(self.paths[state]) for state in told.states]
        return told


@pytest.mark.parametrize(("patience", "budgets"), [(1, 1), (2, 2), (50, None)])
def test_patience_goes_on_until_something_is_nearer(patience, budgets):
    """At the end of the short way nothing within a budget is nearer: a patient plan spends more, until something is."""
    model = Detour()
    planner = OPD(OPDConfig(gamma=0.9, expansions=4, batch=1, patience=patience))
    first = planner.plan(model)
    assert first.actions[0] == 1 and first.expansions == 4  # where the distance at the root is not known
    planner.advance(1)
    second = planner.plan(model)
    nearest = min(second.tree.distance[1:])
    if budgets is not None:
        assert second.expansions == 4 * budgets and nearest >= 0.5
    else:
        assert nearest <= 0.95 * 0.5 and second.expansions % 4 == 0 and 8 < second.expansions < 200
    assert model.transitions == 2 * (first.expansions + second.expansions)


def test_budget_in_seconds_ends_a_search():
    """No time at all is enough for one round, so that there is a plan."""
    found = plan(TreeModel(scattered), seconds=1e-9, batch=3)
    assert (found.expansions, found.actions.size) == (1, 1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gamma": 1.0}, r"gamma: must lie in \(0, 1\), got 1"),
        ({"batch": 0}, "batch: must be at least 1, got 0"),
        ({"patience": 0}, "patience: must be at least 1, got 0"),
    ],
)
def test_bad_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        OPDConfig(**settings)


def test_needs_discrete_actions():
    with pytest.raises(ValueError, match="opd: needs 2 or more discrete actions, the model has 0"):
        plan(TreeModel(scattered, count=0))


def test_of_nodes_that_are_alike_the_best_one_is_expanded():
    """Each count of actions is expanded once, where its bound is the greatest of all nodes of that count.

    As bounds fall on the way down, the first that is taken is the best: one leaf at a time, a kept tree aside.
    """
    model = CommutingModel(scattered, count=3)
    tree = plan(model, gamma=0.9, batch=1, expansions=40).tree
    gain = {node: tree.value[node] + 0.9 ** tree.depth[node] / 0.1 for node in range(len(tree))}
    expanded = {tree.likeness[node]: node for node in range(1, len(tree)) if tree.visits[node]}
    assert len(expanded) == 39 == sum(tree.visits) - 1
    for node in range(1, len(tree)):
        if tree.likeness[node] in expanded:
            assert gain[node] <= gain[expanded[tree.likeness[node]]]
    apart = plan(CommutingModel(scattered, count=3), gamma=0.9, batch=1, expansions=40, merge=False).tree
    assert apart.to_dict() == plan(TreeModel(scattered, count=3), gamma=0.9, batch=1, expansions=40).tree.to_dict()


def test_merging_reaches_deeper():
    """Equal rewards, two actions: a depth d has d + 1 states, not 2^d, and 15 expansions are the first five depths."""
    tree = plan(CommutingModel(lambda path: 0.5), gamma=0.9, expansions=15, batch=1).tree
    assert [sum(tree.visits[i] for i in range(len(tree)) if tree.depth[i] == d) for d in range(5)] == [1, 2, 3, 4, 5]
    tree = plan(CommutingModel(lambda path: 0.5, horizon=4), gamma=0.9, expansions=100, batch=8).tree
    assert sum(tree.visits) == 1 + 2 + 3 + 4  # nothing else is left


def test_what_was_merged_with_a_branch_that_is_left_is_expanded_after_all():
    """0 then 1 is expanded, 1 then 0 is not; after action 1 it is what leads on."""
    model = CommutingModel(lambda path: 0.6 if path[0] == 0 else 0.5)
    planner = OPD(OPDConfig(gamma=0.5, batch=1, expansions=5, until_success=True))
    tree = planner.plan(model).tree
    path = {tuple(tree.path(node)): node for node in range(len(tree))}
    assert tree.visits[path[0, 1]] and not tree.visits[path[1, 0]]
    planner._plan = [path[(1,)]]
    planner.advance(1)
    tree = planner.plan(model).tree
    path = {tuple(tree.path(node)): node for node in range(len(tree))}
    assert tree.visits[path[(0,)]]
