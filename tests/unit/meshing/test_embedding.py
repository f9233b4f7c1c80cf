"""Points tied to tetrahedra by barycentric weights."""

import numpy as np
import pytest

from softwarp import meshing
from softwarp.meshing import MeshError

MESH = meshing.box((1.0, 0.2, 0.3), (10, 2, 3))


def carried(tet, weights):
    return np.einsum("pk,pkd->pd", weights, MESH.nodes[MESH.tets[tet]])


def test_weights_reproduce_points_inside(rng):
    points = rng.uniform(0.0, 1.0, (200, 3)) * [1.0, 0.2, 0.3]
    tet, weights = meshing.embed(MESH.nodes, MESH.tets, points)
    assert (tet.dtype, tet.shape, weights.shape) == (np.int32, (200,), (200, 4))
    assert weights.min() >= -1e-9
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-14)
    np.testing.assert_allclose(carried(tet, weights), points, atol=1e-15)


def test_weights_follow_an_affine_motion(rng):
    """Barycentric weights carry a point through any affine map exactly."""
    points = rng.uniform(0.0, 1.0, (20, 3)) * [1.0, 0.2, 0.3]
    tet, weights = meshing.embed(MESH.nodes, MESH.tets, points)
    stretch, shift = rng.standard_normal((3, 3)), rng.standard_normal(3)
    moved = MESH.nodes @ stretch.T + shift
    after = np.einsum("pk,pkd->pd", weights, moved[MESH.tets[tet]])
    np.testing.assert_allclose(after, points @ stretch.T + shift, atol=1e-13)


def test_every_node_is_carried_by_a_tet_that_holds_it():
    tet, weights = meshing.embed(MESH.nodes, MESH.tets, MESH.nodes)
    assert all(node in corners for node, corners in enumerate(MESH.tets[tet].tolist()))
    np.testing.assert_allclose(np.sort(weights, axis=1), np.tile([0.0, 0.0, 0.0, 1.0], (len(tet), 1)), atol=1e-12)


def test_one_point_may_be_given_flat():
    tet, weights = meshing.embed(MESH.nodes, MESH.tets, [0.5, 0.1, 0.15])
    assert (tet.shape, weights.shape) == ((1,), (1, 4))


@pytest.mark.parametrize(
    ("point", "distance"),
    [
        ((0.52, 0.11, 0.35), 0.05),  # above a face
        ((-0.3, 0.11, -0.4), 0.5),  # beside an edge
        ((1.2, 0.5, 0.9), 0.7),  # beyond a corner: (0.2, 0.3, 0.6)
    ],
)
def test_outside_points_are_refused_with_their_distance(point, distance):
    with pytest.raises(MeshError) as refusal:
        meshing.embed(MESH.nodes, MESH.tets, [(0.5, 0.1, 0.1), point], name="cable 'north'")
    message = str(refusal.value)
    assert message.startswith("cable 'north': point 1 at (")
    assert f"lies {distance:g} m outside the mesh" in message
    assert "snap=" in message


def test_refusal_names_the_farthest_of_several():
    points = [(0.5, 0.1, 0.35), (0.5, 0.1, 0.45), (0.5, 0.1, 0.1)]
    with pytest.raises(MeshError, match=r"point 1 .* 0\.15 m outside.*; 2 of 3 points lie outside, this one farthest"):
        meshing.embed(MESH.nodes, MESH.tets, points)


def test_rounding_outside_is_accepted_and_keeps_its_place():
    """The default tolerance is 1e-6 of the diagonal, here 1.06e-6 m."""
    point = np.array([[0.52, 0.11, 0.3 + 1e-6]])
    tet, weights = meshing.embed(MESH.nodes, MESH.tets, point)
    assert -1e-4 < weights.min() < 0.0
    np.testing.assert_allclose(carried(tet, weights), point, atol=1e-15)
    with pytest.raises(MeshError, match=r"more than the 1e-08 m allowed"):
        meshing.embed(MESH.nodes, MESH.tets, point, tolerance=1e-8)


@pytest.mark.parametrize("point", [(0.52, 0.11, 0.32), (1.02, 0.21, 0.31), (1.02, 0.21, 0.11)])
def test_snapped_points_keep_their_place_and_use_the_nearest_tet(point):
    tet, weights = meshing.embed(MESH.nodes, MESH.tets, [point], snap=0.03)
    np.testing.assert_allclose(carried(tet, weights), [point], atol=1e-14)
    assert weights.min() < 0.0
    nearest = np.clip(point, 0.0, [1.0, 0.2, 0.3])
    _, inside = meshing.embed(MESH.nodes, MESH.tets[tet], nearest[None])
    assert inside.min() >= -1e-9


def test_points_that_are_no_positions_are_refused():
    with pytest.raises(MeshError, match="tip: point 1 is not finite"):
        meshing.embed(MESH.nodes, MESH.tets, [(0.5, 0.1, 0.1), (np.nan, 0.0, 0.0)], name="tip")
    with pytest.raises(MeshError, match=r"tip: points must have shape \(point, 3\)"):
        meshing.embed(MESH.nodes, MESH.tets, [(0.5, 0.1)], name="tip")
