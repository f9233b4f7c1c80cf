"""Collision detection: distances against independent ones, sets of contacts, self-contact, bad input."""

import itertools

import numpy as np
import pytest

from softwarp import meshing, shapes
from softwarp.model.codes import WORLD
from softwarp.plan.collision_scene import CollisionBuilder
from softwarp.shapes.base import quaternion_product, rotation_matrix
from softwarp.solvers.collision.detector import Detector
from softwarp.solvers.collision.overlaps import initial_overlaps
from tests.collision_cases import (
    EXACT,
    Probe,
    box_on_box,
    cube,
    free,
    hull_distance,
    placed,
    pose_of,
    random_quaternion,
    two_cubes,
)

HULL = shapes.Mesh.hull(np.random.default_rng(24).standard_normal((9, 3)) * 0.03)
CONVEX = {
    "sphere": (shapes.Sphere(0.03), np.zeros((1, 3)), 0.03),
    "capsule": (shapes.Capsule(0.015, 0.08), np.array([[0, 0, -0.04], [0, 0, 0.04]]), 0.015),
    "box": (shapes.Box((0.05, 0.08, 0.06)), shapes.Box((0.05, 0.08, 0.06)).surface()[0], 0.0),
    "mesh": (HULL, HULL.vertices, 0.0),
}


# Distances


@pytest.mark.parametrize(("one", "other"), list(itertools.combinations_with_replacement(CONVEX, 2)))
def test_smallest_gap_is_distance_of_convex_shapes(one, other, rng):
    """min over contacts of the gap = distance of the cores - radii, from a quadratic program, at random poses."""
    (a, core_a, radius_a), (b, core_b, radius_b) = CONVEX[one], CONVEX[other]
    scene = CollisionBuilder()
    scene.pair(scene.add_shape(0, a), scene.add_shape(1, b))
    probe = Probe(scene, pose=np.zeros((2, 7)), alarm=0.3)
    compared = 0
    for _ in range(40):
        way = rng.standard_normal(3)
        shift = way * rng.uniform(0.05, 0.12) / np.linalg.norm(way)
        poses = np.array([pose_of(np.zeros(3), random_quaternion(rng)), pose_of(shift, random_quaternion(rng))])
        between = hull_distance(placed(core_a, poses[0]), placed(core_b, poses[1]))
        if between > 1e-4:
            probe.pose[0] = poses
            found = probe.find()
            assert found.gap.min() == pytest.approx(between - radius_a - radius_b, abs=1e-7)
            nearest = np.argmin(found.gap)
            assert np.linalg.norm(found.axes[nearest] @ found.axes[nearest].T - np.eye(3)) < 1e-12
            compared += 1
    assert compared > 15


def brute_force(x, triangles, other):
    """Smallest distance between the surfaces of two separate soft bodies: all corners and faces, all pairs of edges."""
    best = np.inf
    for corners, faces in ((triangles, other), (other, triangles)):
        points = x[np.unique(corners)]
        for face in faces:
            best = min(best, hull_distances(points, x[face]))
    edges = [
        np.unique(np.sort(np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]]), axis=1), axis=0)
        for t in (triangles, other)
    ]
    p, d = x[edges[0][:, 0]], x[edges[0][:, 1]] - x[edges[0][:, 0]]
    for i, j in edges[1]:
        q, e = x[i], x[j] - x[i]
        r = p - q
        dd, ee, de = np.sum(d * d, 1), e @ e, d @ e
        det = dd * ee - de**2
        s = np.clip((de * (r @ e) - ee * np.sum(r * d, 1)) / np.maximum(det, 1e-30), 0, 1)
        t = np.clip((r + s[:, None] * d) @ e / ee, 0, 1)
        best = min(best, np.linalg.norm(r + s[:, None] * d - t[:, None] * e, axis=1).min())
    return best


def hull_distances(points, triangle):
    """Smallest distance of some points from one triangle, by projection and clipping to its sides."""
    a, b, c = triangle
    n = np.cross(b - a, c - a)
    u = np.cross(points - a, c - a) @ n / (n @ n)
    v = np.cross(b - a, points - a) @ n / (n @ n)
    inside = (u >= 0) & (v >= 0) & (u + v <= 1)
    best = np.where(inside, np.abs((points - a) @ n) / np.linalg.norm(n), np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        t = np.clip((points - p) @ (q - p) / ((q - p) @ (q - p)), 0, 1)
        best = np.minimum(best, np.linalg.norm(points - p - t[:, None] * (q - p), axis=1))
    return best.min()


def test_smallest_gap_is_distance_of_soft_surfaces(rng):
    """Two bent cubes at random positions, against all pairs of corners, faces and edges.

    Edges between nearly flat faces (5 degrees) and the inset of corners may change it by 1 % of the distance.
    """
    scene, x = two_cubes((0.0, 0.0, 0.2))
    triangles = cube()[1]
    half = len(x) // 2
    probe = Probe(scene, x, alarm=0.3, capacity=2000)
    for _ in range(12):
        bent = x + 0.006 * rng.standard_normal(x.shape)
        way = rng.standard_normal(3)
        R = rotation_matrix(random_quaternion(rng))
        bent[half:] = (bent[half:] - 0.05 - np.array([0, 0, 0.2])) @ R.T + 0.05 + 0.17 * way / np.linalg.norm(way)
        probe.x[0] = bent
        exact = brute_force(bent, triangles, triangles + half)
        assert probe.find().gap.min() == pytest.approx(exact, rel=0.01)


def test_point_finds_nearest_face_of_rigid_mesh(rng):
    """A small ball around and inside a mesh that is not convex: distance from all triangles, sign from winding."""
    vertices, triangles = l_shape()
    mesh = shapes.Mesh(vertices, triangles)
    scene = CollisionBuilder()
    scene.pair(scene.add_shape(0, shapes.Sphere(0.001)), scene.add_shape(1, mesh))
    probe = Probe(scene, pose=np.zeros((2, 7)), alarm=1.0)
    body = pose_of(rng.standard_normal(3), random_quaternion(rng))
    for local in rng.uniform(-0.02, 0.12, (40, 3)) * [1.0, 0.6, 1.0]:
        centre = placed(local[None], body)[0]
        probe.pose[0] = [pose_of(centre), body]
        found = probe.find()
        exact = min(hull_distances(local[None], vertices[t]) for t in triangles)
        inside = (
            0.0 < local[1] < 0.05 and all(local[[0, 2]] > 0) and all(local[[0, 2]] < 0.1) and min(local[[0, 2]]) < 0.04
        )
        expected = (-exact if inside else exact) - 0.001
        nearest = np.argmin(np.abs(found.gap + 0.001))
        assert found.gap[nearest] == pytest.approx(expected, abs=1e-12)
        np.testing.assert_allclose(
            probe_direction(local, vertices, triangles, body, inside), found.normal[nearest], atol=1e-6
        )


def probe_direction(local, vertices, triangles, body, inside):
    """Gradient of the signed distance by central differences, in the world."""
    step, grad = 1e-7, np.zeros(3)
    for c in range(3):
        e = np.eye(3)[c] * step
        values = [min(hull_distances((local + s * e)[None], vertices[t]) for t in triangles) for s in (1, -1)]
        grad[c] = (values[0] - values[1]) / (2 * step)
    return rotation_matrix(body[3:]) @ (grad / np.linalg.norm(grad)) * (-1.0 if inside else 1.0)


def l_shape():
    """An L in the x z plane, legs 0.1 long and 0.04 thick, 0.05 deep."""
    outline = np.array([[0, 0], [0.1, 0], [0.1, 0.04], [0.04, 0.04], [0.04, 0.1], [0, 0.1]])
    vertices = np.concatenate([np.insert(outline, 1, y, axis=1) for y in (0.0, 0.05)])
    front = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    back = [[a + 6, c + 6, b + 6] for a, b, c in front]
    sides = [t for k in range(6) for t in ([k, k + 6, (k + 1) % 6], [(k + 1) % 6, k + 6, (k + 1) % 6 + 6])]
    return vertices, np.array(front + back + sides)


def test_grid_agrees_with_mesh(rng):
    """A ball and a box against the distance grid of a box, compared with the box, to the grid's accuracy."""
    box = shapes.Box((0.1, 0.08, 0.06))
    grid = shapes.SDF.from_mesh(*box.surface(), spacing=0.004)
    for feature in (shapes.Sphere(0.02), shapes.Capsule(0.01, 0.05)):
        gaps = []
        for target in (box, grid):
            scene = CollisionBuilder()
            scene.pair(scene.add_shape(0, feature), scene.add_shape(1, target))
            probe = Probe(scene, pose=np.zeros((2, 7)), alarm=0.1)
            gaps.append([])
            generator = np.random.default_rng(3)
            for _ in range(15):
                way = generator.standard_normal(3)
                at = 0.07 * way / np.linalg.norm(way)
                probe.pose[0] = [pose_of(at, random_quaternion(generator)), pose_of(np.zeros(3))]
                gaps[-1].append(probe.find().gap.min())
        np.testing.assert_allclose(gaps[0], gaps[1], atol=0.0015)


# Manifolds


@pytest.mark.parametrize("depth", [1e-6, 1e-4, -1e-6])
@pytest.mark.parametrize(
    ("shift", "angle", "corners"),
    [
        ((0.0, 0.0), 0.0, 4),
        ((0.03, 0.0), 0.0, 4),
        ((0.03, -0.02), 0.0, 4),
        ((0.0, 0.0), np.pi / 4, 8),
        ((0.0, 0.0), 1e-4, 8),
    ],
)
def test_box_on_box_touches_at_the_corners_of_the_common_polygon(depth, shift, angle, corners):
    """All normals are vertical, also where side faces are flush; the points span the polygon, the gap is its height."""
    found = box_on_box((*shift, -depth), angle, alarm=0.001).find()
    np.testing.assert_allclose(np.abs(found.normal[:, 2]), 1.0, atol=1e-9)
    np.testing.assert_allclose(found.gap, -depth, atol=1e-9)
    distinct = np.unique(np.round(found.point[:, :2], 4), axis=0)
    if angle != 1e-4:
        assert len(distinct) == corners
    assert np.ptp(distinct[:, 0]) == pytest.approx(0.1 - abs(shift[0]), abs=3e-4)


def test_crossed_beams_touch_at_four_points():
    """Two beams across each other: their common square, found by edges alone."""
    scene = CollisionBuilder()
    scene.pair(scene.add_shape(0, shapes.Box((0.3, 0.04, 0.04))), scene.add_shape(1, shapes.Box((0.04, 0.3, 0.04))))
    found = Probe(scene, pose=[pose_of([0, 0, 0.0399]), pose_of(np.zeros(3))], alarm=0.001).find()
    assert found.count == 4
    np.testing.assert_allclose(np.abs(found.normal[:, 2]), 1.0, atol=1e-9)
    expected = np.array(list(itertools.product((-0.02, 0.02), repeat=2)))
    np.testing.assert_allclose(np.unique(np.round(found.point[:, :2], 3), axis=0), expected, atol=1e-6)


def test_edge_on_edge_has_the_common_normal():
    """A box standing on its edge across the edge of another one: one contact, normal across both edges, true depth."""
    scene = CollisionBuilder()
    scene.pair(scene.add_shape(0, shapes.Box((0.1, 0.1, 0.1))), scene.add_shape(1, shapes.Box((0.1, 0.1, 0.1))))
    eighth = np.pi / 8
    lower, upper = [np.sin(eighth), 0, 0, np.cos(eighth)], [0, np.sin(eighth), 0, np.cos(eighth)]
    for depth in (1e-4, -1e-4):
        height = 2 * 0.05 * np.sqrt(2.0) - depth
        found = Probe(
            scene, pose=[pose_of([0.01, 0.02, height], upper), pose_of(np.zeros(3), lower)], alarm=0.001
        ).find()
        assert found.count == 1
        np.testing.assert_allclose(found.normal[0], [0, 0, 1], atol=1e-9)
        assert found.gap[0] == pytest.approx(-depth, abs=1e-12)
        np.testing.assert_allclose(found.point[0, :2], [0.01, 0.0], atol=0.021)


def test_cylinder_lies_on_its_lowest_line_and_stands_on_its_rim():
    """Lying it touches at the lowest point of each rim, however it is turned; standing at four points."""
    scene = CollisionBuilder()
    scene.pair(scene.add_shape(0, shapes.Cylinder(0.03, 0.1)), scene.add_shape(WORLD, shapes.Plane()))
    half = np.sqrt(0.5)
    for angle in (0.0, 0.3, 1.0):
        lie = np.array([0, half, 0, half])
        spin = np.array([0, 0, np.sin(angle / 2), np.cos(angle / 2)])
        found = Probe(scene, pose=[pose_of([0, 0, 0.03], quaternion_product(lie, spin))], alarm=0.001).find()
        assert found.count == 2
        np.testing.assert_allclose(found.gap, 0.0, atol=1e-12)
        np.testing.assert_allclose(np.sort(found.point[:, 0]), [-0.05, 0.05], atol=1e-9)
    found = Probe(scene, pose=[pose_of([0, 0, 0.05])], alarm=0.001).find()
    assert found.count == 4
    np.testing.assert_allclose(found.point.mean(axis=0), 0.0, atol=1e-9)


def test_ball_in_a_corner_touches_both_walls():
    """A ball in the inner corner of an L: contacts with both legs, none with faces behind."""
    scene = CollisionBuilder()
    scene.pair(scene.add_shape(0, shapes.Sphere(0.01)), scene.add_shape(1, shapes.Mesh(*l_shape())))
    found = Probe(scene, pose=[pose_of([0.05001, 0.025, 0.04999]), pose_of(np.zeros(3))], alarm=0.005).find()
    assert found.count == 2
    order = np.argsort(found.normal[:, 0])
    np.testing.assert_allclose(found.normal[order], [[0, 0, 1], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(found.gap[order], [-1e-5, 1e-5], atol=1e-12)


def test_rod_touches_with_nodes_and_segments():
    """A rod across a box, a crossing rod and a soft cube: gap = distance of the axis - radius, normals across it."""
    nodes, triangles = cube(2, 0.1, (-0.05, -0.05, -0.1))
    for target in ("box", "rod", "cube", "mesh"):
        scene = CollisionBuilder()
        rod = scene.add_rod([0, 1], 0.005, [[-0.1, 0, 0], [0.1, 0, 0]])
        axis = 0.0052
        poses = [
            pose_of([-0.1, 0.013, axis]),
            pose_of([0.1, 0.013, axis]),
            pose_of([0, 0, -0.05]),
            pose_of([0.003, 0.1, -0.05]),
        ]
        x = ()
        if target == "box":
            other = scene.add_shape(2, shapes.Box((0.1, 0.1, 0.1)))
        elif target == "mesh":
            other = scene.add_shape(2, shapes.Mesh(*shapes.Box((0.1, 0.1, 0.1)).surface()))
        elif target == "cube":
            other, x = scene.add_soft_surface(triangles, nodes), nodes
        else:
            poses[2:] = [pose_of([0.003, -0.1, -0.002]), pose_of([0.003, 0.1, -0.002])]
            other = scene.add_rod([2, 3], 0.002, [[0, -0.1, 0], [0, 0.1, 0]])
        scene.pair(rod, other)
        found = Probe(scene, x, poses, alarm=0.001).find()
        assert found.count >= 1
        up = np.abs(found.normal[:, 2]) > 1 - 1e-6
        assert up.all()
        np.testing.assert_allclose(found.gap, 2e-4, atol=1e-9)


# Self-contact


def test_folded_sheet_touches_itself_only_where_it_folds(rng):
    """A thin soft strip, flat (no contact) and folded over (contact between its two halves)."""
    mesh = meshing.box((0.3, 0.03, 0.01), (24, 2, 1))
    scene = CollisionBuilder()
    strip = scene.add_soft_surface(meshing.tet_surface(mesh.tets), mesh.nodes)
    scene.pair(strip, strip)
    probe = Probe(scene, mesh.nodes, alarm=0.002, capacity=2000)
    assert probe.find().count == 0
    probe.x[0] = mesh.nodes * [1.0, 1.0, 0.9] + 1e-4 * rng.standard_normal(mesh.nodes.shape)
    assert probe.find().count == 0
    radius = 0.0156  # the strip's lower face ends up on a cylinder; the halves are then 1.2 mm apart
    s, z = mesh.nodes[:, 0] - 0.15, mesh.nodes[:, 2] - 0.01
    arc = np.clip(s, -0.5 * np.pi * radius, 0.5 * np.pi * radius)
    angle, rest = arc / radius, s - arc
    bent = np.stack(
        [
            (radius + z) * np.sin(angle) + rest * np.cos(angle),
            mesh.nodes[:, 1],
            (radius + z) * np.cos(angle) - rest * np.sin(angle),
        ],
        axis=1,
    )
    probe.x[0] = squeezed(bent, s, 0.5 * np.pi * radius)
    found = probe.find()
    assert found.count > 5
    assert np.abs(found.normal[:, 0]).min() > 0.8


def squeezed(x, s, start):
    """Bring the two straight halves of a hairpin together until 1 mm is between them."""
    result = x.copy()
    left, right = s < -start, s > start
    between = x[right, 0].min() - x[left, 0].max()
    along = np.minimum((np.abs(s) - start) / 0.05, 1.0)
    result[left, 0] += 0.5 * (between - 0.001) * along[left]
    result[right, 0] -= 0.5 * (between - 0.001) * along[right]
    return result


def test_rod_touches_itself_where_it_crosses():
    """A straight rod has no contact with itself; a loop has one where its ends cross, at the distance of the axes."""
    count, radius = 41, 0.002
    t = np.linspace(-2.0, 2.0, count)
    straight = np.stack([0.1 * t, 0 * t, 0 * t], axis=1)
    loop = np.stack([0.05 * np.sin(1.9 * t), 0.05 * np.cos(1.9 * t), 0.0012 * t], axis=1)
    scene = CollisionBuilder()
    rod = scene.add_rod(np.arange(count), radius, straight)
    scene.pair(rod, rod)
    probe = Probe(scene, pose=[pose_of(p) for p in straight], alarm=0.004)
    assert probe.find().count == 0
    probe.pose[0, :, :3] = loop
    found = probe.find()
    assert found.count >= 1
    assert found.gap.min() < 0.001
    assert found.gap.min() > -2 * radius


# Bad input


def test_pairs_that_cannot_touch_are_refused():
    scene = CollisionBuilder()
    floor, wall = (
        scene.add_shape(WORLD, shapes.Plane(), name="floor"),
        scene.add_shape(WORLD, shapes.Plane(), name="wall"),
    )
    with pytest.raises(ValueError, match=r"floor and wall: nothing of the two can touch"):
        scene.pair(floor, wall)
    ball = scene.add_shape(0, shapes.Sphere(0.1), name="ball")
    with pytest.raises(ValueError, match="ball and ball"):
        scene.pair(ball, ball)
    scene.pair(ball, floor)
    with pytest.raises(ValueError, match="at least 1 per world, got 0"):
        Detector(EXACT, 1, scene, free(0, 1), 0, "cpu")


def test_overlaps_at_the_start_are_found_with_depth():
    """A ball half a radius in the floor is shallow; boxes in each other are deep; a pebble in a cube is engulfed."""
    nodes, triangles = cube(3, 0.2)
    scene = CollisionBuilder()
    floor = scene.add_shape(WORLD, shapes.Plane(), [0, 0, -1.0], name="floor")
    ball = scene.add_shape(0, shapes.Sphere(0.1), name="ball")
    one, two = (
        scene.add_shape(1, shapes.Box((0.1, 0.1, 0.1)), name="one"),
        scene.add_shape(2, shapes.Box((0.1, 0.1, 0.1)), name="two"),
    )
    soft = scene.add_soft_surface(triangles, nodes, name="soft")
    pebble = scene.add_shape(3, shapes.Sphere(0.01), name="pebble")
    scene.pair(ball, floor)
    scene.pair(one, two)
    scene.pair(soft, pebble)
    scene.pair(soft, floor)
    poses = [pose_of([0, 0, -0.95]), pose_of([2, 0, 0]), pose_of([2.01, 0.003, 0.004]), pose_of([0.1, 0.1, 0.1])]
    found = {o.a: o for o in initial_overlaps(scene, free(len(nodes), 4), nodes, poses)}
    assert {(o.a, o.b) for o in found.values()} == {("floor", "ball"), ("one", "two"), ("soft", "pebble")}
    assert found["floor"].depth == pytest.approx(0.05)
    assert not found["floor"].is_deep
    assert found["one"].is_deep
    assert found["soft"].is_engulfed
    assert "move them apart" in str(found["one"])
