"""What ``add_contact`` and ``finalize`` refuse, and overlaps that a scene may start with."""

import itertools
from typing import Any

import numpy as np
import pytest

import softwarp as sw
from softwarp import meshing
from tests.contact_cases import pair, run


def test_deep_overlap_is_refused() -> None:
    """Bodies that overlap by more than a radius at the start: an error with their names and the depth."""
    builder = sw.ModelBuilder()
    a = builder.add_rigid(sw.Sphere(0.1), density=1000, name="left ball")
    b = builder.add_rigid(sw.Sphere(0.1), density=1000, pose=(0.05, 0, 0), name="right ball")
    builder.add_contact(a, b)
    with pytest.raises(ValueError, match=r"left ball.*right ball.*0\.15 m"):
        builder.finalize()


PLACES = {
    "soft": (0.0, 0.0, 0.0),
    "table": (0.0, 0.0, 0.06),
    "crate": (0.05, 0.05, 0.05),
    "ball": (0.06, 0.05, 0.05),
    "hull": (0.04, 0.05, 0.05),
    "needle": (-0.1, 0.05, 0.05),
    "rod across": (0.03, -0.1, 0.055),
}


def overlapping(builder: sw.ModelBuilder, kind: str) -> int:
    """One part of those that all lie in each other."""
    place = np.array(PLACES[kind])
    if kind == "soft":
        mesh = meshing.box((0.1,) * 3, (2, 2, 2))
        return builder.add_tets(mesh, material=sw.NeoHookean(1e5, 0.4), density=1e3, name=kind)
    if kind in ("needle", "rod across"):
        along = (0.3, 0.0, 0.0) if kind == "needle" else (0.0, 0.3, 0.0)
        points = np.linspace(place, place + along, 8)
        return builder.add_rod(points, radius=0.01, youngs=1e6, density=1e3, name=kind)
    shapes: dict[str, Any] = {
        "table": sw.Plane(),
        "crate": sw.Box((0.08,) * 3),
        "ball": sw.Sphere(0.05),
        "hull": sw.RigidMesh(*sw.Box((0.1,) * 3).surface()),
    }
    mass: dict[str, Any] = {"kinematic": True} if kind == "table" else {"mass": 1.0}
    return builder.add_rigid(shapes[kind], pose=tuple(place), name=kind, **mass)


@pytest.mark.parametrize(("first", "second"), list(itertools.combinations(PLACES, 2)))
def test_deep_overlap_of_any_two_parts_is_refused(first: str, second: str) -> None:
    """Soft bodies, rods and shapes that start in each other: both names, the depth and the way out."""
    builder = sw.ModelBuilder()
    builder.add_contact(overlapping(builder, first), overlapping(builder, second))
    message = rf"'({first}' and '{second}|{second}' and '{first})' overlap by 0\.\d+ m at the start .*; move them apart"
    with pytest.raises(ValueError, match=message):
        builder.finalize()


@pytest.mark.parametrize("first", PLACES)
def test_parts_that_start_apart_are_accepted(first: str) -> None:
    """A ball 1 mm above a soft body, a rod, a shape is no overlap."""
    builder = sw.ModelBuilder()
    part = overlapping(builder, first)
    top = {"soft": 0.1, "table": 0.06, "crate": 0.09, "ball": 0.1, "hull": 0.1, "needle": 0.06, "rod across": 0.065}
    x, y = (0.03, 0.05) if first == "rod across" else (0.08, 0.05)
    drop = builder.add_rigid(sw.Sphere(0.02), mass=0.1, pose=(x, y, top[first] + 0.021))
    builder.add_contact(part, drop)
    builder.finalize()


@pytest.mark.parametrize("capacity", [0, -1, 2.5, True])
def test_capacity_is_a_positive_integer(capacity: Any) -> None:
    builder = sw.ModelBuilder()
    floor = builder.add_rigid(sw.Plane(), kinematic=True)
    builder.add_contact(builder.add_rigid(sw.Sphere(0.1), mass=1.0, pose=(0, 0, 1)), floor)
    with pytest.raises(ValueError, match=f"contact_capacity must be an integer of at least 1, got {capacity}; it"):
        builder.finalize(contact_capacity=capacity)


def test_shallow_overlap_is_pushed_apart() -> None:
    """1 cm of overlap shrinks at the recovery speed, then with the recovery time, and throws nothing into the air."""
    options = {"recovery_speed": 0.2, "recovery_time": 0.02}
    sim, body, _ = pair(sw.Plane(), sw.Sphere(0.05), (0, 0, 0.04), options=options)
    heights = [float(sim.body_pose[0, body, 2])]
    for _ in range(40):
        run(sim, 1)
        heights.append(float(sim.body_pose[0, body, 2]))
    rises = np.diff(heights)
    assert rises.max() == pytest.approx(0.002, rel=1e-6)
    assert heights[-1] == pytest.approx(0.05, abs=1e-6)
    assert max(heights) < 0.05 + 1e-9


def test_unknown_parts_and_values_are_named() -> None:
    """Parts that do not exist, pairs given twice, laws outside their ranges: errors that say which."""
    builder = sw.ModelBuilder()
    ground = builder.add_rigid(sw.Plane(), kinematic=True)
    ball = builder.add_rigid(sw.Sphere(0.1), density=1000, pose=(0, 0, 1), name="ball")
    bare = builder.add_rigid(mass=1.0, inertia=(1, 1, 1), name="bare")
    with pytest.raises(ValueError, match="rigid body 7 does not exist; the builder has 3"):
        builder.add_contact(ball, type(ball)(7))
    with pytest.raises(ValueError, match=r"0 \.\. -1"):
        builder.add_contact(ball, 3)
    for wrong, value in (
        ("mu", -0.1),
        ("mu", np.nan),
        ("restitution", 1.5),
        ("compliance", -1.0),
        ("contact_distance", np.inf),
    ):
        with pytest.raises(ValueError, match=f"'ball - .*{wrong}"):
            builder.add_contact(ball, ground, **{wrong: value})
    builder.add_contact(ball, ground)
    with pytest.raises(ValueError, match="exists already"):
        builder.add_contact(ground, ball)
    model = builder.finalize()
    with pytest.raises(ValueError, match="no contact pair"):
        sw.Simulation(model).contact_force(ball, bare)
    with pytest.raises(ValueError, match="contact_capacity"):
        builder.finalize(contact_capacity=0)
    builder.add_contact(bare, ball)
    with pytest.raises(ValueError, match="'bare' has no shape"):
        builder.finalize()


def test_planes_cannot_touch_each_other() -> None:
    builder = sw.ModelBuilder()
    a = builder.add_rigid(sw.Plane(), kinematic=True, name="floor")
    b = builder.add_rigid(sw.Plane(), kinematic=True, name="wall", pose=(0, 0, 0, 0, np.sin(0.5), 0, np.cos(0.5)))
    builder.add_contact(a, b)
    with pytest.raises(ValueError, match="floor and wall"):
        builder.finalize()


def hollow(builder: sw.ModelBuilder) -> int:
    """A closed pad, whose chamber reaches from z = -21 mm to -3.5 mm."""
    return builder.add_tets(meshing.pad().mesh, material=sw.Corotational(1e6, 0.3), density=1e3, name="pad")


@pytest.mark.parametrize(("kind", "faces"), [("ball", 96), ("floor", 96), ("self", 192)])
def test_walls_of_closed_chambers_are_reached_by_their_body_alone(kind: str, faces: int) -> None:
    """The coarse pad has 96 triangles outside and as many around its chamber; only self-contact takes all."""
    builder = sw.ModelBuilder()
    pad = hollow(builder)
    other: int = pad
    if kind == "floor":
        other = builder.add_rigid(sw.Plane(), kinematic=True, pose=(0.0, 0.0, -0.03))
    if kind == "ball":
        other = builder.add_rigid(sw.Sphere(0.005), mass=0.1, pose=(0.0, 0.0, 0.02))
    builder.add_contact(pad, other)
    contact = builder.finalize().contact
    assert contact is not None
    assert len(contact.scene.faces) == faces


def test_nothing_starts_in_a_closed_chamber() -> None:
    """It is refused as an overlap, so that leaving out the walls cannot hide a contact."""
    builder = sw.ModelBuilder()
    builder.add_contact(hollow(builder), builder.add_rigid(sw.Sphere(0.005), mass=0.1, pose=(0.0, 0.0, -0.012)))
    with pytest.raises(ValueError, match="the centre of one lies inside the other"):
        builder.finalize()


def test_a_ball_within_a_cube_overlaps_by_no_number():
    """Where no surface cuts the other there is no depth to tell: 0 m would read as if they did not overlap."""
    builder = sw.ModelBuilder()
    mesh = meshing.box((0.04,) * 3, (2,) * 3)
    cube = builder.add_tets(mesh, material=sw.Corotational(1e5, 0.4), density=1e3, name="cube")
    ball = builder.add_rigid(sw.Sphere(0.02), mass=0.1, pose=(0.02, 0.02, 0.02), name="ball")
    builder.add_contact(cube, ball)
    with pytest.raises(ValueError, match=r"'cube' and 'ball' overlap at the start \(the centre of one lies inside"):
        builder.finalize()
