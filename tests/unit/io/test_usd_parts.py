import dataclasses

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdValidation

from softwarp import meshing
from softwarp.io import colormap, palette, tubes
from softwarp.io.parts import posed
from softwarp.io.usd import export_usd
from softwarp.io.usd_values import continuous
from tests.unit.io.fakes import BALL, CRATE, TOOL, parts_film, recording

WORLD = "/World/world_1"


def opened(tmp_path, film, **options):
    return Usd.Stage.Open(str(export_usd(film, tmp_path / "film.usdc", **options)))


def geometry(stage, rigid):
    """The prims that draw a rigid body, seen through its instance."""
    prim = stage.GetPrimAtPath(f"{WORLD}/rigid_{rigid}")
    return list(prim.GetFilteredChildren(Usd.TraverseInstanceProxies()))


@pytest.mark.parametrize("soft", [True, False])
@pytest.mark.parametrize("suffix", ["usdc", "usdz"])
def test_stage_passes_every_validator(tmp_path, soft, suffix):
    """All validators that come with USD find nothing, with all parts and with those that are not soft."""
    path = export_usd(parts_film(soft=soft), tmp_path / f"film.{suffix}", joints=True, twist=soft)
    stage = Usd.Stage.Open(str(path))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetErrorAsString() for error in found] == []


def test_rigid_bodies_move_as_recorded(tmp_path):
    """The transform of every body takes local points where its pose takes them, at and between the frames."""
    film = parts_film()
    stage = opened(tmp_path, film)
    points = np.array([[0.0, 0.0, 0.0], [0.1, 0.2, 0.3]])
    for rigid in range(1, 6):
        xform = UsdGeom.Xformable.Get(stage, f"{WORLD}/rigid_{rigid}")
        for frame in range(4):
            matrix = np.array(xform.GetLocalTransformation(frame))
            expected = posed(film.rigid_pose[frame, 1, rigid], points)
            np.testing.assert_allclose(points @ matrix[:3, :3] + matrix[3, :3], expected, atol=1e-6)
    still = UsdGeom.Xformable.Get(stage, f"{WORLD}/rigid_0")
    assert not still.TransformMightBeTimeVarying()


def test_rigid_bodies_are_instances_of_shared_shapes(tmp_path):
    """One prototype per shape, used in all worlds; bodies carry their own colours."""
    film = parts_film()
    stage = opened(tmp_path, film)
    assert len(stage.GetPrimAtPath("/shapes").GetAllChildren()) == 5
    prototypes = set()
    for world in range(2):
        prim = stage.GetPrimAtPath(f"/World/world_{world}/rigid_{CRATE}")
        assert prim.IsInstance()
        prototypes.add(prim.GetPrototype().GetPath())
        color = UsdGeom.PrimvarsAPI(prim).GetPrimvar("displayColor").Get()
        np.testing.assert_allclose(color[0], colormap.srgb_to_linear(palette.RIGID[CRATE]), atol=1e-6)
    assert len(prototypes) == 1
    floor = stage.GetPrimAtPath(f"{WORLD}/rigid_0")
    np.testing.assert_allclose(
        UsdGeom.PrimvarsAPI(floor).GetPrimvar("displayColor").Get()[0],
        colormap.srgb_to_linear(palette.KINEMATIC),
        atol=1e-6,
    )
    assert floor.GetCustomDataByKey("softwarp:kinematic") is True
    assert not stage.GetPrimAtPath(f"{WORLD}/rigid_5").IsInstance()  # it has no shape


def test_primitives_are_exact(tmp_path):
    """Box, ball, capsule and cylinder are USD's own, with their sizes; a mesh and a plane are polygons."""
    stage = opened(tmp_path, parts_film())
    (box,) = geometry(stage, CRATE)
    scale = UsdGeom.Cube(box).GetOrderedXformOps()[-1]
    assert UsdGeom.Cube(box).GetSizeAttr().Get() == 1.0
    np.testing.assert_allclose(scale.Get(), [0.02] * 3, rtol=1e-6)
    (ball,) = geometry(stage, BALL)
    assert UsdGeom.Sphere(ball).GetRadiusAttr().Get() == 0.01
    capsule, cylinder = geometry(stage, TOOL)
    assert UsdGeom.Capsule(capsule).GetRadiusAttr().Get() == 0.004
    assert UsdGeom.Capsule(capsule).GetHeightAttr().Get() == 0.02
    assert UsdGeom.Cylinder(cylinder).GetAxisAttr().Get() == UsdGeom.Tokens.z
    assert UsdGeom.Cylinder(cylinder).GetHeightAttr().Get() == 0.01
    (gem,) = geometry(stage, 4)
    assert len(UsdGeom.Mesh(gem).GetPointsAttr().Get()) == 8
    (plane,) = geometry(stage, 0)
    assert list(UsdGeom.Mesh(plane).GetFaceVertexCountsAttr().Get()) == [4]


def test_bounds_of_rigid_bodies(tmp_path):
    """USD's own bounding box of each body is that of its pieces' surfaces."""
    film = parts_film()
    stage = opened(tmp_path, film)
    for rigid in (CRATE, BALL, TOOL, 4):
        pieces = film.parts.pieces(rigid)
        local = [posed(film.parts.piece_pose[p], film.parts.piece_surface(p)[0]) for p in pieces]
        imageable = UsdGeom.Imageable.Get(stage, f"{WORLD}/rigid_{rigid}")
        box = imageable.ComputeUntransformedBound(0, UsdGeom.Tokens.default_).ComputeAlignedRange()
        np.testing.assert_allclose([box.GetMin(), box.GetMax()], _bounds(local), atol=2e-4)


def _bounds(parts):
    x = np.concatenate(parts)
    return [x.min(axis=0), x.max(axis=0)]


def test_the_floor_stands_for_a_ground_plane(tmp_path):
    """The checkered floor lies in the plane, whose own square becomes a guide; one that moves is drawn."""
    film = parts_film()
    stage = opened(tmp_path, film)
    points = np.array(UsdGeom.Mesh.Get(stage, "/World/floor").GetPointsAttr().Get())
    np.testing.assert_allclose(points[:, 2], -0.01, atol=1e-7)
    assert UsdGeom.Imageable.Get(stage, f"{WORLD}/rigid_0").GetPurposeAttr().Get() == UsdGeom.Tokens.guide
    pose = film.rigid_pose.copy()
    pose[-1, :, 0, 0] = 0.5
    stage = opened(tmp_path, dataclasses.replace(film, rigid_pose=pose))
    assert UsdGeom.Imageable.Get(stage, f"{WORLD}/rigid_0").GetPurposeAttr().Get() != UsdGeom.Tokens.guide
    assert np.array(UsdGeom.Mesh.Get(stage, "/World/floor").GetPointsAttr().Get())[:, 2].max() < -0.004


def test_rods_are_curves_of_their_radius(tmp_path):
    """Nodes, widths and orientations of every frame; the extent holds the tube."""
    film = parts_film()
    stage = opened(tmp_path, film)
    curve = UsdGeom.BasisCurves.Get(stage, f"{WORLD}/whip")
    assert list(curve.GetCurveVertexCountsAttr().Get()) == [5]
    np.testing.assert_allclose(curve.GetWidthsAttr().Get(), 2.0 * film.parts.rod_radius)
    for frame in range(4):
        np.testing.assert_array_equal(np.array(curve.GetPointsAttr().Get(frame)), film.rod_x[frame, 1])
        extent = np.array(curve.GetExtentAttr().Get(frame))
        assert np.all(extent[0] <= film.rod_x[frame, 1].min(axis=0) - 0.0039)
        q = UsdGeom.PrimvarsAPI(curve).GetPrimvar("orientation").Get(frame)
        found = np.array([[*value.GetImaginary(), value.GetReal()] for value in q])
        np.testing.assert_allclose(np.abs(np.sum(found * film.rod_q[frame, 1], axis=-1)), 1.0, atol=1e-6)


def test_rods_show_their_twist_on_request(tmp_path):
    """A closed tube instead of a curve, with two colours."""
    film = parts_film()
    stage = opened(tmp_path, film, twist=True)
    mesh = UsdGeom.Mesh.Get(stage, f"{WORLD}/whip")
    points = np.array(mesh.GetPointsAttr().Get(3))
    triangles = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    expected = tubes.sweep(film.rod_x[3, 1], film.rod_q[3, 1], film.parts.rod_radius, 20, 12)
    np.testing.assert_allclose(points, expected, atol=1e-7)
    assert meshing.surface_volume(points, triangles) > 0.0
    assert len(np.unique(np.array(mesh.GetDisplayColorAttr().Get()), axis=0)) == 2


def test_chambers_show_pressure_and_volume(tmp_path):
    """Points, pressure, volume and colour of every frame; red above, blue below the ambient pressure."""
    film = parts_film()
    stage = opened(tmp_path, film)
    for cavity, name in enumerate(("left", "right")):
        mesh = UsdGeom.Mesh.Get(stage, f"{WORLD}/{name}")
        api = UsdGeom.PrimvarsAPI(mesh)
        triangles = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        for frame in range(4):
            points = np.array(mesh.GetPointsAttr().Get(frame))
            np.testing.assert_array_equal(points, film.cavity_x[frame, 1, 8 * cavity : 8 * cavity + 8])
            assert api.GetPrimvar("pressure").Get(frame)[0] == film.cavity_pressure[frame, 1, cavity]
            assert api.GetPrimvar("volume").Get(frame)[0] == film.cavity_volume[frame, 1, cavity]
        assert meshing.surface_volume(points, triangles) == pytest.approx(0.4**3 * 8e-6, rel=1e-4)
        red, _, blue = mesh.GetDisplayColorAttr().Get(3)[0]
        assert (red > blue) == (cavity == 0)
    root = stage.GetDefaultPrim()
    assert root.GetCustomDataByKey("softwarp:pressureRange:high") == pytest.approx(1e4)
    assert root.GetCustomDataByKey("softwarp:pressureRange:low") == pytest.approx(-1e4)


def test_bodies_with_chambers_are_translucent(tmp_path):
    """Unless told otherwise; bodies without chambers are not."""

    def opacity(film, **options):
        stage = opened(tmp_path, film, **options)
        return UsdGeom.Mesh.Get(stage, f"{WORLD}/beam").GetDisplayOpacityAttr().Get()

    assert opacity(parts_film())[0] < 0.6
    assert opacity(parts_film(), body_opacity=1.0) is None
    assert opacity(recording(worlds=(1,))) is None


def test_membranes_are_subsets_of_faces(tmp_path):
    film = parts_film()
    cover = np.full(len(film.triangles), -1)
    cover[[3, 5]], cover[7] = 0, 1
    stage = opened(tmp_path, dataclasses.replace(film, tri_membrane=cover, membrane_names=("skin", "patch")))
    mesh = UsdGeom.Mesh.Get(stage, f"{WORLD}/beam")
    subsets = {s.GetPrim().GetName(): list(s.GetIndicesAttr().Get()) for s in UsdGeom.Subset.GetAllGeomSubsets(mesh)}
    assert subsets == {"skin": [3, 5], "patch": [7]}


def test_contacts_are_points_and_arrows(tmp_path):
    """World 0: none, one, two, two contacts; an arrow ends where the force points to, as long as it is strong."""
    film = parts_film()
    stage = opened(tmp_path, film)
    points = UsdGeom.Points.Get(stage, "/World/world_0/contacts")
    arrows = UsdGeom.BasisCurves.Get(stage, "/World/world_0/contact_forces")
    counts = [len(points.GetPointsAttr().Get(frame)) for frame in range(4)]
    assert counts == [0, 1, 2, 2]
    assert [list(arrows.GetCurveVertexCountsAttr().Get(f)) for f in range(4)] == [[4] * n for n in counts]
    assert list(UsdGeom.PrimvarsAPI(points).GetPrimvar("pair").Get(2)) == [0, 1]
    assert list(points.GetPrim().GetAttribute("softwarp:pairNames").Get()) == ["crate - floor", "ball - crate"]
    path = np.array(arrows.GetPointsAttr().Get(3)).reshape(2, 4, 3)
    np.testing.assert_allclose(path[0, 0], [0.03, 0.0, 0.01], atol=1e-7)
    np.testing.assert_allclose(path[0, -1] - path[0, 0], [0.0, 0.0, 0.3 * film.size()], atol=1e-6)
    np.testing.assert_array_equal(UsdGeom.PrimvarsAPI(arrows).GetPrimvar("force").Get(3), [[0.0, 0.0, 2.0]] * 2)
    without = opened(tmp_path, film, contacts=False)
    assert not without.GetPrimAtPath("/World/world_0/contacts")


def test_joints_are_drawn_on_request(tmp_path):
    """A hinge and a slider as lines through their anchors, a ball and a weld as points; the last one on a rod."""
    film = parts_film()
    assert not opened(tmp_path, film).GetPrimAtPath(f"{WORLD}/turn")
    stage = opened(tmp_path, film, joints=True)
    line = np.array(UsdGeom.BasisCurves.Get(stage, f"{WORLD}/turn").GetPointsAttr().Get(2))
    anchor = posed(film.rigid_pose[2, 1, CRATE], np.array([[0.0, 0.0, 0.005]]))[0]
    np.testing.assert_allclose(line.mean(axis=0), anchor, atol=1e-6)
    np.testing.assert_allclose(line[1] - line[0], [0.0, 0.0, 0.28 * film.size()], atol=1e-6)
    assert stage.GetPrimAtPath(f"{WORLD}/slide").IsA(UsdGeom.BasisCurves)
    assert stage.GetPrimAtPath(f"{WORLD}/swivel").IsA(UsdGeom.Points)
    glue = np.array(UsdGeom.Points.Get(stage, f"{WORLD}/glue").GetPointsAttr().Get(0))
    np.testing.assert_allclose(glue[0], film.rod_x[0, 1, 4] + (0.0, 0.0, 0.005), atol=1e-4)


def test_quaternions_do_not_jump():
    """Signs are chosen so that neighbours are near each other: interpolation never goes the long way."""
    angle = np.linspace(0.0, 4.0 * np.pi, 50)
    q = np.stack([0 * angle, 0 * angle, np.sin(angle / 2), np.cos(angle / 2)], axis=-1)
    mixed = q * np.where(np.arange(50) % 3 == 0, -1.0, 1.0)[:, None]
    np.testing.assert_allclose(continuous(mixed), -q, atol=1e-12)
    assert continuous(q[:1]).shape == (1, 4)
