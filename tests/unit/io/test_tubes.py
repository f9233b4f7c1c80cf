import numpy as np
import pytest
from scipy.linalg import expm

from softwarp import meshing
from softwarp.io import tubes
from softwarp.shapes.base import quaternion_of, rotation_matrix


def cross_matrix(k):
    return np.array([[0.0, -k[2], k[1]], [k[2], 0.0, -k[0]], [-k[1], k[0], 0.0]])


@pytest.mark.parametrize("turn", [0.0, 1e-7, 0.005, 0.02, 1.0, 2.9])
def test_curve_between_nodes_has_constant_strain(rng, turn):
    """The frame at part s of a segment is T0 exp(s xi), with the matrix exponential of SciPy."""
    k = rng.standard_normal(3)
    xi = np.zeros((4, 4))
    xi[:3, :3], xi[:3, 3] = cross_matrix(turn * k / np.linalg.norm(k)), rng.standard_normal(3)
    start = np.eye(4)
    start[:3, :3], start[:3, 3] = expm(cross_matrix(rng.standard_normal(3))), rng.standard_normal(3)
    way = np.array([start @ expm(s * xi) for s in np.linspace(0.0, 1.0, 5)])
    points, axes = tubes.rod_curve(way[[0, -1], :3, 3], [quaternion_of(T[:3, :3]) for T in way[[0, -1]]], 4)
    np.testing.assert_allclose(points, way[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(axes, way[:, :3, :3], atol=1e-9)


def test_an_arc_of_few_segments_is_a_circle():
    """Three quarters of a circle of 6 segments: every point between has the radius."""
    rod = meshing.rod_geometry(meshing.arc(0.1, 1.5 * np.pi, 6), radius=0.01)
    # Frames of an arc's nodes turn evenly; those from the polygon's edges agree but for the two ends.
    inner = slice(1, -1)
    points, _ = tubes.rod_curve(rod.positions[inner], rod.quaternions[inner], 8)
    np.testing.assert_allclose(np.linalg.norm(points - (0.1, 0.0, 0.0), axis=1), 0.1, rtol=1e-6)


def test_tube_is_closed_and_has_the_right_volume():
    """A straight cone of 3 segments: its surface is closed, and its volume that of prismoids of regular polygons."""
    positions = meshing.straight(0.3, 3)
    radius = np.array([0.05, 0.04, 0.03, 0.02])
    vertices = tubes.sweep(positions, np.tile([0.0, 0.0, 0.0, 1.0], (4, 1)), radius, 12, 2)
    triangles = tubes.tube_triangles(4, 12, 2)
    closed = meshing.check_closed(vertices, triangles, name="tube")
    np.testing.assert_array_equal(closed, triangles)
    polygon = 0.5 * 12 * np.sin(2.0 * np.pi / 12)
    exact = polygon * 0.3 * (0.05**2 + 0.05 * 0.02 + 0.02**2) / 3.0
    # Quads of a cone's side are flat, so splitting them changes nothing.
    np.testing.assert_allclose(meshing.surface_volume(vertices, triangles), exact, rtol=1e-12)


def test_several_frames_at_once(rng):
    """Leading axes are frames: each tube equals the one computed alone; quaternions may be off unit length."""
    positions = meshing.straight(0.2, 2) + 0.01 * rng.standard_normal((5, 3, 3))
    quaternions = rng.standard_normal((5, 3, 4)) * 0.1 + (0.0, 0.0, 0.0, 1.0)
    together = tubes.sweep(positions, quaternions, np.full(3, 0.01), 8, 3)
    assert together.shape == (5, 7 * 8 + 2, 3)
    for frame in range(5):
        alone = tubes.sweep(positions[frame], 2.0 * quaternions[frame], np.full(3, 0.01), 8, 3)
        np.testing.assert_allclose(together[frame], alone, atol=1e-14)


def test_stripe_follows_the_first_axis():
    """Marked vertices lie within 30 degrees of +-d1; the ends' middles are not marked."""
    marked = tubes.stripe(3, 24, 2)
    q = np.array([0.0, 0.0, np.sin(0.3), np.cos(0.3)])
    vertices = tubes.sweep(meshing.straight(1.0, 2), np.tile(q, (3, 1)), np.ones(3), 24, 2)
    assert marked.shape == (len(vertices),)
    along = np.abs(vertices[:-2, :2] @ rotation_matrix(q)[:2, 0])
    np.testing.assert_array_equal(marked[:-2], along > np.cos(np.radians(37.0)))
    assert not marked[-2:].any()


def test_rods_look_smooth_with_any_number_of_segments():
    assert [tubes.pieces_per_segment(n) for n in (1, 10, 24, 500)] == [12, 5, 2, 1]
