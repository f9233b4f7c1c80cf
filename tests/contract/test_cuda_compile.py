"""Every kernel compiles for CUDA (PTX for compute capability 9.0), also on a machine without a GPU.

Warp brings its own compiler, so a mistake that only the CUDA compiler sees is found on any laptop. Code of a device is
made where kernels take much of the memory that threads share, since PTX with too much of it compiles.
"""

import importlib
import inspect
import itertools
import pkgutil
import re
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

import pytest
import warp as wp

from softwarp.kernels.algebra import lanes
from softwarp.kernels.elements import laws

# Values of the parameters that kernel factories have besides the variant.
CHOICES: dict[str, tuple[Any, ...]] = {
    "law": tuple(laws.LAWS),
    "project": (False, True),
    "by_parameters": (False, True),
    "is_large": (False, True),
    "forward": (False, True),
    "varying": (False, True),
    "together": (False, True),
    "wide": (False, True),
    "own_rows": (1,),
    "own_contacts": (1, 6),
    "near_rows": (0, 104),
    "near_unknowns": (0, 63),  # as many as coulomb_tiers gives float64
    "held_rows": (8,),
    "held_sides": (9,),
    "modes": (48, 96),
}
SHARED = 32 * 1024  # bytes of a block up to which nobody doubts that there is room
COMPILED: set[wp.Kernel] = set()  # found in PTX; a later factory may bring some that stand in a module before it


LONG = {  # without native code of their own, so that what CPUs compile is the same source
    *("collision.keeping", "collision.surface_phase", "collision.shapes_phase"),
    *("elements.quadratic", "elements.turning", "elements.directional"),
    *("elements.floating_adjoint", "elements.floating_inertia"),
    *("frames.gyration", "frames.gyration_adjoint", "frames.inertia", "frames.momentum", "frames.windup"),
    *("frames.adjoint", "frames.extrapolated_adjoint", "frames.leaning_adjoint"),
    *("rows.touch_adjoint", "rows.touch_directional", "rows.touch_gather", "rows.joint_adjoint"),
    *("inverse.laws", "inverse.program", "inverse.settling"),
}


def modules_with_kernels() -> Iterator[ModuleType]:
    """All modules below softwarp that may define kernels: those of the simulator and of the ray caster."""
    for package in ("kernels", "solvers", "render"):
        root = importlib.import_module(f"softwarp.{package}")
        yield root
        for info in pkgutil.walk_packages(root.__path__, f"{root.__name__}."):
            yield importlib.import_module(info.name)


def factories(module: ModuleType) -> list[tuple[str, Callable[..., Any]]]:
    """Cached functions of a module that return kernels for a ``Variant``, or for a scalar type."""
    found = inspect.getmembers(module, lambda value: callable(value) and hasattr(value, "__wrapped__"))
    return [
        (name, value)
        for name, value in found
        if value.__module__ == module.__name__
        and {"variant", "real"} & set(inspect.signature(value).parameters)
        and not inspect.isgeneratorfunction(inspect.unwrap(value))  # which a context manager is
    ]


def is_slow(module: str, choice: dict[str, Any]) -> bool:
    """Whether others that compile in less time show as much, as they are written in the same way."""
    usual = {"law": "neo_hookean", "own_contacts": 1, "near_rows": 104, "project": True}
    usual |= {
        "modes": 48,
        "by_parameters": True,
        "is_large": False,
        "together": True,
        "varying": False,
        "near_unknowns": 0,
    }
    return module.removeprefix("kernels.") in LONG or any(
        choice.get(key, value) != value for key, value in usual.items()
    )


def cases() -> Iterator[Any]:
    """One test per factory, choice of its parameters, and precision; float64 is slow: CPUs compile the same source."""
    for module in modules_with_kernels():
        short = module.__name__.removeprefix("softwarp.")
        # Factories of functions bring a kernel or two, which are part of the module that the file's kernels stand in.
        for name, factory in sorted(factories(module), key=lambda found: found[0] != "kernels"):
            others = [key for key in inspect.signature(factory).parameters if key not in ("variant", "real")]
            for precision, *values in itertools.product(("float32", "float64"), *(CHOICES[key] for key in others)):
                label = "-".join([short, name, precision, *map(str, values)])
                choice = dict(zip(others, values, strict=True))
                if choice.get("near_rows") and choice.get("near_unknowns"):
                    continue  # shared memory holds one of them
                is_other = precision == "float64" or name.startswith(
                    "_"
                )  # whose kernels those of the public factory are
                marks = [pytest.mark.slow] if is_other or is_slow(short, choice) else []
                yield pytest.param(factory, precision, choice, id=label, marks=marks)


def shared_bytes(ptx: str) -> int:
    """Memory that the threads of a block share, of all kernels in some PTX together."""
    return sum(int(size) for size in re.findall(r"\.shared[^;]*\.b8 \w+\[(\d+)\];", ptx))


def compile_to_ptx(kernels: list[wp.Kernel], folder: Any) -> None:
    """Compile the Warp modules of some kernels and look all their kernels up in PTX, but for those found before."""
    for module in {kernel.module for kernel in kernels if kernel not in COMPILED}:
        made = wp.compile_aot_module(module, arch=90, module_dir=folder, use_ptx=True)
        ptx = "\n".join(path.read_text() for path in made if path.suffix == ".ptx")
        assert ".target sm_90" in ptx
        asked = {kernel for kernel in kernels if kernel.module is module}
        others = {kernel for kernel in module.kernels.values() if kernel.hash is not None}
        COMPILED.update(k for k in asked | others if f".entry {k.get_mangled_name()}_cuda_kernel_forward" in ptx)
        if shared_bytes(ptx) > SHARED:
            wp.compile_aot_module(module, arch=90, module_dir=folder, use_ptx=False)
    assert COMPILED.issuperset(kernels)


@pytest.mark.parametrize(("factory", "precision", "choice"), list(cases()))
def test_factory_compiles(factory, precision, choice, tmp_path):
    """All kernels that a factory makes for the CUDA variant."""
    chosen = lanes.variant("cuda", precision)
    kind = {"variant": chosen, "real": chosen.real}
    made = factory(*(kind[key] for key in inspect.signature(factory).parameters if key in kind), **choice)
    kernels = [value for value in vars(made).values() if isinstance(value, wp.Kernel)]
    if not kernels:  # functions for the kernels of other files, which are compiled with these
        assert any(isinstance(value, wp.Function) for value in vars(made).values())
        return
    compile_to_ptx(kernels, tmp_path)


def test_plain_kernels_compile(tmp_path):
    """Kernels defined directly in a module, without a factory."""
    kernels = [
        value for module in modules_with_kernels() for value in vars(module).values() if isinstance(value, wp.Kernel)
    ]
    if kernels:
        compile_to_ptx(kernels, tmp_path)
