"""Air chambers in equilibrium against theory and the catalogue, sections 3.1 to 3.3; E = 1e5 Pa."""

import numpy as np
import pytest

import softwarp as sw
from tests import pneumatic_cases as cases
from tests.pneumatic_cases import radial, settle, statics

YOUNGS = 1.0e5
INNER, OUTER = 0.01, 0.02  # m, radii A and B of the thick sphere and cylinder


def inflated(case, law, nu, pressure, **options):
    """The case in equilibrium under a gauge pressure [Pa]."""
    sim = statics(cases.builder_of(case, law, YOUNGS, nu), **options)
    sim.control.cavity_pressure.fill_(pressure)
    settle(sim)
    return sim


SPHERES = [  # law, nu, pressure, n = nr, mean displacements of the inner and outer wall [mm] on this mesh
    ("nh_log", 0.3, 2.0e4, 4, 2.218635, 0.939892),
    ("nh_log", 0.3, 2.0e4, 8, 2.466440, 1.046048),
    ("stvk", 0.3, 1.0e4, 4, 0.856194, 0.299242),
    ("stvk", 0.3, 1.0e4, 8, 0.963601, 0.328376),
    ("nh_log", 0.45, 2.0e4, 4, 2.351647, 0.767124),
    ("nh_log", 0.45, 2.0e4, 8, 2.647862, 0.889206),
]


@pytest.mark.parametrize(
    ("law", "nu", "pressure", "n", "inner", "outer"),
    [pytest.param(*case, marks=pytest.mark.slow if case[3] > 4 else ()) for case in SPHERES],
)
def test_sphere_same_mesh(law, nu, pressure, n, inner, outer):
    """Catalogue 3.1, P1 octants, to its last digit: 2e-6. CalculiX C3D4 has 0.856019/0.299189 for stvk (4, 4)."""
    case = cases.sphere_octant(n, n)
    sim = inflated(case, law, nu, pressure)
    found = [1e3 * radial(case, sim, nodes) for nodes in (case.inner, case.outer)]
    np.testing.assert_allclose(found, [inner, outer], rtol=2e-6)
    np.testing.assert_allclose(sim.cavity_pressure.item(), pressure, rtol=1e-12)


EXACT_SPHERES = [  # law, nu, pressure, exact displacements, same-mesh ones where the catalogue has them [mm]
    ("nh_log", 0.3, 2.0e4, (2.571350, 1.090583), (2.543459, 1.078900)),
    ("nh_log", 0.45, 2.0e4, (2.813751, 0.956425), (2.761933, 0.935967)),
    ("stvk", 0.3, 1.0e4, (1.017828, 0.342053), None),
    ("snh", 0.3, 2.0e4, (2.546781, 1.058026), None),
    ("corot", 0.3, 2.0e4, (2.500000, 0.937500), None),
]


@pytest.mark.slow
@pytest.mark.parametrize(("law", "nu", "pressure", "exact", "mesh"), EXACT_SPHERES)
def test_sphere_exact(law, nu, pressure, exact, mesh):
    """The radial boundary value problem: mesh values 1e-5, (16, 16) 1.5 %, extrapolated with (8, 8) 0.5 %.

    Two miss 1.5 % by their mesh alone: 1.512 % for stvk, and 1.84 and 2.14 % at nu = 0.45, where linear tets lock (the
    catalogue's own mesh values are as far off) and 0.51 % is left after extrapolation.
    """
    found = []
    for n in (8, 16):
        case = cases.sphere_octant(n, n)
        sim = inflated(case, law, nu, pressure, newton_tolerance=1e-6)
        found.append([1e3 * radial(case, sim, nodes) for nodes in (case.inner, case.outer)])
    coarse, fine = np.array(found)
    np.testing.assert_allclose(fine, exact, rtol=0.0215 if nu > 0.4 else 0.0152 if law == "stvk" else 0.015)
    np.testing.assert_allclose((4.0 * fine - coarse) / 3.0, exact, rtol=0.006 if nu > 0.4 else 0.005)
    if mesh is not None:
        np.testing.assert_allclose(fine, mesh, rtol=1e-5)


CYLINDERS = [  # law, cells, displacements [mm]; nu = 0.3, p = 1e4
    ("nh_log", (4, 6, 1), 2.474868, 1.657812),
    ("nh_log", (8, 12, 2), 2.553104, 1.703670),
    ("stvk", (8, 12, 2), 2.082723, 1.217936),
]


@pytest.mark.parametrize(("law", "cells", "inner", "outer"), CYLINDERS)
def test_cylinder_same_mesh(law, cells, inner, outer):
    """Catalogue 3.1, plane strain, to its last digit: 2e-6."""
    case = cases.cylinder_quarter(*cells)
    sim = inflated(case, law, 0.3, 1.0e4)
    found = [1e3 * radial(case, sim, nodes, axes=2) for nodes in (case.inner, case.outer)]
    np.testing.assert_allclose(found, [inner, outer], rtol=2e-6)


EXACT_CYLINDERS = [
    ("nh_log", 0.3, (2.583378, 1.721351), (2.575663, 1.716858)),
    ("stvk", 0.3, (2.126183, 1.236369), (2.114753, 1.231557)),
    ("nh_log", 0.45, (2.762296, 1.600736), None),
    ("stvk", 0.45, (2.320416, 1.125002), None),
]


@pytest.mark.slow
@pytest.mark.parametrize(("law", "nu", "exact", "mesh"), EXACT_CYLINDERS)
def test_cylinder_exact(law, nu, exact, mesh):
    """The radial boundary value problem at (16, 24, 2): 1.5 %; mesh values 1e-5."""
    case = cases.cylinder_quarter(16, 24, 2)
    sim = inflated(case, law, nu, 1.0e4, newton_tolerance=1e-7)
    found = [1e3 * radial(case, sim, nodes, axes=2) for nodes in (case.inner, case.outer)]
    np.testing.assert_allclose(found, exact, rtol=0.015)
    if mesh is not None:
        np.testing.assert_allclose(found, mesh, rtol=1e-5)


def lame_sphere(r, pressure, nu):
    """u(r) = p A^3 / (E (B^3 - A^3)) ((1 - 2 nu) r + (1 + nu) B^3 / (2 r^2)) [m]."""
    a, b = INNER**3, OUTER**3
    return pressure * a / (YOUNGS * (b - a)) * ((1.0 - 2.0 * nu) * r + (1.0 + nu) * b / (2.0 * r * r))


def lame_cylinder(r, pressure, nu):
    """u(r) = (1 + nu) p A^2 / (E (B^2 - A^2)) ((1 - 2 nu) r + B^2 / r) [m], plane strain."""
    a, b = INNER**2, OUTER**2
    return (1.0 + nu) * pressure * a / (YOUNGS * (b - a)) * ((1.0 - 2.0 * nu) * r + b / r)


@pytest.mark.parametrize(
    "law", ["large", *(pytest.param(law, marks=pytest.mark.slow) for law in ("stvk", "nh_log", "snh", "corot"))]
)
def test_small_pressure_is_lame(law):
    """Lame's thick sphere and cylinder at 1 Pa: extrapolated from two meshes 1 %; every law is linear there."""
    pressure, nu = 1.0, 0.3
    for make, lame, axes in (
        (lambda n: cases.sphere_octant(n, n), lame_sphere, 3),
        (lambda n: cases.cylinder_quarter(n, 3 * n // 2, n // 4), lame_cylinder, 2),
    ):
        found = []
        for n in (4, 8):
            case = make(n)
            sim = inflated(case, law, nu, pressure)
            found.append([radial(case, sim, nodes, axes) for nodes in (case.inner, case.outer)])
        limit = (4.0 * np.array(found[1]) - np.array(found[0])) / 3.0
        np.testing.assert_allclose(limit, [lame(INNER, pressure, nu), lame(OUTER, pressure, nu)], rtol=0.01)


BENDERS = [  # law, refinement, displacement of the corner (0.06, 0.01, 0) [mm], volume [m^3]; nu = 0.4, 8 kPa
    pytest.param("stvk", 1, (0.114091, 0.089448, -0.502664), 3.0392569e-6, id="stvk"),
    pytest.param("nh_log", 1, (0.102838, 0.084179, -0.493837), 3.0967234e-6, id="nh_log"),
    pytest.param("stvk", 2, (0.138824, 0.059997, -0.705155), 3.3482860e-6, id="stvk-fine", marks=pytest.mark.slow),
    pytest.param("nh_log", 2, (0.133941, 0.055127, -0.658850), 3.4610552e-6, id="nh_log-fine", marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("law", "refine", "tip", "volume"), BENDERS)
def test_bender_same_mesh(law, refine, tip, volume):
    """Catalogue 3.3: 1e-4 of the deflection, 1e-5 of the volume; CalculiX C3D4 has 0.114133, 0.089380, -0.502497."""
    case = cases.bender(refine)
    sim = inflated(case, law, 0.4, 8.0e3)
    assert sim.model.cavities.rest_volume[0] == pytest.approx(2.5e-6)
    corner = int(np.argmin(np.linalg.norm(case.mesh.nodes - cases.BENDER_TIP, axis=1)))
    moved = 1e3 * (sim.node_x[0, corner].numpy() - case.mesh.nodes[corner])
    np.testing.assert_allclose(moved, tip, atol=1e-4 * abs(tip[2]))
    np.testing.assert_allclose(sim.cavity_volume.item(), volume, rtol=1e-5)


@pytest.mark.parametrize(
    ("iterations", "precision", "tolerance"),
    [(1, "float64", 1e-7), pytest.param(4, "float64", 1e-7, marks=pytest.mark.slow), (1, "float32", 2e-5)],
)
def test_equilibrium_does_not_depend_on_the_step(iterations, precision, tolerance):
    """A held pressure gives the static shape with steps of 10, 1 and 0.1 ms; the catalogue asks for 1e-5."""
    case, pressure = cases.sphere_octant(3, 2), 1.0e4
    shape = inflated(case, "nh_log", 0.3, pressure).node_x[0].numpy()
    for dt, steps in ((1e-2, 60), (1e-3, 300), (1e-4, 2000)):
        builder = cases.builder_of(case, "nh_log", YOUNGS, 0.3, rayleigh=(200.0, 2.0e-3))
        sim = sw.Simulation(builder.finalize(precision=precision), dt=dt, newton_iterations=iterations)
        sim.control.cavity_pressure.fill_(pressure)
        for _ in range(steps):
            sim.step()
        assert sim.status.item() == sw.Status.OK
        np.testing.assert_allclose(sim.cavity_pressure.item(), pressure, rtol=1e-6)
        np.testing.assert_allclose(sim.node_x[0], shape, atol=tolerance * np.abs(shape - case.mesh.nodes).max())


@pytest.mark.parametrize("law", ["stvk", pytest.param("nh_log", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda: cases.sphere_octant(4, 4), id="sphere"),
        pytest.param(lambda: cases.bender(1), id="bender", marks=pytest.mark.slow),
    ],
)
def test_volume_and_gas_control_find_the_pressure(make, law):
    """At equal volume or amount of gas the multiplier is the imposed pressure, and the shapes agree: 1e-6."""
    case, nu, pressure = make(), 0.35, 9.0e3
    imposed = inflated(case, law, nu, pressure)
    volume = imposed.cavity_volume.item()
    size = np.abs(imposed.node_x[0].numpy() - case.mesh.nodes).max()
    for exponent in (1.0, 1.4):
        content = volume * (1.0 + pressure / 101325.0) ** (1.0 / exponent)
        for control, command in (("volume", volume), ("gas", content)):
            sim = statics(cases.builder_of(case, law, YOUNGS, nu, control=control, exponent=exponent))
            getattr(sim.control, f"cavity_{control}").fill_(command)
            settle(sim)
            np.testing.assert_allclose(sim.cavity_pressure.item(), pressure, rtol=1e-6)
            np.testing.assert_allclose(sim.cavity_volume.item(), volume, rtol=1e-9)
            np.testing.assert_allclose(sim.node_x[0], imposed.node_x[0], atol=1e-6 * size)


@pytest.mark.slow
def test_work_of_pressure_is_stored():
    """The elastic energy is the integral of p dV along a static path: Simpson's rule over 24 volumes, 1e-6."""
    sim = statics(cases.builder_of(cases.sphere_octant(4, 4), "nh_log", YOUNGS, 0.3, control="volume"))
    rest = sim.cavity_volume.item()
    volumes = np.linspace(rest, 2.2 * rest, 25)
    pressures = [0.0]
    for volume in volumes[1:]:
        sim.control.cavity_volume.fill_(volume)
        settle(sim)
        pressures.append(sim.cavity_pressure.item())
    weights = np.where(np.arange(25) % 2 == 1, 4.0, 2.0)
    weights[[0, -1]] = 1.0
    work = (volumes[1] - volumes[0]) / 3.0 * np.dot(weights, pressures)
    np.testing.assert_allclose(sim.elastic_energy().item(), work, rtol=1e-6)


class TestBalloon:
    """Thin sphere, R = 10 mm, H = 0.5 mm, nu = 0.45: p = 2 mu H / R (1/l - 1/l^7), at most 1.23946 mu H / R.

    The formula is for no compressibility and no thickness; with these and facets 4 % are left.
    """

    RADIUS, WALL = 0.01, 0.0005  # m
    SHEAR = YOUNGS / 2.9  # Pa
    LIMIT = 1.23946 * SHEAR * WALL / RADIUS  # Pa

    def sim(self, control):
        case = cases.sphere_octant(8, 1, self.RADIUS - self.WALL / 2, self.RADIUS + self.WALL / 2)
        return statics(cases.builder_of(case, "nh_log", YOUNGS, 0.45, control=control), newton_tolerance=1e-8)

    def test_volume_control_passes_the_limit_point(self):
        """Every volume up to a stretch of 2 has its equilibrium; the pressure rises, peaks near 7^(1/6), and falls."""
        sim = self.sim("volume")
        rest, stretches, pressures = sim.cavity_volume.item(), np.linspace(1.05, 2.0, 20), []
        for stretch in stretches:
            sim.control.cavity_volume.fill_(rest * stretch**3)
            settle(sim)
            pressures.append(sim.cavity_pressure.item())
        peak = int(np.argmax(pressures))
        assert 1.3 < stretches[peak] < 1.5
        assert (np.diff(pressures[: peak + 1]) > 0.0).all() and (np.diff(pressures[peak:]) < 0.0).all()
        np.testing.assert_allclose(pressures[peak], self.LIMIT, rtol=0.03)
        theory = 2.0 * self.SHEAR * self.WALL / self.RADIUS * (1.0 / stretches - stretches**-7)
        np.testing.assert_allclose(pressures[5:], theory[5:], rtol=0.04)

    def test_pressure_control_snaps(self):
        """Below the limit the balloon holds; 5 % above it there is no equilibrium, and the world says so."""
        sim = self.sim("pressure")
        rest = sim.cavity_volume.item()
        sim.control.cavity_pressure.fill_(0.95 * self.LIMIT)
        settle(sim)
        assert sim.cavity_volume.item() < 1.4**3 * rest
        sim.control.cavity_pressure.fill_(1.05 * self.LIMIT)
        sim.step()
        assert sim.status.item() != sw.Status.OK

    def test_pressure_control_runs_away_in_dynamics(self):
        """With inertia the volume passes 8 rest volumes above the limit; below it it stays within 1.4^3 of them."""
        largest = []
        for share in (0.9, 1.05):
            case = cases.sphere_octant(8, 1, self.RADIUS - self.WALL / 2, self.RADIUS + self.WALL / 2)
            builder = cases.builder_of(case, "nh_log", YOUNGS, 0.45, rayleigh=(100.0, 0.0))
            sim = sw.Simulation(builder.finalize(precision="float64"), dt=2e-3)
            rest = sim.cavity_volume.item()
            sim.control.cavity_pressure.fill_(share * self.LIMIT)
            ratio = 1.0
            for _ in range(400):
                sim.step()
                if sim.status.item() != sw.Status.OK or ratio > 8.0:
                    break
                ratio = max(ratio, sim.cavity_volume.item() / rest)
            largest.append(ratio)
        assert largest[0] < 1.4**3
        assert largest[1] > 8.0


def test_membrane_on_the_wall_stiffens_the_chamber():
    """Skin on the inner wall of a thick sphere at a small pressure: u = c (p - 2 E_s t u / ((1 - nu_s) A^2)).

    c [m/Pa] is measured without the skin; 2 % for the facets (5.3 % at n = 4, 0.5 % at n = 14).
    """
    pressure, youngs, nu, thickness = 10.0, 8.0e6, 0.3, 1.0e-4
    case = cases.sphere_octant(8, 4)
    compliance = radial(case, inflated(case, "stvk", 0.3, pressure), case.inner) / pressure
    builder = cases.builder_of(case, "stvk", YOUNGS, 0.3)
    wall = case.vertex_node[case.triangles]
    builder.add_membrane(0, wall[(wall >= 0).all(axis=1)], thickness=thickness, youngs=youngs, nu=nu)
    sim = statics(builder)
    sim.control.cavity_pressure.fill_(pressure)
    settle(sim)
    stiffness = 2.0 * youngs * thickness / ((1.0 - nu) * INNER**2)
    assert compliance * stiffness > 1.0  # the skin carries more than the wall
    expected = compliance * pressure / (1.0 + compliance * stiffness)
    np.testing.assert_allclose(radial(case, sim, case.inner), expected, rtol=0.02)
