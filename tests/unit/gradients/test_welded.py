"""Gradients of what moves with another part: centres of mass off an origin, attached bodies and rods."""

from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Rollout
from tests.gradient_cases import STEPS, Inputs, gradients
from tests.unit.gradients import test_joints, test_rigid
from tests.unit.gradients.test_forward_frames import compare
from tests.unit.gradients.test_rigid import bodies
from tests.unit.gradients.test_rods import check, turned

SLOW = pytest.mark.slow
LOPSIDED = sw.Compound([(sw.Box((0.06, 0.03, 0.02)), (0.01, 0.0, 0.004)), (sw.Sphere(0.012), (0.035, 0.008, 0.01))])
SIZES: dict[str, dict[str, float]] = {
    group: test_rigid.SIZES.get(group, {}) | test_joints.SIZES.get(group, {}) for group in test_rigid.SIZES
}
SIZES["controls"]["rod_force"] = 1e-6
SIZES["parameters"] |= {"rod_nu": 1e-5, "rod_rayleigh_stiffness": 1e-6, "rod_rayleigh_mass": 1e-3, "pair_mu": 1e-5}


def scene(kind: str, num_worlds: int = 1, precision: str = "float64") -> sw.Simulation:
    """One way to be welded.

    Args:
        kind: ``tops``: lopsided bodies that fly, slide along axes, hang on cables and carry others; ``arm``: a soft
            beam with one at its end, and one on that; ``rod``: rods on a free and on a moving body; ``hinge``: a
            lopsided link whose attached end has a motor; ``bed``: one body attached to another presses into a soft bed.
        num_worlds: Worlds.
        precision: Of the model.
    """
    builder = sw.ModelBuilder(gravity=(1.0, 2.0, -9.81))
    BUILD[kind](builder)
    model = builder.finalize(num_worlds=num_worlds, precision=precision)  # type: ignore[arg-type]
    exact = {"gauss_seidel_tolerance": 1e-14, "gauss_seidel_iterations": 400, "contact_passes": 0}
    return sw.Simulation(model, dt=0.01, **(exact if kind == "bed" else {}))  # type: ignore[arg-type]


def _tops(builder: sw.ModelBuilder) -> None:
    builder.add_rigid(LOPSIDED, mass=0.05, pose=(0.0, 0.0, 0.3), damping=0.3)
    hung = builder.add_rigid(LOPSIDED, mass=0.1, pose=(0.3, 0.0, 0.0))
    load = builder.add_rigid(sw.Box((0.02, 0.03, 0.01)), mass=0.03, pose=(0.33, 0.01, 0.02), damping=0.5)
    builder.attach(load, to=hung)
    cart = builder.add_rigid(LOPSIDED, mass=0.2, pose=(0.5, 0.0, 0.0), free_axes=("x", "ry"))
    builder.add_cable([load, cart], [(0.33, 0.02, 0.01), (0.51, 0.01, 0.01)], control="force")
    builder.add_marker(load, (0.32, 0.03, 0.01))


def _arm(builder: sw.ModelBuilder) -> None:
    beam = builder.add_tets(
        meshing.box((0.1, 0.04, 0.04), (2, 1, 1)), material=sw.Corotational(1e5, 0.4), density=1e3, rayleigh=(0.5, 0.01)
    )
    builder.fix(beam, box=((-1, -1, -1), (1e-6, 1, 1)))
    end = builder.add_rigid(LOPSIDED, mass=0.03, pose=(0.11, 0.02, 0.02), damping=0.4)
    builder.attach(beam, box=((0.0999, -1, -1), (1, 1, 1)), to=end)
    tool = builder.add_rigid(LOPSIDED, mass=0.02, pose=(0.15, 0.02, 0.03, 0.0, 0.6, 0.0, 0.8), damping=0.2)
    builder.attach(tool, to=end)
    builder.add_cable(
        [beam, tool], [(0.03, 0.03, 0.035), (0.15, 0.03, 0.04)], pull_point=(-0.1, 0.0, 0.1), control="force"
    )
    builder.add_marker(tool, (0.17, 0.02, 0.02))


def _rod(builder: sw.ModelBuilder) -> None:
    base = builder.add_rigid(sw.Box((0.02, 0.04, 0.04)), pose=(-0.01, 0.0, 0.01), kinematic=True)
    line = np.linspace((0.0, 0.0, 0.0), (0.12, 0.0, 0.0), 4)
    arm = builder.add_rod(line, radius=0.006, youngs=1e6, density=1100.0, rayleigh=(0.3, 0.01))
    builder.attach(arm, nodes=[0], to=base)
    end = builder.add_rigid(LOPSIDED, mass=0.03, pose=(0.13, 0.01, 0.0), damping=0.4)
    builder.attach(arm, nodes=[3], to=end)
    line = np.linspace((0.15, 0.02, 0.0), (0.2, 0.03, 0.0), 3)
    tail = builder.add_rod(line, radius=0.005, youngs=1e6, density=1100.0, rayleigh=(0.3, 0.01))
    builder.attach(tail, nodes=[0], to=end)
    builder.add_cable(tail, [(0.17, 0.025, 0.004), (0.2, 0.03, 0.004)], pull_point=(0.1, 0.0, 0.1), control="force")
    builder.add_marker(end, (0.14, 0.02, 0.0))


def _hinge(builder: sw.ModelBuilder) -> None:
    upper = builder.add_rigid(LOPSIDED, mass=0.08, pose=(0.05, 0.0, 0.0), damping=0.2)
    knee = builder.add_rigid(sw.Box((0.02, 0.03, 0.02)), mass=0.01, pose=(0.1, 0.005, 0.0, 0.0, 0.0, 0.6, 0.8))
    builder.attach(knee, to=upper)
    lower = builder.add_rigid(LOPSIDED, mass=0.06, pose=(0.15, 0.0, 0.0))
    builder.add_joint(None, upper, "hinge", anchor=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.2))
    servo: dict[str, Any] = test_joints.MOTORS["servo"]
    builder.add_joint(knee, lower, "hinge", anchor=(0.1, 0.0, 0.0), axis=(0.1, 1.0, 0.0), **servo)
    builder.add_marker(lower, (0.2, 0.0, 0.01))
    builder.add_cable([upper, lower], [(0.03, 0.01, 0.01), (0.17, 0.01, 0.01)], control="force")


def _bed(builder: sw.ModelBuilder) -> None:
    mesh = meshing.box((0.2, 0.2, 0.1), (2, 2, 1))
    soft = builder.add_tets(
        mesh.nodes - (0.1, 0.1, 0.1), mesh.tets, material=sw.Corotational(1e5, 0.4), density=1e3, rayleigh=(0.5, 0.01)
    )
    builder.fix(soft, box=((-1, -1, -1), (1, 1, 1e-6 - 0.1)))
    held = builder.add_rigid(LOPSIDED, mass=0.1, pose=(0.013, 0.007, 0.06))
    foot = builder.add_rigid(sw.Sphere(0.02), mass=0.2, pose=(0.01, 0.013, 0.018))
    builder.attach(foot, to=held)
    builder.add_contact(soft, foot, mu=0.4)
    builder.add_marker(foot, (0.01, 0.02, 0.01))


BUILD = {"tops": _tops, "arm": _arm, "rod": _rod, "hinge": _hinge, "bed": _bed}


def thrown(sim: sw.Simulation, seeds: list[int]) -> Inputs:
    """All that moves, displaced, turned and spinning; world i has that of individual ``seeds[i]``."""
    kept: dict[str, dict[str, list[torch.Tensor]]] = {"state": {}, "controls": {}}
    for seed in seeds:
        rng = np.random.default_rng(seed)

        def near(value: torch.Tensor, size: float, rng: np.random.Generator = rng) -> torch.Tensor:
            return value[0] + torch.tensor(size * rng.standard_normal(value[0].shape)).to(value)

        wrench = torch.tensor([0.1] * 3 + [0.002] * 3).to(sim.body_pose)
        values = {
            "state": {
                "node_x": near(sim.node_x, 5e-4),
                "node_v": near(sim.node_v, 0.05),
                "rod_x": near(sim.rod_x, 1e-4),
                "rod_q": turned(sim.rod_q[0], near(0.0 * sim.rod_w, 0.02)),
                "rod_v": near(sim.rod_v, 0.05),
                "rod_w": near(sim.rod_w, 1.0),
                **({} if sim.model.has_kinematic else bodies(sim, near)),
            },
            "controls": {
                "body_force": near(sim.control.body_force, 1.0) * wrench,
                "rod_force": near(sim.control.rod_force, 1.0) * wrench,
                "cable_tension": near(sim.control.cable_tension, 0.0) + 0.5,
                "joint_target": near(sim.control.joint_target, 0.05),
                **({"body_velocity": near(sim.control.body_velocity, 0.2)} if sim.model.has_kinematic else {}),
            },
        }
        for group, held in values.items():
            for name, value in held.items():
                kept[group].setdefault(name, []).append(value)
    stacked = {g: {n: torch.stack(v) for n, v in held.items() if v[0].numel()} for g, held in kept.items()}
    stacked["controls"]["body_force"] = stacked["controls"]["body_force"].expand(STEPS, -1, -1, -1)
    parameters = {name: getattr(sim.params, name).clone() for name in SIZES["parameters"]}
    return {**stacked, "parameters": {name: value for name, value in parameters.items() if value.numel()}}


def loss(states: Any) -> torch.Tensor:
    """A weight for every result; (world,)."""
    return test_rigid.loss(states) + 0.1 * states.cable_tension.sum(dim=(0, 2)) + 0.01 * states.rod_q.sum(dim=(0, 2, 3))


@pytest.mark.parametrize("kind", ["tops", "rod", *(pytest.param(kind, marks=SLOW) for kind in ("arm", "hinge", "bed"))])
def test_gradients_are_those_of_differences(kind: str) -> None:
    """By all that a step starts from and by all parameters, of parts that are carried and of those that carry."""
    sim = scene(kind)
    check(Rollout(sim), thrown(sim, [1]), loss, SIZES)


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=SLOW) for kind in BUILD])
def test_forward_mode_is_the_transpose(kind: str) -> None:
    """Along all inputs at once, and along each alone."""
    sim = scene(kind)
    compare(Rollout(sim), thrown(sim, [1]), loss)


@pytest.mark.parametrize("kind", ["rod", *(pytest.param(kind, marks=SLOW) for kind in ("tops", "hinge", "bed"))])
def test_worlds_and_kept_factors_change_no_bit(kind: str) -> None:
    """A batch has the gradients of each world alone, whether factors are kept or not."""
    seeds = [1, 2]
    batch, single = scene(kind, num_worlds=2), scene(kind)
    rollout, given = Rollout(batch), thrown(batch, seeds)
    plain = gradients(rollout, given, loss, steps=STEPS)
    kept = gradients(rollout, given, loss, steps=STEPS, factors=True)
    assert all(torch.equal(kept[g][n], plain[g][n]) for g, held in plain.items() for n in held)
    for world, seed in enumerate(seeds):
        for group, held in gradients(Rollout(single), thrown(single, [seed]), loss, steps=STEPS).items():
            for name, value in held.items():
                axis = 1 if name == "body_force" else 0
                assert torch.equal(plain[group][name].select(axis, world), value.select(axis, 0)), (group, name)


def test_attached_bodies_start_where_their_carrier_is() -> None:
    """What is given for a part that moves with another has gradient 0, and changes nothing."""
    sim = scene("tops")
    given = thrown(sim, [1])
    pose = given["state"]["body_pose"].clone().requires_grad_()
    moved = pose + torch.tensor([0.0, 0.0, 0.02, 0.0])[:, None].to(pose)  # the third body is attached
    rollout = Rollout(sim)
    ends = [rollout({"body_pose": value}, steps=2).body_pose[-1] for value in (pose, moved)]
    assert torch.equal(*ends)
    ends[0].sum().backward()
    assert pose.grad is not None
    assert pose.grad[0, 2].abs().max() == 0.0 < pose.grad[0, 1].abs().max()
