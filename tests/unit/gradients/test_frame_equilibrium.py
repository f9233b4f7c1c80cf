"""Equilibria of rods and rigid bodies, and their gradients, against central differences in float64."""

from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Diverged, Equilibrium

SIZES = {
    "cable_tension": 1e-4,
    "body_force": 1e-5,
    "rod_force": 1e-5,
    "rod_youngs": 20.0,
    "rod_nu": 1e-4,
    "rod_density": 0.1,
    "body_mass": 1e-5,
    "gravity": 1e-3,
}
COMMANDS = ("cable_tension", "body_force", "rod_force")


def hanging(num_worlds: int = 1, precision: str = "float64", *, tip: bool = True) -> sw.Simulation:
    """A rod that hangs down with two cables, and a lopsided body attached to its tip."""
    builder = sw.ModelBuilder(gravity=(0.3, 0.2, -9.81))
    line = np.linspace((0.0, 0.0, 0.0), (0.0, 0.0, -0.24), 7)
    rod = builder.add_rod(
        line, radius=0.008, youngs=4e5, nu=0.45, density=1080.0, normal=(1, 0, 0), rayleigh=(4.0, 0.0)
    )
    builder.fix(rod, nodes=[0])
    for way in ((0.005, 0.0, 0.0), (-0.002, 0.0045, 0.0)):
        builder.add_cable(rod, line[:6] + np.array(way), control="force")
    builder.add_marker(rod, (0.01, 0.0, -0.2))
    if tip:
        shape = sw.Compound([(sw.Box((0.02, 0.02, 0.02)), (0.004, 0.0, 0.0)), (sw.Sphere(0.01), (0.0, 0.01, -0.01))])
        load = builder.add_rigid(shape, mass=0.02, pose=(0.0, 0.0, -0.25))
        builder.attach(load, to=rod, node=6)
        builder.add_marker(load, (0.0, 0.02, -0.25))
    sim = sw.Simulation(builder.finalize(num_worlds, precision=precision), dt=0.05)  # type: ignore[arg-type]
    sim.control.cable_tension[...] = torch.tensor([0.6, 0.3]).to(sim.node_x)
    return sim


def given(sim: sw.Simulation, seeds: list[int]) -> dict[str, torch.Tensor]:
    """Commands and parameters; world i has those of individual ``seeds[i]``."""
    found: dict[str, list[torch.Tensor]] = {}
    for seed in seeds:
        rng = np.random.default_rng(seed)
        for name in SIZES:
            value = getattr(sim.control if name in COMMANDS else sim.params, name)[0]
            if value.numel():
                noise = torch.tensor(rng.standard_normal(tuple(value.shape))).to(value)
                change = 5e-3 * noise if "force" in name else 0.03 * value * noise
                if name.endswith("_force"):
                    change = change * torch.tensor([1.0] * 3 + [0.02] * 3).to(value)
                found.setdefault(name, []).append(value + change)
    return {name: torch.stack(values) for name, values in found.items()}


def solve(equilibrium: Equilibrium, values: dict[str, torch.Tensor], **options: Any) -> Any:
    """An equilibrium with these."""
    controls = {name: value for name, value in values.items() if name in COMMANDS}
    return equilibrium(controls, {n: v for n, v in values.items() if n not in COMMANDS}, **options)


def loss(pose: Any) -> torch.Tensor:
    """A weight for every result, (world,)."""
    rng = np.random.default_rng(3)
    total = pose.rod_x.new_zeros(len(pose.rod_x))
    for name in ("rod_x", "rod_q", "body_pose", "marker_x", "cable_tension"):
        value = getattr(pose, name)
        total = total + (value * torch.tensor(rng.standard_normal(tuple(value.shape[1:]))).to(value)).flatten(1).sum(1)
    return total


def gradients(equilibrium: Equilibrium, values: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """By all that is given."""
    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    loss(solve(equilibrium, leaves)).sum().backward()
    return {name: leaf.grad for name, leaf in leaves.items()}  # type: ignore[misc]


def test_gradients_are_those_of_differences() -> None:
    """By commands and parameters, of nodes, an attached body with its centre elsewhere, and markers."""
    sim = hanging()
    equilibrium = Equilibrium(sim)
    values = given(sim, [1])
    found, wrong = gradients(equilibrium, values), []
    torch.manual_seed(2)
    for name, gradient in found.items():
        change = SIZES[name] * torch.randn_like(gradient)
        ends = [float(loss(solve(equilibrium, {**values, name: values[name] + f * change}))) for f in (2, 1, -1, -2)]
        expected = (8.0 * (ends[1] - ends[2]) - (ends[0] - ends[3])) / 12.0
        derivative, scale = float((gradient * change).sum()), float((gradient * change).abs().sum())
        if not abs(derivative - expected) <= 1e-6 * max(abs(expected), 0.1 * scale):
            wrong.append(f"{name}: {derivative:.9e} instead of {expected:.9e}")
    assert not wrong, "\n".join(wrong)


def test_it_is_where_motion_ends() -> None:
    """Damped steps come to the same pose, and none leads away from it."""
    sim = hanging()
    pose = Equilibrium(sim)()
    assert torch.equal(sim.rod_x, hanging().rod_x)  # left as it is
    sim.step(600)
    assert (pose.rod_x - sim.rod_x).abs().max() < 1e-8
    assert (pose.body_pose - sim.body_pose).abs().max() < 1e-7
    assert (pose.marker_x - sim.marker_x).abs().max() < 1e-8


def test_worlds_change_no_bit() -> None:
    """A batch has poses and gradients of each world alone."""
    batch, single = hanging(2), hanging()
    both, values = Equilibrium(batch), given(batch, [1, 2])
    poses, found = solve(both, values), gradients(both, values)
    for world, seed in enumerate((1, 2)):
        alone, own = Equilibrium(single), given(single, [seed])
        assert torch.equal(solve(alone, own).rod_x[0], poses.rod_x[world])
        for name, value in gradients(alone, own).items():
            assert torch.equal(value[0], found[name][world]), name


def test_many_losses_at_once() -> None:
    """A backward pass that torch batches has the gradients of each loss, by everything that was given."""
    sim = hanging(2)
    equilibrium = Equilibrium(sim)
    leaves = {name: value.clone().requires_grad_() for name, value in given(sim, [1, 2]).items()}
    tips = solve(equilibrium, leaves).marker_x.flatten(1).sum(dim=0)

    def pull(by: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return torch.autograd.grad(tips, list(leaves.values()), by, retain_graph=True)

    each = torch.eye(len(tips), dtype=tips.dtype)
    for name, together, *alone in zip(leaves, torch.vmap(pull)(each), *map(pull, each), strict=True):
        for row, value in zip(together, alone, strict=True):
            assert torch.allclose(row, value, rtol=1e-10, atol=1e-12 * float(value.abs().max())), name


def test_a_warm_start_finds_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses and gradients of earlier equilibria, too, after others have been found; without steps to lead there."""
    sim = hanging()
    cold, warm = Equilibrium(sim), Equilibrium(sim, warm=True)
    values = given(sim, [1])
    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    first = loss(solve(warm, leaves)).sum()
    assert warm.frames is not None
    monkeypatch.setattr(warm.frames, "_step", lambda: pytest.fail("a step was taken"))
    other = {**values, "rod_youngs": 1.03 * values["rod_youngs"]}
    assert (solve(warm, other).rod_x - solve(cold, other).rod_x).abs().max() < 1e-9
    first.backward()
    for name, value in gradients(cold, values).items():
        assert torch.allclose(leaves[name].grad, value, rtol=1e-7, atol=1e-9 * float(value.abs().max())), name


def bent(num_worlds: int) -> sw.Simulation:
    """A block of silicone on the end of a rod that is bent far, with a cable from beside the clamp."""
    builder = sw.ModelBuilder(gravity=(1.0, 0.5, -2.0))
    line = np.linspace((-0.2, 0.03, 0.025), (0.0, 0.03, 0.025), 5)
    rod = builder.add_rod(line, radius=0.006, youngs=2e6, rayleigh=(0.1, 0.005))
    builder.fix(rod, nodes=[0])
    mesh = meshing.box((0.1, 0.06, 0.05), (2, 1, 1))
    block = builder.add_tets(mesh, material=sw.Corotational(8e4, 0.35), density=900.0)
    builder.attach(block, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)), to=rod, node=-1)
    way = [(0.015, 0.012, 0.04), (0.05, 0.012, 0.04), (0.085, 0.012, 0.04)]
    builder.add_cable(block, way, pull_point=(-0.25, 0.012, 0.04), control="force")
    builder.add_marker(block, (0.08, 0.05, 0.04))
    return sw.Simulation(builder.finalize(num_worlds, precision="float64"))


@pytest.mark.slow  # 45 s; the other tests here and the carried beams of test_relaxation prove such gradients
def test_far_from_the_tangent_of_a_step() -> None:
    """Steps without momentum, and corrections of the adjoint, would go away in a few directions; worlds change no bit.

    Where steps fail, at a tension that turns elements inside out, nothing is taken to be at rest because it stays.
    """
    tension, h = (0.2, 0.5, 1.0), 1e-5
    values = torch.tensor([[t + d] for t in tension for d in (0.0, h, -h)], dtype=torch.float64, requires_grad=True)
    places = Equilibrium(bent(9))({"cable_tension": values}).marker_x.sum((1, 2))
    (slope,) = torch.autograd.grad(places.sum(), values)
    for number, one in enumerate(tension):
        middle, up, down = (float(places[3 * number + k]) for k in range(3))
        assert float(slope[3 * number, 0]) == pytest.approx((up - down) / (2.0 * h), rel=1e-6)
        alone = torch.tensor([[one]], dtype=torch.float64, requires_grad=True)
        place = Equilibrium(bent(1))({"cable_tension": alone}).marker_x.sum()
        (found,) = torch.autograd.grad(place, alone)
        assert float(place) == middle and torch.equal(found[0], slope[3 * number])
    with pytest.raises(Diverged, match="did not come to rest"):
        Equilibrium(bent(1))({"cable_tension": torch.tensor([[2.0]], dtype=torch.float64)})


def test_what_does_not_come_to_rest_is_told() -> None:
    """A body that nothing holds has no equilibrium."""
    builder = sw.ModelBuilder()
    builder.add_rigid(sw.Sphere(0.1), mass=1.0)
    equilibrium = Equilibrium(sw.Simulation(builder.finalize(1), dt=0.01))
    with pytest.raises(RuntimeError, match="did not come to rest"):
        equilibrium(max_iterations=2)


def _inflated(builder: sw.ModelBuilder) -> None:
    from softwarp import meshing

    mesh, skin = meshing.box((0.1, 0.1, 0.1), (1, 1, 1)), meshing.box((0.04, 0.04, 0.04), (1, 1, 1))
    body = builder.add_tets(mesh, material=sw.Corotational(1e5, 0.4), density=1e3)
    builder.add_cavity(body, skin.nodes + 0.03, skin.surface())


def _length(builder: sw.ModelBuilder) -> None:
    rod = builder.add_rod([[0, 0, 0], [0.1, 0, 0]], radius=0.01, youngs=1e6, density=1e3)
    builder.add_cable(rod, [(0.0, 0.0, 0.005), (0.1, 0.0, 0.005)])


def _hinge(builder: sw.ModelBuilder) -> None:
    link = builder.add_rigid(sw.Sphere(0.1), mass=1.0)
    builder.add_joint(None, link, "hinge", anchor=(0.0, 0.0, 0.5), axis=(0.0, 1.0, 0.0))


def _base(builder: sw.ModelBuilder) -> None:
    builder.add_rigid(sw.Sphere(0.1), kinematic=True)


@pytest.mark.parametrize(
    ("build", "told"),
    [
        (_inflated, "beside chambers"),
        (_length, "whose length is"),
        (_hinge, "beside joints"),
        (_base, "beside kinematic"),
    ],
)
def test_what_has_no_gradient_is_refused(build: Any, told: str) -> None:
    """By name, with the way out."""
    builder = sw.ModelBuilder()
    builder.add_rigid(sw.Sphere(0.1), mass=1.0, pose=(1.0, 0.0, 0.0))
    build(builder)
    with pytest.raises(ValueError, match=told):
        Equilibrium(sw.Simulation(builder.finalize(1), dt=0.01))
