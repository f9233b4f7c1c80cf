"""Gripper: actions, observations, goals, rewards, pulls, parameters of worlds, bad options, the hand-written policy."""

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from softwarp.envs import registry
from softwarp.envs.options.gripper import GripperConfig
from softwarp.envs.tasks.gripper import CHOICES, LIMIT, PAPER, POSE, TOUCH
from softwarp.policies.baselines.table import rule

QUICK = {"finger": "plain"}


def make(num_worlds=3, seed=1, **options):
    return registry.make("Gripper", num_worlds=num_worlds, seed=seed, **(QUICK | options))


def act(env, action):
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]


def held(env):
    """An action that changes nothing."""
    return torch.zeros(env.num_worlds, env.action_size)


@pytest.fixture(scope="module")
def env():
    """One environment shared by the tests that reset it themselves."""
    return make()


@pytest.fixture(scope="module")
def rigid():
    """The same with a rigid cube, touch and a cable of its own for each finger."""
    return make(object="cube", finger="cavities", touch=True, cables="each")


@pytest.fixture(scope="module")
def choosing():
    """One world with SofaGym's choices."""
    return make(1, action_kind="discrete", settle=False)


def test_continuous_actions_move_the_commands(env):
    """x and y by 5 mm, z by 10 mm up and 5 mm down, yaw by 0.15 rad, both cables by 5 mm, reached after the action."""
    env.reset()
    start = env.command.clone()
    act(env, torch.tensor([[1.0, -1.0, 1.0, 1.0, 1.0], [0.5, 0.0, -1.0, 0.0, -1.0], [0.0] * 5]))
    change = env.command - start
    expected = [[0.005, -0.005, 0.010, 0.15, 0.005, 0.005], [0.0025, 0.0, -0.005, 0.0, 0.0, 0.0], [0.0] * 6]
    np.testing.assert_allclose(change, expected, atol=1e-7)
    pose = env.sim.body_pose[:, env.scene.hand]
    np.testing.assert_allclose(pose[:, :3], env.command[:, :3], atol=1e-6)
    np.testing.assert_allclose(2.0 * torch.atan2(pose[:, 5], pose[:, 6]), env.command[:, 3], atol=1e-6)
    np.testing.assert_allclose(env.sim.control.cable_displacement, env.command[:, 4:], atol=1e-9)


def test_each_cable_can_have_its_own(rigid):
    rigid.reset()
    act(rigid, torch.tensor([[0.0, 0.0, 0.0, 0.0, 1.0, 0.2]] * 3))
    np.testing.assert_allclose(rigid.command[:, 4:], [[0.005, 0.001]] * 3, atol=1e-8)


@pytest.mark.parametrize("choice", range(len(CHOICES)))
def test_discrete_actions_are_sofagyms(choosing, choice):
    """Up 10 mm, down 5, +x, -x, +y, -y 5, both cables 5 mm shorter and longer."""
    env = choosing
    env.reset()
    act(env, torch.tensor([6]))
    start = env.command.clone()
    act(env, torch.tensor([choice]))
    expected = np.zeros(6)
    column, value = (
        (2, 0.010),
        (2, -0.005),
        (0, 0.005),
        (0, -0.005),
        (1, 0.005),
        (1, -0.005),
        (4, 0.005),
        (4, -0.005),
    )[choice]
    expected[column] = value
    expected[5] = expected[4]
    np.testing.assert_allclose((env.command - start)[0], expected, atol=1e-7)


def test_commands_stay_in_their_limits(env):
    env.reset()
    for _ in range(20):
        act(env, torch.tensor([[1.0, 1.0, 1.0, 1.0, 1.0], [-1.0, -1.0, -1.0, -1.0, -1.0], [0.0] * 5]))
    config = env.config
    limits = (config.hand_x, config.hand_y, config.hand_z, config.hand_yaw, (0.0, 0.020), (0.0, 0.020))
    np.testing.assert_allclose(env.command[0], [high for _, high in limits], atol=1e-6)
    np.testing.assert_allclose(env.command[1], [low for low, _ in limits], atol=1e-6)


def test_observation_tells_the_scene(env):
    """Every quantity in SI units, against the simulation."""
    env.reset()
    data = act(env, torch.tensor([[0.5, -0.5, -1.0, 0.3, 0.5]] * 3))
    told = env.decode(data["observation"])
    sim, scene = env.sim, env.scene
    first, last = sim.model.body_node_start[scene.object : scene.object + 2]
    middle = sim.node_x[:, first:last].mean(dim=1)
    np.testing.assert_allclose(told["hand"], env.command[:, :3], atol=1e-6)
    np.testing.assert_allclose(told["hand"] + told["object"], middle, atol=1e-5)
    np.testing.assert_allclose(torch.atan2(*told["yaw"].unbind(dim=1)), env.command[:, 3], atol=1e-5)
    np.testing.assert_allclose(told["height"][:, 0], middle[:, 2], atol=1e-5)
    np.testing.assert_allclose(told["tips"].reshape(3, 2, 3) + middle[:, None], sim.marker_x, atol=1e-5)
    np.testing.assert_allclose(told["cables"], env.command[:, 4:], atol=1e-6)
    np.testing.assert_allclose(told["tensions"], sim.cable_tension, rtol=1e-4)
    np.testing.assert_allclose(told["error"][:, 2], env.goal[:, 2] - middle[:, 2], atol=1e-5)
    np.testing.assert_allclose(told["error"][:, 2].abs(), data["distance"][:, 0], atol=1e-6)
    np.testing.assert_allclose(told["goal"], env.goal, atol=1e-6)
    ex, ey = told["axes"][:, :3], told["axes"][:, 3:]
    np.testing.assert_allclose((ex * ey).sum(dim=1), 0.0, atol=1e-5)
    turn = env.draw(1, 3)[:, 2] * 1.2 - 0.6
    np.testing.assert_allclose(torch.atan2(ex[:, 1], ex[:, 0]), turn, atol=1e-3)


def test_rigid_and_soft_cubes_are_observed_alike(env, rigid):
    """The same draws put both at the same place, with the same axes and corners."""
    for other in (env, rigid):
        other.set_seed(6)
        other.reset()
    np.testing.assert_allclose(env.object_position(), rigid.object_position(), atol=1e-4)
    np.testing.assert_allclose(env.corners(), rigid.corners(), atol=3e-4)
    for a, b in zip(env.object_axes(), rigid.object_axes(), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-3)


@pytest.mark.parametrize(
    ("kind", "size", "touch"),
    [
        ("pose", 39, True),
        ("nodes", 54, False),
        ("paper", 31, True),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (("pose", 39, False), ("nodes", 54, True), ("paper", 31, False))
        ),
    ],
)
def test_observation_sizes(kind, size, touch):
    env = make(1, observation=kind, touch=touch, finger="cavities", settle=False)
    observation = env.reset()["observation"]
    assert observation.shape == (1, size + 14 * touch)
    assert sum(entries for _, entries, _ in PAPER) == 31 and sum(entries for _, entries, _ in POSE) == 39
    assert (observation.abs() <= LIMIT).all()


def test_touch_feels_the_object(rigid):
    """Before contact no force; in the grasp both fingers are pushed outwards, and the pressures are those told."""
    rigid.reset()
    policy, data = rule(rigid, "Gripper"), rigid.reset()
    assert (rigid.finger_forces() == 0.0).all()
    for _ in range(45):
        data = rigid.step(policy(data))["next"]
    start = sum(size for _, size, _ in POSE)
    told = data["observation"][:, start:] * torch.tensor([d for _, size, d in TOUCH for _ in range(size)])
    np.testing.assert_allclose(told[:, :8], rigid.sim.cavity_pressure, rtol=1e-3, atol=1.0)
    forces = told[:, 8:].reshape(3, 2, 3)
    np.testing.assert_allclose(forces, rigid.finger_forces(), rtol=1e-4, atol=1e-3)
    apart = rigid.sim.marker_x[:, 0] - rigid.sim.marker_x[:, 1]
    assert ((forces[:, 0] - forces[:, 1]) * apart).sum(dim=1).gt(0.1).all()
    np.testing.assert_allclose(forces.sum(dim=1)[:, 2], -rigid.mass * 9.81, rtol=0.02)


def test_goals_are_drawn_where_they_should_be():
    env = make(64, object="cube", settle=False)
    env.reset()
    low, high = env.config.goal_z
    assert (env.goal[:, 2] >= low).all() and (env.goal[:, 2] <= high).all() and env.goal[:, 2].std() > 0.02
    np.testing.assert_allclose(env.goal[:, :2], env.object_position()[:, :2], atol=1e-6)
    np.testing.assert_allclose(env.first_distance, env.goal[:, 2] - env.object_position()[:, 2], atol=1e-6)
    listed = make(64, object="cube", settle=False, goals="list", goal_heights=(0.06, 0.1))
    listed.reset()
    assert sorted(set(listed.goal[:, 2].tolist())) == pytest.approx([0.06, 0.1])
    places = make(64, object="cube", settle=False, goals="places")
    places.reset()
    assert places.goal[:, :2].std(dim=0).min() > 0.01
    away = torch.linalg.vector_norm(places.goal - places.object_position(), dim=1)
    np.testing.assert_allclose(places.measure_distance(), away, rtol=1e-6)


def test_dense_reward_is_at_most_two(env):
    """lift 1 - d / d0, hold 1 within 3 mm, and a cost of fingertips that are far."""
    env.reset()
    env.first_distance.fill_(0.1)
    lifts = [env.reward_terms(held(env), torch.full((3,), d)) for d in (0.1, 0.05, 0.002, 0.0, 0.5)]
    assert [terms["lift"][0].item() for terms in lifts] == pytest.approx([0.0, 0.5, 0.98, 1.0, -1.0])
    assert [terms["hold"][0].item() for terms in lifts] == [0.0, 0.0, 1.0, 1.0, 0.0]
    middle, tips = env.object_position(), env.tips().mean(dim=1)
    way = torch.linalg.vector_norm(tips - middle, dim=1)
    np.testing.assert_allclose(lifts[0]["approach"], -0.2 * (way - 0.02) / 0.1, rtol=1e-5)
    assert env.reward_range == pytest.approx((-1.4, 2.0))
    assert sum(2.0 * 0.99**k for k in range(250)) == pytest.approx(183.8, abs=0.05)


def test_reward_of_the_paper():
    env = make(1, reward="paper", settle=False)
    env.reset()
    env.distance.fill_(0.050)
    terms = [env.reward_terms(held(env), torch.tensor([d])) for d in (0.060, 0.040, 0.010, 0.003)]
    assert [t["progress"].item() for t in terms] == pytest.approx([0.0, 0.5, 1.0, 1.0])
    assert [t["goal"].item() for t in terms] == [0.0, 0.0, 0.0, 1.0]
    assert env.reward_range == (0.0, 2.0)


def test_worlds_differ_as_asked():
    """Mass, modulus, friction and growth are drawn per world, apply to the simulation, and stay in a masked reset."""
    options = {
        "object_mass": (0.05, 0.2),
        "object_youngs": (2e5, 8e5),
        "object_growth": (0.0, 4e-3),
        "mu": (0.5, 1.0),
    }
    env = make(16, **options)
    env.reset()
    params, scene = env.sim.params, env.scene
    first, last = env.sim.model.body_node_start[scene.object : scene.object + 2]
    mass = env.sim.mass[:, first:last].sum(dim=1)
    np.testing.assert_allclose(mass, env.mass, rtol=1e-4)

    def drawn():
        return {
            "object_mass": env.mass.clone(),
            "object_youngs": params.youngs[:, scene.object].clone(),
            "mu": params.pair_mu[:, scene.holds[0]].clone(),
            "object_growth": params.pair_contact_distance[:, scene.holds[0]] - env.config.contact_distance,
        }

    before = drawn()
    for name, values in before.items():
        low, high = options[name]
        assert (values >= low - 1e-9).all() and (values <= high * (1 + 1e-6)).all(), name
        assert values.std() > 0.15 * (high - low), name
    is_reset = torch.arange(16) == 3
    env.reset_where(is_reset)
    for name, values in drawn().items():
        assert torch.equal(values != before[name], is_reset), name


@pytest.mark.parametrize("thing", ["soft_cube", "sphere"])
def test_growth_makes_an_object_larger(thing):
    """A grown object rests higher by its growth, still, and the fingers meet it earlier."""
    env = make(2, object=thing, object_growth=(0.0, 4e-3))
    env.reset()
    growth = env.sim.params.pair_contact_distance[:, env.scene.holds[0]] - env.config.contact_distance
    assert (growth[0] - growth[1]).abs() > 3e-4
    height = env.object_position()[:, 2].clone()
    np.testing.assert_allclose(height, 0.0205 + growth, atol=1e-4)
    for _ in range(5):
        act(env, held(env))
    np.testing.assert_allclose(env.object_position()[:, 2], height, atol=1e-4)


@pytest.mark.parametrize("thing", [pytest.param("soft_cube", marks=pytest.mark.slow), "cube"])
def test_pull_is_a_wrench_on_the_object(thing):
    """Forces lie in the cone, at most ``pull`` weights, new in every action; moments are what was drawn."""
    env = make(32, object=thing, pull=0.5, pull_cone=0.5, pull_turn=0.4)
    env.reset()
    forces = []
    for _ in range(2):
        act(env, held(env))
        if env.scene.is_soft:
            loads = env.sim.control.node_force[:, env._nodes]
            force = loads.sum(dim=1)
        else:
            force = env.sim.control.body_force[:, env.scene.object, :3]
        forces.append(force.clone())
    weight = (env.mass * 9.81)[:, None]
    size = torch.linalg.vector_norm(forces[1], dim=1, keepdim=True)
    assert (size <= 0.5 * weight * (1 + 1e-5)).all() and (size / weight).mean() > 0.15
    assert (-forces[1][:, 2:] >= math.cos(0.5) * size * (1 - 1e-4)).all()
    assert not torch.isclose(forces[0], forces[1]).any(dim=1).all()
    assert len({round(float(x), 7) for x in forces[1][:, 2]}) > 28
    repeated = make(32, object=thing, pull=0.5, pull_cone=0.5, pull_turn=0.4)
    repeated.reset()
    for _ in range(2):
        act(repeated, held(repeated))
    assert torch.equal(env.object_position(), repeated.object_position())


def test_moment_on_a_soft_object_is_the_one_drawn():
    """Nodal forces M x r / (2/3 sum r^2) add up to no force and to the moment M."""
    env = make(4, pull_turn=0.5, pull=0.0)
    env.reset()
    nodes = env.sim.node_x[:, env._nodes].clone()
    env._pull()
    loads = env.sim.control.node_force[:, env._nodes]
    away = nodes - env.object_position()[:, None]
    moment = torch.linalg.cross(away, loads).sum(dim=1)
    from softwarp.envs import randomization

    number = env._episode * (1 << 20) + env.step_count
    u = randomization.uniform(env._seeds, env._streams, number, 6, 6)[:, 3:]
    expected = (env.mass * 9.81)[:, None] * (0.5 * 0.04 * 0.5) * (2.0 * u - 1.0)
    np.testing.assert_allclose(moment, expected, rtol=0.02, atol=2e-5)
    np.testing.assert_allclose(loads.sum(dim=1), 0.0, atol=1e-3 * float(loads.abs().max()))


BAD = [
    ({"object_size": 0.08}, r"object_size must lie in \[0.032, 0.07\] m, what the hand can hold, got 0.08 m"),
    ({"object_size": 0.02}, "what the hand can hold, got 0.02 m"),
    ({"min_tension": 1000.0, "settle": False}, "min_tension must be at most 200 N, got 1000.0"),
    ({"min_tension": 150.0, "finger": "plain"}, "min_tension must be at most 100 N, got 150.0"),
    ({"min_tension": 51.0, "element": "p2"}, "min_tension must be at most 50 N, got 51.0"),
    ({"object_growth": (0.0, 0.018)}, r"got 0.04 m with object_growth \(0.0, 0.018\)"),
    ({"hand_start": 0.1, "object_x": (-0.03, 0.03)}, "the object would start inside a finger"),
    ({"goal_z": (0.06, 0.3)}, r"goal_z must lie in \[0.02, 0.185\] m, between the object at rest and what the hand"),
    ({"goals": "list", "goal_heights": (0.001,)}, "goal_heights must lie in"),
    ({"goals": "list", "goal_heights": ()}, "goal_heights must hold at least one height"),
    ({"goals": "places", "goal_x": (-0.1, 0.1)}, "goal_x must lie within hand_x"),
    ({"object_y": (-0.1, 0.1)}, "object_y must lie within hand_y"),
    ({"touch": True, "finger": "plain"}, "touch=True needs fingers with cavities, the finger 'plain' has none"),
    ({"object": "ball"}, "unknown object 'ball'; "),
    ({"hand_z": (0.05, 0.26)}, "hand_z must begin at 0.087 m or higher"),
    ({"hand_start": 0.3}, "hand_start must lie within hand_z"),
    ({"pull_cone": 4.0}, "pull_cone must"),
    ({"mu": (0.9, 0.2)}, "mu must be"),
    ({"mu": (0.0, 0.0)}, r"mu must begin at 0.0062 or higher, got \(0.0, 0.0\): nothing but friction lifts an object"),
    ({"mu": (0.05, 0.8), "object_mass": (0.1, 1.0)}, "press 1 kg by no more than 80 N each; make mu or youngs larger"),
    ({"mu": (0.0, 0.5), "gravity": (0.0, 0.0, 0.0)}, "mu must begin at 0.0001 or higher"),
    ({"hand_z": (0.15, 0.26)}, "hand_z must begin at 0.0995 m or lower, so that fingers come down"),
    ({"hand_yaw": (0.5, 1.0)}, "hand_yaw must hold 0, where the hand starts"),
    ({"max_displacement": 0.005}, "max_displacement must be 0.0097 m or more, or the fingers do not close"),
    ({"max_displacement": 0.2}, "max_displacement must be 0.025 m or less, got 0.2: the fingers meet before"),
    ({"max_speed": 1e-9}, r"max_speed must be 0\.0\d+ m/s or more, so that the hand gets down to the object and up"),
    ({"down_step": 1e-6}, r"down_step must be 0\.000\d+ m or more, or 250 actions do not suffice"),
    ({"up_step": 1e-5}, "up_step must be 0.00016 m or more"),
    ({"cable_step": 1e-5}, "cable_step must be 3.9e-05 m or more"),
    ({"contact_distance": 0.5}, "contact_distance must be less than 0.032 m, the room between an object"),
    ({"gravity": (0.0, 0.0, 9.81)}, "gravity must press the object onto the floor"),
    ({"gravity": (9.0, 0.0, -9.81)}, "within the cone of its friction mu 0.8"),
    ({"action_kind": "discrete", "cables": "each"}, "cables='each' needs action_kind='continuous'"),
    ({"gravity": (0.0, 0.0, 0.0), "pull": 0.2}, "pull and pull_turn are in parts of the weight"),
]


def test_options_at_the_edge_are_taken():
    """What still works is not refused: weightless, tilted within friction, little of it, a narrow range of the hand."""
    GripperConfig(mu=(0.0062, 0.0062))
    for options in ({"gravity": (0.0, 0.0, 0.0)}, {"gravity": (7.8, 0.0, -9.81)}, {"hand_z": (0.0995, 0.26)}):
        GripperConfig(**options)
    GripperConfig(hand_yaw=(0.0, 0.0), max_displacement=0.012, action_kind="discrete")
    GripperConfig(max_displacement=0.025, max_speed=0.01, max_episode_steps=3, dt=1e-4)  # short tests
    with pytest.raises(ValueError, match="max_speed"):
        GripperConfig(max_speed=0.005)
    GripperConfig(max_speed=0.005, max_episode_steps=1000)


@pytest.mark.slow
@pytest.mark.parametrize("finger", ["cavities", "plain"])
def test_fingers_bear_the_largest_pull_that_is_taken(finger):
    """At 25 mm of cable no step fails and no element is inside out; then the fingers meet and give some of it back."""
    env = make(1, finger=finger, max_displacement=0.025)
    env.reset()
    action = torch.zeros(1, env.action_size)
    action[:, -1] = 1.0
    largest = torch.zeros(1, 2)
    for _ in range(40):
        data = env.step(env.reset_where(torch.tensor([False])).set("action", action))["next"]
        assert data["world_status"].item() < 3 and env.sim.inverted_count.item() == 0
        largest = torch.maximum(largest, env.sim.cable_displacement)
    assert largest.min() > 0.0249


@pytest.mark.slow
def test_fingers_close_as_the_check_of_max_displacement_takes_it():
    """Tips are 104 mm apart, and no more than 6.6 mm nearer for a mm of cable: weightless, away from the object."""
    env = make(3, object="sphere", object_size=0.032, gravity=(0.0, 0.0, 0.0), settle=False)
    env.reset()
    sim, starts = env.sim, env.sim.model.body_node_start
    shortened = torch.tensor([0.0, 0.005, 0.010])
    sim.control.cable_displacement[:] = shortened[:, None]
    sim.step(60)
    below = env.config.hand_start - 0.05
    gaps = []
    for world in range(3):
        tips = [sim.node_x[world, slice(*starts[i : i + 2])] for i in range(2)]
        left, right = (nodes[nodes[:, 2] < below] for nodes in tips)
        gaps.append(float(torch.cdist(left, right).min()))
    assert gaps[0] == pytest.approx(0.104, abs=1e-3)
    for gap, way in zip(gaps[1:], shortened[1:].tolist(), strict=True):
        assert 5.9 < (gaps[0] - gap) / way <= 6.6


@pytest.mark.parametrize(("options", "message"), BAD, ids=[next(iter(options)) for options, _ in BAD])
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        GripperConfig(**options)


def test_paper_options():
    """SofaGym's eight actions, observation of 31 numbers, reward, end and mass."""
    config = GripperConfig.paper()
    assert (config.action_kind, config.observation, config.reward, config.goals) == (
        "discrete",
        "paper",
        "paper",
        "list",
    )
    assert (config.max_episode_steps, config.action_repeat, config.dt) == (250, 5, 0.01)
    assert config.end_on_success and config.object_mass == (1.0, 1.0) and config.min_tension == -math.inf
    env = registry.make("Gripper", config=GripperConfig.paper(settle=False), seed=1)
    assert env.reset()["observation"].shape == (1, 31) and env.action_count == 8


def test_policy_needs_the_pose():
    with pytest.raises(ValueError, match="reads observation='pose', got 'nodes'"):
        rule(make(1, observation="nodes", settle=False), "Gripper")


def rate(steps=60, worlds=8, **options):
    """Share of episodes in which the hand-written policy holds the object at its goal."""
    env = make(worlds, seed=7, **options)
    policy, data = rule(env, "Gripper"), env.reset()
    for _ in range(steps):
        data = env.step(policy(data))["next"]
    assert (data["world_status"] < 3).all()
    return float(data["success"].float().mean())


@pytest.mark.parametrize(
    "thing", ["cube", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("soft_cube", "sphere", "capsule"))]
)
def test_scripted_policy_lifts_every_object(thing):
    assert rate(object=thing) >= 0.95


@pytest.mark.slow
@pytest.mark.parametrize(
    ("thing", "size"),
    [
        ("sphere", 0.034),
        ("sphere", 0.060),
        ("cube", 0.032),
        ("cube", 0.060),
    ],
)
def test_scripted_policy_lifts_small_and_large_objects(thing, size):
    """Large ones are met higher up: below its middle a ball would be squeezed out of the hand."""
    assert rate(object=thing, object_size=size) >= 0.85


@pytest.mark.slow
@pytest.mark.parametrize("height", [0.060, 0.110, 0.160])
def test_scripted_policy_lifts_to_every_height(height):
    """Fingers with cavities and a soft cube, pulled at by up to half its weight."""
    options = {"finger": "cavities", "goals": "list", "goal_heights": (height,), "pull": 0.5, "pull_turn": 0.3}
    assert rate(**options, worlds=4) == 1.0


@pytest.mark.slow  # test_scripted_policy_lifts_every_object has the cube
@pytest.mark.parametrize(
    "options",
    [{"action_kind": "discrete", "object_yaw": (0.0, 0.0)}, {"goals": "places"}],
)
def test_scripted_policy_with_other_tasks(options):
    assert rate(object="cube", **options, steps=90) >= 0.85
