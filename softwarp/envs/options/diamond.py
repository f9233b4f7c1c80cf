"""Options of the scene ``scenes/diamond.py`` and of the task ``tasks/diamond.py``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from softwarp.envs.options import (
    Count,
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
    check_borne,
    check_choice,
    check_options,
)
from softwarp.envs.options.cable_reach import CableReachConfig
from softwarp.envs.options.fidelity import FidelityConfig

CABLES = 4
ROTATIONS = ("large", "polar", "warped")
COARSENED_NU = 0.45  # that factors of moduli are fitted for
BORNE = 1.6e-5  # m^2, tension of all cables over youngs: 2.88 N shorten them by 3 cm by default; 4 N never come to rest


@dataclass(kw_only=True)
class DiamondSceneConfig(FidelityConfig):
    """Options of the scene; the defaults are SofaGym's, with cables that only pull, as far as 25 mm."""

    mesh: str = "medium"  # "coarse", "medium", "fine", or a mesh file
    mesh_scale: Positive = 1.0  # metres per unit of a mesh file, which is placed as SofaGym's: base down, axis z
    youngs: Modulus = 180.0e3  # Pa
    nu: PoissonRatio = 0.45
    element: str = "p1"  # "p1" (SOFA's linear tetrahedra, too stiff) or "p2" (quadratic ones between the same nodes)
    rotation: str = "large"  # "large" (SOFA's) or "polar"
    coarsened: bool = False  # moduli along the legs with which the coarse mesh of "p2" moves as converged ones do
    cable_ends: str = "points"  # what they pull at: "points" of elbows, which sink in, or "patches", 17 mm high
    total_mass: Mass = 0.5  # kg
    lumping: str = "uniform"  # "uniform": the same mass on each node, of "p1"; "volume": by the volumes around it
    rayleigh: Rayleigh = (0.0, 0.0)  # 1/s on mass, s on stiffness
    gravity: Gravity = (0.0, 0.0, 0.0)  # m/s^2; SofaGym's scene weighs a thousandth of its weight
    base_half: Length = 0.017  # m, nodes of the base within this of the axis along x and y are held; SofaGym: 0.015
    min_tension: LowLimit = 0.0  # N, cables only pull; -inf makes them rods
    min_displacement: LowLimit = 0.0  # m, how far cables may be let out, negative
    max_displacement: HighLimit = 0.025  # m, how far they may be shortened
    max_rate: Unlimited = 0.1  # m/s, change of a cable's length: 1 mm in 10 ms

    ACCURATE: ClassVar[Mapping[str, Any]] = {
        "mesh": "coarse",
        "element": "p2",
        "rotation": "warped",
        "coarsened": True,
        "cable_ends": "patches",
    }

    def __post_init__(self) -> None:
        """Refuse impossible limits, and cables that crush the body whatever they are told."""
        check_options(self)
        self.take_fidelity()
        if self.coarsened and (self.mesh, self.element, self.nu) != ("coarse", "p2", COARSENED_NU):
            raise ValueError(
                f"{type(self).__name__}: coarsened moduli are for mesh='coarse', element='p2' and nu={COARSENED_NU:g}, "
                f"got {self.mesh!r}, {self.element!r} and {self.nu!r}; leave coarsened and fidelity out"
            )
        check_choice(self, "element", ("p1", "p2"))
        check_choice(self, "rotation", ROTATIONS)
        check_choice(self, "cable_ends", ("points", "patches"))
        check_choice(self, "lumping", ("uniform", "volume"))
        if not self.min_displacement < self.max_displacement:
            raise ValueError(
                f"DiamondConfig: min_displacement must be below max_displacement, got {self.min_displacement} and "
                f"{self.max_displacement}"
            )
        check_borne(self, BORNE)


@dataclass(kw_only=True)
class DiamondConfig(DiamondSceneConfig, CableReachConfig):
    """Options of the Diamond environment."""

    max_episode_steps: Count = 50
    start_displacement: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)  # m, commands at the start
    goal_list: list[list[Place]] = field(default_factory=lambda: [[0.0, 0.0, 0.140], [0.010, -0.010, 0.135]])  # m
    goal_jitter: Distance = 0.001  # m, uniform on each axis
    precision_scale: Length = 0.005  # m at which precision is worth half its weight

    GOAL_KINDS: ClassVar[tuple[str, ...]] = ("workspace", "box", "list")

    def __post_init__(self) -> None:
        """Check names and ranges."""
        DiamondSceneConfig.__post_init__(self)
        CableReachConfig.__post_init__(self)
        self.start_displacement = tuple(float(x) for x in self.start_displacement)
        low, high = self.min_displacement, self.max_displacement
        within = [math.isfinite(x) and low <= x <= high for x in self.start_displacement]
        if len(within) != CABLES or not all(within):
            raise ValueError(
                f"DiamondConfig: start_displacement must hold {CABLES} lengths in metres, each in [{low:g}, {high:g}] "
                f"(min_displacement, max_displacement), got {self.start_displacement}"
            )
        if self.action_kind == "absolute" and not math.isfinite(self.max_displacement - self.min_displacement):
            raise ValueError(
                "DiamondConfig: absolute actions need finite displacement limits, got "
                f"{self.min_displacement} and {self.max_displacement}; set them or choose action_kind='continuous'"
            )

    @classmethod
    def paper(cls, **options: Any) -> DiamondConfig:
        """SofaGym's behaviour, except that every action has exactly 5 sub-steps and episodes end after 50 actions.

        Its action step of 6.25 mm, its north cable that starts 20 mm short, and cables that also push are all kept.
        """
        faithful: dict[str, Any] = {
            "action_kind": "discrete",
            "action_step": 0.00625,
            "observation": "paper",
            "goals": "box",
            "reward": "paper",
            "settle": False,
            "clamp_commands": False,
            "start_displacement": (0.020, 0.0, 0.0, 0.0),
            "base_half": 0.015,
            "min_tension": -math.inf,
            "min_displacement": -math.inf,
            "max_displacement": math.inf,
            "max_rate": math.inf,
            "end_on_success": True,
            "failure_penalty": 0.0,
        }
        return cls(**(faithful | options))
