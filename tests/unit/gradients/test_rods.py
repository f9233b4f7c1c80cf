"""Gradients through steps of rods against central differences in float64: poses, twists, forces and parameters."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Rollout, States
from tests.gradient_cases import STEPS, Inputs, gradients

WAYPOINTS = 6  # nodes of cables that rods carry, behind those of soft bodies
TOLERANCE = 1e-6  # relative, of directional derivatives
STARTS = {"rod_x": 1e-8, "rod_v": 1e-5, "rod_q": 1e-6, "rod_w": 1e-4}
SIZES = {
    "state": STARTS,
    "controls": {"rod_force": 1e-9, "cable_displacement": 1e-7, "cable_tension": 1e-5},
    "parameters": {
        "rod_youngs": 10.0,
        "rod_nu": 1e-5,
        "rod_density": 1e-1,
        "rod_rayleigh_mass": 1e-3,
        "rod_rayleigh_stiffness": 1e-6,
        "gravity": 1e-3,
        "cable_stiffness": 1e-3,
        "cable_damping": 1e-3,
    },
}


def rods(
    num_worlds: int = 1, precision: str = "float64", *, soft: bool = False, driven: bool = False, **stretch: float
) -> sw.Simulation:
    """A curved rod that is clamped and a free one with other sections.

    Args:
        num_worlds: Worlds.
        precision: Of the model.
        soft: Put a cube of soft elements beside them.
        driven: Give the clamped rod a cable of each control, one of them to the free one, and a marker.
        **stretch: Stiffness and damping of the cable whose length is commanded.
    """
    builder = sw.ModelBuilder(gravity=(1.0, 2.0, -9.81))
    angle = np.linspace(0.0, 1.2, 5)
    bow = np.stack([0.1 * np.sin(angle), 0.02 * angle, 0.1 * np.cos(angle)], axis=1)
    held = builder.add_rod(bow, radius=0.006, youngs=2e6, nu=0.4, density=1100.0, rayleigh=(0.3, 0.01))
    builder.fix(held, nodes=[0])
    section = [2e-5, 1.6e-5, 6e-11, 2e-11, 5e-11]
    line = np.stack([np.linspace(0.3, 0.4, 4), np.zeros(4), np.zeros(4)], axis=1)
    free = builder.add_rod(line, radius=0.003, youngs=1e6, density=900.0, section=section, curvature=(2.0, 1.0, 3.0))
    if driven:
        side = np.array([0.004, 0.003, 0.0])
        builder.add_cable(held, bow[[0, 2, 4]] + side, pull_point=(-0.02, 0.0, -0.05), **stretch)
        waypoints = [bow[1] - side, bow[3] - side, line[2] + side]
        builder.add_cable([held, held, free], waypoints, control="force")
        builder.add_marker(held, bow[4] + side)
    if soft:
        cube = builder.add_tets(meshing.box((0.1,) * 3, (1, 1, 1)), material=sw.Corotational(1e5, 0.4), density=1e3)
        builder.fix(cube, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    model = builder.finalize(num_worlds=num_worlds, precision=precision)  # type: ignore[arg-type]
    return sw.Simulation(model, dt=0.01)


def bent(sim: sw.Simulation, seeds: list[int]) -> Inputs:
    """Nodes that are displaced and turned at random and move; world i has those of individual ``seeds[i]``."""
    worlds: dict[str, list[torch.Tensor]] = {name: [] for name in (*STARTS, "rod_force")}
    for seed in seeds:
        rng = np.random.default_rng(seed)
        x, q = sim.rod_x[0].numpy(), sim.rod_q[0].numpy()
        turn = 0.2 * rng.standard_normal((len(x), 3))
        values = {
            "rod_x": x + 2e-3 * rng.standard_normal(x.shape),
            "rod_q": turned(torch.tensor(q), torch.tensor(turn)).numpy(),
            "rod_v": 0.1 * rng.standard_normal(x.shape),
            "rod_w": 3.0 * rng.standard_normal(x.shape),
            "rod_force": 1e-3 * rng.standard_normal((STEPS, len(x), 6)),
        }
        for name, value in values.items():
            worlds[name].append(torch.tensor(value).to(sim.rod_x))
    force = torch.stack(worlds.pop("rod_force"), dim=1)
    one, count = torch.ones(STEPS, len(seeds), sim.model.cable_count).to(sim.rod_x), sim.model.cable_count
    cables = {"cable_displacement": 1e-3 * one, "cable_tension": 0.2 * one} if count else {}
    parameters = {name: getattr(sim.params, name).clone() for name in SIZES["parameters"]}
    return {
        "state": {name: torch.stack(value) for name, value in worlds.items()},
        "controls": {"rod_force": force, **cables},
        "parameters": {name: value for name, value in parameters.items() if value.numel()},
    }


def turned(q: torch.Tensor, turn: torch.Tensor) -> torch.Tensor:
    """exp [turn] after q."""
    angle = turn.norm(dim=-1, keepdim=True).clamp(min=1e-30)
    u, w = turn / angle * (0.5 * angle).sin(), (0.5 * angle).cos()
    v, s = q[..., :3], q[..., 3:]
    return torch.cat([w * v + s * u + torch.linalg.cross(u, v), w * s - (u * v).sum(-1, keepdim=True)], dim=-1)


def displaced(name: str, start: torch.Tensor, change: torch.Tensor) -> torch.Tensor:
    """An input and a change of it; of orientations, also those of poses, the change is a turn."""
    if name in ("rod_q", "mode_turn"):
        return turned(start, change)
    if name == "body_pose":
        return torch.cat([start[..., :3] + change[..., :3], turned(start[..., 3:], change[..., 3:])], dim=-1)
    return start + change


WIDTHS = {"rod_q": 3, "mode_turn": 3, "body_pose": 6}  # of changes of what has a quaternion


def loss(states: States) -> torch.Tensor:
    """A random weight for every result; (world,)."""
    rng = np.random.default_rng(7)
    total = states.rod_x.new_zeros(states.rod_x.shape[1])
    sizes = {"rod_x": 10.0, "rod_q": 1.0, "rod_v": 1.0, "rod_w": 0.02, "node_x": 10.0, "node_v": 1.0, "marker_x": 10.0}
    for name, size in sizes.items():
        value = getattr(states, name)
        value = value[..., -WAYPOINTS:, :] if name.startswith("node") else value
        weight = torch.tensor(rng.standard_normal((STEPS, 1, *value.shape[2:]))).to(value)[-len(value) :]
        total = total + size * (value * weight).sum(dim=(0, 2, 3))
    return total + 0.1 * states.cable_tension.sum(dim=(0, 2))


def check(
    rollout: Rollout, given: Inputs, loss: Callable[[States], torch.Tensor], sizes: dict[str, dict[str, float]]
) -> None:
    """Compare the derivative along a random direction in every input with its difference; quaternions turn."""
    found, wrong = gradients(rollout, given, loss), []
    torch.manual_seed(3)
    for group, held in found.items():
        for name, gradient in held.items():
            size = sizes[group][name]
            change = size * torch.randn_like(gradient[..., : WIDTHS.get(name, gradient.shape[-1])])

            def moved(factor: float, group: str = group, name: str = name, change: torch.Tensor = change) -> float:
                start = given[group][name]
                value = displaced(name, start, factor * change)
                inputs = {**given, group: {**given[group], name: value}}
                return float(loss(rollout(inputs["state"], inputs["controls"], inputs["parameters"])).sum())

            expected = (8.0 * (moved(1.0) - moved(-1.0)) - (moved(2.0) - moved(-2.0))) / 12.0
            start = given[group][name]
            along = 0.5 * (displaced(name, start, change) - displaced(name, start, -change))
            derivative, scale = float((gradient * along).sum()), float((gradient * along).abs().sum())
            if not abs(derivative - expected) <= TOLERANCE * max(abs(expected), 0.1 * scale):
                wrong.append(f"{group} {name}: {derivative:.9e} instead of {expected:.9e}")
    assert not wrong, "\n".join(wrong)


def test_gradients_are_those_of_differences() -> None:
    """Stretched, sheared, bent, twisted and spinning, clamped and free."""
    sim = rods()
    check(Rollout(sim), bent(sim, [1]), loss, SIZES)


@pytest.mark.parametrize("stretch", [{}, {"stiffness": 300.0, "damping": 0.5}])
def test_cables_on_rods(stretch: dict[str, float]) -> None:
    """Cables whose waypoints and tensions turn with sections, one of them between rods, and a marker beside a node."""
    sim = rods(driven=True, **stretch)
    given = bent(sim, [1])
    states = Rollout(sim)(given["state"], given["controls"], given["parameters"])
    assert (states.cable_tension > 0.01).all()
    check(Rollout(sim), given, loss, SIZES)


def test_worlds_kept_factors_and_soft_bodies_change_no_bit() -> None:
    """A batch has the gradients of each world alone, whether factors are kept, and whether a soft body is beside."""
    seeds = [1, 2, 3]
    batch, single, beside = rods(3, driven=True), rods(driven=True), rods(3, soft=True, driven=True)
    rollout, given = Rollout(batch), bent(batch, seeds)
    plain = gradients(rollout, given, loss)
    others = {
        "factors": gradients(rollout, given, loss, factors=True),
        "beside": gradients(Rollout(beside), given, loss),
    }
    for label, other in others.items():
        for group, held in plain.items():
            for name, value in held.items():
                close = torch.allclose(other[group][name], value, rtol=1e-9, atol=1e-12 * float(value.abs().max()))
                assert close if label == "beside" else torch.equal(other[group][name], value), (label, group, name)
    last = gradients(rollout, given, loss, every=STEPS)
    again = gradients(rollout, given, loss, every=STEPS, factors=True)
    assert all(torch.equal(last[group][name], again[group][name]) for group in last for name in last[group])
    for world, seed in enumerate(seeds):
        for group, held in gradients(Rollout(single), bent(single, [seed]), loss).items():
            for name, value in held.items():
                axis = 1 if group == "controls" else 0
                assert torch.equal(plain[group][name].select(axis, world), value.select(axis, 0)), (group, name)


def test_states_are_those_of_the_simulation() -> None:
    """A rollout takes the steps of the simulation to the bit, and leaves it as it is."""
    sim = rods(driven=True)
    states = Rollout(sim)(steps=2)
    sim.step()
    assert torch.allclose(states.marker_x[0], sim.marker_x, atol=1e-15)
    for name in ("rod_x", "rod_q", "rod_v", "rod_w", "cable_tension", "node_x"):
        assert torch.equal(getattr(states, name)[0], getattr(sim, name)), name


@pytest.mark.slow
def test_float32_follows_float64() -> None:
    """In lanes of eight worlds too."""
    seeds = list(range(9))
    exact, rough = rods(9), rods(9, "float32")
    a, b = (gradients(Rollout(sim), bent(exact, seeds), loss) for sim in (exact, rough))
    for group, held in a.items():
        for name, value in held.items():
            assert (b[group][name] - value).abs().max() < 0.02 * value.abs().max(), (group, name)


def test_modulus_is_found() -> None:
    """Gauss and Newton's method finds the modulus of a rod from how its tip swings."""
    builder = sw.ModelBuilder()
    rod = builder.add_rod(np.linspace((0.0, 0.0, 0.0), (0.2, 0.0, 0.0), 5), radius=0.005, youngs=1e6, density=1000.0)
    builder.fix(rod, nodes=[0])
    rollout = Rollout(sw.Simulation(builder.finalize(num_worlds=1, precision="float64"), dt=0.01))
    shown = float(rollout(parameters={"rod_youngs": torch.tensor([2.5e6])}, steps=10).rod_x[-1, 0, -1, 2])
    log_modulus = torch.tensor(1e6, dtype=torch.float64).log().requires_grad_()
    for _ in range(6):
        height = rollout(parameters={"rod_youngs": log_modulus.exp()}, steps=10).rod_x[-1, 0, -1, 2]
        (slope,) = torch.autograd.grad(height, log_modulus)
        with torch.no_grad():
            log_modulus -= ((height - shown) / slope).clamp(-0.5, 0.5)
    assert abs(float(log_modulus.exp()) - 2.5e6) < 1.0


def test_refusals() -> None:
    """What of rods has no gradient is told by name."""

    def scene(**options: Any) -> sw.Simulation:
        builder = sw.ModelBuilder()
        builder.add_rod([(0, 0, 0), (0.1, 0, 0)], radius=0.01, youngs=1e6, name="stem")
        return sw.Simulation(builder.finalize(num_worlds=1), dt=0.01, **options)

    with pytest.raises(ValueError, match="rod 'stem' has no gradient with project_tangent=False yet"):
        Rollout(scene(project_tangent=False))
