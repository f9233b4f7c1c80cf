"""Boxes, checks, repairs, surfaces and quality of tetrahedral meshes."""

import itertools

import numpy as np
import pytest

from softwarp import meshing
from softwarp.meshing import MeshError, SurfaceMesh, TetMesh

CORNER = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
REGULAR = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
ONE = np.array([[0, 1, 2, 3]])


def enclosed_volume(nodes: np.ndarray, triangles: np.ndarray) -> float:
    """Divergence theorem: the sum of a . (b x c) / 6 over outward triangles."""
    a, b, c = np.moveaxis(nodes[triangles], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def assert_closed(triangles: np.ndarray) -> None:
    """Every edge is walked once in each direction."""
    walked = [tuple(edge) for t in triangles.tolist() for edge in zip(t, [t[1], t[2], t[0]], strict=True)]
    assert len(set(walked)) == len(walked)
    assert set(walked) == {(b, a) for a, b in walked}


def test_box_nodes_lie_where_the_catalogue_says():
    """Node i + (nx + 1)(j + (ny + 1) k) at (i Lx / nx, j Ly / ny, k Lz / nz)."""
    (nx, ny, nz), size = (3, 2, 4), np.array([0.6, 0.2, 1.2])
    mesh = meshing.box(size, (nx, ny, nz))
    assert mesh.nodes.shape == ((nx + 1) * (ny + 1) * (nz + 1), 3)
    for i, j, k in itertools.product(range(nx + 1), range(ny + 1), range(nz + 1)):
        expected = np.array([i, j, k]) * size / [nx, ny, nz]
        np.testing.assert_allclose(mesh.nodes[i + (nx + 1) * (j + (ny + 1) * k)], expected, rtol=1e-14, atol=0)


def test_box_cell_is_walked_along_every_order_of_the_axes():
    """One tetrahedron (v, v + e_p, v + e_p + e_q, v + e_p + e_q + e_r) per permutation; middle two swapped if odd."""
    mesh = meshing.box((1.0, 1.0, 1.0), (1, 1, 1))
    expected = set()
    for order in itertools.permutations(range(3)):
        path = [0, 2 ** order[0], 2 ** order[0] + 2 ** order[1], 7]
        if order in {(0, 2, 1), (1, 0, 2), (2, 1, 0)}:
            path[1], path[2] = path[2], path[1]
        expected.add(tuple(path))
    assert {tuple(t) for t in mesh.tets.tolist()} == expected


def test_box_fills_its_volume_with_equal_positive_tets():
    mesh = meshing.box((0.3, 0.2, 0.1), (3, 2, 1))
    assert mesh.tets.shape == (36, 4)
    assert mesh.tets.dtype == np.int32
    assert mesh.nodes.dtype == np.float64
    np.testing.assert_allclose(mesh.tet_volumes, 0.006 / 36, rtol=1e-12)
    assert mesh.volume == pytest.approx(0.006, rel=1e-12)
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [0.3, 0.2, 0.1]], rtol=1e-14)


@pytest.mark.parametrize("size", [(1.0, 0.0, 1.0), (1.0, -1.0, 1.0), (1.0, np.nan, 1.0), (1.0, 1.0)])
def test_box_refuses_sizes(size):
    with pytest.raises(MeshError, match="size must be three positive lengths"):
        meshing.box(size, (1, 1, 1))


@pytest.mark.parametrize("cells", [(0, 1, 1), (1, 1), (1.5, 1, 1)])
def test_box_refuses_cells(cells):
    with pytest.raises(MeshError, match="cells must be three integers"):
        meshing.box((1.0, 1.0, 1.0), cells)


def test_surface_is_closed_outward_and_encloses_the_volume():
    """A box of n = (3, 2, 4) cells has 4 (nx ny + ny nz + nz nx) boundary triangles."""
    mesh = meshing.box((0.3, 0.2, 0.4), (3, 2, 4))
    triangles = mesh.surface()
    assert triangles.shape == (4 * (6 + 8 + 12), 3)
    assert triangles.dtype == np.int32
    assert_closed(triangles)
    assert enclosed_volume(mesh.nodes, triangles) == pytest.approx(mesh.volume, rel=1e-12)


def test_surface_of_one_tet_is_its_four_faces_outward():
    triangles = meshing.tet_surface(ONE)
    assert_closed(triangles)
    assert enclosed_volume(CORNER, triangles) == pytest.approx(1.0 / 6.0)


def test_quality_of_a_regular_tet_is_one_and_its_angle_arccos_a_third():
    tets = meshing.orient(REGULAR, ONE)
    np.testing.assert_allclose(meshing.radius_ratio(REGULAR, tets), 1.0, rtol=1e-12)
    np.testing.assert_allclose(meshing.min_dihedral(REGULAR, tets), np.degrees(np.arccos(1.0 / 3.0)), rtol=1e-12)


def test_quality_of_a_cube_corner():
    """Inscribed radius (3 - sqrt 3) / 6, circumscribed sqrt 3 / 2; slanted face to the others: arccos(1 / sqrt 3)."""
    ratio = 3.0 * ((3.0 - np.sqrt(3.0)) / 6.0) / (np.sqrt(3.0) / 2.0)
    np.testing.assert_allclose(meshing.radius_ratio(CORNER, ONE), ratio, rtol=1e-12)
    np.testing.assert_allclose(meshing.min_dihedral(CORNER, ONE), np.degrees(np.arccos(1.0 / np.sqrt(3.0))), rtol=1e-12)


@pytest.mark.parametrize(
    ("nodes", "tets", "message"),
    [
        (CORNER, np.zeros((0, 4), dtype=int), "holds no tetrahedron"),
        (CORNER, [[0, 1, 2]], r"shape \(tetrahedron, 4\), got \(1, 3\)"),
        (CORNER, [[0.0, 1.0, 2.0, 3.0]], "must be integers, got float64"),
        (CORNER[:, :2], ONE, r"shape \(node, 3\)"),
        (np.array([["a", "b", "c"]]), ONE, r"shape \(node, 3\)"),
        (np.where(CORNER == 1.0, np.nan, CORNER), ONE, "3 nodes are not finite .first: 1, 2, 3"),
        (np.where(CORNER == 1.0, np.inf, CORNER), ONE, "3 nodes are not finite"),
        (CORNER, [[0, 1, 2, 4]], "name a missing node .first: row 0, corners .*count from 0 to 3"),
        (CORNER, [[0, 1, 2, -1]], "name a missing node"),
        (CORNER, [[0, 1, 2, 2]], "name a node twice"),
        (np.vstack([CORNER, [[5.0, 5.0, 5.0]]]), ONE, "1 of 5 nodes belong to no tetrahedron .first: 4.*compact"),
        (CORNER, [[0, 2, 1, 3]], "1 of 1 tetrahedra are inverted.*orient"),
        (CORNER * [1.0, 1.0, 5e-9], ONE, "1 of 1 tetrahedra are flat"),
        (CORNER, [[0, 1, 2, 3], [1, 2, 0, 3]], "1 tetrahedron rows repeat the corners of another .first: 1"),
    ],
)
def test_check_refuses(nodes, tets, message):
    with pytest.raises(MeshError, match=message) as refusal:
        meshing.check_tets(nodes, tets, name="lump")
    assert "'lump'" in str(refusal.value)


def test_check_refuses_coincident_nodes_and_weld_joins_them():
    """Two tetrahedra on one face, given with six nodes of their own, weld to five."""
    nodes = np.vstack([CORNER, CORNER[[0, 1, 2]], [[0.0, 0.0, -1.0]]])
    nodes[4] += 1e-11
    tets = np.array([[0, 1, 2, 3], [4, 6, 5, 7]])
    with pytest.raises(MeshError, match=r"3 nodes coincide with another .first: 0 and 4.*weld"):
        meshing.check_tets(nodes, tets)
    welded = TetMesh(*meshing.weld(nodes, tets))
    assert welded.nodes.shape == (5, 3)
    assert len(welded.surface()) == 6
    np.testing.assert_array_equal(welded.nodes[:4], CORNER)


def test_weld_joins_chains_of_three_copies():
    nodes = np.vstack([CORNER, CORNER, CORNER])
    tets = np.array([[0, 5, 10, 3], [8, 1, 6, 11]])
    welded_nodes, welded_tets = meshing.weld(nodes, tets)
    np.testing.assert_array_equal(welded_nodes, CORNER)
    np.testing.assert_array_equal(welded_tets, [[0, 1, 2, 3], [0, 1, 2, 3]])


def test_check_refuses_three_tets_on_one_face():
    nodes = np.vstack([CORNER, [[0.0, 0.0, -1.0]], [[0.3, 0.3, 2.0]]])
    tets = np.array([[0, 1, 2, 3], [0, 2, 1, 4], [0, 1, 2, 5]])
    with pytest.raises(MeshError, match="belongs to 3 tetrahedra"):
        meshing.check_tets(nodes, tets)


def test_check_accepts_a_large_mesh_and_reports_only_the_first_few():
    mesh = meshing.box((1.0, 1.0, 1.0), (6, 6, 6))
    with pytest.raises(MeshError, match=r"1296 of 1296 tetrahedra are inverted.*first: 0, 1, 2, 3, 4, \.\.\.\)"):
        meshing.check_tets(mesh.nodes, mesh.tets[:, [0, 2, 1, 3]])


def test_orient_turns_inverted_tets_and_leaves_the_others():
    mesh = meshing.box((1.0, 1.0, 1.0), (2, 2, 2))
    tets = mesh.tets.copy()
    tets[::3] = tets[::3][:, [0, 1, 3, 2]]
    np.testing.assert_array_equal(meshing.orient(mesh.nodes, tets), mesh.tets)


def test_compact_drops_unused_nodes_and_keeps_the_order():
    nodes = np.vstack([[[9.0, 9.0, 9.0]], CORNER[:2], [[8.0, 8.0, 8.0]], CORNER[2:]])
    compacted, tets = meshing.compact(nodes, [[1, 2, 4, 5]])
    np.testing.assert_array_equal(compacted, CORNER)
    np.testing.assert_array_equal(tets, ONE)


def test_mesh_converts_types_and_checks():
    mesh = TetMesh(CORNER.astype(np.float32), ONE.astype(np.int64), "drop")
    assert (mesh.nodes.dtype, mesh.tets.dtype, mesh.name) == (np.float64, np.int32, "drop")
    with pytest.raises(MeshError, match=r"'drop'.*inverted"):
        TetMesh(CORNER, ONE[:, [1, 0, 2, 3]], "drop")


def test_surface_mesh_has_no_tets_and_says_how_to_get_them():
    mesh = SurfaceMesh(CORNER, [[0, 1, 2]], "skin")
    np.testing.assert_array_equal(mesh.bounds, [[0, 0, 0], [1, 1, 1]])
    with pytest.raises(MeshError, match=r"'skin' is a surface of 1 triangles.*mesher"):
        _ = mesh.tets
    with pytest.raises(MeshError, match="missing node"):
        SurfaceMesh(CORNER, [[0, 1, 4]])
