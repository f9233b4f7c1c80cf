"""SimpleMaze: ways, goals, masks, rewards, and what its hand-written policy reaches."""

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import ActionMask, TransformedEnv

import softwarp as sw
from softwarp.envs.maze_ways import MazeWays
from softwarp.envs.options.simple_maze import SimpleMazeConfig
from softwarp.envs.tasks.simple_maze import turned
from softwarp.meshing import random_maze, serpentine
from softwarp.policies.baselines.table import rule
from softwarp.shapes.base import rotation_matrix


def stepped(env, action):
    """What follows from one action in all worlds."""
    given = torch.full((env.num_worlds,), action) if isinstance(action, int) else action
    return env.step(TensorDict({"action": given}, batch_size=env.batch_size))["next"]


def success_of(env, steps):
    """Share of worlds in which the hand-written policy meets the goal."""
    policy, now = rule(env, "SimpleMaze"), env.reset()
    met = torch.zeros(env.num_worlds, dtype=torch.bool)
    for _ in range(steps):
        now = env.step(policy(now))["next"]
        met |= now["success"][:, 0]
    return float(met.float().mean())


@pytest.mark.parametrize("loops", [0, 5])
def test_ways_on_the_device_are_those_of_the_maze(loops):
    """On the middles the way left is the length of the shortest path; waypoints are corners of it."""
    mazes = [random_maze(6, 5, seed=seed, loops=loops) for seed in range(3)]
    ways, rng = MazeWays(mazes, "cpu"), np.random.default_rng(0)
    for _ in range(60):
        number = int(rng.integers(3))
        maze = mazes[number]
        ends = []
        for _ in range(2):
            cell = int(rng.integers(30))
            side = int(rng.choice(np.flatnonzero(maze.neighbours[cell] >= 0)))
            along = float(rng.choice([0.0, rng.uniform(0.0, 0.499 * maze.pitch)]))
            ends.append((cell, side, along))
        start, goal = (maze._place(*end) for end in ends)
        index = [torch.tensor([value]) for value in (number, *ends[1])]
        place = torch.tensor(start[None], dtype=torch.float32)
        found = float(ways.remaining(index[0], place, *index[1:3], index[3].float()))
        assert found == pytest.approx(maze.distance(start, goal), abs=1e-6)
        first, _ = ways.waypoints(index[0], place, *index[1:3], index[3].float())
        through = maze.distance(start, first[0].numpy()) + maze.distance(first[0].numpy(), goal)
        assert through == pytest.approx(maze.distance(start, goal), abs=1e-6)


def test_the_way_left_is_continuous_round_corners():
    """A ball that cuts a corner within what the walls let it sees no jump."""
    maze = serpentine()
    ways = MazeWays([maze], "cpu")
    line = torch.linspace(0.0, 1.0, 400)[:, None]
    a, b, c = (torch.tensor(maze.centres[k], dtype=torch.float32) for k in (0, 1, 9))  # north, then east
    bend = torch.cat((a + line * (b - a), b + line * (c - b))) + 0.0011
    zero, goal = torch.zeros(len(bend), dtype=torch.long), torch.full((len(bend),), 40)
    left = ways.remaining(zero, bend, goal, zero, torch.zeros(len(bend)))
    assert float(left.diff().abs().max()) < 3e-3


def test_tilts_are_down_towards_x_and_y():
    """Turned by (a, 0) the axis x points down by a; a ball is driven towards +x, as discrete action 0 does."""
    R = rotation_matrix(turned(torch.tensor([[0.2, 0.0], [0.0, 0.3]])).double().numpy())
    np.testing.assert_allclose(R[0, :, 0], [np.cos(0.2), 0.0, -np.sin(0.2)], atol=1e-6)
    np.testing.assert_allclose(R[1, :, 1], [0.0, np.cos(0.3), -np.sin(0.3)], atol=1e-6)
    env = sw.make("SimpleMaze", num_worlds=1, seed=0, action_repeat=10)
    env.reset()
    before = env.ball_place()[0][0, 0].item()
    stepped(env, 0)
    assert env.ball_place()[0][0, 0].item() > before + 1e-3


def test_masks_leave_out_the_opposite_tilt():
    """After 0: 0, 1, 2; after 1: 0, 1, 3; after 2: 0, 2, 3; after 3: 1, 2, 3; at the start all. Everywhere the same."""
    legal = [[1, 1, 1, 0], [1, 1, 0, 1], [1, 0, 1, 1], [0, 1, 1, 1]]
    env = sw.make("SimpleMaze", num_worlds=4, seed=0, action_repeat=2)
    assert env.reset()["action_mask"].all()
    after = stepped(env, torch.arange(4))
    assert after["action_mask"].int().tolist() == legal
    assert env.observation_spec["action_mask"].is_in(after["action_mask"])
    masked = TransformedEnv(sw.make("SimpleMaze", num_worlds=4, seed=0, action_repeat=2), ActionMask())
    now = masked.reset()
    for _ in range(6):
        now = masked.rand_action(now)
        assert now["action_mask"].gather(1, now["action"][:, None]).all()
        now = masked.step(now)["next"]
    single = gymnasium.make("softwarp/SimpleMaze-v0", action_repeat=2)
    _, info = single.reset(seed=0)
    assert info["action_mask"].tolist() == [1, 1, 1, 1]
    info = single.step(2)[-1]
    assert info["action_mask"].tolist() == legal[2]
    assert single.action_space.sample(mask=info["action_mask"]) != 1
    many = gymnasium.make_vec("softwarp/SimpleMaze-v0", num_envs=2, action_repeat=2)
    many.reset(seed=0)
    assert many.step(np.array([0, 3]))[-1]["action_mask"].tolist() == [legal[0], legal[3]]
    free = sw.make("SimpleMaze", num_worlds=1, seed=0, action_repeat=2, mask_opposite=False)
    free.reset()
    assert stepped(free, 3)["action_mask"].all()
    assert sw.make("SimpleMaze", action_kind="continuous", action_repeat=2).action_mask() is None


def test_progress_telescopes():
    """The sum of all rewards for progress is the way from the start, less what is left, in cells."""
    env = sw.make("SimpleMaze", num_worlds=8, seed=1, end_on_success=False)
    env.reset()
    first = env.way.clone()
    total = torch.zeros(8)
    for action in (0, 2, 3, 1, 0, 1):
        stepped(env, action)
        total = env.episode_sums["progress"]
    torch.testing.assert_close(total, (first - env.way) / env.ways.pitch, atol=1e-4, rtol=0.0)


def test_paper_rewards_new_bests():
    """1 where the way left is shorter than ever before in the episode, else 0."""
    config = SimpleMazeConfig.paper(action_repeat=30, end_on_success=False)
    env = sw.make("SimpleMaze", num_worlds=8, seed=1, config=config)
    observation = env.reset()["observation"]
    assert observation.shape == (8, 13)
    best = env.way.clone()
    for action in (0, 2, 3, 1, 0, 1, 2):
        reward = stepped(env, action)["reward"][:, 0]
        expected = ((env.way < best) | env._success).float()
        assert reward.tolist() == expected.tolist()
        best = torch.minimum(best, env.way)


def test_goals_in_passing_count():
    """A ball that rolls over the goal within an action has met it, though the action ends elsewhere."""
    maze = serpentine()
    middle = maze.centres[5 * 8 + 3]  # on the straight corridor that the ball starts in
    env = sw.make("SimpleMaze", num_worlds=1, seed=0, goal_place=tuple(middle), end_on_success=False)
    env.reset()
    after = stepped(env, 0)
    assert bool(after["success"])
    assert float(torch.linalg.vector_norm(env.ball_place()[0][0, :2] - env.goal[0, :2])) > 0.006


@pytest.mark.parametrize("goal", [pytest.param("corner", marks=pytest.mark.slow), "any"])
def test_goals_lie_in_corridors_and_far_enough(goal):
    """Corners are the middles of the four corner cells; any goal lies on a middle, beyond the least way."""
    env = sw.make("SimpleMaze", num_worlds=64, seed=3, maze="random", mazes=6, goal=goal)
    env.reset()
    assert env.maze.unique().tolist() == list(range(6))
    assert float(env.way.min()) >= env.config.least_way
    assert torch.equal(env.maze.float(), env.sim.params.body_choice[:, 0])
    for world in range(64):
        maze = env.scene.mazes[int(env.maze[world])]
        place = env.goal[world, :2].double().numpy()
        cell, side, along = maze.on_middle(place)
        np.testing.assert_allclose(maze._place(cell, side, along), place, atol=1e-6)
        if goal == "corner":
            assert cell in maze.corners()
        start = env.ball_place()[0][world, :2].double().numpy()
        assert float(env.way[world]) == pytest.approx(maze.distance(start, place), abs=1e-6)


@pytest.mark.slow
def test_the_policy_reaches_all_corners():
    """Of the serpentine with either kind of action, and with ten tilts a second of 20 random mazes."""
    for kind in ("discrete", "continuous"):
        assert success_of(sw.make("SimpleMaze", num_worlds=32, seed=0, action_kind=kind), 16) == 1.0
    options = {"maze": "random", "mazes": 20, "action_kind": "continuous", "action_repeat": 10}
    env = sw.make("SimpleMaze", num_worlds=40, seed=0, max_episode_steps=120, **options)
    assert success_of(env, 120) >= 0.95


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"goal_place": (0.0, 0.0)}, "goal_place.*lies in a wall"),
        ({"start": (0.1, 0.0)}, "start.*lies outside"),
        ({"start": (-0.0235, -0.0235)}, "free of the walls"),
        ({"ball_radius": 0.0035}, r"ball_radius \+ contact_distance must be less than 0.00\d+ m, half of corridor"),
        ({"success_tolerance": 0.01}, "success_tolerance"),
        ({"mazes": 3}, "mazes must be 1"),
        ({"maze": "random", "columns": 1}, "columns"),
        ({"maze": "random", "loops": 100}, "loops"),
        ({"maze": "spiral"}, "maze"),
        ({"max_tilt": 1.2}, "max_tilt"),
        ({"least_way": 0.4}, "least_way"),
    ],
)
def test_refusals(options, told):
    """What no maze can be is told."""
    with pytest.raises(ValueError, match=told):
        SimpleMazeConfig(**options)
