"""Lumina: surfaces, ways along them, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from softwarp import meshing
from softwarp.meshing import Lumen
from softwarp.shapes import Vessel


def bent(radius: object = 0.004) -> Lumen:
    """A quarter turn of radius 40 mm in the plane of y and z."""
    a = np.linspace(0.0, 0.5 * np.pi, 91)
    return Lumen(0.04 * np.stack([0.0 * a, 1.0 - np.cos(a), np.sin(a)], axis=1), radius)  # type: ignore[arg-type]


def test_way_along_a_bend() -> None:
    """A point beside the line is as far along as its angle tells."""
    lumen, a = bent(), np.array([0.2, 0.7, 1.4])
    inside = 0.042 * np.stack([0.0 * a, -np.cos(a), np.sin(a)], axis=1) + np.array([0.003, 0.04, 0.0])
    arc, away = lumen.along(inside)
    np.testing.assert_allclose(arc, 0.04 * a, atol=2e-5)  # chords
    np.testing.assert_allclose(away, np.hypot(0.002, 0.003), atol=1e-5)
    assert lumen.length == pytest.approx(0.02 * np.pi, rel=1e-4)
    np.testing.assert_allclose(lumen.at(lumen.arc)[0], lumen.points, atol=1e-12)


def test_surface_encloses_the_sections() -> None:
    """Area by Pappus; triangles face outwards."""
    surface = bent().surface(64)
    corner = surface.nodes[surface.triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    assert 0.5 * np.linalg.norm(normal, axis=1).sum() == pytest.approx(2.0 * np.pi * 0.004 * 0.02 * np.pi, rel=2e-3)
    arc, _ = bent().along(corner.mean(axis=1))
    out = corner.mean(axis=1) - bent().at(arc)[0]
    assert ((normal * out).sum(axis=1) > 0.0).all()


@pytest.mark.slow  # test_vessel has vessels of open and closed meshes
def test_a_vessel_of_the_surface_holds_the_line() -> None:
    """At the smaller semi-axis."""
    flat = bent(np.tile([0.003, 0.006], (91, 1)))
    vessel = Vessel.from_mesh(flat.surface().nodes, flat.surface().triangles, 6e-4)
    np.testing.assert_allclose(vessel.clearance(flat.at([0.02, 0.03])[0]), 0.003, atol=1e-4)


def test_smooth_lumen_through_places() -> None:
    """It passes the places given, with points at equal distances."""
    places = np.array([(0.0, 0.0, 0.0), (0.0, 0.01, 0.03), (0.01, 0.03, 0.05)])
    lumen = Lumen.through(places, [0.003, 0.005, 0.004], 0.001)
    assert lumen.along(places)[1].max() < 1e-4
    steps = np.diff(lumen.arc)
    assert np.ptp(steps) < 0.02 * steps.mean()
    assert 0.003 <= lumen.radius.min() < lumen.radius.max() <= 0.005 + 1e-9
    assert lumen.resampled(12).length == pytest.approx(lumen.length, rel=5e-3)


def test_refusals() -> None:
    """Messages name what is wrong."""
    line = np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
    with pytest.raises(meshing.MeshError, match="radius"):
        Lumen(line, -1.0)  # type: ignore[arg-type]
    with pytest.raises(meshing.MeshError, match="points 0 and 1 coincide"):
        Lumen(np.zeros((2, 3)), 1.0)  # type: ignore[arg-type]
    with pytest.raises(meshing.MeshError, match="across"):
        Lumen(line, [[1.0, 2.0]] * 2, (0.0, 0.0, 1.0))  # type: ignore[arg-type]
    with pytest.raises(meshing.MeshError, match="be finite numbers"):
        Lumen(line[:1], 1.0)  # type: ignore[arg-type]
