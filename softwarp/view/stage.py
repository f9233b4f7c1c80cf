"""The scene of a running simulation in a browser: worlds side by side, moved without making anything anew."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp.io import colormap, palette
from softwarp.io.parts import ChamberPoints, Parts
from softwarp.io.placement import Placement
from softwarp.io.trajectory import compact_surface, up_against
from softwarp.model.handles import SoftBody
from softwarp.render.camera import around
from softwarp.render.solids import Solids
from softwarp.view.paint import Arrows, ContactPressure, Painted, surface_strain

if TYPE_CHECKING:
    from softwarp.model.model import Model
    from softwarp.simulation import Simulation

Floats = NDArray[np.float64]

_GAP = 1.35  # from world to world, in widths of the scene
_CABLE, _GOAL = 0.009, 0.035  # thickness of cables, radius of goals, in sizes of the scene
_SEEN_THROUGH = 0.3  # opacity of bodies that show their chambers
_WALL_OPACITY = 0.75


class Stage:
    """Soft bodies, rigid bodies, rods, cables, chambers, contact forces and goals of all worlds of a simulation.

    A body is one mesh whose vertices move: viser keeps the newest vertices alone for clients that come later, so memory
    stays as it is however long this goes on.

    Args:
        server: A ``viser.ViserServer``.
        sim: The simulation; it is never changed.
        has_goals: Whether ``show`` will be given goals.
        goal_radius: Of their balls [m]; None fits the scene's size.
        worlds: How many of the simulation's worlds are shown, from the first on; None shows all.
    """

    def __init__(
        self,
        server: Any,
        sim: Simulation,
        *,
        has_goals: bool = False,
        goal_radius: float | None = None,
        worlds: int | None = None,
    ) -> None:
        model = sim.model
        self.sim, self.parts = sim, Parts.of_model(model)
        self.count = sim.num_worlds if worlds is None else worlds
        self.up = up_against(model.defaults["gravity"])
        start = _start(model)
        ground = self.parts.ground(start.rigid_pose[0], self.up)
        triangles = model.surface_tri.astype(np.int64)
        self._solids = Solids(triangles, model.node_rest, self.parts, start, hidden=ground, twist=False, device="cpu")
        self.size = self.parts.scene_size(
            model.node_rest[self._solids.vertex_node], start.rigid_pose[0], start.rod_x[0]
        )
        self._chamber_points = ChamberPoints(model)
        self.offsets = self._grid(model, start)
        server.scene.set_up_direction(tuple(float(v) for v in self.up))
        self._bodies = self._add_bodies(server)
        self._cables = self._add_cables(server, model)
        self._chambers = self._add_chambers(server)
        self._goals = [
            server.scene.add_icosphere(
                f"/goal/{world}",
                radius=_GOAL * self.size if goal_radius is None else goal_radius,
                color=_color(palette.GOAL),
                opacity=0.8,
                subdivisions=2,
            )
            for world in range(self.count if has_goals else 0)
        ]
        self._forces = Arrows(server, self.size)
        self._painted: Painted | None = None
        self._pressure = ContactPressure(self._solids.triangles[self._solids.tri_owner == -1])
        pairs = [] if model.contact is None else model.contact.parts
        self._is_soft_pair = np.array([any(isinstance(part, SoftBody) for part in pair) for pair in pairs], dtype=bool)
        self.limits: dict[str, float] = {}  # ends of the scales: stress [Pa], strain, contact [Pa]
        self._add_floor(server, model, start, ground)
        self._server = server

    @property
    def bodies(self) -> dict[str, Any]:
        """Handles of the meshes by name: ``soft``, ``rigid/<name>``, ``rods``."""
        return {name: handle for name, handle, _ in self._bodies}

    def show(self, goals: ArrayLike | None = None, *, contacts: bool = False, color: str = "plain") -> None:
        """Move everything to where it is now.

        Args:
            goals: Goal positions [m], shape (world, 3).
            contacts: Whether to draw contact forces.
            color: What soft bodies are coloured by: ``plain``, ``stress`` (von Mises), ``strain`` (largest one of the
                surface) or ``contact`` (pressure). The scale widens with the largest value seen, ``limits`` tells it.
        """
        worlds = list(range(self.count))
        x = self.sim.node_x[worlds]
        with_contacts = contacts or color == "contact"
        placed = Placement.of_simulation(self.sim, self._chamber_points, worlds, contacts=with_contacts)
        self._solids.place(self.count, x, placed)
        vertices = self._solids.layer.vertex_x.numpy()[: self.count].astype(np.float32) + self.offsets[:, None]
        vertices = np.nan_to_num(vertices, copy=False)
        for _, handle, chosen in self._bodies:
            handle.vertices = vertices[:, chosen].reshape(-1, 3)
        self._paint(color, vertices, placed)
        if self._cables is not None:
            handle, segments = self._cables
            points = _host(self.sim.cable_x[worlds]) + self.offsets[:, None]
            handle.points = points[:, segments].reshape(-1, 2, 3).astype(np.float32)
        if self._chambers and self._chambers[0][0].visible:
            self._show_chambers(placed)
        if goals is not None:
            for handle, at in zip(self._goals, np.asarray(goals)[: self.count] + self.offsets, strict=True):
                handle.position = tuple(float(v) for v in at)
        if contacts and placed.contact_x is not None:
            self._show_forces(_host(placed.contact_x), _host(placed.contact_force))
        else:
            self._forces.hide()

    def _paint(self, color: str, vertices: NDArray[np.float32], placed: Placement) -> None:
        """Soft bodies in the colours of a scale, in place of the plain ones."""
        soft = self._solids.triangles[self._solids.tri_owner == -1]
        is_plain = color == "plain" or not len(soft)
        if "soft" in self.bodies:
            self.bodies["soft"].visible = is_plain
        if is_plain:
            if self._painted is not None:
                self._painted.hide()
            return
        if self._painted is None:
            self._painted = Painted(self._server, "painted")
        corners = vertices[:, soft]
        if color == "stress":
            stress = _host(self.sim.node_stress())[: self.count, self._solids.vertex_node]
            values = stress[:, soft].mean(axis=-1)
        elif color == "contact":
            values = self._contact_pressure(vertices, placed)
        else:
            values = surface_strain(self._solids.rest[soft], corners)
        if color != "contact" or values.any():  # most triangles touch nothing: the scale is of those that do
            shown = values[values > 0.0] if color == "contact" else values
            self.limits[color] = max(self.limits.get(color, 0.0), colormap.legible_limit(shown))
        self._painted.show(corners.reshape(-1, 3, 3), values.reshape(-1), self.limits.get(color, 1.0))

    def _contact_pressure(self, vertices: NDArray[np.float32], placed: Placement) -> Floats:
        """Pressure of contacts with soft bodies on their triangles [Pa], (world, tri)."""
        if placed.contact_x is None:
            return np.zeros((self.count, int((self._solids.tri_owner == -1).sum())))
        pair = _host(self.sim.contact_pair)[: self.count]
        is_soft = self._is_soft_pair[np.maximum(pair, 0)] & (pair >= 0)
        at = np.where(is_soft[..., None], _host(placed.contact_x) + self.offsets[:, None], np.nan)
        return np.stack(
            [self._pressure(x, p, f) for x, p, f in zip(vertices, at, _host(placed.contact_force), strict=True)]
        )

    def see_through(self, is_on: bool) -> None:
        """Let bodies be seen through, and show the chambers in them, red by pressure and blue by suction."""
        for _, handle, _ in self._bodies:
            handle.opacity = _SEEN_THROUGH if is_on else None
        for handle, *_ in self._chambers:
            handle.visible = is_on

    def world_at(self, point: ArrayLike) -> tuple[int, Floats]:
        """The world whose place on the stage is nearest to a point there, and that point in it [m]."""
        local = np.asarray(point, dtype=np.float64) - self.offsets
        middle = self.sim.model.node_rest.mean(axis=0) if len(self.sim.model.node_rest) else np.zeros(3)
        world = int(np.linalg.norm(local - middle, axis=1).argmin())
        return world, local[world]

    def _grid(self, model: Model, start: Placement) -> Floats:
        """Where the worlds stand [m], (world, 3), in a square on the floor."""
        x = self._solids.rest
        extent = np.ptp(x, axis=0) if len(x) else np.ones(3)
        flat = [axis for axis in range(3) if abs(self.up[axis]) < 0.5] or [0, 1]
        step = _GAP * max(self.size, min(float(extent[flat].max()), 2.0 * self.size))
        columns = math.ceil(math.sqrt(self.count))
        offsets = np.zeros((self.count, 3))
        number = np.arange(self.count)
        offsets[:, flat[0]], offsets[:, flat[-1]] = step * (number % columns), step * (number // columns)
        return offsets

    def _add_bodies(self, server: Any) -> list[tuple[str, Any, NDArray[np.int32]]]:
        """A mesh for soft bodies, one for each rigid body, one for rods: name, handle, its vertices of a world."""
        owner = self._solids.tri_owner
        named = {-1: ("soft", palette.BODY), self.parts.rigid_count: ("rods", palette.ROD)}
        for body, (name, kinematic) in enumerate(zip(self.parts.rigid_names, self.parts.rigid_kinematic, strict=True)):
            named[body] = (f"rigid/{name}", palette.rigid_color(body, bool(kinematic)))
        found = []
        for number in np.unique(owner):
            name, color = named[int(number)]
            vertices, faces = compact_surface(self._solids.triangles[owner == number])
            handle = server.scene.add_mesh_simple(
                f"/{name}",
                np.tile(self._solids.rest[vertices], (self.count, 1)).astype(np.float32),
                _repeated(faces, len(vertices), self.count),
                color=_color(color),
                side="double",
                flat_shading=False,
            )
            found.append((name, handle, vertices))
        return found

    def _add_cables(self, server: Any, model: Model) -> tuple[Any, NDArray[np.int64]] | None:
        """Line segments of all cables, and the two points of each in a world."""
        starts = np.asarray(model.cable_point_start)
        first = np.setdiff1d(np.arange(int(starts[-1])), starts[1:] - 1)
        if not len(first):
            return None
        segments = np.column_stack([first, first + 1])
        points = np.zeros((self.count * len(segments), 2, 3), dtype=np.float32)
        thickness = _CABLE * self.size
        return server.scene.add_line_segments(
            "/cables", points, _color(palette.CABLE), thickness=thickness, thickness_units="world"
        ), segments

    def _add_chambers(self, server: Any) -> list[tuple[Any, int, int]]:
        """A hidden mesh for every chamber of every world: handle, world, chamber."""
        found = []
        for chamber in range(self.parts.cavity_count):
            points = self.parts.cavity_points(chamber)
            tri = self.parts.cavity_tri
            mine = tri[(tri[:, 0] >= points.start) & (tri[:, 0] < points.stop)] - points.start
            for world in range(self.count):
                handle = server.scene.add_mesh_simple(
                    f"/chamber/{chamber}/{world}",
                    np.zeros((points.stop - points.start, 3), dtype=np.float32),
                    mine.astype(np.uint32),
                    opacity=_WALL_OPACITY,
                    side="double",
                    visible=False,
                )
                found.append((handle, world, chamber))
        return found

    def _show_chambers(self, placed: Placement) -> None:
        pressure = _host(placed.cavity_pressure)
        colors = colormap.diverging(pressure, colormap.legible_limit(np.abs(pressure)))
        x = _host(placed.cavity_x)
        for handle, world, chamber in self._chambers:
            points = x[world, self.parts.cavity_points(chamber)] + self.offsets[world]
            handle.vertices = np.nan_to_num(points).astype(np.float32)
            handle.color = _color(colors[world, chamber])

    def _show_forces(self, at: Floats, force: Floats) -> None:
        """Arrows along the forces on the first part of each pair, the strongest as long as pictures have it."""
        there = np.isfinite(at).all(axis=-1) & np.isfinite(force).all(axis=-1)
        strongest = float(np.linalg.norm(force[there], axis=-1).max(initial=0.0))
        self._forces.show(at + self.offsets[:, None], force, strongest)

    def _add_floor(self, server: Any, model: Model, start: Placement, ground: int | None) -> None:
        """A grid below everything, or where the ground plane is."""
        axis = int(np.abs(self.up).argmax())
        along = float(np.sign(self.up[axis]))
        heights = self._solids.rest[:, axis] * along
        low = float(heights.min()) if len(heights) else 0.0
        if ground is not None:
            low = float(start.rigid_pose[0][int(self.parts.piece_rigid[ground]), axis]) * along
        cell = 10.0 ** math.floor(math.log10(self.size))
        middle = self.offsets.mean(axis=0)
        middle[axis] = low * along
        edge = 2.0 * float(np.ptp(self.offsets, axis=0).max()) + 4.0 * self.size
        server.scene.add_grid(
            "/floor",
            width=edge,
            height=edge,
            plane=("yz", "xz", "xy")[axis],
            cell_size=cell,
            section_size=5.0 * cell,
            position=tuple(float(v) for v in middle),
        )

    def region(self) -> Floats:
        """Corners of the box round everything at rest, with room to move [m], shape (8, 3)."""
        rest = self._solids.rest
        points = np.concatenate([rest + offset for offset in self.offsets]) if len(rest) else self.offsets
        return around(points, 0.1)


def _start(model: Model) -> Placement:
    """Where all parts are at rest; parts that a model lacks have no rows."""
    start = Placement.at_rest(model)
    for name, width in (("rigid_pose", 7), ("rod_x", 3), ("rod_q", 4)):
        value = getattr(start, name)
        setattr(start, name, np.zeros((1, 0, width)) if value is None else _host(value).astype(np.float64))
    return start


def _repeated(faces: NDArray[np.int32], vertices: int, count: int) -> NDArray[np.uint32]:
    """Triangles of as many copies of a mesh, one after another."""
    first = vertices * np.arange(count)
    return (faces[None] + first[:, None, None]).reshape(-1, 3).astype(np.uint32)


def _color(color: Any) -> tuple[int, int, int]:
    """An sRGB colour in [0, 1] in bytes."""
    red, green, blue = (round(255.0 * float(v)) for v in color)
    return red, green, blue


def _host(array: Any) -> NDArray[Any]:
    return array.detach().cpu().numpy() if hasattr(array, "detach") else np.asarray(array)
