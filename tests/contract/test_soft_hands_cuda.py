"""Robots that touch what they move, on a GPU: in contact they do what they do on the CPU, and steps are captured."""

import pytest
import torch

from softwarp.envs import registry
from softwarp.policies.baselines.table import rule
from tests.env_replays import act, assert_equal, stepped

pytestmark = pytest.mark.cuda
N = 40  # more than a warp, and not a multiple of one

# Options, actions of the hand-written policy until there is contact, and how far [m] what is moved may be from where it
# is on the CPU then, in a share of the worlds and in all. Rounding grows by sliding, and a ball over a chamber's middle
# rolls off to nowhere in particular. A cup slips: on one CPU, places of nodes changed by 1e-8 m move it by 0.04 mm in
# half of the worlds, by 0.9 mm in a tenth, and by up to 15 mm.
GRASPS = {
    "Gripper": ({"finger": "plain"}, 34, (0.9, 5.0e-4, 5.0e-3)),
    "TrunkCup": ({}, 10, (0.5, 3.0e-4, 2.0e-2)),
    "BubbleMotion": ({}, 3, (0.9, 2.0e-3, 2.0e-2)),
}
EVERY = pytest.mark.parametrize("name", GRASPS)


def make(name, device="cuda:0", num_worlds=N, **options):
    return registry.make(name, num_worlds=num_worlds, device=device, seed=1, **(GRASPS[name][0] | options))


def place(env):
    """Middle of what is moved [m], (world, 3), on the host."""
    found = {"Gripper": "object_position", "TrunkCup": "tip"}.get(type(env).__name__)
    return (getattr(env, found)() if found else env.sim.body_pose[:, env.scene.ball, :3]).float().cpu().clone()


def play(env, count):
    """Actions of the hand-written policy, and the snapshot of some worlds before them."""
    policy, now, taken = rule(env, type(env).__name__), env.reset(), []
    start = env.snapshot(range(N - 7))
    for _ in range(count):
        now = policy(now)
        taken.append(now["action"].clone())
        now = env.step(now)["next"]
    return start, taken


@EVERY
def test_a_grasp_ends_where_it_does_on_the_cpu(name):
    """Actions recorded on the CPU, carried out on the GPU: all worlds in contact, none failed, within bounds."""
    _, count, (share, bound, most) = GRASPS[name]
    cpu, gpu = make(name, "cpu"), make(name)
    _, actions = play(cpu, count)
    gpu.reset()
    for action in actions:
        data = act(gpu, action.to(gpu.device))
    assert (data["world_status"] == 0).all()
    for env in (cpu, gpu):
        assert (env.sim.contact_count > 0).all() and (env.sim.contact_overflow == 0).all()
    away = (place(cpu) - place(gpu)).norm(dim=1)
    assert float(away.quantile(share)) < bound and float(away.max()) < most


@EVERY
def test_worlds_in_contact_do_not_know_of_each_other(name):
    """Some worlds alone do what they do beside others, to the bit."""
    whole, some = make(name), N - 7  # of which the snapshot is
    start, actions = play(whole, GRASPS[name][1])
    part = make(name, num_worlds=some)
    part.reset()
    part.restore(start)
    for action in actions:
        act(part, action[:some])
    assert torch.equal(place(part), place(whole)[:some])


@EVERY
def test_captured_steps_have_the_same_bits_in_contact(name):
    """The grasp and the reset after it, replayed as a graph and launched part by part."""
    _, count, _ = GRASPS[name]
    _, actions = play(make(name), count)
    actions += actions[:3]
    told = stepped(make(name, capture=False, max_episode_steps=count), actions)
    env = make(name, capture=True, max_episode_steps=count)
    assert_equal(stepped(env, actions), told)
    assert env.captures.recorded == ["_captured_reset", "_captured_step"]
