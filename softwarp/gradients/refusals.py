"""What of a scene has no gradient yet, each with the way out."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from softwarp.model.codes import CavityControl
from softwarp.model.model import Model
from softwarp.simulation import Simulation
from softwarp.solvers.options import Options


def missing(sim: Simulation) -> str | None:
    """The first part of a scene, or option, whose steps have no gradient, and what to do instead; None if all have."""
    return next(itertools.chain(_options(sim.options), _parts(sim.model)), None)


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
    for found in _parts(sim.model):
        raise ValueError(f"gradients.Equilibrium: {found}; or fit without gradients, by softwarp.identification")
    if sim.model.cavities is not None:
        name = sim.model.cavity_names[0]
        told = f"equilibria with chamber {name!r} have no gradient yet"
        raise ValueError(f"gradients.Equilibrium: {told}; take a Rollout with damping that comes to rest")


def _options(options: Options) -> Iterator[str]:
    if options.integrator != "euler":
        yield f"steps of integrator {options.integrator!r} have no gradient yet; take integrator='euler'"
    if options.newton_iterations > 1:
        count = options.newton_iterations
        yield f"steps of newton_iterations={count} have no gradient yet; take newton_iterations=1 and a shorter dt"
    if options.pressure_tangent:
        yield "the tangent of pressures has no gradient yet; leave pressure_tangent out"


def _parts(model: Model) -> Iterator[str]:
    """Parts by name."""
    for names, kind in ((model.rigid_names, "rigid body"), (model.rod_names, "rod")):
        if names:
            yield f"{kind} {names[0]!r} has no gradient yet; build the scene of soft bodies alone"
    if model.contact is not None:
        yield "contact has no gradient yet; build the scene without add_contact"
    if model.quadratic is not None:
        yield "quadratic tetrahedra have no gradient yet; mesh the body with linear ones"
    if model.membranes is not None:
        yield f"membrane {model.membranes.names[0]!r} has no gradient yet; leave it out"
    if model.tractions is not None:
        yield "tractions have no gradient yet; command their sum as control.node_force"
    if model.reduction is not None:
        yield "reduced bodies have no gradient yet; take the full mesh"
    if model.relaxes:
        body = int(np.flatnonzero(model.defaults["relaxation_ratio"].ravel())[0])
        yield f"the relaxation of body {model.body_names[body]!r} has no gradient yet; leave its Maxwell branch out"
    if model.cable_elastic.any():
        cable = model.cable_names[int(np.flatnonzero(model.cable_elastic)[0])]
        yield f"the stiffness of cable {cable!r} has no gradient yet; leave stiffness out"
    if model.cavities is not None:
        control = model.cavities.cavity_control.numpy()
        others = np.flatnonzero(control != CavityControl.PRESSURE)
        if others.size:
            name, kind = model.cavity_names[int(others[0])], CavityControl(int(control[others[0]])).name.lower()
            yield f"{kind} control of chamber {name!r} has no gradient yet; take control='pressure'"
