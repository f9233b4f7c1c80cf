"""Gradients through Maxwell branches, carried quadratic elements and stages beside frames, and of their equilibria."""

from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Equilibrium, Rollout
from tests.cases import material
from tests.gradient_cases import STEPS, Inputs, gradients
from tests.unit.gradients import test_adjoint, test_contact, test_rigid
from tests.unit.gradients.test_forward_frames import compare
from tests.unit.gradients.test_rods import check

SIZES = {
    **test_rigid.SIZES,
    "parameters": {**test_rigid.SIZES["parameters"], "relaxation_ratio": 1e-4, "relaxation_time": 1e-5},
}
MEMORY = (0.4, 0.02)
RESTING: dict[str, float] = {  # what an equilibrium depends on, and the change for differences
    "body_force": 1e-4,
    "node_force": 1e-4,
    "cable_tension": 1e-4,
    "youngs": 10.0,
    "nu": 1e-4,
    "density": 0.1,
    "gravity": 1e-3,
    "body_mass": 1e-5,
}


def beam(
    base: str = "fixed", integrator: str = "euler", num_worlds: int = 1, *, quadratic: bool = True, law: str = "snh"
) -> sw.Simulation:
    """A beam with a memory and a box on its end, one element wide; its other end is fixed or moved."""
    builder = sw.ModelBuilder(gravity=(1.0, 2.0, -9.81))
    mesh = meshing.box((0.1, 0.04, 0.04), (2, 1, 1))
    body = builder.add_tets(
        meshing.elevate(mesh) if quadratic else mesh,
        material=material(law, 1e5, 0.4),
        density=1000.0,
        rayleigh=(0.5, 0.01),
        relaxation=MEMORY,
    )
    box = builder.add_rigid(sw.Box((0.02, 0.06, 0.05)), mass=0.03, pose=(0.11, 0.02, 0.02), damping=0.4)
    builder.attach(body, box=((0.0999, -1, -1), (1, 1, 1)), to=box)
    if base == "fixed":
        builder.fix(body, box=((-1, -1, -1), (1e-6, 1, 1)))
    else:
        held = builder.add_rigid(sw.Box((0.02, 0.04, 0.04)), pose=(-0.01, 0.02, 0.02), kinematic=True)
        builder.attach(body, box=((-1, -1, -1), (1e-6, 1, 1)), to=held)
    builder.add_cable(
        [body, box], [(0.03, 0.03, 0.035), (0.12, 0.03, 0.04)], pull_point=(-0.1, 0.0, 0.1), control="force"
    )
    builder.add_marker(box, (0.12, 0.02, 0.02))
    model = builder.finalize(num_worlds=num_worlds, precision="float64")
    return sw.Simulation(model, dt=0.01, integrator=integrator)  # type: ignore[arg-type]


def given_of(sim: sw.Simulation, seeds: list[int]) -> Inputs:
    """Nodes and bodies that are displaced and move a little."""
    given = test_rigid.thrown(sim, seeds)
    for name in ("node_v", "body_twist"):
        if name in given["state"]:
            given["state"][name] *= 0.1
    for name in ("relaxation_ratio", "relaxation_time"):
        given["parameters"][name] = getattr(sim.params, name).clone()
    return given


@pytest.mark.parametrize(
    ("base", "integrator", "options"),
    [
        ("fixed", "euler", {}),
        ("fixed", "bdf2", {}),
        ("kinematic", "bdf2", {}),
        pytest.param("kinematic", "euler", {}, marks=pytest.mark.slow),
        pytest.param("kinematic", "bdf2", {"quadratic": False, "law": "large"}, marks=pytest.mark.slow),
    ],
)
def test_gradients_are_those_of_differences(base: str, integrator: str, options: dict[str, Any]) -> None:
    """By ratio and time of the branch, and all inputs that a carried beam has."""
    sim = beam(base, integrator, **options)
    given = given_of(sim, [2])
    given["controls"] = {name: value.expand(STEPS, *value.shape) for name, value in given["controls"].items()}
    check(Rollout(sim), given, test_rigid.loss, SIZES)


@pytest.mark.parametrize(
    ("integrator", "quadratic"),
    [
        ("bdf2", True),
        pytest.param("bdf2", False, marks=pytest.mark.slow),
        pytest.param("euler", False, marks=pytest.mark.slow),
        pytest.param("euler", True, marks=pytest.mark.slow),
    ],
)
def test_both_modes_agree(integrator: str, quadratic: bool) -> None:
    """The forward mode has slopes of memories too, and of quadratic elements that are carried."""
    sim = beam(integrator=integrator, quadratic=quadratic)
    compare(Rollout(sim), given_of(sim, [1]), test_rigid.loss)


@pytest.mark.parametrize("integrator", ["bdf2", "euler"])
def test_worlds_beside_change_no_bit(integrator: str) -> None:
    """A batch has the gradients of each world alone; with Euler's rule kept factors give the same ones."""
    seeds = [1, 2]
    batch, single = beam(integrator=integrator, num_worlds=2), beam(integrator=integrator)
    together = gradients(Rollout(batch), given_of(batch, seeds), test_rigid.loss, steps=STEPS)
    for world, seed in enumerate(seeds):
        alone = gradients(Rollout(single), given_of(single, [seed]), test_rigid.loss, steps=STEPS)
        for group, held in alone.items():
            for name, value in held.items():
                assert torch.equal(together[group][name][world], value[0]), (group, name)
    if integrator == "euler":
        kept = gradients(Rollout(batch), given_of(batch, seeds), test_rigid.loss, steps=STEPS, factors=True)
        for group, held in kept.items():
            assert all(torch.equal(together[group][name], value) for name, value in held.items())


def test_a_cube_that_touches_a_floor() -> None:
    """By ratio and time too; of a batch each world's alone, whether factors are kept or not."""
    batch, single = (test_contact.block(0.5, worlds, memory=(0.3, 0.02)) for worlds in (2, 1))

    def given(sim: sw.Simulation, seeds: tuple[int, ...]) -> Inputs:
        found = test_contact.thrown(sim, 0.3, seeds)
        for name in ("relaxation_ratio", "relaxation_time"):
            found["parameters"][name] = getattr(sim.params, name).clone()
        return found

    rollout = Rollout(single)
    test_adjoint.check(rollout, given(single, (1,)), test_contact.loss)
    together = gradients(Rollout(batch), given(batch, (1, 2)), test_contact.loss, factors=True)
    for world, seed in enumerate((1, 2)):
        alone = gradients(rollout, given(single, (seed,)), test_contact.loss)
        for group in ("state", "parameters"):
            for name, value in alone[group].items():
                assert torch.equal(together[group][name][world], value[0]), (group, name)


def test_equilibria_of_carried_beams() -> None:
    """Gradients by loads, masses and moduli; of a batch each world's alone, and from the last pose the same."""
    batch, single = beam(num_worlds=2), beam()

    def given(sim: sw.Simulation, seeds: list[int]) -> dict[str, torch.Tensor]:
        found: dict[str, list[torch.Tensor]] = {name: [] for name in RESTING}
        for seed in seeds:
            rng = np.random.default_rng(seed)
            for name in RESTING:
                value = getattr(sim.control if name in list(RESTING)[:3] else sim.params, name)[0]
                noise = torch.tensor(rng.standard_normal(tuple(value.shape))).to(value)
                size = {"node_force": 0.01, "body_force": 0.02, "cable_tension": 0.3}.get(name, 0.03 * value.abs())
                found[name].append(value + size * noise.abs() if name == "cable_tension" else value + size * noise)
        return {name: torch.stack(values) for name, values in found.items()}

    def loss(equilibrium: Equilibrium, values: dict[str, torch.Tensor]) -> torch.Tensor:
        controls, parameters = (dict(list(values.items())[part]) for part in (slice(3), slice(3, None)))
        pose, rng = equilibrium(controls, parameters), np.random.default_rng(5)
        total = torch.zeros((), dtype=torch.float64)
        for value in (pose.node_x, pose.body_pose, pose.marker_x):
            total = total + (value * torch.tensor(rng.standard_normal(value.shape[1:]))).sum()
        return total

    def slopes(equilibrium: Equilibrium, values: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
        loss(equilibrium, leaves).backward()
        return {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}

    equilibrium = Equilibrium(single)
    values = given(single, [1])
    found = slopes(equilibrium, values)
    torch.manual_seed(3)
    for name, size in RESTING.items():
        change = size * torch.randn_like(values[name])
        with torch.no_grad():
            far = [float(loss(equilibrium, {**values, name: values[name] + f * change})) for f in (2, 1, -1, -2)]
        expected = (8.0 * (far[1] - far[2]) - (far[0] - far[3])) / 12.0
        assert float((found[name] * change).sum()) == pytest.approx(expected, rel=1e-6), name
    together = slopes(Equilibrium(batch), given(batch, [1, 2]))
    assert all(torch.equal(together[name][0], value[0]) for name, value in found.items())
    warm = Equilibrium(single, warm=True)
    slopes(warm, given(single, [2]))
    again = slopes(warm, values)
    assert all(torch.allclose(again[name], value, rtol=1e-6, atol=1e-12) for name, value in found.items())
