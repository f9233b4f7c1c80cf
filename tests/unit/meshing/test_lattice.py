"""The lattice mesher: exact crossings, exact boxes, angles, shells; thickness of walls."""

import numpy as np
import pytest
import trimesh

from softwarp import meshing
from softwarp.meshing.lattice import Family, crossings, families, in_cells, lattice_around, stuff
from softwarp.meshing.nearest import nearest
from softwarp.meshing.walls import measure

ROUND = trimesh.creation.icosphere(3)


def filled(surface: trimesh.Trimesh, edge: float) -> meshing.TetMesh:
    x, t = np.asarray(surface.vertices), np.asarray(surface.faces, dtype=np.int32)
    lattice = lattice_around(x.min(axis=0), x.max(axis=0), edge)
    return meshing.TetMesh(*stuff(lattice, [crossings(f, in_cells(lattice, x), t) for f in families()]))


def test_lines_enter_and_leave_where_the_triangles_are(rng):
    """Along x through a sphere of facets: as often in as out, and at the heights that rays of trimesh find."""
    x, t = np.asarray(ROUND.vertices) * 4.3 + 0.03, np.asarray(ROUND.faces, dtype=np.int32)
    found = crossings(Family(np.roll(np.eye(3), -1, axis=0), 0.0, 1.0), x, t)
    assert found.sign.sum() == 0
    for line in ((0, 0), (2, -3), (-1, 4)):
        mine = found.at[(found.line == line).all(axis=1)]
        corner = x[t]
        hits = []
        for a, b, c in corner:
            rows = np.column_stack([b - a, c - a, [-1.0, 0.0, 0.0]])
            if abs(np.linalg.det(rows)) > 1e-12:
                u, v, s = np.linalg.solve(rows, np.array([0.0, *line]) - a)
                hits += [s] if min(u, v, 1.0 - u - v) >= 0.0 else []
        np.testing.assert_allclose(mine, sorted(hits), atol=1e-9)


def test_no_line_slips_through_vertices_and_edges():
    """Every line through the inside of a grid of triangles that has its vertices exactly on lines hits it once."""
    block = meshing.box((4.0, 4.0, 4.0), (4, 4, 4))
    found = crossings(Family(np.eye(3), 0.0, 1.0), block.nodes, block.surface())
    inner = ((found.line > 0) & (found.line < 4)).all(axis=1)
    assert inner.sum() == 2 * 9
    assert found.at[inner].tolist() == [0.0, 4.0] * 9


def test_box_is_exact():
    """The planes of the lattice fit a box: no corner is cut off, and angles are nearly those of the regular lattice."""
    mesh = filled(trimesh.creation.box((1.0, 0.3, 0.2)), 0.05)
    assert mesh.volume == pytest.approx(0.06, rel=1e-6)
    np.testing.assert_allclose(mesh.bounds, [[-0.5, -0.15, -0.1], [0.5, 0.15, 0.1]], atol=1e-7)
    assert meshing.min_dihedral(mesh.nodes, mesh.tets).min() > 35.0


@pytest.mark.parametrize("turn", [0.0, 0.3, 0.7])
@pytest.mark.parametrize(
    ("make", "edge"),
    [
        (lambda: trimesh.creation.icosphere(3), 0.2),
        (lambda: trimesh.creation.torus(1.0, 0.3), 0.15),
        (lambda: trimesh.creation.cone(0.5, 1.0), 0.12),
        (lambda: trimesh.creation.annulus(0.2, 0.4, 0.5), 0.08),
        (lambda: trimesh.creation.box((1.0, 0.6, 0.4)), 0.11),
    ],
    ids=["sphere", "torus", "cone", "tube", "box"],
)
def test_angles_nodes_and_topology(make, edge, turn):
    """Angles exceed the 10.7 degrees of Labelle and Shewchuk; boundary nodes lie on the surface and keep its holes."""
    surface = make()
    surface.apply_transform(trimesh.transformations.rotation_matrix(turn, (1, 2, 3)))
    mesh = filled(surface, edge)
    assert meshing.min_dihedral(mesh.nodes, mesh.tets).min() > 10.7
    x, t = meshing.compact(mesh.nodes, mesh.surface())
    t = meshing.check_closed(x, t)
    assert trimesh.Trimesh(x, t).euler_number == surface.euler_number
    assert mesh.volume == pytest.approx(surface.volume, rel=0.1)
    away = np.linalg.norm(x - nearest(surface.vertices, surface.faces, x, 0.2)[0], axis=1)
    assert away.max() < 1e-6 * edge


def test_volume_converges_with_the_square_of_the_edge():
    """Facets under a sphere miss a volume of order h^2."""
    ball = trimesh.creation.icosphere(5)
    errors = [ball.volume - filled(ball, edge).volume for edge in (0.3, 0.15)]
    assert 3.0 < errors[0] / errors[1] < 5.0


def test_thinnest_wall_and_gap():
    """Of a plate of 0.05 m beside one of 0.2 m, 0.1 m apart; turned, so that no line crosses them straight."""
    plates = [trimesh.creation.box((1.0, 1.0, h)) for h in (0.05, 0.2)]
    plates[1].apply_translation((0.0, 0.0, 0.225))
    both = trimesh.util.concatenate(plates)
    both.apply_transform(trimesh.transformations.rotation_matrix(0.4, (1, 2, 3)))
    x, t = np.asarray(both.vertices), np.asarray(both.faces, dtype=np.int32)
    lattice = lattice_around(x.min(axis=0), x.max(axis=0), 0.1)
    met = [crossings(family, in_cells(lattice, x), t) for family in families()]
    wall, gap = measure(lattice, met, x, t, "plates")
    assert wall.width == pytest.approx(0.05, rel=1e-6)
    assert gap.width == pytest.approx(0.1, rel=1e-6)
