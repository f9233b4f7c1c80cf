"""Robots of ``softwarp bench fidelity``: their variants, what is taken for truth, how they are loaded and driven.

A robot's own way of being moved tells little about elements: where a cable pulls at a point, the solid gives way the
more the finer its mesh is, and a commanded length counts that in. So solids are held where the robot's are, and bent by
their weight along several directions, many times theirs where they are stiff; a pad is inflated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import softwarp
from softwarp import meshing
from softwarp.envs.options.catch_the_object import CatchSceneConfig
from softwarp.envs.options.diamond import DiamondSceneConfig
from softwarp.envs.options.gripper import GripperSceneConfig
from softwarp.envs.options.tripod import TripodSceneConfig
from softwarp.envs.options.trunk import TrunkSceneConfig
from softwarp.envs.scenes.catch_the_object import add_pad, build_catch_scene
from softwarp.envs.scenes.diamond import EFFECTOR, build_diamond_scene, diamond_mesh
from softwarp.envs.scenes.gripper import build_gripper_scene
from softwarp.envs.scenes.tripod import HEIGHT, SERVOS, build_tripod_scene, tripod_mesh, tripod_walls, turn
from softwarp.envs.scenes.trunk import build_trunk_scene, trunk_mesh
from softwarp.meshing.diamond_geometry import coarse_stiffness
from softwarp.meshing.finger_geometry import FLANGE
from softwarp.meshing.finger_geometry import TIP as FINGER_TIP
from softwarp.meshing.tripod_geometry import HELD, HOLE_RADIUS
from softwarp.meshing.trunk_geometry import LENGTH

from . import trunk

Floats = NDArray[np.float64]
Options = Mapping[str, Any]
WARPED = {"rotation": "warped"}
SOLID = WARPED | {"element": "p2"}
DIAMOND_LOADS = ((0.0, 0.0, -5.0), (0.0, 0.0, 10.0), (5.0, 0.0, 0.0), (2.5, 2.5, -2.5))  # m/s^2
# m, of the top under these: limits that ``fidelity_truth`` finds
DIAMOND_WAYS = 1e-3 * np.array([[0.0, 0.0, -32.51], [0.0, 0.0, 27.70], [32.21, 0.0, -1.55], [16.92, 16.92, -13.14]])
TRIPOD_LOADS = ((0.0, 0.0, -20.0), (0.0, 0.0, 20.0), (20.0, 0.0, -20.0))  # m/s^2
# m, of the hole's rim under these: limits that ``fidelity_tripod`` finds
TRIPOD_WAYS = 1e-3 * np.array([[0.0, -0.13, -4.86], [0.0, 0.25, 4.82], [0.26, -0.13, -4.86]])
FINGER_END = (FINGER_TIP[0][1], FINGER_TIP[0][0], 0.0)  # m, the middle of the end of its back
FINGER_LOADS = ((0.0, -0.6, 0.0), (0.0, 0.0, 0.6), (0.6, 0.0, 0.0), (0.3, -0.3, 0.18))  # m/s^2, small ones
# m, of that point under these: limits that ``assets/gripper/coarsen.py truth`` finds
FINGER_WAYS = 1e-4 * np.array([[0.160, -2.847, 0.0], [0.0, 0.0, 2.574], [-0.004, 0.3066, 0.0], [0.078, -1.270, 0.772]])


@dataclass(frozen=True)
class Robot:
    """What ``softwarp bench fidelity`` needs of one.

    Attributes:
        scene: Adds the robot's whole scene to a builder, from options.
        rest: Places of the point that is looked at, one for every load, and where it is without, from options.
        truth: Options of the finest affordable quadratic mesh, or ways of the point that were extrapolated from several
            [m], (load, 3).
        variants: Options by name; the first is the default.
        gravity: Of the scene [m/s^2].
        drive: Commands of a step.
    """

    scene: Callable[[Options, softwarp.ModelBuilder], Any]
    rest: Callable[[Options], tuple[Floats, Floats]]
    truth: Options | Floats
    variants: Mapping[str, Options]
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    drive: Callable[[softwarp.Simulation, int], None] = field(default=lambda sim, step: None)


def weighed(
    mesh: Any,
    config: Any,
    mass: float,
    held: Callable[[Floats], NDArray[np.bool_]],
    point: Sequence[float] | Floats,
    gravity: Sequence[Sequence[float]],
    stiffness: Floats | None = None,
    *,
    thin: bool = True,
) -> tuple[Floats, Floats]:
    """Where a point of a solid rests under gravity [m/s^2], in float64, (case, 3), and where it is without.

    Args:
        mesh: Nodes and linear elements, or hexahedra of walls.
        config: Has ``youngs``, ``nu``, ``rotation`` and ``element``, perhaps ``lumping``.
        mass: Of the solid [kg].
        held: Which of places (node, 3) are held.
        point: What is looked at [m].
        gravity: One a case.
        stiffness: Factors of the modulus.
        thin: Whether hexahedra have the modes of walls.
    """
    builder = softwarp.ModelBuilder()
    law = softwarp.Corotational(config.youngs, config.nu, method=config.rotation)
    given: dict[str, Any] = {"material": law, "total_mass": mass, "stiffness": stiffness}
    if isinstance(mesh, meshing.HexMesh):
        body = builder.add_hexes(mesh, thin=thin, **given)
    else:
        lumping = getattr(config, "lumping", "volume") if config.element == "p1" else "volume"
        body = builder.add_tets(mesh, element=config.element, lumping=lumping, **given)
    builder.fix(body, nodes=np.flatnonzero(held(builder.bodies[body].mesh.nodes)))
    builder.add_marker(body, tuple(point), tolerance=0.006)
    sim = softwarp.Simulation(builder.finalize(len(gravity), "cpu", "float64"))
    sim.params.gravity.copy_(torch.tensor(gravity))
    start = sim.marker_x[0, 0].numpy().copy()
    if not sim.solve_static().converged.all():
        raise RuntimeError(f"{type(config).__name__}: a load has no equilibrium")
    return sim.marker_x[:, 0].numpy(), start


def _trunk(options: Options) -> tuple[Floats, Floats]:
    config = TrunkSceneConfig(**options)
    gravity = ((0.0, -9.81, 0.0), (0.0, -2.0, 0.0), (0.0, 5.0, 5.0), (5.0, -5.0, 7.0), (-7.0, 0.0, 5.0))
    limit = config.fixed_length + 1.0e-9
    held = lambda x: x[:, 2] <= limit  # noqa: E731
    return weighed(trunk_mesh(config), config, config.total_mass, held, (0.0, 0.0, LENGTH), gravity)


def _diamond(options: Options) -> tuple[Floats, Floats]:
    config = DiamondSceneConfig(**options)
    limit = config.base_half + 1.0e-9

    def held(x: Floats) -> NDArray[np.bool_]:
        return (np.abs(x[:, 0]) <= limit) & (np.abs(x[:, 1]) <= limit) & (x[:, 2] <= 0.01)

    stiffness = coarse_stiffness() if config.coarsened else None
    return weighed(diamond_mesh(config), config, config.total_mass, held, EFFECTOR, DIAMOND_LOADS, stiffness)


def hang_tripod(mesh: Any, config: TripodSceneConfig, loads: Sequence[Sequence[float]]) -> tuple[Floats, Floats]:
    """A point of the hole's rim, as ``weighed``; every mesh is held from the same line on, whatever nodes it has."""

    def held(x: Floats) -> NDArray[np.bool_]:
        along = [(x @ turn(servo))[:, 1] for servo in range(SERVOS)]
        return np.asarray(np.max(along, axis=0) > HELD - 1.0e-6)

    return weighed(mesh, config, config.total_mass, held, (0.0, HOLE_RADIUS, HEIGHT), loads)


def _tripod(options: Options) -> tuple[Floats, Floats]:
    config = TripodSceneConfig(**options)
    mesh = tripod_walls() if config.element == "walls" else tripod_mesh(config)
    return hang_tripod(mesh, config, TRIPOD_LOADS)


def _finger(options: Options) -> tuple[Floats, Floats]:
    config = GripperSceneConfig(**options)
    held = lambda x: x[:, 0] <= FLANGE[1] + 1.0e-6  # noqa: E731
    if config.element == "bricks":
        made = meshing.finger_bricks()
        return weighed(
            made.mesh, config, config.finger_mass, held, FINGER_END, FINGER_LOADS, made.stiffness, thin=False
        )
    mesh = meshing.finger(config.mesh, config.finger).mesh
    return weighed(mesh, config, config.finger_mass, held, FINGER_END, FINGER_LOADS)


def _pad(options: Options) -> tuple[Floats, Floats]:
    """The middle of a pad's front, under three pressures."""
    builder = softwarp.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    pad, chamber = add_pad(CatchSceneConfig(**options), builder, 1.0, "right")
    nodes = builder.bodies[pad].mesh.nodes
    front = nodes[nodes[:, 0] < nodes[:, 0].min() + 1.0e-6].mean(axis=0)
    builder.add_marker(pad, tuple(front), tolerance=0.006)
    sim = softwarp.Simulation(builder.finalize(3, "cpu", "float64"))
    start = sim.marker_x[0, 0].numpy().copy()
    sim.control.cavity_pressure[:, chamber] = torch.tensor([1.0e4, 3.0e4, 6.0e4], dtype=torch.float64)
    if not sim.solve_static().converged.all():
        raise RuntimeError("CatchTheObject: a pressure has no equilibrium")
    return sim.marker_x[:, 0].numpy(), start


def _pull(sim: softwarp.Simulation, step: int) -> None:
    sim.control.cable_displacement[:] = 0.004 + 0.003 * np.sin(0.02 * step)


def _inflate(sim: softwarp.Simulation, step: int) -> None:
    sim.control.cavity_pressure[:] = 1.0e5 + 5.0e4 * np.sin(0.02 * step)


ROBOTS = {
    "Trunk": Robot(
        lambda options, builder: build_trunk_scene(TrunkSceneConfig(**options), builder),
        _trunk,
        {"mesh": "round fine", **SOLID},
        {
            "default": {},
            "warped": {**WARPED, "lumping": "volume"},
            "fine": {"mesh": "fine", **WARPED, "lumping": "volume"},
            "accurate": {"fidelity": "accurate"},
        },
        (0.0, -9.81, 0.0),
        trunk.drive,
    ),
    "Diamond": Robot(
        lambda options, builder: build_diamond_scene(DiamondSceneConfig(**options), builder),
        _diamond,
        DIAMOND_WAYS,
        {
            "default": {},
            "fine": {"mesh": "fine", **WARPED, "lumping": "volume"},
            "p2": {"mesh": "coarse", **SOLID},
            "accurate": {"fidelity": "accurate"},
        },
        (0.0, 0.0, 0.0),
        _pull,
    ),
    "Gripper": Robot(
        lambda options, builder: build_gripper_scene(GripperSceneConfig(**options), builder),
        _finger,
        FINGER_WAYS,
        {"default": {}, "medium": {"mesh": "medium"}, "p2": SOLID, "accurate": {"fidelity": "accurate"}},
        drive=_pull,
    ),
    "Tripod": Robot(
        lambda options, builder: build_tripod_scene(TripodSceneConfig(**options), builder),
        _tripod,
        TRIPOD_WAYS,
        {
            "default": {},
            "fine": {"mesh": "fine", **WARPED, "lumping": "volume"},
            "p2": SOLID,
            "accurate": {"fidelity": "accurate"},
        },
    ),
    "CatchTheObject": Robot(
        lambda options, builder: build_catch_scene(CatchSceneConfig(**options), builder),
        _pad,
        SOLID,  # bent by pressure, a finer one takes many minutes
        {"default": {}, "p2": SOLID},
        drive=_inflate,
    ),
}
