"""Branching vessels: outlets where they are asked for, ways along the centre lines, branches apart."""

from __future__ import annotations

import numpy as np
import pytest

from softwarp import meshing
from softwarp.meshing import MeshError
from softwarp.meshing.aorta_geometry import BEYOND, INLET, OUTLETS, RADIUS, VesselTree, aorta
from softwarp.shapes import Vessel


def test_the_default_has_the_outlets_of_the_reference() -> None:
    """Seven outlets where the phantom's are, an inlet of its radius at the origin along z."""
    tree = meshing.aorta()
    np.testing.assert_allclose(tree.points[tree.outlets], OUTLETS, atol=1e-9)
    np.testing.assert_allclose(tree.points[tree.inlet], 0.0, atol=1e-9)
    np.testing.assert_allclose(tree.direction[tree.inlet], (0.0, 0.0, 1.0), atol=1e-9)
    np.testing.assert_allclose(tree.points[0], (0.0, 0.0, -INLET), atol=1e-9)
    assert tree.radius[tree.inlet] == pytest.approx(RADIUS)
    assert len(tree.forks) == 6  # a tree that forks in two
    assert (tree.length[tree.outlets] > 1.0).all()
    assert tree.length.max() == pytest.approx(tree.length[tree.outlets].max() + BEYOND, abs=1e-6)


@pytest.mark.parametrize("count", [1, 2, 5, 12])
def test_as_many_outlets_as_asked(count: int) -> None:
    """Every outlet has its own way; branches do not touch."""
    tree = aorta(count, seed=count)
    assert len(set(tree.outlets.tolist())) == count
    assert tree.clearance() > 0.3 * RADIUS
    assert len(tree.tubes()) == count


def test_seeds_give_different_anatomies_again_and_again() -> None:
    """Same seed, same vessel; another one, another vessel."""
    one, again, other = aorta(seed=3), aorta(seed=3), aorta(seed=4)
    np.testing.assert_array_equal(one.points, again.points)
    assert np.abs(one.points[one.outlets] - other.points[other.outlets]).max() > 1e-3


def test_ways_along_a_fork() -> None:
    """A stem of 2 m with two branches of 1 m: 3 m to either outlet, 2 m from one to the other."""
    points = np.array([(0, 0, 0), (0, 0, 1), (0, 0, 2), (0, 1, 2), (0, -1, 2), (0, -2, 2)], dtype=float)
    tree = VesselTree(points, np.full(6, 0.1), np.array([-1, 0, 1, 2, 2, 4]), 0, np.array([3, 4]))
    np.testing.assert_allclose(tree.length, [0, 1, 2, 3, 3, 4])
    np.testing.assert_allclose(tree.ways, [[3, 2, 1, 0, 2, 3], [3, 2, 1, 2, 0, 1]])
    np.testing.assert_array_equal(tree.towards, [[1, 2, 3, 3, 2, 4], [1, 2, 4, 2, 4, 4]])
    np.testing.assert_array_equal(tree.ahead(2.0), [[2, 3, 3, 3, 3, 2], [2, 4, 4, 4, 4, 4]])
    assert tree.forks.tolist() == [2]


def test_the_lumen_is_open_along_every_way() -> None:
    """On the centre lines the wall is a radius away, less what trilinear samples cut off a cone's tip."""
    tree = aorta(2, seed=5)
    vessel = Vessel.from_tubes(tree.tubes(), 0.002)
    inside = tree.points[3:]
    clear = vessel.clearance(inside)
    assert clear.min() > RADIUS - 0.75 * 0.002
    ring = inside[20] + 1.1 * RADIUS * np.array([(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)])
    assert vessel.clearance(ring).max() < 0.0


def test_what_is_no_vessel_is_refused() -> None:
    """Messages name the vessel and the fault."""
    with pytest.raises(MeshError, match=r"aorta: outlets must be finite positions"):
        aorta(np.zeros((2, 2)))
    with pytest.raises(MeshError, match=r"aorta: branches come within"):
        aorta(np.array([(0.03, 0.0, 1.0), (0.03, 0.0133, 1.0)]))
    with pytest.raises(MeshError, match=r"outlets 0 and 1 must be more than two radii, 0.0132 m, apart, got 0.005 m"):
        aorta(np.array([(0.03, 0.0, 1.0), (0.03, 0.005, 1.0)]), seed=0)  # at once, not after 200 random vessels
    with pytest.raises(MeshError, match=r"the place of outlet 1 must be more than 0.004 m above the inlet"):
        aorta(np.array([(0.03, 0.0, 1.0), (0.0, 0.0, 0.0)]))
    with pytest.raises(MeshError, match=r"aorta: outlets must be"):
        aorta(40)
    with pytest.raises(MeshError, match=r"every point but the first must follow"):
        VesselTree(np.eye(3), np.ones(3), np.array([-1, 2, 0]), 0, np.array([2]))
