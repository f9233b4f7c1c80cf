"""Gradients of steps of the trapezoidal rule, where no rows make it ``bdf2``, against differences."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Rollout
from tests.cases import FITTED
from tests.gradient_cases import STEPS, Inputs, gradients
from tests.unit.gradients import test_every_input
from tests.unit.gradients.test_forward_frames import compare
from tests.unit.gradients.test_newton import NEWTON
from tests.unit.gradients.test_rods import check as check_frames

SLOW = pytest.mark.slow


def swinging(num_worlds: int = 1, precision: str = "float64", device: str = "cpu", **options: Any) -> sw.Simulation:
    """A soft cube with a memory and a membrane, a clamped rod, a free one and a body that tumbles, without any rows."""
    builder = sw.ModelBuilder(gravity=(1.0, 2.0, -9.81))
    mesh = meshing.box((0.1, 0.1, 0.1), (2, 2, 2))
    law = FITTED["yeoh"](1e5, 0.4)
    body = builder.add_tets(mesh, material=law, density=1e3, rayleigh=(0.5, 0.01), relaxation=(0.4, 0.02))
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    builder.add_membrane(body, mesh.surface(), thickness=5e-4, youngs=4e5, nu=0.3, density=900.0)
    builder.add_traction(body, (0.0, 0.0, 1.0), box=((-1.0, -1.0, 0.0999), (1.0, 1.0, 1.0)))
    line = np.linspace((0.3, 0.0, 0.0), (0.5, 0.0, 0.0), 4)
    for place in (0.0, 0.2):
        rod = builder.add_rod(
            line + (0.0, place, 0.0), radius=0.01, youngs=5e6, nu=0.4, density=1100.0, rayleigh=(0.2, 0.0)
        )
        if place == 0.0:
            builder.fix(rod, nodes=[0])
    builder.add_rigid(sw.Box((0.05, 0.03, 0.02)), mass=0.05, pose=(0.8, 0.0, 0.0), damping=0.3)
    model = builder.finalize(num_worlds=num_worlds, precision=precision, device=device)
    return sw.Simulation(model, dt=0.01, integrator="trapezoidal", **options)


def carrying(
    num_worlds: int = 1,
    precision: str = "float64",
    device: str = "cpu",
    *,
    base: str = "rod",
    relaxes: bool = False,
    **options: Any,
) -> sw.Simulation:
    """A soft beam between a box and the end of a rod, a body that moves freely or a moved base, and two linked boxes.

    Args:
        num_worlds: Worlds.
        precision: Of the model.
        device: Of the model.
        base: What the beam begins on: ``rod``, ``free`` or ``kinematic``.
        relaxes: Give it a Maxwell branch.
        **options: Of the simulation.
    """
    builder = sw.ModelBuilder(gravity=(1.0, 2.0, -9.81))
    memory = {"relaxation": (0.4, 0.02)} if relaxes else {}
    mesh, law = meshing.box((0.1, 0.04, 0.04), (3, 1, 1)), FITTED["yeoh"](1e5, 0.4)
    body = builder.add_tets(mesh, material=law, density=1e3, rayleigh=(0.5, 0.01), **memory)
    box = builder.add_rigid(sw.Box((0.02, 0.06, 0.05)), mass=0.03, pose=(0.11, 0.02, 0.02), damping=0.4)
    builder.attach(body, box=((0.0999, -1.0, -1.0), (1.0, 1.0, 1.0)), to=box)
    begin: Any = ((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0))
    if base == "rod":
        line = np.linspace((-0.2, 0.02, 0.02), (0.0, 0.02, 0.02), 4)
        stem = builder.add_rod(
            line, radius=0.01, youngs=5e7, nu=0.4, density=1100.0, rayleigh=(0.2, 0.0 if relaxes else 0.005)
        )
        builder.fix(stem, nodes=[0])
        builder.attach(body, box=begin, to=stem, node=3)
        side = builder.add_rigid(sw.Box((0.02, 0.02, 0.04)), mass=0.02, pose=(-0.0667, 0.04, 0.02))
        builder.attach(side, to=stem, node=2)
    else:
        how: dict[str, Any] = {"kinematic": True} if base == "kinematic" else {"mass": 0.05, "damping": 0.2}
        held = builder.add_rigid(sw.Box((0.02, 0.04, 0.05)), pose=(-0.01, 0.02, 0.02), **how)
        builder.attach(body, box=begin, to=held)
    one = builder.add_rigid(sw.Box((0.05, 0.03, 0.02)), mass=0.05, pose=(0.8, 0.0, 0.0), damping=0.3)
    other = builder.add_rigid(sw.Box((0.02, 0.03, 0.05)), mass=0.03, pose=(0.83, 0.01, 0.0))
    builder.attach(other, to=one)
    builder.add_marker(box, (0.12, 0.02, 0.02))
    model = builder.finalize(num_worlds=num_worlds, precision=precision, device=device)
    return sw.Simulation(model, dt=0.01, integrator="trapezoidal", **options)


CARRIES = [
    pytest.param("rod", False, {}, id="a rod"),
    pytest.param("free", False, {}, id="a body"),
    pytest.param("kinematic", False, {}, id="a base"),
    pytest.param("rod", True, {}, id="a rod, memory", marks=SLOW),
    pytest.param("free", True, {}, id="a body, memory"),
    pytest.param("rod", False, NEWTON, id="a rod, solved", marks=SLOW),
    pytest.param("kinematic", True, NEWTON, id="a base, memory, solved", marks=SLOW),
]


@pytest.mark.parametrize(("base", "relaxes", "options"), CARRIES)
def test_what_rods_and_bodies_carry(base: str, relaxes: bool, options: dict[str, Any]) -> None:
    """By every input, where it follows from what carries it and that is extrapolated."""
    sim = carrying(base=base, relaxes=relaxes, **options)
    given, sizes = test_every_input.given_of(sim, 0.3)
    sizes["parameters"]["gravity"] *= 0.3  # else they cross a kink of projected tangents
    if relaxes:  # else differences are rounding
        sizes["parameters"]["relaxation_ratio"] *= 100.0
        sizes["parameters"]["relaxation_time"] *= 100.0
        sizes["parameters"]["rayleigh_stiffness"] *= 30.0
    check_frames(Rollout(sim), given, test_every_input.loss, sizes)
    if not options:
        compare(Rollout(sim), given, test_every_input.loss)


@pytest.mark.parametrize("options", [{}, pytest.param(NEWTON, marks=SLOW)])
def test_the_trapezoidal_rule(options: dict[str, Any]) -> None:
    """By every input; two linearisations of a stage, or stages that are solved."""
    sim = swinging(**options)
    given, sizes = test_every_input.given_of(sim, 0.3)
    sizes["parameters"]["relaxation_time"] *= 100.0 if options else 10.0  # else differences are rounding
    check_frames(Rollout(sim), given, test_every_input.loss, sizes)
    if not options:
        compare(Rollout(sim), given, test_every_input.loss)


@pytest.mark.parametrize("scene", [swinging, carrying])
@pytest.mark.parametrize("precision", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
def test_worlds_beside_change_no_bit_of_the_trapezoidal_rule(
    precision: str, scene: Callable[..., sw.Simulation]
) -> None:
    """World i of a batch has the gradients of that world alone."""

    def found(seeds: list[int]) -> Inputs:
        sim = scene(len(seeds), precision)
        shape = sim.node_v[0].shape
        v = torch.stack([torch.tensor(np.random.default_rng(seed).standard_normal(shape)) for seed in seeds])
        v = 0.05 * v.to(sim.node_x)
        given: Inputs = {"state": {"node_v": v, "body_twist": sim.body_twist + 20.0 * v[:, :1, :1]}, "controls": {}}
        given["parameters"] = {name: getattr(sim.params, name).clone() for name in ("youngs", "gravity")}
        return gradients(Rollout(sim), given, test_every_input.loss, steps=STEPS)

    others = [[1], [2], [3]] if precision == "float64" else [[1, 1, 1], [2, 2, 2], [3, 3, 3]]
    batch = found([1, 2, 3])
    for world, seeds in enumerate(others):
        for group, held in found(seeds).items():
            for name, value in held.items():
                assert torch.equal(batch[group][name][world], value[0]), (seeds, group, name)
