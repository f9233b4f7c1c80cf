"""The Trunk environment on the real simulator: TorchRL's checker, batch contract, actions, observations, rewards."""

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import RewardSum, StepCounter, TransformedEnv
from torchrl.envs.transforms import Compose
from torchrl.envs.utils import check_env_specs

from softwarp.envs import registry
from softwarp.envs.tasks.trunk import CABLES, COMPACT, TrunkConfig, reachable_points
from softwarp.policies.baselines.trunk import trunk_baseline


def make(num_worlds=3, seed=1, **options):
    return registry.make("Trunk", num_worlds=num_worlds, seed=seed, **({"mesh": "coarse"} | options))


@pytest.fixture(scope="module")
def env():
    """One environment shared by the tests that reset it themselves."""
    return make()


def act(env, action):
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]


def actions_of(count, worlds, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [2.0 * torch.rand(worlds, CABLES, generator=generator) - 1.0 for _ in range(count)]


@pytest.mark.parametrize(
    ("kind", "observation"),
    [
        ("continuous", "compact"),
        ("absolute", "paper"),
        ("discrete", "compact"),
        *(
            pytest.param(*pair, marks=pytest.mark.slow)
            for pair in (("continuous", "paper"), ("absolute", "compact"), ("discrete", "paper"))
        ),
    ],
)
def test_specs_and_bounds(kind, observation):
    """TorchRL's checker, bare and transformed; 30 random actions stay inside the declared, finite bounds."""
    env = make(num_worlds=2, action_kind=kind, observation=observation, max_episode_steps=20)
    check_env_specs(env)
    spec = env.observation_spec["observation"]
    assert spec.space.low.isfinite().all() and spec.space.high.isfinite().all()
    data = env.rollout(30, break_when_any_done=False)
    for value in (data["observation"], data["next", "observation"]):
        assert value.isfinite().all()
        assert (value >= spec.space.low[:, None]).all() and (value <= spec.space.high[:, None]).all()
    assert data["next", "reward"].isfinite().all()
    assert not data["next", "terminated"].any()
    check_env_specs(TransformedEnv(env, Compose(StepCounter(), RewardSum())))


def test_starts_settled(env):
    """The start is in equilibrium: held commands for 0.5 s move the tip by less than 2 mm, the same in all worlds."""
    env.reset()
    start = env.tip()
    assert torch.equal(start[0], start[1])
    for _ in range(10):
        act(env, torch.zeros(3, CABLES))
    assert (env.tip() - start).norm(dim=-1).max() < 2e-3


@pytest.mark.slow  # test_envs has four environments, this one among them
@pytest.mark.parametrize("path", ["scalar", "lanes"])
def test_world_equals_alone(path):
    """World i of 11 has the bits of the same seed alone on the same solver path, through actions and two episodes."""
    batch = make(num_worlds=11, solver_path=path)
    batch.seed_worlds(list(range(11)))
    actions = actions_of(6, 11)
    worlds = (0, 9)
    singles = [make(num_worlds=1, solver_path=path) for _ in worlds]
    for single, world in zip(singles, worlds, strict=True):
        single.seed_worlds([world])
    for _ in range(2):
        first = batch.reset()
        for single, world in zip(singles, worlds, strict=True):
            assert torch.equal(single.reset()["observation"][0], first["observation"][world])
        for action in actions:
            together = act(batch, action)
            for single, world in zip(singles, worlds, strict=True):
                alone = act(single, action[world : world + 1])
                for key in ("observation", "reward", "distance"):
                    assert torch.equal(alone[key][0], together[key][world]), key


def test_float64():
    """In double precision the same episode, with float32 at the border, to rounding and its growth over 10 actions."""
    tips = []
    for precision in ("float32", "float64"):
        env = make(num_worlds=2, precision=precision)
        env.reset()
        data = [act(env, a) for a in actions_of(10, 2)]
        assert data[-1]["observation"].dtype == data[-1]["reward"].dtype == torch.float32
        tips.append(env.tip())
    torch.testing.assert_close(*tips, atol=1e-3, rtol=0)


def test_poisoned_world_is_isolated(env):
    """NaN written into one world's state: reported, ended, finite; the others keep their bits and it heals at reset."""
    sequences = []
    for poison in (False, True):
        env.set_seed(3)
        env.reset()
        act(env, actions_of(1, 3)[0])
        if poison:
            env.sim.node_x[1] = torch.nan
        data = [act(env, a) for a in actions_of(2, 3, seed=4)]
        sequences.append(torch.stack([d["observation"] for d in data]))
        if poison:
            assert data[0]["world_status"].flatten().tolist() == [0, 3, 0]
            assert data[0]["terminated"].flatten().tolist() == [False, True, False]
            assert all(d[key].isfinite().all() for d in data for key in ("observation", "reward", "distance"))
    assert torch.equal(sequences[0][:, [0, 2]], sequences[1][:, [0, 2]])
    env.reset()
    assert act(env, torch.zeros(3, CABLES))["world_status"].sum() == 0


def test_absurd_force_is_isolated(env):
    """A world torn at by an absurd force neither harms its neighbours nor returns non-finite values."""
    env.set_seed(3)
    env.reset()
    env.sim.control.node_force[1] = 1.0e12
    data = act(env, torch.zeros(3, CABLES))
    assert data["terminated"].flatten().tolist() == [False, True, False]
    assert data["observation"].isfinite().all() and data["reward"].isfinite().all()
    env.reset()


def test_branching_copies_a_world(env):
    """One world into all: the same action gives the same bits in each."""
    env.set_seed(2)
    env.reset()
    act(env, actions_of(1, 3)[0])
    env.restore(env.snapshot([1]))
    data = act(env, actions_of(1, 1)[0].expand(3, -1).clone())
    assert torch.equal(data["observation"][0], data["observation"][1])
    assert torch.equal(data["observation"][0], data["observation"][2])


def test_continuous_action_moves_commands_in_equal_parts(env):
    """+1 on one cable: 1 mm more in each of the five sub-steps, 5 mm at the end, exactly; out of range counts as 1."""
    env.reset()
    seen = []
    step = env.sim.step
    env.sim.step = lambda: (seen.append(env.sim.control.cable_displacement[0, 0].item()), step())
    try:
        action = torch.zeros(3, CABLES)
        action[:, 0] = 7.0
        act(env, action)
    finally:
        del env.sim.step
    assert seen == pytest.approx([0.001, 0.002, 0.003, 0.004, 0.005], abs=1e-7)


def test_commands_never_wind_up():
    """60 actions against each limit stop at the limits; reversing takes effect with the first action."""
    env = make(num_worlds=2)
    env.reset()
    action = torch.zeros(2, CABLES)
    action[0, 4], action[1, 0] = 1.0, -1.0
    for _ in range(60):
        act(env, action)
    assert env.command[0, 4].item() == pytest.approx(0.040)
    slack = env.sim.cable_displacement[1, 0] - env.command[1, 0]
    assert slack <= 0.005 + 1e-3
    before = env.command.clone()
    act(env, -action)
    assert (env.command - before)[0, 4].item() == pytest.approx(-0.005)


def test_discrete_actions_are_the_papers():
    """0-7 shorten, 8-15 lengthen one cable by 5 mm."""
    env = make(num_worlds=16, action_kind="discrete", clamp_commands=False)
    env.reset()
    act(env, torch.arange(16))
    expected = 0.005 * torch.cat((torch.eye(8), -torch.eye(8)))
    torch.testing.assert_close(env.command, expected)


def test_absolute_action_is_approached_at_limited_speed():
    env = make(num_worlds=1, action_kind="absolute")
    env.reset()
    for _ in range(20):
        act(env, torch.full((1, CABLES), -1.0 / 11.0))  # 10 mm for long cables between -40 and 70
        assert env.command.abs().max() <= 0.05
    torch.testing.assert_close(env.command[0, :4], torch.full((4,), 0.010), atol=1e-4, rtol=0)


def test_pulling_bends_to_that_side():
    """Each long cable moves the tip towards its own side, compared with holding still."""
    from softwarp.meshing.trunk_geometry import CABLE_SIDES

    env = make(num_worlds=5)
    env.reset()
    action = torch.zeros(5, CABLES)
    action[:4, :4] = 2.0 * torch.eye(4) - 1.0
    for _ in range(4):
        act(env, action)
    moved = env.tip()[:4, :2] - env.tip()[4, :2]
    along = (moved * torch.tensor(CABLE_SIDES)).sum(dim=1)
    assert (along > 2e-3).all(), along


def test_compact_observation_is_what_it_says(env):
    data = env.reset()
    for action in actions_of(3, 3):
        data = act(env, action)
    view = {name: data["observation"][:, part] for name, part in env.observation_layout.items()}
    assert [(name, value.shape[1]) for name, value in view.items()] == [(name, size) for name, size, _ in COMPACT]
    tip, goal = env.tip(), env.goal
    torch.testing.assert_close(view["tip"] * 0.1, tip)
    torch.testing.assert_close(view["goal"] * 0.1, goal)
    torch.testing.assert_close(view["error"] * 0.05, goal - tip)
    torch.testing.assert_close(view["command"] * 0.05, env.command)
    torch.testing.assert_close(view["tension"] * 10.0, env.sim.cable_tension.float())
    torch.testing.assert_close(data["distance"][:, 0], (goal - tip).norm(dim=1))


def test_paper_observation_is_what_it_says():
    """66 metres: stations from the base (0, 0, 0) to the tip, then the goal, displaced on request."""
    env = make(num_worlds=2, observation="paper", settle=False)
    observation = env.reset()["observation"]
    assert observation.shape == (2, 66)
    torch.testing.assert_close(observation[:, :3], torch.zeros(2, 3), atol=1e-6, rtol=0)
    torch.testing.assert_close(observation[:, 60:63], torch.tensor([[0.0, 0.0, 0.18437]] * 2), atol=1e-5, rtol=0)
    torch.testing.assert_close(observation[:, 63:], env.goal)
    shifted = make(num_worlds=2, observation="paper", settle=False, goal_offset=True).reset()["observation"]
    torch.testing.assert_close(shifted[:, 63:] - observation[:, 63:], torch.tensor([[0.0, -0.1, 0.1]] * 2))


def test_workspace_goals():
    """Splits are disjoint, goals lie within the jitter of their split's points, and vary."""
    table = torch.from_numpy(reachable_points())
    cut = int(0.8 * len(table))
    assert len(table) >= 2000
    assert len({tuple(row) for row in table.tolist()}) == len(table)
    for split, rows in (("train", table[:cut]), ("eval", table[cut:])):
        env = make(num_worlds=2, goal_split=split, settle=False)
        goals = []
        for _ in range(20):
            env.reset()
            goals.append(env.goal.clone())
        goals = torch.cat(goals)
        offset = (goals[:, None] - rows[None]).abs().amax(dim=-1).amin(dim=1)
        assert offset.max() <= 0.002 + 1e-6
        assert len(torch.unique(goals, dim=0)) == 40


def test_list_goals():
    env = make(num_worlds=2, goals="list", settle=False)
    seen = set()
    for _ in range(12):
        env.reset()
        seen |= {tuple(round(x, 4) for x in goal) for goal in env.goal.tolist()}
    assert seen == {(0.04, 0.04, 0.1), (-0.01, 0.02, 0.08)}


def test_shaped_reward(env):
    """Terms by their formulas, from the distances that the steps report."""
    previous = env.reset()["distance"][:, 0]
    action = actions_of(1, 3)[0]
    data = act(env, action)
    distance = data["distance"][:, 0]
    expected = (previous - distance) / 0.01 + 1 / (1 + (distance / 0.01) ** 2) - 0.01 * action.square().mean(dim=1)
    torch.testing.assert_close(data["reward"][:, 0], expected)


def test_paper_config():
    """SofaGym's task: 16 actions, 66 numbers, two goals, 1 mm, ends at success, clipped relative progress."""
    env = registry.make("Trunk", num_worlds=2, seed=0, config=TrunkConfig.paper(mesh="coarse"))
    previous = env.reset()["distance"]
    assert env.action_count == 16 and env.observation_spec["observation"].shape == (2, 66)
    data = act(env, torch.tensor([0, 3]))
    expected = ((previous - data["distance"]) / previous).clamp(0, 1).sqrt()
    torch.testing.assert_close(data["reward"], expected)
    env.goal.copy_(env.tip())
    env.goal[1] += 0.5
    stopped = act(env, torch.tensor([0, 3]))
    assert stopped["success"].tolist() == stopped["terminated"].tolist()


def test_success_tolerance():
    """5 mm by default."""
    env = make(num_worlds=2)
    env.reset()
    env.goal.copy_(env.tip() + torch.tensor([[0.004, 0.0, 0.0], [0.007, 0.0, 0.0]]))
    data = act(env, torch.zeros(2, CABLES))
    assert data["success"].flatten().tolist() == [True, False]
    assert not data["terminated"].any()


def test_randomization():
    """Modulus, damping and gravity are drawn in their ranges, per world, at that world's reset only."""
    tilt = 0.2
    env = make(num_worlds=3, youngs_range=(3e5, 6e5), damping_range=(0.5, 2.0), gravity_tilt=tilt, settle=False)
    env.reset()
    params = env.sim.params
    youngs, gravity = params.youngs.clone(), params.gravity.clone()
    assert len(torch.unique(youngs)) == 3
    assert (youngs >= 3e5).all() and (youngs <= 6e5).all()
    assert (params.rayleigh_mass >= 0.05 - 1e-6).all() and (params.rayleigh_mass <= 0.2 + 1e-6).all()
    torch.testing.assert_close(params.rayleigh_stiffness, params.rayleigh_mass)
    torch.testing.assert_close(gravity.norm(dim=1), torch.full((3,), 9.81))
    assert (-gravity[:, 1] / 9.81 >= math.cos(tilt) - 1e-6).all()
    env.reset_where(torch.tensor([True, False, False]))
    assert torch.equal(params.youngs[1:], youngs[1:]) and not torch.equal(params.youngs[:1], youngs[:1])
    assert torch.equal(params.gravity[1:], gravity[1:])


def test_randomized_modulus_changes_the_motion():
    """A softer trunk sags further in the same time."""
    tips = []
    for youngs in (3e5, 6e5):
        env = make(num_worlds=1, youngs_range=(youngs, youngs))
        env.reset()
        for _ in range(5):
            act(env, torch.zeros(1, CABLES))
        tips.append(env.tip()[0, 1].item())
    assert tips[0] < tips[1] - 1e-3


@pytest.mark.parametrize(
    ("kind", "observation"), [("continuous", "compact"), pytest.param("discrete", "paper", marks=pytest.mark.slow)]
)
def test_baseline_gets_closer_than_doing_nothing(kind, observation):
    """From observations alone, 40 actions bring the tip closer to 32 goals on average."""
    env = make(num_worlds=32, action_kind=kind, observation=observation, max_episode_steps=100)
    start = env.reset()["distance"].mean()
    data = env.rollout(40, trunk_baseline(env), break_when_any_done=False)
    assert data["next", "distance"][:, -1].mean() < 0.8 * start


def test_config_composes_with_omegaconf():
    """Every option has a type that Hydra's structured configs know, and survives a round trip."""
    from omegaconf import OmegaConf

    schema = OmegaConf.structured(TrunkConfig)
    merged = OmegaConf.merge(schema, {"mesh": "coarse", "youngs_range": [3e5, 6e5], "goal_list": [[0.0, 0.1, 0.1]]})
    config = OmegaConf.to_object(merged)
    assert config == TrunkConfig(mesh="coarse", youngs_range=(3e5, 6e5), goal_list=[[0.0, 0.1, 0.1]])
    assert config.youngs_range == (3e5, 6e5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"action_kind": "contnuous"}, r"unknown action_kind 'contnuous'.*'continuous'"),
        ({"mesh": "corse"}, r"trunk mesh 'corse' is neither a file nor one of.*'coarse'"),
        ({"youngs_range": (5.0, 1.0)}, "youngs_range must be"),
        ({"goals": "list", "goal_list": [[0.0, 0.0, 0.1], [0.0, 0.0, 9.0]]}, r"goal_list must lie within 0\.\d+ m of"),
        ({"min_tension": 10.0}, r"min_tension must be at most 2 N, got 10.0: .* youngs is 450000 Pa; make"),
        ({"min_tension": 2.0, "element": "p2"}, r"NONFINITE.*loads \(a min_tension of 2 N pulls all the time\)"),
        ({"goal_list": [[0.1, 0.2]]}, r"goal_list must hold points \(x, y, z\)"),
        ({"max_displacement": (0.01, -0.03)}, "displacement limits must be finite and rising"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)


@pytest.mark.slow
def test_quadratic_elements():
    """``element="p2"``: the tip hangs lower under its weight than with linear ones, and actions work."""
    heights = {}
    for element in ("p1", "p2"):
        env = make(num_worlds=1, element=element)
        env.reset()
        heights[element] = float(env.tip()[0, 1])
        assert int(act(env, actions_of(1, 1)[0])["world_status"]) == 0
    assert heights["p2"] < heights["p1"] - 0.010
