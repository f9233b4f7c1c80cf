"""The quadruped that turns to headings: when it arrives, the table, and the hand-written wave on the reduced model."""

import json

import pytest

from experiments import heading_study
from experiments.heading_study import Turn


def test_it_has_arrived_where_it_stays():
    left = [[20.0, 11.0, 9.0, 8.0], [20.0, 9.0, 11.0, 12.0], [-15.0, -9.0, -12.0, 9.0], [5.0, 4.0, 3.0, 2.0]]
    shown = Turn("wave", "full", left, way=[1.0, 2.0, 3.0, 4.0], failed=[False, True, False, False])
    assert shown.arrivals(10.0) == [2, None, 3, 0]
    last = heading_study.table([shown], 10.0).splitlines()[-1]
    assert last == "| wave | full | 3 of 4 | 2, 3 | 7.8 | 2.5 | 1 |"


@pytest.mark.slow
def test_the_wave_turns_both_ways(tmp_path):
    """One cycle of the hand-written wave turns the reduced robot by 1.2 degrees, to the left and to the right."""
    file = tmp_path / "headings.json"
    arguments = ["--models", "reduced", "--actions", "8", "--headings", "2", "--json", str(file)]
    (shown,) = heading_study.main(arguments)
    assert shown.policy == heading_study.HAND and shown.failed == [False, False]
    for left, sign in zip(shown.left, (-1.0, 1.0), strict=True):
        assert left[0] == pytest.approx(sign * heading_study.LARGEST, abs=0.01)
        assert sign * (left[4] - left[8]) == pytest.approx(1.21, abs=0.1)
    assert json.loads(file.read_text())[0]["left"] == shown.left
