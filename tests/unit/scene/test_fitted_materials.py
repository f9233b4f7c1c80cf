"""Laws with parameters of their own at one material point: Yeoh, Mooney-Rivlin, Ogden; and published silicones.

Numbers of the tables were computed with 40 digits from the energies alone, psi = W + bulk/2 (J - 1)^2, by solving for
the stretch of the free sides. What all laws share is tested in test_materials.py.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.optimize

import softwarp as sw
from softwarp.kernels.elements.laws import LAWS
from softwarp.scene.materials import FittedMaterial
from softwarp.scene.silicones import SILICONES, silicone

# Parameters of the tables: a negative c20 within its bound, and a negative exponent.
PARAMETERS: dict[str, tuple[Any, dict[str, float]]] = {
    "yeoh": (sw.Yeoh, {"c10": 1e4, "c20": -200.0, "c30": 30.0}),
    "mooney_rivlin": (sw.MooneyRivlin, {"c10": 12e3, "c01": 4e3}),
    "ogden": (
        sw.Ogden,
        {"mu_1": 15e3, "alpha_1": 1.3, "mu_2": 3e3, "alpha_2": 5.0, "mu_3": 2e3, "alpha_3": -2.0},
    ),
}
TERMS = ((15e3, 1.3), (3e3, 5.0), (2e3, -2.0))
TABLE_F = np.array([[1.1, 0.3, -0.05], [0.02, 0.9, 0.15], [0.1, -0.2, 1.2]])

# (law, nu) -> energy density [J/m^3], P [Pa] row by row at TABLE_F
GENERAL = {
    ("yeoh", 0.45): (
        6502.40060234,
        [47911.23135, 4978.624158, -3307.613535, -8733.623544, 50014.86223]
        + [9092.568657, 4072.519232, -7781.794487, 46379.41494],
    ),
    ("yeoh", 0.49): (
        26394.0006023,
        [245935.2314, 3373.024158, -20077.21353, -71173.62354, 286394.8622]
        + [53692.56866, 20128.51923, -37396.19449, 221925.0149],
    ),
    ("mooney_rivlin", 0.45): (
        10533.5143899,
        [76746.02500, 8671.315749, -5170.520794, -13155.27037, 79173.51574]
        + [14354.61522, 6557.808093, -12494.15089, 74592.58475],
    ),
    ("mooney_rivlin", 0.49): (
        42360.0743899,
        [393584.4250, 6102.355749, -32001.88079, -113059.2704, 457381.5157]
        + [85714.61522, 32247.40809, -59877.19089, 355465.5448],
    ),
    ("ogden", 0.45): (
        6550.75374268,
        [47936.54512, 5247.270702, -3263.699900, -8420.209714, 49682.50566]
        + [9016.029291, 4086.749368, -7802.229658, 46539.89833],
    ),
    ("ogden", 0.49): (
        26442.3537427,
        [245960.5451, 3641.670702, -20033.29990, -70860.20971, 286062.5057]
        + [53616.02929, 20142.74937, -37416.62966, 222085.4983],
    ),
}

# (law, nu) -> stretch, nominal stress [Pa] with free sides, their stretch
UNIAXIAL = {
    ("yeoh", 0.45): (
        (0.5, -65586.46505, 1.371014819),
        (0.7, -25750.87996, 1.175882842),
        (0.9, -6476.844541, 1.048727606),
        (1.1, 5267.353132, 0.9581667898),
        (1.5, 19660.42473, 0.8360599002),
        (2.0, 31048.51053, 0.7407928798),
        (3.0, 52922.45025, 0.6386696145),
    ),
    ("yeoh", 0.49): (
        (0.5, -67132.76628, 1.406133917),
        (0.7, -26335.12279, 1.191502742),
        (0.9, -6642.237305, 1.053032613),
        (1.1, 5424.811429, 0.9544148390),
        (1.5, 20462.15409, 0.8206484379),
        (2.0, 32892.23954, 0.7147056756),
        (3.0, 61525.40462, 0.5940017937),
    ),
    ("mooney_rivlin", 0.45): (
        (0.5, -133192.4411, 1.358072929),
        (0.7, -45837.52720, 1.173601424),
        (0.9, -10644.17368, 1.048580079),
        (1.1, 8257.181033, 0.9580727056),
        (1.5, 29556.64561, 0.8349400821),
        (2.0, 45840.33853, 0.7384401470),
        (3.0, 68627.43685, 0.6289985979),
    ),
    ("mooney_rivlin", 0.49): (
        (0.5, -138734.1530, 1.403733227),
        (0.7, -47183.18527, 1.191052522),
        (0.9, -10932.64351, 1.053002108),
        (1.1, 8494.436751, 0.9543945634),
        (1.5, 30661.20489, 0.8203879739),
        (2.0, 48270.12919, 0.7140915140),
        (3.0, 74788.76518, 0.5902059167),
    ),
    ("ogden", 0.45): (
        (0.5, -77731.70317, 1.362184423),
        (0.7, -27627.60001, 1.174407802),
        (0.9, -6574.320136, 1.048645803),
        (1.1, 5228.317863, 0.9581323478),
        (1.5, 20228.38435, 0.8365929312),
        (2.0, 37136.43922, 0.7466134023),
        (3.0, 86133.84782, 0.6668279035),
    ),
    ("ogden", 0.49): (
        (0.5, -80539.13563, 1.404492083),
        (0.7, -28379.39183, 1.191211063),
        (0.9, -6748.228923, 1.053015655),
        (1.1, 5382.819865, 0.9544074862),
        (1.5, 21169.62290, 0.8207901318),
        (2.0, 40692.14977, 0.7164504435),
        (3.0, 111443.8223, 0.6060318202),
    ),
}

# (law, stretch) at nu = 0.45 -> equibiaxial stress [Pa], stretch of z; planar stress, stretch of z
EQUIBIAXIAL_PLANAR = {
    ("yeoh", 0.8): (-34631.41713, 1.395344418, -20124.57933, 1.193995275),
    ("yeoh", 1.2): (14336.29074, 0.7334498365, 11398.84585, 0.8594879487),
    ("yeoh", 1.5): (23962.12652, 0.4940035554, 21791.38529, 0.7118126621),
    ("yeoh", 2.0): (34320.46322, 0.2994084376, 32701.35446, 0.5597445325),
    ("mooney_rivlin", 0.8): (-52747.02781, 1.404405185, -32722.51049, 1.194925686),
    ("mooney_rivlin", 1.2): (25187.86721, 0.7370654436, 18185.62947, 0.8601377120),
    ("mooney_rivlin", 1.5): (49317.10302, 0.5066077335, 35016.76570, 0.7147475689),
    ("mooney_rivlin", 2.0): (84317.60913, 0.3208057025, 53091.73192, 0.5663936801),
    ("ogden", 0.8): (-35253.91561, 1.391921335, -20510.61080, 1.193746588),
    ("ogden", 1.2): (15245.31243, 0.7357910708, 11485.17951, 0.8600043812),
    ("ogden", 1.5): (28743.95540, 0.5028478483, 23009.60980, 0.7151928161),
    ("ogden", 2.0): (47842.43364, 0.3153857627, 39876.19510, 0.5725444621),
}

each_law = pytest.mark.parametrize("law", PARAMETERS)


def material(law: str, nu: float = 0.45) -> Any:
    cls, parameters = PARAMETERS[law]
    return cls.with_nu(nu, **parameters)


def free_stretch(solid: Any, gradient: Callable[[float], np.ndarray]) -> float:
    """Stretch of the free direction z at which P_zz = 0."""
    free = lambda stretch: float(solid.stress(gradient(stretch))[2, 2])  # noqa: E731
    return float(scipy.optimize.brentq(free, 0.1, 2.5, xtol=1e-14))


def diagonal(kind: str, stretch: float) -> Callable[[float], np.ndarray]:
    """Deformation gradient at a stretch, given the free one: x pulled; x and y pulled; x pulled with y held."""
    return {
        "uniaxial": lambda free: np.diag([stretch, free, free]),
        "equibiaxial": lambda free: np.diag([stretch, stretch, free]),
        "planar": lambda free: np.diag([stretch, 1.0, free]),
    }[kind]


def incompressible_stress(law: str, kind: str, s: float) -> float:
    """Nominal stress P_11 = 2 (s - z^2/s) W1 [Pa] and its like, where z is the free stretch.

    uniaxial I1 = s^2 + 2/s, equibiaxial 2 s^2 + s^-4, planar s^2 + 1 + s^-2. Yeoh: W1 = c10 + 2 c20 x + 3 c30 x^2 with
    x = I1 - 3. Mooney-Rivlin: W1 = c10 + c01 (1/s, s^2, 1). Ogden: sum 2 mu/alpha (s^(alpha-1) - s^(-n alpha - 1)),
    n = 1/2, 2, 1.
    """
    invariant = {"uniaxial": s**2 + 2.0 / s, "equibiaxial": 2.0 * s**2 + s**-4, "planar": s**2 + 1.0 + s**-2}[kind]
    other = {"uniaxial": s**-2, "equibiaxial": s**-5, "planar": s**-3}[kind]
    if law == "yeoh":
        x = invariant - 3.0
        return 2.0 * (s - other) * (1e4 - 2.0 * 200.0 * x + 3.0 * 30.0 * x**2)
    if law == "mooney_rivlin":
        return 2.0 * (s - other) * (12e3 + 4e3 * {"uniaxial": 1.0 / s, "equibiaxial": s**2, "planar": 1.0}[kind])
    n = {"uniaxial": 0.5, "equibiaxial": 2.0, "planar": 1.0}[kind]
    return sum(2.0 * mu / alpha * (s ** (alpha - 1.0) - s ** (-n * alpha - 1.0)) for mu, alpha in TERMS)


@pytest.mark.parametrize(("law", "nu"), GENERAL)
def test_general_stress(law: str, nu: float) -> None:
    """Energy and stress of one general F, J = 1.223."""
    energy, stress = GENERAL[law, nu]
    np.testing.assert_allclose(material(law, nu).energy(TABLE_F), energy, rtol=1e-9)
    np.testing.assert_allclose(material(law, nu).stress(TABLE_F).ravel(), stress, rtol=1e-8)


@pytest.mark.parametrize(("law", "nu"), UNIAXIAL)
def test_uniaxial_stress(law: str, nu: float) -> None:
    """Nominal stress with free sides and their stretch."""
    solid = material(law, nu)
    for stretch, stress, lateral in UNIAXIAL[law, nu]:
        gradient = diagonal("uniaxial", stretch)
        free = free_stretch(solid, gradient)
        assert free == pytest.approx(lateral, rel=1e-9)
        assert solid.stress(gradient(free))[0, 0] == pytest.approx(stress, rel=2e-9)


@pytest.mark.parametrize(("law", "stretch"), EQUIBIAXIAL_PLANAR)
def test_equibiaxial_and_planar_stress(law: str, stretch: float) -> None:
    """x and y pulled alike with z free, and x pulled with y held and z free."""
    solid, expected = material(law), EQUIBIAXIAL_PLANAR[law, stretch]
    for kind, stress, thickness in (("equibiaxial", *expected[:2]), ("planar", *expected[2:])):
        gradient = diagonal(kind, stretch)
        free = free_stretch(solid, gradient)
        assert free == pytest.approx(thickness, rel=1e-9)
        assert solid.stress(gradient(free))[0, 0] == pytest.approx(stress, rel=2e-9)


@each_law
@pytest.mark.parametrize("kind", ["uniaxial", "equibiaxial", "planar"])
@pytest.mark.parametrize("stretch", [0.7, 1.3, 2.0])
def test_incompressible_limit(law: str, kind: str, stretch: float) -> None:
    """As nu -> 1/2 the stress tends to the closed form of ``incompressible_stress``, with an error of order mu/bulk."""
    solid, gradient = material(law, 0.4999999), diagonal(kind, stretch)
    stress = solid.stress(gradient(free_stretch(solid, gradient)))[0, 0]
    assert stress == pytest.approx(incompressible_stress(law, kind, stretch), rel=1e-5)


@each_law
@pytest.mark.parametrize("gamma", [0.1, 0.5, 1.0, 2.0])
def test_simple_shear(law: str, gamma: float) -> None:
    """J = 1, so that the shear stress is that of the incompressible law, whatever the bulk modulus.

    Yeoh: 2 gamma (c10 + 2 c20 gamma^2 + 3 c30 gamma^4). Mooney-Rivlin: 2 gamma (c10 + c01). Ogden, with the stretch
    l = gamma/2 + sqrt(1 + gamma^2/4): sum 2 mu/alpha (l^alpha - l^-alpha)/(l + 1/l).
    """
    F = np.eye(3)
    F[0, 1] = gamma
    stretch = 0.5 * gamma + np.sqrt(1.0 + 0.25 * gamma**2)
    total = sum(2.0 * mu / alpha * (stretch**alpha - stretch**-alpha) for mu, alpha in TERMS)
    expected = {
        "yeoh": 2.0 * gamma * (1e4 - 2.0 * 200.0 * gamma**2 + 3.0 * 30.0 * gamma**4),
        "mooney_rivlin": 2.0 * gamma * 16e3,
        "ogden": total / (stretch + 1.0 / stretch),
    }[law]
    for nu in (0.3, 0.49):
        assert material(law, nu).stress(F)[0, 1] == pytest.approx(expected, rel=1e-9)


@each_law
def test_flat_and_mirrored_elements_are_refused(law: str) -> None:
    """Energy is infinite and stress and tangent are not finite for J <= 0, by which the step control knows them."""
    for last in (0.0, -0.5):
        F = np.diag([1.0, 1.0, last])
        assert np.isposinf(material(law).energy(F))
        assert not np.isfinite(material(law).stress(F)).all()
        assert not np.isfinite(material(law).tangent(F)).all()


@each_law
def test_equal_stretches(law: str) -> None:
    """The tangent has no gap where two or three stretches meet: changed by 1e-7, it changes by about as much."""
    for s in ([1.0, 1.0, 1.0], [1.3, 1.3, 1.3], [1.4, 1.4, 0.7], [0.8, 1.2, 1.2]):
        met = material(law).tangent(np.diag(s))
        for distance in (1e-7, 1e-9, 1e-12):
            near = material(law).tangent(np.diag(np.array(s) * (1.0 + distance * np.array([0.0, 1.0, -0.5]))))
            assert np.abs(near - met).max() < (20.0 * distance + 1e-13) * np.abs(met).max()


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (sw.Yeoh(c10=1e4, bulk=2e5), sw.MooneyRivlin(c10=1e4, c01=0.0, bulk=2e5)),
        (sw.Yeoh(c10=1e4, bulk=2e5), sw.Ogden(mu_1=2e4, alpha_1=2.0, bulk=2e5)),
        (
            sw.MooneyRivlin(c10=1e4, c01=3e3, bulk=2e5),
            sw.Ogden(mu_1=2e4, alpha_1=2.0, mu_2=6e3, alpha_2=-2.0, bulk=2e5),
        ),
        (
            sw.Ogden(mu_1=2e4, alpha_1=3.0, mu_2=1e3, alpha_2=-1.0, bulk=2e5),
            sw.Ogden(mu_1=0.0, alpha_1=7.0, mu_2=1e3, alpha_2=-1.0, mu_3=2e4, alpha_3=3.0, bulk=2e5),
        ),
        (sw.Ogden(mu_1=2e4, alpha_1=0.0, bulk=2e5), sw.Ogden(mu_1=2e4, alpha_1=1e-9, bulk=2e5)),
    ],
)
def test_laws_that_are_the_same(a: Any, b: Any) -> None:
    """Yeoh(c, 0, 0) = MooneyRivlin(c, 0) = Ogden(2 c, 2), MooneyRivlin(c, d) = Ogden(2 c, 2; 2 d, -2)."""
    np.testing.assert_allclose(a.energy(TABLE_F), b.energy(TABLE_F), rtol=1e-8)
    np.testing.assert_allclose(a.stress(TABLE_F), b.stress(TABLE_F), rtol=1e-8)
    np.testing.assert_allclose(a.tangent(TABLE_F), b.tangent(TABLE_F), atol=1e-8 * a.bulk)


def test_logarithmic_ogden() -> None:
    """alpha = 0 is W = mu sum (ln sbar_i)^2: at diag(s, 1, 1/s), tau_i = 2 mu ln s_i."""
    s = np.array([1.5, 1.0, 1.0 / 1.5])
    solid = sw.Ogden(mu_1=2e4, alpha_1=0.0, bulk=2e5)
    assert solid.energy(np.diag(s)) == pytest.approx(2e4 * (np.log(s) ** 2).sum(), rel=1e-12)
    np.testing.assert_allclose(np.diag(solid.stress(np.diag(s))), 2.0 * 2e4 * np.log(s) / s, atol=1e-9)


@each_law
def test_moduli_at_small_strain(law: str) -> None:
    """bulk = 2 mu (1 + nu)/(3 (1 - 2 nu)) and E = 2 mu (1 + nu)."""
    solid = material(law, 0.45)
    shear = {"yeoh": 2e4, "mooney_rivlin": 3.2e4, "ogden": 2e4}[law]
    assert solid.shear == pytest.approx(shear)
    assert solid.bulk == pytest.approx(2.0 * shear * 1.45 / 0.3)
    assert (solid.youngs, solid.nu) == pytest.approx((2.9 * shear, 0.45))


def test_declarations_match_kernels() -> None:
    """Materials declare as many parameters as their kernels read, in the order of the vector p."""
    for cls, parameters in PARAMETERS.values():
        names = [parameter.name for parameter in cls.parameters()]
        assert names == ["bulk", *parameters]
        assert LAWS[cls.law].own == LAWS[cls.law].count == len(names)
        solid = cls(bulk=1e5, **parameters)
        assert solid.kernel_parameters == (1e5, *parameters.values())
    assert [p.name for p in sw.NeoHookean.parameters()] == ["youngs", "nu"]
    assert sw.Yeoh.parameters()[2].default == 0.0
    assert sw.Yeoh.parameters()[1].default is None
    assert sw.Yeoh.parameters()[1].unit == "Pa"


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: sw.Yeoh(c10=0.0, bulk=1e5), r"Yeoh: c10 must be positive and finite \[Pa\], got 0.0"),
        (lambda: sw.Yeoh(c10=1e4, c20=np.inf, bulk=1e5), r"Yeoh: c20 must be finite \[Pa\], got inf"),
        (lambda: sw.Yeoh(c10=1e4, bulk=-1e5), "Yeoh: bulk must be positive"),
        (lambda: sw.Yeoh(c10=1e4, bulk=1e30), "Yeoh: Poisson's ratio must lie in"),
        (
            lambda: sw.Yeoh.with_nu(0.5, c10=1e4),
            r"Yeoh: Poisson's ratio must lie in \(-1, 0.5\), got 0.5; for silicone",
        ),
        (lambda: sw.MooneyRivlin(c10=1e4, c01=-2e4, bulk=1e5), "MooneyRivlin: the shear modulus at small strain"),
        (lambda: sw.Ogden(mu_1=0.0, alpha_1=2.0, bulk=1e5), "Ogden: the shear modulus at small strain"),
        (lambda: sw.Ogden(mu_1=1e4, alpha_1=np.nan, bulk=1e5), "Ogden: alpha_1 must be finite, got nan"),
    ],
)
def test_bad_parameters_are_refused(make: Callable[[], Any], told: str) -> None:
    """The message names class, parameter, range and value."""
    with pytest.raises(ValueError, match=told):
        make()


def test_a_law_must_tell_its_shear_modulus() -> None:
    """``FittedMaterial`` is abstract: a law without it cannot be made, nor can the base itself."""
    with pytest.raises(TypeError, match="shear"):
        FittedMaterial(bulk=1e5)


@pytest.mark.parametrize("name", SILICONES)
def test_silicones(name: str) -> None:
    """Entries have a source, a plausible density, and stress that rises over stretches of robots in three tests."""
    entry = silicone(name)
    assert entry.source
    assert entry.range
    solid = sw.Material.silicone(name)
    assert solid.density == entry.density
    assert 1000.0 < entry.density < 1200.0
    assert solid.nu == pytest.approx(0.49)
    for kind in ("uniaxial", "equibiaxial", "planar"):
        stress = []
        for stretch in np.linspace(0.6, 2.0, 15):
            gradient = diagonal(kind, stretch)
            stress.append(solid.stress(gradient(free_stretch(solid, gradient)))[0, 0])
        assert (np.diff(stress) > 0.0).all()


def test_silicones_at_small_strain() -> None:
    """Moduli that the sources tell for small strain [Pa]: E = 6 c10 (incompressible), or the measured one."""
    expected = {"Ecoflex 00-30": 83e3, "Ecoflex 00-10": 46e3, "Ecoflex 00-50": 140e3, "Dragon Skin 10": 263.8e3}
    for name, youngs in expected.items():
        assert sw.Material.silicone(name).youngs == pytest.approx(youngs, rel=0.01)


def test_silicones_are_found_by_name() -> None:
    """Case does not matter; an unknown name lists the nearest ones."""
    assert sw.Material.silicone("dragon skin 30", nu=0.45) == sw.Material.silicone("Dragon Skin 30", nu=0.45)
    with pytest.raises(ValueError, match="no silicone is called 'Dragonskin 30'; did you mean 'Dragon Skin 30'"):
        sw.Material.silicone("Dragonskin 30")
    with pytest.raises(ValueError, match="valid names are 'Dragon Skin 10', "):
        sw.Material.silicone("x")
