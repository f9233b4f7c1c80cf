"""``softwarp bench fidelity``: errors and times of a robot's variants."""

import json

import numpy as np
import pytest

from softwarp import cli


@pytest.mark.slow  # 15 s
def test_errors_and_times(tmp_path, capsys, monkeypatch):
    """A variant that is the truth is not off, a coarser one is; records tell times beside errors."""
    fidelity, robots = (cli.script("benchmarks", name) for name in ("fidelity", "fidelity_robots"))
    pad = robots.ROBOTS["CatchTheObject"]
    small = {"mesh": "coarse", "element": "p2", "rotation": "warped"}
    variants = {"default": {}, "p2": small}
    monkeypatch.setitem(
        fidelity.ROBOTS, "CatchTheObject", robots.Robot(pad.scene, pad.rest, small, variants, drive=pad.drive)
    )
    path = tmp_path / "records.json"
    assert (
        fidelity.main(
            ["--robots", "CatchTheObject", "--worlds", "2", "--cores", "1", "--repeats", "1", "--json", str(path)]
        )
        == 0
    )
    default, p2 = json.loads(path.read_text())
    assert (default["robot"], default["variant"], p2["variant"]) == ("CatchTheObject", "default", "p2")
    assert default["ratio"] == 1.0 and p2["ratio"] > 1.0 and p2["nodes"] > 2 * default["nodes"]
    assert max(p2["errors_percent"]) == 0.0 and min(default["errors_percent"]) > 10.0
    assert "CatchTheObject default" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["Trunk", "Diamond", "Gripper", "Tripod"])
def test_solids_are_held_and_bent(name):
    """The point that is looked at moves a good way under every load, but stays in sight; Gripper's loads are small."""
    robots = cli.script("benchmarks", "fidelity_robots")
    places, start = robots.ROBOTS[name].rest(robots.ROBOTS[name].variants["default"])
    ways = np.linalg.norm(places - start, axis=1)
    assert (ways > (1e-6 if name == "Gripper" else 1e-3)).all() and (ways < 0.3).all()


def test_the_accurate_tripod_is_near_the_truth():
    """Within 2 % of the limit of quadratic meshes, under loads that nothing was fitted to."""
    robots = cli.script("benchmarks", "fidelity_robots")
    tripod = robots.ROBOTS["Tripod"]
    places, start = tripod.rest(tripod.variants["accurate"])
    off = np.linalg.norm(places - start - tripod.truth, axis=1)
    assert (off < 0.02 * np.linalg.norm(tripod.truth, axis=1)).all()


@pytest.mark.slow  # 10 s; the coarsest of the meshes whose limit is taken for truth
def test_parts_of_the_diamond_rest_where_the_whole_one_does():
    """Halves and quarters under loads as symmetric as they are."""
    truth, robots = (cli.script("benchmarks", name) for name in ("fidelity_truth", "fidelity_robots"))
    places, start = robots.ROBOTS["Diamond"].rest(robots.ROBOTS["Diamond"].variants["p2"])
    axial, side = truth.ways(1, truth.AXIAL, 4), truth.ways(1, truth.SIDE, 2)
    found = np.concatenate([axial, side, truth.ways(1, truth.OBLIQUE, 2, np.pi / 4.0) @ truth.turned(np.pi / 4.0)])
    np.testing.assert_allclose(found, places - start, atol=1e-8)
