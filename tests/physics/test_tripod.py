"""The tripod on its servo arms: symmetry, weight, work of the motors, and where its plate stands."""

import math

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import Status, meshing
from softwarp.envs.options.tripod import TripodSceneConfig
from softwarp.envs.scenes.tripod import SERVOS, build_tripod_scene, held_nodes, set_up, tripod_mesh

G = 9.81
HOME = -1.4965  # rad, of SofaGym's setup motion


def tripod(*, angle=HOME, precision="float64", num_worlds=1, newton_iterations=6, **options):
    """The tripod after its setup motion, not yet at rest, without limits of torque."""
    config = TripodSceneConfig(**({"angle": angle, "max_torque": math.inf} | options))
    builder = sw.ModelBuilder(gravity=config.gravity)
    scene = build_tripod_scene(config, builder)
    sim = sw.Simulation(builder.finalize(num_worlds, precision=precision), 0.01, newton_iterations)
    set_up(sim, scene, config)
    return sim, scene


def turn_to(sim, angles, steps=20):
    """Turn the servos, then let the tripod come to rest."""
    start, end = sim.joint_position.clone(), torch.as_tensor(angles).to(sim.joint_position)
    for step in range(steps):
        sim.control.joint_target.copy_(torch.lerp(start, end.expand_as(start), (step + 1) / steps))
        sim.step()
    assert sim.solve_static(max_iterations=100).converged.all()


def plate(sim, scene):
    """Middle of the plate [mm] and the slopes of its normal, nx / nz and ny / nz, of world 0."""
    x, y, z, w = sim.frame_pose[0, scene.plate, 3:].tolist()
    normal = np.array([2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)])
    return 1e3 * sim.marker_x[0, scene.middle].numpy(), normal[:2] / normal[2]


@pytest.fixture(scope="module")
def rested():
    """At rest under equal angles of -1 rad, polar elements, whose force is the derivative of their energy."""
    sim, scene = tripod(angle=-1.0, rotation="polar")
    turn_to(sim, [-1.0] * SERVOS)
    return sim, scene


def test_equal_angles_do_not_tilt(rested):
    """A third of a turn and a mirror map scene and mesh to themselves, so the plate stays level on the axis."""
    sim, scene = rested
    middle, slope = plate(sim, scene)
    assert np.abs(middle[:2]).max() < 1e-5 and np.abs(slope).max() < 1e-6
    assert sim.joint_force.std() < 1e-7 and sim.status.tolist() == [Status.OK]


def test_joints_carry_the_weight(rested):
    """The bases hold all that stands on them: the vertical reactions are the weight of silicone, arms and plate."""
    sim, scene = rested
    reaction = sim.joint_reaction[0, list(scene.motors), 2].sum()
    assert float(reaction) == pytest.approx((0.032 + 3 * 0.01 + 1e-6) * G, rel=1e-6)


@pytest.mark.slow
def test_torque_is_the_derivative_of_the_energy(rested):
    """Virtual work: between equilibria sum_i tau_i d theta_i = dE, elastic and gravitational; Simpson's rule, O(d^4).

    Servo 0 turns by +-0.02 rad, then all by as much.
    """
    sim, _ = rested
    for moved in ([1.0, 0.0, 0.0], [1.0, 1.0, 1.0]):
        step = 0.02 * torch.tensor(moved, dtype=torch.float64)
        energies, powers = [], []
        for share in (-1.0, 0.0, 1.0):
            turn_to(sim, -1.0 + share * step, steps=2)
            energies.append(float(sim.energy()))
            powers.append(float(sim.joint_force[0] @ step))
        work = (powers[0] + 4.0 * powers[1] + powers[2]) / 3.0
        assert abs(work) > 1e-5  # J
        assert energies[2] - energies[0] == pytest.approx(work, rel=1e-3)
    turn_to(sim, [-1.0] * SERVOS)


@pytest.mark.parametrize(
    ("angles", "height", "slope", "torque"),
    [
        pytest.param((HOME, HOME, HOME), 26.211, 0.0, -0.23345, marks=pytest.mark.slow),
        ((-1.0, -1.0, -1.0), 45.897, 0.0, -0.03814),
        ((-0.6, -1.2, -1.2), 44.467, -math.tan(0.24692), 0.05683),
    ],
)
def test_static_heights_and_tilts(angles, height, slope, torque):
    """The table of assets/tripod/README.md: SofaGym's setup angle, the level and a tilted plate at work [mm, N m]."""
    sim, scene = tripod()
    turn_to(sim, angles)
    middle, slopes = plate(sim, scene)
    assert middle[2] == pytest.approx(height, abs=5e-3)
    assert slopes[1] == pytest.approx(slope, abs=2e-4)
    assert float(sim.joint_force[0, 0]) == pytest.approx(torque, abs=2e-5)


@pytest.mark.slow
def test_quadratic_elements_are_softer():
    """42.93 mm at -1 rad with quadratic elements between the coarse mesh's nodes, 3 mm below the linear ones."""
    sim, scene = tripod(angle=-1.0, element="p2", rotation="polar", precision="float32", newton_iterations=2)
    for _ in range(60):
        sim.step()
    assert sim.node_v.abs().max() < 1e-3
    middle, _ = plate(sim, scene)
    assert middle[2] == pytest.approx(42.934, abs=0.05)


def test_a_mesh_file_lies_where_sofagym_has_it(tmp_path):
    """The generated mesh turned as SoftRobots' files are, a leg along -y and z upwards in mm, gives the same scene."""
    meshio = pytest.importorskip("meshio")
    made = meshing.tripod("coarse")
    x, y, z = 1e3 * made.nodes.T
    path = tmp_path / "tripod.vtu"
    meshio.Mesh(np.column_stack([x, -y, -z]), [("tetra", made.tets)]).write(path)
    config = TripodSceneConfig(mesh=str(path), mesh_scale=1e-3)
    placed, own = tripod_mesh(config), tripod_mesh(TripodSceneConfig())
    np.testing.assert_allclose(placed.nodes, own.nodes, atol=1e-9)
    assert [len(held_nodes(config, placed.nodes, servo)) for servo in range(SERVOS)] == [20, 20, 20]


def test_walls_have_a_mesh_of_their_own():
    """The accurate variant is one of hexahedra; other meshes and rotations are refused beside it."""
    sim, _ = tripod(fidelity="accurate")
    assert (sim.model.hex_count, sim.model.tet_count) == (96, 0)
    with pytest.raises(ValueError, match="mesh of its own"):
        TripodSceneConfig(element="walls", rotation="warped", mesh="medium")
    with pytest.raises(ValueError, match="means element='walls'"):
        TripodSceneConfig(fidelity="accurate", element="p2")
