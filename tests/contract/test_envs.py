"""Promises that every environment of the table keeps: checkers, batches, seeds, resets, snapshots, pictures, files."""

import importlib

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import RewardSum, StepCounter, TransformedEnv
from torchrl.envs.transforms import Compose
from torchrl.envs.utils import check_env_specs

from softwarp.envs import registry
from softwarp.io.parts import ChamberPoints, Parts
from softwarp.io.placement import Placement
from tests.env_cases import CASES, FAST, FIRST_OF_EACH, NAMES, SMALL, path_of, quick_ones, some


@pytest.fixture(scope="module", params=NAMES)
def env(request):
    return make(request.param)


def make(name, num_worlds=3, seed=1, **options):
    return registry.make(name, num_worlds=num_worlds, seed=seed, **(FAST.get(name, {}) | options))


def act(env, action):
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]


def play(env, count, seed=0):
    """Random actions that depend on the seed alone; observations, shape (count, world, k)."""
    torch.manual_seed(seed)
    return torch.stack([act(env, env.action_spec.rand())["observation"] for _ in range(count)])


def actions_of(env, count):
    """Random actions for the worlds of an environment."""
    torch.manual_seed(5)
    return [env.action_spec.rand() for _ in range(count)]


def test_specs_below_transforms(env):
    check_env_specs(TransformedEnv(env, Compose(StepCounter(), RewardSum())))


@FIRST_OF_EACH
def test_specs_of_every_action_kind(case):
    """TorchRL's checker, and random rollouts over ends of episodes within the declared, finite bounds."""
    name, options = case
    env = make(name, num_worlds=2, max_episode_steps=4, **options)
    check_env_specs(env)
    assert (env.action_count > 0) != (env.action_size > 0)
    assert len(set(env.action_names())) in (0, env.action_count + env.action_size)
    data = env.rollout(10, break_when_any_done=False)
    spec = env.observation_spec["observation"]
    for value in (data["observation"], data["next", "observation"]):
        assert (value >= spec.space.low[:, None]).all() and (value <= spec.space.high[:, None]).all()
    assert data["next", "reward"].isfinite().all() and data["next", "distance"].isfinite().all()
    assert (data["next", "world_status"] == 0).all()
    assert data["next", "done"].any(dim=1).all()


def test_values_lie_in_their_specs(env):
    spec = env.observation_spec["observation"]
    assert spec.space.low.isfinite().all() and spec.space.high.isfinite().all()
    env.reset()
    assert all(spec.is_in(observation) for observation in play(env, 5))


def test_same_seed_same_bits(env):
    sequences = []
    for _ in range(2):
        env.set_seed(4)
        env.reset()
        sequences.append(play(env, 3))
    assert torch.equal(*sequences)


def test_masked_reset_leaves_the_others_bit_equal(env):
    mask = torch.tensor([False, True, False])
    sequences = []
    for is_reset in (False, True):
        env.set_seed(4)
        env.reset()
        play(env, 2)
        if is_reset:
            env.reset_where(mask)
        sequences.append(play(env, 2, seed=1))
    assert torch.equal(sequences[0][:, ~mask], sequences[1][:, ~mask])
    assert not torch.equal(sequences[0][:, mask], sequences[1][:, mask])


@pytest.mark.parametrize("path", [pytest.param("scalar", marks=pytest.mark.slow), "lanes"])
@pytest.mark.parametrize("name", some(0))
def test_world_equals_alone(name, path):
    """World i of 9 has the bits of the same seed alone on the same solver path, through actions and two episodes."""
    batch, single = (make(name, num_worlds=n, solver_path=path_of(name, path)) for n in (9, 1))
    batch.seed_worlds(list(range(9)))
    single.seed_worlds([7])
    for _ in range(2):
        assert torch.equal(batch.reset()["observation"][7], single.reset()["observation"][0])
        for action in actions_of(batch, 4):
            together, alone = act(batch, action), act(single, action[7:8])
            for key in ("observation", "reward", "distance", "terminated"):
                assert torch.equal(together[key][7], alone[key][0]), key


RANDOMISED = {  # environments that draw more than their start where they are asked to
    "Trunk": {"youngs_range": (1e5, 2e5), "damping_range": (0.5, 2.0), "gravity_tilt": 0.1},
    "Diamond": {"youngs_range": (1e5, 2e5)},
    "Gripper": {
        "object_mass": (0.05, 0.2),
        "object_youngs": (2e5, 8e5),
        "object_growth": (0.0, 3e-3),
        "mu": (0.6, 1.0),
    },
}
DRAWING = {"MultiGaitFull": {"goals": "headings", "chambers": "each"}}  # which by themselves always start alike
DRAWERS = [
    name for name in quick_ones([*SMALL, "Gripper"]) if name.values[0] != "MultiGaitReduced"
]  # which never draws


@pytest.mark.parametrize("name", DRAWERS)
def test_every_draw_has_a_stream_of_its_own(name):
    """Quantities that shared a stream would be the same numbers: a stiff trunk would always get the far goals."""
    randomised = RANDOMISED.get(name, {})
    env = make(name, settle=False, **randomised, **DRAWING.get(name, {}))
    drawn, draw = [], env.draw
    env.draw = lambda stream, count: (drawn.append(stream), draw(stream, count))[1]
    env.reset()
    assert len(drawn) > len(randomised)
    assert len(set(drawn)) == len(drawn)


def test_snapshot_replays_the_same_bits(env):
    env.reset()
    saved = env.snapshot()
    first = play(env, 3)
    env.restore(saved)
    assert torch.equal(first, play(env, 3))


@pytest.mark.parametrize("name", some(1))
def test_snapshot_goes_on_elsewhere(name):
    """One world of a batch, saved in mid-episode, goes on in another environment with its bits, its next start too."""
    path = path_of(name, "lanes")
    batch = make(name, num_worlds=6, solver_path=path, max_episode_steps=5)
    batch.reset()
    actions = actions_of(batch, 10)
    for action in actions[:3]:
        act(batch, action)
    single = make(name, num_worlds=1, seed=9, solver_path=path, max_episode_steps=5)
    single.restore(batch.snapshot().of_worlds([4]).state_dict())
    for action in actions[3:]:
        pair = act(batch, action), act(single, action[4:5])
        for key in ("observation", "reward", "done", "success"):
            assert torch.equal(pair[0][key][4], pair[1][key][0]), key
        if pair[1]["done"].all():
            mask = torch.arange(6) == 4
            assert torch.equal(batch.reset_where(mask)["observation"][4], single.reset()["observation"][0])


def test_poisoned_world_is_reported_and_alone(env):
    env.reset()
    saved = env.snapshot()
    expected = play(env, 1)[0]
    env.restore(saved)
    env.sim.node_x[1] = torch.nan
    env.sim.frame_pose[1] = torch.nan
    torch.manual_seed(0)
    data = act(env, env.action_spec.rand())
    assert data["terminated"].flatten().tolist() == [False, True, False]
    assert (data["world_status"].flatten() >= 3).tolist() == [False, True, False]
    assert data["observation"].isfinite().all() and data["reward"].isfinite().all()
    assert torch.equal(data["observation"][[0, 2]], expected[[0, 2]])
    env.reset()
    assert (act(env, env.action_spec.rand())["world_status"] == 0).all()


@pytest.mark.parametrize("name", some(2))
def test_picture_and_usd(name, tmp_path):
    """A picture with something in it, and a film that USD reads."""
    from pxr import Usd

    from softwarp.io.trajectory import Recorder
    from softwarp.io.usd import export_usd

    env = make(name, num_worlds=2, render_width=80, render_height=60)
    env.reset()
    recorder = Recorder(env.sim, [1])
    for action in actions_of(env, 2):
        goals = env.goal_points()
        recorder.capture(None if goals is None else goals[1:])
        act(env, action)
    frames = env.render()
    assert frames.shape == (2, 60, 80, 3) and frames.std() > 5.0
    stage = Usd.Stage.Open(str(export_usd(recorder.finish(), tmp_path / "film.usdc")))
    assert stage.GetEndTimeCode() > stage.GetStartTimeCode()
    assert any(prim.GetTypeName() == "Mesh" for prim in stage.Traverse())


@pytest.mark.parametrize("name", some(0))
def test_the_robot_fills_live_pictures_of_one_camera(name):
    """At the start it takes more than half of the picture's height or width, and the goal is in sight; later, too.

    The camera of the first picture is that of the whole episode. (From the middle of its circle the pendulum can fill
    no more than half; the pads and the ball above them leave room for the cart.)
    """
    env = make(name, num_worlds=1, render_width=80, render_height=60)
    env.reset()
    env.render()
    camera = env._pictures._caster.camera
    at = camera.project(outline_of(env.sim, whole=name in ("SimpleMaze", "ConcentricTubeRobot", "CatheterBeam")))
    low, high = at.min(axis=0), at.max(axis=0)
    assert 0.5 * (high - low).max() > (0.4 if name in ("StemPendulum", "CatchTheObject") else 0.5)
    assert np.abs(at).max() < 1.0
    for action in actions_of(env, 3):
        act(env, action)
        env.render()
        assert env._pictures._caster.camera == camera
    if env.goal_points() is not None:
        assert np.abs(camera.project(env.goal_points().cpu().numpy())).max() < 1.0


def outline_of(sim, *, whole: bool = False) -> np.ndarray:
    """Positions of all that moves in world 0 [m], shape (k, 3), or of everything: where what is driven is the robot."""
    parts, placed = Parts.of_model(sim.model), Placement.of_simulation(sim, ChamberPoints(sim.model), [0])
    moving = np.flatnonzero(~parts.rigid_kinematic | whole)
    pose, rod_x = np.asarray(placed.rigid_pose.cpu()[0], float), np.asarray(placed.rod_x.cpu()[0], float)
    found = [sim.node_x[0].cpu().numpy(), parts.rod_outline(rod_x), *parts.rigid_outline(pose, moving)]
    return np.concatenate([points.reshape(-1, 3) for points in found])


def test_a_goal_outside_the_picture_widens_it():
    """It is in sight with the robot; goals within leave the camera as it is."""
    env = make("StemPendulum", num_worlds=1, render_width=80, render_height=60)
    env.reset()
    env.render()
    before = env._pictures._caster.camera
    far = torch.tensor([[0.4, 0.0, 0.3]])
    env.goal_points = lambda: far
    env.render()
    camera = env._pictures._caster.camera
    assert np.abs(before.project(far.numpy())).max() > 1.0 > np.abs(camera.project(far.numpy())).max()
    assert np.abs(camera.project(outline_of(env.sim))).max() < 1.0
    env.goal_points = lambda: 0.2 * far
    env.render()
    assert env._pictures._caster.camera == camera


def test_every_environment_lists_its_action_kinds():
    """The cases above are those of the modules: no kind is left out."""
    for name in registry.names():
        entry = registry.spec(name)
        module = importlib.import_module(entry.env.partition(":")[0])
        kinds = getattr(module, "ACTION_KINDS", ())
        assert [options["action_kind"] for case, options in CASES if case == name and options] == list(kinds)
