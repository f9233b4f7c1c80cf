"""The list of mutants fits the code: what it changes is there, what should notice is there, and its runner tells."""

import ast
import re
from collections import Counter
from pathlib import Path

import pytest

from benchmarks.mutants import MUTANTS, Mutant
from benchmarks.mutations import Copy, changed, table

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_mutants_change_code_that_is_there(mutant):
    """``old`` stands in its file exactly once, and what comes out is another program that parses."""
    text = (ROOT / mutant.file).read_text(encoding="utf-8")
    wrong = changed(mutant, text)
    assert ast.dump(ast.parse(wrong)) != ast.dump(ast.parse(text))
    for test in mutant.tests:
        file, _, name = test.partition("::")
        held = (ROOT / file).read_text(encoding="utf-8")
        assert not name or re.search(rf"^def {name}\(", held, re.MULTILINE), f"{file} has no {name}"


def test_every_mutant_has_a_name_of_its_own():
    """Names tell outcomes apart."""
    assert max(Counter(mutant.name for mutant in MUTANTS).values()) == 1


def test_a_mutant_that_moved_is_told():
    """The message names mutant, file and text, and says what to do."""
    mutant = Mutant("gone", "softwarp/advice.py", "no such text", "", ())
    with pytest.raises(ValueError, match=r"'gone': softwarp/advice.py holds 'no such text' 0 times.*mutants.py up to"):
        changed(mutant, "text")


@pytest.fixture
def checkout(tmp_path):
    """A checkout with one function and two tests, of which one looks at what it gives."""
    root = tmp_path / "root"
    for folder in ("softwarp", "tests"):
        (root / folder).mkdir(parents=True)
    (root / "softwarp" / "__init__.py").write_text("def double(x):\n    return 2 * x\n")
    test = "import softwarp\n\n\ndef test_{}():\n    {}\n"
    (root / "tests" / "test_blind.py").write_text(test.format("blind", "softwarp.double(1)"))
    (root / "tests" / "test_seeing.py").write_text(test.format("seeing", "assert softwarp.double(3) == 6"))
    (root / "tests" / "test_slow.py").write_text(test.format("slow", "while softwarp.double(1) == 3: pass"))
    return root


def test_outcomes_are_told_apart(checkout, tmp_path):
    """A change that is noticed, one that is not and one that hangs; the checkout keeps every byte."""
    (tmp_path / "scratch").mkdir()
    copy = Copy(tmp_path / "scratch", checkout)

    def outcome(*names, limit=60.0):
        tests = tuple(f"tests/test_{name}.py" for name in names)
        return copy.try_out(Mutant(names[-1], "softwarp/__init__.py", "2 * x", "3 * x", tests), limit)

    outcomes = [outcome("blind", "seeing"), outcome("blind")]
    assert [(o.verdict, o.by) for o in outcomes] == [
        ("killed", "tests/test_seeing.py::test_seeing"),
        ("survived", ""),
    ]
    for root in (checkout, copy.root):
        assert "2 * x" in (root / "softwarp" / "__init__.py").read_text()
    told = table(outcomes).splitlines()
    assert told[2] == "| blind | `softwarp/__init__.py` | survived | - |"
    assert told[3] == "| seeing | `softwarp/__init__.py` | killed | test_seeing |"


@pytest.mark.slow
def test_what_cannot_be_run_is_no_outcome(checkout, tmp_path):
    """A selection that names no test says nothing about the mutant."""
    (tmp_path / "scratch").mkdir()
    nowhere = Mutant("nowhere", "softwarp/__init__.py", "2 * x", "3 * x", ("tests/test_blind.py::test_other",))
    with pytest.raises(RuntimeError, match="mutant 'nowhere': pytest ended with code 4; it told"):
        Copy(tmp_path / "scratch", checkout).try_out(nowhere, 60.0)


@pytest.mark.slow
def test_tests_that_hang_are_ended(checkout, tmp_path):
    """A change that lets a loop run for ever counts as noticed."""
    (tmp_path / "scratch").mkdir()
    (checkout / "softwarp" / "__init__.py").write_text("def double(x):\n    return 2 * x + (x == 1)\n")
    copy = Copy(tmp_path / "scratch", checkout)
    code, _ = copy.run(["tests/test_slow.py"], 3.0)
    assert code is None
