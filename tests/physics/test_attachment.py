"""What rigid bodies carry, against theory: glued nodes, masses on beams, momentum of an assembly.

Numbers are those of the validation catalogue, sections 5 and 6, unless a formula is given.
"""

from typing import Any

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.plan.frames import FrameLayout
from tests import cases
from tests import rod_cases as rods
from tests.rigid_cases import spinning, vector


def held_beam(kind: str, law: str, **options: Any) -> sw.Simulation:
    """A soft beam of the catalogue's cantilever, x = 0 fixed, or glued to a body that does not move."""
    mesh = meshing.box((1.0, 0.1, 0.1), (10, 2, 2))
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    soft = builder.add_tets(mesh, material=cases.material(law, 1e6, 0.3), density=1000.0, rayleigh=(0.3, 0.02))
    box = ((-1.0, -1.0, -1.0), (1e-9, 1.0, 1.0))
    if kind == "fixed":
        builder.fix(soft, box=box)
    else:
        wall = builder.add_rigid(sw.Box((0.2, 0.4, 0.4)), kinematic=True, pose=(-0.1, 0.05, 0.05))
        chosen = builder.attach(soft, within=1e-6, to=wall)
        assert len(chosen) == 9
    return sw.Simulation(builder.finalize(precision="float64"), dt=0.01, **options)


@pytest.mark.parametrize("law", ["large", "nh_log"])
@pytest.mark.parametrize("iterations", [1, 8])
def test_glue_equals_a_support(law: str, iterations: int) -> None:
    """Nodes glued to a body at rest behave as fixed ones, to rounding."""
    sims = [held_beam(kind, law, newton_iterations=iterations) for kind in ("fixed", "glued")]
    for sim in sims:
        for _ in range(25):
            sim.step()
    assert float(sims[0].node_x[0, :, 2].min()) < -0.1
    assert float((sims[0].node_x - sims[1].node_x).abs().max()) < 1e-10
    assert float((sims[0].node_v - sims[1].node_v).abs().max()) < 1e-8


def tip_loaded(law: str, mass: float, *, skin: float = 0.0, **options: Any) -> tuple[sw.Simulation, np.ndarray]:
    """The cantilever with a rigid plate of a mass on its end face, perhaps in a skin [m]; also the face's nodes."""
    mesh = meshing.box((1.0, 0.1, 0.1), (20, 2, 2))
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    rayleigh = options.pop("rayleigh", (0.0, 0.0))
    soft = builder.add_tets(mesh, material=cases.material(law, 1e6, 0.3), density=1000.0, rayleigh=rayleigh)
    if skin > 0.0:
        builder.add_membrane(soft, mesh.surface(), thickness=skin, youngs=1e7)
    builder.fix(soft, box=((-1.0, -1.0, -1.0), (1e-9, 1.0, 1.0)))
    plate = builder.add_rigid(mass=max(mass, 1e-6), inertia=np.full(3, 1e-6), pose=(1.0, 0.05, 0.05))
    face = builder.attach(soft, box=((1.0 - 1e-9, -1.0, -1.0), (2.0, 1.0, 1.0)), to=plate)
    return sw.Simulation(builder.finalize(precision="float64"), **options), np.asarray(face)


def first_mode(mass: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Lowest bending mode along z of the same mesh with its face rigid: K and M condensed on the plate's motion."""
    case = cases.cantilever((20, 2, 2), "corot")
    free = np.repeat(case.free, 3)
    K = scipy.sparse.csr_matrix(case.sim.stiffness_matrix())
    lumped = np.repeat(case.sim.mass[0].numpy(), 3)
    count, face = len(case.mesh.nodes), cases.on_plane(case.mesh, 0, 1.0)
    own = np.flatnonzero(free & ~np.repeat(face, 3))
    T = scipy.sparse.lil_matrix((3 * count, own.size + 6))
    T[own, np.arange(own.size)] = 1.0
    for node in np.flatnonzero(face):
        x, y, z = case.mesh.nodes[node] - [1.0, 0.05, 0.05]
        T[3 * node : 3 * node + 3, own.size :] = np.hstack([np.eye(3), [[0, z, -y], [-z, 0, x], [y, -x, 0]]])
    T = T.tocsr()
    M = (T.T @ scipy.sparse.diags(lumped) @ T).tolil()
    for i in range(3):
        M[own.size + i, own.size + i] += mass
        M[own.size + 3 + i, own.size + 3 + i] += 1e-6
    values, vectors = scipy.sparse.linalg.eigsh((T.T @ K @ T).tocsc(), 4, M.tocsc(), sigma=0.0)
    shapes = (T @ vectors).T.reshape(4, count, 3)
    best = int(np.argmax([np.abs(shape[face, 2]).mean() / np.abs(shape[face]).mean() for shape in shapes[:2]]))
    return float(np.sqrt(values[best])), shapes[best], vectors[own.size :, best]


@pytest.mark.parametrize("ratio", [0.25, 1.0])
def test_glued_mass_lowers_the_frequency(ratio: float) -> None:
    """A body glued to a soft beam's end is a tip mass m rho A L: that of the mesh to 1e-4, of theory to 2 % (6.6).

    Linear tetrahedra are too stiff, so theory is compared by the ratio of the frequencies with and without the mass.
    """
    omega, shape, plate = first_mode(10.0 * ratio)
    bare = first_mode(0.0)[0]
    theory = (rods.beam_number(ratio, 0) / rods.beam_number(0.0, 0)) ** 2
    assert omega / bare == pytest.approx(theory, rel=0.02)
    h = 0.02 / omega
    sim, _ = tip_loaded("corot", 10.0 * ratio, dt=h)
    scale = 1e-5 / np.abs(shape).max()
    sim.node_v[0] = torch.tensor(omega * scale * shape)
    sim.body_twist[0, 0] = torch.tensor(omega * scale * plate)
    values = []
    for _ in range(100):
        sim.step()
        values.append(float(sim.body_pose[0, 0, 2]) - 0.05)
    assert rods.frequency(values, h) == pytest.approx(omega, rel=1e-4)


@pytest.mark.parametrize("skin", [0.0, 2e-3])
@pytest.mark.parametrize("law", ["large", "nh_log"])
def test_damping_of_carried_nodes(law: str, skin: float) -> None:
    """Small vibrations are linear: many Newton iterations give what one gives, with damping on glued nodes and skin."""
    tips = []
    for iterations in (1, 6):
        options = {"dt": 0.02, "newton_iterations": iterations, "rayleigh": (0.0, 0.05)}
        sim, _ = tip_loaded(law, 2.0, skin=skin, **options)
        sim.control.body_force[0, 0] = vector(0.0, 1e-4, 1e-3, 1e-5, 0.0, 1e-5)
        for _ in range(30):
            sim.step()
        tips.append(torch.cat([sim.body_pose[0, 0, :3], sim.body_twist[0, 0]]).numpy())
    assert abs(tips[0][2] - 0.05) > 1e-5
    assert np.abs(tips[0] - tips[1]).max() < 2e-4 * np.abs(tips[0][:3] - [1.0, 0.05, 0.05]).max()


def assembly(**simulation: Any) -> sw.Simulation:
    """A soft block, a box, a rod and a ball in a row, all attached, thrown and shaken."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    mesh = meshing.box((0.2, 0.1, 0.1), (4, 2, 2))
    soft = builder.add_tets(mesh, material=sw.NeoHookean(1e5, 0.4), density=1000.0)
    box = builder.add_rigid(sw.Box((0.1, 0.1, 0.1)), density=2000.0, pose=(0.25, 0.05, 0.05))
    builder.attach(soft, box=((0.2 - 1e-6, -1.0, -1.0), (0.3, 1.0, 1.0)), to=box)
    rod = builder.add_rod(
        meshing.straight(0.5, 10, start=(0.3, 0.05, 0.05), direction=(1.0, 0.0, 0.0)),
        radius=0.01,
        youngs=1e7,
        density=1200.0,
    )
    builder.attach(rod, nodes=[0], to=box)
    ball = builder.add_rigid(sw.Sphere(0.05), density=500.0, pose=(0.8, 0.05, 0.1))
    builder.attach(ball, to=rod, node=-1)
    sim = sw.Simulation(builder.finalize(precision="float64"), **simulation)
    rng = np.random.default_rng(0)
    spin_, centre, drift = np.array([1.0, -2.0, 3.0]), np.array([0.3, 0.05, 0.05]), np.array([0.3, 0.1, -0.2])

    def velocity(x: torch.Tensor, shake: float) -> torch.Tensor:
        moved = np.cross(spin_, x.numpy() - centre) + drift
        return torch.tensor(moved + shake * rng.standard_normal(moved.shape))

    sim.node_v[0] = velocity(sim.node_x[0], 0.1)
    sim.rod_v[0] = velocity(sim.rod_x[0], 0.05)
    sim.body_twist[0, :, :3] = velocity(sim.body_pose[0, :, :3], 0.0)
    sim.rod_w[0], sim.body_twist[0, :, 3:] = torch.tensor(spin_), torch.tensor(spin_)
    sim.refresh()
    return sim


@pytest.mark.parametrize(("iterations", "tolerance"), [(1, 1e-13), (8, 1e-7)])
def test_assembly_keeps_momentum(iterations: int, tolerance: float) -> None:
    """Linear momentum of soft, rigid and rod parts to rounding, or Newton's tolerance; angular at first order (5.4)."""
    losses = []
    for halvings in range(3):
        sim = assembly(dt=0.004 / 2**halvings, newton_iterations=iterations)
        linear, angular = sim.momentum()
        for _ in range(50 * 2**halvings):
            sim.step()
        now, turning = sim.momentum()
        assert float((now - linear).norm() / linear.norm()) < tolerance
        losses.append(float((turning - angular).norm() / angular.norm()))
    assert losses[0] < 0.03
    assert np.log2(losses[1] / losses[2]) == pytest.approx(1.0, abs=0.2)


def test_written_velocities_reach_what_is_carried() -> None:
    """A twist written by hand moves all that the body carries; so does a pose, and ``refresh`` shows it at once."""
    sim = assembly(dt=0.001)
    for view in (sim.node_v, sim.rod_v, sim.rod_w, sim.body_twist):
        view.zero_()
    sim.body_twist[0, 0] = vector(1.0, 0.0, 0.0, 0.0, 0.0, 2.0)
    sim.refresh()
    glued = np.flatnonzero(np.abs(sim.model.node_rest[:, 0] - 0.2) < 1e-9)
    lever = sim.node_x[0, glued].numpy() - sim.body_pose[0, 0, :3].numpy()
    expected = np.array([1.0, 0.0, 0.0]) + np.cross([0.0, 0.0, 2.0], lever)
    assert np.abs(sim.node_v[0, glued].numpy() - expected).max() < 1e-14
    before = sim.node_x[0, glued].clone()
    sim.body_pose[0, 0, 1] += 0.01
    sim.refresh()
    assert np.abs((sim.node_x[0, glued] - before).numpy() - [0.0, 0.01, 0.0]).max() < 1e-14
    body = spinning((1.0, 1.0, 1.0), (0.0, 0.0, 0.0), dt=0.01)
    body.body_twist[0, 0, 0] = 3.0
    body.step()
    assert float(body.body_pose[0, 0, 0]) == pytest.approx(0.03)


@pytest.mark.parametrize("element", ["p1", "p2"])
@pytest.mark.parametrize("law", ["large", "nh_log"])
def test_elements_gripped_whole_add_nothing(law: str, element: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bar that two bodies grip moves, strains and weighs as with the stiffness of what they grip."""

    def swing(*, gripped: bool) -> tuple[sw.Simulation, list[torch.Tensor]]:
        if gripped:
            monkeypatch.setattr(FrameLayout, "carries_whole", lambda self, corners: np.zeros(len(corners), dtype=bool))
        builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
        bar = builder.add_tets(
            meshing.box((0.06, 0.01, 0.01), (6, 1, 1)), material=cases.material(law, 1.0e5, 0.4), element=element,
            density=1000.0, rayleigh=(0.0, 0.01),
        )  # fmt: skip
        x = builder.bodies[bar].mesh.nodes[:, 0]
        hand = builder.add_rigid(kinematic=True)
        tip = builder.add_rigid(sw.Box((0.02, 0.01, 0.01)), mass=0.01, pose=(0.05, 0.005, 0.005, 0, 0, 0, 1))
        builder.attach(bar, np.flatnonzero(x < 0.0201), to=hand)
        builder.attach(bar, np.flatnonzero(x > 0.0399), to=tip)
        sim = sw.Simulation(builder.finalize(1, "cpu", "float64"), newton_iterations=2)
        found = []
        for step in range(10):
            sim.control.body_pose[:, hand, 2] = 0.001 * step
            sim.step()
            measured = (sim.node_x, sim.body_pose, sim.energy(), sim.element_stress())
            found += [value.clone() for value in measured]
        return sim, found

    sim, without = swing(gripped=False)
    reference, whole = swing(gripped=True)
    for found, expected in zip(without, whole, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9 * float(expected.abs().max()))
    frames = (sim.model.frames, reference.model.frames)
    entries = [sum(lists[2].shape[0] for lists in f.carried_blocks.values()) + f.gripped_entry.shape[0] for f in frames]
    assert entries[0] < (0.5 if element == "p1" else 0.95) * entries[1]


def test_body_gripped_whole() -> None:
    """A soft body that a rigid one carries as a whole falls with it, has no stress and keeps its mass."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    block = builder.add_tets(
        meshing.box((0.02, 0.02, 0.02), (1, 1, 1)), material=sw.Corotational(1e5, 0.3), density=1e3
    )
    crate = builder.add_rigid(sw.Box((0.02, 0.02, 0.02)), mass=0.01, pose=(0.01, 0.01, 0.01, 0, 0, 0, 1))
    builder.attach(block, np.arange(8), to=crate)
    sim = sw.Simulation(builder.finalize(1, "cpu", "float64"))
    start = sim.node_x.clone()
    for _ in range(10):
        sim.step()
    fall = (sim.node_x - start).mean(dim=1)[0]
    assert fall.tolist() == pytest.approx([0.0, 0.0, -9.81 * 1e-4 * 55], abs=1e-12)
    assert float(sim.element_stress().abs().max()) < 1e-6


@pytest.mark.parametrize("cells", [1, 3])
def test_grips_of_quadratic_elements(cells: int) -> None:
    """From rest, sums over what frames carry give the step that blocks of every pair of nodes give, of a stored law.

    Elements of a bar of one cell are carried by two frames, whose rotations they couple.
    """
    found = []
    for method in ("warped", "large", "polar"):
        builder = sw.ModelBuilder(gravity=(1.0, -2.0, -9.81))
        bar = builder.add_tets(
            meshing.box((0.01 * cells, 0.01, 0.012), (cells, 1, 1)),
            material=sw.Corotational(1.0e5, 0.4, method=method),
            element="p2",
            density=1000.0,
            rayleigh=(0.0, 0.02),
        )
        x = builder.bodies[bar].mesh.nodes[:, 0]
        ends = []
        for place, held in ((0.0, x < 1e-6), (0.01 * cells, x > 0.01 * cells - 1e-6)):
            pose = (place, 0.02, -0.01, 0.0, 0.0, 0.0, 1.0)
            ends.append(builder.add_rigid(sw.Box((0.01, 0.02, 0.01)), mass=0.01, pose=pose))
            builder.attach(bar, np.flatnonzero(held), to=ends[-1])
        sim = sw.Simulation(builder.finalize(1, "cpu", "float64"))
        assert (sim.model.frames.grip_count > 0) == (method != "polar")
        sim.control.body_force[0, ends[0]] = vector(0.1, -0.2, 0.05, 1e-3, 2e-3, -3e-3)
        sim.step()
        found.append(torch.cat([sim.node_v.flatten(), sim.body_twist.flatten()]))
    scale = float(found[2].abs().max())
    assert float((found[0] - found[2]).abs().max()) < 1e-10 * scale
    assert float((found[1] - found[2]).abs().max()) < 1e-10 * scale
