"""What every rigid shape offers: kind and size for the device, mass properties, contact features, a surface to draw.

Lengths in metres, densities in kg/m^3. A shape lives in its own local frame; a pose is x y z and a quaternion x y z w.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]


class Kind(IntEnum):
    """Number by which kernels tell shapes apart. A compound never reaches them: its parts do."""

    PLANE = 0
    SPHERE = 1
    CAPSULE = 2
    BOX = 3
    CYLINDER = 4
    MESH = 5
    GRID = 6
    COMPOUND = 7


class MassProperties(NamedTuple):
    """Mass of a body and how it is spread.

    Attributes:
        mass: Mass [kg].
        centre: Centre of mass in the local frame [m], shape (3,).
        inertia: Inertia tensor about the centre in local axes [kg m^2], shape (3, 3).
    """

    mass: float
    centre: FloatArray
    inertia: FloatArray


class Principal(NamedTuple):
    """Principal axes of an inertia tensor.

    Attributes:
        moments: Principal moments in ascending order [kg m^2], shape (3,).
        quaternion: Turn (x, y, z, w) from principal to local axes, shape (4,).
    """

    moments: FloatArray
    quaternion: FloatArray


@dataclass(frozen=True, eq=False)
class Features:
    """Points and edges of a shape that can touch other shapes, each the centre of a ball or capsule.

    Attributes:
        points: Positions [m], shape (p, 3).
        point_radius: Radius around each point [m], shape (p,).
        edges: End points [m], shape (e, 2, 3).
        edge_radius: Radius around each edge [m], shape (e,).
    """

    points: FloatArray
    point_radius: FloatArray
    edges: FloatArray
    edge_radius: FloatArray

    @staticmethod
    def of(
        points: ArrayLike = (), point_radius: ArrayLike = 0.0, edges: ArrayLike = (), edge_radius: ArrayLike = 0.0
    ) -> Features:
        """Arrays of the right shape; one radius serves all points or edges."""
        p = np.array(points, dtype=np.float64).reshape(-1, 3)
        e = np.array(edges, dtype=np.float64).reshape(-1, 2, 3)
        p_radius = np.array(np.broadcast_to(point_radius, len(p)), dtype=np.float64)
        e_radius = np.array(np.broadcast_to(edge_radius, len(e)), dtype=np.float64)
        return Features(p, p_radius, e, e_radius)

    @staticmethod
    def joined(parts: Iterable[Features]) -> Features:
        """All points and edges of several sets, in their order."""
        sets = [Features.of(), *parts]
        return Features(
            np.concatenate([f.points for f in sets]),
            np.concatenate([f.point_radius for f in sets]),
            np.concatenate([f.edges for f in sets]),
            np.concatenate([f.edge_radius for f in sets]),
        )

    def moved(self, position: ArrayLike, quaternion: ArrayLike) -> Features:
        """The features in the frame in which theirs has this pose."""
        x, R = np.asarray(position, dtype=np.float64), rotation_matrix(quaternion)
        return Features(self.points @ R.T + x, self.point_radius, self.edges @ R.T + x, self.edge_radius)


class Part(NamedTuple):
    """A simple shape in the frame of the body that it belongs to.

    Attributes:
        shape: Any shape but a compound.
        position: Origin of the shape's frame [m], shape (3,).
        quaternion: Its orientation (x, y, z, w), shape (4,).
    """

    shape: Shape
    position: FloatArray
    quaternion: FloatArray


class Solid(NamedTuple):
    """Integrals over a solid of density 1, and its extent.

    Attributes:
        volume: Volume [m^3].
        centre: Centre of volume [m], shape (3,).
        second_moment: Integral of (x - centre)(x - centre)' [m^5], shape (3, 3).
        bounds: Lowest and highest corner of the bounding box [m], shape (2, 3).
    """

    volume: float
    centre: FloatArray
    second_moment: FloatArray
    bounds: FloatArray


class Shape(ABC):
    """A rigid solid in its local frame.

    Attributes:
        kind: Which distance function describes it.
        size: Parameters of the distance function [m]; extents of the bounding box for meshes, grids and compounds.
    """

    kind: ClassVar[Kind]
    if TYPE_CHECKING:  # a descriptor at run time would take the place of a field of that name

        @property
        def size(self) -> tuple[float, float, float]:
            """Parameters of the distance function [m]."""
            ...

    @abstractmethod
    def _solid(self) -> Solid: ...

    @abstractmethod
    def distance(self, points: FloatArray) -> FloatArray:
        """Signed distance of local points [m], shape (n, 3), to the surface, negative inside, shape (n,)."""

    @abstractmethod
    def features(self) -> Features:
        """Points and edges that can touch other shapes."""

    @abstractmethod
    def surface(self, resolution: int = 32) -> tuple[FloatArray, IntArray]:
        """Outward triangles for pictures and files.

        Args:
            resolution: Corners of a full circle; shapes without curved faces ignore it.

        Returns:
            Vertices [m], shape (v, 3), and corners, shape (t, 3).
        """

    @property
    def volume(self) -> float:
        """Volume [m^3]."""
        return self._solid().volume

    @property
    def centre(self) -> FloatArray:
        """Centre of volume [m], shape (3,)."""
        return self._solid().centre

    @property
    def bounds(self) -> FloatArray:
        """Lowest and highest corner of the bounding box [m], shape (2, 3)."""
        return self._solid().bounds

    def parts(self) -> tuple[Part, ...]:
        """The simple shapes that it is made of, with their poses; the shape itself unless it is a compound."""
        return (Part(self, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])),)

    def inertia(self, *, density: float | None = None, mass: float | None = None) -> MassProperties:
        """Mass, centre of mass and inertia of the homogeneous solid.

        Args:
            density: Density [kg/m^3].
            mass: Mass [kg]; exactly one of the two is given.

        Raises:
            ValueError: If neither or both are given, the value is not positive, or the solid has no finite volume.
        """
        name, (volume, centre, C, _) = type(self).__name__.lower(), self._solid()
        if (density is None) == (mass is None):
            raise ValueError(f"{name}: give either density [kg/m^3] or mass [kg], got {density=} and {mass=}")
        if not np.isfinite(volume):
            raise ValueError(f"{name}: fills half of space and has no mass; use it with kinematic=True")
        if density is None:
            density = positive(name, "mass", mass, "kg") / volume
        density = positive(name, "density", density, "kg/m^3")
        return MassProperties(density * volume, centre, density * (np.trace(C) * np.eye(3) - C))


def distances(shape: Shape, pose: ArrayLike, points: ArrayLike) -> FloatArray:
    """Signed distance of points to a shape that lies anywhere, on the host.

    Args:
        shape: Any shape.
        pose: Its pose: x y z, x y z qx qy qz qw, or a 4x4 matrix.
        points: Positions in the frame of the pose [m], shape (n, 3).

    Returns:
        Distances [m], shape (n,), negative inside.

    Raises:
        ValueError: If the pose is malformed.
    """
    position, quaternion = split_pose(pose, "pose")
    local = np.asarray(points, dtype=np.float64).reshape(-1, 3) - position
    return shape.distance(local @ rotation_matrix(quaternion))


def principal(mass: float, inertia: ArrayLike, name: str = "body") -> Principal:
    """Principal moments and axes, after a check that a body of positive mass can have this inertia.

    Args:
        mass: Mass [kg].
        inertia: Inertia about the centre of mass [kg m^2]: a tensor (3, 3) or three principal moments (3,).
        name: What messages call the body.

    Raises:
        ValueError: If a value is not finite or not positive, the tensor is not symmetric, or one moment exceeds the
            sum of the others.
    """
    name = checks.label(name, "body")
    positive(name, "mass", mass, "kg")
    need = "be a finite tensor (3, 3) or moments (3,) [kg m^2]"
    tensor = checks.array(inertia, f"{name}: inertia", (3, 3), (3,), need=need)
    tensor = np.diag(tensor) if tensor.shape == (3,) else tensor
    scale = float(np.abs(tensor).max())
    if np.abs(tensor - tensor.T).max() > 1e-9 * scale:
        raise ValueError(f"{name}: inertia must be symmetric, got {tensor.tolist()}; average it with its transpose")
    moments, axes = np.linalg.eigh(0.5 * (tensor + tensor.T))
    if moments[0] <= 1e-12 * scale:
        raise ValueError(
            f"{name}: principal moments must be positive, got {moments.tolist()} kg m^2; give the body a thickness, or "
            f"the inertia that the missing parts would add"
        )
    if moments[2] > (moments[0] + moments[1]) * (1.0 + 1e-9):
        raise ValueError(
            f"{name}: no body has the principal moments {moments.tolist()} kg m^2: the largest may not exceed the sum "
            f"of the others; check units and products of inertia"
        )
    if np.linalg.det(axes) < 0.0:
        axes[:, 2] = -axes[:, 2]
    return Principal(moments, quaternion_of(axes))


def positive(name: str, quantity: str, value: Any, unit: str = "m", *, zero: bool = False) -> float:
    """The value as a float, refused unless it is a finite positive number.

    Raises:
        ValueError: Naming the object, the quantity and the value.
    """
    high = checks.FARTHEST if unit == "m" else checks.LARGEST
    try:
        return checks.number(value, name, low=0.0, high=high, above=None if zero else 0.0)
    except ValueError:
        limit = "zero or positive" if zero else "positive"
        need = f"be a {limit} finite number [{unit}]" + (f" of at most {high:g}" if _is_above(value, high) else "")
        raise ValueError(checks.refusal(f"{name}: {quantity}", need, value)) from None


def _is_above(value: Any, high: float) -> bool:
    return isinstance(value, (int, float)) and value > high


def split_pose(pose: ArrayLike, name: str) -> tuple[FloatArray, FloatArray]:
    """Position and unit quaternion of a pose: 3 or 7 numbers, or a 4x4 matrix.

    Raises:
        ValueError: If it has another shape or is not finite, its quaternion is not of unit length, or its matrix no
            rotation, within 1e-3.
    """
    need, far = "be x y z, x y z qx qy qz qw or a 4x4 matrix, finite", checks.FARTHEST
    values = checks.array(pose, f"{name}: a pose", (3,), (7,), (4, 4), low=-far, high=far, need=need)
    if values.ndim == 2:
        check_rotation(values, name)
        return values[:3, 3].copy(), quaternion_of(values[:3, :3])
    quaternion = values[3:] if len(values) == 7 else np.array([0.0, 0.0, 0.0, 1.0])
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > 1e-3:
        raise ValueError(
            f"{name}: the quaternion (x, y, z, w) of a pose must be of length 1, got {quaternion.tolist()} of length "
            f"{length:g}; no turn is 0 0 0 1"
        )
    return values[:3].copy(), quaternion / length


def check_rotation(matrix: FloatArray, name: str) -> None:
    """Refuse a 4x4 matrix that does more than turn and shift, within 1e-3.

    Raises:
        ValueError: Naming the pose.
    """
    R = matrix[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0.0:
        raise ValueError(f"{name}: the matrix of a pose must turn without scale or reflection, got {R.tolist()}")


def rotation_matrix(quaternion: ArrayLike) -> FloatArray:
    """Rotation matrices of unit quaternions (x, y, z, w), shape (..., 3, 3) for (..., 4)."""
    x, y, z, w = np.moveaxis(np.asarray(quaternion, dtype=np.float64), -1, 0)
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return np.ascontiguousarray(np.moveaxis(R, (0, 1), (-2, -1)))


def quaternion_of(rotation: ArrayLike) -> FloatArray:
    """Unit quaternion (x, y, z, w) of a rotation matrix, w not negative.

    It is the eigenvector to the largest eigenvalue, 3, of a symmetric 4 x 4 matrix (Bar-Itzhack, 2000): no branches.
    """
    R = np.asarray(rotation, dtype=np.float64)
    trace = float(np.trace(R))
    K = np.empty((4, 4))
    K[:3, :3] = R + R.T - trace * np.eye(3)
    K[3, :3] = K[:3, 3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    K[3, 3] = trace
    q = np.linalg.eigh(K)[1][:, 3]
    return np.asarray(-q if q[3] < 0.0 else q)


def quaternion_product(a: ArrayLike, b: ArrayLike) -> FloatArray:
    """Quaternion (x, y, z, w) of the turn b followed by the turn a."""
    p, q = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    vector = p[3] * q[:3] + q[3] * p[:3] + np.cross(p[:3], q[:3])
    return np.array([*vector, p[3] * q[3] - p[:3] @ q[:3]])
