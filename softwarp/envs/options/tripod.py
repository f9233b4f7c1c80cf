"""Options of the scene ``scenes/tripod.py``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from softwarp.envs.options import (
    Angle,
    Distance,
    Gravity,
    HighLimit,
    Length,
    LowLimit,
    Mass,
    Modulus,
    Place,
    PoissonRatio,
    Positive,
    Rayleigh,
    Unlimited,
    check_choice,
    check_options,
)
from softwarp.envs.options.fidelity import FidelityConfig

SERVOS = 3
RESOLUTIONS = ("coarse", "medium", "fine")
ELEMENTS = ("p1", "p2", "walls")
ROTATIONS = ("large", "polar", "warped")


@dataclass(kw_only=True)
class TripodSceneConfig(FidelityConfig):
    """Options of the scene; the defaults are SofaGym's, but for the limits of its servos."""

    mesh: str = "coarse"  # "coarse", "medium", "fine", or a mesh file
    mesh_scale: Positive = 1.0  # metres per unit of a mesh file, which lies flat as SoftRobots': a leg along -y, z >= 0
    youngs: Modulus = 250.0e3  # Pa
    nu: PoissonRatio = 0.45
    element: str = "p1"  # "p1" (SOFA's linear tetrahedra, too stiff), "p2" (quadratic ones) or "walls" (hexahedra)
    rotation: str = "large"  # "large" (SOFA's) or "polar"
    total_mass: Mass = 0.032  # kg
    lumping: str = "uniform"  # "uniform": the same mass on each node, of "p1"; "volume": by the volumes around it
    rayleigh: Rayleigh = (0.0, 0.05)  # 1/s on mass, s on stiffness
    gravity: Gravity = (0.0, 0.0, -9.81)  # m/s^2
    radius: Length = 0.060  # m, from the axis to a servo in the flat state
    servo_height: Place = -0.00135  # m
    advance: Distance = 0.035  # m, by which the setup motion moves the servos inwards
    angle: Angle = -1.4965  # rad, to which it turns their arms
    min_angle: LowLimit = -2.0225  # rad, lowest angle of a servo; those of the robot that SoftRobots describes
    max_angle: HighLimit = -0.0255  # rad, highest
    max_speed: Unlimited = 8.7  # rad/s, of a servo without load: 0.12 s for 60 degrees
    max_torque: HighLimit = 0.18  # N m, of a servo that stands still: 1.8 kg cm
    arm_mass: Mass = 0.01  # kg

    ACCURATE: ClassVar[Mapping[str, Any]] = {"mesh": "coarse", "element": "walls", "rotation": "warped"}

    def __post_init__(self) -> None:
        """Refuse impossible limits, and hexahedra where there are none."""
        check_options(self)
        self.take_fidelity()
        check_choice(self, "element", ELEMENTS)
        if self.element == "walls" and (self.mesh != "coarse" or self.rotation != "warped"):
            raise ValueError(
                f"{type(self).__name__}: element='walls' has a mesh of its own (leave mesh 'coarse') and needs "
                f"rotation='warped', got {self.mesh!r} and {self.rotation!r}; fidelity='accurate' chooses all three"
            )
        check_choice(self, "rotation", ROTATIONS)
        check_choice(self, "lumping", ("uniform", "volume"))
        if not self.min_angle <= self.angle <= self.max_angle:
            raise ValueError(
                f"{type(self).__name__}: angle must lie in [min_angle, max_angle], got {self.angle:g} outside "
                f"[{self.min_angle:g}, {self.max_angle:g}]"
            )
        if self.max_torque <= 0.0:
            raise ValueError(
                f"{type(self).__name__}: max_torque must be positive, got {self.max_torque:g}; inf for any"
            )

    @property
    def joint_limits(self) -> tuple[float, float]:
        """Stops of the joints [rad]; the flat state, 0, is among what they let through."""
        return min(self.min_angle, 0.0), max(self.max_angle, 0.0)
