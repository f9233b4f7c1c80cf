"""Worlds with rigid bodies and rods never influence each other: batch, place, threads, snapshots, resets, failures.

Every comparison is of bits. Worlds differ in moduli, masses, gravity, damping and commands; a soft beam hangs on a
driven body, a rod with a weight on another one, two tubes slide in each other, and three bodies move freely, on rails
and about a pivot.
"""

from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from tests.contract.batch_checks import Play, assert_same

PATHS = [
    pytest.param({"solver_path": "scalar"}, "float32", "cpu", id="scalar"),
    pytest.param({"solver_path": "lanes"}, "float32", "cpu", id="lanes"),
    pytest.param({"solver_path": "scalar"}, "float64", "cpu", id="float64", marks=pytest.mark.slow),
    pytest.param(
        {"solver_path": "lanes", "newton_iterations": 4}, "float32", "cpu", id="lanes, Newton", marks=pytest.mark.slow
    ),
    pytest.param({}, "float32", "cuda:0", id="cuda", marks=pytest.mark.cuda),
]
each_path = pytest.mark.parametrize(("options", "precision", "device"), PATHS)
BASE, HOLDER, WEIGHT, STONE, CART, ARM = range(6)


def build(
    num_worlds: int, options: dict[str, Any], precision: str = "float32", device: str = "cpu", law: str = ""
) -> sw.Simulation:
    """The scene of the module docstring; with a law, which decides how Newton's method ends, without the tubes."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    base = builder.add_rigid(sw.Box((0.02, 0.04, 0.04)), kinematic=True, pose=(-0.01, 0.015, 0.015), max_speed=1.0)
    material = sw.NeoHookean(2e5, 0.4) if law == "nh_log" else sw.Corotational(2e5, 0.4, method="large")
    mesh = meshing.box((0.12, 0.03, 0.03), (4, 2, 2))
    beam = builder.add_tets(mesh, material=material, density=1000.0, rayleigh=(0.5, 0.01))
    builder.attach(beam, within=1e-6, to=base)
    holder = builder.add_rigid(kinematic=True, pose=(0.0, 0.2, 0.0))
    rod = builder.add_rod(
        meshing.straight(0.2, 8, start=(0.0, 0.2, 0.0), direction=(1.0, 0.0, 0.0)),
        radius=0.004,
        youngs=2e6,
        nu=0.4,
        density=1100.0,
        rayleigh=(0.2, 0.004),
    )
    builder.attach(rod, nodes=[0], to=holder)
    weight = builder.add_rigid(sw.Sphere(0.01), mass=0.01, pose=(0.21, 0.2, 0.005))
    builder.attach(weight, to=rod, node=-1)
    block = meshing.box((0.12, 0.03, 0.03), (1, 1, 1))
    stone = sw.shapes.Mesh(block.nodes + 0.02, block.surface())  # its origin is not its centre of mass
    builder.add_rigid(stone, density=800.0, pose=(0.0, -0.3, 0.0), velocity=(0.2, 0.0, 1.0, 4.0, -3.0, 2.0))
    builder.add_rigid(mass=0.3, inertia=(1e-3, 1e-3, 1e-3), free_axes="x", pose=(0.0, -0.5, 0.0))
    builder.add_rigid(stone, density=800.0, pose=(0.0, -0.7, 0.0), free_axes=("ry",), damping=0.3)
    inner = sw.Tube([sw.TubeSection(0.1), sw.TubeSection(0.1, (9.0, 0.0, 2.0))], radius=2e-3, youngs=2e8)
    outer = sw.Tube([sw.TubeSection(0.15, (4.0, 1.0, 0.0))], radius=3e-3, inner_radius=2e-3, youngs=2e8)
    if not law:
        builder.add_telescope(
            [inner, outer], port=(0.0, 0.5, 0.0), segments=9, lengths=(0.08, 0.05), rayleigh=(0.2, 1e-3)
        )
    return sw.Simulation(
        builder.finalize(num_worlds=num_worlds, device=device, precision=precision), dt=0.01, **options
    )


def characterise(sim: sw.Simulation, identity: list[int]) -> None:
    """Give world i of ``sim`` the parameters of individual ``identity[i]``."""
    factors = np.array([np.random.default_rng(100 + i).uniform(0.7, 1.3, 7) for i in identity])
    names = ("youngs", "rod_youngs", "body_mass", "rod_rayleigh_stiffness", "gravity", "tube_youngs", "tube_curvature")
    for name, column in zip(names, factors.T, strict=True):
        view = getattr(sim.params, name)
        view.mul_(torch.as_tensor(column, device=view.device).to(view.dtype)[:, None])


def command(sim: sw.Simulation, identity: list[int], step: int) -> None:
    """Smooth commands that differ between individuals."""
    phase = np.array(identity, dtype=float)
    spin = torch.as_tensor(np.sin(0.3 * phase + 0.1 * step))
    sim.control.body_velocity[:, BASE, 4] = spin.to(sim.control.body_velocity)
    place = torch.as_tensor(0.02 * np.sin(phase + 0.2 * step))
    sim.control.body_pose[:, HOLDER, 2] = place.to(sim.control.body_pose)
    reach = torch.as_tensor(0.08 + 0.06 * np.sin(phase + 0.3 * step))  # at times the outer tube reaches farther
    if sim.model.telescopes is not None:
        sim.control.tube_length.copy_(torch.stack([reach, 0.14 - reach], dim=1))
        sim.control.tube_angle[:, 0] = spin.to(sim.control.tube_angle)
    push = torch.as_tensor(0.05 * np.cos(phase + 0.15 * step)).to(sim.control.frame_force)
    sim.control.body_force[:, CART, 0] = push
    sim.control.rod_force[:, 4, 1] = 0.1 * push


def run(sim: sw.Simulation, identity: list[int], steps: int, start: int = 0) -> None:
    for step in range(start, start + steps):
        command(sim, identity, step)
        sim.step()


def state(sim: sw.Simulation) -> dict[str, torch.Tensor]:
    """Copies of everything a user sees of the worlds."""
    names = ("node_x", "node_v", "frame_pose", "frame_twist", "status", "time")
    return {name: getattr(sim, name).clone() for name in names}


PLAY = Play(build, characterise, run, state)


@pytest.mark.parametrize(
    ("options", "precision", "device"),
    [PATHS[0], pytest.param(*PATHS[1].values, id="lanes", marks=pytest.mark.slow), *PATHS[2:]],
)
def test_world_does_not_depend_on_its_batch(options: dict[str, Any], precision: str, device: str) -> None:
    """Individual 17 of 40 is the same alone, and at other places of batches of 3 and 9, after 40 steps."""
    everyone = list(range(40))
    sim = build(40, options, precision, device)
    characterise(sim, everyone)
    run(sim, everyone, 40)
    reference = state(sim)
    assert bool((reference["status"] <= sw.Status.MAX_ITERATIONS).all())
    assert float((reference["frame_pose"] - sim.frame_pose[:1]).abs().amax(dim=(0, 2)).min()) > 1e-5  # they differ
    for identity in ([17], [31, 17, 3], [9, 8, 7, 39, 17, 0, 17, 1, 2]):
        small = build(len(identity), options, precision, device)
        characterise(small, identity)
        run(small, identity, 40)
        assert_same(reference, state(small), identity, list(range(len(identity))))


@pytest.mark.parametrize("law", ["large", "nh_log"])
@pytest.mark.parametrize("iterations", [1, pytest.param(6, marks=pytest.mark.slow)])
def test_paths_agree(law: str, iterations: int) -> None:
    """Scalar and lane kernels give the motion of float64 to the rounding of float32."""
    identity = list(range(9))
    runs = []
    for path, precision in (("scalar", "float64"), ("scalar", "float32"), ("lanes", "float32")):
        options = {"solver_path": path, "newton_iterations": iterations, "newton_tolerance": 1e-7}
        sim = build(9, options, precision, law=law)
        characterise(sim, identity)
        run(sim, identity, 20)
        runs.append({name: value.double() for name, value in state(sim).items()})
    for other in runs[1:]:
        assert float((other["node_x"] - runs[0]["node_x"]).abs().max()) < 2e-5
        assert float((other["frame_pose"] - runs[0]["frame_pose"]).abs().max()) < 1e-4


@pytest.mark.parametrize("path", ["scalar", "lanes"])
def test_threads_do_not_matter(path: str) -> None:
    """Worlds spread over other numbers of threads give the same bits."""
    PLAY.check_threads(path, 15)


@each_path
def test_snapshot_continues_to_the_bit(options: dict[str, Any], precision: str, device: str) -> None:
    """Save, go on, restore, go on again: the same; also from one world into another place of another batch."""
    PLAY.check_snapshot(options, precision, device, 12)


@each_path
def test_reset_touches_masked_worlds_only(options: dict[str, Any], precision: str, device: str) -> None:
    """Worlds that are reset start over, to the bit; the others do not notice."""
    PLAY.check_reset(options, precision, device, 10)


POISON = {
    "force on a body": lambda sim: sim.control.body_force[1, STONE].fill_(np.nan),
    "force on a rod": lambda sim: sim.control.rod_force[1, 3].fill_(np.inf),
    "command": lambda sim: sim.control.body_pose[1, BASE].fill_(np.nan),
    "twist": lambda sim: sim.body_twist[1, STONE].fill_(np.nan),
    "length of a tube": lambda sim: sim.control.tube_length[1].fill_(np.nan),
    "angle of a tube": lambda sim: sim.tube_angle[1].fill_(np.nan),
    "pose": lambda sim: sim.rod_x[1, 5].fill_(np.nan),
    "modulus": lambda sim: sim.params.rod_youngs[1].fill_(np.nan),
}


@pytest.mark.parametrize(
    ("path", "iterations", "poison"),
    [
        pytest.param(path, n, key, marks=() if key == "pose" or (path, n) == ("lanes", 1) else pytest.mark.slow)
        for path in ("scalar", "lanes")
        for n in (1, 4)
        for key in POISON
    ],
)
def test_failed_world_is_rolled_back_and_isolated(path: str, iterations: int, poison: str) -> None:
    """A world with a NaN reports NONFINITE and keeps its last good state; its neighbours keep their bits."""
    options = {"solver_path": path, "newton_iterations": iterations}
    kept = ("node_x", "frame_pose", "frame_twist", "time")
    PLAY.check_poisoned(options, POISON[poison], 8, kept, finite=("frame_pose",))


@pytest.mark.parametrize("iterations", [1, 4])
@pytest.mark.parametrize("mass", [0.0, -1.0])
def test_mass_that_is_none_is_reported(mass: float, iterations: int) -> None:
    """A mass set to 0 or less while running: the world says so and stays finite, the others keep their bits."""
    sims = [build(9, {"newton_iterations": iterations}) for _ in range(2)]
    sims[0].params.body_mass[1, STONE] = mass
    for sim in sims:
        run(sim, list(range(9)), 3)
    others = [0, *range(2, 9)]
    assert_same(state(sims[0]), state(sims[1]), others, others)
    assert int(sims[0].status[1]) != sw.Status.OK
    assert all(bool(torch.isfinite(value[1]).all()) for value in state(sims[0]).values())


@pytest.mark.parametrize("path", ["scalar", "lanes"])
def test_diverged_world_is_rolled_back(path: str) -> None:
    """A body that would fly farther than the scene in one step is put back, alone; a command may take it that far."""
    sim = build(9, {"solver_path": path})
    run(sim, list(range(9)), 3)
    sim.body_twist[4, STONE, 0] = 1e4
    sim.params.body_max_speed[6, BASE] = 1e6
    sim.control.body_pose[6, BASE, 0] = 50.0
    before = state(sim)
    sim.step()
    assert int(sim.status[4]) == sw.Status.DIVERGED
    assert torch.equal(sim.frame_pose[4], before["frame_pose"][4])
    assert (sim.status[[0, 1, 2, 3, 5, 6, 7, 8]] <= sw.Status.OK).all()  # 6 is torn inside out
    assert float(sim.body_pose[6, BASE, 0]) == pytest.approx(50.0, rel=1e-5)
