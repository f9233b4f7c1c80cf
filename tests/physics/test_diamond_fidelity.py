"""The Diamond of fidelity "accurate": moduli along its legs make up for coarse quadratic elements."""

import dataclasses
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

import softwarp as sw
from softwarp import cli, meshing
from softwarp.envs import registry
from softwarp.envs.options.diamond import DiamondConfig, DiamondSceneConfig
from softwarp.envs.scenes.diamond import build_diamond_scene

assets = Path(__file__).parents[2] / "assets" / "diamond"


def script(name):
    spec = importlib.util.spec_from_file_location(name, assets / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def coarsen():
    return script("coarsen")


@pytest.fixture
def commanded(coarsen, monkeypatch):
    monkeypatch.setitem(sys.modules, "coarsen", coarsen)
    return script("commanded")


@pytest.mark.slow  # 15 s
def test_top_is_within_two_percent_of_converged_ways(coarsen):
    """Under loads that moduli were fitted to and under others; pulled 38 mm up, farther than cables do, within four."""
    fitted, loads, truth = coarsen.read()
    half = coarsen.Half(1, loads)
    rows, factors = meshing.diamond_geometry.COARSE_STIFFNESS
    ways, nominal = half.ways(np.interp(half.places, rows, factors)), half.ways()
    extent = np.linalg.norm(truth[:, 0], axis=1)
    off, before = (np.linalg.norm((found - truth)[:, 0], axis=1) / extent for found in (ways, nominal))
    is_far = (loads[:, 2:] > 1.4).all(axis=1) | (loads[:, 2:4].min(axis=1) > 1.4)
    assert fitted.sum() == 5 and (~fitted).sum() == 14
    assert off[~is_far].max() < 0.02 and off.max() < 0.04, off
    assert before[~is_far].min() > 0.04, before


@pytest.mark.slow  # 10 s
def test_oblique_weight_of_the_whole_body():
    """Of the benchmark's loads the last is none that moduli were fitted to, and none that half a body can bear."""
    robot = cli.script("benchmarks", "fidelity_robots").ROBOTS["Diamond"]
    places, start = robot.rest({"fidelity": "accurate"})
    way = np.linalg.norm(robot.truth, axis=1)
    assert (np.linalg.norm(places - start - robot.truth, axis=1) < 0.02 * way).all()


@pytest.mark.slow  # 15 s
def test_top_is_within_two_percent_under_commanded_lengths(commanded):
    """Moduli were fitted to no cables; with cables on points of the elbows the same robot is up to 7 % off."""
    tensions, commands, _ = commanded.read()
    assert len(tensions) == 9 and commands.max() > 0.025 and commands.min() < 0.001
    accurate = DiamondConfig(fidelity="accurate")
    assert commanded.errors(accurate).max() < 0.02
    assert commanded.errors(dataclasses.replace(accurate, fidelity="fast", cable_ends="points")).max() > 0.05


def test_tractions_of_patches_find_the_way_of_their_cables(commanded):
    """Pulled evenly, with directions that are found by iterating, elbows of the coarse mesh go where cables pull them.

    Patches of four points give way a little more than evenly pulled ones.
    """
    tensions = commanded.read()[0][:1]
    top, mean, directions = commanded.ways(1, tensions, None, 6)
    rest = commanded.coarsen.Half(1, np.zeros((1, 5))).patch_means()
    command = np.linalg.norm(commanded.ANCHORS - rest, axis=2) - np.linalg.norm(commanded.ANCHORS - rest - mean, axis=2)
    options = {"mesh": "coarse", "element": "p2", "rotation": "warped", "cable_ends": "patches"}
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    build_diamond_scene(DiamondSceneConfig(**options), builder)
    sim = sw.Simulation(builder.finalize(1, precision="float64"))
    start = sim.marker_x[0, 0].numpy().copy()
    sim.control.cable_displacement[:] = float(command[0, 0])
    assert sim.solve_static().converged.all()
    assert np.linalg.norm(directions, axis=2) == pytest.approx(1.0)
    np.testing.assert_allclose(sim.marker_x[0, 0].numpy() - start, top[0], atol=0.02 * top[0, 2])
    assert sim.cable_tension[0, 0].item() == pytest.approx(tensions[0, 0], rel=0.03)


def test_meshes_without_nodes_for_patches_are_refused():
    nodes = meshing.diamond("coarse").nodes
    with pytest.raises(meshing.MeshError, match="no node lies in the middle of each quarter of an elbow's outer face"):
        meshing.diamond_geometry.elbow_patch(nodes, (0.0, 1.0))
    chosen, shares = meshing.diamond_geometry.elbow_patch(meshing.diamond("medium").nodes, (0.0, 1.0))
    assert len(set(chosen)) == 4 and shares.sum() == pytest.approx(1.0)


def test_environment_takes_it_and_refuses_contradictions():
    env = registry.make("Diamond", num_worlds=2, seed=0, fidelity="accurate")
    config = env.config
    assert (config.mesh, config.element, config.rotation, config.coarsened) == ("coarse", "p2", "warped", True)
    assert config.cable_ends == "patches" and DiamondConfig().cable_ends == "points"
    assert env.sim.model.node_count == 1770
    env.rollout(2)
    assert DiamondConfig.paper(fidelity="accurate").mesh == "coarse"
    assert not DiamondConfig(mesh="coarse", element="p2").coarsened
    with pytest.raises(ValueError, match=r"fidelity='accurate' means mesh='coarse', got mesh='fine'; leave one"):
        DiamondConfig(fidelity="accurate", mesh="fine")
    with pytest.raises(ValueError, match=r"coarsened moduli are for .* nu=0.45, got 'coarse', 'p2' and 0.3"):
        DiamondConfig(fidelity="accurate", nu=0.3)
    with pytest.raises(ValueError, match="coarsened moduli are for mesh='coarse'"):
        DiamondConfig(coarsened=True)
