"""Gradients through steps against central differences in float64: every input, every law, rows in all their states."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

from softwarp.gradients import Rollout, States
from tests.gradient_cases import CHANGES, STEPS, Inputs, cube, gradients, inputs, weights

LAWS = [
    "large",
    "corot",
    "nh_log",
    *(pytest.param(law, marks=pytest.mark.slow) for law in ("warped", "stvk", "snh", "yeoh", "mooney_rivlin", "ogden")),
]
TOLERANCE = 1e-6  # relative, of directional derivatives


def difference(
    rollout: Rollout,
    given: Inputs,
    loss: Callable[[States], torch.Tensor],
    group: str,
    name: str,
    change: torch.Tensor,
) -> float:
    """Derivative along ``change`` by central differences of fourth order."""

    def value(factor: float) -> float:
        held = {**given, group: {**given[group], name: given[group][name] + factor * change}}
        states = rollout(held["state"], held["controls"], held["parameters"])
        return float(loss(states).sum())

    return (8.0 * (value(1.0) - value(-1.0)) - (value(2.0) - value(-2.0))) / 12.0


def check(rollout: Rollout, given: Inputs, loss: Callable[[States], torch.Tensor], own: float = 1e-5) -> None:
    """Compare the derivative along a random direction in every input with its difference."""
    found, wrong = gradients(rollout, given, loss), []
    torch.manual_seed(3)
    for group, held in found.items():
        for name, gradient in held.items():
            size = CHANGES[group].get(name, own) * (given[group][name].abs() if name == "law_parameter" else 1.0)
            change = size * torch.randn_like(gradient)
            expected = difference(rollout, given, loss, group, name, change)
            derivative = float((gradient * change).sum())
            scale = float((gradient * change).abs().sum())  # what may cancel in both
            if not abs(derivative - expected) <= TOLERANCE * max(abs(expected), 0.1 * scale):
                wrong.append(f"{group} {name}: {derivative:.9e} instead of {expected:.9e}")
    assert not wrong, wrong


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("strain", [0.1, 0.4])
def test_gradients_are_those_of_differences(law: str, strain: float) -> None:
    """At the larger strain, elements are compressed to half: tangents are projected and guards push."""
    sim = cube(law)
    check(Rollout(sim), inputs(sim, [1], strain), weights(sim))


@pytest.mark.parametrize("law", ["warped", "nh_log", pytest.param("large", marks=pytest.mark.slow)])
def test_quadratic_elements_and_cables_that_stretch(law: str) -> None:
    """Gauss points have gradients as linear tets have; a consistent mass; stiffness and damping of a cable."""
    sim = cube(law, quadratic=True, elastic=True)
    check(Rollout(sim), inputs(sim, [2], 0.3), weights(sim))


@pytest.mark.parametrize("integrator", ["euler", "bdf2"])
@pytest.mark.parametrize("refinement", [0, 2])
def test_refinement(refinement: int, integrator: str) -> None:
    """Passes of the linear solve, none or two, and as many of its adjoint."""
    options: dict[str, Any] = EXACT if integrator == "bdf2" else {"elastic": True}
    sim = cube("nh_log", refinement=refinement, integrator=integrator, **options)
    check(Rollout(sim), inputs(sim, [1]), weights(sim))


@pytest.mark.parametrize("refinement", [1, 2])
def test_cables_alone(refinement: int) -> None:
    """Rows that are all bounded: by half-solved sides, or by passes of refinement."""
    sim = cube("warped", refinement=refinement, hollow=False)
    check(Rollout(sim), inputs(sim, [1]), weights(sim))


@pytest.mark.parametrize("graded", [False, True])
def test_gradients_of_the_exact_tangent(graded: bool) -> None:
    """Without projection, A has negative eigenvalues of elements in it; elements may have moduli of their own."""
    sim = cube("nh_log", project_tangent=False, graded=graded)
    check(Rollout(sim), inputs(sim, [1], 0.3), weights(sim))


def test_factors_of_quadratic_elements() -> None:
    """Moduli of elements that have several Gauss points each."""
    sim = cube("warped", quadratic=True, graded=True)
    check(Rollout(sim), inputs(sim, [2], 0.3), weights(sim))


@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param({"project_tangent": False}, marks=pytest.mark.slow),
        pytest.param({"integrator": "bdf2"}, marks=pytest.mark.slow),
        pytest.param({"newton_iterations": 60, "newton_tolerance": 1e-13}, marks=pytest.mark.slow),
    ],
)
def test_membranes(options: dict[str, Any]) -> None:
    """By their moduli, and by all that stretches and presses them; the negative part of their stress is not in A."""
    sim = cube("nh_log", covered=True, **options)
    check(Rollout(sim), inputs(sim, [1]), weights(sim))


def test_some_tangents_are_projected() -> None:
    """The strained state of these tests has clamped elements, or they would prove nothing about the projection."""
    ends = []
    for project in (True, False):
        sim = cube("nh_log", project_tangent=project)
        given = inputs(sim, [1], 0.4)
        with torch.no_grad():
            ends.append(Rollout(sim)(given["state"], given["controls"], given["parameters"]).node_x)
    assert (ends[0] - ends[1]).abs().max() > 1e-5


def test_slack_and_saturated_cables_pass_their_commands_no_gradient() -> None:
    """A slack cable has tension 0 whatever small change; a saturated one its largest, also within limits of rates."""
    sim = cube()
    given = inputs(sim, [1])
    given["controls"]["cable_displacement"] = torch.tensor([[[-0.05, 0.0]]] * 3).to(sim.node_x)
    given["controls"]["cable_tension"] = torch.tensor([[[0.0, -2.0]]] * 3).to(sim.node_x)
    found = gradients(Rollout(sim), given, weights(sim))
    assert not found["controls"]["cable_displacement"].any()
    assert not found["controls"]["cable_tension"].any()
    assert found["controls"]["node_force"].any()


def test_limited_commands() -> None:
    """Limits of tension and rates of displacement are active in the forward steps, and differences agree."""
    sim = cube()
    sim.params.cable_max_rate[...] = 0.05
    sim.params.cable_max_tension[...] = 2.0
    given = inputs(sim, [1])
    given["controls"]["cable_tension"] += 1.5
    rollout, loss = Rollout(sim), weights(sim)
    check(rollout, given, loss)
    found = gradients(rollout, given, loss)
    assert not found["controls"]["cable_displacement"].any()
    assert not found["controls"]["cable_tension"][:, 0, 1].any()


EXACT = {"gauss_seidel_tolerance": 1e-15, "gauss_seidel_iterations": 3000}
GAS = {"control": "gas", "exponent": 1.4}


@pytest.mark.parametrize(
    ("chamber", "factor", "is_free"),
    [
        pytest.param({"control": "volume", "max_flow": 2e-5}, 1.0, False, id="flow"),
        pytest.param({"control": "volume"}, 1.3, True, id="stride"),
        pytest.param(GAS, 1.0, True, id="gas"),
        pytest.param(GAS | {"max_flow": 2e-5}, 1.0, False, id="flow of gas"),
    ],
)
def test_volumes_and_gas(chamber: dict[str, Any], factor: float, is_free: bool) -> None:
    """Commanded volumes and gas; what a flow or the stride of a step overrules follows the start of the step instead.

    The volume that is too far for the first step is reached in the second one.
    """
    sim = cube(chamber=chamber, **EXACT)
    given = inputs(sim, [1])
    given["controls"]["cavity_volume"] *= factor
    if is_free or chamber["control"] == "volume":
        del given["state"]["cavity_pressure"]  # a first guess only
    rollout, loss = Rollout(sim), weights(sim)
    check(rollout, given, loss)
    found = gradients(rollout, given, loss)["controls"]
    assert bool(found[f"cavity_{chamber['control']}"].any()) == is_free
    assert not found["cavity_pressure"].any()


@pytest.mark.parametrize("blow", [None, 0.0, 20.0])
def test_tangent_of_pressures(blow: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pressures at the start of steps are in A; also where a command overrules them, and in stages, rough ones too."""
    sim = cube("nh_log", chamber={}, pressure_tangent=True)
    if blow is not None:
        sim = cube("nh_log", chamber={}, pressure_tangent=True, integrator="bdf2", **EXACT)
        monkeypatch.setitem(CHANGES["state"], "cavity_pressure", 300.0)  # else differences are rounding
    given = inputs(sim, [1])
    given["controls"]["node_force"] += blow or 0.0
    given["state"]["cavity_pressure"] *= 100.0
    given["controls"]["cavity_pressure"] *= 10.0
    rollout, loss = Rollout(sim), weights(sim)
    check(rollout, given, loss)
    assert gradients(rollout, given, loss)["state"]["cavity_pressure"].any()


@pytest.mark.parametrize(
    ("law", "rate", "quadratic"), [("large", None, False), ("nh_log", 0.05, False), ("warped", None, True)]
)
def test_steps_of_second_order(law: str, rate: float | None, quadratic: bool) -> None:
    """Two stages, linearised where velocities lead to, with an extrapolation between; cables go part of their way.

    The velocity at the start has a part along a locked axis, which counts for nothing.
    """
    sim = cube(law, integrator="bdf2", quadratic=quadratic, **EXACT)
    if rate is not None:
        sim.params.cable_max_rate[...] = rate
    rollout, loss, given = Rollout(sim), weights(sim), inputs(sim, [1])
    check(rollout, given, loss)
    if rate is None:
        plain, sparse = (gradients(rollout, given, _at_the_end, every=every) for every in (1, STEPS))
        for group, held in sparse.items():
            assert all(torch.equal(plain[group][name], value) for name, value in held.items())


def test_steps_of_second_order_keep_no_factors() -> None:
    """They are told so."""
    with pytest.raises(ValueError, match="keeps no factors"):
        Rollout(cube(integrator="bdf2"))(steps=1, factors=True)


def _at_the_end(states: States) -> torch.Tensor:
    return states.node_x[-1].square().sum()
