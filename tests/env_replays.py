"""The same steps of an environment in several ways, for tests that they have the same bits."""

from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import step_mdp

Row = dict[str, Tensor]


def random_actions(env: Any, count: int, seed: int = 0) -> list[Tensor]:
    """Actions that depend on the seed alone, not on the device."""
    torch.manual_seed(seed)
    spec = env.action_spec.to("cpu")
    return [spec.rand().to(env.device) for _ in range(count)]


def kept(data: Any) -> Row:
    """Leaves of a TensorDict as they are, not copied: a later step must not change them."""
    return dict(data.items())


def stepped(env: Any, actions: list[Tensor]) -> list[Row]:
    """What ``step`` and ``maybe_reset`` of TorchRL return: where each action led and what came after it."""
    rows, now = [], env.reset()
    for action in actions:
        data = env.step(now.set("action", action))
        rows.append(kept(data["next"]))
        now = env.maybe_reset(step_mdp(data))
        rows.append(kept(now))
    return rows


def collected(env: Any, actions: list[Tensor]) -> list[Row]:
    """The same from ``step_and_maybe_reset``, which TorchRL's collectors call."""
    rows, now = [], env.reset()
    for action in actions:
        data, now = env.step_and_maybe_reset(now.set("action", action))
        assert torch.equal(data["action"], action) and torch.equal(now["action"], action)
        rows += [kept(data["next"]), kept(now.exclude("action"))]
    return rows


def fused(env: Any, actions: list[Tensor]) -> list[Row]:
    """The same from ``step_and_reset``."""
    rows = []
    env.reset()
    for action in actions:
        rows += [kept(data) for data in env.step_and_reset(action)]
    return rows


def assert_equal(one: list[Row], two: list[Row]) -> None:
    """Every bit of every row."""
    assert len(one) == len(two)
    for number, (first, second) in enumerate(zip(one, two, strict=True)):
        assert first.keys() == second.keys(), number
        for key, value in first.items():
            assert value.dtype == second[key].dtype and value.shape == second[key].shape, (number, key)
            assert torch.equal(value, second[key]), (number, key)


def act(env: Any, action: Tensor) -> Any:
    """Step with an action; where it led."""
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]
