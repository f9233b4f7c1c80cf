"""Gradients through frictional contact against central differences in float64: stick, slip, open, soft, bouncing."""

from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Equilibrium, Rollout, States
from tests.gradient_cases import SIDE, STEPS, Inputs, gradients
from tests.unit.gradients.test_adjoint import check

EXACT = {"gauss_seidel_tolerance": 1e-15, "gauss_seidel_iterations": 30000}
OPEN, STUCK, SLIPPING = range(3)


def block(
    mu: float,
    num_worlds: int = 1,
    precision: str = "float64",
    device: str = "cpu",
    *,
    memory: tuple[float, float] = (0.0, 0.0),
    skin: Any = None,
    **laws: float,
) -> sw.Simulation:
    """A cube with a cable, and perhaps a Maxwell branch or a skin of its own, on a floor that a kinematic body is."""
    builder = sw.ModelBuilder(gravity=(0.3, 0.2, -9.81))
    body = builder.add_tets(
        meshing.box((SIDE, SIDE, SIDE), (2, 2, 2)),
        material=sw.Corotational(1e5, 0.4),
        density=1e3,
        rayleigh=(0.5, 0.01),
        relaxation=memory,
        contact_surface=skin,
    )
    builder.add_cable(body, [(0.02, 0.05, 0.03), (0.05, 0.04, 0.05), (0.08, 0.05, 0.07)], control="force")
    floor = builder.add_rigid(sw.Plane(), kinematic=True, name="floor")
    builder.add_contact(body, floor, mu=mu, **laws)
    model = builder.finalize(num_worlds=num_worlds, precision=precision, device=device)
    return sw.Simulation(model, dt=0.01, **(EXACT if precision == "float64" else {}))


def thrown(sim: sw.Simulation, speed: float, seeds: tuple[int, ...] = (1,)) -> Inputs:
    """Start on the floor, some nodes a little in it or above it, with a velocity along it; world i has ``seeds[i]``."""
    worlds: dict[str, list[torch.Tensor]] = {"node_x": [], "node_v": [], "node_force": []}
    for seed in seeds:
        rng = np.random.default_rng(seed)
        x = sim.node_x[0].cpu().numpy() + 1e-3 * rng.standard_normal(sim.node_x[0].shape)
        low = x[:, 2] < 0.01
        x[low, 2] = rng.uniform(-2e-4, 1e-3, low.sum())
        v = 0.05 * rng.standard_normal(x.shape) + (speed, 0.0, -0.3)
        for name, value in (("node_x", x), ("node_v", v), ("node_force", 0.01 * rng.standard_normal(x.shape))):
            worlds[name].append(torch.tensor(value).to(sim.node_x))
    stacked = {name: torch.stack(values) for name, values in worlds.items()}
    force = stacked.pop("node_force").expand(STEPS, *stacked["node_x"].shape)
    controls = {"node_force": force, "cable_tension": torch.full((len(seeds), 1), 2.0).to(sim.node_x)}
    names = ("youngs", "nu", "density", "rayleigh_mass", "rayleigh_stiffness", "gravity", "pair_mu")
    return {"state": stacked, "controls": controls, "parameters": {n: getattr(sim.params, n).clone() for n in names}}


def loss(states: States) -> torch.Tensor:
    """A random weight for every result; (world,)."""
    x = states.node_x
    rng = np.random.default_rng(7)
    drawn = [torch.tensor(rng.standard_normal((STEPS, 1, *x.shape[2:]))).to(x)[-len(x) :] for _ in range(2)]
    total = (x * drawn[0] / SIDE + states.node_v * drawn[1]).sum(dim=(0, 2, 3))
    return total + 0.1 * states.cable_tension.sum(dim=(0, 2))


def modes(sim: sw.Simulation, given: Inputs) -> set[int]:
    """States of all contacts in the steps that a rollout takes."""
    for group, target in (("state", sim), ("controls", sim.control), ("parameters", sim.params)):
        for name, value in given[group].items():
            getattr(target, name)[...] = value[0] if name == "node_force" else value
    found: set[int] = set()
    for _ in range(STEPS):
        sim.step()
        pressure = (sim.contact_load * sim.contact_normal).sum(dim=-1)
        friction = (sim.contact_load - pressure[..., None] * sim.contact_normal).norm(dim=-1)
        is_used, slips = sim.contact_pair >= 0, friction >= (1.0 - 1e-8) * sim.params.pair_mu * pressure
        mode = torch.where(pressure == 0.0, OPEN, torch.where(slips, SLIPPING, STUCK))
        found |= set(mode[is_used].tolist())
    return found


@pytest.mark.parametrize(
    ("mu", "speed", "laws", "expected"),
    [
        pytest.param(2.0, 0.0, {}, {STUCK, SLIPPING}, id="stick"),
        pytest.param(0.3, 0.3, {"compliance": 1e-4}, {OPEN, SLIPPING}, id="slip, soft"),
        pytest.param(0.3, 0.3, {"restitution": 0.5}, {OPEN, SLIPPING}, id="bounce"),
    ],
)
def test_gradients_are_those_of_differences(
    mu: float, speed: float, laws: dict[str, float], expected: set[int]
) -> None:
    """By state, commands, moduli and friction; the steps have contacts in the states that they are to prove."""
    sim = block(mu, **laws)
    given = thrown(sim, speed)
    check(Rollout(sim), given, loss, own=1e-5)
    assert modes(sim, given) >= expected


def test_moving_floor() -> None:
    """A floor that moves and turns gives contacts velocities that depend on the place."""
    sim = block(0.8)
    sim.control.body_velocity[...] = torch.tensor([0.1, 0.0, 0.05, 0.3, -0.2, 0.5])
    given = thrown(sim, 0.1)
    check(Rollout(sim), given, loss, own=1e-5)
    once = sw.Simulation(sim.model, dt=0.01, contact_passes=0, **EXACT)
    once.control.body_velocity[...] = sim.control.body_velocity
    check(Rollout(once), given, loss, own=1e-5)


def carried(base: str, **options: Any) -> sw.Simulation:
    """A cube on a floor, with an edge on a moving base, or with a corner on a rigid body that moves freely."""
    builder = sw.ModelBuilder(gravity=(0.3, 0.2, -9.81))
    body = builder.add_tets(
        meshing.box((SIDE, SIDE, SIDE), (2, 2, 2)),
        material=sw.Corotational(1e5, 0.4),
        density=1e3,
        rayleigh=(0.5, 0.01),
    )
    floor = builder.add_rigid(sw.Plane(), kinematic=True, name="floor")
    how: dict[str, Any] = {"kinematic": True} if base == "kinematic" else {"mass": 0.2, "inertia": (2e-4, 3e-4, 4e-4)}
    held = builder.add_rigid(pose=(-0.02, 0.05, 0.05), name="base", **how)
    high = SIDE if base == "kinematic" else 1e-6
    builder.attach(body, box=((-1.0, -1.0, -1.0), (1e-6, 1e-6, high)), to=held)
    builder.add_contact(body, floor, mu=0.4)
    builder.add_marker(held, (-0.02, 0.0, 0.0))
    model = builder.finalize(num_worlds=1, precision="float64")
    return sw.Simulation(model, dt=0.01, **EXACT, **options)


@pytest.mark.parametrize(("base", "passes"), [("kinematic", 0), ("free", 0), ("kinematic", 1), ("free", 1)])
def test_bodies_that_carry_what_touches(base: str, passes: int) -> None:
    """By how a base and the floor move and turn, and through nodes on the floor that a body carries.

    The floor turns, as on one at rest what slips is at a switch: nodes end a step on it to rounding.
    """
    sim = carried(base, contact_passes=passes)
    given = thrown(sim, 0.1)
    del given["controls"]["cable_tension"]
    velocity = torch.tensor([[0.1, 0.0, 0.02, 0.3, -0.2, 0.5], [0.1, 0.05, -0.2, 0.2, 0.1, 0.3]]).to(sim.node_x)
    if base == "free":
        sim.body_twist[:, 1] = velocity[1]
    given["controls"]["body_velocity"] = velocity.expand(STEPS, 1, 2, 6).contiguous()
    weight = torch.tensor([10.0, -20.0, 15.0]).to(sim.node_x)
    check(Rollout(sim), given, lambda states: loss(states) + (states.marker_x * weight).sum(dim=(0, 2, 3)), own=1e-6)


@pytest.mark.parametrize("precision", [pytest.param("float32", marks=pytest.mark.slow), "float64"])
def test_kept_states_factors_and_worlds_beside_change_no_bit(precision: str) -> None:
    """Steps taken again, factors kept, and a world alone have the bits of a batch that keeps every state."""
    seeds = (1, 2, 3)
    batch, single = block(0.5, len(seeds), precision), block(0.5, 1, precision)
    options: Any
    rollout, alone, given = Rollout(batch), Rollout(single), thrown(batch, 0.2, seeds)
    plain = gradients(rollout, given, loss)
    for options in ({"factors": True}, {"every": STEPS}, {"every": STEPS, "factors": True}):
        last = gradients(rollout, given, loss, **{**options, "factors": False})
        found = gradients(rollout, given, loss, **options)
        for group, held in found.items():
            for name, value in held.items():
                wanted = last if "every" in options else plain
                assert torch.equal(value, wanted[group][name]), (options, group, name)
    if precision == "float64":  # float32 has other paths for one world and for many
        for world, seed in enumerate(seeds):
            for group, held in gradients(alone, thrown(single, 0.2, (seed,)), loss).items():
                for name, value in held.items():
                    axis = 1 if name == "node_force" else 0
                    assert torch.equal(plain[group][name].select(axis, world), value.select(axis, 0)), (group, name)


@pytest.mark.cuda
def test_a_gpu_finds_the_same() -> None:
    """Gradients of several worlds on a GPU are those on a CPU but for rounding."""
    found = []
    for device in ("cpu", "cuda:0"):
        sim = block(0.5, 3, device=device)
        found.append(gradients(Rollout(sim), thrown(sim, 0.2, (1, 2, 3)), loss))
    for group, held in found[0].items():
        for name, value in held.items():
            torch.testing.assert_close(
                found[1][group][name].cpu(), value, rtol=1e-6, atol=1e-7 * float(value.abs().max())
            )


def test_refusals() -> None:
    """What of contact has no gradient is told by name."""
    with pytest.raises(ValueError, match=r"more than once a step \(contact_passes=1, refinement=2\).*refinement=1"):
        Rollout(sw.Simulation(block(0.5).model, refinement=2))
    builder = sw.ModelBuilder()
    body = builder.add_tets(meshing.box((SIDE,) * 3, (1, 1, 1)), material=sw.Corotational(1e5, 0.4), density=1e3)
    free = builder.add_rigid(mass=0.1, inertia=(1e-4,) * 3, name="palm")
    builder.attach(body, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)), to=free)
    builder.add_contact(body, builder.add_rigid(sw.Plane(), kinematic=True))
    with pytest.raises(ValueError, match="rigid body 'palm', which moves freely and carries several nodes"):
        Rollout(sw.Simulation(builder.finalize(num_worlds=1)))
    with pytest.raises(ValueError, match="equilibria with contact"):
        Equilibrium(block(0.5))
