"""CartStemContact: draws, actions, observations, rewards, ends; the direct approach gets stuck, leaning reaches."""

import pytest
import torch
from tensordict import TensorDict

from softwarp.envs import registry
from softwarp.envs.tasks.cart_stem_contact import BENCHMARK
from softwarp.policies.baselines.cart import stem_contact_direct, stem_contact_lean


def make(num_worlds=4, seed=1, **options):
    return registry.make("CartStemContact", num_worlds=num_worlds, seed=seed, **options)


def act(env, action):
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]


def successes(env, policy):
    """Whether each world meets its goal within an episode, and whether that goal lies behind."""
    data = env.reset()
    behind, met = env.is_behind().clone(), torch.zeros(env.num_worlds, dtype=torch.bool)
    over = met.clone()
    for _ in range(env.max_episode_steps):
        data = env.step(policy(data))["next"]
        met |= data["success"][:, 0] & ~over
        over |= data["done"][:, 0]
        assert (data["world_status"] == 0).all()
    return met, behind


def test_draws():
    """Obstacles in [-6, -4] and [4, 6] cm; cart and stem touch neither; goals 0 to 3.5 cm inwards of either."""
    env = make(num_worlds=1000)
    env.reset()
    left, right = env.obstacles.unbind(dim=1)
    assert (left >= -0.06).all() and (left <= -0.04).all() and (right >= 0.04).all() and (right <= 0.06).all()
    cart = env._cart_x
    assert (cart >= left + 0.03 - 1e-6).all() and (cart <= right - 0.03 + 1e-6).all()
    from_left, from_right = env.goal_x - left, right - env.goal_x
    is_left = from_left < from_right
    assert 0.4 < is_left.float().mean() < 0.6
    depth = torch.minimum(from_left, from_right)
    assert depth.min() >= -1e-6 and depth.max() <= 0.035 + 1e-6
    assert env.is_behind().float().mean() == pytest.approx(env.config.reach / 0.035, abs=0.05)
    torch.testing.assert_close(env.max_move, torch.maximum(-left, right) + 0.01)
    poses = env.sim.body_pose
    torch.testing.assert_close(poses[:, list(env.scene.obstacles), 0], env.obstacles)
    torch.testing.assert_close(env.sim.rod_x[:, -1, 0], cart)
    assert (act(env, torch.zeros(1000, 1))["world_status"] == 0).all()


@pytest.mark.parametrize("goals", ["behind", "open", "benchmark"])
def test_kinds_of_goals(goals):
    env = make(num_worlds=64, goals=goals)
    env.reset()
    assert (env.is_behind() == (goals != "open")).all()
    if goals == "benchmark":
        row = torch.stack((*env.obstacles.unbind(dim=1), env._cart_x, env.goal_x), dim=1)
        torch.testing.assert_close(row, torch.tensor([BENCHMARK]).expand(64, 4))


def test_absolute_actions():
    """The cart goes to a max_move, at no more than 6 mm per action, and stays."""
    env = make(num_worlds=2, goals="benchmark", end_on_success=False)
    env.reset()
    action = torch.tensor([[0.1], [-1.0]])
    places = [act(env, action)["observation"][:, 0].clone() * 0.05 for _ in range(12)]
    torch.testing.assert_close(places[0], torch.tensor([0.006, -0.006]), rtol=1e-3, atol=0.0)
    torch.testing.assert_close(places[3], torch.tensor([0.006, -0.024]), rtol=1e-3, atol=0.0)
    torch.testing.assert_close(places[11], torch.tensor([0.006, -0.060]), rtol=1e-3, atol=0.0)


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_relative_actions(kind):
    """Speeds per 2 cm/s; the cart stops at max_move."""
    env = make(num_worlds=3, goals="benchmark", action_kind=kind, end_on_success=False)
    env.reset()
    action = torch.tensor([[0.2], [0.0], [-1.0]]) if kind == "continuous" else torch.tensor([5, 3, 0])
    for _ in range(2):
        x = act(env, action)["observation"][:, 0] * 0.05
    torch.testing.assert_close(x, torch.tensor([0.0024, 0.0, -0.012]), rtol=1e-3, atol=1e-7)
    for _ in range(10):
        x = act(env, action)["observation"][:, 0] * 0.05
    assert float(x[2]) == pytest.approx(-0.06, rel=1e-3)


@pytest.mark.parametrize("observation", ["scaled", "paper"])
def test_observations(observation):
    """Both kinds decode to the same places; the paper's holds the obstacles' half sizes, in centimetres."""
    env = make(observation=observation)
    seen = env.reset()["observation"]
    places = torch.stack((env._cart_x, env._tip_x, *env.obstacles.unbind(dim=1), env.goal_x), dim=1)
    torch.testing.assert_close(env.decode(seen), places)
    if observation == "paper":
        assert seen.shape == (4, 8)
        torch.testing.assert_close(seen[:, 4:7], torch.tensor([[2.0, 1.0, 2.0]] * 4))
    else:
        error = env.goal_x - env._tip_x
        torch.testing.assert_close(seen[:, 5:], torch.stack((error / 0.02, error / (error.abs() + 0.003)), dim=1))


def test_reward_and_success():
    """-min(d, max_move) / max_move; the episode ends within 1.5 mm."""
    env = make(num_worlds=3, goals="benchmark", action_kind="continuous")
    env.reset()
    env.goal_x.copy_(torch.tensor([0.0012, 0.03, 0.5]))
    data = act(env, torch.zeros(3, 1))
    torch.testing.assert_close(data["reward"][:, 0], torch.tensor([-0.02, -0.5, -1.0]))
    assert data["success"].flatten().tolist() == data["terminated"].flatten().tolist() == [True, False, False]


@pytest.mark.parametrize("kind", [pytest.param("absolute", marks=pytest.mark.slow), "continuous"])
def test_leaning_reaches_every_goal(kind):
    """Goals behind an obstacle are reached by bending the stem at the other one."""
    env = make(num_worlds=48, seed=5, action_kind=kind)
    met, behind = successes(env, stem_contact_lean(env))
    assert met.all() and behind.float().mean() > 0.7


@pytest.mark.slow
def test_direct_approach_gets_stuck():
    """It reaches the goals in the open, and of those behind only what the tolerance gives away."""
    env = make(num_worlds=128, seed=5, action_kind="continuous")
    met, behind = successes(env, stem_contact_direct(env))
    assert met[~behind].all()
    assert met[behind].float().mean() < 0.08
    last = env.decode(env.world_state["last_observation"])[behind & ~met]
    near = torch.minimum(last[:, 1] - last[:, 2], last[:, 3] - last[:, 1])
    torch.testing.assert_close(near, torch.full_like(near, env.config.reach), atol=0.002, rtol=0.0)


@pytest.mark.slow
def test_discrete_actions_reach():
    """With three speeds either way, nearly always."""
    env = make(num_worlds=128, seed=5, action_kind="discrete")
    met, _ = successes(env, stem_contact_lean(env))
    assert met.float().mean() > 0.95


def test_goal_is_shown():
    env = make(num_worlds=2, render_width=120, render_height=90)
    env.reset()
    torch.testing.assert_close(env.goal_points()[:, 0], env.goal_x)
    with_goal = env.render([0])[0].astype(int)
    env.goal_x.add_(1.0)
    assert abs(with_goal - env.render([0])[0]).max() > 40


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"goals": "behin"}, "unknown goals 'behin'.*'behind'"),
        ({"obstacle_x": (0.06, 0.04)}, r"obstacle_x must be \(low, high\) with low <= high"),
        ({"clearance": 0.02}, "clearance must be more than 0.02928 m, at which the stem touches"),
        ({"skin": 0.0}, "skin must lie in .*, got 0.0"),
        ({"goals": "open", "goal_depth": 0.02}, "goal_depth must be more than 0.02928 m for open goals"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)
