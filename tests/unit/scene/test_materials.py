"""Laws of solids at one material point: energy, first Piola-Kirchhoff stress, tangent.

All numbers come from the formulas in the docstrings, or from the stress tables of the validation catalogue
(docs/validation.md, sections 1.2 and 1.3), which were computed there from symbolic derivatives of the energies. The
laws are evaluated in float64 through the functions that the kernels call.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.optimize

import softwarp as sw
from tests import cases

YOUNGS, NU = 1.0e5, 0.4
TABLE_F = np.array([[1.1, 0.3, -0.05], [0.02, 0.9, 0.15], [0.1, -0.2, 1.2]])

# validation catalogue 1.2: energy density [J/m^3], P [Pa] row by row at TABLE_F, E = 1e5 Pa, nu = 0.4
STRESS_TABLE = {
    "nh_log": (
        6872.930157,
        [32972.2709, 10765.4758, -1251.0623, 2705.0111, 24606.5396, 3935.1961, 3059.5278, -6198.6845, 37260.3606],
    ),
    "snh": (
        7643.660714,
        [43844.6429, 10677.3214, -2171.7857, -723.2143, 37584.8214, 6383.9286, 3941.0714, -7824.6429, 46898.5714],
    ),
    "stvk": (
        11641.673929,
        [61190.0, 25858.5714, -1678.2143, 11958.0, 37867.1429, 5383.2143, 5825.7143, -12477.1429, 74634.2857],
    ),
    "corot": (
        8760.253739,
        [44026.3462, 16400.6193, -1404.6837, 6013.4518, 30153.2328, 4607.7007, 4150.5408, -8538.4361, 51343.4748],
    ),
}

# validation catalogue 1.3: (law, nu) -> nominal stress [Pa] at the stretches, E = 1e5 Pa
STRETCHES = (0.7, 0.9, 1.1, 1.5, 2.0)
UNIAXIAL = {
    ("nh_log", 0.3): (-40523.04, -10872.22, 9307.74, 37828.02, 64674.47),
    ("snh", 0.3): (-38113.93, -10757.62, 9365.43, 38319.09, 65384.62),
    ("stvk", 0.3): (-17850.00, -8550.00, 11550.00, 93750.00, 300000.00),
    ("corot", 0.3): (-30000.0, -10000.0, 10000.0, 50000.0, 100000.0),
    ("nh_log", 0.45): (-43393.88, -11071.29, 9170.34, 35861.44, 59879.63),
}
LATERAL = {
    ("nh_log", 0.3): (1.107935, 1.031702, 0.971493, 0.880175, 0.798078),
    ("nh_log", 0.45): (1.170853, 1.048313, 0.957844, 0.830679, 0.725935),
}
EQUIBIAXIAL = {  # nu = 0.3
    "nh_log": {0.8: -37073.79, 1.2: 23398.95, 1.5: 46791.59},
    "snh": {0.8: -28116.72, 1.2: 24864.25, 1.5: 49165.75},
    "corot": {0.8: -28571.43, 1.2: 28571.43, 1.5: 71428.57},
    "stvk": {0.8: -20571.43, 1.2: 37714.29},
}

each_law = pytest.mark.parametrize("law", [*cases.LAWS, *cases.FITTED])


def material(law: str, nu: float = NU) -> Any:
    return cases.material(law, YOUNGS, nu)


def deformations(rng: np.random.Generator, count: int = 20) -> np.ndarray:
    """Random deformation gradients (count, 3, 3) with 0.2 < J < 5."""
    F = np.eye(3) + 0.35 * rng.standard_normal((20 * count, 3, 3))
    J = np.linalg.det(F)
    return F[(J > 0.2) & (J < 5.0)][:count]


def central_difference(function: Callable[[np.ndarray], np.ndarray], F: np.ndarray, step: float) -> np.ndarray:
    """Derivative by F_kl, the last axis running over kl row by row."""
    columns = []
    for k in range(9):
        dF = np.zeros(9)
        dF[k] = step
        dF = dF.reshape(3, 3)
        columns.append((function(F + dF) - function(F - dF)) / (2.0 * step))
    return np.stack(columns, axis=-1)


def lateral_stretch(law: str, nu: float, gradient: Callable[[float], np.ndarray]) -> float:
    """Stretch of the free direction z at which P_zz = 0, by bisection."""
    free = lambda stretch: float(material(law, nu).stress(gradient(stretch))[2, 2])  # noqa: E731
    return float(scipy.optimize.brentq(free, 0.2, 2.0, xtol=1e-14))


@each_law
def test_stress_is_energy_gradient(law: str, rng: np.random.Generator) -> None:
    """P_ij = d psi / d F_ij; central differences with step 1e-5, error (step)^2 and rounding below 1e-8."""
    F = deformations(rng)
    expected = central_difference(material(law).energy, F, 1e-5).reshape(-1, 3, 3)
    stress = material(law).stress(F)
    error = np.linalg.norm(stress - expected, axis=(1, 2)) / np.linalg.norm(stress, axis=(1, 2))
    assert error.max() < 1e-7


@each_law
def test_tangent_is_stress_gradient(law: str, rng: np.random.Generator) -> None:
    """dP_ij / dF_kl; central differences with step 1e-5."""
    F = deformations(rng)
    expected = central_difference(lambda G: material(law).stress(G).reshape(-1, 9), F, 1e-5)
    tangent = material(law).tangent(F, project=False)
    error = np.linalg.norm(tangent - expected, axis=(1, 2)) / np.linalg.norm(tangent, axis=(1, 2))
    assert error.max() < 1e-6


@each_law
def test_tangent_is_symmetric(law: str, rng: np.random.Generator) -> None:
    """A tangent that comes from an energy has the major symmetry dP_ij/dF_kl = dP_kl/dF_ij."""
    tangent = material(law).tangent(deformations(rng), project=False)
    skew = np.abs(tangent - tangent.transpose(0, 2, 1)).max()
    assert skew < 1e-12 * np.abs(tangent).max()


@each_law
def test_projected_tangent_is_positive_semidefinite(law: str, rng: np.random.Generator) -> None:
    """After projection no eigenvalue is negative, even in strong compression, where the laws in moduli have some."""
    F = np.concatenate([deformations(rng), 0.5 * np.eye(3)[None], np.diag([0.4, 1.0, 1.0])[None]])
    tangent = material(law).tangent(F, project=True)
    eigenvalues = np.linalg.eigvalsh(0.5 * (tangent + tangent.transpose(0, 2, 1)))
    assert eigenvalues.min() > -1e-9 * eigenvalues.max()


@each_law
def test_projection_keeps_a_stable_tangent(law: str) -> None:
    """At F = 1 the tangent 2 mu sym + lam 1x1 is semidefinite, so projecting it changes nothing."""
    mu, lam = cases.lame(YOUNGS, NU)
    identity = np.eye(3)
    symmetric = 0.5 * (np.einsum("ik,jl->ijkl", identity, identity) + np.einsum("il,jk->ijkl", identity, identity))
    expected = (2.0 * mu * symmetric + lam * np.einsum("ij,kl->ijkl", identity, identity)).reshape(9, 9)
    for project in (False, True):
        np.testing.assert_allclose(material(law).tangent(identity, project=project), expected, atol=1e-8 * YOUNGS)


@pytest.mark.parametrize("law", STRESS_TABLE)
def test_stress_table(law: str) -> None:
    """Energy and stress of one general F against the catalogue's table 1.2, printed to about 1e-9."""
    energy, stress = STRESS_TABLE[law]
    np.testing.assert_allclose(material(law).energy(TABLE_F), energy, rtol=1e-6)
    np.testing.assert_allclose(material(law).stress(TABLE_F).ravel(), stress, rtol=1e-6)


@pytest.mark.parametrize(("law", "nu"), UNIAXIAL)
def test_uniaxial_stress(law: str, nu: float) -> None:
    """Nominal stress with free sides against table 1.3, printed to 0.01 Pa and 1e-6."""
    for i, stretch in enumerate(STRETCHES):
        gradient = lambda lateral, stretch=stretch: np.diag([stretch, lateral, lateral])  # noqa: E731
        lateral = lateral_stretch(law, nu, gradient)
        assert material(law, nu).stress(gradient(lateral))[0, 0] == pytest.approx(UNIAXIAL[law, nu][i], abs=0.006)
        if (law, nu) in LATERAL:
            assert lateral == pytest.approx(LATERAL[law, nu][i], abs=6e-7)


@pytest.mark.parametrize("stretch", STRETCHES)
def test_uniaxial_closed_forms(stretch: float) -> None:
    """stvk: P = E s (s^2 - 1)/2, side^2 = 1 - nu (s^2 - 1); corot: P = E (s - 1), side = 1 - nu (s - 1)."""
    sides = {"stvk": np.sqrt(1.0 - 0.3 * (stretch**2 - 1.0)), "corot": 1.0 - 0.3 * (stretch - 1.0)}
    stresses = {"stvk": 0.5 * YOUNGS * stretch * (stretch**2 - 1.0), "corot": YOUNGS * (stretch - 1.0)}
    for law, side in sides.items():
        expected = np.diag([stresses[law], 0.0, 0.0])
        stress = material(law, 0.3).stress(np.diag([stretch, side, side]))
        np.testing.assert_allclose(stress, expected, atol=1e-9 * YOUNGS)


@pytest.mark.parametrize(("law", "stretch"), [(law, s) for law, row in EQUIBIAXIAL.items() for s in row])
def test_equibiaxial_stress(law: str, stretch: float) -> None:
    """Equal stretch in x and y, z free: table 1.3, nu = 0.3."""
    gradient = lambda lateral: np.diag([stretch, stretch, lateral])  # noqa: E731
    stress = material(law, 0.3).stress(gradient(lateral_stretch(law, 0.3, gradient)))
    assert stress[0, 0] == pytest.approx(EQUIBIAXIAL[law][stretch], abs=0.006)
    assert stress[1, 1] == pytest.approx(stress[0, 0], rel=1e-12)


@pytest.mark.parametrize("law", ["nh_log", "snh"])
@pytest.mark.parametrize("stretch", [0.7, 1.3, 2.0])
def test_incompressible_limit(law: str, stretch: float) -> None:
    """As nu -> 1/2 both neo-Hookean laws tend to P = mu (s - s^-2), with an error of order mu / lam = 2e-5."""
    nu = 0.49999
    mu, _ = cases.lame(YOUNGS, nu)
    gradient = lambda lateral: np.diag([stretch, lateral, lateral])  # noqa: E731
    stress = material(law, nu).stress(gradient(lateral_stretch(law, nu, gradient)))
    assert stress[0, 0] == pytest.approx(mu * (stretch - stretch**-2), rel=1e-3)


def test_stvk_softens_in_compression() -> None:
    """The law's least uniaxial stress is -E/(3 sqrt 3), at the stretch 1/sqrt 3; beyond it the solid collapses."""
    stretches = np.linspace(0.4, 0.8, 41)
    F = np.zeros((41, 3, 3))
    F[:, 0, 0] = stretches
    F[:, 1, 1] = F[:, 2, 2] = np.sqrt(1.0 - NU * (stretches**2 - 1.0))
    stress = material("stvk").stress(F)[:, 0, 0]
    assert stress.min() >= -YOUNGS / (3.0 * np.sqrt(3.0)) * (1.0 + 1e-12)
    assert stretches[stress.argmin()] == pytest.approx(1.0 / np.sqrt(3.0), abs=0.006)


@each_law
def test_angular_momentum(law: str, rng: np.random.Generator) -> None:
    """P F^T (Kirchhoff stress) is symmetric."""
    F = deformations(rng)
    kirchhoff = material(law).stress(F) @ F.transpose(0, 2, 1)
    assert np.abs(kirchhoff - kirchhoff.transpose(0, 2, 1)).max() < 1e-12 * np.abs(kirchhoff).max()


@each_law
def test_frame_indifference(law: str, rng: np.random.Generator) -> None:
    """psi(Q F) = psi(F) and P(Q F) = Q P(F) for every rotation Q, a turn by 180 degrees included."""
    F = deformations(rng)
    for Q in (cases.random_rotation(rng), np.diag([-1.0, -1.0, 1.0])):
        np.testing.assert_allclose(material(law).energy(Q @ F), material(law).energy(F), rtol=1e-11)
        expected = Q @ material(law).stress(F)
        np.testing.assert_allclose(material(law).stress(Q @ F), expected, atol=1e-11 * np.abs(expected).max())


@each_law
def test_isotropy(law: str, rng: np.random.Generator) -> None:
    """psi(F Q) = psi(F) and P(F Q) = P(F) Q."""
    F, Q = deformations(rng), cases.random_rotation(rng)
    np.testing.assert_allclose(material(law).energy(F @ Q), material(law).energy(F), rtol=1e-11)
    expected = material(law).stress(F) @ Q
    np.testing.assert_allclose(material(law).stress(F @ Q), expected, atol=1e-11 * np.abs(expected).max())


@each_law
def test_undeformed_is_stress_free(law: str, rng: np.random.Generator) -> None:
    """psi(Q) = 0 and P(Q) = 0 for F = Q, the identity and a rotation."""
    for Q in (np.eye(3), cases.random_rotation(rng)):
        assert abs(float(material(law).energy(Q))) < 1e-12 * YOUNGS
        assert np.abs(material(law).stress(Q)).max() < 1e-11 * YOUNGS


@each_law
def test_small_strain_limit(law: str, rng: np.random.Generator) -> None:
    """P(1 + eps H) = sigma_lin + O(eps^2): ten times less strain, a hundred times less difference."""
    mu, lam = cases.lame(YOUNGS, NU)
    H = rng.standard_normal((3, 3))
    strain = 0.5 * (H + H.T)
    linear = 2.0 * mu * strain + lam * np.trace(strain) * np.eye(3)
    eps = np.array([1e-2, 1e-3, 1e-4])
    error = [np.linalg.norm(material(law).stress(np.eye(3) + e * H) - e * linear) for e in eps]
    order = np.diff(np.log10(error)) / np.diff(np.log10(eps))
    np.testing.assert_allclose(order, 2.0, atol=0.05)
    assert error[-1] < 1e-2 * eps[-1] * np.linalg.norm(linear)


def test_corotational_reflection(rng: np.random.Generator) -> None:
    """Where det F < 0, R stays the nearest rotation (det R = +1), so the element pushes back to the unmirrored side.

    P = 2 mu (F - R) + lam (tr(R^T F) - 3) R with R = U diag(1, 1, det(U V^T)) V^T from the singular value
    decomposition, the smallest singular value last.
    """
    mu, lam = cases.lame(YOUNGS, NU)
    F = rng.standard_normal((40, 3, 3))
    s = np.linalg.svd(F)[1]
    F = F[(np.linalg.det(F) < 0.0) & (s[:, 1] - s[:, 2] > 0.1)]  # unique nearest rotation
    U, _, Vt = np.linalg.svd(F)
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    R = U @ Vt
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    trace = np.einsum("nij,nij->n", R, F)
    expected = 2.0 * mu * (F - R) + (lam * (trace - 3.0))[:, None, None] * R
    np.testing.assert_allclose(material("corot").stress(F), expected, atol=1e-9 * np.abs(expected).max())
    inverted = np.diag([1.0, 1.0, -0.5])
    assert material("corot").energy(inverted) == pytest.approx((mu + 0.5 * lam) * 1.5**2, rel=1e-12)


@each_law
def test_stacked_and_single_agree(law: str, rng: np.random.Generator) -> None:
    """One F of shape (3, 3) gives the same numbers as the same F in a stack."""
    F = deformations(rng, 3)
    assert material(law).energy(F).shape == (3,)
    assert material(law).stress(F).shape == (3, 3, 3)
    assert material(law).tangent(F, project=False).shape == (3, 9, 9)
    assert np.ndim(material(law).energy(F[1])) == 0
    np.testing.assert_array_equal(material(law).stress(F[1]), material(law).stress(F)[1])
    np.testing.assert_array_equal(
        material(law).tangent(F[1], project=False), material(law).tangent(F, project=False)[1]
    )


@pytest.mark.parametrize("law", cases.LAWS)
@pytest.mark.parametrize(
    ("youngs", "nu", "named"),
    [
        (-1.0, 0.3, "modulus"),
        (0.0, 0.3, "modulus"),
        (np.nan, 0.3, "modulus"),
        (1e5, 0.5, "Poisson"),
        (1e5, -1.0, "Poisson"),
    ],
)
def test_bad_moduli_are_refused(law: str, youngs: float, nu: float, named: str) -> None:
    """The message names the quantity; E > 0 and -1 < nu < 1/2."""
    with pytest.raises(ValueError, match=named):
        cases.LAWS[law](youngs, nu)


def test_unknown_method_lists_the_nearest() -> None:
    with pytest.raises(ValueError, match="polar"):
        sw.Corotational(YOUNGS, NU, method="pollar")


@pytest.mark.parametrize("material", [sw.Material(YOUNGS, NU), (YOUNGS, NU)], ids=["without a law", "numbers"])
def test_bodies_are_made_of_laws(material: Any) -> None:
    """A material without a law is named with those that have one."""
    with pytest.raises(TypeError, match=r"a material with a law, such as Corotational, .*, got "):
        sw.ModelBuilder().add_tets(sw.meshing.trunk("coarse"), material=material, density=1000.0)
