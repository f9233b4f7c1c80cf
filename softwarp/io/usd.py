"""Universal Scene Description: a trajectory as an animated stage for usdview, Omniverse, Blender and others.

Layout of the stage::

    /World                  assembly, default prim, z up, metres
        world_0             one Xform per world, set side by side; turned so that gravity points along -z
            <body>          Mesh: sampled points and extent, displayColor by stress, primvar ``stress`` [Pa]
            <cable>         BasisCurves: sampled points and extent, displayColor and primvar ``tension`` [N]
            <rigid body>    Xform: sampled translate and orient, instance of one of the shapes
            <rod>           BasisCurves of its radius, primvar ``orientation``; or a Mesh striped along its sections
            <chamber>       Mesh: sampled points, displayColor by pressure, primvars ``pressure`` [Pa], ``volume`` [m^3]
            contacts        Points, primvar ``pair``
            contact_forces  BasisCurves as arrows, primvar ``force`` [N]
            inverted        Points: elements inside out
            <joint>         BasisCurves along its axis
            markers         Points, purpose guide
            goal            Sphere, sampled translate
        floor, lights, camera
        looks               one UsdPreviewSurface that shows displayColor and displayOpacity, bound to all
    /shapes                 class: shapes of rigid bodies

A membrane is a GeomSubset of its body's faces, of family ``membrane``.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.io import colormap, palette
from softwarp.io.atomic import atomic_path
from softwarp.io.trajectory import Trajectory
from softwarp.io.usd_parts import PartsOptions, PartsWriter
from softwarp.io.usd_values import Sampler, colors_of, paint, prim_name, set_faces, set_points

Floats = NDArray[np.float64]

_CABLE_RADIUS = 0.006  # of the size of the body
_GOAL_RADIUS = 0.03  # of the size of the body
_FLOOR_CELLS = 12
_CHAMBERED = 0.45  # opacity of a body with air chambers, so that they show


def export_usd(
    trajectory: Trajectory,
    path: str | os.PathLike[str],
    worlds: Sequence[int] | None = None,
    fps: float | None = None,
    stress_range: tuple[float, float] | None = None,
    *,
    body_opacity: float | None = None,
    contacts: bool = True,
    inversions: bool = True,
    joints: bool = False,
    twist: bool = False,
) -> Path:
    """Write a trajectory as a USD file, whole or not at all.

    Every recorded frame is a time sample at its own time, so nothing is lost at any ``fps``.

    Args:
        trajectory: What was recorded.
        path: File to write; ``.usdc`` (small, fast), ``.usda`` (text) or ``.usdz`` (package).
        worlds: Numbers of the recorded worlds to write; None means all.
        fps: Time codes per second; None takes the recording's frame rate, which puts frame i at time code i.
        stress_range: Stresses [Pa] of the ends of the colour scale; None fits the scale to the recording.
        body_opacity: Display opacity of soft bodies in (0, 1]; below one, cables and chambers inside show in viewers
            that can. None takes 1, and 0.45 for bodies with air chambers.
        contacts: Whether to write contacts where they were recorded.
        inversions: Whether to mark elements that are inside out, where that was recorded and some are.
        joints: Whether to write the axes of joints.
        twist: Whether rods are surfaces with a stripe that shows their twist; otherwise they are curves.

    Returns:
        The path written.

    Raises:
        ImportError: If usd-core is not installed.
        ValueError: For an unknown suffix, world, rate, range or opacity.
        OSError: If the file cannot be written there.
    """
    _require_usd()
    target = Path(path)
    if target.suffix not in (".usdc", ".usda", ".usdz"):
        raise ValueError(f"cannot write {target}: a USD file ends in .usdc, .usda or .usdz, got {target.suffix!r}")
    if fps is not None and not fps > 0.0:
        raise ValueError(f"USD export of {trajectory.name!r}: fps must be positive, got {fps:g}")
    if stress_range is not None and not stress_range[1] > stress_range[0]:
        raise ValueError(f"USD export of {trajectory.name!r}: stress_range must rise, got {stress_range}")
    if body_opacity is not None and not 0.0 < body_opacity <= 1.0:
        raise ValueError(f"USD export of {trajectory.name!r}: body_opacity must lie in (0, 1], got {body_opacity:g}")
    rows = trajectory.world_rows(worlds)
    rate = trajectory.frame_rate if fps is None else fps
    options = PartsOptions(contacts=contacts, inversions=inversions, joints=joints, twist=twist)
    writer = _StageWriter(trajectory, rows, rate, stress_range, body_opacity, options)
    writer.write()
    _save(writer.stage, target)
    return target


class _StageWriter:
    """Fills one in-memory stage from a trajectory."""

    def __init__(
        self,
        trajectory: Trajectory,
        rows: list[int],
        fps: float,
        stress_range: tuple[float, float] | None,
        body_opacity: float | None,
        options: PartsOptions,
    ) -> None:
        from pxr import Sdf, Usd

        self.trajectory, self.rows, self.fps, self.body_opacity = trajectory, rows, fps, body_opacity
        self.stage = Usd.Stage.Open(Sdf.Layer.CreateAnonymous(".usdc"))
        self.codes = _time_codes(trajectory.time, fps)
        self.sampler = Sampler(self.codes)
        self.parts = PartsWriter(self.stage, trajectory, self.sampler, rows, options)
        self.size = trajectory.size()
        self.turn = _turn_to_z(trajectory.up)
        self.bounds = _turned_bounds(trajectory.bounds(), self.turn)
        if trajectory.stress is not None and stress_range is None:
            stress_range = (0.0, colormap.legible_limit(trajectory.stress[:, rows]))
        self.stress_range = stress_range
        self.tension_limit = colormap.legible_limit(trajectory.cable_tension[:, rows])

    def write(self) -> None:
        """Author the whole stage."""
        from pxr import Kind, Usd, UsdGeom

        stage = self.stage
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(self.fps)
        stage.SetFramesPerSecond(self.fps)
        stage.SetStartTimeCode(self.codes[0])
        stage.SetEndTimeCode(self.codes[-1])
        root = UsdGeom.Xform.Define(stage, "/World").GetPrim()
        stage.SetDefaultPrim(root)
        Usd.ModelAPI(root).SetKind(Kind.Tokens.assembly)
        root.SetCustomDataByKey("softwarp:source", self.trajectory.name)
        if self.stress_range is not None:
            for end, value in zip(("low", "high"), self.stress_range, strict=True):
                root.SetCustomDataByKey(f"softwarp:stressRange:{end}", float(value))
        if self.trajectory.parts.cavity_count:
            root.SetCustomDataByKey("softwarp:pressureRange:low", -self.parts.pressure_limit)
            root.SetCustomDataByKey("softwarp:pressureRange:high", self.parts.pressure_limit)
        offsets = self._layout()
        for row, offset in zip(self.rows, offsets, strict=True):
            self._world(row, offset)
        low = self.bounds[0] + offsets.min(axis=0)
        high = self.bounds[1] + offsets.max(axis=0)
        self._floor(low, high)
        self._lights()
        self._camera(low, high)
        self._material(root)

    def _layout(self) -> Floats:
        """Where each world stands [m], shape (world, 3): a near-square grid on the ground."""
        count = len(self.rows)
        columns = int(np.ceil(np.sqrt(count)))
        pitch = 1.15 * (self.bounds[1] - self.bounds[0]) + 0.1 * self.size
        k = np.arange(count)
        return np.stack([(k % columns) * pitch[0], (k // columns) * pitch[1], np.zeros(count)], axis=-1)

    def _world(self, row: int, offset: Floats) -> None:
        from pxr import Gf, Kind, Usd, UsdGeom

        path = f"/World/world_{int(self.trajectory.world[row])}"
        xform = UsdGeom.Xform.Define(self.stage, path)
        Usd.ModelAPI(xform.GetPrim()).SetKind(Kind.Tokens.component)
        xform.AddTranslateOp().Set(Gf.Vec3d(*offset.tolist()))
        if not np.allclose(self.turn, np.eye(3)):
            xform.AddOrientOp().Set(_quaternion(self.turn))
        taken = {"markers", "goal", "contacts", "contact_forces", "inverted"}
        for body in np.unique(self.trajectory.tri_body):
            self._body(path, row, int(body), taken)
        for cable in range(len(self.trajectory.cable_names)):
            self._cable(path, row, cable, taken)
        self.parts.write(path, row, taken)
        self._markers(path, row)
        self._goal(path, row)

    def _body(self, parent: str, row: int, body: int, taken: set[str]) -> None:
        """One body's surface, its vertices numbered within the body."""
        from pxr import UsdGeom

        t = self.trajectory
        chosen = t.tri_body == body
        vertices, corners = np.unique(t.triangles[chosen], return_inverse=True)
        mesh = UsdGeom.Mesh.Define(self.stage, f"{parent}/{prim_name(t.body_names[body], taken)}")
        set_faces(mesh, corners.reshape(-1, 3))
        self.sampler.points(mesh, t.vertex_x[:, row, vertices], padding=0.0)
        opacity = self.body_opacity
        if opacity is None:
            opacity = _CHAMBERED if body in t.parts.cavity_body else 1.0
        if opacity < 1.0:
            mesh.CreateDisplayOpacityPrimvar(UsdGeom.Tokens.constant).Set([opacity])
        if t.stress is None or self.stress_range is None:
            paint(mesh, palette.BODY)
        else:
            shades = colormap.colors(t.stress[:, row, vertices], *self.stress_range)
            self.sampler.primvar(mesh, "stress", t.stress[:, row, vertices], UsdGeom.Tokens.vertex)
            self.sampler.color(mesh, shades, UsdGeom.Tokens.vertex)
        if t.tri_membrane is not None:
            _membranes(mesh, t.tri_membrane[chosen], t.membrane_names)

    def _cable(self, parent: str, row: int, cable: int, taken: set[str]) -> None:
        from pxr import UsdGeom, Vt

        t = self.trajectory
        points = slice(int(t.cable_point_start[cable]), int(t.cable_point_start[cable + 1]))
        curve = UsdGeom.BasisCurves.Define(self.stage, f"{parent}/{prim_name(t.cable_names[cable], taken)}")
        curve.CreateTypeAttr(UsdGeom.Tokens.linear)
        curve.CreateWrapAttr(UsdGeom.Tokens.nonperiodic)
        curve.CreateCurveVertexCountsAttr(Vt.IntArray([points.stop - points.start]))
        width = 2.0 * _CABLE_RADIUS * self.size
        curve.CreateWidthsAttr(Vt.FloatArray([width]))
        curve.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        self.sampler.points(curve, t.cable_x[:, row, points], padding=0.5 * width)
        tension = t.cable_tension[:, row, cable : cable + 1]
        taut = palette.CABLE_TAUT if self.stress_range is None else palette.CABLE_TAUT_ON_STRESS
        shades = colormap.blend(tension / self.tension_limit, palette.CABLE_SLACK, taut)
        self.sampler.primvar(curve, "tension", tension, UsdGeom.Tokens.constant)
        self.sampler.color(curve, shades, UsdGeom.Tokens.constant)

    def _markers(self, parent: str, row: int) -> None:
        from pxr import UsdGeom, Vt

        marker_x = self.trajectory.marker_x[:, row]
        if marker_x.shape[1] == 0:
            return
        points = UsdGeom.Points.Define(self.stage, f"{parent}/markers")
        points.CreatePurposeAttr(UsdGeom.Tokens.guide)
        width = 3.0 * _CABLE_RADIUS * self.size
        points.CreateWidthsAttr(Vt.FloatArray([width]))
        points.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        paint(points, palette.CABLE_TAUT)
        self.sampler.points(points, marker_x, padding=0.5 * width)

    def _goal(self, parent: str, row: int) -> None:
        from pxr import Gf, UsdGeom, Vt

        if self.trajectory.goal is None:
            return
        sphere = UsdGeom.Sphere.Define(self.stage, f"{parent}/goal")
        radius = _GOAL_RADIUS * self.size
        sphere.CreateRadiusAttr(radius)
        sphere.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.array([[-radius] * 3, [radius] * 3], dtype=np.float32)))
        paint(sphere, palette.GOAL, opacity=0.6)
        translate = sphere.AddTranslateOp()
        for code, goal in zip(self.codes, self.trajectory.goal[:, row], strict=True):
            translate.Set(Gf.Vec3d(*(float(g) for g in goal)), code)

    def _floor(self, low: Floats, high: Floats) -> None:
        """A checkered square below everything, or in the ground plane."""
        from pxr import UsdGeom

        n = _FLOOR_CELLS
        half = 1.5 * float(np.max((high - low)[:2])) + self.size
        centre = 0.5 * (low + high)
        ground = self.parts.floor_height(self.turn)
        height = float(low[2]) - 0.02 * self.size if ground is None else ground
        line = np.linspace(-half, half, n + 1)
        y, x = np.meshgrid(line, line, indexing="ij")
        points = np.stack([x + centre[0], y + centre[1], np.full_like(x, height)], axis=-1).reshape(-1, 3)
        j, i = (index.ravel() for index in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
        corner = j * (n + 1) + i
        quads = np.stack([corner, corner + 1, corner + n + 2, corner + n + 1], axis=-1)
        mesh = UsdGeom.Mesh.Define(self.stage, "/World/floor")
        set_points(mesh, points)
        set_faces(mesh, quads)
        shades = np.array([palette.FLOOR_EVEN, palette.FLOOR_ODD])[(i + j) % 2]
        mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.uniform).Set(colors_of(shades))

    def _lights(self) -> None:
        from pxr import Gf, UsdGeom, UsdLux

        UsdGeom.Scope.Define(self.stage, "/World/lights")
        key = UsdLux.DistantLight.Define(self.stage, "/World/lights/key")
        key.CreateIntensityAttr(2.5)
        key.CreateAngleAttr(3.0)
        key.CreateNormalizeAttr(True)
        key.AddRotateXYZOp().Set(Gf.Vec3f(35.0, -25.0, 20.0))
        dome = UsdLux.DomeLight.Define(self.stage, "/World/lights/sky")
        dome.CreateIntensityAttr(0.6)
        dome.CreateColorAttr(Gf.Vec3f(0.93, 0.96, 1.0))

    def _material(self, root: Any) -> None:
        """One surface for everything: renderers that look at materials alone then show display colours too."""
        from pxr import Sdf, UsdGeom, UsdShade

        kinds = Sdf.ValueTypeNames
        UsdGeom.Scope.Define(self.stage, "/World/looks")
        material = UsdShade.Material.Define(self.stage, "/World/looks/silicone")
        surface = UsdShade.Shader.Define(self.stage, "/World/looks/silicone/surface")
        surface.CreateIdAttr("UsdPreviewSurface")
        surface.CreateInput("roughness", kinds.Float).Set(0.45)
        for name, reader, kind, fallback, target in (
            ("displayColor", "UsdPrimvarReader_float3", kinds.Float3, palette.BODY, ("diffuseColor", kinds.Color3f)),
            ("displayOpacity", "UsdPrimvarReader_float", kinds.Float, 1.0, ("opacity", kinds.Float)),
        ):
            read = UsdShade.Shader.Define(self.stage, f"/World/looks/silicone/{name}")
            read.CreateIdAttr(reader)
            read.CreateInput("varname", kinds.String).Set(name)
            read.CreateInput("fallback", kind).Set(fallback)
            result = read.CreateOutput("result", kind)
            surface.CreateInput(*target).ConnectToSource(result)
        material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
        UsdShade.MaterialBindingAPI.Apply(root).Bind(material)

    def _camera(self, low: Floats, high: Floats) -> None:
        """A camera in front, to the right and above, far enough to see all worlds."""
        from pxr import Gf, UsdGeom

        centre = 0.5 * (low + high)
        radius = 0.5 * float(np.linalg.norm(high - low))
        camera = UsdGeom.Camera.Define(self.stage, "/World/camera")
        camera.CreateFocalLengthAttr(35.0)
        camera.CreateHorizontalApertureAttr(24.0)
        camera.CreateVerticalApertureAttr(18.0)
        distance = 1.1 * radius / np.sin(np.arctan(0.5 * 18.0 / 35.0))
        camera.CreateClippingRangeAttr(Gf.Vec2f(0.01 * distance, 10.0 * distance))
        camera.CreateFocusDistanceAttr(distance)
        towards = np.array([0.45, -0.85, 0.35])
        eye = centre + distance * towards / np.linalg.norm(towards)
        view = Gf.Matrix4d().SetLookAt(Gf.Vec3d(*eye.tolist()), Gf.Vec3d(*centre.tolist()), Gf.Vec3d(0, 0, 1))
        camera.AddTransformOp().Set(view.GetInverse())


def _membranes(mesh: Any, membrane: NDArray[np.int32], names: tuple[str, ...]) -> None:
    """Mark the faces of a body that membranes cover."""
    from pxr import UsdGeom, Vt

    taken: set[str] = set()
    for number, name in enumerate(names):
        faces = np.flatnonzero(membrane == number).astype(np.int32)
        if len(faces):
            UsdGeom.Subset.CreateGeomSubset(
                mesh, prim_name(name, taken), UsdGeom.Tokens.face, Vt.IntArray.FromNumpy(faces), "membrane"
            )


def _require_usd() -> None:
    try:
        import pxr.Usd  # noqa: F401
    except ImportError as error:
        raise ImportError(
            "USD export needs the package usd-core, which is not installed; pip install 'softwarp[usd]'"
        ) from error


def _save(stage: Any, target: Path) -> None:
    """Write a stage beside its target and move it there; a layer open under that name is told to reload."""
    from pxr import Sdf, UsdUtils

    with atomic_path(target) as scratch:
        if target.suffix == ".usdz":
            layer = scratch.with_suffix(".usdc")
            try:
                stage.GetRootLayer().Export(str(layer))
                done = UsdUtils.CreateNewUsdzPackage(str(layer), str(scratch), f"{target.stem}.usdc")
            finally:
                layer.unlink(missing_ok=True)
        else:
            done = stage.GetRootLayer().Export(str(scratch))
        if not done:
            raise OSError(f"cannot write {target}: USD refused; see the messages it printed")
    opened = Sdf.Layer.Find(str(target.absolute()))
    if opened:
        opened.Reload(force=True)


def _time_codes(time: Floats, fps: float) -> list[float]:
    """Time codes of the frames from 0 on; within 2 % of a whole one it is meant, the clock being float32."""
    exact = (time - time[0]) * fps
    whole = np.round(exact)
    return [float(code) for code in np.where(np.abs(exact - whole) < 0.02, whole, exact)]


def _turn_to_z(up: NDArray[Any]) -> Floats:
    """The rotation matrix of the shortest turn that takes the unit vector ``up`` to +z."""
    u = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    if u[2] < -1.0 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    v = np.cross(u, (0.0, 0.0, 1.0))
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + u[2]))


def _quaternion(turn: Floats) -> Any:
    from pxr import Gf

    # Gf matrices act on row vectors.
    return Gf.Quatf(Gf.Matrix3d(*turn.T.ravel().tolist()).ExtractRotation().GetQuat())


def _turned_bounds(bounds: Floats, turn: Floats) -> Floats:
    """Bounds of a turned box, shape (2, 3)."""
    corners = np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    turned = corners @ turn.T
    return np.stack([turned.min(axis=0), turned.max(axis=0)])
