"""The Trunk environment on a GPU: TorchRL's checker, the batch contract, and the same goals as on the CPU."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from softwarp.envs import registry

pytestmark = pytest.mark.cuda
N = 40  # more than a warp, and not a multiple of one


def make(device="cuda:0", num_worlds=N, **options):
    return registry.make("Trunk", num_worlds=num_worlds, device=device, seed=1, **({"mesh": "coarse"} | options))


def act(env, action):
    return env.step(TensorDict({"action": action.to(env.device)}, batch_size=env.batch_size))["next"]


def actions_of(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [2.0 * torch.rand(N, 8, generator=generator) - 1.0 for _ in range(count)]


@pytest.mark.parametrize("options", [{}, {"action_kind": "discrete", "observation": "paper"}], ids=["default", "paper"])
def test_specs(options):
    env = make(max_episode_steps=4, **options)
    check_env_specs(env)
    data = env.rollout(10, break_when_any_done=False)
    assert data.device.type == "cuda"
    assert data["next", "observation"].isfinite().all() and data["next", "reward"].isfinite().all()


def test_goals_are_those_of_the_cpu():
    """Draws have the same bits on both devices."""
    gpu, cpu = make(settle=False), make("cpu", settle=False)
    for _ in range(2):
        gpu.reset(), cpu.reset()
        assert torch.equal(gpu.goal.cpu(), cpu.goal)


def test_motion_agrees_with_the_cpu():
    """To float32 rounding and its growth over 10 actions."""
    tips = []
    for device in ("cuda:0", "cpu"):
        env = make(device)
        env.reset()
        for action in actions_of(10):
            act(env, action)
        tips.append(env.tip().cpu())
    assert (tips[0] - tips[1]).norm(dim=1).max() < 2e-3


def test_repeatable_and_masked_reset():
    """Same seed, same bits; a reset of some worlds leaves the others bit-equal."""
    env = make()
    mask = (torch.arange(N) % 3 == 1).to(env.device)
    sequences = []
    for reset in (False, False, True):
        env.set_seed(3)
        env.reset()
        for action in actions_of(3):
            act(env, action)
        if reset:
            env.reset_where(mask)
        sequences.append(torch.stack([act(env, a)["observation"] for a in actions_of(3, seed=4)]))
    assert torch.equal(sequences[0], sequences[1])
    assert torch.equal(sequences[0][:, ~mask], sequences[2][:, ~mask])
    assert not torch.equal(sequences[0][:, mask], sequences[2][:, mask])


def test_poisoned_world_is_isolated_and_snapshot_heals():
    env = make()
    env.reset()
    act(env, actions_of(1)[0])
    saved = env.snapshot()
    expected = act(env, actions_of(1, seed=2)[0])["observation"]
    env.restore(saved)
    env.sim.node_x[7] = torch.nan
    data = act(env, actions_of(1, seed=2)[0])
    others = torch.arange(N, device=env.device) != 7
    assert data["world_status"].flatten().nonzero().flatten().tolist() == [7]
    assert data["observation"].isfinite().all() and data["reward"].isfinite().all()
    assert torch.equal(data["observation"][others], expected[others])
    env.restore(saved)
    assert torch.equal(act(env, actions_of(1, seed=2)[0])["observation"], expected)


def test_render():
    env = make(num_worlds=2, render_width=64, render_height=48)
    env.reset()
    frames = env.render()
    assert frames.shape == (2, 48, 64, 3) and frames.std() > 1.0
