"""Gradients of steps that look at contacts where they lead to, against central differences in float64."""

import pytest
import torch

import softwarp as sw
from softwarp.gradients import Rollout
from softwarp.kernels.rows.touch_adjoint import BOUNCED, LATE, MEASURED
from tests.gradient_cases import STEPS, Inputs, gradients
from tests.unit.gradients.test_rods import check
from tests.unit.gradients.test_touches import SIZES, loss, on_bed, on_shape, on_soft, thrown


def prove(sim: sw.Simulation, given: Inputs, expected: set[int]) -> None:
    """Gradients are those of differences; contacts of the steps look at what they are to prove."""
    rollout = Rollout(sim)
    check(rollout, given, loss, SIZES)
    assert looked(rollout, given) >= expected


def looked(rollout: Rollout, given: Inputs, constant: tuple[str, ...] = ()) -> set[int]:
    """What contacts look at in the steps of a rollout, see ``touch_adjoint``; some commands have no axis of steps."""
    found: set[int] = set()
    ((_, system),) = rollout.worlds._twins
    first = system.watch.__self__  # type: ignore[union-attr]
    for steps in range(1, STEPS + 1):
        controls = {name: value if name in constant else value[:steps] for name, value in given["controls"].items()}
        rollout(given["state"], controls, given["parameters"], steps=steps)
        found |= set(first.look.real.numpy().ravel().tolist())
    return found


def turning(given: Inputs, factor: float) -> Inputs:
    """The same with bodies that turn faster."""
    for group, name in (("state", "body_twist"), ("controls", "body_velocity")):
        if name in given[group]:
            given[group][name][..., 3:] *= factor
    return given


@pytest.mark.parametrize(
    ("kind", "base", "along", "expected"),
    [
        ("capsule", "kinematic", 0.2, {MEASURED, LATE}),
        pytest.param("capsule", "free", 0.2, {MEASURED}, marks=pytest.mark.slow),
        pytest.param("sphere", "kinematic", 0.6, {MEASURED, LATE}, marks=pytest.mark.slow),
        pytest.param("sphere", "free", 0.2, {MEASURED}, marks=pytest.mark.slow),
        pytest.param("edge", "kinematic", 0.2, {LATE}, marks=pytest.mark.slow),
        pytest.param("edge", "free", 0.2, {LATE}, marks=pytest.mark.slow),
        pytest.param("cylinder", "free", 0.2, {MEASURED}, marks=pytest.mark.slow),
        pytest.param("mesh", "kinematic", 0.2, {MEASURED, LATE}, marks=pytest.mark.slow),
        pytest.param("mesh", "free", 0.2, {LATE}, marks=pytest.mark.slow),
    ],
)
def test_a_soft_cube_on_a_shape(kind: str, base: str, along: float, expected: set[int]) -> None:
    """Distances measured on round parts, faces, edges and corners that turn and move, and late contacts with them."""
    sim = on_shape(kind, base, passes=1)
    prove(sim, turning(thrown(sim, along, 0.3), 2.0), expected)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seed", "expected"),
    [("sphere", 2, {MEASURED}), ("capsule", 1, {MEASURED}), ("box", 1, {LATE}), ("cylinder", 1, {LATE})],
)
def test_a_rigid_body_on_a_soft_bed(kind: str, seed: int, expected: set[int]) -> None:
    """Balls, corners, edges and rims on the faces, edges and nodes of a soft body."""
    sim = on_bed(kind, passes=1)
    prove(sim, turning(thrown(sim, 0.0, 0.0, (seed,)), 2.0), expected)


@pytest.mark.parametrize(
    ("lift", "along", "down", "expected"), [(-5e-4, 0.6, 0.1, {MEASURED, LATE}), (1e-3, 0.0, 0.2, {MEASURED})]
)
def test_soft_on_soft(lift: float, along: float, down: float, expected: set[int]) -> None:
    """Faces and edges, some of them contacts in reserve until the step ends in them."""
    sim = on_soft(lift, passes=1)
    given = thrown(sim, along, down, (2,))
    given["state"]["node_v"][:, 27:] = 0.0
    prove(sim, given, expected)


@pytest.mark.parametrize(
    ("kind", "laws", "along", "down", "factor", "expected"),
    [
        ("edge", {"restitution": 0.5}, 0.5, 0.05, 20.0, {MEASURED, BOUNCED}),
        pytest.param("edge", {"restitution": 0.5}, 1.0, 0.3, 2.0, {LATE}, marks=pytest.mark.slow),
        pytest.param("capsule", {"compliance": 1e-4}, 0.2, 0.3, 2.0, {MEASURED}, marks=pytest.mark.slow),
    ],
)
def test_laws(kind: str, laws: dict[str, float], along: float, down: float, factor: float, expected: set[int]) -> None:
    """Contacts that bounce, one of them found late, and those that give way."""
    sim = on_shape(kind, "free", passes=1, **laws)
    prove(sim, turning(thrown(sim, along, down), factor), expected)


@pytest.mark.parametrize("kind", ["capsule", pytest.param("edge", marks=pytest.mark.slow)])
def test_worlds_beside_and_kept_factors_change_no_bit(kind: str) -> None:
    """A world of a batch has the gradient of that world alone, and kept factors lead to the same."""
    seeds = (1, 2, 3)
    batch, single = on_shape(kind, "free", len(seeds), passes=1), on_shape(kind, "free", passes=1)
    rollout, alone, given = Rollout(batch), Rollout(single), turning(thrown(batch, 0.2, 0.3, seeds), 2.0)
    plain, kept = gradients(rollout, given, loss), gradients(rollout, given, loss, factors=True)
    for world, seed in enumerate(seeds):
        for group, held in gradients(alone, turning(thrown(single, 0.2, 0.3, (seed,)), 2.0), loss).items():
            for name, value in held.items():
                axis = 1 if group == "controls" else 0
                assert torch.equal(plain[group][name].select(axis, world), value.select(axis, 0)), (group, name)
                assert torch.equal(plain[group][name], kept[group][name]), (group, name)
