"""A figure that several pages quote is the same on all of them, and that of its record.

``docs/figures.json`` lists figures: a ``value`` with its ``source``, or a ``field`` of the one entry of a ``record`` in
which all of ``where`` holds, times ``factor``, to ``digits`` significant ones; and the sentences that quote it, page by
page, with the figure as a format. Whoever measures anew changes record or value, and this test names the sentences
that are left behind.
"""

import json
import math
import re
from pathlib import Path
from typing import Any

import pytest

from benchmarks import cantilever

ROOT = Path(__file__).parents[2]
FIGURES = json.loads((ROOT / "docs" / "figures.json").read_text(encoding="utf-8"))
FORMAT = re.compile(r"\{:[^}]*\}")


def value_of(figure: dict[str, Any]) -> float:
    """The figure itself, or from its record."""
    if "value" in figure:
        return float(figure["value"])
    records = json.loads((ROOT / figure["record"]).read_text(encoding="utf-8"))
    found = [record for record in records if figure["where"].items() <= record.items()]
    assert len(found) == 1, f"{figure['record']}: {len(found)} entries with {figure['where']}"
    value = float(found[0][figure["field"]]) * figure.get("factor", 1.0)
    return round(value, figure["digits"] - 1 - math.floor(math.log10(value))) if "digits" in figure else value


def flat(text: str) -> str:
    """Text on one line, as pages break theirs anywhere."""
    return " ".join(text.split())


def check(figure: dict[str, Any], pages: dict[str, str]) -> list[str]:
    """What is wrong with the quotes of a figure, in pages by their path."""
    wrong = []
    for page, sentences in figure["quotes"].items():
        for sentence in sentences:
            expected = FORMAT.sub(lambda form: form[0].format(value_of(figure)).replace(",", " "), sentence)
            before, after = map(re.escape, FORMAT.split(sentence))
            found = re.findall(rf"{before}\d[\d. ]*{after}", flat(pages[page]))
            if set(found) != {expected}:
                wrong.append(f"{page} has to say {expected!r}, says {found or 'nothing of the kind'}")
    return wrong


@pytest.mark.parametrize("figure", FIGURES, ids=lambda figure: figure["figure"])
def test_quotes_agree_with_their_record(figure):
    """Every sentence is on its page, with the figure of the record and no other."""
    pages = {page: (ROOT / page).read_text(encoding="utf-8") for page in figure["quotes"]}
    assert not check(figure, pages)


def test_figures_have_a_source():
    """Each is a value with its source, or comes from a record; names differ, and two places at least agree."""
    assert len({figure["figure"] for figure in FIGURES}) == len(FIGURES)
    for figure in FIGURES:
        assert ("source" in figure) == ("value" in figure) != ("record" in figure), figure["figure"]
        quotes = sum(len(sentences) for sentences in figure["quotes"].values())
        assert quotes + ("record" in figure) >= 2, figure["figure"]


def test_figures_that_stand_in_code_are_those():
    """The constants of the cantilever are the figures of the pages."""
    told = {figure["figure"]: figure.get("value") for figure in FIGURES}
    for name, constant in (("converged", cantilever.CONVERGED), ("linear tetrahedra", cantilever.LINEAR)):
        assert 1e3 * constant == pytest.approx(told[f"sag of the silicone cantilever, {name} [mm]"])


def test_disagreement_is_told():
    """Another number, a second one beside the right one, and a sentence that has gone are each found."""
    figure = {"figure": "way", "value": 12.34, "source": "here", "quotes": {"a.md": ["the way is {:.1f} mm long"]}}
    assert check(figure, {"a.md": "So the way is\n12.3 mm long."}) == []
    (told,) = check(figure, {"a.md": "So the way is 12.4 mm long."})
    assert told == "a.md has to say 'the way is 12.3 mm long', says ['the way is 12.4 mm long']"
    assert check(figure, {"a.md": "the way is 12.3 mm long, or the way is 13 mm long"})
    assert "nothing of the kind" in check(figure, {"a.md": "It is long."})[0]
