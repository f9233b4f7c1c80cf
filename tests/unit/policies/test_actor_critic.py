"""Networks from specs: shapes, limits, log-probabilities, settings."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Normal
from torchrl.data import Bounded, Categorical, Composite, OneHot, Unbounded

from softwarp.policies.actor_critic import ActorCritic
from softwarp.policies.policy import NetworkConfig, Spaces, mlp


class Env:
    """Only the specs of an environment."""

    def __init__(self, action_spec, size=5):
        self.action_spec_unbatched = action_spec
        self.observation_spec = Composite(observation=Unbounded((3, size)), shape=(3,))


def make(spaces, **options):
    torch.manual_seed(0)
    return ActorCritic(spaces, NetworkConfig(**({"hidden": [8]} | options)))


def test_spaces_are_read_from_specs():
    """Sizes and limits of a vector, number of choices of the others."""
    limits = torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 4.0])
    assert Spaces.of(Env(Bounded(*limits, (2,)))) == Spaces(5, 2, (-1.0, 0.0), (1.0, 4.0))
    assert Spaces.of(Env(Categorical(16))) == Spaces(5, 16)
    assert Spaces.of(Env(OneHot(16))) == Spaces(5, 16, is_one_hot=True)


@pytest.mark.parametrize("spec", [Unbounded((2,)), Bounded(-1.0, 1.0, (2, 2)), Bounded(-math.inf, 1.0, (2,))])
def test_other_actions_are_refused(spec):
    """No limits, or more than a vector: the message says what is needed."""
    with pytest.raises(ValueError, match="must be a Bounded vector with finite limits or one choice"):
        Spaces.of(Env(spec))


def test_actions_stay_within_their_limits():
    """u = -1, 0, 1 and beyond map to low, centre and high."""
    policy = make(Spaces(3, 2, (-1.0, 0.0), (1.0, 4.0)))
    samples = torch.tensor([[-1.0, -1.0], [0.0, 0.0], [1.0, 1.0], [9.0, -9.0]])
    expected = torch.tensor([[-1.0, 0.0], [0.0, 2.0], [1.0, 4.0], [1.0, 0.0]])
    torch.testing.assert_close(policy.to_env(samples), expected)


def test_log_probability_is_that_of_independent_normals():
    """log p(u) is the sum over entries of log N(u_i | mean_i, std)."""
    policy = make(Spaces(3, 2, (-1.0, -1.0), (1.0, 1.0)), initial_std=0.3)
    observation, sample = torch.randn(7, 3), torch.randn(7, 2)
    mean = policy.actor[0].module.body(observation)
    expected = Normal(mean, 0.3).log_prob(sample).sum(-1)
    torch.testing.assert_close(policy.distribution(observation).log_prob(sample), expected)


def test_first_policy_does_hardly_anything():
    """The last layer starts small: a zero-mean policy, whatever the observation."""
    policy = make(Spaces(3, 2, (-1.0, -1.0), (1.0, 1.0)))
    assert policy.act(torch.randn(50, 3)).abs().max() < 0.1


@pytest.mark.parametrize(
    ("spaces", "shape", "dtype"),
    [
        (Spaces(3, 2, (-1.0, -1.0), (1.0, 1.0)), (6, 2), torch.float32),
        (Spaces(3, 4), (6,), torch.int64),
        (Spaces(3, 4, is_one_hot=True), (6, 4), torch.int64),
    ],
)
def test_policy_writes_an_action_for_torchrl(spaces, shape, dtype):
    """Called on a TensorDict it writes the deterministic action."""
    policy = make(spaces)
    observation = torch.randn(6, 3)
    written = policy(TensorDict({"observation": observation}, [6]))["action"]
    assert written.shape == shape
    assert written.dtype == dtype
    assert torch.equal(written, policy.act(observation))
    assert policy.value(observation).shape == (6, 1)


def test_loss_network_and_policy_agree():
    """The actor that the loss sees on scaled observations is the policy on raw ones."""
    policy = make(Spaces(3, 2, (-1.0, -1.0), (1.0, 1.0)))
    policy.observation_norm.update(3.0 + 2.0 * torch.randn(500, 3))
    observation = 3.0 + 2.0 * torch.randn(4, 3)
    scaled = TensorDict({"observation": policy.observation_norm(observation)}, [4])
    torch.testing.assert_close(policy.actor.get_dist(scaled).mean, policy.distribution(observation).mean)


def test_orthogonal_layers():
    """Rows of a square layer are orthogonal with the gain's length; biases are zero."""
    layer = mlp([4, 4, 2], torch.nn.Tanh, last_gain=0.01)[0]
    torch.testing.assert_close(layer.weight @ layer.weight.T, 2.0 * torch.eye(4), atol=1e-5, rtol=0.0)
    assert layer.bias.abs().max() == 0.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"activation": "swish"}, "network.activation: 'swish' is unknown; choose from elu, relu"),
        ({"hidden": []}, "network.hidden: needs layers"),
        ({"hidden": [16, 0]}, "network.hidden: needs layers"),
        ({"initial_std": 0.0}, "network.initial_std: must lie in"),
    ],
)
def test_bad_networks_are_refused(options, message):
    """The message names setting, value and requirement."""
    with pytest.raises(ValueError, match=message):
        NetworkConfig(**options)
