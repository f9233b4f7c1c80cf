"""Forward mode of what frames move, y . J d = d . J' y, over the scenes whose gradients are those of differences."""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import pytest
import torch

import softwarp as sw
from softwarp.gradients import Rollout, States, jvp
from tests.gradient_cases import STEPS, Inputs, cube, gradients, inputs, weights
from tests.unit.gradients import test_bodies, test_joints, test_rigid, test_rods
from tests.unit.gradients import test_touches as touches

AGREES = 1e-10  # of both modes in float64, relative to what may cancel in their product
SLOW = pytest.mark.slow
FIELDS = tuple(field.name for field in fields(States) if field.name != "step")


LARGEST = 1e6  # of an input's size: what is rigid has a stiffness that means nothing


def along(given: Inputs, count: int) -> Inputs:
    """Changes of all inputs, each in a unit of its own, with an axis of directions."""
    torch.manual_seed(5)

    def drawn(value: torch.Tensor) -> torch.Tensor:
        size = 1e-3 * (value.abs().clamp(max=LARGEST).mean() + 1e-3)
        return (size * torch.randn((count, *value.shape))).to(value)

    return {group: {name: drawn(value) for name, value in held.items()} for group, held in given.items()}


def compare(rollout: Rollout, given: Inputs, loss: Callable[[States], torch.Tensor], steps: int = STEPS) -> None:
    """Check every input at once, and each alone."""
    found = gradients(rollout, given, loss, steps=steps)
    given = {group: {name: given[group][name] for name in held} for group, held in found.items()}
    names = [(group, name) for group, held in given.items() for name in held]
    whole = along(given, 1 + len(names))
    for number, kept in enumerate(names):  # the first direction is along all, others along one
        for group, name in names:
            if (group, name) != kept:
                whole[group][name][1 + number] = 0.0
    _, slopes = jvp(rollout, whole, given["state"], given["controls"], given["parameters"], steps=steps)
    for number in range(1 + len(names)):
        terms = [(found[g][n] * s[number]).flatten() for g, held in whole.items() for n, s in held.items()]
        backward, scale = float(sum(term.sum() for term in terms)), float(sum(term.abs().sum() for term in terms))
        one = replace(slopes, **{name: getattr(slopes, name)[number] for name in FIELDS})
        forward = float(linear(loss, one))
        assert abs(forward - backward) <= AGREES * scale, ((("all", ""), *names)[number], forward, backward)


def linear(loss: Callable[[States], torch.Tensor], slopes: States) -> torch.Tensor:
    """A loss that is linear in states, of slopes."""
    return loss(slopes).sum() - loss(replace(slopes, **{n: torch.zeros_like(getattr(slopes, n)) for n in FIELDS})).sum()


@pytest.mark.parametrize("motor", [m if m == "weak" else pytest.param(m, marks=SLOW) for m in test_joints.MOTORS])
def test_joints_and_motors(motor: str) -> None:
    """A double pendulum that is driven in every way."""
    sim = test_joints.arm(motor)
    compare(Rollout(sim), test_joints.thrown(sim, [1]), test_joints.loss)


@SLOW
def test_membranes() -> None:
    """Triangles on a cube's surface; by rows."""
    sim = cube("nh_log", covered=True)
    compare(Rollout(sim), inputs(sim, [1]), weights(sim))


@SLOW
def test_joints_in_steps_of_second_order() -> None:
    """Stages beside joints."""
    sim = test_joints.arm("slow", integrator="bdf2")
    compare(Rollout(sim), test_joints.thrown(sim, [1]), test_joints.loss)


@SLOW
@pytest.mark.parametrize("options", [{"kind": "slider"}, {"kind": "ball"}, {"base": "rod"}, {"base": "kinematic"}])
def test_other_joints_and_bases(options: dict[str, Any]) -> None:
    """Rows of other kinds, on what moves."""
    sim = test_joints.arm("servo", **options)
    compare(Rollout(sim), test_joints.thrown(sim, [1]), test_joints.loss)


@SLOW
def test_a_soft_finger_on_a_link() -> None:
    """Nodes that a frame carries, and others."""
    sim = test_joints.arm("servo", soft=True)
    compare(Rollout(sim), test_joints.thrown(sim, [1]), test_joints.loss)


def test_rods_and_cables() -> None:
    """A clamped rod and a free one, with cables."""
    sim = test_rods.rods(driven=True, stiffness=300.0, damping=2.0)
    compare(Rollout(sim), test_rods.bent(sim, [1]), test_rods.loss)


@pytest.mark.parametrize("base", ["kinematic", pytest.param("cart", marks=SLOW), pytest.param("rod", marks=SLOW)])
def test_carried_soft_bodies(base: str) -> None:
    """A soft beam between a base and a box."""
    sim = test_rigid.arm(base=base)
    compare(Rollout(sim), test_rigid.thrown(sim, [1]), test_rigid.loss)


def test_tumbling_bodies() -> None:
    """Boxes that turn fast, on cables and a rail."""
    sim = test_bodies.tumbling()
    compare(Rollout(sim), test_bodies.thrown(sim, [1]), test_bodies.loss)


@pytest.mark.parametrize("passes", [0, pytest.param(1, marks=SLOW)])
@pytest.mark.parametrize("kind", ["capsule", pytest.param("edge", marks=SLOW), pytest.param("mesh", marks=SLOW)])
def test_soft_bodies_on_free_shapes(kind: str, passes: int) -> None:
    """Contact with what moves freely."""
    sim = touches.on_shape(kind, "free", passes=passes)
    compare(Rollout(sim), touches.thrown(sim, 0.2, 0.3), touches.loss)


@SLOW
@pytest.mark.parametrize("kind", touches.ABOVE)
def test_free_shapes_on_a_soft_bed(kind: str) -> None:
    """Corners, edges and rims of rigid bodies."""
    sim = touches.on_bed(kind)
    compare(Rollout(sim), touches.thrown(sim, 0.0, 0.0), touches.loss)


def test_steps_of_second_order() -> None:
    """BDF2 of a soft cube with cables and a chamber."""
    sim = cube("nh_log", integrator="bdf2", locked=False)
    compare(Rollout(sim), inputs(sim, [1]), weights(sim))


@pytest.mark.parametrize("scene", ["tops", *(pytest.param(scene, marks=SLOW) for scene in ("bodies", "rod", "cart"))])
def test_frames_in_steps_of_second_order(scene: str) -> None:
    """Tops alone, bodies on cables and a rail, and a rod and a cart that carry a soft beam."""
    if scene == "tops":
        sim = test_bodies.alone(integrator="bdf2")
        compare(Rollout(sim), test_bodies.spun(sim, [1]), test_bodies.loss)
    elif scene == "bodies":
        sim = test_bodies.tumbling(integrator="bdf2")
        compare(Rollout(sim), test_bodies.thrown(sim, [1]), test_bodies.loss)
    else:
        sim = second_order(test_rigid.arm(base=scene))
        compare(Rollout(sim), test_rigid.thrown(sim, [1]), test_rigid.loss)


def second_order(sim: sw.Simulation) -> sw.Simulation:
    """The same scene with steps of ``bdf2``."""
    return sw.Simulation(sim.model, dt=sim.dt, integrator="bdf2")


def test_worlds_beside_change_no_bit() -> None:
    """World i of a batch has the slopes of that world alone."""
    seeds = [1, 2, 3]
    batch, single = test_joints.arm("weak", num_worlds=3), Rollout(test_joints.arm("weak"))

    def stiffer(worlds: int) -> Inputs:
        return {"parameters": {"joint_stiffness": torch.ones((1, worlds, 2)).to(batch.body_pose)}}

    _, slopes = jvp(Rollout(batch), stiffer(3), **test_joints.thrown(batch, seeds))
    for world, seed in enumerate(seeds):
        _, alone = jvp(single, stiffer(1), **test_joints.thrown(single.worlds.sim, [seed]))
        for name in FIELDS:
            assert torch.equal(getattr(slopes, name)[:, :, world], getattr(alone, name)[:, :, 0]), name


@SLOW
def test_dual_tensors_are_the_same() -> None:
    """Torch's own forward mode through a rollout, markers on frames included."""
    sim = test_joints.arm("weak")
    given, rollout = test_joints.thrown(sim, [1]), Rollout(sim)
    stiff = given["parameters"]["joint_stiffness"]
    states, slopes = jvp(rollout, {"parameters": {"joint_stiffness": torch.ones_like(stiff)[None]}}, **given)
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(stiff, torch.ones_like(stiff))
        found = rollout(given["state"], given["controls"], {**given["parameters"], "joint_stiffness": dual})
        for name in ("body_pose", "body_twist", "cable_tension", "marker_x"):
            value, slope = torch.autograd.forward_ad.unpack_dual(getattr(found, name))
            assert torch.equal(value, getattr(states, name)), name
            assert torch.allclose(slope, getattr(slopes, name)[0], rtol=1e-12, atol=1e-20), name
