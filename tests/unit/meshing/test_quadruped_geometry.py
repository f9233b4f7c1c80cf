"""The quadruped of MultiGait: volumes, counts, chambers, symmetry, quality, skin, refusals."""

import numpy as np
import pytest

from softwarp import meshing
from softwarp.meshing.quadruped_geometry import CHAMBERS, HEIGHT, OUTLINE, base_triangles

# Of the published surfaces of the chambers [mm^3], and of the published solid.
PUBLISHED = {"centre": 507.10, "front_left": 350.02, "front_right": 350.02, "rear_left": 280.30, "rear_right": 280.30}
SOLID, SIZE = 26050.6, (135.7, 58.5, 6.3)


def outline_area():
    """Area of the outline [mm^2], by the shoelace formula over a quarter and its three images."""
    x, y = 1e3 * np.array([(0.0, 0.0), *OUTLINE, (0.0, OUTLINE[-1][1])]).T
    return 4.0 * 0.5 * abs(float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()))


@pytest.mark.parametrize(("resolution", "nodes", "tets"), [("coarse", 3182, 11498), ("fine", 15377, 64822)])
def test_counts_and_volumes(resolution, nodes, tets):
    """Chambers within 0.2 % of the published ones, the solid within 0.1 %; solid and air fill the outline exactly."""
    body = meshing.quadruped(resolution)
    meshing.check_tets(body.nodes, body.tets, name=body.name)
    assert (len(body.nodes), len(body.tets)) == (nodes, tets)
    air = {name: 1e9 * wall.volume for name, wall in body.cavities.items()}
    assert tuple(air) == CHAMBERS
    for name, volume in PUBLISHED.items():
        assert air[name] == pytest.approx(volume, rel=2e-3)
    assert 1e9 * body.volume == pytest.approx(SOLID, rel=1e-3)
    assert 1e9 * body.volume + sum(air.values()) == pytest.approx(outline_area() * 1e3 * HEIGHT, rel=1e-12)
    np.testing.assert_allclose(1e3 * np.ptp(body.bounds, axis=0), SIZE, atol=0.05)


def test_chambers_follow_the_plan_exactly():
    """Slots and channels: heights of 3.8 and 1 mm over the areas of their rectangles, on every mesh."""
    slots, gaps = 13, 12
    lengths = 2.0 * sum((14.5, 16.0, 17.5, 19.0)) + 5.0 * 20.5
    centre = 0.5 * lengths * 3.8 + 1.5 * 1.0 * (gaps * (3.4 - 0.5) + 24.35 - (-20.65 + 3.4 * (slots - 1) + 0.5))
    leg = 0.5 * 3.8 * sum(15.0 - 0.6 * k for k in range(11)) + 1.0 * 1.0 * 10 * (3.45 - 0.5)
    for resolution in ("coarse", "fine"):
        air = meshing.quadruped(resolution).cavities
        assert 1e9 * air["centre"].volume == pytest.approx(centre, rel=1e-9)
        assert 1e9 * air["rear_left"].volume == pytest.approx(leg, rel=1e-9)
        for wall in air.values():
            np.testing.assert_allclose(wall.nodes[:, 2].min(), 0.0010)
            np.testing.assert_allclose(wall.nodes[:, 2].max(), 0.0048)


@pytest.mark.parametrize("resolution", ["coarse", "fine"])
def test_symmetric_and_named_by_side(resolution):
    """The mirror y = 0 maps tetrahedra to tetrahedra; left is positive y, front positive x; vertices are nodes."""
    body = meshing.quadruped(resolution)
    at = {tuple(x): i for i, x in enumerate((body.nodes + 0.0).round(10).tolist())}
    image = np.array([at[tuple(x)] for x in (body.nodes * [1.0, -1.0, 1.0] + 0.0).round(10).tolist()])
    there = {tuple(sorted(tet)) for tet in body.tets.tolist()}
    assert {tuple(sorted(tet)) for tet in image[body.tets].tolist()} == there
    for name, wall in body.cavities.items():
        np.testing.assert_array_equal(body.nodes[wall.node], wall.nodes)
        if name != "centre":
            assert (wall.nodes[:, 1] > 0.0).all() == name.endswith("left")
            assert (wall.nodes[:, 0].max() > 0.06) == name.startswith("front")


def test_base_is_the_whole_lower_side():
    """The stiff skin covers 4416 mm^2, as the published one does."""
    for resolution in ("coarse", "fine"):
        body = meshing.quadruped(resolution)
        base = base_triangles(body)
        assert 1e6 * meshing.triangle_areas(body.nodes, base).sum() == pytest.approx(4416.0, rel=1e-3)


def test_quality():
    """Fine tetrahedra are well shaped; coarse ones span slots of half a millimetre."""
    assert meshing.min_dihedral(*_mesh("fine")).min() > 9.0
    assert meshing.min_dihedral(*_mesh("coarse")).min() > 3.0


def _mesh(resolution):
    body = meshing.quadruped(resolution)
    return body.nodes, body.tets


def test_skin_is_closed_and_coarse():
    """About the published 123 points; the volume of the outline; symmetric."""
    skin = meshing.quadruped_skin()
    assert 110 <= len(skin.nodes) <= 130
    assert 1e9 * meshing.surface_volume(skin.nodes, skin.triangles) == pytest.approx(outline_area() * 6.3, rel=1e-9)
    meshing.check_closed(skin.nodes, skin.triangles)
    points = {tuple(x) for x in (skin.nodes + 0.0).round(9).tolist()}
    assert {tuple(x) for x in (skin.nodes * [1.0, -1.0, 1.0] + 0.0).round(9).tolist()} == points


def test_unknown_resolution():
    """Names the known ones and the nearest."""
    with pytest.raises(meshing.MeshError, match=r"quadruped: unknown resolution 'coars'; known: coarse, fine"):
        meshing.quadruped("coars")
