"""Gradients of equilibria against central differences in float64."""

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Equilibrium
from tests.cases import material

LAWS = [
    ("large", None, False),
    ("nh_log", "pressure", False),
    ("nh_log", None, True),
    *(pytest.param(law, None, False, marks=pytest.mark.slow) for law in ("nh_log", "warped", "corot", "stvk", "ogden")),
    *(pytest.param("large", control, True, marks=pytest.mark.slow) for control in (None, "pressure", "volume", "gas")),
    *(pytest.param("nh_log", control, False, marks=pytest.mark.slow) for control in ("volume", "gas")),
]
KINDS = [("large", None), ("nh_log", "gas"), ("nh_log", "volume")]
CHAMBERS = ("cavity_pressure", "cavity_volume", "cavity_gas")
STEPS = {
    "node_force": 1e-4,
    "cable_displacement": 1e-6,
    "cable_tension": 1e-4,
    "cavity_pressure": 1.0,
    "cavity_volume": 1e-9,
    "cavity_gas": 1e-9,
    "traction": 1e-2,
    "youngs": 10.0,
    "nu": 1e-5,
    "density": 0.1,
    "gravity": 1e-3,
    "cable_stiffness": 1e-2,
    "law_parameter": 1e-4,
}


def beam(
    law: str = "large",
    num_worlds: int = 1,
    *,
    chamber: str | None = None,
    quadratic: bool = False,
    precision: str = "float64",
    **options: object,
) -> sw.Simulation:
    """A beam held at one end, with a taut cable of each control and a slack one, perhaps with a chamber in it.

    Of quadratic elements it has a traction on its end, and the cable whose length is commanded stretches.
    """
    builder = sw.ModelBuilder(gravity=(0.5, 1.0, -9.81))
    mesh = meshing.box((0.1, 0.04, 0.04), (3, 1, 1))
    body = builder.add_tets(
        meshing.elevate(mesh) if quadratic else mesh, material=material(law, 1e5, 0.4), density=1000.0
    )
    if quadratic:
        builder.add_traction(body, (0.0, 0.0, 100.0), box=((0.099, -1.0, -1.0), (1.0, 1.0, 1.0)))
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    x = np.linspace(0.0, 0.1, 3)
    for y, control in ((0.01, "length"), (0.03, "force"), (0.02, "length")):
        points = np.stack([x, np.full(3, y), np.full(3, 0.035)], axis=1)
        stretch = {"stiffness": 200.0} if quadratic and control == "length" else {}
        builder.add_cable(body, points, control=control, **stretch)  # type: ignore[arg-type]
    if chamber is not None:
        skin = meshing.box((0.04, 0.02, 0.02), (1, 1, 1))
        builder.add_cavity(
            body, skin.nodes + (0.03, 0.01, 0.01), skin.surface(), control=chamber, max_pressure_rate=1e3
        )  # type: ignore[arg-type]
    builder.add_marker(body, (0.1, 0.02, 0.02))
    sim = sw.Simulation(builder.finalize(num_worlds=num_worlds, precision=precision), **options)  # type: ignore[arg-type]
    sim.control.cable_displacement[...] = torch.tensor([0.004, 0.0, -0.02]).to(sim.node_x)
    sim.control.cable_tension[...] = 0.5
    sim.control.cavity_pressure[...] = 5e3
    sim.control.cavity_volume[...] = 1.7e-5
    sim.control.cavity_gas[...] = 1.8e-5
    return sim


@pytest.mark.parametrize(("law", "chamber", "quadratic"), LAWS)
def test_gradients_of_equilibria(law: str, chamber: str | None, quadratic: bool) -> None:
    """Every input, along a random direction, to 1e-6; ``large`` has no energy and an unsymmetric tangent."""
    sim = beam(law, chamber=chamber, quadratic=quadratic)
    equilibrium = Equilibrium(sim)
    torch.manual_seed(0)
    groups = ({}, {})
    for group, names, views in (
        (0, ("node_force", "cable_displacement", "cable_tension", *CHAMBERS, "traction"), sim.control),
        (1, ("youngs", "nu", "density", "gravity", "law_parameter", "cable_stiffness"), sim.params),
    ):
        for name in names:
            value = getattr(views, name).clone()
            if value.numel():
                groups[group][name] = (value + 0.05 * torch.randn_like(value) * (name == "node_force")).requires_grad_()
    w = torch.randn_like(sim.node_x) / 0.1
    w_tension, w_marker = torch.randn_like(sim.cable_tension), torch.randn_like(sim.marker_x) / 0.1
    w_pressure = torch.randn_like(sim.cavity_pressure) / 1e4

    def loss() -> torch.Tensor:
        pose = equilibrium(*groups, tolerance=1e-13)
        value: torch.Tensor = (pose.node_x * w).sum() + (pose.cable_tension * w_tension).sum()
        value = value + (pose.cavity_pressure * w_pressure).sum()
        return value + (pose.marker_x * w_marker).sum()

    loss().backward()
    wrong = []
    for group in groups:
        for name, leaf in group.items():
            size = STEPS[name] * (leaf.detach().abs() if name == "law_parameter" else 1.0)
            change = size * torch.randn_like(leaf)
            values = []
            with torch.no_grad():
                for factor in (1.0, -1.0, 2.0, -2.0):
                    leaf += factor * change
                    values.append(float(loss()))
                    leaf -= factor * change
            expected = (8.0 * (values[0] - values[1]) - (values[2] - values[3])) / 12.0
            derivative = float((leaf.grad * change).sum())
            scale = float((leaf.grad * change).abs().sum())
            if not abs(derivative - expected) <= 1e-6 * max(abs(expected), 0.1 * scale):
                wrong.append(f"{name}: {derivative:.9e} instead of {expected:.9e}")
    assert not wrong, wrong
    assert groups[0]["cable_displacement"].grad[0, 0] != 0.0
    assert groups[0]["cable_displacement"].grad[0, 2] == 0.0  # slack
    assert groups[0]["cable_tension"].grad[0, 1] != 0.0
    if chamber is not None:
        assert groups[0][f"cavity_{chamber}"].grad[0, 0] != 0.0


def test_world_of_a_batch_and_the_simulation_stay_as_they_are() -> None:
    """Worlds with other moduli have the gradients that each has alone, bit for bit; the simulation is left alone."""
    youngs = torch.tensor([[0.8e5], [1e5], [1.3e5]], dtype=torch.float64)
    sims = [beam(num_worlds=count, solver_path="scalar") for count in (3, 1)]
    before = sims[0].snapshot()

    def gradient(sim: sw.Simulation, value: torch.Tensor) -> torch.Tensor:
        leaf = value.clone().requires_grad_()
        Equilibrium(sim)(parameters={"youngs": leaf}, tolerance=1e-10).marker_x[..., 2].sum().backward()
        assert leaf.grad is not None
        return leaf.grad

    together = gradient(sims[0], youngs)
    assert all(torch.equal(value, before.arrays[name]) for name, value in sims[0].snapshot().arrays.items())
    for world in range(3):
        assert torch.equal(gradient(sims[1], youngs[world : world + 1])[0], together[world])


@pytest.mark.parametrize(
    ("law", "chamber"), [("nh_log", "pressure"), *(pytest.param(*k, marks=pytest.mark.slow) for k in KINDS)]
)
def test_from_the_last_pose(law: str, chamber: str | None) -> None:
    """Poses and gradients from the pose before are those from rest, also where a world has to be led there."""
    sims = [beam(law, 2, chamber=chamber) for _ in range(2)]
    warm, cold = Equilibrium(sims[0], warm=True), Equilibrium(sims[1])
    led = []
    follow = sims[0].follow_static
    sims[0].follow_static = lambda **limits: led.append(1) or follow(**limits)  # type: ignore[method-assign]
    for modulus in (1e5, 1.05e5, 1.03e5, 3e5, 2.9e5, 2.85e5):
        youngs = torch.tensor([[modulus], [1.1 * modulus]], dtype=torch.float64, requires_grad=True)
        found = []
        for equilibrium, tolerance in ((warm, 1e-11), (cold, 1e-13)):
            pose = equilibrium(parameters={"youngs": youngs}, tolerance=tolerance)
            x, force = pose.marker_x[..., 2].sum(), pose.cavity_pressure.sum() + pose.cable_tension.sum()
            slopes = [torch.autograd.grad(part, youngs, retain_graph=True)[0] for part in (x, force)]
            found.append((pose.node_x.detach(), pose.cable_tension.detach(), *slopes))
        for ours, theirs in zip(*found, strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-7, atol=1e-10 * float(theirs.abs().max()) + 1e-12)
    assert len(led) <= 3  # at the start, and after the leap


@pytest.mark.parametrize("path", ["lanes", "scalar"])
def test_worlds_at_rest_from_the_last_pose(path: str) -> None:
    """Worlds of a pack go their own ways: in float32, with unequal moduli, as from rest; to rounding."""
    sims = [beam("nh_log", 5, chamber="pressure", precision="float32", solver_path=path) for _ in range(2)]
    warm, cold = Equilibrium(sims[0], warm=True), Equilibrium(sims[1])
    for factor in (1.0, 1.1, 1.05):
        youngs = factor * torch.tensor([[0.8e5], [1e5], [1.3e5], [1e5], [2e5]])
        poses = [equilibrium(parameters={"youngs": youngs}) for equilibrium in (warm, cold)]
        torch.testing.assert_close(poses[0].node_x, poses[1].node_x, rtol=0.0, atol=2e-5)


def test_refusals() -> None:
    """What does not come to rest, and what an equilibrium does not depend on."""
    sim = beam()
    with pytest.raises(RuntimeError, match="did not come to rest"):
        Equilibrium(sim)(max_iterations=1)
    with pytest.raises(ValueError, match="'rayleigh_mass' has no gradient"):
        Equilibrium(sim)(parameters={"rayleigh_mass": torch.ones(1)})
