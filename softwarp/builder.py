"""Describe a scene in Python, then ``finalize`` it into a batched model."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from softwarp import interop, meshing
from softwarp.bricks import Bricks
from softwarp.model.handles import Cavity, ContactPair, Handle, Joint, RigidBody, Rod, SoftBody
from softwarp.model.model import Model
from softwarp.plan.compile import plan
from softwarp.scene import bodies, cavities, contact, frames, joints, tractions
from softwarp.scene.cavities import ATMOSPHERE
from softwarp.scene.checks import Box, vector
from softwarp.scene.joints import Part
from softwarp.scene.materials import Material
from softwarp.scene.parts import AXES, BodySpec, FloatArray, IntArray, JointSpec, Scene
from softwarp.scene.reduction import Reduced, reduce
from softwarp.solvers.collision.overlaps import refuse_deep
from softwarp.solvers.footprint import Footprint, footprint, require_room
from softwarp.telescopes import Telescopes
from softwarp.tendons import Tendons

Precision = Literal["float32", "float64"]


class ModelBuilder(Bricks, Tendons, Telescopes):
    """Collects bodies, rods, supports, cables, markers, loads and contacts of a scene. SI units.

    Args:
        gravity: Gravity [m/s^2].

    Attributes:
        scene: What was collected so far.

    Raises:
        ValueError: From every method, for input that names no thing, lies outside its range or is not finite.
    """

    def __init__(self, gravity: Sequence[float] = (0.0, 0.0, -9.81)) -> None:
        self.scene = Scene(gravity=vector(gravity, "gravity"))

    @property
    def gravity(self) -> FloatArray:
        """Gravity [m/s^2], (3,)."""
        return self.scene.gravity

    @gravity.setter
    def gravity(self, value: Sequence[float]) -> None:
        self.scene.gravity = vector(value, "gravity")

    @property
    def bodies(self) -> list[BodySpec]:
        """Soft bodies so far, for their meshes."""
        return self.scene.bodies

    @property
    def joints(self) -> list[JointSpec]:
        """Joints so far."""
        return self.scene.joints

    def add_tets(
        self,
        nodes: ArrayLike | meshing.TetMesh | meshing.QuadraticMesh,
        tets: ArrayLike | None = None,
        *,
        material: Material,
        element: Literal["p1", "p2"] | None = None,
        density: float | None = None,
        total_mass: float | None = None,
        lumping: Literal["volume", "uniform"] = "volume",
        rayleigh: tuple[float, float] = (0.0, 0.0),
        relaxation: tuple[float, float] = (0.0, 0.0),
        stiffness: ArrayLike | None = None,
        contact_surface: Any = None,
        name: str | None = None,
    ) -> SoftBody:
        """Add a soft body of linear or quadratic tetrahedra.

        Args:
            nodes: Rest positions [m], shape (n, 3), a ``TetMesh`` (``meshing.tetrahedralize``) or a ``QuadraticMesh``.
            tets: Corners with positive volume, shape (m, 4), or the ten nodes of quadratic elements, shape (m, 10), in
                the order of ``meshing.quadratic``; omitted for a mesh.
            material: Elastic law.
            element: ``p1``, the default, has four nodes, as in SOFA, and is too stiff in bending. ``p2`` has ten: six
                more nodes, in the middles of the edges, follow those of the mesh. A ``QuadraticMesh`` is ``p2``.
            density: Density [kg/m^3]; exactly one of ``density`` and ``total_mass``, unless the material has one.
            total_mass: Mass of the body [kg].
            lumping: ``volume`` gives a node a quarter of its tets, ``uniform`` the same mass to every node. The mass of
                ``p2`` is consistent and takes ``volume`` only.
            rayleigh: Damping factors (mass [1/s], stiffness [s]).
            relaxation: Stress that decays: the stiffness of a Maxwell branch per that of the law, and its time [s].
                At rest the body is as stiff as its law, in quick motion by the ratio stiffer, and damped in between.
            stiffness: Factors of the modulus, positive: one an element, (m,), or one a Gauss point of quadratic ones,
                (m, 4). They stand for several materials, or make up for a coarse mesh; stresses that are told are the
                law's, without them.
            contact_surface: What touches, coarser or finer than the mesh: a ``SurfaceMesh``, ``trimesh.Trimesh`` or
                (points, triangles) beside its boundary, or points (k, 3) alone; None takes the boundary itself.
            name: For messages and exports.

        Returns:
            Index of the body.

        Raises:
            MeshError: If the mesh is a surface, empty, inverted, degenerate or otherwise broken. A body larger than
                2 m or smaller than 2 mm, often one in another unit, draws a warning.
        """
        options: dict[str, Any] = {"material": material, "element": element, "density": density, "name": name}
        options |= {"total_mass": total_mass, "lumping": lumping, "rayleigh": rayleigh}
        options |= {"relaxation": relaxation, "stiffness": stiffness, "contact_surface": contact_surface}
        return bodies.add_tets(self.scene, nodes, tets, **options)

    def reduce(self, body: SoftBody | int, reduction: Reduced, *, frame: str | None = None) -> None:
        """Let a soft body move in modes only, with few of its elements standing for all: ``softwarp.reduction``.

        Cables, chambers, markers, loads and contacts of the body stay as they are, and all its nodes remain in views.

        Args:
            body: From ``add_tets``. One of quadratic elements has more nodes in views, of no mass, behind its own.
            reduction: What ``reduction.train`` made of a scene with this mesh, its supports and its membranes.
            frame: Refuse a reduction of another frame than ``"floating"``, with which the body can turn by any angle,
                or ``"fixed"``; None takes the one that it was trained in.

        Raises:
            ValueError: For a reduction of another mesh or of elements of another order, modes or weights that are none,
                and a body that relaxes or is reduced already; from ``finalize``, where modes move nodes that are
                fixed, the membranes are others, or nodes are held along single axes or attached to frames.
        """
        reduce(self.scene, body, reduction, frame)

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
        return frames.add_rigid(
            self.scene,
            shape,
            mass=mass,
            density=density,
            inertia=inertia,
            pose=pose,
            kinematic=kinematic,
            free_axes=free_axes,
            velocity=velocity,
            damping=damping,
            max_speed=max_speed,
            max_spin=max_spin,
            name=name,
        )

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
        return frames.add_rod(
            self.scene,
            points,
            radius=radius,
            youngs=youngs,
            nu=nu,
            density=density,
            curvature=curvature,
            inner_radius=inner_radius,
            normal=normal,
            section=section,
            stiffness=stiffness,
            rayleigh=rayleigh,
            contact_pieces=contact_pieces,
            name=name,
        )

    def fix(self, body: int, nodes: ArrayLike | None = None, box: Box | None = None, axes: str = "xyz") -> IntArray:
        """Hold nodes of a soft body, or nodes of a rod with their sections, where they are.

        Args:
            body: From ``add_tets`` or ``add_rod``.
            nodes: Node indices within the body.
            box: Corners ((x0, y0, z0), (x1, y1, z1)) [m]; nodes inside or on it are fixed.
            axes: Axes of the world along which nodes of a soft body are held, as in ``"z"`` for a plane of symmetry.

        Returns:
            Indices of the nodes that this call fixed.
        """
        return bodies.fix(self.scene, body, nodes, box, axes)

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
        return frames.attach(self.scene, body, nodes, to, box=box, within=within, node=node)

    def add_point_load(self, body: int, nodes: ArrayLike, force: Sequence[float]) -> IntArray:
        """Add a constant dead load, shared equally by nodes.

        Args:
            body: Index from ``add_tets``.
            nodes: Node indices within the body.
            force: Total force [N].

        Returns:
            Indices of the loaded nodes within ``Simulation.node_x``, for ``control.node_force``.
        """
        return bodies.add_point_load(self.scene, body, nodes, force)

    def add_traction(
        self,
        body: int,
        traction: Sequence[float] = (0.0, 0.0, 0.0),
        *,
        box: Box | None = None,
        where: Callable[[FloatArray], ArrayLike] | None = None,
        triangles: ArrayLike | None = None,
        name: str | None = None,
    ) -> Handle:
        """Pull at boundary faces of a soft body with a dead load per area.

        The load keeps its direction in the world and counts the faces' area at rest. Nodes receive it consistently:
        those of linear faces a third each, others by their shape functions. A pressure that turns
        with a surface is that of an air chamber.

        Args:
            body: Index from ``add_tets``.
            traction: Force per area in world axes [Pa], (3,), at the start and after a reset; ``control.traction``
                changes it, world by world.
            box: Corners ((x0, y0, z0), (x1, y1, z1)) [m]; boundary faces with all corners in it or on it are loaded.
            where: Instead, a function of the middles of all boundary faces, (face, 3) [m], that returns flags (face,).
            triangles: Instead, boundary faces by their corner nodes within the body, (t, 3), in any order.
            name: For messages.

        Returns:
            Handle, index of ``control.traction`` (world, traction, 3).

        Raises:
            ValueError: For a triangle that is no boundary face or there twice, where nothing is chosen, and for a load
                that is not finite.
        """
        choice: dict[str, Any] = {"box": box, "where": where, "triangles": triangles}
        return tractions.add_traction(self.scene, body, traction, name=name, **choice)

    def add_cavity(
        self,
        body: int,
        vertices: ArrayLike | meshing.SurfaceMesh,
        triangles: ArrayLike | None = None,
        control: Literal["pressure", "volume", "gas"] = "pressure",
        *,
        min_pressure: float = -math.inf,
        max_pressure: float = math.inf,
        min_volume: float = 0.0,
        max_volume: float = math.inf,
        max_pressure_rate: float = math.inf,
        max_flow: float = math.inf,
        ambient: float = ATMOSPHERE,
        exponent: float = 1.0,
        anchored: ArrayLike = (),
        tolerance: float | None = None,
        name: str | None = None,
    ) -> Cavity:
        """Add an air chamber: a closed surface in a soft body that a pressure pushes outwards.

        Args:
            body: Soft body that carries the surface.
            vertices: Vertices at rest [m], shape (v, 3), inside or on the body, or a surface: ``solid.cavities[name]``
                of ``meshing.tetrahedralize`` fits linear and quadratic bodies. A vertex on a node moves with it alone.
                On quadratic elements pass all six nodes of a face and its four triangles, as ``surface`` of their
                linear mesh has them: the pressure on them is then that on the curved face.
            triangles: Corners, shape (t, 3), of a closed surface, outward from the air; not for a surface.
            control: ``pressure`` imposes a gauge pressure, ``volume`` a volume, ``gas`` an amount of gas, whose
                pressure follows p = ambient (gas / V)^exponent - ambient.
            min_pressure: Lower limit of the gauge pressure [Pa].
            max_pressure: Upper limit of the gauge pressure [Pa].
            min_volume: Lower limit of a commanded volume [m^3].
            max_volume: Upper limit of a commanded volume [m^3].
            max_pressure_rate: Largest change of a commanded pressure [Pa/s].
            max_flow: Largest change of a commanded volume or amount of gas [m^3/s].
            ambient: Absolute pressure outside [Pa].
            exponent: 1 for isothermal, 1.4 for adiabatic air.
            anchored: Indices of vertices that are fixed in space, as on planes of symmetry.
            tolerance: Distance [m] that a vertex may lie outside the body's faceted surface.
            name: For messages and exports.

        Returns:
            Handle, index of ``Simulation.cavity_volume`` and of the commands.

        Raises:
            MeshError: For a surface that is open, not oriented, or outside the body; the message names the place.
        """
        return cavities.add_cavity(
            self.scene,
            body,
            vertices,
            triangles,
            control,
            min_pressure=min_pressure,
            max_pressure=max_pressure,
            min_volume=min_volume,
            max_volume=max_volume,
            max_pressure_rate=max_pressure_rate,
            max_flow=max_flow,
            ambient=ambient,
            exponent=exponent,
            anchored=anchored,
            tolerance=tolerance,
            name=name,
        )

    def add_membrane(
        self,
        body: int,
        triangles: ArrayLike,
        *,
        thickness: float | ArrayLike,
        youngs: float,
        nu: float = 0.45,
        density: float = 0.0,
        name: str | None = None,
    ) -> Handle:
        """Glue a thin elastic skin to nodes of a soft body; it resists stretching, not bending.

        Args:
            body: Soft body.
            triangles: Node indices within the body, shape (t, 3).
            thickness: Thickness [m], one or one per triangle.
            youngs: Young's modulus [Pa].
            nu: Poisson's ratio.
            density: Density [kg/m^3]; 0 for a skin without mass.
            name: For messages.

        Returns:
            Handle, index of ``params.membrane_youngs``.

        Raises:
            MeshError: For a triangle without area or a thickness that is not positive.
        """
        return cavities.add_membrane(
            self.scene, body, triangles, thickness=thickness, youngs=youngs, nu=nu, density=density, name=name
        )

    def add_joint(
        self,
        parent: Part | None,
        child: Part,
        kind: Literal["hinge", "slider", "ball", "weld"] = "hinge",
        *,
        anchor: Sequence[float] | None = None,
        axis: Sequence[float] = (0.0, 0.0, 1.0),
        limits: tuple[float, float] = (-math.inf, math.inf),
        control: Literal["none", "position", "velocity", "force"] = "none",
        stiffness: float = math.inf,
        damping: float = 0.0,
        max_force: float = math.inf,
        max_rate: float = math.inf,
        name: str | None = None,
    ) -> Joint:
        """Join two rigid bodies or rod nodes, or one of them to the world, perhaps with limits and a motor.

        Positions are angles [rad] of hinges, counted over any number of turns, and ways [m] of sliders; both are 0 at
        the start and grow when the child turns about, or moves along, the axis relative to the parent. A rod node
        joins with its section. The motor of a body with ``free_axes`` is that of a joint to the world along the free
        axis, such as ``add_joint(None, cart, "slider", axis=(1, 0, 0), control="force")`` for ``free_axes="x"``.

        Args:
            parent: Rigid body, or rod and node; None is the world.
            child: Rigid body, or rod and node.
            kind: ``hinge`` turns about the axis, ``slider`` moves along it, ``ball`` turns about the anchor, ``weld``
                does neither and reports the load that it carries.
            anchor: Point of the joint at the start [m], in the world; None takes the child's origin.
            axis: Axis at the start, in the world.
            limits: Lowest and highest position, around 0.
            control: Motor of a hinge or slider: ``position`` steers to ``control.joint_target``, ``velocity`` moves at
                it, ``force`` exerts ``control.joint_force``.
            stiffness: Of a position servo, with force = stiffness (reference - position) - damping velocity +
                ``control.joint_force``; infinite for one that is where its reference is [N m/rad, N/m].
            damping: Likewise [N m s/rad, N s/m]. A spring with a damper is a position servo whose target stays 0.
            max_force: Largest force of the motor [N m, N]. A motor built without a limit has none in any world.
            max_rate: Largest speed of the servo's reference, or of a velocity command [rad/s, m/s].
            name: For messages and exports.

        Returns:
            Handle, index of ``Simulation.joint_position``, ``joint_velocity``, ``joint_force`` (of the motor) and
            ``joint_reaction`` (force and moment about the anchor on the child).

        Raises:
            ValueError: For a part that does not exist, a value outside its range, or a motor that the joint cannot
                have.
        """
        return joints.add_joint(
            self.scene,
            parent,
            child,
            kind,
            anchor=anchor,
            axis=axis,
            limits=limits,
            control=control,
            stiffness=stiffness,
            damping=damping,
            max_force=max_force,
            max_rate=max_rate,
            name=name,
        )

    def add_contact(
        self,
        a: int,
        b: int,
        mu: float = 0.0,
        *,
        restitution: float = 0.0,
        contact_distance: float = 0.0,
        alarm_distance: float | None = None,
        compliance: float = 0.0,
        name: str | None = None,
    ) -> ContactPair:
        """Let two parts touch by the laws of Signorini and Coulomb; ``a = b`` is self-contact.

        Walls of closed chambers take part in self-contact only: nothing else can reach them.

        Args:
            a: Soft body, rigid body or rod.
            b: The other part.
            mu: Friction coefficient.
            restitution: Coefficient of restitution in [0, 1].
            contact_distance: Distance at which the surfaces rest on each other [m]; SOFA's ``contactDistance``.
            alarm_distance: Distance from which they are looked at [m]; SOFA's ``alarmDistance``. None takes the contact
                distance plus 1 % of the smaller part. What moves fast is seen from farther away in any case.
            compliance: Compliance of the normal law [m/N]; 0 is hard contact.
            name: For messages.

        Returns:
            Handle; ``Simulation.contact_force(a, b)`` gives the force on a.

        Raises:
            ValueError: For a part that does not exist, a pair that exists, or a value outside its range.
        """
        return contact.add_contact(
            self.scene,
            a,
            b,
            mu,
            restitution=restitution,
            contact_distance=contact_distance,
            alarm_distance=alarm_distance,
            compliance=compliance,
            name=name,
        )

    def finalize(
        self,
        num_worlds: int = 1,
        device: str = "cpu",
        precision: Precision = "float32",
        contact_capacity: int | None = None,
    ) -> Model:
        """Check the scene, analyse its linear system and copy it to a device.

        Args:
            num_worlds: Worlds that share this scene. Kernels are chosen by their number: with 1 to 3 a world may differ
                by rounding from the same one among 4 or more, unless ``Simulation`` is told a ``solver_path``.
            device: Warp device, ``cpu`` or ``cuda:0``.
            precision: Scalar type of state and solver; ``float64`` is for validation.
            contact_capacity: Contacts that a world can hold; None takes 16 per pair of rigid bodies and 48 per other
                pair, or fewer where fewer can exist. A world that needs more reports ``CONTACT_OVERFLOW``.

        Raises:
            MemoryError: If the worlds do not fit on the device; the message tells how many do.
        """
        model = plan(self.scene, num_worlds, device, precision, contact_capacity)
        require_room(model, reclaim=interop.empty_cache)
        if model.contact is not None:
            poses = np.empty((0, 7)) if model.frames is None else model.frames.rest_pose
            refuse_deep(model.contact.scene, model.contact.topology, model.node_rest, poses)
        return model

    def memory_estimate(
        self,
        num_worlds: int = 1,
        device: str = "cpu",
        precision: Precision = "float32",
        contact_capacity: int | None = None,
    ) -> Footprint:
        """Memory that a ``Simulation`` of so many worlds takes, and what is free, without allocating it.

        Args:
            num_worlds: As for ``finalize``.
            device: Likewise.
            precision: Likewise.
            contact_capacity: Likewise.
        """
        return footprint(plan(self.scene, num_worlds, device, precision, contact_capacity))
