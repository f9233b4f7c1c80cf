"""Initial values of all parameters that worlds may differ in, from what the user gave. Host only."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.model.codes import UNBOUNDED
from softwarp.plan.contact import pair_defaults
from softwarp.plan.joints import joint_defaults
from softwarp.scene.parts import Scene

FloatArray = NDArray[np.float64]
CABLE_LIMITS = (
    "cable_min_displacement",
    "cable_max_displacement",
    "cable_min_tension",
    "cable_max_tension",
    "cable_max_rate",
)
CAVITY_LIMITS = (
    "cavity_min_pressure",
    "cavity_max_pressure",
    "cavity_min_volume",
    "cavity_max_volume",
    "cavity_max_pressure_rate",
    "cavity_max_flow",
)


def parameter_defaults(scene: Scene) -> dict[str, FloatArray]:
    """One value per item of every parameter that ``Parameters`` declares, without the world axis."""
    bodies, rigids, rods = scene.bodies, scene.rigids, scene.rods
    cables = {key: [c.limits[key] for c in scene.cables] for key in CABLE_LIMITS}
    cavities = {key: [c.limits[key] for c in scene.cavities] for key in CAVITY_LIMITS}
    values: dict[str, Any] = {
        "youngs": [b.material.youngs for b in bodies],
        "nu": [b.material.nu for b in bodies],
        "law_parameter": [value for b in bodies for value in b.material.law_parameters.values()],
        "density": [b.density for b in bodies],
        "rayleigh_mass": [b.rayleigh[0] for b in bodies],
        "rayleigh_stiffness": [b.rayleigh[1] for b in bodies],
        "gravity": scene.gravity,
        **pair_defaults(scene),
        **joint_defaults(scene),
        "membrane_youngs": [m.youngs for m in scene.membranes],
        "membrane_nu": [m.nu for m in scene.membranes],
        "cavity_ambient": [c.ambient for c in scene.cavities],
        "cavity_exponent": [c.exponent for c in scene.cavities],
        "body_mass": [b.mass for b in rigids],
        "body_damping": [b.damping for b in rigids],
        "body_max_speed": np.minimum([b.max_speed for b in rigids], UNBOUNDED),
        "body_max_spin": np.minimum([b.max_spin for b in rigids], UNBOUNDED),
        "rod_youngs": [b.youngs for b in rods],
        "rod_nu": [b.nu for b in rods],
        "rod_density": [b.density for b in rods],
        "rod_rayleigh_mass": [b.rayleigh[0] for b in rods],
        "rod_rayleigh_stiffness": [b.rayleigh[1] for b in rods],
        **{key: np.clip(np.array(limits), -UNBOUNDED, UNBOUNDED) for key, limits in (cables | cavities).items()},
    }
    return {key: np.asarray(value, dtype=np.float64) for key, value in values.items()}
