"""The Diamond of fidelity "accurate": moduli along its legs make up for coarse quadratic elements."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from softwarp import cli, meshing
from softwarp.envs import registry
from softwarp.envs.options.diamond import DiamondConfig

assets = Path(__file__).parents[2] / "assets" / "diamond"


@pytest.fixture(scope="module")
def coarsen():
    spec = importlib.util.spec_from_file_location("coarsen", assets / "coarsen.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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


def test_environment_takes_it_and_refuses_contradictions():
    env = registry.make("Diamond", num_worlds=2, seed=0, fidelity="accurate")
    config = env.config
    assert (config.mesh, config.element, config.rotation, config.coarsened) == ("coarse", "p2", "warped", True)
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
