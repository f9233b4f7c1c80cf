"""Rods against theory: bending, buckling, helices, vibration, damping, momentum.

Numbers are those of the validation catalogue, sections 4 and 5, unless a formula is given.
"""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from scipy.special import ellipe, ellipk

import softwarp as sw
from softwarp import meshing
from tests import rod_cases as rods

EI = rods.bending()
X = (1.0, 0.0, 0.0)

# alpha = F L^2 / EI: drop / L, shortening / L, tip angle [rad] of the elastica (Bisshopp and Drucker, 1945)
ELASTICA = {
    0.25: (0.082746, 0.004118, 0.124292),
    0.5: (0.162144, 0.015919, 0.244534),
    1.0: (0.301721, 0.056433, 0.461352),
    2.0: (0.493457, 0.160642, 0.781750),
    3.0: (0.603253, 0.254420, 0.986017),
    4.0: (0.669964, 0.328941, 1.121239),
    5.0: (0.713792, 0.387628, 1.215368),
    7.5: (0.776702, 0.489574, 1.355927),
    10.0: (0.810609, 0.554996, 1.430286),
}


def beam(segments: int, **options: Any) -> sw.Simulation:
    """A metre of rod along x, clamped at the origin."""
    return rods.scene(meshing.straight(rods.LENGTH, segments, direction=X), **options)


def elastica(segments: int, alpha: float, radius: float = 0.005, **options: Any) -> tuple[float, float, float]:
    """Drop, shortening and tip angle under a dead transverse end force; E A L^2 = 1.6e5 E I."""
    sim = beam(segments, radius=radius, **options)
    rods.pull(sim, -1, (0.0, 0.0, -alpha * rods.bending(radius)))
    rods.settle(sim)
    x, tangent = rods.positions(sim)[-1], rods.rotations(sim)[-1].apply([0.0, 0.0, 1.0])
    return -x[2], 1.0 - x[0], float(np.arctan2(-tangent[2], tangent[0]))


@pytest.mark.parametrize(("segments", "turns"), [(5, 0.25), (5, 1.0), (20, 0.25), (20, 0.5), (20, 1.0), (20, 2.0)])
def test_end_moment_rolls_up(segments: int, turns: float) -> None:
    """M = 2 pi n EI / L bends to n circles, x = sin(kL)/k, z = (cos(kL) - 1)/k: exact for any number of segments (4.1).

    A quarter turn of load at a time; the length does not change. (From about 1.6 turns on the plane shape is unstable
    under a moment whose axis is fixed in space: what rounding has grown out of the plane is taken back at every load.)
    """
    sim = beam(segments)
    start = sim.rod_q[0].clone()
    for load in np.arange(0.25, turns + 0.1, 0.25):
        rods.flatten(sim, start)
        rods.pull(sim, -1, (0.0, 0.0, 0.0), (0.0, 2.0 * np.pi * load * EI, 0.0))
        rods.settle(sim)
    kappa = 2.0 * np.pi * turns
    s = np.linspace(0.0, 1.0, segments + 1)
    expected = np.stack([np.sin(kappa * s), 0.0 * s, np.cos(kappa * s) - 1.0], axis=1) / kappa
    assert np.abs(rods.positions(sim) - expected).max() < 1e-8
    assert float(sim.rod_resultants()[0, :, :3].abs().max()) < 1e-8 * EI


@pytest.mark.parametrize("alpha", ELASTICA)
def test_elastica(alpha: float) -> None:
    """Large bending by a dead end force, 20 segments, to 1e-3 of the length (4.2)."""
    assert elastica(20, alpha) == pytest.approx(ELASTICA[alpha], abs=1e-3)


def test_elastica_is_of_second_order() -> None:
    """At alpha = 5 halving the segments divides the error of the drop by four."""
    errors = [abs(elastica(n, 5.0, radius=0.001)[0] - ELASTICA[5.0][0]) for n in (10, 20)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("path", [pytest.param("scalar", marks=pytest.mark.slow), "lanes"])
def test_elastica_in_float32(path: str) -> None:
    """alpha = 3 in float32 within 2e-3."""
    options = {"precision": "float32", "num_worlds": 2, "simulation": {"solver_path": path}}
    assert elastica(20, 3.0, radius=0.01, **options) == pytest.approx(ELASTICA[3.0], abs=2e-3)


# G J, G A_s and the tips for P = 300, 450, 600 of the bend, from the boundary value problem
BEND = {
    (1.0 / 6.0, 1.0): (
        (58.77912, 22.24478, 40.19189),
        (52.23856, 18.50818, 48.50293),
        (47.15044, 15.68480, 53.47486),
    ),
    (1.0 / 6.0, 5.0 / 6.0): (
        (58.77890, 22.24468, 40.19239),
        (52.23826, 18.50806, 48.50349),
        (47.15010, 15.68469, 53.47548),
    ),
    (0.140577, 5.0 / 6.0): (
        (58.53571, 22.11251, 40.48076),
        (51.96942, 18.36916, 48.70535),
        (46.89159, 15.55768, 53.60799),
    ),
}


def bend(segments: int, torsion: float, shear: float, **options: Any) -> sw.Simulation:
    """An eighth of a circle of radius 100 with a unit square section, E = 1e7, nu = 0 (Bathe and Bolourchi, 1979)."""
    points = meshing.arc(100.0, np.pi / 4.0, segments, tangent=X, normal=(0.0, 1.0, 0.0))
    section = (1.0, shear, 1.0 / 12.0, 1.0 / 12.0, torsion)
    return rods.scene(points, radius=0.5, youngs=1e7, nu=0.0, density=1.0, section=section, **options)


@pytest.mark.parametrize(("torsion", "shear"), BEND)
def test_bend_of_45_degrees(torsion: float, shear: float) -> None:
    """Bending and twist in space under an end force: 8 segments, 0.5 % of the radius (4.3)."""
    sim = bend(8, torsion, shear)
    for force, expected in zip((300.0, 450.0, 600.0), BEND[torsion, shear], strict=True):
        rods.pull(sim, -1, (0.0, 0.0, force))
        rods.settle(sim)
        assert np.linalg.norm(rods.positions(sim)[-1] - expected) < 0.5


def test_newton_converges_where_frames_turn_far() -> None:
    """One long step from rest to the bend's equilibrium under P = 150: 16 iterations to 1e-9."""
    sim = bend(16, 1.0 / 6.0, 1.0, simulation={"dt": 1e4, "newton_iterations": 16})
    rods.pull(sim, -1, (0.0, 0.0, 150.0))
    sim.step()
    assert int(sim.status[0]) == sw.Status.OK
    stepped = rods.positions(sim)
    rods.settle(sim)
    assert np.abs(stepped - rods.positions(sim)).max() < 1e-3


@pytest.mark.parametrize(
    ("length", "expected"), [(0.10, (0.0978865, -0.0192032)), (0.20, (0.1168872, -0.1507705))], ids=["10 cm", "20 cm"]
)
def test_heavy_rod(length: float, expected: tuple[float, float]) -> None:
    """Silicone rod of 5 mm radius under its weight, 20 segments, tip (x, z) to 1e-4 m (4.4)."""
    points = meshing.straight(length, 20, direction=X)
    sim = rods.scene(points, radius=0.005, nu=0.5, gravity=(0.0, 0.0, -9.81))
    rods.settle(sim)
    assert rods.positions(sim)[-1, [0, 2]] == pytest.approx(expected, abs=1e-4)


def test_follower_force() -> None:
    """Force 3 EI / L^2 normal to the tip tangent, turning with it: tip (0.551665, -0.726685), 20 segments (4.5).

    Dead loads along the last normal have the follower force as their limit.
    """
    sim = beam(20, radius=0.005)
    load = 3.0 * rods.bending(0.005)
    change = 1.0
    for _ in range(30):
        tangent = rods.rotations(sim)[-1].apply([0.0, 0.0, 1.0])
        rods.pull(sim, -1, load * np.array([tangent[2], 0.0, -tangent[0]]))
        before = rods.positions(sim)
        rods.settle(sim)
        change = np.abs(rods.positions(sim) - before).max()
        if change < 1e-7:
            break
    assert change < 1e-7
    assert rods.positions(sim)[-1, [0, 2]] == pytest.approx((0.551665, -0.726685), abs=1e-3)


def test_intrinsic_curvature() -> None:
    """A rod laid out straight curls to the helix of its rest curvature (3, 2, 5) 1/m, exactly, without stress (4.6)."""
    u = np.array([3.0, 2.0, 5.0])
    sim = rods.scene(meshing.straight(1.5, 30, direction=X), curvature=u)
    base = rods.rotations(sim)[0].as_matrix()
    rods.settle(sim)
    generator = np.zeros((4, 4))
    generator[:3, :3] = [[0.0, -u[2], u[1]], [u[2], 0.0, -u[0]], [-u[1], u[0], 0.0]]
    generator[2, 3] = 1.0
    expected = np.array([base @ expm(generator * s)[:3, 3] for s in np.linspace(0.0, 1.5, 31)])
    assert np.abs(rods.positions(sim) - expected).max() < 1e-8
    darboux = base @ u
    axis = darboux / np.linalg.norm(u)
    centre = np.cross(darboux, base[:, 2]) / (u @ u)
    spokes = rods.positions(sim) - centre
    radii = np.linalg.norm(spokes - np.outer(spokes @ axis, axis), axis=1)
    assert radii == pytest.approx(np.full(31, np.hypot(3.0, 2.0) / (u @ u)), rel=1e-6)
    assert float(sim.elastic_energy()[0]) < 1e-12 * EI


def test_precurved_rod() -> None:
    """A clamped quarter circle stays where it is without load, and an end moment EI / R straightens it."""
    sim = rods.scene(meshing.arc(0.5, np.pi / 2.0, 12, tangent=X, normal=(0.0, 0.0, 1.0)))
    start = rods.positions(sim)
    rods.settle(sim)
    assert np.abs(rods.positions(sim) - start).max() < 1e-10
    rods.pull(sim, -1, (0.0, 0.0, 0.0), (0.0, EI / 0.5, 0.0))
    rods.settle(sim)
    x = np.linspace(0.0, 0.25 * np.pi, 13)
    assert np.abs(rods.positions(sim) - np.stack([x, 0.0 * x, 0.0 * x], axis=1)).max() < 1e-6


@pytest.mark.parametrize("moment", [(1.0, 1.0), (1.0, 2.0), (2.0, 1.0)])
def test_twist_and_bend(moment: tuple[float, float]) -> None:
    """A dead end moment EI (along, across) / L bends and twists a straight rod into a helix about it (4.6).

    Its curvature is m_across / EI and its torsion m_along / EI whatever G J; the distance of the ends follows.
    """
    sim = beam(20)
    along, across = moment
    rods.pull(sim, -1, (0.0, 0.0, 0.0), EI * np.array([along, 0.0, across]))
    rods.settle(sim)
    turn = np.hypot(along, across)
    expected = np.hypot(2.0 * across / turn**2 * np.sin(0.5 * turn), along / turn)
    assert np.linalg.norm(rods.positions(sim)[-1]) == pytest.approx(expected, abs=1e-4)


# Buckling

COLUMNS = {"clamped-free": 0.25, "pinned-pinned": 1.0, "clamped-clamped": 4.0}  # P_cr L^2 / (pi^2 EI)


def column(kind: str, segments: int, **options: Any) -> sw.Simulation:
    """A metre of rod upwards; ends that are pinned, or that slide along z, are attached to bodies with locked axes."""
    if kind == "clamped-free":
        return rods.scene(meshing.straight(1.0, segments), **options)
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    rod = builder.add_rod(
        meshing.straight(1.0, segments), radius=rods.RADIUS, youngs=rods.YOUNGS, nu=rods.NU, density=rods.DENSITY
    )
    small: dict[str, Any] = {"mass": 0.01, "inertia": (1e-6, 1e-6, 1e-6)}
    if kind == "pinned-pinned":
        foot = builder.add_rigid(free_axes=("rx", "ry"), **small)
        builder.attach(rod, nodes=[0], to=foot)
        head = builder.add_rigid(free_axes=("z", "rx", "ry"), pose=(0.0, 0.0, 1.0), **small)
    else:
        builder.fix(rod, nodes=[0])
        head = builder.add_rigid(free_axes="z", pose=(0.0, 0.0, 1.0), **small)
    builder.attach(rod, nodes=[-1], to=head)
    return sw.Simulation(builder.finalize(precision="float64"), **options)


@pytest.mark.parametrize("kind", COLUMNS)
@pytest.mark.parametrize("share", [0.5, 0.9])
def test_beam_columns(kind: str, share: float) -> None:
    """Euler's loads from below (4.7): deflection w by a side force Q under P = 0.5 and 0.9 P_cr, with k^2 = P / EI.

    Q (tan kL - kL) / kP at the tip; Q (tan(kL/2) - kL/2) / 2kP and Q (tan(kL/4) - kL/4) / kP in the middle.
    40 segments; what P_cr is off shows ten times at 0.9 P_cr.
    """
    sim = column(kind, 40)
    load = share * COLUMNS[kind] * np.pi**2 * EI
    k, side, node = np.sqrt(load / EI), 1e-3 * EI, 40 if kind == "clamped-free" else 20
    rods.pull(sim, -1, (0.0, 0.0, -load))
    sim.control.rod_force[:, node, 0] = side
    rods.settle(sim)
    arm = {"clamped-free": 1.0, "pinned-pinned": 0.5, "clamped-clamped": 0.25}[kind]
    factor = 0.5 if kind == "pinned-pinned" else 1.0
    expected = factor * side / (k * load) * (np.tan(k * arm) - k * arm)
    assert rods.positions(sim)[node, 0] == pytest.approx(expected, rel=2e-3 if share < 0.9 else 5e-3)


@pytest.mark.parametrize("angle", [pytest.param(60.0, marks=pytest.mark.slow), 120.0])
def test_buckled_column(angle: float) -> None:
    """Beyond Euler's load a column bends to the elastica: tip angle phi at P = P_cr (2K / pi)^2, k = sin(phi/2).

    Tip (2k / K, 2E / K - 1); it is found after a side force has been taken away, and is stable.
    """
    k = np.sin(np.radians(angle) / 2.0)
    K, E = ellipk(k * k), ellipe(k * k)
    sim = column("clamped-free", 20)
    rods.pull(sim, -1, (0.01 * EI, 0.0, -K * K * EI))
    rods.settle(sim)
    rods.pull(sim, -1, (0.0, 0.0, -K * K * EI))
    rods.settle(sim)
    assert rods.positions(sim)[-1, [0, 2]] == pytest.approx((2.0 * k / K, 2.0 * E / K - 1.0), abs=1e-3)


@pytest.mark.parametrize("share", [0.95, 1.05])
def test_greenhill(share: float) -> None:
    """A stem carries its weight up to L = (7.8373 EI / (rho g A))^(1/3): after a kick it stands or falls (4.7)."""
    radius = 0.005
    weight = rods.DENSITY * 9.81 * rods.area(radius)
    length = share * (7.8373 * rods.bending(radius) / weight) ** (1.0 / 3.0)
    sim = rods.scene(
        meshing.straight(length, 20),
        radius=radius,
        gravity=(0.0, 0.0, -9.81),
        rayleigh=(1.0, 0.0),
        simulation={"dt": 0.02, "newton_iterations": 8},
    )
    sim.rod_v[0, :, 0] = 1e-4 * length * 7.0 * torch.linspace(0.0, 1.0, 21) ** 2
    for _ in range(400):
        sim.step()
    sway = float(sim.rod_x[0, -1, 0].abs()) / length
    assert sway < 1e-4 if share < 1.0 else sway > 0.1


def test_strong_shear() -> None:
    """w = F x / GA_s + F (L x^2 / 2 - x^3 / 6) / EI with G a hundredth of E: half of it is shear (4.9)."""
    length, radius, youngs, force = 3.0, 0.25, 1e6, 0.01
    section, inertia = rods.area(radius), np.pi * radius**4 / 4.0
    shear = 0.9 * 1e4 * section  # G A_s
    given = (section, shear / (youngs / 2.0), inertia, inertia, 2.0 * inertia)
    points = meshing.straight(length, 20, direction=X)
    sim = rods.scene(points, radius=radius, youngs=youngs, nu=0.0, section=given)
    rods.pull(sim, -1, (0.0, 0.0, force))
    rods.settle(sim)
    x = points[:, 0]
    expected = force * (x / shear + (length * x**2 / 2.0 - x**3 / 6.0) / (youngs * inertia))
    assert np.abs(rods.positions(sim)[:, 2] - expected).max() < 2e-3 * expected[-1]


def test_catenary() -> None:
    """A thin rod of length 1 hung over 0.8 m: sag 0.265438, middle tension 0.338202 w (4.8).

    Ends are clamped; the rod is soft enough for them to matter over millimetres only.
    """
    half = brentq_arc(1.0, 0.8)
    arc = meshing.arc(0.5 / half, 2.0 * half, 80, tangent=(np.cos(half), 0.0, -np.sin(half)), normal=(0.0, 0.0, 1.0))
    radius, gravity = 2e-4, (0.0, 0.0, -9.81)
    sim = rods.scene(arc, radius=radius, youngs=1e7, curvature=(0.0, 0.0, 0.0), fixed=(0, -1), gravity=gravity)
    rods.settle(sim)
    assert -rods.positions(sim)[40, 2] == pytest.approx(0.265438, rel=5e-3)
    weight = rods.DENSITY * rods.area(radius) * 9.81
    tension = sim.rod_resultants()[0, 39:41, 2].mean()
    assert float(tension) / weight == pytest.approx(0.338202, rel=5e-3)


def brentq_arc(length: float, chord: float) -> float:
    """Half the angle of an arc with the given length and chord."""
    from scipy.optimize import brentq

    return float(brentq(lambda a: np.sin(a) / a - chord / length, 0.01, 3.0))


# Vibration


def vibrate(segments: int, mode: int, tip: float, steps: int, **options: Any) -> tuple[np.ndarray, float, float]:
    """Amplitudes of a small bending mode, its angular frequency by beam theory, and the time step."""
    beta = rods.beam_number(tip, mode)
    mass = rods.DENSITY * rods.area()
    omega = beta**2 * np.sqrt(EI / mass)
    h = 0.02 / omega
    rayleigh = options.pop("rayleigh", (0.0, 0.0))
    options["rayleigh"] = (rayleigh[0] * omega, rayleigh[1] / omega)
    simulation = {"dt": h} | options.pop("simulation", {})
    sim = beam(segments, tip_mass=tip * mass, simulation=simulation, **options)
    shape, slope = rods.mode_shape(beta, np.linspace(0.0, 1.0, segments + 1))
    sim.rod_v[0, :, 2] = torch.tensor(1e-4 * omega * shape)
    sim.rod_w[0, :, 1] = torch.tensor(-1e-4 * omega * slope)
    sim.refresh()
    weight = rods.lumped(segments + 1, tip) * shape
    values = []
    for _ in range(steps):
        sim.step()
        values.append(weight @ rods.positions(sim)[:, 2])
    return np.array(values), omega, h


@pytest.mark.parametrize("tip", [0.0, 0.25, 0.5, 1.0])
@pytest.mark.parametrize("mode", [0, 1])
def test_bending_frequencies(mode: int, tip: float) -> None:
    """f = (beta L)^2 / 2 pi L^2 sqrt(EI / rho A) of a cantilever, without and with a rigid body on its end (5.1, 6.6).

    0.3 %, of which shear and rotary inertia take 0.2 % of the second mode. The roots beta L are those of the catalogue.
    """
    table = {
        0.0: (1.875104, 4.694091),
        0.25: (1.573751, 4.225113),
        0.5: (1.419964, 4.111133),
        1.0: (1.247917, 4.031139),
    }
    assert rods.beam_number(tip, mode) == pytest.approx(table[tip][mode], abs=1e-6)
    values, omega, h = vibrate(30, mode, tip, 300)
    assert rods.frequency(values, h) == pytest.approx(omega, rel=3e-3)


@pytest.mark.parametrize("kind", ["axial", "torsion"])
def test_axial_and_torsional_frequency(kind: str) -> None:
    """c / 4 L with c = sqrt(E / rho), or sqrt(G / rho) for a round section; lumped masses take 1 / (4.9 n^2) of it."""
    speed = np.sqrt(rods.YOUNGS / rods.DENSITY / (1.0 if kind == "axial" else 2.0 * (1.0 + rods.NU)))
    omega, s = 0.5 * np.pi * speed, np.linspace(0.0, 1.0, 21)
    h = 0.02 / omega
    sim = beam(20, simulation={"dt": h})
    shape = np.sin(0.5 * np.pi * s)
    part = sim.rod_v if kind == "axial" else sim.rod_w
    part[0, :, 0] = torch.tensor(1e-4 * omega * shape)
    start, values = rods.rotations(sim), []
    for _ in range(200):
        sim.step()
        turn = (rods.rotations(sim) * start.inv()).as_rotvec()[:, 0]
        moved = rods.positions(sim)[:, 0] - s if kind == "axial" else turn
        values.append((rods.lumped(21) * shape) @ moved)
    # sin(w h / 2) dispersion of lumped masses: (2 n / (pi/2)) sin(pi / 4 n) of the continuum
    discrete = 40.0 / (0.5 * np.pi) * np.sin(np.pi / 80.0)
    assert rods.frequency(values, h) == pytest.approx(omega * discrete, rel=2e-5)


@pytest.mark.parametrize("rayleigh", [(0.0, 0.0), (0.3, 0.0), (0.0, 0.3), (0.2, 0.2)])
@pytest.mark.parametrize("iterations", [1, 6])
def test_damping(rayleigh: tuple[float, float], iterations: int) -> None:
    """A mode under C = a M + b K follows x_{n+1} (1 + h c + h^2 w^2) = (2 + h c) x_n - x_{n-1}, c = a + b w^2 (5.2).

    The same with one and with many Newton iterations; to 1e-4 in both coefficients at w h = 0.02 (w by beam theory).
    """
    values, omega, h = vibrate(20, 0, 0.0, 200, rayleigh=rayleigh, simulation={"newton_iterations": iterations})
    expected = rods.backward_euler(omega, h, rayleigh[0] * omega, rayleigh[1] / omega)
    measured = rods.recurrence(values)
    assert measured == pytest.approx(expected, abs=2e-5)
    decay, turn = -0.5 * np.log(measured[1]), np.arccos(0.5 * measured[0] / np.sqrt(measured[1]))
    zeta = decay / np.hypot(decay, turn)
    assert zeta == pytest.approx(0.5 * (sum(rayleigh) + 0.02), abs=2e-3)  # w h / 2 of it from the method


def free_rod(**simulation: Any) -> sw.Simulation:
    """A kicked rod that nothing holds."""
    sim = beam(20, fixed=(), simulation=simulation)
    s = torch.linspace(0.0, 1.0, 21, dtype=torch.float64)
    sim.rod_v[0, :, 1] = torch.sin(5.0 * s) + 0.5
    sim.rod_v[0, :, 2] = torch.cos(8.0 * s)
    sim.rod_w[0, :, 0] = 2.0 * s
    return sim


@pytest.mark.parametrize(("iterations", "tolerance"), [(1, 1e-14), (12, 1e-9)])
def test_free_rod_keeps_momentum(iterations: int, tolerance: float) -> None:
    """Linear momentum to rounding (to the Newton tolerance); angular momentum is lost in proportion to dt (5.4)."""
    losses = []
    for halvings in range(3):
        sim = free_rod(dt=0.004 / 2**halvings, newton_iterations=iterations)
        linear, angular = sim.momentum()
        for _ in range(25 * 2**halvings):
            sim.step()
        now, turning = sim.momentum()
        assert float((now - linear).norm() / linear.norm()) < 25 * 2**halvings * tolerance
        losses.append(float((turning - angular).norm() / angular.norm()))
    assert losses[0] < 0.02
    assert np.log2(losses[1] / losses[2]) == pytest.approx(1.0, abs=0.35)


def test_free_rod_loses_energy_only() -> None:
    """Kinetic plus elastic energy never grows under backward Euler with converged Newton steps (5.4)."""
    sim = free_rod(dt=0.002, newton_iterations=15)
    energies = []
    for _ in range(60):
        energies.append(float(sim.kinetic_energy()[0] + sim.elastic_energy()[0]))
        sim.step()
    assert np.diff(energies).max() < 1e-9 * energies[0]
    assert energies[-1] < 0.999 * energies[0]


def test_sections_turn_with_their_momentum() -> None:
    """Sections of a rod without stiffness are symmetric tops, I_3 = 2 I_1: w turns about the tangent at w_3 (6.2).

    First order in dt.
    """
    errors = []
    for dt in (2e-3, 1e-3):
        sim = beam(2, fixed=(), radius=0.1, youngs=1e-12, simulation={"dt": dt})
        start = rods.rotations(sim)[0]
        sim.rod_w[0] = torch.tensor(start.apply([0.5, 0.0, 4.0]))
        for _ in range(round(1.0 / dt)):
            sim.step()
        w = rods.rotations(sim)[0].inv().apply(sim.rod_w[0, 0].numpy())
        errors.append(np.abs(w - [0.5 * np.cos(4.0), 0.5 * np.sin(4.0), 4.0]).max())
    assert errors[1] < 1e-2
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize(("radius", "tolerance"), [(1e-3, 1e-3), (2e-4, 0.04), (5e-5, 0.06)])
def test_thin_rods_in_float32(radius: float, tolerance: float) -> None:
    """A thin clamped rod falls as in float64 although products of its pieces' moments of inertia underflow.

    These are 1e-12 to 1e-17 kg m2. Bending is (L / r)^2 times softer than stretching, and rounding grows by that.
    """
    tips = []
    for precision in ("float64", "float32"):
        points = meshing.straight(0.1, 20, direction=X)
        sim = rods.scene(points, radius=radius, youngs=1e9, gravity=(0.0, 0.0, -9.81), precision=precision)
        for _ in range(20):
            sim.step()
        assert int(sim.status[0]) == 0
        tips.append(rods.positions(sim)[-1])
    assert np.linalg.norm(tips[0] - points[-1]) > 1e-4
    assert np.linalg.norm(tips[1] - tips[0]) < tolerance * np.linalg.norm(tips[0] - points[-1])


def test_free_free_frequency() -> None:
    """First bending mode of a free rod: beta L = 4.730041, 0.5 % (5.1)."""
    beta = 4.730041
    omega = beta**2 * np.sqrt(EI / (rods.DENSITY * rods.area()))
    h, s = 0.02 / omega, np.linspace(0.0, 1.0, 31)
    sim = beam(30, fixed=(), simulation={"dt": h})
    k = (np.cosh(beta) - np.cos(beta)) / (np.sinh(beta) - np.sin(beta))
    shape = np.cosh(beta * s) + np.cos(beta * s) - k * (np.sinh(beta * s) + np.sin(beta * s))
    slope = beta * (np.sinh(beta * s) - np.sin(beta * s) - k * (np.cosh(beta * s) + np.cos(beta * s)))
    sim.rod_v[0, :, 2] = torch.tensor(1e-4 * omega * shape)
    sim.rod_w[0, :, 1] = torch.tensor(-1e-4 * omega * slope)
    values = []
    for _ in range(300):
        sim.step()
        values.append((rods.lumped(31) * shape) @ rods.positions(sim)[:, 2])
    assert rods.frequency(values, h) == pytest.approx(omega, rel=5e-3)
