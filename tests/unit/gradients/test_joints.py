"""Gradients through steps of joints and motors, against central differences in float64."""

from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Rollout
from tests.cases import material
from tests.gradient_cases import STEPS, Inputs, gradients
from tests.unit.gradients.test_bodies import loss
from tests.unit.gradients.test_contact import EXACT
from tests.unit.gradients.test_rigid import bodies
from tests.unit.gradients.test_rods import check

SIZES = {
    "state": {"body_pose": 1e-7, "body_twist": 1e-5, "node_x": 1e-7, "node_v": 1e-5},
    "controls": {
        "body_force": 1e-6,
        "cable_tension": 1e-5,
        "joint_target": 1e-5,
        "joint_force": 1e-6,
        "body_velocity": 1e-5,
    },
    "parameters": {
        "body_mass": 1e-6,
        "body_damping": 1e-3,
        "joint_stiffness": 1e-3,
        "joint_damping": 1e-5,
        "gravity": 1e-3,
        "youngs": 50.0,
        "nu": 1e-4,  # at a tenth of it rounding is a millionth of the smallest slopes
        "density": 1e-2,
        "rayleigh_stiffness": 1e-6,
        "relaxation_ratio": 1e-5,
        "relaxation_time": 1e-6,
    },
}
MOTORS: dict[str, dict[str, Any]] = {
    "none": {},
    "servo": {"control": "position", "stiffness": 0.5, "damping": 0.01},
    "slow": {"control": "position", "stiffness": 0.5, "damping": 0.01, "max_rate": 0.4},
    "weak": {"control": "position", "stiffness": 5.0, "damping": 0.01, "max_force": 0.02},
    "stopped": {"limits": (-0.01, 0.01)},
    "outside": {"control": "position", "stiffness": 0.5, "damping": 0.01, "limits": (-0.004, 0.5)},
    "rigid": {"control": "position"},
    "velocity": {"control": "velocity"},
    "force": {"control": "force"},
}


def arm(
    motor: str = "servo",
    kind: str = "hinge",
    num_worlds: int = 1,
    precision: str = "float64",
    *,
    soft: bool = False,
    base: str = "world",
    integrator: str = "euler",
    relaxation: tuple[float, float] = (0.0, 0.0),
) -> sw.Simulation:
    """Two links, the first on a hinge; the second one may carry a soft finger.

    Args:
        motor: Of the joint between both, of ``MOTORS``.
        kind: Of that joint.
        num_worlds: Worlds.
        precision: Of the model.
        soft: Put the finger on.
        base: What the first link hangs from: the world, a moving base or the free end of a rod.
        integrator: Of the simulation.
        relaxation: Maxwell branch of the finger.
    """
    builder = sw.ModelBuilder(gravity=(1.0, 2.0, -9.81))
    shape = sw.Box((0.1, 0.03, 0.02))
    upper = builder.add_rigid(shape, mass=0.08, pose=(0.05, 0.0, 0.0), damping=0.2)
    lower = builder.add_rigid(shape, mass=0.06, pose=(0.15, 0.0, 0.0))
    held: Any = None
    if base == "kinematic":
        held = builder.add_rigid(sw.Box((0.02, 0.02, 0.02)), pose=(-0.01, 0.0, 0.0), kinematic=True)
    elif base == "rod":
        line = np.linspace((-0.1, 0.0, 0.0), (0.0, 0.0, 0.0), 3)
        rod = builder.add_rod(line, radius=0.005, youngs=5e7, density=1100.0, rayleigh=(0.2, 0.005))
        builder.fix(rod, nodes=[0])
        held = (rod, 2)
    builder.add_joint(held, upper, "hinge", anchor=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.2))
    driven = MOTORS[motor] if kind in ("hinge", "slider") else {}
    builder.add_joint(upper, lower, kind, anchor=(0.1, 0.0, 0.0), axis=(0.1, 1.0, 0.0), **driven)  # type: ignore[arg-type]
    builder.add_marker(lower, (0.2, 0.0, 0.01))
    builder.add_cable([upper, lower], [(0.03, 0.01, 0.01), (0.17, 0.01, 0.01)], control="force")
    if soft:
        mesh = meshing.box((0.06, 0.02, 0.02), (2, 1, 1))
        finger = builder.add_tets(
            mesh.nodes + (0.2, -0.01, -0.01),
            mesh.tets,
            material=material("large", 1e5, 0.4),
            density=1000.0,
            rayleigh=(0.5, 0.01),
            relaxation=relaxation,
        )
        builder.attach(finger, box=((0.19, -1, -1), (0.2 + 1e-6, 1, 1)), to=lower)
    model = builder.finalize(num_worlds=num_worlds, precision=precision)  # type: ignore[arg-type]
    return sw.Simulation(model, dt=0.01, integrator=integrator, **({} if integrator == "euler" else EXACT))  # type: ignore[arg-type]


def thrown(sim: sw.Simulation, seeds: list[int]) -> Inputs:
    """Links that are a little apart and swing; world i has those of individual ``seeds[i]``."""
    worlds: dict[str, list[torch.Tensor]] = {}
    for seed in seeds:
        rng = np.random.default_rng(seed)

        def near(value: torch.Tensor, size: float, rng: np.random.Generator = rng) -> torch.Tensor:
            return value[0] + torch.tensor(size * rng.standard_normal(value[0].shape)).to(value)

        found = {} if sim.model.has_kinematic else bodies(sim, near)
        if sim.model.body_count:
            found |= {"node_x": near(sim.node_x, 1e-4), "node_v": near(sim.node_v, 0.05)}
        found["body_force"] = near(sim.control.body_force, 0.1) * torch.tensor([1.0] * 3 + [0.02] * 3).to(sim.body_pose)
        for name, value in found.items():
            worlds.setdefault(name, []).append(value)
    stacked = {name: torch.stack(value) for name, value in worlds.items()}
    controls = {"body_force": stacked.pop("body_force").expand(STEPS, -1, -1, -1)}
    steps = torch.arange(1, STEPS + 1).to(sim.body_pose)[:, None, None]
    one = torch.ones_like(sim.control.joint_target)
    controls |= {"joint_target": 0.05 * steps * one, "joint_force": 0.01 * steps * one}
    controls["cable_tension"] = (0.4 * torch.ones_like(sim.control.cable_tension)).expand(STEPS, -1, -1)
    if sim.model.has_kinematic:
        controls["body_velocity"] = 0.3 * torch.ones_like(sim.control.body_velocity).expand(STEPS, -1, -1, -1)
    parameters = {name: getattr(sim.params, name).clone() for name in SIZES["parameters"]}
    return {"state": stacked, "controls": controls, "parameters": {n: v for n, v in parameters.items() if v.numel()}}


SLOW = pytest.mark.slow


COARSE = {"density": 1.0, "relaxation_time": 1e-5}  # changes of what has the smallest slopes beside memories
MEMORY = (0.4, 0.02)


@pytest.mark.parametrize(
    ("motor", "options"),
    [
        ("weak", {}),
        pytest.param("none", {}, marks=SLOW),
        pytest.param("stopped", {}, marks=SLOW),
        pytest.param("rigid", {}, marks=SLOW),
        ("servo", {"base": "kinematic"}),
        pytest.param("servo", {"integrator": "bdf2"}, marks=SLOW),
        pytest.param("none", {"base": "kinematic", "integrator": "bdf2"}, marks=SLOW),
    ],
)
def test_fingers_with_memories_on_links(motor: str, options: dict[str, Any]) -> None:
    """A Maxwell branch of what driven links carry."""
    sim = arm(motor, soft=True, relaxation=MEMORY, **options)
    check(Rollout(sim), thrown(sim, [1]), loss, {**SIZES, "parameters": SIZES["parameters"] | COARSE})


def test_worlds_and_kept_factors_change_no_bit_beside_memories() -> None:
    """A batch has the gradients of each world alone, whether factors are kept."""
    batch, single = (arm("weak", num_worlds=count, soft=True, relaxation=MEMORY) for count in (2, 1))
    together, rollout = gradients(Rollout(batch), thrown(batch, [1, 2]), loss), Rollout(single)
    for world, seed in enumerate([1, 2]):
        alone = gradients(rollout, thrown(single, [seed]), loss)
        kept = gradients(rollout, thrown(single, [seed]), loss, factors=True)
        for group, held in alone.items():
            for name, value in held.items():
                axis = int(group == "controls")
                assert torch.equal(together[group][name].select(axis, world), value.select(axis, 0)), (group, name)
                assert torch.equal(kept[group][name], value), (group, name)


@pytest.mark.parametrize(
    "motor", [motor if motor in ("none", "weak") else pytest.param(motor, marks=SLOW) for motor in MOTORS]
)
def test_gradients_are_those_of_differences(motor: str) -> None:
    """Of a double pendulum that is driven in every way, by all that a step starts from."""
    sim = arm(motor)
    check(Rollout(sim), thrown(sim, [1]), loss, SIZES)


def test_motors_are_in_the_states_that_gradients_are_to_prove() -> None:
    """The weak motor has its largest force, limits push, and the slow one's reference lags."""
    found = {}
    for motor in ("weak", "stopped", "outside", "slow"):
        sim = arm(motor)
        given = thrown(sim, [1])
        states = Rollout(sim)(given["state"], given["controls"], given["parameters"])
        assert len(states.step) == STEPS
        for name, value in given["state"].items():
            getattr(sim, name)[...] = value
        for step in range(STEPS):
            for name, value in given["controls"].items():
                getattr(sim.control, name)[...] = value[step]
            sim.step()
            if step == 0:  # outside its limits; a row's force has the length that it turns about
                scale = float(sim.model.joints.joint_scale.numpy()[1])
                row = scale * float(sim.state_tensors()["joint_multiplier"][0, -1])
                assert (row > 1.01 * abs(float(sim.joint_force[0, 1]))) == (motor in ("stopped", "outside")), motor
        found[motor] = sim
    assert abs(float(found["weak"].joint_force[0, 1])) == pytest.approx(0.02, rel=1e-9)
    assert float(found["stopped"].joint_position[0, 1]) == pytest.approx(-0.01, abs=1e-5)
    lag = float(found["slow"].control.joint_target[0, 1] - found["slow"].state_tensors()["joint_reference"][0, 1])
    assert lag > 0.1


@SLOW
@pytest.mark.parametrize("kind", ["slider", "ball", "weld"])
def test_other_joints(kind: str) -> None:
    """Rows of all kinds, with a servo where there is an axis."""
    sim = arm("servo", kind)
    check(Rollout(sim), thrown(sim, [1]), loss, SIZES)


@pytest.mark.parametrize("base", ["kinematic", pytest.param("rod", marks=SLOW)])
def test_moving_bases(base: str) -> None:
    """A hinge on a base that commands move, or on a rod."""
    sim = arm("servo", base=base)
    check(Rollout(sim), thrown(sim, [1]), loss, SIZES)


@pytest.mark.parametrize("motor", ["servo", pytest.param("weak", marks=SLOW)])
def test_soft_fingers_on_links(motor: str) -> None:
    """A soft body that a driven link carries."""
    sim = arm(motor, soft=True)
    check(Rollout(sim), thrown(sim, [1]), loss, SIZES)


@SLOW
@pytest.mark.parametrize("motor", ["none", "servo"])
def test_laden_bodies_that_turn_fast(motor: str) -> None:
    """Masses of what a jointed body carries change how it turns by itself, and how it is slowed down."""
    sim = arm(motor, soft=True)
    given = thrown(sim, [1])
    given["state"]["body_twist"] *= 8.0
    check(Rollout(sim), given, loss, SIZES)


@pytest.mark.parametrize("free", ["x", "ry"])
def test_motors_of_bodies_on_rails(free: str) -> None:
    """A cart on a slider and a turntable on a hinge: what a servo's target does to them is that of a driven oscillator.

    A step with stiffness k, damping d and mass m takes q1 - q0 = h v1, m (v1 - v0) = h (k (r - q1) - d v1), so that
    dv1/dr = h k / (m + h d + h^2 k), and the same with the moment of inertia.
    """
    stiffness, damping, h = 3.0, 0.05, 0.01
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    cart = builder.add_rigid(mass=0.2, inertia=(1e-3, 2e-3, 3e-3), free_axes=(free,))
    kind, axis = ("slider", (1.0, 0.0, 0.0)) if free == "x" else ("hinge", (0.0, 1.0, 0.0))
    builder.add_joint(None, cart, kind, axis=axis, control="position", stiffness=stiffness, damping=damping)  # type: ignore[arg-type]
    sim = sw.Simulation(builder.finalize(num_worlds=1, precision="float64"), dt=h)
    target = torch.full((1, 1, 1), 0.01, dtype=torch.float64, requires_grad=True)
    twist = Rollout(sim)(controls={"joint_target": target}).body_twist[0, 0, cart]
    found = twist[0] if free == "x" else twist[4]
    (slope,) = torch.autograd.grad(found, target)
    mass = 0.2 if free == "x" else 2e-3
    assert float(slope) == pytest.approx(h * stiffness / (mass + h * damping + h**2 * stiffness), rel=1e-12)


@SLOW
def test_worlds_and_kept_factors_change_no_bit() -> None:
    """A batch has the gradients of each world alone, whether factors are kept or not."""
    seeds = [1, 2]
    batch, single = arm("weak", num_worlds=2, soft=True), arm("weak", soft=True)
    rollout, given = Rollout(batch), thrown(batch, seeds)
    plain = gradients(rollout, given, loss, steps=STEPS)
    for options in ({"factors": True}, {"every": STEPS}, {"every": STEPS, "factors": True}):
        last = gradients(rollout, given, loss, steps=STEPS, every=options.get("every", 1))
        other = gradients(rollout, given, loss, steps=STEPS, **options)
        assert all(torch.equal(other[g][n], last[g][n]) for g, held in last.items() for n in held), options
    for world, seed in enumerate(seeds):
        alone = gradients(Rollout(single), thrown(single, [seed]), loss, steps=STEPS)
        for name, value in alone["state"].items():
            assert torch.equal(plain["state"][name][world], value[0]), name


@pytest.mark.parametrize(
    ("motor", "options"),
    [
        ("slow", {}),
        *(pytest.param(motor, {}, marks=SLOW) for motor in MOTORS if motor != "slow"),
        *(pytest.param("servo", {"kind": kind}, marks=SLOW) for kind in ("slider", "ball", "weld")),
        pytest.param("servo", {"base": "kinematic"}, marks=SLOW),
        pytest.param("servo", {"base": "rod", "soft": True}, marks=SLOW),
    ],
)
def test_steps_of_second_order(motor: str, options: dict[str, Any]) -> None:
    """Two stages that are linearised where they start, and motors that go part of their way in each."""
    sim = arm(motor, integrator="bdf2", **options)
    damping = 1e-4 if "base" in options else 1e-3  # there it counts, and differences of a tenth of it are not exact
    parameters = SIZES["parameters"] | {"body_mass": 1e-4, "joint_damping": damping, "density": 1.0}  # hardly count
    check(Rollout(sim), thrown(sim, [1]), loss, {**SIZES, "parameters": parameters})


def test_worlds_beside_change_no_bit_of_steps_of_second_order() -> None:
    """A batch has the gradients of each world alone."""
    batch, single = arm("weak", num_worlds=2, integrator="bdf2"), arm("weak", integrator="bdf2")
    together = gradients(Rollout(batch), thrown(batch, [1, 2]), loss, steps=STEPS)
    for world, seed in enumerate((1, 2)):
        alone = gradients(Rollout(single), thrown(single, [seed]), loss, steps=STEPS)
        for name, value in alone["state"].items():
            assert torch.equal(together["state"][name][world], value[0]), name
        for name, value in alone["controls"].items():
            assert torch.equal(together["controls"][name][:, world], value[:, 0]), name


@SLOW
def test_lanes_follow_float64() -> None:
    """Gradients in float32, of nine worlds in lanes, agree with those in float64 to a hundredth of their size."""
    found = []
    for precision in ("float64", "float32"):
        sim = arm("servo", num_worlds=9, precision=precision)
        given = thrown(arm("servo", num_worlds=9), list(range(9)))
        fitting = {g: {n: v.to(sim.body_pose) for n, v in held.items()} for g, held in given.items()}
        found.append(gradients(Rollout(sim), fitting, loss, steps=STEPS))
    for group, held in found[0].items():
        for name, value in held.items():
            error = (found[1][group][name].double() - value).abs().max()
            assert error <= 1e-2 * value.abs().max(), (group, name)
