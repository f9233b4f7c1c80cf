"""Worlds with air chambers and membranes: batch, place, threads, snapshots, resets, failures, workspace. All in bits.

Worlds differ in moduli, gas exponents, limits and commands. A finger has a chamber at a pressure with a rate limit and
one with gas, off its nodes, and a stiff skin on top; a second block has a chamber with a commanded volume.
"""

from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

import softwarp as sw
from softwarp import meshing
from softwarp.model.cavities import CavityModel, MembraneModel
from tests.contract.batch_checks import Play, assert_same
from tests.contract.test_batch import KEPT, constants, held_arrays

PATHS = [
    pytest.param({"solver_path": "scalar"}, "float32", "cpu", id="scalar"),
    pytest.param({"solver_path": "lanes"}, "float32", "cpu", id="lanes"),
    pytest.param({"solver_path": "scalar"}, "float64", "cpu", id="float64", marks=pytest.mark.slow),
    pytest.param({"solver_path": "lanes", "pressure_tangent": True}, "float32", "cpu", id="lanes, tangent"),
    pytest.param(
        {"solver_path": "lanes", "newton_iterations": 4}, "float32", "cpu", id="lanes, Newton", marks=pytest.mark.slow
    ),
    pytest.param({}, "float32", "cuda:0", id="cuda", marks=pytest.mark.cuda),
]
each_path = pytest.mark.parametrize(("options", "precision", "device"), PATHS)
DRIVEN, SEALED, PUMPED = range(3)
GOOD = (sw.Status.OK, sw.Status.MAX_ITERATIONS)


def build(
    num_worlds: int, options: dict[str, Any], precision: str = "float32", device: str = "cpu", dt: float = 0.01
) -> sw.Simulation:
    """The scene of the module docstring."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    mesh = meshing.box((0.06, 0.02, 0.02), (6, 3, 3))
    finger = builder.add_tets(mesh, material=sw.NeoHookean(1e5, 0.4), density=1000.0, rayleigh=(0.5, 0.01))
    builder.fix(finger, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    skin = meshing.box((0.02, 0.01, 0.006), (2, 1, 1))
    builder.add_cavity(finger, skin.nodes + (0.008, 0.005, 0.009), skin.surface(), max_pressure_rate=4e5)
    builder.add_cavity(finger, skin.nodes + (0.032, 0.005, 0.009), skin.surface(), control="gas", exponent=1.4)
    top = mesh.surface()
    top = top[(mesh.nodes[top][:, :, 2] > 0.0199).all(axis=1)]
    builder.add_membrane(finger, top, thickness=1e-4, youngs=1e6)
    block = meshing.box((0.02, 0.02, 0.02), (2, 2, 2))
    block = meshing.TetMesh(block.nodes + (0.0, 0.05, 0.0), block.tets, "block")
    pump = builder.add_tets(block, material=sw.StableNeoHookean(8e4, 0.45), density=1000.0, rayleigh=(0.5, 0.01))
    builder.fix(pump, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    inner = meshing.box((0.01, 0.01, 0.01), (1, 1, 1))
    builder.add_cavity(
        pump, inner.nodes + (0.005, 0.055, 0.005), inner.surface(), control="volume", max_pressure=2e4, max_flow=2e-5
    )
    return sw.Simulation(builder.finalize(num_worlds=num_worlds, device=device, precision=precision), dt=dt, **options)


def characterise(sim: sw.Simulation, identity: list[int]) -> None:
    """Give world i of ``sim`` the parameters of individual ``identity[i]``."""
    factors = np.array([np.random.default_rng(200 + i).uniform(0.7, 1.3, 4) for i in identity])
    names = ("youngs", "membrane_youngs", "cavity_exponent", "cavity_max_pressure_rate")
    for name, column in zip(names, factors.T, strict=True):
        view = getattr(sim.params, name)
        view.mul_(torch.as_tensor(column, device=view.device).to(view.dtype)[:, None])


def command(sim: sw.Simulation, identity: list[int], step: int) -> None:
    """Smooth commands that differ between individuals."""
    phase = np.array(identity, dtype=float)
    c = sim.control
    c.cavity_pressure[:, DRIVEN] = torch.as_tensor(8e3 * np.sin(0.4 * phase + 0.2 * step)).to(c.cavity_pressure)
    c.cavity_gas[:, SEALED] = torch.as_tensor(1.2e-6 * (1.2 + np.cos(phase + 0.15 * step))).to(c.cavity_gas)
    c.cavity_volume[:, PUMPED] = torch.as_tensor(1e-6 * (1.1 + 0.2 * np.sin(phase - 0.3 * step))).to(c.cavity_volume)


def run(sim: sw.Simulation, identity: list[int], steps: int, start: int = 0) -> None:
    for step in range(start, start + steps):
        command(sim, identity, step)
        sim.step()


def state(sim: sw.Simulation) -> dict[str, torch.Tensor]:
    """Copies of everything a user sees of the worlds."""
    names = ("node_x", "node_v", "cavity_pressure", "cavity_volume", "status", "time")
    return {name: getattr(sim, name).clone() for name in names}


PLAY = Play(build, characterise, run, state)


@pytest.mark.parametrize(
    ("options", "precision", "device"),
    [pytest.param(*PATHS[0].values, id="scalar", marks=pytest.mark.slow), *PATHS[1:]],
)
def test_world_does_not_depend_on_its_batch(options: dict[str, Any], precision: str, device: str) -> None:
    """Individual 17 of 20 is the same alone, and at other places of batches of 3 and 9, after 30 steps."""
    everyone = list(range(20))
    sim = build(20, options, precision, device)
    characterise(sim, everyone)
    run(sim, everyone, 30)
    reference = state(sim)
    assert all(status in GOOD for status in reference["status"].flatten().tolist())
    assert float((reference["cavity_volume"].std(dim=0) / reference["cavity_volume"].mean(dim=0)).min()) > 1e-3
    for identity in ([17], [11, 17, 3], [9, 8, 7, 19, 17, 0, 17, 1, 2]):
        small = build(len(identity), options, precision, device)
        characterise(small, identity)
        run(small, identity, 30)
        assert_same(reference, state(small), identity, list(range(len(identity))))


@pytest.mark.parametrize("iterations", [1, pytest.param(6, marks=pytest.mark.slow)])
def test_paths_agree(iterations: int) -> None:
    """Scalar and lane kernels give positions and volumes of float64 to the rounding of float32."""
    identity = list(range(9))
    runs = []
    for path, precision in (("scalar", "float64"), ("scalar", "float32"), ("lanes", "float32")):
        options = {"solver_path": path, "newton_iterations": iterations, "newton_tolerance": 1e-6}
        sim = build(9, options, precision)
        characterise(sim, identity)
        run(sim, identity, 20)
        runs.append({name: value.double() for name, value in state(sim).items()})
    for other in runs[1:]:
        assert float((other["node_x"] - runs[0]["node_x"]).abs().max()) < 3e-6
        assert float((other["cavity_volume"] / runs[0]["cavity_volume"] - 1.0).abs().max()) < 5e-4
        assert float((other["cavity_pressure"] - runs[0]["cavity_pressure"]).abs().max()) < 50.0


@pytest.mark.parametrize("path", ["scalar", "lanes"])
def test_threads_do_not_matter(path: str) -> None:
    """Worlds spread over other numbers of threads give the same bits."""
    PLAY.check_threads(path, 10)


@each_path
def test_snapshot_continues_to_the_bit(options: dict[str, Any], precision: str, device: str) -> None:
    """Save, go on, restore, go on again: the same; also from one world into another place of another batch."""
    PLAY.check_snapshot(options, precision, device, 10)


@each_path
def test_reset_touches_masked_worlds_only(options: dict[str, Any], precision: str, device: str) -> None:
    """Worlds that are reset start over, to the bit, with the volume at rest; the others do not notice."""
    PLAY.check_reset(options, precision, device, 8)
    sim = build(2, options, precision, device)
    rest = sim.cavity_volume.clone()
    characterise(sim, [0, 1])
    run(sim, [0, 1], 8)
    assert not torch.equal(sim.cavity_volume[1], rest[1])
    sim.reset(torch.tensor([False, True], device=sim.status.device))
    assert torch.equal(sim.cavity_volume[1], rest[1]) and not sim.cavity_pressure[1].any()


POISON = {
    "pressure": lambda sim: sim.control.cavity_pressure[1, DRIVEN].fill_(np.nan),
    "gas": lambda sim: sim.control.cavity_gas[1, SEALED].fill_(np.inf),
    "volume": lambda sim: sim.control.cavity_volume[1, PUMPED].fill_(np.nan),
    "warm start": lambda sim: sim.cavity_pressure[1, SEALED].fill_(np.nan),
    "modulus": lambda sim: sim.params.membrane_youngs[1].fill_(np.nan),
}


@pytest.mark.parametrize(
    ("path", "iterations", "poison"),
    [
        pytest.param(path, n, key, marks=() if key == "gas" or (path, n) == ("lanes", 1) else pytest.mark.slow)
        for path in ("scalar", "lanes")
        for n in (1, 4)
        for key in POISON
    ],
)
def test_failed_world_is_rolled_back_and_isolated(path: str, iterations: int, poison: str) -> None:
    """A world with a NaN reports NONFINITE and keeps its last good state; its neighbours keep their bits."""
    options = {"solver_path": path, "newton_iterations": iterations}
    kept = ("node_x", "node_v", "cavity_volume", "time")
    PLAY.check_poisoned(options, POISON[poison], 4, kept, finite=("cavity_pressure",))


def test_failed_step_after_settling_comes_back_to_rest() -> None:
    """Settling drops velocities for good: a world whose velocities are then lost is rolled back to none."""
    sim = build(1, {})
    run(sim, [0], 4)
    assert float(sim.node_v.abs().max()) > 1e-3
    sim.solve_static(max_iterations=4)
    sim.node_v[0, -1] = np.nan
    sim.step()
    assert int(sim.status[0]) == sw.Status.NONFINITE
    assert not sim.node_v.any()


@each_path
def test_workspace_content_does_not_matter(options: dict[str, Any], precision: str, device: str) -> None:
    """Steps rebuild the workspace: filling it with NaN before each of them changes no bit."""
    identity = list(range(5))
    clean, dirty = (build(5, options, precision, device) for _ in range(2))
    for sim in (clean, dirty):
        characterise(sim, identity)
        run(sim, identity, 2)
    for step in (2, 3, 4):
        pairs = list(held_arrays(dirty, dirty, set()))
        kept = {array.ptr for holder, array in pairs if isinstance(holder, (*KEPT, CavityModel, MembraneModel))}
        kept |= {array.ptr for system in dirty._systems for array in constants(system.work)}
        tensors = [wp.to_torch(array) for _, array in pairs if array.ptr not in kept and array.size]
        floats = [tensor for tensor in tensors if tensor.is_floating_point()]
        assert len(floats) > 30
        for tensor in floats:
            tensor.fill_(float("nan"))
        run(clean, identity, 1, start=step)
        run(dirty, identity, 1, start=step)
        assert_same(state(clean), state(dirty), identity, identity)
