"""softwarp: trains and controls soft robots in batched finite-element worlds on CPU and GPU.

Importing it loads no Torch, USD or Hydra; environments and clients are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from softwarp import gym, meshing, shapes  # gym registers the Gymnasium ids
from softwarp.builder import ModelBuilder
from softwarp.model.codes import Status
from softwarp.model.model import Model
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
from softwarp.shapes import SDF, Box, Capsule, Compound, Cylinder, Plane, Sphere
from softwarp.shapes import Mesh as RigidMesh
from softwarp.simulation import Simulation, StaticResult
from softwarp.snapshot import Snapshot

if TYPE_CHECKING:
    from softwarp.envs.registry import make
    from softwarp.io.mesh import read_mesh
    from softwarp.io.urdf import read_urdf

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
    "StaticResult",
    "Status",
    "Yeoh",
    "gym",
    "make",
    "meshing",
    "read_mesh",
    "read_urdf",
    "shapes",
]

_LAZY = {"make": "softwarp.envs.registry", "read_mesh": "softwarp.io.mesh", "read_urdf": "softwarp.io.urdf"}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        from importlib import import_module

        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'softwarp' has no attribute {name!r}; it has {', '.join(__all__)}")
