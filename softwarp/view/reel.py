"""Recordings in the browser: scrubbed on a page, or as one HTML file that plays without Python or network."""

from __future__ import annotations

import itertools
import math
import os
import threading
import time
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from softwarp import checks
from softwarp.io import colormap, palette
from softwarp.io.atomic import write_text
from softwarp.io.placement import Placement
from softwarp.io.trajectory import Trajectory, compact_surface
from softwarp.render.camera import Camera, around
from softwarp.render.solids import Solids
from softwarp.view import server
from softwarp.view.paint import UNITS, Arrows, ContactPressure, Painted, surface_strain
from softwarp.view.server import FPS, LOCAL, PORT

Floats = NDArray[np.float64]
Color = Literal["plain", "stress", "strain", "contact"]

COLORS: tuple[Color, ...] = ("plain", "stress", "strain", "contact")
_GAP = 1.35  # from world to world, in sizes of the scene
_CABLE, _GOAL = 0.009, 0.035  # thickness of cables, radius of goals, in sizes of the scene
_CHAMBER_OPACITY = 0.75
_BODY_OPACITY = 0.3


class Reel:
    """A recording on the stage of a server; ``show`` moves everything to a frame.

    Args:
        server: A ``viser.ViserServer``.
        trajectory: What was recorded.
    """

    def __init__(self, server: Any, trajectory: Trajectory) -> None:
        self.trajectory, self._server = trajectory, server
        self.size, self.count = trajectory.size(), trajectory.world_count
        start = Placement.of_trajectory(trajectory, slice(0, 1), 0)
        parts = trajectory.parts
        self._ground = parts.ground(start.rigid_pose[0], trajectory.up) if parts.rigid_count else None
        triangles = trajectory.triangles.astype(np.int64)
        self._solids = Solids(
            triangles, trajectory.vertex_rest, parts, start, hidden=self._ground, twist=False, device="cpu"
        )
        flat = [axis for axis in range(3) if abs(trajectory.up[axis]) < 0.5]
        columns = math.ceil(math.sqrt(self.count))
        number = np.arange(self.count)
        step = _GAP * max(self.size, float(np.ptp(trajectory.bounds(), axis=0)[flat].max()))
        self.offsets = np.zeros((self.count, 3))
        self.offsets[:, flat[0]], self.offsets[:, flat[-1]] = step * (number % columns), step * (number // columns)
        server.scene.set_up_direction(tuple(float(v) for v in trajectory.up))
        self.bodies = self._add_bodies()
        self._painted = Painted(server, "painted")
        self._soft = self._solids.triangles[self._solids.tri_owner == -1]
        self._pressure = ContactPressure(self._soft)
        self.limits = self._measure_limits()
        self._cables = self._add_cables()
        self._chambers = self._add_chambers()
        self._forces = Arrows(server, self.size)
        self._goals = [
            server.scene.add_icosphere(
                f"/goal/{world}", radius=_GOAL * self.size, color=_color(palette.GOAL), opacity=0.8, subdivisions=2
            )
            for world in range(self.count if trajectory.goal is not None else 0)
        ]

    @property
    def colors(self) -> tuple[Color, ...]:
        """What bodies can be coloured by."""
        return tuple(name for name in COLORS if name == "plain" or self.limits.get(name, 0.0) > 0.0)

    def show(self, frame: int, color: Color = "plain", *, chambers: bool = False) -> None:
        """Move everything to a frame.

        Args:
            frame: Its index.
            color: What soft bodies are coloured by.
            chambers: Whether bodies are seen through, and chambers shown by their pressure.
        """
        recorded, offsets = self.trajectory, self.offsets
        placed = Placement(
            rigid_pose=recorded.rigid_pose[frame], rod_x=recorded.rod_x[frame], rod_q=recorded.rod_q[frame]
        )
        self._solids.place(self.count, recorded.vertex_x[frame], placed)
        x = np.nan_to_num(self._solids.layer.vertex_x.numpy()[: self.count]) + offsets[:, None]
        for name, (handle, chosen) in self.bodies.items():
            handle.visible = name != "soft" or color == "plain"
            handle.opacity = _BODY_OPACITY if chambers else None
            handle.vertices = x[:, chosen].reshape(-1, 3).astype(np.float32)
        if color == "plain":
            self._painted.hide()
        else:
            values = self._values(frame, color)
            self._painted.show(x[:, self._soft].reshape(-1, 3, 3), values.reshape(-1), self.limits[color])
        if self._cables is not None:
            handle, segments = self._cables
            points = recorded.cable_x[frame] + offsets[:, None]
            handle.points = points[:, segments].reshape(-1, 2, 3).astype(np.float32)
        self._show_chambers(frame, chambers)
        if recorded.contact_x is not None:
            self._show_forces(frame)
        if recorded.goal is not None:
            for goal, at in zip(self._goals, recorded.goal[frame] + offsets, strict=True):
                goal.position = tuple(float(v) for v in at)

    def camera(self) -> Camera:
        """Where all is seen from."""
        corners = around(self.trajectory.bounds().astype(np.float64), 0.1)
        return Camera.seeing(
            np.concatenate([corners + offset for offset in self.offsets]), self.trajectory.up, aspect=1.0
        )

    def _values(self, frame: int, color: Color) -> Floats:
        """A number for each soft triangle, (world, tri)."""
        recorded = self.trajectory
        if color == "stress" and recorded.stress is not None:
            stress = recorded.stress[frame][:, self._solids.vertex_node]
            return np.asarray(stress[:, self._soft].mean(axis=-1))
        if color == "contact" and recorded.contact_x is not None and recorded.contact_force is not None:
            x = recorded.vertex_x[frame][:, self._solids.vertex_node]
            loads = zip(x, recorded.contact_x[frame], recorded.contact_force[frame], strict=True)
            return np.stack([self._pressure(*load) for load in loads])
        rest, now = (x[..., self._solids.vertex_node, :] for x in (recorded.vertex_rest, recorded.vertex_x[frame]))
        return surface_strain(rest[self._soft], now[:, self._soft])

    def _measure_limits(self) -> dict[Color, float]:
        """Ends of the scales, that fit the whole recording."""
        if not len(self._soft):
            return {}
        frames = np.unique(np.linspace(0, self.trajectory.frame_count - 1, 20).astype(int))
        strain = np.concatenate([self._values(int(frame), "strain").reshape(-1) for frame in frames])
        limits: dict[Color, float] = {"strain": colormap.legible_limit(strain)}
        if self.trajectory.stress is not None:
            limits["stress"] = colormap.legible_limit(self.trajectory.stress)
        if self.trajectory.contact_x is not None:
            contact = np.concatenate([self._values(int(frame), "contact").reshape(-1) for frame in frames])
            limits["contact"] = colormap.legible_limit(contact[contact > 0.0]) if contact.any() else 0.0
        return limits

    def _add_bodies(self) -> dict[str, tuple[Any, NDArray[np.int32]]]:
        """A mesh for soft bodies, one for each rigid body, one for rods: handle, its vertices of a world."""
        owner, parts = self._solids.tri_owner, self.trajectory.parts
        named = {-1: ("soft", palette.BODY), parts.rigid_count: ("rods", palette.ROD)}
        for body, (name, kinematic) in enumerate(zip(parts.rigid_names, parts.rigid_kinematic, strict=True)):
            named[body] = (f"rigid/{name}", palette.rigid_color(body, bool(kinematic)))
        found = {}
        for number in np.unique(owner):
            name, color = named[int(number)]
            vertices, faces = compact_surface(self._solids.triangles[owner == number])
            first = len(vertices) * np.arange(self.count)
            handle = self._server.scene.add_mesh_simple(
                f"/{name}",
                np.zeros((self.count * len(vertices), 3), dtype=np.float32),
                (faces[None] + first[:, None, None]).reshape(-1, 3).astype(np.uint32),
                color=_color(color),
                side="double",
            )
            found[name] = (handle, vertices)
        return found

    def _add_cables(self) -> tuple[Any, NDArray[np.int64]] | None:
        """Line segments of all cables, and the two points of each in a world."""
        start = self.trajectory.cable_point_start
        first = np.concatenate(
            [np.arange(a, b - 1) for a, b in itertools.pairwise(start)] or [np.empty(0, dtype=np.int64)]
        ).astype(np.int64)
        if not len(first):
            return None
        points = np.zeros((self.count * len(first), 2, 3), dtype=np.float32)
        options: dict[str, Any] = {"thickness": _CABLE * self.size, "thickness_units": "world"}
        handle = self._server.scene.add_line_segments("/cables", points, _color(palette.CABLE), **options)
        return handle, np.column_stack([first, first + 1])

    def _add_chambers(self) -> list[tuple[Any, int, int]]:
        """A hidden mesh for every chamber of every world: handle, world, chamber."""
        found, parts = [], self.trajectory.parts
        for chamber in range(parts.cavity_count):
            points, tri = parts.cavity_points(chamber), parts.cavity_tri
            mine = tri[(tri[:, 0] >= points.start) & (tri[:, 0] < points.stop)] - points.start
            for world in range(self.count):
                handle = self._server.scene.add_mesh_simple(
                    f"/chamber/{chamber}/{world}",
                    np.zeros((points.stop - points.start, 3), dtype=np.float32),
                    mine.astype(np.uint32),
                    opacity=_CHAMBER_OPACITY,
                    side="double",
                    visible=False,
                )
                found.append((handle, world, chamber))
        return found

    def _show_chambers(self, frame: int, is_on: bool) -> None:
        """Chambers red by pressure, blue by suction."""
        recorded = self.trajectory
        limit = colormap.legible_limit(np.abs(recorded.cavity_pressure))
        for handle, world, chamber in self._chambers:
            handle.visible = is_on
            if is_on:
                points = recorded.cavity_x[frame, world, recorded.parts.cavity_points(chamber)] + self.offsets[world]
                handle.vertices = np.nan_to_num(points).astype(np.float32)
                handle.color = _color(colormap.diverging(recorded.cavity_pressure[frame, world, chamber], limit))

    def _show_forces(self, frame: int) -> None:
        """Arrows along the forces on the first part of each pair, as long as they are strong."""
        recorded = self.trajectory
        at = np.asarray(recorded.contact_x)[frame] + self.offsets[:, None]
        self._forces.show(at, np.asarray(recorded.contact_force)[frame], recorded.strong_force())


class Player:
    """A page on which a recording is played and scrubbed. Only this machine can connect unless ``host`` says otherwise.

    Args:
        trajectory: What was recorded.
        host: Address to listen at.
        port: First port that is tried; the next free one is taken.
        speed: Recorded time over that of the clock.
        fps: Pictures per second, at most.

    Raises:
        ImportError: Without viser.
        ValueError: For a value out of range.
    """

    def __init__(
        self, trajectory: Trajectory, *, host: str = LOCAL, port: int = PORT, speed: float = 1.0, fps: float = FPS
    ) -> None:
        self._fps = checks.number(fps, "player: fps", above=0.0, high=1000.0)
        checks.number(speed, "player: speed", above=0.0, high=1000.0)
        self._server, self._host = server.serve(host, port), host
        self.trajectory = trajectory
        self.reel = Reel(self._server, trajectory)
        gui = self._server.gui
        with gui.add_folder("recording"):
            self._told = gui.add_markdown(trajectory.name)
            self._plays = gui.add_checkbox("play", initial_value=True)
            self.frame = gui.add_slider("frame", 0, max(trajectory.frame_count - 1, 1), 1, 0)
            self._speed = gui.add_slider("speed", 0.1, 4.0, 0.1, min(max(speed, 0.1), 4.0), hint="1: real time")
            self._repeats = gui.add_checkbox("again at the end", initial_value=True)
        with gui.add_folder("show"):
            self._color = gui.add_dropdown("colour", self.reel.colors)
            has_chambers = trajectory.parts.cavity_count > 0
            self._chambers = gui.add_checkbox("chambers", initial_value=False, visible=has_chambers)
        self._shown: tuple[Any, ...] = ()
        self._is_stopped = threading.Event()
        _look(self._server, self.reel)
        self._show()

    @property
    def url(self) -> str:
        """Where browsers look."""
        return server.url(self._server, self._host)

    def run(self, seconds: float = math.inf) -> None:
        """Play until ``stop`` is called, or so many seconds have passed."""
        time_of, last = self.trajectory.time, self.trajectory.frame_count - 1
        end, before, at = time.monotonic() + seconds, time.monotonic(), float(time_of[int(self.frame.value)])
        while not self._is_stopped.is_set() and time.monotonic() < end:
            now, passed = time.monotonic(), time.monotonic() - before
            before = now
            if int(self.frame.value) != self._shown[0]:  # moved by a user
                at = float(time_of[min(int(self.frame.value), last)])
            elif self._plays.value:
                at += passed * float(self._speed.value)
                if at > time_of[-1] and self._repeats.value:
                    at = float(time_of[0])
                self.frame.value = int(np.clip(np.searchsorted(time_of, at, side="right") - 1, 0, last))
            self._show()
            self._is_stopped.wait(max(0.0, 1.0 / self._fps - (time.monotonic() - now)))

    def stop(self) -> None:
        """End ``run``; from any thread."""
        self._is_stopped.set()

    def close(self) -> None:
        """End ``run``, let browsers go and free the port."""
        self.stop()
        server.stop(self._server)

    def __enter__(self) -> Player:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _show(self) -> None:
        """Draw what is asked for, unless it is there."""
        frame = min(int(self.frame.value), self.trajectory.frame_count - 1)
        asked = (frame, str(self._color.value), bool(self._chambers.value))
        if asked == self._shown:
            return
        self._shown = asked
        color = next(name for name in COLORS if name == asked[1])
        self.reel.show(frame, color, chambers=asked[2])
        scale = f"; colours end at {self.reel.limits[color]:.3g} {UNITS[color]}" if color != "plain" else ""
        self._told.content = f"**{self.trajectory.name}**, {self.trajectory.time[frame]:.2f} s{scale}"


def write_html(
    trajectory: Trajectory,
    path: str | os.PathLike[str],
    *,
    color: Color = "plain",
    fps: float = 30.0,
    chambers: bool = False,
    port: int = 8980,
) -> Path:
    """Write a recording as one HTML file, whole or not at all, for web pages: it needs neither Python nor a network.

    Args:
        trajectory: What was recorded.
        path: File to write, ``.html``.
        color: What soft bodies are coloured by.
        fps: Pictures per second of recorded time, at most.
        chambers: Whether bodies are seen through, and chambers shown by their pressure.
        port: First port that is tried for a server of this machine alone, which is gone when the file is written.

    Returns:
        The path written.

    Raises:
        ImportError: Without viser.
        ValueError: For another suffix, or what the recording cannot be coloured by.
        OSError: If the file cannot be written there.
    """
    target = Path(path)
    if target.suffix != ".html":
        raise ValueError(f"cannot write {target}: a page ends in .html, got {target.suffix!r}")
    page = server.serve(LOCAL, port)
    try:
        reel = Reel(page, trajectory)
        if color not in reel.colors:
            raise ValueError(f"cannot colour {trajectory.name!r} by {color!r}; it has {', '.join(reel.colors)}")
        rate = min(fps, trajectory.frame_rate)
        frames = trajectory.frames_at(rate)
        _look(page, reel)
        reel.show(int(frames[0]), color, chambers=chambers)
        serializer = page.get_scene_serializer()
        for frame in frames[1:]:
            serializer.insert_sleep(1.0 / rate)
            reel.show(int(frame), color, chambers=chambers)
        serializer.insert_sleep(1.0 / rate)
        write_text(target, serializer.as_html())
    finally:
        server.stop(page)
    return target


def _look(page: Any, reel: Reel) -> None:
    """The picture that browsers begin with."""
    camera, first = reel.camera(), page.initial_camera
    first.position, first.look_at, first.up = camera.eye, camera.target, camera.up
    first.fov = math.radians(camera.fov)
    first.near, first.far = 0.01 * reel.size, 1000.0 * reel.size


def _color(color: Any) -> tuple[int, int, int]:
    """An sRGB colour in [0, 1] in bytes."""
    red, green, blue = (round(255.0 * float(v)) for v in color)
    return red, green, blue
