"""Gradients of steps of second order against differences, beside contact and where they are rough."""

from typing import Any

import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Diverged, Rollout
from softwarp.solvers.second_order_adjoint import SecondOrderAdjoint
from tests.gradient_cases import Inputs, cube, gradients, inputs, weights
from tests.unit.gradients import test_contact, test_every_input, test_touches
from tests.unit.gradients.test_adjoint import check
from tests.unit.gradients.test_contact import EXACT, OPEN, SIDE, SLIPPING, STUCK
from tests.unit.gradients.test_forward_frames import compare
from tests.unit.gradients.test_newton import NEWTON
from tests.unit.gradients.test_rods import check as check_frames

SLOW = pytest.mark.slow


def second(sim: sw.Simulation, **options: Any) -> sw.Simulation:
    """The same scene with steps of BDF2."""
    exact = EXACT if sim.model.precision == "float64" else {}
    return sw.Simulation(sim.model, dt=sim.dt, integrator="bdf2", **{**exact, **options})


@pytest.fixture
def thirds(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Grows with every third stage that a backward pass takes."""
    found, pull = [], SecondOrderAdjoint._pull_third

    def counted(self: SecondOrderAdjoint, *, parameters: bool) -> None:
        found.append(parameters)
        pull(self, parameters=parameters)

    monkeypatch.setattr(SecondOrderAdjoint, "_pull_third", counted)
    return found


@pytest.mark.parametrize("passes", [0, 1])
@pytest.mark.parametrize(
    ("mu", "speed", "laws", "expected"),
    [
        pytest.param(2.0, 0.0, {}, {STUCK, SLIPPING}, id="stick"),
        pytest.param(0.3, 0.3, {"compliance": 1e-4}, {OPEN, SLIPPING}, id="slip, soft"),
        pytest.param(0.3, 0.3, {"restitution": 0.5}, {OPEN, SLIPPING}, id="bounce"),
    ],
)
def test_laws_of_contact(
    mu: float, speed: float, laws: dict[str, float], expected: set[int], passes: int, thirds: list[bool]
) -> None:
    """A cube with a cable on a floor, by state, commands, moduli and friction; without and with a look ahead."""
    sim = second(test_contact.block(mu, **laws), contact_passes=passes)
    given = test_contact.thrown(sim, speed)
    check(Rollout(sim), given, test_contact.loss, own=1e-5)
    assert test_contact.modes(sim, given) >= expected
    assert thirds


def test_a_skin_apart_from_the_elements() -> None:
    """A cube that touches the floor by points between its nodes, and slips."""
    skin = 0.01 * SIDE + meshing.box((0.98 * SIDE,) * 3, (3, 3, 1)).nodes
    sim = second(test_contact.block(0.3, skin=skin, compliance=1e-4))
    given = test_contact.thrown(sim, 0.3)
    check(Rollout(sim), given, test_contact.loss, own=1e-5)
    assert SLIPPING in test_contact.modes(sim, given)


@SLOW
@pytest.mark.parametrize("options", [{}, {"relaxes": True}, {"joints": True, "relaxes": True}])
def test_contact_of_steps_that_are_solved(options: dict[str, Any]) -> None:
    """By every input; some changes are small beside those of states of contacts, others above what Newton leaves."""
    sim = second(test_every_input.touching(**options), **NEWTON)
    sim.node_v[...] = torch.tensor((0.2, 0.06, -0.8))
    given, sizes = test_every_input.given_of(sim)
    if sim.model.joints is None:
        for name in ("rayleigh_mass", "cable_stiffness", "body_damping"):
            sizes["parameters"][name] *= 0.1
        sizes["controls"]["node_force"] *= 0.1
        for name in {"rod_nu", "relaxation_time"} & set(sizes["parameters"]):
            sizes["parameters"][name] *= 10.0
    check_frames(Rollout(sim), given, test_every_input.loss, sizes)
    slips = gradients(Rollout(sim), given, test_every_input.loss)["parameters"]["pair_mu"]
    assert slips.any()  # in stages, if not at the end of steps


def blown(sim: sw.Simulation, seeds: list[int]) -> Inputs:
    """Inputs of worlds, of which those with even seeds are hit."""
    given = inputs(sim, seeds)
    hit = torch.tensor([20.0 * (seed % 2 == 0) for seed in seeds]).to(sim.node_x)
    given["controls"]["node_force"] = given["controls"]["node_force"] + hit[:, None, None]
    return given


def test_a_blow(thirds: list[bool]) -> None:
    """It makes a world rough, which takes three plain steps."""
    sim = cube(integrator="bdf2", locked=False, chamber={}, **EXACT)
    given = blown(sim, [2])
    del given["state"]["cavity_pressure"]  # which nothing depends on without a rate
    check(Rollout(sim), given, weights(sim))
    assert thirds


@pytest.mark.parametrize("options", [{}, {"law": "nh_log", "pressure_tangent": True}], ids=["plain", "tangent"])
@pytest.mark.parametrize("precision", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
def test_smooth_and_rough_worlds_change_no_bit_of_each_other(precision: str, options: dict[str, Any]) -> None:
    """Worlds of a batch have the gradients of each alone; float32 has other paths for one world and for many."""

    def found(seeds: list[int]) -> Inputs:
        sim = cube(num_worlds=len(seeds), precision=precision, integrator="bdf2", locked=False, **options)
        return gradients(Rollout(sim), blown(sim, seeds), weights(sim))

    others = [[1], [2], [3]] if precision == "float64" else [[1, 1, 1], [2, 2, 2], [3, 3, 3]]
    batch, shaped = found([1, 2, 3]), cube().control
    for world, seeds in enumerate(others):
        for group, held in found(seeds).items():
            for name, value in held.items():
                axis = value.ndim - getattr(shaped, name).ndim if group == "controls" else 0
                wanted = value.select(axis, 0)
                assert torch.equal(batch[group][name].select(axis, world), wanted), (seeds, group, name)


@pytest.mark.parametrize("precision", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
def test_worlds_beside_change_no_bit_of_contact(precision: str) -> None:
    """The same of what touches, beside a world that flies."""

    def found(seeds: tuple[int, ...]) -> Inputs:
        sim = second(test_contact.block(0.5, len(seeds), precision))
        given = test_contact.thrown(sim, 0.2, seeds)
        flies = torch.tensor([0.3 * (seed == 3) for seed in seeds]).to(sim.node_x)
        given["state"]["node_x"][..., 2] += flies[:, None]
        return gradients(Rollout(sim), given, test_contact.loss)

    others = [(1,), (2,), (3,)] if precision == "float64" else [(1, 1, 1), (2, 2, 2), (3, 3, 3)]
    batch = found((1, 2, 3))
    for world, seeds in enumerate(others):
        for group, held in found(seeds).items():
            for name, value in held.items():
                axis = 1 if name == "node_force" else 0
                wanted = value.select(axis, 0)
                assert torch.equal(batch[group][name].select(axis, world), wanted), (seeds, group, name)


@pytest.mark.parametrize(
    "options", [{}, pytest.param({"newton_iterations": 60, "newton_tolerance": 1e-13}, marks=SLOW)]
)
def test_both_modes_agree(options: dict[str, Any]) -> None:
    """To rounding, beside contact."""
    sim = second(test_contact.block(0.5), **options)
    compare(Rollout(sim), test_contact.thrown(sim, 0.2), test_contact.loss)


@pytest.mark.cuda
def test_a_gpu_finds_the_same() -> None:
    """Gradients beside contact of several worlds on a GPU are those on a CPU but for rounding."""
    found = []
    for device in ("cpu", "cuda:0"):
        sim = second(test_contact.block(0.5, 3, device=device))
        found.append(gradients(Rollout(sim), test_contact.thrown(sim, 0.2, (1, 2, 3)), test_contact.loss))
    for group, held in found[0].items():
        for name, value in held.items():
            size = float(value.abs().max())
            torch.testing.assert_close(found[1][group][name].cpu(), value, rtol=1e-6, atol=1e-7 * size)


def test_contacts_that_repeat_each_other_and_slip_are_told() -> None:
    """Three in a line press as two do, in a stage of a step as in a whole one."""
    sim, given = test_touches.hit_block("free")
    with pytest.raises(Diverged, match=r"world 0 and 0 others contacts that repeat each other slipped.*compliance"):
        gradients(Rollout(second(sim, contact_passes=0)), given, test_touches.loss)
