"""Shapes with closed formulas: plane, sphere, capsule, box, cylinder. Formulas: docs/theory/shapes.md."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from softwarp import checks
from softwarp.shapes.base import Features, FloatArray, IntArray, Kind, Shape, Solid, positive

MOST_RIM_POINTS = 10_000
_CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))  # corner 4 i + 2 j + k of the unit cube
_BOX_EDGES = np.array([(a, b) for a, b in itertools.combinations(range(8), 2) if (a ^ b) in (1, 2, 4)])
_BOX_QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


@dataclass(frozen=True)
class Plane(Shape):
    """Half space: everything below z = 0 is solid. Floors, walls and ramps, placed and tilted by their pose.

    Args:
        drawn_size: Edge length of the square that pictures show [m].

    Raises:
        ValueError: If ``drawn_size`` is not positive.
    """

    kind = Kind.PLANE
    drawn_size: float = 2.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "drawn_size", positive("plane", "drawn_size", self.drawn_size))

    @property
    def size(self) -> tuple[float, float, float]:
        """Nothing: a plane has no parameters."""
        return (0.0, 0.0, 0.0)

    def _solid(self) -> Solid:
        unknown = np.full((3, 3), np.inf)
        return Solid(np.inf, np.zeros(3), unknown, np.array([[-np.inf, -np.inf, -np.inf], [np.inf, np.inf, 0.0]]))

    def distance(self, points: FloatArray) -> FloatArray:
        """Height above it."""
        return points[:, 2].copy()

    def features(self) -> Features:
        """None: a plane is only touched."""
        return Features.of()

    def surface(self, resolution: int = 32) -> tuple[FloatArray, IntArray]:
        """Square of ``drawn_size`` about the origin."""
        a = 0.5 * self.drawn_size
        vertices = np.array([[-a, -a, 0.0], [a, -a, 0.0], [a, a, 0.0], [-a, a, 0.0]])
        return vertices, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


@dataclass(frozen=True)
class Sphere(Shape):
    """Ball about the origin.

    Args:
        radius: Radius [m].

    Raises:
        ValueError: If the radius is not positive.
    """

    kind = Kind.SPHERE
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "radius", positive("sphere", "radius", self.radius))

    @property
    def size(self) -> tuple[float, float, float]:
        """Radius [m], twice zero."""
        return (self.radius, 0.0, 0.0)

    def _solid(self) -> Solid:
        volume = 4.0 / 3.0 * np.pi * self.radius**3
        return _centred(volume, volume * self.radius**2 / 5.0 * np.ones(3), self.radius * np.ones(3))

    def distance(self, points: FloatArray) -> FloatArray:
        """|p| - r."""
        return np.asarray(np.linalg.norm(points, axis=1) - self.radius)

    def features(self) -> Features:
        """The centre with the radius."""
        return Features.of(np.zeros(3), self.radius)

    def surface(self, resolution: int = 32) -> tuple[FloatArray, IntArray]:
        """Rings between two poles."""
        return _revolve(_arc(self.radius, 0.0, resolution), resolution)


@dataclass(frozen=True)
class Capsule(Shape):
    """Ball swept along the z axis.

    Args:
        radius: Radius of the ball [m].
        length: Distance between the centres of the two end balls [m].

    Raises:
        ValueError: If radius or length is not positive.
    """

    kind = Kind.CAPSULE
    radius: float
    length: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "radius", positive("capsule", "radius", self.radius))
        object.__setattr__(self, "length", positive("capsule", "length", self.length))

    @property
    def size(self) -> tuple[float, float, float]:
        """Radius, length [m], zero."""
        return (self.radius, self.length, 0.0)

    def _solid(self) -> Solid:
        r, h = self.radius, self.length
        barrel, ball = np.pi * r**2 * h, 4.0 / 3.0 * np.pi * r**3
        across = barrel * r**2 / 4.0 + ball * r**2 / 5.0
        along = barrel * h**2 / 12.0 + ball * (r**2 / 5.0 + h**2 / 4.0 + 3.0 / 8.0 * h * r)
        return _centred(barrel + ball, np.array([across, across, along]), np.array([r, r, 0.5 * h + r]))

    def distance(self, points: FloatArray) -> FloatArray:
        """Distance to the segment between the centres, less the radius."""
        z = points[:, 2]
        away = np.clip(np.abs(z) - 0.5 * self.length, 0.0, None)
        return np.asarray(np.sqrt(points[:, 0] ** 2 + points[:, 1] ** 2 + away**2) - self.radius)

    def features(self) -> Features:
        """Both end balls and the rounded edge between them."""
        ends = np.array([[0.0, 0.0, -0.5 * self.length], [0.0, 0.0, 0.5 * self.length]])
        return Features.of(ends, self.radius, ends[None], self.radius)

    def surface(self, resolution: int = 32) -> tuple[FloatArray, IntArray]:
        """Rings between two poles."""
        return _revolve(_arc(self.radius, self.length, resolution), resolution)


@dataclass(frozen=True)
class Box(Shape):
    """Box about the origin, edges along the axes.

    Args:
        size: Full edge lengths (x, y, z) [m].

    Raises:
        ValueError: If these are not three positive lengths.
    """

    kind = Kind.BOX
    size: tuple[float, float, float]

    def __post_init__(self) -> None:
        edges = checks.as_array(self.size)
        if edges.shape != (3,) or edges.dtype.kind not in "fiu":
            raise ValueError(checks.refusal("box: size", "be three edge lengths (x, y, z) [m]", self.size))
        object.__setattr__(
            self, "size", tuple(positive("box", f"size along {c}", e) for c, e in zip("xyz", edges, strict=True))
        )

    def _solid(self) -> Solid:
        edges = np.array(self.size)
        volume = float(edges.prod())
        return _centred(volume, volume * edges**2 / 12.0, 0.5 * edges)

    def distance(self, points: FloatArray) -> FloatArray:
        """That to the nearest face, edge or corner."""
        return _outside(np.abs(points) - 0.5 * np.array(self.size))

    def features(self) -> Features:
        """8 corners and 12 edges."""
        corners = _CORNERS * np.array(self.size)
        return Features.of(corners, 0.0, corners[_BOX_EDGES], 0.0)

    def surface(self, resolution: int = 32) -> tuple[FloatArray, IntArray]:
        """12 triangles."""
        triangles = _BOX_QUADS[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
        return _CORNERS * np.array(self.size), triangles.astype(np.int32)


@dataclass(frozen=True)
class Cylinder(Shape):
    """Cylinder about the z axis, its centre in the origin.

    Its features are points on the two rims, and the axis as an edge with the cylinder's radius: where an edge is
    touched between its ends the contact normal is across it, and there the rounded edge and the cylinder are the same.

    Args:
        radius: Radius [m].
        length: Length [m].
        rim_points: Contact points on each rim; they lie on the circle and leave out 1 - cos(pi / rim_points) of the
            radius between them (1.9 % for 16).

    Raises:
        ValueError: If radius or length is not positive, or ``rim_points`` is below 3.
    """

    kind = Kind.CYLINDER
    radius: float
    length: float
    rim_points: int = 16

    def __post_init__(self) -> None:
        object.__setattr__(self, "radius", positive("cylinder", "radius", self.radius))
        object.__setattr__(self, "length", positive("cylinder", "length", self.length))
        checks.count(self.rim_points, "cylinder: rim_points", low=3, high=MOST_RIM_POINTS)

    @property
    def size(self) -> tuple[float, float, float]:
        """Radius, length [m], zero."""
        return (self.radius, self.length, 0.0)

    def _solid(self) -> Solid:
        r, h = self.radius, self.length
        volume = np.pi * r**2 * h
        moment = volume * np.array([r**2 / 4.0, r**2 / 4.0, h**2 / 12.0])
        return _centred(volume, moment, np.array([r, r, 0.5 * h]))

    def distance(self, points: FloatArray) -> FloatArray:
        """That to the mantle, a cap or a rim."""
        radial = np.hypot(points[:, 0], points[:, 1]) - self.radius
        return _outside(np.column_stack([radial, np.abs(points[:, 2]) - 0.5 * self.length]))

    def features(self) -> Features:
        """Points on both rims and the rounded axis."""
        half = 0.5 * self.length
        circle = _circle(self.radius, self.rim_points)
        rims = [np.column_stack([circle, np.full(self.rim_points, z)]) for z in (-half, half)]
        axis = np.array([[[0.0, 0.0, -half], [0.0, 0.0, half]]])
        return Features.of(np.concatenate(rims), 0.0, axis, self.radius)

    def surface(self, resolution: int = 32) -> tuple[FloatArray, IntArray]:
        """Mantle and two caps."""
        r, half = self.radius, 0.5 * self.length
        return _revolve(np.array([[0.0, -half], [r, -half], [r, half], [0.0, half]]), resolution)


def _centred(volume: float, moments: FloatArray, top: FloatArray) -> Solid:
    """A solid that is symmetric to all three coordinate planes."""
    return Solid(volume, np.zeros(3), np.diag(moments), np.stack([-top, top]))


def _outside(excess: FloatArray) -> FloatArray:
    """Distance from how far points lie beyond each of several pairwise normal faces, shape (n, face)."""
    return np.asarray(np.linalg.norm(np.maximum(excess, 0.0), axis=1) + np.minimum(excess.max(axis=1), 0.0))


def _circle(radius: float, count: int) -> FloatArray:
    """Points on a circle, counter-clockwise from the x axis, shape (count, 2)."""
    angle = 2.0 * np.pi * np.arange(count) / count
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def _arc(radius: float, length: float, resolution: int) -> FloatArray:
    """Profile (rho, z) of a capsule from pole to pole; a sphere for length 0."""
    count = max(int(resolution) // 4, 2)
    angle = 0.5 * np.pi * np.arange(count + 1) / count
    upper = np.column_stack([radius * np.cos(angle), 0.5 * length + radius * np.sin(angle)])
    upper[-1, 0] = 0.0
    lower = upper[::-1] * np.array([1.0, -1.0])
    return np.concatenate([lower, upper if length > 0.0 else upper[1:]])


def _revolve(profile: FloatArray, resolution: int) -> tuple[FloatArray, IntArray]:
    """Closed outward surface of revolution about z; the profile (rho, z) rises from the axis back to the axis."""
    count = max(int(resolution), 3)
    rings = profile[1:-1]
    circle = _circle(1.0, count)
    sides = np.concatenate([np.column_stack([rho * circle, np.full(count, z)]) for rho, z in rings])
    poles = np.array([[0.0, 0.0, profile[0, 1]], [0.0, 0.0, profile[-1, 1]]])
    i = np.arange(count)
    j = (i + 1) % count
    bottom, top = len(sides), len(sides) + 1
    last = count * (len(rings) - 1)
    triangles = [np.column_stack([np.full(count, bottom), j, i])]
    for a in range(0, last, count):
        b = a + count
        triangles.append(np.column_stack([a + i, a + j, b + j]))
        triangles.append(np.column_stack([a + i, b + j, b + i]))
    triangles.append(np.column_stack([last + i, last + j, np.full(count, top)]))
    return np.concatenate([sides, poles]), np.concatenate(triangles).astype(np.int32)
