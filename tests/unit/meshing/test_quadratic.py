import numpy as np
import pytest

from softwarp import meshing
from softwarp.meshing import MeshError, quadratic
from tests import cases, pneumatic_cases

INNER, OUTER = 0.01, 0.02  # m


def on_spheres(points: np.ndarray) -> np.ndarray:
    """Points within 5 % of the inner or outer sphere go onto it, the others stay."""
    size = np.linalg.norm(points, axis=1, keepdims=True)
    for radius in (INNER, OUTER):
        points = np.where(np.abs(size - radius) < 0.05 * radius, points * radius / size, points)
    return points


def test_elevated_box():
    """Nodes of the linear mesh keep their numbers; the new ones are the middles of all edges, once each."""
    mesh = meshing.box((0.3, 0.2, 0.1), (3, 2, 2))
    high = meshing.elevate(mesh)
    np.testing.assert_array_equal(high.nodes[: len(mesh.nodes)], mesh.nodes)
    np.testing.assert_array_equal(high.elements[:, :4], mesh.tets)
    edges = np.unique(np.sort(mesh.tets[:, quadratic.EDGES], axis=2).reshape(-1, 2), axis=0)
    assert len(high.nodes) == len(mesh.nodes) + len(edges)
    for a, (i, j) in enumerate(quadratic.EDGES):
        middle = 0.5 * (mesh.nodes[mesh.tets[:, i]] + mesh.nodes[mesh.tets[:, j]])
        np.testing.assert_allclose(high.nodes[high.elements[:, 4 + a]], middle, atol=1e-16)
    assert high.volume == pytest.approx(mesh.volume, rel=1e-13)


def test_linear_pieces(rng):
    """Eight tetrahedra of an eighth of the volume each; a face falls into four triangles between its six nodes."""
    mesh = cases.jittered(meshing.box((0.3, 0.2, 0.2), (3, 2, 2)), 0.02, rng)
    high = meshing.elevate(mesh)
    pieces = high.linear()
    np.testing.assert_allclose(pieces.tet_volumes.reshape(-1, 8), mesh.tet_volumes[:, None] / 8.0 * np.ones(8))
    outer, skin = mesh.surface(), pieces.surface()
    assert len(skin) == 4 * len(outer)
    assert meshing.surface_volume(high.nodes, skin) == pytest.approx(mesh.volume, rel=1e-12)
    assert np.isin(outer, skin).all()


def test_derivatives(rng):
    """Gradient weights reproduce linear fields; shape functions are 1 at their node and 0 at the others."""
    mesh = cases.jittered(meshing.box((0.3, 0.2, 0.2), (2, 2, 2)), 0.02, rng)
    high = meshing.elevate(mesh)
    field = high.nodes @ rng.standard_normal((3, 3))
    y = quadratic.point_corners(field, high.elements)
    corner = field[mesh.tets][:, None]
    np.testing.assert_allclose(
        y[:, :, 1:] - y[:, :, :1], (corner[:, :, 1:] - corner[:, :, :1]).repeat(4, 1), atol=1e-14
    )
    L = [*np.eye(4), *(0.5 * np.eye(4)[quadratic.EDGES].sum(axis=1))]
    np.testing.assert_allclose([quadratic._shapes(point) for point in L], np.eye(10), atol=1e-15)


def test_products_and_lumped_volumes():
    """Straight elements: row sums -1/20 and 1/5, lumped 1/36 and 4/27 of the volume; integral of N_0^2 is V / 70."""
    high = meshing.elevate(meshing.box((0.3, 0.2, 0.1), (1, 1, 1)))
    products = quadratic.shape_products(high.nodes, high.elements)
    volume = products.sum(axis=(1, 2))[:, None]
    np.testing.assert_allclose(volume[:, 0], 0.3 * 0.2 * 0.1 / 6.0)
    rows = products.sum(axis=2) / volume
    np.testing.assert_allclose(rows, np.tile([-0.05] * 4 + [0.2] * 6, (6, 1)), rtol=1e-12)
    np.testing.assert_allclose(quadratic.lumped(products) / volume, np.tile([1 / 36] * 4 + [4 / 27] * 6, (6, 1)))
    np.testing.assert_allclose(products[:, 0, 0], volume[:, 0] / 70.0)


def test_projected_nodes_follow_spheres():
    """Octant of a shell: 96 % of the faceted mesh's error in the volume goes; inner and plane nodes stay."""
    mesh = pneumatic_cases.sphere_octant(4, 3, INNER, OUTER).mesh
    exact = np.pi / 6.0 * (OUTER**3 - INNER**3)
    straight, curved = meshing.elevate(mesh), meshing.elevate(mesh, project=on_spheres)
    assert abs(curved.volume - exact) < 0.04 * abs(straight.volume - exact)
    moved = np.abs(curved.nodes - straight.nodes).max(axis=1) > 0.0
    size = np.linalg.norm(curved.nodes[moved], axis=1)
    np.testing.assert_allclose(np.minimum(np.abs(size - INNER), np.abs(size - OUTER)), 0.0, atol=1e-15)
    assert np.isin(np.flatnonzero(moved), np.unique(curved.linear().surface())).all()


def test_broken_meshes_are_refused():
    """Wrong shapes, shared edge nodes, corners as edge nodes, and edges that curve too far."""
    high = meshing.elevate(meshing.box((1.0, 1.0, 1.0), (1, 1, 1)))
    with pytest.raises(MeshError, match=r"quadratic elements must be integers of shape \(element, 10\)"):
        meshing.QuadraticMesh(high.nodes, high.elements[:, :4])
    with pytest.raises(MeshError, match="tets are missing"):
        meshing.elevate(high.nodes)
    own = high.nodes[high.elements[0, 4]]
    twice = high.elements.copy()
    twice[0, 4] = len(high.nodes)
    with pytest.raises(MeshError, match="coincide"):
        meshing.QuadraticMesh(np.vstack([high.nodes, own]), twice)
    with pytest.raises(MeshError, match="joined inconsistently"):
        meshing.QuadraticMesh(np.vstack([high.nodes, own + 0.01]), twice)
    with pytest.raises(MeshError, match=r"inverted|folds|flat"):
        meshing.elevate(meshing.box((1.0, 1.0, 1.0), (1, 1, 1)), project=lambda x: 0.5 + 0.05 * (x - 0.5))
    bent = high.nodes.copy()
    bent[high.elements[0, 4]] += 0.3 * (high.nodes[high.elements[0, 1]] - high.nodes[high.elements[0, 0]])
    with pytest.raises(MeshError, match="element 0 folds"):
        meshing.QuadraticMesh(bent, high.elements)
