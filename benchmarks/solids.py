"""Solids whose answer is known, for ``softwarp bench accuracy``: how they are built, loaded and read.

The cantilever of the peers stands in ``cantilever.py``; the others are the scenes of the tests in ``tests/physics``, so
that this part needs a checkout.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import softwarp
from softwarp import meshing

from . import cantilever

ROOT = Path(__file__).resolve().parent.parent
Cells = tuple[int, int, int]
GRADING = 1.5  # cells of the cantilever end at L (i / n)^1.5: fine where it is clamped, which is where it bends


def test_scenes() -> Any:
    """The modules ``cases``, ``element_cases`` and ``pneumatic_cases`` of the tests.

    Raises:
        FileNotFoundError: If there is no checkout around this file.
    """
    if not (ROOT / "tests" / "element_cases.py").is_file():
        raise FileNotFoundError(f"{ROOT / 'tests'}: not there; the accuracy part needs a checkout of softwarp")
    if str(ROOT) not in sys.path:
        sys.path.insert(0, str(ROOT))
    from tests import element_cases, pneumatic_cases

    return element_cases, pneumatic_cases


@dataclass(frozen=True)
class Solid:
    """One solid, loaded and at rest.

    Attributes:
        sim: The simulation.
        settle: Brings it from rest to equilibrium, and tells whether it got there.
        value: The quantity that is compared, in the unit of its problem.
    """

    sim: softwarp.Simulation
    settle: Callable[[], bool]
    value: Callable[[], float]


@dataclass(frozen=True)
class Problem:
    """What is computed, what is right, and on which meshes.

    Attributes:
        name: Of records and pictures.
        title: For a reader.
        quantity, unit: What is compared.
        exact: Its right value.
        source: Where that is from.
        cells: Meshes of every element, coarse to fine.
        build: Makes a solid from element, cells and options of ``Model`` and ``Simulation``.
    """

    name: str
    title: str
    quantity: str
    unit: str
    exact: float
    source: str
    cells: dict[str, tuple[Cells, ...]]
    build: Callable[..., Solid]


def _solid(case: Any, value: Callable[[], float]) -> Solid:
    """A case of the tests, settled by ``solve_static`` from rest."""
    load = case.sim.control.node_force.clone()

    def settle() -> bool:
        case.sim.reset()
        case.sim.control.node_force.copy_(load)
        return bool(case.sim.solve_static(tolerance=1e-7).converged.all())

    return Solid(case.sim, settle, value)


def sagging(element: str, cells: Cells, graded: bool = True, precision: str = "float64", **options: Any) -> Solid:
    """The silicone cantilever under its weight; sag [mm], the mean over its end."""
    mesh = cantilever.mesh(cells)
    length = cantilever.SIZE[0]
    if graded:
        nodes = mesh.nodes.copy()
        nodes[:, 0] = length * (nodes[:, 0] / length) ** GRADING
        mesh = meshing.TetMesh(nodes, mesh.tets, mesh.name)
    builder = softwarp.ModelBuilder(gravity=(0.0, 0.0, -cantilever.GRAVITY))
    material = softwarp.Corotational(cantilever.YOUNGS, cantilever.NU, method="polar")
    body = builder.add_tets(
        mesh, material=material, density=cantilever.DENSITY, rayleigh=(0.0, cantilever.DAMPING), element=element
    )
    rest = builder.bodies[body].mesh.nodes
    builder.fix(body, nodes=cantilever.clamped(rest))
    sim = softwarp.Simulation(builder.finalize(precision=precision), **options)

    def settle() -> bool:
        sim.reset()
        return bool(sim.solve_static(tolerance=1e-7).converged.all())

    return Solid(sim, settle, lambda: 1e3 * cantilever.sag(rest, sim.node_x[0].double().numpy()))


def loaded(element: str, cells: Cells, **options: Any) -> Solid:
    """The beam of catalogue 2.1; -u_z [m] of the middle of its end."""
    scenes, _ = test_scenes()
    case = scenes.loaded_beam(element, "nh_log", cells, **options)
    node = case.node((1.0, 0.05, 0.05))
    return _solid(case, lambda: -float(case.displacements()[node, 2]))


def cook(element: str, cells: Cells, **options: Any) -> Solid:
    """Cook's membrane; u_y of its upper corner."""
    scenes, _ = test_scenes()
    case = scenes.cook(element, "nh_log", cells, **options)
    node = case.node((48.0, 60.0, 0.0))
    return _solid(case, lambda: float(case.displacements()[node, 1]))


PRESSURE = 2.0e4  # Pa, in the sphere


def sphere(element: str, cells: Cells, nu: float, precision: str = "float64", **options: Any) -> Solid:
    """The octant of the thick sphere under pressure; displacement [mm] of elements' corners in the inner wall."""
    _, scenes = test_scenes()
    case = scenes.sphere_octant(cells[0], cells[1], element=element, curved=True)
    options = {"dt": 1.0e3, "newton_iterations": 60} | options
    builder = scenes.builder_of(case, "nh_log", 1.0e5, nu)
    sim = softwarp.Simulation(builder.finalize(precision=precision), **options)
    sim.control.cavity_pressure.fill_(PRESSURE)
    corner = np.unique(case.mesh.tets if case.quadratic is None else case.quadratic.elements[:, :4])
    wall = np.intersect1d(case.inner, corner)

    def settle() -> bool:
        sim.reset()
        sim.control.cavity_pressure.fill_(PRESSURE)
        sim.step()
        return bool((sim.status == softwarp.Status.OK).all())

    return Solid(sim, settle, lambda: 1e3 * scenes.radial(case, sim, wall))


def problems() -> list[Problem]:
    """All of them; the exact spheres are computed here."""
    scenes, _ = test_scenes()
    octants = {"p1": ((3, 3, 1), (4, 4, 1), (8, 8, 1), (12, 12, 1)), "p2": ((3, 3, 1), (4, 4, 1), (6, 6, 1))}
    spheres = [
        Problem(
            f"sphere_{str(nu).replace('0.', '')}",
            f"Inflated thick sphere, Poisson's ratio {nu:g}",
            "radial displacement of the inner wall",
            "mm",
            float(scenes.exact_sphere(nu, PRESSURE)[0]),
            "the radial boundary value problem",
            octants,
            partial(sphere, nu=nu),
        )
        for nu in (0.3, 0.49, 0.499)
    ]
    return [
        Problem(
            "cantilever",
            "Silicone cantilever under its weight",
            "sag of the end",
            "mm",
            1e3 * cantilever.CONVERGED,
            "quadratic elements on finer and finer graded cells (73.22 with 7008, 73.33 with 18120 unknowns)",
            {
                "p1": ((10, 2, 2), (20, 4, 4), (30, 6, 6), (40, 8, 8), (70, 9, 9)),
                "p2": ((6, 1, 1), (8, 1, 2), (12, 1, 2), (16, 2, 2), (16, 4, 4)),
            },
            sagging,
        ),
        Problem(
            "beam",
            "Cantilever with a dead end load, large deflection",
            "deflection of the end",
            "m",
            0.608,
            "quadratic elements on (20, 2, 2) and (40, 4, 4) cells, extrapolated",
            {"p1": ((20, 2, 2), (40, 4, 4), (60, 6, 6)), "p2": ((8, 1, 1), (16, 1, 1), (20, 2, 2))},
            loaded,
        ),
        Problem(
            "cook",
            "Cook's membrane",
            "displacement of the upper corner",
            "length",
            8.225,
            "quadratic elements on (8, 8, 2) and (16, 16, 2) cells, extrapolated",
            {
                "p1": ((6, 6, 2), (8, 8, 2), (16, 16, 4), (20, 20, 5)),
                "p2": ((3, 3, 1), (4, 4, 1), (6, 6, 1), (8, 8, 2)),
            },
            cook,
        ),
        *spheres,
    ]
