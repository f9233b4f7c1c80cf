"""Gradients through steps of rigid bodies that nothing soft holds, against central differences in float64."""

from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp.gradients import Rollout, States
from tests.gradient_cases import STEPS, Inputs, gradients
from tests.unit.gradients.test_rigid import bodies
from tests.unit.gradients.test_rods import check

SIZES = {
    "state": {"body_pose": 1e-7, "body_twist": 1e-5},
    "controls": {"body_force": 1e-6, "cable_tension": 1e-5, "cable_displacement": 1e-7},
    "parameters": {"body_mass": 1e-6, "body_damping": 1e-3, "gravity": 1e-3},
}
WEIGHTS = {"body_pose": 10.0, "body_twist": 0.3, "marker_x": 10.0, "node_x": 10.0, "node_v": 1.0}


def tumbling(num_worlds: int = 1, precision: str = "float64", **options: Any) -> sw.Simulation:
    """A box that tumbles freely, one on two cables, and a cart that slides along x and turns about y."""
    builder = sw.ModelBuilder(gravity=(1.0, 2.0, -9.81))
    builder.add_rigid(mass=0.05, inertia=(2e-5, 3e-5, 4.5e-5), damping=0.3, name="top")
    hung = builder.add_rigid(sw.Box((0.04, 0.06, 0.02)), mass=0.1, pose=(0.3, 0.0, 0.0))
    cart = builder.add_rigid(sw.Box((0.05, 0.03, 0.02)), mass=0.2, pose=(0.5, 0.0, 0.0), free_axes=("x", "ry"))
    builder.add_cable([hung, cart], [(0.31, 0.02, 0.01), (0.51, 0.01, 0.01)], control="force")
    builder.add_cable(hung, [(0.29, -0.02, 0.01)], pull_point=(0.3, 0.0, 0.5))
    builder.add_marker(hung, (0.32, 0.03, 0.01))
    model = builder.finalize(num_worlds=num_worlds, precision=precision)  # type: ignore[arg-type]
    return sw.Simulation(model, dt=0.01, **options)


def thrown(sim: sw.Simulation, seeds: list[int], spin: float = 8.0) -> Inputs:
    """Bodies that are displaced, turned and spin; world i has those of individual ``seeds[i]``."""
    worlds: dict[str, list[torch.Tensor]] = {"body_pose": [], "body_twist": [], "body_force": []}
    for seed in seeds:
        rng = np.random.default_rng(seed)

        def near(value: torch.Tensor, size: float, rng: np.random.Generator = rng) -> torch.Tensor:
            return value[0] + torch.tensor(size * rng.standard_normal(value[0].shape)).to(value)

        found = bodies(sim, near)
        found["body_twist"][:, 3:] *= spin
        found["body_force"] = near(sim.control.body_force, 0.1) * torch.tensor([1.0] * 3 + [0.02] * 3).to(sim.body_pose)
        for name, value in found.items():
            worlds[name].append(value)
    stacked = {name: torch.stack(value) for name, value in worlds.items()}
    force = stacked.pop("body_force").expand(STEPS, -1, -1, -1)
    commands = {"cable_tension": 0.4, "cable_displacement": 2e-3}
    ones = torch.ones_like(sim.control.cable_tension).expand(STEPS, -1, -1)
    return {
        "state": stacked,
        "controls": {"body_force": force, **{name: value * ones for name, value in commands.items()}},
        "parameters": {name: getattr(sim.params, name).clone() for name in SIZES["parameters"]},
    }


def loss(states: States) -> torch.Tensor:
    """A random weight for every result; (world,)."""
    rng = np.random.default_rng(7)
    total = states.body_pose.new_zeros(states.body_pose.shape[1])
    for name, size in WEIGHTS.items():
        value = getattr(states, name)
        weight = torch.tensor(rng.standard_normal((STEPS, 1, *value.shape[2:]))).to(value)[-len(value) :]
        total = total + size * (value * weight).sum(dim=(0, 2, 3))
    return total + 0.1 * states.cable_tension.sum(dim=(0, 2))


@pytest.mark.parametrize("integrator", ["euler", "bdf2"])
@pytest.mark.parametrize("spin", [pytest.param(1.0, marks=pytest.mark.slow), 30.0])
def test_gradients_are_those_of_differences(spin: float, integrator: str) -> None:
    """Of tops that turn by up to half a radian a step, and of a cart on a rail."""
    sim = tumbling(integrator=integrator)
    check(Rollout(sim), thrown(sim, [1], spin), loss, SIZES)


def alone(num_worlds: int = 1, **options: Any) -> sw.Simulation:
    """Two bodies that tumble freely, one about axes that are not its own; nothing else is there."""
    builder = sw.ModelBuilder(gravity=(1.0, 2.0, -9.81))
    builder.add_rigid(mass=0.05, inertia=(2e-5, 3e-5, 4.5e-5), damping=0.3)
    inertia = ((6e-5, 1e-5, 0.0), (1e-5, 1.1e-4, -5e-6), (0.0, -5e-6, 7e-5))
    builder.add_rigid(mass=0.1, inertia=inertia, pose=(0.2, 0.1, 0.0))
    model = builder.finalize(num_worlds=num_worlds, precision="float64")
    return sw.Simulation(model, dt=0.01, **options)


def spun(sim: sw.Simulation, seeds: list[int]) -> Inputs:
    """As ``thrown``, of a scene without cables."""
    given = thrown(sim, seeds, 30.0)
    given["controls"] = {"body_force": given["controls"]["body_force"]}
    return given


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"integrator": "bdf2"},
        {"newton_iterations": 60, "newton_tolerance": 1e-13},
        {"newton_iterations": 60, "newton_tolerance": 1e-13, "integrator": "bdf2"},
    ],
)
def test_tops_alone(options: dict[str, Any]) -> None:
    """Where nothing but free tops is, which have no rows and carry nothing; both modes agree."""
    sim = alone(**options)
    sizes = {**SIZES, "parameters": {"body_mass": 1e-5, "body_damping": 1e-2, "gravity": 1e-3}}
    check(Rollout(sim), spun(sim, [1]), loss, sizes)


def test_a_top_turns_as_a_spin_about_a_principal_axis_says() -> None:
    """A spin w about a principal axis turns it by w t: the end's quaternion has the slope t/2 by w, at any spin."""
    sim = tumbling()
    rollout = Rollout(sim)
    spin = torch.tensor(12.0, dtype=torch.float64, requires_grad=True)
    twist = torch.zeros_like(sim.body_twist)
    twist = torch.cat([twist[..., :5], torch.stack([spin, spin * 0.0, spin * 0.0]).reshape(1, 3, 1)], dim=-1)
    still = {"gravity": torch.zeros_like(sim.params.gravity), "body_damping": torch.zeros_like(sim.params.body_damping)}
    turned = rollout({"body_twist": twist}, parameters=still, steps=4).body_pose[-1, 0, 0, 3:]
    (slope,) = torch.autograd.grad(turned[2], spin)
    angle = 12.0 * 4 * sim.dt
    assert abs(float(turned[2].detach()) - np.sin(0.5 * angle)) < 1e-6
    assert abs(float(slope) - 0.5 * 4 * sim.dt * np.cos(0.5 * angle)) < 1e-6


def test_worlds_and_kept_factors_change_no_bit() -> None:
    """A batch has the gradients of each world alone, whether factors are kept or not."""
    seeds = [1, 2]
    batch, single = tumbling(num_worlds=2), tumbling()
    rollout, given = Rollout(batch), thrown(batch, seeds)
    plain = gradients(rollout, given, loss, steps=STEPS)
    kept = gradients(rollout, given, loss, steps=STEPS, factors=True)
    assert all(torch.equal(kept[g][n], plain[g][n]) for g, held in plain.items() for n in held)
    for world, seed in enumerate(seeds):
        alone = gradients(Rollout(single), thrown(single, [seed]), loss, steps=STEPS)
        for name, value in alone["state"].items():
            assert torch.equal(plain["state"][name][world], value[0]), name
