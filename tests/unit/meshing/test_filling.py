"""From surfaces to solids: inputs, cavities, reports, curved elements, refusals."""

import re
import shutil
import warnings

import numpy as np
import pytest
import trimesh

import softwarp as sw
from softwarp import meshing
from softwarp.meshing import MeshError, SurfaceMesh
from softwarp.meshing.filling import MOST_POINTS, _points
from softwarp.meshing.lattice import lattice_around
from softwarp.meshing.nearest import nearest
from softwarp.meshing.sharp import _along, _features

OUTER, INNER = trimesh.creation.icosphere(3, radius=0.1), trimesh.creation.icosphere(3, radius=0.06)
EDGE = 0.019


@pytest.fixture(scope="module")
def ball() -> meshing.SolidMesh:
    """A hollow ball."""
    return meshing.tetrahedralize(OUTER, edge_length=EDGE, cavities={"air": INNER}, name="ball")


def assert_same(a: meshing.TetMesh, b: meshing.TetMesh) -> None:
    np.testing.assert_allclose(a.nodes, b.nodes, atol=1e-7)
    np.testing.assert_array_equal(a.tets, b.tets)


@pytest.mark.parametrize("kind", ["stl", "obj", "ply", "off"])
def test_files(kind, tmp_path):
    path = tmp_path / f"part.{kind}"
    OUTER.export(path)
    solid = meshing.tetrahedralize(path, edge_length=0.04)
    assert solid.name == path.name
    assert solid.volume == pytest.approx(OUTER.volume, rel=0.06)
    assert sw.read_mesh(path).triangles.shape == OUTER.faces.shape


def test_kinds_of_surfaces_give_the_same_solid():
    x, t = np.array(OUTER.vertices), np.array(OUTER.faces)
    solid = meshing.tetrahedralize(OUTER, edge_length=0.04)
    for value in ((x, t), SurfaceMesh(x, t), (x, t[:, ::-1]), (x[t].reshape(-1, 3), np.arange(t.size).reshape(-1, 3))):
        other = meshing.tetrahedralize(value, edge_length=0.04)
        assert len(other.tets) == len(solid.tets)
        assert other.volume == pytest.approx(solid.volume, rel=1e-6)


def test_scale_turns_millimetres_into_metres():
    large = (1000.0 * OUTER.vertices, OUTER.faces)
    assert_same(
        meshing.tetrahedralize(large, edge_length=0.04, scale=1e-3), meshing.tetrahedralize(OUTER, edge_length=0.04)
    )


def test_shells_inside_are_cavities_however_they_are_turned(ball):
    """By name or by nesting, inward or outward: the same solid, and a wall around the air of the inner surface."""
    inward = INNER.copy()
    inward.invert()
    for turned in (INNER, inward):
        nested = meshing.tetrahedralize(trimesh.util.concatenate([OUTER, turned]), edge_length=EDGE)
        assert list(nested.cavities) == ["cavity 0"]
        assert_same(nested, ball)
    wall = ball.cavities["air"]
    meshing.check_closed(wall.nodes, wall.triangles)
    assert wall.volume == pytest.approx(INNER.volume, rel=0.03)
    np.testing.assert_array_equal(ball.nodes[wall.node], wall.nodes)
    assert ball.volume == pytest.approx(OUTER.volume - INNER.volume, rel=0.02)


def test_two_cavities_keep_their_names():
    """Of a block with a large and a small bubble."""
    block = trimesh.creation.box((0.3, 0.1, 0.1))
    bubbles = {}
    for name, x, radius in (("right", 0.08, 0.02), ("left", -0.07, 0.03)):
        bubbles[name] = trimesh.creation.icosphere(2, radius=radius)
        bubbles[name].apply_translation((x, 0.0, 0.0))
    solid = meshing.tetrahedralize(block, edge_length=0.01, cavities=bubbles)
    assert list(solid.cavities) == ["right", "left"]
    for name, bubble in bubbles.items():
        assert solid.cavities[name].volume == pytest.approx(bubble.volume, rel=0.1)
        np.testing.assert_allclose(solid.cavities[name].nodes.mean(axis=0), bubble.centroid, atol=2e-3)


def test_report(ball):
    """Counts and figures against those of the arrays; distances below the sagitta h^2 / 8r of a facet."""
    report = ball.report()
    assert (report.nodes, report.tets) == (len(ball.nodes), len(ball.tets))
    assert report.volume_error == pytest.approx(ball.volume / (OUTER.volume - INNER.volume) - 1.0, abs=1e-9)
    assert report.dihedral == pytest.approx(meshing.min_dihedral(ball.nodes, ball.tets).min())
    assert report.radius_ratio == pytest.approx(meshing.radius_ratio(ball.nodes, ball.tets).min())
    assert report.edges[0] < report.edges[1] < report.edges[2] < 2.0 * EDGE
    assert report.edges[1] == pytest.approx(EDGE, rel=0.1)
    assert 0.0 < report.mean_deviation < report.deviation < (2.0 * EDGE) ** 2 / (8.0 * 0.06)
    assert report.wall == pytest.approx(0.04, rel=0.15)
    assert "solid 'ball' (lattice)" in str(report)
    assert "cavity 'air'" in str(report)


def test_picture(ball, tmp_path):
    """Two views side by side, with something in each."""
    from PIL import Image

    image = np.asarray(Image.open(ball.picture(tmp_path / "ball.png", size=120)))
    assert image.shape == (120, 240, 3)
    assert (image[:, :120] < 200).any(axis=2).mean() > 0.3
    assert (image[:, 120:] < 200).any(axis=2).mean() > 0.3
    with pytest.raises(ValueError, match=r"must end in .png"):
        ball.picture(tmp_path / "ball.txt")


def angle_iron() -> trimesh.Trimesh:
    """An L-shaped prism, with an edge that is concave."""
    x = np.array([(0.0, 0.0), (0.1, 0.0), (0.1, 0.04), (0.04, 0.04), (0.04, 0.1), (0.0, 0.1)])
    low, high = (np.column_stack([x, np.full(6, z)]) for z in (0.0, 0.05))
    cap = np.array([(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)])
    sides = [(k, (k + 1) % 6, (k + 1) % 6 + 6) for k in range(6)] + [(k, (k + 1) % 6 + 6, k + 6) for k in range(6)]
    return trimesh.Trimesh(np.concatenate([low, high]), np.concatenate([cap[:, ::-1], cap + 6, sides]), process=False)


@pytest.mark.parametrize("make", [lambda: trimesh.creation.box((0.1, 0.06, 0.04)), angle_iron], ids=["box", "L"])
@pytest.mark.parametrize("turn", [0.5, 0.9])
def test_sharp_edges_are_found_again(make, turn):
    """Of a solid that no plane of the lattice fits: most of its edges are those of elements, and all good ones.

    Points of the edges lie a sixth of what they did from the surface without moves, and 1 % of the volume is lost
    at most, of 4 %; 10 degrees is what the lattice promises.
    """
    solid = make()
    solid.apply_transform(trimesh.transformations.rotation_matrix(turn, (1, 2, 3)))
    x, t = np.asarray(solid.vertices), np.asarray(solid.faces)
    edges = _along(_features(x, t)[0], 0.001)
    away, missing = [], []
    for flag in (True, False):
        mesh = meshing.tetrahedralize(solid, edge_length=0.01, sharp_edges=flag)
        away.append(np.linalg.norm(nearest(mesh.nodes, mesh.surface(), edges, 0.02)[0] - edges, axis=1))
        missing.append(1.0 - mesh.volume / solid.volume)
        assert meshing.min_dihedral(mesh.nodes, mesh.tets).min() > 10.0
    assert (away[0] < 2e-4).mean() > 0.65
    assert away[0].mean() < 0.22 * away[1].mean()
    assert 0.0 < missing[0] < 0.25 * missing[1]


@pytest.mark.parametrize("thickness", [0.003, 0.0007, 0.0041])
def test_walls_of_one_edge_are_meshed(thickness):
    """Exactly, or thinner by what a file in float32 makes of it; thinner ones are refused in words that hold."""
    plate = trimesh.creation.box((20.0 * thickness, 10.0 * thickness, thickness))
    for part in (1.0, 1.0 - 1e-6, 0.993):
        with pytest.warns(UserWarning, match="take edge_length="):
            mesh = meshing.tetrahedralize(plate, edge_length=thickness / part, method="lattice")
        assert mesh.volume == pytest.approx(plate.volume, rel=1e-4)
    with pytest.raises(MeshError, match=r"is 0\.98 edges thick"):
        meshing.tetrahedralize(plate, edge_length=thickness / 0.98, method="lattice")


@pytest.mark.parametrize("thickness", [0.00199, 0.00333, 0.0101, 0.00096])
def test_advised_edges_are_taken(thickness):
    """As typed, without another refusal or warning: two edges across, never fewer by rounding."""
    plate = trimesh.creation.box((8.0 * thickness, 5.0 * thickness, thickness))
    with pytest.raises(MeshError) as refused:
        meshing.tetrahedralize(plate, edge_length=1.3 * thickness, method="lattice")
    edge = float(re.search(r"take edge_length=(\S+?),", str(refused.value))[1])
    assert 2.0 <= thickness / edge < 2.2
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        meshing.tetrahedralize(plate, edge_length=edge, method="lattice")


@pytest.mark.parametrize("edge", [1e-5, 3.3e-4, 4.1e-4])
def test_advised_edges_are_long_enough(edge):
    """Those of a surface that is too large for its edges, with the layer of cells around it."""
    with pytest.raises(MeshError) as refused:
        meshing.tetrahedralize(OUTER, edge_length=edge)
    advised = float(re.search(r"take (\S+) m or more", str(refused.value))[1])
    low, high = OUTER.bounds
    assert lattice_around(low, high, advised).count <= 1.5 * MOST_POINTS
    assert _points(high - low, advised) <= MOST_POINTS < _points(high - low, 0.9 * advised)


def test_curved_elements_follow_the_surface():
    """Of a fine sphere: straight elements miss 3 %, curved ones of the same nodes 0.1 %; none folds."""
    fine = trimesh.creation.icosphere(5, radius=0.1)
    solid = meshing.tetrahedralize(fine, edge_length=0.03)
    curved = solid.curved()
    assert abs(solid.volume / fine.volume - 1.0) > 0.02
    assert abs(curved.volume / fine.volume - 1.0) < 1e-3
    np.testing.assert_array_equal(curved.nodes[: len(solid.nodes)], solid.nodes)


def test_an_edge_that_would_fold_its_element_is_drawn_back():
    """One of a box is projected to the far side: refused as it is, straightened on request, the others kept."""
    box = meshing.box((1.0, 1.0, 1.0), (2, 2, 2))

    def project(points):
        moved = points * 1.01
        moved[0] += (0.0, 0.0, 0.7)
        return moved

    with pytest.raises(MeshError):
        meshing.elevate(box, project=project)
    curved = meshing.elevate(box, project=project, straighten=True)
    assert curved.volume > 1.0


def test_named_wall_becomes_a_chamber():
    """Of linear and of quadratic elements; the volume at rest is that of the wall, and nearly that of a sphere."""
    hole = trimesh.creation.icosphere(3, radius=0.04)
    ball = meshing.tetrahedralize(OUTER, edge_length=0.03, cavities={"air": hole})
    for mesh, element in ((ball, None), (ball, "p2"), (ball.curved(), None)):
        builder = sw.ModelBuilder()
        body = builder.add_tets(mesh, material=sw.NeoHookean(1e5, 0.4), density=1000.0, element=element)
        cavity = builder.add_cavity(body, ball.cavities["air"])
        spec = builder.scene.cavities[cavity]
        assert spec.name == "air"
        volume = meshing.surface_volume(spec.vertices, spec.triangles)
        if isinstance(mesh, meshing.QuadraticMesh):
            assert volume == pytest.approx(hole.volume, rel=0.04)
        else:
            assert volume == pytest.approx(ball.cavities["air"].volume, rel=1e-9)
            assert abs(volume / hole.volume - 1.0) > 0.2


def test_wall_of_another_solid_is_refused(ball):
    builder = sw.ModelBuilder()
    mesh = meshing.box((0.3, 0.3, 0.3), (2, 2, 2))
    body = builder.add_tets(mesh, material=sw.NeoHookean(1e5, 0.4), density=1000.0, element="p2")
    with pytest.raises(ValueError, match="cavity 'air': its wall belongs to another solid"):
        builder.add_cavity(body, ball.cavities["air"])
    with pytest.raises(ValueError, match="triangles are missing"):
        builder.add_cavity(body, ball.cavities["air"].nodes)


def shifted(mesh: trimesh.Trimesh, x: float) -> trimesh.Trimesh:
    moved = mesh.copy()
    moved.apply_translation((x, 0.0, 0.0))
    return moved


BROKEN = np.array(OUTER.vertices)
BROKEN[3] = np.nan
HALF_TURNED = np.concatenate([OUTER.faces[:5, ::-1], OUTER.faces[5:]])
REFUSED = [
    ((OUTER.vertices, OUTER.faces[1:]), {}, "surface 'part' is open: edge .* close the hole"),
    ((OUTER.vertices, HALF_TURNED), {}, "surface 'part' is badly oriented: .* use meshing.orient_surface"),
    ((BROKEN, OUTER.faces), {}, "'part': 1 nodes are not finite .first: 3"),
    ((np.zeros((0, 3)), np.zeros((0, 3), dtype=int)), {}, "'part': holds no triangle"),
    ((np.zeros((3, 3)), [[0, 1, 2]]), {}, "every triangle shrinks"),
    (3, {}, "'part': cannot make a surface of int; give the path"),
    ("part.step", {}, "does not exist"),
    (
        trimesh.util.concatenate([OUTER, shifted(OUTER, 0.1)]),
        {},
        "crosses itself or another shell near .* meshing.union",
    ),
    (OUTER, {"edge_length": 0.0}, r"edge_length \[m\] must lie in .*got 0"),
    (OUTER, {"edge_length": float("nan")}, r"edge_length \[m\] must .* got nan"),
    (OUTER, {"edge_length": 0.11}, "edge_length must be at most half of its extent of 0.2 m, got 0.11"),
    (
        OUTER,
        {"edge_length": 1e-5},
        r"edge_length=1e-05 m is too short for an extent of 0.2 m: .* take [\d.e-]+ m or more",
    ),
    (OUTER, {"scale": -1.0}, "scale must lie in .*0.001 reads millimetres"),
    (OUTER, {"cavities": [INNER]}, "cavities must be surfaces by name, {name: surface}, got "),
    (OUTER, {"strict": 1}, "strict must be True or False"),
    (OUTER, {"method": "magic"}, "method must be one of auto, lattice, tetwild, gmsh"),
    (OUTER, {"cavities": {"air": shifted(INNER, 0.2)}}, "cavity 'air': does not lie inside surface 'part'"),
    (OUTER, {"cavities": {"air": shifted(INNER, 0.05)}}, "crosses itself or another shell"),
    (OUTER, {"cavities": {"air": INNER, "more": trimesh.creation.icosphere(2, radius=0.03)}}, "lies within a cavity"),
    (OUTER, {"cavities": {"air": trimesh.util.concatenate([shifted(INNER, 0.5), INNER])}}, "does not lie inside"),
    (
        OUTER,
        {"edge_length": 0.05, "cavities": {"air": INNER}, "method": "lattice"},
        r"thinnest wall, 0.03\d* m at .* edges thick .*edge_length=0.019",
    ),
]


@pytest.mark.parametrize(("surface", "options", "message"), REFUSED)
def test_refusals(surface, options, message):
    with pytest.raises((MeshError, FileNotFoundError), match=message):
        meshing.tetrahedralize(surface, **({"edge_length": 0.04, "name": "part"} | options))


def test_a_lost_gap_is_refused_unless_asked_for():
    """Two plates 0.4 edges apart would become one body with a torn gap."""
    plates = [trimesh.creation.box((0.2, 0.2, 0.05)) for _ in range(2)]
    plates[1].apply_translation((0.0, 0.0, 0.054))
    both = trimesh.util.concatenate(plates)
    both.apply_transform(trimesh.transformations.rotation_matrix(0.4, (1, 2, 3)))
    with pytest.raises(MeshError, match=r"narrowest gap measures 0.004 m at .* strict=False"):
        meshing.tetrahedralize(both, edge_length=0.02, method="lattice")


def test_a_single_element_across_is_told():
    with pytest.warns(UserWarning, match=r"thinnest wall, 0.03\d* m at .* edges thick: bending .* edge_length=0.01"):
        meshing.tetrahedralize(OUTER, edge_length=0.03, cavities={"air": INNER})


def test_missing_meshers_are_named(monkeypatch):
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ImportError, match=r"gmsh.*GPL and not part of softwarp: install it yourself"):
        meshing.tetrahedralize(OUTER, edge_length=0.04, method="gmsh")
    monkeypatch.setitem(__import__("sys").modules, "pytetwild", None)
    with pytest.raises(ImportError, match=re.escape('pip install "softwarp[tetwild]"')):
        meshing.tetrahedralize(OUTER, edge_length=0.04, method="tetwild")


@pytest.mark.slow
@pytest.mark.parametrize("method", ["tetwild", "gmsh"])
def test_other_meshers(method):
    """The same ball from them: its cavity is found, its volume right, its elements good."""
    if method == "tetwild":
        pytest.importorskip("pytetwild")
    elif shutil.which("gmsh") is None:
        pytest.skip("the program gmsh is not installed")
    solid = meshing.tetrahedralize(OUTER, edge_length=0.02, cavities={"air": INNER}, method=method)
    report = solid.report()
    assert abs(report.volume_error) < 0.01
    assert report.dihedral > 5.0
    assert solid.cavities["air"].volume == pytest.approx(INNER.volume, rel=0.06)


def test_soft_bodies_of_surfaces_are_refused_with_the_way(tmp_path):
    path = tmp_path / "part.stl"
    OUTER.export(path)
    builder = sw.ModelBuilder()
    for value in (sw.read_mesh(path), path, OUTER):
        with pytest.raises(MeshError, match=r"fill it: add_tets\(meshing.tetrahedralize\("):
            builder.add_tets(value, material=sw.NeoHookean(1e5, 0.4), density=1000.0, name="part")
    with pytest.raises(MeshError, match=r"mesh 'part': corners must .*meshing.tetrahedralize"):
        builder.add_tets(OUTER.vertices, OUTER.faces, material=sw.NeoHookean(1e5, 0.4), density=1000.0, name="part")


@pytest.mark.parametrize(
    ("size", "told"), [(2.5, "larger than 2 m: it spans 2.5 m.*scale=1e-3"), (1e-3, "smaller than 2 mm")]
)
def test_unlikely_sizes_draw_a_warning(size, told):
    builder = sw.ModelBuilder()
    with pytest.warns(UserWarning, match=f"body 'part' is {told}"):
        mesh = meshing.box((size,) * 3, (1, 1, 1))
        builder.add_tets(mesh, material=sw.NeoHookean(1e5, 0.4), density=1000.0, name="part")
