"""Gradients of hexahedra, by every input, against central differences in float64, beside all that they may be with."""

from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Equilibrium, Rollout
from tests.gradient_cases import Inputs, gradients, weights
from tests.unit.gradients import test_adjoint, test_every_input
from tests.unit.gradients.test_contact import EXACT, SLIPPING, STUCK
from tests.unit.gradients.test_forward import compare
from tests.unit.gradients.test_forward_frames import compare as compare_frames
from tests.unit.gradients.test_rods import check
from tests.unit.gradients.test_touches import modes

SIZE = (0.1, 0.04, 0.04)
SLOW = pytest.mark.slow
SOLVED = {"newton_iterations": 60, "newton_tolerance": 1e-13}


def beam(builder: sw.ModelBuilder, *, thin: bool = False, loaded: bool = True) -> Any:
    """A beam along x of two hexahedra that are no bricks, with moduli of their own, a chamber, a cable, a membrane."""
    mesh = meshing.brick(SIZE, (2, 1, 1))
    nodes = mesh.nodes.copy()
    nodes[:, 0] += 2.0 * nodes[:, 1] * nodes[:, 0] * (SIZE[0] - nodes[:, 0]) / SIZE[0]
    body = builder.add_hexes(
        nodes,
        mesh.hexes,
        material=sw.Corotational(1e5, 0.4),
        density=1000.0,
        rayleigh=(0.5, 0.01),
        stiffness=[0.7, 1.4],
        thin=thin,
    )
    path = [(0.01, 0.03, 0.03), (0.05, 0.03, 0.035), (0.09, 0.03, 0.03)]
    if loaded:
        skin = meshing.box((0.03, 0.02, 0.02), (1, 1, 1))
        builder.add_cavity(body, skin.nodes + (0.03, 0.01, 0.01), skin.surface(), max_pressure_rate=2e4)
        builder.add_cable(body, path, pull_point=(-0.1, 0.0, 0.0), stiffness=300.0, damping=2.0)
        builder.add_traction(body, (0.0, 0.0, 1.0), box=((-1.0, -1.0, 0.0399), (1.0, 1.0, 1.0)))
    builder.add_cable(body, path, control="force")
    builder.add_marker(body, (0.1, 0.02, 0.02))
    return body


def held(num_worlds: int = 1, precision: str = "float64", *, thin: bool = False, **options: Any) -> sw.Simulation:
    """The beam, held at one end."""
    builder = sw.ModelBuilder(gravity=(1.0, 2.0, -9.81))
    body = beam(builder, thin=thin)
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    model = builder.finalize(num_worlds=num_worlds, precision=precision)  # type: ignore[arg-type]
    return sw.Simulation(model, dt=0.01, **options)


def given_of(sim: sw.Simulation, seeds: list[int], strain: float) -> Inputs:
    """Inputs at random; elements are pressed together to about 1 - ``strain``."""
    values: dict[str, dict[str, list[np.ndarray]]] = {"state": {}, "controls": {}, "parameters": {}}
    for seed in seeds:
        rng = np.random.default_rng(seed)
        x, count = sim.node_x[0].cpu().numpy().copy(), sim.model.node_count
        x[:, 0] *= 1.0 - strain
        x += 2e-3 * rng.standard_normal(x.shape)
        ramp = np.arange(1.0, 4.0)[:, None] * rng.uniform(0.8, 1.2)
        found: dict[str, dict[str, Any]] = {
            "state": {"node_x": x, "node_v": 0.1 * rng.standard_normal(x.shape), "cavity_pressure": [50.0]},
            "controls": {
                "node_force": 0.1 * rng.standard_normal((count, 3)),
                "cable_displacement": 0.004 * ramp * np.ones(2),
                "cable_tension": ramp * np.ones(2),
                "cavity_pressure": [510.0],
                "traction": rng.uniform(-50.0, 50.0, (1, 3)),
            },
            "parameters": {
                name: getattr(sim.params, name)[0].cpu().numpy() * rng.uniform(0.9, 1.1)
                for name in ("youngs", "nu", "density", "rayleigh_mass", "rayleigh_stiffness", "gravity")
            },
        }
        for group, parts in found.items():
            for name, value in parts.items():
                values[group].setdefault(name, []).append(np.asarray(value))
    return {
        group: {
            name: torch.tensor(np.stack(each, axis=int(name.startswith("cable")))).to(sim.node_x)
            for name, each in parts.items()
        }
        for group, parts in values.items()
    }


@pytest.mark.parametrize(
    ("thin", "strain", "options"),
    [
        (False, 0.1, {}),
        (True, 0.1, {}),
        (False, 0.6, {}),
        pytest.param(True, 0.6, {"pressure_tangent": True}, marks=SLOW),
        pytest.param(False, 0.1, {"integrator": "bdf2"}, marks=SLOW),
        (False, 0.1, SOLVED),
        pytest.param(True, 0.6, SOLVED, marks=SLOW),
    ],
)
def test_gradients_are_those_of_differences(*, thin: bool, strain: float, options: dict[str, Any]) -> None:
    """By all inputs; pressed to less than half, guards push."""
    sim = held(thin=thin, **options)
    given = given_of(sim, [1], strain)
    test_adjoint.check(Rollout(sim), given, weights(sim))


def test_both_modes_agree() -> None:
    """Forward and reverse."""
    sim = held()
    compare(Rollout(sim), given_of(sim, [1], 0.1), weights(sim))


def carried(base: str, integrator: str = "euler") -> sw.Simulation:
    """The beam under a membrane on the end of a rod, or on a moved base, with a box at its own end."""
    builder = sw.ModelBuilder(gravity=(1.0, 2.0, -9.81))
    body = beam(builder)
    skin = builder.bodies[body].mesh.surface()
    builder.add_membrane(body, skin, thickness=5e-4, youngs=4e5, nu=0.3, density=900.0)
    box = builder.add_rigid(sw.Box((0.02, 0.06, 0.05)), mass=0.03, pose=(0.11, 0.02, 0.02), damping=0.4)
    builder.attach(body, box=((0.0999, -1, -1), (1, 1, 1)), to=box)
    if base == "rod":
        stem = test_every_input.rod(builder, (0.0, 0.02, 0.02))
        builder.attach(body, box=((-1, -1, -1), (1e-6, 1, 1)), to=stem, node=3)
    else:
        moved = builder.add_rigid(sw.Box((0.02, 0.04, 0.04)), pose=(-0.01, 0.02, 0.02), kinematic=True)
        builder.attach(body, box=((-1, -1, -1), (1e-6, 1, 1)), to=moved)
    return test_every_input.finished(builder, integrator=integrator)


@pytest.mark.parametrize(
    ("base", "integrator"),
    [
        ("rod", "euler"),
        pytest.param("kinematic", "euler", marks=SLOW),
        pytest.param("kinematic", "bdf2", marks=SLOW),
    ],
)
def test_what_carries_hexahedra(base: str, integrator: str) -> None:
    """By how it moves, and by all else; the forces of elements at nodes that frames carry count."""
    sim = carried(base, integrator)
    given, sizes = test_every_input.given_of(sim, 1.0 if integrator == "euler" else 0.1)
    check(Rollout(sim), given, test_every_input.loss, sizes)
    compare_frames(Rollout(sim), given, test_every_input.loss)


def test_hexahedra_that_touch() -> None:
    """On a tilted box that moves freely, sticking and slipping."""
    builder = sw.ModelBuilder(gravity=(0.3, 0.2, -9.81))
    body = beam(builder, loaded=False)
    turn = np.array((0.05, 0.02, 0.03, 1.0))
    pose = (0.047, 0.023, -0.0225, *(turn / np.linalg.norm(turn)))
    free: dict[str, Any] = {"mass": 0.5, "inertia": (1e-3, 2e-3, 1.5e-3), "damping": 0.3}
    builder.add_contact(body, builder.add_rigid(sw.Box((0.3, 0.3, 0.05)), pose=pose, **free), mu=0.5)
    sim = test_every_input.finished(builder, **EXACT)
    sim.node_v[...] = torch.tensor((0.2, 0.06, -0.8))
    given, sizes = test_every_input.given_of(sim)
    check(Rollout(sim), given, test_every_input.loss, sizes)
    assert modes(sim, given) & {STUCK, SLIPPING}


@pytest.mark.parametrize("precision", ["float64", pytest.param("float32", marks=SLOW)])
def test_worlds_beside_and_kept_factors_change_no_bit(precision: str) -> None:
    """A world has its gradients alone and in a batch, with kept factors too; in lanes those of float64 nearly."""
    count = 1 if precision == "float64" else 8
    many, one = held(count + 1, precision), held(count, precision)
    found = gradients(Rollout(many), given_of(many, [*range(count + 1)], 0.1), weights(many), factors=True)
    alone = gradients(Rollout(one), given_of(one, [*range(count)], 0.1), weights(one))
    for group, parts in alone.items():
        for name, value in parts.items():
            axis = int(name.startswith("cable") and group == "controls")
            assert torch.equal(found[group][name].narrow(axis, 0, count), value), name
    if precision == "float32":
        exact = held(count)
        expected = gradients(Rollout(exact), given_of(exact, [*range(count)], 0.1), weights(exact))
        for group, parts in alone.items():
            for name, value in parts.items():
                other = expected[group][name]
                assert (value - other).abs().max() <= 2e-3 * other.abs().max(), name


def test_what_has_no_gradient_is_told() -> None:
    """Equilibria and rest shapes, with the way out."""
    with pytest.raises(ValueError, match=r"equilibria of hexahedra.* take a Rollout"):
        Equilibrium(held())
    with pytest.raises(ValueError, match=r"no gradient beside hexahedra; leave rest=True out"):
        Rollout(held(), rest=True)
