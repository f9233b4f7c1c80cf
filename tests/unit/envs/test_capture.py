"""Captured calls on a CPU: fixed tensors, copies that stay, what can be recorded; all but the graphs."""

import contextlib
import threading
import warnings

import pytest
import torch

from softwarp import interop
from softwarp.envs.capture import Capture, CaptureError, Captures, Packed, waits_for_device
from tests.env_replays import act, assert_equal, collected, fused, random_actions, stepped
from tests.unit.envs.fake import PointConfig, PointEnv

N = 4
CPU = torch.device("cpu")


def make(*, captured=True, **options):
    """With the path of captured steps, which a CPU takes on request only."""
    env = PointEnv(PointConfig(**options), num_worlds=N, seed=3)
    env.captures.are_on = captured
    return env


def test_packed_tensors_keep_type_shape_and_bits():
    parts = {
        "flag": torch.tensor([[True], [False], [True]]),
        "count": torch.tensor([1, -2, 2**40]),
        "reward": torch.tensor([[0.1, -0.0], [torch.nan, 3.0]]).t(),
        "status": torch.tensor([3], dtype=torch.int32),
        "phase": torch.tensor([[0.1]], dtype=torch.float64),
    }
    packed = Packed(parts)
    packed.write(parts)
    copies = packed.copy()
    packed.write({name: torch.zeros_like(part) for name, part in parts.items()})
    for name, part in parts.items():
        assert copies[name].dtype == part.dtype
        torch.testing.assert_close(copies[name], part, rtol=0.0, atol=0.0, equal_nan=True)
        assert not packed.copy()[name].any()
    assert copies["reward"].is_contiguous()
    assert len({part.untyped_storage().data_ptr() for part in copies.values()}) == len(parts)


def test_packed_tensors_of_a_type_share_memory_and_can_be_saved(tmp_path):
    """Files take tensors that share memory if they are of one type."""
    parts = {name: torch.full((3,), i) for i, name in enumerate("abc")} | {"flag": torch.ones(2, dtype=torch.bool)}
    packed = Packed(parts)
    packed.write(parts)
    copies = packed.copy()
    assert len({part.untyped_storage().data_ptr() for part in copies.values()}) == 2
    torch.save(copies, tmp_path / "parts.pt")
    loaded = torch.load(tmp_path / "parts.pt")
    assert all(torch.equal(loaded[name], part) for name, part in parts.items())


def test_arguments_reach_the_function_through_tensors_that_stay():
    """The function sees the same tensors in all calls; results are nobody else's."""
    capture, seen = Capture(CPU), []

    def double(x):
        seen.append(x)
        return {"y": 2.0 * x}

    results = [capture(double, torch.full((3,), float(i)))["y"] for i in range(4)]
    assert all(x is seen[0] for x in seen)
    assert [y.tolist() for y in results] == [[2.0 * i] * 3 for i in range(4)]
    assert not capture.is_recorded


class FakeGraph:
    """Runs the function where a graph would be replayed."""

    def __init__(self, replay):
        self.replay = replay


@pytest.fixture
def recording(monkeypatch):
    """Captures of a GPU that is not there; yields what happens to the mode in which torch warns of waits."""
    modes = [0]

    def record(self, function, results):
        assert modes[-1] == 0
        return FakeGraph(lambda: results.write(function(*self._arguments)))

    monkeypatch.setattr(torch.cuda, "get_sync_debug_mode", lambda: modes[-1])
    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", lambda mode: modes.append({"warn": 1, "default": 0}[mode]))
    monkeypatch.setattr(interop, "on_torch_stream", lambda device: contextlib.nullcontext())
    monkeypatch.setattr(Capture, "_record", record)
    return modes


def wait():
    """What torch does on a GPU where it waits, in the mode in which it warns."""
    warnings.warn("called a synchronizing CUDA operation (Triggered internally)", stacklevel=2)


def test_a_function_is_recorded_after_a_call_without_waits(recording):
    """Watched once; one that waits in its first call only gets a second chance; results are right throughout."""
    for waiting in (0, 1):
        capture, calls = Capture(torch.device("cuda:0")), []

        def function(x, waiting=waiting, calls=calls):
            calls.append(1)
            if len(calls) <= waiting:
                wait()
            return {"y": x + 1.0}

        del recording[1:]
        recorded = []
        for i in range(4):
            assert capture(function, torch.full((2,), float(i)))["y"].tolist() == [i + 1.0] * 2
            recorded.append(capture.is_recorded)
        assert recorded == [i > waiting for i in range(4)]
        assert recording == [0] + [1, 0] * (waiting + 1)


def test_a_function_that_waits_is_not_recorded(recording):
    """The error comes with the third call and names the line."""
    capture = Capture(torch.device("cuda:0"))

    def function(x):
        wait()
        wait()
        return {"y": x}

    for _ in range(2):
        capture(function, torch.ones(1))
    line = function.__code__.co_firstlineno + 1
    with pytest.raises(CaptureError, match=rf"it waits at {__file__}:{line}, {__file__}:{line + 1}$"):
        capture(function, torch.ones(1))


@pytest.mark.filterwarnings("ignore:called a synchronizing")
def test_only_waits_of_this_thread_count_and_other_warnings_pass(recording):
    """Another thread may wait, which is none of our business; what the function warns of is shown as ever."""
    capture = Capture(torch.device("cuda:0"))

    def function(x):
        thread = threading.Thread(target=wait)
        thread.start()
        thread.join()
        warnings.warn("something else", stacklevel=1)
        return {"y": x}

    with pytest.warns(UserWarning, match="something else") as told:
        capture(function, torch.ones(1))
    assert len(told) == 1
    with pytest.warns(UserWarning, match="something else"):
        capture(function, torch.ones(1))
    assert capture.is_recorded


def test_waits_are_left_to_whoever_watches_them_already(recording):
    recording.append(1)
    with pytest.warns(UserWarning, match="synchronizing"), waits_for_device() as places:
        wait()
    assert places == [] and recording == [0, 1]


def test_modes_of_autograd_do_not_mix():
    """First called in inference mode it goes on outside; an argument that requires a gradient leaves no trace."""
    capture = Capture(CPU)
    with torch.inference_mode():
        assert capture(lambda x: {"y": x + 1.0}, torch.zeros(2))["y"].is_inference()
    y = capture(lambda x: {"y": x + 1.0}, torch.ones(2, requires_grad=True))["y"]
    assert not y.requires_grad and not y.is_inference() and y.tolist() == [2.0, 2.0]


def test_an_environment_may_live_in_inference_mode():
    with torch.inference_mode():
        env = make()
        inside = fused(env, random_actions(env, 6))
    assert_equal(inside, fused(make(), random_actions(make(), 6)))


def test_captures_are_made_anew_when_something_else_is_given():
    captures, factor = Captures("Point", CPU, None), [1.0]

    def scaled(x):
        return {"y": factor[0] * x}

    assert captures.run(scaled, torch.ones(1), given=1)["y"].tolist() == [1.0]
    with pytest.raises(ValueError, match=r"scaled: an argument must have shape \(1,\), got \(2,\)"):
        captures.run(scaled, torch.ones(2), given=1)
    assert captures.run(scaled, torch.ones(2), given=2)["y"].tolist() == [1.0, 1.0]


def test_a_function_that_cannot_be_recorded(monkeypatch):
    """Goes on without with a warning, or is an error if captures were asked for."""

    def refuse(self, function, *arguments):
        raise CaptureError("it reads the device back")

    monkeypatch.setattr(Capture, "__call__", refuse)
    captures = Captures("Point", CPU, None)
    with pytest.warns(UserWarning, match="Point: steps are launched part by part from now on; it reads the device"):
        assert captures.run(lambda x: {"y": x}, torch.ones(1), given=0)["y"].tolist() == [1.0]
    assert not captures.are_on
    captures._is_strict = True
    with pytest.raises(CaptureError):
        captures.run(lambda x: {"y": x}, torch.ones(1), given=0)


def test_capture_on_a_cpu_is_refused():
    with pytest.raises(ValueError, match="PointEnv: capture=True needs a CUDA device, this environment is on cpu"):
        PointEnv(PointConfig(capture=True), num_worlds=N)
    assert not PointEnv(PointConfig(), num_worlds=N).captures.are_on


@pytest.mark.parametrize("discrete", [False, True])
def test_captured_steps_have_the_same_bits(discrete):
    """Ways through 30 actions with resets: with and without captures, TorchRL's calls and the fused one."""
    options = {"discrete": discrete, "max_episode_steps": 7}
    actions = random_actions(make(**options), 30)
    plain = stepped(make(captured=False, **options), actions)
    for captured, way in ((True, stepped), (True, collected), (True, fused), (False, collected), (False, fused)):
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message=".*launched part by part")
            assert_equal(way(make(captured=captured, **options), actions), plain)


def test_cut_episodes_are_truncated_and_start_anew():
    envs = [make(), make(captured=False)]
    cut = torch.tensor([True, False, False, True])
    action = torch.full((N, 2), 0.5)
    results = []
    for env in envs:
        env.reset()
        env.step_and_reset(action)
        results.append(env.step_and_reset(action, cut))
        after, now = results[-1]
        assert torch.equal(after["done"][:, 0], cut) and torch.equal(after["truncated"][:, 0], cut)
        assert not after["terminated"].any() and not now["done"].any()
        assert (now["observation"][cut][:, :2] == 0.25).all() and (after["observation"][:, :2] != 0.25).all()
        assert env.step_count.tolist() == [0, 2, 2, 0]
        assert env.pop_episode_log() == {"episodes": 0.0}
    for one, two in zip(*results, strict=True):
        assert_equal([dict(one.items())], [dict(two.items())])


def test_a_terminated_world_is_not_cut():
    env = make(edge=0.5)
    env.reset()
    after, _ = env.step_and_reset(torch.full((N, 2), 3.0), torch.ones(N, dtype=torch.bool))
    assert after["terminated"].all() and not after["truncated"].any()


def test_changed_options_make_captures_anew():
    """Those of the simulation, of an episode and of the configuration; nothing else does."""
    env = make(max_episode_steps=50)
    action = torch.full((N, 2), 0.5)
    env.reset()
    act(env, action)
    for change in (
        lambda: setattr(env.sim, "revision", 1),
        lambda: setattr(env, "max_episode_steps", 3),
        lambda: setattr(env.config, "end_on_success", True),
    ):
        before = env.captures._captures[env]["_captured_step"]
        act(env, action)
        assert env.captures._captures[env]["_captured_step"] is before
        change()
        act(env, action)
        assert env.captures._captures[env]["_captured_step"] is not before


def test_the_log_counts_the_same_episodes():
    logs = []
    for captured in (True, False):
        env = make(captured=captured, max_episode_steps=5)
        fused(env, random_actions(env, 12))
        logs.append(env.pop_episode_log())
    assert logs[0] == logs[1] and logs[0]["episodes"] == 2 * N
