"""Learning from memory: states, rewards and ends are those of the robot that was simulated once."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from experiments import gait_study
from experiments.gait_memory import Remembered, remember
from softwarp.planning.model import Transitions

ACTIONS = 3


class Walker:
    """A robot that is at ``place(actions)`` and observes a sum of them, where what does nothing counts as a wait."""

    worlds, root = 7, 0

    def __init__(self):
        self.sequences, self.seen = [()], []
        self.pool = SimpleNamespace(observe=lambda: {"observation": torch.tensor(self.seen, dtype=torch.float32)})

    @staticmethod
    def place(sequence):
        """What fills or empties a group moves it by so much as when and which it is."""
        full, way = set(), 0.0
        for step, action in enumerate(sequence):
            group = action % 3
            if (action < 3) != (group in full):
                full ^= {group}
                way += 1e-3 * (step + 1) * (action - 1.5)
        return way

    def step_many(self, states, actions):
        made = [(*self.sequences[s], int(a)) for s, a in zip(states, actions, strict=True)]
        names = np.arange(len(made)) + len(self.sequences)
        self.sequences += made
        way = np.array([self.place(sequence) for sequence in made])
        self.seen = [[10.0 * w, float(len(s))] for w, s in zip(way, made, strict=True)] + [[9.0, 9.0]]
        none = np.zeros(len(made))
        return Transitions(names, none, none > 0.0, none, none > 0.0, 0.2 - way)


@pytest.fixture(scope="module")
def memory():
    return remember(Walker(), torch.zeros(2), ACTIONS)


def test_all_states_are_remembered_once(memory):
    assert memory.way.shape == (1 + 4 + 16 + 64,)
    assert int((memory.after[:21] < 0).sum()) == 0 and int((memory.after[21:] >= 0).sum()) == 0


def test_every_episode_is_the_robots(memory):
    """All 216 sequences of six actions, waits of any kind included: observations, rewards and the end."""
    sequences = torch.cartesian_prod(*[torch.arange(6)] * ACTIONS)
    env = Remembered(memory, len(sequences))
    state, won = env.reset(), torch.zeros(len(sequences))
    for step in range(ACTIONS):
        action = TensorDict({"action": sequences[:, step]}, env.batch_size)
        state = env.step(state.update(action))["next"]
        won += state["reward"][:, 0]
        ways = torch.tensor([Walker.place(s[: step + 1]) for s in sequences.tolist()])
        torch.testing.assert_close(won, 100.0 * ways, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(state["observation"][:, 0], 10.0 * ways, atol=1e-6, rtol=1e-5)
        assert bool((state["done"] == (step == ACTIONS - 1)).all()) and not bool(state["terminated"].any())


def test_worlds_are_reset_apart_and_go_on_from_a_snapshot(memory):
    env = Remembered(memory, 2)
    check_env_specs(env)
    env.reset()
    env.step(TensorDict({"action": torch.tensor([1, 2])}, [2]))
    kept = env.snapshot()
    env.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, [2]))
    assert env.state[0] == 0 and env.state[1] > 0
    env.restore(kept)
    assert bool((env.state > 0).all())


@pytest.mark.slow
def test_a_policy_learned_from_memory_walks(tmp_path):
    """``gait_study --remember``: an action from rest is learned from memory and carried out, as it was remembered."""
    settings = ["num_worlds=8", "total_steps=64", "algo.horizon=1", "evaluations=1", "logger=quiet"]
    arguments = ["--remember", "--actions", "1", "--seeds", "0", "--models", "reduced", "--training", *settings]
    hand, learned = gait_study.main([str(tmp_path), *arguments])
    assert hand.actions == (1,) and hand.way[-1] == pytest.approx(0.557, abs=0.01)
    way = {0: -0.455, 1: 0.557, 2: -0.502}.get(learned.actions[0], 0.0)  # what six choices lead to
    assert learned.way[-1] == pytest.approx(way, abs=0.01)
    assert (tmp_path / "table2.md").exists() and (tmp_path / "figure6.png").exists()
