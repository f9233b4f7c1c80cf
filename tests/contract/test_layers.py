"""Import arrows point down: a file imports lower layers or its own folder; heavy packages stay where they belong."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

# Lowest first. Names on one line may not import each other.
LAYERS = (
    ("advice",),
    ("meshing",),
    ("shapes",),
    ("model",),
    ("kernels",),
    ("scene",),
    ("plan",),
    ("solvers",),
    ("interop",),
    ("diagnostics", "snapshot"),
    ("builder", "simulation"),
    ("io",),
    ("render",),
    ("envs", "policies"),
    ("gym",),
    ("training", "planning", "control"),
    ("experiments",),
    ("cli",),
    ("benchmarks",),
    ("__main__",),
)
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}

CLIENTS = {"io", "envs", "policies", "gym", "training", "planning", "control", "experiments", "benchmarks"}

# Third-party packages and the only places that may name them.
HOMES = {
    "torch": {"interop", "snapshot", "diagnostics", "simulation", *CLIENTS},
    "torchrl": {"envs", "policies", "training", "experiments"},
    "tensordict": {"envs", "policies", "gym", "training", "planning", "control", "experiments"},
    "gymnasium": {"envs", "gym", "experiments"},
    "stable_baselines3": {"experiments"},
    "hydra": {"experiments", "cli"},
    "omegaconf": {"experiments", "cli"},
    "pxr": {"io"},
    "matplotlib": {"render", "training", "planning", "experiments", "benchmarks"},
}


def sources() -> list[Path]:
    """Every Python file that is installed."""
    files = [path for folder in ("softwarp", "experiments", "benchmarks") for path in (ROOT / folder).rglob("*.py")]
    return sorted(path for path in files if path != ROOT / "softwarp" / "__init__.py")


def module_parts(path: Path) -> tuple[str, ...]:
    """Dotted name below ``softwarp`` of a file, for example ("kernels", "cable")."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts[1:] if parts[0] == "softwarp" else parts
    return parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts


def type_only(tree: ast.Module) -> set[ast.AST]:
    """Everything under ``if TYPE_CHECKING``: names for annotations, which never run."""
    blocks = (node for node in ast.walk(tree) if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    return {node for block in blocks for statement in block.body for node in ast.walk(statement)}


def imports(path: Path) -> Iterator[tuple[int, str]]:
    """Line and absolute dotted name of everything a file imports to run, also inside functions."""
    package = (
        ("softwarp", *module_parts(path)) if path.name == "__init__.py" else ("softwarp", *module_parts(path)[:-1])
    )
    tree = ast.parse(path.read_text(), str(path))
    skipped = type_only(tree)
    for node in ast.walk(tree):
        if node in skipped:
            continue
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join((*base, *(node.module or "").split("."))).strip(".")
            for alias in node.names:
                yield node.lineno, f"{module}.{alias.name}"


def layer_of(name: str) -> str | None:
    """The layer a dotted import names, "" for the bare package, None for another package."""
    parts = name.split(".")
    if parts[0] == "experiments":
        return "experiments"
    if parts[0] != "softwarp":
        return None
    return parts[1] if len(parts) > 1 and parts[1] in RANK else ""


@pytest.mark.parametrize("path", sources(), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_down(path):
    """No file imports its own rank (outside its folder), a higher one, or the bare package below the top layers."""
    own = module_parts(path)[0]
    assert own in RANK, f"{path.name}: add the layer {own!r} to LAYERS"
    for line, name in imports(path):
        layer = layer_of(name)
        if layer is None or layer == own:
            continue
        if layer == "":
            assert RANK[own] >= RANK["envs"], (
                f"{path.name}:{line} imports the bare package ({name}); name the file instead"
            )
        else:
            assert RANK[layer] < RANK[own], f"{path.name}:{line} imports {name}, which lies above {own}"


@pytest.mark.parametrize("path", sources(), ids=lambda path: str(path.relative_to(ROOT)))
def test_heavy_packages_stay_in_their_layers(path):
    """Torch, Hydra, USD and plotting are named only by the layers that are about them."""
    own = module_parts(path)[0]
    for line, name in imports(path):
        homes = HOMES.get(name.split(".")[0])
        assert homes is None or own in homes, f"{path.name}:{line} imports {name}; allowed in {sorted(homes)}"
