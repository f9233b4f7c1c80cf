"""Gradients of steps of reduced bodies, by amplitudes, commands and parameters, against differences in float64."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Diverged, Equilibrium, Rollout, States
from tests.cases import FITTED
from tests.gradient_cases import STEPS, Inputs, gradients
from tests.reduction_cases import AIR, SLAB, quadratic_modes, reduced_by, scene, smooth_modes
from tests.unit.gradients.test_contact import EXACT, SLIPPING, STUCK
from tests.unit.gradients.test_forward_frames import compare
from tests.unit.gradients.test_rods import check
from tests.unit.gradients.test_touches import modes as found_modes

SIZES = {
    "state": {"mode_q": 1e-8, "mode_v": 1e-6, "node_x": 1e-8, "node_v": 1e-5, "cavity_pressure": 1.0},
    "controls": {
        "node_force": 1e-6,
        "cable_displacement": 1e-8,
        "cable_tension": 1e-4,
        "cavity_volume": 1e-11,
        "cavity_pressure": 0.1,
        "cavity_gas": 1e-11,
    },
    "parameters": {
        "youngs": 100.0,
        "nu": 1e-5,
        "density": 1e-2,
        "rayleigh_mass": 1e-3,
        "rayleigh_stiffness": 1e-6,
        "gravity": 1e-3,
        "law_parameter": 1.0,
        "membrane_youngs": 10.0,
        "membrane_nu": 1e-4,
        "pair_mu": 1e-5,
    },
}
RESULTS = {  # weights in the loss
    "node_x": 10.0,
    "node_v": 1.0,
    "mode_q": 10.0,
    "mode_v": 1.0,
    "marker_x": 10.0,
    "cable_tension": 0.1,
    "cavity_pressure": 1e-3,
}
TILT = 0.3  # rad, of a floor, on which a slab lies with one edge
SOFTNESS = 1e-4  # m/N, with which contacts that modes do not tell apart share a load


def support(builder: sw.ModelBuilder, on: str) -> Any:
    """What the slab touches: a "ball", a "floor" that is tilted, or a soft "bed"."""
    if on == "ball":
        return builder.add_rigid(sw.Sphere(0.02), kinematic=True, pose=(0.031, 0.0152, -0.0203))
    if on == "floor":
        half = -0.5 * TILT
        pose = (0.06, 0.0, -0.0003, 0.0, float(np.sin(half)), 0.0, float(np.cos(half)))
        return builder.add_rigid(sw.Plane(), kinematic=True, pose=pose)
    mesh = meshing.box((0.03, 0.02, 0.01), (2, 2, 1))
    at = (0.017, 0.006, -0.0103)
    bed = builder.add_tets(mesh.nodes + at, mesh.tets, material=sw.Corotational(5e4, 0.3), density=900.0)
    builder.fix(bed, box=((-1.0, -1.0, -1.0), (1.0, 1.0, -0.0102)))
    return bed


def slab(
    num_worlds: int = 1,
    precision: str = "float64",
    device: str = "cpu",
    *,
    on: str = "",
    law: Any = None,
    mu: float = 0.7,
    softness: float = 0.0,
    beside: bool = False,
    skin: bool = False,
    whole: bool = False,
    air: str = "volume",
    **options: Any,
) -> sw.Simulation:
    """The slab of ``reduction_cases`` with two thirds of its elements, held or on something.

    Args:
        num_worlds: Of the model.
        precision: Likewise.
        device: Likewise.
        on: What it touches: a "ball", a "floor" that is tilted, a soft "bed"; nothing, and it is held, for "".
        law: Material.
        mu: Friction of the contact.
        softness: Its compliance [m/N].
        air: Control of the chamber; but for "volume" the cable's is its tension, and pressures have a rate.
        skin: Whether a coarse surface of its own touches for it.
        whole: Whether it is not reduced.
        beside: Whether a soft body that is not reduced hangs on the same scene.
        **options: Of the simulation.
    """
    surface = meshing.box((0.06, 0.03, 0.012), (4, 2, 2)) if skin else None
    shown = None if surface is None else (surface.nodes, surface.surface())
    builder = scene(held=not on, contact=False, law=law, lone=air != "volume", skin=shown)
    if air != "volume":
        shell = meshing.compact(AIR.nodes + (0.01, 0.005, 0.003), AIR.surface())
        limits = {"max_pressure_rate": 2e4} if air == "pressure" else {}
        builder.add_cavity(0, *shell, control=air, **limits)  # type: ignore[arg-type]
        builder.add_cable(0, [(x, 0.015, 0.009) for x in (0.06, 0.03, 0.0)], control="force")
    weights = np.random.default_rng(0).uniform(0.5, 1.5, len(SLAB.tets))
    weights[::3] = 0.0
    if not whole:
        builder.reduce(0, reduced_by(smooth_modes(held=not on), tet_weight=weights))
    other = support(builder, "bed" if beside else on) if on or beside else None
    if on:
        builder.add_contact(0, other, mu=mu, compliance=softness, alarm_distance=0.003, contact_distance=0.0005)
    model = builder.finalize(
        num_worlds=num_worlds, precision=precision, device=device, contact_capacity=200 if on else None
    )
    return sw.Simulation(model, dt=0.01, **({**EXACT, **options} if on else options))


def given_of(sim: sw.Simulation, seeds: list[int], *, nodes: bool = False) -> Inputs:
    """Inputs of ``STEPS`` steps; world i has those of individual ``seeds[i]``."""
    kept: dict[str, dict[str, list[Any]]] = {"state": {}, "controls": {}, "parameters": {}}
    rest, size = float(sim.model.cavities.rest_volume[0]), sim.model.mode_count
    for seed in seeds:
        rng = np.random.default_rng(seed)
        ramp = np.arange(1.0, STEPS + 1.0)[:, None] * rng.uniform(0.8, 1.2)
        values: dict[str, dict[str, Any]] = {
            "state": {},
            "controls": {
                "node_force": 0.02 * rng.standard_normal((sim.model.node_count, 3)),
            },
            "parameters": {},
        }
        values["controls"] |= {"cable_displacement": 1e-3 * ramp, "cable_tension": 0.5 * ramp}
        values["controls"] |= {"cavity_volume": rest * (1.0 + 0.01 * ramp), "cavity_gas": rest * (1.0 + 0.01 * ramp)}
        values["controls"]["cavity_pressure"] = np.array([[300.0], [310.0], [320.0]]) * rng.uniform(0.9, 1.1)
        if sim.params.cavity_max_pressure_rate[0, 0] < 1e6:  # else it is a first guess only
            values["state"]["cavity_pressure"] = rng.uniform(40.0, 60.0, 1)
        if size:
            values["state"] = {"mode_q": 1e-4 * rng.standard_normal(size), "mode_v": 0.03 * rng.standard_normal(size)}
        if nodes:
            values["state"]["node_x"] = sim.node_x[0].cpu().numpy() + 1e-4 * rng.standard_normal(sim.node_x[0].shape)
            values["state"]["node_v"] = 0.03 * rng.standard_normal(sim.node_x[0].shape)
        for name in SIZES["parameters"]:
            value = getattr(sim.params, name)[0].cpu().numpy()
            if value.size and (name != "law_parameter" or np.any(value)):
                values["parameters"][name] = value * rng.uniform(0.95, 1.05)
        for group, found in values.items():
            for name, value in found.items():
                kept[group].setdefault(name, []).append(torch.tensor(value).to(sim.node_x))
    return {
        group: {name: torch.stack(value, dim=axis_of(group, name)) for name, value in found.items()}
        for group, found in kept.items()
    }


def axis_of(group: str, name: str) -> int:
    """That of worlds, behind that of steps in commands with one."""
    return int(group == "controls" and name != "node_force")


def loss(states: States) -> torch.Tensor:
    """A number for every world, of all results with random weights, the same for every world."""
    rng, total = np.random.default_rng(7), torch.zeros(())
    for name, size in RESULTS.items():
        value = getattr(states, name)
        weight = size * torch.tensor(rng.standard_normal((len(value), 1, *value.shape[2:]))).to(value)
        total = total + (value * weight).flatten(2).sum(dim=(0, 2))
    return total


TOUCHING = {
    "on a ball": partial(slab, on="ball"),
    "slipping on an edge": partial(slab, on="floor", softness=SOFTNESS),
    "on a soft bed": partial(slab, on="bed", softness=SOFTNESS),
    "of a skin that slips": partial(slab, on="floor", softness=SOFTNESS, skin=True),
    "of a skin on a ball": partial(slab, on="ball", softness=SOFTNESS, skin=True),
    "not reduced, of a skin that slips": partial(slab, on="floor", skin=True, whole=True),
    "not reduced, of a skin on a ball": partial(slab, on="ball", skin=True, whole=True),
}
SCENES = {
    "held": slab,
    "of a law of own parameters": partial(slab, law=FITTED["yeoh"](1e5, 0.3)),
    "beside a soft body": partial(slab, beside=True),
    "under pressure": partial(slab, air="pressure"),
    "with gas": partial(slab, air="gas"),
    **TOUCHING,
}


@pytest.mark.parametrize("name", SCENES)
def test_gradients_are_those_of_differences(name: str) -> None:
    """Held by its chamber and cable, and touching something, with contacts looked at where steps lead to."""
    sim = SCENES[name]()
    given = given_of(sim, [2 if name == "on a soft bed" else 1], nodes=sim.model.own_node_count > 0)
    check(Rollout(sim), given, loss, SIZES)
    if name in TOUCHING:
        assert found_modes(sim, given) & {STUCK, SLIPPING}


@pytest.mark.parametrize("name", ["held", pytest.param("slipping on an edge", marks=pytest.mark.slow)])
def test_forward_mode_agrees(name: str) -> None:
    """By rows of modes, y . J d = d . J' y in every input."""
    sim = SCENES[name]()
    compare(Rollout(sim), given_of(sim, [1]), loss)


PATHS = [
    pytest.param({"solver_path": "scalar"}, "float64", "cpu", id="scalar"),
    pytest.param({"solver_path": "lanes"}, "float32", "cpu", id="lanes"),
    pytest.param({"solver_path": "panels"}, "float32", "cuda:0", id="panels", marks=pytest.mark.cuda),
    pytest.param({"solver_path": "levels"}, "float64", "cuda:0", id="levels", marks=pytest.mark.cuda),
]


def equal_alone(
    batch: sw.Simulation,
    single: sw.Simulation,
    given_of: Callable[[sw.Simulation, list[int]], Inputs],
    loss: Callable[[States], torch.Tensor],
) -> None:
    """Gradients of three worlds are to the bit those of each alone, with and without kept factors."""
    seeds = [1, 2, 3]
    together, rollout = gradients(Rollout(batch), given_of(batch, seeds), loss), Rollout(single)
    for world, seed in enumerate(seeds):
        alone = gradients(rollout, given_of(single, [seed]), loss)
        kept = gradients(rollout, given_of(single, [seed]), loss, factors=True)
        for group, held in alone.items():
            for name, value in held.items():
                axis = axis_of(group, name)
                assert torch.equal(together[group][name].select(axis, world), value.select(axis, 0)), (group, name)
                assert torch.equal(kept[group][name], value), (group, name)


@pytest.mark.parametrize(("options", "precision", "device"), PATHS)
@pytest.mark.parametrize("on", ["", "ball"])
def test_world_of_a_batch_has_the_gradient_of_that_world_alone(
    on: str, options: dict[str, Any], precision: str, device: str
) -> None:
    """Three worlds that differ in all inputs, then each alone, with and without kept factors and states."""
    batch, single = (slab(count, precision, device, on=on, **options) for count in (3, 1))
    equal_alone(batch, single, given_of, loss)


def test_steps_are_those_of_the_simulation() -> None:
    """To the bit, from amplitudes that were given, nodes and markers included."""
    sim = slab(on="ball")
    given = given_of(sim, [1])
    states = Rollout(sim)(given["state"], given["controls"], given["parameters"])
    for name, value in given["state"].items():
        getattr(sim, name)[...] = value
    for name, value in given["parameters"].items():
        getattr(sim.params, name)[...] = value
    for step in range(STEPS):
        for name, value in given["controls"].items():
            getattr(sim.control, name)[...] = value if name == "node_force" else value[step]
        sim.step()
        for name in ("node_x", "node_v", "mode_q", "mode_v", "cable_tension", "cavity_pressure"):
            assert torch.equal(getattr(sim, name), getattr(states, name)[step]), name
        assert torch.allclose(sim.marker_x, states.marker_x[step], rtol=1e-14, atol=0.0)


def test_what_has_no_gradient_is_told() -> None:
    """By name and with the way out: nodes, steps that are solved, equilibria and rest shapes."""
    sim = slab()
    with pytest.raises(ValueError, match=r"state .node_x. has no gradient: all nodes follow.*give mode_q"):
        Rollout(sim)({"node_x": sim.node_x}, steps=1)
    with pytest.raises(ValueError, match="in a floating frame with newton_iterations=5 yet; take newton_iterations=1"):
        Rollout(sw.Simulation(floating_slab(), dt=0.01, newton_iterations=5))
    with pytest.raises(ValueError, match="equilibria of reduced bodies have no gradient yet"):
        Equilibrium(sim)
    with pytest.raises(ValueError, match="rest shapes have no gradient beside reduced bodies"):
        Rollout(sim, rest=True)


def floating_slab() -> sw.Model:
    """The slab, free, with a frame that turns with it."""
    builder = scene(held=False, contact=False)
    builder.reduce(0, reduced_by(quadratic_modes(), frame="floating"))
    return builder.finalize(num_worlds=1)


def test_friction_that_is_not_unique_is_told() -> None:
    """An edge of four nodes, whose normal motions the modes do not tell apart, lands on a hard floor and slips."""
    sim = slab(on="floor")
    given = given_of(sim, [2])
    given["state"]["mode_q"].zero_()
    given["state"]["mode_v"][:, 2] = -0.3
    with pytest.raises(Diverged, match="slipped on more contacts than its modes tell apart"):
        gradients(Rollout(sim), given, loss)


def test_chambers_that_modes_do_not_tell_apart() -> None:
    """Two chambers in one place, beside contacts: rows repeat each other, so the first one has the gradient of both."""
    builder = scene(held=False, contact=False)
    builder.add_cavity(0, *meshing.compact(AIR.nodes + (0.01, 0.005, 0.003), AIR.surface()), control="volume")
    builder.reduce(0, reduced_by(smooth_modes(held=False)))
    ball = builder.add_rigid(sw.Sphere(0.02), kinematic=True, pose=(0.031, 0.0152, -0.0203))
    builder.add_contact(0, ball, mu=0.7, compliance=SOFTNESS, alarm_distance=0.003, contact_distance=0.0005)
    model = builder.finalize(num_worlds=1, precision="float64", contact_capacity=200)
    rollout = Rollout(sw.Simulation(model, dt=0.01, **EXACT))
    rest = torch.tensor(np.asarray(model.cavities.rest_volume), dtype=torch.float64)
    modes = {"mode_v": torch.full((1, model.mode_count), 0.01, dtype=torch.float64)}

    def value(growth: torch.Tensor) -> torch.Tensor:
        states = rollout(modes, {"cavity_volume": rest * (1.0 + growth)}, steps=2)
        return (states.node_x * torch.arange(1.0, model.node_count + 1.0)[:, None]).sum()

    growth = torch.full((2,), 0.01, dtype=torch.float64, requires_grad=True)
    value(growth).backward()
    assert growth.grad is not None
    with torch.no_grad():
        expected = float(value(growth + 1e-6) - value(growth - 1e-6)) / 2e-6
    assert growth.grad.abs().max() <= 10.0 * abs(expected)
    assert abs(float(growth.grad.sum()) - expected) <= 1e-6 * abs(expected)


@pytest.mark.cuda
@pytest.mark.parametrize("on", ["", "ball", "skin"])
def test_a_gpu_finds_the_same(on: str) -> None:
    """To what sums in another order and contacts that are iterated leave."""
    found = []
    for device in ("cpu", "cuda:0"):
        sim = slab(2, device=device, on="ball" if on == "skin" else on, skin=on == "skin", softness=SOFTNESS)
        found.append(gradients(Rollout(sim), given_of(sim, [1, 2]), loss))
    for group, held in found[0].items():
        for name, value in held.items():
            error = (found[1][group][name].cpu() - value).abs().max()
            assert error <= 1e-8 * value.abs().max(), (group, name, float(error), float(value.abs().max()))
