"""Rods, rigid bodies, chambers, membranes and contact on a GPU: the CPU's motion, and the batch contract to the bit."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.solvers.options import Integrator

INTEGRATORS = pytest.mark.parametrize("integrator", ["euler", "bdf2"])
N = 70  # more than two warps, and not a multiple of one


def everything(
    num_worlds: int, device: str, precision: str = "float32", integrator: Integrator = "euler"
) -> sw.Simulation:
    """A pressurised finger that rests on a cube, a driven rod with a tip mass over a ball, and a floor under all."""
    builder = sw.ModelBuilder()
    floor = builder.add_rigid(sw.Plane(), kinematic=True, pose=(0.0, 0.0, -0.06))
    mesh = meshing.box((0.12, 0.03, 0.03), (8, 2, 2))
    finger = builder.add_tets(mesh, material=sw.NeoHookean(2e5, 0.4), density=1000.0, rayleigh=(0.5, 0.005))
    holder = builder.add_rigid(sw.Box((0.02, 0.03, 0.03)), kinematic=True, pose=(-0.01, 0.015, 0.015))
    builder.attach(finger, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)), to=holder)
    skin = meshing.box((0.08, 0.01, 0.01), (2, 1, 1))
    builder.add_cavity(finger, skin.nodes + (0.02, 0.01, 0.017), skin.surface(), max_pressure=2e4)
    bottom = [t for t in mesh.surface() if (mesh.nodes[t][:, 2] < 1e-9).all()]
    builder.add_membrane(finger, bottom, thickness=5e-4, youngs=2e6, nu=0.4)
    cube = builder.add_rigid(sw.Box((0.03, 0.03, 0.03)), density=800.0, pose=(0.1, 0.015, -0.045))
    ball = builder.add_rigid(sw.Sphere(0.015), density=1500.0, pose=(0.0, 0.1, -0.044))
    base = builder.add_rigid(kinematic=True, pose=(0.0, 0.1, 0.1))
    points = np.linspace((0.0, 0.1, 0.1), (0.0, 0.1, 0.0), 9)
    rod = builder.add_rod(points, radius=0.003, youngs=1e6, nu=0.4, density=1100.0, rayleigh=(0.1, 0.002))
    builder.attach(rod, nodes=[0], to=base)
    tip = builder.add_rigid(sw.Capsule(0.006, 0.01), mass=0.01, pose=(0.0, 0.1, 0.0))
    builder.attach(tip, to=rod, node=-1)
    builder.add_marker(rod, (0.0, 0.1, 0.0))
    for a, b in ((finger, cube), (cube, floor), (ball, floor), (ball, tip), (ball, rod), (finger, floor)):
        builder.add_contact(a, b, mu=0.4)
    return sw.Simulation(builder.finalize(num_worlds, device, precision), dt=0.01, integrator=integrator)


def command(sim: sw.Simulation, identity: list[int], step: int) -> None:
    """Individual ``identity[i]`` drives world i."""
    phase = torch.tensor(identity, dtype=sim.time.dtype, device=sim.time.device)
    sim.control.cavity_pressure[:, 0] = 8e3 * (1.0 + torch.sin(phase + 0.1 * step))
    sim.control.body_velocity[:, 3, 0] = 0.1 * torch.cos(phase)
    sim.control.body_velocity[:, 3, 4] = torch.sin(phase)


def outputs(sim: sw.Simulation, world: int) -> Iterator[torch.Tensor]:
    for name in ("node_x", "node_v", "frame_pose", "frame_twist", "cavity_volume", "contact_load", "marker_x"):
        yield getattr(sim, name)[world].cpu().clone()


@pytest.mark.cuda
@INTEGRATORS
def test_motion_is_that_of_the_cpu(integrator):
    gpu, cpu = everything(3, "cuda:0", integrator=integrator), everything(3, "cpu", "float64", integrator)
    for step in range(20):
        for sim in (gpu, cpu):
            command(sim, [0, 1, 2], step)
            sim.step()
    assert (gpu.status == 0).all() and (cpu.status == 0).all()
    for world in range(3):
        np.testing.assert_allclose(gpu.node_x[world].cpu(), cpu.node_x[world], atol=2e-5)
        np.testing.assert_allclose(gpu.frame_pose[world].cpu(), cpu.frame_pose[world], atol=1e-4)
        np.testing.assert_allclose(gpu.cavity_volume[world].cpu(), cpu.cavity_volume[world], rtol=1e-3)


@INTEGRATORS
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.cuda)])
def test_world_of_a_batch_equals_it_in_another(device, integrator):
    count = N if device != "cpu" else 17
    large, small = (everything(worlds, device, integrator=integrator) for worlds in (count, 9))
    chosen = [3, count - 1, 11, 7, 0, 5, 9, 2, 1]
    for step in range(30):
        command(large, list(range(count)), step)
        command(small, chosen, step)
        large.step()
        small.step()
    for place, identity in enumerate(chosen):
        for one, other in zip(outputs(small, place), outputs(large, identity), strict=True):
            assert torch.equal(one, other)
    assert (large.contact_count > 0).all()


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.cuda)])
def test_snapshot_continues_to_the_bit(device):
    sim = everything(9, device)
    for step in range(15):
        command(sim, list(range(9)), step)
        sim.step()
    saved = sim.snapshot()

    def run() -> list[torch.Tensor]:
        for step in range(15, 25):
            command(sim, list(range(9)), step)
            sim.step()
        return [value for world in range(9) for value in outputs(sim, world)]

    first = run()
    sim.restore(saved)
    assert all(torch.equal(one, other) for one, other in zip(first, run(), strict=True))
