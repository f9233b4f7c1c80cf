"""Cables whose points meet: a segment below its closing length pulls in proportion to it (docs/theory/cable.md)."""

import itertools
from typing import Literal

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.envs.scenes.trunk import TrunkSceneConfig, build_trunk_scene

GRAVITY = 9.81  # m/s^2
CLOSING = 0.02  # m
# Shortening of the trunk's cables [m], all of them taut: short segments on the inside have little left of 6 mm.
CRUSHING = (0.00932, 0.02096, 0.04001, 0.02721, 0.02087, 0.00812, 0.00595, 0.0186)


def lifted(control: Literal["length", "force"]) -> sw.Simulation:
    """A cube of 0.1 kg that a cable lifts towards an anchor 10 cm above it."""
    mesh = meshing.box((0.02, 0.02, 0.02), (1, 1, 1))
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    body = builder.add_tets(mesh, material=sw.Corotational(1.0e5, 0.3), total_mass=0.1, rayleigh=(5.0, 0.01))
    centre = np.array([[0.01, 0.01, 0.01]])
    builder.add_cable(body, centre, (0.01, 0.01, 0.11), control=control, closing_length=CLOSING)
    return sw.Simulation(builder.finalize(precision="float64"), dt=0.005)


@pytest.mark.slow
@pytest.mark.parametrize("weights", [1.25, 2.0, 5.0])
def test_lifted_mass_hangs_where_the_shortened_pull_carries_it(weights: float) -> None:
    """T l / c = m g: it hangs c m g / T below the anchor. The length that counts there is (l^2 / c + c) / 2."""
    sim = lifted("force")
    sim.control.cable_tension.fill_(weights * 0.1 * GRAVITY)
    sim.step(3000)
    way = CLOSING / weights
    length = sim.cable_x[0, 0] - sim.cable_x[0, 1]
    np.testing.assert_allclose(length.numpy(), [0.0, 0.0, way], atol=1e-8)
    assert float(sim.cable_length[0, 0]) == pytest.approx(0.5 * (way**2 / CLOSING + CLOSING), abs=1e-8)
    assert float(sim.cable_displacement[0, 0] + sim.cable_length[0, 0]) == pytest.approx(0.1, rel=1e-12)


def test_length_that_is_commanded_is_the_one_that_counts() -> None:
    """Shortened to (l^2 / c + c) / 2 for l = c / 4, the mass hangs l below the anchor, on a tension of four weights."""
    sim, way = lifted("length"), CLOSING / 4.0
    shortened = 0.1 - 0.5 * (way**2 / CLOSING + CLOSING)
    for part in np.linspace(0.0, 1.0, 401)[1:]:
        sim.control.cable_displacement.fill_(part * shortened)
        sim.step()
    sim.step(1600)
    assert float(sim.cable_displacement[0, 0]) == pytest.approx(shortened, abs=1e-8)
    assert float(sim.cable_x[0, 0, 2] - sim.cable_x[0, 1, 2]) == pytest.approx(way, abs=1e-7)
    assert float(sim.cable_tension[0, 0]) == pytest.approx(4.0 * 0.1 * GRAVITY, rel=1e-5)


def trunk(closing_length: float) -> sw.Simulation:
    """The trunk of the task under lengths that crush it on one side, after six seconds."""
    builder = sw.ModelBuilder(gravity=(0.0, -GRAVITY, 0.0))
    build_trunk_scene(TrunkSceneConfig(closing_length=closing_length), builder)
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01)
    for part in np.linspace(0.0, 1.0, 201)[1:]:
        sim.control.cable_displacement.copy_(torch.tensor([CRUSHING]) * part)
        sim.step()
    sim.step(400)
    return sim


@pytest.mark.slow
@pytest.mark.parametrize(("closing_length", "fewest", "most"), [(0.0, 4, 64), (0.001, 0, 0)])
def test_random_commands_are_held_at_rest(
    closing_length: float, fewest: int, most: int, rng: np.random.Generator
) -> None:
    """Bends of up to 4 cm, held for five seconds: how many of 64 worlds change a tension by 0.1 N in a step.

    Without a closing length 7 or 8 do, by rounding; with one, none.
    """
    sides = np.array([(0.0, 1.0), (-1.0, 0.0), (0.0, -1.0), (1.0, 0.0)])
    angle, amplitude = rng.uniform(0.0, 2.0 * np.pi, (64, 2)), rng.uniform(0.0, 1.0, (64, 2)) * (0.042, 0.020)
    bends = [
        (a[:, None] * np.stack([np.cos(b), np.sin(b)], 1)) @ sides.T for a, b in zip(amplitude.T, angle.T, strict=True)
    ]
    command = torch.from_numpy(np.concatenate(bends, axis=1)).float()
    builder = sw.ModelBuilder(gravity=(0.0, -GRAVITY, 0.0))
    build_trunk_scene(TrunkSceneConfig(closing_length=closing_length), builder)
    sim = sw.Simulation(builder.finalize(num_worlds=64), dt=0.01)
    for part in np.linspace(0.0, 1.0, 101)[1:]:
        sim.control.cable_displacement.copy_(command * part)
        sim.step()
    sim.step(500)
    before = sim.cable_tension.clone()
    sim.step()
    jumps = (sim.cable_tension - before).abs().amax(dim=1)
    assert fewest <= int((jumps > 0.1).sum()) <= most


def shortest_segment(sim: sw.Simulation) -> float:
    """Of all cables [m]."""
    points, starts = sim.cable_x[0].numpy(), sim.model.cable_starts
    paths = [points[a:b] for a, b in itertools.pairwise(starts)]
    return min(float(np.linalg.norm(np.diff(path, axis=0), axis=1).min()) for path in paths)


def test_crushed_trunk_comes_to_rest() -> None:
    """Without a closing length tensions chatter by newtons from step to step, at steps of 1 ms as at 10 ms."""
    sim = trunk(TrunkSceneConfig().closing_length)
    assert shortest_segment(sim) < TrunkSceneConfig().closing_length
    before = sim.cable_tension.clone()
    sim.step()
    assert float((sim.cable_tension - before).abs().max()) < 0.01  # N, of 3 N
    assert float(sim.node_v.abs().max()) < 0.01  # m/s
    chattering = trunk(0.0)
    before = chattering.cable_tension.clone()
    chattering.step()
    assert float((chattering.cable_tension - before).abs().max()) > 0.3


def test_mistakes_are_named() -> None:
    builder = sw.ModelBuilder()
    body = builder.add_tets(
        meshing.box((0.1, 0.02, 0.02), (5, 1, 1)), material=sw.Corotational(1e5, 0.3), total_mass=1.0
    )
    path = [(0.0, 0.01, 0.01), (0.06, 0.01, 0.01), (0.09, 0.01, 0.01)]
    below = r"at least 0 and below its shortest .* 0\.03 m, got 0.03"
    for wrong, told in (
        (-1e-3, "at least 0 and finite, got -0.001"),
        (0.03, below),
        (float("nan"), "at least 0 and finite, got nan"),
    ):
        with pytest.raises(ValueError, match=f"tendon: closing_length must be {told}"):
            builder.add_cable(body, path, closing_length=wrong, name="tendon")
    builder.add_cable(body, path, closing_length=0.029)


def test_scenes_that_differ_in_it_do_not_share_snapshots() -> None:
    models = []
    for closing in (0.0, 0.003):
        builder = sw.ModelBuilder()
        build_trunk_scene(TrunkSceneConfig(mesh="coarse", closing_length=closing), builder)
        models.append(builder.finalize())
    start = sw.Simulation(models[0]).snapshot()
    with pytest.raises(ValueError, match="another scene"):
        sw.Simulation(models[1]).restore(start)
