"""Frequencies of meshed beams and the damping of the time integrator (catalogue 5.1, 5.2)."""

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

from softwarp import meshing
from tests import cases


def modes(case: cases.Case, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Lowest angular frequencies [rad/s] and mode shapes (count, node, 3) of K u = w^2 M u about the present state."""
    free = np.repeat(case.free, 3)
    K = scipy.sparse.csc_matrix(case.sim.stiffness_matrix())[free][:, free]
    mass = np.repeat(case.sim.mass[0].double().cpu().numpy(), 3)
    values, vectors = scipy.sparse.linalg.eigsh(K, count, scipy.sparse.diags(mass[free]).tocsc(), sigma=0.0)
    shapes = np.zeros((count, free.size))
    shapes[:, free] = vectors.T
    return np.sqrt(values), shapes.reshape(count, -1, 3)


@pytest.mark.parametrize(
    "law", ["corot", "nh_log", "large", *(pytest.param(law, marks=pytest.mark.slow) for law in ("stvk", "snh"))]
)
def test_cantilever_frequencies_same_mesh(law: str) -> None:
    """P1 (20,2,2), lumped mass: two bending pairs, torsion, axial [Hz] as in 5.1, printed to 1e-5; all laws agree.

    Timoshenko's beam has 0.506816 Hz: linear tetrahedra are 30 to 54 % too stiff in bending here.
    """
    case = cases.cantilever((20, 2, 2), law)
    omega, _ = modes(case, 8)
    measured = omega / (2.0 * np.pi)
    for expected in (0.65915, 0.78220, 3.88055, 4.50042, 5.61519, 7.96437):
        assert np.abs(measured - expected).min() < 1.5e-5
    np.testing.assert_allclose(measured[:4], [0.65915, 0.78220, 3.88055, 4.50042], atol=1.5e-5)


def test_axial_frequency() -> None:
    """With nu = 0 the lowest axial mode of the bar is sqrt(E / rho) / 4 L = 7.90569 Hz, lumped P1 within 0.3 %."""
    case = cases.cantilever((20, 2, 2), "corot", nu=0.0)
    omega, shapes = modes(case, 8)
    axial = np.argmax((shapes[:, :, 0] ** 2).sum(axis=1) / (shapes**2).sum(axis=(1, 2)))
    assert omega[axial] / (2.0 * np.pi) == pytest.approx(np.sqrt(1e6 / 1000.0) / 4.0, rel=3e-3)


def spring(step: float, rayleigh: tuple[float, float] = (0.0, 0.0), **options: object) -> tuple[cases.Case, float]:
    """One tetrahedron with three held corners: a mass on an exactly linear spring, and its omega [rad/s].

    The free corner moves along the height H = 0.1 m of the element. F = 1 + (z/H) e_z e_z^T is symmetric, so the
    corotational force V (2 mu + lam) z / H^2 is linear for every z > -H; its mass is rho V / 4:
    omega^2 = 4 (2 mu + lam) / (rho H^2). ``step`` is omega dt.
    """
    youngs, nu, density, height = 1e4, 0.3, 1000.0, 0.1
    mu, lam = cases.lame(youngs, nu)
    omega = np.sqrt(4.0 * (2.0 * mu + lam) / (density * height**2))
    nodes = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, height]])
    mesh = meshing.TetMesh(nodes, np.array([[0, 1, 2, 3]], dtype=np.int32))
    damping = (rayleigh[0] * omega, rayleigh[1] / omega)
    case = cases.body(
        mesh, "corot", youngs, nu, density=density, fixed=np.arange(3), rayleigh=damping, dt=step / omega, **options
    )
    return case, float(omega)


def oscillate(case: cases.Case, steps: int, height: float) -> np.ndarray:
    """Elongation and velocity of the free corner, (steps + 1, 2), released from 0.02 m."""
    start = case.mesh.nodes.copy()
    start[3, 2] += 0.02
    case.move(start)
    track = [(0.02, 0.0)]
    for _ in range(steps):
        case.sim.step()
        track.append((float(case.sim.node_x[0, 3, 2]) - height, float(case.sim.node_v[0, 3, 2])))
    return np.array(track)


@pytest.mark.parametrize("step", [0.01, 0.1, 1.0, 5.0])
@pytest.mark.parametrize("newton_iterations", [1, 4])
def test_backward_euler_on_a_spring(step: float, newton_iterations: int) -> None:
    """Each step multiplies x + i v / w by 1 / (1 - i w h): amplitude rho^n, rho = 1 / sqrt(1 + w^2 h^2) (5.2).

    One Newton iteration is exact on a linear spring. 100 steps at w h = 0.1: amplitude 0.6080388246890.
    """
    case, omega = spring(step, newton_iterations=newton_iterations)
    track = oscillate(case, 100, 0.1)
    measured = (track[:, 0] - 1j * track[:, 1] / omega) / 0.02
    expected = (1.0 / (1.0 - 1j * step)) ** np.arange(101)
    np.testing.assert_allclose(measured, expected, atol=1e-10)
    if step == 0.1:
        assert abs(measured[-1]) == pytest.approx(0.6080388246890, abs=1e-10)
    energy = np.abs(measured) ** 2
    np.testing.assert_allclose(energy, (1.0 + step**2) ** -np.arange(101.0), atol=1e-10)


@pytest.mark.parametrize("rayleigh", [(0.2, 0.0), (0.0, 0.3), (0.2, 0.3)])
@pytest.mark.parametrize("newton_iterations", [1, 4])
def test_rayleigh_damping_on_a_spring(rayleigh: tuple[float, float], newton_iterations: int) -> None:
    """C = a M + b K with a = 0.2 w, b = 0.3 / w: (1 + h a + h (h + b) w^2) v' = v - h w^2 x, x' = x + h v'."""
    step = 0.1
    case, omega = spring(step, rayleigh, newton_iterations=newton_iterations)
    h, a, b = step / omega, rayleigh[0] * omega, rayleigh[1] / omega
    x, v, expected = 0.02, 0.0, [(0.02, 0.0)]
    for _ in range(100):
        v = (v - h * omega**2 * x) / (1.0 + h * a + h * (h + b) * omega**2)
        x = x + h * v
        expected.append((x, v))
    track = oscillate(case, 100, 0.1)
    np.testing.assert_allclose(track * [1.0, 1.0 / omega], np.array(expected) * [1.0, 1.0 / omega], atol=2e-12)


def test_spring_in_float32() -> None:
    """float32 keeps the closed form to 1e-5 of the amplitude times the rounding of x = 0.1 m over 100 steps."""
    case, _ = spring(0.1, precision="float32")
    track = oscillate(case, 100, 0.1)
    expected = (1.0 / (1.0 - 0.1j)) ** np.arange(101)
    np.testing.assert_allclose(track[:, 0] / 0.02, expected.real, atol=1e-3)


@pytest.mark.parametrize("law", [*cases.LAWS, "large"])
def test_beam_mode_is_damped_like_the_formula(law: str) -> None:
    """First bending mode of an FE beam, w h = 0.1, 100 steps: amplitude 0.608039 to 1 % (5.2).

    Released at 1e-4 of its length, where every law is linear to 1e-4.
    """
    case = cases.cantilever((10, 2, 2), law)
    omega, shapes = modes(case, 1)
    case = cases.cantilever((10, 2, 2), law, dt=0.1 / omega[0])
    mass = case.sim.mass[0].double().cpu().numpy()
    shape = shapes[0] * 1e-4 / np.abs(shapes[0]).max()
    case.move(case.mesh.nodes + shape)
    weight = mass[:, None] * shape / (mass[:, None] * shape**2).sum()
    for _ in range(100):
        case.sim.step()
    x = (weight * case.displacements()).sum()
    v = (weight * case.sim.node_v[0].double().cpu().numpy()).sum()
    assert np.hypot(x, v / omega[0]) == pytest.approx(0.6080388246890, rel=0.01)
    phase = np.unwrap([0.0, 100.0 * np.arctan(0.1)])[-1]
    assert np.exp(1j * phase) == pytest.approx((x - 1j * v / omega[0]) / np.hypot(x, v / omega[0]), abs=0.01)
