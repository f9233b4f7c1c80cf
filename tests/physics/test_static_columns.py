"""Columns above their buckling load: a load that bends them a little, and all that may stand beside them in a scene."""

from typing import Any, Literal, cast

import numpy as np
import pytest
import scipy.optimize
import scipy.special
import torch

import softwarp as sw
from softwarp import meshing

RADIUS, LENGTH, YOUNGS = 0.002, 0.3, 1e7
CRITICAL = np.pi**2 * YOUNGS * np.pi * RADIUS**4 / 4.0 / (4.0 * LENGTH**2)  # of the clamped rod [N]
WIDTH, HEIGHT, SOFT = 0.02, 0.2, 1e6  # of a column of tets


def elastica(load: float) -> tuple[float, float]:
    """How far aside and how high the tip is, per length: 2 k / K(k) and 2 E(k) / K(k) - 1, load = (2 K(k) / pi)^2."""
    k = scipy.optimize.brentq(lambda k: (2.0 * scipy.special.ellipk(k * k) / np.pi) ** 2 - load, 0.01, 0.99)
    full, half = scipy.special.ellipk(k * k), scipy.special.ellipe(k * k)
    return 2.0 * k / full, 2.0 * half / full - 1.0


def add_rod(builder: sw.ModelBuilder) -> int:
    rod = builder.add_rod(meshing.straight(LENGTH, 10), radius=RADIUS, youngs=YOUNGS)
    builder.fix(rod, nodes=[0])
    return rod


def add_neighbour(builder: sw.ModelBuilder, kind: str) -> None:
    """A part beside the column: a block with a cable, one that stretches or a chamber, a body, one that rests."""
    if kind in ("cable", "elastic cable", "chamber"):
        block = meshing.box((0.05,) * 3, (2,) * 3)
        shift = np.array([0.3, 0.0, 0.0])
        body = builder.add_tets(block.nodes + shift, block.tets, material=sw.StableNeoHookean(1e6, 0.3), density=1e3)
        builder.fix(body, box=((0.29, -1.0, -0.01), (0.36, 1.0, 1e-6)))
        if kind == "chamber":
            air = meshing.box((0.02,) * 3, (1,) * 3)
            builder.add_cavity(body, air.nodes + 0.015 + shift, air.surface())
        else:
            stretch = {"stiffness": 100.0} if kind == "elastic cable" else {}
            builder.add_cable(body, [(0.325, 0.025, 0.05)], pull_point=(0.325, 0.025, 0.2), **stretch)
    elif kind == "body":
        builder.add_rigid(sw.Sphere(0.01), mass=1.0, pose=(0.4, 0.0, 0.0), kinematic=True)
    elif kind == "contact":
        box = builder.add_rigid(sw.Box((0.05, 0.05, 0.05)), mass=0.1, pose=(0.4, 0.0, 0.0251))
        floor = builder.add_rigid(sw.Box((0.3, 0.3, 0.02)), mass=1.0, pose=(0.4, 0.0, -0.01), kinematic=True)
        builder.add_contact(box, floor)


@pytest.mark.parametrize("precision", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
@pytest.mark.parametrize("side", [1e-7, *(pytest.param(side, marks=pytest.mark.slow) for side in (1e-8, 1e-6))])
def test_a_column_goes_where_the_least_load_bends_it(side: float, precision: str) -> None:
    """A load of ``side`` P_cr across decides where a round column goes: along it, as far as the elastica, to 4 %."""
    loads = [0.9, 1.1, 1.3, 1.5, 2.0, 3.0]
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_rod(builder)
    sim = sw.Simulation(builder.finalize(len(loads), precision=precision))
    sim.control.rod_force[:, -1, 0] = side * CRITICAL
    sim.control.rod_force[:, -1, 2] = -CRITICAL * torch.tensor(loads)
    result = sim.solve_static()
    assert result.converged.all(), result
    tips = sim.rod_x[:, -1].double().numpy() / LENGTH
    assert np.abs(tips[:, 1]).max() < 1e-3 and np.hypot(*tips[0, :2]) < 1e-4
    for tip, load in zip(tips[1:], loads[1:], strict=True):
        aside, height = elastica(load)
        assert tip[0] == pytest.approx(aside, rel=0.04) and tip[2] == pytest.approx(height, abs=0.04)


@pytest.mark.parametrize(
    "kind",
    [
        "cable",
        *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("elastic cable", "chamber", "body", "contact")),
    ],
)
def test_a_perfect_rod_buckles_whatever_is_beside_it(kind: str) -> None:
    """Twice above its load the straight shape is in balance and unstable: never is it called an equilibrium."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_rod(builder)
    add_neighbour(builder, kind)
    sim = sw.Simulation(builder.finalize(2, precision="float64", contact_capacity=50))
    sim.control.rod_force[:, -1, 2] = -CRITICAL * torch.tensor([0.9, 2.0])
    if "cable" in kind:
        sim.control.cable_displacement.fill_(0.003)
    result = sim.solve_static()
    assert result.converged.all(), result
    away = sim.rod_x[:, -1, :2].norm(dim=1) / LENGTH
    assert float(away[0]) < 1e-6 and float(away[1]) == pytest.approx(elastica(2.0)[0], rel=0.03)


def tet_column(kind: str, material: Any, precision: str = "float64", element: str = "p1") -> tuple[Any, torch.Tensor]:
    """Below and well above its load, with something beside it: result and tips over the height."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    mesh = meshing.box((WIDTH, WIDTH, HEIGHT), (2, 2, 10) if element == "p1" else (1, 1, 5))
    body = builder.add_tets(mesh, material=material, density=1000.0, element=cast(Literal["p1", "p2"], element))
    nodes = builder.bodies[body].mesh.nodes
    builder.fix(body, nodes=np.flatnonzero(nodes[:, 2] < 1e-9))
    add_neighbour(builder, kind)
    model = builder.finalize(2, precision=cast(Literal["float32", "float64"], precision), contact_capacity=50)
    sim = sw.Simulation(model)
    top = np.flatnonzero(nodes[:, 2] > HEIGHT - 1e-9)
    critical = np.pi**2 * SOFT * WIDTH**4 / 12.0 / (4.0 * HEIGHT**2)
    loads = -critical / len(top) * torch.tensor([[0.9], [3.0]])
    sim.control.node_force[:, top, 2] = loads.to(sim.control.node_force)
    result = sim.solve_static()
    return result, (sim.node_x[:, top].mean(dim=1).double() - torch.as_tensor(nodes[top].mean(axis=0))) / HEIGHT


@pytest.mark.parametrize(
    ("kind", "material"),
    [
        ("body", sw.StableNeoHookean(SOFT, 0.3)),
        *(
            pytest.param(kind, material, marks=pytest.mark.slow)
            for kind, material in (
                ("contact", sw.StableNeoHookean(SOFT, 0.3)),
                ("chamber", sw.StableNeoHookean(SOFT, 0.3)),
                ("elastic cable", sw.Corotational(SOFT, 0.3)),
                ("body", sw.Corotational(SOFT, 0.3, method="polar")),
                ("chamber", sw.Corotational(SOFT, 0.3)),
            )
        ),
    ],
)
def test_a_perfect_column_of_tets_buckles_whatever_is_beside_it(kind: str, material: Any) -> None:
    """As it does alone, where the path of equilibria is followed: the same shape or one of its mirror images."""
    _, alone = tet_column("nothing", material)
    result, tips = tet_column(kind, material)
    assert result.converged.all(), result
    assert float(tips[0, :2].norm()) < 1e-2
    check_same_bend(tips[1], alone[1])


def check_same_bend(tip: torch.Tensor, alone: torch.Tensor) -> None:
    """Tips over the height that lie equally far aside and equally low, and far."""
    assert float(alone[:2].norm()) > 0.5
    assert float(tip[:2].norm()) == pytest.approx(float(alone[:2].norm()), rel=0.01)
    assert float(tip[2]) == pytest.approx(float(alone[2]), abs=0.005)


@pytest.mark.parametrize(
    ("kind", "method", "element", "precision"),
    [
        ("body", "warped", "p1", "float64"),
        ("body", "warped", "p1", "float32"),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                ("body", "large", "p1", "float64"),
                ("body", "large", "p1", "float32"),
                ("contact", "warped", "p1", "float64"),
                ("contact", "warped", "p1", "float32"),
                ("contact", "large", "p1", "float64"),
                ("contact", "large", "p1", "float32"),
                ("body", "warped", "p2", "float64"),
                ("body", "warped", "p2", "float32"),
                ("contact", "warped", "p2", "float64"),
            )
        ),
    ],
)
def test_columns_whose_elements_turn_buckle_beside_bodies(
    kind: str, method: Literal["large", "warped"], element: str, precision: str
) -> None:
    """Their steps leave out what turning softens: the look at who has arrived must not."""
    material = sw.Corotational(SOFT, 0.3, method=method)
    _, alone = tet_column("nothing", material, element=element)
    result, tips = tet_column(kind, material, precision, element)
    assert result.converged.all(), result
    assert float(tips[0, :2].norm()) < 1e-2
    check_same_bend(tips[1], alone[1])
