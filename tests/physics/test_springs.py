"""Springs and elastic cables against closed forms: force laws, oscillation, decay, statics; carried pull points."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.control import InverseController

MASS, K, C, G = 0.4, 250.0, 3.0, 9.81
PATHS = [("float32", "scalar"), ("float32", "lanes"), ("float64", "scalar")]


def hanging(worlds: int = 1, precision: str = "float64", path: str = "auto", dt: float = 1e-3, **spring: Any) -> Any:
    """A ball on a spring below a fixed post, free along z only."""
    builder = sw.ModelBuilder()
    post = builder.add_rigid(sw.Box((0.01, 0.01, 0.01)), kinematic=True, pose=(0.0, 0.0, 0.5))
    ball = builder.add_rigid(sw.Sphere(0.02), mass=MASS, pose=(0.0, 0.0, 0.2), free_axes="z")
    options: dict[str, Any] = {"stiffness": K, **spring}
    number = builder.add_spring(post, ball, [(0.0, 0.0, 0.5), (0.0, 0.0, 0.2)], **options)
    model = builder.finalize(worlds, precision=precision)
    return sw.Simulation(model, dt, solver_path=path), ball, number


@pytest.mark.parametrize(("precision", "path"), PATHS)
def test_weight_on_a_spring(precision: str, path: str) -> None:
    """It sinks by m g / k, whatever the damping; the force is the weight; stiffness differs between worlds."""
    sim, ball, number = hanging(5, precision, path, dt=0.01, damping=20.0)
    sim.params.cable_stiffness[3] *= 2.0
    for _ in range(600):
        sim.step()
    sag = 0.2 - sim.body_pose[:, ball, 2].double()
    stiffness = torch.tensor([K, K, K, 2 * K, K], dtype=torch.float64)
    np.testing.assert_allclose(sag, MASS * G / stiffness, rtol=2e-5)
    np.testing.assert_allclose(sim.cable_tension[:, number], MASS * G, rtol=2e-5)


def test_oscillation_and_decay() -> None:
    """Frequency sqrt(k/m - (c/2m)^2) and rate c / 2m, to first order in the step."""
    sim, ball, _ = hanging(dt=1e-4, damping=C)
    heights = []
    for _ in range(12000):
        sim.step()
        heights.append(float(sim.body_pose[0, ball, 2]))
    motion = np.array(heights) - (0.2 - MASS * G / K)
    crossings = np.flatnonzero(np.diff(np.sign(motion)))
    omega = math.sqrt(K / MASS - (C / (2 * MASS)) ** 2)
    np.testing.assert_allclose(np.diff(crossings) * 1e-4, math.pi / omega, rtol=5e-3)
    peaks = [np.abs(motion[i:j]).max() for i, j in itertools.pairwise(crossings)]
    decay = -np.log(peaks[4] / peaks[0]) / (4 * math.pi / omega)
    h_error = 0.5 * 1e-4 * K / MASS  # damping of backward Euler
    np.testing.assert_allclose(decay, C / (2 * MASS) + h_error, rtol=0.01)


def test_rest_length_pushes_and_a_band_only_pulls() -> None:
    """A spring longer than its place pushes with k times the difference; a rubber band is slack there."""
    push, ball, number = hanging(dt=0.01, rest_length=0.35, damping=30.0)
    band, fallen, slack = hanging(dt=0.01, rest_length=0.35, damping=30.0, only_pulls=True)
    push.step()
    band.step()
    assert float(push.cable_tension[0, number]) < 0.0 == float(band.cable_tension[0, slack])
    for sim, body in ((push, ball), (band, fallen)):
        for _ in range(1500):
            sim.step()
        np.testing.assert_allclose(0.5 - sim.body_pose[0, body, 2], 0.35 + MASS * G / K, rtol=1e-6)


def test_spring_between_soft_points_conserves_momentum_and_statics_know_it() -> None:
    """Two soft cubes pulled together: no net momentum; statics end where time does."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    law = {"material": sw.Corotational(1e5, 0.3, method="large"), "density": 1000.0, "rayleigh": (0.0, 0.02)}
    cube = meshing.box((0.04, 0.04, 0.04), (2, 2, 2))
    left = builder.add_tets(cube, **law)
    right = builder.add_tets(meshing.TetMesh(cube.nodes + (0.1, 0.0, 0.0), cube.tets), **law)
    ends = [(0.03, 0.015, 0.02), (0.11, 0.025, 0.02)]
    builder.add_spring(left, right, ends, stiffness=40.0, rest_length=0.06)
    held = builder.finalize(precision="float64")
    sim = sw.Simulation(held, 0.002)
    for _ in range(50):
        sim.step()
    assert float(sim.kinetic_energy()) > 1e-6
    np.testing.assert_allclose(sim.momentum()[0], 0.0, atol=1e-12)
    for body in (left, right):
        builder.fix(body, box=((-1, -1, -1), (1e-6, 1, 1)) if body == left else ((0.14 - 1e-6, -1, -1), (1, 1, 1)))
    stepped = sw.Simulation(builder.finalize(precision="float64"), 0.02, newton_iterations=5)
    still = sw.Simulation(builder.finalize(precision="float64"), 0.02, newton_iterations=5)
    for _ in range(800):
        stepped.step()
    assert bool(still.solve_static().converged.all())
    np.testing.assert_allclose(still.node_x, stepped.node_x, atol=1e-7)
    stretch = 0.06 - (float(stepped.cable_length[0, 0]))
    np.testing.assert_allclose(stepped.cable_tension[0, 0], -40.0 * stretch, rtol=1e-9)


def test_elastic_cable_gives_way() -> None:
    """T = k (commanded less measured displacement); a stiffness of 1e30 is that of a cable that does not stretch."""
    tensions, ways = [], []
    for stiffness in (math.inf, 1e29, 500.0):
        builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        mesh = meshing.box((0.1, 0.02, 0.02), (8, 2, 2))
        beam = builder.add_tets(
            mesh, material=sw.Corotational(1e5, 0.4, method="large"), density=1000.0, rayleigh=(1.0, 0.02)
        )
        builder.fix(beam, box=((-1, -1, -1), (1e-6, 1, 1)))
        builder.add_cable(beam, [(0.0, 0.01, 0.018), (0.1, 0.01, 0.018)], stiffness=stiffness)
        sim = sw.Simulation(builder.finalize(precision="float64"), 0.01)
        sim.control.cable_displacement[:] = 0.004
        for _ in range(300):
            sim.step()
        tensions.append(float(sim.cable_tension[0, 0]))
        ways.append(float(sim.cable_displacement[0, 0]))
    np.testing.assert_allclose(tensions[1], tensions[0], rtol=1e-9)
    np.testing.assert_allclose(ways[:2], 0.004, rtol=1e-9)
    np.testing.assert_allclose(tensions[2], 500.0 * (0.004 - ways[2]), rtol=1e-9)
    assert tensions[2] < 0.9 * tensions[0]


def test_pull_point_on_a_wrist_moves_with_it() -> None:
    """``pull_on`` is the waypoint on that body that ``body=[wrist, ...]`` gives: same bits, and it moves along."""
    ends = []
    for named in (True, False):
        builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        wrist = builder.add_rigid(sw.Box((0.02, 0.02, 0.02)), kinematic=True, pose=(-0.03, 0.01, 0.01))
        finger = builder.add_tets(
            meshing.box((0.1, 0.02, 0.02), (6, 2, 2)),
            material=sw.Corotational(1e5, 0.4, method="large"),
            density=1000.0,
        )
        builder.attach(finger, to=wrist, box=((-1, -1, -1), (1e-6, 1, 1)))
        inner = [(0.01, 0.01, 0.018), (0.09, 0.01, 0.018)]
        start = (-0.02, 0.01, 0.018)
        if named:
            builder.add_cable(finger, inner, start, pull_on=wrist, max_displacement=0.01)
        else:
            builder.add_cable([wrist, finger, finger], [start, *inner], max_displacement=0.01)
        sim = sw.Simulation(builder.finalize(), 0.01)
        sim.control.cable_displacement[:] = 0.003
        sim.control.body_velocity[0, wrist, 1] = 0.05
        for _ in range(40):
            sim.step()
        ends.append(sim.node_x.clone())
        np.testing.assert_allclose(sim.cable_x[0, 0], np.array(start) + (0.0, 0.02, 0.0), atol=1e-6)
    assert torch.equal(*ends)


def test_snapshot_and_batch() -> None:
    """World i of a batch equals that world alone, and a restored one goes on with the same bits."""
    batch, ball, _ = hanging(9, "float32", "lanes", dt=0.01, damping=C)
    alone, _, _ = hanging(1, "float32", "lanes", dt=0.01, damping=C)
    for world in range(9):
        batch.params.cable_stiffness[world] = K * (1 + world)
        batch.params.cable_damping[world] = C * world
    alone.params.cable_stiffness[:], alone.params.cable_damping[:] = K * 7, C * 6
    for sim in (batch, alone):
        for _ in range(30):
            sim.step()
    assert torch.equal(batch.body_pose[6], alone.body_pose[0])
    saved = batch.snapshot([6])
    alone.restore(saved)
    for sim in (batch, alone):
        for _ in range(30):
            sim.step()
    assert torch.equal(batch.body_pose[6, ball], alone.body_pose[0, ball])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stiffness": 0.0}, r"stiffness \[N/m\] must be"),
        ({"stiffness": math.nan}, r"stiffness \[N/m\] must be"),
        ({"stiffness": math.inf}, r"stiffness \[N/m\] must be"),
        ({"damping": -1.0}, r"damping \[N s/m\] must be"),
        ({"rest_length": -0.1}, r"rest_length \[m\] must be"),
        ({"only_pulls": 1}, "only_pulls must be True or False"),
    ],
)
def test_springs_refuse(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        hanging(**options)


def test_cables_refuse() -> None:
    builder = sw.ModelBuilder()
    ball = builder.add_rigid(sw.Sphere(0.02), mass=MASS)
    post = builder.add_rigid(sw.Sphere(0.02), kinematic=True, pose=(0.0, 0.0, 0.5))
    ends = [(0.0, 0.0, 0.5), (0.0, 0.0, 0.0)]
    with pytest.raises(ValueError, match="stiffness needs control='length'"):
        builder.add_cable([post, ball], ends, control="force", stiffness=10.0)
    with pytest.raises(ValueError, match="damping needs a stiffness"):
        builder.add_cable([post, ball], ends, damping=10.0)
    with pytest.raises(ValueError, match="pull_on needs a pull_point"):
        builder.add_cable([post, ball], ends, pull_on=post)
    with pytest.raises(ValueError, match=r"no part|does not exist|is no"):
        builder.add_cable(ball, ends[1:], ends[0], pull_on=77)
    builder.add_spring(post, ball, ends, stiffness=K)
    tip = builder.add_marker(ball, (0.0, 0.0, 0.0))
    sim = sw.Simulation(builder.finalize())
    with pytest.raises(ValueError, match="nothing to act with"):
        InverseController(sim, [tip])
    with pytest.raises(ValueError, match="'spring0' is elastic or a spring"):
        InverseController(sim, [tip], cables=[0])
