"""Pictures of many worlds at once, without a window or OpenGL: a ray caster in Warp, on CPU and CUDA.

Every world has its own bounding volume hierarchy over the surface of its bodies, refitted for each picture. A primary
ray per pixel and a shadow ray where it lands; pixels on an edge are cast again with four rays.
"""

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softwarp import checks, notices
from softwarp.io import colormap, palette
from softwarp.io.colormap import srgb_to_linear
from softwarp.io.parts import ChamberPoints, Parts, posed, tri_membrane
from softwarp.io.placement import Placement
from softwarp.io.trajectory import up_against
from softwarp.render import raycast
from softwarp.render.camera import MARGIN, Camera, around, within, workspace
from softwarp.render.layer import Layer, no_surface, upload
from softwarp.render.look import default_floor, look_of, view_of
from softwarp.render.notes import Notes, contact_notes, inversion_notes, joined, joint_notes
from softwarp.render.solids import Solids
from softwarp.shapes.base import quaternion_product
from softwarp.threads import alone, begin
from softwarp.unpicklable import Unpicklable

if TYPE_CHECKING:
    from softwarp.model.model import Model
    from softwarp.simulation import Simulation

Frames = NDArray[np.uint8]
Floats = NDArray[np.float64]

_MOST_PIXELS = 16384  # along one side
_EDGE_CONTRAST = 0.035  # difference between neighbouring pixels, on a square-root scale, that asks for more rays
_CABLE_RADIUS = 0.0045  # of the size of the body
_MEMBRANE_COVER = 0.55  # how much of its colour a triangle owes to a membrane on it
_GOAL_RADIUS = 0.035  # of the size of the body
_LEAST_ROD, _LEAST_CABLE, _LEAST_GOAL = 1.25, 0.7, 3.0  # pixels, least drawn radii in the middle of the picture
_LIGHT_SPREAD = 0.045  # tangent of the key light's half angle: softens shadows
_BATCH_PIXELS = 1 << 24  # pixels held at once; more worlds are drawn in turns


class RayCaster(Unpicklable, instead="make it there: RayCaster.for_model(sim.model)"):
    """Draws soft and rigid bodies, rods, cables, air chambers and goals of many worlds on a checkered floor.

    Args:
        triangles: Outward surface triangles of soft bodies as node indices, shape (tri, 3).
        rest: Rest positions of the nodes [m], shape (node, 3); they set the scale, the camera and the edges.
        parts: Rigid bodies, rods and chambers; None for soft bodies alone. A level kinematic plane becomes the floor.
        placed: Where these are at rest, n = 1.
        fixed: Nodes held fixed, drawn darker, shape (node,).
        cable_point_start: Cable c owns the points start[c] to start[c + 1], shape (cable + 1,).
        tri_membrane: Membrane on each triangle or -1, shape (tri,); membranes are tinted.
        up: Unit vector that points upwards; the floor is normal to it.
        region: Positions [m] that the picture shows, the lowest of them on the floor, shape (k, 3); None takes what
            there is at rest, with room to bend for a body held at ``fixed``.
        beside: More positions to show [m], such as goals, shape (k, 3).
        camera: Where to look from; None sees all of ``region`` and ``beside``, and stays.
        towards: Direction from there to the eye if ``camera`` is None, (3,); None looks from the front and above.
        width: Picture width [pixels].
        height: Picture height [pixels].
        samples: Rays for a pixel on an edge or in a penumbra; 1 leaves edges jagged and shadows hard, 16 is for print.
        twist: Whether rods carry a stripe along the first axis of their sections.
        cable_radius: Drawn radius of cables [m]; None fits the body's size.
        goal_radius: Drawn radius of goals [m]; None fits the body's size.
        device: Warp device.
        threads: CPU threads; None takes all that the process may use.
    """

    @alone
    def __init__(
        self,
        triangles: ArrayLike,
        rest: ArrayLike,
        *,
        parts: Parts | None = None,
        placed: Placement | None = None,
        fixed: ArrayLike | None = None,
        cable_point_start: ArrayLike = (0,),
        tri_membrane: ArrayLike | None = None,
        up: ArrayLike = (0.0, 0.0, 1.0),
        region: ArrayLike | None = None,
        beside: ArrayLike | None = None,
        camera: Camera | None = None,
        towards: ArrayLike | None = None,
        width: int = 320,
        height: int = 240,
        samples: int = 4,
        twist: bool = False,
        cable_radius: float | None = None,
        goal_radius: float | None = None,
        device: str = "cpu",
        threads: int | None = None,
    ) -> None:
        tri, rest_x = _surface(triangles, rest)
        up = checks.array(up, "ray caster: up", (3,), low=-checks.FARTHEST, high=checks.FARTHEST)
        self.parts = Parts() if parts is None else parts
        start = _complete(self.parts, placed)
        _check_surface(tri, rest_x, self.parts)
        for name, value in (("width", width), ("height", height)):
            checks.count(value, f"ray caster: {name} of a picture [pixels]", high=_MOST_PIXELS)
        checks.count(samples, "ray caster: samples", high=256)
        for name, radius in (("cable_radius", cable_radius), ("goal_radius", goal_radius)):
            if radius is not None:
                checks.number(radius, f"ray caster: {name} [m]", above=0.0, high=checks.FARTHEST)
        if fixed is not None and checks.as_array(fixed).shape != (len(rest_x),):
            raise ValueError(checks.refusal("ray caster: fixed", f"be flags of shape ({len(rest_x)},)", fixed))
        far, need = checks.FARTHEST, "be finite positions of shape (k, 3)"
        if region is not None:
            region = checks.array(region, "ray caster: region", (None, 3), low=-far, high=far, need=need)
        shown = _reach(rest_x, fixed, self.parts, start) if region is None else np.asarray(region)
        if beside is not None:
            more = checks.array(beside, "ray caster: beside", (None, 3), low=-far, high=far, need=need)
            shown = np.concatenate([shown, more])
        self.width, self.height, self.samples = width, height, samples
        self.camera = Camera.seeing(shown, up, towards=towards, aspect=width / height) if camera is None else camera
        self.device = _device_name(device)
        self.node_count = rest_x.shape[0]
        self.cable_point_start = np.asarray(cable_point_start, dtype=np.int32)
        self._threads = _usable_cores() if threads is None else checks.count(threads, "ray caster: threads", high=4096)
        self.size = self.parts.scene_size(rest_x[tri], start.rigid_pose[0], start.rod_x[0])
        self._up = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
        self._ground = self.parts.ground(start.rigid_pose[0], self._up)
        away = float(np.linalg.norm(np.subtract(self.camera.target, self.camera.eye)))
        self._pixel = 2.0 * math.tan(0.5 * math.radians(self.camera.fov)) * away / height  # m
        self._look = self._lit(shown, cable_radius, goal_radius)
        self._view = view_of(self.camera, width, height)
        self._floor = default_floor(self._look, self._up, self.device)
        held = np.zeros(self.node_count, dtype=bool) if fixed is None else np.asarray(fixed, dtype=bool)
        self._node_color = np.where(held[:, None], palette.CLAMP, palette.BODY)
        self._cable_color = np.tile(palette.CABLE, (len(self.cable_point_start) - 1, 1))
        least = _LEAST_ROD * self._pixel
        self._solids = Solids(
            tri,
            rest_x,
            self.parts,
            start,
            least_radius=least,
            hidden=self._ground,
            twist=twist,
            device=self.device,
        )
        self._chambers = Layer(self.parts.cavity_tri, np.asarray(start.cavity_x[0]), 50.0, self.device)
        self._notes: tuple[NDArray[np.int32], Layer] | None = None
        cover = np.zeros(max(len(tri), 1)) if tri_membrane is None else np.asarray(tri_membrane) >= 0
        self._tri_cover = wp.array(_MEMBRANE_COVER * cover, dtype=float, device=self.device)
        self._cables = _Segments(self.cable_point_start, self.device)
        self._worlds: _Worlds | None = None
        self._chamber_points: ChamberPoints | None = None

    def _lit(self, shown: Floats, cable_radius: float | None, goal_radius: float | None) -> Any:
        """Light, colours and measures for the positions to show [m]."""
        cable = _CABLE_RADIUS * self.size if cable_radius is None else cable_radius
        goal = _GOAL_RADIUS * self.size if goal_radius is None else goal_radius
        cable, goal = max(cable, _LEAST_CABLE * self._pixel), max(goal, _LEAST_GOAL * self._pixel)
        look = look_of(shown, self._up, self.camera, self.size, cable, goal)
        # Few rays make a wide penumbra grainy, so it narrows with their number.
        look.light_spread = _LIGHT_SPREAD * min(1.0, (self.samples - 1) / 12.0)
        look.light_turn = 2.39996323 * self.samples  # golden angles
        return look

    def look_from(self, camera: Camera) -> None:
        """Take the next pictures with another camera; light and floor stay, so that films are steady."""
        self.camera = camera
        self._view = view_of(camera, self.width, self.height)

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
        """A ray caster for all bodies, rods, chambers and cables of a model.

        Args:
            model: What to draw.
            width: Picture width [pixels].
            height: Picture height [pixels].
            camera: Where to look from; None sees the robot, which fills the picture.
            device: Warp device; None takes the model's.
            **options: As for the class; ``up`` points against the model's gravity unless given.
        """
        options.setdefault("up", up_against(model.defaults["gravity"]))
        if model.membranes is not None:
            options.setdefault("tri_membrane", tri_membrane(model.surface_tri, model.membranes))
        caster = cls(
            model.surface_tri,
            model.node_rest,
            parts=Parts.of_model(model),
            placed=Placement.at_rest(model),
            fixed=model.node_fixed,
            cable_point_start=model.cable_point_start,
            camera=camera,
            width=width,
            height=height,
            device=str(model.device) if device is None else device,
            **options,
        )
        caster._chamber_points = ChamberPoints(model)
        return caster

    def draw(
        self,
        sim: "Simulation",
        worlds: Sequence[int] | None = None,
        goals: Any | None = None,
        *,
        contacts: bool = False,
        joints: bool = False,
        inversions: bool = False,
    ) -> Frames:
        """Draw worlds of a running simulation of the model that ``for_model`` was given.

        Args:
            sim: The simulation; it is never changed.
            worlds: Which worlds; None draws all.
            goals: Goal positions of these worlds [m], shape (n, 3); None draws no goals.
            contacts: Whether to show contacts: points, and arrows along the forces on the first part of their pairs.
            joints: Whether to show the axes of joints.
            inversions: Whether to mark elements that are inside out.

        Returns:
            Pictures, shape (n, height, width, 3).

        Raises:
            ValueError: If the ray caster was made without a model, or for another one.
        """
        if self._chamber_points is None:
            raise ValueError("ray caster: draw needs RayCaster.for_model(sim.model); use render for bare positions")
        chosen = list(range(sim.num_worlds)) if worlds is None else [int(w) for w in worlds]
        points, shown = self._chamber_points, {"contacts": contacts, "inversions": inversions}
        placed = Placement.of_simulation(sim, points, chosen, **shown)
        return self.render(sim.node_x[chosen], sim.cable_x[chosen], goals, placed, joints=joints)

    @alone
    def render(
        self,
        node_x: Any,
        cable_x: Any | None = None,
        goals: Any | None = None,
        placed: Placement | None = None,
        *,
        node_color: ArrayLike | None = None,
        cable_color: ArrayLike | None = None,
        pressure_limit: float | None = None,
        force_limit: float | None = None,
        joints: bool = False,
    ) -> Frames:
        """Draw one picture per world.

        Args:
            node_x: Node positions [m], shape (n, node, 3), numpy or torch on any device.
            cable_x: Points of all cables in order [m], shape (n, point, 3); None draws no cables.
            goals: Goal positions [m], shape (n, 3); None draws no goals.
            placed: Where rigid bodies, rods and chambers are, and contacts and elements inside out to show; what it
                lacks is not drawn.
            node_color: sRGB colours of the nodes in [0, 1], shape (node, 3) or (n, node, 3).
            cable_color: sRGB colours of the cables in [0, 1], shape (cable, 3) or (n, cable, 3).
            pressure_limit: Magnitude of the gauge pressure [Pa] with the strongest colour; None fits the pictures.
            force_limit: Force [N] with the longest arrow; None fits the pictures.
            joints: Whether to show the axes of joints.

        Returns:
            Pictures, shape (n, height, width, 3).

        Raises:
            ValueError: If a shape does not fit the model.
        """
        count, cable_count = len(node_x), len(self.cable_point_start) - 1
        node_x = _checked_points("node_x", node_x, (count, self.node_count, 3))
        cable_x = _checked_points("cable_x", cable_x, (count, int(self.cable_point_start[-1]), 3))
        goals = _checked_points("goals", goals, (count, 3))
        placed = _checked_placement(Placement() if placed is None else placed, self.parts, count)
        paint = _linear_colors("node_color", node_color, self._node_color, count)
        shades = _linear_colors("cable_color", cable_color, self._cable_color, count)
        walls = self._chamber_colors(placed, pressure_limit)
        notes = self._noted(placed, force_limit, joints)
        images = np.empty((count, self.height, self.width, 3), dtype=np.uint8)
        batch = max(1, _BATCH_PIXELS // (self.width * self.height))
        for first in range(0, count, batch):
            notices.progress("drawing", f"{first} of {count} pictures")
            part = slice(first, min(first + batch, count))
            worlds = self._reserve(part.stop - part.start)
            scene = self._place(node_x[part], paint if len(paint) == 1 else paint[part], placed.part(part))
            if placed.cavity_x is not None and self.parts.cavity_count:
                self._chambers.reserve(part.stop - part.start)
                self._chambers.put(placed.cavity_x[part])
                scene.chamber = self._chambers.surface(part.stop - part.start, walls[part])
            if notes is not None:
                scene.note = self._place_notes(notes, part)
            if cable_x is not None and cable_count:
                radius = float(self._look.cable_radius)
                worlds.place_cables(
                    scene, self._cables, cable_x[part], shades if len(shades) == 1 else shades[part], radius
                )
            if goals is not None:
                scene.goal = upload(goals[part], self.device)
            images[part] = self._draw(scene, worlds, part.stop - part.start)
        return images

    def _place(self, node_x: Any, node_color: Floats, placed: Placement) -> Any:
        """A scene with the solids of as many worlds as ``node_x`` holds."""
        count = len(node_x)
        self._solids.place(count, node_x, placed)
        scene = raycast.Scene()
        scene.solid = self._solids.surface(count, node_color)
        scene.soft_tris, scene.tri_cover = self._solids.soft_tris, self._tri_cover
        scene.chamber, scene.note = no_surface(self.device), no_surface(self.device)
        scene.floor = self._floor_of(placed)
        scene.seg_point, scene.seg_cable = self._cables.seg_point, self._cables.seg_cable
        with wp.ScopedDevice(self.device):
            scene.cable_bvh = wp.empty(0, dtype=wp.uint64)
            scene.cable_x = wp.empty((0, 0), dtype=wp.vec3)
            scene.cable_color = wp.empty((0, 0), dtype=wp.vec3)
            scene.goal = wp.empty(0, dtype=wp.vec3)
        return scene

    def _floor_of(self, placed: Placement) -> wp.array:
        """Pose of the floor in every world: that of the ground plane, where there is one."""
        if self._ground is None or placed.rigid_pose is None:
            return self._floor
        body, local = int(self.parts.piece_rigid[self._ground]), self.parts.piece_pose[self._ground]
        pose = _on_host(placed.rigid_pose)[:, body].astype(np.float64)
        x = posed(pose, local[None, :3])[:, 0]
        q = np.array([quaternion_product(p[3:], local[3:]) for p in pose])
        return upload(np.concatenate([x, q], axis=1), self.device, wp.transform)

    def _chamber_colors(self, placed: Placement, limit: float | None) -> Floats:
        """Linear-light colours of the chambers' points by pressure, shape (n, cavity_point, 3)."""
        count = 0 if placed.cavity_x is None else len(placed.cavity_x)
        pressure = np.zeros((count, self.parts.cavity_count))
        if placed.cavity_pressure is not None:
            pressure = _on_host(placed.cavity_pressure)
        strongest = colormap.legible_limit(np.abs(pressure)) if limit is None else limit
        shade = srgb_to_linear(colormap.diverging(pressure, strongest))
        return np.repeat(shade, np.diff(self.parts.cavity_point_start), axis=1)

    def _noted(self, placed: Placement, limit: float | None, joints: bool) -> Notes | None:
        """Arrows and axes to draw in every world."""
        found = []
        if placed.contact_x is not None and placed.contact_x.shape[1]:
            force = np.linalg.norm(_on_host(placed.contact_force), axis=-1)
            there = np.isfinite(_on_host(placed.contact_x)).all(axis=-1) & np.isfinite(force)
            strongest = float(force[there].max(initial=0.0)) if limit is None else limit
            found.append(contact_notes(placed.contact_x, placed.contact_force, self.size, strongest))
        frames = placed.frame_pose() if joints and self.parts.joint_count else None
        if frames is not None:
            found.append(joint_notes(self.parts, frames, self.size))
        if placed.inverted_x is not None and placed.inverted_x.shape[1]:
            found.append(inversion_notes(placed.inverted_x, self.size))
        return joined(found) if found else None

    def _place_notes(self, notes: Notes, part: slice) -> Any:
        """The surface of notes; its topology is kept as long as their number stays."""
        x = notes.x[part]
        if self._notes is None or not np.array_equal(self._notes[0], notes.triangles):
            self._notes = (notes.triangles, Layer(notes.triangles, notes.shape, 50.0, self.device))
        layer = self._notes[1]
        layer.reserve(len(x))
        layer.put(x)
        return layer.surface(len(x), srgb_to_linear(notes.color)[None])

    def _reserve(self, count: int) -> "_Worlds":
        """Room for ``count`` worlds; kept from picture to picture."""
        if self._worlds is None or self._worlds.capacity < count:
            self._worlds = None  # gives back the smaller one first
            self._worlds = _Worlds(count, self._cables.seg_count, self.height, self.width, self.device)
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
        """Run ``work(first, count)`` over all picture rows, on a CPU split over threads, for which this one waits."""
        if self.device != "cpu" or self._threads == 1:
            work(0, rows)
            return
        wp.load_module(raycast, device=self.device)
        piece = -(-rows // (4 * self._threads))
        with ThreadPoolExecutor(self._threads) as pool:
            list(pool.map(lambda first: work(first, min(piece, rows - first)), range(0, rows, piece)))


class _Segments:
    """Segments of cables on the device."""

    def __init__(self, cable_point_start: NDArray[np.int32], device: str) -> None:
        point_cable = np.repeat(np.arange(len(cable_point_start) - 1), np.diff(cable_point_start))
        seg_point = np.setdiff1d(np.arange(int(cable_point_start[-1])), cable_point_start[1:] - 1)
        with wp.ScopedDevice(device):
            self.seg_point = wp.array(seg_point, dtype=int)
            self.seg_cable = wp.array(point_cable[seg_point], dtype=int)
        self.seg_count = len(seg_point)


class _Worlds:
    """Pictures and cables of a number of worlds."""

    def __init__(self, capacity: int, seg_count: int, height: int, width: int, device: str) -> None:
        self.capacity, self.device = capacity, device
        with wp.ScopedDevice(device):
            self.seg_low = wp.empty((capacity, seg_count), dtype=wp.vec3)
            self.seg_high = wp.empty((capacity, seg_count), dtype=wp.vec3)
            self.light = wp.empty((capacity, height, width), dtype=wp.vec3)
            self.image = wp.empty((capacity, height, width), dtype=wp.vec3ub)
        self._bvh: list[wp.Bvh] = []

    def place_cables(self, scene: Any, segments: _Segments, cable_x: Any, cable_color: Floats, radius: float) -> None:
        """Add the cables of as many worlds as ``cable_x`` holds to a scene."""
        count = len(cable_x)
        scene.cable_x = upload(cable_x, self.device)
        scene.cable_color = upload(cable_color, self.device)
        wp.launch(
            raycast._segment_boxes,
            dim=(count, segments.seg_count),
            inputs=[segments.seg_point, scene.cable_x, radius],
            outputs=[self.seg_low, self.seg_high],
            device=self.device,
        )
        for bvh in self._bvh[:count]:
            bvh.refit()
        for world in range(len(self._bvh), count):
            self._bvh.append(wp.Bvh(self.seg_low[world], self.seg_high[world]))
        scene.cable_bvh = wp.array([bvh.id for bvh in self._bvh[:count]], dtype=wp.uint64, device=self.device)


def _reach(rest: Floats, fixed: ArrayLike | None, parts: Parts, placed: Placement) -> Floats:
    """Positions [m] to show of a scene: what moves and where it bends, and kinematic bodies near by."""
    pose, rod_x = placed.rigid_pose[0], placed.rod_x[0]
    free = np.flatnonzero(~parts.rigid_kinematic)
    moving = np.concatenate([parts.rod_outline(rod_x), *parts.rigid_outline(pose, free)])
    found = ([workspace(rest, fixed)] if len(rest) else []) + ([around(moving, MARGIN)] if len(moving) else [])
    held = np.concatenate(parts.rigid_outline(pose, np.flatnonzero(parts.rigid_kinematic)))
    if found and len(held):
        found.append(within(held, np.concatenate(found), MARGIN))
    elif len(held):
        found.append(held)
    return np.concatenate(found) if found else around([[-0.5] * 3, [0.5] * 3], 0.0)


def _complete(parts: Parts, placed: Placement | None) -> Placement:
    """Where all parts are at rest.

    Raises:
        ValueError: If something of it is missing.
    """
    if placed is None and (parts.rigid_count or parts.rod_count or parts.cavity_count):
        raise ValueError("ray caster: parts need placed, where they are at rest; use Placement.at_rest(model)")
    start = Placement() if placed is None else placed
    empty = Placement(rigid_pose=np.zeros((1, 0, 7)), rod_x=np.zeros((1, 0, 3)), rod_q=np.zeros((1, 0, 4)))
    for name in ("rigid_pose", "rod_x", "rod_q"):
        if getattr(start, name) is not None:
            setattr(empty, name, _on_host(getattr(start, name)).astype(np.float64))
    empty.cavity_x = np.zeros((1, 0, 3)) if start.cavity_x is None else _on_host(start.cavity_x).astype(np.float64)
    return _checked_placement(empty, parts, 1)


def _on_host(array: Any) -> NDArray[Any]:
    return array.detach().cpu().numpy() if hasattr(array, "detach") else np.asarray(array)


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


def _checked_placement(placed: Placement, parts: Parts, count: int) -> Placement:
    """The placement, if it fits the parts."""
    contacts, inverted = (_width(points) for points in (placed.contact_x, placed.inverted_x))
    for name, items in (
        ("rigid_pose", (parts.rigid_count, 7)),
        ("rod_x", (parts.rod_point_count, 3)),
        ("rod_q", (parts.rod_point_count, 4)),
        ("cavity_x", (parts.cavity_point_count, 3)),
        ("cavity_pressure", (parts.cavity_count,)),
        ("contact_x", (contacts, 3)),
        ("contact_force", (contacts, 3)),
        ("inverted_x", (inverted, 3)),
    ):
        value = getattr(placed, name)
        if value is not None and tuple(value.shape) != (count, *items):
            raise ValueError(f"render: {name} must have shape {(count, *items)}, got {tuple(value.shape)}")
    if (placed.contact_x is None) != (placed.contact_force is None):
        raise ValueError("render: contact_x and contact_force go together; give both or none")
    return placed


def _width(points: Any) -> int:
    """Length of the second axis of points, 0 without one."""
    return 0 if points is None or len(np.shape(points)) < 2 else int(points.shape[1])


def _surface(triangles: ArrayLike, rest: ArrayLike) -> tuple[NDArray[np.int64], Floats]:
    """Triangles (tri, 3) and rest positions (node, 3) as arrays, checked before they are cast."""
    corners, far = checks.as_array(triangles), checks.FARTHEST
    if corners.size == 0 and corners.dtype.kind in "fiu":
        corners = np.empty((0, 3), dtype=np.int32)
    corners = checks.integers(corners, "ray caster: triangles", (None, 3), low=-checks.MOST)
    need = "be finite positions of shape (node, 3)"
    return corners.astype(np.int64), checks.array(rest, "ray caster: rest", (None, 3), low=-far, high=far, need=need)


def _check_surface(tri: NDArray[np.int64], rest: Floats, parts: Parts) -> None:
    if not len(tri) and not (parts.rigid_count or parts.rod_count):
        raise ValueError("ray caster: there is nothing to draw; give triangles, or parts with rigid bodies or rods")
    if len(tri) and not 0 <= tri.min() <= tri.max() < len(rest):
        raise ValueError(
            f"ray caster: triangle indices must lie in [0, {len(rest)}), got {tri.min()} to {tri.max()}; "
            "give rest positions of all nodes"
        )


def _usable_cores() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _device_name(device: str) -> str:
    begin()
    try:
        return str(wp.get_device(device))
    except (ValueError, RuntimeError) as error:
        known = ", ".join(str(d) for d in wp.get_devices())
        raise ValueError(f"ray caster: no device {device!r} here; there is {known}") from error
