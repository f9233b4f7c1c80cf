"""Scenes whose gradients tests compare with differences."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Rollout, States
from tests.cases import material

SIDE = 0.1  # m, of the cube
STEPS = 3

# Parameters that are drawn last, behind those of laws: draws of others stay as they were.
LATER = {"relaxation_ratio": 1e-5, "relaxation_time": 1e-6, "membrane_youngs": 10.0, "membrane_nu": 1e-4}

# Inputs of a rollout by group, with the size of a step for central differences, which is also that of the change.
CHANGES = {
    "state": {"node_x": 1e-7, "node_v": 1e-5, "cavity_pressure": 3.0},
    "controls": {
        "node_force": 1e-4,
        "cable_displacement": 1e-7,
        "cable_tension": 1e-4,
        "cavity_pressure": 1e-1,
        "cavity_volume": 1e-11,
        "cavity_gas": 1e-11,
        "traction": 1e-2,
    },
    "parameters": {
        "youngs": 1.0,
        "nu": 1e-5,
        "density": 1e-2,
        "rayleigh_mass": 1e-3,
        "rayleigh_stiffness": 1e-6,
        "gravity": 1e-3,
        "cable_stiffness": 1e-3,
        "cable_damping": 1e-5,
        "pair_mu": 1e-5,
        **LATER,
    },
}
Inputs = dict[str, dict[str, torch.Tensor]]


def cube(
    law: str = "large",
    num_worlds: int = 1,
    precision: str = "float64",
    device: str = "cpu",
    *,
    quadratic: bool = False,
    elastic: bool = False,
    chamber: dict[str, Any] | None = None,
    hollow: bool = True,
    locked: bool = True,
    covered: bool = False,
    graded: bool = False,
    **options: Any,
) -> sw.Simulation:
    """A cube of 2 x 2 x 2 cells, held at x = 0, with a cable of each control, a chamber with a rate and a marker.

    Args:
        law: Of ``tests.cases``.
        num_worlds: Worlds.
        precision: Of the model.
        device: Of the model.
        quadratic: One cell of quadratic elements instead, with a traction on a face.
        elastic: The cable whose length is commanded stretches.
        chamber: Control and limits of the chamber; pressure control with a rate if left out.
        covered: Glue a membrane to the cube's surface; its corners are those of linear elements.
        hollow: It has the chamber; without, all rows are bounded and none gives way.
        locked: A corner moves along x and z only.
        graded: The modulus grows from element to element, from 0.6 to 1.7 times.
        **options: Of the simulation.
    """
    builder = sw.ModelBuilder(gravity=(1.0, 2.0, -9.81))
    size = (SIDE, SIDE, SIDE)
    mesh = meshing.elevate(meshing.box(size, (1, 1, 1))) if quadratic else meshing.box(size, (2, 2, 2))
    body = builder.add_tets(
        mesh,
        stiffness=np.linspace(0.6, 1.7, 6 if quadratic else 48) if graded else None,
        material=material(law, 1e5, 0.4),
        density=1000.0,
        rayleigh=(0.5, 0.01),
    )
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    if locked:
        builder.fix(body, box=((0.099, 0.099, 0.099), (1.0, 1.0, 1.0)), axes="y")
    one = [(0.01, 0.02, 0.03), (0.05, 0.03, 0.03), (0.09, 0.02, 0.05)]
    other = [(0.02, 0.08, 0.03), (0.05, 0.07, 0.03), (0.09, 0.08, 0.05)]
    stretch = {"stiffness": 300.0, "damping": 2.0} if elastic else {}
    builder.add_cable(body, one, pull_point=(-0.1, 0.0, 0.0), **stretch)
    builder.add_cable(body, other, control="force")
    skin = meshing.box((0.04, 0.04, 0.04), (1, 1, 1))
    law_of_air = {"max_pressure_rate": 2e4} if chamber is None else chamber
    if hollow:
        builder.add_cavity(body, skin.nodes + (0.03, 0.03, 0.03), skin.surface(), **law_of_air)
    builder.add_marker(body, (SIDE, 0.05, 0.05))
    if covered:
        surface = meshing.box(size, (2, 2, 2)).surface()
        builder.add_membrane(body, surface, thickness=1e-3, youngs=4e5, nu=0.3, density=900.0)
    if quadratic:
        builder.add_traction(body, (0.0, 0.0, 1.0), box=((-1.0, -1.0, 0.099), (1.0, 1.0, 1.0)))
    model = builder.finalize(num_worlds=num_worlds, device=device, precision=precision)
    return sw.Simulation(model, dt=0.01, **options)


def inputs(sim: sw.Simulation, seeds: list[int], strain: float = 0.1) -> Inputs:
    """Inputs of a rollout of ``STEPS`` steps; world i has those of individual ``seeds[i]``.

    The pressure goes to its command as fast as its rate allows and arrives in the last step.
    """
    kept: dict[str, dict[str, list[torch.Tensor]]] = {group: {} for group in CHANGES}
    chambers = sim.control.cavity_pressure.shape[1]
    for seed in seeds:
        rng = np.random.default_rng(seed)
        values = {
            "state": {
                "node_x": sim.node_x[0].cpu().numpy() + 0.03 * SIDE * strain * rng.standard_normal(sim.node_x[0].shape),
                "node_v": 0.1 * rng.standard_normal(sim.node_v[0].shape),
                "cavity_pressure": rng.uniform(40.0, 60.0, chambers),
            },
            "controls": {
                "node_force": 0.1 * rng.standard_normal(sim.node_x[0].shape),
                "cable_displacement": np.linspace(0.004, 0.01, STEPS)[:, None] * rng.uniform(0.8, 1.2, (STEPS, 2)),
                "cable_tension": rng.uniform(1.0, 3.0, (STEPS, 2)),
                "cavity_pressure": rng.uniform(500.0, 520.0, chambers),
                "cavity_volume": rng.uniform(6.5e-5, 6.6e-5, chambers),
                "cavity_gas": rng.uniform(6.5e-5, 6.6e-5, chambers),
                "traction": rng.uniform(-50.0, 50.0, tuple(sim.control.traction.shape[1:])),
            },
            "parameters": {
                name: getattr(sim.params, name)[0].cpu().numpy() * rng.uniform(0.9, 1.1)
                for name in (*(n for n in CHANGES["parameters"] if n not in LATER), "law_parameter", *LATER)
            },
        }
        for group, found in values.items():
            for name, value in found.items():
                kept[group].setdefault(name, []).append(torch.tensor(value).to(sim.node_x))
    axis = {"cable_displacement": 1, "cable_tension": 1}  # behind that of steps
    return {
        group: {name: torch.stack(value, dim=axis.get(name, 0)) for name, value in found.items()}
        for group, found in kept.items()
    }


def weights(sim: sw.Simulation) -> Callable[[States], torch.Tensor]:
    """A loss (world,) in which every result has a random weight and about the same share."""
    rng = np.random.default_rng(7)

    def drawn(*shape: int) -> torch.Tensor:
        return torch.tensor(rng.standard_normal(shape)).to(sim.node_x)

    nodes = sim.model.node_count
    x, v = drawn(STEPS, 1, nodes, 3) / SIDE, drawn(STEPS, 1, nodes, 3)
    tension, pressure, marker = 0.1 * drawn(STEPS, 1, 2), 1e-3 * drawn(STEPS, 1, 1), drawn(STEPS, 1, 1, 3) / SIDE

    def loss(states: States) -> torch.Tensor:
        first = -len(states.node_x)
        total: torch.Tensor = (states.node_x * x[first:]).sum(dim=(0, 2, 3))
        total = total + (states.node_v * v[first:]).sum(dim=(0, 2, 3))
        total = total + (states.cable_tension * tension[first:]).sum(dim=(0, 2))
        total = total + (states.cavity_pressure * pressure[first:]).sum(dim=(0, 2))
        return total + (states.marker_x * marker[first:]).sum(dim=(0, 2, 3))

    return loss


def gradients(rollout: Rollout, given: Inputs, loss: Callable[[States], torch.Tensor], **options: Any) -> Inputs:
    """Gradient of the sum of losses by every input."""
    leaves = {
        group: {name: value.clone().requires_grad_() for name, value in held.items() if value.numel()}
        for group, held in given.items()
    }
    states = rollout(leaves["state"], leaves["controls"], leaves["parameters"], **options)
    loss(states).sum().backward()
    found = {group: {name: leaf.grad for name, leaf in held.items()} for group, held in leaves.items()}
    assert all(value is not None for held in found.values() for value in held.values())
    return found  # type: ignore[return-value]
