"""A body whose surface is one of several, which worlds may choose differently."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softwarp import checks
from softwarp.shapes.base import FloatArray
from softwarp.shapes.mesh import Mesh

MOST = 100_000


@dataclass(frozen=True, eq=False, init=False)
class OneOf(Mesh):
    """One of several meshes, in each world the one that ``sim.params.body_choice`` names: 0 to begin with.

    Only balls can touch it, as they alone need no corners and edges of it. Mass, pictures and files are those of the
    first mesh where nobody says which is meant.

    Args:
        meshes: The meshes, all in the frame of the body.
        name: What messages call it.

    Raises:
        ValueError: If there is none, or too many, or something else among them.
    """

    alternatives: tuple[Mesh, ...] = ()

    def __init__(self, meshes: Sequence[Mesh], *, name: str = "one of several") -> None:
        name = checks.label(name, "one of several")
        given = tuple(meshes) if isinstance(meshes, Sequence) and not isinstance(meshes, str) else ()
        if not 0 < len(given) <= MOST or not all(type(mesh) is Mesh for mesh in given):
            need = f"be a list of 1 to {MOST} shapes.Mesh"
            raise ValueError(checks.refusal(f"{name}: meshes", need, meshes))
        first = given[0]
        for attribute in ("vertices", "triangles", "feature_angle"):
            object.__setattr__(self, attribute, getattr(first, attribute))
        object.__setattr__(self, "convex", False)
        object.__setattr__(self, "name", name)
        object.__setattr__(self, "alternatives", given)

    @property
    def reach(self) -> FloatArray:
        """Lowest and highest corner of the box around all meshes [m], shape (2, 3)."""
        boxes = np.array([mesh.bounds for mesh in self.alternatives])
        return np.array([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
