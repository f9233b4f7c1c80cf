import dataclasses
import json
import os

import numpy as np
import pytest

import softwarp as sw
from softwarp import meshing
from softwarp.io.atomic import atomic_path
from softwarp.io.trajectory import Recorder, Trajectory, TrajectoryError, compact_surface, up_against
from softwarp.render import RayCaster
from tests.unit.io.fakes import FakeSimulation, parts_film, recording

FIRST_VERSION = (
    *("time", "world", "up", "triangles", "tri_body", "vertex_node", "vertex_rest", "vertex_fixed", "vertex_x"),
    *("cable_point_start", "cable_x", "cable_tension", "marker_x", "goal", "stress"),
)


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


@pytest.fixture(scope="module")
def gripping():
    """Three worlds after a few steps: a ball on a floor under a soft block with a chamber, a rod with a hinged arm."""
    builder = sw.ModelBuilder()
    floor = builder.add_rigid(sw.Plane(), kinematic=True, name="floor")
    ball = builder.add_rigid(sw.Sphere(0.02), density=800.0, pose=(0.0, 0.0, 0.019999), name="ball")
    builder.add_contact(ball, floor, mu=0.5, name="ball on floor")
    block = meshing.box((0.03, 0.03, 0.03), (3, 3, 3))
    nodes, tets = meshing.compact(block.nodes + (0.1, 0.0, 0.1), block.tets[np.repeat(np.arange(27) != 13, 6)])
    body = builder.add_tets(nodes, tets, material=sw.NeoHookean(1e5, 0.4), density=1e3, name="block")
    builder.fix(body, nodes=np.flatnonzero(nodes[:, 2] > 0.1299))
    wall, corners = np.unique(meshing.voids(nodes, tets)[0], return_inverse=True)
    builder.add_cavity(body, nodes[wall], meshing.orient_surface(corners.reshape(-1, 3)), name="void")
    rod = builder.add_rod(meshing.straight(0.1, 4, start=(-0.1, 0.0, 0.3)), radius=0.003, youngs=1e6, name="rod")
    builder.fix(rod, nodes=[0])
    arm = builder.add_rigid(sw.Box((0.02, 0.02, 0.02)), density=500.0, pose=(-0.1, 0.0, 0.41), name="arm")
    builder.add_joint((rod, 4), arm, "hinge", anchor=(-0.1, 0.0, 0.4), axis=(0.0, 1.0, 0.0), name="hinge")
    sim = sw.Simulation(builder.finalize(3), dt=0.005)
    sim.control.cavity_pressure[2] = 500.0
    recorder = Recorder(sim, [2, 1], contacts=True)
    for _ in range(4):
        sim.step()
        recorder.capture()
    return sim, recorder.finish()


def test_recorder_keeps_all_parts(gripping):
    """Poses, rods, chambers and contacts of worlds 2 and 1 are those of the simulation at the last frame."""
    sim, film = gripping
    assert film.name == "block"
    assert film.parts.rigid_names == ("floor", "ball", "arm")
    assert (film.parts.rod_names, film.parts.cavity_names) == (("rod",), ("void",))
    assert film.parts.joint_names == ("hinge",)
    for array, view in (
        (film.rigid_pose, sim.body_pose),
        (film.rod_x, sim.rod_x),
        (film.rod_q, sim.rod_q),
        (film.cavity_pressure, sim.cavity_pressure),
        (film.cavity_volume, sim.cavity_volume),
    ):
        np.testing.assert_array_equal(array[-1], view[[2, 1]].numpy())
    assert film.cavity_pressure[-1, :, 0].tolist() == [500.0, 0.0]
    for world in range(2):
        volume = meshing.surface_volume(film.cavity_x[-1, world], film.parts.cavity_tri)
        np.testing.assert_allclose(volume, film.cavity_volume[-1, world, 0], rtol=1e-4)


def test_recorder_keeps_contacts(gripping):
    """One contact in every world: below the ball, with its weight, of the only pair."""
    sim, film = gripping
    assert film.pair_names == ("ball on floor",)
    assert film.contact_pair.tolist() == [[[0], [0]]] * 4
    np.testing.assert_array_equal(film.contact_x[-1, :, 0], sim.contact_point[[2, 1], 0].numpy())
    weight = 800.0 * 4.0 / 3.0 * np.pi * 0.02**3 * 9.81
    np.testing.assert_allclose(film.contact_force[-1, :, 0], [[0.0, 0.0, weight]] * 2, rtol=2e-2, atol=1e-3)
    assert film.strong_force() == pytest.approx(weight, rel=0.1)
    without = Recorder(sim)
    without.capture()
    assert without.finish().contact_x is None


def test_recorder_of_a_scene_without_soft_bodies(tmp_path):
    """A spinning top without a shape and a rod: the recording is named, bounded, saved and read."""
    builder = sw.ModelBuilder()
    rod = builder.add_rod(meshing.straight(0.1, 2), radius=0.01, youngs=1e6, name="whip")
    builder.fix(rod, nodes=[0])
    builder.add_rigid(mass=1.0, inertia=(1e-3, 2e-3, 2e-3), pose=(0.3, 0.0, 0.0), name="top")
    sim = sw.Simulation(builder.finalize(1), dt=0.005)
    recorder = Recorder(sim)
    recorder.capture()
    film = recorder.finish()
    assert film.name == "whip"
    np.testing.assert_allclose(film.bounds(), [[-0.01, -0.01, -0.01], [0.3, 0.01, 0.11]], atol=1e-6)
    assert film.size() == pytest.approx(0.31)
    assert_same(Trajectory.load(film.save(tmp_path / "film.npz")), film)


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


def test_file_gives_back_all_parts(tmp_path):
    film = parts_film()
    assert_same(Trajectory.load(film.save(tmp_path / "film.npz")), film)


def test_files_of_the_first_version_are_read(tmp_path):
    """Files from before rigid bodies and rods: what they hold is there, the rest is empty."""
    film = recording()
    arrays = {name: getattr(film, name) for name in FIRST_VERSION}
    names = {key: list(getattr(film, key)) for key in ("body_names", "cable_names", "marker_names")}
    header = {"format": "softwarp.trajectory", "version": 1, "name": film.name, "dt": film.dt} | names
    np.savez_compressed(tmp_path / "old.npz", header=np.array(json.dumps(header)), **arrays)
    assert_same(Trajectory.load(tmp_path / "old.npz"), film)


def test_files_of_this_version_need_all_arrays(tmp_path):
    path = parts_film().save(tmp_path / "film.npz")
    with np.load(path) as archive:
        kept = {name: archive[name] for name in archive.files if name not in ("rod_q", "piece_size")}
    np.savez(path, **kept)
    with pytest.raises(TrajectoryError, match="damaged file, lacks rod_q, piece_size"):
        Trajectory.load(path)


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
    film = parts_film(2)
    with pytest.raises(TrajectoryError, match=r"rod_q must have shape \(frame 2, world 2, rod_point 5, 4\)"):
        dataclasses.replace(film, rod_q=film.rod_q[..., :3])
    with pytest.raises(TrajectoryError, match=r"rigid_pose is missing; it must have shape \(2, 2, 6, 7\)"):
        dataclasses.replace(film, rigid_pose=np.zeros(0))
    with pytest.raises(TrajectoryError, match="all of contact_x, contact_force, contact_pair or none"):
        dataclasses.replace(film, contact_x=None)
    with pytest.raises(TrajectoryError, match=r"contact_pair must lie in \[-1, 1\), got 1"):
        dataclasses.replace(parts_film(3), pair_names=("one",))


def test_bounds_and_size_of_parts():
    """Bodies at 0.03 b, the floor left out; without soft bodies the rod is the tallest."""
    film = parts_film(4, soft=False)
    low, high = film.bounds()
    assert low[2] > -0.005  # the plane lies at -0.01
    assert high[0] == pytest.approx(0.15)  # the body without a shape
    assert film.size() == pytest.approx(0.22, abs=1e-3)


def test_strong_force_leaves_out_rare_blows():
    """1 N in 19 frames and 100 N in one: arrows are scaled by 1 N; without contacts by nothing."""
    film = parts_film(20)
    force = film.contact_force / 2.0
    force[7] *= 100.0
    film = dataclasses.replace(film, contact_force=force)
    assert film.strong_force() == pytest.approx(1.0)
    assert film.strong_force(frames=[7]) == pytest.approx(100.0)
    assert film.strong_force(frames=[0]) == 0.0
    assert recording().strong_force() == 0.0


def test_frames_at_picks_the_nearest():
    """Frames every 0.01 s up to 0.05 s; a clock of 30 ticks per second asks for 0 and 0.0333 s after the first."""
    film = recording(6)
    assert film.frame_rate == 100.0
    assert film.frames_at(30.0).tolist() == [0, 3]
    assert film.frames_at(100.0).tolist() == [0, 1, 2, 3, 4, 5]
    assert dataclasses.replace(film, time=film.time + 3.07).frames_at(30.0).tolist() == [0, 3]
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
