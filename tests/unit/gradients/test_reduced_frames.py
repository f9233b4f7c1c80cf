"""Gradients of reduced bodies beside rigid bodies that move, joints and memories, by every input."""

from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Rollout, States
from tests.gradient_cases import STEPS, Inputs, gradients
from tests.reduction_cases import SLAB, quadratic_modes, reduced_by, scene, smooth_modes
from tests.unit.gradients import test_reduced_beside as beside
from tests.unit.gradients import test_rods as rods
from tests.unit.gradients.test_contact import EXACT, SLIPPING, STUCK
from tests.unit.gradients.test_forward_frames import compare
from tests.unit.gradients.test_reduced import SOFTNESS
from tests.unit.gradients.test_rods import check
from tests.unit.gradients.test_touches import modes

SLOW = pytest.mark.slow


def chained(
    num_worlds: int = 1,
    precision: str = "float64",
    device: str = "cpu",
    *,
    joints: bool = True,
    floating: bool = False,
    relaxes: bool = False,
    touches: bool = False,
    soft: bool = True,
    dt: float = 0.01,
    **options: Any,
) -> sw.Simulation:
    """The slab, reduced, with a cable to a rigid body that hangs on a hinge or moves freely; a soft one is on its end.

    Args:
        num_worlds: Of the model.
        precision: Likewise.
        device: Likewise.
        joints: Hang the rigid body on a hinge with a servo, and another on a ball joint behind it.
        floating: The slab is free and has a floating frame; else it is held.
        relaxes: Whether the soft body has a memory.
        touches: The slab lies on a ball, which a joint holds if there are joints.
        soft: Put the soft body on.
        dt: Step [s].
        **options: Of the simulation.
    """
    builder = scene(held=not floating, contact=False)
    weights = np.random.default_rng(0).uniform(0.5, 1.5, len(SLAB.tets))
    weights[::3] = 0.0
    modes = quadratic_modes() if floating else smooth_modes(held=True)
    builder.reduce(0, reduced_by(modes, frame="floating" if floating else "fixed", tet_weight=weights))
    box, end = sw.Box((0.04, 0.02, 0.02)), 0.12
    link = last = builder.add_rigid(box, mass=0.03, pose=(0.1, 0.015, 0.006), damping=0.2)
    if joints:
        last, end = builder.add_rigid(box, mass=0.03, pose=(0.14, 0.015, 0.006), damping=0.2), 0.16
        servo: dict[str, Any] = {"control": "position", "stiffness": 0.5, "damping": 0.01}
        builder.add_joint(None, link, "hinge", anchor=(0.08, 0.015, 0.006), axis=(0.0, 1.0, 0.2), **servo)
        builder.add_joint(link, last, "ball", anchor=(0.12, 0.015, 0.006))
    path = [(0.03, 0.01, 0.01), (0.055, 0.01, 0.01), (0.11, 0.02, 0.012)]
    builder.add_cable([0, 0, link], path, stiffness=200.0, damping=1.0)
    if soft:
        mesh, stuff = meshing.box((0.03, 0.02, 0.02), (1, 1, 1)), sw.Corotational(1e5, 0.3)
        memory: dict[str, Any] = {"rayleigh": (0.3, 0.01), **({"relaxation": (0.3, 0.05)} if relaxes else {})}
        finger = builder.add_tets(mesh.nodes + (end, 0.005, 0.0), mesh.tets, material=stuff, density=1000.0, **memory)
        builder.attach(finger, box=((0.11, -1.0, -1.0), (end + 1e-4, 1.0, 1.0)), to=last)
    exact = EXACT if precision == "float64" else {}
    if touches:
        ball = builder.add_rigid(sw.Sphere(0.02), mass=0.05, pose=(0.041, 0.0152, -0.0203))
        if joints:
            builder.add_joint(None, ball, "ball", anchor=(0.041, 0.0152, -0.0403))
        laws = {"mu": 0.7, "compliance": SOFTNESS, "alarm_distance": 0.003, "contact_distance": 0.0005}
        builder.add_contact(0, ball, **laws)
        exact = {**exact, "contact_passes": 0 if joints else 1}
    capacity = 200 if touches else None
    model = builder.finalize(num_worlds=num_worlds, precision=precision, device=device, contact_capacity=capacity)
    return sw.Simulation(model, dt=dt, **{**exact, **options})


def given_of(sim: sw.Simulation, seeds: list[int]) -> tuple[Inputs, dict[str, dict[str, Any]]]:
    """Every input of worlds, each of its own seed, and its change."""
    given, sizes = beside.given_of(sim, seeds)
    sizes = {group: dict(held) for group, held in sizes.items()}
    if sim.model.joints is not None:
        shape = (STEPS, sim.control.joint_target.shape[1])
        targets = [np.random.default_rng(seed).uniform(0.03, 0.06, shape) for seed in seeds]
        given["controls"]["joint_target"] = torch.tensor(np.stack(targets, axis=1))
        sizes["controls"]["joint_target"] = 1e-5
        sizes["parameters"] |= {"joint_stiffness": 1e-3, "joint_damping": 1e-5}
    if sim.model.reduction is not None and sim.model.reduction.floating is not None:
        turns = [np.random.default_rng(100 + seed).standard_normal((1, 4)) for seed in seeds]
        turn = torch.tensor(np.stack(turns))
        given["state"]["mode_turn"] = turn / turn.norm(dim=-1, keepdim=True)
        given["state"]["mode_q"][:, 3:6] = 0.0
        sizes["state"]["mode_turn"] = 1e-5
    if sim.model.contact is not None:  # less crosses no switch, and bodies lie where the scene has them
        given["state"]["body_pose"] = sim.body_pose.cpu().clone()
        sizes["parameters"] |= {"pair_mu": 1e-5, "youngs": 10.0, "nu": 1e-4}
    placed = {group: {name: value.to(sim.node_x) for name, value in held.items()} for group, held in given.items()}
    return placed, sizes


def loss(states: States) -> torch.Tensor:
    """A number for every world; of quaternions too."""
    rng = np.random.default_rng(8)
    total = states.node_x.new_zeros(states.node_x.shape[1])
    sizes = {"node_x": 10.0, "node_v": 1.0, "body_pose": 10.0, "body_twist": 1.0, "mode_q": 10.0, "mode_v": 1.0}
    for name, size in {
        **sizes,
        "mode_turn": 0.1,
        "marker_x": 10.0,
        "cable_tension": 0.1,
        "cavity_pressure": 1e-3,
    }.items():
        value = getattr(states, name)
        if value.numel():
            weight = torch.tensor(rng.standard_normal((STEPS, 1, *value.shape[2:]))).to(value)[-len(value) :]
            total = total + size * (value * weight).flatten(2).sum(dim=(0, 2))
    return total


SCENES = {
    "joints": chained,
    "joints and a memory": partial(chained, relaxes=True),
    "joints, floating": partial(chained, floating=True),
    "joints and a memory, floating": partial(chained, floating=True, relaxes=True),
    "a body, floating": partial(chained, joints=False, floating=True),
    "a body with a memory, floating": partial(chained, joints=False, floating=True, relaxes=True),
}
TOUCHING = {
    "joints and a ball": partial(chained, touches=True),
    "joints and a ball, floating": partial(chained, touches=True, floating=True),
    "a ball, floating": partial(chained, joints=False, touches=True, floating=True),
}
SOLVED: dict[str, Any] = {"newton_iterations": 100, "newton_tolerance": 1e-13, "project_tangent": False}
ON_A_GPU = ["joints", "joints, floating", "a body with a memory, floating"]
FAST = ["joints", "joints and a memory, floating"]


@pytest.mark.parametrize("name", [name if name in FAST else pytest.param(name, marks=SLOW) for name in SCENES])
def test_gradients_are_those_of_differences(name: str) -> None:
    """In a fixed and in a floating frame."""
    sim = SCENES[name]()
    given, sizes = given_of(sim, [3])
    check(Rollout(sim), given, loss, sizes)


@pytest.mark.parametrize(
    "name", [name if name == "joints and a ball" else pytest.param(name, marks=SLOW) for name in TOUCHING]
)
def test_gradients_beside_contact_are_those_of_differences(name: str) -> None:
    """On a ball that moves, one of three parts that the slab is held by."""
    sim = TOUCHING[name]()
    given, sizes = given_of(sim, [3])
    check(Rollout(sim), given, loss, sizes)
    assert "pair_mu" in given["parameters"]
    if name != "a ball, floating":
        assert modes(sim, given) & {STUCK, SLIPPING}


def tied_to_a_rod() -> sw.Simulation:
    """The slab, in a floating frame, with a cable to the middle of a rod that is clamped."""
    builder = scene(held=False, contact=False)
    builder.reduce(0, reduced_by(quadratic_modes(), frame="floating"))
    line = np.linspace((0.09, 0.015, 0.006), (0.15, 0.015, 0.016), 3)
    rod = builder.add_rod(line, radius=0.003, youngs=2e6, nu=0.4, density=1100.0, rayleigh=(0.3, 0.01))
    builder.fix(rod, nodes=[2])
    path = [(0.03, 0.01, 0.01), (0.055, 0.01, 0.01), (0.12, 0.018, 0.012)]
    builder.add_cable([0, 0, rod], path, stiffness=200.0, damping=1.0)
    return sw.Simulation(builder.finalize(num_worlds=1, precision="float64"), dt=0.01, **EXACT)


def test_gradients_beside_a_rod_are_those_of_differences() -> None:
    """In a floating frame, by states, loads and moduli of both."""
    sim = tied_to_a_rod()
    given, sizes = given_of(sim, [3])
    of_rods = rods.bent(sim, [3])
    given["state"] = {name: value for name, value in given["state"].items() if value.numel()} | of_rods["state"]
    given["controls"]["rod_force"] = 0.1 * of_rods["controls"]["rod_force"]
    given["parameters"] |= of_rods["parameters"]
    sizes = {group: {**held, **rods.SIZES.get(group, {})} for group, held in sizes.items()}
    sizes["controls"]["cable_displacement"] = 1e-8
    sizes["state"] |= {**rods.STARTS, "rod_w": 1e-2}  # which change little beside the slab
    sizes["parameters"] |= {"rod_youngs": 2e3}

    def both(states: States) -> torch.Tensor:
        rng = np.random.default_rng(9)
        weight = torch.tensor(rng.standard_normal((STEPS, 1, *states.rod_x.shape[2:])))
        return loss(states) + 10.0 * (states.rod_x * weight).sum(dim=(0, 2, 3)) + states.rod_q.sum(dim=(0, 2, 3))

    assert (Rollout(sim)(given["state"], given["controls"]).cable_tension[:2] > 1e-3).all()
    check(Rollout(sim), given, both, sizes)
    assert {"rod_youngs", "youngs"} <= set(given["parameters"])


@SLOW
def test_gradients_of_several_iterations_beside_joints_and_contact() -> None:
    """In short steps, whose iterations converge beside a ball."""
    sim = chained(touches=True, soft=False, dt=0.001, **SOLVED)
    given, sizes = given_of(sim, [3])
    check(Rollout(sim), given, loss, sizes)
    assert modes(sim, given) & {STUCK, SLIPPING}


@SLOW
@pytest.mark.parametrize("integrator", ["bdf2", "trapezoidal"])
def test_gradients_of_steps_of_second_order_beside_joints(integrator: str) -> None:
    """With the exact tangent, as at rest a projected one has kinks."""
    sim = chained(integrator=integrator, project_tangent=False)
    given, sizes = given_of(sim, [3])
    check(Rollout(sim), given, loss, sizes)


@pytest.mark.parametrize("name", ["joints", pytest.param("joints, floating", marks=SLOW)])
def test_both_modes_agree(name: str) -> None:
    """y . J d = d . J' y in every input."""
    sim = SCENES[name]()
    compare(Rollout(sim), given_of(sim, [3])[0], loss)


@pytest.mark.parametrize(
    ("name", "precision", "device"),
    [
        ("joints and a memory, floating", "float64", "cpu"),
        pytest.param("joints", "float32", "cpu", marks=SLOW),
        pytest.param("joints, floating", "float64", "cuda:0", marks=pytest.mark.cuda),
    ],
)
def test_worlds_beside_and_kept_factors_change_no_bit(name: str, precision: str, device: str) -> None:
    """A world of a batch has the gradient of that world alone, and kept factors lead to the same."""
    seeds = [1, 2, 3]
    batch, single = (SCENES[name](count, precision, device) for count in (3, 1))
    rollout, given = Rollout(batch), given_of(batch, seeds)[0]
    plain, kept = gradients(rollout, given, loss), gradients(rollout, given, loss, factors=True)
    alone = Rollout(single)
    for world, seed in enumerate(seeds):
        for group, held in gradients(alone, given_of(single, [seed])[0], loss).items():
            for key, value in held.items():
                axis = int(group == "controls")
                assert torch.equal(plain[group][key].select(axis, world), value.select(axis, 0)), (group, key)
                assert torch.equal(plain[group][key], kept[group][key]), (group, key)


@pytest.mark.cuda
@pytest.mark.parametrize("name", ON_A_GPU)
def test_a_gpu_finds_the_same(name: str) -> None:
    """To what sums in another order leave."""
    found = []
    for device in ("cpu", "cuda:0"):
        sim = SCENES[name](2, device=device)
        found.append(gradients(Rollout(sim), given_of(sim, [1, 2])[0], loss))
    for group, held in found[0].items():
        for key, value in held.items():
            error = (found[1][group][key].cpu() - value).abs().max()
            assert error <= 1e-8 * value.abs().max(), (group, key, float(error), float(value.abs().max()))
