"""Reading mesh files: round trips through every format, and every refusal."""

import meshio
import numpy as np
import pytest
import trimesh

from softwarp import meshing
from softwarp.io.mesh import read_mesh
from softwarp.meshing import MeshError, SurfaceMesh, TetMesh

BOX = meshing.box((3.0, 2.0, 1.0), (3, 2, 1))
VOLUME_FORMATS = [("vtk", "vtk42"), ("vtk", "vtk51"), ("vtu", "vtu"), ("msh", "gmsh22"), ("msh", "gmsh")]


def write(path, cells, file_format=None, nodes=BOX.nodes, **options):
    meshio.Mesh(nodes, cells).write(path, file_format=file_format, **options)
    return path


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize(("suffix", "file_format"), VOLUME_FORMATS)
def test_tets_keep_their_order_through_every_format(tmp_path, suffix, file_format, binary):
    path = write(tmp_path / f"block.{suffix}", [("tetra", BOX.tets)], file_format, binary=binary)
    mesh = read_mesh(path)
    assert isinstance(mesh, TetMesh)
    assert mesh.name == f"block.{suffix}"
    np.testing.assert_allclose(mesh.nodes, BOX.nodes, atol=1e-12)
    np.testing.assert_array_equal(mesh.tets, BOX.tets)


@pytest.mark.parametrize(("suffix", "file_format"), VOLUME_FORMATS)
def test_quadratic_tets(tmp_path, suffix, file_format):
    """10-node tetrahedra with six-node triangles beside them; edge nodes come in another order."""
    high = meshing.elevate(BOX, project=lambda x: x + 0.05 * np.sin(2.0 * x[:, [1, 2, 0]]))
    theirs = high.elements[:, [0, 1, 2, 3, 4, 7, 5, 6, 8, 9]]
    path = write(tmp_path / f"block.{suffix}", [("tetra10", theirs)], file_format, nodes=high.nodes)
    mesh = read_mesh(path, scale=0.5)
    assert isinstance(mesh, meshing.QuadraticMesh)
    np.testing.assert_allclose(mesh.nodes, 0.5 * high.nodes, atol=1e-12)
    np.testing.assert_array_equal(mesh.elements, high.elements)
    with pytest.raises(MeshError, match="36 quadratic elements of ten nodes; pass it to add_tets as it is"):
        _ = mesh.tets
    mirrored = theirs[:, [0, 1, 3, 2, 4, 8, 7, 6, 5, 9]]
    path = write(tmp_path / f"mirrored.{suffix}", [("tetra10", mirrored)], file_format, nodes=high.nodes)
    with pytest.raises(MeshError, match="inverted"):
        read_mesh(path)
    assert read_mesh(path, orient=True).volume == pytest.approx(high.volume)


def test_scale_gives_metres(tmp_path):
    path = write(tmp_path / "block.vtu", [("tetra", BOX.tets)])
    mesh = read_mesh(str(path), scale=1e-3)
    assert isinstance(mesh, TetMesh)
    np.testing.assert_allclose(mesh.nodes, BOX.nodes * 1e-3, rtol=1e-15)
    assert mesh.volume == pytest.approx(6e-9)


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf, True])
def test_scale_must_be_positive(tmp_path, scale):
    path = write(tmp_path / "block.vtu", [("tetra", BOX.tets)])
    with pytest.raises(MeshError, match=r"'block.vtu': scale must lie in .*, got .*0\.001 reads millimetres"):
        read_mesh(path, scale=scale)


def test_boundary_cells_beside_tets_are_left_out(tmp_path):
    cells = [("vertex", [[0]]), ("line", [[0, 1]]), ("triangle", BOX.surface()), ("tetra", BOX.tets[:20])]
    mesh = read_mesh(write(tmp_path / "block.msh", [*cells, ("tetra", BOX.tets[20:])], "gmsh22"))
    assert isinstance(mesh, TetMesh)
    np.testing.assert_array_equal(mesh.tets, BOX.tets)


def test_triangles_alone_are_a_surface(tmp_path):
    mesh = read_mesh(write(tmp_path / "skin.vtk", [("line", [[0, 1]]), ("triangle", BOX.surface())]))
    assert isinstance(mesh, SurfaceMesh)
    np.testing.assert_array_equal(mesh.triangles, BOX.surface())
    with pytest.raises(MeshError, match=r"'skin.vtk' is a surface"):
        _ = mesh.tets


@pytest.mark.parametrize(
    ("cells", "counts"),
    [
        ([("tetra", BOX.tets), ("hexahedron", [list(range(8))])], "1 hexahedron, 36 tetra"),
        ([("tetra10", [list(range(10))]), ("tetra", BOX.tets)], "36 tetra, 1 tetra10"),
        ([("quad", [[0, 1, 2, 3]]), ("triangle", [[0, 1, 2]])], "1 quad, 1 triangle"),
        ([("line", [[0, 1], [1, 2]])], "2 line"),
    ],
)
def test_other_elements_are_refused_with_counts(tmp_path, cells, counts):
    with pytest.raises(MeshError, match=rf"'mixed.vtu' holds {counts}; only 4-node.*Remesh"):
        read_mesh(write(tmp_path / "mixed.vtu", cells))


def test_inverted_tets_are_refused_or_oriented(tmp_path):
    tets = BOX.tets.copy()
    tets[5] = tets[5][[0, 1, 3, 2]]
    path = write(tmp_path / "block.vtu", [("tetra", tets)])
    with pytest.raises(MeshError, match=r"'block.vtu': 1 of 36 tetrahedra are inverted.*first: 5.*orient=True"):
        read_mesh(path)
    mesh = read_mesh(path, orient=True)
    np.testing.assert_array_equal(mesh.tets, BOX.tets)


def test_unused_nodes_are_refused_or_dropped(tmp_path):
    nodes = np.vstack([[[7.0, 7.0, 7.0]], BOX.nodes])
    path = write(tmp_path / "block.vtu", [("tetra", BOX.tets + 1)], nodes=nodes)
    with pytest.raises(MeshError, match=r"1 of 25 nodes belong to no tetrahedron.*compact"):
        read_mesh(path)
    mesh = read_mesh(path, compact=True)
    np.testing.assert_array_equal(mesh.nodes, BOX.nodes)
    np.testing.assert_array_equal(mesh.tets, BOX.tets)


@pytest.mark.parametrize("repairs", [{}, {"orient": True, "compact": True}])
def test_missing_nodes_are_refused(tmp_path, repairs):
    path = tmp_path / "block.vtk"
    write(path, [("tetra", BOX.tets)], "vtk42", binary=False)
    text = path.read_text()
    path.write_text(text.replace("\n4 0 1 5 17", "\n4 0 1 5 99").replace("\n4\n0\n1\n", "\n4\n99\n1\n"))
    assert path.read_text() != text
    with pytest.raises(MeshError, match="missing node"):
        read_mesh(path, **repairs)


def test_stl_corners_are_welded(tmp_path):
    path = tmp_path / "skin.stl"
    trimesh.Trimesh(BOX.nodes, BOX.surface(), process=False).export(path)
    mesh = read_mesh(path, scale=0.1)
    assert isinstance(mesh, SurfaceMesh)
    assert len(mesh.nodes) == len(BOX.nodes)
    np.testing.assert_allclose(mesh.nodes[mesh.triangles], 0.1 * BOX.nodes[BOX.surface()], atol=1e-7)


def test_ascii_stl_is_read_and_its_empty_facets_are_dropped(tmp_path):
    path = tmp_path / "skin.stl"
    facet = "facet normal 0 0 1\n outer loop\n  vertex 0 0 0\n  vertex {}\n  vertex 0 1 0\n endloop\nendfacet\n"
    path.write_text("solid skin\n" + facet.format("1 0 0") + facet.format("0 1 0") + "endsolid skin\n")
    mesh = read_mesh(path)
    np.testing.assert_array_equal(mesh.nodes, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(mesh.triangles, [[0, 1, 2]])


def test_obj_keeps_its_order(tmp_path):
    path = tmp_path / "skin.obj"
    trimesh.Trimesh(BOX.nodes, BOX.surface(), process=False).export(path)
    mesh = read_mesh(path)
    np.testing.assert_allclose(mesh.nodes, BOX.nodes, atol=1e-7)
    np.testing.assert_array_equal(mesh.triangles, BOX.surface())


def test_obj_polygons_are_triangulated(tmp_path):
    path = tmp_path / "plate.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    mesh = read_mesh(path)
    corner = mesh.nodes[mesh.triangles]
    area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])[:, 2] / 2.0
    assert len(area) == 2
    assert area.sum() == pytest.approx(1.0)


def test_missing_file_names_its_neighbours(tmp_path):
    write(tmp_path / "trunk.vtu", [("tetra", BOX.tets)])
    with pytest.raises(FileNotFoundError, match=r"trunc.vtu' does not exist; nearest in its folder: trunk.vtu"):
        read_mesh(tmp_path / "trunc.vtu")
    with pytest.raises(FileNotFoundError, match="does not exist; check the path"):
        read_mesh(tmp_path / "nowhere" / "trunk.vtu")


def test_folders_and_unknown_suffixes_are_refused(tmp_path):
    with pytest.raises(MeshError, match=r"is a folder; name a file in it that ends in .vtk, .vtu, .msh, .stl, .obj"):
        read_mesh(tmp_path)
    (tmp_path / "part.step").write_text("ISO-10303-21;")
    with pytest.raises(MeshError, match=r"'part.step': cannot read files ending in '.step'.*meshio convert part.step"):
        read_mesh(tmp_path / "part.step")


@pytest.mark.parametrize("suffix", ["vtk", "vtu", "msh", "stl", "obj"])
@pytest.mark.parametrize("content", [b"", b"hello\nworld 1 2 3\n" * 20, bytes(range(256)) * 9, b"<VTKFile/>"])
def test_broken_content_is_refused(tmp_path, capfd, suffix, content):
    """One error that names the file; nothing printed, and no exit, which some parsers do."""
    path = tmp_path / f"broken.{suffix}"
    path.write_bytes(content)
    with pytest.raises(MeshError, match=rf"'broken.{suffix}'"):
        read_mesh(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
@pytest.mark.parametrize(("suffix", "file_format"), VOLUME_FORMATS)
def test_files_cut_short_are_refused(tmp_path, suffix, file_format, share):
    path = write(tmp_path / f"block.{suffix}", [("tetra", BOX.tets)], file_format)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(MeshError, match=rf"'block.{suffix}'"):
        read_mesh(path)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_surfaces_cut_short_are_refused(tmp_path, share):
    path = tmp_path / "skin.stl"
    trimesh.Trimesh(BOX.nodes, BOX.surface(), process=False).export(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(MeshError, match=r"'skin.stl' holds no triangles, or is cut short"):
        read_mesh(path)


def test_ansys_files_are_named(tmp_path):
    path = write(tmp_path / "block.msh", [("tetra", BOX.tets)], "ansys")
    with pytest.raises(MeshError, match=r"'block.msh' is an Ansys file; export it from gmsh"):
        read_mesh(path)
