"""Solid materials: elastic moduli and the law they enter. Energies are defined in docs/theory/hyperelastic.md."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


def lame(youngs: float, nu: float) -> tuple[float, float]:
    """Lame constants (mu, lam) [Pa] of an isotropic solid."""
    return youngs / (2.0 * (1.0 + nu)), youngs * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


@dataclass(frozen=True)
class Material:
    """Isotropic elastic solid.

    Attributes:
        youngs: Young's modulus [Pa], positive.
        nu: Poisson's ratio, in (-1, 0.5).

    Raises:
        ValueError: If a modulus is out of its range or not finite.
    """

    youngs: float
    nu: float
    law: ClassVar[str] = ""

    def __post_init__(self) -> None:
        name = type(self).__name__
        if not (math.isfinite(self.youngs) and self.youngs > 0.0):
            raise ValueError(f"{name}: Young's modulus must be positive and finite [Pa], got {self.youngs!r}")
        if not -1.0 < self.nu < 0.5:
            raise ValueError(
                f"{name}: Poisson's ratio must lie in (-1, 0.5), got {self.nu!r}; for silicone use 0.45 to 0.49"
            )

    @property
    def kernel_law(self) -> str:
        """Name of the element kernel: a law of ``kernels.elements.materials`` or ``large``."""
        return self.law

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

        from softwarp.kernels.elements import hyperelastic

        array = np.asarray(F, dtype=np.float64)
        if array.shape[-2:] != (3, 3):
            raise ValueError(f"deformation gradients must have shape (3, 3) or (n, 3, 3), got {array.shape}")
        flat = array.reshape(-1, 3, 3)
        device: Any = "cpu"
        given = wp.array(flat, dtype=wp.mat33d, device=device)
        energy = wp.empty(len(flat), dtype=wp.float64, device=device)
        stress = wp.empty(len(flat), dtype=wp.mat33d, device=device)
        tangent = wp.empty((len(flat), 9, 9), dtype=wp.float64, device=device)
        wp.launch(
            hyperelastic.evaluation_kernels(self.law).evaluate,
            dim=len(flat),
            inputs=[given, wp.vec2d(*lame(self.youngs, self.nu)), project],
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
        method: ``polar`` takes the rotation nearest to the deformation gradient and its exact tangent; ``large`` takes
            it from the element's edges as SOFA's TetrahedronFEMForceField does, several times cheaper, and depends
            slightly on the order of an element's corners. ``warped`` has the forces and statics of ``polar`` and in
            steps the tangent of ``large``, at little more than its cost.
    """

    method: str = "polar"
    law: ClassVar[str] = "corotational"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.method not in ("polar", "large", "warped"):
            raise ValueError(f"Corotational: method must be 'polar', 'large' or 'warped', got {self.method!r}")

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
