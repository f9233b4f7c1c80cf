"""The generated trunk: size, symmetry, quality, and room for the cables."""

import numpy as np
import pytest

from softwarp import meshing
from softwarp.meshing import MeshError
from softwarp.meshing.trunk_geometry import NECK_RADIUS, NECK_Z

REFERENCE_VOLUME = 38_900e-9  # m^3, of the published mesh: 709 nodes, 1972 tetrahedra
RESOLUTIONS = ("coarse", "medium", "fine")


def cables(quarter: float) -> np.ndarray:
    """Four cables of 21 points [m]: the base, then a point on each flank of the ten grooves."""
    lean = np.array([0.0, -8.0, 195.0]) / np.hypot(8.0, 195.0)
    line = [(0.0, 10.0, 0.0)]
    line += [(0.0, 17.5 * j * lean[1] + 10.0, 17.5 * j * lean[2] + z) for j in range(10) for z in (21.0, 27.0)]
    turns = [
        np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
        for a in quarter * np.arange(4)
    ]
    return np.concatenate([np.array(line) @ turn.T for turn in turns]) * 1e-3


@pytest.fixture(scope="module", params=RESOLUTIONS)
def trunk(request):
    return meshing.trunk(request.param)


@pytest.mark.parametrize(
    ("resolution", "nodes", "tets", "volume"),
    [("coarse", 305, 816, 0.021), ("medium", 674, 1688, 0.016), ("fine", 2710, 10512, 0.034)],
)
def test_counts_and_volume(resolution, nodes, tets, volume):
    """Rounder meshes hold more: a body of revolution with this profile has 40,750 mm^3."""
    mesh = meshing.trunk(resolution)
    assert (len(mesh.nodes), len(mesh.tets)) == (nodes, tets)
    assert mesh.volume == pytest.approx(REFERENCE_VOLUME, rel=volume)
    assert mesh.name == f"trunk {resolution}"


def test_bounds_are_those_of_the_published_mesh(trunk):
    np.testing.assert_allclose(trunk.bounds, [[-0.013, -0.013, 0.0], [0.013, 0.013, 0.195]], atol=1e-12)


def test_profile_has_necks_in_the_grooves_and_a_taper_outside(trunk):
    radius, z = np.hypot(trunk.nodes[:, 0], trunk.nodes[:, 1]), trunk.nodes[:, 2]
    assert np.all(radius <= 0.013 - 0.008 * z / 0.195 + 1e-12)
    for neck, expected in zip(NECK_Z, NECK_RADIUS, strict=True):
        assert radius[np.abs(z - neck) < 1e-9].max() == pytest.approx(expected, rel=1e-12)
    assert radius[z == 0.0].max() == pytest.approx(0.013)
    assert radius[z > 0.195 - 1e-12].max() == pytest.approx(0.005)


def test_a_layer_of_nodes_ends_the_clamp(trunk):
    layer = trunk.nodes[np.abs(trunk.nodes[:, 2] - 0.020) < 1e-12]
    assert len(layer) >= 17
    assert np.hypot(layer[:, 0], layer[:, 1]).max() == pytest.approx(0.013 - 0.008 * 20 / 195)
    assert np.sum(trunk.nodes[:, 2] <= 0.020) >= 26


@pytest.mark.parametrize(
    "turn",
    [
        np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]),  # quarter turn
        np.diag([-1, 1, 1]),
        np.diag([1, -1, 1]),
    ],
)
def test_mesh_is_symmetric_tets_included(trunk, turn):
    """The map permutes the nodes, and the permuted tetrahedra are the tetrahedra."""
    place = {tuple(key): node for node, key in enumerate(np.round(trunk.nodes * 1e9).astype(int).tolist())}
    images = np.round(trunk.nodes @ turn.T * 1e9).astype(int).tolist()
    permuted = np.array([place[tuple(key)] for key in images])
    assert {tuple(t) for t in np.sort(permuted[trunk.tets], axis=1)} == {tuple(t) for t in np.sort(trunk.tets, axis=1)}


def test_quality(trunk):
    """Better than the published mesh, whose worst radius ratio is 0.014 and worst dihedral angle 0.7 degrees."""
    assert meshing.radius_ratio(trunk.nodes, trunk.tets).min() > 0.11
    assert meshing.min_dihedral(trunk.nodes, trunk.tets).min() > 7.5


def test_surface_encloses_the_volume_without_overlap(trunk):
    a, b, c = np.moveaxis(trunk.nodes[trunk.surface()], 1, 0)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0 == pytest.approx(trunk.volume, rel=1e-10)


@pytest.mark.parametrize("quarter", [np.pi / 2.0, 1.57])
def test_cables_run_inside(trunk, quarter):
    """Also with the published 1.57 in place of a quarter turn."""
    _, weights = meshing.embed(trunk.nodes, trunk.tets, cables(quarter), name="cables")
    assert weights.min() > -1e-5


def test_mesh_is_the_same_every_time():
    first, second = meshing.trunk("medium"), meshing.trunk("medium")
    np.testing.assert_array_equal(first.nodes, second.nodes)
    np.testing.assert_array_equal(first.tets, second.tets)


@pytest.mark.parametrize("wish", [200, 305, 500, 700, 1000, 1500, 2000, 3000, 4000])
def test_node_count_chooses_a_valid_mesh_nearby(wish):
    mesh = meshing.trunk(wish)
    assert len(mesh.nodes) == pytest.approx(wish, rel=0.15 if wish > 200 else 0.6)
    assert meshing.min_dihedral(mesh.nodes, mesh.tets).min() > 5.0
    meshing.embed(mesh.nodes, mesh.tets, cables(np.pi / 2.0), name="cables")


def test_unknown_resolutions_are_refused():
    with pytest.raises(
        MeshError, match=r"unknown resolution 'medum'; known: coarse, medium, fine.*did you mean 'medium'"
    ):
        meshing.trunk("medum")
    for count in (10, 10**6):
        with pytest.raises(MeshError, match=rf"node count must lie between 152 and \d+, got {count};"):
            meshing.trunk(count)
