"""A coil, a guide and a catheter in an aorta with outlets. Scene only; task: ``tasks/catheter_beam.py``.

Frame: the middle of the vessel's inlet is the origin, and the port, through which instruments come along +z. Several
anatomies lie side by side along x in the wall of one body; a world has the one which stands at the port.

Reference: the three-instrument example of BeamAdapter, and SofaGym's CatheterBeam scene made from it.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from softwarp import Tube, TubeSection
from softwarp.builder import ModelBuilder
from softwarp.envs.options.catheter_beam import AnatomyKey, CatheterSceneConfig, make_anatomy
from softwarp.meshing import VesselTree
from softwarp.scene import RigidBody, Telescope
from softwarp.shapes import Vessel

CONTACT_CAPACITY = 96  # per world; a line of 48 segments all of which touch has 50, and more where a step ends
VIEWED_FROM = (1.0, 0.0, 0.0)  # pictures show the vessel without the side that hides what is inside
WALL = 0.020  # m, so thick that nothing gets past its middle, from where it is pushed out
BETWEEN = 0.05  # m, from the lumen of an anatomy to that of the next


@dataclass(frozen=True)
class CatheterScene:
    """Ids of what was added to the builder, the anatomies and where they lie in the wall's frame."""

    instruments: Telescope
    wall: RigidBody
    trees: tuple[VesselTree, ...]
    offsets: tuple[float, ...]  # m, along x
    vessel: Vessel


def build_catheter_scene(config: CatheterSceneConfig, builder: ModelBuilder, first: tuple[float, ...]) -> CatheterScene:
    """Add vessel and instruments to a builder.

    Args:
        config: Options.
        builder: What the scene is added to.
        first: Lengths of the instruments that are out at the start [m].
    """
    keys = config.anatomy_keys()
    trees = tuple(make_anatomy(key) for key in keys)
    offsets = _side_by_side(trees)
    try:
        vessel = _vessel(keys, config.grid)
    except ValueError as error:
        if len(keys) == 1:
            raise
        told = f"{type(config).__name__}: anatomies={len(keys)} with grid={config.grid:g} m"
        raise ValueError(f"{told}: {error}, for grid, or fewer anatomies") from None
    wall = builder.add_rigid(vessel, kinematic=True, name="vessel")
    instruments = builder.add_telescope(
        make_instruments(config),
        port=(0.0, 0.0, 0.0),
        segments=config.segments,
        lengths=first,
        windup=config.windup,
        rayleigh=config.rayleigh,
        contact_radius=config.contact_radius,
        name="instruments",
    )
    builder.add_contact(instruments, wall, mu=config.mu)
    return CatheterScene(instruments, wall, trees, offsets, vessel)


def make_instruments(config: CatheterSceneConfig) -> list[Tube]:
    """Coil, guide and catheter; moduli and densities of hollow ones leave them as stiff and heavy as solid ones."""
    coil, guide, catheter = config.lengths
    sections = (
        (
            TubeSection(coil - config.coil_end),
            TubeSection.helix(config.coil_end, 0.5 * config.coil_diameter, config.coil_pitch),
        ),
        (TubeSection(guide - config.guide_end), TubeSection.arc(config.guide_end, 0.5 * config.guide_diameter)),
        (
            TubeSection(catheter - config.catheter_end),
            TubeSection.arc(config.catheter_end, 0.5 * config.catheter_diameter),
        ),
    )
    inner = (0.0, *config.radii[:-1])
    found = []
    for parts, radius, hole, youngs, density in zip(
        sections, config.radii, inner, config.youngs, config.density, strict=True
    ):
        share = hole / radius
        found.append(
            Tube(
                parts,
                radius=radius,
                inner_radius=hole,
                youngs=youngs / (1.0 - share**4),
                nu=config.nu,
                density=density / (1.0 - share**2),
            )
        )
    return found


def _side_by_side(trees: tuple[VesselTree, ...]) -> tuple[float, ...]:
    """Where inlets lie along x so that the anatomies keep apart [m]; the first at 0."""
    found, end = [], None
    for tree in trees:
        low, high = (float(bound) for bound in _extent(tree))
        found.append(0.0 if end is None else end + BETWEEN - low)
        end = found[-1] + high
    return tuple(found)


def _extent(tree: VesselTree) -> tuple[float, float]:
    """Lowest and highest x of a lumen [m]."""
    x, r = tree.points[:, 0], tree.radius
    return float(np.min(x - r)), float(np.max(x + r))


@functools.lru_cache(maxsize=2)
def _vessel(keys: tuple[AnatomyKey, ...], grid: float) -> Vessel:
    """The wall around all anatomies, which takes seconds to sample."""
    trees = tuple(make_anatomy(key) for key in keys)
    tubes = [
        (points + np.array([x, 0.0, 0.0]), lumen)
        for x, tree in zip(_side_by_side(trees), trees, strict=True)
        for points, lumen in tree.tubes()
    ]
    return Vessel.from_tubes(tubes, grid, wall=WALL, name="aorta").cut_open(VIEWED_FROM)
