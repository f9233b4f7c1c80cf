"""Geometry of rods: points, frames, sections, strain at rest, messages."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softwarp import meshing

LINE = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.1], [0.0, 0.0, 0.3]])


def test_points_of_straight_arc_and_helix() -> None:
    """Ends, spacing and radius follow the formulas of a line, a circle and a helix."""
    line = meshing.straight(0.6, 3, start=(1.0, 0.0, 0.0), direction=(0.0, 2.0, 0.0))
    np.testing.assert_allclose(line, [[1.0, 0.0, 0.0], [1.0, 0.2, 0.0], [1.0, 0.4, 0.0], [1.0, 0.6, 0.0]], atol=1e-15)
    arc = meshing.arc(2.0, np.pi / 2.0, 5, start=(0.0, 1.0, 0.0), tangent=(0.0, 0.0, 3.0), normal=(1.0, 0.0, 9.0))
    np.testing.assert_allclose(arc[-1], [2.0, 1.0, 2.0], atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(arc - [2.0, 1.0, 0.0], axis=1), 2.0, rtol=1e-14)
    helix = meshing.helix(0.1, -0.04, 2.5, 50, centre=(1.0, 2.0, 3.0))
    np.testing.assert_allclose(helix[[0, -1]], [[1.1, 2.0, 3.0], [0.9, 2.0, 2.9]], atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(helix[:, :2] - [1.0, 2.0], axis=1), 0.1, rtol=1e-13)


def test_arc_has_exact_tangents_lengths_and_curvature() -> None:
    """A circle of radius R, unevenly cut: length R angle, curvature 1 / R about the local axis normal to the plane."""
    angle = np.array([0.0, 0.1, 0.5, 0.7, 1.6, 2.0])
    points = 0.3 * np.stack([np.sin(angle), 1.0 - np.cos(angle), np.zeros(6)], axis=1)
    geometry = meshing.rod_geometry(points, radius=0.01, normal=(0.0, 0.0, 1.0))
    np.testing.assert_allclose(geometry.length, 0.3 * np.diff(angle), rtol=1e-13)
    np.testing.assert_allclose(geometry.rest, np.tile([0.0, 0.0, 1.0, 1.0 / 0.3, 0.0, 0.0], (5, 1)), atol=1e-12)
    frame = Rotation.from_quat(geometry.quaternions)
    tangent = np.stack([np.cos(angle), np.sin(angle), np.zeros(6)], axis=1)
    np.testing.assert_allclose(frame.apply([0.0, 0.0, 1.0]), tangent, atol=1e-14)
    np.testing.assert_allclose(frame.apply([1.0, 0.0, 0.0]), np.tile([0.0, 0.0, 1.0], (6, 1)), atol=1e-14)


def test_frames_are_right_handed_and_smooth(rng: np.random.Generator) -> None:
    """Unit quaternions, neighbours on one half of the sphere, local z within a segment's turn of the chords."""
    points = np.cumsum(rng.uniform(0.0, 1.0, (30, 3)) * [0.3, 0.3, 1.0] + [0.0, 0.0, 0.2], axis=0)
    geometry = meshing.rod_geometry(points, radius=0.01)
    q = geometry.quaternions
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, rtol=1e-14)
    assert ((q[1:] * q[:-1]).sum(axis=1) > 0.0).all()
    chord = np.diff(points, axis=0)
    chord /= np.linalg.norm(chord, axis=1, keepdims=True)
    z = Rotation.from_quat(q).apply([0.0, 0.0, 1.0])
    assert ((z[1:-1] * chord[1:]).sum(axis=1) > 0.7).all()
    assert np.linalg.norm(geometry.rest[:, :3], axis=1) == pytest.approx(1.0, rel=1e-14)


def test_round_sections() -> None:
    """Circle and annulus: area, Cowper's shear area, second moments, torsion constant."""
    nu = 0.3
    solid = meshing.rod_geometry(LINE, radius=[0.02, 0.01], nu=nu)
    r = np.array([0.02, 0.01])
    second = np.pi / 4.0 * r**4
    area = np.pi * r**2
    shear = 6.0 * (1.0 + nu) / (7.0 + 6.0 * nu) * area
    np.testing.assert_allclose(solid.section, np.stack([area, shear, second, second, 2.0 * second], axis=1), rtol=1e-14)
    hollow = meshing.rod_geometry(LINE, radius=0.02, inner_radius=0.0199999, nu=nu)
    thin = 2.0 * np.pi * 0.02 * 1e-7
    factor = 2.0 * (1.0 + nu) / (4.0 + 3.0 * nu)  # of a thin tube
    expected = [thin, factor * thin, thin * 2e-4, thin * 2e-4, thin * 4e-4]
    np.testing.assert_allclose(hollow.section[0], expected, rtol=2e-5)


def test_lumped_volume_and_inertia() -> None:
    """Half of each segment's volume and section inertia to either node."""
    geometry = meshing.rod_geometry(LINE, radius=0.02)
    area, second = np.pi * 4e-4, np.pi / 4.0 * 1.6e-7
    np.testing.assert_allclose(geometry.node_volume, area * np.array([0.05, 0.15, 0.1]), rtol=1e-13)
    expected = second * np.outer([0.05, 0.15, 0.1], [1.0, 1.0, 2.0])
    np.testing.assert_allclose(geometry.node_inertia, expected, rtol=1e-13)
    np.testing.assert_array_equal(geometry.radius, 0.02)


def test_intrinsic_curvature_keeps_the_points_as_start() -> None:
    """The strain at rest is the given one, the length that of the start shape."""
    geometry = meshing.rod_geometry(LINE, radius=0.02, curvature=(1.0, 2.0, 3.0))
    np.testing.assert_allclose(geometry.rest, np.tile([0.0, 0.0, 1.0, 1.0, 2.0, 3.0], (2, 1)))
    np.testing.assert_allclose(geometry.length, [0.1, 0.2], rtol=1e-14)
    each = meshing.rod_geometry(LINE, radius=0.02, curvature=[[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    np.testing.assert_allclose(each.rest[:, 3:], [[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": [[0.0, 0.0, 0.0]]}, r"shape \(n, 3\) with n >= 2, got \(1, 3\)"),
        ({"points": [[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]]}, "point 1 of a rod"),
        ({"points": [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]}, "points 1 and 2 of a rod coincide"),
        ({"points": [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]}, "folds back on itself at point 1"),
        ({"radius": -0.01}, "radius of a rod must be positive and finite, got -0.01"),
        ({"radius": [0.01, 0.02, 0.03]}, r"one per segment \(2\), got shape \(3,\)"),
        ({"inner_radius": 0.01}, "inner_radius of a rod must be below its radius"),
        ({"inner_radius": -0.01}, "inner_radius of a rod must be at least zero"),
        ({"curvature": (1.0, 2.0)}, r"of shape \(3,\) or \(2, 3\)"),
        ({"curvature": (0.0, 20.0, 0.0)}, "segment 1 of a rod, 0.2 m, turns by 4 rad"),
        ({"normal": (0.0, 0.0, 1.0)}, "must not point along its tangent"),
        ({"normal": (0.0, 0.0, 0.0)}, "not all zero"),
        ({"nu": 0.6}, r"Poisson's ratio of a rod must lie in \(-1, 0.5\], got 0.6"),
        ({"section": (1.0, 1.0, 1.0)}, r"shape \(5,\) or \(2, 5\), got shape \(3,\)"),
        ({"section": (1.0, 1.0, 0.0, 1.0, 1.0)}, "section of a rod must be positive"),
    ],
)
def test_errors_name_value_and_remedy(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"points": LINE, "radius": 0.01, **change}
    with pytest.raises(ValueError, match=message):
        meshing.rod_geometry(arguments.pop("points"), **arguments)


def test_errors_of_helpers() -> None:
    for call in (
        lambda: meshing.straight(0.0, 3),
        lambda: meshing.straight(1.0, 0),
        lambda: meshing.arc(-1.0, 1.0, 3),
        lambda: meshing.arc(1.0, 1.0, 3, normal=(0.0, 0.0, 1.0)),
        lambda: meshing.helix(0.1, 0.1, 0.0, 3),
    ):
        with pytest.raises(ValueError, match="a rod"):
            call()


def test_sharp_turn_between_points_is_refused() -> None:
    """Tangents of neighbouring nodes may differ by 2.5 rad at most."""
    corner = 0.1 * np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.9, 0.0, 0.1], [0.0, 0.1, 0.0]])
    with pytest.raises(ValueError, match="use shorter segments"):
        meshing.rod_geometry(corner, radius=0.001)
