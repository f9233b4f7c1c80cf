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

from softwarp import meshing
from softwarp.advice import nearest
from softwarp.builder import ModelBuilder
from softwarp.envs.options import (
    Gravity,
    HighLimit,
    Length,
    LowLimit,
    Mass,
    Modulus,
    PoissonRatio,
    Positive,
    Rayleigh,
    Unlimited,
    check_choice,
    check_options,
)
from softwarp.meshing.trunk_geometry import CABLE_SIDES
from softwarp.scene.materials import Corotational

CABLES = 4
EFFECTOR = (0.0, 0.0, 0.125)  # m, at rest
BELOW_EFFECTOR = (0.0, 0.0, 0.115)  # m
RESOLUTIONS = ("coarse", "medium", "fine")
ROTATIONS = ("large", "polar", "warped")

_ELBOW = (0.097, 0.045)  # m, distance from the axis and height of the point that a cable pulls
_ANCHOR = (0.010, 0.030)  # m, the same of the fixed end
_OUTSIDE = 0.003  # m, how far these points may lie outside a mesh's facets; 1.5 mm on SofaGym's mesh
_BASE_TOP = 0.010  # m, nothing above this height is held


@dataclass(kw_only=True)
class DiamondSceneConfig:
    """Options of the scene; the defaults are SofaGym's, with cables that only pull, as far as 25 mm."""

    mesh: str = "medium"  # "coarse", "medium", "fine", or a mesh file
    mesh_scale: Positive = 1.0  # metres per unit of a mesh file, which is placed as SofaGym's: base down, axis z
    youngs: Modulus = 180.0e3  # Pa
    nu: PoissonRatio = 0.45
    element: str = "p1"  # "p1" (SOFA's linear tetrahedra, too stiff) or "p2" (quadratic ones between the same nodes)
    rotation: str = "large"  # "large" (SOFA's) or "polar"
    total_mass: Mass = 0.5  # kg
    lumping: str = "uniform"  # "uniform": the same mass on each node, of "p1"; "volume": by the volumes around it
    rayleigh: Rayleigh = (0.0, 0.0)  # 1/s on mass, s on stiffness
    gravity: Gravity = (0.0, 0.0, 0.0)  # m/s^2; SofaGym's scene weighs a thousandth of its weight
    base_half: Length = 0.017  # m, nodes of the base within this of the axis along x and y are held; SofaGym: 0.015
    min_tension: LowLimit = 0.0  # N, cables only pull; -inf makes them rods
    min_displacement: LowLimit = 0.0  # m, how far cables may be let out, negative
    max_displacement: HighLimit = 0.025  # m, how far they may be shortened
    max_rate: Unlimited = 0.1  # m/s, change of a cable's length: 1 mm in 10 ms

    def __post_init__(self) -> None:
        """Refuse impossible limits."""
        check_options(self)
        check_choice(self, "element", ("p1", "p2"))
        check_choice(self, "rotation", ROTATIONS)
        check_choice(self, "lumping", ("uniform", "volume"))
        if not self.min_displacement < self.max_displacement:
            raise ValueError(
                f"DiamondConfig: min_displacement must be below max_displacement, got {self.min_displacement} and "
                f"{self.max_displacement}"
            )


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
        name="diamond",
    )
    half = config.base_half + 1.0e-9
    builder.fix(body, box=((-half, -half, -1.0), (half, half, _BASE_TOP)))
    elbows = [(_ELBOW[0] * x, _ELBOW[0] * y, _ELBOW[1]) for x, y in CABLE_SIDES]
    cables = tuple(
        builder.add_cable(
            body,
            [elbow],
            (_ANCHOR[0] * x, _ANCHOR[0] * y, _ANCHOR[1]),
            control="length",
            min_tension=config.min_tension,
            min_displacement=config.min_displacement,
            max_displacement=config.max_displacement,
            max_rate=config.max_rate,
            tolerance=_OUTSIDE,
            name=f"cable_{name}",
        )
        for elbow, (x, y), name in zip(elbows, CABLE_SIDES, ("north", "west", "south", "east"), strict=True)
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
