"""The generated cup: size, quality, a skin that lies on it; and the points that the trunk touches with."""

import numpy as np
import pytest

from softwarp import meshing
from softwarp.meshing import MeshError
from softwarp.meshing.cup_geometry import BOTTOM_RADIUS, HEIGHT, RIM_RADIUS, WALL
from softwarp.meshing.trunk_geometry import BASE_RADIUS, CLAMP, LENGTH, TIP_RADIUS

REFERENCE_VOLUME = 28_165e-9  # m^3, of the published mesh: 1255 nodes, 3800 tetrahedra
RESOLUTIONS = ("coarse", "medium", "fine")


@pytest.fixture(scope="module", params=RESOLUTIONS)
def cup(request):
    return meshing.cup(request.param)


@pytest.mark.parametrize(
    ("resolution", "nodes", "tets"), [("coarse", 354, 1008), ("medium", 418, 1200), ("fine", 1218, 3552)]
)
def test_counts_and_volume(resolution, nodes, tets):
    mesh = meshing.cup(resolution).mesh
    assert (len(mesh.nodes), len(mesh.tets)) == (nodes, tets)
    assert mesh.volume == pytest.approx(REFERENCE_VOLUME, rel=0.02)
    assert mesh.name == f"cup {resolution}"


def test_volume_approaches_that_of_the_solid_of_revolution():
    """Frustum less frustum, plus the bottom inside; inscribed polygons lose sin(a)/a of it, a = 2 pi / corners."""

    def frustum(low, high, height):
        return np.pi * height / 3.0 * (low**2 + low * high + high**2)

    slope = (RIM_RADIUS - BOTTOM_RADIUS) / HEIGHT
    across = WALL * np.hypot(1.0, slope)
    inner = frustum(BOTTOM_RADIUS + slope * WALL - across, RIM_RADIUS - across, HEIGHT - WALL)
    exact = frustum(BOTTOM_RADIUS, RIM_RADIUS, HEIGHT) - inner
    for resolution, corners in (("coarse", 16), ("fine", 32)):
        angle = 2.0 * np.pi / corners
        assert meshing.cup(resolution).mesh.volume == pytest.approx(exact * np.sin(angle) / angle, rel=1e-9)


def test_bounds_are_those_of_the_published_mesh(cup):
    """Box [-34.97, 34.97] x [-35.0, 34.9] x [0, 78.58] mm there."""
    np.testing.assert_allclose(cup.mesh.bounds, [[-0.035, -0.035, 0.0], [0.035, 0.035, 0.0786]], atol=1e-12)


def test_quality(cup):
    meshing.check_tets(cup.mesh.nodes, cup.mesh.tets)
    assert meshing.radius_ratio(cup.mesh.nodes, cup.mesh.tets).min() > 0.2
    assert meshing.min_dihedral(cup.mesh.nodes, cup.mesh.tets).min() > 7.0


def test_surface_is_one_sphere(cup):
    """Closed, and V - E + F = 2: a cup has no hole."""
    triangles = cup.mesh.surface()
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    distinct, uses = np.unique(edges, axis=0, return_counts=True)
    assert (uses == 2).all()
    assert len(np.unique(triangles)) - len(distinct) + len(triangles) == 2
    assert meshing.surface_volume(cup.mesh.nodes, triangles) == pytest.approx(cup.mesh.volume, rel=1e-10)


def test_skin_is_the_boundary(cup):
    """Closed, of nodes of the mesh, around the same volume, inside and rim included."""
    nodes, triangles = cup.skin.nodes, cup.skin.triangles
    known = {tuple(node) for node in cup.mesh.nodes}
    assert all(tuple(point) in known for point in nodes)
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    assert meshing.surface_volume(nodes, triangles) == pytest.approx(cup.mesh.volume, rel=1e-4)
    radius = np.hypot(nodes[:, 0], nodes[:, 1])
    assert radius[nodes[:, 2] == nodes[:, 2].max()].max() == pytest.approx(RIM_RADIUS)
    assert radius[nodes[:, 2] == 0.0].max() == pytest.approx(BOTTOM_RADIUS)


def test_skin_has_every_layer_of_the_wall(cup):
    """Walls that are folded anywhere touch as they are: what is bridged is all in the bottom."""
    known = {tuple(point) for point in cup.skin.nodes}
    boundary = cup.mesh.nodes[np.unique(cup.mesh.surface())]
    bridged = [node for node in boundary if tuple(node) not in known]
    assert 0 < len(bridged) < 0.1 * len(boundary)
    assert max(z for _, _, z in bridged) <= WALL


def test_unknown_resolution():
    with pytest.raises(MeshError, match="did you mean 'fine'"):
        meshing.cup("finest")


@pytest.mark.parametrize("resolution", RESOLUTIONS)
def test_skin_of_the_trunk(resolution):
    """Twenty-two rings of eight on the taper, closed; every trunk has their points on its boundary."""
    skin = meshing.trunk_skin()
    points, rings = skin.nodes, skin.nodes[:-2]
    assert len(rings) == 22 * 8
    radius = np.hypot(rings[:, 0], rings[:, 1])
    np.testing.assert_allclose(radius, BASE_RADIUS + (TIP_RADIUS - BASE_RADIUS) * rings[:, 2] / LENGTH, atol=1e-12)
    assert rings[:, 2].min() == 0.0 and rings[:, 2].max() == LENGTH and CLAMP in rings[:, 2]
    assert (np.diff(rings[::8, 2]) > 0.0).all()
    edges = np.sort(skin.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    mesh = meshing.trunk(resolution)
    volume = np.sqrt(8.0) / 3.0 * (BASE_RADIUS**2 + BASE_RADIUS * TIP_RADIUS + TIP_RADIUS**2) * LENGTH
    assert meshing.surface_volume(points, skin.triangles) == pytest.approx(volume, rel=1e-12)
    tet, weight = meshing.embed(mesh.nodes, mesh.tets, points, name="skin", snap=1e-6)
    carried = np.einsum("pk,pkx->px", weight, mesh.nodes[mesh.tets[tet]])
    assert np.linalg.norm(carried - points, axis=1).max() < 1e-12
