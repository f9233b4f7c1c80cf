import dataclasses
import json
import os

import numpy as np
import pytest

import softwarp as sw
from softwarp.io.atomic import atomic_path
from softwarp.io.trajectory import Recorder, Trajectory, TrajectoryError, compact_surface, up_against
from softwarp.render import RayCaster
from tests.unit.io.fakes import FakeSimulation, recording


def assert_same(one, other):
    """Two trajectories hold the same values."""
    for part, twin in ((one, other), (one.parts, other.parts)):
        for field in dataclasses.fields(part):
            if field.name != "parts":
                np.testing.assert_array_equal(getattr(part, field.name), getattr(twin, field.name), err_msg=field.name)


def test_recorder_keeps_the_surface_of_the_chosen_worlds():
    """Positions, tensions and stresses of worlds 2 and 0, in that order, at surface nodes only."""
    sim = FakeSimulation(3)
    recorder = Recorder(sim, [2, 0])
    sim.step([0.1, 0.2, 0.3])
    recorder.capture(goal=np.zeros((2, 3)))
    film = recorder.finish()
    np.testing.assert_array_equal(film.vertex_x[0], sim.node_x.numpy()[[2, 0]][:, film.vertex_node])
    np.testing.assert_array_equal(film.stress[0], sim.node_stress().numpy()[[2, 0]][:, film.vertex_node])
    np.testing.assert_array_equal(film.cable_tension[0], sim.cable_tension.numpy()[[2, 0]])
    np.testing.assert_array_equal(film.cable_x[0], sim.cable_x.numpy()[[2, 0]])
    np.testing.assert_array_equal(film.vertex_node[film.triangles], sim.model.surface_tri)
    assert film.vertex_fixed.sum() == 16
    assert film.frame_count == 1
    assert film.world.tolist() == [2, 0]


def test_recorder_reads_a_real_simulation():
    """A cantilever with one cable: what is recorded is what the simulation shows, and the cable's end moves."""
    builder = sw.ModelBuilder(gravity=(0.0, -9.81, 0.0))
    body = builder.add_tets(
        sw.meshing.box((0.1, 0.02, 0.02), (5, 1, 1)), material=sw.Corotational(1e5, 0.4), density=1e3
    )
    builder.fix(body, box=((-1, -1, -1), (1e-6, 1, 1)))
    builder.add_cable(body, [(0.0, 0.015, 0.01), (0.05, 0.015, 0.01), (0.1, 0.015, 0.01)], name="upper")
    builder.add_marker(body, (0.1, 0.01, 0.01), name="tip")
    sim = sw.Simulation(builder.finalize(num_worlds=2, device="cpu"), dt=0.02)
    recorder = Recorder(sim, worlds=[1])
    recorder.capture()
    for _ in range(3):
        sim.control.cable_displacement[1] = 2e-3
        sim.step()
        recorder.capture()
    film = recorder.finish()
    assert film.up.tolist() == [0.0, 1.0, 0.0]
    assert film.cable_names == ("upper",)
    assert film.cable_x.shape == (4, 1, 3, 3)
    np.testing.assert_allclose(film.time, [0.0, 0.02, 0.04, 0.06], rtol=1e-5)
    np.testing.assert_array_equal(film.vertex_x[-1, 0], sim.node_x[1].numpy()[film.vertex_node])
    np.testing.assert_array_equal(film.marker_x[-1, 0], sim.marker_x[1].numpy())
    assert film.vertex_fixed.sum() == 4
    assert film.cable_tension[-1] > 0.0
    assert film.stress[-1].max() > 10.0 * film.stress[0].max()
    frame = RayCaster.for_model(sim.model, width=32, height=24).render(sim.node_x, sim.cable_x)
    assert frame.shape == (2, 24, 32, 3)


def test_recording_does_not_alias_the_simulation():
    """A later step leaves earlier frames as they were."""
    sim = FakeSimulation()
    recorder = Recorder(sim)
    recorder.capture()
    before = sim.node_x.clone()
    sim.node_x += 1.0
    sim.time += 0.01
    recorder.capture()
    film = recorder.finish()
    np.testing.assert_array_equal(film.vertex_x[0, 0], before[0, film.vertex_node].numpy())


def test_clock_goes_on_over_a_reset():
    """Times 0, 0.01, 0.02, then a reset to 0 and on: frames stay 0.01 s apart."""
    sim = FakeSimulation()
    recorder = Recorder(sim, stress=False)
    for k in range(6):
        if k == 3:
            sim.time.zero_()
        recorder.capture()
        sim.step([0.1 * k])
    film = recorder.finish()
    np.testing.assert_allclose(np.diff(film.time), 0.01, rtol=1e-5)
    assert film.stress is None
    assert film.goal is None


def test_explicit_times_must_increase():
    sim = FakeSimulation()
    recorder = Recorder(sim)
    recorder.capture(time=1.0)
    with pytest.raises(ValueError, match=r"increase, got 1 s after 1 s"):
        recorder.capture(time=1.0)
    recorder.capture(time=1.5)
    assert recorder.finish().time.tolist() == [1.0, 1.5]


def test_goal_in_all_frames_or_none():
    sim = FakeSimulation()
    recorder = Recorder(sim)
    recorder.capture()
    with pytest.raises(ValueError, match="frame 0 had no goal, frame 1 has one"):
        recorder.capture(goal=[[0.0, 0.0, 0.0]])
    with pytest.raises(ValueError, match=r"shape \(1, 3\), got \(3,\)"):
        Recorder(sim).capture(goal=[0.0, 0.0, 0.0])


@pytest.mark.parametrize("worlds", [[], [3], [-1], [0, 0]])
def test_unknown_worlds_are_refused(worlds):
    with pytest.raises(ValueError, match=r"different numbers in \[0, 3\)"):
        Recorder(FakeSimulation(3), worlds)


def test_finish_needs_a_frame():
    with pytest.raises(TrajectoryError, match=r"capture\(\) at least once"):
        Recorder(FakeSimulation()).finish()


def test_file_gives_back_every_value(tmp_path):
    film = recording()
    again = Trajectory.load(film.save(tmp_path / "deep" / "film.npz"))
    assert_same(again, film)
    assert os.listdir(tmp_path / "deep") == ["film.npz"]


def test_file_without_goal_and_stress(tmp_path):
    film = recording(goal=False, stress=False)
    again = Trajectory.load(film.save(tmp_path / "film.npz"))
    assert again.goal is None
    assert again.stress is None


def test_foreign_and_newer_files_are_refused(tmp_path):
    """Text, an npz of other arrays, another format, a newer version, a missing array: each with its own message."""
    text = tmp_path / "text.npz"
    text.write_text("not a zip file")
    with pytest.raises(TrajectoryError, match="not a readable trajectory"):
        Trajectory.load(text)
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(TrajectoryError, match="not a softwarp trajectory"):
        Trajectory.load(tmp_path / "other.npz")
    for change, message in (
        ({"format": "softwarp.snapshot"}, "holds 'softwarp.snapshot'"),
        ({"version": 99}, "format 99 is newer than 2"),
        ({}, "damaged file, lacks world, up"),
    ):
        header = {"format": "softwarp.trajectory", "version": 1} | change
        np.savez(tmp_path / "x.npz", header=np.array(json.dumps(header)), time=np.zeros(1))
        with pytest.raises(TrajectoryError, match=message):
            Trajectory.load(tmp_path / "x.npz")
    with pytest.raises(FileNotFoundError, match=r"nowhere\.npz"):
        Trajectory.load(tmp_path / "nowhere.npz")


def test_truncated_file_is_refused(tmp_path):
    path = recording().save(tmp_path / "film.npz")
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(TrajectoryError, match="not a readable trajectory"):
        Trajectory.load(path)


def test_suffix_and_folder_are_checked(tmp_path):
    film = recording(1)
    with pytest.raises(ValueError, match=r"did you mean .*film\.npz"):
        film.save(tmp_path / "film")
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"cannot write .*film\.npz.*; choose a folder"):
        film.save(tmp_path / "file" / "film.npz")


def test_inconsistent_arrays_are_refused():
    film = recording(2)
    with pytest.raises(TrajectoryError, match=r"goal must have shape \(frame 2, world 2, 3\), got \(3, 2, 3\)"):
        dataclasses.replace(film, goal=np.zeros((3, 2, 3)))
    with pytest.raises(TrajectoryError, match="strictly increasing"):
        dataclasses.replace(film, time=[0.0, 0.0])
    with pytest.raises(TrajectoryError, match="4 cables, 1 cable names"):
        dataclasses.replace(film, cable_names=("one",))
    with pytest.raises(TrajectoryError, match="triangle indices"):
        dataclasses.replace(film, triangles=film.triangles + 1000)
    with pytest.raises(TrajectoryError, match="cable_point_start"):
        dataclasses.replace(film, cable_point_start=[0, 8, 16, 24, 31])


def test_frames_at_picks_the_nearest():
    """Frames every 0.01 s up to 0.05 s; a clock of 30 ticks per second asks for 0 and 0.0333 s."""
    film = recording(6)
    assert film.frame_rate == 100.0
    assert film.frames_at(30.0).tolist() == [0, 3]
    assert film.frames_at(100.0).tolist() == [0, 1, 2, 3, 4, 5]
    assert recording(1).frames_at(25.0).tolist() == [0]
    with pytest.raises(ValueError, match="fps must be positive"):
        film.frames_at(0.0)


def test_world_rows_are_numbers_of_the_simulation():
    film = recording(1, worlds=(1, 3))
    assert film.world_rows(None) == [0, 1]
    assert film.world_rows([3]) == [1]
    with pytest.raises(ValueError, match=r"holds the worlds \[1, 3\], asked for \[0\]"):
        film.world_rows([0])


def test_compact_surface_keeps_order():
    nodes, tri = compact_surface([[7, 2, 9], [9, 2, 4]])
    assert nodes.tolist() == [2, 4, 7, 9]
    assert tri.tolist() == [[2, 0, 3], [3, 0, 1]]


def test_up_is_the_axis_against_gravity():
    assert up_against((0.0, -9.81, 0.1)).tolist() == [0.0, 1.0, 0.0]
    assert up_against((9.81, 0.0, 0.0)).tolist() == [-1.0, 0.0, 0.0]
    assert up_against((0.0, 0.0, 0.0)).tolist() == [0.0, 0.0, 1.0]


def test_atomic_path_leaves_the_old_file_on_failure(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError):
        with atomic_path(path) as scratch:
            scratch.write_text("half")
            raise RuntimeError
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]
    with atomic_path(path) as scratch:
        scratch.write_text("new")
    assert path.read_text() == "new"
    with pytest.raises(IsADirectoryError, match="it is a folder"), atomic_path(tmp_path):
        pass
