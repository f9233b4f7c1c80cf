"""What the source of a class tells of its fields: comments behind or above them, and the docstring's Attributes.

Needs nothing but Python: docs/generate.py reads it without importing softwarp.
"""

import ast


def trailing_comment(lines: list[str], node: ast.AnnAssign) -> str:
    """Comment behind a field, or directly above it."""
    code = lines[(node.end_lineno or node.lineno) - 1]
    behind = code[node.end_col_offset :].partition("#")[2].strip()
    if behind:
        return behind
    above = []
    for line in reversed(lines[: node.lineno - 1]):
        if not line.strip().startswith("#"):
            break
        above.append(line.strip().lstrip("# "))
    return " ".join(reversed(above))


def attribute_notes(node: ast.ClassDef) -> dict[str, str]:
    """Descriptions in the ``Attributes:`` section of a class docstring."""
    _, found, section = (ast.get_docstring(node) or "").partition("Attributes:\n")
    notes: dict[str, str] = {}
    name = ""
    for line in section.splitlines() if found else []:
        if line.strip() and not line.startswith(" "):
            break
        indent = len(line) - len(line.lstrip())
        if indent == 4 and ":" in line:
            name, _, text = line.strip().partition(":")
            notes[name] = text.strip()
        elif line.strip() and name:
            notes[name] += f" {line.strip()}"
    return notes


def field_notes(source: str) -> dict[str, str]:
    """What is told of each field of the class that ``source`` defines."""
    [node] = [entry for entry in ast.parse(source).body if isinstance(entry, ast.ClassDef)]
    documented, lines = attribute_notes(node), source.splitlines()
    fields = [entry for entry in node.body if isinstance(entry, ast.AnnAssign) and isinstance(entry.target, ast.Name)]
    return {
        entry.target.id: documented.get(entry.target.id) or trailing_comment(lines, entry)
        for entry in fields
        if isinstance(entry.target, ast.Name)
    }
