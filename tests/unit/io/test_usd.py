import builtins
import dataclasses
import os

import numpy as np
import pytest
from pxr import Gf, Kind, Usd, UsdGeom, UsdLux, UsdShade, UsdValidation

from softwarp.io import colormap
from softwarp.io.usd import export_usd
from tests.unit.io.fakes import recording


@pytest.mark.parametrize("suffix", ["usdc", "usda", "usdz"])
def test_stage_passes_every_validator(tmp_path, suffix):
    """All validators that come with USD find nothing."""
    path = export_usd(recording(), tmp_path / f"film.{suffix}")
    stage = Usd.Stage.Open(str(path))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) >= 20
    found = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetErrorAsString() for error in found] == []
    assert os.listdir(tmp_path) == [f"film.{suffix}"]


def test_materials_show_the_display_colours(tmp_path):
    """Every prim that is drawn has a surface whose colour and opacity are read from its own primvars."""
    stage = Usd.Stage.Open(str(export_usd(recording(), tmp_path / "film.usdc")))
    drawn = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Gprim)]
    assert len(drawn) > 5
    for prim in drawn:
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        surface, _, _ = material.ComputeSurfaceSource()
        assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
        for name, primvar in (("diffuseColor", "displayColor"), ("opacity", "displayOpacity")):
            [source] = surface.GetInput(name).GetConnectedSources()[0]
            assert source.source.GetInput("varname").Get() == primvar


def test_stage_metadata(tmp_path):
    film = recording(5)
    stage = Usd.Stage.Open(str(export_usd(film, tmp_path / "film.usdc")))
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == 100.0
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 4.0)
    root = stage.GetDefaultPrim()
    assert root.GetPath() == "/World"
    assert Usd.ModelAPI(root).GetKind() == Kind.Tokens.assembly
    assert stage.GetPrimAtPath("/World/floor").IsA(UsdGeom.Mesh)
    assert stage.GetPrimAtPath("/World/camera").IsA(UsdGeom.Camera)
    assert stage.GetPrimAtPath("/World/lights/key").IsA(UsdLux.DistantLight)


def test_recording_that_starts_late_begins_at_zero(tmp_path):
    """Time codes count from the first frame, whatever the clock of the simulation said then."""
    film = recording(4)
    late = dataclasses.replace(film, time=film.time + 3.07)
    stage = Usd.Stage.Open(str(export_usd(late, tmp_path / "film.usdc")))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 3.0)
    points = UsdGeom.Mesh.Get(stage, "/World/world_0/beam").GetPointsAttr()
    assert points.GetTimeSamples() == [0.0, 1.0, 2.0, 3.0]
    np.testing.assert_array_equal(np.array(points.Get(2)), film.vertex_x[2, 0])


def test_numbers_survive(tmp_path):
    """Points, extents, stresses, cable points, tensions and goals of both worlds, frame by frame."""
    film = recording(4)
    stage = Usd.Stage.Open(str(export_usd(film, tmp_path / "film.usdc")))
    for row, world in enumerate(film.world):
        mesh = UsdGeom.Mesh.Get(stage, f"/World/world_{world}/beam")
        np.testing.assert_array_equal(np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), film.triangles)
        stress = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("stress")
        goal = UsdGeom.Sphere.Get(stage, f"/World/world_{world}/goal").GetOrderedXformOps()[0]
        for frame in range(4):
            x = film.vertex_x[frame, row]
            np.testing.assert_array_equal(np.array(mesh.GetPointsAttr().Get(frame)), x)
            np.testing.assert_array_equal(np.array(mesh.GetExtentAttr().Get(frame)), [x.min(axis=0), x.max(axis=0)])
            np.testing.assert_array_equal(np.array(stress.Get(frame)), film.stress[frame, row])
            np.testing.assert_allclose(np.array(goal.Get(frame)), film.goal[frame, row], rtol=1e-6)
            for cable in range(4):
                curve = UsdGeom.BasisCurves.Get(stage, f"/World/world_{world}/cable_{cable}")
                points = film.cable_x[frame, row, 8 * cable : 8 * cable + 8]
                np.testing.assert_array_equal(np.array(curve.GetPointsAttr().Get(frame)), points)
                tension = UsdGeom.PrimvarsAPI(curve).GetPrimvar("tension").Get(frame)
                np.testing.assert_array_equal(np.array(tension), film.cable_tension[frame, row, [cable]])
        assert curve.GetCurveVertexCountsAttr().Get() == [8]
        assert len(curve.GetWidthsAttr().Get()) == 1


def test_extents_hold_what_is_drawn(tmp_path):
    """The authored extents agree with those that USD computes, curve widths included."""
    stage = Usd.Stage.Open(str(export_usd(recording(3), tmp_path / "film.usdc")))
    for name in ("beam", "cable_1", "markers", "goal"):
        prim = UsdGeom.Boundable.Get(stage, f"/World/world_2/{name}")
        computed = UsdGeom.Boundable.ComputeExtentFromPlugins(prim, Usd.TimeCode(2))
        np.testing.assert_allclose(np.array(prim.GetExtentAttr().Get(2)), np.array(computed), atol=1e-7)


def test_colours_follow_stress_in_linear_light(tmp_path):
    """Display colours are the uniform scale over stress_range, without the sRGB curve."""
    film = recording(3)
    stage = Usd.Stage.Open(str(export_usd(film, tmp_path / "film.usdc", stress_range=(0.0, 1e4))))
    color = np.array(UsdGeom.Mesh.Get(stage, "/World/world_0/beam").GetDisplayColorAttr().Get(2))
    expected = colormap.srgb_to_linear(colormap.colors(film.stress[2, 0], 0.0, 1e4))
    np.testing.assert_allclose(color, expected, atol=1e-6)


def test_without_stress_and_goal(tmp_path):
    film = recording(2, goal=False, stress=False)
    stage = Usd.Stage.Open(str(export_usd(film, tmp_path / "film.usda", body_opacity=0.5)))
    mesh = UsdGeom.Mesh.Get(stage, "/World/world_0/beam")
    assert len(mesh.GetDisplayColorAttr().Get()) == 1
    assert list(mesh.GetDisplayOpacityAttr().Get()) == [0.5]
    assert not stage.GetPrimAtPath("/World/world_0/goal")


def test_worlds_stand_side_by_side(tmp_path):
    """Four worlds, two asked for: their boxes do not overlap, and the others are left out."""
    film = recording(3, worlds=(0, 1, 2, 3))
    stage = Usd.Stage.Open(str(export_usd(film, tmp_path / "film.usdc", worlds=[1, 3])))
    names = [prim.GetName() for prim in stage.GetPrimAtPath("/World").GetChildren()]
    assert [name for name in names if name.startswith("world")] == ["world_1", "world_3"]
    cache = UsdGeom.BBoxCache(Usd.TimeCode(2), [UsdGeom.Tokens.default_])
    boxes = [cache.ComputeWorldBound(stage.GetPrimAtPath(f"/World/world_{w}")).ComputeAlignedRange() for w in (1, 3)]
    assert Gf.Range3d.GetIntersection(*boxes).IsEmpty()


def test_gravity_points_down_on_the_stage(tmp_path):
    """Gravity along -y: what the simulator calls +y is up, +z, on the stage; the points themselves are not changed."""
    film = recording(2, gravity=(0.0, -9.81, 0.0))
    stage = Usd.Stage.Open(str(export_usd(film, tmp_path / "film.usdc")))
    turn = UsdGeom.Xformable.Get(stage, "/World/world_0").ComputeLocalToWorldTransform(0)
    np.testing.assert_allclose(np.array(turn.TransformDir(Gf.Vec3d(0, 1, 0))), [0, 0, 1], atol=1e-6)
    mesh = UsdGeom.Mesh.Get(stage, "/World/world_0/beam")
    np.testing.assert_array_equal(np.array(mesh.GetPointsAttr().Get(1)), film.vertex_x[1, 0])


def test_frames_keep_their_time_at_any_rate(tmp_path):
    """Frames 0.01 s apart at 24 time codes per second lie 0.24 codes apart."""
    stage = Usd.Stage.Open(str(export_usd(recording(3), tmp_path / "film.usdc", fps=24.0)))
    samples = UsdGeom.Mesh.Get(stage, "/World/world_0/beam").GetPointsAttr().GetTimeSamples()
    np.testing.assert_allclose(samples, [0.0, 0.24, 0.48], atol=1e-5)
    assert stage.GetTimeCodesPerSecond() == 24.0


def test_camera_sees_all_worlds(tmp_path):
    """Every corner of the worlds' box lies inside the camera's frustum."""
    stage = Usd.Stage.Open(str(export_usd(recording(3), tmp_path / "film.usdc")))
    frustum = UsdGeom.Camera.Get(stage, "/World/camera").GetCamera(0).frustum
    cache = UsdGeom.BBoxCache(Usd.TimeCode(2), [UsdGeom.Tokens.default_])
    for world in (0, 2):
        box = cache.ComputeWorldBound(stage.GetPrimAtPath(f"/World/world_{world}")).ComputeAlignedRange()
        assert all(frustum.Intersects(box.GetCorner(k)) for k in range(8))


def test_names_become_valid_and_different(tmp_path):
    film = dataclasses.replace(recording(1), cable_names=("goal", "long cable", "long-cable", "3rd"))
    stage = Usd.Stage.Open(str(export_usd(film, tmp_path / "film.usdc")))
    curves = [p.GetName() for p in stage.GetPrimAtPath("/World/world_0").GetChildren() if p.IsA(UsdGeom.BasisCurves)]
    assert curves == ["goal_2", "long_cable", "long_cable_2", "_3rd"]


def test_an_open_stage_sees_the_new_file(tmp_path):
    """Writing over a file that this process has open updates the open stage."""
    path = tmp_path / "film.usdc"
    stage = Usd.Stage.Open(str(export_usd(recording(2), path)))
    export_usd(recording(4), path)
    assert stage.GetEndTimeCode() == 3.0


def test_bad_requests_are_refused(tmp_path):
    film = recording(1)
    with pytest.raises(ValueError, match=r"\.usdc, \.usda or \.usdz, got '\.obj'"):
        export_usd(film, tmp_path / "film.obj")
    with pytest.raises(ValueError, match=r"holds the worlds \[0, 2\]"):
        export_usd(film, tmp_path / "film.usdc", worlds=[1])
    with pytest.raises(ValueError, match="fps must be positive"):
        export_usd(film, tmp_path / "film.usdc", fps=-1.0)
    with pytest.raises(ValueError, match="stress_range must rise"):
        export_usd(film, tmp_path / "film.usdc", stress_range=(1.0, 1.0))
    with pytest.raises(ValueError, match="body_opacity"):
        export_usd(film, tmp_path / "film.usdc", body_opacity=0.0)
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"cannot write .*film\.usdc.*; choose a folder"):
        export_usd(film, tmp_path / "file" / "film.usdc")
    assert os.listdir(tmp_path) == ["file"]


def test_missing_usd_names_the_extra(tmp_path, monkeypatch):
    load = builtins.__import__

    def without_usd(name, *args, **kwargs):
        if name.startswith("pxr"):
            raise ImportError(name)
        return load(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_usd)
    with pytest.raises(ImportError, match=r"pip install 'softwarp\[usd\]'"):
        export_usd(recording(1), tmp_path / "film.usdc")
