"""The trunk robot: a tapered silicone body pulled by eight cables. Scene only; the task is ``tasks/trunk.py``.

Frame: the base stands at z = 0, the unloaded trunk points along +z, and gravity acts along -y, so y is up in pictures.
Four long cables run to the tip, four short ones to 91 mm; cable i and cable i + 4 lie on the same side, in the order
+y, -x, -y, +x. Both pass through point pairs 6 mm apart, the pairs 17.5 mm apart, on lines that taper with the body.

Reference: SofaGym, Trunk scene. ``TrunkConfig.paper`` lists what differs by default.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from softwarp import meshing
from softwarp.advice import nearest
from softwarp.builder import ModelBuilder
from softwarp.envs.options import (
    Angle,
    Distance,
    Gravity,
    LowLimit,
    Mass,
    Modulus,
    Places,
    PoissonRatio,
    Positive,
    Rayleigh,
    Share,
    Unlimited,
    check_choice,
    check_options,
)
from softwarp.meshing.trunk_geometry import CABLE_SIDES
from softwarp.scene.materials import Corotational

LONG_CABLES = 4
SHORT_CABLES = 4
STATIONS = 21  # points of a long cable: one at the base and 20 along the body
SHORT_POINTS = 10
RESOLUTIONS = ("coarse", "medium", "fine")
ROTATIONS = ("large", "polar", "warped")

_AXIS = np.array([0.0, -0.008, 0.195])  # m, from a cable's first pair to where its line would end
_PITCH = 0.0175  # m, between pairs
_RADIUS = 0.010  # m, distance of cables from the axis at the base
_PAIR = (0.021, 0.027)  # m, height of the first pair
_PAIRS = 10
_OUTSIDE = 0.001  # m, how far a cable may run outside a coarse mesh's facets; 0.8 mm on SofaGym's mesh


@dataclass(kw_only=True)
class TrunkSceneConfig:
    """Options of the scene: SofaGym's, but for quarter turns between cables, ``closing_length`` and the guard."""

    mesh: str = "medium"  # "coarse", "medium", "fine", or a mesh file
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

    def __post_init__(self) -> None:
        """Refuse impossible limits."""
        check_options(self)
        check_choice(self, "element", ("p1", "p2"))
        check_choice(self, "rotation", ROTATIONS)
        check_choice(self, "lumping", ("uniform", "volume"))
        for low, high in zip(self.min_displacement, self.max_displacement, strict=True):
            if not -math.inf < low < high < math.inf:
                raise ValueError(f"TrunkConfig: displacement limits must be finite and rising, got {low} and {high}")


@dataclass(frozen=True)
class TrunkScene:
    """Ids of what was added to the builder."""

    body: int
    cables: tuple[int, ...]  # four long, four short
    tip_markers: tuple[int, ...]  # at the ends of the long cables; the tip is their mean


def build_trunk_scene(config: TrunkSceneConfig, builder: ModelBuilder) -> TrunkScene:
    """Add the trunk, its clamp, cables and tip markers to a builder."""
    body = builder.add_tets(
        trunk_mesh(config),
        material=Corotational(config.youngs, config.nu, method=config.rotation, inversion_guard=config.inversion_guard),
        element=cast('Literal["p1", "p2"]', config.element),
        total_mass=config.total_mass,
        lumping=cast('Literal["volume", "uniform"]', config.lumping if config.element == "p1" else "volume"),
        rayleigh=config.rayleigh,
        name="trunk",
    )
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1.0, 1.0, config.fixed_length + 1.0e-9)))
    cables = []
    for i, waypoints in enumerate(cable_waypoints(config.cable_angle)):
        is_short = int(i >= LONG_CABLES)
        cable = builder.add_cable(
            body,
            waypoints,
            control="length",
            min_tension=config.min_tension,
            min_displacement=config.min_displacement[is_short],
            max_displacement=config.max_displacement[is_short],
            max_rate=config.max_rate,
            closing_length=config.closing_length,
            tolerance=_OUTSIDE,
            name=f"{'short' if is_short else 'long'}_{i % LONG_CABLES}",
        )
        cables.append(cable)
    ends = [waypoints[-1] for waypoints in cable_waypoints(config.cable_angle)[:LONG_CABLES]]
    markers = [builder.add_marker(body, end, tolerance=_OUTSIDE, name=f"tip_{i}") for i, end in enumerate(ends)]
    return TrunkScene(body, tuple(cables), tuple(markers))


def cable_waypoints(angle: float = math.pi / 2) -> list[NDArray[np.float64]]:
    """Rest positions [m] of the waypoints: four arrays (21, 3), then four of (10, 3).

    Args:
        angle: Turn about z from one cable to the next [rad].
    """
    direction = _AXIS / np.linalg.norm(_AXIS)
    line = [
        (0.0, _PITCH * j * direction[1] + _RADIUS, _PITCH * j * direction[2] + height)
        for j in range(_PAIRS)
        for height in _PAIR
    ]
    cables = []
    for i, (x, y) in enumerate(CABLE_SIDES):
        cos, sin = math.cos(angle * i), math.sin(angle * i)
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        base = np.array([[_RADIUS * x, _RADIUS * y, 0.0]])
        cables.append(np.concatenate((base, np.array(line) @ turn.T)))
    return cables + [cable[:SHORT_POINTS] for cable in cables]


def trunk_mesh(config: TrunkSceneConfig) -> meshing.TetMesh:
    """The generated mesh of a resolution, or the file that ``config.mesh`` names.

    Raises:
        ValueError: If it is neither; the message lists the resolutions.
        MeshError: If the file holds no usable tetrahedra.
    """
    if config.mesh in RESOLUTIONS:
        return meshing.trunk(config.mesh)
    if not Path(config.mesh).is_file():
        advice = nearest(config.mesh, RESOLUTIONS)
        raise ValueError(f"trunk mesh {config.mesh!r} is neither a file nor one of {', '.join(RESOLUTIONS)}; {advice}")
    from softwarp.io.mesh import read_mesh

    mesh = read_mesh(config.mesh, scale=config.mesh_scale)
    return meshing.TetMesh(mesh.nodes, mesh.tets, name=Path(config.mesh).name)
