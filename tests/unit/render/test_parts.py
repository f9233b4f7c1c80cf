"""Pictures of rigid bodies, rods, chambers, contacts and joints."""

import dataclasses

import numpy as np
import pytest

import softwarp as sw
from softwarp import meshing, shapes
from softwarp.io.parts import ChamberPoints, Parts
from softwarp.io.placement import Placement
from softwarp.render import Camera, RayCaster, render_trajectory
from softwarp.render.notes import contact_notes
from tests.unit.io.fakes import kuhn_surface, parts_film, parts_of

STILL = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
NOTHING = {"triangles": np.zeros((0, 3)), "rest": np.zeros((0, 3))}
FRONT = Camera((0.0, -4.0, 0.0), (0.0, 0.0, 0.0), fov=2 * np.degrees(np.arctan(0.25)))  # 2 m wide at the origin
SIZE = {"camera": FRONT, "width": 100, "height": 100, "samples": 1}
NEAR = Camera((0.0, -4.0, 0.0), (0.0, 0.0, 0.0), fov=10.0)  # 0.7 m wide
BELOW = [[-1.0, -1.0, -3.0], [1.0, 1.0, 3.0]]  # keeps the floor out of the picture


def rigid_caster(*shape_list, pose=None, **options):
    """A ray caster for rigid bodies alone."""
    start = np.array([pose or [STILL] * len(shape_list)])
    options = {**SIZE, "region": BELOW} | options
    return RayCaster(**NOTHING, parts=parts_of(shape_list), placed=Placement(rigid_pose=start), **options)


def no_nodes(count=1):
    return np.zeros((count, 0, 3))


def poses(*each):
    return Placement(rigid_pose=np.array([each]))


def differ(a, b):
    """Pixels in which two pictures differ visibly."""
    return np.abs(a.astype(int) - b).max(axis=-1) > 8


def test_a_ball_covers_a_circle():
    """A ball of 0.5 m, 4 m away: its outline is a circle of tan = 0.5 / sqrt(4^2 - 0.5^2), so 25.2 pixels."""
    caster = rigid_caster(shapes.Sphere(0.5))
    empty = caster.render(no_nodes())[0]
    seen = differ(caster.render(no_nodes(), placed=poses(STILL))[0], empty)
    y, x = np.mgrid[:100, :100] - 49.5
    radius = 4.0 * 0.5 / np.sqrt(4.0**2 - 0.5**2) * 50.0
    away = np.hypot(x, y)
    assert seen[away < radius - 1.0].all()
    assert not seen[away > radius + 1.0].any()


def test_bodies_follow_their_poses():
    """A turned, moved box covers the pixels of its corners' outline: a square standing on its corner."""
    caster = rigid_caster(shapes.Box((0.4, 0.01, 0.4)))
    turn = [0.2, 0.0, 0.3, 0.0, np.sin(np.pi / 8), 0.0, np.cos(np.pi / 8)]
    empty = caster.render(no_nodes())[0]
    seen = differ(caster.render(no_nodes(), placed=poses(turn))[0], empty)
    y, x = np.mgrid[:100, :100]
    diamond = np.abs((x + 0.5) / 50 - 1.0 - 0.2) + np.abs(1.0 - (y + 0.5) / 50 - 0.3)
    assert seen[diamond < 0.27].all()
    assert not seen[diamond > 0.295].any()


def test_worlds_have_their_own_bodies():
    """Pictures of two worlds are those of each alone, bit for bit; what has no pose is not drawn."""
    caster = rigid_caster(shapes.Sphere(0.3), shapes.Cylinder(0.2, 0.5))
    both = np.array([[STILL, [0.5, *STILL[1:]]], [[-0.4, *STILL[1:]], STILL]])
    together = caster.render(no_nodes(2), placed=Placement(rigid_pose=both))
    for world in range(2):
        alone = caster.render(no_nodes(), placed=Placement(rigid_pose=both[[world]]))
        np.testing.assert_array_equal(alone[0], together[world])
    assert differ(*together).sum() > 100
    assert not differ(caster.render(no_nodes())[0], caster.render(no_nodes())[0]).any()


def test_kinematic_bodies_are_grey():
    """The first body is kinematic and grey, the second has a colour."""
    caster = rigid_caster(shapes.Sphere(0.3), shapes.Sphere(0.3))
    frame = caster.render(no_nodes(), placed=poses([-0.5, *STILL[1:]], [0.5, *STILL[1:]]))[0].astype(int)
    assert np.ptp(frame[50, 25]) < 25
    assert np.ptp(frame[50, 75]) > 60


def test_a_ground_plane_is_the_floor():
    """A level plane moves the floor up to it and is no square of its own; a ball below it is hidden."""
    pose = [[0.0, 0.0, -0.5, 0.0, 0.0, 0.0, 1.0], STILL]
    above_it = Camera((0.0, -4.0, 2.0), (0.0, 0.0, 0.0), fov=28.0)
    options = {"region": [[-1, -1, -0.5], [1, 1, 1]], "camera": above_it}
    caster = rigid_caster(shapes.Plane(0.1), shapes.Sphere(0.2), pose=pose, **options)
    above = caster.render(no_nodes(), placed=poses(*pose))[0]
    far = [0.0, 0.0, -50.0, 0.0, 0.0, 0.0, 1.0]
    hidden = caster.render(no_nodes(), placed=poses(pose[0], far))[0]
    assert differ(above, hidden).sum() > 200
    raised = caster.render(no_nodes(), placed=poses([0.0, 0.0, 0.4, 0.0, 0.0, 0.0, 1.0], STILL))[0]
    empty = caster.render(no_nodes(), placed=poses([0.0, 0.0, 0.4, 0.0, 0.0, 0.0, 1.0], far))[0]
    assert not differ(raised, empty).any()
    assert differ(raised, hidden).any()


def rod_caster(**options):
    """A vertical rod of 1 m and radius 0.1 m, centred in the picture, with the default floor far below."""
    parts = Parts(rod_names=("rod",), rod_point_start=[0, 3], rod_radius=[0.1] * 3)
    x = np.array([[[0.0, 0.0, -0.5], [0.0, 0.0, 0.0], [0.0, 0.0, 0.5]]])
    q = np.tile([0.0, 0.0, 0.0, 1.0], (1, 3, 1))
    placed = Placement(rod_x=x, rod_q=q)
    return RayCaster(**NOTHING, parts=parts, placed=placed, **SIZE, region=BELOW, **options), placed


def test_a_rod_far_thinner_than_a_pixel_is_seen():
    """Of 0.1 mm in a picture where a pixel is 20 mm: drawn two or three pixels wide, in a colour of its own."""
    parts = Parts(rod_names=("rod",), rod_point_start=[0, 2], rod_radius=[1e-4] * 2)
    x = np.array([[[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]]])
    placed = Placement(rod_x=x, rod_q=np.tile([0.0, np.sin(np.pi / 4), 0.0, np.cos(np.pi / 4)], (1, 2, 1)))
    caster = RayCaster(**NOTHING, parts=parts, placed=placed, **SIZE, region=BELOW)
    empty, seen = caster.render(no_nodes())[0], caster.render(no_nodes(), placed=placed)[0]
    covered = differ(seen, empty)
    assert (covered[:, 30:70].sum(axis=0) >= 2).all() and covered.any(axis=1).sum() <= 3
    red, _, blue = seen[covered].mean(axis=0)
    assert red > 2.0 * blue


def test_a_rod_is_a_tube_of_its_radius():
    """It covers 10 pixels across and 50 along (a little more in front), and no others."""
    caster, placed = rod_caster()
    seen = differ(caster.render(no_nodes(), placed=placed)[0], caster.render(no_nodes())[0])
    assert seen[26:74, 46:54].all()
    assert not seen[:, :44].any()
    assert not seen[:, 56:].any()
    assert not seen[:22].any()
    assert not seen[78:].any()


def test_twist_shows_as_stripes():
    """Striped on request: a second hue, which moves where the rod is turned about itself."""
    plain, placed = rod_caster()
    striped, _ = rod_caster(twist=True)
    turned = Placement(rod_x=placed.rod_x, rod_q=np.tile([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)], (1, 3, 1)))
    frames = [
        c.render(no_nodes(), placed=p)[0].astype(int)
        for c, p in ((plain, placed), (striped, placed), (striped, turned))
    ]
    yellow = [(f[30:70, 45:55, 0] > f[30:70, 45:55, 2] + 20).sum() for f in frames]
    assert yellow[0] == 0
    assert yellow[2] > yellow[1] + 50  # d1 towards the eye, or away from it


def chamber_caster(pressure, *, lid=False):
    """A soft unit cube with a chamber of half its size, seen from the front; a rigid lid in between on request."""
    nodes, _, surface = kuhn_surface((1, 1, 1))
    walls = meshing.check_closed(0.5 * (nodes - 0.5), surface, name="walls")
    parts = dataclasses.replace(
        parts_of((shapes.Box((1.2, 0.1, 1.2)),) if lid else ()),
        cavity_names=("chamber",),
        cavity_point_start=[0, 8],
        cavity_tri=walls,
        cavity_body=[0],
    )
    lids = np.array([[[0.0, -0.8, 0.0, 0.0, 0.0, 0.0, 1.0]]])[:, : parts.rigid_count]
    placed = Placement(
        rigid_pose=lids,
        cavity_x=0.5 * (nodes - 0.5)[None],
        cavity_pressure=np.array([[pressure]]),
    )
    caster = RayCaster(surface, nodes - 0.5, parts=parts, placed=placed, region=BELOW, **SIZE)
    return caster.render((nodes - 0.5)[None], placed=placed, pressure_limit=1e4)[0].astype(int)


def test_chambers_shine_through_soft_bodies():
    """Above the ambient pressure the middle of the cube is redder than its rim, below it bluer; a lid hides both."""
    high, low = chamber_caster(1e4), chamber_caster(-1e4)
    rim, middle = (50, 30), (50, 50)
    assert high[middle][0] > high[rim][0] + 30
    assert low[middle][2] > low[middle][0] + 60
    np.testing.assert_array_equal(high[rim], low[rim])
    assert not differ(chamber_caster(1e4, lid=True), chamber_caster(-1e4, lid=True)).any()


def test_membranes_are_tinted():
    """The covered face of a cube is darker, the bare cube is not changed."""
    nodes, _, surface = kuhn_surface((1, 1, 1))
    front = (nodes[surface][:, :, 1] == 0.0).all(axis=1)
    options = {"camera": Camera((0.5, -4.0, 0.5), (0.5, 0.5, 0.5), fov=28.0), "width": 60, "height": 60}
    bare = RayCaster(surface, nodes, **options).render(nodes[None])[0]
    cover = np.where(front, 0, -1)
    covered = RayCaster(surface, nodes, tri_membrane=cover, **options).render(nodes[None])[0]
    none = RayCaster(surface, nodes, tri_membrane=np.full(len(surface), -1), **options).render(nodes[None])[0]
    np.testing.assert_array_equal(none, bare)
    assert covered[30, 30].sum() < bare[30, 30].sum() - 60
    assert not differ(covered, bare)[:10].any()


def test_contact_arrows_are_as_long_as_forces_are_strong():
    """An arrow for the limit is 0.3 sizes long, a weaker one in proportion, a blow at most 1.5 times that."""
    x = np.zeros((1, 4, 3))
    x[0, 3] = np.nan
    force = np.array([[[0.0, 0.0, 1.0], [0.5, 0.0, 0.0], [0.0, 50.0, 0.0], [1.0, 1.0, 1.0]]])
    notes = contact_notes(x, force, 2.0, 1.0)
    per_arrow = 3 * 12 + 2
    arrows = notes.x[0, -4 * per_arrow :].reshape(4, per_arrow, 3)
    np.testing.assert_allclose(arrows[:3, -1], [[0.0, 0.0, 0.6], [0.3, 0.0, 0.0], [0.0, 0.9, 0.0]], atol=1e-12)
    assert not arrows[3].any()
    assert notes.triangles.max() < notes.x.shape[1]


def test_contacts_show_even_behind_bodies():
    """An arrow in front is plain, one behind a ball shines through; frames without contacts have none."""
    caster = rigid_caster(shapes.Sphere(0.3), camera=NEAR)
    plain = caster.render(no_nodes(), placed=poses(STILL))[0]
    red = []
    for y in (-1.0, 1.0, np.nan):
        placed = poses(STILL)
        placed.contact_x = np.array([[[0.0, y, 0.0]]])
        placed.contact_force = np.array([[[0.0, 0.0, 3.0]]])
        frame = caster.render(no_nodes(), placed=placed)[0].astype(int)
        red.append((differ(frame, plain) & (frame[..., 0] > frame[..., 1] + 30)).sum())
    assert red[0] > red[1] > 10
    assert red[2] == 0


def test_number_of_contacts_may_change():
    """Between pictures, and between worlds of one picture, where the missing ones are NaN."""
    caster = rigid_caster(shapes.Sphere(0.3), camera=NEAR)
    frames = []
    for count in (1, 3, 1, 0):
        placed = poses(STILL)
        placed.contact_x = np.linspace(-0.3, 0.3, 2 * count + 1)[1::2][None, :, None] * np.eye(3)[0] - (0.0, 1.0, 0.0)
        placed.contact_force = np.broadcast_to([0.0, 0.0, 1.0], (1, count, 3))
        frames.append(caster.render(no_nodes(), placed=placed)[0])
    np.testing.assert_array_equal(frames[0], frames[2])
    assert differ(frames[1], frames[3]).sum() > differ(frames[0], frames[3]).sum() > 0


def test_notes_of_one_picture_leave_the_next_alone(swing):
    """Joints, then contacts, then joints again: each time as a new caster draws them."""
    sim, _ = swing
    used = RayCaster.for_model(sim.model, width=64, height=48)
    touched = Placement.of_simulation(sim, ChamberPoints(sim.model), [0, 1])
    touched.contact_x = np.full((2, 1, 3), 0.1)
    touched.contact_force = np.ones((2, 1, 3))
    for placed, joints in ((touched.part([0, 1]), False), (Placement(rigid_pose=sim.body_pose), True), (touched, True)):
        placed.rod_x, placed.rod_q = sim.rod_x, sim.rod_q
        fresh = RayCaster.for_model(sim.model, width=64, height=48)
        expected = fresh.render(sim.node_x, placed=placed, joints=joints)
        np.testing.assert_array_equal(used.render(sim.node_x, placed=placed, joints=joints), expected)


def test_trajectory_with_all_parts_is_drawn():
    """Frames differ as things move; contacts and joints change the picture; without soft bodies, too."""
    options = {"width": 64, "height": 48, "samples": 1, "frames": [1, 3], "worlds": [0]}
    for film in (parts_film(), parts_film(soft=False)):
        frames = render_trajectory(film, **options)
        assert differ(*frames).sum() > 40
        assert differ(frames[1], render_trajectory(film, **options, contacts=False)[1]).sum() > 5
        assert differ(frames[1], render_trajectory(film, **options, joints=True)[1]).sum() > 5
    assert render_trajectory(parts_film(2), width=32, height=24, samples=1).shape == (2, 24, 68, 3)


def test_a_large_table_does_not_shrink_the_rest():
    """The picture shows a free ball large, however wide the kinematic table below it is."""
    frames = []
    for width in (0.4, 40.0):
        table = shapes.Box((width, width, 0.1))
        pose = [[0.0, 0.0, -0.05, 0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0]]
        parts = parts_of((table, shapes.Sphere(0.1)))
        caster = RayCaster(**NOTHING, parts=parts, placed=poses(*pose), width=80, height=60, samples=1)
        with_ball = caster.render(no_nodes(), placed=poses(*pose))[0].astype(int)
        frames.append((with_ball[..., 0] > with_ball[..., 2] + 40).sum())
    assert frames[1] > 0.5 * frames[0] > 100


@pytest.fixture(scope="module")
def swing():
    """A pendulum: a free box on a hinge, and a clamped rod; no soft body. Two worlds, one of them released."""
    builder = sw.ModelBuilder()
    box = builder.add_rigid(sw.Box((0.05, 0.05, 0.05)), density=1e3, pose=(0.2, 0.0, 0.3))
    builder.add_joint(None, box, "hinge", anchor=(0.0, 0.0, 0.3), axis=(0.0, 1.0, 0.0))
    rod = builder.add_rod(meshing.straight(0.2, 4), radius=0.005, youngs=1e7)
    builder.fix(rod, nodes=[0])
    sim = sw.Simulation(builder.finalize(2), dt=0.01)
    sim.params.gravity[0] = 0.0
    for _ in range(10):
        sim.step()
    return sim, RayCaster.for_model(sim.model, width=64, height=48)


def test_draw_shows_a_simulation(swing):
    """All worlds or some, as ``render`` does from the views; the swinging box differs from the resting one."""
    sim, caster = swing
    frames = caster.draw(sim)
    placed = Placement(rigid_pose=sim.body_pose, rod_x=sim.rod_x, rod_q=sim.rod_q)
    np.testing.assert_array_equal(frames, caster.render(sim.node_x, placed=placed))
    np.testing.assert_array_equal(caster.draw(sim, [1])[0], frames[1])
    assert differ(*frames).sum() > 20
    assert differ(caster.draw(sim, joints=True)[0], frames[0]).any()
    goals = np.array([[0.1, 0.0, 0.1]] * 2)
    assert differ(caster.draw(sim, None, goals)[0], frames[0]).any()
    np.testing.assert_array_equal(caster.draw(sim, contacts=True), frames)


def test_a_model_is_seen_whole(swing):
    """The camera chosen for a model sees the rod and the box, at rest and some way around."""
    sim, caster = swing
    start = Placement.at_rest(sim.model)
    at_rest = caster.render(sim.node_x[:1], placed=start)
    seen = differ(at_rest[0], caster.render(sim.node_x[:1])[0])
    assert seen.sum() > 60
    assert not seen[[0, -1]].any()
    assert not seen[:, [0, -1]].any()


def test_bad_placements_are_refused(swing):
    sim, caster = swing
    with pytest.raises(ValueError, match=r"rigid_pose must have shape \(2, 1, 7\), got \(2, 1, 3\)"):
        caster.render(sim.node_x, placed=Placement(rigid_pose=sim.body_pose[..., :3]))
    with pytest.raises(ValueError, match=r"rod_q must have shape \(2, 5, 4\)"):
        caster.render(sim.node_x, placed=Placement(rod_x=sim.rod_x, rod_q=sim.rod_x))
    with pytest.raises(ValueError, match="contact_x and contact_force go together"):
        caster.render(sim.node_x, placed=Placement(contact_x=np.zeros((2, 1, 3))))
    with pytest.raises(ValueError, match=r"draw needs RayCaster\.for_model"):
        rigid_caster(shapes.Sphere(0.1)).draw(sim)
    with pytest.raises(ValueError, match="parts need placed"):
        RayCaster(**NOTHING, parts=parts_of((shapes.Sphere(0.1),)))
    with pytest.raises(ValueError, match="nothing to draw"):
        RayCaster(**NOTHING)


@pytest.mark.cuda
def test_cuda_draws_the_same_parts(swing):
    """Torch tensors of the GPU go in; nearly all pixels agree with the CPU's to two levels."""
    sim, caster = swing
    there = RayCaster.for_model(sim.model, width=64, height=48, device="cuda:0")
    placed = Placement(rigid_pose=sim.body_pose.cuda(), rod_x=sim.rod_x.cuda(), rod_q=sim.rod_q.cuda())
    frames = there.render(sim.node_x.cuda(), placed=placed, joints=True).astype(int)
    assert np.mean(np.abs(frames - caster.draw(sim, joints=True)).max(axis=-1) <= 2) > 0.98
