"""What the builder refuses: every message names the object, the value, what is allowed and the way out."""

import numpy as np
import pytest

import softwarp as sw
from softwarp import meshing
from softwarp.meshing import MeshError


@pytest.fixture
def builder() -> sw.ModelBuilder:
    """A soft cube, a floor, a box and a rod that lie apart."""
    result = sw.ModelBuilder()
    result.add_tets(
        meshing.box((0.1, 0.1, 0.1), (2, 2, 2)), material=sw.Corotational(1e5, 0.3), density=1e3, name="cube"
    )
    result.add_rigid(sw.Plane(), kinematic=True, pose=(0.0, 0.0, -1.0), name="floor")
    result.add_rigid(sw.Box((0.1, 0.1, 0.1)), mass=1.0, pose=(1.0, 0.0, 0.0), name="box")
    points = np.linspace((2.0, 0.0, 0.0), (2.0, 0.0, 1.0), 5)
    result.add_rod(points, radius=0.01, youngs=1e6, density=1e3, name="stem")
    return result


SOFT, FLOOR, BOX, STEM = 0, sw.scene.RigidBody(0), sw.scene.RigidBody(1), sw.scene.Rod(0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "exactly one of mass"),
        ({"mass": 1.0, "density": 1.0}, "exactly one of mass"),
        ({"mass": 0.0}, "mass and density must be positive"),
        ({"mass": np.nan}, "mass and density must be positive"),
        ({"mass": 1.0, "inertia": (0.0, 0.0, 0.0)}, "positive moments"),
        ({"mass": 1.0, "inertia": (1.0, 1.0, 5.0)}, "triangle inequality"),
        ({"mass": 1.0, "pose": (0.0, 0.0)}, "3 or 7 finite numbers"),
        ({"mass": 1.0, "pose": (0.0,) * 7}, "quaternion x y z w must not be zero"),
        ({"mass": 1.0, "free_axes": "q"}, "none of x, y, z, rx, ry, rz"),
        ({"mass": 1.0, "name": "cube"}, "'cube' exists already"),
        ({"kinematic": True, "max_speed": -1.0}, "max_speed must be at least 0"),
    ],
)
def test_rigid(builder, options, message):
    with pytest.raises(ValueError, match=message):
        builder.add_rigid(sw.Sphere(0.1), **options)


def test_rigid_without_shape_needs_an_inertia(builder):
    with pytest.raises(ValueError, match="has no shape: give its mass"):
        builder.add_rigid(mass=1.0)
    with pytest.raises(ValueError, match="radius"):
        builder.add_rigid(sw.Sphere(-0.1), mass=1.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"radius": -0.01}, "radius"),
        ({"radius": 0.01, "inner_radius": 0.02}, "inner"),
        ({"youngs": 0.0}, "youngs must be positive"),
        ({"nu": 0.6}, "Poisson's ratio"),
        ({"density": -1.0}, "density must be at least 0"),
        ({"stiffness": 0.0}, "stiffness factors must be positive"),
        ({"rayleigh": (-1.0, 0.0)}, "rayleigh must be two finite factors"),
        ({"contact_pieces": 0}, "contact_pieces must be an integer of at least 1"),
        ({"points": [(0.0, 0.0, 0.0)]}, "point"),
        ({"points": [(0.0, 0.0, 0.0), (0.0, 0.0, 0.0)]}, "coincide|length|apart"),
    ],
)
def test_rod(builder, options, message):
    given = {"points": [(0.0, 0.0, 0.0), (0.0, 0.0, 1.0)], "radius": 0.01, "youngs": 1e6} | options
    with pytest.raises(ValueError, match=message):
        builder.add_rod(**given)


def test_attachments(builder):
    with pytest.raises(ValueError, match="to must be a rigid body or a rod"):
        builder.attach(SOFT, nodes=[0], to=SOFT)
    with pytest.raises(ValueError, match="exactly one of nodes, box and within"):
        builder.attach(SOFT, to=BOX)
    with pytest.raises(ValueError, match=r"no node lies within 0\.01 m of rigid body 'box'; the nearest is node"):
        builder.attach(SOFT, within=0.01, to=BOX)
    with pytest.raises(ValueError, match="no node lies in box"):
        builder.attach(SOFT, box=((5.0,) * 3, (6.0,) * 3), to=BOX)
    with pytest.raises(ValueError, match="index 99 is outside"):
        builder.attach(SOFT, nodes=[99], to=BOX)
    with pytest.raises(ValueError, match="kinematic and cannot be carried"):
        builder.attach(FLOOR, to=STEM, node=0)
    builder.fix(SOFT, nodes=[3])
    with pytest.raises(ValueError, match="node 3 is fixed"):
        builder.attach(SOFT, nodes=[3], to=BOX)
    builder.attach(SOFT, nodes=[0], to=BOX)
    builder.attach(SOFT, nodes=[0], to=FLOOR)
    with pytest.raises(ValueError, match="node 0 is attached twice"):
        builder.finalize()


def test_attachment_in_a_circle(builder):
    builder.attach(BOX, to=STEM, node=0)
    builder.attach(STEM, nodes=[0], to=BOX)
    with pytest.raises(ValueError, match="attached to itself over other parts"):
        builder.finalize()


def test_fixed_axes(builder):
    with pytest.raises(ValueError, match="axes to fix must be letters of 'xyz'"):
        builder.fix(SOFT, nodes=[0], axes="w")
    with pytest.raises(ValueError, match="axes to fix must be 'xyz'"):
        builder.fix(STEM, nodes=[0], axes="x")


def test_chambers(builder):
    inner = meshing.box((0.04, 0.04, 0.04), (1, 1, 1))
    where, skin = inner.nodes + 0.03, inner.surface()
    with pytest.raises(MeshError, match="is open: edge"):
        builder.add_cavity(SOFT, where, skin[:-1])
    with pytest.raises(MeshError):
        builder.add_cavity(SOFT, where + 1.0, skin)
    with pytest.raises(ValueError, match="control must be one of pressure, volume, gas"):
        builder.add_cavity(SOFT, where, skin, control="air")
    with pytest.raises(ValueError, match="limits must be ordered"):
        builder.add_cavity(SOFT, where, skin, min_pressure=1.0, max_pressure=0.0)
    with pytest.raises(ValueError, match="no soft body"):
        builder.add_cavity(BOX, where, skin)
    builder.add_cavity(SOFT, where, skin, name="air")
    with pytest.raises(ValueError, match="cavity 'air' exists already"):
        builder.add_cavity(SOFT, where, skin, name="air")


def test_contacts(builder):
    with pytest.raises(ValueError, match="mu must be at least 0"):
        builder.add_contact(SOFT, BOX, mu=-0.1)
    with pytest.raises(ValueError, match="restitution must lie in"):
        builder.add_contact(SOFT, BOX, restitution=1.5)
    with pytest.raises(ValueError, match="alarm_distance must be at least contact_distance"):
        builder.add_contact(SOFT, BOX, contact_distance=0.01, alarm_distance=0.001)
    with pytest.raises(ValueError, match="rigid body 7 does not exist"):
        builder.add_contact(SOFT, sw.scene.RigidBody(7))
    with pytest.raises(ValueError, match="no soft body"):
        builder.add_contact(5, BOX)
    builder.add_contact(SOFT, BOX)
    with pytest.raises(ValueError, match="'box - cube' exists already"):
        builder.add_contact(BOX, SOFT)
    with pytest.raises(ValueError, match="contact_capacity must be an integer of at least 1"):
        builder.finalize(contact_capacity=0)
    sim = sw.Simulation(builder.finalize())
    with pytest.raises(ValueError, match="are no contact pair; pairs are cube - box"):
        sim.contact_force(SOFT, FLOOR)
    for part in ("cube", None, 0.5, True, -1):
        with pytest.raises(ValueError, match=r"part of a contact pair, a handle .*pairs are cube - box"):
            sim.contact_force(part, BOX)


def test_shapeless_body_touches_nothing(builder):
    ghost = builder.add_rigid(mass=1.0, inertia=(1.0, 1.0, 1.0), name="ghost")
    builder.add_contact(ghost, BOX)
    with pytest.raises(ValueError, match="'ghost' has no shape"):
        builder.finalize()


@pytest.mark.parametrize(("height", "refused"), [(0.1, False), (0.07, False), (0.02, True)])
def test_deep_overlap_at_the_start(builder, height, refused):
    ball = builder.add_rigid(sw.Sphere(0.05), mass=1.0, pose=(1.0, 0.0, height), name="ball")
    builder.add_contact(ball, BOX)
    if refused:
        with pytest.raises(ValueError, match=r"'ball' and 'box' overlap by 0\.08 m at the start .*; move them apart"):
            builder.finalize()
    else:
        sim = sw.Simulation(builder.finalize())
        for _ in range(5):
            sim.step()
        assert (sim.status == 0).all()


def test_capacity_too_small_is_counted_not_fatal(builder):
    floor = builder.add_rigid(sw.Plane(), kinematic=True, pose=(0.0, 0.0, -0.001), name="table")
    builder.add_contact(SOFT, floor)
    sim = sw.Simulation(builder.finalize(contact_capacity=3))
    sim.step()
    assert sim.status.item() == sw.Status.CONTACT_OVERFLOW
    assert sim.contact_overflow.item() == 6
    assert sim.contact_count.item() == 3
