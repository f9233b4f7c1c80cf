"""Bad inputs: what is no value of any argument, calls whose arguments take it in turn, and how a refusal is judged.

A refusal is a ``ValueError`` or ``TypeError`` that softwarp raises itself (its traceback ends in a ``raise`` of ours),
whose message names the argument or its object and shows what was given. Anything else that is raised is a raw
traceback, and what is raised nowhere is a silent acceptance, unless the call lists it.
"""

from __future__ import annotations

import dataclasses
import linecache
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import softwarp as sw
from softwarp import checks, meshing
from softwarp.envs import registry
from softwarp.render import Camera, RayCaster
from softwarp.solvers.options import Options

ROOT = Path(sw.__file__).parent

# By name, as a call lists what it rightly takes.
BAD: dict[str, Any] = {
    "nan": math.nan,
    "inf": math.inf,
    "-inf": -math.inf,
    "-1": -1,
    "-1.5": -1.5,
    "1e300": 1e300,
    "2^200": 2**200,
    "flag": True,
    "none": None,
    "text": "a",
    "empty text": "",
    "complex": 1j,
    "object": object(),
    "empty": [],
    "eleven": [1.0] * 11,
    "ragged": [[1.0, 2.0], [3.0]],
    "nans": [math.nan, math.nan, math.nan],
    "texts": ["a", "b", "c"],
    "complex array": np.ones((2, 3), dtype=complex),
    "deep array": np.zeros((2, 2, 2, 2)),
    "dictionary": {"a": 1},
}


@dataclass
class Call:
    """A function with arguments that it takes.

    Attributes:
        name: For reports.
        function: What is called.
        good: Arguments, all of which a call takes.
        accepted: Names of bad values that an argument rightly takes.
        words: What messages may call an argument besides its own name.
        left_out: Arguments that are not tried.
    """

    name: str
    function: Callable[..., Any]
    good: dict[str, Any]
    accepted: dict[str, set[str]] = field(default_factory=dict)
    words: dict[str, tuple[str, ...]] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()

    def inputs(self) -> Iterator[tuple[str, str, dict[str, Any]]]:
        """Argument, name of the bad value, and all arguments."""
        for argument in self.good:
            if argument not in self.left_out:
                for kind, value in BAD.items():
                    yield argument, kind, self.good | {argument: value}


def judge(call: Call, argument: str, kind: str, arguments: dict[str, Any]) -> str | None:
    """What is wrong with how a call takes a bad value; None for nothing."""
    is_accepted = kind in call.accepted.get(argument, set())
    try:
        call.function(**arguments)
    except Exception as error:  # noqa: BLE001 (whatever is raised is looked at)
        if is_accepted:
            return f"refused although listed: {error}"
        return _fault(error, (argument, *call.words.get(argument, ())))
    return None if is_accepted else "accepted silently"


def _fault(error: Exception, names: tuple[str, ...]) -> str | None:
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    assert last is not None
    place, line = last.tb_frame.f_code.co_filename, last.tb_lineno
    source = linecache.getline(place, line).strip()
    if not Path(place).is_relative_to(ROOT) or not source.startswith("raise"):
        return f"raw {type(error).__name__} at {Path(place).name}:{line}: {error}"
    if not isinstance(error, (ValueError, TypeError, FileNotFoundError)):
        return f"raised {type(error).__name__}: {error}"
    if not any(name.lower() in str(error).lower() for name in names):
        return f"the message names none of {names}: {error}"
    return None


# Scenes


def _scene() -> dict[str, Any]:
    """A builder with one part of each kind, and what calls need of it."""
    builder = sw.ModelBuilder()
    mesh = meshing.box((0.1, 0.1, 0.1), (1, 1, 1))
    body = builder.add_tets(mesh, material=sw.Corotational(1e5, 0.3), density=1e3, name="cube")
    rigid = builder.add_rigid(sw.Box((0.1, 0.1, 0.1)), mass=1.0, pose=(0.0, 0.0, 1.0), name="brick")
    rod = builder.add_rod([[1.0, 0.0, 0.0], [1.0, 0.0, 0.5], [1.0, 0.0, 1.0]], radius=0.01, youngs=1e6, name="stem")
    return {"builder": builder, "mesh": mesh, "body": body, "rigid": rigid, "rod": rod}


def scene_calls() -> list[Call]:
    """Every method of the builder; each call gets a scene of its own where the last one was changed."""
    held: dict[str, Any] = {}

    def method(name: str) -> Callable[..., Any]:
        def call(**arguments: Any) -> None:
            if not held:
                held.update(_scene())
            try:
                getattr(held["builder"], name)(**arguments)
            except BaseException:
                _check_untouched(held["builder"])
                raise
            held.clear()

        return call

    s = _scene()
    mesh, body, rigid, rod = s["mesh"], s["body"], s["rigid"], s["rod"]
    inner = meshing.box((0.05, 0.05, 0.05), (1, 1, 1))
    box = ((-1.0, -1.0, -1.0), (1.0, 1.0, 0.0))
    unlimited = {"inf"}
    return [
        Call("ModelBuilder", sw.ModelBuilder, {"gravity": (0.0, 0.0, -9.81)}),
        Call(
            "add_tets",
            method("add_tets"),
            {
                "nodes": mesh.nodes,
                "tets": mesh.tets,
                "material": sw.Corotational(1e5, 0.3),
                "element": "p1",
                "density": 1e3,
                "lumping": "volume",
                "rayleigh": (0.0, 0.0),
                "name": "b",
            },
            {"element": {"none"}, "name": {"none", "text"}},
            {"tets": ("corners", "tetra", "element"), "density": ("mass",), "name": ("name",)},
        ),
        Call(
            "add_tets with a mass",
            method("add_tets"),
            {"nodes": mesh, "material": sw.Corotational(1e5, 0.3), "total_mass": 1.0},
            words={"total_mass": ("mass",), "nodes": ("tets are missing",)},
        ),
        _rigid_call(method, unlimited),
        Call(
            "add_rod",
            method("add_rod"),
            {
                "points": [[0.0, 0.0, 0.0], [0.0, 0.0, 0.5], [0.0, 0.0, 1.0]],
                "radius": 0.01,
                "youngs": 1e6,
                "nu": 0.4,
                "density": 1e3,
                "curvature": (0.0, 0.0, 0.0),
                "inner_radius": 0.0,
                "normal": (1.0, 0.0, 0.0),
                "section": (1e-4, 1e-4, 1e-8, 1e-8, 1e-8),
                "stiffness": 1.0,
                "rayleigh": (0.0, 0.0),
                "contact_pieces": 1,
                "name": "s",
            },
            {"curvature": {"none"}, "normal": {"none"}, "section": {"none"}, "name": {"none", "text"}},
            {"nu": ("poisson",), "points": ("point",)},
            left_out=("inner_radius",),
        ),
        Call(
            "add_rod with a bore",
            method("add_rod"),
            {"points": [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], "radius": 0.01, "youngs": 1e6, "inner_radius": 0.005},
            words={"points": ("point",)},
        ),
        Call("fix nodes", method("fix"), {"body": body, "nodes": [0, 1], "axes": "xyz"}, words=_OF_NODES),
        Call("fix a box", method("fix"), {"body": body, "box": box}, words=_OF_NODES),
        Call(
            "attach nodes",
            method("attach"),
            {"body": body, "nodes": [0], "to": rod, "node": 0},
            words=_OF_NODES,
            accepted={"node": {"-1"}},
        ),
        Call("attach a box", method("attach"), {"body": body, "to": rigid, "box": box}, words=_OF_NODES),
        Call("attach within", method("attach"), {"body": body, "to": rigid, "within": 1.0}, words=_OF_NODES),
        Call(
            "add_point_load",
            method("add_point_load"),
            {"body": body, "nodes": [0], "force": (0.0, 0.0, 1.0)},
            words=_OF_NODES,
        ),
        Call(
            "add_traction triangles",
            method("add_traction"),
            {"body": body, "traction": (0.0, 0.0, 1.0), "triangles": [(0, 1, 3)]},
        ),
        Call("add_traction box", method("add_traction"), {"body": body, "traction": (0.0, 0.0, 1.0), "box": box}),
        Call(
            "add_cable",
            method("add_cable"),
            {
                "body": body,
                "waypoints": [[0.05, 0.05, 0.05], [0.05, 0.05, 0.08]],
                "pull_point": (0.05, 0.05, 0.0),
                "control": "length",
                "min_tension": 0.0,
                "max_tension": 10.0,
                "min_displacement": -0.1,
                "max_displacement": 0.1,
                "max_rate": 1.0,
                "closing_length": 0.0,
                "tolerance": 1e-6,
                "name": "c",
            },
            {
                "pull_point": {"none"},
                "min_tension": {"-inf", "-1", "-1.5"},
                "max_tension": {"inf"},
                "min_displacement": {"-inf", "-1", "-1.5"},
                "max_displacement": {"inf"},
                "max_rate": {"inf"},
                "tolerance": {"none"},
                "name": {"none", "text"},
            },
        ),
        Call(
            "add_marker",
            method("add_marker"),
            {"body": body, "point": (0.05, 0.05, 0.05), "tolerance": 1e-6, "name": "m"},
            {"tolerance": {"none"}, "name": {"none", "text"}},
        ),
        Call(
            "add_cavity",
            method("add_cavity"),
            {
                "body": body,
                "vertices": inner.nodes + 0.02,
                "triangles": inner.surface(),
                "control": "pressure",
                "min_pressure": -1e5,
                "max_pressure": 1e5,
                "min_volume": 0.0,
                "max_volume": 1.0,
                "max_pressure_rate": 1e5,
                "max_flow": 1.0,
                "ambient": 1e5,
                "exponent": 1.0,
                "anchored": [0],
                "tolerance": 1e-6,
                "name": "v",
            },
            {
                "min_pressure": {"-inf", "-1", "-1.5"},
                "max_pressure": {"inf", "-1", "-1.5"},
                "min_volume": {"-inf", "-1", "-1.5"},
                "max_volume": {"inf"},
                "max_pressure_rate": {"inf"},
                "max_flow": {"inf"},
                "anchored": {"empty"},
                "tolerance": {"none"},
                "name": {"none", "text"},
            },
            {"vertices": ("nodes", "surface"), "triangles": ("corners", "surface", "triangle")},
        ),
        Call(
            "add_membrane",
            method("add_membrane"),
            {
                "body": body,
                "triangles": mesh.surface(),
                "thickness": 1e-3,
                "youngs": 1e6,
                "nu": 0.3,
                "density": 1e3,
                "name": "w",
            },
            {"name": {"none", "text"}},
            {"triangles": ("corners", "triangle"), "nu": ("poisson",)},
        ),
        Call(
            "add_joint",
            method("add_joint"),
            {
                "parent": rigid,
                "child": (rod, 0),
                "kind": "hinge",
                "anchor": (0.0, 0.0, 0.0),
                "axis": (0.0, 0.0, 1.0),
                "limits": (-1.0, 1.0),
                "control": "position",
                "stiffness": 1.0,
                "damping": 1.0,
                "max_force": 1.0,
                "max_rate": 1.0,
                "name": "j",
            },
            {
                "parent": {"none"},
                "anchor": {"none"},
                "max_force": {"inf"},
                "max_rate": {"inf"},
                "name": {"none", "text"},
            },
            {"stiffness": ("damping",), "limits": ("limit",)},
        ),
        Call(
            "add_contact",
            method("add_contact"),
            {
                "a": body,
                "b": rigid,
                "mu": 0.5,
                "restitution": 0.0,
                "contact_distance": 1e-3,
                "alarm_distance": 1e-2,
                "compliance": 0.0,
                "name": "p",
            },
            {"alarm_distance": {"none"}, "name": {"none", "text"}},
        ),
        Call(
            "finalize",
            method("finalize"),
            {"num_worlds": 1, "device": "cpu", "precision": "float32", "contact_capacity": 4},
            {"contact_capacity": {"none"}},
        ),
    ]


_OF_NODES = {"nodes": ("node",), "to": ("attach",), "within": ("node",)}


def _rigid_call(method: Callable[[str], Callable[..., Any]], unlimited: set[str]) -> Call:
    """``add_rigid``, whose shape may be described in many ways."""
    return Call(
        "add_rigid",
        method("add_rigid"),
        {
            "shape": sw.Sphere(0.1),
            "mass": 1.0,
            "inertia": (1.0, 1.0, 1.0),
            "pose": (0.0, 0.0, 0.0),
            "kinematic": False,
            "free_axes": "x",
            "velocity": (0.0,) * 6,
            "damping": 0.0,
            "max_speed": 1.0,
            "max_spin": 1.0,
            "name": "r",
        },
        {
            "shape": {"none"},
            "inertia": {"none"},
            "kinematic": {"flag"},
            "free_axes": {"empty"},
            "max_speed": unlimited,
            "max_spin": unlimited,
            "name": {"none", "text"},
        },
        {"shape": ("compound", "part 0"), "free_axes": ("free axis",)},
    )


def _check_untouched(builder: sw.ModelBuilder) -> None:
    """A refused call leaves the scene as it was: one part of each kind."""
    scene = builder.scene
    counts = {f.name: len(getattr(scene, f.name)) for f in dataclasses.fields(scene) if f.name != "gravity"}
    left = {name for name, count in counts.items() if count != (name in ("bodies", "rigids", "rods"))}
    assert not left, f"a refused call left {left} changed"


# Shapes, materials, meshes


def value_calls() -> list[Call]:
    """Shapes, materials, meshes and what makes them."""
    mesh = meshing.box((0.1, 0.1, 0.1), (1, 1, 1))
    curved = meshing.elevate(mesh)
    skin = mesh.surface()
    x = np.linspace(-1.0, 1.0, 8)
    ball = np.linalg.norm(np.stack(np.meshgrid(x, x, x, indexing="ij")), axis=0) - 0.5
    point = (0.0, 0.0, 1.0)
    of_mesh = {"nodes": ("mesh", "surface"), "tets": ("corners", "tetra"), "triangles": ("corners", "triangle", "mesh")}
    calls = [
        Call("Box", sw.Box, {"size": (1.0, 1.0, 1.0)}),
        Call("Sphere", sw.Sphere, {"radius": 1.0}),
        Call("Capsule", sw.Capsule, {"radius": 1.0, "length": 1.0}),
        Call("Cylinder", sw.Cylinder, {"radius": 1.0, "length": 1.0, "rim_points": 8}),
        Call("Plane", sw.Plane, {"drawn_size": 1.0}),
        Call(
            "RigidMesh",
            sw.RigidMesh,
            {"vertices": mesh.nodes, "triangles": skin, "convex": None, "feature_angle": 5.0},
            {"convex": {"none", "flag"}},
            {"vertices": ("nodes", "mesh"), "triangles": ("corners", "triangle")},
        ),
        Call("hull", sw.RigidMesh.hull, {"points": mesh.nodes}),
        Call(
            "SDF",
            sw.SDF,
            {"values": ball, "spacing": x[1] - x[0], "origin": (0.0, 0.0, 0.0)},
            words={"spacing": ("values",)},
        ),
        Call(
            "Compound",
            sw.Compound,
            {"parts": [sw.Sphere(1.0)]},
            words={"parts": ("part", "compound", "mesh file")},
        ),
        Call("TetMesh", sw.meshing.TetMesh, {"nodes": mesh.nodes, "tets": mesh.tets}, words=of_mesh),
        Call("SurfaceMesh", sw.meshing.SurfaceMesh, {"nodes": mesh.nodes, "triangles": skin}, words=of_mesh),
        Call(
            "QuadraticMesh",
            meshing.QuadraticMesh,
            {"nodes": curved.nodes, "elements": curved.elements},
            words={"nodes": ("mesh",)},
        ),
        Call("elevate", meshing.elevate, {"nodes": mesh.nodes, "tets": mesh.tets}, words=of_mesh),
        Call(
            "check_closed",
            meshing.check_closed,
            {"vertices": mesh.nodes, "triangles": skin},
            words={"vertices": ("nodes", "surface"), "triangles": ("corners", "triangle")},
        ),
        Call("box", meshing.box, {"size": (1.0, 1.0, 1.0), "cells": (1, 1, 1)}),
        Call(
            "embed",
            lambda points: meshing.embed(mesh.nodes, mesh.tets, points),
            {"points": [[0.05, 0.05, 0.05]]},
            words={"points": ("point",)},
        ),
        Call(
            "orient", lambda tets: meshing.orient(mesh.nodes, tets), {"tets": mesh.tets}, words={"tets": ("corners",)}
        ),
        Call("straight", meshing.straight, {"length": 1.0, "segments": 3, "start": point, "direction": point}),
        Call(
            "arc",
            meshing.arc,
            {"radius": 1.0, "angle": 1.0, "segments": 3, "start": point, "tangent": point, "normal": (1.0, 0.0, 0.0)},
            {"normal": {"none"}},
        ),
        Call(
            "helix",
            meshing.helix,
            {"radius": 1.0, "pitch": 0.1, "turns": 2.0, "segments": 9, "centre": point},
            {"pitch": {"-1", "-1.5"}},
        ),
        Call(
            "make",
            _unmade,
            {"name": "Trunk", "num_worlds": 1, "device": "cpu", "seed": 0},
            {"seed": {"none"}},
            {"name": ("environment",)},
        ),
        Call("silicone", sw.Material.silicone, {"name": "Ecoflex 00-30", "nu": 0.45}, words={"nu": ("poisson",)}),
        Call("Snapshot.load", _load_snapshot, {"path": "x.npz"}, words={"path": ("snapshot",)}),
        Call("Camera", Camera, {"eye": (1.0, 0.0, 0.0), "target": (0.0, 0.0, 0.0), "up": point, "fov": 35.0}),
        Call(
            "RayCaster",
            RayCaster,
            {
                "triangles": skin,
                "rest": mesh.nodes,
                "fixed": np.zeros(8, dtype=bool),
                "up": point,
                "region": mesh.nodes,
                "width": 8,
                "height": 8,
                "samples": 2,
                "cable_radius": 0.01,
                "goal_radius": 0.01,
                "threads": 1,
            },
            {name: {"none"} for name in ("fixed", "region", "cable_radius", "goal_radius", "threads")},
            {"triangles": ("nothing to draw",)},
        ),
        Call(
            "read_mesh",
            sw.read_mesh,
            {"path": Path(__file__).parent / "data" / "tetrahedron.obj", "scale": 1.0},
            words={"path": ("mesh",)},
        ),
    ]
    laws: list[tuple[type[sw.Material], dict[str, Any]]] = [
        (sw.Corotational, {"youngs": 1e5, "nu": 0.3, "density": 1e3, "method": "polar"}),
        (sw.NeoHookean, {"youngs": 1e5, "nu": 0.3}),
        (sw.Yeoh, {"bulk": 1e6, "c10": 1e4, "c20": 0.0, "c30": 1.0}),
        (sw.MooneyRivlin, {"bulk": 1e6, "c10": 1e4, "c01": 1e3}),
        (sw.Ogden, {"bulk": 1e6, "mu_1": 1e4, "alpha_1": 2.0, "mu_2": 0.0}),
    ]
    signed = {"-1", "-1.5"}
    free = dict.fromkeys(("c20", "c30", "alpha_1", "mu_2", "c01"), signed) | {"density": {"none"}}
    calls += [
        Call(
            law.__name__,
            law,
            good,
            {k: v for k, v in free.items() if k in good} | ({"c10": signed} if law is sw.MooneyRivlin else {}),
            {
                "youngs": ("young",),
                "nu": ("poisson",),
                "c10": ("shear",),
                "mu_1": ("shear",),
                "mu_2": ("shear",),
                "c01": ("shear",),
            },
        )
        for law, good in laws
    ]
    return calls


def _unmade(**given: Any) -> None:
    """All that ``make`` checks before it builds the environment."""
    registry.spec(given["name"])
    registry.check_num_worlds(given["num_worlds"])
    registry.check_device(given["device"])
    if given["seed"] is not None:
        checks.seed(given["seed"])


def _load_snapshot(path: Any) -> None:
    """Loads a file that is missing, whatever its good name."""
    if not (isinstance(path, str) and path == "x.npz"):
        sw.Snapshot.load(path)


# Options


def option_calls() -> list[Call]:
    """Options of the solver, and of every environment that is registered: each field of each."""
    flags = {"flag"}
    solver = {f.name: f.default for f in dataclasses.fields(Options) if f.name != "gpu_path"}
    accepted = {name: flags for name, value in solver.items() if isinstance(value, bool)} | {
        name: {"inf"} for name in ("most_swing", "repeat_swing")
    }
    calls = [Call("Options", Options, solver, accepted)]
    for name in registry.names():
        config = registry.spec(name).config_class()
        made = config()
        good = {f.name: getattr(made, f.name) for f in dataclasses.fields(made)}
        calls.append(Call(name, config, good, rightly_accepted(name, good)))
    return calls


SIGNED = (("Trunk", "cable_angle"), ("TrunkCup", "cable_angle"), ("CartPole", "hinge_height"), ("CartPole", "force"))
UNLIMITED = ("max_rate",)


def rightly_accepted(name: str, good: dict[str, Any]) -> dict[str, set[str]]:
    """What an environment's options rightly take of the bad values, field by field."""
    accepted: dict[str, set[str]] = {}
    for key, value in good.items():
        if isinstance(value, bool):
            accepted[key] = {"flag"}
        elif value is None:
            accepted[key] = {"none"} | ({"flag"} if key == "capture" else set())
        elif (name, key) in SIGNED:
            accepted[key] = {"-1", "-1.5"}
        elif key in UNLIMITED:
            accepted[key] = {"inf"}
    accepted |= {"mesh": {"text", "empty text"}} if "mesh_scale" in good else {}  # a file's name, read later
    accepted |= {"min_tension": {"-inf", "-1", "-1.5"}, "success_height": {"-1"}, "sensors": {"empty"}}
    if name == "ConcentricTubeRobot":  # whose vessel may be a file's name, read later, and whose force has no limit
        accepted |= {"vessel": {"text", "empty text"}, "force_limit": {"inf"}, "max_insertion_force": {"inf"}}
    if name == "CatheterBeam":  # whose force has no limit, and which does not start nested
        accepted |= {"force_limit": {"inf"}, "max_insertion_force": {"inf"}, "nested": set()}
    if name == "Diamond":  # whose cables may have no limits, and whose moduli are fitted to one mesh
        accepted |= {"min_displacement": {"-inf", "-1", "-1.5"}, "max_displacement": {"inf"}, "coarsened": set()}
    if name == "Maze":  # whose angles count from the flat state, outwards negative, and whose servos may have no limits
        accepted |= {key: {"-1", "-1.5"} for key in ("servo_height", "angle")} | {"max_angle": {"inf", "-1"}}
        accepted |= {"min_angle": {"-inf", "-1", "-1.5"}, "max_speed": {"inf"}, "max_torque": {"inf"}}
    if name == "Gripper":  # whose goals may be as many
        accepted |= {"goal_heights": {"eleven"}}
    return accepted
