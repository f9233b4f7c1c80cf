"""The environments on a GPU: TorchRL's checker, the batch contract, and the same starts and motion as on the CPU."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from softwarp.envs import registry
from tests.env_cases import CASES, FAST, case_id

pytestmark = pytest.mark.cuda
EVERY = pytest.mark.parametrize("name", registry.names())
SENSITIVE = {
    "BubbleMotion": (1, 1.0),
    "Maze": (1, 1.0),  # what rolls: 1e-8 m after every step grows to 1e-6 in one action, to 2e-4 in four, in float64
    "SimpleMaze": (1, 1.0),
    "TrunkCup": (4, 0.1),
}  # actions and their size, for little growth
N = 40  # more than a warp, and not a multiple of one


def make(name, device="cuda:0", num_worlds=N, **options):
    return registry.make(name, num_worlds=num_worlds, device=device, seed=1, **(FAST.get(name, {}) | options))


def act(env, action):
    return env.step(TensorDict({"action": action.to(env.device)}, batch_size=env.batch_size))["next"]


def actions_of(env, count, seed=0):
    """Random actions that depend on the seed alone, not on the device."""
    torch.manual_seed(seed)
    spec = env.action_spec.to("cpu")
    return [spec.rand() for _ in range(count)]


@pytest.mark.parametrize("case", CASES, ids=case_id)
def test_specs(case):
    name, options = case
    env = make(name, max_episode_steps=4, **options)
    check_env_specs(env)
    data = env.rollout(10, break_when_any_done=False)
    assert data.device.type == "cuda"
    assert data["next", "observation"].isfinite().all() and data["next", "reward"].isfinite().all()
    assert data["next", "done"].any(dim=1).all()


@EVERY
def test_motion_agrees_with_the_cpu(name):
    """To float32 rounding and its growth over 4 actions, of what rolls or slips over gentle ones or one alone.

    Starts and goals are drawn with the same numbers. The growth is that between a CPU's two solver paths. A ball at an
    edge follows one of its two faces, which rounding chooses: BubbleMotion is compared with a CPU in float64.
    """
    count, size = SENSITIVE.get(name, (4, 1.0))
    ends, goals = [], []
    for device in ("cuda:0", "cpu"):
        exact = name == "BubbleMotion" and device == "cpu"
        env = make(name, device, **({"precision": "float64"} if exact else {}))
        env.reset()
        goal = env.goal_points()
        goals.append(torch.zeros(0) if goal is None else goal.cpu())
        for action in actions_of(env, count):
            act(env, action * size if action.is_floating_point() else action)
        ends.append((env.sim.node_x.cpu().float(), env.sim.frame_pose.cpu().float()))
    torch.testing.assert_close(*goals, rtol=0.0, atol=1e-6)  # those above an object follow where it came to rest
    (nodes, poses), (cpu_nodes, cpu_poses) = ends
    for one, two in ((nodes, cpu_nodes), (poses[..., :3], cpu_poses[..., :3])):
        torch.testing.assert_close(one, two, rtol=0.0, atol=2e-3)
    turned = (poses[..., 3:] * cpu_poses[..., 3:]).sum(dim=-1).abs()  # cosine of half the angle between them
    assert (turned > 1.0 - 2e-4).all()  # 0.04 rad


@EVERY
def test_repeatable_and_masked_reset(name):
    """Same seed, same bits; a reset of some worlds leaves the others bit-equal."""
    env = make(name)
    mask = (torch.arange(N) % 3 == 1).to(env.device)
    sequences = []
    for reset in (False, False, True):
        env.set_seed(3)
        env.reset()
        for action in actions_of(env, 3):
            act(env, action)
        if reset:
            env.reset_where(mask)
        sequences.append(torch.stack([act(env, a)["observation"] for a in actions_of(env, 3, seed=4)]))
    assert torch.equal(sequences[0], sequences[1])
    assert torch.equal(sequences[0][:, ~mask], sequences[2][:, ~mask])
    assert not torch.equal(sequences[0][:, mask], sequences[2][:, mask])


@EVERY
def test_world_equals_alone(name):
    """World i of 40 has the bits of the same seed alone."""
    batch, single = make(name), make(name, num_worlds=1)
    batch.seed_worlds(list(range(N)))
    single.seed_worlds([7])
    assert torch.equal(batch.reset()["observation"][7], single.reset()["observation"][0])
    for action in actions_of(batch, 4):
        together, alone = act(batch, action), act(single, action[7:8])
        for key in ("observation", "reward", "distance", "terminated"):
            assert torch.equal(together[key][7], alone[key][0]), key


@EVERY
def test_poisoned_world_is_isolated_and_snapshot_heals(name):
    env = make(name)
    env.reset()
    act(env, actions_of(env, 1)[0])
    saved = env.snapshot()
    action = actions_of(env, 1, seed=2)[0]
    expected = act(env, action)["observation"]
    env.restore(saved)
    env.sim.node_x[7] = torch.nan
    env.sim.frame_pose[7] = torch.nan
    data = act(env, action)
    others = torch.arange(N, device=env.device) != 7
    assert (data["world_status"].flatten() >= 3).nonzero().flatten().tolist() == [7]
    assert data["observation"].isfinite().all() and data["reward"].isfinite().all()
    assert torch.equal(data["observation"][others], expected[others])
    env.restore(saved)
    assert torch.equal(act(env, action)["observation"], expected)


@EVERY
def test_render(name):
    env = make(name, num_worlds=2, render_width=64, render_height=48)
    env.reset()
    frames = env.render()
    assert frames.shape == (2, 48, 64, 3) and frames.std() > 1.0
