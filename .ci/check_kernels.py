"""Check the rules of ``softwarp/kernels`` on the syntax tree: ``python .ci/check_kernels.py``. Needs only Python.

For every file: a docstring whose theory page exists, no print. For every kernel: a docstring; annotated arguments
without defaults, in the order topology, parameters, state, control, workspace, outputs, each group under its comment
(scalars may also stand first); thread indices on the first line, one of them the world; arrays named ``_in`` are never
written, those named ``_out`` are, all others (model and schedules) are read only, also through functions; a comment at
every atomic. For every kernel and function: nothing that Warp hashes otherwise once it has compiled it, so that a
module has one name in the cache whatever has been compiled before it.
"""

import ast
import io
import sys
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
KERNELS = ROOT / "softwarp" / "kernels"

# Group comments of a kernel's arguments, in the order they must appear in.
GROUPS = (
    "Symbolic",
    "Model",
    "State",
    "Control",
    "Workspace in",
    "Samples in",
    "State out",
    "Workspace out",
    "Samples out",
)
SUFFIX = {"State": "_in", "Control": "_in", "Workspace in": "_in", "Samples in": "_in"}
SUFFIX |= {"State out": "_out", "Workspace out": "_out", "Samples out": "_out"}
WORLD_NAMES = {"w", "world", "pack", "group", "sample"}  # packs and groups hold worlds; samples are not simulated
# Constants of Warp, for which it takes local variables of the same name where it hashes what stands behind their dots.
CONSTANTS = {"e", "inf", "ln2", "ln10", "log2e", "log10e", "nan", "phi", "pi", "half_pi", "tau"}
CONSTANTS |= {name.upper() for name in CONSTANTS}
WITHOUT_THEORY = {"transfer"}  # copies between memory layouts
KERNEL_LINES = 120  # vectors are written out by component, because SIMD lanes take the place of scalars


@dataclass(frozen=True)
class Finding:
    """One broken rule."""

    path: Path
    line: int
    message: str

    def __str__(self) -> str:
        """Clickable form, path relative to the repository where it lies inside."""
        path = self.path.relative_to(ROOT) if self.path.is_relative_to(ROOT) else self.path
        return f"{path}:{self.line}: {self.message}"


def decorated(tree: ast.AST, kind: str) -> list[ast.FunctionDef]:
    """Functions under ``@wp.kernel`` or ``@wp.func``, with or without arguments, wherever they are defined."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            names = (ast.unparse(d.func if isinstance(d, ast.Call) else d) for d in node.decorator_list)
            if f"wp.{kind}" in names:
                found.append(node)
    return found


def base_name(node: ast.AST) -> str | None:
    """``a`` of ``a[i, j].x``, None where nothing is indexed."""
    indexed = False
    while isinstance(node, ast.Subscript | ast.Attribute):
        indexed = indexed or isinstance(node, ast.Subscript)
        node = node.value
    return node.id if indexed and isinstance(node, ast.Name) else None


def writes(function: ast.FunctionDef, written_by: dict[str, set[int]]) -> set[str]:
    """Names whose elements a function stores to, directly, by an atomic, or through a function that does."""
    names: set[str | None] = set()
    for node in ast.walk(function):
        if isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            for target in targets:
                parts = target.elts if isinstance(target, ast.Tuple) else [target]
                names |= {base_name(part) for part in parts}
        elif isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if called.startswith(("wp.atomic_", "wp.tile_store", "wp.tile_atomic")):
                names.add(node.args[0].id if isinstance(node.args[0], ast.Name) else base_name(node.args[0]))
            for index in written_by.get(called.rsplit(".", 1)[-1], ()):
                if index < len(node.args) and isinstance(node.args[index], ast.Name):
                    names.add(node.args[index].id)
    return {name for name in names if name is not None}


def written_parameters(trees: list[ast.AST]) -> dict[str, set[int]]:
    """For each Warp function of all files, the positions of the arguments it writes to, followed through calls.

    Functions of native code name what they write ``_out``.
    """
    functions = [function for tree in trees for function in decorated(tree, "func")]
    result: dict[str, set[int]] = {function.name: set() for function in functions}
    for function in (function for tree in trees for function in decorated(tree, "func_native")):
        names = [argument.arg for argument in function.args.args]
        result[function.name] = {index for index, name in enumerate(names) if name.endswith("_out")}
    changed = True
    while changed:
        changed = False
        for function in functions:
            stored = writes(function, result)
            found = {index for index, arg in enumerate(function.args.args) if arg.arg in stored}
            if not found <= result[function.name]:
                result[function.name] |= found
                changed = True
    return result


def comments(source: str) -> dict[int, str]:
    """Comment text by line number."""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}


def is_array(argument: ast.arg) -> bool:
    """Whether an argument's annotation is a Warp array of any form."""
    return argument.annotation is not None and "array" in ast.unparse(argument.annotation)


def check_arguments(kernel: ast.FunctionDef, notes: dict[int, str], stored: set[str]) -> Iterator[tuple[int, str]]:
    """Grouping, order, suffixes and access of a kernel's arguments."""
    if kernel.args.defaults or kernel.args.kwonlyargs or kernel.args.vararg or kernel.args.kwarg:
        yield kernel.lineno, "kernel arguments are positional and have no defaults"
    group, last = None, kernel.lineno
    for argument in kernel.args.args:
        for line in range(last, argument.lineno):
            if line not in notes:
                continue
            if notes[line] not in GROUPS:
                yield line, f"unknown argument group {notes[line]!r}; use one of {', '.join(GROUPS)}"
            elif group in GROUPS and GROUPS.index(notes[line]) <= GROUPS.index(group):
                yield line, f"argument group {notes[line]!r} stands after {group!r}; the order is {', '.join(GROUPS)}"
            group = notes[line]
        last = argument.lineno
        name = argument.arg
        if argument.annotation is None:
            yield argument.lineno, f"argument {name!r} has no type"
        if group is None and is_array(argument):
            yield argument.lineno, f"argument {name!r} stands under no group comment"
        if is_array(argument) and group in SUFFIX and not name.endswith(SUFFIX[group]):
            yield argument.lineno, f"array {name!r} under {group!r} must end in {SUFFIX[group]!r}"
        if group and group not in SUFFIX and name.endswith(("_in", "_out")):
            yield argument.lineno, f"{name!r} stands under {group!r}, whose arguments have no suffix"
        if name.endswith("_out") and name not in stored:
            yield argument.lineno, f"output {name!r} is never written"
        if not name.endswith("_out") and name in stored:
            yield argument.lineno, f"{name!r} is written, but is not an output"


def check_body(kernel: ast.FunctionDef) -> Iterator[tuple[int, str]]:
    """Docstring, thread indices and length of a kernel."""
    if ast.get_docstring(kernel) is None:
        yield kernel.lineno, "kernel without a docstring"
        return
    first = kernel.body[1] if len(kernel.body) > 1 else kernel.body[0]
    if not (isinstance(first, ast.Assign) and ast.unparse(first.value) == "wp.tid()"):
        yield first.lineno, "the first line of a kernel names the thread indices: world, item = wp.tid()"
        return
    target = first.targets[0]
    names = {
        part.id for part in (target.elts if isinstance(target, ast.Tuple) else [target]) if isinstance(part, ast.Name)
    }
    if not names & WORLD_NAMES:
        yield first.lineno, f"no thread index is the world; name one of them {' or '.join(sorted(WORLD_NAMES))}"
    end = kernel.end_lineno or kernel.lineno
    if end - first.lineno + 1 > KERNEL_LINES:
        yield (
            kernel.lineno,
            f"{end - first.lineno + 1} lines of code; at most {KERNEL_LINES}, move element math to functions",
        )


def check_calls(tree: ast.AST, notes: dict[int, str]) -> Iterator[tuple[int, str]]:
    """No print anywhere; atomics say why."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if called in ("print", "wp.printf"):
                yield node.lineno, "no print in kernel files"
            if called.startswith("wp.atomic_") and not {node.lineno, node.lineno - 1} & set(notes):
                yield node.lineno, f"{called} without a comment on what it gains over a gather"


def check_header(path: Path, tree: ast.Module) -> Iterator[tuple[int, str]]:
    """A docstring; files with kernels name their theory page, which exists."""
    text = ast.get_docstring(tree)
    if text is None:
        yield 1, "file without a docstring"
        return
    pages = [word.strip("`.,;:()") for word in text.split() if word.startswith(("docs/", "`docs/", "(docs/"))]
    if decorated(tree, "kernel") and not pages and path.stem not in WITHOUT_THEORY:
        yield 1, "the docstring of a file with kernels names its page, docs/theory/<concept>.md"
    for page in pages:
        if not (ROOT / page).exists():
            yield 1, f"the page {page} does not exist"


def check_hash(function: ast.FunctionDef) -> Iterator[tuple[int, str]]:
    """What makes the hash of a function depend on whether Warp has compiled it before."""
    for node in ast.walk(function):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in CONSTANTS:
            yield node.lineno, f"{node.value.id!r} is a constant of Warp: give the variable another name"
        if not isinstance(node, ast.For):
            continue
        targets = {name.id for name in ast.walk(node.target) if isinstance(name, ast.Name)}
        for call in (call for line in node.body for call in ast.walk(line) if isinstance(call, ast.Call)):
            names = {name.id for name in ast.walk(call) if isinstance(name, ast.Name)}
            if ast.unparse(call.func) == "wp.static" and names & targets:
                yield call.lineno, f"wp.static of {sorted(names & targets)[0]!r} of a loop: index a vector of constants"


def check(paths: list[Path]) -> list[Finding]:
    """All broken rules of some kernel files."""
    sources = {path: path.read_text(encoding="utf-8") for path in paths}
    trees = {path: ast.parse(source, str(path)) for path, source in sources.items()}
    written_by = written_parameters(list(trees.values()))
    findings = []
    for path, tree in trees.items():
        notes = comments(sources[path])
        found = [*check_header(path, tree), *check_calls(tree, notes)]
        for kernel in decorated(tree, "kernel"):
            found += [*check_arguments(kernel, notes, writes(kernel, written_by)), *check_body(kernel)]
        for function in (*decorated(tree, "kernel"), *decorated(tree, "func")):
            found += check_hash(function)
        findings += [Finding(path, line, message) for line, message in found]
    return sorted(findings, key=lambda finding: (finding.path, finding.line))


def main() -> int:
    """Print findings; the exit status is 1 if there are any."""
    paths = sorted(KERNELS.rglob("*.py"))
    findings = check(paths)
    for finding in findings:
        print(finding)
    print(f"{len(paths)} kernel files, {len(findings)} findings")
    return 1 if findings or not paths else 0


if __name__ == "__main__":
    sys.exit(main())
