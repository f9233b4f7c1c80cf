"""Joints: gradients of rows, coordinates, commands and what the builder refuses."""

import math

import numpy as np
import pytest
import torch
import warp as wp
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import softwarp as sw
from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.frames import gyration
from softwarp.model.codes import JointRow
from softwarp.solvers.workspace.rows import allocate

KINDS = ("hinge", "slider", "ball", "weld")
AXIS = np.array([1.0, -2.0, 0.5]) / math.sqrt(5.25)
ANCHOR = np.array([0.1, -0.05, 0.2])
DEVICES = [
    pytest.param("cpu", "float64", id="cpu"),
    pytest.param("cuda:0", "float64", id="cuda", marks=pytest.mark.cuda),
]


def two_bodies(kind: str, device: str = "cpu", precision: str = "float64", **options) -> sw.Simulation:
    """Two bodies and a third one that the second carries; the joint ties the first to the third."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    inertia = {"mass": 1.0, "inertia": (0.01, 0.02, 0.025)}
    first = builder.add_rigid(pose=(0.0, 0.0, 0.0), **inertia)
    second = builder.add_rigid(pose=(0.3, 0.1, 0.2), **inertia)
    third = builder.add_rigid(pose=(0.2, -0.1, 0.1), **inertia)
    builder.attach(third, to=second)
    builder.add_joint(first, third, kind, anchor=ANCHOR, axis=AXIS, **options)
    return sw.Simulation(builder.finalize(device=device, precision=precision), dt=0.01, threads=1)


def place(sim: sw.Simulation, frame: int, about: np.ndarray, turn: np.ndarray, way: np.ndarray) -> None:
    """Turn a master about a point by a rotation vector, then move it."""
    pose = sim.body_pose[0, frame].cpu().double().numpy()
    rotation = Rotation.from_rotvec(turn)
    x = about + rotation.apply(pose[:3] - about) + way
    q = (rotation * Rotation.from_quat(pose[3:])).as_quat()
    sim.body_pose[0, frame] = torch.as_tensor(np.concatenate([x, q]), dtype=sim.body_pose.dtype)


def rows(sim: sw.Simulation) -> tuple[np.ndarray, np.ndarray]:
    """Gaps of all rows and H on the twists of both masters, (row, 12), at the poses of the state."""
    sim.refresh()
    system = sim._systems[0]
    system.load()
    system.measure_rows()
    count = sim.model.joints.rows
    gap = system.work.displacement.real.numpy()[0, :count, 0].copy()
    H = system.work.row.real.numpy()[0, : 12 * count, 0].reshape(count, 12).copy()
    return gap, H


def moved_gap(sim: sw.Simulation, twist: np.ndarray) -> np.ndarray:
    """Gaps and, for limits and motors, the coordinate, after both masters have moved by a small twist."""
    kept = sim.body_pose.clone()
    for frame, part in ((0, twist[:6]), (1, twist[6:])):
        place(sim, frame, sim.body_pose[0, frame, :3].cpu().double().numpy(), part[3:], part[:3])
    gap, _ = rows(sim)
    kind = sim.model.joints.row_kind.numpy()
    scale = sim.model.joints.joint_scale.numpy()[0]
    gap = np.where(kind == JointRow.FREE, scale * float(sim.joint_position[0, 0]), gap)
    sim.body_pose.copy_(kept)
    sim.refresh()
    return gap


@pytest.mark.parametrize(("device", "precision"), DEVICES)
@pytest.mark.parametrize("kind", KINDS)
def test_rows_are_gradients_of_gaps(kind, device, precision, rng):
    """H v = dg/dt, central differences with 1e-6 rad and m, at a place that the joint allows and, for turns, others.

    Forces act on both sides at the child's anchor, which is the parent's too where anchors meet.
    """
    options = {"control": "force", "limits": (-3.0, 3.0)} if kind in ("hinge", "slider") else {}
    sim = two_bodies(kind, device, precision, **options)
    for frame in (0, 1):
        place(sim, frame, ANCHOR, np.array([0.4, -0.7, 0.3]), np.array([0.05, 0.02, -0.3]))
    anchor = ANCHOR + [0.05, 0.02, -0.3]
    axis = Rotation.from_rotvec([0.4, -0.7, 0.3]).apply(AXIS)
    if kind == "slider":
        place(sim, 1, anchor, np.zeros(3), 0.13 * axis)
    if kind == "hinge":
        place(sim, 1, anchor, 0.9 * axis, np.zeros(3))
    if kind in ("ball", "weld"):
        place(sim, 1, anchor, 0.3 * rng.standard_normal(3), np.zeros(3))
    gap, H = rows(sim)
    if kind != "weld":
        assert np.abs(gap).max() < 1e-12
    for _ in range(4):
        twist = rng.standard_normal(12)
        step = 1e-6
        change = (moved_gap(sim, step * twist) - moved_gap(sim, -step * twist)) / (2.0 * step)
        np.testing.assert_allclose(H @ twist, change, atol=1e-8)


def test_axes_of_hinges_are_held_far_from_their_place(rng):
    """The two rows that keep a hinge's axes parallel are exact gradients for bodies at any angle to each other."""
    sim = two_bodies("hinge")
    place(sim, 1, ANCHOR, np.array([0.5, 0.3, -0.4]), np.zeros(3))
    _, H = rows(sim)
    for _ in range(4):
        twist = rng.standard_normal(12)
        change = (moved_gap(sim, 1e-6 * twist) - moved_gap(sim, -1e-6 * twist)) / 2e-6
        np.testing.assert_allclose((H @ twist)[3:], change[3:], atol=1e-8)


@pytest.mark.parametrize(("kind", "unit"), [("hinge", 1.0), ("slider", 0.1)])
def test_coordinate(kind, unit):
    """Angles and ways count from the start, positive about and along the axis; ``refresh`` finds velocities too."""
    sim = two_bodies(kind, control="force")
    for q in (0.7 * unit, -0.4 * unit):
        sim.reset()
        turn, way = (q * AXIS, np.zeros(3)) if kind == "hinge" else (np.zeros(3), q * AXIS)
        place(sim, 1, ANCHOR, turn, way)
        sim.body_twist[0, 1, 3:] = torch.as_tensor(AXIS if kind == "hinge" else 0.0 * AXIS)
        centre = sim.body_pose[0, 1, :3].numpy()
        v = np.cross(AXIS, centre - ANCHOR) if kind == "hinge" else AXIS
        sim.body_twist[0, 1, :3] = torch.as_tensor(v)
        sim.refresh()
        assert float(sim.joint_position[0, 0]) == pytest.approx(q, abs=1e-12)
        assert float(sim.joint_velocity[0, 0]) == pytest.approx(1.0, abs=1e-12)


def test_angles_count_turns():
    """A hinge that is turned on by hand in parts of a turn counts them all; 60 turns cost no precision."""
    sim = two_bodies("hinge", precision="float32")
    for step in range(1, 201):
        place(sim, 1, ANCHOR, 0.3 * 2.0 * np.pi * AXIS, np.zeros(3))
        sim.refresh()
        if step % 50 == 0:
            assert float(sim.joint_position[0, 0]) == pytest.approx(0.3 * 2.0 * np.pi * step, abs=2e-4)


def servo(**options) -> sw.Simulation:
    """One wheel on a hinge to the world."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    wheel = builder.add_rigid(mass=2.0, inertia=(0.02, 0.02, 0.02))
    builder.add_joint(None, wheel, "hinge", axis=(0.0, 1.0, 0.0), **options)
    return sw.Simulation(builder.finalize(2, precision="float64"), dt=0.01, threads=1)


def test_servo_is_implicit():
    """One step from rest: I w / h = kp (r - h w) - kd w + f, at any stiffness; parameters belong to worlds."""
    sim = servo(control="position", stiffness=5.0, damping=0.3)
    sim.params.joint_stiffness[1], sim.params.joint_damping[1] = 1e7, 0.0
    sim.control.joint_target[:] = 0.2
    sim.control.joint_force[:] = 0.1
    sim.step()
    kp, kd = np.array([5.0, 1e7]), np.array([0.3, 0.0])
    w = (kp * 0.2 + 0.1) / (0.02 / 0.01 + kp * 0.01 + kd)
    np.testing.assert_allclose(sim.joint_velocity[:, 0], w, rtol=1e-9)
    np.testing.assert_allclose(sim.joint_force[:, 0], 0.02 * w / 0.01, rtol=1e-6)
    np.testing.assert_allclose(sim.joint_reaction[:, 0, 4], 0.02 * w / 0.01, rtol=1e-6)


def test_limits_of_worlds_differ():
    """Limits, forces and rates are parameters of each world."""
    sim = servo(control="position", max_force=1e3, limits=(-1.0, 1.0))
    sim.params.joint_max_position[1] = 0.3
    sim.control.joint_target[:] = 0.8
    for _ in range(3):
        sim.step()
    np.testing.assert_allclose(sim.joint_position[:, 0], [0.8, 0.3], atol=1e-9)
    sim.params.joint_max_rate[0] = 2.0
    sim.params.joint_max_force[1] = 0.05
    sim.control.joint_target[:] = 0.0
    before = sim.joint_position.clone()
    sim.step()
    travel = (sim.joint_position - before)[:, 0]
    np.testing.assert_allclose(travel, [-0.02, -0.05 / 0.02 * 0.01**2], atol=1e-9)


def test_rows_of_a_cart():
    """A body that never turns keeps only the rows that a free axis can violate."""
    builder = sw.ModelBuilder()
    cart = builder.add_rigid(mass=1.0, inertia=(1.0, 1.0, 1.0), free_axes="x")
    plate = builder.add_rigid(mass=1.0, inertia=(1.0, 1.0, 1.0), free_axes=("x", "y"))
    builder.add_joint(None, cart, "slider", axis=(1, 0, 0), control="velocity", max_force=9.0, limits=(-1.0, 2.0))
    builder.add_joint(None, plate, "slider", axis=(1, 0, 0))
    joints = builder.finalize().joints
    assert joints.row_kind.numpy().tolist() == [JointRow.FREE, JointRow.SIDE]
    assert joints.unbounded.tolist() == [1]


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("axis", [(0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 1.0, 1e-8)])
def test_hinge_on_the_one_axis_that_is_free(axis, precision):
    """Rows that a hub on one free axis cannot violate are left out, so that rounding cannot lock it: w = M t / I."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    hub = builder.add_rigid(mass=1.0, inertia=(0.004, 0.004, 0.004), free_axes=("ry",))
    slide = builder.add_rigid(mass=1.0, inertia=(0.004, 0.004, 0.004), free_axes=("x", "ry"))
    for body in (hub, slide):
        builder.add_joint(None, body, "hinge", axis=axis, control="force")
    model = builder.finalize(precision=precision)
    assert model.joints.row_kind.numpy().tolist() == [JointRow.FREE, JointRow.POINT, JointRow.FREE]
    sim = sw.Simulation(model, dt=0.01)
    sim.control.joint_force[:] = 1.0
    for _ in range(10):
        sim.step()
    np.testing.assert_allclose(sim.joint_velocity[0], 25.0, rtol=1e-5)
    np.testing.assert_allclose(sim.body_twist[0, :, 4], math.copysign(25.0, axis[1]), rtol=1e-5)
    assert sim.body_pose[0, slide, :3].abs().max() < 1e-6


def test_hinge_beside_the_free_axis_locks_the_hub():
    """About an anchor 0.1 m beside its own axis a body that may only spin cannot turn."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    hub = builder.add_rigid(mass=1.0, inertia=(0.004, 0.004, 0.004), free_axes=("ry",))
    builder.add_joint(None, hub, "hinge", axis=(0.0, 1.0, 0.0), anchor=(0.1, 0.0, 0.0), control="force")
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01)
    sim.control.joint_force[:] = 1.0
    sim.step()
    assert abs(float(sim.body_twist[0, hub, 4])) < 1e-6


def test_commands_that_are_no_numbers_fail_their_world_alone():
    """A target of nan rolls back its world; the other one moves on."""
    sim = servo(control="position", stiffness=5.0, damping=0.3)
    sim.control.joint_target[:, 0] = torch.tensor([math.nan, 0.1], dtype=torch.float64)
    sim.step()
    assert sim.status.tolist() == [sw.Status.NONFINITE, sw.Status.OK]
    assert sim.joint_position[:, 0].tolist()[0] == 0.0
    assert float(sim.joint_position[1, 0]) > 0.0


def test_free_turn_is_that_of_a_free_top(rng):
    """Against the equations dR/dt = [w] R, L constant: third order per step; to rounding for two equal moments."""
    chosen = variant("scalar", "float64")
    k = gyration.kernels(chosen)

    def turn(moments: np.ndarray, w: np.ndarray, h: float) -> np.ndarray:
        def array(values: np.ndarray) -> wp.array:
            target = allocate(chosen, 1, len(values), "cpu")
            target.real.assign(np.asarray(values, dtype=np.float64).reshape(1, -1, 1))
            return target.real

        compound = np.zeros(20)
        compound[0], compound[4:7] = 1.0, moments
        compound[10:] = compound[:10]
        difference, b = array(np.zeros(6)), array(np.zeros(6))
        index = wp.array([0, 1], dtype=wp.int32, device="cpu")
        frame = wp.array([0], dtype=wp.int32, device="cpu")
        inputs = [frame, index, array([0, 0, 0, 0, 0, 0, 1]), array([0, 0, 0, *w])]
        inputs += [array(compound), array(np.zeros(6)), array(np.zeros(6)), h, 0]
        wp.launch(k.add_gyration, dim=(1, 1, 1), inputs=inputs, outputs=[difference, b], device="cpu")
        change = difference.numpy()[0, 3:6, 0]
        np.testing.assert_allclose(b.numpy()[0, 3:6, 0], moments * change, atol=1e-12)
        return (w + change) * h

    def exact(moments: np.ndarray, w: np.ndarray, h: float) -> np.ndarray:
        def rate(_: float, y: np.ndarray) -> np.ndarray:
            rotation = Rotation.from_quat(y)
            v = rotation.apply(rotation.inv().apply(moments * w) / moments)
            return 0.5 * np.array([*(v * y[3] + np.cross(v, y[:3])), -v @ y[:3]])

        y = solve_ivp(rate, (0.0, h), [0.0, 0.0, 0.0, 1.0], rtol=1e-12, atol=1e-14).y[:, -1]
        return Rotation.from_quat(y).as_rotvec()

    w = rng.standard_normal(3)
    for moments in ((2.0, 2.0, 0.5), (1.0, 3.0, 3.0), (2.0, 2.0, 2.0), (0.3, 1.0, 0.3)):
        np.testing.assert_allclose(turn(np.array(moments), w, 1.0), exact(np.array(moments), w, 1.0), atol=1e-9)
    moments = np.array([1.0, 2.0, 2.7])
    errors = [np.abs(turn(moments, w, h) - exact(moments, w, h)).max() for h in (0.2, 0.1)]
    assert errors[1] < 1e-4
    assert errors[0] / errors[1] > 6.0


REFUSED = [
    ({"kind": "gear"}, "kind must be one of hinge, slider, ball, weld"),
    ({"control": "torque"}, "control must be one of none, position, velocity, force"),
    ({"axis": (0.0, 0.0, 0.0)}, "axis must not be zero"),
    ({"axis": (0.0, math.nan, 0.0)}, "axis must be three finite numbers"),
    ({"anchor": (0.0, 1.0)}, "anchor must be three finite numbers"),
    ({"limits": (0.2, 1.0)}, "limits must be ordered around 0"),
    ({"limits": (1.0, -1.0)}, "limits must be ordered around 0"),
    ({"kind": "ball", "limits": (-1.0, 1.0)}, "no axis to limit or drive"),
    ({"kind": "weld", "control": "force"}, "no axis to limit or drive"),
    ({"max_force": 2.0}, "max_force belongs to a motor"),
    ({"control": "force", "stiffness": 2.0}, "stiffness and damping belong to control='position'"),
    ({"control": "position", "damping": 2.0}, "needs a finite stiffness"),
    ({"control": "position", "stiffness": -1.0}, "stiffness must be at least 0"),
    ({"control": "position", "stiffness": 0.0}, "a servo needs stiffness or damping"),
    ({"control": "velocity", "max_force": -1.0}, "max_force must be at least 0"),
    ({"name": "taken"}, "exists already"),
]


@pytest.mark.parametrize(("options", "message"), REFUSED)
def test_refused(options, message):
    """What makes no joint names the joint, the value and the remedy."""
    builder = sw.ModelBuilder()
    first, second = (builder.add_rigid(mass=1.0, inertia=(1.0, 1.0, 1.0)) for _ in range(2))
    builder.add_joint(None, first, name="taken")
    with pytest.raises(ValueError, match=message):
        builder.add_joint(first, second, **{"kind": "hinge", **options})


def test_refused_parts():
    """Parts that are no frames, do not exist, are one and the same, move as one, or cannot move at all."""
    builder = sw.ModelBuilder()
    inertia = {"mass": 1.0, "inertia": (1.0, 1.0, 1.0)}
    first, second = builder.add_rigid(**inertia), builder.add_rigid(**inertia)
    rod = builder.add_rod([[0, 0, 0], [1, 0, 0], [2, 0, 0]], radius=0.01, youngs=1e6)
    held = builder.add_rigid(kinematic=True)
    with pytest.raises(ValueError, match=r"a rod and one of its nodes as \(rod, node\)"):
        builder.add_joint(None, rod)
    with pytest.raises(ValueError, match="index 7 is outside"):
        builder.add_joint(None, (rod, 7))
    with pytest.raises(ValueError, match="does not exist"):
        builder.add_joint(None, type(first)(9))
    with pytest.raises(ValueError, match="to itself"):
        builder.add_joint((rod, -1), (rod, 2))
    builder.add_joint(None, held, name="stuck")
    with pytest.raises(ValueError, match="'stuck' connects parts that cannot move"):
        builder.finalize()
    builder.joints.pop()
    builder.attach(second, to=first)
    builder.add_joint(first, second, name="same")
    with pytest.raises(ValueError, match="'same' connects parts that are attached to each other"):
        builder.finalize()
    builder.joints.pop()
    rail = builder.add_rigid(**inertia, free_axes="y")
    builder.add_joint(None, rail, "slider", axis=(1, 0, 0), control="force", name="across")
    with pytest.raises(ValueError, match="'across': the free_axes of the child lock its axis"):
        builder.finalize()
