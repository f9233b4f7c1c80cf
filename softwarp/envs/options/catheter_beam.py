"""Options of the scene ``scenes/catheter_beam.py`` and of the task ``tasks/catheter_beam.py``."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

from softwarp.envs.options import (
    Count,
    Density,
    Distance,
    Further,
    Gravity,
    HalfAngle,
    Length,
    Modulus,
    NotNegative,
    Pieces,
    Positive,
    Rayleigh,
    RodPoissonRatio,
    Sizes,
    check_choice,
    check_options,
)
from softwarp.envs.options.tubes import Lengths, TubesConfig, Turns
from softwarp.meshing import VesselTree, aorta
from softwarp.meshing.aorta_geometry import MOST_OUTLETS, OUTLETS, RADIUS
from softwarp.ranges import Seed

ANATOMY_KINDS = ("reference", "random")
OBSERVATION_KINDS = ("compact", "local", "paper")
MOST_ANATOMIES = 64
COIL, GUIDE, CATHETER = range(3)

AnatomyKey = tuple[int | None, int, float, float]  # seed, outlets, radii of inlet and outlets [m]


@dataclass(kw_only=True)
class CatheterSceneConfig:
    """Options of the scene; instruments go from the innermost to the outermost: coil, guide, catheter."""

    anatomy: str = "reference"  # "reference" (seven outlets, those of SofaGym's phantom) or "random"
    anatomy_seed: Seed = 0  # of the first random anatomy; the next one has the next seed
    anatomies: Count = 1  # random anatomies, of which every episode of a world has one
    outlets: Count = len(OUTLETS)  # of random anatomies
    vessel_radius: Length = RADIUS  # m, of the inlet
    outlet_radius: Length = RADIUS  # m
    grid: Length = 0.002  # m, spacing of the samples of the wall, which is four of them thick
    mu: NotNegative = 0.1  # friction of instruments and wall
    lengths: Sizes = (1.3, 1.3, 1.3)  # [R] m; SofaGym's 0.6, 1.0 and 1.0 do not reach the outlets
    coil_end: Length = 0.060  # m, along its helix
    coil_diameter: Length = 0.007  # m, of the helix
    coil_pitch: Distance = 0.005  # m
    guide_end: Length = 0.020  # m, along its arc
    guide_diameter: Length = 0.025  # m, of the arc
    catheter_end: Length = 0.400  # m, along its arc
    catheter_diameter: Length = 4.0  # m, of the arc
    radii: Sizes = (1.0e-4, 9.0e-4, 1.0e-3)  # m, outer ones; each instrument fills what the next leaves free
    youngs: tuple[Modulus, Modulus, Modulus] = (1.68e8, 1.0e7, 1.0e7)  # Pa, as if they were solid
    nu: RodPoissonRatio = 0.49
    density: tuple[Density, Density, Density] = (21000.0, 1550.0, 1550.0)  # kg/m^3, as if they were solid
    contact_radius: Length = 0.001  # m, of the whole line
    segments: Pieces = 48  # of the line that is out
    rayleigh: Rayleigh = (0.1, 0.02)  # SofaGym's stiffness part is 0.2
    windup: bool = False  # whether instruments twist within each other; SofaGym's do not
    gravity: Gravity = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Refuse impossible values and instruments that do not fit into each other or the vessel."""
        check_options(self)
        name = type(self).__name__
        check_choice(self, "anatomy", ANATOMY_KINDS)
        if self.anatomy == "reference" and self.anatomies != 1:
            raise ValueError(
                f"{name}: there is one reference anatomy, anatomies must be 1, got {self.anatomies!r}; set "
                "anatomy='random'"
            )
        if self.anatomies > MOST_ANATOMIES:
            raise ValueError(f"{name}: anatomies must be at most {MOST_ANATOMIES}, got {self.anatomies!r}")
        if self.outlets > MOST_OUTLETS:
            raise ValueError(f"{name}: outlets must be at most {MOST_OUTLETS}, got {self.outlets!r}")
        if list(self.radii) != sorted(set(self.radii)):
            raise ValueError(f"{name}: radii must rise from the innermost instrument on, got {self.radii!r}")
        for place, key in enumerate(("coil_end", "guide_end", "catheter_end")):
            end, length = getattr(self, key), self.lengths[place]
            if end >= length:
                raise ValueError(f"{name}: {key} must be less than lengths[{place}], {length:g} m, got {end!r}")
        for key in ("vessel_radius", "outlet_radius"):
            radius = getattr(self, key)
            if radius <= 2.0 * max(self.grid, self.contact_radius):
                raise ValueError(
                    f"{name}: {key} must be more than twice grid ({self.grid:g} m) and twice contact_radius "
                    f"({self.contact_radius:g} m), got {radius!r}"
                )

    def anatomy_keys(self) -> tuple[AnatomyKey, ...]:
        """What tells all the anatomies."""
        size = (self.vessel_radius, self.outlet_radius)
        if self.anatomy == "reference":
            return ((None, len(OUTLETS), *size),)
        return tuple((self.anatomy_seed + number, self.outlets, *size) for number in range(self.anatomies))


@functools.lru_cache(maxsize=MOST_ANATOMIES)
def make_anatomy(key: AnatomyKey) -> VesselTree:
    """The anatomy of a key."""
    seed, outlets, radius, outlet_radius = key
    if seed is None:
        return aorta(radius=radius, outlet_radius=outlet_radius)
    return aorta(outlets, seed=seed, radius=radius, outlet_radius=outlet_radius, name=f"anatomy of seed {seed}")


@dataclass(kw_only=True)
class CatheterBeamConfig(CatheterSceneConfig, TubesConfig):
    """Options of the CatheterBeam environment."""

    precision: str = "float64"  # bending of the whole line and of a segment lie too far apart for float32
    max_episode_steps: Count = 120
    end_on_success: bool = True
    insert_step: Sizes = (0.025, 0.025, 0.025)  # [R] m, largest insertion per action; SofaGym's is at most 10 mm
    withdraw_step: Sizes = (0.025, 0.025, 0.025)  # m, a discrete withdrawal
    turn_step: Turns = (0.6, 0.6, 0.6)  # rad, largest turn per action
    first_lengths: Lengths = (0.0, 0.0, 0.001)  # m out of the port at the start
    nested: bool = False  # instruments may overtake each other
    leads: tuple[Distance, Distance] = (0.020, 0.060)  # [R] m, coil and guide reach beyond the next by this; paper: any
    progress_scale: Length = 0.050  # m of way along the vessel worth 1
    reach_bonus: NotNegative = 5.0  # with reward="shaped"
    success_tolerance: Distance = 0.005  # m, how near a tip must come at any time
    outlet: Further | None = None  # always this one; None draws it
    start_turn: HalfAngle = math.pi  # rad, instruments begin to turn to angles up to this, drawn; SofaGym's begin at 0
    observation: str = "compact"  # "compact", "local" (in the frame of the guide's hook) or "paper"
    force_scale: Positive = 1.0  # N worth 1 in an observation

    def __post_init__(self) -> None:
        """Check names and ranges."""
        CatheterSceneConfig.__post_init__(self)
        TubesConfig.__post_init__(self)
        self.check_reach("lengths", self.lengths)
        count = min(len(make_anatomy(key).outlets) for key in self.anatomy_keys())
        if self.outlet is not None and self.outlet >= count:
            raise ValueError(
                f"{type(self).__name__}: outlet must be one of 0 to {count - 1}, or None for any, got {self.outlet!r}"
            )

    @property
    def observation_kinds(self) -> tuple[str, ...]:
        """What ``observation`` may be."""
        return OBSERVATION_KINDS

    @classmethod
    def paper(cls, **options: Any) -> CatheterBeamConfig:
        """SofaGym's instruments, discrete actions, observation and reward; no outlet is in reach of 80 such actions."""
        faithful: dict[str, Any] = {
            "lengths": (0.6, 1.0, 1.0),
            "action_kind": "discrete",
            "insert_step": (0.02 / 3.0, 0.008, 0.010),
            "withdraw_step": (0.007 / 3.0, 0.0028, 0.0035),
            "leads": (1.3, 1.3),
            "turn_step": (2.0 / 9.0, 4.0 / 15.0, 1.0 / 3.0),
            "rayleigh": (0.1, 0.2),
            "start_turn": 0.0,
            "max_episode_steps": 80,
            "observation": "paper",
            "reward": "paper",
            "failure_penalty": 0.0,
        }
        return cls(**(faithful | options))
