"""The diamond robot: a hollow silicone body whose four elbows are pulled inwards by cables. Scene only.

The task is ``tasks/diamond.py``. The base stands on the axis with its lower face at z = -37 mm, the legs reach out to
97 mm at z = 45 mm, and the top is at z = 126 mm. Cable i runs from an anchor in space, 10 mm from the axis at
z = 30 mm, to the elbow on its side, in the order +y (north), -x (west), -y (south), +x (east). Pulling all four pushes
the top up; pulling one moves it away from that side.

Reference: SofaGym, Diamond scene. ``DiamondConfig.paper`` lists what differs by default.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np

from softwarp import meshing
from softwarp.advice import nearest
from softwarp.builder import ModelBuilder
from softwarp.envs.options.diamond import CABLES as CABLES
from softwarp.envs.options.diamond import ROTATIONS as ROTATIONS
from softwarp.envs.options.diamond import DiamondSceneConfig
from softwarp.meshing.diamond_geometry import coarse_stiffness, elbow_patch
from softwarp.meshing.trunk_geometry import CABLE_SIDES
from softwarp.scene.materials import Corotational

EFFECTOR = (0.0, 0.0, 0.125)  # m, at rest
BELOW_EFFECTOR = (0.0, 0.0, 0.115)  # m
RESOLUTIONS = ("coarse", "medium", "fine")

_ELBOW = (0.097, 0.045)  # m, distance from the axis and height of the point that a cable pulls
_ANCHOR = (0.010, 0.030)  # m, the same of the fixed end
_OUTSIDE = 0.003  # m, how far these points may lie outside a mesh's facets; 1.5 mm on SofaGym's mesh
_BASE_TOP = 0.010  # m, nothing above this height is held


@dataclass(frozen=True)
class DiamondScene:
    """Ids of what was added to the builder."""

    body: int
    cables: tuple[int, ...]  # north, west, south, east
    effector: int  # marker at the top
    markers: tuple[int, ...]  # effector, then the four elbows, then a point 10 mm below the effector


def build_diamond_scene(config: DiamondSceneConfig, builder: ModelBuilder) -> DiamondScene:
    """Add the body, its clamped base, cables and markers to a builder."""
    body = builder.add_tets(
        diamond_mesh(config),
        material=Corotational(config.youngs, config.nu, method=config.rotation),
        element=cast('Literal["p1", "p2"]', config.element),
        total_mass=config.total_mass,
        lumping=cast('Literal["volume", "uniform"]', config.lumping if config.element == "p1" else "volume"),
        rayleigh=config.rayleigh,
        stiffness=coarse_stiffness() if config.coarsened else None,
        name="diamond",
    )
    half = config.base_half + 1.0e-9
    builder.fix(body, box=((-half, -half, -1.0), (half, half, _BASE_TOP)))
    elbows = [(_ELBOW[0] * x, _ELBOW[0] * y, _ELBOW[1]) for x, y in CABLE_SIDES]
    nodes, are_spread = builder.bodies[body].mesh.nodes, config.cable_ends == "patches"
    patches = [elbow_patch(nodes, side) for side in CABLE_SIDES] if are_spread else []
    ends = [shares @ nodes[chosen] for chosen, shares in patches] if are_spread else np.array(elbows)
    cables = tuple(
        builder.add_cable(
            body,
            ends[i : i + 1],
            (_ANCHOR[0] * x, _ANCHOR[0] * y, _ANCHOR[1]),
            control="length",
            min_tension=config.min_tension,
            min_displacement=config.min_displacement,
            max_displacement=config.max_displacement,
            max_rate=config.max_rate,
            patches={0: patches[i]} if are_spread else None,
            tolerance=_OUTSIDE,
            name=f"cable_{name}",
        )
        for i, ((x, y), name) in enumerate(zip(CABLE_SIDES, ("north", "west", "south", "east"), strict=True))
    )
    points = [("effector", EFFECTOR), *((f"elbow_{i}", elbow) for i, elbow in enumerate(elbows))]
    points.append(("below_effector", BELOW_EFFECTOR))
    markers = tuple(builder.add_marker(body, point, tolerance=_OUTSIDE, name=name) for name, point in points)
    return DiamondScene(body, cables, markers[0], markers)


def diamond_mesh(config: DiamondSceneConfig) -> meshing.TetMesh:
    """The generated mesh of a resolution, or the file that ``config.mesh`` names.

    Raises:
        ValueError: If it is neither; the message lists the resolutions.
        MeshError: If the file holds no usable tetrahedra.
    """
    if config.mesh in RESOLUTIONS:
        return meshing.diamond(config.mesh)
    if not Path(config.mesh).is_file():
        advice = nearest(config.mesh, RESOLUTIONS)
        raise ValueError(
            f"diamond mesh {config.mesh!r} is neither a file nor one of {', '.join(RESOLUTIONS)}; {advice}"
        )
    from softwarp.io.mesh import read_mesh

    mesh = read_mesh(config.mesh, scale=config.mesh_scale)
    return meshing.TetMesh(mesh.nodes, mesh.tets, name=Path(config.mesh).name)
