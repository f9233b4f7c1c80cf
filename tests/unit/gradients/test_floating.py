"""Gradients of reduced bodies that turn with a floating frame, against central differences in float64."""

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Rollout, States
from softwarp.kernels.rows.touch_adjoint import AT_START, BOUNCED, LATE, MEASURED
from tests.gradient_cases import STEPS, Inputs, gradients
from tests.reduction_cases import AIR, SLAB, quadratic_modes, reduced_by, scene
from tests.unit.gradients import test_reduced
from tests.unit.gradients.test_contact import EXACT, SLIPPING, STUCK
from tests.unit.gradients.test_forward_frames import compare
from tests.unit.gradients.test_looks import looked
from tests.unit.gradients.test_rods import check
from tests.unit.gradients.test_touches import modes as found_modes

SIZES = {
    **test_reduced.SIZES,
    "state": {**test_reduced.SIZES["state"], "mode_turn": 1e-5},
    "parameters": {**test_reduced.SIZES["parameters"], "rayleigh_mass": 1e-1, "membrane_youngs": 1e3},
}


def slab(
    num_worlds: int = 1,
    precision: str = "float64",
    device: str = "cpu",
    *,
    law: Any = None,
    air: str = "volume",
    beside: bool = False,
    on: str = "",
    restitution: float = 0.0,
    tied: bool = False,
    **options: Any,
) -> sw.Simulation:
    """The free slab of ``reduction_cases`` with two thirds of its elements.

    Args:
        num_worlds: Of the model.
        precision: Likewise.
        device: Likewise.
        law: Material.
        air: Control of its chamber.
        beside: Whether a soft body that is not reduced is in the same scene.
        on: What it touches: a "ball", a "floor" that is tilted, a soft "bed"; nothing for "".
        restitution: Of the contact.
        tied: Whether a cable leads to a point in space.
        **options: Of the simulation.
    """
    builder = scene(held=False, contact=False, law=law, lone=air != "volume")
    if air != "volume":
        shell = meshing.compact(AIR.nodes + (0.01, 0.005, 0.003), AIR.surface())
        builder.add_cavity(0, *shell, control=air)  # type: ignore[arg-type]
        builder.add_cable(0, [(x, 0.015, 0.009) for x in (0.06, 0.03, 0.0)], control="force")
    weights = np.random.default_rng(0).uniform(0.5, 1.5, len(SLAB.tets))
    weights[::3] = 0.0
    builder.reduce(0, reduced_by(quadratic_modes(), frame="floating", tet_weight=weights))
    if tied:
        builder.add_cable(0, [(0.05, 0.01, 0.009), (0.05, 0.02, 0.012)], pull_point=(0.05, 0.0, 0.03), control="force")
    if beside:
        mesh = meshing.box((0.03, 0.02, 0.01), (2, 2, 1))
        other = builder.add_tets(mesh.nodes + 0.1, mesh.tets, material=sw.Corotational(5e4, 0.3), density=900.0)
        builder.fix(other, box=((-1.0, -1.0, -1.0), (1.0, 1.0, 0.1001)))
    if on:
        laws = {"mu": 0.7, "compliance": test_reduced.SOFTNESS, "alarm_distance": 0.003, "contact_distance": 0.0005}
        builder.add_contact(0, test_reduced.support(builder, on), restitution=restitution, **laws)
        options = {**EXACT, **options}
    model = builder.finalize(
        num_worlds=num_worlds, precision=precision, device=device, contact_capacity=200 if on else None
    )
    return sw.Simulation(model, dt=0.01, **options)


def given_of(sim: sw.Simulation, seeds: list[int]) -> Inputs:
    """Inputs of ``STEPS`` steps: tumbling bodies, each turned its own way."""
    given = test_reduced.given_of(sim, seeds, nodes=sim.model.own_node_count > 0)
    turns = [np.random.default_rng(100 + seed).standard_normal((1, 4)) for seed in seeds]
    if sim.model.contact is not None:  # a little, so that it stays on what it touches
        turns = [0.02 * turn + (0.0, 0.0, 0.0, 1.0) for turn in turns]
    turn = torch.tensor(np.stack(turns)).to(sim.node_x)
    given["state"]["mode_turn"] = turn / turn.norm(dim=-1, keepdim=True)
    given["state"]["mode_q"][:, 3:6] = 0.0
    if sim.model.contact is None:
        given["state"]["mode_v"][:, 3:6] *= 3.0
    return given


def loss(states: States) -> torch.Tensor:
    """A number for every world; of quaternions too."""
    weight = torch.tensor(np.random.default_rng(8).standard_normal((len(states.mode_turn), 1, 1, 4)))
    return test_reduced.loss(states) + 0.1 * (states.mode_turn * weight.to(states.mode_turn)).flatten(2).sum(dim=(0, 2))


SCENES = {
    "tumbling": slab,
    "of a projected law": partial(slab, law=sw.StableNeoHookean(1e5, 0.3)),
    "under pressure": partial(slab, air="pressure"),
    "beside a soft body, with gas": partial(slab, air="gas", beside=True),
    "on a ball": partial(slab, on="ball"),
    "tied, on a ball": partial(slab, on="ball", tied=True),
    "on a ball that is looked at once": partial(slab, on="ball", contact_passes=0),
    "on a floor": partial(slab, on="floor"),
    "on a bed": partial(slab, on="bed"),
}
LOOKS = {"on a ball": {AT_START, MEASURED}, "on a floor": {AT_START, MEASURED}, "on a bed": {AT_START, MEASURED}}
SEEDS = {"on a floor": 3, "on a bed": 5}  # in which contacts look at where a step leads to
SLOW = [
    "tied, on a ball",
    "of a projected law",
    "under pressure",
    "on a ball that is looked at once",
    "on a floor",
    "on a bed",
]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in SCENES]
)
def test_gradients_are_those_of_differences(name: str) -> None:
    """By amplitudes, velocities, turns, commands and all parameters."""
    sim = SCENES[name]()
    given = given_of(sim, [SEEDS.get(name, 1)])
    rollout, touches = Rollout(sim), sim.model.contact is not None
    youngs = {"youngs": 10.0} if touches else {}  # more of it crosses a switch
    thin = {"membrane_nu": 1e-2} if name == "on a bed" else {}  # less of it leaves rounding alone
    check(rollout, given, loss, {**SIZES, "parameters": SIZES["parameters"] | youngs | thin})
    if touches:
        assert found_modes(sim, given) & {STUCK, SLIPPING}
    if name in LOOKS:
        assert looked(rollout, given, ("node_force",)) >= LOOKS[name]


@pytest.mark.slow
@pytest.mark.parametrize(("restitution", "expected"), [(0.0, LATE), (0.5, BOUNCED)])
def test_contacts_found_late(restitution: float, expected: int) -> None:
    """Contacts that are listed where the step leads to, one that bounces in the first step among them."""
    sim = slab(on="ball", restitution=restitution)
    rollout, given = Rollout(sim), given_of(sim, [2])
    assert expected in looked(rollout, given, ("node_force",))
    names = {"state": SIZES["state"], "controls": SIZES["controls"]}  # of parameters too little is left of the loss
    check(rollout, {**given, "parameters": {}}, loss, names)


@pytest.mark.parametrize("on", ["", pytest.param("ball", marks=pytest.mark.slow)])
def test_forward_mode_agrees(on: str) -> None:
    """By rows of modes and turns; nodes follow them: y . J d = d . J' y in every input."""
    sim = slab(on=on)
    compare(Rollout(sim), given_of(sim, [1]), loss)


@pytest.mark.parametrize(("options", "precision", "device"), test_reduced.PATHS)
def test_world_of_a_batch_has_the_gradient_of_that_world_alone(
    options: dict[str, Any], precision: str, device: str
) -> None:
    """Three worlds that differ in all inputs, then each alone, with and without kept factors."""
    batch, single = (slab(count, precision, device, **options) for count in (3, 1))
    test_reduced.equal_alone(batch, single, given_of, loss)


@pytest.mark.parametrize("precision", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
def test_world_of_a_batch_that_touches_has_the_gradient_of_that_world_alone(precision: str) -> None:
    """The same on a ball."""
    exact = {} if precision == "float64" else {"gauss_seidel_tolerance": 1e-6}
    batch, single = (slab(count, precision, on="ball", **exact) for count in (3, 1))
    test_reduced.equal_alone(batch, single, given_of, loss)


@pytest.mark.parametrize("on", ["", pytest.param("floor", marks=pytest.mark.slow)])
@pytest.mark.parametrize("factors", [True, False])
def test_what_else_is_asked_for_makes_no_difference(on: str, factors: bool) -> None:
    """Of places by one command, with loads on all nodes: without velocities and with p at few nodes, and with all."""
    sim = slab(on=on)
    rollout, given = Rollout(sim), given_of(sim, [1])
    assert given["controls"]["node_force"].abs().min() > 0.0
    found = []
    for names, velocities in ((("cavity_volume",), False), (("cavity_volume", "node_force"), True)):
        controls = {name: value.clone().requires_grad_(name in names) for name, value in given["controls"].items()}
        states = rollout(given["state"], controls, given["parameters"], factors=factors)
        total = states.node_x.pow(3).sum() + states.mode_turn.pow(3).sum()
        (total + 0.0 * states.node_v.sum() if velocities else total).backward()
        found.append(controls["cavity_volume"].grad)
    assert found[0] is not None and found[1] is not None and found[0].abs().max() > 0.0
    np.testing.assert_allclose(found[0].numpy(), found[1].numpy(), rtol=1e-9, atol=1e-12 * float(found[1].abs().max()))


def test_steps_are_those_of_the_simulation() -> None:
    """To the bit, from a turn that was given."""
    sim = slab()
    given = given_of(sim, [1])
    states = Rollout(sim)(given["state"], given["controls"], given["parameters"])
    for group, target in (("state", sim), ("parameters", sim.params)):
        for name, value in given[group].items():
            getattr(target, name)[...] = value
    for step in range(STEPS):
        for name, value in given["controls"].items():
            getattr(sim.control, name)[...] = value if name == "node_force" else value[step]
        sim.step()
        for name in ("node_x", "node_v", "mode_q", "mode_v", "mode_turn"):
            assert torch.equal(getattr(sim, name), getattr(states, name)[step]), name


@pytest.mark.cuda
def test_a_gpu_finds_the_same() -> None:
    """To what sums in another order leave."""
    found = []
    for device in ("cpu", "cuda:0"):
        sim = slab(2, device=device)
        found.append(gradients(Rollout(sim), given_of(sim, [1, 2]), loss))
    for group, held in found[0].items():
        for name, value in held.items():
            error = (found[1][group][name].cpu() - value).abs().max()
            assert error <= 1e-8 * value.abs().max(), (group, name, float(error), float(value.abs().max()))
