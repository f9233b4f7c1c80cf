"""Options of the scene ``scenes/concentric_tube_robot.py`` and of the task ``tasks/concentric_tube_robot.py``."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Any

from softwarp.envs.options import (
    Count,
    Density,
    Distance,
    Gravity,
    HalfAngle,
    Length,
    NotNegative,
    Pieces,
    Place,
    PoissonRatio,
    Positive,
    Rayleigh,
    Sizes,
    check_choice,
    check_options,
)
from softwarp.envs.options.tubes import Lengths, TubesConfig
from softwarp.ranges import Range, Seed

Moduli = Annotated[tuple[float, float, float], Range(low=1.0, high=1.0e13)]  # Pa
GOAL_KINDS = ("workspace", "box", "list")


@dataclass(kw_only=True)
class ConcentricTubeSceneConfig:
    """Options of the scene: SofaGym's tubes, with radii by which they fit into each other; innermost first."""

    vessel: str = "passage"  # "passage" (generated, nostril at the origin) or a mesh file of a surface
    vessel_scale: Positive = 1.0  # metres per unit of a mesh file, or size of the passage
    anatomy: Seed | None = None  # of a random passage; None: the standard one
    variation: NotNegative = 1.0  # how much random passages differ, at most 3
    spacing: Length = 0.0015  # m, between samples of the wall's distance
    wall: Length = 0.010  # m, thickness of the wall
    straight: Sizes = (0.475, 0.480, 0.485)  # m, straight part of each tube
    curved: Sizes = (0.025, 0.020, 0.015)  # m, curved end of each tube
    curve_radius: Sizes = (0.0125, 0.010, 0.0075)  # m, of the centre line of the curved ends
    radius: Sizes = (0.0005, 0.00075, 0.001)  # m, outer radius
    inner_radius: Lengths = (0.0003, 0.00055, 0.0008)  # m
    youngs: Moduli = (919e6, 222e6, 84.6e6)  # Pa, straight part: E I as of SofaGym's, 50 MPa with 1 mm radius
    curved_youngs: Moduli = (919e6, 444e6, 253.8e6)  # Pa, curved end: once, twice, three times that, as SofaGym's
    nu: PoissonRatio = 0.49
    density: Density = 1550.0  # kg/m^3
    windup: bool = False  # whether tubes twist, so that strongly curved ones snap; SofaGym's are rigid in torsion
    segments: Pieces = 24  # of the line, from the port to its end
    rayleigh: Rayleigh = (0.1, 0.02)  # 1/s on mass, s on stiffness; SofaGym: 0.1, 0.2
    contact_radius: Length = 0.0005  # m, of the whole line
    mu: NotNegative = 0.1
    max_length: Sizes = (0.090, 0.075, 0.060)  # m, that tubes can be pushed out
    gravity: Gravity = (0.0, 0.0, 0.0)  # m/s^2; SofaGym's is a thousandth of the true one

    def __post_init__(self) -> None:
        """Refuse impossible values, and tubes that do not fit into each other."""
        check_options(self)
        name = type(self).__name__
        for tube, (most, straight, curved) in enumerate(zip(self.max_length, self.straight, self.curved, strict=True)):
            if most > straight + curved:
                raise ValueError(
                    f"{name}: max_length of tube {tube} must be at most its length, {straight + curved:g} m, got "
                    f"{most!r}"
                )
        for inside, outside in ((0, 1), (1, 2)):
            if self.inner_radius[outside] < self.radius[inside]:
                raise ValueError(
                    f"{name}: tube {inside} with a radius of {self.radius[inside]:g} m does not fit into tube "
                    f"{outside} with an inner radius of {self.inner_radius[outside]:g} m; change radius or inner_radius"
                )
        for tube in range(3):
            if self.inner_radius[tube] >= self.radius[tube]:
                raise ValueError(
                    f"{name}: inner_radius of tube {tube} must be below its radius, {self.radius[tube]:g} m"
                )
        if self.variation > 3.0:
            raise ValueError(f"{name}: variation must be at most 3, got {self.variation!r}")
        if self.wall < 4.0 * self.spacing:
            raise ValueError(
                f"{name}: wall must be at least four times spacing, {4.0 * self.spacing:g} m, got {self.wall!r}: "
                "tubes would be pushed out of a thin wall on its other side"
            )


@dataclass(kw_only=True)
class ConcentricTubeRobotConfig(ConcentricTubeSceneConfig, TubesConfig):
    """Options of the ConcentricTubeRobot environment."""

    goals: str = "workspace"  # "workspace", "box" or "list"
    goal_list: list[list[Place]] = field(default_factory=lambda: [[0.0, 0.010, 0.030], [0.003, 0.020, 0.035]])  # m
    goal_split: str = "train"  # "train", "eval" or "all" of the workspace's goals; the first two are disjoint
    goal_turn: HalfAngle = 2.0  # rad, goals of the workspace are reached with angles of at most this
    goal_depth: Distance = 0.012  # m, their least distance from the port
    goal_margin: Distance = 0.0005  # m, that the whole line is clear of the wall at such a goal
    goal_count: Count = 1000  # of the workspace
    goal_seed: Seed = 0  # of the search for them; another one gives other goals of the same workspace

    def __post_init__(self) -> None:
        """Check names and ranges."""
        ConcentricTubeSceneConfig.__post_init__(self)
        TubesConfig.__post_init__(self)
        name = type(self).__name__
        check_choice(self, "goals", GOAL_KINDS)
        check_choice(self, "goal_split", ("train", "eval", "all"))
        self.check_reach("max_length", self.max_length)
        if self.goal_turn <= 0.0:
            raise ValueError(f"{name}: goal_turn must be positive, got {self.goal_turn!r} rad")
        if self.goal_depth >= self.max_length[0]:
            raise ValueError(f"{name}: goal_depth must be less than max_length of tube 0, got {self.goal_depth!r} m")
        self.goal_list = [[float(x) for x in point] for point in self.goal_list]
        if not self.goal_list or any(len(point) != 3 for point in self.goal_list):
            raise ValueError(f"{name}: goal_list must hold points (x, y, z) in metres, got {self.goal_list}")
        far = max(self.goal_list, key=lambda point: math.hypot(*point))
        if self.goals == "list" and math.hypot(*far) > max(self.max_length):
            raise ValueError(
                f"{name}: points of goal_list must lie within max_length of the port, {max(self.max_length):g} m, so "
                f"that a tube reaches them, got {far}; goals='workspace' has only such"
            )

    @classmethod
    def paper(cls, **options: Any) -> ConcentricTubeRobotConfig:
        """SofaGym's behaviour with all rotations, a clamped base along +z and 10 sub-steps per action.

        Goals come from SofaGym's box, whether or not they lie in the lumen; tubes reach out as far as they are long.
        """
        faithful: dict[str, Any] = {
            "action_kind": "discrete",
            "observation": "paper",
            "reward": "paper",
            "goals": "box",
            "nested": False,
            "rayleigh": (0.1, 0.2),
            "max_length": (0.5, 0.5, 0.5),
            "success_tolerance": 0.003,
            "end_on_success": True,
            "failure_penalty": 0.0,
        }
        return cls(**(faithful | options))
