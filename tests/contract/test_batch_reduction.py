"""Worlds with a reduced body in contact: batch, place, threads, snapshots, failures, workspace. All in bits."""

from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

import softwarp as sw
from softwarp.model.cavities import CavityModel, MembraneModel
from softwarp.model.contact import ContactModel
from softwarp.model.floating import FloatingModel
from softwarp.model.frames import FrameModel
from softwarp.model.reduction import ReductionModel
from softwarp.solvers.collision.arrays import SceneArrays
from tests.contract.batch_checks import Play, assert_same
from tests.contract.test_batch import KEPT, constants, held_arrays
from tests.reduction_cases import quadratic_modes, reduced_by, scene, smooth_modes

SMOOTH = smooth_modes(held=False)
PATHS = [
    pytest.param({"solver_path": "scalar"}, "float32", "cpu", id="scalar"),
    pytest.param({"solver_path": "lanes"}, "float32", "cpu", id="lanes"),
    pytest.param(
        {"solver_path": "scalar", "integrator": "bdf2"},
        "float64",
        "cpu",
        id="float64, second order",
        marks=pytest.mark.slow,
    ),
    pytest.param({"solver_path": "scalar", "frame": "floating"}, "float32", "cpu", id="scalar, floating"),
    pytest.param({"solver_path": "lanes", "frame": "floating"}, "float32", "cpu", id="lanes, floating"),
    pytest.param({"frame": "floating"}, "float32", "cuda:0", id="cuda, floating", marks=pytest.mark.cuda),
    pytest.param({}, "float32", "cuda:0", id="cuda", marks=pytest.mark.cuda),
    pytest.param({"solver_path": "levels"}, "float32", "cuda:0", id="cuda, levels", marks=pytest.mark.cuda),
]
each_path = pytest.mark.parametrize(("options", "precision", "device"), PATHS)


def build(
    num_worlds: int, options: dict[str, Any], precision: str = "float32", device: str = "cpu", dt: float = 0.01
) -> sw.Simulation:
    """The free slab on the floor in eleven modes, or in eighteen of a floating frame."""
    builder, others = scene(held=False, contact=True), dict(options)
    is_floating = others.pop("frame", "fixed") == "floating"
    builder.reduce(0, reduced_by(quadratic_modes(), frame="floating") if is_floating else reduced_by(SMOOTH))
    sim = sw.Simulation(builder.finalize(num_worlds=num_worlds, device=device, precision=precision), dt=dt, **others)
    if is_floating:
        sim.mode_turn[:, 0] = torch.tensor([0.0, 0.0, 0.6, 0.8]).to(sim.mode_turn)
        sim.refresh()
    return sim


def characterise(sim: sw.Simulation, identity: list[int]) -> None:
    """Give world i of ``sim`` the parameters of individual ``identity[i]``."""
    factors = np.array([np.random.default_rng(300 + i).uniform(0.7, 1.3, 4) for i in identity])
    for name, column in zip(("youngs", "membrane_youngs", "density", "pair_mu"), factors.T, strict=True):
        view = getattr(sim.params, name)
        view.mul_(torch.as_tensor(column, device=view.device).to(view.dtype)[:, None])


def run(sim: sw.Simulation, identity: list[int], steps: int, start: int = 0) -> None:
    """Commands that differ between individuals."""
    phase, c = np.array(identity, dtype=float), sim.control
    rest = float(sim.model.cavities.rest_volume[0])
    for step in range(start, start + steps):
        c.cavity_volume[:, 0] = torch.as_tensor(rest * (1.2 + 0.2 * np.sin(phase + 0.3 * step))).to(c.cavity_volume)
        c.cable_displacement[:, 0] = torch.as_tensor(2e-3 * np.cos(phase - 0.2 * step)).to(c.cable_displacement)
        c.node_force[:, 5, 1] = torch.as_tensor(2e-3 * np.sin(phase + step)).to(c.node_force)
        sim.step()


def state(sim: sw.Simulation) -> dict[str, torch.Tensor]:
    """Copies of everything a user sees of the worlds."""
    names = ("node_x", "node_v", "mode_q", "mode_v", "mode_turn", "cavity_pressure", "cable_tension", "contact_count")
    return {name: getattr(sim, name).clone() for name in (*names, "marker_x", "status", "time")}


PLAY = Play(build, characterise, run, state)


@each_path
def test_world_does_not_depend_on_its_batch(options: dict[str, Any], precision: str, device: str) -> None:
    """Individual 17 of 20 is the same alone, and at other places of batches of 3 and 9, after 20 steps."""
    everyone = list(range(20))
    sim = build(20, options, precision, device)
    characterise(sim, everyone)
    run(sim, everyone, 20)
    reference = state(sim)
    assert bool((reference["status"] == sw.Status.OK).all())
    assert int(reference["contact_count"].min()) > 0
    assert float(reference["mode_q"].std(dim=0).max()) > 1e-4
    for identity in ([17], [11, 17, 3], [9, 8, 7, 19, 17, 0, 17, 1, 2]):
        small = build(len(identity), options, precision, device)
        characterise(small, identity)
        run(small, identity, 20)
        assert_same(reference, state(small), identity, list(range(len(identity))))


@pytest.mark.parametrize("path", ["scalar", "lanes"])
def test_threads_do_not_matter(path: str) -> None:
    """Worlds spread over other numbers of threads give the same bits."""
    PLAY.check_threads(path, 8)


@each_path
def test_snapshot_continues_to_the_bit(options: dict[str, Any], precision: str, device: str) -> None:
    """Save, go on, restore, go on again: the same; also from one world into another place of another batch."""
    PLAY.check_snapshot(options, precision, device, 8)


POISON = {
    "amplitude": lambda sim: sim.mode_q[1, 3].fill_(np.nan),
    "velocity": lambda sim: sim.mode_v[1, 0].fill_(np.inf),
    "volume": lambda sim: sim.control.cavity_volume[1].fill_(np.nan),
    "force": lambda sim: sim.control.node_force[1, 7].fill_(np.nan),
    "density": lambda sim: sim.params.density[1].fill_(np.nan),
    "turn": lambda sim: sim.mode_turn[1].fill_(np.nan),
}


@pytest.mark.parametrize(
    ("path", "poison"),
    [
        pytest.param(path, key, marks=() if key == "amplitude" or path == "lanes" else pytest.mark.slow)
        for path in ("scalar", "lanes")
        for key in POISON
    ],
)
def test_failed_world_is_rolled_back_and_isolated(path: str, poison: str) -> None:
    """A world with a NaN reports NONFINITE and keeps its last good state; its neighbours keep their bits."""
    options = {"solver_path": path, "frame": "floating" if poison == "turn" else "fixed"}
    kept = ("node_x", "node_v", "mode_q", "mode_v", "mode_turn", "time")
    PLAY.check_poisoned(options, POISON[poison], 4, kept)


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
        keep = (*KEPT, CavityModel, MembraneModel, ReductionModel, FloatingModel, ContactModel, FrameModel, SceneArrays)
        kept = {array.ptr for holder, array in pairs if isinstance(holder, keep)}
        kept |= {array.ptr for system in dirty._systems for array in constants(system.work)}
        tensors = [wp.to_torch(array) for _, array in pairs if array.ptr not in kept and array.size]
        floats = [tensor for tensor in tensors if tensor.is_floating_point()]
        assert len(floats) > 30
        for tensor in floats:
            tensor.fill_(float("nan"))
        run(clean, identity, 1, start=step)
        run(dirty, identity, 1, start=step)
        assert_same(state(clean), state(dirty), identity, identity)


def test_statics_find_where_reduced_bodies_rest() -> None:
    """A static solve ends where steps come to rest."""
    builder = scene(held=True, contact=False)
    builder.reduce(0, reduced_by(smooth_modes(held=True)))
    still, moving = (sw.Simulation(builder.finalize(1, precision="float64"), dt=0.05) for _ in range(2))
    assert bool(still.solve_static().converged.all())
    for _ in range(400):
        moving.step()
    torch.testing.assert_close(still.node_x, moving.node_x, rtol=0.0, atol=1e-6)
    assert not still.mode_v.any()


@each_path
def test_what_hands_write_counts_at_once(options, precision, device):
    """A step starts where amplitudes are, whoever wrote them; nodes follow, and their places by hand count for nothing.

    On a CPU a step takes the nodes' places of the last one where nothing was written: asked for here after every way
    to write amplitudes, in one world of nine.
    """
    sims = [build(9, options, precision, device) for _ in range(2)]
    kept = []

    def check() -> None:
        one, other = (sim.node_x.clone() for sim in sims)
        assert torch.equal(one, other) and bool(torch.isfinite(one).all())
        kept.append(one)

    def write(amplitude: float | torch.Tensor) -> None:
        for sim in sims:
            sim.mode_q[3, 7] = amplitude
        sims[1].refresh()  # the other one is not told

    for sim in sims:
        run(sim, list(range(9)), 3)
    check()
    before = sims[0].mode_q[3, 7].clone()
    write(float(before) + 2e-3)
    for sim in sims:
        sim.step()
    check()
    assert float((kept[1][3] - kept[0][3]).abs().max()) > 5e-4  # it was there
    now = sims[0].mode_q[3, 7].clone()
    write(float(now) - 1e-3)
    sims[0].refresh()
    write(now)  # back where the last step ended, and again only one is told
    sims[0].node_x[4] += 1e-3
    for sim in sims:
        sim.step()
    check()
