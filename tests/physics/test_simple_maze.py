"""A ball in a maze: it rolls and slides by the closed forms, and neither floor nor walls let it through."""

import math

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing, shapes
from softwarp.envs.tasks.simple_maze import turned
from softwarp.io.trajectory import Recorder

G, RADIUS, MASS = 9.81, 0.002, 1.0e-4


def ball_in(shape, place, *, mu=0.2, worlds=1, dt=0.01, rate=math.inf, below=False, down=0.0):
    """A simulation of a ball in a kinematic body that lies tilted down towards x, their numbers."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -G))
    q = turned(torch.tensor([[down, 0.0]])).double().numpy()[0]
    start = shapes.base.rotation_matrix(q) @ (*place, RADIUS)
    ball = builder.add_rigid(shapes.Sphere(RADIUS), mass=MASS, pose=start, name="ball")
    maze = builder.add_rigid(shape, kinematic=True, max_spin=rate, pose=(0.0, 0.0, 0.0, *q), name="maze")
    builder.add_contact(ball, maze, mu=mu)
    if below:
        place = {"pose": (0.0, 0.0, -0.0011), "max_spin": rate}
        box = builder.add_rigid(shapes.Box((0.06, 0.06, 0.002)), kinematic=True, name="box", **place)
        builder.add_contact(ball, box, mu=mu)
    return sw.Simulation(builder.finalize(worlds, "cpu", "float32", 16), dt), int(ball), int(maze)


def solid_of(maze):
    surface = maze.surface()
    return shapes.Mesh(surface.nodes, surface.triangles)


def corridor(cells=12, **measures):
    """One straight corridor along x."""
    return meshing.Maze(np.ones((cells - 1, 1), bool), np.zeros((cells, 0), bool), **measures)


def tray(floor=0.0):
    """A tray of 60 x 60 mm with a wall of 1 mm across its middle, a floor without thickness at 0, closed all the same.

    Its floor is two sheets of triangles that lie on each other, as that of SofaGym's maze.
    """
    line = np.array([-0.030, -0.029, -0.0005, 0.0005, 0.029, 0.030])
    wall = np.zeros((5, 5), bool)
    wall[[0, -1]], wall[:, [0, -1]], wall[2] = True, True, True
    quads = []
    for i in range(5):
        for j in range(5):
            corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
            top = 2 if wall[i, j] else 1
            quads.append([(*c, top) for c in corners])
            quads.append([(*c, 0) for c in reversed(corners)])
            for side, (di, dj) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
                inside = 0 <= i + di < 5 and 0 <= j + dj < 5
                low = (2 if wall[i + di, j + dj] else 1) if inside else 0
                a, b = corners[(side + 1) % 4], corners[(side + 2) % 4]
                if low < top:
                    quads.append([(*a, low), (*b, low), (*b, top), (*a, top)])
    number, triangles = {}, []
    for quad in quads:
        a, b, c, d = (number.setdefault(corner, len(number)) for corner in quad)
        triangles += [(a, b, c), (a, c, d)]
    heights = (-floor, 0.0, 0.009)
    return shapes.Mesh(np.array([(line[i], line[j], heights[k]) for i, j, k in number]), np.array(triangles))


def tilt(sim, maze, towards):
    """Tell the maze how to lie."""
    values = turned(torch.as_tensor(towards, dtype=torch.float32).reshape(-1, 2))
    sim.control.body_pose[:, maze, 3:] = values.expand(sim.num_worlds, 4)


def local(sim, ball, maze):
    """Place of the ball in the maze's frame [m], (world, 3)."""
    pose = sim.body_pose[:, maze].double().numpy()
    away = sim.body_pose[:, ball, :3].double().numpy() - pose[:, :3]
    return np.einsum("wji,wj->wi", shapes.base.rotation_matrix(pose[:, 3:]), away)


@pytest.mark.parametrize(("mu", "angle"), [(0.2, 0.2), (0.2, 0.05), (0.05, 0.2), (0.0, 0.1)])
def test_rolling_and_sliding(mu, angle):
    """Down a slope a ball rolls with 5/7 g sin a up to tan a = 7/2 mu, and slides with g (sin a - mu cos a) beyond.

    Backward Euler has the exact speed under a constant force.
    """
    maze = corridor(corridor=0.012)
    sim, ball, _ = ball_in(solid_of(maze), (-0.06, 0.0), mu=mu, dt=0.002, down=angle)
    sim.step(20)
    before = sim.body_twist[0, ball].double().numpy().copy()
    sim.step(100)
    speed = float(np.linalg.norm(sim.body_twist[0, ball, :3].double().numpy() - before[:3])) / 0.2
    sticks = math.tan(angle) <= 3.5 * mu
    expected = 5.0 / 7.0 * G * math.sin(angle) if sticks else G * (math.sin(angle) - mu * math.cos(angle))
    assert speed == pytest.approx(expected, rel=2e-3)
    spin = float(sim.body_twist[0, ball, 3:].norm() - np.linalg.norm(before[3:])) / 0.2
    turning = 5.0 / 7.0 * G * math.sin(angle) / RADIUS if sticks else 2.5 * mu * G * math.cos(angle) / RADIUS
    assert spin == pytest.approx(turning, rel=5e-3, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.1, 0.25, 0.5])
def test_walls_of_1_mm_hold(speed):
    """96 balls, at some speed in all directions from all cells of a maze, dt 10 ms: none leaves its corridors.

    At 0.5 m/s a ball goes five times a wall's thickness in a step, and more than its own diameter.
    """
    maze = meshing.random_maze(8, 8, seed=4)
    sim, ball, body = ball_in(solid_of(maze), maze.centres[0], worlds=96)
    angle = np.linspace(0.0, 2.0 * np.pi, 96, endpoint=False) + 0.01
    sim.frame_pose[:, ball, :2] = torch.as_tensor(maze.centres[np.arange(96) * 7 % 64], dtype=torch.float32)
    sim.frame_twist[:, ball, :2] = speed * torch.as_tensor(np.stack([np.cos(angle), np.sin(angle)], 1)).float()
    for step in range(60):
        if step % 10 == 9:  # once more, whatever the walls have left of it
            angle = angle + 1.0
            sim.frame_twist[:, ball, :2] = speed * torch.as_tensor(np.stack([np.cos(angle), np.sin(angle)], 1)).float()
        sim.step()
        place = local(sim, ball, body)
        assert np.abs(place[:, 2] - RADIUS).max() < 5e-5
        gap = solid_of(maze).distance(place) - RADIUS
        assert gap.min() > -5e-5
    assert int(sim.status.max()) == 0
    assert int(sim.contact_overflow.max()) == 0


@pytest.mark.parametrize("dt", [0.01, 0.002])
@pytest.mark.parametrize("below", [False, True], ids=["alone", "over a box"])
def test_sheets_without_thickness_hold(dt, below):
    """A ball on two coincident faces, pressed into the corner of floor and wall by tilts at 2 rad/s, stays above.

    Contacts with the far sides of floor and wall once took it through in one step, with status 0.
    """
    sim, ball, maze = ball_in(tray(), (0.01, 0.01), worlds=16, dt=dt, rate=2.0, below=below)
    generator = np.random.default_rng(0)
    for step in range(round(1.5 / dt)):
        if step % round(0.2 / dt) == 0:
            values = turned(torch.as_tensor(0.3 * generator.integers(-1, 2, (16, 2)), dtype=torch.float32))
            for body in range(sim.model.rigid_count):
                if body != ball:
                    sim.control.body_pose[:, body, 3:] = values
        sim.step()
        place = local(sim, ball, maze)
        assert place[:, 2].min() > 0.0
        assert np.abs(place[:, :2]).max() < 0.029
        assert (place[:, 0] > 0.0).all()  # the wall across the middle
    assert place[:, 2].min() == pytest.approx(RADIUS, abs=2e-5)
    assert int(sim.status.max()) == 0


def test_each_world_has_its_own_maze():
    """With one of several meshes, the world that chose a mesh has the bits of one that has this mesh alone."""
    mazes = [meshing.random_maze(5, 5, seed=seed) for seed in range(4)]
    start = mazes[0].centres[12]
    sim, ball, body = ball_in(shapes.OneOf([solid_of(maze) for maze in mazes]), start, worlds=8, rate=4.0)
    chosen = [3, 0, 2, 1, 1, 2, 0, 3]
    sim.params.body_choice[:, 0] = torch.tensor(chosen, dtype=torch.float32)
    alone = [ball_in(solid_of(maze), start, worlds=8, rate=4.0)[0] for maze in mazes]
    for step in range(30):
        for one in (sim, *alone):
            tilt(one, body, (0.2 if step % 40 < 20 else -0.2, 0.2 if step % 30 < 15 else -0.2))
            one.step()
    places = sim.body_pose[:, ball].clone()
    for world, number in enumerate(chosen):
        assert torch.equal(places[world], alone[number].body_pose[world, ball])
    assert len({tuple(place) for place in places.tolist()}) == 4
    saved = sim.snapshot(worlds=[2])
    sim.restore(saved, worlds=range(8))
    assert (sim.params.body_choice[:, 0] == 2.0).all()


def test_corners_pass_no_sheets():
    """Contact of a box with a sheet without thickness is refused with the reason; floors of some thickness are none."""
    builder = sw.ModelBuilder()
    box = builder.add_rigid(shapes.Box((0.01, 0.01, 0.01)), mass=1.0, pose=(0.0, 0.0, 0.1), name="box")
    sheet = builder.add_rigid(tray(), kinematic=True, name="tray")
    builder.add_contact(box, sheet, mu=0.5)
    with pytest.raises(ValueError, match=r"triangle \d+ of tray lies on another"):
        builder.finalize(1)
    assert tray().sheet >= 0
    assert tray(floor=1.0e-4).sheet == -1
    assert solid_of(meshing.serpentine()).sheet == -1


def test_only_balls_touch_one_of_several():
    """A box needs corners and edges of what it touches."""
    builder = sw.ModelBuilder()
    box = builder.add_rigid(shapes.Box((0.01, 0.01, 0.01)), mass=1.0, pose=(0.0, 0.0, 0.1), name="box")
    meshes = [shapes.Mesh(*shapes.Box((1.0, 1.0, 0.1)).surface()), solid_of(corridor())]
    either = builder.add_rigid(shapes.OneOf(meshes), kinematic=True, name="either")
    builder.add_contact(box, either, mu=0.5)
    with pytest.raises(ValueError, match="only balls"):
        builder.finalize(1)
    with pytest.raises(ValueError, match="meshes"):
        shapes.OneOf([])
    with pytest.raises(ValueError, match="meshes"):
        shapes.OneOf([shapes.Box((1.0, 1.0, 1.0))])


def test_a_recording_shows_the_mesh_that_the_world_chose():
    """One recording holds one mesh; worlds with different ones are recorded one by one."""
    mazes = [solid_of(meshing.random_maze(3, 3, seed=seed)) for seed in range(2)]
    sim, _, body = ball_in(shapes.OneOf(mazes), (-0.007375, -0.007375), worlds=2)
    sim.params.body_choice[1] = 1.0
    for world in range(2):
        recorder = Recorder(sim, worlds=[world])
        recorder.capture()
        parts = recorder.finish().parts
        np.testing.assert_allclose(parts.piece_surface(parts.pieces(body)[0], 8)[0], mazes[world].vertices, atol=1e-8)
    with pytest.raises(ValueError, match="one by one"):
        Recorder(sim, worlds=[0, 1]).capture()
