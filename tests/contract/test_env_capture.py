"""What is captured on a GPU, on a CPU: the same bits as a plain step, and nothing that a graph could not replay."""

from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from softwarp.envs import registry
from tests.env_cases import FAST, some_cases
from tests.env_replays import assert_equal, fused, random_actions, stepped

N = 8

# What a graph cannot replay: tensors made from Python numbers, values read back, results whose shape depends on data.
UNFIT = {"lift_fresh", "scalar_tensor", "_local_scalar_dense", "nonzero", "masked_select", "equal", "unique"}
# Parameters drawn at resets.
DRAWN = {"Trunk": {"youngs_range": (4.0e5, 5.0e5), "damping_range": (0.8, 1.2), "gravity_tilt": 0.2}}


class Recorder(TorchDispatchMode):
    """Notes the operators that run; an index that is a mask counts as the ``nonzero`` that it begins with."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.names.append(func.overloadpacket.__name__)
        if self.names[-1].startswith("index"):
            indices = [index for index in args[1] if index is not None] if isinstance(args[1], (list, tuple)) else []
            self.names += ["nonzero" for index in indices if index.dtype == torch.bool]
        return func(*args, **(kwargs or {}))


def make(case, *, captured):
    name, options = case
    options = FAST.get(name, {}) | DRAWN.get(name, {}) | {"max_episode_steps": 4} | options
    env = registry.make(name, num_worlds=N, seed=1, **options)
    env.captures.are_on = captured
    return env


@some_cases(2)
def test_captured_steps(case):
    """Ten actions with resets, as they are captured and as they are launched; what is captured can be replayed."""
    plain, env = make(case, captured=False), make(case, captured=True)
    actions = random_actions(plain, 10)
    assert_equal(fused(env, actions), stepped(plain, actions))
    assert plain.pop_episode_log() == env.pop_episode_log()
    cut = torch.arange(N) % 3 == 0
    with Recorder() as recorder:
        env._captured_step_and_reset(actions[0], cut)
    assert len(recorder.names) > 50
    assert UNFIT.isdisjoint(recorder.names)


def test_the_recorder_notices_what_is_unfit():
    """Among it an index that is a list, which a device would have to be sent."""
    x = torch.arange(6.0).reshape(2, 3)
    unfits = (
        lambda: x[:, [0, 2]],
        lambda: torch.tensor([1.0]),
        lambda: float(x.sum()),
        lambda: x[x > 1.0],
        lambda: torch.where(x > 1.0, 1.0, -1.0),
    )
    for unfit in unfits:
        with Recorder() as recorder:
            unfit()
        assert not UNFIT.isdisjoint(recorder.names), recorder.names
