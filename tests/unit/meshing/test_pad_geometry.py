"""The pad of CatchTheObject: counts, volumes, symmetry, chamber, quality."""

import numpy as np
import pytest

from softwarp import meshing

COUNTS = [("coarse", 100, 288, 96), ("medium", 452, 1344, 448), ("fine", 1446, 5760, 960)]


def frustum(wide, narrow, height):
    """Volume between two squares with the given edges."""
    return height / 3.0 * (wide**2 + narrow**2 + wide * narrow)


@pytest.mark.parametrize(("resolution", "nodes", "tets", "triangles"), COUNTS)
def test_counts_and_volumes(resolution, nodes, tets, triangles):
    """The chamber holds 32.01 cm^3 and the walls are what is left of the outer frustum, on every mesh."""
    pad = meshing.pad(resolution)
    mesh, chamber = pad.mesh, frustum(0.056, 0.028, 0.0175)
    meshing.check_tets(mesh.nodes, mesh.tets, name=mesh.name)
    assert (len(mesh.nodes), len(mesh.tets), len(pad.cavity_triangles)) == (nodes, tets, triangles)
    np.testing.assert_allclose(chamber, 32.01e-6, rtol=1e-3)
    np.testing.assert_allclose(meshing.surface_volume(pad.cavity_vertices, pad.cavity_triangles), chamber, rtol=1e-12)
    np.testing.assert_allclose(mesh.volume, frustum(0.070, 0.042, 0.028) - chamber, rtol=1e-12)
    np.testing.assert_allclose(mesh.nodes.min(axis=0), [-0.035, -0.035, -0.028], atol=1e-15)
    np.testing.assert_allclose(mesh.nodes.max(axis=0), [0.035, 0.035, 0.0], atol=1e-15)


@pytest.mark.parametrize("resolution", ["coarse", "medium", "fine"])
def test_chamber_is_the_void_of_the_mesh(resolution):
    """Every vertex of the chamber is a node, and its triangles are those of the inner surface, turned over."""
    pad = meshing.pad(resolution)
    at = {tuple(x): i for i, x in enumerate(pad.mesh.nodes.round(12).tolist())}
    number = np.array([at[tuple(x)] for x in pad.cavity_vertices.round(12).tolist()])
    surface = {frozenset(t) for t in meshing.tet_surface(pad.mesh.tets).tolist()}
    assert {frozenset(t) for t in number[pad.cavity_triangles].tolist()} <= surface
    closed = meshing.check_closed(pad.cavity_vertices, pad.cavity_triangles)
    np.testing.assert_array_equal(closed, pad.cavity_triangles)  # outward as it is


@pytest.mark.parametrize("turn", [[1, 0, 2, -1, 1], [0, 1, 2, -1, 1], [0, 1, 2, 1, -1], [1, 0, 2, 1, 1]])
@pytest.mark.parametrize("resolution", ["coarse", "medium"])
def test_symmetric_tets_included(resolution, turn):
    """Quarter turn and mirrors map tetrahedra to tetrahedra."""
    mesh = meshing.pad(resolution).mesh
    moved = mesh.nodes[:, turn[:3]] * [turn[3], turn[4], 1.0]
    at = {tuple(x): i for i, x in enumerate((mesh.nodes + 0.0).round(9).tolist())}
    image = np.array([at[tuple(x)] for x in (moved + 0.0).round(9).tolist()])
    before = {frozenset(t) for t in mesh.tets.tolist()}
    assert {frozenset(t) for t in image[mesh.tets].tolist()} == before


def test_quality():
    """No sliver: the worst dihedral angle is that of the thin front's wedge in the corner."""
    for resolution, angle in (("coarse", 6.0), ("medium", 10.0), ("fine", 10.0)):
        mesh = meshing.pad(resolution).mesh
        assert meshing.min_dihedral(mesh.nodes, mesh.tets).min() > angle
        assert meshing.radius_ratio(mesh.nodes, mesh.tets).min() > 0.05


def test_unknown_resolution():
    with pytest.raises(
        meshing.MeshError, match="unknown resolution 'corse'; known: coarse, medium, fine; did you mean"
    ):
        meshing.pad("corse")
