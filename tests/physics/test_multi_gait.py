"""The pneumatic quadruped: pressures against volumes, the gait's way, friction and symmetry, room for contacts."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

import softwarp as sw
from softwarp import meshing
from softwarp.builder import ModelBuilder
from softwarp.envs import registry
from softwarp.envs.options.multi_gait_full import MultiGaitSceneConfig
from softwarp.envs.scenes.multi_gait import build_multi_gait_scene
from softwarp.meshing.quadruped_geometry import CHAMBERS
from softwarp.policies.baselines.multi_gait import GAIT


def act(env, choice):
    """One action in all worlds."""
    action = torch.full((env.num_worlds,), choice)
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]


@pytest.mark.slow
def test_hand_gait_crawls_forwards():
    """Two cycles of the paper's gait lead along +x, straight ahead; without friction they lead nowhere.

    Measured: 2.8 mm after the first cycle. The paper tells 3.24 for its reduced and 3.56 for its full model, "cm" of a
    code that counts millimetres.
    """
    env = registry.make("MultiGaitFull", num_worlds=1, seed=1, max_episode_steps=12)
    env.reset()
    start, way = env.position().clone(), []
    for _ in range(2):
        for choice in GAIT:
            told = act(env, choice)
            assert int(told["world_status"]) == 0  # contacts find room, steps converge, no element is inside out
        way.append(env.position() - start)
    assert 0.0020 < float(way[0][0, 0]) < 0.0036
    assert float(way[1][0, 0]) > 1.5 * float(way[0][0, 0])
    assert abs(float(way[1][0, 1])) < 1e-4 and abs(float(env.heading())) < 0.01
    smooth = registry.make("MultiGaitFull", num_worlds=1, seed=1, mu=0.0, precision="float64")
    smooth.reset()
    start = smooth.position().clone()
    for choice in GAIT:
        act(smooth, choice)
    assert float((smooth.position() - start)[0, :2].abs().max()) < 1e-6  # in float32 rounded forces push it 0.5 mm away


@pytest.mark.slow
def test_pressures_of_the_largest_volumes():
    """Pressures that volumes of 2000 mm^3 in the centre and 1500 mm^3 in a leg take, on the coarse mesh.

    With the corotational law the coarse mesh takes 54 and 66 kPa, our fine mesh 32 kPa for 2.0 cm^3 in the centre and
    34 kPa for 1.5 cm^3 in each leg, the published fine mesh 30 kPa for 1.9 to 2.0 cm^3 in the centre.
    """
    env = registry.make("MultiGaitFull", num_worlds=1, seed=1)
    env.reset()
    for choice in (1, 0, 2):
        act(env, choice)
    pressure = env.pressures()[0].tolist()
    np.testing.assert_allclose(pressure, [45.3e3, 50.3e3, 50.3e3, 48.8e3, 48.8e3], rtol=0.1)


@pytest.mark.slow
def test_base_hardly_stretches():
    """The stiff skin keeps the base's length to 1 % where the centre is filled, and lets it bend."""
    config = MultiGaitSceneConfig(gravity=(0.0, 0.0, 0.0))
    builder = ModelBuilder(gravity=config.gravity)
    scene = build_multi_gait_scene(config, builder)
    sim = sw.Simulation(builder.finalize(1, contact_capacity=128), 0.01)
    rest = float(sim.cavity_volume[0, scene.chambers[CHAMBERS.index("centre")]])
    before = meshing.triangle_areas(sim.node_x[0].numpy(), scene.base).sum()
    for step in range(20):
        sim.control.cavity_volume[0, scene.chambers[0]] = rest + 1.0e-6 * min(1.0, (step + 1) / 15)
        sim.step()
    after = meshing.triangle_areas(sim.node_x[0].numpy(), scene.base).sum()
    assert after / before == pytest.approx(1.0, abs=0.01)
    height = sim.node_x[0, list(scene.tracked), 2]
    assert float(height.max() - height.min()) > 1e-3
