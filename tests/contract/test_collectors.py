"""TorchRL's own collectors run softwarp environments with softwarp policies, in this process and in others."""

import functools
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import InitTracker, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import RandomPolicy

from softwarp.envs import registry
from softwarp.policies.actor_critic import ActorCritic
from softwarp.policies.policy import NetworkConfig, Spaces

WORLDS, STEPS = 4, 30


make_env = functools.partial(registry.make, "CartStem", num_worlds=WORLDS, seed=0, max_episode_steps=12)


def make_policy():
    torch.manual_seed(0)
    return ActorCritic(Spaces.of(make_env()), NetworkConfig(hidden=[8]))


def test_collectors_explore_and_evaluation_does_not():
    """TorchRL's exploration type says whether a policy draws its action."""
    env, policy = make_env(), make_policy()
    now = env.reset()
    with set_exploration_type(ExplorationType.RANDOM):
        drawn = {tuple(policy(now.clone())["action"].tolist()) for _ in range(20)}
    chosen = {tuple(policy(now.clone())["action"].tolist()) for _ in range(20)}
    assert len(drawn) > 1
    assert chosen == {tuple(policy.act(now["observation"]).tolist())}


def check(batch, worlds):
    """Steps follow each other within episodes and every episode ends after at most 12 of them."""
    assert batch.shape == (worlds, STEPS)
    done = batch["next", "done"][..., 0]
    assert (done.sum(-1) >= 2).all()
    now, after = batch["observation"][:, 1:], batch["next", "observation"][:, :-1]
    assert torch.equal(now[~done[:, :-1]], after[~done[:, :-1]])
    assert not torch.equal(now[done[:, :-1]], after[done[:, :-1]])
    assert torch.isfinite(batch["next", "reward"]).all()


@pytest.mark.parametrize("make", [make_policy, lambda: RandomPolicy(make_env().action_spec)], ids=["network", "random"])
def test_collector_in_this_process(make):
    """Two batches of whole steps from one environment."""
    total = WORLDS * STEPS
    collector = Collector(make_env, make(), frames_per_batch=total, total_frames=2 * total)
    batches = [batch.clone() for batch in collector]
    collector.shutdown()
    assert len(batches) == 2
    for batch in batches:
        check(batch, WORLDS)


def test_memory_is_cleared_by_the_tracker_of_resets():
    """A recurrent policy behind an InitTracker starts each episode with an empty memory and keeps it in between."""
    torch.manual_seed(0)
    policy = ActorCritic(Spaces.of(make_env()), NetworkConfig(hidden=[8], recurrent=3))
    total = WORLDS * STEPS
    collector = Collector(
        lambda: TransformedEnv(make_env(), InitTracker()), policy, frames_per_batch=total, total_frames=total
    )
    (batch,) = [batch.clone() for batch in collector]
    collector.shutdown()
    check(batch, WORLDS)
    memory = torch.zeros(WORLDS, 6)
    with torch.no_grad():
        for step in batch.unbind(1):
            memory = memory * ~step["is_init"]
            memory = policy.features(step["observation"], memory)[1]
            torch.testing.assert_close(step["memory"], memory)
    begins = batch["is_init"][:, 1:, 0]
    assert torch.equal(begins, batch["next", "done"][:, :-1, 0])


@pytest.mark.slow
def test_collectors_in_two_processes():
    """Each process has its own simulation and seed; their batches are put side by side."""
    makers = [functools.partial(make_env, seed=seed) for seed in (1, 2)]
    total = 2 * WORLDS * STEPS
    collector = MultiSyncCollector(makers, make_policy(), frames_per_batch=total, total_frames=2 * total, cat_results=0)
    batches = [batch.clone() for batch in collector]
    collector.shutdown()
    assert len(batches) == 2
    for batch in batches:
        check(batch, 2 * WORLDS)
        assert not torch.equal(batch["observation"][:WORLDS], batch["observation"][WORLDS:])


REMOTE = {  # options of the backends that reach other machines, here with processes of this one
    "distributed": {"launcher": "mp", "backend": "gloo"},
    "ray": {
        "ray_init_config": {"address": "local", "num_cpus": 2, "include_dashboard": False},
        "remote_configs": {"num_cpus": 1, "num_gpus": 0},
    },
}
PROGRAM = """
import functools, sys
import torch
from torchrl.collectors import Collector
from tests.contract import test_collectors as here

if __name__ == "__main__":  # processes that torch starts import this file again
    kind, total = sys.argv[1], 2 * here.WORLDS * here.STEPS
    makers = [functools.partial(here.make_env, seed=seed) for seed in (1, 2)]
    collector = Collector(
        makers, here.make_policy(), backend=kind, backend_options=here.REMOTE[kind], sync=True,
        frames_per_batch=total, total_frames=2 * total,
    )
    batches = [batch.clone() for batch in collector]
    assert len(batches) == 2
    for batch in batches:
        batch = batch.reshape(2 * here.WORLDS, here.STEPS)
        here.check(batch, 2 * here.WORLDS)
        assert not torch.equal(batch["observation"][: here.WORLDS], batch["observation"][here.WORLDS :])
    print("collected", flush=True)
    collector.shutdown()
"""


@pytest.mark.slow
@pytest.mark.parametrize("kind", REMOTE)
def test_collectors_over_machines(kind, tmp_path):
    """Two collectors of TorchRL's distributed backend, and of its Ray backend, each with a simulation of its own."""
    if kind == "ray":
        pytest.importorskip("ray")
    program = tmp_path / "collect.py"
    program.write_text(PROGRAM)
    root = str(Path(__file__).parents[2])
    paths = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    command = [sys.executable, str(program), kind]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True, timeout=900)
    assert "collected" in done.stdout, done.stderr[-2000:]
