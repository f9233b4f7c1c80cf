"""BubbleMotion: starts and goals, pressures, ends, rewards, options, pictures, files, a policy that rolls the ball."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from softwarp.envs import registry
from softwarp.envs.options.bubble_motion import BubbleMotionConfig
from softwarp.policies.baselines.bubble_motion import bubble_baseline
from softwarp.policies.baselines.scripted import random
from softwarp.policies.policy import Spaces
from softwarp.training.evaluation import run_episodes


def make(num_worlds=4, seed=1, **options):
    return registry.make("BubbleMotion", num_worlds=num_worlds, seed=seed, **options)


def act(env, action):
    """One action, the same in all worlds: a number, nine numbers, or a choice."""
    if env.action_count:
        value = torch.full((env.num_worlds,), int(action))
    else:
        value = torch.as_tensor(action, dtype=torch.float32).expand(env.num_worlds, 9).clone()
    return env.step(TensorDict({"action": value}, batch_size=env.batch_size))["next"]


@pytest.fixture(scope="module")
def env():
    """One environment shared by the tests that reset it themselves."""
    return make()


def test_starts_and_goals_are_where_the_ball_can_be():
    """Both within +-30 mm, at least 15 mm apart; means of 256 uniform draws within four of their deviations."""
    env = make(num_worlds=256, seed=5, settle=False)
    seen = env.decode(env.reset()["observation"])
    start, goal = seen["ball"], seen["goal"]
    assert float(start.abs().max()) <= 0.030 + 1e-6 and float(goal.abs().max()) <= 0.030 + 1e-6
    assert float((goal - start).norm(dim=1).min()) >= 0.015 - 1e-6
    assert float(start.mean(dim=0).abs().max()) < 4.0 * 0.06 / np.sqrt(12.0) / 16.0
    np.testing.assert_allclose(start, env.sim.body_pose[:, env.scene.ball, :2], atol=1e-7)
    np.testing.assert_allclose(goal, env.goal_points()[:, :2], atol=1e-7)
    np.testing.assert_allclose(env.sim.body_pose[:, env.scene.ball, 2], 0.021, atol=1e-7)
    assert (env.sim.body_twist == 0.0).all() and (env.sim.control.body_force == 0.0).all()
    assert (seen["pressure"] == 0.0).all()


def test_every_goal_that_is_far_enough_is_drawn_alike():
    """Least ways that leave a corner only still end: the farthest corner is taken where no draw is far enough."""
    env = make(num_worlds=8, seed=2, settle=False, start_range=(0.0, 0.0), least_way=0.0424)
    env.reset()
    np.testing.assert_allclose(env.goal[:, :2].abs(), 0.030, atol=3e-4)
    near = make(num_worlds=128, seed=2, settle=False, start_range=(0.0, 0.0), least_way=0.0)
    near.reset()
    assert float(near.goal[:, :2].norm(dim=1).min()) < 0.006


def test_pressures_are_pascal_and_reached_in_equal_increments(env):
    """A twentieth of the change per sub-step, from where the last action ended; twice the sub-steps, the same end."""
    env.reset()
    act(env, 0.0)
    assert (env.pressure == 150.0e3).all()
    seen = []
    action = torch.linspace(-1.0, 1.0, 9).expand(4, 9)
    for substep in range(20):
        env.apply_action(action, substep)
        seen.append(env.sim.control.cavity_pressure[0].tolist())
    share = np.arange(1, 21)[:, None] / 20.0
    expected = 150.0e3 + share * (np.linspace(0.0, 300.0e3, 9) - 150.0e3)
    np.testing.assert_allclose(seen, expected, rtol=1e-5, atol=0.1)
    finer = make(num_worlds=1, dt=0.005, action_repeat=40)
    finer.reset()
    act(finer, 0.0)
    np.testing.assert_allclose(finer.sim.cavity_pressure, 150.0e3, rtol=1e-5)


def test_discrete_actions_fill_one_chamber():
    """Choices 0 to 8 fill that chamber and empty the others, 9 empties all."""
    env = make(num_worlds=1, action_kind="discrete")
    env.reset()
    for choice, expected in ((2, [2]), (7, [7]), (9, []), (0, [0])):
        act(env, choice)
        assert torch.nonzero(env.pressure[0]).flatten().tolist() == expected
        np.testing.assert_allclose(env.sim.cavity_pressure[0, expected], 300.0e3, rtol=1e-5)


def test_ball_rolls():
    """Filled under it a chamber rolls the ball off: it turns as it goes, v = w x r, to the side on which it lay."""
    env = make(num_worlds=2, settle=False, goal=(0.03, 0.03))
    env.reset()
    poses = env.sim.frame_pose.clone()
    poses[:, env.scene.ball, :2] = torch.tensor([[0.008, 0.0], [0.0, -0.008]])
    env.place_frames(poses, torch.ones(2, dtype=torch.bool))
    before = env.sim.body_pose[:, env.scene.ball, :3].clone()
    pressures = -torch.ones(9)
    pressures[4] = 1.0
    speeds = []
    for substep in range(20):
        env.apply_action(pressures.expand(2, 9), substep)
        env.sim.step()
        speeds.append(env.sim.body_twist[:, env.scene.ball].clone())
    moved = env.sim.body_pose[:, env.scene.ball, :3] - before
    assert float(moved[0, 0]) > 0.004 and float(moved[1, 1]) < -0.004
    assert float(moved[0, 1].abs()) < 1e-3 and float(moved[1, 0].abs()) < 1e-3
    twist = torch.stack(speeds)[-8:]
    rolled = (twist[:, 0, 4] / twist[:, 0, 0]).mean(), (-twist[:, 1, 3] / twist[:, 1, 1]).mean()
    np.testing.assert_allclose(rolled, 1.0 / 0.010, rtol=0.1)


def test_observation_and_reward(env):
    """Entries are those of the table; the reward is the way won, and the bonus once."""
    start = env.reset()
    distance = start["distance"].clone()
    data = act(env, torch.linspace(-0.6, 0.9, 9))
    ball, v = env.sim.body_pose[:, env.scene.ball, :3], env.sim.body_twist[:, env.scene.ball, :3]
    o = data["observation"]
    np.testing.assert_allclose(o[:, :9], 0.5 + 0.5 * np.linspace(-0.6, 0.9, 9)[None].repeat(4, 0), rtol=1e-5)
    np.testing.assert_allclose(o[:, 9:11], ball[:, :2] / 0.04, atol=1e-6)
    np.testing.assert_allclose(o[:, 11], (ball[:, 2] - 0.02) / 0.01, atol=1e-5)
    np.testing.assert_allclose(o[:, 12:15], (v / 0.2).clamp(-3.0, 3.0), atol=1e-5)
    np.testing.assert_allclose(o[:, 15:17] - o[:, 9:11], o[:, 17:], atol=1e-5)
    reached = 5.0 * (data["distance"] <= 0.006)
    np.testing.assert_allclose(data["reward"], (distance - data["distance"]) / 0.010 + reached, atol=1e-4)
    assert torch.equal(data["terminated"], data["distance"] <= 0.006)


def test_goal_ends_the_episode_or_is_held():
    """A ball that lies in the middle of a chamber is at a goal there at once; without ``end_on_success`` it goes on."""
    for ends in (True, False):
        env = make(num_worlds=1, goal=(0.0, 0.0), start_range=(0.0, 0.0), end_on_success=ends)
        env.reset()
        data = act(env, -1.0)
        assert bool(data["success"]) and bool(data["terminated"]) == ends
        assert float(data["reward"]) == pytest.approx(5.0, abs=0.1)


def test_ball_beside_the_board_ends_the_episode(env):
    env.reset()
    poses = env.sim.frame_pose.clone()
    poses[1, env.scene.ball, :3] = torch.tensor([0.0, 0.08, 0.03])
    env.place_frames(poses, torch.tensor([False, True, False, False]))
    data = act(env, -1.0)
    assert bool(data["terminated"][1]) and not bool(data["success"][1])


def test_sofagym_options():
    """Places from the board's corner in 10 and 5 cm, goals beyond the rim, reward -d / d_start, a slow ball of 2e-4."""
    env = make(num_worlds=16, config=BubbleMotionConfig.paper())
    data = env.reset()
    goal, ball = env.goal, env.sim.body_pose[:, env.scene.ball, :3]
    assert float(goal[:, :2].abs().max()) > 0.031
    assert float(ball[:, 0].min()) >= -0.010 and float(ball[:, 2].min()) == pytest.approx(0.050, abs=1e-6)
    np.testing.assert_allclose(
        data["observation"][:, 9:12],
        (ball + torch.tensor([0.05, 0.05, 0.0])) * 10.0 * torch.tensor([1.0, 1.0, 2.0]),
        rtol=1e-5,
    )
    np.testing.assert_allclose(data["observation"][:, 12:14], (goal[:, :2] + 0.05) * 10.0, rtol=1e-5)
    way = data["distance"].clone()
    data = act(env, 1.0)
    assert (env.pressure == 400.0e3).all() and (data["world_status"] == 0).all()
    np.testing.assert_allclose(data["reward"], -data["distance"] / way.clamp_min(1e-6), rtol=1e-4)
    assert env.reward_names == ("distance", "failure")
    assert float(env.sim.mass[0].sum()) == pytest.approx(0.0, abs=1e-6)


def test_wild_play_fails_nowhere():
    """Chambers full or empty at random: no world fails, few contacts, and the ball stays inside the rim."""
    env = make(num_worlds=8, seed=8, end_on_success=False)
    env.reset()
    generator = torch.Generator().manual_seed(0)
    for _ in range(10):
        action = torch.randint(0, 2, (8, 9), generator=generator).float() * 2.0 - 1.0
        data = env.step(TensorDict({"action": action}, batch_size=[8]))["next"]
        assert (data["world_status"] == 0).all() and not data["terminated"].any()
        ball = env.sim.body_pose[:, env.scene.ball, :3]
        assert float(ball[:, :2].abs().max()) < 0.0303 and float(ball[:, 2].min()) > 0.017
        assert int(env.sim.contact_count.max()) <= 12
    assert (env.sim.contact_overflow == 0).all()


@pytest.mark.slow
def test_policy_rolls_the_ball_to_its_goals():
    """At least 85 % of 64 random goals are reached in 4 s, by random pressures under 25 %."""
    env = make(num_worlds=64, seed=21)
    scripted = run_episodes(env, bubble_baseline(env), seed=21).summary()
    blind = run_episodes(env, random(Spaces.of(env)), seed=21).summary()
    assert scripted["success"] >= 0.85 and scripted["failed"] == 0.0
    assert blind["success"] <= 0.25


def test_policy_needs_the_velocity():
    with pytest.raises(ValueError, match="decode needs observation='state'"):
        bubble_baseline(make(num_worlds=1, observation="paper"))


def test_picture_and_scene_file(tmp_path):
    """Board, rim and ball are seen where they are; the USD file holds them with their motion."""
    from pxr import Usd, UsdGeom

    from softwarp.io.trajectory import Recorder
    from softwarp.io.usd import export_usd

    env = make(num_worlds=1, render_width=160, render_height=120)
    env.reset()
    first = env.render()[0]
    recorder = Recorder(env.sim, worlds=[0])
    recorder.capture()
    policy = bubble_baseline(env)
    now = env.reset()
    for _ in range(3):
        now = env.step(policy(now))["next"]
        recorder.capture()
    second = env.render()[0]
    assert first.shape == (120, 160, 3) and (first != second).any(axis=-1).mean() > 0.01
    file = tmp_path / "bubble.usda"
    export_usd(recorder.finish(), file)
    stage = Usd.Stage.Open(str(file))
    assert {"ball", "rim", "board"} <= {prim.GetName() for prim in stage.Traverse()}
    ball = next(prim for prim in stage.Traverse() if prim.GetName() == "ball")
    ends = [
        np.array(UsdGeom.Xformable(ball).ComputeLocalToWorldTransform(time).ExtractTranslation())
        for time in (stage.GetStartTimeCode(), stage.GetEndTimeCode())
    ]
    assert np.linalg.norm(ends[1] - ends[0]) > 0.003


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mesh": "corse"}, r"unknown mesh 'corse'; did you mean 'coarse'"),
        ({"reward": "papr"}, r"unknown reward 'papr'; did you mean 'paper'"),
        ({"action_kind": "discret"}, r"unknown action_kind 'discret'; did you mean 'discrete'"),
        ({"observation": "states"}, r"unknown observation 'states'; did you mean 'state'"),
        ({"start_range": (-0.035, 0.03)}, r"start_range must lie within \+-0.03 m, where the rim stops the ball"),
        ({"goal_range": (-0.03, 0.04)}, r"goal_range must lie within \+-0.03 m.*goals_beyond_reach=True"),
        ({"goal": (0.0, 0.05)}, r"goal must lie within \+-0.03 m, where the rim stops the ball, got \(0.0, 0.05\)"),
        ({"goal_range": (0.03, -0.03)}, r"goal_range must be \(low, high\)"),
        ({"least_way": 0.05}, r"least_way must be at most 0.04243 m"),
        ({"max_pressure": -1.0}, r"max_pressure must lie in .*, got -1.0"),
        ({"max_pressure": 1.0e7}, r"max_pressure must lie in .*, got 10000000.0"),
        ({"skin": 0.008}, r"skin must be at most 0.007 m"),
        ({"ball_radius": 0.041}, r"ball_radius \+ contact_distance must be less than 0.04 m"),
        ({"ball_inertia": 0.0}, r"ball_inertia must lie in .*, got 0.0"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_accurate_boards_say_what_they_are():
    """The option chooses mesh, elements and rotations together, and refuses others beside it."""
    config = BubbleMotionConfig(fidelity="accurate")
    assert (config.mesh, config.element, config.rotation) == ("graded", "p2", "polar")
    with pytest.raises(ValueError, match=r"modes for skin=0\.006 and nu=0\.3"):
        BubbleMotionConfig(fidelity="accurate", skin=0.005)
    with pytest.raises(ValueError, match="means mesh='graded', got mesh='fine'"):
        BubbleMotionConfig(fidelity="accurate", mesh="fine")
