"""Ways through branching vessels on the device: places, ways, forks, ends, against the tree that they are made from."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from softwarp.envs.vessel_ways import VesselWays
from softwarp.meshing import VesselTree

POINTS = np.array([(0, 0, 0), (0, 0, 1), (0, 0, 2), (0, 1, 2), (0, -1, 2), (0, -2, 2)], dtype=float)


@pytest.fixture(scope="module")
def ways() -> VesselWays:
    """A stem of 2 m, a branch of 1 m to either side; the second one goes on behind its outlet."""
    tree = VesselTree(POINTS, np.full(6, 0.1), np.array([-1, 0, 1, 2, 2, 4]), 0, np.array([3, 4]))
    return VesselWays([tree, tree], (1.0, 2.0), "cpu")


def test_way_left_is_continuous_along_the_stem_and_a_wrong_branch(ways: VesselWays) -> None:
    """From the outlet of the one branch, 1 m back to the fork and 1 m to the other; in between as the place says."""
    vessel, outlet = torch.zeros(4, dtype=torch.int64), torch.zeros(4, dtype=torch.int64)
    place = torch.tensor([[0.0, 0.0, 1.3], [0.02, 0.0, 0.8], [0.0, -1.2, 2.0], [0.0, 0.7, 2.0]])
    located = ways.locate(vessel, place)
    torch.testing.assert_close(ways.remaining(vessel, outlet, located), torch.tensor([1.7, 2.2, 2.2, 0.3]))
    torch.testing.assert_close(ways.leads_on(vessel, outlet, located), torch.tensor([1.0, 1.0, -1.0, 1.0]))
    torch.testing.assert_close(ways.room_left(vessel, located), torch.tensor([1.7, 2.2, 0.8, 0.3]))


def test_forks_and_sides(ways: VesselWays) -> None:
    """The next choice is the fork at 2 m, to +y or -y; behind it the outlet, without a side."""
    vessel, outlet = torch.zeros(3, dtype=torch.int64), torch.tensor([0, 1, 0])
    located = ways.locate(vessel, torch.tensor([[0.0, 0.0, 1.2], [0.0, 0.0, 1.2], [0.0, 0.9, 2.0]]))
    way, side = ways.next_fork(vessel, outlet, located)
    torch.testing.assert_close(way, torch.tensor([0.8, 0.8, 0.1]))
    torch.testing.assert_close(side, torch.tensor([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 0.0]]))
    ahead = ways.look_ahead(vessel, outlet, located)
    torch.testing.assert_close(ahead[0], torch.tensor([[0.0, 0.0, 2.0], [0.0, 1.0, 2.0]]))
    torch.testing.assert_close(ahead[1, 1], torch.tensor([0.0, -1.0, 2.0]))


def test_vessels_must_have_equally_many_outlets() -> None:
    """Tables are one array."""
    trees = [
        VesselTree(POINTS, np.full(6, 0.1), np.array([-1, 0, 1, 2, 2, 4]), 0, np.array(outlets))
        for outlets in ([3], [3, 4])
    ]
    with pytest.raises(ValueError, match=r"equally many outlets, got \[1, 2\]"):
        VesselWays(trees, (1.0,), "cpu")
