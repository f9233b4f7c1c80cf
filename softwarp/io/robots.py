"""Trees of rigid links, as files describe robots, and how they become bodies and joints of a scene.

``softwarp.io.urdf`` reads them. Links become rigid bodies; joints become welds, hinges and sliders.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from softwarp import checks, shapes
from softwarp.advice import close_to
from softwarp.builder import ModelBuilder
from softwarp.model.handles import Joint, RigidBody
from softwarp.scene.checks import as_pose

Floats = NDArray[np.float64]

KINDS = {"fixed": "weld", "revolute": "hinge", "continuous": "hinge", "prismatic": "slider", "floating": ""}


class RobotError(ValueError):
    """A robot description that cannot be used; the message names the file, the element and the remedy."""


@dataclass
class RobotLink:
    """A link.

    Attributes:
        name: Its name.
        mass: Mass [kg]; 0 without an ``inertial`` element.
        centre: Centre of mass in the link's frame [m], shape (3,).
        inertia: Inertia about it in the axes of the link's frame [kg m^2], shape (3, 3).
        shapes: Collision shapes with their poses in the link's frame, (4, 4).
    """

    name: str
    mass: float = 0.0
    centre: Floats = field(default_factory=lambda: np.zeros(3))
    inertia: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    shapes: list[tuple[shapes.Shape, Floats]] = field(default_factory=list)


@dataclass(frozen=True)
class Mimic:
    """How a joint of the file follows another one: position = multiplier * position of the other + offset.

    Attributes:
        joint: Name of the other one.
        multiplier: Of positions.
        offset: [rad, m].
    """

    joint: str
    multiplier: float
    offset: float

    def position(self, other: float) -> float:
        """Where the other one's position puts the joint [rad, m], both in the file's terms."""
        return self.multiplier * other + self.offset


@dataclass(frozen=True)
class RobotJoint:
    """A joint.

    Attributes:
        name: Its name.
        kind: Of the file: fixed, revolute, continuous, prismatic or floating.
        parent: Name of the link it hangs on.
        child: Name of the link that it moves.
        origin: Frame of the child in that of the parent at position 0, shape (4, 4).
        axis: In the frame of the child, of length 1, shape (3,).
        limits: Lowest and highest position [rad, m].
        effort: Largest force of its motor [N m, N].
        velocity: Largest speed [rad/s, m/s].
        damping: Viscous friction [N m s/rad, N s/m].
        mimic: What it should follow; None for a joint of its own.
    """

    name: str
    kind: str
    parent: str
    child: str
    origin: Floats
    axis: Floats
    limits: tuple[float, float]
    effort: float
    velocity: float
    damping: float
    mimic: Mimic | None = None


@dataclass(frozen=True)
class AddedRobot:
    """What a robot has become in a scene.

    Attributes:
        links: Rigid body of every link; links without a mass share that of the link they are fixed to.
        joints: Joint of every moving or welded joint.
        start: Position of every joint in the file's terms at which the scene's position is 0.
        mimics: Joints that should follow another one, which nothing but their commands makes them do.
    """

    links: dict[str, RigidBody]
    joints: dict[str, Joint]
    start: dict[str, float]
    mimics: dict[str, Mimic] = field(default_factory=dict)


@dataclass(frozen=True)
class Robot:
    """A robot as its file describes it.

    Attributes:
        name: Of the robot.
        links: Its links, by name.
        joints: Its joints, by name; they form a tree.
        root: Name of the link that hangs on no joint.
    """

    name: str
    links: dict[str, RobotLink]
    joints: dict[str, RobotJoint]
    root: str

    def add_to(
        self,
        builder: ModelBuilder,
        *,
        pose: ArrayLike = (0.0, 0.0, 0.0),
        base: Literal["fixed", "free"] = "fixed",
        positions: Mapping[str, float] | None = None,
        control: Literal["none", "position", "velocity", "force"] = "none",
        stiffness: float = math.inf,
        damping: float = 0.0,
        prefix: str = "",
    ) -> AddedRobot:
        """Add the robot to a scene; its parts touch nothing until ``add_contact`` says so.

        Args:
            builder: The scene.
            pose: Of the root link: position [m], (3,), with a quaternion x y z w, (7,), or a 4x4 matrix.
            base: ``fixed`` makes the root link kinematic, so that it stays or follows ``control.body_pose``; ``free``
                lets it move.
            positions: Where joints are at the start [rad, m]; others are at 0 or where they mimic, or at their limit
                next to it.
            control: Motor of all moving joints, with the file's effort and velocity as limits. With ``none`` a joint
                with damping becomes a damper, and its velocity limit is left out.
            stiffness: Of position servos [N m/rad, N/m].
            damping: Likewise [N m s/rad, N s/m]; the file's damping is added where the stiffness is finite.
            prefix: Set before the names of links and joints, for several robots of one kind.

        Raises:
            RobotError: If a moving link has no mass, or a position names no joint or lies outside its limits.
            ValueError: If the builder refuses a value.
        """
        start = self._start(positions or {})
        poses = self._poses(as_pose(pose, f"robot {self.name!r}: pose"), start)
        carrier, bodies = self._merged()
        links: dict[str, RigidBody] = {}
        for name, link in bodies.items():
            links[name] = self._add_link(builder, link, poses[name], prefix, name == carrier[self.root], base)
        joints = {}
        for joint in self.joints.values():
            first, second = carrier[joint.parent], carrier[joint.child]
            if first == second or joint.kind == "floating":
                continue
            frame = poses[joint.child]
            joints[joint.name] = builder.add_joint(
                links[first],
                links[second],
                KINDS[joint.kind],  # type: ignore[arg-type]
                anchor=frame[:3, 3].tolist(),
                axis=(frame[:3, :3] @ joint.axis).tolist(),
                name=prefix + joint.name,
                **_motor(joint, start[joint.name], control, stiffness, damping),
            )
        moving = {name: value for name, value in start.items() if name in joints and self.joints[name].kind != "fixed"}
        mimics = {name: joint.mimic for name, joint in self.joints.items() if joint.mimic is not None}
        return AddedRobot({name: links[carrier[name]] for name in self.links}, joints, moving, mimics)

    def _start(self, positions: Mapping[str, float]) -> dict[str, float]:
        """Position of every joint at the start, checked."""
        unknown = [name for name in positions if name not in self.joints]
        if unknown:
            near = ", ".join(close_to(unknown[0], list(self.joints)) or self.joints)
            raise RobotError(f"robot {self.name!r} has no joint {unknown[0]!r}; nearest: {near}")
        start: dict[str, float] = {}
        own = [joint for joint in self.joints.values() if joint.mimic is None]
        for joint in (*own, *(joint for joint in self.joints.values() if joint.mimic is not None)):
            name, (low, high) = joint.name, joint.limits
            wanted = 0.0 if joint.mimic is None else joint.mimic.position(start[joint.mimic.joint])
            value = checks.number(positions.get(name, min(max(wanted, low), high)), f"joint {name!r}: position")
            if not low <= value <= high:
                raise RobotError(f"joint {name!r}: position {value:g} lies outside its limits [{low:g}, {high:g}]")
            start[name] = value
        return start

    def _poses(self, root: Floats, start: dict[str, float]) -> dict[str, Floats]:
        """Frame of every link in the world, (4, 4), parents before children."""
        poses = {self.root: matrix(root[:3], Rotation.from_quat(root[3:]))}
        waiting = list(self.joints.values())
        while waiting:
            ready = [joint for joint in waiting if joint.parent in poses]
            for joint in ready:
                step = start[joint.name] * joint.axis
                move = matrix(step, Rotation.identity())
                if KINDS[joint.kind] == "hinge":
                    move = matrix(np.zeros(3), Rotation.from_rotvec(step))
                poses[joint.child] = poses[joint.parent] @ joint.origin @ move
            waiting = [joint for joint in waiting if joint.parent not in poses or joint.child not in poses]
        return poses

    def _merged(self) -> tuple[dict[str, str], dict[str, RobotLink]]:
        """Which link stands for each one, and these links: one of two that are fixed together may lack a mass."""
        place = {name: (name, np.eye(4)) for name in self.links}
        bodies = {name: RobotLink(name, k.mass, k.centre, k.inertia, list(k.shapes)) for name, k in self.links.items()}
        for joint in _from_root(self.root, self.joints):
            if joint.kind != "fixed":
                continue
            (owner, frame), child = place[joint.parent], bodies[joint.child]
            if child.mass > 0.0 and bodies[owner].mass > 0.0:
                continue
            where = frame @ joint.origin
            if child.mass > 0.0:
                R = where[:3, :3]
                bodies[owner].mass, bodies[owner].inertia = child.mass, R @ child.inertia @ R.T
                bodies[owner].centre = where[:3, 3] + R @ child.centre
            bodies[owner].shapes += [(shape, where @ pose) for shape, pose in child.shapes]
            place[joint.child] = (owner, where)
            del bodies[joint.child]
        return {name: owner for name, (owner, _) in place.items()}, bodies

    def _add_link(
        self, builder: ModelBuilder, link: RobotLink, pose: Floats, prefix: str, is_root: bool, base: str
    ) -> RigidBody:
        """One rigid body in the frame of its link."""
        checks.choice(base, f"robot {self.name!r}: base", ("fixed", "free"))
        shape = shapes.Compound([(shape, where) for shape, where in link.shapes]) if link.shapes else None
        if is_root and base == "fixed":
            return builder.add_rigid(shape, pose=pose, kinematic=True, name=prefix + link.name)
        if link.mass <= 0.0:
            raise RobotError(
                f"link {link.name!r} moves and has no mass; give it an inertial element with mass [kg] and inertia "
                f"[kg m^2], or fix it to a link that has one"
            )
        body = builder.add_rigid(shape, mass=link.mass, inertia=link.inertia, pose=pose, name=prefix + link.name)
        builder.scene.rigids[body].centre = link.centre.copy()  # the file's, which need not be that of the shape
        return body


def _from_root(root: str, joints: dict[str, RobotJoint]) -> list[RobotJoint]:
    """Joints, parents before children."""
    result: list[RobotJoint] = []
    front = [root]
    while front:
        link = front.pop()
        below = [joint for joint in joints.values() if joint.parent == link]
        result += below
        front += [joint.child for joint in below]
    return result


def _motor(joint: RobotJoint, start: float, control: str, stiffness: float, damping: float) -> dict[str, Any]:
    """Limits and motor of a joint for ``add_joint``."""
    if joint.kind == "fixed":
        return {}
    limits = (joint.limits[0] - start, joint.limits[1] - start)
    if control == "none":
        passive = {"control": "position", "stiffness": 0.0, "damping": joint.damping} if joint.damping > 0.0 else {}
        return {"limits": limits} | passive
    motor: dict[str, Any] = {"limits": limits, "control": control, "max_force": joint.effort}
    if control != "force":
        motor["max_rate"] = joint.velocity
    if control == "position":
        motor["stiffness"] = stiffness
        motor["damping"] = damping + (joint.damping if math.isfinite(stiffness) else 0.0)
    return motor


def matrix(position: Floats, turn: Rotation) -> Floats:
    """Pose as a 4x4 matrix."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.as_matrix(), position
    return pose
