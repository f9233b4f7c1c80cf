"""``PartsBuilder``: the builder's methods for rigid bodies, rods and attachments."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import meshing, shapes
from softwarp.scene.parts import AXES, FloatArray, Handle, IntArray, RigidBody, RigidSpec, Rod, RodSpec, SoftBody, Weld

if TYPE_CHECKING:
    from softwarp.builder import BodySpec

Box = tuple[Sequence[float], Sequence[float]]


class PartsBuilder:
    """Rigid bodies, rods and what is attached to what; part of ``ModelBuilder``."""

    bodies: list[BodySpec]

    def __init__(self) -> None:
        self.rigids: list[RigidSpec] = []
        self.rods: list[RodSpec] = []
        self.welds: list[Weld] = []

    def add_rigid(
        self,
        shape: Any = None,
        *,
        mass: float | None = None,
        density: float | None = None,
        inertia: ArrayLike | None = None,
        pose: ArrayLike = (0.0, 0.0, 0.0),
        kinematic: bool = False,
        free_axes: str | Iterable[Any] = AXES,
        velocity: ArrayLike = (0.0,) * 6,
        damping: float = 0.0,
        max_speed: float = math.inf,
        max_spin: float = math.inf,
        name: str | None = None,
    ) -> RigidBody:
        """Add a rigid body.

        Args:
            shape: Geometry: a shape of ``softwarp.shapes``, a ``SurfaceMesh``, a ``trimesh.Trimesh``, a path, or None
                for a body that touches nothing.
            mass: Mass [kg]; exactly one of ``mass`` and ``density`` unless the body is kinematic.
            density: Density [kg/m^3].
            inertia: Moments about the centre of mass in the body's axes, (3,) principal or (3, 3) [kg m^2]; None
                computes them from the shape.
            pose: Position [m], (3,), or position and quaternion x y z w, (7,), or a 4x4 matrix.
            kinematic: Follow ``control.body_pose`` and ``control.body_velocity`` whatever the forces.
            free_axes: Axes of the world that a dynamic body may move along (x, y, z) and turn about (rx, ry, rz), as
                names or six flags; a cart on rails along x has ``free_axes="x"``.
            velocity: Initial velocity [m/s] and angular velocity [rad/s], (6,).
            damping: Mass-proportional damping [1/s].
            max_speed: Largest speed of a kinematic body [m/s].
            max_spin: Largest angular speed of a kinematic body [rad/s].
            name: For messages and exports.

        Returns:
            Handle, index of ``Simulation.body_pose``.
        """
        label = self._new_name(name, f"rigid{len(self.rigids)}")
        solid = None if shape is None else shapes.as_shape(shape)
        where = as_pose(pose, f"rigid body {label!r}: pose")
        twist = _array(velocity, (6,), f"rigid body {label!r}: velocity")
        if not kinematic or mass is not None or density is not None:
            value, centre, tensor = _mass_properties(label, solid, mass, density, inertia)
        else:
            value, centre, tensor = 0.0, np.zeros(3), np.zeros((3, 3))
        free = _free_axes(free_axes, label)
        if kinematic:
            free = np.zeros(6, dtype=bool)
        for what, number in (("damping", damping), ("max_speed", max_speed), ("max_spin", max_spin)):
            if math.isnan(number) or number < 0.0:
                raise ValueError(f"rigid body {label!r}: {what} must be at least 0, got {number!r}")
        self.rigids.append(
            RigidSpec(
                name=label,
                shape=solid,
                mass=value,
                centre=centre,
                inertia=tensor,
                pose=where,
                free=free,
                kinematic=kinematic,
                max_speed=float(max_speed),
                max_spin=float(max_spin),
                damping=float(damping),
                twist=twist,
            )
        )
        return RigidBody(len(self.rigids) - 1)

    def add_rod(
        self,
        points: ArrayLike,
        *,
        radius: float | ArrayLike,
        youngs: float,
        nu: float = 0.45,
        density: float = 1000.0,
        curvature: ArrayLike | None = None,
        inner_radius: float | ArrayLike = 0.0,
        normal: Sequence[float] | None = None,
        section: ArrayLike | None = None,
        stiffness: float | ArrayLike = 1.0,
        rayleigh: tuple[float, float] = (0.0, 0.0),
        contact_pieces: int = 1,
        name: str | None = None,
    ) -> Rod:
        """Add a rod that stretches, shears, bends and twists, by default with circular or annular sections.

        Curvature is constant along a segment, so a rod with two points is a piecewise-constant-curvature stem of one
        section.

        Args:
            points: Nodes along the centre line [m], shape (n, 3), n >= 2.
            radius: Outer radius [m], one or one per segment.
            youngs: Young's modulus [Pa].
            nu: Poisson's ratio.
            density: Density [kg/m^3]; 0 for a rod without mass, which something has to hold.
            curvature: Stress-free curvature and twist [1/m] in the axes of the sections (bending about d1, d2, twist),
                (3,) or one per segment; None makes ``points`` the stress-free shape.
            inner_radius: Inner radius of an annular section [m].
            normal: Direction of the first section's axis d1; None picks one.
            section: Sections that are not round: area, shear area [m^2], second moments of area about d1 and d2,
                torsion constant [m^4], (5,) or one per segment; ``radius`` then serves contact and pictures only.
            stiffness: Factor on all stiffnesses, one or one per segment.
            rayleigh: Damping factors (mass [1/s], stiffness [s]).
            contact_pieces: Straight pieces that a bent segment is cut into for contact; many for few long segments.
            name: For messages and exports.

        Returns:
            Handle; ``Model.rod_nodes(rod)`` gives its nodes in ``Simulation.rod_x``.
        """
        label = self._new_name(name, f"rod{len(self.rods)}")
        if not (math.isfinite(youngs) and youngs > 0.0 and math.isfinite(density) and density >= 0.0):
            raise ValueError(
                f"rod {label!r}: youngs must be positive and density at least 0, got {youngs!r} and {density!r}"
            )
        if not -1.0 < nu <= 0.5:
            raise ValueError(f"rod {label!r}: Poisson's ratio must lie in (-1, 0.5], got {nu!r}")
        if len(rayleigh) != 2 or not all(math.isfinite(r) and r >= 0.0 for r in rayleigh):
            raise ValueError(f"rod {label!r}: rayleigh must be two finite factors >= 0, got {rayleigh!r}")
        try:
            geometry = meshing.rod_geometry(
                points,
                radius=radius,
                inner_radius=inner_radius,
                curvature=curvature,
                normal=normal,
                nu=nu,
                section=section,
            )
        except ValueError as error:
            raise ValueError(f"rod {label!r}: {error}") from error
        scale = np.broadcast_to(np.asarray(stiffness, dtype=np.float64), geometry.length.shape).copy()
        if not (np.isfinite(scale) & (scale > 0.0)).all():
            raise ValueError(f"rod {label!r}: stiffness factors must be positive and finite, got {stiffness!r}")
        if isinstance(contact_pieces, bool) or contact_pieces < 1:
            raise ValueError(f"rod {label!r}: contact_pieces must be an integer of at least 1, got {contact_pieces!r}")
        self.rods.append(
            RodSpec(
                name=label,
                geometry=geometry,
                youngs=float(youngs),
                nu=float(nu),
                density=float(density),
                rayleigh=(float(rayleigh[0]), float(rayleigh[1])),
                scale=scale,
                clamped=np.zeros(len(geometry.positions), dtype=bool),
                contact_pieces=int(contact_pieces),
            )
        )
        return Rod(len(self.rods) - 1)

    def attach(
        self,
        body: int,
        nodes: ArrayLike | None = None,
        to: int | None = None,
        *,
        box: Box | None = None,
        within: float | None = None,
        node: int = 0,
    ) -> IntArray:
        """Let a rigid body or a rod carry nodes of a soft body or a rod, or a whole rigid body.

        What is carried moves exactly with its carrier and gives it its mass and stiffness; nothing is added that could
        stretch. ``attach(rigid, to=rod, node=-1)`` mounts a body on a rod's end, ``attach(rod, nodes=[0], to=rigid)``
        makes a body drive a rod's base.

        Args:
            body: Soft body, rod or rigid body that is carried.
            nodes: Node indices within the soft body or rod.
            to: Rigid body or rod that carries.
            box: Corners ((x0, y0, z0), (x1, y1, z1)) [m] around the nodes, instead of ``nodes``.
            within: Distance [m] from the carrier's shape up to which nodes are attached, instead of ``nodes``.
            node: Node of a carrying rod.

        Returns:
            Indices of the attached nodes within the body.
        """
        to_rod = isinstance(to, Rod)
        if not isinstance(to, (Rod, RigidBody)):
            raise ValueError(
                f"attach: to must be a rigid body or a rod, got {to!r}; pass what add_rigid or add_rod returned"
            )
        count = len(self.rods if to_rod else self.rigids)
        if not 0 <= to < count:
            raise ValueError(f"attach: {to!r} does not exist; the builder has {count}")
        to_node = np.array([-1], dtype=np.int32)
        if to_rod:
            to_node = _rod_node(node, self.rods[to])
        if isinstance(body, RigidBody):
            if not 0 <= body < len(self.rigids):
                raise ValueError(f"attach: {body!r} does not exist; the builder has {len(self.rigids)}")
            if self.rigids[body].kinematic:
                name = self.rigids[body].name
                raise ValueError(
                    f"rigid body {name!r} is kinematic and cannot be carried; attach its carrier to it instead"
                )
            chosen = np.empty(0, dtype=np.int32)
            self.welds.append(Weld("rigid", int(body), chosen, to_rod, int(to), to_node))
            return chosen
        is_rod = isinstance(body, Rod)
        where = self.rods[body].geometry.positions if is_rod else self._soft(body).mesh.nodes
        label = f"rod {self.rods[body].name!r}" if is_rod else f"body {self._soft(body).name!r}"
        chosen = self._chosen(label, where, nodes, box, within, to)
        held = self.rods[body].clamped if is_rod else self._soft(body).fixed
        if held[chosen].any():
            first = int(chosen[held[chosen]][0])
            raise ValueError(f"{label}: node {first} is fixed and cannot be attached as well; do one of both")
        self.welds.append(Weld("rod" if is_rod else "nodes", int(body), chosen, to_rod, int(to), to_node))
        return chosen

    def _soft(self, body: int) -> BodySpec:
        is_other = isinstance(body, (bool, Handle)) and not isinstance(body, SoftBody)
        if is_other or not isinstance(body, (int, np.integer)) or not 0 <= body < len(self.bodies):
            raise ValueError(f"body {body!r} is no soft body; the builder has bodies 0 .. {len(self.bodies) - 1}")
        return self.bodies[int(body)]

    def _chosen(
        self, label: str, where: FloatArray, nodes: ArrayLike | None, box: Box | None, within: float | None, to: int
    ) -> IntArray:
        if sum(value is not None for value in (nodes, box, within)) != 1:
            raise ValueError(f"{label}: attach takes exactly one of nodes, box and within")
        if nodes is not None:
            return node_indices(nodes, len(where), f"{label}: attached nodes")
        if box is not None:
            low, high = np.asarray(box, dtype=np.float64)
            inside = ((where >= low) & (where <= high)).all(axis=1)
            if not inside.any():
                bounds = np.array2string(np.array([where.min(axis=0), where.max(axis=0)]), precision=4)
                raise ValueError(f"{label}: no node lies in box {box!r}; the body spans {bounds} m")
            return np.flatnonzero(inside).astype(np.int32)
        if isinstance(to, Rod) or self.rigids[to].shape is None:
            raise ValueError(f"{label}: within needs a rigid body with a shape to measure from; pass nodes or box")
        rigid = self.rigids[to]
        assert rigid.shape is not None
        distance = shapes.distances(rigid.shape, rigid.pose, where)
        near = np.flatnonzero(distance <= float(within or 0.0)).astype(np.int32)
        if near.size == 0:
            raise ValueError(
                f"{label}: no node lies within {within:g} m of rigid body {rigid.name!r}; the nearest is node "
                f"{int(distance.argmin())} at {distance.min():.4g} m"
            )
        return near

    def _new_name(self, name: str | None, default: str) -> str:
        label = name or default
        taken = [spec.name for group in (self.bodies, self.rigids, self.rods) for spec in group]
        if label in taken:
            raise ValueError(f"body {label!r} exists already; give every body its own name")
        return label


def as_pose(value: ArrayLike, name: str) -> FloatArray:
    """Position and unit quaternion x y z w from (3,), (7,) or a 4x4 matrix.

    Raises:
        ValueError: For another shape, numbers that are not finite, or a zero quaternion.
    """
    array = np.asarray(value, dtype=np.float64)
    if array.shape not in ((3,), (7,), (4, 4)) or not np.isfinite(array).all():
        raise ValueError(f"{name} must be 3 or 7 finite numbers or a 4x4 matrix, got {value!r}")
    if array.shape == (3,):
        return np.append(array, [0.0, 0.0, 0.0, 1.0])
    if array.shape == (4, 4):
        from scipy.spatial.transform import Rotation

        return np.concatenate([array[:3, 3], Rotation.from_matrix(array[:3, :3]).as_quat()])
    length = float(np.linalg.norm(array[3:]))
    if length < 1e-6:
        raise ValueError(f"{name}: the quaternion x y z w must not be zero, got {value!r}")
    return np.append(array[:3], array[3:] / length)


def node_indices(nodes: ArrayLike | None, count: int, name: str) -> IntArray:
    """Sorted node indices from indices (negative ones count from the end) or flags.

    Raises:
        ValueError: For an empty list, or an index that does not exist.
    """
    array = np.asarray(nodes)
    if array.dtype == bool and array.shape == (count,):
        array = np.flatnonzero(array)
    if array.size == 0 or array.ndim != 1 or not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"{name} must be a non-empty list of node indices, got {nodes!r}")
    wrong = array[(array < -count) | (array >= count)]
    if wrong.size:
        raise ValueError(f"{name}: index {int(wrong[0])} is outside {-count} .. {count - 1}")
    return np.unique(array % count).astype(np.int32)


def _rod_node(node: int, rod: RodSpec) -> IntArray:
    return node_indices([node], len(rod.geometry.positions), f"rod {rod.name!r}: node")


def _array(value: ArrayLike, shape: tuple[int, ...], name: str) -> FloatArray:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite with shape {shape}, got {value!r}")
    return array


def _free_axes(value: str | Iterable[Any], label: str) -> NDArray[np.bool_]:
    items = [value] if isinstance(value, str) else list(value)
    if len(items) == 6 and all(isinstance(item, (bool, np.bool_, int)) for item in items):
        return np.array(items, dtype=bool)
    wrong = [item for item in items if item not in AXES]
    if wrong:
        raise ValueError(f"rigid body {label!r}: free axis {wrong[0]!r} is none of {', '.join(AXES)}")
    return np.array([axis in items for axis in AXES])


def _mass_properties(
    label: str, shape: shapes.Shape | None, mass: float | None, density: float | None, inertia: ArrayLike | None
) -> tuple[float, FloatArray, FloatArray]:
    """Mass [kg], centre (3,) and inertia (3, 3) about it."""
    if (mass is None) == (density is None):
        raise ValueError(f"rigid body {label!r}: give exactly one of mass [kg] and density [kg/m^3]")
    given = mass if mass is not None else density
    if given is None or not (math.isfinite(given) and given > 0.0):
        raise ValueError(f"rigid body {label!r}: mass and density must be positive and finite, got {given!r}")
    if shape is None and (mass is None or inertia is None):
        raise ValueError(f"rigid body {label!r} has no shape: give its mass [kg] and its inertia [kg m^2]")
    value, centre, tensor = (float(given), np.zeros(3), np.zeros((3, 3)))
    if shape is not None and (inertia is None or mass is None):
        value, centre, tensor = shape.inertia(mass=mass, density=density)
    if inertia is not None:
        array = np.asarray(inertia, dtype=np.float64)
        if array.shape not in ((3,), (3, 3)) or not np.isfinite(array).all():
            raise ValueError(f"rigid body {label!r}: inertia must be finite with shape (3,) or (3, 3), got {inertia!r}")
        tensor = np.diag(array) if array.shape == (3,) else array
        if shape is not None:
            centre = shape.centre
    principal = np.linalg.eigvalsh(0.5 * (tensor + tensor.T))
    if not (principal > 0.0).all() or not np.allclose(tensor, tensor.T, rtol=1e-6):
        raise ValueError(
            f"rigid body {label!r}: the inertia must be symmetric with positive moments, got {principal} kg m^2; "
            "give the body an extent in all directions"
        )
    if principal[2] > (principal[0] + principal[1]) * (1.0 + 1e-6):
        raise ValueError(f"rigid body {label!r}: moments {principal} kg m^2 break the triangle inequality")
    return value, np.asarray(centre, dtype=np.float64), tensor


__all__ = ["PartsBuilder", "SoftBody", "as_pose", "node_indices"]
