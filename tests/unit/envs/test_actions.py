"""Refused actions: at once where steps are launched part by part (see test_base.py), later where they are captured."""

import pytest
import torch

from softwarp.envs.actions import ActionGuard
from tests.env_replays import act, assert_equal
from tests.unit.envs.fake import PointConfig, PointEnv

N = 4


def make(**options):
    """With the path of captured steps, which a CPU takes on request only."""
    env = PointEnv(PointConfig(**options), num_worlds=N, seed=3)
    env.captures.are_on = True
    return env


def test_the_first_refused_action_of_each_world_is_told():
    """Good actions pass with all bits; what follows a refused one in its world does not hide it."""
    env = make()
    guard = ActionGuard("Point", env.action_spec, 0, is_on=True)
    good = torch.tensor([[0.1, -0.0], [1e-40, 2.0], [-3.0, 0.5], [0.0, 1.0]])
    assert torch.equal(guard.screen(good).view(torch.int32), good.view(torch.int32))
    for wrong in (torch.inf, torch.nan):
        bad = good.clone()
        bad[2, 1] = wrong
        assert guard.screen(bad).tolist() == [*good[:2].tolist(), [0.0, 0.0], good[3].tolist()]
    guard.raise_noted()
    guard.publish()
    with pytest.raises(ValueError, match=r"world 2 got something else, for example \[-3.0, inf\]. Steps are captured"):
        guard.raise_noted()
    guard.raise_noted(wait=True)


@pytest.mark.parametrize(
    ("discrete", "bad", "message"),
    [
        (
            False,
            torch.tensor([[0.0, 0.0], [torch.nan, 0.0], [0.0, 0.0], [0.5, torch.inf]]),
            "be finite; world 1, 3 got",
        ),
        (True, torch.tensor([0, 4, 1, -1]), r"lie in \[0, 3\]; world 1, 3 got something else, for example 4"),
    ],
)
def test_refused_actions_are_found_by_the_next_call(discrete, bad, message):
    """The step acts with 0 in those worlds; the next one, a reset, a snapshot or a question raises, once."""
    message = f"PointEnv: every action must {message}"
    good = torch.where(torch.tensor([False, True, False, True]).reshape(-1, *[1] * (bad.dim() - 1)), 0, bad)
    env, healthy = make(discrete=discrete), make(discrete=discrete)
    for call in (
        lambda: act(env, good),
        lambda: env.step_and_reset(good),
        lambda: env.reset(),
        lambda: env.snapshot(),
        lambda: env.pop_episode_log(),
        lambda: env.raise_refused_actions(),
    ):
        for e in (env, healthy):
            e.set_seed(5)
            e.reset()
        assert_equal([dict(act(env, bad).items())], [dict(act(healthy, good).items())])
        with pytest.raises(ValueError, match=message):
            call()
        env.raise_refused_actions()
    act(env, good)


def test_forms_are_refused_at_once_and_values_not_at_all_if_unchecked():
    env = make()
    env.reset()
    with pytest.raises(ValueError, match=r"PointEnv: action must have shape \(4, 2\), got \(4, 3\)"):
        env.step_and_reset(torch.zeros(N, 3))
    env = make(check_actions=False)
    env.reset()
    action = torch.zeros(N, 2)
    action[2] = 1000.0
    after, now = env.step_and_reset(action)
    assert after["world_status"].flatten().tolist() == [0, 0, 3, 0] and now["world_status"].sum() == 0
    env.raise_refused_actions()
