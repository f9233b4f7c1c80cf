"""Options of the scene ``scenes/gripper.py`` and of the task ``tasks/gripper.py``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

from softwarp.envs.options import (
    AngleRange,
    Distance,
    Gravity,
    HalfAngle,
    Length,
    LowLimit,
    Mass,
    Modulus,
    NotNegative,
    Place,
    PlaceRange,
    PoissonRatio,
    Positive,
    PositiveRange,
    Rayleigh,
    Speed,
    check_borne,
    check_choice,
    check_options,
)
from softwarp.envs.options.base import EnvConfig
from softwarp.envs.options.fidelity import FidelityConfig
from softwarp.ranges import Range

FINGERS = ("cavities", "plain")
RESOLUTIONS = ("coarse", "medium", "fine")
ELEMENTS = ("p1", "p2", "bricks")
BRICK_NU = 0.48  # that factors of the moduli of bricks are fitted for
OBJECTS = ("soft_cube", "cube", "sphere", "capsule", "figurine")
ACTION_KINDS = ("continuous", "discrete")
CABLE_KINDS = ("both", "each")
OBSERVATION_KINDS = ("pose", "nodes", "paper")
GOAL_KINDS = ("heights", "list", "places")
REWARD_KINDS = ("dense", "paper")

REACH = 0.0795  # m, how far below the hand's origin its open fingers end
GRASP_DEPTH = 0.070  # m, how far below it they hold
CLOSED_DEPTH = 0.087  # m, how far below it they come while they close
OPENING = 0.118  # m, between the open fingers where they hold
SMALLEST = 0.032  # m, what they can hold from the floor: of something smaller they reach the upper part alone
LARGEST = 0.070  # m, what fits between the phalanges below the palms
TIPS, CLOSING = 0.104, 6.6  # m, between the tips of open fingers; m less for a m of cable, at most, plain ones
CRUSHED = 0.025  # m of cable: empty fingers have met by then; at 30 mm elements turn inside out
EPISODE, ACTIONS = 12.5, 250  # s and actions of an ordinary episode, within which the task must be feasible
BORNE = {
    "cavities": 1.0e-5,
    "plain": 5.0e-6,
}  # m^2, tension over youngs that empty fingers bear: 200 N
SQUEEZE = 4.0e-6  # m^2, normal force of a finger over its youngs, at most: 78 N on an object 70 mm wide
SUPPLE = 0.25  # times that for quadratic elements and bricks, which bend more easily
CLEARANCE = 0.004  # m, between what must not touch at the start

Growth = Annotated[tuple[float, float], Range(low=0.0, high=0.02, rising=True)]  # m
Coefficients = Annotated[tuple[float, float], Range(low=0.0, high=1.0e3, rising=True)]
Cells = Annotated[int, Range(low=1, high=20)]


@dataclass(kw_only=True)
class GripperSceneConfig(FidelityConfig):
    """Options of the scene; the fingers are SofaGym's, gravity is real."""

    finger: str = "cavities"  # "cavities" (SofaGym's shape) or "plain" (a simpler one with a third of the nodes)
    mesh: str = "coarse"  # "coarse", "medium" or "fine"
    youngs: Modulus = 20.0e6  # Pa, of the fingers
    nu: PoissonRatio = 0.48
    element: str = "p1"  # "p1" (linear tetrahedra, too stiff), "p2" (quadratic ones) or "bricks" (fitted hexahedra)
    rotation: str = "warped"  # "warped", "polar", or "large" (SOFA's, which pushes symmetric fingers sideways)
    finger_mass: Mass = 0.1  # kg, of one
    rayleigh: Rayleigh = (0.0, 0.0)  # 1/s on mass, s on stiffness, of the fingers
    touch: bool = False  # close the cavities, so that their pressures tell of contact
    object: str = "soft_cube"  # "soft_cube", "cube", "sphere", "capsule" or "figurine"; all but the first are rigid
    object_size: Length = 0.040  # m, edge, diameter (a capsule lies on its side), or diameter of the figurine's foot
    object_mass: PositiveRange = (0.1, 0.1)  # kg, drawn per world at reset; SofaGym: 1.0
    object_youngs: PositiveRange = (400.0e3, 400.0e3)  # Pa, of the soft cube, likewise
    object_growth: Growth = (0.0, 0.0)  # m, likewise: how far its surfaces reach beyond object_size, on all sides
    object_nu: PoissonRatio = 0.45
    object_cells: Cells = 2  # of the soft cube along an edge; SofaGym's is a shell of 12 triangles
    mu: Coefficients = (0.8, 0.8)  # friction of the object with all else, drawn per world at reset
    contact_distance: Distance = 0.0005  # m, surfaces rest that far apart; SofaGym: 5 mm
    gravity: Gravity = (0.0, 0.0, -9.81)  # m/s^2
    min_tension: LowLimit = 0.0  # N, cables only pull; -inf makes them rods
    max_displacement: Length = 0.020  # m, how far a cable may be shortened: empty fingers meet there; SofaGym: 25 mm
    hand_x: PlaceRange = (-0.06, 0.06)  # m, where the hand may go
    hand_y: PlaceRange = (-0.06, 0.06)  # m
    hand_z: PlaceRange = (0.0875, 0.260)  # m, of its origin above the floor
    hand_yaw: AngleRange = (-1.6, 1.6)  # rad
    hand_start: Length = 0.162  # m, of its origin above the floor
    max_speed: Speed = 0.25  # m/s, of the hand
    max_spin: Speed = 4.0  # rad/s

    ACCURATE: ClassVar[Mapping[str, Any]] = {"finger": "cavities", "mesh": "coarse", "element": "bricks"}

    def __post_init__(self) -> None:
        """Refuse what cannot be built or held."""
        check_options(self)
        self.take_fidelity()
        for name, choices in (("finger", FINGERS), ("mesh", RESOLUTIONS), ("object", OBJECTS)):
            check_choice(self, name, choices)
        check_choice(self, "element", ELEMENTS)
        check_choice(self, "rotation", ("large", "polar", "warped"))
        label = type(self).__name__
        asked = (self.finger, self.mesh, self.rotation, self.nu)
        if self.element == "bricks" and asked != ("cavities", "coarse", "warped", BRICK_NU):
            raise ValueError(
                f"{label}: element='bricks' has a mesh of its own with fitted moduli and needs finger='cavities', "
                f"mesh='coarse', rotation='warped' and nu={BRICK_NU:g}, got {asked}; leave element and fidelity out"
            )
        if self.touch and self.finger != "cavities":
            raise ValueError(
                f"{label}: touch=True needs fingers with cavities, the finger {self.finger!r} has none; take "
                "finger='cavities', or touch=False"
            )
        low, high = self.width
        if low < SMALLEST or high > LARGEST:
            grown = f" with object_growth {self.object_growth}" if self.object_growth[1] else ""
            raise ValueError(
                f"{label}: object_size must lie in [{SMALLEST:g}, {LARGEST:g}] m, what the hand can hold, got "
                f"{self.object_size:g} m{grown}"
            )
        if not self.hand_z[0] <= self.hand_start <= self.hand_z[1]:
            raise ValueError(f"{label}: hand_start must lie within hand_z {self.hand_z}, got {self.hand_start:g} m")
        if self.hand_z[0] < CLOSED_DEPTH:
            raise ValueError(
                f"{label}: hand_z must begin at {CLOSED_DEPTH:g} m or higher, so that closing fingers pass "
                f"above the floor, got {self.hand_z}"
            )
        check_borne(self, BORNE[self.finger] * (1.0 if self.element == "p1" else SUPPLE))
        self._check_grasp(label)

    def _check_grasp(self, label: str) -> None:
        """Refuse a hand that cannot get to the object or close on it, and gravity that takes the object away."""
        deepest, low = REACH + 0.5 * self.object_size, self.hand_z[0]
        if low > deepest:
            raise ValueError(
                f"{label}: hand_z must begin at {deepest:.4g} m or lower, so that fingers come down to the middle of "
                f"an object of {self.object_size:g} m on the floor, got {self.hand_z}"
            )
        if not self.hand_yaw[0] <= 0.0 <= self.hand_yaw[1]:
            raise ValueError(f"{label}: hand_yaw must hold 0, where the hand starts, got {self.hand_yaw}")
        least = (TIPS - self.width[1]) / CLOSING
        if self.max_displacement < least:
            raise ValueError(
                f"{label}: max_displacement must be {least:.3g} m or more, or the fingers do not close on an object "
                f"{self.width[1]:g} m wide, got {self.max_displacement:g}; or take a larger object_size"
            )
        if self.max_displacement > CRUSHED:
            raise ValueError(
                f"{label}: max_displacement must be {CRUSHED:g} m or less, got {self.max_displacement:g}: the fingers "
                "meet before, and would be crushed"
            )
        room = 0.5 * (TIPS - self.width[1])
        if self.contact_distance >= room:
            raise ValueError(
                f"{label}: contact_distance must be less than {room:.3g} m, the room between an object "
                f"{self.width[1]:g} m wide and the open fingers, got {self.contact_distance:g}"
            )
        weight, grip = self.object_mass[1] * math.hypot(*self.gravity), 2.0 * SQUEEZE * self.youngs
        least = max(math.ceil(1.0e4 * weight / grip), 1.0) / 1.0e4
        if self.mu[0] < least:
            raise ValueError(
                f"{label}: mu must begin at {least:g} or higher, got {self.mu}: nothing but friction lifts an object, "
                f"and fingers whose youngs is {self.youngs:g} Pa press {self.object_mass[1]:g} kg by no more "
                f"than {0.5 * grip:.3g} N each; make mu or youngs larger, or object_mass smaller"
            )
        across, down = math.hypot(*self.gravity[:2]), -self.gravity[2]
        if down < 0.0 or across > self.mu[0] * down:
            raise ValueError(
                f"{label}: gravity must press the object onto the floor, within the cone of its friction mu "
                f"{self.mu[0]:g}, or be zero, got {self.gravity}; tilt it less, or raise mu"
            )

    @property
    def width(self) -> tuple[float, float]:
        """Least and largest extent [m] of the object sideways."""
        return self.object_size + 2.0 * self.object_growth[0], self.object_size + 2.0 * self.object_growth[1]

    @property
    def object_height(self) -> float:
        """How high the object reaches above the floor at most [m], gaps included."""
        tall = 1.46 if self.object == "figurine" else 1.0
        return tall * self.object_size + 2.0 * (self.object_growth[1] + self.contact_distance)


@dataclass(kw_only=True)
class GripperConfig(GripperSceneConfig, EnvConfig):
    """Options of the Gripper environment."""

    action_kind: str = "continuous"  # "continuous" or "discrete" (8 choices)
    cables: str = "both"  # continuous actions pull "both" cables together or "each" on its own
    move_step: Length = 0.005  # m, largest way of the hand along x and y in an action
    up_step: Length = 0.010  # m, likewise upwards
    down_step: Length = 0.005  # m, likewise downwards
    yaw_step: Positive = 0.15  # rad
    cable_step: Length = 0.005  # m
    observation: str = "pose"  # of the object: "pose" or "nodes" (corners of its box); "paper": SofaGym's 31 numbers
    goals: str = "heights"  # "heights" in goal_z, "list" of goal_heights, or "places" in goal_x, goal_y and goal_z
    goal_z: PlaceRange = (0.060, 0.160)  # m, of the object's middle above the floor
    goal_x: PlaceRange = (-0.040, 0.040)  # m
    goal_y: PlaceRange = (-0.040, 0.040)  # m
    goal_heights: list[Place] = field(default_factory=lambda: [0.150, 0.160, 0.165])  # m, above the floor
    object_x: PlaceRange = (-0.020, 0.020)  # m, where the object starts
    object_y: PlaceRange = (-0.030, 0.030)  # m
    object_yaw: AngleRange = (-0.6, 0.6)  # rad
    pull: NotNegative = 0.0  # largest random force on the object, drawn anew every action, in parts of its weight
    pull_cone: HalfAngle = math.pi / 4  # rad, half angle about the downward direction within which it points
    pull_turn: NotNegative = 0.0  # likewise the largest random moment, in parts of its weight times half its size
    reward: str = "dense"  # "dense" (at most 2 per action) or "paper"
    approach_weight: NotNegative = 0.2  # with reward="dense": cost of a way of 0.1 m from the fingertips to the object
    success_tolerance: Length = 0.003  # m

    def __post_init__(self) -> None:
        """Check names and ranges, and whether hand and goals are within reach."""
        GripperSceneConfig.__post_init__(self)
        EnvConfig.__post_init__(self)
        check_choice(self, "action_kind", ACTION_KINDS)
        check_choice(self, "cables", CABLE_KINDS)
        check_choice(self, "observation", OBSERVATION_KINDS)
        check_choice(self, "goals", GOAL_KINDS)
        check_choice(self, "reward", REWARD_KINDS)
        label = type(self).__name__
        if self.action_kind == "discrete" and self.cables == "each":
            raise ValueError(
                f"{label}: cables='each' needs action_kind='continuous'; the discrete actions pull both, cables='both'"
            )
        if (self.pull > 0.0 or self.pull_turn > 0.0) and not any(self.gravity):
            raise ValueError(
                f"{label}: pull and pull_turn are in parts of the weight, and without gravity there is none"
            )
        self._check_start()
        self._check_goals()
        self._check_pace()

    def _check_start(self) -> None:
        """Refuse an object that starts in a finger."""
        far = max(abs(place) for place in self.object_x) + 0.75 * self.width[1] + CLEARANCE
        above = self.hand_start - REACH - self.object_height
        if above < CLEARANCE and far > 0.5 * OPENING:
            raise ValueError(
                f"{type(self).__name__}: the object would start inside a finger: at hand_start {self.hand_start:g} m "
                f"the fingers end {1e3 * above:.3g} mm above it, and with object_x {self.object_x} it reaches there; "
                f"raise hand_start to {self.object_height + REACH + CLEARANCE:.3g} m or narrow object_x"
            )

    def _check_goals(self) -> None:
        """Refuse goals to which the hand cannot lift or carry the object."""
        label, rest = type(self).__name__, 0.5 * self.object_size
        low, high = rest, self.hand_z[1] - GRASP_DEPTH - 0.005
        if not self.goal_heights:
            raise ValueError(f"{label}: goal_heights must hold at least one height [m], got []")
        heights = self.goal_heights if self.goals == "list" else self.goal_z
        name = "goal_heights" if self.goals == "list" else "goal_z"
        wrong = [height for height in heights if not low <= height <= high]
        if wrong:
            raise ValueError(
                f"{label}: {name} must lie in [{low:g}, {high:g}] m, between the object at rest and what the hand "
                f"reaches with hand_z {self.hand_z}, got {wrong[0]:g}"
            )
        for name, span in (("x", self.hand_x), ("y", self.hand_y)):
            starts, goals = getattr(self, f"object_{name}"), getattr(self, f"goal_{name}")
            for what, places in (("object", starts), ("goal", goals if self.goals == "places" else starts)):
                if not span[0] <= places[0] <= places[1] <= span[1]:
                    need = f"lie within hand_{name} {span}, where the hand can go"
                    raise ValueError(f"{label}: {what}_{name} must {need}, got {places}")

    def _check_pace(self) -> None:
        """Refuse a hand too slow for the way down to the object and up to the lowest goal, whatever the policy does.

        Short episodes are no reason: they count as ordinary ones.
        """
        label = type(self).__name__
        heights = self.goal_heights if self.goals == "list" else self.goal_z
        down = self.hand_start - REACH - self.object_height
        up = min(heights) - 0.5 * self.object_size
        seconds = max(EPISODE, self.max_episode_steps * self.action_repeat * self.dt)
        actions = max(ACTIONS, self.max_episode_steps)
        way = max(down, 0.0) + up
        if self.max_speed * seconds < way:
            raise ValueError(
                f"{label}: max_speed must be {way / seconds:.2g} m/s or more, so that the hand gets down to the object "
                f"and up to the lowest goal, {way:.3g} m in {seconds:g} s, got {self.max_speed:g}; or take more "
                "max_episode_steps"
            )
        close = max(TIPS - self.width[1], 0.0) / CLOSING
        for name, least in (("down_step", down), ("cable_step", close), ("up_step", up)):
            if getattr(self, name) * actions < least:
                raise ValueError(
                    f"{label}: {name} must be {least / actions:.2g} m or more, or {actions} actions do not suffice for "
                    f"the {least:.3g} m that the task takes, got {getattr(self, name):g}"
                )

    @classmethod
    def paper(cls, **options: Any) -> GripperConfig:
        """SofaGym's behaviour, in real gravity and with a hand that does travel, a solid cube and true fingertips.

        Its cables that also push, its undamped cube of 1 kg, its steps and its reward are kept, its contact distance of
        5 mm is not. Heights are those that its hand can reach.
        """
        faithful: dict[str, Any] = {
            "action_kind": "discrete",
            "min_tension": -math.inf,
            "max_displacement": 0.025,
            "object_mass": (1.0, 1.0),
            "object_yaw": (0.0, 0.0),
            "observation": "paper",
            "goals": "list",
            "reward": "paper",
            "end_on_success": True,
            "failure_penalty": 0.0,
        }
        return cls(**(faithful | options))
