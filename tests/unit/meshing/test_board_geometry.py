"""The board of BubbleMotion: counts, volumes, symmetry, chambers, quality, refusals."""

import numpy as np
import pytest

from softwarp import meshing
from softwarp.meshing.board_geometry import CHAMBER, chamber_centres

COUNTS = [("coarse", 644, 2304, 32), ("medium", 1701, 6624, 96), ("fine", 5894, 24336, 384), ("graded", 1701, 6624, 96)]
PLATE, RIM, AIR = 0.1**2 * 0.01, (0.1**2 - 0.08**2) * 0.02, CHAMBER**2 * 0.0065


@pytest.mark.parametrize(("resolution", "nodes", "tets", "triangles"), COUNTS)
def test_counts_and_volumes(resolution, nodes, tets, triangles):
    """The published board has 136.406 cm^3 of silicone and nine chambers of 3.9549 cm^3; ours too, on every mesh."""
    board = meshing.board(resolution)
    meshing.check_tets(board.nodes, board.tets, name=board.name)
    walls = list(board.cavities.values())
    assert (len(board.nodes), len(board.tets), len(walls[4].triangles)) == (nodes, tets, triangles)
    np.testing.assert_allclose([PLATE + RIM - 9.0 * AIR, AIR], [136.406e-6, 3.9549e-6], rtol=2e-5)
    np.testing.assert_allclose(board.volume, PLATE + RIM - 9.0 * AIR, rtol=1e-12)
    np.testing.assert_allclose([wall.volume for wall in walls], AIR, rtol=1e-12)
    np.testing.assert_allclose(board.bounds, [[-0.05, -0.05, 0.0], [0.05, 0.05, 0.03]], atol=1e-15)
    plate = meshing.board(resolution, rim=False)
    np.testing.assert_allclose(plate.volume, PLATE - 9.0 * AIR, rtol=1e-12)
    np.testing.assert_allclose(plate.bounds[1], [0.05, 0.05, 0.01], atol=1e-15)


def test_skin():
    """A thicker floor takes its height from the chambers; silicone and air together stay what they are."""
    board = meshing.board(skin=0.004)
    wall = board.cavities["cell_0"]
    np.testing.assert_allclose(wall.nodes[:, 2].min(), 0.0025)
    np.testing.assert_allclose(wall.nodes[:, 2].max(), 0.006)
    np.testing.assert_allclose(board.volume + 9.0 * wall.volume, PLATE + RIM, rtol=1e-12)


@pytest.mark.parametrize("resolution", ["coarse", "medium"])
def test_chambers_are_tagged_voids(resolution):
    """Cell k lies at centre k, in rows along y; its wall is a void of the mesh, outward from the air, node by node."""
    board = meshing.board(resolution)
    assert list(board.cavities) == [f"cell_{k}" for k in range(9)]
    x = 0.001 * np.array([11.5 + 12.3333333, 50.0, 100.0 - 11.5 - 12.3333333]) - 0.05  # of the published surfaces
    np.testing.assert_allclose(chamber_centres(), [[a, b] for a in x for b in x], atol=1e-9)
    voids = {frozenset(map(frozenset, void.tolist())) for void in meshing.voids(board.nodes, board.tets)}
    for wall, centre in zip(board.cavities.values(), chamber_centres(), strict=True):
        np.testing.assert_allclose(0.5 * (wall.nodes.min(axis=0) + wall.nodes.max(axis=0))[:2], centre, atol=1e-12)
        np.testing.assert_array_equal(board.nodes[wall.node], wall.nodes)
        assert frozenset(map(frozenset, wall.node[wall.triangles].tolist())) in voids
        np.testing.assert_array_equal(meshing.check_closed(wall.nodes, wall.triangles), wall.triangles)


@pytest.mark.parametrize("turn", [[1, 0, 2, -1, 1], [0, 1, 2, -1, 1], [0, 1, 2, 1, -1], [1, 0, 2, 1, 1]])
@pytest.mark.parametrize(
    ("resolution", "rim"), [("coarse", True), ("coarse", False), ("medium", True), ("graded", True)]
)
def test_symmetric_tets_included(resolution, rim, turn):
    """Quarter turn and mirrors map tetrahedra to tetrahedra."""
    mesh = meshing.board(resolution, rim=rim)
    moved = mesh.nodes[:, turn[:3]] * [turn[3], turn[4], 1.0]
    at = {tuple(x): i for i, x in enumerate((mesh.nodes + 0.0).round(9).tolist())}
    image = np.array([at[tuple(x)] for x in (moved + 0.0).round(9).tolist()])
    before = {frozenset(t) for t in mesh.tets.tolist()}
    assert {frozenset(t) for t in image[mesh.tets].tolist()} == before


def test_quality():
    """Thin walls make flat elements, but none is a sliver like the published mesh's worst, of 0.4 degrees."""
    for resolution, angle in (("coarse", 3.0), ("medium", 1.4), ("graded", 1.4), ("fine", 0.9)):
        mesh = meshing.board(resolution)
        assert meshing.min_dihedral(mesh.nodes, mesh.tets).min() > angle


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resolution": "corse"}, "unknown resolution 'corse'; known: coarse, medium, fine, graded; did you mean"),
        ({"skin": 0.0}, r"board: skin \[m\] must lie in .*, got 0.0"),
        ({"skin": 0.0075}, r"board: skin \[m\] must lie in .*, got 0.0075"),
        ({"skin": float("nan")}, r"board: skin \[m\] must .*, got nan"),
    ],
)
def test_refusals(options, message):
    with pytest.raises(meshing.MeshError, match=message):
        meshing.board(**options)
