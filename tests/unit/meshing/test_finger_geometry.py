"""The gripper's finger: counts, box, volumes of silicone and air, symmetry, cavities, quality; the figurine."""

import numpy as np
import pytest

from softwarp import meshing, shapes
from softwarp.meshing import finger_geometry as geometry

COUNTS = [
    ("coarse", "cavities", 504, 1692),
    ("medium", "cavities", 3141, 13536),
    ("coarse", "plain", 168, 468),
    ("medium", "plain", 945, 3744),
]
AIR = 713.2e-9  # m^3, a cavity of SofaGym's finger
LOW, HIGH = [-0.0345, -0.0195, -0.0118], [0.0865, 0.003, 0.0118]  # m, its box


@pytest.mark.parametrize(("resolution", "kind", "nodes", "tets"), COUNTS)
def test_counts_and_box(resolution, kind, nodes, tets):
    """The published finger's box; the plain one has no bellows that stick out sideways."""
    mesh = meshing.finger(resolution, kind).mesh
    meshing.check_tets(mesh.nodes, mesh.tets, name=mesh.name)
    assert (len(mesh.nodes), len(mesh.tets)) == (nodes, tets)
    side = HIGH[2] if kind == "cavities" else geometry.HALF_WIDTH
    np.testing.assert_allclose(mesh.nodes.min(axis=0), [*LOW[:2], -side], atol=1e-15)
    np.testing.assert_allclose(mesh.nodes.max(axis=0), [*HIGH[:2], side], atol=1e-15)


@pytest.mark.parametrize("resolution", ["coarse", "medium", "fine"])
def test_volumes(resolution):
    """Each cavity holds what the published one holds, within 0.5 %; finer meshes differ in facets alone."""
    finger = meshing.finger(resolution)
    for vertices, triangles in finger.cavities:
        np.testing.assert_allclose(meshing.surface_volume(vertices, triangles), AIR, rtol=5e-3)
    np.testing.assert_allclose(finger.mesh.volume, meshing.finger("coarse").mesh.volume, rtol=2e-4)
    assert 0.9 < finger.mesh.volume / 32879e-9 < 1.0  # the published finger's silicone


@pytest.mark.parametrize("resolution", ["coarse", "medium"])
def test_cavities_are_the_voids_of_the_mesh(resolution):
    """Boundary watertight: an outer surface and four cavities, whose triangles are the mesh's, turned over."""
    finger = meshing.finger(resolution)
    mesh = finger.mesh
    assert len(meshing.voids(mesh.nodes, mesh.tets)) == len(finger.cavities) == 4
    at = {tuple(x): i for i, x in enumerate((mesh.nodes + 0.0).round(12).tolist())}
    surface = meshing.tet_surface(mesh.tets)
    part = meshing.surface_parts(surface)
    for number in np.unique(part):
        meshing.check_closed(*meshing.compact(mesh.nodes, surface[part == number]), name=mesh.name)
    faces = {frozenset(t) for t in surface.tolist()}
    middles = []
    for vertices, triangles in finger.cavities:
        node = np.array([at[tuple(x)] for x in (vertices + 0.0).round(12).tolist()])
        assert {frozenset(t) for t in node[triangles].tolist()} <= faces
        np.testing.assert_array_equal(meshing.check_closed(vertices, triangles), triangles)  # outward as it is
        middles.append(vertices.mean(axis=0))
    order = [(joint, side) for joint in geometry.JOINTS for side in (-1.0, 1.0)]
    for (joint, side), middle in zip(order, middles, strict=True):
        assert abs(middle[0] - joint) < 1e-3
        assert middle[2] * side > 0.002


@pytest.mark.parametrize(("resolution", "kind", "nodes", "tets"), COUNTS)
def test_symmetric_tets_included(resolution, kind, nodes, tets):
    """The mirror z = 0 maps tetrahedra to tetrahedra."""
    mesh = meshing.finger(resolution, kind).mesh
    at = {tuple(x): i for i, x in enumerate((mesh.nodes + 0.0).round(9).tolist())}
    image = np.array([at[tuple(x)] for x in (mesh.nodes * [1.0, 1.0, -1.0] + 0.0).round(9).tolist()])
    assert {frozenset(t) for t in image[mesh.tets].tolist()} == {frozenset(t) for t in mesh.tets.tolist()}


@pytest.mark.parametrize("kind", ["cavities", "plain"])
def test_cable_tip_and_base(kind):
    """The cable runs inside the phalanges and leaves through the base; tip and base are where they should be."""
    finger = meshing.finger("coarse", kind)
    mesh = finger.mesh
    tets, weights = meshing.embed(mesh.nodes, mesh.tets, finger.cable, name="cable")
    np.testing.assert_allclose((mesh.nodes[mesh.tets[tets]] * weights[..., None]).sum(axis=1), finger.cable, atol=1e-9)
    np.testing.assert_allclose(finger.pull_point, [-0.040, -0.011, 0.0])
    np.testing.assert_allclose(mesh.nodes[finger.tip, :2], [[0.0865, 0.003]] * len(finger.tip), atol=1e-12)
    assert (np.diff(mesh.nodes[finger.tip, 2]) > 0.0).all()
    assert mesh.nodes[finger.base, 0].max() <= -0.0305 + 1e-12


def test_quality():
    """No sliver; the published mesh has a radius ratio of 0.008 and an angle of 3.1 degrees at worst."""
    for resolution, angle in (("coarse", 5.5), ("medium", 4.0)):
        mesh = meshing.finger(resolution).mesh
        assert meshing.radius_ratio(mesh.nodes, mesh.tets).min() > 0.035
        assert meshing.min_dihedral(mesh.nodes, mesh.tets).min() > angle


def test_unknown_names():
    with pytest.raises(meshing.MeshError, match="unknown resolution 'corse'; known: coarse, medium, fine; did you"):
        meshing.finger("corse")
    with pytest.raises(meshing.MeshError, match="unknown kind 'plane'; known: cavities, plain; did you mean"):
        meshing.finger(kind="plane")


@pytest.mark.parametrize("width", [0.04, 0.02])
def test_figurine_is_a_solid_that_stands(width):
    """Closed, not convex, with a flat foot of its width under its centre of mass."""
    surface = meshing.figurine(width)
    solid = shapes.Mesh(surface.nodes, surface.triangles)
    assert solid.convex is False
    foot = surface.nodes[surface.nodes[:, 2] < 1e-12]
    np.testing.assert_allclose(np.ptp(foot, axis=0)[:2], width, rtol=1e-12)
    assert np.hypot(*solid.inertia(density=1000.0).centre[:2]) < 0.1 * width
    filled = meshing.tetrahedralize(surface, edge_length=0.15 * width)  # refuses a surface that cuts itself
    np.testing.assert_allclose(filled.volume, meshing.surface_volume(surface.nodes, surface.triangles), rtol=0.1)


def test_figurine_without_width():
    with pytest.raises(meshing.MeshError, match=r"width \[m\] must be"):
        meshing.figurine(0.0)


def test_bricks_are_the_finger_in_hexahedra():
    """Box, volume and cavities of the tetrahedra, its own mirror image, moduli too; its flange and cable."""
    made, tets = meshing.finger_bricks(), meshing.finger()
    mesh = made.mesh
    assert (len(mesh.nodes), len(mesh.hexes)) == (432, 231)
    np.testing.assert_allclose(mesh.nodes.min(axis=0), LOW, atol=1e-15)
    np.testing.assert_allclose(mesh.nodes.max(axis=0), HIGH, atol=1e-15)
    np.testing.assert_allclose(mesh.volume, tets.mesh.volume, rtol=1e-4)
    for mine, theirs in zip(made.cavities, tets.cavities, strict=True):
        np.testing.assert_allclose(mine[0].mean(axis=0), theirs[0].mean(axis=0), atol=5e-4)
        np.testing.assert_allclose(meshing.surface_volume(*mine), AIR, rtol=5e-3)
    middles = mesh.nodes[mesh.hexes].mean(axis=1)
    image = [np.argmin(np.linalg.norm(middles - m, axis=1)) for m in middles * [1.0, 1.0, -1.0]]
    np.testing.assert_allclose(middles[image] * [1.0, 1.0, -1.0], middles, atol=1e-12)
    np.testing.assert_array_equal(made.stiffness[image], made.stiffness)
    assert made.stiffness.min() > 0.1 and len(np.unique(made.regions)) == 25
    assert len(made.base) == 48 and len(made.tip) == 6
    np.testing.assert_array_equal(made.cable, tets.cable)
