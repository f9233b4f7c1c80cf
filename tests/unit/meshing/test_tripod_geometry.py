"""The generated tripod: size, symmetry, quality, and nodes where arms and plate hold it."""

import math

import numpy as np
import pytest

from softwarp import meshing
from softwarp.meshing import MeshError
from softwarp.meshing.tripod_geometry import DETAILS, HELD, HOLE_RADIUS, REACH, SIDE, THICKNESS, WIDTH

RESOLUTIONS = ("coarse", "medium", "fine")


@pytest.fixture(scope="module", params=RESOLUTIONS)
def tripod(request):
    return meshing.tripod(request.param)


@pytest.mark.parametrize(
    ("resolution", "nodes", "tets"), [("coarse", 228, 504), ("medium", 864, 2808), ("fine", 2736, 10800)]
)
def test_counts_and_volume(resolution, nodes, tets):
    """Triangle and three legs less a hole with 3 n corners; the published meshes, hold 0.1 % more."""
    mesh = meshing.tripod(resolution)
    assert (len(mesh.nodes), len(mesh.tets)) == (nodes, tets)
    corners = 3 * DETAILS[resolution][0]
    hole = 0.5 * corners * HOLE_RADIUS**2 * math.sin(2.0 * math.pi / corners)
    area = 0.25 * math.sqrt(3.0) * WIDTH**2 + 3.0 * WIDTH * (REACH - SIDE)
    assert mesh.volume == pytest.approx(THICKNESS * (area - hole), rel=1e-12)
    assert mesh.volume == pytest.approx(22_447.9e-9, rel=0.002)
    assert mesh.name == f"tripod {resolution}"


def test_bounds_are_those_of_the_published_mesh(tripod):
    """Box [-55.131, 55.131] x [-55, 40.490] x [0, 5] mm there, its leg along -y."""
    np.testing.assert_allclose(1e3 * tripod.bounds, [[-55.1314, -40.4904, -5.0], [55.1314, 55.0, 0.0]], atol=1e-4)


def test_surface_is_closed_with_one_hole(tripod):
    """V - E + F = 0: one handle."""
    triangles = tripod.surface()
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    distinct, uses = np.unique(edges, axis=0, return_counts=True)
    assert (uses == 2).all()
    assert len(np.unique(triangles)) - len(distinct) + len(triangles) == 0


@pytest.mark.parametrize("image", ["third", "mirror"])
def test_mesh_is_symmetric_tets_included(tripod, image):
    """The map permutes the nodes, and the permuted tetrahedra are the tetrahedra."""
    cos, sin = -0.5, math.sqrt(0.75)
    third = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    images = tripod.nodes @ (third if image == "third" else np.diag([-1.0, 1.0, 1.0])).T
    apart = np.linalg.norm(images[:, None] - tripod.nodes[None], axis=-1)
    permuted = apart.argmin(axis=1)
    assert apart.min(axis=1).max() < 1e-9
    mapped = {tuple(t) for t in np.sort(permuted[tripod.tets], axis=1).tolist()}
    assert mapped == {tuple(t) for t in np.sort(tripod.tets, axis=1).tolist()}


def test_quality(tripod):
    """The flattest elements are the thin ones of the medium mesh."""
    assert meshing.radius_ratio(tripod.nodes, tripod.tets).min() > 0.14
    assert meshing.min_dihedral(tripod.nodes, tripod.tets).min() > 7.0


def test_legs_are_held_from_the_same_line_on(tripod):
    """The first line of nodes beyond 45 mm is at 47.3 mm in all resolutions, as in the published coarse mesh."""
    along = tripod.nodes[np.abs(tripod.nodes[:, 0]) <= 0.5 * WIDTH + 1e-9, 1]
    assert along[along >= 0.045].min() == pytest.approx(HELD, abs=1e-9)


def test_bricks_are_symmetric_and_held_from_the_same_line_on():
    """One layer of the coarse mesh's outline; a third of a turn and the mirror permute nodes and hexahedra."""
    bricks = meshing.tripod_bricks()
    assert bricks.volume == pytest.approx(meshing.tripod("coarse").volume, rel=1e-12)
    assert bricks.hexes.shape == (96, 8)
    cos, sin = -0.5, math.sqrt(0.75)
    third = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    for image in (third, np.diag([-1.0, 1.0, 1.0])):
        apart = np.linalg.norm((bricks.nodes @ image.T)[:, None] - bricks.nodes[None], axis=-1)
        assert apart.min(axis=1).max() < 1e-9
        mapped = {tuple(h) for h in np.sort(apart.argmin(axis=1)[bricks.hexes], axis=1).tolist()}
        assert mapped == {tuple(h) for h in np.sort(bricks.hexes, axis=1).tolist()}
    along = bricks.nodes[np.abs(bricks.nodes[:, 0]) <= 0.5 * WIDTH + 1e-9, 1]
    assert along[along >= 0.045].min() == pytest.approx(HELD, abs=1e-9)


def test_unknown_resolution():
    """The message lists those that there are."""
    with pytest.raises(MeshError, match="known: coarse, medium, fine; did you mean 'coarse'"):
        meshing.tripod("corse")
