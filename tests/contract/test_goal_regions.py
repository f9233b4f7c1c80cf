"""The study of goal regions: its table, its file, and what it says of the hand-written policies."""

import json

from experiments import goal_regions


def test_table_and_file(tmp_path, capsys):
    """Leaning reaches everything, the direct approach what is in the open; the file holds the same rows."""
    rows = goal_regions.main(["--episodes", "32", "--json", str(tmp_path / "regions.json")])
    assert rows["scripted"].success[-1] == 1.0
    assert rows["direct"].success[:2] == [0.0, 0.0] and rows["direct"].success[3] == 1.0
    assert sum(rows["direct"].episodes[:-1]) == rows["direct"].episodes[-1] == 32
    assert rows["random"].success[-1] < 0.5
    text = capsys.readouterr().out.splitlines()[-4:]
    assert "29-35 mm (open)" in text[0] and text[1].split()[0] == "direct"
    assert json.loads((tmp_path / "regions.json").read_text())["direct"]["success"] == rows["direct"].success
