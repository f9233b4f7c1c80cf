"""The benchmark suite: every environment is in it, its cantilever is the one it says, records are complete."""

import json
import time
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from softwarp import cli, meshing
from softwarp.envs import registry


def part(name: str) -> ModuleType:
    return cli.script("benchmarks", name)


def test_every_environment_is_a_scene():
    """A new environment is timed without being asked."""
    assert {f"env_{spec.file_name}" for spec in registry.ENVIRONMENTS.values()} <= set(part("scenes").SCENES)


def test_cantilever_of_the_peers():
    """525 nodes, 1600 tetrahedra that fill the box, and the mass of it; faces of neighbouring cells match."""
    beam = part("cantilever")
    solid = beam.mesh()
    assert (len(solid.nodes), len(solid.tets)) == (525, 1600)
    volume = np.prod(beam.SIZE)
    volumes = meshing.tet_volumes(solid.nodes, solid.tets)
    assert volumes.min() > 0.0
    np.testing.assert_allclose(volumes.sum(), volume, rtol=1e-12)
    np.testing.assert_allclose(beam.masses(solid).sum(), beam.DENSITY * volume, rtol=1e-12)
    cells = beam.CELLS
    faces = 4 * (cells[0] * cells[1] + cells[1] * cells[2] + cells[0] * cells[2])  # two triangles per square outside
    assert len(meshing.tet_surface(solid.tets)) == faces


def test_memory_counts_every_array_once():
    """Twice the worlds take less than twice the bytes (the structure is shared), and more than the state alone."""
    rod = part("rod")
    timing = part("timing")
    small, large = (timing.array_bytes(rod.build(worlds, "cpu", "float32")) for worlds in (8, 16))
    assert 8 * 4 * (21 * 13) < large - small < small


def test_cores_are_given_back():
    """Inside the limit there is one core, afterwards all; more than there are is refused with their number."""
    timing = part("timing")
    with timing.limited_cores(None) as before, timing.limited_cores(1) as one:
        assert one == 1
    with timing.limited_cores(None) as after:
        assert after == before
    with (
        pytest.raises(ValueError, match=f"cores={before + 1}: this process may use {before}"),
        timing.limited_cores(before + 1),
    ):
        pass


def test_one_scene_to_files(tmp_path, capsys):
    """A record says what was measured where, and the table repeats it."""
    run = part("run")
    out = tmp_path / "bench"
    assert run.main(["--filter", "rod", "--worlds", "2", "--quick", "--device", "cpu", "--out", str(out)]) == 0
    (record,) = json.loads((out / "results.json").read_text())
    assert (record["case"], record["worlds"], record["nodes"], record["failed_worlds"]) == ("rod", 2, 21, 0)
    assert 0.0 < record["ms_min"] <= record["ms_per_step"] <= record["ms_max"]
    assert record["world_steps_per_s"] == pytest.approx(2e3 / record["ms_per_step"])
    assert {"build_s", "first_step_s", "memory_mb_per_world", "commit", "hardware", "versions"} <= set(record)
    assert record["scene"] in (out / "results.md").read_text()
    with pytest.raises(ValueError, match="no scene matches 'tree'; there are trunk, rod"):
        run.main(["--filter", "tree"])
    with pytest.raises(ValueError, match="no part 'tree'; there are accuracy, locking, peers"):
        run.main(["tree"])


def test_whole_steps_of_an_environment(tmp_path, capsys):
    """On a CPU parts are launched; the host is busy for no longer than a step takes."""
    path = tmp_path / "capture.json"
    arguments = ["--tasks", "CartPole", "--worlds", "2", "--device", "cpu", "--steps", "2", "--json", str(path)]
    assert part("capture").main(arguments) == 0
    (record,) = json.loads(path.read_text())
    assert (record["task"], record["worlds"], record["capture"]) == ("CartPole", 2, False)
    assert 0.0 < record["host_ms"] <= record["ms_per_step"]
    assert "CartPole              2 worlds, parts" in capsys.readouterr().out


def test_peers_that_are_missing_are_named(capsys, monkeypatch):
    """Without other simulators softwarp settles where linear tetrahedra do; the rest is listed, with its cure."""
    peers = part("peers")
    for name, runner in peers.RUNNERS.items():
        if name != "softwarp":
            monkeypatch.setattr(runner, "missing", classmethod(lambda cls: True))
    assert peers.main(["--worlds", "2", "--repeats", "1", "--settle", "200"]) == 0
    told = capsys.readouterr().out
    cures = "mujoco (pip install softwarp[peers]), newton (pip install newton), genesis (pip install genesis-world)"
    assert f"not installed: {cures}" in told
    rows = [line for line in told.splitlines() if line.startswith("| softwarp")]
    assert len(rows) == 2
    sag = float(rows[0].split("|")[9].split()[0])
    assert sag == pytest.approx(59.4, abs=1.5)


def test_a_module_of_the_same_name_is_not_the_peer(monkeypatch):
    """PyPI has another ``genesis``; without the metadata of its package a simulator counts as missing."""
    peers = part("peers")
    monkeypatch.setattr(peers.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(peers.RUNNERS["genesis"], "package", "no-such-package-of-softwarp")
    assert peers.RUNNERS["genesis"].missing()
    monkeypatch.setattr(peers.RUNNERS["genesis"], "package", "numpy")
    assert not peers.RUNNERS["genesis"].missing()


def test_slow_simulators_sit_out(monkeypatch):
    """One that has had its time is sampled no more; its record still has a speed, a factor and an answer."""
    peers = part("peers")

    class Slow(peers.Runner):
        module, steps, swings = "softwarp", 2, 0

        def swing(self, steps):
            Slow.swings += 1
            time.sleep(0.02)

        def sag(self, steps):
            return 0.06

    monkeypatch.setitem(peers.RUNNERS, "slow", Slow)
    monkeypatch.setattr(peers, "BUDGET", 0.01)
    records = peers.compare(["softwarp", "slow"], 2, 2, 3, 1, {})
    assert Slow.swings == 2  # one for compilers, one sample
    assert [record["engine"] for record in records] == ["softwarp", "slow"]
    assert records[1]["ms_per_step"] >= 10.0
    assert records[1]["times_softwarp"] == pytest.approx(records[1]["ms_per_step"] / records[0]["ms_per_step"])
    assert records[1]["sag_mm"] == pytest.approx(60.0)


@pytest.mark.slow
def test_quick_run_of_everything(tmp_path):
    """Every scene steps without a failed world, and the plots are drawn."""
    assert part("run").main(["--quick", "--device", "cpu", "--out", str(tmp_path)]) == 0
    records = json.loads((tmp_path / "results.json").read_text())
    assert {record["case"] for record in records if "case" in record} == set(part("scenes").SCENES)
    assert {record["figure"] for record in records if "figure" in record} == {"worlds", "nodes", "cores"}
    told = (tmp_path / "results.md").read_text()
    assert all(f"scaling with {figure}" in told for figure in ("worlds", "nodes", "cores"))
    assert (tmp_path / "scaling.png").stat().st_size > 10_000


def test_first_line_of_a_command_is_waited_for_and_no_longer():
    """A program that goes on is ended; one that says nothing is told."""
    start = part("start")
    done = start.run_until_told("import time; print('here', flush=True); time.sleep(600)")
    assert done.output == "here\n"
    assert 0.0 < done.wall < 60.0
    with pytest.raises(RuntimeError, match="ended without a word"):
        start.run_until_told("pass")


@pytest.mark.slow
def test_a_grasp_lifts_and_contacts_are_those_asked_for(tmp_path: Path) -> None:
    """Parts that users run by hand: every cube hangs in the end, nothing passes; a wider punch has more contacts."""
    from benchmarks import contacts, lift

    record = lift.run(2, "cpu", 1)
    assert record["lifted"] == 1.0 and record["failed"] == record["overflowed"] == 0
    assert record["penetration"] < 0.01
    options = ["--steps", "1", "--repeats", "1", "--json", str(tmp_path / "c")]
    assert contacts.main(["--contacts", "4", "16", *options]) == 0
    few, many = json.loads((tmp_path / "c").read_text())
    assert 4 <= few["contacts"] < many["contacts"] and many["contacts"] >= 16
