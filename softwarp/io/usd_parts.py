"""Rigid bodies, rods, air chambers, contacts and joints of a trajectory as USD prims."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.io import colormap, palette, tubes
from softwarp.io.parts import Parts, posed
from softwarp.io.placement import Placement
from softwarp.io.trajectory import Trajectory
from softwarp.io.usd_values import Sampler, colors_of, extent_of, paint, prim_name, set_faces, set_points
from softwarp.model.codes import JOINT_KINDS
from softwarp.shapes import Box, Capsule, Cylinder, Plane, Sphere

Floats = NDArray[np.float64]

SHAPES = "/shapes"  # root of the prototypes that rigid bodies are instances of
_SIDES = 20  # of a rod's swept surface


@dataclass
class PartsOptions:
    """What to show of parts.

    Attributes:
        contacts: Whether to write contacts where they were recorded.
        inversions: Whether to mark elements that are inside out.
        joints: Whether to write the axes of joints.
        twist: Whether rods are swept surfaces with a stripe along the first axis of their sections, not curves.
    """

    contacts: bool
    inversions: bool
    joints: bool
    twist: bool


class PartsWriter:
    """Adds the parts of one recorded world after the other to a stage.

    Args:
        stage: To write to.
        trajectory: What was recorded.
        sampler: Time codes of its frames.
        rows: Recorded worlds that are written; they share the scales of colours and arrows.
        options: What to show.
    """

    def __init__(
        self, stage: Any, trajectory: Trajectory, sampler: Sampler, rows: list[int], options: PartsOptions
    ) -> None:
        self.stage, self.trajectory, self.sampler, self.options = stage, trajectory, sampler, options
        self.parts: Parts = trajectory.parts
        self.size = trajectory.size()
        self.pressure_limit = colormap.legible_limit(np.abs(trajectory.cavity_pressure[:, rows]))
        self.ground = self._still_ground(rows)
        self.force_limit = trajectory.strong_force(rows=rows)
        self._prototypes: dict[tuple[Any, ...], str] = {}

    def write(self, parent: str, row: int, taken: set[str]) -> None:
        """Add all parts of a recorded world below a prim; names are added to ``taken``."""
        for rigid in range(self.parts.rigid_count):
            self._rigid(parent, row, rigid, taken)
        for rod in range(self.parts.rod_count):
            self._rod(parent, row, rod, taken)
        for cavity in range(self.parts.cavity_count):
            self._cavity(parent, row, cavity, taken)
        if self.options.contacts and self.trajectory.contact_x is not None:
            self._contacts(parent, row)
        if self.options.inversions and self.trajectory.inverted_x is not None and self.trajectory.inverted_x.shape[2]:
            self._inversions(parent, self.trajectory.inverted_x[:, row])
        if self.options.joints:
            for joint in range(self.parts.joint_count):
                self._joint(parent, row, joint, taken)

    def floor_height(self, turn: Floats) -> float | None:
        """Height of the ground plane on the stage [m], None without one.

        Args:
            turn: Rotation matrix from the trajectory's axes to those of the stage.
        """
        if self.ground is None:
            return None
        pose = self.trajectory.rigid_pose[0, 0, self.parts.piece_rigid[self.ground]]
        return float((turn @ posed(pose, self.parts.piece_pose[self.ground, None, :3])[0])[2])

    def _still_ground(self, rows: list[int]) -> int | None:
        """The piece that the stage's floor stands for: a ground plane that never moves."""
        t = self.trajectory
        piece = self.parts.ground(t.rigid_pose[0, rows[0]], t.up)
        if piece is None:
            return None
        pose = t.rigid_pose[:, rows, self.parts.piece_rigid[piece]]
        return piece if np.abs(pose - pose[0, 0]).max() < 1e-6 else None

    # Rigid bodies

    def _rigid(self, parent: str, row: int, rigid: int, taken: set[str]) -> None:
        from pxr import UsdGeom

        is_kinematic = bool(self.parts.rigid_kinematic[rigid])
        path = f"{parent}/{prim_name(self.parts.rigid_names[rigid], taken)}"
        xform = UsdGeom.Xform.Define(self.stage, path)
        prim = xform.GetPrim()
        prim.SetCustomDataByKey("softwarp:kinematic", is_kinematic)
        self.sampler.pose(xform, self.trajectory.rigid_pose[:, row, rigid])
        paint(xform, palette.rigid_color(rigid, is_kinematic))
        pieces = self.parts.pieces(rigid)
        if pieces:
            prim.GetReferences().AddInternalReference(self._prototype(pieces))
            prim.SetInstanceable(True)
        if self.ground is not None and pieces == [self.ground]:
            xform.CreatePurposeAttr(UsdGeom.Tokens.guide)  # the checkered floor stands for it

    def _prototype(self, pieces: list[int]) -> str:
        """Path of the shape made of some pieces; equal shapes share one."""
        from pxr import Gf, UsdGeom

        key = tuple(self._piece_key(piece) for piece in pieces)
        if key in self._prototypes:
            return self._prototypes[key]
        if not self._prototypes:
            self.stage.CreateClassPrim(SHAPES)
        path = f"{SHAPES}/shape_{len(self._prototypes)}"
        self._prototypes[key] = path
        UsdGeom.Xform.Define(self.stage, path)
        for number, piece in enumerate(pieces):
            prim = self._piece(f"{path}/piece_{number}", piece)
            Sampler([0.0]).pose(prim, self.parts.piece_pose[[piece]])
            if isinstance(self.parts.piece_shape(piece), Box):
                prim.AddScaleOp().Set(Gf.Vec3f(*self.parts.piece_size[piece].tolist()))
        return path

    def _piece_key(self, piece: int) -> tuple[Any, ...]:
        """What makes two pieces equal."""
        p = self.parts
        x, tri = (np.zeros(0), np.zeros(0)) if p.piece_shape(piece) is not None else p.piece_surface(piece)
        numbers = (p.piece_size[piece], p.piece_pose[piece], x, tri)
        return (int(p.piece_kind[piece]), *(array.tobytes() for array in numbers))

    def _piece(self, path: str, piece: int) -> Any:
        """One solid in its own frame: an exact prim where USD has one, else triangles."""
        from pxr import UsdGeom

        shape = self.parts.piece_shape(piece)
        if isinstance(shape, Sphere):
            prim = UsdGeom.Sphere.Define(self.stage, path)
            prim.CreateRadiusAttr(shape.radius)
        elif isinstance(shape, Capsule | Cylinder):
            kind = UsdGeom.Capsule if isinstance(shape, Capsule) else UsdGeom.Cylinder
            prim = kind.Define(self.stage, path)
            prim.CreateAxisAttr(UsdGeom.Tokens.z)
            prim.CreateRadiusAttr(shape.radius)
            prim.CreateHeightAttr(shape.length)
        elif isinstance(shape, Box):
            prim = UsdGeom.Cube.Define(self.stage, path)
            prim.CreateSizeAttr(1.0)  # a scale gives it its edges
            prim.CreateExtentAttr(extent_of(np.array([[-0.5] * 3, [0.5] * 3]), 0.0))
            return prim
        else:
            x, triangles = self.parts.piece_surface(piece)
            prim = UsdGeom.Mesh.Define(self.stage, path)
            set_faces(prim, np.array([[0, 1, 2, 3]]) if isinstance(shape, Plane) else triangles)
            set_points(prim, x)
            return prim
        prim.CreateExtentAttr(extent_of(shape.bounds, 0.0))
        return prim

    # Rods and chambers

    def _rod(self, parent: str, row: int, rod: int, taken: set[str]) -> None:
        from pxr import UsdGeom, Vt

        nodes = self.parts.rod_points(rod)
        x, q = self.trajectory.rod_x[:, row, nodes], self.trajectory.rod_q[:, row, nodes]
        radius = self.parts.rod_radius[nodes]
        path = f"{parent}/{prim_name(self.parts.rod_names[rod], taken)}"
        if self.options.twist:
            self._swept_rod(path, x, q, radius)
            return
        curve = UsdGeom.BasisCurves.Define(self.stage, path)
        is_round = len(radius) > 2  # two points make no cubic
        curve.CreateTypeAttr(UsdGeom.Tokens.cubic if is_round else UsdGeom.Tokens.linear)
        if is_round:
            curve.CreateBasisAttr(UsdGeom.Tokens.catmullRom)
        curve.CreateWrapAttr(UsdGeom.Tokens.pinned if is_round else UsdGeom.Tokens.nonperiodic)
        curve.CreateCurveVertexCountsAttr(Vt.IntArray([len(radius)]))
        curve.CreateWidthsAttr(Vt.FloatArray.FromNumpy(np.ascontiguousarray(2.0 * radius, dtype=np.float32)))
        curve.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
        self.sampler.points(curve, x, padding=float(radius.max()))
        self.sampler.quaternions(curve, "orientation", q)
        paint(curve, palette.ROD)

    def _swept_rod(self, path: str, x: NDArray[Any], q: NDArray[Any], radius: NDArray[Any]) -> None:
        """A rod as a tube of triangles, striped along d1."""
        from pxr import UsdGeom

        fine = tubes.pieces_per_segment(len(radius) - 1)
        mesh = UsdGeom.Mesh.Define(self.stage, path)
        set_faces(mesh, tubes.tube_triangles(len(radius), _SIDES, fine))
        self.sampler.points(mesh, tubes.sweep(x, q, radius, _SIDES, fine), padding=0.0)
        marked = tubes.stripe(len(radius), _SIDES, fine)
        color = mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
        color.Set(colors_of(np.where(marked[:, None], palette.ROD_STRIPE, palette.ROD)))

    def _cavity(self, parent: str, row: int, cavity: int, taken: set[str]) -> None:
        from pxr import UsdGeom

        t, points = self.trajectory, self.parts.cavity_points(cavity)
        corners = self.parts.cavity_tri
        mine = corners[(corners[:, 0] >= points.start) & (corners[:, 0] < points.stop)] - points.start
        mesh = UsdGeom.Mesh.Define(self.stage, f"{parent}/{prim_name(self.parts.cavity_names[cavity], taken)}")
        set_faces(mesh, mine)
        self.sampler.points(mesh, t.cavity_x[:, row, points], padding=0.0)
        pressure = t.cavity_pressure[:, row, [cavity]]
        self.sampler.primvar(mesh, "pressure", pressure, UsdGeom.Tokens.constant)
        self.sampler.primvar(mesh, "volume", t.cavity_volume[:, row, [cavity]], UsdGeom.Tokens.constant)
        self.sampler.color(mesh, colormap.diverging(pressure, self.pressure_limit), UsdGeom.Tokens.constant)

    # Contacts and joints

    def _contacts(self, parent: str, row: int) -> None:
        """Points and arrows, whose number changes from frame to frame."""
        from pxr import Sdf, UsdGeom, Vt

        t, kinds = self.trajectory, Sdf.ValueTypeNames
        assert t.contact_x is not None and t.contact_force is not None and t.contact_pair is not None
        points = UsdGeom.Points.Define(self.stage, f"{parent}/contacts")
        points.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        points.CreateWidthsAttr(Vt.FloatArray([2.0 * palette.POINT_RADIUS * self.size]))
        paint(points, palette.CONTACT)
        pair = UsdGeom.PrimvarsAPI(points).CreatePrimvar("pair", kinds.IntArray, UsdGeom.Tokens.vertex)
        names = points.GetPrim().CreateAttribute("softwarp:pairNames", kinds.StringArray, custom=True)
        names.Set(Vt.StringArray(list(t.pair_names)))
        arrows = UsdGeom.BasisCurves.Define(self.stage, f"{parent}/contact_forces")
        arrows.CreateTypeAttr(UsdGeom.Tokens.linear)
        arrows.CreateWrapAttr(UsdGeom.Tokens.nonperiodic)
        arrows.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
        paint(arrows, palette.FORCE)
        force = UsdGeom.PrimvarsAPI(arrows).CreatePrimvar("force", kinds.Vector3fArray, UsdGeom.Tokens.uniform)
        recorded = (t.contact_x[:, row], t.contact_force[:, row], t.contact_pair[:, row])
        for code, x, f, number in zip(self.sampler.codes, *recorded, strict=True):
            there = (number >= 0) & np.isfinite(x).all(axis=-1) & np.isfinite(f).all(axis=-1)
            path, widths = self._arrows(x[there], f[there])
            points.CreatePointsAttr().Set(_vectors(x[there]), code)
            points.CreateExtentAttr().Set(extent_of(x[there], palette.POINT_RADIUS * self.size), code)
            pair.Set(Vt.IntArray.FromNumpy(np.ascontiguousarray(number[there])), code)
            arrows.CreatePointsAttr().Set(_vectors(path), code)
            arrows.CreateExtentAttr().Set(extent_of(path, 0.5 * float(widths.max(initial=0.0))), code)
            arrows.CreateWidthsAttr().Set(Vt.FloatArray.FromNumpy(widths.astype(np.float32)), code)
            arrows.CreateCurveVertexCountsAttr().Set(Vt.IntArray([4] * int(there.sum())), code)
            force.Set(_vectors(f[there]), code)

    def _inversions(self, parent: str, frames: NDArray[Any]) -> None:
        """A point per element inside out, whose number changes from frame to frame."""
        from pxr import UsdGeom, Vt

        points = UsdGeom.Points.Define(self.stage, f"{parent}/inverted")
        points.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        points.CreateWidthsAttr(Vt.FloatArray([2.0 * palette.MARK_RADIUS * self.size]))
        paint(points, palette.INVERTED)
        for code, x in zip(self.sampler.codes, frames, strict=True):
            there = x[np.isfinite(x).all(axis=-1)]
            points.CreatePointsAttr().Set(_vectors(there), code)
            points.CreateExtentAttr().Set(extent_of(there, palette.MARK_RADIUS * self.size), code)

    def _arrows(self, x: NDArray[Any], force: NDArray[Any]) -> tuple[Floats, Floats]:
        """Curves of four points whose widths make a shaft and a head, shapes (4 n, 3) and (4 n,)."""
        shaft = 2.0 * palette.ARROW_RADIUS * self.size
        limit = max(self.force_limit, 1e-30)
        strength = np.linalg.norm(force, axis=-1, keepdims=True) / limit
        vector = force / limit / np.maximum(strength / palette.ARROW_EXCESS, 1.0) * palette.ARROW_LENGTH * self.size
        length = np.linalg.norm(vector, axis=-1, keepdims=True)
        neck = x + vector * np.maximum(1.0 - 3.0 * shaft / np.maximum(length, 1e-30), 0.0)
        path = np.stack([x, neck, neck, x + vector], axis=1).reshape(-1, 3)
        return path, (np.minimum(shaft, 0.4 * length) * np.array([1.0, 1.0, 2.6, 0.0])).ravel()

    def _joint(self, parent: str, row: int, joint: int, taken: set[str]) -> None:
        """A curve along the axis of a hinge or slider, a point for the others."""
        from pxr import UsdGeom, Vt

        t, kind = self.trajectory, JOINT_KINDS[int(self.parts.joint_kind[joint])]
        poses = Placement.of_trajectory(t, slice(None), row).frame_pose()
        assert poses is not None
        line = self.parts.joint_line(joint, poses, 0.5 * palette.AXIS_LENGTH * self.size)
        path = f"{parent}/{prim_name(self.parts.joint_names[joint], taken)}"
        width = 2.0 * palette.ARROW_RADIUS * self.size
        if kind in ("hinge", "slider"):
            shape = UsdGeom.BasisCurves.Define(self.stage, path)
            shape.CreateTypeAttr(UsdGeom.Tokens.linear)
            shape.CreateWrapAttr(UsdGeom.Tokens.nonperiodic)
            shape.CreateCurveVertexCountsAttr(Vt.IntArray([2]))
            frames = line[:, 1:]
        else:
            shape, frames, width = UsdGeom.Points.Define(self.stage, path), line[:, :1], 2.0 * width
        shape.CreateWidthsAttr(Vt.FloatArray([width]))
        shape.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        self.sampler.points(shape, frames, padding=0.5 * width)
        shape.GetPrim().SetCustomDataByKey("softwarp:joint", kind)
        paint(shape, palette.JOINT)


def _vectors(values: NDArray[Any]) -> Any:
    from pxr import Vt

    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))
