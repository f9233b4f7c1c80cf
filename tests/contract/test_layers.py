"""Import arrows point down: a file imports lower layers or its own folder; heavy packages stay where they belong."""

import ast
from collections.abc import Iterator, Sequence
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[2]

# Lowest first. Names on one line may not import each other; what is listed is a file or a folder below softwarp.
LAYERS = (
    ("host", "notices", "remembered", "unpicklable"),
    ("kernel_cache", "recording"),
    ("compiling",),
    ("advice", "checks", "io.atomic", "io.bounded", "threads"),
    ("ranges",),
    ("meshing",),
    ("shapes",),
    ("model",),
    ("kernels.algebra",),
    ("kernels.collision", "kernels.elements", "kernels.inverse", "kernels.linear", "kernels.step"),
    ("kernels.frames", "kernels.rows"),
    ("scene",),
    ("plan",),
    ("solvers.options",),
    ("solvers.workspace",),
    ("solvers.collision", "solvers.linear", "solvers.partition"),
    ("solvers.sharing", "solvers.subspace"),
    ("solvers.sides",),
    ("solvers.response",),
    ("solvers.terms",),
    ("solvers.looks",),
    ("solvers.multipliers",),
    ("solvers.system",),
    ("solvers.adjoint_index",),
    ("solvers.cavity_adjoint", "solvers.contact_adjoint", "solvers.element_adjoint", "solvers.newton_control"),
    ("solvers.frame_adjoint", "solvers.newton_contacts"),
    ("solvers.joint_sides",),
    ("solvers.leaning_adjoint", "solvers.membrane_adjoint", "solvers.hex_adjoint"),
    ("solvers.floating_adjoint",),
    ("solvers.mode_adjoint", "solvers.solution"),
    ("solvers.adjoint", "solvers.contact_directional"),
    ("solvers.implicit_euler", "solvers.outputs", "solvers.quasi_static"),
    ("solvers.repeats",),
    (
        *("solvers.directional", "solvers.frame_tangent", "solvers.joint_adjoint"),
        *("solvers.second_order", "solvers.stage_adjoint", "solvers.static_adjoint"),
    ),
    ("solvers.look_adjoint", "solvers.newton_joints"),
    ("solvers.look_directional", "solvers.newton_adjoint", "solvers.static_newton"),
    ("solvers.second_order_adjoint",),
    ("solvers.footprint", "solvers.trapezoidal_adjoint"),
    ("solvers.inverse", "solvers.relaxation"),
    ("interop",),
    ("hex_tensors",),
    ("diagnostics", "growth"),
    ("modal", "reactions", "static_advice", "stresses"),
    ("measures", "snapshot", "statics"),
    ("bricks", "telescopes", "tendons"),
    ("builder", "simulation"),
    ("gradients",),
    ("identification", "io", "reduction"),
    ("render",),
    ("view",),
    ("envs", "policies"),
    ("gym",),
    ("sb3", "training", "planning", "control"),
    ("deploy",),
    ("processes",),
    ("jobs",),
    ("experiments",),
    ("cli",),
    ("benchmarks",),
    ("__main__",),
)
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}

CLIENTS = {
    "io",
    "view",
    "envs",
    "policies",
    "gym",
    "sb3",
    "training",
    "planning",
    "control",
    "deploy",
    "experiments",
    "benchmarks",
}

# Third-party packages and the only places that may name them.
HOMES = {
    "torch": {
        "interop",
        "snapshot",
        "diagnostics",
        "gradients",
        "growth",
        "hex_tensors",
        "identification",
        "measures",
        "reactions",
        "statics",
        "stresses",
        "simulation",
        "reduction",
        *CLIENTS,
    },
    "torchrl": {"envs", "policies", "training", "deploy", "experiments"},
    "tensordict": {"envs", "policies", "gym", "training", "planning", "control", "deploy", "experiments"},
    "viser": {"view"},
    "onnx": {"deploy"},
    "onnxruntime": {"deploy"},
    "gymnasium": {"envs", "gym", "sb3", "training", "experiments"},
    "minari": {"training"},
    "mlflow": {"training"},
    "stable_baselines3": {"sb3", "experiments"},
    "skrl": {"experiments"},
    "ray": {"experiments"},
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


@cache
def imports(path: Path) -> list[tuple[int, str]]:
    """Line and absolute dotted name of everything a file imports, also inside functions and for annotations only."""
    return list(_imports(path))


def _imports(path: Path) -> Iterator[tuple[int, str]]:
    package = (
        ("softwarp", *module_parts(path)) if path.name == "__init__.py" else ("softwarp", *module_parts(path)[:-1])
    )
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join((*base, *(node.module or "").split("."))).strip(".")
            for alias in node.names:
                yield node.lineno, f"{module}.{alias.name}"


def layer(parts: Sequence[str]) -> str | None:
    """The listed folder or file that a dotted name below softwarp belongs to, None for none."""
    names = (".".join(parts[:count]) for count in range(len(parts), 0, -1))
    return next((name for name in names if name in RANK), None)


def layer_of(name: str) -> str | None:
    """The layer a dotted import names, "" for the bare package, None for another package."""
    parts = name.split(".")
    if parts[0] == "experiments":
        return "experiments"
    if parts[0] != "softwarp":
        return None
    return layer(parts[1:]) or ""


def wrong_way(path: Path) -> Iterator[str]:
    """Imports of a file that point at its own rank (outside its folder), up, or at the bare package from below."""
    own = layer(module_parts(path))
    if own is None and path.name == "__init__.py":
        return
    if own is None:
        yield f"{path.name}: add its folder or file to LAYERS"
        return
    for line, name in imports(path):
        other = layer_of(name)
        if other is None or other == own:
            continue
        if other == "":
            if RANK[own] < RANK["envs"]:
                yield f"{path.name}:{line} imports the bare package ({name}); name the file instead"
        elif RANK[other] >= RANK[own]:
            yield f"{path.name}:{line} imports {name}, which lies above {own}"


def test_imports_point_down():
    """No file imports its own rank (outside its folder), a higher one, or the bare package below the top layers."""
    assert not [problem for path in sources() for problem in wrong_way(path)]


def test_heavy_packages_stay_in_their_layers():
    """Torch, Hydra, USD and plotting are named only by the layers that are about them."""
    strangers = [
        f"{path.name}:{line} imports {name}; allowed in {sorted(homes)}"
        for path in sources()
        for line, name in imports(path)
        if (homes := HOMES.get(name.split(".")[0])) is not None and module_parts(path)[0] not in homes
    ]
    assert not strangers


def test_the_list_is_the_tree():
    """Every layer is a file or a folder, and every folder of sources belongs to a layer."""
    modules = {module_parts(path) for path in sources()}
    for name in RANK:
        parts = tuple(name.split("."))
        assert any(module[: len(parts)] == parts for module in modules), f"there is no {name}"


def test_no_circles():
    """No file imports itself through others, not even for annotations."""
    modules = {("softwarp", *module_parts(path)): path for path in sources()}
    graph: dict[tuple[str, ...], set[tuple[str, ...]]] = {}
    for module, path in modules.items():
        names = [tuple(name.split(".")) for _, name in imports(path)]
        found = {name if name in modules else name[:-1] for name in names}
        graph[module] = {name for name in found if name in modules and name != module}
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle
