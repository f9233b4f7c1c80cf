"""Checkpoint files: whole or not there, plain content, clear errors."""

import pickle
import warnings

import pytest
import torch

from softwarp.policies.actor_critic import ActorCritic
from softwarp.policies.policy import NetworkConfig, Spaces
from softwarp.policies.soft_actor import SoftActor
from softwarp.training.checkpoints import (
    CheckpointError,
    CheckpointFolder,
    build_policy,
    hold,
    load,
    load_policy,
    policy_content,
    save,
    take_over,
)

SPACES = Spaces(3, 2, (-1.0, 0.0), (1.0, 4.0))


@pytest.fixture
def policy():
    torch.manual_seed(0)
    return ActorCritic(SPACES, NetworkConfig(hidden=[4]))


def test_policy_survives_a_file(policy, tmp_path):
    """A rebuilt policy acts like the saved one, its observation statistics included."""
    policy.observation_norm.update(5.0 + torch.randn(100, 3))
    save(tmp_path / "best.pt", "policy", policy_content(policy))
    again = build_policy(load(tmp_path / "best.pt"))
    observation = 5.0 + torch.randn(7, 3)
    assert torch.equal(again.act(observation), policy.act(observation))
    assert again.spaces == SPACES


def test_only_the_last_are_kept(tmp_path):
    """The newest ``keep`` stay, by step and not by time of writing."""
    folder = CheckpointFolder(tmp_path, keep=2)
    for step in (100, 20000, 3000):
        folder.save(step, {"step": step})
    assert [path.name for path in folder.files()] == ["step_000000003000.pt", "step_000000020000.pt"]
    assert folder.load_latest()["step"] == 20000


def test_no_scratch_file_is_left(tmp_path):
    """What cannot be saved leaves the old file and nothing else."""
    save(tmp_path / "a.pt", "policy", {"x": 1})
    with pytest.raises((AttributeError, pickle.PicklingError)):
        save(tmp_path / "a.pt", "policy", {"x": lambda: 0})
    assert load(tmp_path / "a.pt")["x"] == 1
    assert [path.name for path in tmp_path.iterdir()] == ["a.pt"]


@pytest.mark.parametrize("part", [0.0, 0.1, 0.5, 0.99])
def test_cut_file_falls_back_to_the_one_before(tmp_path, part):
    """A truncated newest checkpoint is passed over with a warning."""
    folder = CheckpointFolder(tmp_path, keep=3)
    folder.save(1, {"x": torch.zeros(1000)})
    newest = folder.save(2, {"x": torch.ones(1000)})
    whole = newest.read_bytes()
    newest.write_bytes(whole[: int(part * len(whole))])
    with pytest.warns(UserWarning, match="step_000000000002.pt: cut short or not a checkpoint.*using the one before"):
        assert folder.load_latest()["x"].sum() == 0.0


def test_altered_byte_is_noticed(tmp_path):
    """One flipped byte in the numbers fails the checksum."""
    path = tmp_path / "a.pt"
    save(path, "policy", {"x": torch.full((1000,), 0.5)})
    content = bytearray(path.read_bytes())
    at = content.find(torch.full((4,), 0.5).numpy().tobytes()) + 100
    content[at] ^= 0xFF
    path.write_bytes(bytes(content))
    with pytest.raises(CheckpointError, match="damaged in"):
        load(path)


def test_foreign_files_are_refused(tmp_path):
    """Another program's archive, a pickle with code, a newer version and a missing file each say what is wrong."""
    torch.save({"model": torch.zeros(2)}, tmp_path / "other.pt")
    torch.save({"x": print}, tmp_path / "code.pt")
    torch.save({"format": "softwarp checkpoint", "version": 99, "kind": "policy"}, tmp_path / "newer.pt")
    (tmp_path / "text.pt").write_text("hello")
    for name, message in {
        "other.pt": "not written by softwarp",
        "code.pt": "not written by softwarp",
        "newer.pt": "format version 99, this softwarp reads 1; update it",
        "text.pt": "cut short or not a checkpoint",
        "missing.pt": "no such file",
    }.items():
        with pytest.raises(CheckpointError, match=message):
            load(tmp_path / name)


def test_newer_checkpoints_are_not_passed_over(tmp_path):
    """The last one is of a later version: going on from the first would end in its removal."""
    folder = CheckpointFolder(tmp_path, keep=2)
    for steps in (10, 20):
        folder.save(steps, {"steps": steps})
    newest = folder.files()[-1]
    torch.save(torch.load(newest, weights_only=True) | {"version": 99}, newest)
    with pytest.raises(CheckpointError, match="format version 99, this softwarp reads 1; update it"):
        folder.load_latest()
    assert newest.is_file() and len(folder.files()) == 2


def test_a_run_has_one_writer(tmp_path):
    """A second one is refused while the first is at work; readers leave its scratch files alone."""
    folder = CheckpointFolder(tmp_path / "checkpoints", keep=1)
    folder.save(1, {"x": 1})
    scratch = tmp_path / "checkpoints" / ".step_000000000002.0123456789ab.pt"
    scratch.write_bytes(b"half")
    with hold(tmp_path):
        with pytest.raises(CheckpointError, match="another process trains there; stop it first"), hold(tmp_path):
            raise AssertionError
        assert load_policy(tmp_path)["x"] == 1
        assert scratch.exists()
    with hold(tmp_path):
        folder.sweep()
    assert not scratch.exists()


def test_nothing_to_load_says_so(tmp_path):
    """An empty run, and one whose checkpoints are all broken."""
    with pytest.raises(CheckpointError, match="it holds no checkpoint yet"):
        CheckpointFolder(tmp_path / "checkpoints", keep=1).load_latest()
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "step_000000000001.pt").write_bytes(b"")
    with warnings.catch_warnings(), pytest.raises(CheckpointError, match="none of its 1 checkpoints can be read"):
        warnings.simplefilter("ignore")
        CheckpointFolder(tmp_path / "checkpoints", keep=1).load_latest()
    with pytest.raises(CheckpointError, match="no such folder or checkpoint"):
        load_policy(tmp_path / "nowhere")


def test_best_policy_is_preferred_and_replaced_if_broken(policy, tmp_path):
    """A run folder stands for its best policy; a broken one for the newest training checkpoint."""
    folder = CheckpointFolder(tmp_path / "checkpoints", keep=1)
    folder.save(5, {"step": 5, **policy_content(policy)})
    save(tmp_path / "best.pt", "policy", policy_content(policy))
    assert load_policy(tmp_path)["kind"] == "policy"
    (tmp_path / "best.pt").write_bytes(b"PK")
    with pytest.warns(UserWarning, match="using the newest training checkpoint"):
        assert load_policy(tmp_path)["kind"] == "training"


def test_warm_start_acts_like_the_trained_policy(policy, tmp_path):
    """Networks and the scale of observations are taken over; a first deviation may be asked for that was another."""
    policy.observation_norm.update(5.0 + torch.randn(100, 3))
    save(tmp_path / "best.pt", "policy", policy_content(policy))
    torch.manual_seed(1)
    new = ActorCritic(SPACES, NetworkConfig(hidden=[4], initial_std=0.1))
    observation = 5.0 + torch.randn(7, 3)
    assert not torch.equal(new.act(observation), policy.act(observation))
    take_over(new, tmp_path)
    new.observation_norm.update(torch.randn(100, 3))  # which would take from the networks what they know
    assert torch.equal(new.act(observation), policy.act(observation))


def test_warm_start_of_another_shape_is_refused(policy, tmp_path):
    """Kind, spaces and networks are compared, and named."""
    save(tmp_path / "best.pt", "policy", policy_content(policy))
    small = NetworkConfig(hidden=[4])
    for other, match in (
        (ActorCritic(Spaces(5, 2, (-1.0, 0.0), (1.0, 4.0)), small), r"observation and action is .*3.*this run's .*5"),
        (ActorCritic(SPACES, NetworkConfig(hidden=[8])), r"network is .*\[4\].*this run's .*\[8\]"),
        (SoftActor(SPACES, small), "kind of policy is actor_critic, this run's"),
    ):
        with pytest.raises(CheckpointError, match=match):
            take_over(other, tmp_path)


def test_policy_that_does_not_fit_is_refused(policy):
    """Numbers of another network are not forced into this one."""
    content = policy_content(policy)
    content["network"]["hidden"] = [8]
    with pytest.raises(CheckpointError, match="cannot be rebuilt"):
        build_policy(content)


def _broken(content, key, value):
    return content | {key: value}


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("spaces", None),
        ("spaces", ["a"]),
        ("spaces", {"observation_size": -1, "action_size": 2}),
        ("spaces", {"observation_size": "3", "action_size": 2}),
        ("network", None),
        ("network", {"hidden": ["a"]}),
        ("network", {"hidden": [4], "activation": "none"}),
        ("policy", None),
        ("policy", [1, 2]),
        ("policy", {}),
        ("policy_kind", "nobody"),
        ("policy_kind", ["a"]),
    ],
)
def test_odd_fields_are_one_error(policy, key, value):
    """Whatever stands in a checkpoint instead of a policy."""
    with pytest.raises(CheckpointError, match="its policy cannot be rebuilt"):
        build_policy(_broken(policy_content(policy), key, value))


def test_weights_that_are_not_finite_are_refused(policy):
    """They would act with nan from the first step on."""
    content = policy_content(policy)
    name = next(name for name, value in content["policy"].items() if value.is_floating_point() and value.dim() == 2)
    content["policy"][name][0, 0] = torch.nan
    with pytest.raises(CheckpointError, match=f"{name} of its policy is not finite"):
        build_policy(content)
