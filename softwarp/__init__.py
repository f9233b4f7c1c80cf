"""softwarp: trains and controls soft robots in batched finite-element worlds on CPU and GPU.

Importing it loads next to nothing: Warp, Torch, USD and the files here are imported when a name is first used.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from softwarp import gym  # registers the Gymnasium ids

if TYPE_CHECKING:
    from softwarp import meshing, shapes
    from softwarp.builder import ModelBuilder
    from softwarp.deploy.policy import load_policy
    from softwarp.envs.registry import make, register
    from softwarp.io.mesh import read_mesh
    from softwarp.io.urdf import read_urdf
    from softwarp.model.codes import StaticReason, Status
    from softwarp.model.model import Model
    from softwarp.scene.damping import rayleigh
    from softwarp.scene.materials import (
        Corotational,
        Material,
        MooneyRivlin,
        NeoHookean,
        Ogden,
        StableNeoHookean,
        StVenantKirchhoff,
        Yeoh,
    )
    from softwarp.scene.telescopes import Tube, TubeSection
    from softwarp.shapes import SDF, Box, Capsule, Compound, Cylinder, Plane, Sphere
    from softwarp.shapes import Mesh as RigidMesh
    from softwarp.simulation import Simulation
    from softwarp.snapshot import Snapshot
    from softwarp.statics import StaticResult
    from softwarp.stresses import von_mises

__version__ = "0.1.0"
__all__ = [
    "SDF",
    "Box",
    "Capsule",
    "Compound",
    "Corotational",
    "Cylinder",
    "Material",
    "Model",
    "ModelBuilder",
    "MooneyRivlin",
    "NeoHookean",
    "Ogden",
    "Plane",
    "RigidMesh",
    "Simulation",
    "Snapshot",
    "Sphere",
    "StVenantKirchhoff",
    "StableNeoHookean",
    "StaticReason",
    "StaticResult",
    "Status",
    "Tube",
    "TubeSection",
    "Yeoh",
    "gym",
    "load_policy",
    "make",
    "meshing",
    "rayleigh",
    "read_mesh",
    "read_urdf",
    "register",
    "shapes",
    "von_mises",
]

_MATERIALS = "Corotational Material MooneyRivlin NeoHookean Ogden StVenantKirchhoff StableNeoHookean Yeoh"
_PLACES = {  # module: what it has; loaded with its first name, so that a mistake in a command is told at once
    "builder": "ModelBuilder",
    "deploy.policy": "load_policy",
    "envs.registry": "make register",
    "io.mesh": "read_mesh",
    "io.urdf": "read_urdf",
    "model.codes": "StaticReason Status",
    "model.model": "Model",
    "scene.damping": "rayleigh",
    "scene.materials": _MATERIALS,
    "scene.telescopes": "Tube TubeSection",
    "shapes": "SDF Box Capsule Compound Cylinder Plane Sphere",
    "simulation": "Simulation",
    "snapshot": "Snapshot",
    "statics": "StaticResult",
    "stresses": "von_mises",
}
_LAZY = {name: (place, name) for place, told in _PLACES.items() for name in told.split()}
_LAZY |= {"RigidMesh": ("shapes", "Mesh"), "meshing": ("meshing", ""), "shapes": ("shapes", "")}


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        if not name.startswith("_") and find_spec(f"softwarp.{name}") is not None:
            return import_module(f"softwarp.{name}")
        raise AttributeError(f"module 'softwarp' has no attribute {name!r}; it has {', '.join(__all__)}")
    place, attribute = _LAZY[name]
    module = import_module(f"softwarp.{place}")
    found = getattr(module, attribute) if attribute else module
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
