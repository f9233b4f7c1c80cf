"""Where a picture is taken from."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks

Floats = NDArray[np.float64]
Vector = tuple[float, float, float]

# Default line of sight, in the frame of `horizontal_axes` and up: in front, to the right and above.
_TOWARDS_EYE = np.array([0.42, -0.85, 0.34])
MARGIN = 0.12  # of the extent of what moves freely, left around it
_BEND = 1.0  # rad by which a held body bends in the picture


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Attributes:
        eye: Position [m].
        target: Point in the middle of the picture [m].
        up: Direction that points upwards in the picture.
        fov: Vertical field of view [degrees].
    """

    eye: Vector
    target: Vector
    up: Vector = (0.0, 0.0, 1.0)
    fov: float = 35.0

    def __post_init__(self) -> None:
        for name in ("eye", "target", "up"):
            need, far = "be three finite numbers", checks.FARTHEST
            value = checks.array(getattr(self, name), f"camera: {name}", (3,), low=-far, high=far, need=need)
            object.__setattr__(self, name, tuple(float(v) for v in value))
        checks.number(self.fov, "camera: fov [degrees]", above=0.0, below=180.0)
        sight = np.subtract(self.target, self.eye)
        if np.linalg.norm(np.cross(sight, self.up)) <= 1e-9 * np.linalg.norm(sight) * np.linalg.norm(self.up):
            raise ValueError(f"camera: eye {self.eye}, target {self.target} and up {self.up} must not lie on one line")

    def basis(self) -> Floats:
        """Unit vectors to the right, upwards and forwards as rows, shape (3, 3)."""
        forward = np.subtract(self.target, self.eye)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, self.up)
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(right, forward), forward])

    def project(self, points: ArrayLike, aspect: float = 4.0 / 3.0) -> Floats:
        """Where points [m], (..., 3), lie in a picture: to the right and upwards, [-1, 1] in it, (..., 2).

        What lies behind the camera comes out as infinite.
        """
        seen = (np.asarray(points, dtype=np.float64) - self.eye) @ self.basis().T
        depth, tan = seen[..., 2:], np.tan(0.5 * np.radians(self.fov)) * np.array([aspect, 1.0])
        return np.asarray(np.where(depth > 0.0, seen[..., :2] / (np.where(depth > 0.0, depth, 1.0) * tan), np.inf))

    @classmethod
    def seeing(
        cls,
        points: ArrayLike,
        up: ArrayLike = (0.0, 0.0, 1.0),
        *,
        towards: ArrayLike | None = None,
        aspect: float = 4.0 / 3.0,
        fov: float = 35.0,
    ) -> "Camera":
        """A camera as near as it can be with all points in the picture.

        Args:
            points: Positions to show [m], shape (k, 3).
            up: Direction that points upwards.
            towards: Direction from there to the eye, (3,); None looks from the front, the right and above.
            aspect: Width of the picture over its height.
            fov: Vertical field of view [degrees].
        """
        x = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        front = _TOWARDS_EYE @ np.stack([*horizontal_axes(up), np.asarray(up, dtype=np.float64)])
        way = front if towards is None else np.asarray(towards, dtype=np.float64)
        way = way / np.linalg.norm(way)
        target = 0.5 * (x.min(axis=0) + x.max(axis=0))
        basis = cls(tuple(target + way), tuple(target), tuple(np.asarray(up)), fov).basis()
        tan = np.tan(0.5 * np.radians(fov)) / 1.08 * np.array([aspect, 1.0])  # with a margin of 8 %
        for _ in range(4):  # moves the target to the middle of what is seen
            seen = (x - target) @ basis.T
            distance = max(float(np.max(np.abs(seen[:, :2]) / tan - seen[:, 2:])), 1e-6)
            flat = seen[:, :2] / (distance + seen[:, 2:])
            target = target + 0.5 * distance * (flat.max(axis=0) + flat.min(axis=0)) @ basis[:2]
        seen = (x - target) @ basis.T
        distance = max(float(np.max(np.abs(seen[:, :2]) / tan - seen[:, 2:])), 1e-6)
        return cls(tuple(target + distance * way), tuple(target), tuple(np.asarray(up)), fov)


def horizontal_axes(up: ArrayLike) -> tuple[Floats, Floats]:
    """Two unit vectors (side, depth) that make a right-handed frame with ``up``: x and y for +z, z and x for +y."""
    u = np.asarray(up, dtype=np.float64)
    u = u / np.linalg.norm(u)
    side = np.roll(np.eye(3)[int(np.argmax(np.abs(u)))], 1)
    side = side - (side @ u) * u
    side = side / np.linalg.norm(side)
    return side, np.cross(u, side)


def workspace(rest: ArrayLike, fixed: ArrayLike | None = None) -> Floats:
    """Points around all that a body held at ``fixed`` reaches as a rule, the body itself included.

    A held body of length L bends to arcs about its root: at an angle b its tip stands L sin(b) / b along its axis and
    L (1 - cos(b)) / b beside it. Angles up to one radian leave the body large in a picture; where it bends farther it
    may reach beyond.

    Args:
        rest: Rest positions [m], shape (node, 3).
        fixed: Which nodes are held, shape (node,); without any, the rest box grown by ``MARGIN`` is taken.

    Returns:
        Positions [m], shape (k, 3).
    """
    x = np.asarray(rest, dtype=np.float64)
    low, high = x.min(axis=0), x.max(axis=0)
    held = np.zeros(len(x), dtype=bool) if fixed is None else np.asarray(fixed, dtype=bool)
    if not held.any() or held.all():
        return around(x, MARGIN)
    root = x[held].mean(axis=0)
    main = x[~held].mean(axis=0) - root
    if np.linalg.norm(main) < 1e-9 * np.max(high - low):  # held all around: nothing sticks out
        return around(x, MARGIN)
    axis = main / np.linalg.norm(main)
    length = float(np.max((x - root) @ axis))
    bend = np.linspace(0.0, _BEND, 5)[1:]
    turn = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    beside = np.cos(turn)[:, None] * horizontal_axes(axis)[0] + np.sin(turn)[:, None] * horizontal_axes(axis)[1]
    tips = (np.sin(bend) / bend)[:, None, None] * axis + ((1.0 - np.cos(bend)) / bend)[:, None, None] * beside
    return np.concatenate([box_corners(np.stack([low, high])), root + length * tips.reshape(-1, 3)])


def box_corners(bounds: ArrayLike) -> Floats:
    """The corners of a box given by its lowest and highest one, shape (8, 3)."""
    low, high = np.asarray(bounds, dtype=np.float64)
    return np.array([[x, y, z] for x, y, z in product(*zip(low, high, strict=True))])


def around(points: ArrayLike, margin: float) -> Floats:
    """Corners of the box around points [m], grown by a part of its largest extent, shape (8, 3)."""
    x = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    low, high = x.min(axis=0), x.max(axis=0)
    grow = margin * float(np.max(high - low))
    return box_corners(np.stack([low - grow, high + grow]))


def within(points: ArrayLike, region: ArrayLike, margin: float) -> Floats:
    """Points [m] moved to the nearest place in the box around a region, grown by a part of its largest extent.

    So a picture shows as much of a large table as lies near to what stands on it.
    """
    corners = around(region, margin)
    return np.clip(np.asarray(points, dtype=np.float64).reshape(-1, 3), corners[0], corners[-1])
