"""Scenes with a reduced body: a slab with a stiff base, a chamber and a cable, held at one end or free on a floor."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import softwarp as sw
from softwarp import meshing, reduction

SLAB = meshing.box((0.06, 0.03, 0.012), (6, 3, 3))
BASE = SLAB.surface()[(SLAB.nodes[SLAB.surface()][:, :, 2] < 1e-9).all(axis=1)]
AIR = meshing.box((0.04, 0.02, 0.006), (2, 2, 1))
CLAMPED = SLAB.nodes[:, 0] < 1e-9


def scene(*, held: bool, contact: bool, law: Any = None, lone: bool = False, skin: Any = None) -> sw.ModelBuilder:
    """The slab, not reduced yet; ``lone`` leaves out what is not part of the body, ``skin`` is what touches for it."""
    builder = sw.ModelBuilder()
    material = law or sw.Corotational(1e5, 0.3)
    slab = builder.add_tets(
        SLAB, material=material, density=1000.0, rayleigh=(0.1, 0.01), name="slab", contact_surface=skin
    )
    if held:
        builder.fix(slab, nodes=np.flatnonzero(CLAMPED))
    builder.add_membrane(slab, BASE, youngs=1e6, nu=0.4, thickness=1e-3, density=1000.0, name="base")
    if not lone:
        shell = meshing.compact(AIR.nodes + (0.01, 0.005, 0.003), AIR.surface())
        builder.add_cavity(slab, *shell, control="volume", name="air")
        builder.add_cable(slab, [(x, 0.015, 0.009) for x in (0.06, 0.03, 0.0)], name="cable")
    builder.add_marker(slab, (0.06, 0.015, 0.006), name="tip")
    if contact:
        floor = builder.add_rigid(sw.Plane(), kinematic=True, pose=(0.0, 0.0, -0.002), name="floor")
        builder.add_contact(slab, floor, mu=0.7, alarm_distance=0.003, contact_distance=0.0005)
    return builder


def reduced_by(modes: NDArray[np.float64], **weights: Any) -> reduction.Reduction:
    """A reduction of the slab to some modes, with all elements unless ``tet_weight`` or ``base_weight`` are given.

    ``frame`` may be given too.
    """
    return reduction.Reduction(
        name="slab",
        nodes=SLAB.nodes,
        tets=SLAB.tets,
        modes=modes,
        rigid=0,
        singular_values=np.ones(len(modes)),
        tet_weight=weights.get("tet_weight", np.ones(len(SLAB.tets))),
        membrane_weight={"base": weights.get("base_weight", np.ones(len(BASE)))},
        frame=weights.get("frame", "fixed"),
    )


def every_node(held: bool) -> NDArray[np.float64]:
    """As many modes as the slab has unknowns: one node along one axis each."""
    free = np.flatnonzero(~CLAMPED if held else np.ones(len(SLAB.nodes), dtype=bool))
    modes = np.zeros((3 * len(free), len(SLAB.nodes), 3))
    modes[np.arange(3 * len(free)), np.repeat(free, 3), np.tile(np.arange(3), len(free))] = 1.0
    return modes


def smooth_modes(held: bool) -> NDArray[np.float64]:
    """Eleven smooth modes, a number that fills no block: products of powers of the coordinates along the axes."""
    x, y, z = (SLAB.nodes / (0.06, 0.015, 0.006) - (0.0, 1.0, 1.0)).T
    grade = x if held else np.ones_like(x)
    shapes = [grade, grade * x, grade * y, grade * z]
    modes = [shape[:, None] * axis for shape in shapes for axis in np.eye(3)]
    return np.array(modes[:11])


def deformations(modes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Modes that are neither rigid motions nor combinations of those before them."""
    x = SLAB.nodes - SLAB.nodes.mean(axis=0)
    moves = [np.broadcast_to(axis, x.shape) for axis in np.eye(3)] + [np.cross(axis, x) for axis in np.eye(3)]
    done, kept = np.linalg.qr(np.array([move.ravel() for move in moves]).T)[0].T, []
    for mode in modes:
        left = mode.ravel() / np.linalg.norm(mode)
        for _ in range(2):
            left = left - (done @ left) @ done
        if np.linalg.norm(left) > 1e-2:
            done = np.concatenate([done, left[None] / np.linalg.norm(left)])
            kept.append(mode)
    return np.array(kept)


def quadratic_modes() -> NDArray[np.float64]:
    """Eighteen modes of deformation, bending and twisting among them."""
    x, y, z = (SLAB.nodes / (0.06, 0.015, 0.006) - (0.5, 1.0, 1.0)).T
    shapes = (x * x, x * y, x * z, y * z, x, y, z)
    return deformations(np.array([shape[:, None] * axis for shape in shapes for axis in np.eye(3)]))


def run(sim: sw.Simulation, steps: int, start: int = 0) -> None:
    """The chamber grows and the cable shortens."""
    rest = float(sim.model.cavities.rest_volume[0])
    for step in range(start, start + steps):
        sim.control.cavity_volume.fill_(rest * 1.01 ** (step + 1))
        sim.control.cable_displacement.fill_(1e-4 * step)
        sim.step()
