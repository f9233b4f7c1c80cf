"""Rigid shapes: primitives, meshes, signed-distance grids and compounds; mass, contact features, surfaces."""

from softwarp.shapes.base import Features, Kind, MassProperties, Part, Principal, Shape, principal
from softwarp.shapes.primitives import Box, Capsule, Cylinder, Plane, Sphere

__all__ = [
    "Box",
    "Capsule",
    "Cylinder",
    "Features",
    "Kind",
    "MassProperties",
    "Part",
    "Plane",
    "Principal",
    "Shape",
    "Sphere",
    "principal",
]
