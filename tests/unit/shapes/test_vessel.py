"""Walls around a lumen: from meshes with open ends and from centre lines."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from softwarp import meshing
from softwarp.shapes import Vessel

Floats = NDArray[np.float64]
RADIUS, LENGTH = 0.005, 0.04


def pipe(flip: bool = False) -> tuple[Floats, NDArray[np.int32]]:
    """A round pipe along z, open at both ends."""
    turn, height = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False), np.linspace(0.0, LENGTH, 17)
    x = np.array([(RADIUS * np.cos(a), RADIUS * np.sin(a), z) for z in height for a in turn])
    tri = []
    for k in range(16):
        for i in range(48):
            a, b = 48 * k + i, 48 * k + (i + 1) % 48
            tri += [(a, b, a + 48), (b, b + 48, a + 48)]
    t = np.array(tri, dtype=np.int32)
    return x, t[:, ::-1].copy() if flip else t


def places() -> tuple[Floats, Floats]:
    """Points in and around the wall, and the distance of its surface from each [m]."""
    points = [(0.0, 0.0, 0.02), (0.003, 0.0, 0.01), (0.0045, 0.0, 0.03), (0.0056, 0.0, 0.02)]
    beyond = [(0.0, 0.003, -0.003), (0.0, 0.0, 0.046)]
    distances = [RADIUS, 0.002, 0.0005, -0.0006, np.hypot(0.002, 0.003), np.hypot(0.005, 0.006)]
    return np.array(points + beyond), np.array(distances)


@pytest.mark.parametrize("flip", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_open_mesh(flip: bool) -> None:
    """The lumen is found whichever way triangles face; beyond an open end the rim is what is near."""
    points, expected = places()
    vessel = Vessel.from_mesh(*pipe(flip), 0.0005)
    np.testing.assert_allclose(vessel.clearance(points)[:4], expected[:4], atol=3e-4)
    assert (vessel.clearance(points[4:]) > 0.001).all()


def test_closed_mesh() -> None:
    """A closed surface keeps what is inside."""
    box = meshing.box((0.02, 0.02, 0.02), (4, 4, 4))
    surface = box.surface()
    used, corner = np.unique(surface, return_inverse=True)
    vessel = Vessel.from_mesh(box.nodes[used], corner.reshape(-1, 3), 0.001)
    inside, wall = np.array([[0.01, 0.01, 0.002]]), np.array([[0.01, 0.01, 0.0215]])
    assert float(vessel.clearance(inside)[0]) == pytest.approx(0.002, abs=1e-6)
    assert float(vessel.clearance(wall)[0]) == pytest.approx(-0.0015, abs=1e-6)


def test_from_tubes() -> None:
    """Straight pipe, and a branch whose wall does not cross the trunk's lumen."""
    trunk = (np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 0.02), (0.0, 0.0, LENGTH)]), RADIUS)
    points, expected = places()
    vessel = Vessel.from_tubes([trunk], 0.0005)
    np.testing.assert_allclose(vessel.clearance(points), expected, atol=1.5e-4)
    branch = (np.array([(0.0, 0.0, 0.02), (0.03, 0.0, 0.03)]), 0.003)
    forked = Vessel.from_tubes([trunk, branch], 0.0005)
    line = np.array([(0.0, 0.0, 0.02)]) + np.linspace(0.0, 1.0, 20)[:, None] * np.array([(0.03, 0.0, 0.01)])
    assert (forked.clearance(line) > 0.0027).all()
    assert (forked.clearance(points[:1]) > 0.0).all()
    beside = (0.02 - 0.01 * 3.0) / np.sqrt(10.0)  # of the branch's line
    assert float(forked.clearance([[0.02, 0.0, 0.03]])[0]) == pytest.approx(0.003 - abs(beside), abs=5e-5)


def test_what_is_drawn() -> None:
    """The inner surface without caps; cut open, without what faces the eye."""
    vessel = Vessel.from_tubes([(np.array([(0.0, 0.0, 0.0), (0.0, 0.0, LENGTH)]), RADIUS)], 0.0005)
    x, t = vessel.surface()
    corner = x[t]
    assert (np.linalg.norm(corner[..., :2], axis=-1) > 0.9 * RADIUS).all()  # no cap
    opened, half = vessel.cut_open((1.0, 0.0, 0.0)).surface()
    assert 0.4 * len(t) < len(half) < 0.6 * len(t)
    assert opened[half].mean(axis=(0, 1))[0] < 0.0


@pytest.mark.parametrize(
    ("points", "radius", "message"),
    [
        ([(0.0, 0.0, 0.0)], 0.005, "n >= 2"),
        ([(0.0, 0.0, 0.0), (0.0, 0.0, np.nan)], 0.005, "finite"),
        ([(0.0, 0.0, 0.0), (0.0, 0.0, 0.01)], 0.0005, "radius"),
        ([(0.0, 0.0, 0.0), (0.0, 0.0, 0.01)], [0.005], "radius"),
    ],
)
def test_lines_that_are_none(points: object, radius: object, message: str) -> None:
    """Messages name the tube."""
    with pytest.raises(ValueError, match=message):
        Vessel.from_tubes([(points, radius)], 0.0005)


def test_surfaces_that_enclose_nothing() -> None:
    """A flat sheet, and triangles without area."""
    sheet = np.array([(0.0, 0.0, 0.0), (0.01, 0.0, 0.0), (0.01, 0.01, 0.0), (0.0, 0.01, 0.0)])
    with pytest.raises(meshing.MeshError, match="no lumen"):
        Vessel.from_mesh(sheet, [(0, 1, 2), (0, 2, 3)], 0.001)
    with pytest.raises(meshing.MeshError, match="no area"):
        Vessel.from_mesh(np.array([(0, 0, 0), (1, 0, 0), (2, 0, 0.0)]), [(0, 1, 2)], 0.1)


def test_a_triangle_that_faces_the_other_way_is_refused() -> None:
    """It would turn the wall inside out around it; one that many others share the edge with is left alone."""
    x, t = pipe()
    turned = t.copy()
    turned[400] = turned[400, ::-1]
    with pytest.raises(meshing.MeshError, match=r"faces another way than its neighbour.*3 such edges.*orient_surface"):
        Vessel.from_mesh(x, turned, 0.0005)


def test_what_no_wall_can_be_made_of_is_refused() -> None:
    """A spacing that does not show the lumen, by the vessel's name, and what are no tubes."""
    with pytest.raises(ValueError, match=r"vessel 'duct': a spacing of 0.01 m does not show this surface: .*smaller"):
        Vessel.from_mesh(*pipe(), 0.01, name="duct")
    for wrong in (None, 3, [], [1, 2], [(np.zeros((2, 3)),)]):
        with pytest.raises(ValueError, match=r"vessel 'vessel': tubes must be one pair .*at least one tube"):
            Vessel.from_tubes(wrong, 0.001)
