"""The list of what has no gradient, in the docs, against what the code says."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
FILES = sorted((ROOT / "softwarp" / "gradients").glob("*.py"))


def told() -> list[str]:
    """Phrases of the table, each part of an error."""
    text = (ROOT / "docs" / "gradients.md").read_text(encoding="utf-8")
    section = text.split("### What has none\n")[1].split("\n#")[0]
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| ")][1:]
    return [phrase for row in rows for phrase in re.findall(r'"([^"]*)"', row)]


def words(node: ast.AST) -> str:
    """All text in an expression."""
    return " ".join(
        part.value for part in ast.walk(node) if isinstance(part, ast.Constant) and isinstance(part.value, str)
    )


def messages(path: Path) -> list[str]:
    """Texts of what a file yields, returns and raises, with those of the names that these use."""
    found = []
    for function in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(function, ast.FunctionDef):
            continue
        held: dict[str, str] = {}
        for node in sorted(ast.walk(function), key=lambda each: getattr(each, "lineno", 0)):
            if isinstance(node, ast.Assign):
                for target in node.targets:
                    names = target.elts if isinstance(target, ast.Tuple) else [target]
                    for name in names:
                        if isinstance(name, ast.Name):
                            before = held.get(name.id, "") if name.id in _names(node.value) else ""
                            held[name.id] = before + words(node.value)
            elif isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Name):
                held[node.target.id] = held.get(node.target.id, "") + words(node.value)
            elif isinstance(node, ast.Yield | ast.Return | ast.Raise):
                found.append(words(node) + " " + " ".join(held.get(name, "") for name in _names(node)))
    return found


def _names(node: ast.AST) -> list[str]:
    return [part.id for part in ast.walk(node) if isinstance(part, ast.Name)]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_all_that_is_refused_is_in_the_list(path: Path) -> None:
    """Every error that tells of something without a gradient, or a rest shape, has a line."""
    phrases = told()
    for message in messages(path):
        tells = "no gradient" in message or "no rest shape" in message
        assert not tells or any(phrase in message for phrase in phrases), message


def test_all_of_the_list_is_refused() -> None:
    """No line stands for an error that is gone."""
    said = " ".join(message for path in FILES for message in messages(path))
    assert [phrase for phrase in told() if phrase not in said] == []
