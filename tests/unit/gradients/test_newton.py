"""Gradients of steps that Newton's method solves, against central differences in float64."""

from typing import Any

import pytest
import torch

import softwarp as sw
from softwarp.gradients import Diverged, Rollout
from tests.gradient_cases import STEPS, cube, gradients, inputs, weights
from tests.unit.gradients import test_adjoint, test_every_input, test_relaxation, test_rigid
from tests.unit.gradients.test_forward_frames import compare
from tests.unit.gradients.test_rods import check

NEWTON: dict[str, Any] = {"newton_iterations": 60, "newton_tolerance": 1e-13}
SLOW = pytest.mark.slow


def solved(sim: sw.Simulation, **options: Any) -> sw.Simulation:
    """The same scene with steps that are solved."""
    return sw.Simulation(sim.model, dt=sim.dt, **{**NEWTON, **options})


@pytest.mark.parametrize(
    ("law", "options"),
    [
        ("nh_log", {"elastic": True}),
        pytest.param("warped", {"quadratic": True, "chamber": {"control": "gas", "exponent": 1.4}}, marks=SLOW),
        pytest.param("large", {}, marks=SLOW),
        pytest.param("nh_log", {"chamber": {"control": "volume"}}, marks=SLOW),
        pytest.param("nh_log", {"integrator": "bdf2"}, marks=SLOW),
    ],
)
def test_soft_bodies(law: str, options: dict[str, Any]) -> None:
    """Every input of a cube with cables and a chamber, whose tangents are projected or leave turning out."""
    sim = cube(law, **NEWTON, **options)
    given = inputs(sim, [1])
    if options.get("chamber"):
        del given["state"]["cavity_pressure"]  # a first guess only
    test_adjoint.check(Rollout(sim), given, weights(sim))


@SLOW
def test_pressures_whose_tangent_newton_takes() -> None:
    """No step depends on it, whether it has it or not."""
    found = []
    for tangent in (True, False):
        sim = cube("nh_log", chamber={}, pressure_tangent=tangent, **NEWTON)
        given = inputs(sim, [1])
        given["controls"]["cavity_pressure"] *= 3.0
        found.append(gradients(Rollout(sim), given, weights(sim)))
    for group, held in found[0].items():
        for name, value in held.items():
            scale = float(value.abs().max()) + 1e-12
            assert torch.allclose(value, found[1][group][name], rtol=1e-8, atol=1e-8 * scale), name


@pytest.mark.parametrize("base", ["cart", pytest.param("kinematic", marks=SLOW), pytest.param("rod", marks=SLOW)])
def test_what_carries_soft_bodies(base: str) -> None:
    """Frames that turn, and what moves along with them."""
    sim = solved(test_rigid.arm(base=base))
    given = test_rigid.thrown(sim, [2])
    given["controls"] = {name: value.expand(STEPS, *value.shape) for name, value in given["controls"].items()}
    parameters = {**test_rigid.SIZES["parameters"], "rod_youngs": 1e4}  # which hardly counts
    check(Rollout(sim), given, test_rigid.loss, {**test_rigid.SIZES, "parameters": parameters})


@SLOW
def test_a_memory_beside_quadratic_elements() -> None:
    """By ratio and time of a branch; steps of second order are those of Newton's method too."""
    sim = solved(test_relaxation.beam(), integrator="bdf2")
    given = test_relaxation.given_of(sim, [2])
    given["controls"] = {name: value.expand(STEPS, *value.shape) for name, value in given["controls"].items()}
    check(Rollout(sim), given, test_rigid.loss, test_relaxation.SIZES)


@SLOW
@pytest.mark.parametrize("scene", ["carried by a rod", "carried by a base", "with a memory", "with gas"])
def test_all_inputs_at_once(scene: str) -> None:
    """Of scenes that have all parts that Newton's method has gradients with."""
    sim = solved(test_every_input.SCENES[scene]())
    given, sizes = test_every_input.given_of(sim)
    sizes["parameters"]["rod_rayleigh_stiffness"] = 1e-5  # which hardly counts
    check(Rollout(sim), given, test_every_input.loss, sizes)


@SLOW
def test_both_modes_agree() -> None:
    """The forward mode is one by rows."""
    sim = solved(test_rigid.arm())
    compare(Rollout(sim), test_rigid.thrown(sim, [1]), test_rigid.loss, steps=2)


def test_steps_that_are_not_solved_are_refused() -> None:
    """An iterate that has not converged has no gradient of the step; it is told in which world."""
    sim = cube("nh_log", newton_iterations=2, newton_tolerance=1e-13)
    given = inputs(sim, [1])
    with pytest.raises(Diverged, match="iterations of a step ended above their tolerance in world 0"):
        Rollout(sim)(given["state"], given["controls"], given["parameters"])


def test_kept_factors_are_refused() -> None:
    """They are not there yet."""
    sim = cube("nh_log", **NEWTON)
    with pytest.raises(ValueError, match="newton_iterations above 1 keeps no factors"):
        Rollout(sim)(steps=1, factors=True)
