"""Bad air chambers are refused with a message that names the chamber, the place or value, and the remedy."""

import numpy as np
import pytest

import softwarp as sw
from softwarp import meshing
from softwarp.meshing import MeshError


@pytest.fixture
def builder():
    """One soft cube of 0.1 m, body 0."""
    builder = sw.ModelBuilder()
    builder.add_tets(meshing.box((0.1, 0.1, 0.1), (4, 4, 4)), material=sw.NeoHookean(1e5, 0.4), density=1000.0)
    return builder


def skin():
    """Vertices and outward triangles of a cube of 0.04 m in the middle of the body."""
    cube = meshing.box((0.04, 0.04, 0.04), (1, 1, 1))
    return cube.nodes + 0.03, cube.surface()


def test_open_surface_names_the_edge(builder):
    vertices, triangles = skin()
    with pytest.raises(MeshError, match=r"'air' is open: edge \d+-\d+ from .* m belongs to triangle \d+ only"):
        builder.add_cavity(0, vertices, triangles[:-1], name="air")


def test_badly_oriented_surface_names_the_edge(builder):
    vertices, triangles = skin()
    triangles = np.array(triangles)
    triangles[3] = triangles[3, ::-1]
    with pytest.raises(MeshError, match=r"'air' is badly oriented: triangles \d+ and \d+ run along edge"):
        builder.add_cavity(0, vertices, triangles, name="air")


def test_surface_that_is_inward_as_a_whole_is_turned(builder):
    vertices, triangles = skin()
    builder.add_cavity(0, vertices, triangles[:, ::-1])
    sim = sw.Simulation(builder.finalize(precision="float64"))
    np.testing.assert_allclose(sim.cavity_volume.item(), 0.04**3, rtol=1e-12)


def test_vertex_outside_the_body_is_named(builder):
    vertices, triangles = skin()
    with pytest.raises(MeshError, match="cavity 'air': vertex"):
        builder.add_cavity(0, vertices + 0.05, triangles, name="air")


def test_flat_surface_is_refused(builder):
    vertices, triangles = skin()
    with pytest.raises(MeshError, match=r"'air': .* encloses no volume"):
        builder.add_cavity(0, vertices * (1.0, 1.0, 0.0) + (0.0, 0.0, 0.05), triangles, name="air")


BAD_VALUES = [
    ({"control": "air"}, "control must be one of pressure, volume, gas, got 'air'"),
    ({"min_pressure": 2.0, "max_pressure": 1.0}, "limits must be ordered"),
    ({"min_volume": 2.0, "max_volume": 1.0}, "limits must be ordered"),
    ({"max_pressure_rate": -1.0}, "rates at least 0"),
    ({"max_flow": -1.0}, "rates at least 0"),
    ({"max_pressure": float("nan")}, "max_pressure must be a number, got nan"),
    ({"ambient": 0.0}, "ambient must be positive"),
    ({"exponent": -1.4}, "exponent must be positive"),
]


@pytest.mark.parametrize(("options", "message"), BAD_VALUES)
def test_bad_value_is_named(builder, options, message):
    with pytest.raises(ValueError, match=f"cavity 'air': .*{message}"):
        builder.add_cavity(0, *skin(), name="air", **options)


def test_name_is_used_once(builder):
    builder.add_cavity(0, *skin(), name="air")
    with pytest.raises(ValueError, match="cavity 'air' exists already"):
        builder.add_cavity(0, *skin(), name="air")


@pytest.mark.parametrize("capacity", [0, -3])
def test_contact_capacity_is_checked_beside_a_chamber(builder, capacity):
    builder.add_cavity(0, *skin())
    ball = builder.add_rigid(sw.Sphere(0.01), mass=0.1, pose=(0.05, 0.05, 0.2))
    builder.add_contact(0, ball)
    with pytest.raises(ValueError, match=f"contact_capacity must be .* got {capacity}"):
        builder.finalize(contact_capacity=capacity)


@pytest.mark.parametrize("six", [False, True])
def test_corners_of_quadratic_faces_alone_are_warned_of(six, recwarn):
    """Their middles would feel no pressure; all six nodes of every face, of the body's linear mesh, are right."""
    builder, box = sw.ModelBuilder(), meshing.box((0.1, 0.1, 0.1), (2, 2, 2))
    body = builder.add_tets(box, material=sw.NeoHookean(1e5, 0.4), density=1000.0, element="p2")
    mesh = builder.bodies[body].mesh if six else box
    builder.add_cavity(body, *meshing.compact(mesh.nodes, mesh.surface()), name="air")
    told = [str(warning.message) for warning in recwarn]
    assert told == [] if six else "'air': 48 of its triangles have only the corners" in told[0]
