"""Gradients of steps of second order of reduced bodies, by every input, against differences in float64."""

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp.gradients import Rollout, States
from softwarp.solvers.second_order_adjoint import SecondOrderAdjoint
from tests.cases import FITTED
from tests.gradient_cases import STEPS, Inputs, gradients
from tests.reduction_cases import SLAB, reduced_by, scene, smooth_modes
from tests.unit.gradients.test_contact import SLIPPING, STUCK
from tests.unit.gradients.test_forward_frames import compare
from tests.unit.gradients.test_reduced import PATHS, SIZES, TOUCHING, axis_of, given_of, loss, slab
from tests.unit.gradients.test_rods import check
from tests.unit.gradients.test_touches import modes as found_modes

SLOW = pytest.mark.slow


def swinging(num_worlds: int = 1, precision: str = "float64", device: str = "cpu", **options: Any) -> sw.Simulation:
    """The slab with two thirds of its elements and its membrane, held, without any rows."""
    builder = scene(held=True, contact=False, law=FITTED["yeoh"](1e5, 0.3), lone=True)
    weights = np.random.default_rng(0).uniform(0.5, 1.5, len(SLAB.tets))
    weights[::3] = 0.0
    builder.reduce(0, reduced_by(smooth_modes(held=True), tet_weight=weights))
    model = builder.finalize(num_worlds=num_worlds, precision=precision, device=device)
    return sw.Simulation(model, dt=0.01, integrator="trapezoidal", **options)


def free_given(sim: sw.Simulation, seeds: list[int]) -> Inputs:
    """Inputs as of ``given_of``, of a scene without a chamber and cable."""
    values: dict[str, dict[str, list[torch.Tensor]]] = {"state": {}, "controls": {}, "parameters": {}}
    size = sim.model.mode_count
    for seed in seeds:
        rng = np.random.default_rng(seed)
        found: dict[str, dict[str, Any]] = {
            "state": {"mode_q": 1e-4 * rng.standard_normal(size), "mode_v": 0.03 * rng.standard_normal(size)},
            "controls": {"node_force": 0.02 * rng.standard_normal((STEPS, sim.model.node_count, 3))},
            "parameters": {},
        }
        for name in SIZES["parameters"]:
            value = getattr(sim.params, name)[0].cpu().numpy()
            if value.size and (name != "law_parameter" or np.any(value)):
                found["parameters"][name] = value * rng.uniform(0.95, 1.05)
        for group, held in found.items():
            for name, value in held.items():
                values[group].setdefault(name, []).append(torch.tensor(value).to(sim.node_x))
    return {
        group: {name: torch.stack(parts, dim=int(name == "node_force")) for name, parts in held.items()}
        for group, held in values.items()
    }


second = partial(slab, integrator="bdf2")
TOUCHING_BALL = partial(second, on="ball")
SCENES = {
    "held": second,
    "of a law of own parameters": partial(second, law=FITTED["yeoh"](1e5, 0.3)),
    "beside a soft body": partial(second, beside=True),
    "under pressure": partial(second, air="pressure"),
    "with gas": partial(second, air="gas"),
}


@pytest.mark.parametrize("name", ["held", *(pytest.param(name, marks=SLOW) for name in list(SCENES)[1:])])
def test_gradients_of_bdf2_are_those_of_differences(name: str) -> None:
    """Held by its chamber and cable, with membranes and chosen elements."""
    sim = SCENES[name]()
    given = given_of(sim, [1], nodes=sim.model.own_node_count > 0)
    check(Rollout(sim), given, loss, SIZES)


def test_gradients_of_the_trapezoidal_rule_are_those_of_differences() -> None:
    """Where no rows make it ``bdf2``."""
    sim = swinging()
    check(Rollout(sim), free_given(sim, [1]), loss, SIZES)


@pytest.mark.parametrize("scene", [second, *(pytest.param(scene, marks=SLOW) for scene in (swinging, TOUCHING_BALL))])
def test_forward_mode_agrees(scene: Any) -> None:
    """By rows of modes, y . J d = d . J' y in every input."""
    sim = scene()
    compare(Rollout(sim), free_given(sim, [1]) if scene is swinging else given_of(sim, [1]), loss)


@pytest.mark.parametrize("name", ["on a ball", *(pytest.param(name, marks=SLOW) for name in list(TOUCHING)[1:5])])
def test_gradients_beside_contact_are_those_of_differences(name: str) -> None:
    """Worlds that touch something are rough: three stages, whose contacts are looked at where these lead to."""
    sim = TOUCHING[name](integrator="bdf2")
    given, sizes = given_of(sim, [2 if name == "on a soft bed" else 1], nodes=sim.model.own_node_count > 0), SIZES
    if name == "on a soft bed":  # else a contact changes its state on the way of the difference
        sizes = {**SIZES, "parameters": {**SIZES["parameters"], "youngs": 30.0}}
    if name == "of a skin that slips":  # else the difference is rounding
        sizes = {**SIZES, "parameters": {**SIZES["parameters"], "pair_mu": 1e-4}}
    check(Rollout(sim), given, loss, sizes)
    assert found_modes(sim, given) & {STUCK, SLIPPING}


def blown(sim: sw.Simulation, seeds: list[int]) -> Inputs:
    """Inputs of worlds, of which those with even seeds are hit at one node of the tip."""
    given = given_of(sim, seeds)
    for world, seed in enumerate(seeds):
        given["controls"]["node_force"][world, -1] += 3.0 * (seed % 2 == 0)
    return given


def test_a_blow_makes_a_world_rough(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stages that are linearised at their starts, without an extrapolation."""
    thirds, pull = [], SecondOrderAdjoint._pull_third

    def counted(self: SecondOrderAdjoint, *, parameters: bool) -> None:
        thirds.append(parameters)
        pull(self, parameters=parameters)

    monkeypatch.setattr(SecondOrderAdjoint, "_pull_third", counted)
    sim = second()
    check(Rollout(sim), blown(sim, [2]), loss, SIZES)
    assert thirds


@pytest.mark.parametrize(("options", "precision", "device"), PATHS)
@pytest.mark.parametrize(
    ("scene", "given_of"),
    [
        pytest.param(second, blown, id="bdf2"),
        pytest.param(TOUCHING_BALL, given_of, id="contact"),
        pytest.param(swinging, free_given, id="trapezoidal"),
    ],
)
def test_world_of_a_batch_has_the_gradient_of_that_world_alone(
    scene: Any, given_of: Any, options: dict[str, Any], precision: str, device: str
) -> None:
    """Three worlds, of which one is hit, or that touch a ball, beside each other and alone."""
    batch, single = (scene(count, precision, device, **options) for count in (3, 1))
    seeds = [1, 2, 3]
    together, rollout = gradients(Rollout(batch), given_of(batch, seeds), loss), Rollout(single)
    for world, seed in enumerate(seeds):
        for group, held in gradients(rollout, given_of(single, [seed]), loss).items():
            for name, value in held.items():
                axis = int(given_of is free_given and name == "node_force") or axis_of(group, name)
                assert torch.equal(together[group][name].select(axis, world), value.select(axis, 0)), (group, name)


def test_beside_a_body_that_tumbles() -> None:
    """By its state too; velocities of solved stages and final ones are not the same there."""
    builder = scene(held=True, contact=False)
    builder.reduce(0, reduced_by(smooth_modes(held=True)))
    builder.add_rigid(sw.Box((0.05, 0.03, 0.02)), mass=0.05, pose=(0.8, 0.0, 0.0), damping=0.3)
    model = builder.finalize(num_worlds=1, precision="float64")
    sim = sw.Simulation(model, dt=0.01, integrator="bdf2")
    given = given_of(sim, [1])
    given["state"]["body_twist"] = torch.tensor([[[0.1, 0.2, -0.1, 3.0, 1.0, -2.0]]], dtype=torch.float64)
    sizes = {**SIZES, "state": {**SIZES["state"], "body_twist": 1e-5}}

    def all_of(states: States) -> torch.Tensor:
        return loss(states) + (states.body_pose[..., :3] * torch.tensor([1.0, -2.0, 0.5])).sum(dim=(0, 2, 3))

    check(Rollout(sim), given, all_of, sizes)


@pytest.mark.cuda
@pytest.mark.parametrize("scene", [second, swinging])
def test_a_gpu_finds_the_same(scene: Any) -> None:
    """To what sums in another order leave."""
    found = []
    for device in ("cpu", "cuda:0"):
        sim = scene(2, device=device)
        given = given_of(sim, [1, 2]) if scene is second else free_given(sim, [1, 2])
        found.append(gradients(Rollout(sim), given, loss))
    for group, held in found[0].items():
        for name, value in held.items():
            error = (found[1][group][name].cpu() - value).abs().max()
            assert error <= 1e-8 * value.abs().max(), (group, name, float(error), float(value.abs().max()))
