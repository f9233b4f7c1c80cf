"""The kernel checker finds what it claims to find, and finds nothing in the repository."""

import ast
import importlib.util
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
spec = importlib.util.spec_from_file_location("check_kernels", ROOT / ".ci" / "check_kernels.py")
check_kernels = importlib.util.module_from_spec(spec)
sys.modules["check_kernels"] = check_kernels
spec.loader.exec_module(check_kernels)

GOOD = '''"""Markers. Theory: docs/theory/cholesky.md."""

@wp.func
def put(target: wp.array2d(dtype=S), w: int, value: S):
    """Store a value."""
    target[w, 0] = value

@wp.kernel(module=module)
def markers(
    # Model
    marker_node: wp.array(dtype=wp.int32),
    # State
    node_x_in: wp.array2d(dtype=S),
    count: int,
    # Workspace out
    marker_x_out: wp.array2d(dtype=S),
):
    """Copy the node of every marker."""
    world, marker = wp.tid()
    put(marker_x_out, world, node_x_in[world, marker_node[marker]])
'''

# What is replaced in GOOD, by what, and a part of the message that must follow.
BAD = [
    ("Markers. Theory: docs/theory/cholesky.md.", "Markers.", "names its page"),
    ("docs/theory/cholesky.md", "docs/theory/nowhere.md", "does not exist"),
    ("    # Model\n", "", "under no group comment"),
    ("# Model", "# Mesh", "unknown argument group 'Mesh'"),
    ("# Workspace out", "# Model", "stands after"),
    ("node_x_in", "node_x", "must end in '_in'"),
    ("marker_x_out", "marker_x", "must end in '_out'"),
    ("    marker_x_out: wp.array2d(dtype=S),\n", "    marker_x_out: wp.array2d(dtype=S) = None,\n", "no defaults"),
    ("count: int", "count", "has no type"),
    ("put(marker_x_out,", "put(node_x_in,", "'node_x_in' is written, but is not an output"),
    ("put(marker_x_out,", "put(node_x_in,", "output 'marker_x_out' is never written"),
    ("    world, marker = wp.tid()\n", "    print(count)\n    world, marker = wp.tid()\n", "no print"),
    ("    world, marker = wp.tid()\n", "    scale = 2\n    world, marker = wp.tid()\n", "first line of a kernel"),
    ("world, marker = wp.tid()", "item, marker = wp.tid()", "no thread index is the world"),
    ("    put(marker_x_out, world,", "    wp.atomic_add(marker_x_out, world, 0,", "without a comment"),
    ('    """Copy the node of every marker."""\n', "", "without a docstring"),
    ("    target[w, 0] = value\n", "    e = value\n    target[w, 0] = e.x\n", "'e' is a constant of Warp"),
    (
        "    target[w, 0] = value\n",
        "    for k in range(3):\n        target[w, k] = wp.static(A[k])\n",
        "wp.static of 'k'",
    ),
]


def findings(source: str, tmp_path: Path) -> list[str]:
    path = tmp_path / "markers.py"
    path.write_text(source)
    return [str(finding) for finding in check_kernels.check([path])]


def test_accepts_a_proper_file(tmp_path):
    """The example that the rejected ones are made from has no finding."""
    assert findings(GOOD, tmp_path) == []


@pytest.mark.parametrize(("old", "new", "message"), BAD, ids=[message for _, _, message in BAD])
def test_rejects(old, new, message, tmp_path):
    """One change breaks one rule, and the finding says which."""
    assert old in GOOD
    assert any(message in finding for finding in findings(GOOD.replace(old, new), tmp_path))


@pytest.mark.slow  # .ci/lint.sh does the same
def test_repository_follows_the_rules():
    """No finding in softwarp/kernels."""
    assert [str(finding) for finding in check_kernels.check(sorted(check_kernels.KERNELS.rglob("*.py")))] == []


def test_kernels_that_lanes_share_use_nothing_of_lanes() -> None:
    """Factories below ``single_worlds`` get the variant of one world in place of lanes, so they may not ask for S."""
    found, shared = [], 0
    for path in sorted((ROOT / "softwarp" / "kernels").rglob("*.py")):
        for factory in ast.parse(path.read_text()).body:
            if isinstance(factory, ast.FunctionDef) and "single_worlds" in map(ast.unparse, factory.decorator_list):
                shared += 1
                asked = {ast.unparse(node) for node in ast.walk(factory) if isinstance(node, ast.Attribute)}
                found += [f"{path.name}: {name}" for name in asked & {"variant.S", "variant.lanes", "variant.name"}]
    assert shared > 20
    assert not found
