"""Telescopes: tubes, catheters and wires one in the other, each inserted and turned at its base.

Theory: docs/theory/telescope.md.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks, meshing
from softwarp.model.handles import Telescope
from softwarp.scene.checks import as_pose, factors
from softwarp.scene.composite import TubeTable, composite_curve, tube_table
from softwarp.scene.parts import RodSpec, Scene, TelescopeSpec

FloatArray = NDArray[np.float64]
MOST_TUBES = 4
MOST_SEGMENTS = 1000
FLYWHEEL = 1.0e5  # m^2, inertia about the line per mass, at most: nodes turn about it with their carrier, not by a step
WHEEL_TIME = 2.3  # s, in which bending would turn it: with more its rounding in float32 outweighs bending
FLOOR = 1.0e-3  # of the longest tube: the shortest length at which a telescope is shown


@dataclass(frozen=True)
class TubeSection:
    """Part of a tube with one stress-free curvature.

    Args:
        length: Length [m].
        curvature: Stress-free bending about the material axes d1 and d2, and twist [1/m].
        youngs: Young's modulus [Pa]; None takes that of the tube.
    """

    length: float
    curvature: tuple[float, float, float] = (0.0, 0.0, 0.0)
    youngs: float | None = None

    def __post_init__(self) -> None:
        """Refuse impossible values."""
        checks.number(self.length, "tube section: length [m]", above=0.0, high=checks.FARTHEST)
        checks.array(self.curvature, "tube section: curvature [1/m]", (3,))
        if self.youngs is not None:
            checks.number(self.youngs, "tube section: youngs [Pa]", above=0.0)

    @classmethod
    def arc(cls, length: float, radius: float, direction: float = 0.0, youngs: float | None = None) -> TubeSection:
        """Planar arc.

        Args:
            length: Along the arc [m].
            radius: Of its centre line [m].
            direction: Angle [rad] from d1 towards d2 of the direction that it bends towards.
            youngs: Young's modulus [Pa]; None takes that of the tube.
        """
        return cls.helix(length, radius, 0.0, direction, youngs)

    @classmethod
    def helix(
        cls, length: float, radius: float, pitch: float, direction: float = 0.0, youngs: float | None = None
    ) -> TubeSection:
        """Helix: curvature r / (r^2 + c^2) and torsion c / (r^2 + c^2) with c = pitch / 2 pi.

        Args:
            length: Along the helix [m].
            radius: Of the helix [m].
            pitch: Rise per turn [m]; negative for a left-handed one.
            direction: Angle [rad] from d1 towards d2 of the direction from its first point to its axis.
            youngs: Young's modulus [Pa]; None takes that of the tube.
        """
        r = checks.number(radius, "tube section: radius [m]", above=0.0, high=checks.FARTHEST)
        c = checks.number(pitch, "tube section: pitch [m]", low=-checks.FARTHEST, high=checks.FARTHEST) / math.tau
        angle = checks.number(direction, "tube section: direction [rad]", low=-1e3, high=1e3)
        kappa, square = r / (r * r + c * c), r * r + c * c
        return cls(length, (-kappa * math.sin(angle), kappa * math.cos(angle), c / square), youngs)


@dataclass(frozen=True)
class Tube:
    """One tube, catheter or wire of a telescope, from its base to its tip.

    Args:
        sections: Its parts from base to tip.
        radius: Outer radius [m].
        inner_radius: Inner radius [m]; 0 for a wire.
        youngs: Young's modulus [Pa].
        nu: Poisson's ratio.
        density: Density [kg/m^3].
        max_speed: Largest speed of insertion [m/s].
        max_spin: Largest angular speed at the base [rad/s].
    """

    sections: Sequence[TubeSection]
    radius: float
    inner_radius: float = 0.0
    youngs: float = 50.0e9
    nu: float = 0.3
    density: float = 6450.0
    max_speed: float = field(default=math.inf)
    max_spin: float = field(default=math.inf)

    def __post_init__(self) -> None:
        """Refuse impossible values."""
        sections = tuple(self.sections) if isinstance(self.sections, Iterable) else ()
        if not sections or not all(isinstance(part, TubeSection) for part in sections):
            raise ValueError(checks.refusal("tube: sections", "be one or more TubeSection", self.sections))
        object.__setattr__(self, "sections", sections)
        outer = checks.number(self.radius, "tube: radius [m]", above=0.0, high=checks.FARTHEST)
        checks.number(self.inner_radius, "tube: inner_radius [m]", low=0.0, below=outer)
        checks.number(self.youngs, "tube: youngs [Pa]", above=0.0)
        checks.number(self.nu, "tube: nu", above=-1.0, high=0.5)
        checks.number(self.density, "tube: density [kg/m^3]", above=0.0)
        checks.number(self.max_speed, "tube: max_speed [m/s]", low=0.0, infinite=True)
        checks.number(self.max_spin, "tube: max_spin [rad/s]", low=0.0, infinite=True)

    @property
    def length(self) -> float:
        """Length [m]."""
        return float(sum(part.length for part in self.sections))


def add_telescope(
    scene: Scene,
    tubes: Sequence[Tube],
    *,
    port: ArrayLike,
    segments: int,
    lengths: ArrayLike | None,
    angles: ArrayLike,
    windup: bool,
    rayleigh: tuple[float, float],
    contact_radius: float | None,
    name: str | None,
) -> Telescope:
    """Add tubes that share a centre line where they overlap."""
    label = scene.new_name(name, f"telescope{len(scene.rods)}")
    what = f"telescope {label!r}"
    given = tuple(tubes) if isinstance(tubes, Iterable) else ()
    if not 1 <= len(given) <= MOST_TUBES or not all(isinstance(tube, Tube) for tube in given):
        raise ValueError(checks.refusal(f"{what}: tubes", f"be 1 to {MOST_TUBES} Tube, innermost first", tubes))
    for number, (inside, outside) in enumerate(itertools.pairwise(given)):
        if outside.inner_radius < inside.radius:
            raise ValueError(
                f"{what}: tube {number + 1} has an inner radius of {outside.inner_radius:g} m, in which tube {number} "
                f"with a radius of {inside.radius:g} m does not fit; give tubes from the innermost to the outermost"
            )
    count = checks.count(segments, f"{what}: segments", high=MOST_SEGMENTS)
    where = as_pose(port, f"{what}: port")
    damping = factors(rayleigh, f"{what}: rayleigh")
    total = np.array([tube.length for tube in given])
    floor = FLOOR * float(total.max())
    start = np.zeros(len(given)) if lengths is None else checks.array(lengths, f"{what}: lengths [m]", (len(given),))
    wrong = np.flatnonzero((start < 0.0) | (start > total))
    if wrong.size:
        raise ValueError(
            f"{what}: tube {wrong[0]} starts with {start[wrong[0]]:g} m deployed; a length from 0 to "
            f"{total[wrong[0]]:g} m is possible"
        )
    turn = np.broadcast_to(checks.array(angles, f"{what}: angles [rad]", (), (len(given),)), (len(given),)).copy()
    radius = max(tube.radius for tube in given)
    if contact_radius is not None:
        radius = checks.number(contact_radius, f"{what}: contact_radius [m]", above=0.0, high=checks.FARTHEST)
    spec = TelescopeSpec(
        table=_table(given),
        port=where,
        lengths=np.asarray(start, dtype=np.float64),
        angles=turn,
        floor=floor,
        windup=checks.flag(windup, f"{what}: windup"),
        max_speed=np.array([tube.max_speed for tube in given]),
        max_spin=np.array([tube.max_spin for tube in given]),
    )
    positions, quaternions = composite_curve(spec.table, where, spec.lengths, turn, count, floor)
    stiffest = given[int(np.argmax([tube.youngs * tube.radius**4 for tube in given]))]
    shown = max(float(start.max()), floor)
    straight = meshing.rod_geometry(
        meshing.straight(shown, count), radius=radius, inner_radius=0.0, nu=float(stiffest.nu), normal=(1.0, 0.0, 0.0)
    )
    across, along = 0.25 * radius**2 + (shown / count) ** 2 / 12.0, _flywheel(given, float(total.max()) / count)
    changed = {"positions": positions, "quaternions": quaternions, "node_volume": np.ones(count + 1)}
    changed["node_inertia"] = np.tile([across, across, along], (count + 1, 1))
    geometry = meshing.RodGeometry(**(vars(straight) | changed))
    clamped = np.zeros(count + 1, dtype=bool)
    clamped[0] = True
    scene.rods.append(
        RodSpec(
            name=label,
            geometry=geometry,
            youngs=float(stiffest.youngs),
            nu=float(stiffest.nu),
            density=float(stiffest.density),
            rayleigh=damping,
            scale=np.ones(count),
            clamped=clamped,
            contact_pieces=1,
            telescope=spec,
        )
    )
    return Telescope(len(scene.rods) - 1)


def _flywheel(tubes: Sequence[Tube], segment: float) -> float:
    """Inertia of nodes about the line per mass [m^2].

    In the axes of the world it stands beside what a step of h adds for bending, h^2 E I / l with the longest segment l,
    and single precision keeps 1e-7 of it: with 1e5 m^2 the matrix of a catheter of 1.3 m was indefinite.
    """
    bending = sum(tube.youngs * (tube.radius**4 - tube.inner_radius**4) / 4.0 for tube in tubes)
    mass = sum(tube.density * (tube.radius**2 - tube.inner_radius**2) for tube in tubes)
    return min(FLYWHEEL, WHEEL_TIME**2 * bending / (mass * segment**2))


def _table(tubes: Sequence[Tube]) -> TubeTable:
    """Numbers of all tubes."""
    return tube_table(
        [[(part.length, part.curvature, part.youngs) for part in tube.sections] for tube in tubes],
        radius=[tube.radius for tube in tubes],
        inner_radius=[tube.inner_radius for tube in tubes],
        youngs=[tube.youngs for tube in tubes],
        nu=[tube.nu for tube in tubes],
        density=[tube.density for tube in tubes],
    )
