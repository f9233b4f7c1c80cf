"""CatheterBeam: motions, ways, rewards, ends of the vessel, wall forces, random anatomies, the hand-written policy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from softwarp.envs import registry
from softwarp.envs.options.catheter_beam import CATHETER, COIL, GUIDE, CatheterBeamConfig
from softwarp.envs.tasks.catheter_beam import REACHED
from softwarp.policies.baselines.catheter_beam import catheter_baseline

FAST = {"grid": 0.003, "segments": 24}


def make(num_worlds: int = 2, seed: int = 1, **options: Any) -> Any:
    return registry.make("CatheterBeam", num_worlds=num_worlds, seed=seed, **(FAST | options))


def act(env: Any, *action: float) -> TensorDict:
    value = torch.tensor(action).expand(env.num_worlds, 6).clone()
    return env.step(TensorDict({"action": value}, batch_size=env.batch_size))["next"]


def clearance(env: Any) -> float:
    """Least distance of the lines of all worlds from the wall [m], where the wall stands."""
    line = env.sim.rod_x.double().numpy()
    shift = env.sim.body_pose[:, env.scene.wall, :3].double().numpy()
    return float(env.scene.vessel.clearance((line - shift[:, None])[:, 1:].reshape(-1, 3)).min())


def test_every_discrete_action_does_what_it_says() -> None:
    """Each of the twelve changes one length or one angle, all rotations included."""
    env = make(
        num_worlds=12, action_kind="discrete", start_turn=0.0, first_lengths=(0.03, 0.03, 0.03), leads=(1.3, 1.3)
    )
    env.reset()
    before = torch.stack((env.sim.tube_length, env.sim.tube_angle)).clone()
    env.step(TensorDict({"action": torch.arange(12)}, batch_size=12))
    change = (torch.stack((env.sim.tube_length, env.sim.tube_angle)) - before).float()
    config, expected = env.config, torch.zeros(2, 12, 3)
    for tube in range(3):
        expected[0, 4 * tube, tube] = config.insert_step[tube]
        expected[1, 4 * tube + 1, tube] = config.turn_step[tube]
        expected[1, 4 * tube + 2, tube] = -config.turn_step[tube]
        expected[0, 4 * tube + 3, tube] = -config.withdraw_step[tube]
    torch.testing.assert_close(change, expected, atol=1e-6, rtol=0.0)


def test_progress_is_the_way_along_the_vessel() -> None:
    """In the straight stem 25 mm of guide are 25 mm of way, 0.5 of reward; the way back costs the same."""
    env = make(start_turn=0.0, guide_diameter=10.0, coil_diameter=0.001, effort_weight=0.0)
    env.reset()
    first = env.way.clone()
    np.testing.assert_allclose(first, env.ways.ways[0, env.scene.trees[0].inlet, env.outlet], atol=2e-3)
    there = [act(env, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)["reward"] for _ in range(2)]
    np.testing.assert_allclose(first - env.way, 0.05 - 0.001, atol=5e-4)
    np.testing.assert_allclose(there[1], 0.5, atol=0.02)
    np.testing.assert_allclose(act(env, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0)["reward"], -0.5, atol=0.02)


def test_reward_of_sofagym_and_its_start() -> None:
    """Minus the distance in mm; 500 at a goal; observations in mm; no instrument reaches the outlets."""
    config = CatheterBeamConfig.paper(**FAST)
    env = registry.make("CatheterBeam", num_worlds=2, seed=0, config=config)
    seen = env.reset()["observation"]
    np.testing.assert_allclose(seen[:, :3], [[0.0, 0.0, 1.0]] * 2, atol=1e-4)
    np.testing.assert_allclose(seen[:, 9:], 1e3 * env.goal, rtol=1e-6)
    assert (env.goal.norm(dim=1) > max(config.lengths)).all()
    data = env.step(TensorDict({"action": torch.tensor([4, 8])}, batch_size=2))["next"]
    np.testing.assert_allclose(data["reward"], -1e3 * data["distance"], rtol=1e-5)
    terms = env.reward_terms(torch.zeros(2, dtype=torch.int64), torch.tensor([0.004, 0.006]))
    np.testing.assert_allclose(terms["distance"], [REACHED, -6.0], rtol=1e-5)


def test_full_withdrawal_and_insertion_with_ends_at_one_point() -> None:
    """Out by 0.2 m together, back to nothing, out again: nothing fails or leaves, and the tip gets as far."""
    env = make(turn_step=(0.3, 0.3, 0.3))
    env.reset()
    tips = []
    for _ in range(2):
        for _ in range(8):
            data = act(env, 1.0, 0.5, 1.0, -0.5, 1.0, 0.5)
            assert (data["world_status"] == 0).all() and clearance(env) > 0.0
        np.testing.assert_allclose(env.sim.tube_length, 0.2, atol=2e-3)
        tips.append(env.tip())
        for _ in range(9):
            data = act(env, -1.0, 0.0, -1.0, 0.0, -1.0, 0.0)
            assert (data["world_status"] == 0).all()
        np.testing.assert_allclose(env.sim.tube_length, 0.0, atol=1e-6)
    assert all((tip[:, 2] > 0.15).all() for tip in tips)


@pytest.mark.slow
def test_a_metre_in_a_vessel_of_twelve_millimetres() -> None:
    """Instruments that are pushed until the vessel ends, and turned all the time, do not fold.

    No world fails, the tip is within the ends, the wall bears 20 N at most, and a line's centre is in it after no more
    than two of 150 actions, by less than 3 mm: tips that a fork throws. Which lines would fold, and which tips are
    thrown, is decided by rounding, so three seeds of four worlds each stand for what happens.
    """
    inside: list[float] = []
    for seed in range(3):
        narrow = {"vessel_radius": 0.006, "outlet_radius": 0.006, "grid": 0.0025, "segments": 48}
        env = make(num_worlds=4, seed=seed, max_episode_steps=80, **narrow)
        env.reset()
        for _ in range(50):
            data = act(env, 0.8, 0.1, 1.0, 0.3, 0.9, -0.2)
            assert (data["world_status"] <= 2).all()
            inside.append(clearance(env))
        assert (env.sim.tube_length.amax(dim=1) > 1.0).all()
        assert not env.is_out().any()
        assert (env.peak_force > 0.0).all() and float(env.peak_force.max()) < 20.0
    assert min(inside) > -0.003 and sum(clear <= 0.0 for clear in inside) <= 2


def test_the_limit_of_force_costs_and_ends() -> None:
    """More than the limit is taken from the reward in N; with end_on_force the episode ends."""
    env = make(force_limit=1e-6, force_penalty=2.0, end_on_force=True, observe_force=True, sensors=("contact_force",))
    env.reset()
    ended = torch.zeros(2, dtype=torch.bool)
    for _ in range(6):
        data = act(env, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
        torch.testing.assert_close(data["observation"][:, -1], (env.force / env.config.force_scale).clamp_max(4.0))
        torch.testing.assert_close(data["wall_force"], torch.stack((env.force, env.peak_force), dim=1))
        torch.testing.assert_close(data["terminated"][:, 0], env.force > 1e-6)
        ended |= data["terminated"][:, 0]
        terms = env.reward_terms(torch.zeros(2, 6), data["distance"][:, 0])
        torch.testing.assert_close(terms["force"], -2.0 * (env.force - 1e-6).clamp_min(0.0))
    assert ended.all() and data["contact_force"].isfinite().all()


def test_a_feed_that_is_pressed_back_slips() -> None:
    """Nothing is inserted while the wall presses back with more than the limit; turns and withdrawals go on."""
    env = make(max_insertion_force=2e-3)
    env.reset()
    slipped, above = False, False
    for _ in range(10):
        before, commanded = env.sim.tube_length.clone(), env.length.clone()
        act(env, 0.0, 0.5, 1.0, 0.5, 0.0, 0.5)
        torch.testing.assert_close(env.sim.tube_length.to(env.length), env.length, atol=1e-6, rtol=0.0)
        went = env.length[:, GUIDE] - commanded[:, GUIDE]
        slipped |= bool((went < 0.0249).any())
        above |= bool((env.insertion_force() > 0.1).any())
        assert (went >= 0.0).all() and (env.sim.tube_length >= before - 1e-6).all()
    assert slipped and not above
    turned = env.angle.clone()
    act(env, 0.0, 0.5, -1.0, 0.5, 0.0, 0.5)
    torch.testing.assert_close(env.angle - turned, torch.full_like(turned, 0.3), atol=1e-6, rtol=0.0)
    free = make()
    free.reset()
    for _ in range(2):
        act(free, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    torch.testing.assert_close(free.length[:, GUIDE], torch.full((2,), 0.05), atol=1e-6, rtol=0.0)
    for way, count in ((1.0, 8), (-1.0, 1)):  # friction presses back what is pushed, and holds back what is pulled
        for _ in range(count):
            act(free, way, 0.0, way, 0.0, way, 0.0)
        assert (way * free.insertion_force() > 1e-5).all()
    with pytest.raises(ValueError, match="max_insertion_force must be positive"):
        CatheterBeamConfig(max_insertion_force=0.0)


@pytest.mark.slow  # two large grids; the goals of an anatomy are in test_vessel_ways, its vessel in test_aorta
def test_every_world_has_an_anatomy_of_its_own() -> None:
    """The wall is moved so that the drawn vessel stands at the port; goals are that vessel's.

    The line's centre stays in the lumen at forks too.
    """
    env = make(num_worlds=6, seed=3, anatomy="random", anatomies=2, outlets=2, grid=0.003)
    env.reset()
    assert set(env.anatomy.tolist()) == {0, 1}
    for world in range(6):
        tree = env.scene.trees[int(env.anatomy[world])]
        np.testing.assert_allclose(env.goal[world], tree.points[tree.outlets[env.outlet[world]]], atol=1e-6)
    for _ in range(8):
        data = act(env, 0.0, 0.0, 1.0, 0.2, 0.6, 0.0)
        assert (data["world_status"] == 0).all()
    assert clearance(env) > 0.0
    assert (env.sim.rod_x[:, -1, 2] > 0.1).all()


def test_the_hand_written_policy_takes_the_right_branch() -> None:
    """To an outlet on either side of the first fork: 0.25 m of the way are behind it, for both kinds of actions."""
    for kind, seen in (("continuous", "local"), ("discrete", "compact")):
        env = make(num_worlds=2, seed=0, action_kind=kind, observation=seen)
        policy = catheter_baseline(env)
        env.reset()
        env.outlet.copy_(torch.tensor([0, 6]))
        env.goal.copy_(env.draw_goals())
        data = env._collect()
        for _ in range(30 if kind == "continuous" else 60):
            data = env.step(policy(TensorDict({"observation": data["observation"]}, batch_size=2)))["next"]
        left = env._way_left()
        assert (left < 0.83).all(), (kind, left)


def test_local_observations_tell_the_same_in_the_frame_of_the_hook() -> None:
    """Turned to world axes by that frame vectors are those of compact ones; the wall ends the tip's way aside."""
    env = make(num_worlds=3, observation="local")
    env.reset()
    for _ in range(4):
        data = act(env, 0.2, 0.4, 1.0, -0.5, 0.6, 0.1)
    frame, seen = env.hook_frame(), env.decode(data["observation"])
    torch.testing.assert_close(frame @ frame.mT, torch.eye(3).expand(3, 3, 3), atol=1e-6, rtol=0.0)
    torch.testing.assert_close(torch.linalg.det(frame), torch.ones(3), atol=1e-6, rtol=0.0)
    turned = {name: part.unflatten(1, (-1, 3)) @ frame for name, part in seen.items() if part.shape[1] % 3 == 0}
    length, tip = env.sim.tube_length.float(), env.tip()
    expected = {"hook": env.hook(), "to_goal": env.goal - tip, "direction": env.direction()}
    located = env.ways.locate(env.anatomy, tip)
    expected["along"] = env.ways.along(env.anatomy, env.outlet, located)
    expected["ahead"] = env.ways.look_ahead(env.anatomy, env.outlet, located) - tip[:, None]
    expected["side"] = env.ways.next_fork(env.anatomy, env.outlet, located)[1]
    for name, value in expected.items():
        torch.testing.assert_close(turned[name].flatten(1), value.flatten(1), atol=2e-6, rtol=0.0, msg=name)
    torch.testing.assert_close(seen["length"], length)
    room = seen["radius"][:, 0] - seen["aside"].norm(dim=1)
    np.testing.assert_allclose(room, env.scene.vessel.clearance(tip.double().numpy()), atol=env.config.grid)
    assert (seen["aside"].norm(dim=1) > 1e-4).any()


def test_policy_needs_compact_observations() -> None:
    """The paper's hold no directions."""
    env = registry.make("CatheterBeam", config=CatheterBeamConfig.paper(**FAST))
    with pytest.raises(ValueError, match=r"needs observation='compact'"):
        catheter_baseline(env)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"anatomy": "arch"}, "unknown anatomy 'arch'"),
        ({"anatomies": 2}, "there is one reference anatomy"),
        ({"outlet": 7}, "outlet must be one of 0 to 6"),
        ({"radii": (1e-3, 1e-3, 2e-3)}, "radii must rise"),
        ({"guide_end": 2.0}, r"guide_end must be less than lengths\[1\], 1.3 m, got 2.0"),
        ({"grid": 0.004}, r"vessel_radius must be more than twice grid \(0.004 m\)"),
        ({"outlet_radius": 0.002}, "outlet_radius must be more than twice grid .*, got 0.002"),
        ({"insert_step": (25.0, 0.01, 0.01)}, r"insert_step of tube 0 must be at most lengths\[0\], 1.3 m, got 25.0"),
        ({"withdraw_step": (0.01, 0.01, 2.0)}, r"withdraw_step of tube 2 must be at most lengths\[2\]"),
        ({"first_lengths": (0.0, 2.0, 0.0)}, r"first_lengths of tube 1 must be at most lengths\[1\], 1.3 m, got 2.0"),
    ],
)
def test_options_that_make_no_sense(options: dict[str, Any], message: str) -> None:
    """Each is refused by name."""
    with pytest.raises(ValueError, match=message):
        CatheterBeamConfig(**options)


def test_more_anatomies_than_a_grid_holds_are_refused_by_their_options() -> None:
    """With both ways out."""
    said = r"anatomies=2 with grid=0.0008 m: .* use a spacing of 0.00\d+ m or more, for grid, or fewer anatomies"
    with pytest.raises(ValueError, match=said):
        make(anatomy="random", anatomies=2, outlets=2, grid=0.0008)


def test_instruments_go_from_the_innermost_on() -> None:
    """Numbers of the instruments, as options, actions and observations order them."""
    assert (COIL, GUIDE, CATHETER) == (0, 1, 2)
    config = CatheterBeamConfig()
    assert config.radii[COIL] < config.radii[GUIDE] < config.radii[CATHETER]
