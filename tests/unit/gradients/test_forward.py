"""Forward mode against reverse mode, y . J d = d . J' y, and central differences, over scenes with each part."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

import softwarp as sw
from softwarp.gradients import Rollout, States, jvp
from tests.gradient_cases import CHANGES, STEPS, Inputs, cube, gradients, inputs, weights
from tests.unit.gradients import test_contact as touching
from tests.unit.gradients import test_touches as touches
from tests.unit.gradients.test_adjoint import EXACT, GAS, difference

AGREES = 1e-10  # of both modes in float64, relative to what may cancel in their product
DIRECTIONS = 2


def directions(given: Inputs, names: dict[str, list[str]] | None = None, count: int = DIRECTIONS) -> Inputs:
    """Random changes of all inputs, or of some, with an axis of directions."""
    torch.manual_seed(5)
    found: Inputs = {}
    for group, held in given.items():
        for name, value in held.items():
            if names is None or name in names.get(group, []):
                size = CHANGES[group].get(name, 1e-5) * (value.abs() if name == "law_parameter" else 1.0)
                found.setdefault(group, {})[name] = size * torch.randn((count, *value.shape)).to(value)
    return found


def compare(rollout: Rollout, given: Inputs, loss: Callable[[States], torch.Tensor]) -> States:
    """Check every direction, in all inputs at once and in each alone."""
    found = gradients(rollout, given, loss)
    given = {group: {name: given[group][name] for name in held} for group, held in found.items()}
    whole = directions(given)
    split = [{group: {name: slope}} for group, held in whole.items() for name, slope in held.items()]
    states = None
    for along in [whole, *split]:
        states, slopes = jvp(rollout, along, given["state"], given["controls"], given["parameters"], steps=STEPS)
        for number in range(DIRECTIONS):
            terms = [(found[g][n] * s[number]).flatten() for g, held in along.items() for n, s in held.items()]
            backward, scale = sum(term.sum() for term in terms), sum(term.abs().sum() for term in terms)
            one = replace(slopes, **{name: getattr(slopes, name)[number] for name in FIELDS})
            forward = float(loss(one).sum())
            names = [name for held in along.values() for name in held]
            assert abs(forward - float(backward)) <= AGREES * float(scale), (names, forward, float(backward))
    assert states is not None
    return states


FIELDS = ("node_x", "node_v", "cable_tension", "cavity_pressure", "marker_x")

LAWS = [
    "large",
    "nh_log",
    *(
        pytest.param(law, marks=pytest.mark.slow)
        for law in ("corot", "warped", "stvk", "snh", "yeoh", "mooney_rivlin", "ogden")
    ),
]


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("strain", [0.1, 0.4])
def test_both_modes_agree(law: str, strain: float) -> None:
    """With cables, a chamber with a rate and a locked axis; at the larger strain tangents are projected."""
    sim = cube(law)
    compare(Rollout(sim), inputs(sim, [1], strain), weights(sim))


@pytest.mark.slow
def test_terms_without_a_modulus() -> None:
    """Ogden's law leaves them out; by their moduli there are gradients nevertheless, of both modes."""
    sim = cube("ogden")
    rollout, loss, given = Rollout(sim), weights(sim), inputs(sim, [1])
    law = given["parameters"]["law_parameter"]
    law[0, 3] = law[0, 5] = 0.0
    found = gradients(rollout, given, loss)["parameters"]["law_parameter"]
    for row in (3, 5):
        change = torch.zeros_like(law)
        change[0, row] = 1.0
        expected = difference(rollout, given, loss, "parameters", "law_parameter", 10.0 * change) / 10.0
        along = {"parameters": {"law_parameter": change[None]}}
        slopes = jvp(rollout, along, given["state"], given["controls"], given["parameters"], steps=STEPS)[1]
        slopes = replace(slopes, **{name: getattr(slopes, name)[0] for name in FIELDS})
        assert abs(float(found[0, row]) - expected) <= 1e-6 * abs(expected)
        assert abs(float(loss(slopes).sum()) - expected) <= 1e-6 * abs(expected)


@pytest.mark.parametrize("law", ["nh_log", pytest.param("warped", marks=pytest.mark.slow)])
def test_quadratic_elements_and_cables_that_stretch(law: str) -> None:
    """A consistent mass, a traction, and a cable's stiffness and damping."""
    sim = cube(law, quadratic=True, elastic=True)
    compare(Rollout(sim), inputs(sim, [2], 0.3), weights(sim))


@pytest.mark.parametrize(
    "chamber",
    [
        pytest.param({"control": "volume", "max_flow": 2e-5}, id="flow"),
        pytest.param({"control": "volume"}, id="volume"),
        pytest.param(GAS, id="gas"),
        pytest.param(GAS | {"max_flow": 2e-5}, id="flow of gas"),
    ],
)
def test_volumes_and_gas(chamber: dict[str, Any]) -> None:
    """Rows of chambers that are between their bounds, beside a rate that holds a cable."""
    sim = cube(chamber=chamber, **EXACT)
    sim.params.cable_max_rate[...] = 0.05
    compare(Rollout(sim), inputs(sim, [1]), weights(sim))


def test_tangent_of_pressures() -> None:
    """Pressures before a step have slopes that its matrix feels."""
    sim = cube("nh_log", chamber={}, pressure_tangent=True)
    given = inputs(sim, [1])
    given["state"]["cavity_pressure"] *= 100.0
    given["controls"]["cavity_pressure"] *= 10.0
    compare(Rollout(sim), given, weights(sim))


@pytest.mark.parametrize(
    ("mu", "speed", "laws"),
    [
        pytest.param(2.0, 0.0, {}, id="stick"),
        pytest.param(0.3, 0.3, {"compliance": 1e-4}, id="slip, soft"),
        pytest.param(0.3, 0.3, {"restitution": 0.5}, id="bounce"),
    ],
)
def test_contact(mu: float, speed: float, laws: dict[str, float]) -> None:
    """Contacts in the states that ``test_contact`` proves these scenes to have."""
    sim = touching.block(mu, **laws)
    compare(Rollout(sim), touching.thrown(sim, speed), touching.loss)


@pytest.mark.parametrize("passes", [0, 1])
def test_moving_floor(passes: int) -> None:
    """A floor that moves and turns."""
    sim = sw.Simulation(touching.block(0.8).model, dt=0.01, contact_passes=passes, **EXACT)
    sim.control.body_velocity[...] = torch.tensor([0.1, 0.0, 0.05, 0.3, -0.2, 0.5])
    compare(Rollout(sim), touching.thrown(sim, 0.1), touching.loss)


SHAPES = [  # with looks on a cylinder, forces are not unique
    pytest.param(kind, passes, marks=() if kind == "capsule" else pytest.mark.slow)
    for kind in touches.UNDER
    for passes in (0, 1)
    if (kind, passes) != ("cylinder", 1)
]


@pytest.mark.parametrize(("kind", "passes"), SHAPES)
def test_contact_with_shapes(kind: str, passes: int) -> None:
    """A soft cube on round parts, faces, edges and corners, which are looked at where steps lead to, too."""
    sim = touches.on_shape(kind, "kinematic", passes=passes)
    sim.body_twist[...] = torch.tensor([0.1, 0.05, -0.1, 0.6, -0.4, 1.0])
    given = touches.thrown(sim, 0.2, 0.3)
    compare(Rollout(sim), given, touches.loss)
    assert touches.modes(sim, given) & {touching.STUCK, touching.SLIPPING}


@pytest.mark.parametrize("passes", [0, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("lift", "along", "down"), [(-5e-4, 0.6, 0.1), (1e-3, 0.0, 0.2)])
def test_contact_of_soft_bodies(lift: float, along: float, down: float, passes: int) -> None:
    """Faces, edges and nodes of both sides, whose weights change."""
    sim = touches.on_soft(lift, passes=passes)
    given = touches.thrown(sim, along, down, (2,))
    given["state"]["node_v"][:, 27:] = 0.0
    compare(Rollout(sim), given, touches.loss)
    assert touches.modes(sim, given) >= {touching.OPEN, touching.SLIPPING}


@pytest.mark.parametrize(
    ("laws", "along", "down"),
    [
        pytest.param({"restitution": 0.5}, 0.5, 0.05, id="bounce"),
        pytest.param({"restitution": 0.5}, 1.0, 0.3, id="late bounce"),
        pytest.param({"compliance": 1e-4}, 0.2, 0.3, id="soft"),
    ],
)
def test_laws_of_contact(laws: dict[str, float], along: float, down: float) -> None:
    """Contacts on an edge that bounce or give way, with a look at where steps lead to."""
    sim = touches.on_shape("edge", "kinematic", passes=1, **laws)
    compare(Rollout(sim), touches.thrown(sim, along, down), touches.loss)


def test_slopes_are_those_of_differences() -> None:
    """One direction in everything at once, at 1e-6; the other test shows each input to agree with reverse mode."""
    sim = cube("nh_log")
    given, loss, rollout = inputs(sim, [1], 0.3), weights(sim), Rollout(sim)
    along = directions(given, count=1)
    states, slopes = jvp(rollout, along, given["state"], given["controls"], given["parameters"])

    def ends(factor: float) -> States:
        moved = {g: {n: v + factor * along[g][n][0] for n, v in held.items()} for g, held in given.items()}
        with torch.no_grad():
            return rollout(moved["state"], moved["controls"], moved["parameters"])

    near, far = (ends(1.0), ends(-1.0)), (ends(2.0), ends(-2.0))
    for name in FIELDS:
        one, two = (getattr(a, name) - getattr(b, name) for a, b in (near, far))
        expected, found = (8.0 * one - two) / 12.0, getattr(slopes, name)[0]
        assert torch.equal(getattr(states, name), getattr(ends(0.0), name))
        assert (found - expected).abs().max() <= 1e-6 * expected.abs().max(), name
    assert loss(states).isfinite().all()


def test_torch_has_the_same_forward_mode() -> None:
    """Dual tensors through a rollout, in one world and in two, of which each has the bits of the one alone."""
    whole = None
    for seeds in ([1, 2], [2]):
        sim = cube(num_worlds=len(seeds))
        given, rollout = inputs(sim, seeds), Rollout(sim)
        slope = 1e3 * torch.ones_like(given["parameters"]["youngs"])
        with torch.autograd.forward_ad.dual_level():
            youngs = torch.autograd.forward_ad.make_dual(given["parameters"]["youngs"], slope)
            states = rollout(given["state"], given["controls"], {**given["parameters"], "youngs": youngs})
            found = [torch.autograd.forward_ad.unpack_dual(getattr(states, name)).tangent for name in FIELDS]
        _, slopes = jvp(rollout, {"parameters": {"youngs": slope[None]}}, **given)
        assert all(torch.equal(a, getattr(slopes, name)[0]) for a, name in zip(found, FIELDS, strict=True))
        whole = found if whole is None else whole
    assert all(torch.equal(both[:, 1], alone[:, 0]) for both, alone in zip(whole, found, strict=True))


@pytest.mark.slow
def test_lanes_and_kept_states_in_float32() -> None:
    """Nine worlds in lanes have the slopes of worlds alone but for rounding; ``every`` picks among the states."""
    seeds = list(range(1, 10))
    sim, single = cube(num_worlds=len(seeds), precision="float32"), cube(precision="float64")
    given, alone = inputs(sim, seeds), inputs(single, [9])
    _, slopes = jvp(Rollout(sim), directions(given, {"parameters": ["youngs", "density"]}), **given)
    _, last = jvp(Rollout(sim), directions(given, {"parameters": ["youngs", "density"]}), every=STEPS, **given)
    assert torch.equal(slopes.node_v[:, -1:], last.node_v)
    along = {
        g: {n: s[:, 8:] for n, s in h.items()}
        for g, h in directions(given, {"parameters": ["youngs", "density"]}).items()
    }
    _, exact = jvp(Rollout(single), along, **alone)
    assert (slopes.node_v[:, :, 8] - exact.node_v[:, :, 0]).abs().max() < 2e-3 * exact.node_v.abs().max()


def test_refusals() -> None:
    """What is asked wrongly is told by name."""
    sim = cube()
    rollout = Rollout(sim)
    with pytest.raises(ValueError, match="along names no direction"):
        jvp(rollout, {}, steps=1)
    with pytest.raises(ValueError, match="no group 'params'"):
        jvp(rollout, {"params": {}}, steps=1)
    with pytest.raises(ValueError, match="leading axis of directions, 2 of them"):
        jvp(rollout, {"parameters": {"youngs": torch.ones(2, 1, 1), "nu": torch.ones(3, 1, 1)}}, steps=1)
    with pytest.raises(ValueError, match="has 2 steps, and the rollout 1"):
        jvp(rollout, {"controls": {"cable_tension": torch.ones(1, 2, 1, 2)}}, steps=1)
