import numpy as np

from softwarp.io.trajectory import compact_surface
from softwarp.render.surface import smooth_corners
from tests.unit.io.fakes import kuhn_surface


def cube():
    nodes, _, triangles = kuhn_surface((2, 2, 2))
    vertex_node, tri = compact_surface(triangles)
    return nodes[vertex_node], tri


def test_cube_keeps_its_edges():
    """A cube has six faces with nine vertices each: 54 normals, and each averages triangles of one face only."""
    rest, tri = cube()
    corner, start, member = smooth_corners(tri, rest, 50.0)
    assert len(start) == 55
    assert corner.max() == 53
    face = np.cross(rest[tri[:, 1]] - rest[tri[:, 0]], rest[tri[:, 2]] - rest[tri[:, 0]])
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    for n in range(54):
        around = member[start[n] : start[n + 1]]
        np.testing.assert_allclose(face[around], np.tile(face[around[0]], (len(around), 1)), atol=1e-12)


def test_all_smooth_above_the_angle_between_faces():
    """With creases only beyond 100 degrees every vertex has one normal, of all its triangles."""
    rest, tri = cube()
    corner, start, member = smooth_corners(tri, rest, 100.0)
    assert len(start) == len(rest) + 1
    assert len(member) == tri.size
    for n in range(len(rest)):
        vertices = np.unique(tri[corner == n])
        assert len(vertices) == 1
        assert set(member[start[n] : start[n + 1]]) == set(np.flatnonzero((tri == vertices[0]).any(axis=1)))


def test_every_corner_lists_its_triangle():
    rest, tri = cube()
    corner, start, member = smooth_corners(tri, rest, 50.0)
    for k, corners in enumerate(corner):
        for n in corners:
            assert k in member[start[n] : start[n + 1]]
