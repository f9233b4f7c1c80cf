"""Rigid shapes: distances against formulas and against their triangles, masses against integrals, refusals by name."""

import subprocess
import sys

import numpy as np
import pytest
import trimesh
import warp as wp

import softwarp as sw
from softwarp import meshing, shapes
from softwarp.kernels.collision import shapes as kernels
from softwarp.shapes.base import quaternion_of, quaternion_product, rotation_matrix
from softwarp.shapes.grid import zero_level
from softwarp.shapes.mesh import signed_distance, solid_of

PRIMITIVES = [sw.Sphere(0.3), sw.Capsule(0.2, 0.5), sw.Box((0.2, 0.4, 0.6)), sw.Cylinder(0.2, 0.5)]
ALL = [sw.Plane(), *PRIMITIVES]
TURN = np.array([0.1, -0.5, 0.3, np.sqrt(1.0 - 0.35)])


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def probe(shape, points, real=wp.float64):
    """Distance and gradient by the device functions."""
    f = kernels.functions(real)
    count = len(points)
    p = wp.array(points, dtype=f.vec3, device="cpu")
    d, n = wp.zeros(count, dtype=real, device="cpu"), wp.zeros(count, dtype=f.vec3, device="cpu")
    if isinstance(shape, sw.SDF):
        value = wp.array(shape.values.reshape(-1), dtype=real, device="cpu")
        inputs = [value, wp.vec3i(*shape.values.shape), f.vec3(*shape.origin), real(shape.spacing), p, d, n]
        wp.launch(f.probe_grid, dim=count, inputs=inputs, device="cpu")
    else:
        kind = wp.array(np.full(count, shape.kind), dtype=wp.int32, device="cpu")
        size = wp.array(np.tile(shape.size, (count, 1)), dtype=f.vec3, device="cpu")
        wp.launch(f.probe, dim=count, inputs=[kind, size, p, d, n], device="cpu")
    return d.numpy(), n.numpy()


def centroids(shape, resolution):
    """Middles of the triangles that are drawn, and their normals."""
    x, t = shape.surface(resolution)
    normal = np.cross(x[t[:, 1]] - x[t[:, 0]], x[t[:, 2]] - x[t[:, 0]])
    return x[t].mean(axis=1), normal / np.linalg.norm(normal, axis=1, keepdims=True)


# Distances


@pytest.mark.parametrize("shape", ALL, ids=repr)
def test_gradient_is_the_derivative_of_the_distance(shape, rng):
    """n = dd/dp with |n| = 1; differences of step 1e-6 away from the few points with a kink."""
    points = rng.uniform(-0.6, 0.6, (4000, 3))
    n = probe(shape, points)[1]
    slope = [(probe(shape, points + e)[0] - probe(shape, points - e)[0]) / 2e-6 for e in 1e-6 * np.eye(3)]
    error = np.abs(np.stack(slope, axis=1) - n).max(axis=1)
    assert np.mean(error > 1e-8) < 1e-3
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1.0, rtol=1e-14)


@pytest.mark.parametrize("shape", ALL, ids=repr)
def test_step_back_along_the_gradient_ends_on_the_surface(shape, rng):
    """d(p - d n) = 0 for the exact distance, inside and outside, and no surface point is nearer than |d|."""
    points = rng.uniform(-0.6, 0.6, (500, 3))
    d, n = probe(shape, points)
    assert (d < 0.0).any() and (d > 0.0).any()
    np.testing.assert_allclose(probe(shape, points - d[:, None] * n)[0], 0.0, atol=1e-15)
    surface = centroids(shape, 64)[0]
    nearest = np.linalg.norm(points[:, None] - surface[None], axis=2).min(axis=1)
    assert np.all(nearest >= np.abs(d) - 2e-3)  # chords of 64 corners cut off 0.12 % of the radius


@pytest.mark.parametrize("shape", PRIMITIVES, ids=repr)
def test_distance_equals_that_to_the_triangles(shape, rng):
    """Chords cut off r (1 - cos(pi / 128)) = 0.03 % of the radius, twice on a sphere."""
    x, t = shape.surface(128)
    points = rng.uniform(-0.5, 0.5, (200, 3))
    np.testing.assert_allclose(
        probe(shape, points)[0], signed_distance(sw.RigidMesh(x, t), points, 0.25), atol=0.3 * 2.0 * 3.02e-4
    )


@pytest.mark.parametrize(("real", "atol"), [(wp.float32, 2e-7), (wp.float64, 0.0)])
@pytest.mark.parametrize("shape", ALL, ids=repr)
def test_degenerate_points_have_a_finite_unit_gradient(shape, real, atol):
    """Centre, axis, edges, corners, faces, and points that square to zero in single precision."""
    h = 0.5 * np.array(shape.size)
    points = np.array([[0, 0, 0], h, -h, [0, 0, h[1]], [0, 0, -h[1]], [h[0], 0, 0], [1e-30, 0, 0], [0, 1e-30, 1e-30]])
    corner = h + 1e-6
    points = np.concatenate([points, [corner, -corner, [shape.size[0], 0, h[1]]]])
    d, n = probe(shape, points, real)
    assert np.all(np.isfinite(d))
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1.0, atol=max(atol, 1e-15))


def test_known_distances():
    """Values by hand, one inside and one outside of each."""
    cases = [
        (sw.Plane(), [5, 5, -2], -2.0, [0, 0, 1]),
        (sw.Sphere(1.0), [0, 3, 4], 4.0, [0, 0.6, 0.8]),
        (sw.Sphere(1.0), [0, 0, 0], -1.0, [0, 0, 1]),
        (sw.Capsule(1.0, 2.0), [3, 0, 5], 4.0, [0.6, 0, 0.8]),
        (sw.Capsule(1.0, 2.0), [0.5, 0, 0.9], -0.5, [1, 0, 0]),
        (sw.Box((2.0, 2.0, 2.0)), [4, 5, 0], 5.0, [0.6, 0.8, 0]),
        (sw.Box((2.0, 2.0, 2.0)), [0, -0.9, 0.2], -0.1, [0, -1, 0]),
        (sw.Cylinder(1.0, 2.0), [0, -4, -5], 5.0, [0, -0.6, -0.8]),
        (sw.Cylinder(1.0, 2.0), [0.2, 0, 0.9], -0.1, [0, 0, 1]),
    ]
    for shape, point, distance, normal in cases:
        d, n = probe(shape, np.array([point], dtype=float))
        np.testing.assert_allclose(d, [distance], rtol=1e-15)
        np.testing.assert_allclose(n, [normal], atol=1e-15)


@pytest.mark.parametrize("shape", ALL, ids=repr)
def test_single_precision_agrees(shape, rng):
    """Rounding of the coordinates, 1e-7 of them, is all that separates the precisions."""
    points = rng.uniform(-0.6, 0.6, (500, 3)).astype(np.float32)
    d32, n32 = probe(shape, points, wp.float32)
    d64, n64 = probe(shape, points)
    np.testing.assert_allclose(d32, d64, atol=3e-7)
    same = np.abs(n32 - n64).max(axis=1) < 1e-4
    assert same.mean() > 0.99  # the nearest of two equal faces may differ


@pytest.mark.parametrize("shape", ALL, ids=repr)
def test_host_and_device_agree(shape, rng):
    """The distances that builders use are those of the kernels, in local axes and for a body that lies anywhere."""
    points = rng.uniform(-0.6, 0.6, (300, 3))
    expected = probe(shape, points)[0]
    np.testing.assert_allclose(shape.distance(points), expected, atol=1e-15)
    R, x = rotation_matrix(TURN), np.array([1.0, 2.0, 3.0])
    matrix = np.block([[R, x[:, None]], [np.zeros(3), 1.0]])
    for pose in ([*x, *TURN], matrix):
        np.testing.assert_allclose(shapes.distances(shape, pose, points @ R.T + x), expected, atol=3e-15)


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_rotation_helpers(real):
    """to_world and to_local undo each other; rotate is the rotation matrix."""
    f = kernels.functions(real)
    rotate, to_world, to_local = f.rotate, f.to_world, f.to_local

    @wp.kernel(enable_backward=False, module="unique")
    def turn(q: f.vec4, x: f.vec3, p: f.vec3, out: wp.array(dtype=f.vec3)):
        out[0] = rotate(q, p)
        out[1] = to_local(x, q, to_world(x, q, p))

    out = wp.zeros(2, dtype=f.vec3, device="cpu")
    p = np.array([0.3, -0.2, 0.7])
    wp.launch(turn, dim=1, inputs=[f.vec4(*TURN), f.vec3(1.0, 2.0, 3.0), f.vec3(*p), out], device="cpu")
    tolerance = 1e-6 if real is wp.float32 else 1e-15
    np.testing.assert_allclose(out.numpy()[0], rotation_matrix(TURN) @ p, atol=tolerance)
    np.testing.assert_allclose(out.numpy()[1], p, atol=tolerance)


# Masses


@pytest.mark.parametrize("shape", PRIMITIVES, ids=repr)
def test_primitives_agree_with_their_triangles(shape):
    """Closed forms against the integrals over inscribed triangles, which converge with the square of the resolution."""
    exact = shape.inertia(density=1000.0)
    error = []
    for resolution in (48, 96):
        mesh = sw.RigidMesh(*shape.surface(resolution)).inertia(density=1000.0)
        relative = np.diag(mesh.inertia) / np.diag(exact.inertia) - 1.0
        error.append(np.array([mesh.mass / exact.mass - 1.0, *relative]))
        np.testing.assert_allclose(mesh.centre, 0.0, atol=1e-15)
    assert np.abs(error[1]).max() < 4e-3
    np.testing.assert_allclose(error[1], error[0] / 4.0, atol=2e-5)


def test_known_inertias():
    """2/5 m r^2, m/12 (b^2 + c^2), m/12 (3 r^2 + l^2); a long thin capsule is a rod, m l^2 / 12."""
    np.testing.assert_allclose(np.diag(sw.Sphere(0.5).inertia(mass=2.0).inertia), 0.2)
    np.testing.assert_allclose(np.diag(sw.Box((1, 2, 3)).inertia(mass=12.0).inertia), [13.0, 10.0, 5.0])
    np.testing.assert_allclose(np.diag(sw.Cylinder(2.0, 6.0).inertia(mass=1.0).inertia), [4.0, 4.0, 2.0])
    thin = sw.Capsule(1e-4, 1.0).inertia(mass=1.0)
    np.testing.assert_allclose(thin.inertia[0, 0], 1.0 / 12.0, rtol=1e-3)
    assert thin.mass == pytest.approx(1.0) and sw.Box((1, 1, 1)).inertia(density=7.0).mass == pytest.approx(7.0)


def test_mesh_inertia_of_an_arbitrary_body(rng):
    """Against trimesh, and unchanged by where the body lies: rounding of the far position, 1e3 times 1e-16."""
    mesh = sw.RigidMesh.hull(rng.standard_normal((40, 3)) * [0.1, 0.2, 0.3])
    body = mesh.inertia(density=500.0)
    other = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    np.testing.assert_allclose(body.mass, 500.0 * other.volume, rtol=1e-13)
    np.testing.assert_allclose(body.centre, other.center_mass, rtol=1e-12)
    np.testing.assert_allclose(body.inertia, 500.0 * other.moment_inertia, atol=1e-13 * body.inertia.max())
    far = sw.RigidMesh(mesh.vertices + 1e3, mesh.triangles).inertia(density=500.0)
    np.testing.assert_allclose(far.inertia, body.inertia, atol=1e-10 * body.inertia.max())


def test_compound_is_the_sum_of_its_parts():
    """Parallel axes: two halves of a box are the box, whichever way they are turned in themselves."""
    whole = sw.Box((0.2, 0.3, 0.4)).inertia(density=1000.0)
    quarter = [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]  # about z: exchanges x and y
    halves = shapes.Compound([
        (sw.Box((0.3, 0.1, 0.4)), [-0.05, 0, 0, *quarter]),
        (sw.Box((0.1, 0.3, 0.4)), [0.05, 0, 0]),
    ])  # fmt: skip
    body = halves.inertia(density=1000.0)
    np.testing.assert_allclose(body.mass, whole.mass)
    np.testing.assert_allclose(body.centre, 0.0, atol=1e-17)
    np.testing.assert_allclose(body.inertia, whole.inertia, atol=1e-15)
    np.testing.assert_allclose(halves.bounds, sw.Box((0.2, 0.3, 0.4)).bounds, atol=1e-15)
    features = halves.features()
    assert features.points.shape == (16, 3) and features.edges.shape == (24, 2, 3)
    np.testing.assert_allclose(features.points.max(axis=0), [0.1, 0.15, 0.2])
    outside = np.array([[0.2, 0.1, 0.0], [0.0, -0.3, 0.4], [0.05, 0.0, 0.5]])
    np.testing.assert_allclose(halves.distance(outside), sw.Box((0.2, 0.3, 0.4)).distance(outside))
    x, t = halves.surface()
    np.testing.assert_allclose(solid_of(x, t).volume, 0.024)


def test_nested_compounds_are_flattened():
    """Poses chain: X = X_outer + R_outer X_inner, q = q_outer q_inner."""
    inner = shapes.Compound([(sw.Sphere(0.1), [0.0, 0.0, 0.5, *TURN])])
    outer = shapes.Compound([(inner, [1.0, 2.0, 3.0, *TURN]), sw.Plane()])
    ball, floor = outer.parts()
    np.testing.assert_allclose(ball.position, [1, 2, 3] + rotation_matrix(TURN) @ [0, 0, 0.5])
    np.testing.assert_allclose(rotation_matrix(ball.quaternion), np.linalg.matrix_power(rotation_matrix(TURN), 2))
    assert isinstance(ball.shape, sw.Sphere) and isinstance(floor.shape, sw.Plane)
    assert outer.volume == np.inf
    assert [part.shape for part in sw.Box((1, 1, 1)).parts()] == [sw.Box((1, 1, 1))]


def test_principal_axes_rebuild_the_tensor(rng):
    """R diag(moments) R' = I with R the turn by the quaternion, a rotation."""
    R = rotation_matrix(quaternion_product(TURN, [0.0, 0.6, 0.0, 0.8]))
    tensor = R @ np.diag([2.0, 3.0, 4.0]) @ R.T
    moments, q = shapes.principal(1.0, tensor)
    np.testing.assert_allclose(moments, [2.0, 3.0, 4.0])
    np.testing.assert_allclose(rotation_matrix(q) @ np.diag(moments) @ rotation_matrix(q).T, tensor, atol=1e-14)
    np.testing.assert_allclose(shapes.principal(1.0, [4.0, 3.0, 2.0]).moments, [2.0, 3.0, 4.0])
    for q in rng.standard_normal((20, 4)):
        unit = q / np.linalg.norm(q)
        np.testing.assert_allclose(quaternion_of(rotation_matrix(unit)), unit * np.sign(unit[3]), atol=1e-14)


# Features


@pytest.mark.parametrize("shape", PRIMITIVES, ids=repr)
def test_features_lie_on_the_surface(shape):
    """Each point is its radius deep, and so is the inside of each edge."""
    f = shape.features()
    np.testing.assert_allclose(probe(shape, f.points)[0], -f.point_radius, atol=1e-15)
    if len(f.edges):
        np.testing.assert_allclose(probe(shape, f.edges.mean(axis=1))[0], -f.edge_radius, atol=1e-15)


def test_feature_counts():
    """Sphere 1, capsule 2 and 1, box 8 and 12, cylinder 32 and 1, plane none."""
    count = [(len(s.features().points), len(s.features().edges)) for s in ALL]
    assert count == [(0, 0), (1, 0), (2, 1), (8, 12), (32, 1)]
    assert len(sw.Cylinder(1.0, 1.0, rim_points=5).features().points) == 10
    lengths = np.linalg.norm(np.diff(sw.Box((1, 2, 3)).features().edges, axis=1)[:, 0], axis=1)
    np.testing.assert_allclose(np.sort(lengths), np.repeat([1, 2, 3], 4))


def test_mesh_edges_that_protrude():
    """A box keeps its 12 edges and no diagonals; an L-shaped prism loses its inner edge; 5 degrees decide."""
    assert len(sw.RigidMesh(*sw.Box((1, 1, 1)).surface()).features().edges) == 12
    outline = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], dtype=float)
    caps = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    x = np.concatenate([np.column_stack([outline, np.full(6, z)]) for z in (0.0, 1.0)])
    ring = [[[i, (i + 1) % 6, (i + 1) % 6 + 6], [i, (i + 1) % 6 + 6, i + 6]] for i in range(6)]
    prism = sw.RigidMesh(x, np.concatenate([caps[:, ::-1], caps + 6, np.reshape(ring, (-1, 3))]))
    assert prism.volume == pytest.approx(3.0) and prism.convex is False
    upright = prism.features().edges[np.ptp(prism.features().edges[:, :, 2], axis=1) > 0.5]
    assert len(upright) == 5 and [1.0, 1.0] not in upright[:, 0, :2].tolist()
    fine = sw.RigidMesh(*sw.Cylinder(1.0, 1.0).surface(90))  # 4 degrees between faces of the mantle
    assert len(fine.features().edges) == 180
    assert len(sw.RigidMesh(fine.vertices, fine.triangles, feature_angle=3.0).features().edges) == 270


# Meshes


def test_convexity():
    """Found by the volume of the hull; a claim is checked; a hull is convex."""
    torus = trimesh.creation.torus(1.0, 0.3)
    assert sw.RigidMesh(*sw.Sphere(1.0).surface()).convex is True
    assert sw.RigidMesh(torus.vertices, torus.faces).convex is False
    assert sw.RigidMesh(*sw.Sphere(1.0).surface(), convex=False).convex is False
    with pytest.raises(ValueError, match=r"is not convex, .* % of its hull is empty"):
        sw.RigidMesh(torus.vertices, torus.faces, convex=True)
    assert sw.RigidMesh.hull(torus.vertices).convex is True


def test_inward_mesh_is_turned_and_hollows_stay():
    """A surface that is inward as a whole is turned over; a smaller ball inside another one is a hollow: 1 - 1/8."""
    x, t = sw.Sphere(1.0).surface()
    ball = sw.RigidMesh(x, t[:, ::-1])
    np.testing.assert_array_equal(ball.triangles, t)
    both = np.concatenate([x, 0.5 * x]), np.concatenate([t, t[:, ::-1] + len(x)])
    assert sw.RigidMesh(*both).volume == pytest.approx(ball.volume * 7.0 / 8.0)
    assert sw.RigidMesh(both[0], both[1][:, ::-1]).volume == pytest.approx(ball.volume * 7.0 / 8.0)
    with pytest.raises(meshing.MeshError, match="lies in no other part"):
        sw.RigidMesh(np.concatenate([x, 0.5 * x + 5.0]), both[1])


def test_signed_distance_of_meshes(rng):
    """Against every triangle by brute force; the sign against the analytic box, also beyond its edges and corners."""
    box = sw.RigidMesh(*sw.Box((0.2, 0.4, 0.6)).surface())
    points = rng.uniform(-0.6, 0.6, (600, 3))
    expected = probe(sw.Box((0.2, 0.4, 0.6)), points)[0]
    for cell in (0.05, 0.3, 5.0):
        np.testing.assert_allclose(signed_distance(box, points, cell), expected, atol=1e-15)
    np.testing.assert_allclose(box.distance(points), expected, atol=1e-15)
    np.testing.assert_allclose(box.distance(points[:1]), expected[:1], atol=1e-15)
    assert box.distance(np.zeros((0, 3))).shape == (0,)
    torus = trimesh.creation.torus(0.5, 0.2, major_sections=64, minor_sections=32)
    ring = np.hypot(points[:, 0], points[:, 1]) - 0.5
    found = signed_distance(sw.RigidMesh(torus.vertices, torus.faces), points, 0.1)
    np.testing.assert_allclose(found, np.hypot(ring, points[:, 2]) - 0.2, atol=2e-3)


# Grids


def sphere_grid(radius, cells, centre=0.0):
    """Exact distance to a ball on a cube of edge 3 radius."""
    axes = np.stack(np.meshgrid(*[np.linspace(-1.5 * radius, 1.5 * radius, cells + 1)] * 3, indexing="ij"), axis=-1)
    origin = (-1.5 * radius, -1.5 * radius, -1.5 * radius)
    return sw.SDF(np.linalg.norm(axes - centre, axis=-1) - radius, 3.0 * radius / cells, origin)


def test_grid_reproduces_a_sphere(rng):
    """A linear interpolant errs by h^2 / (8 R) per direction of curvature 1/R, here R > 0.13: below h^2 / (4 R)."""
    direction = rng.standard_normal((1000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = rng.uniform(0.16, 0.24, 1000)
    error = []
    for cells in (15, 30):
        d, n = probe(sphere_grid(0.2, cells), radius[:, None] * direction)
        error.append(np.abs(d - (radius - 0.2)).max())
        np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1.0, rtol=1e-14)
        anywhere = rng.uniform(-0.5, 0.5, (300, 3))
        host = sphere_grid(0.2, cells).distance(anywhere)
        np.testing.assert_allclose(host, probe(sphere_grid(0.2, cells), anywhere)[0], atol=1e-14)
        assert np.einsum("ij,ij->i", n, direction).min() > 1.0 - 2.0 * (0.6 / cells) ** 2 / 0.13**2
    assert error[1] < 0.02**2 / (4.0 * 0.13) and error[1] < 0.4 * error[0]


def test_grid_is_exact_for_a_plane_and_continuous_across_its_border():
    """A linear field is reproduced; at the border the continuation starts with the value inside."""
    n = np.array([1.0, 2.0, 2.0]) / 3.0
    axes = np.stack(np.meshgrid(*[np.linspace(-1, 1, 9)] * 3, indexing="ij"), axis=-1)
    linear = np.abs(axes @ n) - 0.2  # a slab, cut off by the border: only the device functions see it
    f = kernels.functions(wp.float64)
    points = np.array([[0.3, 0.4, 0.5], [1.0, 0.3, 0.2], [1.0 + 1e-9, 0.3, 0.2], [1.5, 1.0, 1.0], [3.0, 2.0, 2.0]])
    d, g = wp.zeros(5, dtype=wp.float64, device="cpu"), wp.zeros(5, dtype=f.vec3, device="cpu")
    p = wp.array(points, dtype=f.vec3, device="cpu")
    value = wp.array(linear.reshape(-1), dtype=wp.float64, device="cpu")
    inputs = [value, wp.vec3i(9, 9, 9), f.vec3(-1.0, -1.0, -1.0), wp.float64(0.25), p, d, g]
    wp.launch(f.probe_grid, dim=5, inputs=inputs, device="cpu")
    np.testing.assert_allclose(d.numpy()[:3], points[:3] @ n - 0.2, atol=1e-8)
    np.testing.assert_allclose(g.numpy()[:3], np.tile(n, (3, 1)), atol=1e-8)
    corner = np.array([1.0, 1.0, 1.0])
    s = corner - (corner @ n - 0.2) * n  # the surface point below the nearest corner of the grid
    np.testing.assert_allclose(d.numpy()[3:], np.linalg.norm(points[3:] - s, axis=1), rtol=1e-12)


def test_grid_from_values(rng):
    """Mass and pictures come from the zero level: closed, and its volume errs with h^2."""
    error = []
    for cells in (16, 32):
        grid = sphere_grid(0.2, cells, centre=0.01)
        meshing.check_closed(*grid.surface())
        np.testing.assert_allclose(grid.centre, 0.01, atol=1e-4)
        error.append(1.0 - grid.volume / sw.Sphere(0.2).volume)
    assert 0.0 < error[1] < 0.3 * error[0] < 0.01
    points = grid.features().points
    assert len(points) < len(grid.surface()[0]) / 2
    np.testing.assert_allclose(np.linalg.norm(points - 0.01, axis=1), 0.2, atol=2e-3)
    moments = np.diag(grid.inertia(mass=1.0).inertia)
    np.testing.assert_allclose(moments, 0.4 * 0.2**2, rtol=1e-2)
    noise = rng.standard_normal((6, 6, 6))
    noise[[0, -1]] = noise[:, [0, -1]] = noise[:, :, [0, -1]] = 1.0
    noise[2, 3, 3] = 0.0
    meshing.check_closed(*zero_level(noise))  # any signs give a closed oriented surface


def test_grid_from_mesh_keeps_the_mesh():
    """Mass, features and pictures are those of the surface, not of its samples; sizes are those of the grid."""
    box = sw.Box((0.1, 0.1, 0.2))
    grid = sw.SDF.from_mesh(*box.surface(), 0.02)
    assert grid.volume == pytest.approx(0.002) and len(grid.features().edges) == 12
    np.testing.assert_allclose(grid.bounds, box.bounds)
    assert grid.kind == shapes.Kind.GRID and grid.size == pytest.approx((0.22, 0.22, 0.32))
    assert grid.values.shape == (12, 12, 17)
    axes = [grid.origin[c] + 0.02 * np.arange(n) for c, n in enumerate(grid.values.shape)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    np.testing.assert_allclose(grid.values.reshape(-1), probe(box, nodes)[0], atol=1e-15)
    np.testing.assert_allclose(probe(grid, nodes)[0], grid.values.reshape(-1), atol=1e-15)


# Conversion


def test_as_shape_takes_what_users_have(tmp_path):
    """Meshes of this package and of trimesh, arrays, files, and lists of parts."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    for suffix in (".stl", ".obj", ".ply", ".glb"):
        ball.export(tmp_path / f"ball{suffix}")
        mesh = shapes.as_shape(str(tmp_path / f"ball{suffix}"))
        assert mesh.volume == pytest.approx(ball.volume, rel=1e-5) and mesh.convex
    surface = meshing.SurfaceMesh(np.asarray(ball.vertices), np.asarray(ball.faces, dtype=np.int32))
    for value in (ball, surface, (ball.vertices, ball.faces)):
        assert shapes.as_shape(value).volume == pytest.approx(ball.volume)
    assert shapes.as_shape(meshing.box((0.1, 0.2, 0.3), (2, 2, 2))).volume == pytest.approx(0.006)
    box = sw.Box((0.1, 0.1, 0.1))
    assert shapes.as_shape(box) is box
    hammer = shapes.as_shape(
        [(box, (0.0, 0.0, 0.2)), sw.Cylinder(0.01, 0.3), (ball, np.array([1.0, 0, 0, 0, 0, 0, 1]))]
    )
    assert [part.shape.kind for part in hammer.parts()] == [3, 4, 5]
    assert len(shapes.as_shape([box, box]).parts()) == 2
    assert len(shapes.as_shape((box, (0.0, 0.0, 1.0))).parts()) == 1


def test_sizes_are_kept_as_numbers():
    """Integers and NumPy numbers are lengths too; kinds are what kernels expect."""
    assert sw.Box(np.array([1, 2, 3])).size == (1.0, 2.0, 3.0)
    assert sw.Sphere(np.float32(0.5)).size == (0.5, 0.0, 0.0)
    assert sw.Capsule(1, 2).size == (1.0, 2.0, 0.0) and sw.Cylinder(1, 2).size == (1.0, 2.0, 0.0)
    assert [int(shape.kind) for shape in ALL] == [0, 1, 2, 3, 4]


def test_import_stays_light():
    """Neither trimesh nor scipy is loaded with the package."""
    code = "import sys, softwarp; print([m for m in ('trimesh', 'scipy.spatial', 'torch') if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip().endswith("[]")


# Refusals


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: sw.Sphere(-0.1), r"sphere: radius must be a positive finite number \[m\], got -0.1"),
        (lambda: sw.Sphere(np.nan), "sphere: radius .* got nan"),
        (lambda: sw.Sphere("big"), "sphere: radius .* got 'big'"),
        (lambda: sw.Capsule(0.1, 0.0), r"capsule: length must be .* got 0\.0"),
        (lambda: sw.Cylinder(np.inf, 1.0), "cylinder: radius .* got inf"),
        (lambda: sw.Cylinder(1.0, 1.0, rim_points=2), "rim_points must be an integer of at least 3, got 2"),
        (lambda: sw.Box((0.1, 0.2)), r"box: size must be three edge lengths"),
        (lambda: sw.Box((0.1, -0.2, 0.3)), r"box: size along y must be .* got .*-0\.2"),
        (lambda: sw.Box(0.1), "box: size must be three edge lengths"),
        (lambda: sw.Plane(0.0), "plane: drawn_size must be"),
        (
            lambda: sw.Plane().inertia(mass=1.0),
            "plane: fills half of space and has no mass; use it with kinematic=True",
        ),
        (lambda: sw.Sphere(0.1).inertia(), "sphere: give either density .* or mass"),
        (lambda: sw.Sphere(0.1).inertia(density=1.0, mass=1.0), "sphere: give either density"),
        (lambda: sw.Sphere(0.1).inertia(mass=0.0), r"sphere: mass must be a positive finite number \[kg\], got 0.0"),
        (lambda: sw.Sphere(0.1).inertia(density=-1), "sphere: density must be"),
        (lambda: shapes.principal(1.0, np.zeros((3, 3))), "principal moments must be positive"),
        (lambda: shapes.principal(1.0, [1.0, 1.0, 0.0], "rod"), "rod: principal moments must be positive"),
        (lambda: shapes.principal(1.0, [1.0, 1.0, 3.0]), "may not exceed the sum"),
        (lambda: shapes.principal(1.0, np.arange(9.0).reshape(3, 3)), "must be symmetric"),
        (lambda: shapes.principal(0.0, np.eye(3)), r"mass must be a positive finite number \[kg\], got 0"),
        (lambda: shapes.principal(1.0, [1.0, np.nan, 1.0]), "must be a finite tensor"),
        (lambda: shapes.Compound([]), "compound: has no parts"),
        (lambda: shapes.Compound([(sw.Sphere(1.0), (0.0, 1.0))]), "part 0: a pose must be x y z, x y z qx"),
        (lambda: shapes.Compound([(sw.Sphere(1.0), (0, 0, 0, 1, 1, 0, 0))]), "must be of length 1, got .* 1.41421"),
        (lambda: shapes.distances(sw.Plane(), 2.0 * np.eye(4), np.zeros((1, 3))), "without scale or reflection"),
        (lambda: shapes.Compound([(sw.Plane(), np.diag([1.0, 1.0, -1.0, 1.0]))]), "part 0: the matrix of a pose"),
        (lambda: sw.RigidMesh.hull(np.eye(3)), "at least 4 finite points"),
        (lambda: sw.RigidMesh.hull(np.eye(3)[[0, 1, 2, 0, 1]]), "the 5 points span no volume"),
    ],
)
def test_bad_values_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_bad_meshes_are_named():
    """Open, not finite, flat or branching surfaces; the message names the place."""
    x, t = sw.Box((1.0, 1.0, 1.0)).surface()
    with pytest.raises(meshing.MeshError, match=r"'cup' is open: edge \d+-\d+"):
        sw.RigidMesh(x, t[1:], name="cup")
    broken = x.copy()
    broken[3, 1] = np.nan
    with pytest.raises(meshing.MeshError, match=r"1 nodes are not finite \(first: 3\)"):
        sw.RigidMesh(broken, t)
    with pytest.raises(meshing.MeshError, match="badly oriented"):
        sw.RigidMesh(x, np.concatenate([t[:1, ::-1], t[1:]]))
    flat = x.copy()
    flat[t[0, 0]] = flat[t[0, 1]]
    with pytest.raises(meshing.MeshError, match=r"triangles have no area \(first: triangle 0"):
        sw.RigidMesh(flat, t)
    with pytest.raises(meshing.MeshError, match="not a manifold"):
        sw.RigidMesh(x, np.concatenate([t, t[:1]]))
    with pytest.raises(meshing.MeshError, match="encloses no volume"):
        sw.RigidMesh(np.eye(3), np.array([[0, 1, 2], [0, 2, 1]]))
    with pytest.raises(ValueError, match="feature_angle must lie in"):
        sw.RigidMesh(x, t, feature_angle=0.0)


def test_bad_grids_are_named():
    """Values that are no distances, cut solids, wrong arrays; a spacing that asks for too many nodes."""
    axes = np.stack(np.meshgrid(*[np.linspace(-1, 1, 11)] * 3, indexing="ij"), axis=-1)
    ball = np.linalg.norm(axes, axis=-1) - 0.6
    with pytest.raises(ValueError, match="change by 983 m per metre"):
        sw.SDF(1000.0 * ball, 0.2)
    with pytest.raises(ValueError, match="reaches the border of the grid at"):
        sw.SDF(-ball, 0.2)
    with pytest.raises(ValueError, match="no value is negative"):
        sw.SDF(np.abs(ball) + 0.1, 0.2)
    with pytest.raises(ValueError, match="spacing must be a positive finite number"):
        sw.SDF(ball, 0.0)
    with pytest.raises(ValueError, match=r"shape \(nx, ny, nz\)"):
        sw.SDF(ball[0], 0.2)
    with pytest.raises(ValueError, match="origin must be three"):
        sw.SDF(ball, 0.2, (0.0, np.nan, 0.0))
    bad = ball.copy()
    bad[1, 2, 3] = np.inf
    with pytest.raises(ValueError, match=r"1 values are not finite \(first: node \[1, 2, 3\]\)"):
        sw.SDF(bad, 0.2)
    with pytest.raises(ValueError, match=r"use a spacing of .* m or more"):
        sw.SDF.from_mesh(*sw.Box((1.0, 1.0, 1.0)).surface(), 1e-4)


def test_what_is_no_shape_is_named(tmp_path):
    """Types, missing and foreign files."""
    with pytest.raises(TypeError, match="paw: cannot make a shape of int"):
        shapes.as_shape(3, name="paw")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        shapes.as_shape(tmp_path / "none.stl")
    (tmp_path / "mesh.txt").write_text("x")
    with pytest.raises(ValueError, match=r"cannot read 'mesh.txt'; files of shapes end in \.stl"):
        shapes.as_shape(tmp_path / "mesh.txt")
