"""Maze: start, tilts that are held, servos and their limits, observations, rewards, ends, options, its policy."""

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import step_mdp

from softwarp.envs import registry
from softwarp.envs.options.maze import MazeConfig
from softwarp.envs.tasks.simple_maze import START, turned_to
from softwarp.policies.baselines.maze import tripod_maze_baseline

HOME = -1.0  # rad


def make(num_worlds=2, seed=1, **options):
    return registry.make("Maze", num_worlds=num_worlds, seed=seed, **options)


def act(env, action):
    """One action, the same in all worlds."""
    value = torch.as_tensor(action, dtype=env.action_spec.dtype)
    value = value.expand(env.action_spec.shape).clone()
    return env.step(TensorDict({"action": value}, batch_size=env.batch_size))["next"]


@pytest.fixture(scope="module")
def env():
    """Tilts, shared by the tests that reset it themselves."""
    return make()


def test_starts_at_rest_and_level(env):
    """Ball on the floor of the level maze at SofaGym's place, servos at home; nothing moves, each time."""
    first = env.reset()
    seen = env.decode(first["observation"])
    np.testing.assert_allclose(seen["ball"], np.tile(START, (2, 1)), atol=1e-6)
    np.testing.assert_allclose(seen["ball_v"], 0.0, atol=1e-5)
    np.testing.assert_allclose(seen["tilt"], 0.0, atol=1e-5)
    np.testing.assert_allclose(seen["angles"], HOME, atol=1e-5)
    np.testing.assert_allclose(seen["command"], HOME, atol=1e-6)
    assert (env.sim.control.body_force == 0.0).all()
    height = env.sim.body_pose[:, env.scene.maze, 2]
    np.testing.assert_allclose(env.sim.body_pose[:, env.scene.ball, 2] - height, 0.002, atol=1e-6)
    for _ in range(5):
        after = act(env, [0.0, 0.0])
    np.testing.assert_allclose(env.ball_place()[0], np.tile([*START, 0.002], (2, 1)), atol=1e-5)
    assert (after["world_status"] == 0).all()
    assert torch.equal(env.reset()["observation"][:, :2], first["observation"][:, :2])


@pytest.mark.parametrize("tilt", [(1.0, 0.0), (-0.5, 0.5), (1.0, -1.0), (0.3, 0.8)])
def test_tilts_are_held(env, tilt):
    """The servos hold a tilt to 3 mrad, between the tilts of the table too, at the height of the start to 1 mm."""
    env.reset()
    height = float(env.sim.marker_x[0, env.plate_marker, 2])
    for _ in range(20):
        act(env, tilt)
    np.testing.assert_allclose(env.seen_tilt(), 0.2 * torch.tensor([tilt, tilt]), atol=3e-3)
    assert float(env.sim.marker_x[0, env.plate_marker, 2]) == pytest.approx(height, abs=1e-3)


def test_a_tilted_maze_lets_the_ball_roll():
    """From rest in a corridor down along y, clear of its walls: 5/7 g sin(tilt), rolling, to 3 % after 10 steps.

    The tripod stands still before the ball is let go; its weight of 1 mN tilts it by nothing that counts.
    """
    env = make(num_worlds=1, action_kind="continuous", precision="float64", end_on_success=False)
    env.reset()
    for _ in range(30):  # servo 0, on +y, outwards
        act(env, [-0.5 if env.command[0, 0] > -1.2 else 0.0, 0.0, 0.0])
    tilt = float(env.seen_tilt()[0, 1])
    assert tilt > 0.05
    x = float(env.ways.centres[0, 0])
    q = env.sim.frame_pose[:1].clone()
    local = torch.tensor([[x, -0.0258, 0.002]], dtype=q.dtype)
    q[:, env.scene.ball, :3] = q[:, env.scene.maze, :3] + turned_to(q[:, env.scene.maze, 3:], local)
    q[:, env.scene.ball, 3:] = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=q.dtype)
    env.place_frames(q, torch.ones(1, dtype=torch.bool), torch.zeros_like(env.sim.frame_twist))
    places = []
    for _ in range(10):
        env.sim.step()
        places.append(env.ball_place()[0][0].double().numpy())
    way = np.array(places)[:, 1] - local[0, 1].item()
    steps = np.arange(1, 11)
    wished = 5.0 / 7.0 * 9.81 * math.sin(tilt) * 0.01**2 * steps * (steps + 1) / 2.0  # backward Euler
    assert int(env.ways.neighbours[0, 0, 1]) >= 0  # the corridor goes on for more than the 4 mm that it rolls
    np.testing.assert_allclose(way[3:], wished[3:], rtol=0.03)


def test_choices_move_one_servo_within_its_limits():
    """Ten raises of servo 1 by 0.1 rad end at the last that keeps the limit; the mask tells; others stay."""
    env = make(action_kind="discrete", max_angle=-0.55, end_on_success=False)
    env.reset()
    assert env.action_count == 6 and env.action_mask().all()
    for _ in range(10):
        after = act(env, 1)
    np.testing.assert_allclose(env.command, np.tile([HOME, -0.6, HOME], (2, 1)), atol=1e-5)
    np.testing.assert_allclose(env.sim.joint_position, env.command, atol=1e-4)
    assert after["action_mask"].tolist() == [[True, False, True, True, True, True]] * 2
    act(env, 4)
    np.testing.assert_allclose(env.command[:, 1], -0.7, atol=1e-5)


def test_angles_change_in_equal_parts():
    """A fifth of the change per sub-step; clamped to the limits."""
    env = make(action_kind="continuous", min_angle=-1.05)
    env.reset()
    action = torch.tensor([[1.0, -1.0, 0.5]]).expand(2, 3)
    seen = []
    for substep in range(5):
        env.apply_action(action, substep)
        seen.append(env.sim.control.joint_target[0].tolist())
    share = np.arange(1, 6)[:, None] / 5.0
    np.testing.assert_allclose(seen, HOME + share * np.array([0.1, -0.05, 0.05]), atol=1e-6)


def test_paper_options():
    """SofaGym's start, raw observation and reward: 1 for a new best, else the share of the way that is done."""
    config = MazeConfig.paper()
    assert (config.youngs, config.nu, config.total_mass, config.radius) == (250.0e3, 0.45, 0.032, 0.060)
    assert (config.advance, config.angle, config.settle, config.rayleigh) == (0.035, -1.4965, False, (0.0, 0.05))
    env = registry.make("Maze", num_worlds=1, seed=3, config=config)
    first = env.reset()
    assert first["observation"].shape == (1, 9) and env.action_count == 6
    np.testing.assert_allclose(env.sim.joint_position, -1.4965, atol=1e-3)
    x, y = config.maze_offset
    np.testing.assert_allclose(first["observation"][0, :2], [x + START[0], y + START[1]], atol=1e-3)
    corner = first["observation"][0, 3:5].double().numpy()
    np.testing.assert_allclose(corner, [x - 0.030, y - 0.030], atol=1e-3)
    after = act(env, 0)
    share = 1.0 - float(env.way / env.whole_way)
    assert float(after["reward"]) in (1.0, pytest.approx(max(share, 0.0), abs=1e-6))
    with pytest.raises(ValueError, match="decode needs observation='state'"):
        tripod_maze_baseline(env)


def test_ranges_are_drawn_per_world():
    """Modulus, friction and mass of the ball, each within its range, and different from world to world."""
    ranges = {"youngs_range": (2.0e5, 3.0e5), "mu_range": (0.1, 0.3), "ball_mass_range": (5.0e-5, 2.0e-4)}
    env = make(num_worlds=8, action_kind="continuous", **ranges)
    env.reset()
    params = env.sim.params
    drawn = (params.youngs[:, 0], params.pair_mu[:, 0], params.body_mass[:, env.scene.ball])
    for values, (low, high) in zip(drawn, ranges.values(), strict=True):
        assert ((values >= low) & (values <= high)).all() and len(values.unique()) == 8


@pytest.mark.slow
def test_every_world_can_have_its_own_maze():
    """Random mazes on the tripod: the ball starts in the middle of a cell and stays on the floor."""
    env = make(num_worlds=4, maze="random", mazes=4, action_kind="continuous", goal="any")
    env.reset()
    for _ in range(10):
        after = act(env, [0.2, -0.2, 0.1])
    assert (after["world_status"] == 0).all() and not after["terminated"].any()
    np.testing.assert_allclose(env.ball_place()[0][:, 2], 0.002, atol=1e-4)


@pytest.mark.parametrize(
    "kind", ["discrete", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("tilt", "continuous"))]
)
def test_the_policy_reaches_all_corners(kind):
    """All four corners of the serpentine within 250 actions."""
    env = make(num_worlds=8, seed=0, action_kind=kind)
    policy, now = tripod_maze_baseline(env), env.reset()
    assert len(env.goal.unique(dim=0)) >= 3
    met = torch.zeros(8, dtype=torch.bool)
    for _ in range(env.max_episode_steps):
        now = step_mdp(env.step(policy(now)))
        met |= now["success"][:, 0]
        if met.all():
            break
    assert met.all()


def test_mistakes_are_told():
    """Unknown kinds and meshes, angles beyond the limits."""
    with pytest.raises(ValueError, match="MazeConfig: unknown action_kind 'tild'; did you mean 'tilt'"):
        MazeConfig(action_kind="tild")
    with pytest.raises(ValueError, match="tripod mesh 'corse' is neither a file nor one of coarse, medium, fine"):
        make(mesh="corse")
    with pytest.raises(
        ValueError, match=r"angle must lie in \[min_angle, max_angle\], got -1 outside \[-0.9, -0.0255\]"
    ):
        MazeConfig(min_angle=-0.9)


@pytest.mark.slow
def test_tilts_that_the_servos_cannot_hold_are_told():
    """Found by static solves, before the first episode."""
    with pytest.raises(ValueError, match=r"the servos do not hold tilts of max_tilt=0.9 rad from angle=-1 rad"):
        make(num_worlds=1, max_tilt=0.9)


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"max_speed": 0.0}, {"max_torque": 1e-12}, {"advance": 0.0}])
def test_servos_that_do_not_tilt_the_maze_are_told(options):
    """Their turns change nothing, so that no tilt can be inverted."""
    with pytest.raises(ValueError, match=r"MazeConfig: the servos do not tilt the maze: .* look at max_speed"):
        make(num_worlds=1, **options)
