"""ConcentricTubeRobot: closed form, actions, goals, forces, rewards, options, the hand-written policy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from softwarp import notices
from softwarp.envs import registry, tube_goals
from softwarp.envs.options.concentric_tube_robot import ConcentricTubeRobotConfig
from softwarp.envs.scenes.concentric_tube_robot import line_of, tube_of, vessel_of
from softwarp.envs.tasks import concentric_tube_robot as task
from softwarp.envs.tasks.concentric_tube_robot import SIZE, sought_goals, stored_goals, workspace_goals
from softwarp.policies.baselines.table import rule
from softwarp.scene.composite import composite_curve
from softwarp.scene.telescopes import _table


def make(num_worlds: int = 3, seed: int = 1, **options: Any) -> Any:
    return registry.make("ConcentricTubeRobot", num_worlds=num_worlds, seed=seed, **options)


def act(env: Any, action: torch.Tensor) -> TensorDict:
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]


def test_closed_form_is_that_of_the_scene() -> None:
    """Lines of random lengths and angles against composite_curve of the same tubes, to rounding."""
    config, rng = ConcentricTubeRobotConfig(), np.random.default_rng(0)
    table, line = _table([tube_of(config, k) for k in range(3)]), line_of(config)
    length = np.sort(rng.uniform(0.001, 0.06, (6, 3)), axis=1)[:, ::-1].copy()
    length[0, 1:] = 0.0  # one tube alone
    length[1, 2] = length[1, 1]  # two that end at the same place
    angle = rng.uniform(-3.0, 3.0, (6, 3))
    tips = line.tip(torch.as_tensor(length), torch.as_tensor(angle)).numpy()
    port = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    for tip, lengths, angles in zip(tips, length, angle, strict=True):
        np.testing.assert_allclose(tip, composite_curve(table, port, lengths, angles, 8, 1e-4)[0][-1], atol=1e-12)
    swapped = length[2:3, ::-1].copy()  # an outer tube reaches farther: the innermost ends within it
    stops, points = line.points(torch.as_tensor(swapped), torch.as_tensor(angle[2:3]), 4)
    at = int((stops[0] - swapped[0, 0]).abs().argmin())
    np.testing.assert_allclose(
        line.tip(torch.as_tensor(swapped), torch.as_tensor(angle[2:3]))[0].numpy(), points[0, at].numpy(), atol=1e-12
    )


def test_tubes_come_to_rest_at_the_closed_form() -> None:
    """All but rigid in torsion and in contact with nothing: within 0.5 mm where arcs overlap little, 57 mm out."""
    env = make(1, goals="list")
    env.reset()
    length, angle = torch.tensor([[0.0573, 0.0060, 0.0005]]), torch.tensor([[0.62, -0.57, 1.9]])
    step = torch.cat((torch.tensor(env.config.insert_step), torch.tensor(env.config.turn_step)))
    for _ in range(14):
        change = (torch.cat((length - env.length, angle - env.angle), dim=1) / step).clamp(-1.0, 1.0)
        act(env, change.unflatten(1, (2, 3)).transpose(1, 2).flatten(1))
    torch.testing.assert_close(env.sim.tube_length.float(), length, atol=1e-6, rtol=0.0)
    assert float(env.wall_force()) == 0.0
    free = env.line.tip(length.double(), angle.double()).float()
    assert float(torch.linalg.vector_norm(env.tip() - free)) < 5e-4


def test_discrete_actions_move_one_tube_each() -> None:
    """All twelve, SofaGym's steps: insert, turn, turn back, withdraw; the eight that did nothing there turn here."""
    env = make(12, action_kind="discrete", nested=False, first_lengths=(0.012, 0.011, 0.010))
    env.reset()
    data = act(env, torch.arange(12))
    config = env.config
    for tube in range(3):
        rows = slice(4 * tube, 4 * tube + 4)
        length, angle = env.length[rows, tube] - config.first_lengths[tube], env.angle[rows, tube]
        expected = torch.tensor([config.insert_step[tube], 0.0, 0.0, -config.withdraw_step[tube]])
        torch.testing.assert_close(length, expected, atol=1e-6, rtol=0.0)
        turn = config.turn_step[tube]
        torch.testing.assert_close(angle, torch.tensor([0.0, turn, -turn, 0.0]))
    torch.testing.assert_close(env.sim.tube_angle.float(), env.angle, atol=1e-5, rtol=0.0)
    torch.testing.assert_close(env.sim.tube_length.float(), env.length, atol=1e-6, rtol=0.0)
    assert not data["world_status"].any()


def test_commands_stay_in_their_limits() -> None:
    """Lengths from 0 to the largest; with ``nested``, none reaches farther than those within it."""
    env = make(2)
    env.reset()
    push = torch.tensor([[1.0, 0.0, 1.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 1.0, 0.0, 1.0, 0.0]])
    for _ in range(3):
        act(env, push)
    assert (env.length[0].diff() <= 0.0).all() and float(env.length[0, 0]) > 0.02
    assert (env.length[1] == 0.0).all()


def test_goals_lie_in_the_lumen() -> None:
    """Stored ones are clear of the wall; a random anatomy has its own; splits are disjoint."""
    table = stored_goals()
    vessel = vessel_of(ConcentricTubeRobotConfig())
    assert vessel.clearance(table.tip.double().numpy()).min() > 9e-4
    assert len(torch.unique(table.tip, dim=0)) == len(table.tip) == 1000
    parts = {split: make(1, goal_split=split).goals.tip for split in ("train", "eval")}
    assert len(parts["train"]) + len(parts["eval"]) == 1000
    assert not (torch.cdist(parts["train"], parts["eval"]) == 0.0).any()
    config = ConcentricTubeRobotConfig(anatomy=2, goal_count=30)
    other = sought_goals(config)
    assert len(other.tip) == 30 and vessel_of(config).clearance(other.tip.double().numpy()).min() > 9e-4


def test_powers_make_small_actions_finer() -> None:
    """An action a moves by a |a|^(p - 1) of a step; hand-written policies and inverse control undo that."""
    plain, fine = make(2), make(2, action_power=2.0)
    plain.reset(), fine.reset()
    action = torch.tensor([[0.5, -0.5, 0.1, 1.0, 0.0, -0.2], [1.0, 2.0, 0.6, -0.1, 0.3, 0.0]])
    expected = torch.tensor([[0.25, -0.25, 0.01, 1.0, 0.0, -0.04], [1.0, 1.0, 0.36, -0.01, 0.09, 0.0]])
    torch.testing.assert_close(fine.changes(action), plain.changes(expected))
    wish = torch.cat((fine.length, fine.angle), dim=1) + fine.changes(action).transpose(0, 1).flatten(1)
    torch.testing.assert_close(fine.action_for(wish), action.clamp(-1.0, 1.0), atol=1e-5, rtol=1e-5)
    seen = plain.reset()
    moves = [env.changes(rule(env, "ConcentricTubeRobot")(seen.clone())["action"]) for env in (plain, fine)]
    torch.testing.assert_close(*moves, atol=1e-7, rtol=1e-5)
    with pytest.raises(ValueError, match="action_power"):
        ConcentricTubeRobotConfig(action_power=0.5)


def test_margins_that_no_line_keeps_are_told_soon(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Wider than where lines begin: at once. Elsewhere: a quarter of the draws without one goal is enough.

    Commands tell meanwhile how far the search has come.
    """
    with pytest.raises(ValueError, match=r"lines begin 4.13 mm from the wall, .* smaller goal_margin"):
        sought_goals(ConcentricTubeRobotConfig(goal_margin=0.5))
    config = ConcentricTubeRobotConfig()
    vessel, line = vessel_of(config), line_of(config)
    monkeypatch.setattr(tube_goals, "AT_ONCE", 100)
    monkeypatch.setattr(notices, "WAIT_SECONDS", -1.0)
    refusal = r"only 0 lines of 1000 are 1 mm clear .* smaller goal_margin"  # curved ends
    with notices.telling(), pytest.raises(ValueError, match=refusal):
        tube_goals.goal_table(vessel, line, config.max_length, clear=0.001, turn=2.0, depth=0.0899, count=1000)
    assert "seeking goals: 0 of 1000 after 0 of at most 40 draws" in capsys.readouterr().err


def test_another_seed_seeks_other_goals(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the same workspace, none of them twice; the stored ones are those of seed 0."""
    first, second = (
        sought_goals(ConcentricTubeRobotConfig(anatomy=2, goal_count=30, goal_seed=seed)).tip for seed in (0, 1)
    )
    assert len(second) == 30 and not (torch.cdist(first, second) == 0.0).any()
    monkeypatch.setattr(task, "sought_goals", lambda config: config.goal_seed)
    assert workspace_goals(ConcentricTubeRobotConfig(goal_seed=1)) == 1
    assert workspace_goals(ConcentricTubeRobotConfig()) is stored_goals()


def test_wall_force_costs_and_is_told() -> None:
    """Tubes pushed against the wall: the force is told, its peak stays, its excess is taken from the reward."""
    env = make(2, force_limit=0.02, force_penalty=0.5, observe_force=True)
    env.reset()
    seen = [act(env, torch.tensor([[1.0, 0.3, 1.0, -0.3, 0.0, 0.0], [0.0] * 6])) for _ in range(7)]
    force = torch.stack([data["wall_force"] for data in seen])
    assert float(force[-1, 0, 0]) > 0.02 and (force[:, 1] == 0.0).all()
    torch.testing.assert_close(force[..., 1], force[..., 0].cummax(dim=0).values)
    excess = (force[:, :, 0] - 0.02).clamp_min(0.0)
    torch.testing.assert_close(env.episode_sums["force"], -0.5 * excess.sum(dim=0))
    assert seen[-1]["observation"].shape == (2, SIZE + 1)
    torch.testing.assert_close(seen[-1]["observation"][:, -1], force[-1, :, 0])
    ended = make(1, force_limit=0.02, end_on_force=True)
    ended.reset()
    assert any(act(ended, torch.tensor([[1.0, 0.3, 1.0, -0.3, 0.0, 0.0]]))["terminated"].any() for _ in range(7))
    env.reset()
    assert (env.peak_force == 0.0).all()


def test_paper_reward_and_observation() -> None:
    """Twelve raw numbers; only a distance that is the least so far earns."""
    env = make(1, **{k: v for k, v in vars(ConcentricTubeRobotConfig.paper()).items() if k != "goal_list"})
    data = env.reset()
    assert data["observation"].shape == (1, 12)
    y, z = env.goal[0, 1].abs(), env.goal[0, 2]
    assert float(env.goal[0, 0]) == 0.0 and -1e-6 <= float(z - y) <= 0.030 + 1e-6
    least = float(env.distance)
    for action in (0, 3, 0):
        data = act(env, torch.tensor([action]))
        distance = float(data["distance"])
        expected = min(3.0 * np.sqrt(max((least - distance) / least, 0.0)), 1.0)
        assert float(data["reward"]) == pytest.approx(expected, abs=1e-4)
        least = min(least, distance)


def test_bad_options() -> None:
    """Messages name the option and the way out."""
    for options, told in (
        ({"inner_radius": (0.0003, 0.0004, 0.0008)}, "does not fit"),
        ({"force_penalty": 1.0}, "finite force_limit"),
        ({"first_lengths": (0.0, 0.001, 0.0)}, "nested"),
        ({"wall": 0.002}, "wall must be"),
        ({"max_length": (0.6, 0.1, 0.1)}, "max_length"),
        ({"insert_step": (0.01, 0.01, 0.1)}, r"insert_step of tube 2 must be at most max_length\[2\], 0.06 m, got 0.1"),
        ({"first_lengths": (0.2, 0.0, 0.0)}, r"first_lengths of tube 0 must be at most max_length\[0\]"),
        ({"goals": "somewhere"}, "unknown goals"),
        ({"goal_list": [[0.0, 1.0]], "goals": "list"}, "goal_list"),
        ({"goal_list": [[0.5, 0.5, 0.5]], "goals": "list"}, "must lie within max_length of the port"),
    ):
        with pytest.raises(ValueError, match=told):
            ConcentricTubeRobotConfig(**options)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="neither 'passage' nor a file"):
        make(1, vessel="nose.stl", goals="list")


@pytest.mark.slow  # test_vessel has vessels of meshes
def test_vessel_of_a_file(tmp_path: Any) -> None:
    """A user's own wall gives the same clearance as the generated one."""
    import meshio

    from softwarp import meshing

    surface = meshing.nasal_passage().surface(16)
    meshio.Mesh(1e3 * surface.nodes, [("triangle", surface.triangles)]).write(tmp_path / "nose.stl")
    options = {"spacing": 0.003, "wall": 0.012}
    own = vessel_of(ConcentricTubeRobotConfig(vessel=str(tmp_path / "nose.stl"), vessel_scale=1e-3, **options))
    generated = vessel_of(ConcentricTubeRobotConfig(**options))
    line = meshing.nasal_passage().points[8:-4]
    assert np.abs(own.clearance(line) - generated.clearance(line)).max() < 3e-4


def test_hand_written_policy_meets_goals() -> None:
    """Continuous: most of 12 goals that its table does not hold are met within 1 mm at some time, from 30 mm away."""
    env = make(12, seed=5, goal_split="eval")
    policy, data = rule(env, "ConcentricTubeRobot"), env.reset()
    assert float(data["distance"].mean()) > 0.02
    met = torch.zeros(12, dtype=torch.bool)
    for _ in range(40):
        data = env.step(policy(data))["next"]
        met |= data["success"][:, 0]
    assert int(met.sum()) >= 9
    assert not (data["world_status"] >= 3).any()


def test_alike_is_what_the_same_moves_lead_to_in_any_order() -> None:
    """The same five moves in two orders, in free space: equal rows, and tips that come to rest within 0.1 mm.

    In a third order a middle tube is stopped by the inner one that is not out yet: that is another state, by its length
    alone.
    """
    env = make(3, action_kind="discrete", goals="list")
    env.reset()
    for ways in zip((0, 4, 1, 6, 6), (1, 6, 0, 6, 4), (4, 0, 6, 6, 1), strict=True):
        act(env, torch.tensor(ways))
    for _ in range(12):  # a tube that is not out is withdrawn: nothing moves
        act(env, torch.tensor((11, 11, 11)))
    rows, tip = env.likeness(), env.tip()
    assert float(env.peak_force.max()) == 0.0
    assert rows[0].tolist() == rows[1].tolist() == [22, 20, 0, 20, -40, 0]
    assert rows[2].tolist() == [22, 2, 0, 20, -40, 0]
    torch.testing.assert_close(tip[0], tip[1], atol=1e-4, rtol=0.0)
    assert float((tip[2] - tip[0]).norm()) > 1e-3
