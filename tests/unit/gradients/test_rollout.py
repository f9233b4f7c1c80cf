"""Rollouts: the steps of the simulation to the bit, kept states and factors, and what is refused."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Rollout
from tests.cases import material
from tests.gradient_cases import STEPS, cube, gradients, inputs, weights


def test_states_are_those_of_the_simulation() -> None:
    """A rollout takes the very steps that ``sim`` would, and leaves it as it is."""
    sim = cube(precision="float32")
    given = inputs(sim, [1])
    before = sim.snapshot()
    with torch.no_grad():
        states = Rollout(sim)(given["state"], given["controls"], given["parameters"])
    assert all(torch.equal(value, before.arrays[name]) for name, value in sim.snapshot().arrays.items())
    for name, value in given["parameters"].items():
        getattr(sim.params, name)[...] = value
    for name, value in given["state"].items():
        getattr(sim, name)[...] = value
    for step in range(STEPS):
        for name, value in given["controls"].items():
            getattr(sim.control, name)[...] = value[step] if value.ndim > sim.control.tensors()[name].ndim else value
        sim.step()
        for name in ("node_x", "node_v", "cable_tension", "cavity_pressure"):
            assert torch.equal(getattr(states, name)[step], getattr(sim, name)), (name, step)
        torch.testing.assert_close(states.marker_x[step], sim.marker_x)


def test_kept_states_and_factors_change_no_bit() -> None:
    """Steps taken again, and factors kept, give the gradients of a pass that keeps every state."""
    sim = cube()
    rollout, given, loss = Rollout(sim), inputs(sim, [1]), weights(sim)
    for every in (1, STEPS):
        plain = gradients(rollout, given, loss, every=every)
        for factors in (False, True):
            found = gradients(rollout, given, loss, every=every, factors=factors)
            for group, held in found.items():
                for name, value in held.items():
                    assert torch.equal(value, plain[group][name]), (every, factors, name)


@pytest.mark.parametrize(("path", "precision"), [("scalar", "float64"), ("scalar", "float32"), ("lanes", "float32")])
def test_factors_are_read_where_they_are_kept(path: str, precision: str) -> None:
    """From the third pass through the same memory on, which has the bits of those before and of steps solved again."""
    sim = cube(num_worlds=2, precision=precision, solver_path=path, hollow=False)
    rollout, given, loss = Rollout(sim), inputs(sim, [1, 2]), weights(sim)
    other = inputs(sim, [3, 4])
    plain = gradients(rollout, given, loss)
    for _ in range(4):
        gradients(rollout, other, loss, factors=True)  # where steps have their factors there are those of others
        found = gradients(rollout, given, loss, factors=True)
        for group, held in found.items():
            for name, value in held.items():
                assert torch.equal(value, plain[group][name]), name


def test_sides_of_rows_are_kept_instead_of_the_matrix() -> None:
    """A step with few bounded rows keeps L^-1 H'; where more refinement is asked for it keeps A, and goes by that."""
    found, sizes = [], []
    for refinement in (1, 2):
        sim = cube(hollow=False, refinement=refinement)
        rollout = Rollout(sim)
        sizes.append(rollout.solution_bytes)
        found.append(gradients(rollout, inputs(sim, [1]), weights(sim), factors=True))
    assert sizes[0] < sizes[1]
    for group, held in found[0].items():
        for name, value in held.items():
            torch.testing.assert_close(value, found[1][group][name], rtol=1e-9, atol=1e-9 * float(value.abs().max()))


def test_two_graphs_at_once() -> None:
    """Backward passes do not depend on what was called in between, and may be repeated."""
    sim = cube()
    rollout, loss = Rollout(sim), weights(sim)
    youngs = [torch.tensor([[value]], dtype=torch.float64, requires_grad=True) for value in (1e5, 2e5)]
    losses = [loss(rollout(parameters={"youngs": value}, steps=STEPS, factors=True)) for value in youngs]
    together = [torch.autograd.grad(losses[i], youngs[i], retain_graph=True)[0] for i in (1, 0, 1)]
    alone = [
        torch.autograd.grad(loss(rollout(parameters={"youngs": value}, steps=STEPS)), value)[0] for value in youngs
    ]
    assert [torch.equal(together[n], alone[i]) for n, i in enumerate((1, 0, 1))] == [True] * 3


def test_constant_commands_sum_over_steps() -> None:
    """A command without an axis of steps has the sum of the gradients of all steps."""
    sim = cube()
    rollout, loss = Rollout(sim), weights(sim)
    held = torch.full((1, 2), 2.0, dtype=torch.float64, requires_grad=True)
    moving = held.detach().expand(STEPS, 1, 2).clone().requires_grad_()
    for tension in (held, moving):
        loss(rollout(controls={"cable_tension": tension}, steps=STEPS)).sum().backward()
    torch.testing.assert_close(held.grad, moving.grad.sum(dim=0), rtol=1e-12, atol=0.0)


def test_broadcast_parameters() -> None:
    """One modulus for all worlds has the sum of their gradients."""
    sim = cube(num_worlds=3)
    rollout, loss = Rollout(sim), weights(sim)
    one = torch.tensor(1e5, dtype=torch.float64, requires_grad=True)
    loss(rollout(parameters={"youngs": one}, steps=STEPS)).sum().backward()
    each = torch.full((3, 1), 1e5, dtype=torch.float64, requires_grad=True)
    loss(rollout(parameters={"youngs": each}, steps=STEPS)).sum().backward()
    torch.testing.assert_close(one.grad, each.grad.sum())


def test_float32_follows_float64() -> None:
    """Gradients in float32, refined as the steps are, agree with those in float64 to a thousandth of their size."""
    found = []
    for precision in ("float64", "float32"):
        sim = cube(precision=precision, solver_path="scalar")
        found.append(gradients(Rollout(sim), inputs(sim, [1]), weights(sim)))
    for group, held in found[0].items():
        for name, value in held.items():
            error = (found[1][group][name].double() - value).abs().max()
            assert error <= 2e-3 * value.abs().max(), (group, name)


BAD_CALLS: list[tuple[dict[str, Any], str]] = [
    ({}, "say steps=..., or give a command an axis of steps"),
    ({"steps": 0}, "steps"),
    ({"steps": 4, "every": 3}, "every must divide steps, got every=3 and steps=4"),
    ({"steps": 2, "parameters": {"young": 1.0}}, "'young' has no gradient"),
    ({"steps": 2, "parameters": {"youngs": torch.ones(5)}}, "have the shape (1, 1), or broadcast to it"),
    ({"steps": 2, "controls": {"cable_tension": torch.ones(4, 1, 2)}}, "cable_tension has 4, steps has 2"),
]


@pytest.mark.parametrize(("call", "told"), BAD_CALLS)
def test_bad_calls(call: dict[str, Any], told: str) -> None:
    """Names, shapes and numbers of steps that do not fit are told."""
    with pytest.raises(ValueError, match=re.escape(told)):
        Rollout(cube())(**call)


def test_failed_steps_are_told() -> None:
    """A gradient through a step that was rolled back would mean nothing."""
    rollout = Rollout(cube(num_worlds=2))
    tension = torch.zeros((1, 2, 2), dtype=torch.float64)
    tension[0, 1, 1] = float("nan")
    with pytest.raises(RuntimeError, match=r"a step failed in 1 of 2 worlds \(1\)"):
        rollout(controls={"cable_tension": tension})


def _box(builder: sw.ModelBuilder, law: str = "large", **options: Any) -> int:
    return builder.add_tets(
        meshing.box((0.1, 0.1, 0.1), (1, 1, 1)), material=material(law, 1e5, 0.4), density=1e3, **options
    )


def _pieces(builder: sw.ModelBuilder) -> None:
    builder.add_rod([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]], radius=0.01, youngs=1e6, density=1e3, contact_pieces=3)


def _still(builder: sw.ModelBuilder) -> None:
    builder.add_rigid(sw.Plane(), kinematic=True)


def _contact(builder: sw.ModelBuilder) -> None:
    body = _box(builder)
    builder.add_contact(body, body)


def _tubes(builder: sw.ModelBuilder) -> None:
    tubes = [sw.Tube([sw.TubeSection(0.2)], radius=0.4e-3, youngs=5e10)]
    builder.add_telescope([*tubes, sw.Tube([sw.TubeSection(0.1)], radius=1e-3, inner_radius=6e-4, youngs=5e10)])


def _touching_rod(builder: sw.ModelBuilder) -> None:
    stem = builder.add_rod([[0, 0, 0], [0.1, 0, 0]], radius=0.01, youngs=1e6, density=1e3)
    builder.add_contact(stem, builder.add_rigid(sw.Plane(), kinematic=True))


def _two_boxes(builder: sw.ModelBuilder) -> None:
    one, other = (builder.add_rigid(sw.Box((0.1, 0.1, 0.1)), mass=1.0, pose=(0, 0, z)) for z in (0.05, 0.16))
    builder.add_contact(one, other)


def _inflated(builder: sw.ModelBuilder) -> None:
    skin = meshing.box((0.04, 0.04, 0.04), (1, 1, 1))
    builder.add_cavity(_box(builder), skin.nodes + 0.03, skin.surface(), control="volume")


REFUSED: list[tuple[Callable[[sw.ModelBuilder], object], dict[str, Any], str]] = [
    (_pieces, {}, "a rod that contact cuts into pieces has no gradient yet; leave contact_pieces out"),
    (_tubes, {}, "tubes that slide in each other"),
    (_touching_rod, {}, "as that of rods; take a shape, a mesh or a soft body"),
    (_two_boxes, {}, "as that of two rigid bodies, of which only balls have one"),
    (_still, {}, "a scene where nothing moves freely has nothing to differentiate"),
    (_contact, {"contact_passes": 2}, "more than once a step (contact_passes=2, refinement=1) has no gradient yet"),
]


@pytest.mark.parametrize(("build", "options", "told"), REFUSED)
def test_what_has_no_gradient_is_refused(
    build: Callable[[sw.ModelBuilder], object], options: dict[str, Any], told: str
) -> None:
    """Messages name the part and the way out; nothing is differentiated in silence."""
    builder = sw.ModelBuilder()
    build(builder)
    sim = sw.Simulation(builder.finalize(num_worlds=1), **options)
    with pytest.raises(ValueError, match=re.escape(told)):
        Rollout(sim)


def test_gradient_finds_a_modulus() -> None:
    """Newton's method on the gradient finds the modulus that made a motion, from one 40 % off, in six steps."""
    sim = cube()
    rollout = Rollout(sim)
    with torch.no_grad():
        measured = rollout(steps=10).node_x
    log_modulus = torch.tensor(np.log(1.4e5), dtype=torch.float64)
    for _ in range(6):
        slopes = []
        for value in (log_modulus, log_modulus + 1e-4):
            leaf = value.clone().requires_grad_()
            error = (rollout(parameters={"youngs": leaf.exp()}, steps=10).node_x - measured).square().sum()
            error.backward()
            slopes.append(leaf.grad)
        log_modulus -= slopes[0] * 1e-4 / (slopes[1] - slopes[0])
    assert float(log_modulus.exp()) == pytest.approx(1e5, rel=1e-6)
