"""Where a robot stands does not matter: the same answer to the spacing of coordinates, or a refusal, or a status."""

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.model.resolution import STEPS, resolved_sizes, spacing
from tests import cases
from tests.contract.batch_checks import assert_same

DIRECTION = np.array([1.0, -0.7, 0.4])


def place(distance: float) -> np.ndarray:
    """A point whose largest coordinate is ``distance`` [m], representable in float32."""
    return (distance * DIRECTION).astype(np.float32).astype(np.float64)


def cantilever(law: str, distance: float, precision: str = "float32") -> tuple[sw.ModelBuilder, np.ndarray]:
    """A beam of 20 cm, clamped at ``place(distance)``, that sags by 4 cm."""
    mesh, at = meshing.box((0.2, 0.03, 0.03), (6, 2, 2)), place(distance)
    builder = sw.ModelBuilder()
    moved = meshing.TetMesh(mesh.nodes + at, mesh.tets)
    body = builder.add_tets(moved, material=cases.material(law, 2e5, 0.3), density=1e3, rayleigh=(2.0, 0.02))
    builder.fix(body, nodes=np.flatnonzero(cases.on_plane(mesh, 0, 0.0)))
    return builder, mesh.nodes + at


def settled(law: str, distance: float, precision: str = "float32") -> np.ndarray:
    """Displacements [m] of the cantilever at rest, (node, 3)."""
    builder, rest = cantilever(law, distance)
    sim = sw.Simulation(builder.finalize(precision=precision), dt=0.02)
    sim.step(150)
    assert int(sim.status[0]) == sw.Status.OK
    return sim.node_x[0].double().numpy() - rest


@pytest.mark.parametrize("law", ["large", "nh_log", "warped"])
def test_cantilever_sags_the_same_everywhere(law: str) -> None:
    """As far as float32 is taken, displacements are those at the origin to four spacings; float64 goes on."""
    reference = settled(law, 0.0)
    assert -0.046 < reference[:, 2].min() < -0.042
    for distance in (10.0, 100.0, 300.0):
        error = np.abs(settled(law, distance) - reference).max()
        assert error < 4.0 * spacing(distance, "float32"), f"{error:g} m at {distance:g} m"
    assert np.abs(settled(law, 1e5, "float64") - reference).max() < 1e-6


def test_rod_sags_the_same_everywhere() -> None:
    """The same for a rod that hangs from a clamped node, close to the 328 m that are taken."""
    tips = []
    for distance in (0.0, 10.0, 320.0):
        builder = sw.ModelBuilder()
        points = np.linspace((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), 16) + place(distance)
        rod = builder.add_rod(points, radius=0.01, youngs=2e6, density=1e3, rayleigh=(2.0, 0.02))
        builder.fix(rod, nodes=[0])
        sim = sw.Simulation(builder.finalize(), dt=0.02)
        sim.step(150)
        tips.append(sim.rod_x[0].double().numpy() - points)
        assert np.abs(tips[-1] - tips[0]).max() < 4.0 * spacing(max(distance, 0.3), "float32")
    assert -0.16 < tips[0][-1, 2] < -0.14


def test_scene_that_stands_too_far_away_is_refused() -> None:
    """The message names part, place, spacing and limit; in float64 the scene stands well."""
    builder, _ = cantilever("large", 1e5)
    message = r"soft body .* stands at \(1000.*\) m, where float32 coordinates are 0.0078 m apart.* within 546 m"
    with pytest.raises(ValueError, match=message):
        builder.finalize()
    assert builder.finalize(precision="float64").precision == "float64"
    ball = sw.ModelBuilder()
    ball.add_rigid(sw.Sphere(0.05), density=1e3, pose=(0.0, -2e3, 0.0), name="ball")
    with pytest.raises(ValueError, match=r"rigid body 'ball' stands at .0, -2000, 0. m"):
        ball.finalize()
    rod = sw.ModelBuilder()
    rod.add_rod(np.linspace((0.0, 0.0, 900.0), (0.0, 0.0, 901.0), 21), radius=0.01, youngs=1e6, name="hose")
    with pytest.raises(ValueError, match=r"rod 'hose' stands at .* this size .0.05 m. must stay within 819 m"):
        rod.finalize()


def test_limit_follows_from_the_part() -> None:
    """Coordinates at the limit tell 512 places along a part; what has no size has no limit, nor has a plane."""
    for precision in ("float32", "float64"):
        assert 0.5 / STEPS < spacing(resolved_sizes(precision), precision) <= 1.0 / STEPS
    builder = sw.ModelBuilder()
    builder.add_rigid(sw.Plane(), kinematic=True, pose=(5e3, 0.0, 0.0))
    builder.add_rigid(mass=1.0, inertia=(1.0, 1.0, 1.0), pose=(0.0, 0.0, 1.0))
    assert builder.finalize().num_worlds == 1


BASE, BALL = range(2)


def scene(worlds: int, device: str, path: str) -> sw.Simulation:
    """A soft block on a driven base, resolved up to 1638.4 m, and a ball of 4 cm that flies, up to 655.36 m."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    base = builder.add_rigid(sw.Box((0.1, 0.1, 0.1)), kinematic=True)
    block = builder.add_tets(meshing.box((0.1,) * 3, (1, 1, 1)), material=sw.NeoHookean(5e4, 0.3), density=1e3)
    builder.attach(block, nodes=[0, 1, 2, 3], to=base)
    velocity = (40.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    builder.add_rigid(sw.Sphere(0.02), density=1e3, pose=(0.0, 0.5, 0.0), velocity=velocity)
    return sw.Simulation(builder.finalize(worlds, device), dt=0.01, solver_path=path)


def state(sim: sw.Simulation) -> dict[str, torch.Tensor]:
    """Copies of what moves."""
    return {name: getattr(sim, name).clone() for name in ("node_x", "node_v", "frame_pose", "frame_twist", "time")}


@pytest.mark.parametrize(
    ("path", "device"),
    [("scalar", "cpu"), ("lanes", "cpu"), pytest.param("auto", "cuda:0", marks=pytest.mark.cuda)],
)
def test_world_that_wanders_off_says_so(path: str, device: str) -> None:
    """A base that is driven away, a ball that flies away, one that explodes: each alone, the others keep their bits."""
    sims = [scene(9, device, path) for _ in range(2)]
    sim = sims[0]
    for world, x in ((1, 1500.0), (4, 1638.25)):
        sim.node_x[world, :, 0] += x
        sim.body_pose[world, BASE, 0] = x
        sim.control.body_pose[world, BASE, 0] = x + 0.25
    sim.body_pose[5, BALL, 0] = 654.0
    sim.body_twist[7, BALL, 0] = 1e6
    before = state(sim)
    failed = [sw.Status.OK] * 9
    failed[4], failed[7] = sw.Status.TOO_FAR, sw.Status.DIVERGED
    for step in range(5):
        for each in sims:
            each.step()
        failed[5] = sw.Status.TOO_FAR if step > 2 else sw.Status.OK  # the fourth step would lead beyond 655.36 m
        assert sim.status.tolist() == failed
    assert_same(state(sim), before, [4, 7], [4, 7])
    assert float(sim.body_pose[5, BALL, 0]) == pytest.approx(655.2)
    assert float(sim.body_pose[1, BASE, 0]) == 1500.25
    others = [0, 2, 3, 6, 8]
    assert_same(state(sim), state(sims[1]), others, others)
    assert sw.Status.TOO_FAR.failed


@pytest.mark.parametrize("path", ["scalar", "lanes"])
def test_soft_body_that_flies_off_says_so(path: str) -> None:
    """The limit of nodes, which no frame shares: one step before it all is well, beyond it the world stands still."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_tets(meshing.box((0.1,) * 3, (1, 1, 1)), material=sw.NeoHookean(5e4, 0.3), density=1e3)
    sim = sw.Simulation(builder.finalize(9), dt=0.01, solver_path=path)
    limit = sim.model.node_size * resolved_sizes("float32")
    sim.node_x[6, :, 1] -= limit - 0.015
    sim.node_v[6, :, 1] = -1.0
    statuses = []
    for _ in range(4):
        sim.step()
        statuses.append(sim.status[6].item())
    assert statuses == [sw.Status.OK, sw.Status.TOO_FAR, sw.Status.TOO_FAR, sw.Status.TOO_FAR]
    assert float(sim.node_x[6, :, 1].min()) == pytest.approx(0.005 - limit, abs=1e-3)
    assert sim.status[[0, 1, 2, 3, 4, 5, 7, 8]].tolist() == [sw.Status.OK] * 8


def test_short_end_of_a_long_tube_goes_on() -> None:
    """Segments of a telescope grow with what is out: those of 1 mm of a tube of 1.3 m do not set the limit, 0.43 m."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    tube = sw.Tube([sw.TubeSection(1.3)], radius=1e-3, youngs=1e7, density=1550.0)
    builder.add_telescope([tube], port=(0.0, 0.0, 0.42), segments=48, lengths=(0.001,))
    sim = sw.Simulation(builder.finalize(1), dt=0.01)
    sim.control.tube_length.fill_(0.1)
    for _ in range(20):
        sim.step()
        assert int(sim.status[0]) == sw.Status.OK
    assert float(sim.rod_x[0, -1, 2]) == pytest.approx(0.52, abs=1e-5)


def test_world_comes_back() -> None:
    """A world that stood too far away goes on when its command is taken back, with the bits of one that never left."""
    sims = [scene(1, "cpu", "scalar") for _ in range(2)]
    sims[0].control.body_pose[0, BASE, 1] = 1e5
    sims[0].step()
    assert int(sims[0].status[0]) == sw.Status.TOO_FAR
    sims[0].control.body_pose[0, BASE, 1] = 0.0
    for sim in sims:
        sim.step(3)
    assert_same(state(sims[0]), state(sims[1]), [0], [0])
    assert int(sims[0].status[0]) == sw.Status.OK
