"""The nasal passage: its openings, random anatomies, refusals."""

from __future__ import annotations

import numpy as np
import pytest

from softwarp import meshing
from softwarp.meshing import nasal_passage
from softwarp.meshing.nasal_geometry import CHOANA, NARROWEST


def test_openings() -> None:
    """It passes the nostril along +z and ends at the choana, 88 mm away."""
    lumen = nasal_passage()
    assert lumen.along(np.zeros((1, 3)))[1][0] < 3e-4
    np.testing.assert_allclose(lumen.points[-1], CHOANA, atol=1e-9)
    at_nostril = lumen.tangents[np.abs(lumen.points[:, 2]).argmin()]
    assert at_nostril[2] > 0.99
    assert float(np.linalg.norm(CHOANA)) == pytest.approx(0.088, abs=1e-3)
    meshing.SurfaceMesh(lumen.surface().nodes, lumen.surface().triangles)


def test_random_anatomies() -> None:
    """The same seed gives the same, others differ; the vestibule stays; none is too narrow."""
    standard, one = nasal_passage(), nasal_passage(1)
    np.testing.assert_array_equal(one.points, nasal_passage(1).points)
    assert np.abs(one.points[-1] - standard.points[-1]).max() > 1e-4
    for seed in range(10):
        lumen = nasal_passage(seed)
        assert lumen.along(np.zeros((1, 3)))[1][0] < 8e-4
        assert lumen.radius.min() > NARROWEST
        assert np.abs(lumen.points[-1] - standard.points[-1]).max() <= 3e-3 + 1e-9
    np.testing.assert_allclose(nasal_passage(3, variation=0.0).points, standard.points)


def test_refusals() -> None:
    """Too small, and numbers outside their range."""
    with pytest.raises(meshing.MeshError, match="too narrow"):
        nasal_passage(scale=0.4)
    with pytest.raises(ValueError, match="variation"):
        nasal_passage(0, variation=-1.0)
    with pytest.raises(ValueError, match="scale"):
        nasal_passage(scale=0.0)
