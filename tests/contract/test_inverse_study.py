"""The study of inverse control, at a small size: goals of the split in order, what is written, what is refused."""

import json

import pytest

from experiments import inverse_study


@pytest.mark.slow
def test_diamond(tmp_path, monkeypatch):
    """Three goals in batches of two: all within half a millimetre; the circle's lag is that of one to two periods."""
    monkeypatch.setattr(inverse_study, "WORLDS", 2)
    picture, record = tmp_path / "inverse.png", tmp_path / "inverse.json"
    options = ["--goals", "3", "--seconds", "5", "--tasks", "Diamond", "--json", str(record)]
    result = inverse_study.main([str(picture), *options])
    placed = result["Diamond"]["placement"]
    assert placed["goals"] == 3 and placed["reached"] == placed["settled"] == 1.0
    assert placed["median"] <= placed["worst"] < inverse_study.REACHED
    assert 0.0 < result["Diamond"]["circle"]["rms"] < 0.5e-3
    assert json.loads(record.read_text()) == result
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_more_goals_than_there_are():
    with pytest.raises(ValueError, match=r"Diamond has \d+ goals for evaluation, give 1 to \d+, got 100000"):
        inverse_study.placement("Diamond", 100_000)
