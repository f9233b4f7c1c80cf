"""What lives in one process says so when it is pickled or deep-copied; what describes it can be sent anywhere."""

import copy
import io
import pickle

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from tensordict import TensorDict
from torchrl.envs import RewardSum, TransformedEnv

import softwarp as sw
from softwarp.render import RayCaster

NAME, ID = "CartPole", "softwarp/CartPole-v0"


@pytest.fixture(scope="module")
def env():
    made = sw.make(NAME, num_worlds=2, seed=0)
    made.reset()
    return made


def vec_env(_):
    sb3 = pytest.importorskip("softwarp.sb3", reason="needs Stable-Baselines3")
    return sb3.make(NAME, 2)


MAKE_AGAIN = r"^CartPole: cannot be pickled.* softwarp.make\('CartPole', num_worlds=2, config=config\).*snapshot"
GYM = rf"cannot be pickled.* gymnasium.make\('{ID}'\)"
REFUSED = {
    "environment": (lambda env: env, MAKE_AGAIN),
    "torchrl wrapper": (lambda env: TransformedEnv(env, RewardSum()), MAKE_AGAIN),
    "simulation": (lambda env: env.sim, r"^Simulation: cannot be pickled.* sim\.snapshot\(\).*ModelBuilder"),
    "model": (lambda env: env.sim.model, r"^Model: cannot be pickled.* ModelBuilder .*finalize there"),
    "ray caster": (lambda env: RayCaster.for_model(env.sim.model), "^RayCaster: .*for_model"),
    "gymnasium": (lambda _: gymnasium.make(ID), f"^SingleEnv: {GYM}"),
    "gymnasium wrapper": (lambda _: wrappers.ClipReward(gymnasium.make(ID), 0.0, 1.0), f"^SingleEnv: {GYM}"),
    "vector": (lambda _: gymnasium.make_vec(ID, 2), rf"^VectorEnv: .*make_vec\('{ID}', num_envs=2\)"),
    "sb3": (vec_env, r"^VecEnv: .*softwarp\.sb3\.make"),
    "what holds one": (lambda env: {"deep": [(env.sim,)]}, "^Simulation: cannot be pickled"),
}


def through_torch(thing):
    return torch.save(thing, io.BytesIO())


@pytest.mark.parametrize("send", [pickle.dumps, copy.deepcopy, through_torch], ids=["pickle", "deepcopy", "torch.save"])
@pytest.mark.parametrize("kind", REFUSED)
def test_refused_with_the_way_out(env, kind, send):
    """A TypeError, of the object that is the reason, whatever it is wrapped in."""
    make, message = REFUSED[kind]
    with pytest.raises(TypeError, match=message):
        send(make(env))


def test_the_way_out_leads_there(env):
    """Settings and state of an environment, pickled, make one that goes on exactly as the first."""
    config, state = pickle.loads(pickle.dumps((env.config, env.snapshot())))
    other = sw.make(NAME, num_worlds=2, config=config)
    other.reset()
    other.restore(state)
    action = TensorDict({"action": env.action_spec.rand()}, batch_size=[2])
    first, second = (e.step(action.clone())["next", "observation"] for e in (env, other))
    assert torch.equal(first, second)


def test_descriptions_are_sent_as_before(env):
    """Configurations, snapshots, builders, meshes and specs, by pickle and by deepcopy."""
    builder = sw.ModelBuilder()
    builder.add_tets(sw.meshing.box((0.1, 0.1, 0.1), (1, 1, 1)), material=sw.NeoHookean(1e5, 0.4), density=1000.0)
    copies = [pickle.loads(pickle.dumps(builder)), copy.deepcopy(builder)]
    for made in [builder, *copies]:
        np.testing.assert_array_equal(made.finalize(1).node_rest, builder.finalize(1).node_rest)
    for thing in (env.config, env.sim.snapshot(), env.snapshot(), env.action_spec, env.observation_spec):
        pickle.loads(pickle.dumps(thing))
        copy.deepcopy(thing)


def test_a_shallow_copy_shares_its_arrays(env):
    """As before: another name for the same worlds."""
    assert copy.copy(env).sim is env.sim
    assert copy.copy(env.sim).node_x.data_ptr() == env.sim.node_x.data_ptr()
