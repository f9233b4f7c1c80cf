"""CatchTheObject: the cart's way, starts, pressures, ends, rewards, options, pictures, files, a policy that catches."""

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from softwarp.envs import registry
from softwarp.envs.tasks.catch_the_object import FARTHEST, CatchTheObjectConfig
from softwarp.policies.baselines.catch_the_object import catch_baseline
from softwarp.training.evaluation import run_episodes


def make(num_worlds=4, seed=1, **options):
    return registry.make("CatchTheObject", num_worlds=num_worlds, seed=seed, **options)


def act(env, action):
    value = torch.full((env.num_worlds, 1), float(action))
    return env.step(TensorDict({"action": value}, batch_size=env.batch_size))["next"]


@pytest.fixture(scope="module")
def env():
    """One environment shared by the tests that reset it themselves."""
    return make()


def test_cart_goes_to_and_fro(env):
    """0.667 s there, 0.26 s of waiting, the same back; the direction changes when it leaves."""
    leg, wait = 0.2 / 0.3, 0.26
    ends = [0.0, 0.5 * leg, leg, leg + wait - 1e-9, leg + wait + 1e-9, 1.5 * leg + wait, 2.0 * leg + 1.5 * wait]
    times = torch.tensor(ends, dtype=torch.float64)
    x, direction = env.cart_place(times)
    np.testing.assert_allclose(x, [-0.1, 0.0, 0.1, 0.1, 0.1, 0.0, -0.1], atol=1e-6)
    assert direction.tolist() == [1.0, 1.0, 1.0, 1.0, -1.0, -1.0, -1.0]
    again, _ = env.cart_place(times + 2.0 * (leg + wait))
    np.testing.assert_allclose(again, x, atol=1e-6)


def test_cart_follows_its_way_in_the_simulation(env):
    """Every sub-step it moves 3 mm, or stands; actions do not matter to it."""
    env.reset()
    before = env.sim.body_pose[:, env.scene.cart, 0].clone()
    for _ in range(12):
        act(env, -1.0)
        after = env.sim.body_pose[:, env.scene.cart, 0].clone()
        expected, direction = env.cart_place(env.phase)
        np.testing.assert_allclose(after, expected, atol=1e-6)
        np.testing.assert_allclose(env.observe()["observation"][:, 3], direction)
        assert ((after - before).abs() <= 0.03 + 1e-6).all()
        before = after


def test_starts_are_drawn_from_their_ranges():
    """Heights of 0.20 to 0.27 m, carts at +-0.10 m, both directions; means and spread of uniform draws."""
    env = make(num_worlds=256, seed=5, settle=False)
    observation = env.reset()["observation"]
    height, _, x, direction, pressure = env.decode(observation).T
    assert height.min() >= 0.20 and height.max() <= 0.27 and x.min() >= -0.10 and x.max() <= 0.10
    for value, low, high in ((height, 0.20, 0.27), (x, -0.10, 0.10), (direction, -1.0, 1.0)):
        spread = (high - low) / math.sqrt(12.0 if value is not direction else 4.0)
        assert abs(value.mean() - 0.5 * (low + high)) < 4.0 * spread / 16.0
        assert abs(value.std() - spread) < 0.15 * spread
    assert (pressure == 0.0).all() and set(direction.tolist()) == {-1.0, 1.0}
    np.testing.assert_allclose(env.sim.body_pose[:, env.scene.ball, 2], height, rtol=1e-6)
    assert (env.sim.body_twist == 0.0).all() and (env.sim.control.body_force == 0.0).all()


def test_pressure_is_reached_in_equal_increments(env):
    """A tenth of the change per sub-step, from where the last action ended."""
    env.reset()
    act(env, 0.0)
    assert env.pressure.tolist() == [150.0e3] * 4
    seen = []
    action = torch.full((4, 1), 0.5)
    for substep in range(10):
        env.apply_action(action, substep)
        seen.append(env.sim.control.cavity_pressure[0].tolist())
    expected = 150.0e3 + 7.5e3 * np.arange(1, 11)
    np.testing.assert_allclose(seen, np.stack([expected, expected], axis=1), rtol=1e-6)


def test_missed_ball_ends_the_episode():
    """Without pressure and with the cart elsewhere the ball passes its bottom in the third or fourth action."""
    env = make(cart_start=(0.08, 0.10), cart_speed=0.01)
    env.reset()
    rewards, ends = [], []
    for _ in range(4):
        data = act(env, -1.0)
        distance = -data["distance"].flatten() / FARTHEST
        ends.append(data["terminated"].flatten())
        rewards.append(data["reward"].flatten())
        np.testing.assert_allclose(rewards[-1], distance - 5.0 * ends[-1].float(), rtol=1e-5)
        assert not data["success"].any()
        below = env.sim.body_pose[:, env.scene.ball, 2] < 0.0
        assert torch.equal(ends[-1], below)
    assert not ends[1].any() and ends[3].all()


def test_caught_ball_ends_the_episode():
    """A slow cart in the middle catches what falls; the bonus comes once, the distance is less than 25 mm."""
    env = make(cart_start=(0.0, 0.01), cart_speed=0.01)
    env.reset()
    for _ in range(4):
        data = act(env, -1.0)
        if data["terminated"].all():
            break
    assert data["success"].all() and (data["distance"] <= 0.025).all()
    np.testing.assert_allclose(data["reward"], 10.0 - data["distance"] / FARTHEST, rtol=1e-5)
    sums = env.episode_sums
    assert (sums["catch"] == 10.0).all() and (sums["miss"] == 0.0).all()


@pytest.mark.slow
def test_paper_reward_favours_dropping():
    """Why the outcome counts by default: SofaGym's return is better for a ball that is let fall than for a catch."""
    returns = {}
    for name in ("drop", "catch"):
        env = make(num_worlds=32, reward="paper", seed=3)
        policy = catch_baseline(env) if name == "catch" else lambda td: td.set("action", -torch.ones(32, 1))
        data = env.rollout(30, policy, break_when_any_done=False)["next"]
        running = data["terminated"].cumsum(dim=1).cumsum(dim=1) <= 1  # up to the first end
        returns[name] = float((data["reward"] * running).sum(dim=1).mean())
    assert -2.5 < returns["drop"] < -1.0 and returns["catch"] < returns["drop"] - 2.0


@pytest.mark.slow
def test_sofagym_s_figures_are_those_of_not_touching_the_ball():
    """With all of its options pads that stay open return about -3, as its agents do, and catching all of them less."""
    env = make(num_worlds=256, config=CatchTheObjectConfig.paper())
    nothing = run_episodes(env, lambda td: td.set("action", -torch.ones(256, 1)), seed=7).summary()
    catching = run_episodes(env, catch_baseline(env), seed=7).summary()
    assert nothing["return"] == pytest.approx(-3.1, abs=0.2) and 0.15 < nothing["success"] < 0.35
    assert catching["return"] == pytest.approx(-4.5, abs=0.2) and catching["success"] > 0.95


def test_sofagym_options():
    """Corner observed, x up to 0.16 m, direction always -x, a miss only once far away, pads without mass."""
    env = make(config=CatchTheObjectConfig.paper())
    data = env.reset()
    cart = env.sim.body_pose[:, env.scene.cart, 0]
    np.testing.assert_allclose(data["observation"][:, 2], (cart - 0.03) / 0.10, rtol=1e-5)
    np.testing.assert_allclose(env.decode(data["observation"])[:, 2], cart, rtol=1e-5)
    assert (data["observation"][:, 3] == -1.0).all()
    x, _ = env.cart_place(torch.linspace(0.0, 3.0, 301, dtype=torch.float64))
    np.testing.assert_allclose([x.min(), x.max()], [-0.10, 0.16])
    assert float(env.sim.mass.sum()) < 1e-6
    for _ in range(8):
        data = act(env, 0.8)
        assert (data["world_status"] == 0).all()
    assert env.reward_names == ("distance", "failure")
    assert (env.sim.body_pose[:, env.scene.ball, 2] > 0.12).all()  # held by 135 kPa


def test_wild_play_fails_nowhere():
    """Pressures from nothing to all at random: no world overflows its contacts or fails, nothing leaves the plane."""
    env = make(num_worlds=32, seed=8)
    env.reset()
    generator = torch.Generator().manual_seed(0)
    for _ in range(16):
        action = torch.randint(0, 2, (32, 1), generator=generator).float() * 2.0 - 1.0
        data = env.step(TensorDict({"action": action}, batch_size=[32]))["next"]
        assert (data["world_status"] == 0).all()
        if data["terminated"].any():
            env.reset_where(data["terminated"].flatten())
    assert env.sim.body_pose[:, env.scene.ball, 1].abs().max() < 1e-4


def test_policy_catches():
    """Hold, wait, let go: at least 95 % of 32 random episodes end in the cart, each after less than 2.5 s."""
    env = make(num_worlds=32, seed=21)
    policy = catch_baseline(env)
    data = env.rollout(26, policy, break_when_any_done=False)["next"]
    ended = data["terminated"][..., 0]
    first = ended.float().argmax(dim=1)
    assert ended.any(dim=1).all() and (first < 25).all()
    caught = data["success"][..., 0][torch.arange(32), first]
    assert caught.float().mean() >= 0.95


def test_picture_and_scene_file(tmp_path):
    """Pads, ball and cart are seen where they are; the USD file holds them with their motion."""
    from pxr import Usd, UsdGeom

    from softwarp.io.trajectory import Recorder
    from softwarp.io.usd import export_usd

    env = make(num_worlds=1, render_width=160, render_height=120)
    env.reset()
    first = env.render()[0]
    recorder = Recorder(env.sim, worlds=[0])
    recorder.capture()
    for _ in range(3):
        act(env, -0.1)
        recorder.capture()
    second = env.render()[0]
    assert first.shape == (120, 160, 3) and (first != second).any(axis=-1).mean() > 0.01
    file = tmp_path / "catch.usda"
    export_usd(recorder.finish(), file)
    stage = Usd.Stage.Open(str(file))
    names = {prim.GetName() for prim in stage.Traverse()}
    assert {"ball", "cart", "left_pad", "right_pad"} <= names
    ball = next(prim for prim in stage.Traverse() if prim.GetName() == "ball")
    heights = [
        UsdGeom.Xformable(ball).ComputeLocalToWorldTransform(time).ExtractTranslation()[2]
        for time in (stage.GetStartTimeCode(), stage.GetEndTimeCode())
    ]
    assert heights[1] < heights[0] - 0.04


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mesh": "corse"}, r"unknown mesh 'corse'; did you mean 'coarse'"),
        ({"reward": "papr"}, r"unknown reward 'papr'; did you mean 'paper'"),
        ({"miss": "under"}, r"unknown miss 'under'"),
        ({"cart_start": (-0.2, 0.1)}, r"cart_start \(-0.2, 0.1\) must lie within cart_range"),
        ({"ball_height": (0.3, 0.2)}, r"ball_height must be \(low, high\)"),
        ({"max_pressure": 0.0}, r"max_pressure must lie in .*, got 0.0"),
        ({"ball_radius": 0.014}, r"ball_radius \+ contact_distance must be less than 0.015 m"),
        ({"density": -1.0}, r"density must lie in .*, got -1.0"),
        ({"cart_wait": -0.1}, r"cart_wait must lie in .*, got -0.1"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)


@pytest.mark.slow  # test_quadratic_parts has the elements, Diamond's tests their option
def test_quadratic_pads():
    """``element="p2"``: the same nodes and those of edges; fronts that travel twice as far; refused by another name."""
    travels = {}
    for element in ("p1", "p2"):
        env = make(num_worlds=1, element=element)
        env.reset()
        front = env.sim.node_x[0, :, 0].abs().argsort()[:12]
        start = env.sim.node_x[0, front].clone()
        for _ in range(3):
            result = act(env, 0.0)
        assert int(result["world_status"]) == 0
        travels[element] = float((env.sim.node_x[0, front] - start).norm(dim=1).max())
    assert env.sim.model.quadratic_count == 576
    assert travels["p2"] > 1.7 * travels["p1"]
    with pytest.raises(ValueError, match=r"unknown element .p3.; did you mean .p2. or .p1"):
        make(element="p3")
