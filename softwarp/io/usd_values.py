"""How numbers go into USD prims: names, colours, extents, and samples over time."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.io import colormap

Floats = NDArray[np.float64]


class Sampler:
    """Writes time samples at the time codes of a recording's frames.

    Args:
        codes: Time code of every frame.
    """

    def __init__(self, codes: Sequence[float]) -> None:
        self.codes = codes

    def points(self, shape: Any, frames: NDArray[Any], padding: float) -> None:
        """The points, shape (frame, point, 3), and the extent of a point-based prim, grown by half its widths."""
        from pxr import Vt

        points, extent = shape.CreatePointsAttr(), shape.CreateExtentAttr()
        for code, x in zip(self.codes, frames, strict=True):
            points.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(x, dtype=np.float32)), code)
            extent.Set(extent_of(x, padding), code)

    def primvar(self, shape: Any, name: str, values: NDArray[Any], interpolation: str) -> None:
        """A float primvar, shape (frame, item)."""
        from pxr import Sdf, UsdGeom, Vt

        primvar = UsdGeom.PrimvarsAPI(shape).CreatePrimvar(name, Sdf.ValueTypeNames.FloatArray, interpolation)
        for code, value in zip(self.codes, values, strict=True):
            primvar.Set(Vt.FloatArray.FromNumpy(np.ascontiguousarray(value, dtype=np.float32)), code)

    def quaternions(self, shape: Any, name: str, values: NDArray[Any]) -> None:
        """A quaternion primvar per vertex from quaternions x y z w, shape (frame, item, 4)."""
        from pxr import Sdf, UsdGeom, Vt

        kind = Sdf.ValueTypeNames.QuatfArray
        primvar = UsdGeom.PrimvarsAPI(shape).CreatePrimvar(name, kind, UsdGeom.Tokens.vertex)
        for code, value in zip(self.codes, continuous(values), strict=True):
            primvar.Set(Vt.QuatfArray.FromNumpy(np.ascontiguousarray(value, dtype=np.float32)), code)

    def color(self, shape: Any, shades: Floats, interpolation: str) -> None:
        """The display colour from sRGB colours, shape (frame, item, 3)."""
        color = shape.CreateDisplayColorPrimvar(interpolation)
        for code, shade in zip(self.codes, shades, strict=True):
            color.Set(colors_of(shade), code)

    def pose(self, xform: Any, poses: NDArray[Any]) -> None:
        """Translation and orientation from poses, shape (frame, 7); what stands still gets one value without a time."""
        from pxr import Gf

        moving = poses.copy().astype(np.float64)
        moving[:, 3:] = continuous(moving[:, 3:])
        translate, orient = xform.AddTranslateOp(), xform.AddOrientOp()
        times: list[tuple[float, ...]] = [(code,) for code in self.codes]
        if not np.ptp(moving, axis=0).any():
            moving, times = moving[:1], [()]
        for time, (x, y, z, i, j, k, w) in zip(times, moving.tolist(), strict=True):
            translate.Set(Gf.Vec3d(x, y, z), *time)
            orient.Set(Gf.Quatf(w, i, j, k), *time)


def continuous(quaternions: NDArray[Any]) -> NDArray[Any]:
    """Quaternions over frames, shape (frame, ..., 4), with signs such that none jumps to its opposite."""
    near = np.einsum("f...i,f...i->f...", quaternions[1:], quaternions[:-1]) >= 0.0
    sign = np.cumprod(np.concatenate([np.ones_like(quaternions[:1, ..., 0]), np.where(near, 1.0, -1.0)]), axis=0)
    return np.asarray(quaternions * sign[..., None])


def set_points(shape: Any, points: NDArray[Any]) -> None:
    """Points that do not move, shape (n, 3), and their extent."""
    from pxr import Vt

    shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points, dtype=np.float32)))
    shape.CreateExtentAttr(extent_of(points, 0.0))


def set_faces(mesh: Any, triangles: NDArray[Any]) -> None:
    """Constant topology of a polygon mesh from triangles, shape (t, 3), or other faces of one size."""
    from pxr import UsdGeom, Vt

    faces = np.asarray(triangles, dtype=np.int32)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), faces.shape[1], dtype=np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces.ravel())))


def paint(shape: Any, color: Sequence[float], opacity: float = 1.0) -> None:
    """One display colour (sRGB) for a prim and what it holds."""
    from pxr import Sdf, UsdGeom

    api, constant = UsdGeom.PrimvarsAPI(shape), UsdGeom.Tokens.constant
    api.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, constant).Set(colors_of([color]))
    if opacity < 1.0:
        api.CreatePrimvar("displayOpacity", Sdf.ValueTypeNames.FloatArray, constant).Set([opacity])


def extent_of(points: NDArray[Any], padding: float) -> Any:
    """Extent of points grown by a padding; of no points, an empty one about the origin."""
    from pxr import Vt

    x = points if len(points) else np.zeros((1, 3))
    corners = np.stack([x.min(axis=0) - padding, x.max(axis=0) + padding])
    return Vt.Vec3fArray.FromNumpy(corners.astype(np.float32))


def colors_of(srgb: Any) -> Any:
    """USD colours (linear light) of sRGB ones, shape (n, 3)."""
    from pxr import Vt

    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(colormap.srgb_to_linear(srgb), dtype=np.float32))


def prim_name(name: str, taken: set[str]) -> str:
    """A valid prim name that no sibling has; it is added to ``taken``."""
    from pxr import Tf

    base = valid = Tf.MakeValidIdentifier(f"_{name}" if name[:1].isdigit() else name)
    count = 1
    while valid in taken:
        count += 1
        valid = f"{base}_{count}"
    taken.add(valid)
    return str(valid)
