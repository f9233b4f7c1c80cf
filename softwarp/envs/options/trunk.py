"""Options of the scene ``scenes/trunk.py`` and of the task ``tasks/trunk.py``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from softwarp.envs.options import (
    Angle,
    Distance,
    Gravity,
    HalfAngle,
    LowLimit,
    Mass,
    Modulus,
    Place,
    Places,
    PoissonRatio,
    Positive,
    PositiveRange,
    Rayleigh,
    Share,
    Unlimited,
    check_borne,
    check_choice,
    check_options,
)
from softwarp.envs.options.cable_reach import CableReachConfig
from softwarp.envs.options.fidelity import FidelityConfig

ROTATIONS = ("large", "polar", "warped")
ROUND = {"round": "coarse", "round fine": "fine"}  # meshes of ``meshing.round_trunk``, and their details
BORNE = 4.45e-6  # m^2, tension of all cables over youngs: under 2 N the default trunk comes to rest, under 3 N never


@dataclass(kw_only=True)
class TrunkSceneConfig(FidelityConfig):
    """Options of the scene: SofaGym's, but for quarter turns between cables, ``closing_length`` and the guard."""

    mesh: str = "medium"  # "coarse", "medium", "fine"; "round", "round fine" (of "p2"); or a mesh file
    mesh_scale: Positive = 1.0  # metres per unit of a mesh file
    youngs: Modulus = 450.0e3  # Pa
    nu: PoissonRatio = 0.45
    element: str = "p1"  # "p1" (SOFA's linear tetrahedra, too stiff) or "p2" (quadratic ones between the same nodes)
    rotation: str = "large"  # "large" (SOFA's) or "polar"
    inversion_guard: Share = 0.4  # volume ratio below which elements are held upright; SOFA's turn inside out
    total_mass: Mass = 0.042  # kg
    lumping: str = "uniform"  # "uniform": the same mass on each node, of "p1"; "volume": by the volumes around it
    rayleigh: Rayleigh = (0.1, 0.1)  # 1/s on mass, s on stiffness
    gravity: Gravity = (0.0, -9.81, 0.0)  # m/s^2
    fixed_length: Distance = 0.020  # m, nodes up to this height are clamped
    cable_angle: Angle = math.pi / 2  # rad between neighbouring cables; SofaGym has 1.57
    min_tension: LowLimit = 0.0  # N, cables only pull; -inf makes them rods
    max_displacement: Places = (0.070, 0.040)  # m, shortening of long and short cables
    min_displacement: Places = (-0.040, -0.020)  # m, how far they may be let out
    max_rate: Unlimited = 0.1  # m/s, change of a cable's length: 1 mm in 10 ms
    closing_length: Distance = 0.001  # m, a sixth of the short segments, which cables can crush; SOFA: 0, chatters

    ACCURATE: ClassVar[Mapping[str, Any]] = {"mesh": "round", "element": "p2", "rotation": "warped"}

    def __post_init__(self) -> None:
        """Refuse impossible limits."""
        check_options(self)
        self.take_fidelity()
        check_choice(self, "element", ("p1", "p2"))
        if self.mesh in ROUND and self.element != "p2":
            raise ValueError(
                f"{type(self).__name__}: mesh={self.mesh!r} is of quadratic elements; take element='p2', or another "
                "mesh"
            )
        check_choice(self, "rotation", ROTATIONS)
        check_choice(self, "lumping", ("uniform", "volume"))
        for low, high in zip(self.min_displacement, self.max_displacement, strict=True):
            if not -math.inf < low < high < math.inf:
                raise ValueError(f"TrunkConfig: displacement limits must be finite and rising, got {low} and {high}")
        check_borne(self, BORNE)


@dataclass(kw_only=True)
class TrunkConfig(TrunkSceneConfig, CableReachConfig):
    """Options of the Trunk environment."""

    goal_offset: bool = False  # observe the goal displaced by ``PAPER_GOAL_OFFSET``, as SofaGym does
    goal_list: list[list[Place]] = field(default_factory=lambda: [[0.040, 0.040, 0.100], [-0.010, 0.020, 0.080]])  # m
    damping_range: PositiveRange | None = None  # factor on both Rayleigh coefficients, drawn per world at reset
    gravity_tilt: HalfAngle = 0.0  # rad, gravity's direction is drawn from a cone of this half angle at reset

    def __post_init__(self) -> None:
        """Check names and ranges."""
        TrunkSceneConfig.__post_init__(self)
        CableReachConfig.__post_init__(self)

    @classmethod
    def paper(cls, **options: Any) -> TrunkConfig:
        """SofaGym's behaviour, except that every action has exactly 5 sub-steps and episodes end after 250 actions."""
        faithful: dict[str, Any] = {
            "action_kind": "discrete",
            "observation": "paper",
            "goals": "list",
            "goal_offset": True,
            "reward": "paper",
            "settle": False,
            "clamp_commands": False,
            "cable_angle": 1.57,
            "success_tolerance": 0.001,
            "end_on_success": True,
            "failure_penalty": 0.0,
            "closing_length": 0.0,
            "inversion_guard": 0.0,
        }
        return cls(**(faithful | options))
