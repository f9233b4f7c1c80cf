"""Bodies of several shapes, and what a user may write instead of a shape."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softwarp import checks, meshing
from softwarp.shapes.base import (
    Features,
    FloatArray,
    IntArray,
    Kind,
    Part,
    Shape,
    Solid,
    distances,
    quaternion_product,
    rotation_matrix,
    split_pose,
)
from softwarp.shapes.mesh import Mesh

FILES = (".stl", ".obj", ".ply", ".off", ".glb", ".gltf")


@dataclass(frozen=True, eq=False, init=False)
class Compound(Shape):
    """Several shapes that move as one. Where they overlap the mass counts for each of them.

    Args:
        parts: Pairs (shape, pose); a pose is x y z, x y z qx qy qz qw or a 4x4 matrix in the frame of the
            compound. A shape alone
            stands in the origin. Shapes are whatever ``as_shape`` takes, also compounds.

    Raises:
        ValueError: If there is no part, or a pose is malformed.
    """

    kind = Kind.COMPOUND
    members: tuple[Part, ...]

    def __init__(self, parts: Iterable[Any]) -> None:
        members: list[Part] = []
        if not isinstance(parts, Iterable) or isinstance(parts, (str, Shape)):
            raise ValueError(checks.refusal("compound: parts", "be a list of shapes or pairs (shape, pose)", parts))
        for number, entry in enumerate(parts):
            name = f"part {number}"
            shape, pose = entry if _is_pair(entry) else (entry, (0.0, 0.0, 0.0))
            position, quaternion = split_pose(pose, name)
            R = rotation_matrix(quaternion)
            for part in as_shape(shape, name=name).parts():
                turned = quaternion_product(quaternion, part.quaternion)
                members.append(Part(part.shape, position + R @ part.position, turned))
        if not members:
            raise ValueError("compound: has no parts; give at least one shape")
        object.__setattr__(self, "members", tuple(members))

    def parts(self) -> tuple[Part, ...]:
        """Its simple shapes; those of compounds inside it stand for themselves."""
        return self.members

    @property
    def size(self) -> tuple[float, float, float]:
        """Extents of the bounding box [m]."""
        low, high = self.bounds
        x, y, z = (float(v) for v in high - low)
        return (x, y, z)

    def _solid(self) -> Solid:
        solids = [part.shape._solid() for part in self.members]
        turns = [rotation_matrix(part.quaternion) for part in self.members]
        bounds = _joined_bounds(
            [_moved_bounds(s.bounds, p, R) for s, p, R in zip(solids, self.members, turns, strict=True)]
        )
        volumes = np.array([s.volume for s in solids])
        volume = float(volumes.sum())
        if not np.isfinite(volume):
            return Solid(volume, np.zeros(3), np.full((3, 3), np.inf), bounds)
        centres = np.array([p.position + R @ s.centre for s, p, R in zip(solids, self.members, turns, strict=True)])
        centre = volumes @ centres / volume
        arms = centres - centre
        second = sum(
            (
                R @ s.second_moment @ R.T + s.volume * np.outer(r, r)
                for s, R, r in zip(solids, turns, arms, strict=True)
            ),
            np.zeros((3, 3)),
        )
        return Solid(volume, centre, second, bounds)

    def distance(self, points: FloatArray) -> FloatArray:
        """Distance to the nearest part; inside a lower bound of the depth where parts overlap."""
        each = [distances(p.shape, np.concatenate([p.position, p.quaternion]), points) for p in self.members]
        return np.asarray(np.min(each, axis=0))

    def features(self) -> Features:
        """Points and edges of all parts."""
        return Features.joined(part.shape.features().moved(part.position, part.quaternion) for part in self.members)

    def surface(self, resolution: int = 32) -> tuple[FloatArray, IntArray]:
        """Triangles of all parts, each closed in itself."""
        vertices, triangles, count = [], [], 0
        for part in self.members:
            x, t = part.shape.surface(resolution)
            vertices.append(x @ rotation_matrix(part.quaternion).T + part.position)
            triangles.append(t + count)
            count += len(x)
        return np.concatenate(vertices), np.concatenate(triangles).astype(np.int32)


def as_shape(value: Any, *, name: str = "shape") -> Shape:
    """Convert what describes a solid to a shape.

    Args:
        value: A shape, a ``SurfaceMesh``, a ``TetMesh`` (its boundary), a ``trimesh.Trimesh``, arrays (vertices,
            triangles), the path of a mesh file in metres, or a list of shapes or pairs (shape, pose).
        name: What messages call the shape.

    Raises:
        FileNotFoundError: If a path leads nowhere.
        MeshError: If the surface is not closed, as for ``Mesh``.
        TypeError: If the value is nothing of these.
        ValueError: If a list is empty or a pose malformed.
    """
    if isinstance(value, Shape):
        return value
    if isinstance(value, str | Path):
        return _read(Path(value))
    if isinstance(value, meshing.TetMesh):
        return Mesh(*meshing.compact(value.nodes, value.surface()), name=value.name)
    if isinstance(value, meshing.SurfaceMesh):
        return Mesh(value.nodes, value.triangles, name=value.name)
    if hasattr(value, "vertices") and hasattr(value, "faces"):  # trimesh.Trimesh, which need not be installed
        return Mesh(np.asarray(value.vertices), np.asarray(value.faces), name=name)
    if isinstance(value, list | tuple) and len(value) == 2 and _is_table(value[0]) and _is_table(value[1]):
        return Mesh(np.asarray(value[0]), np.asarray(value[1]), name=name)
    if isinstance(value, list | tuple):
        return Compound([value] if _is_pair(value) else value)
    raise TypeError(
        f"{name}: cannot make a shape of {type(value).__name__}; give a shape such as softwarp.Box((0.1, 0.1, 0.1)), a "
        f"SurfaceMesh, a trimesh.Trimesh, (vertices, triangles), the path of a mesh file, or a list of (shape, pose)"
    )


def _is_pair(value: Any) -> bool:
    """Whether the value reads as (shape, pose): its second half is a row of numbers."""
    if not isinstance(value, list | tuple) or len(value) != 2:
        return False
    if isinstance(value[1], Shape | str | Path) or hasattr(value[1], "vertices"):
        return False
    if isinstance(value[1], list | tuple):
        return all(isinstance(v, int | float | np.number) for v in value[1])
    return isinstance(value[1], np.ndarray) and (value[1].ndim == 1 or value[1].shape == (4, 4))


def _is_table(value: Any) -> bool:
    """Whether the value is a matrix of three columns."""
    return isinstance(value, np.ndarray) and value.ndim == 2 and value.shape[1] == 3


def _read(path: Path) -> Mesh:
    """Mesh from a file; a scene's parts are put in their places and joined."""
    import trimesh

    if not path.exists():
        raise FileNotFoundError(
            f"shape: mesh file {str(path)!r} does not exist; check the path and the working directory"
        )
    if path.suffix.lower() not in FILES:
        raise ValueError(f"shape: cannot read {path.name!r}; files of shapes end in {', '.join(FILES)}")
    found = trimesh.load_mesh(path)
    mesh = found.to_mesh() if isinstance(found, trimesh.Scene) else found
    if not len(mesh.faces):
        raise ValueError(f"shape: {path.name!r} holds no triangles; export it as a surface")
    return Mesh(*meshing.weld(mesh.vertices, mesh.faces), name=path.name)


def _moved_bounds(bounds: FloatArray, part: Part, rotation: FloatArray) -> FloatArray:
    """Box around a turned and shifted box; an unbounded one stays unbounded where it is turned."""
    if not np.all(np.isfinite(bounds)):
        return np.array([[-np.inf] * 3, [np.inf] * 3])
    middle, half = bounds.mean(axis=0), 0.5 * np.ptp(bounds, axis=0)
    centre, reach = part.position + rotation @ middle, np.abs(rotation) @ half
    return np.stack([centre - reach, centre + reach])


def _joined_bounds(boxes: list[FloatArray]) -> FloatArray:
    """Box around several boxes."""
    return np.stack([np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)])
