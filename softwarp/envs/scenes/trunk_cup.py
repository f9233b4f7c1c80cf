"""The trunk and a soft cup, wrapped in each other or apart. Scene only; the task is ``tasks/trunk_cup.py``.

Frame: that of ``scenes/trunk.py``, gravity along -y. The cup stands on the place that SofaGym gives it, its axis along
+y, beside the straight trunk. Both touch with closed skins coarser than their meshes: few contacts, whatever those are.
The trunk's bridges its grooves. With ``start="open"`` the cup stands lower and a little farther off, on a table, and
trunk and cup are under gravity.

``Grasp`` is the wrapped state, which assets/trunk_cup/grasp.py makes on the coarse meshes; other meshes are carried
into it by the tetrahedra of these.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from importlib import resources

import numpy as np
import torch
from numpy.typing import NDArray

from softwarp import meshing, shapes
from softwarp.builder import ModelBuilder
from softwarp.envs.options.trunk_cup import TrunkCupSceneConfig
from softwarp.envs.scenes.trunk import TrunkScene, build_trunk_scene
from softwarp.meshing.cup_geometry import BOTTOM_RADIUS, HEIGHT, RIM_RADIUS
from softwarp.model.handles import RigidBody
from softwarp.scene.materials import Corotational
from softwarp.simulation import Simulation

FloatArray = NDArray[np.float64]

CUP_PLACE = (0.042, -0.050, 0.040)  # m, middle of the bottom
OPEN_X = 0.0485  # m, x of a cup on the table, which there clears the straight trunk wherever jitter puts it
CUP_MIDDLE = (0.042, -0.050 + 0.5 * HEIGHT, 0.040)  # m, of the standing cup
FACING_UP = (-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))  # turns a plane's normal from z to y
GRASP_MESH = "coarse"  # of trunk and cup in the file
_OFF = 0.006  # m, how far nodes of other meshes may lie outside those of the file


@dataclass(frozen=True)
class TrunkCupScene:
    """Ids of what was added to the builder."""

    trunk: TrunkScene
    cup: int
    bottom_markers: tuple[int, ...]  # on the edge of the bottom, a quarter turn apart
    rim_markers: tuple[int, ...]  # on the rim; the mean of all eight is the cup's position
    hold: int  # contact pair of trunk and cup
    table: RigidBody | None  # that the cup stands on; None where the trunk holds it


@dataclass(frozen=True)
class Grasp:
    """A wrapped state of the coarse meshes."""

    trunk_x: FloatArray  # (node, 3) [m]
    cup_x: FloatArray  # (node, 3) [m]
    command: FloatArray  # (8,) displacements of the cables [m]


def build_trunk_cup_scene(config: TrunkCupSceneConfig, builder: ModelBuilder) -> TrunkCupScene:
    """Add the straight trunk and the standing cup, its markers, and the contact between them to a builder.

    With ``start="open"`` the cup stands on a table, which the trunk touches as well.
    """
    is_open = config.start == "open"
    place = CUP_PLACE
    if is_open:
        place = (OPEN_X, config.table_height + config.contact_distance, CUP_PLACE[2])
    trunk = build_trunk_scene(config, builder, meshing.trunk_skin(config.skin_corners))
    made = meshing.cup(config.cup_mesh)
    cup = builder.add_tets(
        meshing.TetMesh(standing(made.mesh.nodes, place), made.mesh.tets, made.mesh.name),
        material=Corotational(config.cup_youngs, config.cup_nu, method=config.rotation),
        total_mass=config.cup_mass,
        rayleigh=config.cup_rayleigh,
        contact_surface=meshing.SurfaceMesh(standing(made.skin.nodes, place), made.skin.triangles, made.skin.name),
        name="cup",
    )

    def touch(a: int, b: int, mu: float) -> int:
        near, alarm = config.contact_distance, config.alarm_distance
        return builder.add_contact(a, b, mu, contact_distance=near, alarm_distance=alarm)

    hold, table = touch(trunk.body, cup, config.mu), None
    if is_open:
        table = builder.add_rigid(
            shapes.Plane(), kinematic=True, pose=(0.0, config.table_height, 0.0, *FACING_UP), name="table"
        )
        for part in (cup, trunk.body):
            touch(part, table, config.table_mu)

    def markers(radius: float, height: float, name: str) -> tuple[int, ...]:
        sides = radius * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
        points = standing(np.column_stack([sides, np.full(len(sides), height)]), place)
        return tuple(builder.add_marker(cup, p, tolerance=1.0e-6, name=f"{name}_{i}") for i, p in enumerate(points))

    bottom, rim = markers(BOTTOM_RADIUS, 0.0, "bottom"), markers(RIM_RADIUS, HEIGHT, "rim")
    return TrunkCupScene(trunk, cup, bottom, rim, hold, table)


def standing(points: FloatArray, place: tuple[float, float, float] = CUP_PLACE) -> FloatArray:
    """Points of the cup's mesh, axis along +z, where the scene has them, axis along +y [m], shape (point, 3)."""
    x, y, z = points.T
    return np.stack([x, z, -y], axis=1) + place


@functools.cache
def wrapped() -> Grasp:
    """The grasp that episodes start in; made by assets/trunk_cup/grasp.py."""
    with resources.files("softwarp.envs").joinpath("trunk_cup_grasp.npz").open("rb") as file:
        held = np.load(file)
        return Grasp(*(np.asarray(held[name], dtype=np.float64) for name in ("trunk_x", "cup_x", "command")))


def place_grasp(sim: Simulation, scene: TrunkCupScene, grasp: Grasp) -> None:
    """Put trunk and cup of every world into a grasp, at rest, under its commands; ``reset`` returns there."""
    known = (meshing.trunk(GRASP_MESH), meshing.cup(GRASP_MESH).mesh)
    rest = (known[0], meshing.TetMesh(standing(known[1].nodes), known[1].tets, known[1].name))
    split = int(sim.model.body_node_start[scene.cup])
    moved = [
        carried(nodes, mesh, x)
        for nodes, mesh, x in zip(
            np.split(sim.model.node_rest, [split]), rest, (grasp.trunk_x, grasp.cup_x), strict=True
        )
    ]
    x = torch.from_numpy(np.concatenate(moved)).to(sim.node_x)
    for view in (sim.node_x, sim.good_x):
        view.copy_(x)
    sim.control.cable_displacement.copy_(torch.from_numpy(grasp.command).to(sim.node_x))
    sim.refresh()
    sim.set_initial()


def carried(nodes: FloatArray, mesh: meshing.TetMesh, x: FloatArray) -> FloatArray:
    """Where nodes come [m] that tetrahedra carry whose own nodes come to ``x``, shape (node, 3)."""
    tet, weight = meshing.embed(mesh.nodes, mesh.tets, nodes, name="grasp", snap=_OFF)
    return np.asarray(np.einsum("nk,nkx->nx", weight, x[mesh.tets[tet]]))
