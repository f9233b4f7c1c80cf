"""Scenes that have all parts at once, by every input that a rollout takes, against central differences in float64.

Other files of this folder prove parts by themselves, in every law and state of theirs; here are the inputs of a part
beside other parts. Every number of the state, every command and every parameter that a scene has is in the list of what
is compared, so that a new one is, too.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Rollout, States
from softwarp.model.gradients import COMMANDS, PARAMETERS
from softwarp.scene import SoftBody
from tests.cases import FITTED
from tests.gradient_cases import STEPS, Inputs, gradients
from tests.unit.gradients.test_contact import EXACT, SLIPPING, STUCK
from tests.unit.gradients.test_forward_frames import compare
from tests.unit.gradients.test_rods import check, displaced, turned
from tests.unit.gradients.test_touches import modes

STATE = {  # how far a start is from rest, and the change for differences
    "node_x": (2e-4, 1e-8),
    "node_v": (0.05, 1e-6),
    "rod_x": (1e-4, 1e-8),
    "rod_q": (0.02, 1e-6),
    "rod_v": (0.05, 1e-5),
    "rod_w": (1.0, 1e-3),
    "body_pose": (1e-4, 3e-8),
    "body_twist": (0.3, 1e-5),
    "cavity_pressure": (20.0, 1e-2),
}
CONTROLS = {  # commands at random of this size, and the change
    "node_force": (0.02, 1e-5),
    "rod_force": (1e-3, 1e-6),
    "body_force": (1e-3, 1e-6),
    "body_velocity": (0.1, 1e-6),
    "joint_target": (0.05, 1e-6),
    "joint_force": (0.01, 1e-6),
    "traction": (20.0, 1e-2),
    "cable_displacement": (4e-3, 1e-8),
    "cable_tension": (0.5, 1e-5),
    "cavity_pressure": (300.0, 1e-2),
    "cavity_volume": (0.0, 1e-11),
    "cavity_gas": (0.0, 1e-11),
}
CHANGES = {  # of parameters; of others relative to them
    "gravity": 1e-3,
    "nu": 1e-5,
    "membrane_nu": 1e-3,
    "pair_mu": 1e-5,
    "rayleigh_mass": 1e-2,
    "rayleigh_stiffness": 1e-6,
    "rod_nu": 1e-3,
    "rod_rayleigh_mass": 3e-2,
    "rod_rayleigh_stiffness": 1e-6,
    "body_damping": 1e-2,
    "cable_stiffness": 0.1,
    "relaxation_ratio": 1e-5,
    "relaxation_time": 1e-6,
    "cable_damping": 1e-3,
}
RELATIVE = 1e-4
RESULTS = {  # weights in the loss
    "node_x": 10.0,
    "node_v": 1.0,
    "rod_x": 10.0,
    "rod_q": 1.0,
    "rod_v": 1.0,
    "rod_w": 0.02,
    "body_pose": 10.0,
    "body_twist": 0.3,
    "marker_x": 10.0,
    "cable_tension": 0.1,
    "cavity_pressure": 1e-3,
}
RAYLEIGH = (0.5, 0.01)
MEMORY = (0.4, 0.02)  # of a Maxwell branch
BRIEF = (0.3, 0.02)  # of one that touches something; with the other no step of it is far from a switch


def beam(
    builder: sw.ModelBuilder,
    at: tuple[float, float, float],
    chamber: str = "pressure",
    *,
    hits: bool = False,
    covered: bool = False,
    **options: Any,
) -> SoftBody:
    """A soft beam along x with a law of own parameters, a chamber, a loaded top and a cable that stretches.

    Args:
        builder: Of the scene.
        at: Its corner.
        chamber: Control of the chamber.
        hits: Leave the traction out.
        covered: Glue a membrane to all of its surface.
        **options: Of the body.
    """
    size = (0.1, 0.04, 0.04)
    mesh = meshing.box(size, (3, 1, 1))
    body = builder.add_tets(
        mesh.nodes + at, mesh.tets, material=FITTED["yeoh"](1e5, 0.4), density=1000.0, rayleigh=RAYLEIGH, **options
    )
    skin = meshing.box((0.03, 0.02, 0.02), (1, 1, 1))
    rate = {"max_pressure_rate": 1e4} if chamber == "pressure" else {}
    builder.add_cavity(body, skin.nodes + (0.03, 0.01, 0.01) + np.array(at), skin.surface(), control=chamber, **rate)  # type: ignore[arg-type]
    path = np.array([(0.01, 0.03, 0.03), (0.05, 0.03, 0.035), (0.09, 0.03, 0.03)]) + at
    builder.add_cable(body, path, stiffness=300.0, damping=2.0)
    if covered:
        builder.add_membrane(body, mesh.surface(), thickness=5e-4, youngs=4e5, nu=0.3, density=900.0)
    if not hits:
        low = np.array(at) + (0.0, 0.0, 0.0399)
        builder.add_traction(body, (0.0, 0.0, 1.0), box=(low - (1.0, 1.0, 0.0), low + 1.0))
    return body


def rod(builder: sw.ModelBuilder, end: tuple[float, float, float], damping: float = 0.005) -> Any:
    """A clamped rod that ends at a point, along x, with a cable; damped by its stiffness."""
    line = np.linspace(np.array(end) - (0.2, 0.0, 0.0), end, 4)
    found = builder.add_rod(line, radius=0.01, youngs=5e7, nu=0.4, density=1100.0, rayleigh=(0.2, damping))
    builder.fix(found, nodes=[0])
    builder.add_cable(found, line[[1, 2, 3]] + (0.0, 0.006, 0.004), control="force")
    return found


def carried(
    base: str = "rod",
    chamber: str = "pressure",
    integrator: str = "euler",
    *,
    relaxes: bool = False,
    covered: bool = False,
) -> sw.Simulation:
    """A beam on the end of a rod, or on a moved base beside one, with a box at its own end."""
    builder = sw.ModelBuilder(gravity=(1.0, 2.0, -9.81))
    body = beam(builder, (0.0, 0.0, 0.0), chamber, covered=covered, **({"relaxation": MEMORY} if relaxes else {}))
    stem = rod(builder, (0.0, 0.02, 0.02), 0.0 if relaxes else 0.005)
    box = builder.add_rigid(sw.Box((0.02, 0.06, 0.05)), mass=0.03, pose=(0.11, 0.02, 0.02), damping=0.4)
    builder.attach(body, box=((0.0999, -1, -1), (1, 1, 1)), to=box)
    if base == "rod":
        builder.attach(body, box=((-1, -1, -1), (1e-6, 1, 1)), to=stem, node=3)
    else:
        held = builder.add_rigid(sw.Box((0.02, 0.04, 0.04)), pose=(-0.01, 0.02, 0.02), kinematic=True)
        builder.attach(body, box=((-1, -1, -1), (1e-6, 1, 1)), to=held)
    builder.add_cable([body, box], [(0.03, 0.01, 0.035), (0.12, 0.01, 0.04)], pull_point=(-0.1, 0.0, 0.1))
    builder.add_marker(box, (0.12, 0.02, 0.02))
    return finished(builder, integrator=integrator, **({} if integrator == "euler" else EXACT))


def jointed(base: str = "rod", integrator: str = "euler") -> sw.Simulation:
    """Two links on a servo and a slider, from the end of a rod or a moved base, with a beam at their end."""
    builder = sw.ModelBuilder(gravity=(1.0, 2.0, -9.81))
    stem = rod(builder, (0.0, 0.0, 0.0))
    shape = sw.Box((0.1, 0.03, 0.02))
    upper = builder.add_rigid(shape, mass=0.08, pose=(0.05, 0.0, 0.0), damping=0.2)
    lower = builder.add_rigid(shape, mass=0.06, pose=(0.15, 0.0, 0.0))
    held: Any = (stem, 3)
    if base == "kinematic":
        held = builder.add_rigid(sw.Box((0.02, 0.02, 0.02)), pose=(-0.01, 0.0, 0.0), kinematic=True)
    servo: dict[str, Any] = {"control": "position", "stiffness": 0.5, "damping": 0.01}
    builder.add_joint(held, upper, "hinge", anchor=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.2), **servo)
    builder.add_joint(upper, lower, "slider", anchor=(0.1, 0.0, 0.0), axis=(1.0, 0.1, 0.0), control="force")
    body = beam(builder, (0.2, -0.02, -0.02))
    builder.attach(body, box=((0.19, -1, -1), (0.2 + 1e-6, 1, 1)), to=lower)
    builder.add_cable([upper, lower], [(0.03, 0.01, 0.01), (0.17, 0.01, 0.01)], stiffness=200.0, damping=1.0)
    builder.add_marker(lower, (0.2, 0.0, 0.01))
    return finished(builder, integrator=integrator, **({} if integrator == "euler" else EXACT))


def touching(
    base: str = "free", integrator: str = "euler", *, relaxes: bool = False, joints: bool = False, passes: int = 1
) -> sw.Simulation:
    """A beam on a tilted box that moves freely or is moved, beside a rod, also with joints beside it."""
    builder = sw.ModelBuilder(gravity=(0.3, 0.2, -9.81))
    body = beam(builder, (0.0, 0.0, 0.0), hits=True, **({"relaxation": BRIEF} if relaxes else {}))
    rod(builder, (-0.3, 0.0, 0.0), 0.0 if relaxes else 0.005)
    turn = np.array((0.05, 0.02, 0.03, 1.0))
    pose = (0.047, 0.023, -0.0225, *(turn / np.linalg.norm(turn)))
    how: dict[str, Any] = {"kinematic": True}
    if base == "free":
        how = {"mass": 0.5, "inertia": (1e-3, 2e-3, 1.5e-3), "damping": 0.3}
    other = builder.add_rigid(sw.Box((0.3, 0.3, 0.05)), pose=pose, **how)
    builder.add_contact(body, other, mu=0.5)
    if joints:
        link = builder.add_rigid(sw.Box((0.1, 0.03, 0.02)), mass=0.05, pose=(0.5, 0.0, 0.0))
        servo: dict[str, Any] = {"control": "position", "stiffness": 0.5, "damping": 0.01}
        builder.add_joint(None, link, "hinge", anchor=(0.45, 0.0, 0.0), axis=(0.0, 1.0, 0.2), **servo)
    sim = finished(builder, contact_passes=passes, integrator=integrator, **EXACT)
    sim.node_v[...] = torch.tensor((0.2, 0.06, -0.8))  # thrown on it
    return sim


def finished(builder: sw.ModelBuilder, **options: Any) -> sw.Simulation:
    """Its simulation."""
    return sw.Simulation(builder.finalize(num_worlds=1, precision="float64"), dt=0.01, **options)


def given_of(sim: sw.Simulation, share: float = 1.0) -> tuple[Inputs, dict[str, dict[str, Any]]]:
    """Every input that a scene has, away from rest by a share of its size, and its change."""
    rng = np.random.default_rng(2)

    def near(value: torch.Tensor, size: float) -> torch.Tensor:
        return value + share * size * torch.tensor(rng.standard_normal(value.shape)).to(value)

    given: Inputs = {"state": {}, "controls": {}, "parameters": {}}
    sizes: dict[str, dict[str, Any]] = {group: {} for group in given}
    for name, (size, change) in STATE.items():
        value = getattr(sim, name)
        rate = sim.params.cavity_max_pressure_rate
        is_bound = name == "cavity_pressure" and not bool((rate < 1e20).any())  # to its command
        if value.numel() and not is_bound and not (name.startswith("body") and sim.model.has_kinematic):
            if name == "rod_q":
                start = turned(value, near(0.0 * sim.rod_w, size))
            elif name == "body_pose":
                part = torch.tensor([1.0] * 3 + [50.0] * 3).to(value)
                start = displaced(name, value, part * near(0.0 * sim.body_twist, size))
            else:
                start = near(value, size)
            given["state"][name], sizes["state"][name] = start, change
    for name, (size, change) in CONTROLS.items():
        value = getattr(sim.control, name)
        if value.numel() and (name != "body_velocity" or sim.model.has_kinematic):
            steps = value.expand(STEPS, *value.shape)
            start = near(steps, size)
            is_mean = name in ("cable_displacement", "cable_tension", "cavity_pressure", "joint_target")
            if is_mean:
                start = steps + size * (share + 0.2 * (start - steps) / size)
            given["controls"][name], sizes["controls"][name] = start, change
    for name in PARAMETERS:
        value = getattr(sim.params, name)
        if value.numel() and bool((value != 0.0).any()):
            given["parameters"][name] = value.clone()
            sizes["parameters"][name] = CHANGES.get(name, RELATIVE * value.abs())
    return given, sizes


def loss(states: States) -> torch.Tensor:
    """A random weight for every result; (world,)."""
    rng = np.random.default_rng(7)
    total = states.node_x.new_zeros(states.node_x.shape[1])
    for name, size in RESULTS.items():
        value = getattr(states, name)
        weight = torch.tensor(rng.standard_normal((STEPS, 1, *value.shape[2:]))).to(value)[-len(value) :]
        total = total + size * (value * weight).flatten(2).sum(dim=(0, 2))
    return total


SCENES: dict[str, Callable[..., sw.Simulation]] = {
    "carried by a rod": carried,
    "carried by a base": partial(carried, "kinematic"),
    "with a memory": partial(carried, relaxes=True),
    "with a membrane": partial(carried, covered=True),
    "with a volume": partial(carried, chamber="volume"),
    "with gas": partial(carried, chamber="gas"),
    "jointed to a rod": jointed,
    "jointed to a base": partial(jointed, "kinematic"),
    "touching": touching,
    "touching what is moved": partial(touching, "kinematic"),
    "touching with a memory": partial(touching, relaxes=True),
    "touching beside joints": partial(touching, joints=True, passes=0),
    "touching beside joints with a memory": partial(touching, joints=True, passes=0, relaxes=True),
}
ELSEWHERE = (
    "with a membrane",
    "touching with a memory",
    "touching beside joints with a memory",
)  # quick tests of these are in files of their own
QUIET = 0.1  # part of the sizes at which no step of second order is a rough one
LOUD = 1.0  # of stages beside joints, which are linearised at their start: at rest a projected tangent has kinks


@pytest.mark.parametrize(
    "scene", [pytest.param(name, marks=pytest.mark.slow if name in ELSEWHERE else ()) for name in SCENES]
)
def test_gradients_are_those_of_differences(scene: str) -> None:
    """By all that the scene has; what touches is pressed."""
    sim = SCENES[scene]()
    given, sizes = given_of(sim)
    if "touching" not in scene and "body_mass" in sizes["parameters"]:
        sizes["parameters"]["body_mass"] *= 10.0  # bodies of some grams, to which a loss of 75 owes its last digits
    check(Rollout(sim), given, loss, sizes)
    assert "touching" not in scene or modes(sim, given) & {STUCK, SLIPPING}


@pytest.mark.parametrize(
    "scene",
    [
        pytest.param(name, marks=() if name in ("carried by a rod", "with a volume", "touching") else pytest.mark.slow)
        for name in SCENES
    ],
)
def test_gradients_of_steps_of_second_order(scene: str) -> None:
    """The same with ``bdf2``, nearer to rest in smooth steps; pressures that nothing depends on have gradient 0.

    What touches takes rough steps, as the forward step does.
    """
    touches = "touching" in scene
    sim = SCENES[scene](integrator="bdf2")
    is_loud = touches or sim.model.joints is not None
    given, sizes = given_of(sim, LOUD if is_loud else QUIET)
    if "memory" in scene and touches:
        sizes["parameters"]["relaxation_time"] *= 3.0  # else differences are rounding
    if scene == "with a volume":
        sizes["parameters"]["rod_youngs"] *= 3.0  # likewise
    if touches:
        sizes["parameters"]["rod_nu"] *= 10.0  # likewise
        if "body_damping" in sizes["parameters"]:
            sizes["parameters"]["body_damping"] *= 0.1  # else they cross a switch
    pressure = None if is_loud else given["state"].pop("cavity_pressure", None)
    check(Rollout(sim), given, loss, sizes)
    if pressure is not None:
        found = gradients(Rollout(sim), {**given, "state": {"cavity_pressure": pressure}}, loss)
        assert not found["state"]["cavity_pressure"].any()


@pytest.mark.parametrize(
    ("scene", "integrator"),
    [
        ("with a memory", "euler"),
        ("carried by a base", "bdf2"),
        ("with a memory", "bdf2"),
        ("touching", "bdf2"),
        ("jointed to a rod", "euler"),
        pytest.param("jointed to a base", "bdf2", marks=pytest.mark.slow),
        pytest.param("touching beside joints", "euler", marks=pytest.mark.slow),
        pytest.param("touching beside joints", "bdf2", marks=pytest.mark.slow),
        pytest.param("carried by a base", "euler", marks=pytest.mark.slow),
        pytest.param("touching", "euler", marks=pytest.mark.slow),
        pytest.param("touching with a memory", "bdf2", marks=pytest.mark.slow),
    ],
)
def test_the_tangent_of_pressures(scene: str, integrator: str) -> None:
    """In A with one linearisation, of bodies that something carries and that touch something, in both modes.

    Beside joints too.
    """
    sim = SCENES[scene](integrator=integrator)
    options = {**EXACT, "contact_passes": sim.options.contact_passes} if sim.model.contact is not None else EXACT
    other = sw.Simulation(sim.model, dt=0.01, integrator=integrator, pressure_tangent=True, **options)
    other.node_v[...] = sim.node_v
    is_loud = integrator == "euler" or "touching" in scene or sim.model.joints is not None
    given, sizes = given_of(other, LOUD if is_loud else QUIET)
    given["state"]["cavity_pressure"] = other.cavity_pressure + 3000.0
    sizes["state"]["cavity_pressure"] = 1.0
    sizes["controls"]["cable_displacement"] *= 3.0  # else differences are rounding
    if "memory" in scene:  # else differences are rounding
        sizes["parameters"]["relaxation_ratio"] *= 10.0
        sizes["parameters"]["relaxation_time"] *= 10.0
    check(Rollout(other), given, loss, sizes)
    compare(Rollout(other), given, loss)


@pytest.mark.parametrize("integrator", ["bdf2", "trapezoidal"])
def test_what_has_no_gradient_with_second_order_is_told(integrator: str) -> None:
    """By name and with the way out."""
    with pytest.raises(ValueError, match=r"more than once a step \(contact_passes=2"):
        Rollout(touching(integrator=integrator, passes=2))


def test_the_trapezoidal_rule_beside_rows_is_bdf2() -> None:
    """Where cables or chambers make it that, gradients are the same."""
    found = []
    for integrator in ("bdf2", "trapezoidal"):
        sim = carried(integrator=integrator)
        given, _ = given_of(sim, QUIET)
        found.append(gradients(Rollout(sim), given, loss))
    for group, held in found[0].items():
        assert all(torch.equal(value, found[1][group][name]) for name, value in held.items())


def test_no_input_is_left_out() -> None:
    """Scenes have all commands and parameters together."""
    found: dict[str, set[str]] = {"state": set(), "controls": set(), "parameters": set()}
    for build in SCENES.values():
        for group, held in given_of(build())[0].items():
            found[group] |= set(held)
    assert found == {"state": set(STATE), "controls": set(COMMANDS), "parameters": set(PARAMETERS)}
