import numpy as np
import pytest
import torch
import warp as wp

from softwarp.io import palette
from softwarp.render import Camera, RayCaster, render_trajectory
from softwarp.render.raycast import capsule_hit, sphere_hit
from tests.unit.io.fakes import FakeSimulation, kuhn_surface, recording

CELLS = (2, 2, 6)
RED = (1.0, 0.0, 0.0)


def is_red(frame):
    """Pixels of a body that is painted red."""
    rgb = frame.astype(int)
    return (rgb[..., 0] > 60) & (rgb[..., 1] < rgb[..., 0] // 3) & (rgb[..., 2] < rgb[..., 0] // 3)


def front_caster(**options):
    """A unit cube seen from the front, 4 m from its face, on a picture of 100 x 100 pixels."""
    nodes, _, surface = kuhn_surface((1, 1, 1))
    camera = Camera((0.5, -4.0, 0.5), (0.5, 0.5, 0.5), fov=2 * np.degrees(np.arctan(0.25)))
    return RayCaster(surface, nodes, camera=camera, width=100, height=100, **options), nodes


@pytest.fixture(scope="module")
def beam():
    sim = FakeSimulation(3, CELLS)
    sim.pose([0.0, 0.8, -1.2])
    return sim, RayCaster.for_model(sim.model, width=64, height=48)


def test_a_cube_covers_the_right_pixels():
    """At 4 m the picture is 2 m wide, so the front face of 1 m covers the middle 50 x 50 pixels, and no others."""
    caster, nodes = front_caster(samples=1)
    red = is_red(caster.render(nodes[None], node_color=np.tile(RED, (8, 1)))[0])
    expected = np.zeros((100, 100), dtype=bool)
    expected[25:75, 25:75] = True
    np.testing.assert_array_equal(red, expected)


def test_each_world_has_its_picture(beam):
    """A picture of three worlds holds the three pictures of one world, bit for bit, and they differ."""
    sim, caster = beam
    goals = np.array([[0.05, 0.0, 0.1], [0.1, 0.0, 0.1], [-0.1, 0.05, 0.05]])
    together = caster.render(sim.node_x, sim.cable_x, goals)
    assert together.shape == (3, 48, 64, 3)
    assert together.dtype == np.uint8
    for w in range(3):
        part = slice(w, w + 1)
        np.testing.assert_array_equal(caster.render(sim.node_x[part], sim.cable_x[part], goals[part])[0], together[w])
    assert np.abs(together[0].astype(int) - together[1]).max() > 50


def test_refitted_pictures_do_not_depend_on_what_came_before(beam):
    """A caster that has drawn other poses draws as a new one does, up to the order of equal hits."""
    sim, _ = beam
    used, fresh = (RayCaster.for_model(sim.model, width=64, height=48) for _ in range(2))
    used.render(sim.node_x[1:2], sim.cable_x[1:2])
    np.testing.assert_array_equal(
        used.render(sim.node_x[2:3], sim.cable_x[2:3]), fresh.render(sim.node_x[2:3], sim.cable_x[2:3])
    )


def test_numpy_torch_and_double_precision_agree(beam):
    sim, caster = beam
    expected = caster.render(sim.node_x)
    np.testing.assert_array_equal(caster.render(sim.node_x.numpy()), expected)
    np.testing.assert_array_equal(caster.render(sim.node_x.double()), expected)
    np.testing.assert_array_equal(caster.render(sim.node_x.clone().requires_grad_()), expected)


def test_threads_and_batches_change_nothing(beam, monkeypatch):
    sim, caster = beam
    expected = caster.render(sim.node_x, sim.cable_x)
    alone = RayCaster.for_model(sim.model, width=64, height=48, threads=1)
    np.testing.assert_array_equal(alone.render(sim.node_x, sim.cable_x), expected)
    monkeypatch.setattr("softwarp.render.raycaster._BATCH_PIXELS", 2 * 64 * 48)
    np.testing.assert_array_equal(alone.render(sim.node_x, sim.cable_x), expected)


def test_shadow_lies_on_the_floor():
    """A plate in the air darkens the floor under it, and nothing of the sky."""
    nodes, _, surface = kuhn_surface((1, 1, 1))
    plate = nodes * (1.0, 1.0, 0.05) + (0.0, 0.0, 1.0)
    region = [[-1, -1, 0], [2, 2, 1.5]]
    caster = RayCaster(surface, plate, region=region, width=80, height=60)
    far = plate + (0.0, 0.0, 1e3)
    lit, shaded = caster.render(np.stack([far, plate]), node_color=np.tile(RED, (8, 1))).astype(int)
    darker = (shaded.sum(axis=-1) < 0.85 * lit.sum(axis=-1)) & ~is_red(shaded)
    assert 50 < darker.sum() < 0.3 * darker.size
    assert not darker[:10].any()


def test_goal_is_green_in_front_and_faint_behind():
    caster, nodes = front_caster(goal_radius=0.1)
    paint = np.tile(RED, (8, 1))
    open_, hidden = (
        caster.render(nodes[None], None, [[0.5, y, 0.5]], node_color=paint)[0, 50, 50] for y in (-0.5, 1.5)
    )
    plain = caster.render(nodes[None], node_color=paint)[0, 50, 50].astype(int)
    assert open_[1] > 90
    assert 0 < hidden[1] - plain[1] < open_[1] - plain[1]


def test_cables_show_outside_and_fade_with_depth():
    """A blue cable before a red cube is plain, one just below its surface a mixture, a deep one hardly to be seen."""
    nodes, _, surface = kuhn_surface((1, 1, 1))
    camera = Camera((0.5, -4.0, 0.5), (0.5, 0.5, 0.5), fov=28.0)
    caster = RayCaster(
        surface, nodes, cable_point_start=[0, 2], cable_radius=0.05, camera=camera, width=101, height=101
    )
    cables = np.array([[[0.5, y, 0.2], [0.5, y, 0.8]] for y in (-0.5, 0.06, 0.5)])
    paint = {"node_color": np.tile(RED, (8, 1)), "cable_color": [[0.0, 0.2, 1.0]]}
    frames = caster.render(np.tile(nodes, (3, 1, 1)), cables, **paint)[:, 50, 50].astype(int)
    outside, below, deep = frames
    assert outside[2] > 150
    assert outside[0] < 60
    assert 100 < below[2] < outside[2]
    assert below[0] > outside[0] + 60
    assert deep[2] < 60
    assert is_red(caster.render(nodes[None], node_color=np.tile(RED, (8, 1))))[0, 50, 50]


def test_edges_are_smoothed():
    """One ray a pixel knows body or background; four give the pixels between a colour between."""
    nodes, _, surface = kuhn_surface((1, 1, 1))
    camera = Camera((0.5, -4.0, 0.7), (0.5, 0.5, 0.5), up=(0.3, 0.0, 1.0), fov=28.0)
    values = {}
    for samples in (1, 4):
        caster = RayCaster(surface, nodes, camera=camera, width=60, height=60, samples=samples)
        frame = caster.render(nodes[None], node_color=np.tile(RED, (8, 1)))[0].astype(int)
        between = (frame[..., 0] > 150) & (frame[..., 1] > 60) & (frame[..., 1] < 150)
        values[samples] = between.sum()
    assert values[1] == 0
    assert values[4] > 20


def test_stress_colours_each_world(beam):
    """Colours per world reach their own world only."""
    sim, caster = beam
    paint = np.zeros((3, caster.node_count, 3))
    paint[1, :, 0] = 1.0
    red = is_red(caster.render(sim.node_x, node_color=paint))
    assert red[1].sum() > 50
    assert red[0].sum() == red[2].sum() == 0


def test_a_world_with_lost_nodes_is_still_drawn(beam):
    """NaN in one world neither stops the picture nor touches the other worlds."""
    sim, caster = beam
    expected = caster.render(sim.node_x)
    broken = sim.node_x.clone()
    broken[1] = float("nan")
    frames = caster.render(broken)
    np.testing.assert_array_equal(frames[[0, 2]], expected[[0, 2]])
    np.testing.assert_array_equal(caster.render(sim.node_x), expected)


def test_default_picture_shows_body_and_floor(beam):
    """The beam stands in the middle on a floor that fades into a bright background."""
    sim, caster = beam
    frame = caster.render(sim.node_x[:1])[0].astype(int)
    teal = np.abs(frame / 255 - palette.BODY).max(axis=-1) < 0.3
    assert teal[:, 20:44].sum() > 20
    assert frame[0].min() > 215


def test_up_follows_gravity():
    """With gravity along -y the floor lies below the beam in -y."""
    sim = FakeSimulation(1, CELLS, gravity=(0.0, -9.81, 0.0))
    caster = RayCaster.for_model(sim.model)
    assert caster.camera.up == (0.0, 1.0, 0.0)
    assert caster.camera.eye[1] > caster.camera.target[1]


def test_bad_requests_are_refused(beam):
    sim, caster = beam
    nodes, _, surface = kuhn_surface((1, 1, 1))
    with pytest.raises(ValueError, match=r"node_x must have shape \(3, \d+, 3\), got \(3, \d+, 2\)"):
        caster.render(sim.node_x[..., :2])
    with pytest.raises(ValueError, match=r"cable_x must have shape \(3, 32, 3\)"):
        caster.render(sim.node_x, sim.cable_x[:2])
    with pytest.raises(ValueError, match=r"goals must have shape \(3, 3\)"):
        caster.render(sim.node_x, None, np.zeros((1, 3)))
    with pytest.raises(ValueError, match="node_color must have shape"):
        caster.render(sim.node_x, node_color=np.zeros((5, 3)))
    with pytest.raises(ValueError, match="give rest positions of all nodes"):
        RayCaster(surface, nodes[:4])
    with pytest.raises(ValueError, match=r"width of a picture .* must be an integer of at least 1"):
        RayCaster(surface, nodes, width=0)
    with pytest.raises(ValueError, match="samples must be an integer of at least 1"):
        RayCaster(surface, nodes, samples=0)
    with pytest.raises(ValueError, match="no device 'cuda:9' here; there is cpu"):
        RayCaster(surface, nodes, device="cuda:9")


@wp.kernel
def hit_many(kind: int, radius: float, ray: wp.array[wp.vec3], distance: wp.array[float]):
    k = wp.tid()
    origin = wp.vec3(0.0, -2.0, 0.0)
    a = wp.vec3(-0.3, 0.0, 0.1)
    if kind == 0:
        distance[k] = sphere_hit(origin, ray[k], a, radius)
    else:
        distance[k] = capsule_hit(origin, ray[k], a, wp.vec3(0.4, 0.3, 0.2), radius)


@pytest.mark.parametrize("kind", [0, 1])
@pytest.mark.parametrize("radius", [0.2, 0.01])
def test_hits_lie_on_the_surface(rng, kind, radius):
    """A hit is a point at the radius from the sphere's centre or the segment; a miss passes farther away."""
    a, b = np.array([-0.3, 0.0, 0.1]), np.array([0.4, 0.3, 0.2]) if kind else np.array([-0.3, 0.0, 0.1])
    target = a + rng.uniform(-0.2, 1.2, (600, 1)) * (b - a) + radius * rng.standard_normal((600, 3))
    ray = target - (0.0, -2.0, 0.0)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    out = wp.zeros(len(ray), dtype=float, device="cpu")
    wp.launch(hit_many, len(ray), [kind, radius, wp.array(ray, dtype=wp.vec3, device="cpu")], [out], device="cpu")

    def gap(points):
        ab = b - a
        s = np.clip((points - a) @ ab / max(ab @ ab, 1e-30), 0.0, 1.0)
        return np.linalg.norm(points - a - s[..., None] * ab, axis=-1)

    distance = out.numpy().astype(float)
    hit = distance < 1e29
    along = np.linspace(1.0, 3.5, 4001)
    nearest = np.array([gap((0.0, -2.0, 0.0) + along[:, None] * r).min() for r in ray])
    sure = np.abs(nearest - radius) > 1e-4
    np.testing.assert_array_equal(hit[sure], nearest[sure] < radius)
    np.testing.assert_allclose(gap((0.0, -2.0, 0.0) + distance[hit, None] * ray[hit]), radius, atol=2e-5)
    assert 50 < hit.sum() < 550


def test_trajectory_is_drawn_without_a_simulator():
    film = recording(6)
    frames = render_trajectory(film, width=48, height=36, samples=1)
    assert frames.shape == (6, 36, 48 * 2 + 4, 3)
    assert render_trajectory(film, width=48, height=36, samples=1, fps=50.0).shape[0] == 3
    one = render_trajectory(film, width=48, height=36, samples=1, worlds=[2], frames=[0, -1], stress=False)
    assert one.shape == (2, 36, 48, 3)
    assert np.abs(one[0].astype(int) - one[1]).max() > 50
    with pytest.raises(ValueError, match="indices below 6"):
        render_trajectory(film, frames=[6])
    with pytest.raises(ValueError, match="not both"):
        render_trajectory(film, frames=[0], fps=10.0)


@pytest.mark.cuda
def test_cuda_draws_the_same_picture(beam):
    """Torch tensors on the GPU go in as they are; nearly all pixels agree with the CPU's to two levels."""
    sim, caster = beam
    there = RayCaster.for_model(sim.model, width=64, height=48, device="cuda:0")
    goals = torch.tensor([[0.05, 0.0, 0.1]] * 3)
    expected = caster.render(sim.node_x, sim.cable_x, goals).astype(int)
    frames = there.render(sim.node_x.cuda(), sim.cable_x.cuda(), goals.cuda()).astype(int)
    assert np.mean(np.abs(frames - expected).max(axis=-1) <= 2) > 0.98
