"""Sensors of environments: specs, finite numbers, worlds apart from each other, names; observations stay."""

import dataclasses

import gymnasium
import pytest
import torch

import softwarp as sw
from softwarp import gym  # noqa: F401 (registers the ids)
from softwarp.envs.options.base import SENSORS
from softwarp.envs.sensors import READ

SOME = ("stress", "strain", "reaction", "energy", "cable_tension")


def trunk(worlds: int, sensors: tuple[str, ...] = SOME, device: str = "cpu", **options):
    options = {"mesh": "coarse", "solver_path": "scalar", "seed": 3, "sensors": sensors, **options}
    return sw.make("Trunk", num_worlds=worlds, device=device, **options)


def played(env, actions: torch.Tensor):
    """What an environment tells after each of some actions, key -> (step, world, ...)."""
    env.reset()
    told = [env.step(env.rand_action().set("action", action.to(env.device)))["next"].cpu() for action in actions]
    return {key: torch.stack([one[key] for one in told]) for key in sorted(told[0].keys())}


def test_every_sensor_is_declared_and_read():
    """The table of options and that of functions have the same names."""
    assert list(SENSORS) == list(READ)


def test_sensors_beside_the_observation():
    """In the specs, finite, moving; the same bits for a world alone; all other keys as without sensors."""
    several, plain, alone = trunk(3), trunk(3, ()), trunk(1)
    generator = torch.Generator().manual_seed(0)
    actions = torch.rand(3, 3, several.action_spec.shape[-1], generator=generator) * 2.0 - 1.0
    told, bare = played(several, actions), played(plain, actions)
    single = played(alone, actions[:, :1])
    assert set(told) - set(bare) == set(SOME)
    for key, value in bare.items():
        assert torch.equal(told[key], value), key
    for name in SOME:
        spec = several.observation_spec[name]
        assert spec.shape == told[name].shape[1:] and told[name].dtype == torch.float32
        assert bool(torch.isfinite(told[name]).all()) and bool(told[name][-1].any()), name
        assert torch.equal(told[name][:, :1], single[name]), name
    assert bool((told["stress"][..., 0] >= told["stress"][..., 1]).all())


def test_failed_worlds_keep_the_last_good_numbers():
    """A world that fails tells what it told before; the others go on."""
    env = trunk(2)
    before = played(env, torch.full((2, 2, env.action_spec.shape[-1]), 0.3))
    env.sim.control.node_force[1] = float("nan")
    after = env.step(env.rand_action())["next"]
    assert after["world_status"].flatten().tolist() == [sw.Status.OK, sw.Status.NONFINITE]
    for name in SOME:
        assert torch.equal(after[name][1], before[name][-1, 1]) and not torch.equal(after[name][0], before[name][-1, 0])


def test_contact_and_joint_sensors_and_gymnasium():
    """Forces of pairs in a scene with contact; Gymnasium has sensors in its infos."""
    env = sw.make("CartStemContact", num_worlds=2, seed=0, sensors=("contact_force", "reaction"))
    told = env.reset()
    pairs = env.sim.model.pair_count
    assert told["contact_force"].shape == (2, 3 * pairs)
    wide = gymnasium.make_vec("softwarp/CartStem-v0", num_envs=2, sensors=["energy"])
    _, info = wide.reset(seed=1)
    assert info["energy"].shape == (2, 2) and info["_energy"].all()
    single = gymnasium.make("softwarp/CartStem-v0", sensors=("energy",))
    _, info = single.reset(seed=1)
    assert info["energy"].shape == (2,)


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        (("stres",), r"TrunkConfig: sensors: unknown sensor 'stres'; did you mean 'stress'"),
        (("energy", "energy"), "sensors: 'energy' is there twice"),
        ("stress", "sensors must be a tuple or a list"),
        ((3,), r"sensors\[0\] must be a text, got 3"),
        (
            ("cavity_pressure",),
            "Trunk: sensors: 'cavity_pressure' has nothing to tell, as the scene has no cavity; it",
        ),
    ],
)
def test_bad_names(sensors, message):
    """With the nearest name, and what the scene has."""
    with pytest.raises(ValueError, match=message):
        trunk(1, sensors)


@pytest.mark.cuda
def test_captured_sensors():
    """Steps with all sensors of a scene are replayed as a graph, with the numbers of steps that are not."""
    names = (*SOME, "cable_length")
    captured, plain = trunk(8, names, "cuda:0", capture=True), trunk(8, names, "cuda:0", capture=False)
    assert dataclasses.asdict(captured.config)["sensors"] == names
    actions = torch.rand(5, 8, captured.action_spec.shape[-1]) * 2.0 - 1.0
    one, other = played(captured, actions), played(plain, actions)
    assert "_captured_step" in captured.captures.recorded
    for name in names:
        torch.testing.assert_close(one[name], other[name], rtol=1e-5, atol=1e-6)
