"""MultiGaitFull: actions and ramps, observations, goals, rewards, bad options, the hand-written policy."""

import functools

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from softwarp.envs import registry
from softwarp.envs.options.multi_gait_full import MultiGaitFullConfig
from softwarp.envs.tasks.multi_gait_full import ARM, LAYOUT, MultiGaitFull
from softwarp.policies.baselines.multi_gait import GAIT, multi_gait_baseline

QUICK = {"action_repeat": 4, "ramp": 2, "settle": False}
CENTRE, LEG = 2.0e-6, 1.5e-6


def make(num_worlds=2, seed=1, **options):
    return registry.make("MultiGaitFull", num_worlds=num_worlds, seed=seed, **(QUICK | options))


def act(env, action):
    """One action, the same in all worlds."""
    if env.action_count:
        value = torch.full((env.num_worlds,), int(action))
    else:
        value = torch.as_tensor(action, dtype=torch.float32).expand(env.num_worlds, env.action_size).clone()
    return env.step(TensorDict({"action": value}, batch_size=env.batch_size))["next"]


@pytest.fixture(scope="module")
def env():
    """One environment shared by the tests that reset it themselves."""
    return make()


@pytest.fixture(scope="module")
def turning():
    """Environments with headings for goals, one for each kind of action, which the tests reset themselves."""
    return functools.cache(
        lambda kind: make(num_worlds=32, seed=3, action_kind=kind, chambers="each", goals="headings")
    )


def test_ramps_take_the_same_sub_steps_every_time(env):
    """A volume moves by max / ramp per sub-step and is there after exactly ramp of them, whatever came before."""
    env.reset()
    action = torch.full((2,), 0)
    for start, choice, end in ((0.0, 0, CENTRE), (CENTRE, 3, 0.0), (0.0, 0, CENTRE)):
        action.fill_(choice)
        for substep, share in enumerate((0.5, 1.0, 1.0, 1.0)):
            env.apply_action(action, substep)
            expected = start + share * (end - start)
            np.testing.assert_allclose(env.growth[:, 0], expected, atol=1e-12)
            command = env.sim.control.cavity_volume[:, env.scene.chambers[0]] - env._rest_volume[0]
            np.testing.assert_allclose(command, expected, atol=1e-12)
    assert (env.growth[:, 1:] == 0.0).all()


@pytest.mark.parametrize(
    ("choice", "filled"),
    [
        (1, [0, 0, 0, LEG, LEG]),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in ((0, [CENTRE, 0, 0, 0, 0]), (2, [0, LEG, LEG, 0, 0]))
        ),
    ],
)
def test_symmetric_choices(env, choice, filled):
    """0 to 2 fill centre, rear, front; 3 to 5 empty the same and leave the others."""
    env.reset()
    act(env, choice)
    np.testing.assert_allclose(env.growth, [filled] * 2, atol=1e-12)
    act(env, (choice + 1) % 3)
    act(env, choice + 3)
    now = env.growth.clone()
    assert (now[:, np.array(filled) > 0.0] == 0.0).all() and float(now.max()) > 1.0e-6


@pytest.mark.slow  # what holds a volume is tested with smaller bodies in test_cavity_control
def test_volumes_are_reached():
    """Where an action's 60 sub-steps end, chambers hold what was commanded to 0.1 % of the largest."""
    env = make(num_worlds=1, action_repeat=60, ramp=15)
    env.reset()
    for choice in (1, 0):
        act(env, choice)
        volume = env.sim.cavity_volume[:, list(env.scene.chambers)] - env._rest_volume
        np.testing.assert_allclose(volume, env.growth, atol=1.5e-9)


def test_chambers_apart(turning):
    """Ten choices, and five continuous volumes in the order of the scene; the hand-written policy is told."""
    env = make(chambers="each")
    env.reset()
    act(env, 3)
    np.testing.assert_allclose(env.growth[0], [0, 0, 0, LEG, 0], atol=1e-12)
    act(env, 8)
    assert (env.growth == 0.0).all()
    with pytest.raises(ValueError, match="needs chambers='symmetric', got 'each'"):  # it fills left and right alike
        multi_gait_baseline(env)
    env = turning("continuous")
    env.reset()
    act(env, [-1.0, 0.0, 1.0, -1.0, -0.5])
    np.testing.assert_allclose(env.growth[0], [0, 0.5 * LEG, LEG, 0, 0.25 * LEG], atol=1e-12)


def test_observation_tells_what_it_says(env):
    """At the start nothing but rounding; then shares, pressures, place and shape in SI units."""
    first = env.decode(env.reset()["observation"])
    assert sum(size for _, size, _ in LAYOUT) == env.observation_spec["observation"].shape[-1] == 68
    for name in ("share", "shape", "velocity", "heading", "turn"):
        assert float(first[name].abs().max()) < 1e-5
    told = env.decode(act(env, 1)["observation"])
    np.testing.assert_allclose(told["share"][0], [0, 0, 0, 1, 1], atol=1e-6)
    assert (told["pressure"][:, 3:] > 5e3).all()
    np.testing.assert_allclose(told["place"], env.position()[:, :2], atol=1e-7)
    np.testing.assert_allclose(told["heading"][:, 0], env.heading(), atol=1e-6)


def test_reward_is_progress_in_centimetres(env):
    """Change of the mean of the tracked points along x / 1 cm; paper: the same, never negative."""
    env.reset()
    for choice in (1, 0, 4):
        before = env.position()[:, 0].clone()
        told = act(env, choice)
        won = (env.position()[:, 0] - before) / 0.01
        np.testing.assert_allclose(told["reward"][:, 0], won, atol=2e-4)
        np.testing.assert_allclose(told["distance"][:, 0], 0.2 - env.position()[:, 0], atol=1e-6)
    terms = {kind: _probe(env, kind) for kind in ("progress", "paper")}
    np.testing.assert_allclose(terms["progress"], [-1.0, 1.0], atol=1e-5)
    np.testing.assert_allclose(terms["paper"], [0.0, 1.0], atol=1e-5)


def _probe(env, kind):
    """Reward where one world has lost a centimetre and the other has won one."""
    kept, env.config.reward = env.config.reward, kind
    distance = env.distance + torch.tensor([0.01, -0.01])
    term = env.reward_terms(torch.zeros(2), distance)["progress"]
    env.config.reward = kept
    return term


def test_headings(turning):
    """Goals within their range and drawn per world; distance is the arc of a leg's end; success within 10 degrees."""
    env = turning("discrete")
    told = env.reset()
    assert float(env.goal.abs().max()) <= 0.35 and len(env.goal.unique()) == 32
    np.testing.assert_allclose(told["distance"][:, 0], ARM * env.goal.abs(), atol=1e-6)
    np.testing.assert_array_equal(told["success"][:, 0], env.goal.abs() <= 0.1745)
    np.testing.assert_allclose(env.decode(told["observation"])["turn"][:, 0], env.goal, atol=1e-5)


@pytest.mark.slow
def test_mirrored_commands_mirror_the_motion():
    """Left legs filled in one world, right legs in the other: y and heading change sign, x does not."""
    env = make(chambers="each", action_kind="continuous", settle=True)
    env.reset()
    left, right = [-1.0, 1.0, -1.0, 1.0, -1.0], [-1.0, -1.0, 1.0, -1.0, 1.0]
    env.step(TensorDict({"action": torch.tensor([left, right])}, batch_size=env.batch_size))
    place, turn = env.position(), env.heading()
    np.testing.assert_allclose(place[0] * torch.tensor([1.0, -1.0, 1.0]), place[1], atol=2e-5)
    np.testing.assert_allclose(turn[0], -turn[1], atol=1e-3)


@pytest.mark.parametrize("kind", ["discrete", pytest.param("continuous", marks=pytest.mark.slow)])
def test_policy_is_the_gait_in_either_kind(env, kind):
    """From any state of the gait the next action is the paper's; other states lead back."""
    env = env if kind == "discrete" else make(action_kind=kind)
    policy, now, done = multi_gait_baseline(env), env.reset(), []
    for choice in GAIT:
        wanted = policy(now)["action"]
        if kind == "discrete":
            done.append(int(wanted[0]))
        env.growth.copy_(_after(env.growth, choice))
        now = TensorDict(env.observe(), batch_size=env.batch_size)
    if kind == "discrete":
        assert tuple(done) == GAIT
    assert (env.growth == 0.0).all()


def _after(growth, choice):
    """Volumes after an action of the symmetric kind."""
    growth, groups = growth.clone(), ((0,), (3, 4), (1, 2))
    for chamber in groups[choice % 3]:
        growth[:, chamber] = (CENTRE if chamber == 0 else LEG) if choice < 3 else 0.0
    return growth


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mesh": "fin"}, "unknown mesh 'fin'"),
        ({"law": "neohookean"}, "unknown law 'neohookean'"),
        ({"ramp": 61}, r"ramp must be at most action_repeat \(60\)"),
        ({"goals": "headings"}, "needs chambers='each'"),
        ({"max_growth_leg": 6e-6}, "max_growth_leg"),
        ({"alarm_distance": 1e-4}, "alarm_distance must be at least contact_distance"),
        ({"contact_spacing": 0.05}, "contact_spacing must lie in"),
        ({"nu": 0.5}, "nu"),
        ({"goal_headings": (0.3, -0.3)}, "goal_headings"),
    ],
)
def test_bad_options(options, message):
    """Told with their name, value, what is allowed, and what to do."""
    with pytest.raises(ValueError, match=message):
        MultiGaitFullConfig(**options)


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_policy_turns_by_a_wave_round_the_body(turning, kind):
    """Leg after leg round it; to the left is the mirror image of to the right, and what has turned enough rests."""
    env = turning(kind)
    env.reset()
    env.goal[:3] = torch.tensor([0.3, -0.3, 0.04])
    policy, seen = multi_gait_baseline(env), []
    for _ in range(20 if kind == "discrete" else 10):
        action = policy(TensorDict(env.observe(), batch_size=env.batch_size))["action"]
        if kind == "discrete":
            share = env.growth / env._largest
            chamber = action % 5
            share[torch.arange(32), chamber] = (action < 5).float()
        else:
            share = 0.5 * (action + 1.0)
        env.growth.copy_(share * env._largest)
        seen.append(share.round().long().tolist())
    cycle = 8 if kind == "discrete" else 4
    assert seen[-2 * cycle : -cycle] == seen[-cycle:]
    mirror = [0, 2, 1, 4, 3]
    states = [[tuple(now[w]) for now in seen] for w in range(3)]
    assert {state[0] for state in states[0]} == {0}
    assert set(states[2]) == {(0, 0, 0, 0, 0)}
    mirrored = [tuple(state[c] for c in mirror) for state in states[1]]
    assert mirrored == states[0]
    pairs = [state for state in states[1] if sum(state) == 2]
    assert pairs[:4] == [(0, 1, 1, 0, 0), (0, 0, 1, 0, 1), (0, 0, 0, 1, 1), (0, 1, 0, 1, 0)]
    assert {sum(state) for state in states[1]} == {1, 2}


def test_policy_that_turns_leads_out_of_any_state(turning):
    """From every set of full legs the wave comes about in a few actions; the centre is emptied with continuous ones."""
    env = turning("continuous")
    env.reset()
    env.goal.fill_(-0.3)
    share = torch.tensor([[float(world >> k & 1) for k in range(5)] for world in range(32)])
    policy = multi_gait_baseline(env)
    for _ in range(3):
        env.growth.copy_(share * env._largest)
        action = policy(TensorDict(env.observe(), batch_size=env.batch_size))["action"]
        share = (0.5 * (action + 1.0)).round()
    assert {tuple(map(int, state)) for state in share.tolist()} <= {
        (0, 1, 1, 0, 0), (0, 0, 1, 0, 1), (0, 0, 0, 1, 1), (0, 1, 0, 1, 0)
    }  # fmt: skip


def test_paper_is_sofagyms_scene():
    """Fine mesh, SOFA's rotation and lumping, 60 sub-steps of 10 ms, six actions, Rayleigh 0.1, friction 0.7."""
    config = MultiGaitFullConfig.paper()
    assert config.law == "corotational"
    assert (config.mesh, config.rotation, config.lumping, config.reward) == ("fine", "large", "uniform", "paper")
    assert (config.dt, config.action_repeat, config.max_episode_steps) == (0.01, 60, 6)
    assert (config.rayleigh, config.mu, config.youngs, config.nu) == ((0.1, 0.1), 0.7, 70e3, 0.05)
    assert issubclass(MultiGaitFull, registry.spec("MultiGaitFull").env_class())
