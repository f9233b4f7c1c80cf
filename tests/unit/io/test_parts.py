import dataclasses

import numpy as np
import pytest

import softwarp as sw
from softwarp import meshing, shapes
from softwarp.io.arrays import TrajectoryError
from softwarp.io.parts import ChamberPoints, Parts, posed, tri_membrane
from softwarp.shapes.base import rotation_matrix
from tests.unit.io.fakes import BALL, CRATE, FLOOR, GEM, TOOL, parts_film, parts_of, rigid_shapes

UP = (0.0, 0.0, 1.0)
LEVEL = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]


def chambered():
    """A block with a void of one cell as its chamber, a membrane on top, one more vertex of it fixed in space."""
    builder = sw.ModelBuilder()
    block = meshing.box((0.03, 0.03, 0.03), (3, 3, 3))
    i = np.arange(27)
    nodes, tets = meshing.compact(block.nodes, block.tets[np.repeat(i != 13, 6)])
    body = builder.add_tets(nodes, tets, material=sw.NeoHookean(1e5, 0.4), density=1e3)
    builder.add_cable(body, [(0.005, 0.005, 0.001), (0.005, 0.005, 0.02)])
    (void,) = meshing.voids(nodes, tets)
    wall, corners = np.unique(void, return_inverse=True)
    corners = meshing.orient_surface(corners.reshape(-1, 3))
    builder.add_cavity(body, nodes[wall], corners, anchored=[0], name="void")
    skin = meshing.tet_surface(tets)
    top = skin[(nodes[skin, 2] > 0.03 - 1e-9).all(axis=1)]
    builder.add_membrane(body, top[:3], thickness=1e-4, youngs=1e6)
    builder.add_membrane(body, top[3:5], thickness=1e-4, youngs=1e6)
    return builder, nodes[wall], top


def test_pieces_give_back_the_shapes():
    """Every simple shape of every body: same triangles, same place; a compound is its members."""
    parts = parts_of(rigid_shapes())
    assert parts.piece_rigid.tolist() == [FLOOR, CRATE, BALL, TOOL, TOOL, GEM]
    for rigid, shape in enumerate(rigid_shapes()):
        members = () if shape is None else shape.parts()
        for piece, member in zip(parts.pieces(rigid), members, strict=True):
            vertices, triangles = parts.piece_surface(piece, 24)
            expected, corners = member.shape.surface(24)
            np.testing.assert_allclose(vertices, expected, atol=1e-9)
            np.testing.assert_array_equal(triangles, corners)
            np.testing.assert_array_equal(parts.piece_pose[piece], [*member.position, *member.quaternion])
            assert (parts.piece_shape(piece) is None) == isinstance(member.shape, shapes.Mesh)
    assert parts.is_plane(0)
    assert not parts.is_plane(1)


def test_a_grid_keeps_its_level_surface():
    grid = shapes.SDF.from_mesh(*shapes.Sphere(0.02).surface(16), spacing=0.004)
    parts = parts_of((grid,))
    vertices, triangles = parts.piece_surface(0)
    np.testing.assert_allclose(vertices, grid.surface()[0], atol=1e-8)
    np.testing.assert_array_equal(triangles, grid.surface()[1])


def test_boxes_around_pieces_hold_them():
    parts = parts_of(rigid_shapes())
    for piece in range(1, 6):
        corners = parts.piece_bounds(piece)
        x = posed(parts.piece_pose[piece], parts.piece_surface(piece)[0])
        np.testing.assert_allclose(corners.min(axis=0), x.min(axis=0), atol=1e-9)
        np.testing.assert_allclose(corners.max(axis=0), x.max(axis=0), atol=1e-9)


def test_posed_points_turn_and_move(rng):
    q = rng.standard_normal((2, 5, 4))
    pose = np.concatenate([rng.standard_normal((2, 5, 3)), q / np.linalg.norm(q, axis=-1, keepdims=True)], axis=-1)
    points = rng.standard_normal((4, 3))
    x = posed(pose, points)
    assert x.shape == (2, 5, 4, 3)
    np.testing.assert_allclose(x[1, 3], points @ rotation_matrix(pose[1, 3, 3:]).T + pose[1, 3, :3])


def test_ground_is_the_first_level_kinematic_plane():
    """Not a ball, not a free plane, not a tilted one; with gravity along -y, one whose z axis is turned to y."""
    tilted = [0.0, 0.0, 0.0, np.sin(0.1), 0.0, 0.0, np.cos(0.1)]
    to_y = [0.0, 0.0, 0.0, -np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]
    kinds = (shapes.Sphere(0.1), shapes.Plane(), shapes.Plane(), shapes.Plane())
    parts = dataclasses.replace(parts_of(kinds), rigid_kinematic=[True, False, True, True])
    assert parts.ground([LEVEL, LEVEL, tilted, LEVEL], UP) == 3
    assert parts.ground([LEVEL, LEVEL, LEVEL, LEVEL], UP) == 2
    assert parts.ground([LEVEL, LEVEL, tilted, tilted], UP) is None
    assert parts.ground([LEVEL, LEVEL, to_y, LEVEL], (0.0, 1.0, 0.0)) == 2
    assert Parts().ground(np.zeros((0, 7)), UP) is None


def test_scene_size_is_that_of_what_moves():
    """Soft bodies, rods and free bodies count; a large kinematic table counts only when it is alone."""
    table = (shapes.Box((2.0, 2.0, 0.1)), shapes.Sphere(0.05))
    pose = np.array([LEVEL, LEVEL])
    none = np.zeros((0, 3))
    assert parts_of(table).scene_size(none, pose, none) == pytest.approx(0.1, rel=1e-6)
    assert parts_of(table[:1]).scene_size(none, pose[:1], none) == pytest.approx(2.0)
    assert parts_of((shapes.Plane(),)).scene_size(none, pose[:1], none) == 1.0
    soft = np.array([[0.0, 0.0, 0.0], [0.0, 0.3, 0.1]])
    assert Parts().scene_size(soft, np.zeros((0, 7)), none) == pytest.approx(0.3)
    rod = Parts(rod_names=("r",), rod_point_start=[0, 2], rod_radius=[0.01, 0.02])
    assert rod.scene_size(none, np.zeros((0, 7)), np.array([[0.0, 0, 0], [0, 0, 0.4]])) == pytest.approx(0.43)


def test_chamber_points_follow_their_nodes():
    """At rest they are the builder's vertices; moved nodes carry them along, those fixed in space stay."""
    builder, vertices, _ = chambered()
    model = builder.finalize(1)
    points = ChamberPoints(model)
    np.testing.assert_allclose(points(model.node_rest[None])[0], vertices, atol=1e-7)
    moved = points(np.stack([model.node_rest, 2.0 * model.node_rest + (0.0, 0.0, 1.0)]))
    np.testing.assert_allclose(moved[1, 1:], 2.0 * vertices[1:] + (0.0, 0.0, 1.0), atol=1e-6)
    np.testing.assert_allclose(moved[1, 0], vertices[0], atol=1e-7)
    parts = Parts.of_model(model)
    assert parts.cavity_names == ("void",)
    assert parts.cavity_points(0) == slice(0, len(vertices))
    assert meshing.surface_volume(vertices, parts.cavity_tri) == pytest.approx(1e-6)


def test_membranes_are_found_on_the_surface():
    builder, _, top = chambered()
    model = builder.finalize(1)
    cover = tri_membrane(model.surface_tri, model.membranes)
    for number, triangles in ((0, top[:3]), (1, top[3:5])):
        expected = {tuple(sorted(t)) for t in triangles.tolist()}
        assert {tuple(sorted(t)) for t in model.surface_tri[cover == number].tolist()} == expected
    assert (cover >= 0).sum() == 5


def test_rods_and_joints_of_a_model():
    """Radii per node, the larger of both sides; joint lines start at the anchor and follow the axis."""
    builder = sw.ModelBuilder()
    rod = builder.add_rod(meshing.straight(0.2, 2), radius=[0.01, 0.005], youngs=1e6)
    builder.fix(rod, nodes=[0])
    arm = builder.add_rigid(sw.Box((0.1, 0.02, 0.02)), density=1e3, pose=(0.3, 0.0, 0.0))
    builder.add_joint(None, arm, "hinge", anchor=(0.25, 0.0, 0.0), axis=(0.0, 2.0, 0.0), name="elbow")
    builder.add_joint((rod, 2), arm, "ball", anchor=(0.0, 0.0, 0.2), name="tie")
    model = builder.finalize(1)
    parts = Parts.of_model(model)
    np.testing.assert_allclose(parts.rod_radius, [0.01, 0.01, 0.005], rtol=1e-6)
    assert parts.joint_names == ("elbow", "tie")
    assert parts.joint_frame.tolist() == [[-1, 0], [3, 0]]
    line = parts.joint_line(0, model.frames.rest_pose[None], 0.1)
    np.testing.assert_allclose(line[0], [[0.25, 0, 0], [0.25, -0.1, 0], [0.25, 0.1, 0]], atol=1e-6)
    np.testing.assert_allclose(parts.joint_line(1, model.frames.rest_pose, 0.1)[0], [0.0, 0.0, 0.2], atol=1e-6)


def test_inconsistent_parts_are_refused():
    parts = parts_film(1).parts
    for change, message in (
        ({"rod_radius": [0.1]}, r"rod_radius must have shape \(rod_point 5\), got \(1,\)"),
        ({"rod_point_start": [0, 4]}, r"rod_radius must have shape \(rod_point 4\)"),
        ({"cavity_tri": parts.cavity_tri + 1}, r"cavity_tri must lie in \[0, 16\), got 1 to 16"),
        ({"joint_frame": parts.joint_frame + 20}, r"joint_frame must lie in \[-1, 11\)"),
        ({"piece_rigid": parts.piece_rigid + 5}, r"piece_rigid must lie in \[0, 6\)"),
        ({"rigid_kinematic": np.zeros(0)}, r"rigid_kinematic is missing; it must have shape \(6,\)"),
        ({"piece_tri_start": [0, 0, 0, 0, 0, 0, 3]}, "piece_tri_start must rise from 0 to 12 in 6 steps"),
    ):
        with pytest.raises(TrajectoryError, match=message):
            dataclasses.replace(parts, **change)
