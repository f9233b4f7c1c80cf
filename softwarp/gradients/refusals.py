"""What of a scene has no gradient yet, each with the way out."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from softwarp.model.codes import Carrier, Target
from softwarp.model.frames import FrameModel
from softwarp.model.model import Model
from softwarp.simulation import Simulation


class Diverged(RuntimeError):
    """Worlds failed or did not come to rest, so that a gradient would mean nothing; the message names them."""


def missing(sim: Simulation) -> str | None:
    """The first part of a scene, or option, whose steps have no gradient, and what to do instead; None if all have."""
    parts = itertools.chain(_options(sim), _parts(sim.model), _rods(sim), _reduced(sim), _contacts(sim))
    return next(parts, None)


def require_differentiable(sim: Simulation) -> None:
    """Check that every part of a scene and every option has a gradient.

    Raises:
        ValueError: Naming the first that has none, and what to do instead.
    """
    if found := missing(sim):
        raise ValueError(f"gradients.Rollout: {found}; or fit without gradients, by softwarp.identification")


def require_static_gradient(sim: Simulation) -> None:
    """The same for equilibria, which do not depend on how steps are taken.

    Raises:
        ValueError: As above.
    """
    if sim.model.has_moving_frames:
        for found in _resting_frames(sim):
            raise ValueError(f"gradients.Equilibrium: {found}; take a Rollout with damping that comes to rest")
    if sim.model.reduction is not None:
        told = "equilibria of reduced bodies have no gradient yet"
        raise ValueError(f"gradients.Equilibrium: {told}; take a Rollout with damping that comes to rest")
    if sim.model.hexes is not None:
        name = sim.model.body_names[int(sim.model.hexes.layout.body[0])]
        told = f"equilibria of hexahedra, those of body {name!r}, have no gradient yet"
        raise ValueError(f"gradients.Equilibrium: {told}; take a Rollout with damping that comes to rest")
    if sim.model.membranes is not None:
        told = f"equilibria with membrane {sim.model.membranes.names[0]!r} have no gradient yet"
        raise ValueError(f"gradients.Equilibrium: {told}; take a Rollout with damping that comes to rest")
    for found in _parts(sim.model):
        raise ValueError(f"gradients.Equilibrium: {found}; or fit without gradients, by softwarp.identification")
    if sim.model.contact is not None:
        told = "equilibria with contact have no gradient yet"
        raise ValueError(f"gradients.Equilibrium: {told}; take a Rollout with damping that comes to rest")


def _resting_frames(sim: Simulation) -> Iterator[str]:
    """What equilibria of rods and rigid bodies have no gradient with."""
    model, told = sim.model, "equilibria of rods, and of rigid bodies that move or carry something, have no gradient"
    if model.cavity_count:
        yield f"{told} beside chambers yet"
    if model.joints is not None:
        yield f"{told} beside joints yet"
    if model.has_kinematic:
        yield f"{told} beside kinematic bodies yet"
    if model.cable_count and (not model.cable_force_controlled.all() or model.cable_elastic.any()):
        yield f"{told} with cables whose length is commanded, or that stretch, yet"
    yield from _rods(sim)


def _options(sim: Simulation) -> Iterator[str]:
    options = sim.options
    if options.repeat_swing < float("inf"):
        told = f"steps that may be taken again (repeat_swing={options.repeat_swing:g})"
        yield f"{told} have no gradient yet; take repeat_swing=inf"


SHAPES = (Target.PLANE, Target.SPHERE, Target.CAPSULE, Target.BOX, Target.CYLINDER, Target.MESH)
SOFT = (Target.SOFT, Target.POINTS)


def _contacts(sim: Simulation) -> Iterator[str]:
    """Pairs of contact by name."""
    contact = sim.model.contact
    if contact is None:
        return
    scene, passes = contact.scene, sim.options.contact_passes
    if sim.options.newton_iterations > 1:
        passes = 0  # its iterations find contacts anew where they lead to
    if passes > 0 and max(passes, sim.options.refinement) + sim.options.further_passes > 1:
        told = f"contact that is measured anew more than once a step (contact_passes={passes}, "
        further = f"{sim.options.further_passes} more in worlds that still move, " if sim.options.further_passes else ""
        told += f"{further}refinement={sim.options.refinement}) has no gradient yet"
        yield f"{told}; take contact_passes=1, or 0, and refinement=1, or 0"
    if passes > 0 and sim.model.joints is not None:
        yield "contact that is measured anew beside joints has no gradient yet; take contact_passes=0"
    for couple in scene.couples:
        a, b = scene.entities[couple.a], scene.entities[couple.b]
        told = f"contact of {a.name!r} and {b.name!r} has no gradient yet"
        for one in (a, b):
            if one.kind not in (*SOFT, *SHAPES):
                kind = "rods" if one.kind == Target.CHAIN else "distance fields"
                yield f"{told}, as that of {kind}; take a shape, a mesh or a soft body for {one.name!r}"
        if not {a.kind, b.kind} & {*SOFT, Target.SPHERE}:
            yield f"{told}, as that of two rigid bodies, of which only balls have one"
        carrier = np.asarray(contact.topology.carrier, dtype=np.int32)
        if carrier.size and (np.asarray(contact.topology.node_frame)[carrier] >= 0).any():
            yield f"{told}, as a collision mesh is on nodes that a body carries; leave collision meshes out"


def _parts(model: Model) -> Iterator[str]:
    """Parts by name."""
    if model.body_count == 0 and not model.has_moving_frames:
        yield "a scene where nothing moves freely has nothing to differentiate; add a soft body, rod or rigid body"
    if model.frames is not None:
        yield from _frames(model, model.frames)


def _frames(model: Model, frames: FrameModel) -> Iterator[str]:
    """Rigid bodies and rod nodes by name, and what they carry."""
    names = [f"rigid body {name!r}" for name in model.rigid_names]
    for rod, count in zip(model.rod_names, np.diff(frames.rod_start), strict=True):
        names += [f"node {node} of rod {rod!r}" for node in range(count)]
    if frames.blend_frame.size:
        yield "a rod that contact cuts into pieces has no gradient yet; leave contact_pieces out"
    if model.contact is not None:
        yield from _carriers_of_touching(model, frames, names)


def _carriers_of_touching(model: Model, frames: FrameModel, names: list[str]) -> Iterator[str]:
    """What moves freely and carries several nodes that may touch, whose forces are not unique."""
    assert model.contact is not None
    scene, carrier = model.contact.scene, frames.node_frame.numpy()
    kind, index = (scene.points.array(name, np.int32) for name in ("kind", "index"))
    parts = {entity for couple in scene.couples for entity in (couple.a, couple.b)}
    points = np.concatenate([np.arange(*scene.entities[entity].points) for entity in sorted(parts)])
    nodes = np.unique(index[points][kind[points] == Carrier.NODE])
    held = carrier[nodes[nodes < model.body_node_count]]
    count = np.bincount(held[held >= 0], minlength=len(names))
    for frame, name in enumerate(names):
        moves = frame >= frames.rigid_count or not frames.is_kinematic[frame]
        if moves and count[frame] > 1:
            told = f"{name}, which moves freely and carries several nodes of a body that touches something"
            yield f"{told}, has no gradient yet; make it kinematic, or leave contact out"


def _reduced(sim: Simulation) -> Iterator[str]:
    """What reduced bodies have no gradient with."""
    model, told = sim.model, "reduced bodies have no gradient"
    if model.reduction is None:
        return
    if sim.options.newton_iterations > 1:
        count = sim.options.newton_iterations
        if model.reduction.floating is not None:
            yield f"{told} in a floating frame with newton_iterations={count} yet; take newton_iterations=1"
        if model.relaxes:
            yield f"{told} beside Maxwell branches with newton_iterations={count} yet; take newton_iterations=1"


def _rods(sim: Simulation) -> Iterator[str]:
    """What rods have no gradient with."""
    model = sim.model
    if not model.rod_count:
        return
    name = model.rod_names[0]
    if model.telescopes is not None:
        yield f"tubes that slide in each other, {name!r} among them, have no gradient yet; take plain rods"
    if not sim.options.project_tangent:
        yield f"rod {name!r} has no gradient with project_tangent=False yet; take project_tangent=True"
