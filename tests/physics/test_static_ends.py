"""How static solves end: locked axes on every path, contact in both precisions, and why a world stopped."""

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing

EDGE, YOUNGS, NU, DENSITY = 0.05, 1.0e5, 0.3, 1000.0
MESH = meshing.box((EDGE, EDGE, EDGE), (3, 3, 3))
NODES = MESH.nodes - MESH.nodes.min(axis=0)


def scene(element: str, *, touching: bool, rollers: bool, gap: float = 0.0, mu: float = 0.5) -> sw.ModelBuilder:
    """A silicone cube, held along single axes on three sides or not at all, over a floor that it may touch."""
    builder = sw.ModelBuilder()
    material = sw.Corotational(YOUNGS, NU)
    body = builder.add_tets(NODES + [0.0, 0.0, gap], MESH.tets, material=material, density=DENSITY, element=element)
    for axis in range(3) if rollers else ():
        low, high = np.full(3, -1.0), np.full(3, 1.0)
        low[axis], high[axis] = -1e-9, 1e-9
        builder.fix(body, box=(low, high), axes="xyz"[axis])
    if touching:
        floor = builder.add_rigid(sw.Box((0.3, 0.3, 0.02)), kinematic=True, pose=(0, 0, -0.01 - rollers, 0, 0, 0, 1))
        builder.add_contact(body, floor, mu=mu)
    return builder


@pytest.mark.parametrize("worlds", [1, 9])
@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("element", ["p1", "p2"])
def test_locked_axes_hold_on_both_paths(element: str, precision: str, worlds: int) -> None:
    """Path following and settling by steps: what is locked stays, the rest agrees."""
    ends = []
    for touching in (False, True):
        sim = sw.Simulation(scene(element, touching=touching, rollers=True).finalize(worlds, precision=precision))
        start = sim.node_x.clone()
        result = sim.solve_static()
        assert result.converged.all(), result.reasons
        moved = sim.node_x - start
        for axis in range(3):
            assert (moved[:, start[0, :, axis] == 0.0, axis] == 0.0).all()
        ends.append(moved)
    assert float(ends[0].abs().max()) > 5.0e-5
    torch.testing.assert_close(*ends, rtol=0.0, atol=2.0e-7 if precision == "float32" else 1.0e-9)


def test_a_cube_on_the_floor_settles_in_both_precisions() -> None:
    """Held by contact alone; as stiff above as a cube whose lower face is held, without friction on rollers."""
    tops = {}
    for precision in ("float32", "float64"):
        builder = scene("p1", touching=True, rollers=False, gap=2e-4, mu=0.0)
        sim = sw.Simulation(builder.finalize(2, precision=precision))
        result = sim.solve_static()
        assert result.converged.all() and result.iterations < 20
        assert torch.isfinite(result.residual).all()
        tops[precision] = sim.node_x[0, NODES[:, 2] == EDGE, 2].double().mean()
        assert float(sim.node_x[..., 2].min()) > -1e-6
    assert float(abs(tops["float32"] - tops["float64"])) < 2e-7
    sunk = EDGE - float(tops["float64"])
    assert sunk == pytest.approx(DENSITY * 9.81 * EDGE**2 / (2.0 * YOUNGS), rel=0.03)  # a bar under its own weight


def test_reasons() -> None:
    builder = scene("p1", touching=False, rollers=True)
    sim = sw.Simulation(builder.finalize(3, precision="float64"))
    sim.control.node_force[1, :, 2] = -0.5
    result = sim.solve_static(max_iterations=1)
    assert result.reasons == ["ITERATIONS"] * 3 and not result.converged.any()
    sim.control.node_force[2, :, 2] = torch.nan
    result = sim.solve_static()
    assert result.reasons == ["CONVERGED", "CONVERGED", "FAILED"] and result.converged.tolist() == [True, True, False]
    assert torch.isfinite(sim.node_x).all()
