"""Pictures of many worlds at once, without a window or OpenGL: a ray caster in Warp, on CPU and CUDA.

Every world has its own bounding volume hierarchy over the body's surface, refitted for each picture. A primary ray per
pixel and a shadow ray where it lands; pixels on an edge are cast again with four rays.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softwarp.io import palette
from softwarp.io.colormap import srgb_to_linear
from softwarp.io.trajectory import compact_surface, up_against
from softwarp.render import raycast
from softwarp.render.camera import Camera, horizontal_axes, workspace
from softwarp.render.surface import smooth_corners

if TYPE_CHECKING:
    from softwarp.model import Model

Frames = NDArray[np.uint8]
Floats = NDArray[np.float64]

_CREASE = 50.0  # degrees between neighbouring faces that are shaded as an edge
_EDGE_CONTRAST = 0.035  # difference between neighbouring pixels, on a square-root scale, that asks for more rays
_CABLE_RADIUS = 0.0045  # of the size of the body
_CABLE_GLOW = 0.75  # how strongly a cable just below the surface shows
_CABLE_SINK = 0.03  # of the size of the body: depth at which that has fallen to a third
_GOAL_RADIUS = 0.035  # of the size of the body
_LIGHT_SPREAD = 0.045  # tangent of the key light's half angle: softens shadows
_BATCH_PIXELS = 1 << 24  # pixels held at once; more worlds are drawn in turns


class RayCaster:
    """Draws bodies, cables and goals of many worlds on a checkered floor.

    Args:
        triangles: Outward surface triangles as node indices, shape (tri, 3).
        rest: Rest positions of the nodes [m], shape (node, 3); they set the scale, the camera and the edges.
        fixed: Nodes held fixed, drawn darker, shape (node,).
        cable_point_start: Cable c owns the points start[c] to start[c + 1], shape (cable + 1,).
        up: Unit vector that points upwards; the floor is normal to it.
        region: Positions [m] that the picture shows, the lowest of them on the floor, shape (k, 3); None takes what a
            body held at ``fixed`` can reach.
        camera: Where to look from; None sees all of ``region``.
        width: Picture width [pixels].
        height: Picture height [pixels].
        samples: Rays for a pixel on an edge or in a penumbra; 1 leaves edges jagged and shadows hard, 16 is for print.
        cable_radius: Drawn radius of cables [m]; None fits the body's size.
        goal_radius: Drawn radius of goals [m]; None fits the body's size.
        device: Warp device.
        threads: CPU threads; None takes all that the process may use.
    """

    def __init__(
        self,
        triangles: ArrayLike,
        rest: ArrayLike,
        *,
        fixed: ArrayLike | None = None,
        cable_point_start: ArrayLike = (0,),
        up: ArrayLike = (0.0, 0.0, 1.0),
        region: ArrayLike | None = None,
        camera: Camera | None = None,
        width: int = 320,
        height: int = 240,
        samples: int = 4,
        cable_radius: float | None = None,
        goal_radius: float | None = None,
        device: str = "cpu",
        threads: int | None = None,
    ) -> None:
        tri, rest_x = np.asarray(triangles, dtype=np.int64), np.asarray(rest, dtype=np.float64)
        _check_surface(tri, rest_x)
        if width < 1 or height < 1:
            raise ValueError(f"ray caster: a picture needs at least one pixel, got width {width}, height {height}")
        if not 1 <= samples <= 256:
            raise ValueError(f"ray caster: samples must lie in [1, 256], got {samples}")
        shown = workspace(rest_x, fixed) if region is None else np.asarray(region, dtype=np.float64)
        if shown.ndim != 2 or shown.shape[1] != 3 or not np.all(np.isfinite(shown)):
            raise ValueError(f"ray caster: region must be finite positions of shape (k, 3), got shape {shown.shape}")
        self.width, self.height, self.samples = width, height, samples
        self.camera = Camera.seeing(shown, up, aspect=width / height) if camera is None else camera
        self.device = _device_name(device)
        self.node_count = rest_x.shape[0]
        self.cable_point_start = np.asarray(cable_point_start, dtype=np.int32)
        self._threads = _usable_cores() if threads is None else max(1, threads)
        size = float(np.max(rest_x[tri].max(axis=(0, 1)) - rest_x[tri].min(axis=(0, 1))))
        cable = _CABLE_RADIUS * size if cable_radius is None else cable_radius
        goal = _GOAL_RADIUS * size if goal_radius is None else goal_radius
        self._look = _look(shown, np.asarray(up, dtype=np.float64), self.camera, size, cable, goal)
        # Few rays make a wide penumbra grainy, so it narrows with their number.
        self._look.light_spread = _LIGHT_SPREAD * min(1.0, (samples - 1) / 12.0)
        self._look.light_turn = 2.39996323 * samples  # golden angles
        self._view = _view(self.camera, width, height)
        held = np.zeros(self.node_count, dtype=bool) if fixed is None else np.asarray(fixed, dtype=bool)
        self._node_color = np.where(held[:, None], palette.CLAMP, palette.BODY)
        self._cable_color = np.tile(palette.CABLE, (len(self.cable_point_start) - 1, 1))
        self._surface = _Surface(tri, rest_x, self.cable_point_start, self.device)
        self._worlds: _Worlds | None = None

    @classmethod
    def for_model(
        cls,
        model: "Model",
        *,
        width: int = 320,
        height: int = 240,
        camera: Camera | None = None,
        device: str | None = None,
        **options: Any,
    ) -> "RayCaster":
        """A ray caster for all bodies and cables of a model.

        Args:
            model: What to draw.
            width: Picture width [pixels].
            height: Picture height [pixels].
            camera: Where to look from; None sees the whole workspace.
            device: Warp device; None takes the model's.
            **options: As for the class; ``up`` points against the model's gravity unless given.
        """
        options.setdefault("up", up_against(model.defaults["gravity"]))
        return cls(
            model.surface_tri,
            model.node_rest,
            fixed=model.node_fixed,
            cable_point_start=model.cable_point_start,
            camera=camera,
            width=width,
            height=height,
            device=str(model.device) if device is None else device,
            **options,
        )

    def render(
        self,
        node_x: Any,
        cable_x: Any | None = None,
        goals: Any | None = None,
        *,
        node_color: ArrayLike | None = None,
        cable_color: ArrayLike | None = None,
    ) -> Frames:
        """Draw one picture per world.

        Args:
            node_x: Node positions [m], shape (n, node, 3), numpy or torch on any device.
            cable_x: Points of all cables in order [m], shape (n, point, 3); None draws no cables.
            goals: Goal positions [m], shape (n, 3); None draws no goals.
            node_color: sRGB colours of the nodes in [0, 1], shape (node, 3) or (n, node, 3).
            cable_color: sRGB colours of the cables in [0, 1], shape (cable, 3) or (n, cable, 3).

        Returns:
            Pictures, shape (n, height, width, 3).

        Raises:
            ValueError: If a shape does not fit the model.
        """
        count, cable_count = len(node_x), len(self.cable_point_start) - 1
        node_x = _checked_points("node_x", node_x, (count, self.node_count, 3))
        cable_x = _checked_points("cable_x", cable_x, (count, int(self.cable_point_start[-1]), 3))
        goals = _checked_points("goals", goals, (count, 3))
        paint = _linear_colors("node_color", node_color, self._node_color, count)
        shades = _linear_colors("cable_color", cable_color, self._cable_color, count)
        images = np.empty((count, self.height, self.width, 3), dtype=np.uint8)
        batch = max(1, _BATCH_PIXELS // (self.width * self.height))
        for first in range(0, count, batch):
            part = slice(first, min(first + batch, count))
            worlds = self._reserve(part.stop - part.start)
            scene = worlds.place(self._surface, node_x[part], paint if len(paint) == 1 else paint[part])
            if cable_x is not None and cable_count:
                radius = float(self._look.cable_radius)
                worlds.place_cables(
                    scene, self._surface, cable_x[part], shades if len(shades) == 1 else shades[part], radius
                )
            if goals is not None:
                scene.goal = _upload(goals[part], self.device)
            images[part] = self._draw(scene, worlds, part.stop - part.start)
        return images

    def _reserve(self, count: int) -> "_Worlds":
        """Room for ``count`` worlds; kept from picture to picture."""
        if self._worlds is None or self._worlds.capacity < count:
            self._worlds = None  # gives back the smaller one first
            self._worlds = _Worlds(count, self._surface, self.height, self.width, self.device)
        return self._worlds

    def _draw(self, scene: Any, worlds: "_Worlds", count: int) -> Frames:
        shared = [scene, self._look, self._view]

        def trace(first: int, rows: int) -> None:
            wp.launch(
                raycast._trace,
                dim=(rows, self.width),
                inputs=[*shared, first],
                outputs=[worlds.light],
                device=self.device,
            )

        def resolve(first: int, rows: int) -> None:
            wp.launch(
                raycast._resolve,
                dim=(rows, self.width),
                inputs=[*shared, first, self.samples, _EDGE_CONTRAST, worlds.light],
                outputs=[worlds.image],
                device=self.device,
            )

        for work in (trace, resolve):
            self._over_rows(work, count * self.height)
        return np.asarray(worlds.image.numpy()[:count])

    def _over_rows(self, work: Callable[[int, int], None], rows: int) -> None:
        """Run ``work(first, count)`` over all picture rows, on a CPU split over threads."""
        if self.device != "cpu" or self._threads == 1:
            work(0, rows)
            return
        wp.load_module(raycast, device=self.device)
        piece = -(-rows // (4 * self._threads))
        with ThreadPoolExecutor(self._threads) as pool:
            list(pool.map(lambda first: work(first, min(piece, rows - first)), range(0, rows, piece)))


class _Surface:
    """Topology on the device: surface triangles, shared normals, cable segments."""

    def __init__(self, triangles: NDArray[np.int64], rest: Floats, cable_point_start: NDArray[np.int32], device: str):
        vertex_node, tri_vertex = compact_surface(triangles)
        tri_normal, normal_tri_start, normal_tri = smooth_corners(tri_vertex, rest[vertex_node], _CREASE)
        point_count = int(cable_point_start[-1])
        point_cable = np.repeat(np.arange(len(cable_point_start) - 1), np.diff(cable_point_start))
        seg_point = np.setdiff1d(np.arange(point_count), cable_point_start[1:] - 1)
        with wp.ScopedDevice(device):
            self.vertex_node = wp.array(vertex_node, dtype=int)
            self.tri_vertex = wp.array(tri_vertex, dtype=int)
            self.tri_index = wp.array(tri_vertex.ravel(), dtype=int)
            self.tri_normal = wp.array(tri_normal, dtype=int)
            self.normal_tri_start = wp.array(normal_tri_start, dtype=int)
            self.normal_tri = wp.array(normal_tri, dtype=int)
            self.seg_point = wp.array(seg_point, dtype=int)
            self.seg_cable = wp.array(point_cable[seg_point], dtype=int)
        self.host_vertex_node = vertex_node
        self.vertex_count, self.normal_count = len(vertex_node), len(normal_tri_start) - 1
        self.seg_count = len(seg_point)


class _Worlds:
    """Buffers, hierarchies and pictures of a number of worlds."""

    def __init__(self, capacity: int, surface: _Surface, height: int, width: int, device: str) -> None:
        self.capacity, self.device = capacity, device
        with wp.ScopedDevice(device):
            self.vertex_x = wp.empty((capacity, surface.vertex_count), dtype=wp.vec3)
            self.normal = wp.empty((capacity, surface.normal_count), dtype=wp.vec3)
            self.seg_low = wp.empty((capacity, surface.seg_count), dtype=wp.vec3)
            self.seg_high = wp.empty((capacity, surface.seg_count), dtype=wp.vec3)
            self.light = wp.empty((capacity, height, width), dtype=wp.vec3)
            self.image = wp.empty((capacity, height, width), dtype=wp.vec3ub)
        self._mesh: list[wp.Mesh] = []
        self._bvh: list[wp.Bvh] = []

    def place(self, surface: _Surface, node_x: Any, node_color: Floats) -> Any:
        """A scene with the bodies of as many worlds as ``node_x`` holds."""
        count = len(node_x)
        wp.launch(
            raycast._gather,
            dim=(count, surface.vertex_count),
            inputs=[surface.vertex_node, _upload(node_x, self.device)],
            outputs=[self.vertex_x],
            device=self.device,
        )
        wp.launch(
            raycast._smooth_normals,
            dim=(count, surface.normal_count),
            inputs=[surface.tri_vertex, surface.normal_tri_start, surface.normal_tri, self.vertex_x],
            outputs=[self.normal],
            device=self.device,
        )
        for mesh in self._mesh[:count]:
            mesh.refit()
        for world in range(len(self._mesh), count):
            self._mesh.append(wp.Mesh(points=self.vertex_x[world], indices=surface.tri_index))
        scene = raycast.Scene()
        with wp.ScopedDevice(self.device):
            scene.mesh = wp.array([mesh.id for mesh in self._mesh[:count]], dtype=wp.uint64)
            scene.cable_bvh = wp.empty(0, dtype=wp.uint64)
            scene.cable_x = wp.empty((0, 0), dtype=wp.vec3)
            scene.cable_color = wp.empty((0, 0), dtype=wp.vec3)
            scene.goal = wp.empty(0, dtype=wp.vec3)
        scene.tri_normal, scene.tri_vertex = surface.tri_normal, surface.tri_vertex
        scene.normal = self.normal
        scene.vertex_color = _upload(node_color[:, surface.host_vertex_node], self.device)
        scene.seg_point, scene.seg_cable = surface.seg_point, surface.seg_cable
        return scene

    def place_cables(self, scene: Any, surface: _Surface, cable_x: Any, cable_color: Floats, radius: float) -> None:
        """Add the cables of as many worlds as ``cable_x`` holds to a scene."""
        count = len(cable_x)
        scene.cable_x = _upload(cable_x, self.device)
        scene.cable_color = _upload(cable_color, self.device)
        wp.launch(
            raycast._segment_boxes,
            dim=(count, surface.seg_count),
            inputs=[surface.seg_point, scene.cable_x, radius],
            outputs=[self.seg_low, self.seg_high],
            device=self.device,
        )
        for bvh in self._bvh[:count]:
            bvh.refit()
        for world in range(len(self._bvh), count):
            self._bvh.append(wp.Bvh(self.seg_low[world], self.seg_high[world]))
        scene.cable_bvh = wp.array([bvh.id for bvh in self._bvh[:count]], dtype=wp.uint64, device=self.device)


def _look(region: Floats, up: Floats, camera: Camera, size: float, cable_radius: float, goal_radius: float) -> Any:
    """Light, floor and colours for the positions to show [m] and a body of a size [m].

    The key light stands above, behind the left shoulder of whoever looks through the camera.
    """
    up = up / np.linalg.norm(up)
    side, depth = horizontal_axes(up)
    low, high = region.min(axis=0), region.max(axis=0)
    centre = 0.5 * (low + high)
    centre = centre + (np.min(region @ up) - centre @ up - 0.01 * size) * up
    right = camera.basis()[0]
    light = 0.86 * up - 0.40 * right + 0.30 * np.cross(right, up)
    look = raycast.Look()
    look.up, look.side, look.depth = wp.vec3(*up), wp.vec3(*side), wp.vec3(*depth)
    look.light = wp.vec3(*(light / np.linalg.norm(light)))
    look.floor_centre = wp.vec3(*centre)
    look.floor_cell = _round_length(size / 4.0)
    look.fade = 1.2 * float(np.linalg.norm(high - low)) + 1.5 * size
    look.nudge = 2e-3 * size
    look.cable_radius, look.goal_radius = cable_radius, goal_radius
    look.cable_glow, look.cable_sink = _CABLE_GLOW, _CABLE_SINK * size
    for name, color in (
        ("background", palette.BACKGROUND),
        ("floor_even", palette.FLOOR_EVEN),
        ("floor_odd", palette.FLOOR_ODD),
        ("goal_color", palette.GOAL),
    ):
        setattr(look, name, wp.vec3(*srgb_to_linear(color)))
    return look


def _view(camera: Camera, width: int, height: int) -> Any:
    """The rays of a camera's picture."""
    right, upwards, forward = camera.basis()
    pixel = 2.0 * np.tan(0.5 * np.radians(camera.fov)) / height
    view = raycast.View()
    view.eye = wp.vec3(*camera.eye)
    view.corner = wp.vec3(*(forward - 0.5 * width * pixel * right + 0.5 * height * pixel * upwards))
    view.step_x = wp.vec3(*(pixel * right))
    view.step_y = wp.vec3(*(-pixel * upwards))
    view.pixel = pixel
    view.width, view.height = width, height
    return view


def _round_length(length: float) -> float:
    """The nearest of 1, 2, 5 times a power of ten."""
    steps = np.array([1.0, 2.0, 5.0, 10.0]) * 10.0 ** np.floor(np.log10(length))
    return float(steps[np.argmin(np.abs(np.log(steps / length)))])


def _upload(points: Any, device: str) -> wp.array:
    """Vectors, shape (..., 3), as a Warp array of float32 ``vec3`` on a device; a tensor on that device stays there."""
    if hasattr(points, "detach"):
        points = points.detach()
        if device != "cpu" and points.is_cuda:
            points = points.to(device).float().contiguous()
            wp.synchronize_device(device)  # Torch wrote on a stream of its own
            return wp.from_torch(points, dtype=wp.vec3)
        points = points.cpu().numpy()
    return wp.array(np.ascontiguousarray(points, dtype=np.float32), dtype=wp.vec3, device=device)


def _linear_colors(name: str, colors: ArrayLike | None, default: Floats, count: int) -> Floats:
    """Linear-light colours, shape (1 or count, item, 3), of sRGB ones, or of the default, shape (item, 3)."""
    c = default if colors is None else np.asarray(colors, dtype=np.float64)
    items = len(default)
    if c.shape not in ((items, 3), (count, items, 3)):
        raise ValueError(f"render: {name} must have shape ({items}, 3) or ({count}, {items}, 3), got {c.shape}")
    return srgb_to_linear(c if c.ndim == 3 else c[None])


def _checked_points(name: str, points: Any, shape: tuple[int, ...]) -> Any:
    """The points, as an array if they were a list; None stays None."""
    if points is None:
        return None
    array = np.asarray(points) if isinstance(points, (list, tuple)) else points
    if tuple(array.shape) != shape:
        raise ValueError(f"render: {name} must have shape {shape}, got {tuple(array.shape)}")
    return array


def _check_surface(tri: NDArray[np.int64], rest: Floats) -> None:
    if rest.ndim != 2 or rest.shape[1] != 3 or not np.all(np.isfinite(rest)):
        raise ValueError(f"ray caster: rest must be finite positions of shape (node, 3), got shape {rest.shape}")
    if tri.ndim != 2 or tri.shape[1] != 3 or len(tri) == 0:
        raise ValueError(f"ray caster: triangles must have shape (tri, 3) with at least one, got {tri.shape}")
    if tri.min() < 0 or tri.max() >= len(rest):
        raise ValueError(
            f"ray caster: triangle indices must lie in [0, {len(rest)}), got {tri.min()} to {tri.max()}; "
            "give rest positions of all nodes"
        )


def _usable_cores() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _device_name(device: str) -> str:
    try:
        return str(wp.get_device(device))
    except (ValueError, RuntimeError) as error:
        known = ", ".join(str(d) for d in wp.get_devices())
        raise ValueError(f"ray caster: no device {device!r} here; there is {known}") from error
