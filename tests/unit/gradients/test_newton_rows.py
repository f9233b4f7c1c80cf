"""Gradients of steps that Newton's method solves beside contact and joints, against central differences in float64."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

import softwarp as sw
from softwarp.gradients import Diverged, Rollout
from softwarp.kernels.collision.geometry import DISTANCE, TOUCH_ROWS
from tests.gradient_cases import Inputs, gradients
from tests.unit.gradients import (
    test_adjoint,
    test_contact,
    test_every_input,
    test_joints,
    test_touches,
    test_touching_joints,
)
from tests.unit.gradients.test_contact import EXACT, OPEN, SLIPPING, STUCK
from tests.unit.gradients.test_forward_frames import compare
from tests.unit.gradients.test_newton import NEWTON
from tests.unit.gradients.test_rods import check

SLOW = pytest.mark.slow
SOON: dict[str, Any] = {"newton_iterations": 20}  # all are launched in each step; here fewer are enough
Sizes = dict[str, dict[str, float]]


def solved(sim: sw.Simulation, **options: Any) -> sw.Simulation:
    """The same scene with steps that are solved, and contacts too."""
    return sw.Simulation(sim.model, dt=sim.dt, **{**EXACT, **NEWTON, **options})


def larger(sizes: Sizes, factor: float) -> Sizes:
    """Changes by a factor, where differences of smaller ones are what Newton's tolerance leaves."""
    return {group: {name: factor * size for name, size in held.items()} for group, held in sizes.items()}


@pytest.fixture
def solves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes of ``test_touches`` take steps that are solved."""
    made = test_touches.made
    monkeypatch.setattr(test_touches, "made", lambda *args, **options: solved(made(*args, **options)))


@pytest.fixture
def solves_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same with fewer iterations, above whose tolerance no gradient is told."""
    made = test_touches.made
    monkeypatch.setattr(test_touches, "made", lambda *args, **options: solved(made(*args, **options), **SOON))


@pytest.mark.parametrize(
    ("mu", "speed", "laws", "options", "expected"),
    [
        pytest.param(2.0, 0.0, {}, SOON, {STUCK}, id="stick"),
        pytest.param(0.3, 0.3, {"compliance": 1e-4}, {}, {OPEN, SLIPPING}, id="slip, soft", marks=SLOW),
        pytest.param(0.3, 0.3, {"restitution": 0.5}, {}, {OPEN, SLIPPING}, id="bounce", marks=SLOW),
    ],
)
def test_laws_of_contact(
    mu: float, speed: float, laws: dict[str, float], options: dict[str, Any], expected: set[int]
) -> None:
    """A cube with a cable on a floor, by state, commands, moduli and friction."""
    sim = solved(test_contact.block(mu, **laws), **options)
    given = test_contact.thrown(sim, speed)
    test_adjoint.check(Rollout(sim), given, test_contact.loss, own=1e-5)
    assert test_contact.modes(sim, given) >= expected


@SLOW
def test_a_moving_floor() -> None:
    """It moves and turns, and is where its velocities have taken it at the end of a step."""
    sim = solved(test_contact.block(0.8))
    sim.control.body_velocity[...] = torch.tensor([0.1, 0.0, 0.05, 0.3, -0.2, 0.5])
    test_adjoint.check(Rollout(sim), test_contact.thrown(sim, 0.1), test_contact.loss, own=1e-5)


@pytest.mark.parametrize(
    ("solves", "kind", "base"),
    [
        ("solves_soon", "capsule", "free"),
        *(pytest.param("solves", kind, "free", marks=SLOW) for kind in test_touches.UNDER if kind != "capsule"),
        *(pytest.param("solves", kind, "kinematic", marks=SLOW) for kind in ("sphere", "capsule", "box", "cylinder")),
    ],
)
def test_a_soft_cube_on_a_shape(request: pytest.FixtureRequest, solves: str, kind: str, base: str) -> None:
    """Shapes and meshes that are moved or move freely."""
    request.getfixturevalue(solves)
    test_touches.test_a_soft_cube_on_a_shape(kind, base)


@SLOW
@pytest.mark.parametrize("kind", test_touches.ABOVE)
def test_a_rigid_body_on_a_soft_bed(kind: str) -> None:
    """Corners, edges and rims on a soft body."""
    sim = solved(test_touches.on_bed(kind))
    given = test_touches.thrown(sim, 0.0, 0.0)
    check(Rollout(sim), given, test_touches.loss, larger(test_touches.SIZES, 10.0 if kind == "box" else 1.0))
    assert test_touches.modes(sim, given) & {STUCK, SLIPPING}


@pytest.mark.usefixtures("solves_soon")
def test_soft_on_soft() -> None:
    """Nodes on faces and edges on edges."""
    test_touches.test_soft_on_soft(1e-3, 0.0, 0.2)


@SLOW
@pytest.mark.usefixtures("solves")
def test_what_carries_something_that_touches() -> None:
    """A finger on a base that is moved, a block that is hit on its other side, and a ball that rolls."""
    test_touches.test_a_finger_on_a_base("bed")
    test_touches.test_a_body_that_carries_something_and_is_touched("kinematic")
    test_touches.test_a_ball_on_a_slope_and_a_wall(0)


@SLOW
@pytest.mark.usefixtures("solves")
def test_a_finger_on_a_free_box(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a modulus that changes by ten times as much: differences of less are rounding."""
    monkeypatch.setattr(test_touches, "SIZES", larger(test_touches.SIZES, 1.0))
    test_touches.SIZES["parameters"]["youngs"] *= 10.0
    test_touches.test_a_finger_on_a_base("box")


@pytest.mark.usefixtures("solves_soon")
def test_an_edge_that_lies_flat_and_slips() -> None:
    """Three contacts in a line press as two do: how they share that, and friction with it, a compliance tells alone."""
    sim, given = test_touches.hit_block("free")
    with pytest.raises(Diverged, match=r"world 0 and 0 others contacts that repeat each other slipped.*compliance"):
        gradients(Rollout(sim), given, test_touches.loss)
    sim, given = test_touches.hit_block("free", compliance=1e-5)
    sizes = larger(test_touches.SIZES, 1.0)
    sizes["state"] |= {"body_pose": 1e-8, "body_twist": 1e-6}  # more of them crosses a switch
    check(Rollout(sim), given, test_touches.loss, sizes)


@SLOW
@pytest.mark.parametrize("relaxes", [False, True])
@pytest.mark.parametrize("base", ["free", "kinematic"])
def test_contact_by_every_input(base: str, relaxes: bool) -> None:
    """A beam with cables and a chamber that touches a box beside a rod; also with a Maxwell branch."""
    sim = solved(test_every_input.touching(base, relaxes=relaxes))
    given, sizes = test_every_input.given_of(sim)
    check(Rollout(sim), given, test_every_input.loss, sizes)


@pytest.mark.parametrize(
    ("motor", "options"),
    [
        ("weak", {}),
        *(pytest.param(motor, {}, marks=SLOW) for motor in test_joints.MOTORS if motor != "weak"),
        *(pytest.param("servo", {"kind": kind}, marks=SLOW) for kind in ("slider", "ball", "weld")),
        *(pytest.param("servo", {"base": base}, marks=SLOW) for base in ("kinematic", "rod")),
        *(pytest.param(motor, {"soft": True}, marks=SLOW) for motor in ("servo", "weak")),
    ],
)
def test_joints_and_motors(motor: str, options: dict[str, Any]) -> None:
    """A double pendulum that is driven in every way, on every base, and with a soft finger."""
    sim = solved(test_joints.arm(motor, **options))
    check(Rollout(sim), test_joints.thrown(sim, [1]), test_joints.loss, test_joints.SIZES)


@SLOW
@pytest.mark.parametrize("motor", ["none", "servo"])
def test_laden_bodies_that_turn_fast(motor: str) -> None:
    """Free turning that is found from what is left without it."""
    sim = solved(test_joints.arm(motor, soft=True))
    given = test_joints.thrown(sim, [1])
    given["state"]["body_twist"] *= 8.0
    check(Rollout(sim), given, test_joints.loss, larger(test_joints.SIZES, 5.0))


@SLOW
def test_the_stiffness_of_joint_forces() -> None:
    """No step depends on it, whether Newton's method takes it or not."""
    found = []
    for tangent in (True, False):
        sim = solved(test_joints.arm("servo"), pressure_tangent=tangent)
        found.append(gradients(Rollout(sim), test_joints.thrown(sim, [1]), test_joints.loss))
    for group, held in found[0].items():
        for name, value in held.items():
            scale = float(value.abs().max()) + 1e-12
            assert torch.allclose(value, found[1][group][name], rtol=1e-8, atol=1e-8 * scale), name


@SLOW
@pytest.mark.parametrize("motor", ["servo", "rigid", "slow", "velocity"])
def test_joints_in_steps_of_second_order(motor: str) -> None:
    """Stages that are solved, and motors that go part of their way in each."""
    sim = solved(test_joints.arm(motor), integrator="bdf2")
    check(Rollout(sim), test_joints.thrown(sim, [1]), test_joints.loss, larger(test_joints.SIZES, 10.0))


@SLOW
@pytest.mark.parametrize("base", ["rod", "kinematic"])
def test_joints_by_every_input(base: str) -> None:
    """Links on a servo and a slider with a beam at their end."""
    sim = solved(test_every_input.jointed(base))
    given, sizes = test_every_input.given_of(sim)
    check(Rollout(sim), given, test_every_input.loss, sizes)


@SLOW
@pytest.mark.parametrize("motor", test_joints.MOTORS)
def test_a_leg_on_the_floor(motor: str) -> None:
    """A ball joint and a driven hinge over a foot that slips."""
    sim = solved(test_touching_joints.leg(motor))
    check(Rollout(sim), test_touching_joints.swung(sim), test_joints.loss, test_touching_joints.SIZES)


@SLOW
def test_a_soft_body_on_a_jointed_plate() -> None:
    """Nodes and edges of a soft body beside a joint."""
    sim = solved(test_touching_joints.flap())
    given = test_touches.thrown(sim, 0.2, 0.3)
    given["state"] = {name: value for name, value in given["state"].items() if name.startswith("node")}
    sizes = test_touches.SIZES | {"parameters": test_touches.SIZES["parameters"] | {"density": 0.1}}
    check(Rollout(sim), given, test_touches.loss, sizes)


def capsule() -> tuple[sw.Simulation, Inputs, Any]:
    """A soft cube on a capsule that moves freely."""
    sim = solved(test_touches.on_shape("capsule", "free"))
    return sim, test_touches.thrown(sim, 0.2, 0.3), test_touches.loss


def leg() -> tuple[sw.Simulation, Inputs, Any]:
    """A driven leg with a foot on the floor."""
    sim = solved(test_touching_joints.leg("servo"))
    return sim, test_touching_joints.swung(sim), test_joints.loss


def arm() -> tuple[sw.Simulation, Inputs, Any]:
    """A double pendulum whose motor is at its largest force, with steps of second order."""
    sim = solved(test_joints.arm("weak"), integrator="bdf2")
    return sim, test_joints.thrown(sim, [1]), test_joints.loss


@SLOW
@pytest.mark.parametrize("scene", [leg, arm, capsule])
def test_both_modes_agree(scene: Callable[[], tuple[sw.Simulation, Inputs, Any]]) -> None:
    """y . J d = d . J' y; the forward mode is one by rows."""
    sim, given, loss = scene()
    compare(Rollout(sim), given, loss)


@pytest.mark.parametrize("precision", ["float64", pytest.param("float32", marks=SLOW)])
def test_worlds_beside_change_no_bit_of_contact(precision: str) -> None:
    """A world of a batch has the gradient of that world alone."""

    def found(seeds: tuple[int, ...]) -> Inputs:
        sim = test_contact.block(0.5, len(seeds), precision)
        exact = {} if precision == "float64" else {"gauss_seidel_tolerance": 1e-6, "newton_tolerance": 1e-4}
        sim = solved(sim, **SOON, **exact)
        return gradients(Rollout(sim), test_contact.thrown(sim, 0.2, seeds), test_contact.loss)

    batch = found((1, 2, 3))
    for world, seed in enumerate((1, 2, 3)):
        for group, held in found((seed,)).items():
            for name, value in held.items():
                axis = 1 if name == "node_force" else 0
                assert torch.equal(batch[group][name].select(axis, world), value.select(axis, 0)), (group, name)


@SLOW
def test_worlds_beside_change_no_bit_of_joints_and_contact() -> None:
    """The same of a leg."""

    def found(seeds: tuple[int, ...]) -> Inputs:
        sim = solved(test_touching_joints.leg("weak", num_worlds=len(seeds)))
        return gradients(Rollout(sim), test_touching_joints.swung(sim, seeds), test_joints.loss)

    batch = found((1, 2, 3))
    for world, seed in enumerate((1, 2, 3)):
        for group, held in found((seed,)).items():
            for name, value in held.items():
                axis = 1 if group == "controls" else 0
                assert torch.equal(batch[group][name].select(axis, world), value.select(axis, 0)), (group, name)


@pytest.mark.parametrize(
    ("scene", "seed"),
    [
        ("edge", 1),
        pytest.param("mesh", 1, marks=SLOW),
        pytest.param("crease", 2, marks=SLOW),
        pytest.param("soft", 1, marks=SLOW),
    ],
)
def test_contacts_that_came_and_went(scene: str, seed: int) -> None:
    """Edges of a soft cube that tilt across edges of a box, a mesh and another soft body, and a ball in a crease.

    Between two iterates the lowest place of such an edge jumped from one end to the other, and the nearest face of the
    ball from one to the other, so that steps went round.
    """
    sizes = larger(test_touches.SIZES, 1.0)
    sim, given = come_and_go(scene, (seed,))
    found = test_touches.modes(sim, given)
    assert found & {STUCK, SLIPPING}
    if SLIPPING not in found:
        del given["parameters"]["pair_mu"]  # what sticks does not depend on it, and differences are rounding
    check(Rollout(sim), given, test_touches.loss, sizes)


def come_and_go(scene: str, seeds: tuple[int, ...], precision: str = "float64") -> tuple[sw.Simulation, Inputs]:
    """Scenes whose contacts came and went between iterates of a step."""
    if scene == "soft":
        sim = solved(test_touches.on_soft(-5e-4))
        return sim, test_touches.thrown(sim, 0.6, 0.1, seeds)
    kind = "sphere" if scene == "crease" else scene
    exact = {} if precision == "float64" else {"gauss_seidel_tolerance": 1e-6, "newton_tolerance": 1e-3}
    sim = solved(test_touches.on_shape(kind, "kinematic", len(seeds), precision), **exact)
    return sim, test_touches.thrown(sim, 0.2, 0.3, seeds)


@pytest.mark.parametrize("precision", ["float64", pytest.param("float32", marks=SLOW)])
@pytest.mark.parametrize("scene", ["edge", pytest.param("mesh", marks=SLOW)])
def test_worlds_beside_change_no_bit_of_contacts_that_stay(scene: str, precision: str) -> None:
    """A world of a batch takes the steps of that world alone."""

    def stepped(seeds: tuple[int, ...]) -> sw.Simulation:
        sim, given = come_and_go(scene, seeds, precision)
        for name, value in given["state"].items():
            getattr(sim, name)[...] = value
        sim.step(3)
        assert not sim.status.any()
        return sim

    batch = stepped((1, 2, 3))
    for world, seed in enumerate((1, 2, 3)):
        alone = stepped((seed,))
        for name in ("node_x", "node_v", "contact_load", "contact_pair"):
            assert torch.equal(getattr(batch, name)[world], getattr(alone, name)[0]), name


def test_what_stays_has_no_force_where_it_is_apart() -> None:
    """Where steps end, contacts of edges across edges of the box press, or are apart and have no force."""
    sim, given = come_and_go("edge", (1,))
    for name, value in given["state"].items():
        getattr(sim, name)[...] = value
    contact = sim._systems[0].contact
    assert contact is not None
    across, apart = 0, 0
    for _ in range(5):
        sim.step()
        assert not sim.status.any()
        count = int(contact.contacts.count.real.numpy()[0, 0, 0])
        distance = contact.detector.touch.real.numpy()[0, :, 0].reshape(-1, TOUCH_ROWS)[:count, DISTANCE]
        pressure = contact.contacts.multiplier.real.numpy()[0, :, 0].reshape(-1, 3)[:count, 0]
        assert (pressure[distance > 1e-9] < 1e-9).all()
        across += int((contact.detector.face.real.numpy()[0, :count, 0] > 0).sum())
        apart += int((distance > 1e-9).sum())
    assert across and apart


def test_steps_that_go_round_are_told() -> None:
    """Where contacts turn too much from iteration to iteration, no step and no gradient is found."""
    sim = solved(test_touches.on_bed("capsule"))
    given = test_touches.thrown(sim, 0.0, 0.0, (3,))
    with pytest.raises(Diverged, match="iterations of a step ended above their tolerance in world 0"):
        Rollout(sim)(given["state"], given["controls"], given["parameters"])


@pytest.mark.cuda
@pytest.mark.parametrize("seeds", [(1, 2, 3)])
def test_a_gpu_finds_the_same(seeds: tuple[int, ...]) -> None:
    """Gradients beside contact of several worlds on a GPU are those on a CPU but for rounding."""
    found = []
    for device in ("cpu", "cuda:0"):
        sim = solved(test_contact.block(0.5, len(seeds), device=device))
        found.append(gradients(Rollout(sim), test_contact.thrown(sim, 0.2, seeds), test_contact.loss))
    for group, held in found[0].items():
        for name, value in held.items():
            size = float(value.abs().max())
            torch.testing.assert_close(found[1][group][name].cpu(), value, rtol=1e-6, atol=1e-7 * size)
