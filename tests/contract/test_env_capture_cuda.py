"""Steps that are replayed as one CUDA graph: the same bits as steps launched part by part, whatever changes between."""

import subprocess
import sys
import threading
import warnings

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from softwarp.envs import registry
from softwarp.envs.capture import CaptureError
from softwarp.policies.actor_critic import ActorCritic
from softwarp.policies.policy import NetworkConfig, Spaces
from softwarp.training.rollout import Rollout
from tests.env_cases import CASES, FAST, case_id
from tests.env_replays import act, assert_equal, collected, fused, random_actions, stepped

pytestmark = pytest.mark.cuda
EVERY = pytest.mark.parametrize("case", CASES, ids=case_id)
N = 40  # more than a warp, and not a multiple of one

# Parameters that are drawn at resets, in the captured step too.
DRAWN = {
    "Trunk": {"youngs_range": (4.0e5, 5.0e5), "damping_range": (0.8, 1.2), "gravity_tilt": 0.2},
    "Diamond": {"youngs_range": (1.6e5, 2.0e5)},
}


def make(name, *, capture=True, num_worlds=N, **options):
    options = FAST.get(name, {}) | DRAWN.get(name, {}) | options
    return registry.make(name, num_worlds=num_worlds, device="cuda:0", seed=1, capture=capture, **options)


@pytest.mark.parametrize("case", [*CASES, ("CartStemContact", {"integrator": "bdf2"})], ids=case_id)
def test_captured_steps_have_the_same_bits(case):
    """50 actions with resets, from TorchRL's calls and from the fused one, captured and not."""
    name, options = case
    options = {"max_episode_steps": 9, **options}
    plain_env = make(name, capture=False, **options)
    actions = random_actions(plain_env, 50)
    plain = stepped(plain_env, actions)
    assert not plain_env.captures.recorded
    env = make(name, **options)
    assert_equal(stepped(env, actions), plain)
    assert env.captures.recorded == ["_captured_reset", "_captured_step"]
    env = make(name, **options)
    assert_equal(collected(env, actions), plain)
    env = make(name, **options)
    assert_equal(fused(env, actions), plain)
    assert env.captures.recorded == ["_captured_step_and_reset"]
    logs = plain_env.pop_episode_log(), env.pop_episode_log()
    assert logs[0] == logs[1] and logs[0]["episodes"] >= 5 * N


@EVERY
def test_captured_by_default(case):
    """Every environment of the table can be captured."""
    name, options = case
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*launched part by part")
        env = make(name, capture=None, max_episode_steps=3, **options)
        env.rollout(8, break_when_any_done=False)
    assert env.captures.are_on and env.captures.recorded


@pytest.mark.parametrize("name", registry.names())
def test_specs(name):
    check_env_specs(make(name, max_episode_steps=4))


@pytest.mark.parametrize("name", ["Trunk", "CartStem", "CatchTheObject"])
def test_what_may_change_between_steps(name):
    """Snapshots, seeds, masked resets, parameters, the time step, the start, the length of episodes, partial steps."""
    mask = (torch.arange(N) % 3 == 1).cuda()

    def run(capture):
        env = make(name, capture=capture, max_episode_steps=30)
        given = iter(random_actions(env, 40))
        rows = [dict(env.reset().items())]

        def go(count):
            for _ in range(count):
                rows.extend(dict(data.items()) for data in env.step_and_reset(next(given)))
                rows.append(dict(act(env, next(given)).items()))

        go(3)
        saved = env.snapshot()
        go(1)
        env.restore(saved)
        env.restore(env.snapshot([0]), [5, 7], keep_streams=True)
        go(2)
        env.set_seed(11)
        rows.append(dict(env.reset_where(mask).items()))
        go(2)
        for tensor in env.sim.params.tensors().values():
            tensor.mul_(1.01)
        go(2)
        env.sim.dt = 0.8 * env.sim.dt
        go(3)
        env.sim.set_initial()
        go(1)
        env.reset()
        go(1)
        env.max_episode_steps = 4
        go(3)
        some = TensorDict({"action": next(given), "_step": ~mask}, batch_size=[N])
        rows.append(dict(env.step(some)["next"].items()))
        return rows

    assert_equal(run(True), run(False))


def test_other_streams_threads_and_modes():
    """Replayed on a stream that is not torch's default, from another thread, in inference mode, with autograd on."""
    plain, env = (make("CartStem", capture=capture, action_kind="continuous") for capture in (False, True))
    rows = []
    actions = random_actions(plain, 12)
    expected = stepped(plain, actions)

    def go(part):
        for action in part:
            rows.append(dict(act(env, action).items()))
            rows.append(dict(env.reset_where(rows[-1]["done"].flatten()).items()))

    env.reset()
    with torch.inference_mode():
        go(actions[:3])
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        go(actions[3:6])
    torch.cuda.current_stream().wait_stream(stream)
    thread = threading.Thread(target=go, args=(actions[6:9],))
    thread.start()
    thread.join()
    go([action.clone().requires_grad_() for action in actions[9:]])
    keys = ("observation", "reward", "terminated")
    for number, row in enumerate(expected[::2]):
        for key in keys:
            assert torch.equal(rows[2 * number][key], row[key]), (number, key)
            assert not rows[2 * number][key].requires_grad


def test_results_stay_what_they_were():
    env = make("CatchTheObject", max_episode_steps=5)
    actions = random_actions(env, 8)
    rows = fused(env, actions)
    copies = [{key: value.clone() for key, value in row.items()} for row in rows]
    fused(env, actions[::-1])
    assert_equal(rows, copies)


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_refused_actions_are_found_later(kind):
    """The next calls raise, once; the worlds concerned acted with 0, the others as they should."""
    env, healthy = (make("CartStem", action_kind=kind) for _ in range(2))
    action = random_actions(env, 1)[0]
    bad = action.clone()
    bad[7] = 5 if kind == "discrete" else torch.nan
    action[7] = 0
    for _ in range(3):
        for e in (env, healthy):
            e.set_seed(2)
            e.reset()
        assert_equal([dict(act(env, bad).items())], [dict(act(healthy, action).items())])
        with pytest.raises(ValueError, match=r"CartStem: every action must .*; world 7 got something else"):
            env.raise_refused_actions()
        env.raise_refused_actions()
    act(env, bad)
    torch.cuda.synchronize()
    with pytest.raises(ValueError, match="world 7 got something else"):
        act(env, action)
    plain = make("CartStem", action_kind=kind, capture=False)
    plain.reset()
    with pytest.raises(ValueError, match=r"world 7 got something else, .* No world was stepped"):
        act(plain, bad)


def test_a_step_that_reads_back_goes_without_capture():
    """With capture=None after a warning and with the same bits, with capture=True it is an error that says where."""

    def reading(env):
        reward_terms = env.reward_terms
        env.reward_terms = lambda action, distance: reward_terms(action, distance + 0.0 * float(distance.sum()))
        return env

    plain = make("CartStem", capture=False)
    actions = random_actions(plain, 6)
    expected = stepped(plain, actions)
    env = reading(make("CartStem", capture=None))
    with pytest.warns(UserWarning, match="CartStem: steps are launched part by part from now on"):
        rows = stepped(env, actions)
    assert_equal(rows, expected)
    assert not env.captures.are_on
    env = reading(make("CartStem"))
    env.reset()
    with pytest.raises(
        CaptureError, match=r"cannot be recorded as a CUDA graph: it waits at .*test_env_capture_cuda.py"
    ):
        for action in actions:
            act(env, action)
    assert torch.randn(3, device="cuda").isfinite().all()


# A capture that CUDA itself ends, as torch does not see the wait; random numbers and other captures must go on.
FAILING = """
import torch
import warp as wp
from softwarp.envs.capture import Capture, CaptureError

wp.init()
device = torch.device("cuda:0")
x = torch.ones(3, device=device)
torch.manual_seed(0)
torch.randn(4, device=device)

def unfit(x):
    torch.cuda.synchronize()
    return {"y": x + 1.0}

capture = Capture(device)
try:
    for _ in range(3):
        capture(unfit, x)
except CaptureError as error:
    print(error)
else:
    raise SystemExit("a wait was recorded")
drawn = torch.randn(4, device=device)
torch.manual_seed(0)
torch.randn(4, device=device)
assert torch.equal(torch.randn(4, device=device), drawn)
capture = Capture(device)
for i in range(4):
    assert capture(lambda x: {"y": 2.0 * x}, i * x)["y"].tolist() == [2.0 * i] * 3
assert capture.is_recorded
"""


def test_a_failed_capture_leaves_torch_in_order():
    """In a process of its own: tried, refused, and random numbers go on where they were."""
    run = subprocess.run([sys.executable, "-c", FAILING], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr


@pytest.mark.parametrize("name", ["Trunk", "CartStemContact"])
def test_rollouts_have_the_same_bits_and_do_not_wait(name):
    """Two rollouts with staggered episodes and a resumed one; no synchronisation before a rollout's end."""
    batches = []
    for capture in (True, False):
        env = make(name, capture=capture, max_episode_steps=6)
        torch.manual_seed(0)
        policy = ActorCritic(Spaces.of(env), NetworkConfig(hidden=[16])).cuda()
        rollout = Rollout(env, policy, 8)
        parts = [rollout.collect().clone()]
        state = rollout.state_dict()
        parts.append(rollout.collect().clone())
        rollout.load_state_dict(state)
        parts.append(rollout.collect().clone())
        batches.append((parts, list(rollout.episodes)))
        if capture:
            action = random_actions(env, 1)[0]
            cut = torch.zeros(N, dtype=torch.bool, device="cuda")
            torch.cuda.synchronize()
            torch.cuda.set_sync_debug_mode("error")
            try:
                for _ in range(3):
                    env.step_and_reset(action, cut)
            finally:
                torch.cuda.set_sync_debug_mode("default")
    assert batches[0][1] == batches[1][1]
    for one, two in zip(batches[0][0], batches[1][0], strict=True):
        for key in one.keys(True, True):
            assert torch.equal(one[key], two[key]), key
