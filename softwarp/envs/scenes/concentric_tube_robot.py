"""Three concentric tubes in a nasal passage. Scene only; task: ``tasks/concentric_tube_robot.py``.

Frame: the nostril is the origin, where the tubes come out of a clamped port along +z; at angle 0 their curved ends bend
towards +y, where the passage leads: its other end, the choana, lies at (0, 58, 66) mm.

Reference: SofaGym, scene of ConcentricTubeRobot. ``ConcentricTubeRobotConfig.paper`` lists what differs by default.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from softwarp import meshing
from softwarp.builder import ModelBuilder
from softwarp.envs.options.concentric_tube_robot import ConcentricTubeSceneConfig
from softwarp.envs.tube_line import TubeLine
from softwarp.envs.tube_torsion import TwistedLine
from softwarp.meshing.rods import round_section
from softwarp.model.handles import RigidBody, Telescope
from softwarp.scene.telescopes import Tube, TubeSection
from softwarp.shapes import Vessel

Three = tuple[float, float, float]
CONTACT_CAPACITY = 24  # per world
RIGID_NU = -0.95  # of tubes that are all but rigid in torsion: G J is 50 E I, and bending does not know nu
AROUND = 24  # points of a section of the passage
VIEWED_FROM = (1.0, -0.15, 0.35)  # direction to the eye: from the side, so that the passage lies in the picture


@dataclass(frozen=True)
class ConcentricTubeScene:
    """Ids of what was added to the builder, and the wall."""

    tubes: Telescope
    wall: RigidBody
    vessel: Vessel


def build_concentric_tubes(config: ConcentricTubeSceneConfig, builder: ModelBuilder) -> ConcentricTubeScene:
    """Add tubes and wall to a builder."""
    vessel = vessel_of(config)
    wall = builder.add_rigid(vessel.cut_open(VIEWED_FROM), kinematic=True, name="passage")
    tubes = builder.add_telescope(
        [tube_of(config, number) for number in range(len(config.straight))],
        segments=config.segments,
        lengths=getattr(config, "first_lengths", None),
        windup=config.windup,
        rayleigh=config.rayleigh,
        contact_radius=config.contact_radius,
        name="tubes",
    )
    builder.add_contact(tubes, wall, mu=config.mu)
    return ConcentricTubeScene(tubes, wall, vessel)


def tube_of(config: ConcentricTubeSceneConfig, number: int) -> Tube:
    """One of the tubes, 0 the innermost."""
    curve = TubeSection.arc(
        config.curved[number], config.curve_radius[number], 0.5 * math.pi, youngs=config.curved_youngs[number]
    )
    return Tube(
        [TubeSection(config.straight[number]), curve],
        radius=config.radius[number],
        inner_radius=config.inner_radius[number],
        youngs=config.youngs[number],
        nu=config.nu if config.windup else RIGID_NU,
        density=config.density,
    )


def line_of(config: ConcentricTubeSceneConfig) -> TubeLine:
    """The closed form of the line that the tubes take without loads."""
    parts = (config.curved, config.curve_radius, config.radius, config.inner_radius, config.youngs)
    return _line(*parts, config.curved_youngs, config.nu)


def twisted_line_of(config: ConcentricTubeSceneConfig) -> TwistedLine:
    """The line that they take where they twist each other, as those of the scene do."""
    whole = torch.tensor([a + b for a, b in zip(config.straight, config.curved, strict=True)], dtype=torch.float64)
    nu = config.nu if config.windup else RIGID_NU
    return TwistedLine(line_of(config), 1.0 / (1.0 + nu), whole if config.windup else None)


@functools.lru_cache(maxsize=16)
def _line(curved: Three, bend: Three, radius: Three, inner: Three, youngs: Three, ends: Three, nu: float) -> TubeLine:
    """The line of these tubes, the same object for the same numbers."""
    inertia = torch.as_tensor(round_section(np.array(radius), np.array(inner), nu)[:, 2])
    parts = (torch.tensor(part, dtype=torch.float64) for part in (curved, bend, youngs, ends))
    length, curve, straight, end = parts
    return TubeLine(length, 1.0 / curve, straight * inertia, end * inertia)


def vessel_of(config: ConcentricTubeSceneConfig) -> Vessel:
    """The wall: of the generated passage, or of the surface in a file, made once in a process.

    Raises:
        ValueError: If ``config.vessel`` is neither "passage" nor a file.
        MeshError: If the file holds no surface that encloses a lumen.
    """
    return _vessel(config.vessel, config.vessel_scale, config.anatomy, config.variation, config.spacing, config.wall)


@functools.lru_cache(maxsize=16)
def _vessel(name: str, scale: float, seed: int | None, variation: float, spacing: float, wall: float) -> Vessel:
    if name == "passage":
        surface = meshing.nasal_passage(seed, scale=scale, variation=variation).surface(AROUND)
        return Vessel.from_mesh(surface.nodes, surface.triangles, spacing, wall=wall, name=surface.name)
    if not Path(name).is_file():
        raise ValueError(f"vessel {name!r} is neither 'passage' nor a file of a surface mesh")
    from softwarp.io.mesh import read_mesh

    mesh = read_mesh(name, scale=scale)
    if not isinstance(mesh, meshing.SurfaceMesh):
        raise meshing.MeshError(f"vessel {name!r} holds no surface of triangles; export the wall of the lumen as one")
    return Vessel.from_mesh(mesh.nodes, mesh.triangles, spacing, wall=wall, name=Path(name).name)
