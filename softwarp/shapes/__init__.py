"""Rigid shapes: primitives, meshes, signed-distance grids and compounds; mass, contact features, surfaces."""

from softwarp.shapes.base import Features, Kind, MassProperties, Part, Principal, Shape, distances, principal
from softwarp.shapes.compound import Compound, as_shape
from softwarp.shapes.grid import SDF
from softwarp.shapes.mesh import Mesh
from softwarp.shapes.one_of import OneOf
from softwarp.shapes.primitives import Box, Capsule, Cylinder, Plane, Sphere
from softwarp.shapes.vessel import Vessel

__all__ = [
    "SDF",
    "Box",
    "Capsule",
    "Compound",
    "Cylinder",
    "Features",
    "Kind",
    "MassProperties",
    "Mesh",
    "OneOf",
    "Part",
    "Plane",
    "Principal",
    "Shape",
    "Sphere",
    "Vessel",
    "as_shape",
    "distances",
    "principal",
]
