"""Initial values of all parameters that worlds may differ in, from what the user gave. Host only."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.model.codes import UNBOUNDED
from softwarp.model.fields import declarations
from softwarp.model.state import Parameters
from softwarp.plan.contact import pair_defaults
from softwarp.plan.joints import joint_defaults
from softwarp.scene.parts import Scene
from softwarp.shapes import OneOf

FloatArray = NDArray[np.float64]


def parameter_defaults(scene: Scene) -> dict[str, FloatArray]:
    """One value per item of every parameter that ``Parameters`` declares, without the world axis."""
    bodies, rigids, rods = scene.bodies, scene.rigids, scene.rods
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
        "body_choice": np.zeros(sum(isinstance(b.shape, OneOf) for b in rigids)),
        "body_mass": [b.mass for b in rigids],
        "body_damping": [b.damping for b in rigids],
        "body_max_speed": np.minimum([b.max_speed for b in rigids], UNBOUNDED),
        "body_max_spin": np.minimum([b.max_spin for b in rigids], UNBOUNDED),
        "rod_youngs": [b.youngs for b in rods],
        "rod_nu": [b.nu for b in rods],
        "rod_density": [b.density for b in rods],
        "rod_rayleigh_mass": [b.rayleigh[0] for b in rods],
        "rod_rayleigh_stiffness": [b.rayleigh[1] for b in rods],
    }
    brought = scene.parameters()
    for key, declaration in declarations(Parameters).items():
        if declaration["item"] in brought:
            values[key] = np.clip([part[key] for part in brought[declaration["item"]]], -UNBOUNDED, UNBOUNDED)
    return {key: np.asarray(value, dtype=np.float64) for key, value in values.items()}
