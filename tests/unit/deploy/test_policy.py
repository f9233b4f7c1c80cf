"""Trained policies as functions: one observation or many, arrays and tensors, memory, draws, refusals."""

from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict

import softwarp
from softwarp.deploy.export import compare, export, load_exported
from softwarp.deploy.policy import LoadedPolicy
from softwarp.training.checkpoints import CheckpointError

RUNS = Path(__file__).parents[2] / "data" / "before_the_move"  # of CartPole: choices; continuous; with memory
KINDS = ["ppo", "sac", "memory"]
ENDINGS = [".pt2", pytest.param(".onnx", marks=pytest.mark.slow)]


@pytest.fixture(params=KINDS)
def policy(request) -> LoadedPolicy:
    return softwarp.load_policy(RUNS / request.param)


def observations(rows: int) -> np.ndarray:
    return np.random.default_rng(rows).standard_normal((rows, 4)).astype(np.float32)


def test_every_form_of_an_observation_gives_the_same_action(policy):
    """Rows alone and together, arrays, lists, tensors, mappings, TensorDicts: what the network says."""
    seen = observations(5)
    expected = policy.network.act(torch.from_numpy(seen)).numpy()
    told = [seen, seen.tolist(), {"observation": seen, "success": np.zeros(5)}]
    for given in told:
        policy.reset()
        np.testing.assert_array_equal(policy(given), expected)
    policy.reset()
    assert torch.equal(policy(torch.from_numpy(seen)), torch.from_numpy(expected))
    data = policy(TensorDict({"observation": torch.from_numpy(seen)}, [5]))
    np.testing.assert_array_equal(data["action"], expected)
    for row, action in zip(seen, expected, strict=True):
        policy.reset()
        alone = policy(row)
        assert alone.shape == action.shape and alone.dtype == action.dtype
        np.testing.assert_allclose(alone, action, atol=1e-6)


def test_memory_lasts_until_a_reset():
    """The second action of an episode is that of the network with its memory; a reset forgets, a mask some rows."""
    policy = softwarp.load_policy(RUNS / "memory")
    seen = torch.from_numpy(observations(3))
    first, second = policy(seen), policy(seen)
    features, _ = policy.network.features(seen, policy.network.features(seen)[1])
    assert torch.equal(second, policy.network.to_env(policy.network.greedy(features))) and not first.equal(second)
    policy.reset(np.array([True, False, False]))
    third = policy(seen)
    torch.testing.assert_close(third[0], first[0])
    assert not torch.allclose(third[1:], second[1:], atol=1e-7, rtol=0.0)
    with pytest.raises(ValueError, match="remembers 3 rows, got 1; call reset"):
        policy(seen[0])
    with pytest.raises(ValueError, match="bool of shape"):
        policy.reset([True])
    policy.reset()
    assert policy.is_recurrent and torch.equal(policy(seen), first)


def test_draws_are_repeatable_and_disturb_nobody():
    """Actions that are drawn follow the policy's own seed, and leave Torch's numbers alone."""
    seen = observations(64)
    drawn = []
    for _ in range(2):
        policy = softwarp.load_policy(RUNS / "ppo", deterministic=False, seed=3)
        torch.manual_seed(7)
        drawn.append((policy(seen), policy(seen)))
        after = torch.rand(3)
        torch.manual_seed(7)
        assert torch.equal(after, torch.rand(3))
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert (drawn[0][0] != drawn[0][1]).any()


def test_it_acts_in_the_environment_that_it_was_trained_in(policy):
    """``policy.env`` makes that environment; TorchRL's rollouts take the policy as it is."""
    env = softwarp.make(**policy.env, num_worlds=2, seed=0)
    data = env.rollout(3, policy)
    assert env.action_spec.is_in(data["action"][:, 0])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (np.zeros(5), r"must have shape \(4,\) or \(n, 4\), got \(5,\)"),
        (np.zeros((1, 1, 4)), "must have shape"),
        ([0.0, np.nan, 0.0, 0.0], "must be finite; row 0 has nan at 1"),
        ({"state": np.zeros(4)}, "needs 'observation', got state"),
    ],
)
def test_bad_observations_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        softwarp.load_policy(RUNS / "ppo")(given)


def test_what_is_no_run_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match="no such folder"):
        softwarp.load_policy(tmp_path / "nowhere")


@pytest.mark.parametrize("ending", ENDINGS)
def test_exported_files_act_as_the_policy_does(policy, ending, tmp_path):
    """Single rows, batches and, with memory, sequences; the file says what it takes and gives."""
    pytest.importorskip("onnxruntime" if ending == ".onnx" else "torch")
    assert export(policy, tmp_path / f"policy{ending}") < 1e-5
    exported = load_exported(tmp_path / f"policy{ending}")
    for seen in (observations(1)[0], observations(7)):
        policy.reset(), exported.reset()
        for _ in range(3):
            np.testing.assert_allclose(exported(seen), policy(seen), atol=1e-6)
    about = exported.about
    assert about["env"] == policy.env and about["control_period"] == pytest.approx(0.01)
    assert about["observation"]["size"] == len(about["observation"]["low"]) == 4
    assert about["action"].get("high", []) == list(policy.spaces.high)
    with pytest.raises(ValueError, match="must have shape"):
        exported(np.zeros(3))


def test_a_file_that_acts_differently_is_not_kept(tmp_path, monkeypatch):
    """The comparison notices a scaling that was left out, and nothing stands where the file would have."""
    policy = softwarp.load_policy(RUNS / "sac")
    export(policy, tmp_path / "good.pt2")
    before = (tmp_path / "good.pt2").read_bytes()
    other = softwarp.load_policy(RUNS / "sac")
    other.network.observation_norm.var.mul_(4.0)
    assert compare(other, load_exported(tmp_path / "good.pt2")) > 1e-3
    monkeypatch.setattr("softwarp.deploy.export.compare", lambda *_: float("nan"))
    with pytest.raises(ValueError, match="differ from the policy's by nan; it is not kept"):
        export(policy, tmp_path / "good.pt2")
    assert (tmp_path / "good.pt2").read_bytes() == before


def test_wrong_files_and_missing_packages_are_told(tmp_path, monkeypatch):
    policy = softwarp.load_policy(RUNS / "ppo")
    with pytest.raises(ValueError, match=r"must be one of .onnx, .pt2"):
        export(policy, tmp_path / "policy.pt")
    with pytest.raises(ValueError, match="no such file"):
        load_exported(tmp_path / "policy.pt2")
    foreign = torch.export.export(torch.nn.Linear(2, 2), (torch.zeros(1, 2),))
    torch.export.save(foreign, tmp_path / "foreign.pt2")
    with pytest.raises(ValueError, match="not written by softwarp"):
        load_exported(tmp_path / "foreign.pt2")
    monkeypatch.setitem(__import__("sys").modules, "onnxruntime", None)
    with pytest.raises(ImportError, match=r"pip install 'softwarp\[onnx\]'"):
        export(policy, tmp_path / "policy.onnx")
    assert not (tmp_path / "policy.onnx").exists()
