"""Worlds on several devices behind one call: the episodes and fits are those of one device."""

import json

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import cli
from softwarp.envs import registry
from softwarp.envs.split import SplitEnv
from softwarp.identification import Parameter, Worlds, fit, side_by_side
from softwarp.policies.actor_critic import ActorCritic
from softwarp.policies.baselines import scripted
from softwarp.policies.baselines.table import RULES
from softwarp.policies.policy import NetworkConfig, Spaces
from softwarp.training.evaluation import run_episodes

WORLDS, EPISODES = 7, 11  # odd, and a second batch of which a part is wanted


def make(device, worlds):
    return registry.make("CartPole", num_worlds=worlds, device=device, max_episode_steps=25, solver_path="lanes")


def trained(env):
    torch.manual_seed(1)
    return ActorCritic(Spaces.of(env), NetworkConfig(hidden=[16], recurrent=4))


def test_episodes_on_two_devices_are_those_of_one():
    """["cpu", "cpu"] with 4 and 3 worlds: a network with memory, random actions and a rule that knows its worlds."""
    whole, split = make("cpu", WORLDS), SplitEnv(make, ["cpu", "cpu"], WORLDS)
    assert [part.num_worlds for part in split.parts] == [4, 3]
    rule = next(iter(RULES["CartPole"].values()))
    first = split.parts[0]
    pairs = [(trained(whole), trained(first)), (rule(whole), split.split(rule))]
    pairs += [tuple(scripted.random(Spaces.of(env), 3) for env in (whole, first))]
    found = []
    for alone, shared in pairs:
        one = run_episodes(whole, alone, seed=5, episodes=EPISODES)
        other = run_episodes(split, shared, seed=5, episodes=EPISODES)
        for name, column in vars(one).items():
            assert torch.equal(column.nan_to_num(), getattr(other, name).nan_to_num()), name
        found.append(one.returns)
    assert not torch.equal(found[0], found[2])  # the policies do differ
    assert len(set(found[2].tolist())) > WORLDS  # and so do the episodes


def test_more_devices_than_worlds_are_refused():
    """Every device needs a world."""
    with pytest.raises(ValueError, match="devices: 2 for 1 worlds; give each a world at least"):
        SplitEnv(make, ["cpu", "cpu"], 1)


def test_identification_on_two_devices_is_that_of_one():
    """The modulus of a sagging rod from where its end rests, 4 and 5 candidates beside each other: the same bits."""
    parameter = Parameter("youngs", 1e5, 1e6, scale="log", unit="Pa", target="rod_youngs", item=0)

    def model(candidates, target=0.0):
        builder = sw.ModelBuilder()
        points = np.linspace((0, 0, 0), (0.2, 0, 0), 9)
        rod = builder.add_rod(points, radius=0.005, youngs=4e5, nu=0.49, density=1000.0, rayleigh=(4.0, 0.0))
        builder.fix(rod, nodes=[0])
        sim = sw.Simulation(builder.finalize(num_worlds=candidates), dt=0.05)
        worlds = Worlds(sim, [parameter])

        def residuals(values):
            sim.reset()
            worlds.write(values)
            sim.step(40)
            return worlds.gather(sim.rod_x[:, -1]) - target

        return residuals, worlds.candidates

    target = model(4)[0](np.full((4, 1), 3e5))[0]
    found = []
    for counts in ((9,), (4, 5)):
        residuals, batch = side_by_side([model(count, target) for count in counts])
        assert batch == 9
        found.append(fit([parameter], residuals, batch=batch, samples=8))
    assert found[0].values == found[1].values
    assert found[0].covariance.tolist() == found[1].covariance.tolist()
    assert abs(found[0].values["youngs"] / 3e5 - 1.0) < 1e-3
    with pytest.raises(ValueError, match="3 candidates for 9; call fit with batch=9"):
        residuals(np.full((3, 1), 4e5))


def test_the_command_divides_worlds(tmp_path):
    """softwarp eval devices=[cpu,cpu]: the summary of one device, of a rule that looks at its worlds."""
    told = []
    for extra in ([], ["devices=[cpu,cpu]"]):
        file = tmp_path / f"{len(extra)}.json"
        words = ["env=cart_pole", "policy=scripted", "env.max_episode_steps=20", "episodes=9", "num_worlds=8", *extra]
        assert cli.main(["eval", *words, "--json", str(file)]) == 0
        told.append(json.loads(file.read_text())["policies"])
    assert told[0] == told[1]
    assert told[0]["scripted"]["episodes"] == 9
