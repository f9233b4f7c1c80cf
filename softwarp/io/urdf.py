"""Rigid robots from URDF files.

URDF (Unified Robot Description Format) is XML in SI units. A link has a frame; its inertia, its collision shapes and
its joints are placed in it by ``origin`` elements (xyz, and rpy: turns about x, then y, then z of fixed axes). A
joint's origin is the frame of the child in that of the parent at position 0. A body has one set of shapes, for contact
and pictures: those of its collision elements or, on request, of its visual ones.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from softwarp import checks, meshing, shapes
from softwarp.advice import close_to
from softwarp.io.robots import KINDS, Floats, Mimic, Robot, RobotError, RobotJoint, RobotLink, matrix

LARGEST = 2**26  # bytes of a file
MESHES = ("exact", "hull")
SHAPES_OF = ("collision", "visual")
MIMIC = ("refuse", "independent")


def read_urdf(
    path: str | Path,
    *,
    packages: Mapping[str, str | Path] | None = None,
    meshes: Literal["exact", "hull"] = "exact",
    shapes_of: Literal["collision", "visual"] = "collision",
    mimic: Literal["refuse", "independent"] = "refuse",
) -> Robot:
    """Read a robot from a URDF file; ``read_urdf(path).add_to(builder)`` adds it to a scene.

    Args:
        path: The file; of xacro files, what xacro makes of them.
        packages: Folder of every package in ``package://name/...``; others are looked for above the file.
        meshes: ``exact`` takes meshes as they are, closed; ``hull`` takes their convex hulls.
        shapes_of: Elements that give links their shapes. With ``collision``, which is what contact needs, links that
            have visual ones alone have no shape, which a warning tells; ``visual`` takes those, often finer and open.
        mimic: What becomes of joints that mimic another one, as softwarp couples none: ``independent`` makes them
            joints like all others that start where they mimic, for commands by ``AddedRobot.mimics``.

    Raises:
        FileNotFoundError: If the file, or a mesh that it names, does not exist.
        ImportError: If a mesh is a Collada file (.dae) and pycollada is missing.
        RobotError: If it is no URDF, or holds what softwarp has not: coupled and planar joints, loops.
        MeshError: If a mesh is not closed.
    """
    checks.choice(meshes, "read_urdf: meshes", MESHES)
    checks.choice(shapes_of, "read_urdf: shapes_of", SHAPES_OF)
    checks.choice(mimic, "read_urdf: mimic", MIMIC)
    file = Path(checks.path(path, "read_urdf: path"))
    if not file.is_file():
        raise FileNotFoundError(f"robot {str(file)!r} does not exist; check the path and the working directory")
    root = _xml(file)
    folders = {name: Path(folder) for name, folder in (packages or {}).items()}
    links: dict[str, RobotLink] = {}
    for element in root.findall("link"):
        link = _link(element, file, folders, meshes == "hull", shapes_of)
        if link.name in links:
            raise RobotError(f"robot {file.name!r}: two links are called {link.name!r}; rename one")
        links[link.name] = link
    joints: dict[str, RobotJoint] = {}
    for element in root.findall("joint"):
        joint = _joint(element, links, file.name, mimic == "independent")
        if joint.name in joints:
            raise RobotError(f"robot {file.name!r}: two joints are called {joint.name!r}; rename one")
        joints[joint.name] = joint
    _check_mimics(joints, file.name)
    bare = [e.get("name") for e in root.findall("link") if e.find("visual") is not None and e.find("collision") is None]
    if bare and shapes_of == "collision":
        some = ", ".join(map(str, bare[:3])) + (", ..." if len(bare) > 3 else "")
        warnings.warn(
            f"robot {file.name!r}: {len(bare)} links have visual and no collision elements ({some}): they touch "
            "nothing and no picture shows them; "
            "read_urdf(path, shapes_of='visual') takes the visual ones",
            UserWarning,
            stacklevel=2,
        )
    return Robot(root.get("name") or file.stem, links, joints, _root(links, joints, file.name))


def _xml(file: Path) -> Element:
    """The robot element. Entities, which can stand for other files or for gigabytes, are refused."""
    if file.stat().st_size > LARGEST:
        raise RobotError(f"robot {file.name!r}: the file is larger than {LARGEST // 2**20} MiB, which no URDF needs")
    try:
        text = file.read_bytes().decode("utf-8-sig")
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise RobotError(f"robot {file.name!r}: document types and entities are not read; write them out")
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, UnicodeDecodeError, RecursionError, ValueError) as error:
        if isinstance(error, RobotError):
            raise
        raise RobotError(f"robot {file.name!r}: not an XML file ({error}); write or download it again") from error
    if root.tag != "robot":
        raise RobotError(f"robot {file.name!r}: its outermost element is <{root.tag}>, and URDF has <robot>")
    if not root.findall("link"):
        raise RobotError(f"robot {file.name!r} has no link; of a xacro file pass what xacro makes of it")
    return root


def _root(links: dict[str, RobotLink], joints: dict[str, RobotJoint], name: str) -> str:
    """The link that hangs on no joint, if joints form one tree.

    Raises:
        RobotError: If they do not.
    """
    hung = [joint.child for joint in joints.values()]
    twice = next((link for link in hung if hung.count(link) > 1), None)
    if twice is not None:
        raise RobotError(f"robot {name!r}: link {twice!r} hangs on two joints; close loops with add_joint afterwards")
    roots = [link for link in links if link not in hung]
    reached, front = set(roots[:1]), roots[:1]
    while front:
        below = [joint.child for joint in joints.values() if joint.parent in front]
        front = [link for link in below if link not in reached]
        reached |= set(front)
    if len(reached) < len(links):
        apart = next(link for link in links if link not in reached)
        raise RobotError(f"robot {name!r}: link {apart!r} is not joined to the others; all links must form one tree")
    return roots[0]


def _link(element: Element, file: Path, packages: dict[str, Path], as_hull: bool, shapes_of: str) -> RobotLink:
    """A link with its inertia and shapes."""
    link = RobotLink(_name(element, "link", file.name))
    what = f"robot {file.name!r}: link {link.name!r}"
    inertial = element.find("inertial")
    if inertial is not None:
        pose = _origin(inertial, what)
        mass, inertia = inertial.find("mass"), inertial.find("inertia")
        if mass is None or inertia is None:
            raise RobotError(f"{what}: its inertial element needs mass and inertia")
        link.mass = _number(mass, "value", what, low=0.0)
        xx, yy, zz, xy, xz, yz = (
            _number(inertia, key, what, default=None if key[1] == key[2] else 0.0)
            for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        )
        R, tensor = pose[:3, :3], np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        link.centre, link.inertia = pose[:3, 3], R @ tensor @ R.T
    for part in element.findall(shapes_of):
        geometry = part.find("geometry")
        if geometry is None or len(geometry) != 1:
            raise RobotError(f"{what}: a {shapes_of} element needs one geometry")
        try:
            shape = _shape(geometry[0], what, file, packages, as_hull)
        except (ValueError, ImportError) as error:
            raise type(error)(str(error) if what in str(error) else f"{what}: {error}") from error
        link.shapes.append((shape, _origin(part, what)))
    return link


def _shape(element: Element, what: str, file: Path, packages: dict[str, Path], as_hull: bool) -> shapes.Shape:
    """The shape of one geometry element."""
    if element.tag == "box":
        x, y, z = _numbers(element, "size", 3, what)
        return shapes.Box((x, y, z))
    if element.tag == "sphere":
        return shapes.Sphere(_number(element, "radius", what))
    if element.tag in ("cylinder", "capsule"):
        kind = shapes.Cylinder if element.tag == "cylinder" else shapes.Capsule
        return kind(_number(element, "radius", what), _number(element, "length", what))
    if element.tag != "mesh":
        raise RobotError(f"{what}: shapes are box, sphere, cylinder, capsule and mesh, got {element.tag!r}")
    path = _mesh_path(element.get("filename") or "", what, file, packages)
    scale = _numbers(element, "scale", 3, what, default="1 1 1")
    surface = meshing.as_surface(path, name=path.name)
    vertices = surface.nodes * scale
    if as_hull:
        return shapes.Mesh.hull(vertices, name=path.name)
    try:
        return shapes.Mesh(vertices, surface.triangles, name=path.name)
    except meshing.MeshError as error:
        raise meshing.MeshError(f"{what}: {error}; or take its convex hull: read_urdf(path, meshes='hull')") from error


def _mesh_path(text: str, what: str, file: Path, packages: dict[str, Path]) -> Path:
    """Where a mesh lies."""
    if text.startswith("package://"):
        package, _, rest = text.removeprefix("package://").partition("/")
        folders = [packages[package]] if package in packages else []
        folders += [parent / package for parent in file.resolve().parents]
        folders += [parent for parent in file.resolve().parents if parent.name == package]
        found = next((folder / rest for folder in folders if (folder / rest).is_file()), None)
        if found is None:
            raise FileNotFoundError(
                f"{what}: mesh {text!r} is not there; name its folder with read_urdf(path, packages="
                f"{{{package!r}: folder}})"
            )
        return found
    path = file.parent / text.removeprefix("file://")
    if not path.is_file():
        raise FileNotFoundError(f"{what}: mesh {text!r} is not there; paths start at the folder of the URDF file")
    return path


def _joint(element: Element, links: dict[str, RobotLink], file: str, is_independent: bool) -> RobotJoint:
    """A joint with its limits."""
    name = _name(element, "joint", file)
    what = f"robot {file!r}: joint {name!r}"
    kind = element.get("type") or ""
    if kind not in KINDS:
        raise RobotError(f"{what}: softwarp has no {kind!r} joints; it reads {', '.join(KINDS)}")
    mimic = _mimic(element.find("mimic"), what)
    if mimic is not None and not is_independent:
        raise RobotError(
            f"{what}: mimics {mimic.joint!r} (position = {mimic.multiplier:g} * that of {mimic.joint!r} "
            f"{mimic.offset:+g}), and softwarp has no coupled joints, which share forces; "
            "read_urdf(path, mimic='independent') makes it one like all others, to be commanded along"
        )
    ends = []
    for end in ("parent", "child"):
        found = element.find(end)
        link = "" if found is None else found.get("link") or ""
        if link not in links:
            near = ", ".join(close_to(link, list(links)) or list(links)[:5])
            raise RobotError(f"{what}: its {end} {link!r} is no link; nearest: {near}")
        ends.append(link)
    axis = np.array([1.0, 0.0, 0.0])
    given = element.find("axis")
    if given is not None:
        axis = _numbers(given, "xyz", 3, what)
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        raise RobotError(f"{what}: its axis must not be zero, got {axis.tolist()}")
    limits, effort, velocity = _limits(element.find("limit"), kind, what)
    dynamics = element.find("dynamics")
    damping = 0.0 if dynamics is None else _number(dynamics, "damping", what, low=0.0, default=0.0)
    origin = _origin(element, what)
    return RobotJoint(name, kind, ends[0], ends[1], origin, axis / length, limits, effort, velocity, damping, mimic)


def _mimic(element: Element | None, what: str) -> Mimic | None:
    """What a joint mimics."""
    if element is None:
        return None
    joint = element.get("joint")
    if not joint:
        raise RobotError(f"{what}: its mimic element names no joint")
    multiplier = _number(element, "multiplier", what, default=1.0)
    return Mimic(joint, multiplier, _number(element, "offset", what, default=0.0))


def _check_mimics(joints: dict[str, RobotJoint], file: str) -> None:
    """Refuse mimicked joints that are not there, or that mimic in turn."""
    for joint in joints.values():
        if joint.mimic is None:
            continue
        what, other = f"robot {file!r}: joint {joint.name!r}", joints.get(joint.mimic.joint)
        if other is None:
            near = ", ".join(close_to(joint.mimic.joint, list(joints)) or list(joints)[:5])
            raise RobotError(f"{what}: mimics {joint.mimic.joint!r}, which is no joint; nearest: {near}")
        if other.mimic is not None:
            raise RobotError(f"{what}: mimics {other.name!r}, which mimics another joint; name {other.mimic.joint!r}")


def _limits(limit: Element | None, kind: str, what: str) -> tuple[tuple[float, float], float, float]:
    """Range, effort and velocity of a joint; a missing effort or velocity, and one of 0, is no limit."""
    ends, effort, velocity = (-math.inf, math.inf), math.inf, math.inf
    if kind in ("revolute", "prismatic"):
        if limit is None:
            raise RobotError(f"{what}: {kind} joints need a limit element; without limits make it 'continuous'")
        ends = (_number(limit, "lower", what, default=0.0), _number(limit, "upper", what, default=0.0))
        if not ends[0] < ends[1]:
            raise RobotError(f"{what}: its limits must be ordered, lower < upper, got {ends}")
    if limit is not None:
        effort = _number(limit, "effort", what, low=0.0, default=0.0) or math.inf
        velocity = _number(limit, "velocity", what, low=0.0, default=0.0) or math.inf
    return ends, effort, velocity


def _name(element: Element, kind: str, file: str) -> str:
    name = element.get("name")
    if not name:
        raise RobotError(f"robot {file!r}: a {kind} has no name")
    return name


def _origin(element: Element, what: str) -> Floats:
    """Pose of an origin element, (4, 4); the identity without one."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    angles = _numbers(origin, "rpy", 3, what, default="0 0 0")
    return matrix(_numbers(origin, "xyz", 3, what, default="0 0 0"), Rotation.from_euler("xyz", angles))


def _number(
    element: Element, key: str, what: str, *, low: float = -checks.LARGEST, default: float | None = None
) -> float:
    """One attribute as a finite number."""
    text = element.get(key)
    if text is None and default is not None:
        return default
    value = _floats(text)
    if len(value) != 1 or not value[0] >= low:
        raise RobotError(f"{what}: {key} of <{element.tag}> must be a finite number, got {checks.shown(text)}")
    return value[0]


def _numbers(element: Element, key: str, count: int, what: str, *, default: str | None = None) -> Floats:
    """One attribute as so many finite numbers."""
    text = element.get(key, default)
    value = _floats(text)
    if len(value) != count:
        raise RobotError(f"{what}: {key} of <{element.tag}> must be {count} finite numbers, got {checks.shown(text)}")
    return np.array(value)


def _floats(text: str | None) -> list[float]:
    """Numbers of a text; none if one of them is no finite number."""
    try:
        values = [float(word) for word in (text or "").split()]
    except ValueError:
        return []
    return values if all(abs(value) <= checks.LARGEST for value in values) else []
