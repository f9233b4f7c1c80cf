"""Solid materials: their parameters and the law these enter. Energies are defined in docs/theory/hyperelastic.md."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, ClassVar, Self, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks
from softwarp.model.codes import FAR
from softwarp.scene.silicones import silicone

FloatArray = NDArray[np.float64]


def lame(youngs: float, nu: float) -> tuple[float, float]:
    """Lame constants (mu, lam) [Pa] of an isotropic solid."""
    return youngs / (2.0 * (1.0 + nu)), youngs * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


@dataclass(frozen=True)
class Parameter:
    """A number of a law, declared as the annotation of a material's field.

    Attributes:
        unit: Unit; empty for ratios and exponents.
        low: Values lie above it.
        high: Values lie below it.
        label: What messages call it; empty for the name of the field.
        advice: What messages add for a value out of range.
        name: The field, filled in by ``Material.parameters``.
        default: Its default, filled in likewise; None where a value must be given.
    """

    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    label: str = ""
    advice: str = ""
    name: str = ""
    default: float | None = None

    def check(self, owner: str, value: float) -> None:
        """Refuse a value that is not finite or out of range; ``owner`` is the class that messages name."""
        try:
            checks.number(value, owner, above=self.low, below=self.high)
        except ValueError:
            pass
        else:
            return
        unit = f" [{self.unit}]" if self.unit else ""
        if math.isfinite(self.low) and math.isfinite(self.high):
            need = f"lie in ({self.low:g}, {self.high:g})"
        elif self.low == 0.0:
            need = "be positive and finite"
        else:
            need = "be finite" if self.low == -math.inf else f"be finite and above {self.low:g}"
        advice = f"; {self.advice}" if self.advice else ""
        raise ValueError(f"{checks.refusal(f'{owner}: {self.label or self.name}', need + unit, value)}{advice}")


Pascal = Annotated[float, Parameter("Pa")]
PositivePascal = Annotated[float, Parameter("Pa", low=0.0)]


@dataclass(frozen=True)
class Material:
    """Isotropic elastic solid.

    Attributes:
        youngs: Young's modulus [Pa], positive.
        nu: Poisson's ratio, in (-1, 0.5).
        density: Density [kg/m^3] that bodies get which are given none; None for materials without one.

    Raises:
        ValueError: If a parameter is out of its range or not finite.
    """

    youngs: Annotated[float, Parameter("Pa", low=0.0, label="Young's modulus")]
    nu: Annotated[
        float,
        Parameter(low=-1.0, high=0.5, label="Poisson's ratio", advice="for silicone use 0.45 to 0.49"),
    ]
    density: float | None = field(default=None, repr=False, kw_only=True)
    law: ClassVar[str] = ""

    def __post_init__(self) -> None:
        for parameter in self.parameters():
            parameter.check(type(self).__name__, getattr(self, parameter.name))
        if self.density is not None:
            checks.number(self.density, f"{type(self).__name__}: density [kg/m^3]", above=0.0)

    @classmethod
    def parameters(cls) -> tuple[Parameter, ...]:
        """Numbers that make the law, as declared: name, unit, range and default of each."""
        hints = get_type_hints(cls, include_extras=True)
        declared = []
        for entry in fields(cls):
            default = entry.default if isinstance(entry.default, float) else None
            notes = getattr(hints[entry.name], "__metadata__", ())
            declared += [replace(n, name=entry.name, default=default) for n in notes if isinstance(n, Parameter)]
        return tuple(declared)

    @staticmethod
    def silicone(name: str, nu: float = 0.49) -> Material:
        """A silicone with published parameters and its density; sources and ranges are in ``scene.silicones``.

        Args:
            name: Product, such as ``"Dragon Skin 30"``.
            nu: Poisson's ratio, which none of the sources measured; all take silicone as incompressible. With linear
                tetrahedra take 0.45, as they lock near 0.5.

        Raises:
            ValueError: If there is no such silicone; the message lists the nearest names.
        """
        entry = silicone(name)
        laws: dict[str, type[Material]] = {"NeoHookean": NeoHookean, "Ogden": Ogden, "Yeoh": Yeoh}
        return laws[entry.law].with_nu(nu, density=entry.density, **entry.parameters)

    @classmethod
    def with_nu(cls, nu: float, *, density: float | None = None, **parameters: float) -> Self:
        """The law with Poisson's ratio ``nu`` and its other parameters."""
        return cls(nu=nu, density=density, **parameters)

    @property
    def law_parameters(self) -> dict[str, float]:
        """Parameters of the law's own, in the order of its kernels; none for a law in Lame constants."""
        return {}

    @property
    def kernel_parameters(self) -> tuple[float, ...]:
        """The vector ``p`` of the law's kernels: its own parameters, or Lame constants [Pa]."""
        return tuple(self.law_parameters.values()) or lame(self.youngs, self.nu)

    @property
    def kernel_law(self) -> str:
        """Name of the element kernel: a law of ``kernels.elements.materials`` or ``large``."""
        return self.law

    @property
    def guard(self) -> float:
        """Volume ratio below which elements are held upright; ``-FAR`` for laws that need or have no guard."""
        return -FAR

    def energy(self, F: ArrayLike) -> FloatArray:
        """Energy density [J/m^3] at deformation gradients ``F``, shape (3, 3) or (n, 3, 3), in float64."""
        return self._evaluate(F, False)[0]

    def stress(self, F: ArrayLike) -> FloatArray:
        """First Piola-Kirchhoff stress [Pa], of the shape of ``F``."""
        return self._evaluate(F, False)[1]

    def tangent(self, F: ArrayLike, project: bool = False) -> FloatArray:
        """dP/dF [Pa], shape (..., 9, 9) in row-major index pairs; ``project`` clamps it to semidefinite."""
        return self._evaluate(F, project)[2]

    def _evaluate(self, F: ArrayLike, project: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
        import warp as wp

        from softwarp.kernels.elements import spectral

        array = checks.array(F, "deformation gradients")
        if array.shape[-2:] != (3, 3):
            raise ValueError(f"deformation gradients must have shape (3, 3) or (n, 3, 3), got {array.shape}")
        flat = array.reshape(-1, 3, 3)
        p = self.kernel_parameters
        device: Any = "cpu"
        given = wp.array(flat, dtype=wp.mat33d, device=device)
        energy = wp.empty(len(flat), dtype=wp.float64, device=device)
        stress = wp.empty(len(flat), dtype=wp.mat33d, device=device)
        tangent = wp.empty((len(flat), 9, 9), dtype=wp.float64, device=device)
        wp.launch(
            spectral.evaluation_kernels(self.law).evaluate,
            dim=len(flat),
            inputs=[given, wp.types.vector(len(p), wp.float64)(*p), project],
            outputs=[energy, stress, tangent],
            device=device,
        )
        lead = array.shape[:-2]
        return (
            energy.numpy().reshape(lead),
            stress.numpy().reshape(*lead, 3, 3),
            tangent.numpy().reshape(*lead, 9, 9),
        )


@dataclass(frozen=True)
class Corotational(Material):
    """Linear elasticity in a rotated frame.

    Attributes:
        inversion_guard: Volume ratio below which a growing pressure holds an element of ``large`` or ``warped``
            upright, which linear strain lets be pressed flat and through itself; in [0, 1), 0 for none, as SOFA.
            Above it nothing changes.
        method: ``warped`` takes the rotation nearest to the deformation gradient, and in steps a tangent with that
            rotation held. ``polar`` has the same forces and statics, the exact tangent, and no guard; it takes a fifth
            longer. ``large`` takes the rotation from the element's edges as SOFA's TetrahedronFEMForceField does; it is
            a little cheaper still and depends slightly on the order of an element's corners.
    """

    method: str = "warped"
    inversion_guard: float = field(default=0.4, kw_only=True)
    law: ClassVar[str] = "corotational"

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.choice(self.method, "Corotational: method", ("polar", "large", "warped"))
        checks.number(self.inversion_guard, "Corotational: inversion_guard", low=0.0, below=1.0)

    @property
    def guard(self) -> float:
        """That of ``large`` and ``warped``."""
        is_guarded = self.method != "polar" and self.inversion_guard > 0.0
        return self.inversion_guard if is_guarded else super().guard

    @property
    def kernel_law(self) -> str:
        """``large`` or ``warped``, or the law of the polar rotation with its exact tangent."""
        return self.law if self.method == "polar" else self.method


@dataclass(frozen=True)
class StVenantKirchhoff(Material):
    """psi = mu E:E + lam/2 (tr E)^2; softens and collapses under strong compression."""

    law: ClassVar[str] = "st_venant_kirchhoff"


@dataclass(frozen=True)
class NeoHookean(Material):
    """psi = mu/2 (I1 - 3) - mu ln J + lam/2 (ln J)^2; infinite energy for an inverted element."""

    law: ClassVar[str] = "neo_hookean"


@dataclass(frozen=True)
class StableNeoHookean(Material):
    """psi = mu/2 (I1 - 3) + (lam + mu)/2 (J - a)^2, finite for inverted elements (Smith et al. 2018)."""

    law: ClassVar[str] = "stable_neo_hookean"


@dataclass(frozen=True, kw_only=True)
class FittedMaterial(Material, ABC):
    """Solid with parameters of its own in place of moduli, such as those fitted to tests of a silicone.

    psi = W(isochoric part of F) + bulk/2 (J - 1)^2. Laws declare the parameters of W as annotated fields; the vector
    ``p`` of their kernels is ``bulk`` and then these, in order. Published parameters mostly take the solid as
    incompressible and come without a bulk modulus: ``with_nu`` finds it.

    Attributes:
        youngs: Young's modulus [Pa] at small strain, which follows from the parameters.
        nu: Poisson's ratio at small strain, likewise.
        bulk: Bulk modulus [Pa], positive; 2/D1 in the notation of Abaqus.
    """

    youngs: float = field(init=False, repr=False, compare=False)
    nu: float = field(init=False, repr=False, compare=False)
    bulk: PositivePascal

    def __post_init__(self) -> None:
        super().__post_init__()
        name, shear, bulk = type(self).__name__, self.shear, self.bulk
        if not (math.isfinite(shear) and shear > 0.0):
            raise ValueError(f"{name}: the shear modulus at small strain must be positive [Pa], got {shear!r}")
        object.__setattr__(self, "youngs", 9.0 * bulk * shear / (3.0 * bulk + shear))
        object.__setattr__(self, "nu", (3.0 * bulk - 2.0 * shear) / (2.0 * (3.0 * bulk + shear)))
        for parameter in Material.parameters():
            parameter.check(name, getattr(self, parameter.name))

    @classmethod
    def with_nu(cls, nu: float, *, density: float | None = None, **parameters: float) -> Self:
        """The law with the bulk modulus that gives Poisson's ratio ``nu`` at small strain.

        Args:
            nu: In (-1, 0.5); for silicone 0.45 to 0.49.
            density: Density [kg/m^3].
            parameters: All that the law needs besides ``bulk``.

        Raises:
            ValueError: If a parameter is out of its range or not finite.
        """
        Material.parameters()[1].check(cls.__name__, nu)
        shear = cls(bulk=1.0, **parameters).shear
        return cls(bulk=2.0 * shear * (1.0 + nu) / (3.0 * (1.0 - 2.0 * nu)), density=density, **parameters)

    @property
    @abstractmethod
    def shear(self) -> float:
        """Shear modulus [Pa] at small strain."""

    @property
    def law_parameters(self) -> dict[str, float]:
        """``bulk``, then the parameters of W as declared."""
        return {parameter.name: float(getattr(self, parameter.name)) for parameter in self.parameters()}


@dataclass(frozen=True, kw_only=True)
class Yeoh(FittedMaterial):
    """W = c10 x + c20 x^2 + c30 x^3 with x = J^(-2/3) I1 - 3.

    Stable at every strain if c30 >= 0 and c20 >= -sqrt(3 c10 c30). With c30 < 0, as fits of curves that flatten have,
    the stress falls beyond a strain that is reached sooner in equibiaxial than in uniaxial tension.

    Attributes:
        c10: Half the shear modulus at small strain [Pa], positive.
        c20: [Pa]; negative for the usual dip after the start.
        c30: [Pa]; positive for the final rise.
    """

    c10: PositivePascal
    c20: Pascal = 0.0
    c30: Pascal = 0.0
    law: ClassVar[str] = "yeoh"

    @property
    def shear(self) -> float:
        """2 c10 [Pa]."""
        return 2.0 * self.c10


@dataclass(frozen=True, kw_only=True)
class MooneyRivlin(FittedMaterial):
    """W = c10 (J^(-2/3) I1 - 3) + c01 (J^(-4/3) I2 - 3); c10 + c01 is half the shear modulus at small strain.

    Stable under constant volume if neither is negative. Fits of uniaxial tension alone often have c01 < 0: with these,
    equibiaxial tension falls from the stretch sqrt(-c10/c01) on.

    Attributes:
        c10: Factor of the first invariant [Pa].
        c01: Factor of the second invariant [Pa].
    """

    c10: Pascal
    c01: Pascal
    law: ClassVar[str] = "mooney_rivlin"

    @property
    def shear(self) -> float:
        """2 (c10 + c01) [Pa]."""
        return 2.0 * (self.c10 + self.c01)


@dataclass(frozen=True, kw_only=True)
class Ogden(FittedMaterial):
    """W = sum 2 mu_p/alpha_p^2 (sum_i sbar_i^alpha_p - 3) over up to three terms, sbar_i = J^(-1/3) s_i.

    This is the convention of Abaqus: the shear modulus at small strain is mu_1 + mu_2 + mu_3. Parameters published for
    W = sum mu/alpha (..), as in Ogden (1972), have mu_p = mu alpha/2. Stable under constant volume if no mu_p is
    negative. A term with mu_p = 0 costs next to nothing; alpha_p = 0 is the limit in logarithmic strain.

    Attributes:
        mu_1: Shear modulus of the first term [Pa].
        alpha_1: Its exponent, of either sign.
        mu_2: Of the second term.
        alpha_2: Its exponent.
        mu_3: Of the third term.
        alpha_3: Its exponent.
    """

    mu_1: Pascal
    alpha_1: Annotated[float, Parameter()]
    mu_2: Pascal = 0.0
    alpha_2: Annotated[float, Parameter()] = 2.0
    mu_3: Pascal = 0.0
    alpha_3: Annotated[float, Parameter()] = 2.0
    law: ClassVar[str] = "ogden"

    @property
    def shear(self) -> float:
        """mu_1 + mu_2 + mu_3 [Pa]."""
        return self.mu_1 + self.mu_2 + self.mu_3
