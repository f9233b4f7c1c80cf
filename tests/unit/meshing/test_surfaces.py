"""Closed surfaces: what is refused and in which words, orientation, parts, voids, membranes at rest."""

import numpy as np
import pytest

from softwarp import meshing
from tests import pneumatic_cases

MESH = meshing.box((0.03, 0.02, 0.01), (3, 2, 1))
VERTICES, SURFACE = meshing.compact(MESH.nodes, MESH.surface())


def test_good_surface_is_returned_as_given():
    closed = meshing.check_closed(VERTICES, SURFACE)
    np.testing.assert_array_equal(closed, SURFACE)
    np.testing.assert_allclose(meshing.surface_volume(VERTICES, closed), 6e-6, rtol=1e-12)
    np.testing.assert_allclose(meshing.triangle_areas(VERTICES, closed).sum(), 2.2e-3, rtol=1e-12)


def test_inward_surface_is_turned_over():
    closed = meshing.check_closed(VERTICES, SURFACE[:, ::-1])
    assert meshing.surface_volume(VERTICES, SURFACE[:, ::-1]) < 0.0 < meshing.surface_volume(VERTICES, closed)


def test_open_edge_is_named_with_vertices_and_positions():
    a, b = SURFACE[0, 0], SURFACE[0, 1]
    with pytest.raises(meshing.MeshError, match=r"surface 'pouch' is open: edge") as info:
        meshing.check_closed(VERTICES, SURFACE[1:], name="pouch")
    text = str(info.value)
    assert "3 such edges" in text
    assert "close the hole" in text
    edges = {f"edge {p}-{q}" for p in SURFACE[0] for q in SURFACE[0]}
    assert any(edge in text for edge in edges)
    assert any(f"({', '.join(f'{v:.6g}' for v in VERTICES[k])})" in text for k in (a, b))


def test_unwelded_triangles_are_open_and_can_be_welded():
    soup = VERTICES[SURFACE].reshape(-1, 3)
    triangles = np.arange(len(soup)).reshape(-1, 3)
    with pytest.raises(meshing.MeshError, match=r"meshing\.weld"):
        meshing.check_closed(soup, triangles)
    vertices, welded = meshing.weld(soup, triangles)
    np.testing.assert_allclose(
        meshing.surface_volume(vertices, meshing.check_closed(vertices, welded)), 6e-6, rtol=1e-12
    )


def test_branching_edge_is_named_with_its_triangles():
    wall = np.vstack([SURFACE, SURFACE[:1]])
    with pytest.raises(
        meshing.MeshError, match=rf"not a manifold: edge .* belongs to 3 triangles \[0, .*{len(SURFACE)}\]"
    ):
        meshing.check_closed(VERTICES, wall)


def test_badly_oriented_pair_is_named_and_can_be_repaired():
    wrong = SURFACE.copy()
    wrong[5] = wrong[5, ::-1]
    with pytest.raises(
        meshing.MeshError, match=r"triangles \d+ and \d+ run along edge \d+-\d+ .*same direction"
    ) as info:
        meshing.check_closed(VERTICES, wrong)
    assert " 5 " in str(info.value)
    np.testing.assert_array_equal(meshing.orient_surface(wrong), SURFACE)


def test_flat_surface_has_no_volume():
    flat = VERTICES * [1.0, 1.0, 0.0]
    with pytest.raises(meshing.MeshError, match="encloses no volume"):
        meshing.check_closed(flat, SURFACE)


def test_unused_vertex_and_bad_arrays_are_refused():
    with pytest.raises(meshing.MeshError, match=r"1 of \d+ vertices belong to no triangle"):
        meshing.check_closed(np.vstack([VERTICES, [[0.0, 0.0, 0.0]]]), SURFACE)
    with pytest.raises(meshing.MeshError, match="not finite"):
        meshing.check_closed(np.where(VERTICES > 0.029, np.nan, VERTICES), SURFACE)
    with pytest.raises(meshing.MeshError, match="missing node"):
        meshing.check_closed(VERTICES, SURFACE + 1)


def test_parts_must_agree():
    """Two equal boxes form one chamber of twice the volume; with one of them inward they are refused."""
    shifted = VERTICES + [0.1, 0.0, 0.0]
    both = np.vstack([VERTICES, shifted])
    two = np.vstack([SURFACE, SURFACE + len(VERTICES)])
    np.testing.assert_array_equal(meshing.surface_parts(two), np.repeat([0, 1], len(SURFACE)))
    np.testing.assert_allclose(meshing.surface_volume(both, meshing.check_closed(both, two)), 12e-6, rtol=1e-12)
    mixed = np.vstack([SURFACE, SURFACE[:, ::-1] + len(VERTICES)])
    with pytest.raises(meshing.MeshError, match=rf"triangle {len(SURFACE)} is inward"):
        meshing.check_closed(both, mixed)


def test_one_sided_surface_cannot_be_oriented():
    """A Moebius strip of five triangles."""
    strip = np.array([[i, (i + 1) % 5, (i + 2) % 5] for i in range(5)])
    with pytest.raises(meshing.MeshError, match="one side"):
        meshing.orient_surface(strip)


def test_void_of_the_bender():
    """Catalogue 3.3: 325 nodes, 1032 tets, a chamber of 2.5e-6 m^3."""
    case = pneumatic_cases.bender()
    assert (len(case.mesh.nodes), len(case.mesh.tets)) == (325, 1032)
    assert len(pneumatic_cases.bender(2).mesh.nodes) == 1968
    (around,) = meshing.voids(case.mesh.nodes, case.mesh.tets)
    np.testing.assert_allclose(meshing.surface_volume(case.mesh.nodes, around), 2.5e-6, rtol=1e-12)
    np.testing.assert_allclose(meshing.surface_volume(case.vertices, case.triangles), 2.5e-6, rtol=1e-12)
    assert meshing.voids(MESH.nodes, MESH.tets) == []


def test_symmetric_cases_close_through_the_axis():
    """Volumes of the faceted pieces: the octant tends to pi A^3 / 6, the quarter to pi A^2 H / 4, from below."""
    octant = [pneumatic_cases.sphere_octant(n, 2) for n in (4, 8)]
    quarter = [pneumatic_cases.cylinder_quarter(2, n, 1) for n in (4, 8)]
    for cases, exact in ((octant, np.pi * 1e-6 / 6.0), (quarter, np.pi * 1e-6 / 4.0)):
        error = [1.0 - meshing.surface_volume(c.vertices, c.triangles) / exact for c in cases]
        assert 0.0 < error[1] < 0.3 * error[0] < 0.05
    assert (octant[0].vertex_node < 0).sum() == 1
    assert (quarter[0].vertex_node < 0).sum() == 2
    for case in octant + quarter:
        normal = np.zeros_like(case.vertices)
        corner = case.vertices[case.triangles]
        area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        closing = (case.vertex_node[case.triangles] < 0).any(axis=1)
        np.add.at(normal, case.triangles[closing].ravel(), np.repeat(area[closing], 3, axis=0))
        carried = case.vertex_node >= 0
        held = case.fixed[case.vertex_node[carried]]
        assert np.abs(normal[carried][~held]).max() < 1e-18  # the closing triangles push only against supports


def test_rings_and_edges(rng):
    """Each ring gives the vertex's area vectors; each edge has two ends and two opposite corners; E = 3 T / 2."""
    x = VERTICES + 0.001 * rng.standard_normal(VERTICES.shape)
    start, ring = meshing.surface_rings(SURFACE, len(x))
    assert start[-1] == SURFACE.size
    area = np.cross(x[SURFACE[:, 1]] - x[SURFACE[:, 0]], x[SURFACE[:, 2]] - x[SURFACE[:, 0]])
    expected = np.zeros_like(x)
    np.add.at(expected, SURFACE.ravel(), np.repeat(area, 3, axis=0))
    for v in range(len(x)):
        b, c = ring[start[v] : start[v + 1]].T
        np.testing.assert_allclose(np.cross(x[b] - x[v], x[c] - x[v]).sum(axis=0), expected[v], atol=1e-18)
    ends, opposite = meshing.surface_edges(SURFACE)
    assert len(ends) == 3 * len(SURFACE) // 2
    triangles = {tuple(np.roll(t, k)) for t in SURFACE.tolist() for k in range(3)}
    for (i, j), (k, m) in zip(ends.tolist(), opposite.tolist(), strict=True):
        assert (i, j, k) in triangles
        assert (j, i, m) in triangles


def test_membrane_geometry(rng):
    """Gradients reproduce a linear field in the plane; volumes and node volumes add up."""
    sheet = meshing.membrane_geometry(VERTICES, SURFACE, 0.5e-3)
    np.testing.assert_allclose(sheet.area.sum(), 2.2e-3, rtol=1e-12)
    np.testing.assert_allclose(sheet.volume.sum(), 1.1e-6, rtol=1e-12)
    np.testing.assert_allclose(sheet.node_volume.sum(), 1.1e-6, rtol=1e-12)
    slope = rng.standard_normal(3)
    value = VERTICES @ slope
    G = sheet.gradient.reshape(-1, 2, 2)
    rise = value[SURFACE[:, 1:]] - value[SURFACE[:, :1]]
    local = np.einsum("tb,tbk->tk", rise, G)
    corner = VERTICES[SURFACE]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tangential = slope - (normal @ slope)[:, None] * normal
    np.testing.assert_allclose(np.linalg.norm(local, axis=1), np.linalg.norm(tangential, axis=1), rtol=1e-12)


def test_bad_membranes_are_refused():
    with pytest.raises(meshing.MeshError, match=r"thickness of triangle 0 is -0\.001 m"):
        meshing.membrane_geometry(VERTICES, SURFACE, -0.001, name="base")
    with pytest.raises(meshing.MeshError, match=rf"one per triangle \({len(SURFACE)}\)"):
        meshing.membrane_geometry(VERTICES, SURFACE, [0.001, 0.002])
    with pytest.raises(meshing.MeshError, match="has no area"):
        meshing.membrane_geometry([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], 0.001)
