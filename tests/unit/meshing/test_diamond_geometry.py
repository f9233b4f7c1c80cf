"""The generated diamond: size, symmetry, quality, and places for the cables."""

import numpy as np
import pytest

from softwarp import meshing
from softwarp.meshing import MeshError
from softwarp.meshing.diamond_geometry import HUB_HALF, SECTIONS, TOP_MIDDLE, coarse_stiffness, diamond_places

REFERENCE_VOLUME = 392_357e-9  # m^3, of the published mesh: 1628 nodes, 4147 tetrahedra
RESOLUTIONS = ("coarse", "medium", "fine")


@pytest.fixture(scope="module", params=RESOLUTIONS)
def diamond(request):
    return meshing.diamond(request.param)


@pytest.mark.parametrize(
    ("resolution", "nodes", "tets"), [("coarse", 348, 720), ("medium", 1770, 5760), ("fine", 4984, 19440)]
)
def test_counts_and_volume(resolution, nodes, tets):
    """The published mesh has rounded edges and a hole in its base; ours holds 2.2 % more."""
    mesh = meshing.diamond(resolution)
    assert (len(mesh.nodes), len(mesh.tets)) == (nodes, tets)
    assert mesh.volume == pytest.approx(REFERENCE_VOLUME, rel=0.03)
    assert mesh.name == f"diamond {resolution}"


def test_places_are_where_tets_lie(diamond):
    """Those of the blocks at the ends of a leg, half of them at each; in between, heights of tets rise with places."""
    resolution = diamond.name.split()[1]
    place, rows = diamond_places(resolution), len(SECTIONS) - 1
    height = diamond.nodes[diamond.tets].mean(axis=1)
    assert (height[place == 0.0, 2] < 0.0).all() and (height[place == rows, 2] > 0.1).all()
    axis = np.abs(height[:, :2]).max(axis=1)
    table = np.array(SECTIONS)
    low, high = np.floor(place).astype(int), np.minimum(np.floor(place).astype(int) + 1, rows)
    ends = np.stack([table[low], table[high]])
    is_leg = (place > 0.0) & (place < rows)
    for values, columns in ((axis, [0, 2]), (height[:, 2], [1, 3])):
        least, most = ends[..., columns].min(axis=(0, 2)), ends[..., columns].max(axis=(0, 2))
        assert ((values >= least - 1e-9) & (values <= most + 1e-9))[is_leg].all()
    assert coarse_stiffness().shape == (720,)


def test_bounds_are_those_of_the_published_mesh(diamond):
    """Box [-97.05, 97.09] x [-97.13, 97.21] x [-36.96, 125.74] mm there."""
    np.testing.assert_allclose(diamond.bounds, [[-0.0971, -0.0971, -0.037], [0.0971, 0.0971, 0.1257]], atol=1e-12)


def test_surface_has_the_holes_between_four_legs(diamond):
    """Closed, in one piece, and V - E + F = 2 - 2 * 3: four handles between two blocks make three holes."""
    triangles = diamond.surface()
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    distinct, uses = np.unique(edges, axis=0, return_counts=True)
    assert (uses == 2).all()
    assert len(np.unique(triangles)) - len(distinct) + len(triangles) == -4
    a, b, c = np.moveaxis(diamond.nodes[triangles], 1, 0)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0 == pytest.approx(diamond.volume, rel=1e-10)


@pytest.mark.parametrize(
    "turn",
    [
        np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]),  # quarter turn
        np.diag([-1, 1, 1]),
        np.diag([1, -1, 1]),
    ],
)
def test_mesh_is_symmetric_tets_included(diamond, turn):
    """The map permutes the nodes, and the permuted tetrahedra are the tetrahedra."""
    place = {tuple(key): node for node, key in enumerate(np.round(diamond.nodes * 1e8).astype(int).tolist())}
    images = np.round(diamond.nodes @ turn.T * 1e8).astype(int).tolist()
    permuted = np.array([place[tuple(key)] for key in images])
    mapped = {tuple(t) for t in np.sort(permuted[diamond.tets], axis=1)}
    assert mapped == {tuple(t) for t in np.sort(diamond.tets, axis=1)}


def test_quality(diamond):
    """Better than the published mesh, whose worst radius ratio is 0.005 and worst dihedral angle 0.3 degrees."""
    assert meshing.radius_ratio(diamond.nodes, diamond.tets).min() > 0.1
    assert meshing.min_dihedral(diamond.nodes, diamond.tets).min() > 10.0


def test_nodes_where_cables_pull_and_at_the_top(diamond):
    """The outer middle of each elbow and the middle of the top are nodes; so is the block of the base."""
    radius, height = max(section[2:4] for section in SECTIONS)
    wanted = [(radius, 0.0, height), (0.0, radius, height), (-radius, 0.0, height), (0.0, 0.0, TOP_MIDDLE[1])]
    for point in wanted:
        assert np.linalg.norm(diamond.nodes - point, axis=1).min() < 1e-12
    inside = np.abs(diamond.nodes[:, :2]).max(axis=1) <= HUB_HALF + 1e-12
    assert (inside & (diamond.nodes[:, 2] < 0.0)).sum() >= 18


def test_effector_and_elbows_are_inside_within_the_tolerance_of_the_scene(diamond):
    points = np.array([[0.0, 0.0, 0.125], [0.0, 0.0, 0.115], [0.097, 0.0, 0.045], [0.0, -0.097, 0.045]])
    _, weights = meshing.embed(diamond.nodes, diamond.tets, points, name="points", tolerance=0.003)
    assert weights.shape == (4, 4)


def test_mesh_is_the_same_every_time():
    first, second = meshing.diamond("medium"), meshing.diamond("medium")
    np.testing.assert_array_equal(first.nodes, second.nodes)
    np.testing.assert_array_equal(first.tets, second.tets)


def test_unknown_resolution_is_refused():
    with pytest.raises(
        MeshError, match=r"unknown resolution 'medum'; known: coarse, medium, fine.*did you mean 'medium'"
    ):
        meshing.diamond("medum")
