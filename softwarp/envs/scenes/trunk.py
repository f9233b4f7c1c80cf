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
from softwarp.envs.options.trunk import ROTATIONS as ROTATIONS
from softwarp.envs.options.trunk import ROUND, TrunkSceneConfig
from softwarp.meshing.trunk_geometry import CABLE_SIDES
from softwarp.scene.materials import Corotational

LONG_CABLES = 4
SHORT_CABLES = 4
STATIONS = 21  # points of a long cable: one at the base and 20 along the body
SHORT_POINTS = 10
RESOLUTIONS = ("coarse", "medium", "fine")

_AXIS = np.array([0.0, -0.008, 0.195])  # m, from a cable's first pair to where its line would end
_PITCH = 0.0175  # m, between pairs
_RADIUS = 0.010  # m, distance of cables from the axis at the base
_PAIR = (0.021, 0.027)  # m, height of the first pair
_PAIRS = 10
_OUTSIDE = 0.00125  # m, how far a cable may run outside a mesh's facets: 0.8 mm on SofaGym's, 1.2 mm on the round one


@dataclass(frozen=True)
class TrunkScene:
    """Ids of what was added to the builder."""

    body: int
    cables: tuple[int, ...]  # four long, four short
    tip_markers: tuple[int, ...]  # at the ends of the long cables; the tip is their mean


def build_trunk_scene(
    config: TrunkSceneConfig, builder: ModelBuilder, touching: meshing.SurfaceMesh | None = None
) -> TrunkScene:
    """Add the trunk, its clamp, cables and tip markers to a builder; it touches with its boundary, or a given skin."""
    body = builder.add_tets(
        trunk_mesh(config),
        material=Corotational(config.youngs, config.nu, method=config.rotation, inversion_guard=config.inversion_guard),
        element=cast('Literal["p1", "p2"]', config.element),
        total_mass=config.total_mass,
        lumping=cast('Literal["volume", "uniform"]', config.lumping if config.element == "p1" else "volume"),
        rayleigh=config.rayleigh,
        contact_surface=touching,
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


def trunk_mesh(config: TrunkSceneConfig) -> meshing.TetMesh | meshing.QuadraticMesh:
    """The generated mesh of a resolution, or the file that ``config.mesh`` names.

    Raises:
        ValueError: If it is neither; the message lists the resolutions.
        MeshError: If the file holds no usable tetrahedra.
    """
    if config.mesh in RESOLUTIONS:
        return meshing.trunk(config.mesh)
    if config.mesh in ROUND:
        return meshing.round_trunk(ROUND[config.mesh])
    if not Path(config.mesh).is_file():
        known = (*RESOLUTIONS, *ROUND)
        advice = nearest(config.mesh, known)
        raise ValueError(f"trunk mesh {config.mesh!r} is neither a file nor one of {', '.join(known)}; {advice}")
    from softwarp.io.mesh import read_mesh

    mesh = read_mesh(config.mesh, scale=config.mesh_scale)
    return meshing.TetMesh(mesh.nodes, mesh.tets, name=Path(config.mesh).name)
