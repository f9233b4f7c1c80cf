"""Gradients through steps of rigid bodies and rods that carry soft bodies and cables, against central differences."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Rollout, States
from tests.cases import material
from tests.gradient_cases import STEPS, Inputs, gradients
from tests.unit.gradients import test_contact
from tests.unit.gradients.test_rods import check, displaced, turned

SIZES = {
    "state": {
        "node_x": 1e-7,
        "node_v": 1e-5,
        "body_pose": 1e-7,
        "body_twist": 1e-5,
        "rod_x": 1e-8,
        "rod_q": 1e-6,
        "rod_v": 1e-5,
        "rod_w": 1e-4,
    },
    "controls": {"node_force": 1e-4, "body_force": 1e-5, "body_velocity": 1e-5, "cable_tension": 1e-4},
    "parameters": {
        "youngs": 1.0,
        "nu": 1e-5,
        "density": 1e-1,
        "rayleigh_mass": 1e-3,
        "rayleigh_stiffness": 1e-6,
        "body_mass": 1e-5,
        "body_damping": 1e-3,
        "rod_youngs": 10.0,
        "rod_density": 1e-1,
        "gravity": 1e-3,
    },
}


def arm(
    law: str = "large", num_worlds: int = 1, precision: str = "float64", *, base: str = "kinematic", **options: Any
) -> sw.Simulation:
    """A soft beam on a moving base, on a cart or on the tip of a rod, with a box at its end that a cable pulls."""
    builder = sw.ModelBuilder(gravity=(1.0, 2.0, -9.81))
    size = (0.1, 0.04, 0.04)
    beam = builder.add_tets(
        meshing.box(size, (3, 1, 1)), material=material(law, 1e5, 0.4), density=1000.0, rayleigh=(0.5, 0.01)
    )
    box = builder.add_rigid(sw.Box((0.02, 0.06, 0.05)), mass=0.03, pose=(0.11, 0.02, 0.02), damping=0.4)
    builder.attach(beam, box=((0.0999, -1, -1), (1, 1, 1)), to=box)
    if base == "kinematic":
        held = builder.add_rigid(sw.Box((0.02, 0.04, 0.04)), pose=(-0.01, 0.02, 0.02), kinematic=True)
        builder.attach(beam, box=((-1, -1, -1), (1e-6, 1, 1)), to=held)
    elif base == "cart":
        held = builder.add_rigid(
            sw.Box((0.02, 0.04, 0.04)), mass=0.02, pose=(-0.01, 0.02, 0.02), free_axes=("x", "z", "ry"), damping=0.2
        )
        builder.attach(beam, box=((-1, -1, -1), (1e-6, 1, 1)), to=held)
    else:
        line = np.linspace((-0.2, 0.02, 0.02), (0.0, 0.02, 0.02), 4)
        held = builder.add_rod(line, radius=0.01, youngs=5e7, density=1100.0, rayleigh=(0.2, 0.005))
        builder.fix(held, nodes=[0])
        builder.attach(beam, box=((-1, -1, -1), (1e-6, 1, 1)), to=held, node=3)
    builder.add_cable(
        [beam, box], [(0.03, 0.03, 0.035), (0.12, 0.03, 0.04)], pull_point=(-0.1, 0.0, 0.1), control="force"
    )
    builder.add_marker(box, (0.12, 0.02, 0.02))
    return sw.Simulation(builder.finalize(num_worlds=num_worlds, precision=precision), dt=0.01, **options)  # type: ignore[arg-type]


def bodies(sim: sw.Simulation, near: Callable[..., torch.Tensor]) -> dict[str, torch.Tensor]:
    """Poses of rigid bodies that are displaced and turned, and twists."""
    change = near(0.0 * sim.body_twist, 1.0) * torch.tensor([1e-4] * 3 + [0.02] * 3).to(sim.body_pose)
    return {"body_pose": displaced("body_pose", sim.body_pose[0], change), "body_twist": near(sim.body_twist, 1.0)}


def thrown(sim: sw.Simulation, seeds: list[int]) -> Inputs:
    """Nodes and bodies that are displaced and move; world i has those of individual ``seeds[i]``."""
    kept: dict[str, dict[str, list[torch.Tensor]]] = {"state": {}, "controls": {}}
    for seed in seeds:
        rng = np.random.default_rng(seed)

        def near(value: torch.Tensor, size: float, rng: np.random.Generator = rng) -> torch.Tensor:
            return value[0] + torch.tensor(size * rng.standard_normal(value[0].shape)).to(value)

        values = {
            "state": {
                "node_x": near(sim.node_x, 1e-3),
                "node_v": near(sim.node_v, 0.1),
                "rod_x": near(sim.rod_x, 1e-4),
                "rod_q": turned(sim.rod_q[0], near(0.0 * sim.rod_w, 0.02)),
                "rod_v": near(sim.rod_v, 0.05),
                "rod_w": near(sim.rod_w, 1.0),
                **({} if sim.model.has_kinematic else bodies(sim, near)),
            },
            "controls": {
                "node_force": near(sim.control.node_force, 0.05),
                "body_force": near(sim.control.body_force, 0.01),
                "cable_tension": near(sim.control.cable_tension, 0.0) + 2.0,
                **({"body_velocity": near(sim.control.body_velocity, 0.2)} if sim.model.has_kinematic else {}),
            },
        }
        for group, held in values.items():
            for name, value in held.items():
                kept[group].setdefault(name, []).append(value)
    stacked = {g: {n: torch.stack(v) for n, v in held.items() if v[0].numel()} for g, held in kept.items()}
    parameters = {name: getattr(sim.params, name).clone() for name in SIZES["parameters"]}
    return {**stacked, "parameters": {name: value for name, value in parameters.items() if value.numel()}}


def loss(states: States) -> torch.Tensor:
    """A random weight for every result; (world,)."""
    rng = np.random.default_rng(7)
    total = states.node_x.new_zeros(states.node_x.shape[1])
    sizes = {"node_x": 10.0, "node_v": 1.0, "body_pose": 10.0, "body_twist": 0.3, "marker_x": 10.0, "rod_w": 0.05}
    for name, size in sizes.items():
        value = getattr(states, name)
        weight = torch.tensor(rng.standard_normal((STEPS, 1, *value.shape[2:]))).to(value)[-len(value) :]
        total = total + size * (value * weight).sum(dim=(0, 2, 3))
    return total


@pytest.mark.parametrize(
    ("law", "base"),
    [
        ("large", "kinematic"),
        pytest.param("nh_log", "rod", marks=pytest.mark.slow),
        ("large", "rod"),
        ("large", "cart"),
        pytest.param("warped", "kinematic", marks=pytest.mark.slow),
    ],
)
def test_gradients_are_those_of_differences(law: str, base: str) -> None:
    """By masses, forces on bodies and all that is soft; by how a base moves and turns, or on the tip of a rod."""
    sim = arm(law, base=base)
    given = thrown(sim, [1])
    given = {
        g: {n: v.expand(STEPS, *v.shape) if g == "controls" else v for n, v in h.items()} for g, h in given.items()
    }
    check(Rollout(sim), given, loss, SIZES)


def test_worlds_and_kept_factors_change_no_bit() -> None:
    """A batch has the gradients of each world alone, whether factors are kept or not."""
    seeds = [1, 2]
    batch, single = arm(num_worlds=2, base="rod"), arm(base="rod")
    rollout, given = Rollout(batch), thrown(batch, seeds)
    plain = gradients(rollout, given, loss, steps=STEPS)
    for options in ({"factors": True}, {"every": STEPS}, {"every": STEPS, "factors": True}):
        last = gradients(rollout, given, loss, steps=STEPS, every=options.get("every", 1))
        other = gradients(rollout, given, loss, steps=STEPS, **options)
        assert all(torch.equal(other[g][n], last[g][n]) for g, held in last.items() for n in held), options
    for world, seed in enumerate(seeds):
        alone = gradients(Rollout(single), thrown(single, [seed]), loss, steps=STEPS)
        for group, held in alone.items():
            for name, value in held.items():
                assert torch.equal(plain[group][name][world], value[0]), (group, name)


def test_states_are_those_of_the_simulation() -> None:
    """A rollout takes the steps of the simulation to the bit."""
    sim = arm(base="rod")
    states = Rollout(sim)(steps=1)
    sim.step()
    for name in ("node_x", "node_v", "body_pose", "body_twist", "rod_q", "cable_tension"):
        assert torch.equal(getattr(states, name)[0], getattr(sim, name)), name
    assert torch.allclose(states.marker_x[0], sim.marker_x, atol=1e-15)


def test_refusals() -> None:
    """What of rigid bodies has no gradient is told by name."""
    sim = arm()
    with pytest.raises(ValueError, match="'body_twist' has no gradient: where kinematic bodies are"):
        Rollout(sim)({"body_twist": sim.body_twist}, steps=1)
    sim.control.body_pose[:, 1, 0] += 0.01
    with pytest.raises(RuntimeError, match="a kinematic body moved otherwise than its body_velocity says"):
        Rollout(sim)(controls={"body_velocity": sim.control.body_velocity}, steps=1)
    floor = test_contact.block(0.5)
    with pytest.raises(ValueError, match="'body_velocity' has no gradient"):
        Rollout(floor)(controls={"body_velocity": floor.control.body_velocity}, steps=1)
