"""Gradients of jointed bodies that touch something, against central differences in float64 and forward mode."""

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp.gradients import Rollout
from tests.gradient_cases import STEPS, Inputs, gradients
from tests.unit.gradients import test_touches as touches
from tests.unit.gradients.test_bodies import loss
from tests.unit.gradients.test_contact import EXACT, SLIPPING, STUCK
from tests.unit.gradients.test_forward_frames import compare
from tests.unit.gradients.test_joints import MOTORS
from tests.unit.gradients.test_joints import SIZES as OF_JOINTS
from tests.unit.gradients.test_rods import check

SLOW = pytest.mark.slow
SIZES = {
    "state": {"node_x": 1e-8, "node_v": 1e-6},
    "controls": OF_JOINTS["controls"] | {"node_force": 1e-5},
    "parameters": OF_JOINTS["parameters"] | {"pair_mu": 1e-4},
}


def leg(motor: str, kind: str = "hinge", mu: float = 0.4, num_worlds: int = 1) -> sw.Simulation:
    """A thigh on a ball joint and a round foot on the floor, with a motor between them."""
    builder = sw.ModelBuilder(gravity=(0.5, 0.3, -9.81))
    thigh = builder.add_rigid(sw.Box((0.1, 0.03, 0.02)), mass=0.08, pose=(0.05, 0.0, 0.06), damping=0.2)
    foot = builder.add_rigid(sw.Sphere(0.03), mass=0.06, pose=(0.13, 0.0, 0.0299))
    builder.add_joint(None, thigh, "ball", anchor=(0.0, 0.0, 0.06))
    driven = MOTORS[motor] if kind == "hinge" else {}
    builder.add_joint(thigh, foot, kind, anchor=(0.1, 0.0, 0.05), axis=(0.1, 1.0, 0.0), **driven)  # type: ignore[arg-type]
    floor = builder.add_rigid(sw.Plane(), kinematic=True)
    builder.add_contact(floor, foot, mu=mu)
    builder.add_marker(foot, (0.14, 0.0, 0.0))
    return exact(builder, num_worlds)


def flap(num_worlds: int = 1) -> sw.Simulation:
    """A soft cube that is thrown on a plate on a hinge with a spring."""
    builder = sw.ModelBuilder(gravity=(0.3, 0.2, -9.81))
    body = touches.cube(builder)
    pose = (0.047, 0.053, -0.0235, *touches.unit(touches.FLAT))
    plate = builder.add_rigid(sw.Box((0.3, 0.3, 0.05)), mass=0.5, inertia=(1e-3, 2e-3, 1.5e-3), pose=pose)
    builder.add_joint(
        None, plate, "hinge", anchor=(-0.1, 0.05, -0.0235), axis=(0.1, 1.0, 0.0), control="position", stiffness=5.0
    )
    builder.add_contact(body, plate, mu=0.5)
    builder.add_marker(plate, (0.01, 0.0, 0.0))
    return exact(builder, num_worlds)


def exact(builder: sw.ModelBuilder, num_worlds: int) -> sw.Simulation:
    """Its simulation."""
    model = builder.finalize(num_worlds=num_worlds, precision="float64")
    return sw.Simulation(model, dt=0.01, contact_passes=0, **EXACT)


def swung(sim: sw.Simulation, seeds: tuple[int, ...] = (1,)) -> Inputs:
    """Commands and forces of a leg that swings; world i has those of ``seeds[i]``."""
    forces, targets = [], []
    for world, seed in enumerate(seeds):
        rng = np.random.default_rng(seed)
        moves = torch.tensor([[1.0], [1.0], [0.0]])  # but the floor
        sim.body_twist[world] = torch.tensor(0.5 * rng.standard_normal((3, 6))) * moves
        force = torch.tensor(0.1 * rng.standard_normal((STEPS, 3, 6))) * torch.tensor([1.0] * 3 + [0.02] * 3)
        forces.append(force * moves)
        targets.append(torch.tensor(rng.uniform(0.03, 0.06, (STEPS, 2))))
    target = torch.stack(targets, dim=1)
    names = ("gravity", "pair_mu", "body_mass", "joint_stiffness", "joint_damping")
    parameters = {name: getattr(sim.params, name).clone() for name in names}
    commands = {"body_force": torch.stack(forces, dim=1), "joint_target": target, "joint_force": 0.2 * target}
    return {"state": {}, "controls": commands, "parameters": parameters}


@pytest.mark.parametrize("motor", ["weak", *(pytest.param(m, marks=SLOW) for m in MOTORS if m != "weak")])
def test_a_leg_that_slips(motor: str) -> None:
    """With every motor, also one at its largest force and joints at limits."""
    sim = leg(motor)
    given = swung(sim)
    check(Rollout(sim), given, loss, SIZES)
    assert SLIPPING in touches.modes(sim, given)


def test_a_leg_that_sticks() -> None:
    """A foot on a ball joint, as one on hinges alone would be held by too many rows."""
    sim = leg("none", "ball", mu=3.0)
    given = swung(sim)
    check(Rollout(sim), given, loss, SIZES)
    assert STUCK in touches.modes(sim, given)


@SLOW
def test_a_soft_body_on_a_jointed_plate() -> None:
    """Nodes and edges of a soft body, and moduli, beside a joint."""
    sim = flap()
    given = touches.thrown(sim, 0.2, 0.3)
    given["state"] = {name: value for name, value in given["state"].items() if name.startswith("node")}
    sizes = touches.SIZES | {"parameters": touches.SIZES["parameters"] | {"density": 0.1}}
    check(Rollout(sim), given, touches.loss, sizes)
    assert touches.modes(sim, given) & {STUCK, SLIPPING}


@pytest.mark.parametrize("motor", ["servo", pytest.param("stopped", marks=SLOW)])
def test_both_modes_agree(motor: str) -> None:
    """y . J d = d . J' y."""
    sim = leg(motor)
    compare(Rollout(sim), swung(sim), loss)


@SLOW
def test_worlds_beside_and_kept_factors_change_no_bit() -> None:
    """A world of a batch has the gradient of that world alone, and kept factors lead to the same."""
    seeds = (1, 2, 3)
    batch = leg("weak", num_worlds=len(seeds))
    given, rollout = swung(batch, seeds), Rollout(batch)
    plain, kept = (gradients(rollout, given, loss, factors=factors) for factors in (False, True))
    for world, seed in enumerate(seeds):
        single = leg("weak")
        for group, held in gradients(Rollout(single), swung(single, (seed,)), loss).items():
            for name, value in held.items():
                axis = 1 if group == "controls" else 0
                assert torch.equal(plain[group][name].select(axis, world), value.select(axis, 0)), (group, name)
                assert torch.equal(plain[group][name], kept[group][name]), (group, name)


def test_looks_are_refused() -> None:
    """Contacts that are measured anew beside joints are told, with the way out."""
    with pytest.raises(ValueError, match="measured anew beside joints has no gradient yet; take contact_passes=0"):
        Rollout(sw.Simulation(leg("servo").model, dt=0.01))
