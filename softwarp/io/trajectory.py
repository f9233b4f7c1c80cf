"""Recorded motion: what pictures and USD need of a simulation, replayed without it.

A ``Recorder`` looks at a running ``Simulation`` and keeps the surface of its soft bodies, cables, markers, rigid
bodies, rods, air chambers, contacts, elements inside out and the goal of a few worlds; ``finish`` gives a
``Trajectory``, which is plain numpy and has its own versioned file.
"""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp.io import parts as scene
from softwarp.io.arrays import Declared, TrajectoryError, normalise, nothing
from softwarp.io.atomic import atomic_path
from softwarp.io.bounded import DamagedFileError, parse_json, read_arrays
from softwarp.io.inversions import InvertedElements, padded
from softwarp.io.parts import ChamberPoints, Parts, tri_membrane

if TYPE_CHECKING:
    from softwarp.simulation import Simulation

__all__ = ["Recorder", "Trajectory", "TrajectoryError", "compact_surface", "up_against"]

Array = NDArray[Any]

FORMAT = "softwarp.trajectory"
VERSION = 2

_ARRAYS: Declared = {
    "time": (("frame",), "float64"),
    "world": (("world",), "int32"),
    "up": ((3,), "float32"),
    "triangles": (("tri", 3), "int32"),
    "tri_body": (("tri",), "int32"),
    "vertex_node": (("vertex",), "int32"),
    "vertex_rest": (("vertex", 3), "float32"),
    "vertex_fixed": (("vertex",), "bool"),
    "vertex_x": (("frame", "world", "vertex", 3), "float32"),
    "cable_point_start": (("cable_end",), "int32"),
    "cable_x": (("frame", "world", "point", 3), "float32"),
    "cable_tension": (("frame", "world", "cable"), "float32"),
    "marker_x": (("frame", "world", "marker", 3), "float32"),
    "goal": (("frame", "world", 3), "float32"),
    "stress": (("frame", "world", "vertex"), "float32"),
    "tri_membrane": (("tri",), "int32"),
    "rigid_pose": (("frame", "world", "rigid", 7), "float32"),
    "rod_x": (("frame", "world", "rod_point", 3), "float32"),
    "rod_q": (("frame", "world", "rod_point", 4), "float32"),
    "cavity_x": (("frame", "world", "cavity_point", 3), "float32"),
    "cavity_pressure": (("frame", "world", "cavity"), "float32"),
    "cavity_volume": (("frame", "world", "cavity"), "float32"),
    "contact_x": (("frame", "world", "contact", 3), "float32"),
    "contact_force": (("frame", "world", "contact", 3), "float32"),
    "contact_pair": (("frame", "world", "contact"), "int32"),
    "inverted_x": (("frame", "world", "inverted", 3), "float32"),
}
_OPTIONAL = ("goal", "stress", "tri_membrane", "contact_x", "contact_force", "contact_pair", "inverted_x")
_VERSION_2 = ("rigid_pose", "rod_x", "rod_q", "cavity_x", "cavity_pressure", "cavity_volume", *scene.DECLARED)
_COPIED = {  # array of a frame -> view of the simulation
    "cable_x": "cable_x",
    "cable_tension": "cable_tension",
    "marker_x": "marker_x",
    "rigid_pose": "body_pose",
    "rod_x": "rod_x",
    "rod_q": "rod_q",
    "cavity_pressure": "cavity_pressure",
    "cavity_volume": "cavity_volume",
}
_NAMES = ("body_names", "cable_names", "marker_names", "membrane_names", "pair_names")


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """Recorded frames of one or a few worlds, positions in the world frame [m].

    Only surface vertices are kept: ``vertex_node`` gives each vertex its node in the model.

    Attributes:
        name: What was recorded, for instance the environment's name.
        dt: Time step of the simulation [s].
        time: Strictly increasing time of each frame [s], shape (frame,).
        world: Which worlds of the simulation these are, shape (world,).
        up: Unit vector against gravity, shape (3,).
        triangles: Outward surface triangles as vertex indices, shape (tri, 3).
        tri_body: Body of each triangle, shape (tri,).
        vertex_node: Node of each vertex in the model, shape (vertex,).
        vertex_rest: Rest positions [m], shape (vertex, 3).
        vertex_fixed: Whether the vertex is held fixed, shape (vertex,).
        vertex_x: Positions [m], shape (frame, world, vertex, 3).
        cable_point_start: Cable c owns the points start[c] to start[c + 1], shape (cable + 1,).
        cable_x: Points along the cables [m], shape (frame, world, point, 3).
        cable_tension: Tensions [N], shape (frame, world, cable).
        marker_x: Marker positions [m], shape (frame, world, marker, 3).
        goal: Goal positions [m], shape (frame, world, 3), or None.
        stress: Von Mises stress at the vertices [Pa], shape (frame, world, vertex), or None.
        body_names: A name per body.
        cable_names: A name per cable.
        marker_names: A name per marker.
        parts: What stays the same of rigid bodies, rods, chambers and joints.
        rigid_pose: Position [m] and quaternion x y z w of rigid bodies, shape (frame, world, rigid, 7).
        rod_x: Nodes of all rods in order [m], shape (frame, world, rod_point, 3).
        rod_q: Quaternions x y z w of their sections, shape (frame, world, rod_point, 4).
        cavity_x: Points of the chambers' surfaces [m], shape (frame, world, cavity_point, 3).
        cavity_pressure: Gauge pressure [Pa], shape (frame, world, cavity).
        cavity_volume: Volume [m^3], shape (frame, world, cavity).
        tri_membrane: Membrane on each triangle or -1, shape (tri,), or None without membranes.
        membrane_names: A name per membrane.
        contact_x: Where parts touch [m], NaN for none, shape (frame, world, contact, 3), or None if not recorded.
        contact_force: Force on the first part of the pair [N], same shape.
        contact_pair: Pair of each contact, -1 for none, shape (frame, world, contact).
        pair_names: A name per contact pair.
        inverted_x: Centroids of elements inside out [m], NaN for none, shape (frame, world, inverted, 3); None in files
            of earlier versions.
    """

    name: str
    dt: float
    time: Array
    world: Array
    up: Array
    triangles: Array
    tri_body: Array
    vertex_node: Array
    vertex_rest: Array
    vertex_fixed: Array
    vertex_x: Array
    cable_point_start: Array
    cable_x: Array
    cable_tension: Array
    marker_x: Array
    goal: Array | None
    stress: Array | None
    body_names: tuple[str, ...]
    cable_names: tuple[str, ...]
    marker_names: tuple[str, ...]
    parts: Parts = field(default_factory=Parts)
    rigid_pose: Array = field(default_factory=nothing)
    rod_x: Array = field(default_factory=nothing)
    rod_q: Array = field(default_factory=nothing)
    cavity_x: Array = field(default_factory=nothing)
    cavity_pressure: Array = field(default_factory=nothing)
    cavity_volume: Array = field(default_factory=nothing)
    tri_membrane: Array | None = None
    membrane_names: tuple[str, ...] = ()
    contact_x: Array | None = None
    contact_force: Array | None = None
    contact_pair: Array | None = None
    pair_names: tuple[str, ...] = ()
    inverted_x: Array | None = None

    def __post_init__(self) -> None:
        sizes = self.parts.sizes()
        normalise(self, _ARRAYS, sizes, _OPTIONAL)
        for name in _NAMES:
            object.__setattr__(self, name, tuple(getattr(self, name)))
        self._check_topology(sizes)

    def _check_topology(self, sizes: dict[str, int]) -> None:
        if sizes["frame"] < 1 or sizes["world"] < 1:
            raise TrajectoryError(f"trajectory {self.name!r}: needs at least one frame of one world; capture first")
        if not np.all(np.diff(self.time) > 0.0) or not np.all(np.isfinite(self.time)):
            raise TrajectoryError(f"trajectory {self.name!r}: frame times must be finite and strictly increasing")
        if self.triangles.size and not (self.triangles.min() >= 0 and self.triangles.max() < sizes["vertex"]):
            raise TrajectoryError(
                f"trajectory {self.name!r}: triangle indices must lie in [0, {sizes['vertex']}), "
                f"got {self.triangles.min()} to {self.triangles.max()}"
            )
        start = self.cable_point_start
        ends_fit = start.size == sizes["cable"] + 1 and start[0] == 0 and start[-1] == sizes["point"]
        if not ends_fit or np.any(np.diff(start) < 2):
            raise TrajectoryError(
                f"trajectory {self.name!r}: cable_point_start must rise by two or more from 0 to {sizes['point']} "
                f"in {sizes['cable']} steps, got {start.tolist()}"
            )
        body_count = int(self.tri_body.max()) + 1 if self.tri_body.size else 0
        for what, names, count in (
            ("cable", self.cable_names, sizes["cable"]),
            ("marker", self.marker_names, sizes["marker"]),
        ):
            if len(names) != count:
                raise TrajectoryError(f"trajectory {self.name!r}: {count} {what}s, {len(names)} {what} names")
        if len(self.body_names) < body_count:
            raise TrajectoryError(f"trajectory {self.name!r}: {body_count} bodies, {len(self.body_names)} body names")
        contacts = [self.contact_x, self.contact_force, self.contact_pair]
        if any(array is None for array in contacts) and any(array is not None for array in contacts):
            raise TrajectoryError(
                f"trajectory {self.name!r}: give all of contact_x, contact_force, contact_pair or none"
            )
        for what, index, count in (
            ("contact_pair", self.contact_pair, len(self.pair_names)),
            ("tri_membrane", self.tri_membrane, len(self.membrane_names)),
        ):
            if index is not None and index.size and not -1 <= index.min() <= index.max() < count:
                raise TrajectoryError(f"trajectory {self.name!r}: {what} must lie in [-1, {count}), got {index.max()}")

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return int(self.time.shape[0])

    @property
    def world_count(self) -> int:
        """Number of recorded worlds."""
        return int(self.world.shape[0])

    @property
    def duration(self) -> float:
        """Time from the first frame to the last [s]."""
        return float(self.time[-1] - self.time[0])

    @property
    def frame_rate(self) -> float:
        """Frames per second, from the median interval; 1 / dt for a single frame."""
        interval = float(np.median(np.diff(self.time))) if self.frame_count > 1 else self.dt
        return round(1.0 / interval, 3)

    def frames_at(self, fps: float) -> NDArray[np.int64]:
        """Indices of the frames nearest to an even clock of ``fps`` ticks per second, shape (tick,)."""
        if not fps > 0.0:
            raise ValueError(f"trajectory {self.name!r}: fps must be positive, got {fps:g}")
        tick = self.time[0] + np.arange(int(np.floor(self.duration * fps + 1e-6)) + 1) / fps
        after = np.clip(np.searchsorted(self.time, tick), 1, max(self.frame_count - 1, 1))
        if self.frame_count == 1:
            return np.zeros(1, dtype=np.int64)
        closer_before = tick - self.time[after - 1] <= self.time[after] - tick
        return np.asarray(np.where(closer_before, after - 1, after), dtype=np.int64)

    def world_rows(self, worlds: Sequence[int] | None) -> list[int]:
        """Positions along the world axis of the worlds with these numbers; None means all.

        Raises:
            ValueError: If one was not recorded; the message lists those that were.
        """
        if worlds is None:
            return list(range(self.world_count))
        recorded = [int(w) for w in self.world]
        missing = [w for w in worlds if w not in recorded]
        if missing or not list(worlds):
            raise ValueError(f"trajectory {self.name!r}: holds the worlds {recorded}, asked for {list(worlds)}")
        return [recorded.index(w) for w in worlds]

    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner [m] of all that was recorded, cables and goals too but no planes, shape (2, 3)."""
        everything = range(self.parts.rigid_count)
        found = [self.vertex_x, self.cable_x, self.parts.rod_outline(self.rod_x)]
        found += self.parts.rigid_outline(self.rigid_pose, everything)
        found += [] if self.goal is None else [self.goal]
        points = np.concatenate([p.reshape(-1, 3) for p in found])
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):  # planes alone
            points = np.concatenate([self.rigid_pose[..., :3].reshape(-1, 3) + side for side in (-0.5, 0.5)])
        return np.stack([points.min(axis=0), points.max(axis=0)]).astype(np.float64)

    def size(self) -> float:
        """Size of the scene [m], as ``Parts.scene_size`` has it."""
        return self.parts.scene_size(self.vertex_rest, self.rigid_pose[0], self.rod_x[0])

    def strong_force(self, frames: ArrayLike | None = None, rows: Sequence[int] | None = None) -> float:
        """Contact force [N] that arrows are scaled by: nine of ten frames have none above; 0 without contacts.

        Args:
            frames: Indices of frames; None means all.
            rows: Positions along the world axis; None means all.
        """
        if self.contact_force is None:
            return 0.0
        force = self.contact_force if rows is None else self.contact_force[:, list(rows)]
        strength = np.linalg.norm(force if frames is None else force[np.asarray(frames)], axis=-1)
        strength = np.where(np.isfinite(strength), strength, 0.0).reshape(len(strength), -1)
        strongest = strength.max(axis=1, initial=0.0)
        return float(np.percentile(strongest[strongest > 0.0], 90.0)) if strongest.any() else 0.0

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the trajectory to an ``.npz`` file, whole or not at all; returns its path.

        Raises:
            ValueError: If the suffix is not ``.npz``.
            OSError: If the file cannot be written there.
        """
        target = Path(path)
        if target.suffix != ".npz":
            raise ValueError(f"cannot write {target}: a trajectory file ends in .npz; did you mean {target}.npz?")
        header = {
            "format": FORMAT,
            "version": VERSION,
            "name": self.name,
            "dt": self.dt,
            **{name: list(getattr(self, name)) for name in _NAMES},
            **{name: list(getattr(self.parts, name)) for name in scene.NAMES},
        }
        arrays = {name: getattr(self, name) for name in _ARRAYS if getattr(self, name) is not None}
        arrays |= {name: getattr(self.parts, name) for name in scene.DECLARED}
        with atomic_path(target) as scratch:
            np.savez_compressed(scratch, header=np.array(json.dumps(header)), **arrays)
        return target

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Trajectory":
        """Read a file that ``save`` wrote.

        Raises:
            FileNotFoundError: If there is no such file.
            TrajectoryError: If it is something else, damaged, or was written by a newer softwarp.
        """
        source = Path(path)
        if not source.is_file():
            raise FileNotFoundError(f"no trajectory file {source}; record one with Recorder and Trajectory.save")
        try:
            archive = read_arrays(source)
        except DamagedFileError as error:
            raise TrajectoryError(f"{source}: not a readable trajectory file ({error}); record it again") from error
        header = _read_header(source, archive)
        needed = [name for name in _ARRAYS if name not in _OPTIONAL and name not in _VERSION_2]
        needed += _VERSION_2 if header["version"] >= 2 else ()
        absent = [name for name in needed if name not in archive]
        if absent:
            raise TrajectoryError(f"{source}: damaged file, lacks {', '.join(absent)}; record it again")
        arrays = {name: archive[name] for name in _ARRAYS if name in archive}
        constants = {name: archive[name] for name in scene.DECLARED if name in archive}
        try:
            names = {name: tuple(map(str, header.get(name, ()))) for name in (*_NAMES, *scene.NAMES)}
            fixed: dict[str, Any] = constants | {name: names.pop(name) for name in scene.NAMES}
            given: dict[str, Any] = {"goal": None, "stress": None} | arrays | names
            return cls(name=str(header["name"]), dt=float(header["dt"]), parts=Parts(**fixed), **given)
        except (ValueError, TypeError, KeyError, IndexError) as error:
            raise TrajectoryError(f"{source}: damaged file ({error}); record it again") from error


class Recorder:
    """Takes pictures of chosen worlds of a running simulation, frame by frame.

    The clock of the recording is the simulation's own; where a world is reset, and its time falls back, the recording
    goes on one usual frame interval later, so that several episodes make one film.

    Args:
        sim: The simulation to look at; it is never changed.
        worlds: Which worlds; None means the first.
        stress: Whether to record the von Mises stress (computed for all worlds at every capture).
        contacts: Whether to record contact points and forces.
        name: Name of the trajectory; None takes the first body's.
    """

    def __init__(
        self,
        sim: "Simulation",
        worlds: Sequence[int] | None = None,
        *,
        stress: bool = True,
        contacts: bool = False,
        name: str | None = None,
    ) -> None:
        chosen = [0] if worlds is None else [int(w) for w in worlds]
        outside = [w for w in chosen if not 0 <= w < sim.num_worlds]
        if outside or not chosen or len(set(chosen)) != len(chosen):
            raise ValueError(
                f"recorder: worlds must be different numbers in [0, {sim.num_worlds}), at least one, got {chosen}"
            )
        self.sim = sim
        self.worlds = chosen
        model = sim.model
        self.name = name if name is not None else (*model.body_names, *model.rod_names, *model.rigid_names)[0]
        self._with_stress = stress
        self._with_contacts = contacts and model.contact is not None
        self._parts = Parts.of_model(model)
        self._chamber_points = ChamberPoints(model)
        self._inverted_elements = InvertedElements(model)
        self._vertex_node, self._triangles = compact_surface(model.surface_tri)
        self._frames: dict[str, list[Array]] = {key: [] for key in (*_COPIED, "vertex_x", "goal", "stress", "cavity_x")}
        self._contacts: list[list[tuple[Array, Array, Array]]] = []  # frame, world: points, forces, pairs
        self._inverted: list[Array] = []  # points of each world of each frame
        self._time: list[float] = []
        self._sim_time = np.zeros(len(chosen))
        self._interval = float(sim.dt)

    @property
    def frame_count(self) -> int:
        """Number of frames captured so far."""
        return len(self._time)

    def capture(self, goal: ArrayLike | None = None, time: float | None = None) -> None:
        """Record the simulation as it stands.

        Args:
            goal: Goal positions [m] of the recorded worlds, shape (len(worlds), 3), numpy or torch; given in every
                frame or in none.
            time: Time of the frame [s]; None follows the simulation's clock.

        Raises:
            ValueError: If a goal comes or goes between frames, has another shape, ``time`` does not increase, or a
                body that is one of several has not the same mesh in all worlds and frames.
        """
        goal_x = None if goal is None else _host(goal).astype(np.float32)
        if goal_x is not None and goal_x.shape != (len(self.worlds), 3):
            raise ValueError(f"recorder: goal must have shape ({len(self.worlds)}, 3), got {goal_x.shape}")
        if self._time and (goal_x is None) == bool(self._frames["goal"]):
            had, has = ("a", "none") if self._frames["goal"] else ("no", "one")
            raise ValueError(f"recorder: frame 0 had {had} goal, frame {len(self._time)} has {has}; give all or none")
        self._look_at_choice()
        self._advance_clock(time)
        sim = self.sim
        node_x = self._of_worlds(sim.node_x)
        self._frames["vertex_x"].append(node_x[:, self._vertex_node].astype(np.float32))
        self._frames["cavity_x"].append(self._chamber_points(node_x).astype(np.float32))
        self._inverted += self._inverted_elements(node_x)
        for key, view in _COPIED.items():
            self._frames[key].append(self._of_worlds(getattr(sim, view)).astype(np.float32))
        if goal_x is not None:
            self._frames["goal"].append(goal_x)
        if self._with_stress:
            self._frames["stress"].append(self._of_worlds(sim.node_stress())[:, self._vertex_node].astype(np.float32))
        if self._with_contacts:
            arrays = [self._of_worlds(view) for view in (sim.contact_point, sim.contact_load, sim.contact_pair)]
            self._contacts.append([(x[p >= 0], f[p >= 0], p[p >= 0]) for x, f, p in zip(*arrays, strict=True)])

    def _look_at_choice(self) -> None:
        """Record bodies with one of several meshes as the first frame finds them."""
        choice = self._of_worlds(self.sim.params.body_choice)
        if choice.size == 0:
            return
        if not self._time:
            self._choice = choice[0]
            self._parts = Parts.of_model(self.sim.model.as_chosen(choice[0].tolist()))
        if (choice != self._choice).any():
            raise ValueError(
                "recorder: a recording holds one mesh of a body with one of several, but worlds chose "
                f"{np.unique(choice).astype(int).tolist()}, or chose anew; record worlds and episodes one by one"
            )

    def finish(self) -> Trajectory:
        """All frames captured so far as a trajectory; recording may go on afterwards.

        Raises:
            TrajectoryError: If nothing was captured.
        """
        if not self._time:
            raise TrajectoryError("recorder: no frame was captured; call capture() at least once before finish()")
        model = self.sim.model
        inverted = padded(self._inverted)
        frames: dict[str, Any] = {key: np.stack(parts) if parts else None for key, parts in self._frames.items()}
        return Trajectory(
            name=self.name,
            dt=float(self.sim.dt),
            time=np.array(self._time),
            world=np.array(self.worlds),
            up=up_against(_host(self.sim.params.gravity)[self.worlds[0]]),
            triangles=self._triangles,
            tri_body=np.asarray(model.tri_body),
            vertex_node=self._vertex_node,
            vertex_rest=np.asarray(model.node_rest)[self._vertex_node],
            vertex_fixed=np.asarray(model.node_fixed)[self._vertex_node],
            cable_point_start=np.asarray(model.cable_point_start),
            body_names=tuple(model.body_names),
            cable_names=tuple(model.cable_names),
            marker_names=tuple(model.marker_names),
            parts=self._parts,
            tri_membrane=None if model.membranes is None else tri_membrane(model.surface_tri, model.membranes),
            membrane_names=() if model.membranes is None else model.membranes.names,
            pair_names=model.contact.names if self._with_contacts and model.contact is not None else (),
            inverted_x=inverted.reshape(len(self._time), len(self.worlds), *inverted.shape[1:]),
            **frames,
            **(_padded(self._contacts) if self._with_contacts else {}),
        )

    def _of_worlds(self, view: Any) -> Array:
        """The recorded worlds' rows of a torch view, as a host copy."""
        return _host(view[self.worlds])

    def _advance_clock(self, time: float | None) -> None:
        now = _host(self.sim.time).astype(np.float64)[self.worlds]
        if time is not None:
            if not np.isfinite(time) or (self._time and not time > self._time[-1]):
                last = self._time[-1] if self._time else -np.inf
                raise ValueError(f"recorder: frame times must be finite and increase, got {time:g} s after {last:g} s")
            clock = float(time)
        elif not self._time:
            clock = float(now[0])
        else:
            forward = (now - self._sim_time)[now > self._sim_time]
            self._interval = float(np.median(forward)) if forward.size else self._interval
            clock = self._time[-1] + self._interval
        self._sim_time = now
        self._time.append(clock)


def compact_surface(triangles: ArrayLike) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Number the nodes that a surface uses from zero, in their order.

    Args:
        triangles: Node indices, shape (tri, 3).

    Returns:
        The node of each vertex, shape (vertex,), and the triangles as vertex indices, shape (tri, 3).
    """
    nodes = np.asarray(triangles, dtype=np.int64).reshape(-1, 3)
    vertex_node, vertex = np.unique(nodes, return_inverse=True)
    return vertex_node.astype(np.int32), vertex.reshape(-1, 3).astype(np.int32)


def _padded(contacts: list[list[tuple[Array, Array, Array]]]) -> dict[str, Array]:
    """Contacts of all frames and worlds as arrays, as wide as the fullest one needs."""
    width = max(len(pair) for worlds in contacts for _, _, pair in worlds)
    shape = (len(contacts), len(contacts[0]), width)
    x, force = (np.full((*shape, 3), np.nan, dtype=np.float32) for _ in range(2))
    pairs = np.full(shape, -1, dtype=np.int32)
    for frame, worlds in enumerate(contacts):
        for world, (points, loads, pair) in enumerate(worlds):
            x[frame, world, : len(pair)], force[frame, world, : len(pair)] = points, loads
            pairs[frame, world, : len(pair)] = pair
    return {"contact_x": x, "contact_force": force, "contact_pair": pairs}


def up_against(gravity: ArrayLike) -> NDArray[np.float64]:
    """The axis direction most nearly against gravity [m/s^2], shape (3,); +z without gravity."""
    g = np.asarray(gravity, dtype=np.float64).reshape(3)
    up = np.zeros(3)
    axis = int(np.argmax(np.abs(g))) if np.any(g) else 2
    up[axis] = 1.0 if g[axis] <= 0.0 else -1.0
    return up


def _host(array: Any) -> Array:
    """A numpy copy of a numpy or torch array on any device."""
    if hasattr(array, "detach"):
        array = array.detach().cpu().numpy()
    return np.array(array)


def _read_header(source: Path, archive: Any) -> dict[str, Any]:
    """The checked header of an open archive."""
    if "header" not in archive and str(archive.get("format", "")).startswith("softwarp demonstrations"):
        raise TrajectoryError(
            f"{source}: holds demonstrations, what a policy saw and did, without the motion; "
            "softwarp export env=... policy=... FILE.npz records that"
        )
    try:
        header = parse_json(str(archive["header"]))
        kind, version = header["format"], int(header["version"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise TrajectoryError(f"{source}: not a softwarp trajectory; Trajectory.save writes those") from error
    if kind != FORMAT:
        raise TrajectoryError(f"{source}: holds {kind!r}, not {FORMAT!r}; expected a file that Trajectory.save wrote")
    if version > VERSION:
        raise TrajectoryError(
            f"{source}: trajectory format {version} is newer than {VERSION}, which this softwarp reads; update softwarp"
        )
    return dict(header) | {"version": version}
