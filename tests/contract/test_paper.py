"""``softwarp paper``: parts are run once, kept, told beside the paper; one that fails leaves the others alone."""

import dataclasses

import pytest

from experiments import paper


@pytest.fixture
def counted(monkeypatch):
    """Two small parts that tell how often they ran; the second one fails as long as ``fails`` holds something."""
    ran, fails = [], [True]

    def first(folder, arguments):
        ran.append(("first", tuple(arguments)))
        (folder / "curve.png").write_bytes(b"")
        return "| ours |\n|---|\n| 1.5 |"

    def second(folder, arguments):
        ran.append(("second", tuple(arguments)))
        if fails:
            raise ValueError("no such robot")
        return "as theirs"

    blank = paper.PARTS["speed"]
    parts = {
        "first": dataclasses.replace(blank, title="Table 9", theirs="2.5", quick=("--few",), full=(), run=first),
        "second": dataclasses.replace(blank, title="Figure 9", quick=("--few",), full=(), run=second),
    }
    monkeypatch.setattr(paper, "PARTS", parts)
    return ran, fails


def test_parts_are_kept(counted, tmp_path, capsys):
    """Finished parts are not run again with the same settings; failed ones are; other settings are another study."""
    ran, fails = counted
    assert paper.main([str(tmp_path), "--quick"]) == 1
    text = (tmp_path / paper.PAGE).read_text()
    assert "| 1.5 |" in text and "**Theirs**: 2.5" in text and "first/curve.png" in text
    assert "ValueError: no such robot" in text
    fails.clear()
    assert paper.main([str(tmp_path), "--quick"]) == 0
    assert [name for name, _ in ran] == ["first", "second", "second"]
    assert "as theirs" in (tmp_path / paper.PAGE).read_text()
    assert "first: kept" in capsys.readouterr().out
    assert paper.main([str(tmp_path), "--only", "first"]) == 0
    assert ran[-1] == ("first", ())
    (tmp_path / paper.PAGE).unlink()
    assert paper.main([str(tmp_path), "--report-only"]) == 0
    assert len(ran) == 4 and "Table 9" in (tmp_path / paper.PAGE).read_text()


def test_a_damaged_record_is_run_again(counted, tmp_path):
    """Half a record, as a full disk leaves it elsewhere, counts as none."""
    ran, fails = counted
    fails.clear()
    (tmp_path / "first").mkdir()
    (tmp_path / "first" / paper.RECORD).write_text('{"arguments": ["--few"]')
    assert paper.main([str(tmp_path), "--quick", "--only", "first"]) == 0
    assert ran == [("first", ("--few",))]


def test_speed_is_measured(tmp_path):
    """Simulated time over that of the clock, beside the paper's."""
    text = paper.speed(tmp_path, ["--seconds", "0.2", "--tasks", "CartStem"])
    factor, times = map(float, text.splitlines()[-1].split("|")[3:5])
    assert "| CartStem | 3.6 |" in text and times == pytest.approx(factor / 3.6, rel=0.01) and factor > 0.0


@pytest.mark.slow
def test_quick_page(tmp_path):
    """The studies themselves, small; learning is tested with ``softwarp baselines``."""
    assert paper.main([str(tmp_path), "--quick", "--only", "speed", "table1", "obstacle", "mazes"]) == 0
    text = (tmp_path / paper.PAGE).read_text()
    assert "13.24" in text and "4 of 4" in text and "not run" in text and "**Failed**" not in text
