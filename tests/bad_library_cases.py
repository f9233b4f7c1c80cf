"""Calls of the public functions beside the builder and the options that take bad inputs: see ``bad_input_cases``."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

import softwarp as sw
from softwarp import control, gradients, identification, meshing, reduction, shapes
from tests.bad_input_cases import Call

NONE, SIGNED, TEXT = {"none"}, {"-1", "-1.5"}, {"none", "text"}
CORNERS = {"tets": ("corners",), "triangles": ("corners",)}

# Public names that no call has: what functions return or raise, and what other calls take in turn.
RECORDS = {
    *("EDGES", "CavityWall", "CupMesh", "FingerMesh", "PadMesh", "SolidMesh", "VesselTree", "Maze", "RodGeometry"),
    *("MembraneGeometry", "MeshError", "MeshReport", "Lumen", "TetMesh", "HexMesh", "SurfaceMesh", "QuadraticMesh"),
    *("Basis", "Deviation", "Motion", "Reduction", "ReductionFileError", "Sampling"),
    *("FingerBricks", "Fit", "LeftOut", "Worlds", "Differentiable", "Diverged", "Pose", "States"),
    *("Effector", "Followed", "Outcome", "Solution", "Steerable", "SteerableTubes", "TubeSolution"),
}
# Likewise: they have tests of their own for what they refuse, need a package, or take what meshes are made of.
ELSEWHERE = {
    *("union", "difference", "intersection", "as_surface", "check_tets", "check_closed", "elevate", "embed", "orient"),
    *("brick", "check_hexes", "finger_bricks", "quad_shares"),
    *("box", "arc", "helix", "straight", "edge_couplings", "face_middles", "face_shares", "mean_edge", "surface_edges"),
    *("membrane_geometry", "orient_surface", "surface_middles", "surface_parts", "surface_rings"),
    *("deviation", "pod", "read_about", "sample_elements", "train", "leave_out", "side_by_side", "jvp"),
    *("InversePolicy", "TiltController", "TubeController", "follow"),
}


def library_calls() -> list[Call]:
    """Meshes, tubes, shapes, fits, control, gradients, and what a simulation is asked for."""
    return [*_mesh_calls(), *_generator_calls(), *_part_calls(), *_fit_calls(), *_simulation_calls()]


def _mesh_calls() -> list[Call]:
    mesh = meshing.box((0.1, 0.1, 0.1), (1, 1, 1))
    solid = {"nodes": mesh.nodes, "tets": mesh.tets}
    surface = {"vertices": mesh.nodes, "triangles": mesh.surface()}
    of_tets: list[Callable[..., Any]] = [meshing.weld, meshing.voids, meshing.compact, meshing.tet_volumes]
    of_tets += [meshing.min_dihedral, meshing.radius_ratio]
    return [
        *(Call(function.__name__, function, solid, words=CORNERS) for function in of_tets),
        Call("tet_surface", meshing.tet_surface, {"tets": mesh.tets}, words=CORNERS),
        *(
            Call(function.__name__, function, surface, words=CORNERS | {"vertices": ("nodes",)})
            for function in (meshing.surface_volume, meshing.triangle_areas)
        ),
        Call(
            "tetrahedralize",
            meshing.tetrahedralize,
            {
                "surface": meshing.SurfaceMesh(mesh.nodes, mesh.surface()),
                "edge_length": 0.05,
                "method": "auto",
                "scale": 1.0,
                "sharp_edges": True,
                "strict": True,
                "name": "x",
            },
            {"sharp_edges": {"flag"}, "strict": {"flag"}, "name": TEXT},
            {"surface": ("mesh",)},
        ),
    ]


def _generator_calls() -> list[Call]:
    maze = {"corridor": 0.006, "wall": 0.001, "height": 0.009, "floor": 0.001}
    lumen = {"points": [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], "radius": [[0.1, 0.2]] * 2, "across": (1.0, 0.0, 0.0)}
    named = [meshing.cup, meshing.pad, meshing.quadruped, meshing.tripod, meshing.diamond, meshing.trunk]
    outline = [[0.01, 0.0], [0.02, 0.005], [0.01, 0.01]]
    heights = [0.0, 0.005, 0.01]
    return [
        *(
            Call(function.__name__, function, {"resolution": "coarse"}, words={"resolution": ("node count",)})
            for function in named
        ),
        Call("round_trunk", meshing.round_trunk, {"detail": "coarse"}),
        Call("finger", meshing.finger, {"resolution": "coarse", "kind": "plain"}),
        Call("board", meshing.board, {"resolution": "coarse", "skin": 0.001, "rim": True}, {"rim": {"flag"}}),
        Call("tripod_bricks", meshing.tripod_bricks, {"across": 4, "along": 6}),
        Call("trunk_skin", meshing.trunk_skin, {"corners": 8}),
        Call("quadruped_skin", meshing.quadruped_skin, {"spacing": 0.011}),
        Call("figurine", meshing.figurine, {"width": 0.04, "name": "f"}, {"name": TEXT}),
        Call("random_maze", meshing.random_maze, {"columns": 3, "rows": 3, "seed": 0, "loops": 0} | maze),
        Call("serpentine", meshing.serpentine, maze),
        Call(
            "revolve",
            meshing.revolve,
            {"skin": outline, "axis": heights, "sectors": 3, "start": 0.0, "name": "s"},
            {"axis": NONE, "start": SIGNED, "name": TEXT},
        ),
        Call(
            "aorta",
            meshing.aorta,
            {
                "outlets": 2,
                "radius": 0.0066,
                "outlet_radius": 0.005,
                "seed": 0,
                "tortuosity": 0.0,
                "name": "a",
            },
            dict.fromkeys(("outlets", "outlet_radius", "seed", "tortuosity"), NONE) | {"name": TEXT},
        ),
        Call("nasal_passage", meshing.nasal_passage, {"seed": 0, "scale": 1.0, "variation": 1.0}, {"seed": NONE}),
        Call("Lumen", meshing.Lumen, lumen | {"name": "l"}, {"name": TEXT}),
        Call(
            "rod_geometry",
            meshing.rod_geometry,
            {"points": [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], "radius": 0.1, "inner_radius": 0.0, "nu": 0.5},
            words={"nu": ("poisson",)},
        ),
    ]


def _part_calls() -> list[Call]:
    mesh = meshing.box((0.1, 0.1, 0.1), (1, 1, 1))
    sections = [sw.TubeSection(0.1)]
    tube = {"sections": sections, "radius": 1e-3, "inner_radius": 5e-4, "youngs": 1e9, "nu": 0.3, "density": 1e3}
    telescope = {
        "tubes": [sw.Tube(sections, 1e-3)],
        "port": (0.0, 0.0, 0.0),
        "segments": 5,
        "lengths": [0.05],
        "angles": 0.0,
        "windup": True,
        "rayleigh": (0.0, 0.0),
        "contact_radius": 0.002,
        "name": "t",
    }
    arc = {"length": 0.1, "radius": 0.1, "direction": 0.0, "youngs": 1e9}
    of_arc = {"youngs": NONE, "direction": SIGNED}
    one = [sw.RigidMesh(mesh.nodes, mesh.surface())]
    return [
        Call("Tube", sw.Tube, tube | {"max_speed": 1.0, "max_spin": 1.0}, {"max_speed": {"inf"}, "max_spin": {"inf"}}),
        Call("TubeSection", sw.TubeSection, {"length": 0.1, "curvature": (1.0, 0.0, 0.0), "youngs": 1e9}, of_arc),
        Call("TubeSection.arc", sw.TubeSection.arc, arc, of_arc),
        Call("TubeSection.helix", sw.TubeSection.helix, arc | {"pitch": 0.1}, of_arc | {"pitch": SIGNED}),
        Call(
            "add_telescope",
            lambda **given: sw.ModelBuilder().add_telescope(**given),
            telescope,
            {"lengths": NONE, "angles": SIGNED, "windup": {"flag"}, "contact_radius": NONE, "name": TEXT},
        ),
        *_tied_calls(mesh),
        Call("OneOf", shapes.OneOf, {"meshes": one, "name": "o"}, {"name": TEXT}),
        Call("principal", shapes.principal, {"mass": 1.0, "inertia": np.eye(3), "name": "b"}, {"name": TEXT}),
        Call("rayleigh", sw.rayleigh, {"first": (5.0, 0.05), "second": (20.0, 0.05)}),
        Call("von_mises", sw.von_mises, {"tensor": torch.zeros(2, 3, 3)}),
    ]


def _tied_calls(mesh: meshing.TetMesh) -> list[Call]:
    """Springs, elastic cables, and what a soft body has besides its elements."""
    law = sw.Corotational(1e5, 0.3)

    def with_block(method: str) -> Callable[..., Any]:
        def call(**given: Any) -> None:
            builder = sw.ModelBuilder()
            body = builder.add_tets(mesh, material=law, density=1e3)
            getattr(builder, method)(body, **given)

        return call

    spring = {"b": 0, "points": [[0.0, 0.0, 0.0], [0.1, 0.1, 0.1]], "stiffness": 1.0, "damping": 1.0}
    spring |= {"rest_length": 0.1, "only_pulls": True, "tolerance": 1e-6, "name": "s"}
    cable = {"waypoints": spring["points"], "stiffness": 1.0, "damping": 1.0}
    options = {"relaxation": (0.5, 0.1), "stiffness": np.ones(len(mesh.tets)), "contact_surface": mesh.nodes[:4]}
    lengths = {"rest_length": NONE, "tolerance": NONE}
    brick = meshing.brick((0.1, 0.1, 0.1), (1, 1, 1))
    hexes = {"nodes": brick.nodes, "hexes": brick.hexes, "material": law, "density": 1e3, "lumping": "volume"}
    hexes |= {"rayleigh": (0.0, 0.0), "thin": False, "name": "b"}
    return [
        Call(
            "add_spring",
            with_block("add_spring"),
            spring,
            lengths | {"only_pulls": {"flag"}, "name": TEXT},
            {"b": ("body",)},
        ),
        Call("add_cable that stretches", with_block("add_cable"), cable),
        Call(
            "add_tets with more",
            lambda **given: sw.ModelBuilder().add_tets(mesh, material=law, density=1e3, **given),
            options,
            {"stiffness": NONE, "contact_surface": NONE},
            {"contact_surface": ("surface",)},
        ),
        Call(
            "add_hexes",
            lambda **given: sw.ModelBuilder().add_hexes(**given),
            hexes,
            {"name": {"none", "text"}, "thin": {"flag"}},
            {"hexes": ("corners", "hexa"), "density": ("mass",), "name": ("name",)},
        ),
    ]


def _fit_calls() -> list[Call]:
    parameter = {"name": "E", "low": 1.0, "high": 2.0, "scale": "log", "start": 1.5, "unit": "Pa", "target": "youngs"}
    texts = {"text", "empty text"}
    fit = {
        "parameters": [identification.Parameter("a", 0.0, 1.0)],
        "residuals": lambda values: values - [0.3, 0.2, 0.1],
        "method": "least_squares",
        "samples": 0,
        "batch": 4,
        "tolerance": 1e-6,
        "max_iterations": 3,
        "generations": 2,
        "seed": 0,
    }
    return [
        Call(
            "Parameter",
            identification.Parameter,
            parameter | {"item": 0, "step": 0.01},
            {"start": NONE, "name": {"text"}, "unit": texts, "target": texts, "item": NONE},
        ),
        Call("fit", identification.fit, fit, {"batch": NONE, "method": NONE}),
        Call("PointEffector", control.PointEffector, {"markers": (0,), "axes": "xyz", "weight": 1.0}),
        Call("OrientationEffector", control.OrientationEffector, {"frame": 0, "length": 0.1, "axes": "xyz"}),
        Call("Grip", control.Grip, {"pair": 0, "least": 0.5, "most": 6.0}, {"most": {"inf"}}),
        Call("TargetPath", control.TargetPath, {"times": np.array([0.0, 1.0]), "targets": np.zeros((2, 3))}),
    ]


@functools.cache
def _simulation() -> sw.Simulation:
    builder = sw.ModelBuilder()
    mesh = meshing.box((0.1, 0.1, 0.1), (1, 1, 1))
    body = builder.add_tets(mesh, material=sw.Corotational(1e5, 0.3), density=1e3, name="cube")
    builder.fix(body, box=((0.0, 0.0, 0.0), (1.0, 1.0, 0.0)))
    builder.add_cable(body, [(0.1, 0.1, 0.1), (0.1, 0.1, 0.0)], name="c")
    builder.add_marker(body, (0.1, 0.1, 0.1))
    return sw.Simulation(builder.finalize(2))


def _of(make: Callable[..., Any]) -> Callable[..., Any]:
    """A call with the simulation in front, which is made when it is first asked for."""
    return lambda **given: make(_simulation(), **given)


def _simulation_calls() -> list[Call]:
    controller = {
        "effectors": [0],
        "cables": [0],
        "period": 0.01,
        "horizon": 0.1,
        "energy": 1e-4,
        "share": 0.35,
        "max_step": 0.01,
        "tolerance": 1e-4,
        "settle": 0.1,
        "contact": True,
    }
    rollout = {"state": {}, "controls": {}, "parameters": {}, "steps": 1, "every": 1, "factors": False}
    held = dict.fromkeys(("state", "controls", "parameters"), NONE) | {"factors": {"flag"}}
    worlds = {"sim": _Later(), "parameters": [identification.Parameter("E", 1e4, 1e6)], "experiments": 1}
    return [
        Call("step", _of(sw.Simulation.step), {"count": 1}),
        Call("modes", _of(sw.Simulation.modes), {"count": 2, "world": 0}),
        Call("stiffness_matrix", _of(sw.Simulation.stiffness_matrix), {"world": 0}),
        Call("element_stress", _of(sw.Simulation.element_stress), {"body": 0}, {"body": NONE}),
        Call(
            "restore",
            _of(lambda sim, worlds: sim.restore(sim.snapshot(), worlds)),
            {"worlds": [0, 1]},
            {"worlds": NONE},
        ),
        Call("reset", _of(sw.Simulation.reset), {"mask": torch.tensor([True, False])}, {"mask": NONE}),
        Call(
            "sweep",
            _of(reduction.sweep),
            {"cables": {"c": (0.0, 0.01)}, "cavities": None, "hold": 5, "seed": 0},
            {"cavities": NONE},
            {"cavities": ("chamber",), "cables": ("cable",)},
        ),
        Call("record", _of(reduction.record), {"drive": lambda sim, step: None, "steps": 1, "every": 1}),
        Call("Rollout", _of(gradients.Rollout), {"rest": False}, {"rest": {"flag"}}),
        Call("Rollout()", lambda **given: _rollout()(**given), rollout, held),
        Call("Equilibrium", _of(gradients.Equilibrium), {"rest": False}, {"rest": {"flag"}}),
        Call(
            "InverseController",
            _of(control.InverseController),
            controller,
            dict.fromkeys(("cables", "period", "horizon", "max_step", "settle"), NONE) | {"contact": {"flag"}},
        ),
        Call("Worlds", lambda sim, **given: identification.Worlds(_Later.made(sim), **given), worlds),
    ]


def _restore(worlds: Any) -> None:
    _simulation().restore(_simulation().snapshot(), worlds)


@functools.cache
def _rollout() -> gradients.Rollout:
    return gradients.Rollout(_simulation())


class _Later:
    """Stands for the simulation."""

    @staticmethod
    def made(given: Any) -> Any:
        return _simulation() if isinstance(given, _Later) else given
