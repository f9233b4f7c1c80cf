"""Collision detection: distances against independent ones, kinematics of contacts, lists, memory, batches."""

import itertools

import numpy as np
import pytest
import warp as wp

from softwarp import meshing, shapes
from softwarp.kernels import lanes
from softwarp.shapes.base import quaternion_product, rotation_matrix
from softwarp.solvers import rows
from softwarp.solvers.bounding_tree import TASK, Trees
from softwarp.solvers.collision import Detector, Topology
from softwarp.solvers.collision_scene import WORLD, CollisionScene
from softwarp.solvers.overlaps import initial_overlaps
from tests.collision_cases import EXACT, STILL, Probe, filled, free, hull_distance, placed, random_quaternion, turned

HULL = shapes.Mesh.hull(np.random.default_rng(24).standard_normal((9, 3)) * 0.03)
CONVEX = {
    "sphere": (shapes.Sphere(0.03), np.zeros((1, 3)), 0.03),
    "capsule": (shapes.Capsule(0.015, 0.08), np.array([[0, 0, -0.04], [0, 0, 0.04]]), 0.015),
    "box": (shapes.Box((0.05, 0.08, 0.06)), shapes.Box((0.05, 0.08, 0.06)).surface()[0], 0.0),
    "mesh": (HULL, HULL.vertices, 0.0),
}


def pose_of(position, quaternion=STILL):
    return np.concatenate([position, quaternion])


def cube(cells=3, size=0.1, shift=(0.0, 0.0, 0.0)):
    """Nodes and outer triangles of a soft cube."""
    mesh = meshing.box((size,) * 3, (cells,) * 3)
    return mesh.nodes + np.asarray(shift), meshing.tet_surface(mesh.tets)


def two_cubes(shift, cells=3):
    """Two soft cubes, the second moved by ``shift``, with a pair."""
    nodes, triangles = cube(cells)
    x = np.concatenate([nodes, nodes + np.asarray(shift)])
    scene = CollisionScene()
    a = scene.add_soft_surface(triangles, x, name="a")
    b = scene.add_soft_surface(triangles + len(nodes), x, name="b")
    scene.pair(a, b)
    return scene, x


# Distances


@pytest.mark.parametrize(("one", "other"), list(itertools.combinations_with_replacement(CONVEX, 2)))
def test_smallest_gap_is_distance_of_convex_shapes(one, other, rng):
    """min over contacts of the gap = distance of the cores - radii, from a quadratic program, at random poses."""
    (a, core_a, radius_a), (b, core_b, radius_b) = CONVEX[one], CONVEX[other]
    scene = CollisionScene()
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
    scene = CollisionScene()
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
            scene = CollisionScene()
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


def box_on_box(shift, angle=0.0, capacity=100, **laws):
    """A box of 0.1 m on another one, moved and turned about z."""
    scene = CollisionScene()
    scene.pair(scene.add_shape(0, shapes.Box((0.1, 0.1, 0.1))), scene.add_shape(1, shapes.Box((0.1, 0.1, 0.1))))
    turn = np.array([0.0, 0.0, np.sin(0.5 * angle), np.cos(0.5 * angle)])
    poses = [pose_of([shift[0], shift[1], 0.1 + shift[2]], turn), pose_of(np.zeros(3))]
    return Probe(scene, pose=poses, capacity=capacity, **laws)


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
    scene = CollisionScene()
    scene.pair(scene.add_shape(0, shapes.Box((0.3, 0.04, 0.04))), scene.add_shape(1, shapes.Box((0.04, 0.3, 0.04))))
    found = Probe(scene, pose=[pose_of([0, 0, 0.0399]), pose_of(np.zeros(3))], alarm=0.001).find()
    assert found.count == 4
    np.testing.assert_allclose(np.abs(found.normal[:, 2]), 1.0, atol=1e-9)
    expected = np.array(list(itertools.product((-0.02, 0.02), repeat=2)))
    np.testing.assert_allclose(np.unique(np.round(found.point[:, :2], 3), axis=0), expected, atol=1e-6)


def test_edge_on_edge_has_the_common_normal():
    """A box standing on its edge across the edge of another one: one contact, normal across both edges, true depth."""
    scene = CollisionScene()
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
    scene = CollisionScene()
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
    scene = CollisionScene()
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
        scene = CollisionScene()
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
    scene = CollisionScene()
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
    scene = CollisionScene()
    rod = scene.add_rod(np.arange(count), radius, straight)
    scene.pair(rod, rod)
    probe = Probe(scene, pose=[pose_of(p) for p in straight], alarm=0.004)
    assert probe.find().count == 0
    probe.pose[0, :, :3] = loop
    found = probe.find()
    assert found.count >= 1
    assert found.gap.min() < 0.001
    assert found.gap.min() > -2 * radius


# Kinematics


def mixed_scene(rng):
    """Soft cube with one face carried by a frame, welded rod node, rigid shapes, all near each other."""
    nodes, triangles = cube(2, 0.1)
    n = len(nodes)
    scene = CollisionScene()
    soft = scene.add_soft_surface(triangles, nodes)
    rod = scene.add_rod([0, 1, 2], 0.004, [[-0.02, 0.03, 0.106], [0.05, 0.04, 0.1055], [0.12, 0.08, 0.1058]])
    box = scene.add_shape(3, shapes.Box((0.06, 0.05, 0.07)), [0.002, 0.001, 0.0])
    ball = scene.add_shape(4, shapes.Sphere(0.03))
    mesh = scene.add_shape(5, shapes.Mesh(*shapes.Box((0.05, 0.05, 0.05)).surface()), quaternion=[0, 0, 0.6, 0.8])
    cap = scene.add_shape(6, shapes.Capsule(0.01, 0.06))
    floor = scene.add_shape(WORLD, shapes.Plane(), [0, 0, -0.002])
    for a, b in [
        (soft, rod),
        (soft, box),
        (soft, ball),
        (soft, mesh),
        (soft, floor),
        (rod, ball),
        (rod, cap),
        (box, mesh),
    ]:
        scene.pair(a, b)
    poses = [
        pose_of([-0.02, 0.03, 0.106], random_quaternion(rng)),
        pose_of([0.05, 0.04, 0.1055], random_quaternion(rng)),
        pose_of([0.12, 0.08, 0.1058], random_quaternion(rng)),
        pose_of([0.13, 0.05, 0.05], [0, 0, np.sin(0.02), np.cos(0.02)]),
        pose_of([0.05, -0.0315, 0.05], random_quaternion(rng)),
        pose_of([0.1225, 0.05, 0.11], [0.02, 0.01, 0.0, np.sqrt(1 - 0.0005)]),
        pose_of([0.05, 0.05, 0.122], [0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)]),
    ]
    node_frame = np.where(nodes[:, 2] > 0.099, 7, -1)
    node_dof = np.where(node_frame >= 0, -1, np.arange(n))
    node_dof[0] = -1  # fixed
    master = np.arange(8)
    master[2] = 4  # the rod's end is welded to the ball
    dofs = n + np.arange(16).reshape(8, 2)
    poses.append(pose_of([0.05, 0.05, 0.15], random_quaternion(rng)))
    topology = Topology(node_dof, node_frame, dofs[master].reshape(-1), master)
    return scene, nodes, np.array(poses), topology, n + 16


def moved(x, pose, topology, u, h):
    """Positions after a step h with velocities u of the dofs (dof, 3): what is carried turns with its frame."""
    node_dof, node_frame = np.asarray(topology.node_dof), np.asarray(topology.node_frame)
    dofs, master = np.asarray(topology.frame_dof).reshape(-1, 2), np.asarray(topology.frame_master)
    new_pose, new_x, v = pose.copy(), x.copy(), np.zeros_like(x)
    twist = np.zeros((len(pose), 6))
    for f in range(len(pose)):
        V, w = u[dofs[f, 0]], u[dofs[f, 1]]
        twist[f] = [*(V + np.cross(w, pose[f, :3] - pose[master[f], :3])), *w]
    for f in range(len(pose)):
        m = master[f]
        new_pose[f] = turned(pose[f], twist[f], h)
        turn = turned(pose[m], twist[m], h)
        local = rotation_matrix(pose[m, 3:]).T @ (pose[f, :3] - pose[m, :3])
        new_pose[f, :3] = rotation_matrix(turn[3:]) @ local + turn[:3]
    for n in range(len(x)):
        if node_dof[n] >= 0:
            v[n] = u[node_dof[n]]
        elif node_frame[n] >= 0:
            f = node_frame[n]
            v[n] = twist[f, :3] + np.cross(twist[f, 3:], x[n] - pose[f, :3])
            local = rotation_matrix(pose[f, 3:]).T @ (x[n] - pose[f, :3])
            new_x[n] = rotation_matrix(new_pose[f, 3:]) @ local + new_pose[f, :3]
            continue
        new_x[n] += h * v[n]
    return new_x, new_pose, v, twist


def test_relative_velocity_is_rate_of_gap(rng):
    """d gap / dt = n . relative velocity from slots, weights and levers, for random velocities of all dofs.

    Central differences, step 1e-7 s. Kinks along edges are found to 2^-12 of the edge; a corner in deep penetration
    has the normal at its inset, whose turning is left out.
    """
    scene, x, pose, topology, dofs = mixed_scene(rng)
    probe = Probe(scene, x, pose, topology=topology, alarm=0.004)
    start = probe.find()
    assert set(start.pair) == {0, 1, 2, 3, 4, 6, 7}  # the rod is far from the ball that its end is welded to
    for _ in range(4):
        u = rng.standard_normal((dofs, 3))
        rates = np.full((2, start.count), np.nan)
        for sign, row in ((1, 0), (-1, 1)):
            probe.x[0], probe.pose[0], _, _ = moved(x, pose, topology, u, sign * 1e-7)
            found = probe.find()
            _, at, of = np.intersect1d(start.key, found.key, return_indices=True)
            rates[row, at] = found.gap[of]
        rate = (rates[0] - rates[1]) / 2e-7
        normal = np.sum(start.normal * probe.relative_velocity(start, u), axis=1)
        error = np.abs(rate - normal)[~np.isnan(rate)]
        assert len(error) >= start.count - 2
        assert (error < 1e-4).mean() > 0.9
        assert error.max() < 0.02


def test_forces_balance(rng):
    """Weights of all slots sum to 0: no net force; levers of a common turn about any point sum to 0: no net moment.

    A common rotation w of everything has no relative velocity where both sides meet: sum of slots = w x (a - b).
    """
    scene, x, pose, topology, dofs = mixed_scene(rng)
    probe = Probe(scene, x, pose, topology=topology, alarm=0.004)
    found = probe.find()
    held = np.asarray(topology.node_dof)[0] < 0
    assert held
    u = np.zeros((dofs, 3))
    node_dof, master = np.asarray(topology.node_dof), np.asarray(topology.frame_master)
    frame_dof = np.asarray(topology.frame_dof).reshape(-1, 2)
    w, V = rng.standard_normal(3), rng.standard_normal(3)
    own = np.where(node_dof >= 0)[0]
    u[node_dof[own]] = V + np.cross(w, x[own])
    for f in range(len(pose)):
        u[frame_dof[f, 0]] = V + np.cross(w, pose[master[f], :3])
        u[frame_dof[f, 1]] = w
    relative = probe.relative_velocity(found, u)
    world = found.pair == 4  # against the floor, which does not take part
    at_fixed = np.any(np.abs(found.point - x[0]) < 0.051, axis=1)
    rigid = ~world & ~at_fixed
    assert rigid.sum() > 3
    np.testing.assert_allclose(np.linalg.norm(relative[rigid], axis=1), 0.0, atol=np.linalg.norm(w) * 0.0045)
    assert np.abs(np.sum(relative[rigid] * found.normal[rigid], axis=1)).max() < 1e-9


# Lists, memory, margins


def test_margin_grows_with_relative_speed():
    """A ball 0.1 m above the floor is seen if it can close 1.5 steps of its speed."""
    scene = CollisionScene()
    scene.pair(scene.add_shape(0, shapes.Sphere(0.01)), scene.add_shape(WORLD, shapes.Plane()))
    probe = Probe(scene, pose=[pose_of([0, 0, 0.11])], alarm=0.001)
    for speed, seen in ((6.0, 0), (6.5, 0), (6.65, 1), (20.0, 1)):
        probe.twist[0, 0, 2] = -speed
        assert probe.find(h=0.01).count == seen
    probe.detector.slack = 0.1
    probe.twist[0, 0, 2] = 0.0
    assert probe.find(h=0.01).count == 1


def test_contact_distance_and_laws_are_those_of_the_pair_and_world():
    """gap = distance - contact distance, and every world has its own laws."""
    scene = CollisionScene()
    ball, other = scene.add_shape(0, shapes.Sphere(0.01)), scene.add_shape(1, shapes.Sphere(0.02))
    floor = scene.add_shape(WORLD, shapes.Plane())
    assert [scene.pair(ball, floor), scene.pair(other, floor)] == [0, 1]
    probe = Probe(scene, pose=np.tile([pose_of([0, 0, 0.012]), pose_of([0.1, 0, 0.021])], (2, 1, 1)))
    tables = {name: np.full((2, 2), value) for name, value in probe.laws.items()}
    tables["distance"] = np.array([[0.0, 0.001], [0.002, 0.003]])
    tables["mu"] = np.array([[0.1, 0.2], [0.3, 0.4]])
    probe.parameters = lambda: type("Laws", (), {name: filled(EXACT, value) for name, value in tables.items()})
    for world in range(2):
        found = probe.find(world=world)
        np.testing.assert_allclose(found.gap, np.array([0.002, 0.001]) - tables["distance"][world], atol=1e-15)
        np.testing.assert_allclose(found.mu, tables["mu"][world])


def test_capacity_is_kept_and_the_rest_counted():
    """Of the four corners of a box two find a place; two are counted; entries past the last are neutral."""
    probe = box_on_box((0.0, 0.0, 0.0), alarm=0.001, capacity=2)
    found = probe.find()
    full = box_on_box((0.0, 0.0, 0.0), alarm=0.001).find()
    assert (found.count, found.overflow) == (2, full.count - 2)
    np.testing.assert_array_equal(found.key, full.key[:2])
    probe.pose[0, 0, 2] = 1.0
    probe.find()
    c = probe.detector.contacts
    assert c.count.real.numpy().max() == 0
    assert c.dof.real.numpy().max() == -1
    assert c.gap.real.numpy().min() == 1.0
    for name in ("weight", "lever", "axes", "mu", "multiplier"):
        assert not getattr(c, name).real.numpy().any()


def test_memory_follows_contacts_and_turns_into_new_axes(rng):
    """Forces return to contacts of the same key as the same world vectors; new contacts start at 0."""
    probe = box_on_box((0.0, 0.0, 0.0), 0.3, alarm=0.001)
    first = probe.find()
    force = rng.uniform(1.0, 2.0, (first.count, 3))
    array = np.zeros_like(probe.detector.contacts.multiplier.real.numpy())
    array[0, : force.size, 0] = force.reshape(-1)
    probe.detector.contacts.multiplier.real.assign(array)
    vectors = np.einsum("ca,cax->cx", force, first.axes)
    probe.detector.remember()
    state = [np.zeros((1, 1), np.int32), np.zeros((1, 100), np.int32), np.zeros((1, 300))]
    arrays = [wp.array(a, dtype=wp.int32 if a.dtype == np.int32 else wp.float64, device="cpu") for a in state]
    flag = rows.allocate(EXACT, 1, 2, "cpu", wp.int32)
    flag.real.fill_(1)
    probe.detector.store(flag, *arrays)
    assert arrays[0].numpy()[0, 0] == 0  # a failed world keeps what it had
    flag.zero()
    probe.detector.store(flag, *arrays)
    np.testing.assert_array_equal(arrays[1].numpy()[0, : first.count], first.key)
    other = box_on_box((0.001, 0.0, 0.0), 0.35, alarm=0.001)
    other.detector.load(*arrays)
    second = other.find()
    found = np.einsum("ca,cax->cx", second.multiplier, second.axes)
    for key, vector, normal in zip(second.key, found, second.normal, strict=True):
        old = np.where(first.key == key)[0]
        expected = vectors[old[0]] if len(old) else np.zeros(3)
        expected = expected - min(expected @ normal, 0.0) * normal
        np.testing.assert_allclose(vector, expected, atol=1e-12)


@pytest.mark.parametrize("name", ["scalar", "lanes"])
def test_world_of_a_batch_equals_it_alone(name, rng):
    """Eleven worlds in different states: every contact of a world is bit for bit what it finds alone, in float32."""
    scene, x, pose, topology, _ = mixed_scene(rng)
    worlds = 11
    xs = x + 1e-3 * rng.standard_normal((worlds, *x.shape))
    poses = np.tile(pose, (worlds, 1, 1))
    poses[:, :, :3] += 2e-3 * rng.standard_normal((worlds, len(pose), 3))
    batch = Probe(scene, xs, poses, topology=topology, variant=lanes.variant(name), alarm=0.004)
    batch.find()
    counts = set()
    for world in range(worlds):
        alone = Probe(scene, xs[world], poses[world], topology=topology, variant=lanes.variant("scalar"), alarm=0.004)
        expected, found = alone.find(), batch.contacts(world)
        counts.add(found.count)
        for field in ("key", "pair", "dof", "weight", "lever", "axes", "point", "gap", "multiplier"):
            np.testing.assert_array_equal(getattr(found, field), getattr(expected, field))
    assert len(counts) > 1


def test_workspace_is_rebuilt():
    """Rubbish in the workspace before a search changes nothing."""
    probe = box_on_box((0.01, 0.0, 0.0), alarm=0.001)
    first = probe.find()
    d = probe.detector
    for array in (d.box, d.reach, d.touch, d.contacts.axes, d.contacts.lever, d.contacts.weight, d.contacts.gap):
        array.real.fill_(np.nan)
    for array in (d.hit, d.chunk_hits, d.couple, d.face, d.known, d.contacts.dof, d.contacts.key, d.contacts.count):
        array.real.fill_(7)
    again = probe.find()
    for field in ("key", "dof", "weight", "lever", "axes", "gap", "multiplier"):
        np.testing.assert_array_equal(getattr(again, field), getattr(first, field))


# Trees


def test_boxes_of_a_refitted_tree_hold_their_faces(rng):
    """After a deformation the box of every node is that of the faces below it, also of trees with two passes."""
    scene, x = two_cubes((0.0, 0.0, 0.11), cells=8)
    probe = Probe(scene, x, capacity=10)
    probe.x[0] += 0.01 * rng.standard_normal(x.shape)
    probe.find()
    packed = probe.detector.scene
    skip, first, last = (getattr(packed, f"tree_{n}").numpy() for n in ("skip", "first", "last"))
    assert probe.detector.arrays.tasks[1] > 0
    assert len(skip) > 2 * TASK
    face, corner = packed.tree_face.numpy(), packed.face_corner.numpy()
    index = packed.point_index.numpy()
    boxes = probe.detector.tree_box.real.numpy()[0, :, 0].reshape(-1, 6)
    for node in range(len(skip)):
        leaves = [m for m in range(node, skip[node]) if first[m] >= 0]
        below = np.concatenate([face[first[m] : last[m]] for m in leaves])
        points = probe.x[0][index[corner[below]]].reshape(-1, 3)
        np.testing.assert_array_equal(boxes[node], np.concatenate([points.min(axis=0), points.max(axis=0)]))


def test_tree_holds_every_face_once():
    """Leaves partition the faces; skip leads behind the subtree."""
    rng = np.random.default_rng(1)
    low = rng.random((157, 3))
    trees = Trees.empty()
    root, end = trees.add(np.arange(157), low, low + 0.01)
    assert sorted(trees.face) == list(range(157))
    assert trees.skip[root] == end == len(trees.skip)
    below, above = trees.refit_tasks([(root, end)])
    assert sorted(n for group in (below, above) for task in group for n in task) == list(range(end))


# Bad input


def test_pairs_that_cannot_touch_are_refused():
    scene = CollisionScene()
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
    scene = CollisionScene()
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
