"""Gradients of a world do not depend on the worlds beside it: bits are compared, on every path."""

from typing import Any

import pytest
import torch

from softwarp.gradients import Rollout
from tests.gradient_cases import cube, gradients, inputs, weights

QUADRATIC: dict[str, Any] = {"quadratic": True, "elastic": True}
NEWTON: dict[str, Any] = {"newton_iterations": 30}
PATHS = [
    pytest.param({"solver_path": "scalar"}, "float32", "cpu", id="scalar"),
    pytest.param({"solver_path": "lanes"}, "float32", "cpu", id="lanes"),
    pytest.param({"solver_path": "scalar"}, "float64", "cpu", id="float64", marks=pytest.mark.slow),
    pytest.param({"solver_path": "lanes", "integrator": "bdf2"}, "float32", "cpu", id="second_order"),
    pytest.param({"covered": True, "solver_path": "lanes"}, "float32", "cpu", id="skin"),
    pytest.param(NEWTON | {"solver_path": "lanes"}, "float32", "cpu", id="newton"),
    pytest.param(NEWTON | {"solver_path": "scalar"}, "float64", "cpu", id="newton_float64", marks=pytest.mark.slow),
    pytest.param(QUADRATIC | {"solver_path": "lanes"}, "float32", "cpu", id="quadratic", marks=pytest.mark.slow),
    pytest.param({"solver_path": "panels"}, "float32", "cuda:0", id="panels", marks=pytest.mark.cuda),
    pytest.param({"solver_path": "lanes", "hollow": False}, "float32", "cpu", id="cables"),
    pytest.param(
        {"solver_path": "levels", "hollow": False}, "float32", "cuda:0", id="cables_cuda", marks=pytest.mark.cuda
    ),
    pytest.param({"solver_path": "levels"}, "float32", "cuda:0", id="euler_levels", marks=pytest.mark.cuda),
    pytest.param(
        QUADRATIC | {"solver_path": "panels"}, "float32", "cuda:0", id="quadratic_cuda", marks=pytest.mark.cuda
    ),
    pytest.param(NEWTON | {"solver_path": "levels"}, "float64", "cuda:0", id="newton_cuda", marks=pytest.mark.cuda),
    pytest.param(
        {"solver_path": "levels", "integrator": "bdf2"}, "float64", "cuda:0", id="levels", marks=pytest.mark.cuda
    ),
]


@pytest.mark.parametrize(("options", "precision", "device"), PATHS)
def test_world_of_a_batch_has_the_gradient_of_that_world_alone(
    options: dict[str, Any], precision: str, device: str
) -> None:
    """Three worlds that differ in all inputs, then each alone."""
    seeds = [1, 2, 3]
    batch = cube(num_worlds=3, precision=precision, device=device, **options)
    together = gradients(Rollout(batch), inputs(batch, seeds), weights(batch))
    single = cube(num_worlds=1, precision=precision, device=device, **options)
    rollout, loss = Rollout(single), weights(single)
    for world, seed in enumerate(seeds):
        alone = gradients(rollout, inputs(single, [seed]), loss)
        for group, held in alone.items():
            for name, value in held.items():
                axis = 1 if name in ("cable_displacement", "cable_tension") else 0
                assert torch.equal(together[group][name].select(axis, world), value.select(axis, 0)), (group, name)


def test_lanes_agree_with_one_world_at_a_time() -> None:
    """Paths round differently, and no more."""
    found = []
    for path in ("scalar", "lanes"):
        sim = cube(num_worlds=2, precision="float32", solver_path=path)
        found.append(gradients(Rollout(sim), inputs(sim, [1, 2]), weights(sim)))
    for group, held in found[0].items():
        for name, value in held.items():
            error = (found[1][group][name] - value).abs().max()
            assert error <= 2e-3 * value.abs().max(), (group, name)


@pytest.mark.cuda
@pytest.mark.parametrize("path", ["panels", "levels"])
def test_a_gpu_agrees_with_a_cpu(path: str) -> None:
    """In float64, with factors kept and without."""
    found = []
    for device, own, factors in (("cpu", "auto", False), ("cuda:0", path, False), ("cuda:0", path, True)):
        sim = cube(num_worlds=2, device=device, solver_path=own, hollow=False)
        found.append(gradients(Rollout(sim), inputs(sim, [1, 2]), weights(sim), factors=factors))
    for group, held in found[0].items():
        for name, value in held.items():
            for other in found[1:]:
                close = {"rtol": 1e-8, "atol": 1e-8 * float(value.abs().max())}
                torch.testing.assert_close(other[group][name].cpu(), value, **close)
