"""Static solves on every path: single axes held, why they stop, rounding, limits of time, interrupts."""

from typing import Any

import numpy as np
import pytest
import scipy.optimize
import scipy.special
import torch

import softwarp as sw
from softwarp import StaticReason, meshing, notices
from softwarp.solvers.relaxation import Relaxation

SIZE, YOUNGS = 0.1, 1e5
PARTS = ("plain", "cable", "chamber", "frame", "contact")
PATHS = [
    pytest.param("float64", 1, "scalar", id="float64"),
    pytest.param("float64", 9, "scalar", id="float64, 9", marks=pytest.mark.slow),
    pytest.param("float32", 1, "scalar", id="float32"),
    pytest.param("float32", 9, "lanes", id="lanes, 9"),
]


def rollers(part: str, element: str = "p1", precision: str = "float64", worlds: int = 1, path: Any = "auto") -> Any:
    """A cube on three planes of symmetry, each held along its normal alone, loaded on top by a part of its own.

    Returns the simulation and the nodes of each plane.
    """
    builder = sw.ModelBuilder()
    mesh = meshing.box((SIZE,) * 3, (2,) * 3)
    cube = builder.add_tets(mesh, material=sw.StableNeoHookean(YOUNGS, 0.3), density=1000.0, element=element)
    nodes = builder.bodies[cube].mesh.nodes
    planes = [np.flatnonzero(nodes[:, axis] < 1e-9) for axis in range(3)]
    for axis, plane in enumerate(planes):
        builder.fix(cube, nodes=plane, axes="xyz"[axis])
    top = np.flatnonzero(nodes[:, 2] > SIZE - 1e-9)
    if part == "cable":
        builder.add_cable(cube, [[0.05, 0.05, SIZE]], pull_point=(0.05, 0.05, 0.3))
    elif part == "chamber":
        air = meshing.box((0.04,) * 3, (1,) * 3)
        builder.add_cavity(cube, air.nodes + 0.031, air.surface())
    elif part in ("frame", "contact"):
        gap = 5e-4 if part == "contact" else 0.0
        pose = (0.05, 0.05, SIZE + 0.005 + gap)
        plate = builder.add_rigid(sw.Box((0.14, 0.14, 0.01)), mass=2.0, pose=pose, free_axes="z")
        if part == "frame":
            builder.attach(cube, top, to=plate)
        else:
            builder.add_contact(plate, cube)
    sim = sw.Simulation(builder.finalize(worlds, precision=precision, contact_capacity=300), solver_path=path)
    if part == "plain":
        sim.control.node_force[:, top, 2] = -1.0
    elif part == "cable":
        sim.control.cable_displacement.fill_(0.004)
    elif part == "chamber":
        sim.control.cavity_pressure.fill_(4000.0)
    return sim, planes


@pytest.mark.parametrize("element", [pytest.param("p1", marks=pytest.mark.slow), "p2"])
@pytest.mark.parametrize(
    "part", [pytest.param(part, marks=pytest.mark.slow) if part == "plain" else part for part in PARTS]
)
def test_single_axes_stay_held(part: str, element: str) -> None:
    """Held coordinates do not move at all, others do, on every path; and all paths find one shape, within 2e-4."""
    reference = None
    for param in PATHS[::2] + PATHS[3:]:
        precision, worlds, path = param.values
        sim, planes = rollers(part, element, str(precision), int(str(worlds)), path)
        start = sim.node_x.clone()
        result = sim.solve_static()
        assert bool(result.converged.all()), result
        for axis, plane in enumerate(planes):
            assert torch.equal(sim.node_x[:, plane, axis], start[:, plane, axis])
        assert float((sim.node_x - start)[:, planes[2], :2].abs().max()) > 2e-6
        reference = sim.node_x[:1].double() if reference is None else reference
        assert float((sim.node_x.double() - reference).abs().max()) < 2e-4 * SIZE


def test_contact_carries_the_weight_on_one_column() -> None:
    """A plate of mass m on a cube with nu = 0 and free sides: sigma = m g / A, small strain, to second order.

    Stable neo-Hookean with nu = 0 has no simple closed form; St. Venant-Kirchhoff has N = E (l^2 - 1) l A / 2.
    """
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    cube = builder.add_tets(
        meshing.box((SIZE,) * 3, (2,) * 3), material=sw.StVenantKirchhoff(YOUNGS, 0.0), density=1e-3
    )
    nodes = builder.bodies[cube].mesh.nodes
    for axis in range(3):
        builder.fix(cube, nodes=np.flatnonzero(nodes[:, axis] < 1e-9), axes="xyz"[axis])
    plate = builder.add_rigid(sw.Box((SIZE, SIZE, 0.01)), mass=2.0, pose=(0.05, 0.05, SIZE + 0.0055), free_axes="z")
    builder.add_contact(plate, cube)
    sim = sw.Simulation(builder.finalize(precision="float64", contact_capacity=100))
    result = sim.solve_static()
    assert result.reason == (StaticReason.CONVERGED,)
    stretches = np.roots([0.5 * YOUNGS * SIZE**2, 0.0, -0.5 * YOUNGS * SIZE**2, 2.0 * 9.81])
    stretch = max(root.real for root in stretches if abs(root.imag) < 1e-12)
    top = nodes[:, 2] > SIZE - 1e-9
    np.testing.assert_allclose(sim.node_x[0, top, 2].numpy(), stretch * SIZE, rtol=1e-5)


def test_reasons() -> None:
    """Limits of iterations and time, loads that are not finite, a body that nothing holds: each is called so."""
    for part in ("plain", "chamber"):
        sim, _ = rollers(part)
        assert sim.solve_static(max_iterations=1).reason == (StaticReason.ITERATION_LIMIT,)
        sim, _ = rollers(part)
        before = sim.node_x.clone()
        result = sim.solve_static(max_seconds=1e-9)
        assert result.reason == (StaticReason.TIME_LIMIT,) and not bool(result.converged.any())
        assert part == "plain" or torch.equal(sim.node_x, before)
        assert sim.solve_static().reason == (StaticReason.CONVERGED,)
        sim, _ = rollers(part)
        sim.control.node_force[0, -1, 0] = float("nan")
        result = sim.solve_static()
        assert result.reason == (StaticReason.NOT_FINITE,) and result.iterations < 100
        assert torch.equal(sim.node_x, before)
    with pytest.raises(ValueError, match=r"max_seconds \[s\] must"):
        sim.solve_static(max_seconds=0.0)
    builder = sw.ModelBuilder()
    builder.add_rigid(sw.Sphere(0.1), mass=1.0)
    result = sw.Simulation(builder.finalize(precision="float64")).solve_static()
    assert result.reason == (StaticReason.NO_EQUILIBRIUM,) and bool(torch.isfinite(result.residual).all())
    builder = sw.ModelBuilder()
    builder.add_tets(meshing.box((SIZE,) * 3, (1,) * 3), material=sw.NeoHookean(YOUNGS, 0.3), density=1000.0)
    sim = sw.Simulation(builder.finalize(precision="float64"))
    before = sim.node_x.clone()
    assert sim.solve_static().reason == (StaticReason.NO_EQUILIBRIUM,)
    assert bool(torch.isfinite(sim.node_x).all()) and float((sim.node_x - before).abs().max()) < SIZE


@pytest.mark.slow
def test_what_goes_away_is_named_and_put_back() -> None:
    """A body that nothing holds stays where it was; the advice says which, where to, and what would hold it."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    builder.add_rigid(sw.Sphere(0.1), mass=1.0, name="base", kinematic=True)
    builder.add_rigid(sw.Sphere(0.1), mass=1.0, pose=(1.0, 0.0, 0.0), name="ball")
    sim = sw.Simulation(builder.finalize(2, precision="float64"))
    sim.control.body_force[1, 1, 2] = 9.81  # the other world's ball hovers
    before = sim.body_pose.clone()
    result = sim.solve_static()
    assert result.reason == (StaticReason.NO_EQUILIBRIUM, StaticReason.CONVERGED)
    assert result.advice[0].startswith("'ball' moves away along (0, 0, -1)") and result.advice[1] == ""
    assert torch.equal(sim.body_pose[0], before[0]) and float((sim.body_pose - before).abs().max()) < 1e-12


def column(
    segments: int, loads: list[float], side: float, precision: str, path: Any = "auto"
) -> tuple[Any, Any, float]:
    """A clamped rod under ``loads`` of its buckling load, with ``side`` of it across: result, tip [m] and length."""
    radius, length, youngs = 0.002, 0.3, 1e7
    critical = np.pi**2 * youngs * np.pi * radius**4 / 4.0 / (4.0 * length**2)
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    rod = builder.add_rod(meshing.straight(length, segments), radius=radius, youngs=youngs)
    builder.fix(rod, nodes=[0])
    sim = sw.Simulation(builder.finalize(len(loads), precision=precision), solver_path=path)
    sim.control.rod_force[:, -1, 0] = side * critical
    sim.control.rod_force[:, -1, 2] = -critical * torch.tensor(loads)
    result = sim.solve_static()
    return result, sim.rod_x[:, -1].cpu().double(), length


@pytest.mark.parametrize(
    ("precision", "side"),
    [
        ("float64", 1e-4),
        pytest.param("float64", 0.0, marks=pytest.mark.slow),
        pytest.param("float32", 1e-4, marks=pytest.mark.slow),
        pytest.param("float32", 0.0, marks=pytest.mark.slow),
    ],
)
def test_a_column_buckles_at_the_first_try(precision: str, side: float) -> None:
    """Above Euler's load the tip goes aside as far as the elastica does, below it stands; also a perfect column.

    Elastica: P / P_cr = (2 K(k) / pi)^2, the tip is 2 k L / K(k) aside and L (2 E(k) / K(k) - 1) high. Coarse rods
    are within 3 % of it at twice the load.
    """
    k = scipy.optimize.brentq(lambda k: (2.0 * scipy.special.ellipk(k * k) / np.pi) ** 2 - 2.0, 0.1, 0.99)
    full, half = scipy.special.ellipk(k * k), scipy.special.ellipe(k * k)
    result, tip, length = column(10, [0.95, 2.0], side, precision)
    assert result.converged.all(), result
    away = tip[:, :2].norm(dim=1) / length
    assert float(away[0]) < 0.01
    assert float(away[1]) == pytest.approx(2.0 * k / full, rel=0.03)
    assert float(tip[1, 2]) / length == pytest.approx(2.0 * half / full - 1.0, abs=0.03)


@pytest.mark.slow
@pytest.mark.parametrize(("precision", "path"), [("float64", "scalar"), ("float32", "lanes")])
def test_columns_do_not_depend_on_their_batch(precision: str, path: Any) -> None:
    """Those that take other tangents and lengths than their neighbours, and one whose load is not finite."""
    loads = [0.5, 1.05, float("nan"), 2.0, 1.3]
    result, tips, _ = column(10, loads, 1e-3, precision, path)
    assert [reason == StaticReason.NOT_FINITE for reason in result.reason] == [bool(np.isnan(load)) for load in loads]
    assert result.converged.sum() == 4 and bool(torch.isfinite(tips).all())
    for world in (1, 3):
        assert torch.equal(column(10, [loads[world]], 1e-3, precision, path)[1][0], tips[world])


@pytest.mark.slow
def test_a_column_just_above_its_load() -> None:
    """At 1.05 P_cr, where the softest motion is a hundred times softer than bending, whatever its segments."""
    for segments in (6, 10, 30):
        result, tip, length = column(segments, [1.05], 1e-4, "float64")
        assert result.reason == (StaticReason.CONVERGED,), (segments, result)
        assert float(tip[0, 0]) / length == pytest.approx(0.38, rel=0.06)


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_a_free_body_with_a_chamber(precision: str) -> None:
    """Nothing holds it and nothing needs to: it is inflated as one that six coordinates hold, where it is."""
    mesh = meshing.box((0.03,) * 3, (3,) * 3)
    wall = (np.abs(mesh.nodes[mesh.tets].mean(axis=1) - 0.015) > 0.005).any(axis=1)
    nodes, tets = meshing.compact(mesh.nodes, mesh.tets[wall])
    volumes = []
    for held in (True, False):
        builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        body = builder.add_tets(nodes, tets, material=sw.NeoHookean(YOUNGS, 0.45), density=1000.0)
        builder.add_cavity(body, *meshing.compact(nodes, meshing.voids(nodes, tets)[0]))
        if held:
            for at, axes in (((0.0, 0.0, 0.0), "xyz"), ((0.03, 0.0, 0.0), "yz"), ((0.0, 0.03, 0.0), "z")):
                builder.fix(body, nodes=[int(np.linalg.norm(nodes - at, axis=1).argmin())], axes=axes)
        sim = sw.Simulation(builder.finalize(precision=precision))
        sim.control.cavity_pressure.fill_(4000.0)
        result = sim.solve_static()
        assert result.converged.all(), (held, result)
        volumes.append(float(sim.cavity_volume))
    assert volumes[0] == pytest.approx(volumes[1], rel=1e-6 if precision == "float64" else 1e-4)
    assert float((sim.node_x.double().mean(dim=1) - 0.015).abs().max()) < 1e-3


@pytest.mark.parametrize("precision", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
def test_a_body_that_hangs_from_a_node(precision: str) -> None:
    """Held at one corner, it turns until it hangs below it: its middle is under the corner, its weight balanced."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    mesh = meshing.box((0.1, 0.02, 0.02), (5, 1, 1))
    body = builder.add_tets(mesh, material=sw.NeoHookean(1e6, 0.3), density=1000.0)
    builder.fix(body, nodes=[0])
    sim = sw.Simulation(builder.finalize(precision=precision))
    result = sim.solve_static(max_iterations=300)
    assert result.converged.all() and result.advice == ("",)
    mass = sim.mass[0].double()
    middle = (mass[:, None] * sim.node_x[0].double()).sum(dim=0) / mass.sum()
    assert float(middle[:2].abs().max()) < 2e-4 * 0.1 and float(middle[2]) < -0.05
    assert torch.equal(sim.node_x[0, 0].double(), torch.zeros(3, dtype=torch.float64))


@pytest.mark.slow
def test_without_loads_a_gas_chamber_is_at_rest() -> None:
    """At once, though nothing but rounding is left to balance, whose relative imbalance never falls.

    Beside it a chamber with twice the gas: p V is that of both amounts, (p + p0) V = 2 p0 V0.
    """
    mesh = meshing.box((0.03,) * 3, (6,) * 3)
    wall = (np.abs(mesh.nodes[mesh.tets].mean(axis=1) - 0.015) > 0.005).any(axis=1)
    nodes, tets = meshing.compact(mesh.nodes, mesh.tets[wall])
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_tets(nodes, tets, material=sw.NeoHookean(YOUNGS, 0.45), density=1000.0)
    builder.fix(body, box=((0.0, 0.0, 0.0), (0.03, 0.03, 0.0)))
    builder.add_cavity(body, *meshing.compact(nodes, meshing.voids(nodes, tets)[0]), "gas")
    sim = sw.Simulation(builder.finalize(2, precision="float64"))
    sim.control.cavity_gas[1] *= 2.0
    found = sim.solve_static(max_iterations=40)
    assert found.reason == (StaticReason.CONVERGED,) * 2
    assert float((sim.node_x[0] - torch.as_tensor(nodes)).abs().max()) < 1e-16
    amount = (sim.cavity_pressure[:, 0] + 101325.0) * sim.cavity_volume[:, 0] / 101325.0
    np.testing.assert_allclose(amount, [1e-6, 2e-6], rtol=1e-9)


def test_overflow_is_no_equilibrium() -> None:
    sim, _ = rollers("contact")
    model = sim.model
    tight = sw.Simulation(model.with_contact_capacity(2))
    result = tight.solve_static()
    assert not bool(result.converged.any()) and result.reason != (StaticReason.CONVERGED,)


def test_interrupt_leaves_the_last_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """The state is that at the end of a step, at rest, and commanded speeds are those of before."""
    sim, _ = rollers("frame")
    reference, _ = rollers("frame")
    reference.solve_static(max_iterations=2)
    sim.control.body_velocity.fill_(0.25)
    step, calls = Relaxation.step, 0

    def interrupted(self: Relaxation, *args: Any) -> int:
        nonlocal calls
        calls += 1
        taken = step(self, *args)
        if calls == 3:
            raise KeyboardInterrupt
        return taken

    monkeypatch.setattr(Relaxation, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        sim.solve_static()
    assert torch.equal(sim.node_x, reference.node_x) and not bool(sim.node_v.any()) and float(sim.time) == 0.0
    assert bool((sim.control.body_velocity == 0.25).all())
    sim.control.body_velocity.zero_()
    assert bool(sim.solve_static().converged.all())


@pytest.mark.parametrize(("precision", "path"), [("float32", "lanes"), ("float64", "scalar")])
def test_settled_world_does_not_depend_on_its_batch(precision: str, path: Any) -> None:
    """Worlds that need different numbers of steps and lengths end at the bits that they reach alone."""
    pressure = torch.linspace(-8000.0, 24000.0, 9)
    batch, _ = rollers("chamber", precision=precision, worlds=9, path=path)
    batch.control.cavity_pressure.copy_(pressure[:, None])
    batch.solve_static()
    for world in (0, 4, 8):
        alone, _ = rollers("chamber", precision=precision, path=path)
        alone.control.cavity_pressure.fill_(float(pressure[world]))
        assert bool(alone.solve_static().converged.all())
        assert torch.equal(alone.node_x[0], batch.node_x[world])


def test_long_solves_tell_how_far_they_are(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(notices, "WAIT_SECONDS", 0.0)
    for part in ("plain", "chamber"):
        rollers(part)[0].solve_static()
        assert "solve_static: " in capsys.readouterr().err


def test_a_rod_that_a_tendon_bends() -> None:
    """A tendon at a constant distance e bends a rod to a circle: its end turns by T e L / (E I).

    The tension's own stiffness is not in the tangent, so that long steps fail; what is left of the geometric series of
    shorter ones tells when to stop. A slack tendon beside it does not wait for that.
    """
    length, radius, offset, youngs = 0.2, 0.004, 0.003, 1.0e6
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    rod = builder.add_rod(meshing.straight(length, 20), radius=radius, youngs=youngs, density=1000.0)
    builder.fix(rod, nodes=[0])
    builder.add_cable(rod, [(offset, 0.0, z) for z in np.linspace(0.0, length, 21)], control="force")
    sim = sw.Simulation(builder.finalize(2, precision="float64"))
    sim.control.cable_tension[1] = 0.5
    result = sim.solve_static()
    assert result.converged.all(), (result.reason, result.residual)
    turn = 0.5 * offset * length / (youngs * np.pi * radius**4 / 4.0)
    end = 2.0 * float(torch.acos(sim.rod_q[1, -1, 3].abs()))
    assert end == pytest.approx(turn, rel=0.03)  # a little more, as the rod is a per cent shorter
    assert float((sim.rod_q[0, :, 3].abs() - 1.0).abs().max()) < 1e-12
