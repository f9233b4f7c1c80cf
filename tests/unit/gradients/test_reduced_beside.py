"""Gradients of reduced bodies beside Maxwell branches, and in steps of several iterations, by every input."""

from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Rollout, States
from softwarp.model.gradients import PARAMETERS
from tests.cases import FITTED
from tests.gradient_cases import STEPS, Inputs, gradients
from tests.reduction_cases import SLAB, reduced_by, scene, smooth_modes
from tests.unit.gradients import test_every_input, test_reduced
from tests.unit.gradients.test_contact import EXACT, SLIPPING, STUCK
from tests.unit.gradients.test_forward_frames import compare
from tests.unit.gradients.test_rods import check
from tests.unit.gradients.test_touches import modes

SLOW = pytest.mark.slow
SOLVED: dict[str, Any] = {"newton_iterations": 40, "newton_tolerance": 1e-13, "project_tangent": False}
STATE = {"mode_q": 1e-8, "mode_v": 1e-6, "node_v": 1e-6, "body_twist": 1e-5, "body_pose": 6e-8}
CONTROLS = {"node_force": 1e-5, "body_force": 1e-6, "cable_displacement": 1e-8}
CONTROLS["cavity_volume"] = 1e-11
CHANGES = {**test_every_input.CHANGES, "membrane_nu": 1e-5, "nu": 1e-3, "relaxation_time": 1e-4}
CHANGES |= {"relaxation_ratio": 1e-3, "cable_damping": 1e-2}


def held(num_worlds: int = 1, *, lone: bool = False, **options: Any) -> sw.Simulation:
    """The slab, held and reduced, with a cable to a rigid body with a soft one that relaxes.

    Args:
        num_worlds: Of the model.
        lone: Leave cables and the chamber out.
        **options: Of the simulation.
    """
    builder = scene(held=True, contact=False, law=FITTED["yeoh"](1e5, 0.3), lone=lone)
    weights = np.random.default_rng(0).uniform(0.5, 1.5, len(SLAB.tets))
    weights[::3] = 0.0
    builder.reduce(0, reduced_by(smooth_modes(held=True), tet_weight=weights))
    box = sw.Box((0.04, 0.02, 0.02))
    link = builder.add_rigid(box, mass=0.03, pose=(0.1, 0.015, 0.006), damping=0.2)
    path = [(0.03, 0.01, 0.01), (0.055, 0.01, 0.01), (0.11, 0.02, 0.012)]
    if not lone:
        builder.add_cable([0, 0, link], path, stiffness=200.0, damping=1.0)
    mesh, stuff = meshing.box((0.03, 0.02, 0.02), (1, 1, 1)), sw.Corotational(1e5, 0.3)
    memory = {"rayleigh": (0.3, 0.01), "relaxation": (0.3, 0.05)}
    soft = builder.add_tets(mesh.nodes + (0.12, 0.005, 0.0), mesh.tets, material=stuff, density=1000.0, **memory)
    builder.attach(soft, box=((0.11, -1.0, -1.0), (0.1201, 1.0, 1.0)), to=link)
    return sw.Simulation(builder.finalize(num_worlds=num_worlds, precision="float64"), dt=0.01, **options)


def given_of(sim: sw.Simulation, seeds: list[int]) -> tuple[Inputs, dict[str, dict[str, Any]]]:
    """Every input of worlds, each of its own seed, and its change."""
    values: dict[str, dict[str, list[torch.Tensor]]] = {"state": {}, "controls": {}, "parameters": {}}
    volume = 0.0 if sim.model.cavities is None else float(sim.model.cavities.rest_volume[0])
    size = {"node_force": 0.02, "body_force": 0.01, "cable_displacement": 5e-4}
    mean = {"cable_displacement": 4e-3, "cavity_volume": 1.01 * volume}
    for seed in seeds:
        rng = np.random.default_rng(seed)
        spread = {"mode_q": 1e-4, "mode_v": 0.03, "node_v": 0.05, "body_twist": 0.3, "body_pose": 0.0}
        found: dict[str, dict[str, Any]] = {"state": {}, "controls": {}, "parameters": {}}
        for name in STATE:
            if name != "node_v" or sim.model.own_node_count:
                start = getattr(sim, name)[0].cpu().numpy()
                found["state"][name] = start + spread[name] * rng.standard_normal(start.shape)
        found["state"]["body_pose"][:, :3] += 1e-4 * rng.standard_normal((sim.model.rigid_count, 3))  # else at a kink
        for name in CONTROLS:
            shape = (STEPS, *getattr(sim.control, name).shape[1:])
            if 0 not in shape:
                change = size.get(name, 0.002 * volume) * rng.standard_normal(shape)
                found["controls"][name] = mean.get(name, 0.0) + change
        for name in PARAMETERS:
            value = getattr(sim.params, name)[0].cpu().numpy()
            if value.size and np.any(value):
                found["parameters"][name] = value.copy()
        for group, parts in found.items():
            for name, value in parts.items():
                values[group].setdefault(name, []).append(torch.tensor(value))
    given = {
        group: {name: torch.stack(each, dim=int(group == "controls")) for name, each in parts.items()}
        for group, parts in values.items()
    }
    sizes: dict[str, dict[str, Any]] = {"state": STATE, "controls": CONTROLS}
    sizes["parameters"] = {name: CHANGES.get(name, 1e-3 * v.abs()) for name, v in given["parameters"].items()}
    return given, sizes


def loss(states: States) -> torch.Tensor:
    """A random weight for every result; (world,)."""
    rng, total = np.random.default_rng(7), states.node_x.new_zeros(states.node_x.shape[1])
    for name, size in {**test_every_input.RESULTS, "mode_q": 10.0, "mode_v": 1.0}.items():
        value = getattr(states, name)
        if value.numel():
            weight = torch.tensor(rng.standard_normal((STEPS, 1, *value.shape[2:])))[-len(value) :]
            total = total + size * (value * weight).flatten(2).sum(dim=(0, 2))
    return total


def test_gradients_beside_memories_are_those_of_differences() -> None:
    """By all that the scene has, in both modes."""
    sim = held()
    given, sizes = given_of(sim, [3])
    check(Rollout(sim), given, loss, sizes)
    compare(Rollout(sim), given, loss)


@pytest.mark.parametrize(("integrator", "lone"), [("bdf2", False), pytest.param("trapezoidal", True, marks=SLOW)])
def test_gradients_beside_memories_of_steps_of_second_order(integrator: str, *, lone: bool) -> None:
    """Likewise; with the exact tangent, as at rest a projected one has kinks."""
    sim = held(integrator=integrator, lone=lone, project_tangent=False)
    given, sizes = given_of(sim, [2])
    check(Rollout(sim), given, loss, sizes)
    compare(Rollout(sim), given, loss)


@pytest.mark.parametrize("integrator", ["euler", pytest.param("bdf2", marks=SLOW)])
def test_gradients_of_solved_steps_are_those_of_differences(integrator: str) -> None:
    """Of the slab alone."""
    sim = test_reduced.slab(integrator=integrator, **SOLVED)
    check(Rollout(sim), test_reduced.given_of(sim, [1]), test_reduced.loss, test_reduced.SIZES)


def lying(num_worlds: int = 1, on: str = "floor", dt: float = 0.001, **options: Any) -> sw.Simulation:
    """The slab on something, in steps that are so short that iterations converge beside contacts."""
    sim = test_reduced.slab(num_worlds, on=on, softness=test_reduced.SOFTNESS)
    return sw.Simulation(sim.model, dt=dt, **{**EXACT, **SOLVED, "newton_tolerance": 1e-12, **options})


@pytest.mark.parametrize(
    ("on", "options"),
    [
        ("floor", {}),
        pytest.param("floor", {"dt": 0.002, "newton_iterations": 100, "newton_tolerance": 1e-13}, marks=SLOW),
        pytest.param("bed", {"dt": 0.002, "newton_iterations": 60, "newton_tolerance": 1e-13}, marks=SLOW),
    ],
)
def test_gradients_of_solved_steps_beside_contact(on: str, options: dict[str, Any]) -> None:
    """Contacts are found where each iteration leads to, and count where the step ends."""
    sim = lying(on=on, **options)
    given = test_reduced.given_of(sim, [1], nodes=sim.model.own_node_count > 0)
    check(Rollout(sim), given, test_reduced.loss, test_reduced.SIZES)
    assert modes(sim, given) & {STUCK, SLIPPING}


@pytest.mark.parametrize("integrator", ["euler", pytest.param("bdf2", marks=SLOW)])
def test_worlds_beside_change_no_bit(integrator: str) -> None:
    """Three worlds, and each alone."""
    batch, single = held(3, integrator=integrator), held(integrator=integrator)
    together, rollout = gradients(Rollout(batch), given_of(batch, [1, 2, 3])[0], loss), Rollout(single)
    for world, seed in enumerate((1, 2, 3)):
        for group, parts in gradients(rollout, given_of(single, [seed])[0], loss).items():
            for key, value in parts.items():
                axis = int(group == "controls")
                assert torch.equal(together[group][key].select(axis, world), value.select(axis, 0)), (group, key)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["euler", "bdf2"])
def test_worlds_beside_change_no_bit_of_solved_steps(integrator: str) -> None:
    """The slab alone: three worlds, and each by itself."""
    of_worlds(*(test_reduced.slab(count, integrator=integrator, **SOLVED) for count in (3, 1)))


def test_worlds_beside_change_no_bit_of_solved_steps_beside_contact() -> None:
    """The slab on a floor likewise."""
    of_worlds(lying(3), lying(1))


def of_worlds(batch: sw.Simulation, single: sw.Simulation) -> None:
    """Three worlds, and each by itself."""
    given = test_reduced.given_of
    together, rollout = gradients(Rollout(batch), given(batch, [1, 2, 3]), test_reduced.loss), Rollout(single)
    for world, seed in enumerate((1, 2, 3)):
        for group, parts in gradients(rollout, given(single, [seed]), test_reduced.loss).items():
            for key, value in parts.items():
                axis = test_reduced.axis_of(group, key)
                assert torch.equal(together[group][key].select(axis, world), value.select(axis, 0)), (group, key)
