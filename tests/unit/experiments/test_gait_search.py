"""Search of gaits: four choices in every state, all sequences of them, and the farthest first; sequences by digits."""

import json

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from experiments import gait_search, gait_study
from softwarp.planning.model import Transitions


class Walker:
    """A robot whose place after some actions is told by a function of them; states are the sequences so far."""

    def __init__(self, place):
        self.place, self.sequences, self.root = place, [()], 0

    def step_many(self, states, actions):
        names = []
        for state, action in zip(states, actions, strict=True):
            self.sequences.append((*self.sequences[state], int(action)))
            names.append(len(self.sequences) - 1)
        distance = np.array([0.2 - self.place(self.sequences[name]) for name in names])
        none = np.zeros(len(names))
        return Transitions(np.array(names), none, none > 0.0, none, none > 0.0, distance)


def test_four_actions_differ_wherever_groups_are_full():
    for full in range(8):
        moves = gait_search.moves(full)
        assert len(moves) == 4 and len({after for _, after in moves}) == 4
        for action, after in moves:
            group = action % 3
            assert after == (full | 1 << group if action < 3 else full & ~(1 << group))


def test_every_sequence_is_tried_and_the_farthest_is_found():
    """Place: so far as a drawn table says; the best of four actions is that of all 256."""
    table = np.random.default_rng(3).normal(scale=1e-3, size=(6,) * 4)

    def place(sequence):
        return table[sequence] if len(sequence) == 4 else 0.0

    lengths = list(gait_search.search(Walker(place), 4))
    assert [len(gaits) for gaits in lengths] == [4, 16, 64, 256]
    best = lengths[-1][0]
    assert best.way[-1] == pytest.approx(1e3 * max(table[gait.actions] for gait in lengths[-1]))
    assert any(gait.actions == gait_search.hand_made(4) for gait in lengths[-1])


def test_few_go_on_and_the_hand_made_gait_is_kept_to_compare():
    hand = gait_search.hand_made(6)

    def place(sequence):
        return -1.0 if sequence == hand[: len(sequence)] else 1e-3 * sum(sequence)

    lengths = list(gait_search.search(Walker(place), 6, keep=1))
    assert max(map(len, lengths)) <= 4 * 9
    assert all(gaits[-1].actions == hand[: k + 1] for k, gaits in enumerate(lengths))


def test_digits_lead_a_robot_over_and_over():
    policy = gait_study.open_loop("102")
    seen = [int(policy(TensorDict({}, batch_size=[1]))["action"][0]) for _ in range(5)]
    assert seen == [1, 0, 2, 1, 0]
    assert policy(TensorDict({}, batch_size=[1]))["action"].dtype == torch.int64


@pytest.mark.slow
def test_a_search_of_the_reduced_robot(tmp_path):
    """After one action: filling the rear legs leads farthest, as the hand-made gait begins."""
    gait_search.main([str(tmp_path), "--actions", "1", "--worlds", "4"])
    told = json.loads((tmp_path / "search.json").read_text())
    assert told[0]["tried"] == 4 and told[0]["gaits"][0]["actions"] == "1"
    assert told[0]["gaits"][0]["way_mm"][0] == pytest.approx(0.557, abs=0.01)
