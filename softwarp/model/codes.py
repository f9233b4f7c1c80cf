"""Numbers that more than one layer must agree on: result codes, kinds, columns of tables, what stands for no bound.

Plans write them into arrays, kernels compare with them, and solvers count with them. What one file alone means by a
number is written in that file.
"""

from __future__ import annotations

from enum import IntEnum

from softwarp.shapes.base import Kind

# Values that stand for no bound, in the unit of what they bound
UNBOUNDED = 1.0e30  # of parameters: infinity in float32, so that no kernel computes inf - inf
FAR = 1.0e15  # of lengths and of what is squared: no limit, nothing found; its square is finite in float32
FAR_FROM = 1.0e14  # numbers from here on stand for ``FAR``
ENDLESS = 1.0e16  # m, extent of a plane and penetration limit of what has none; more than ``FAR``

CHUNK_ROWS = 128  # of modes, that reduced bodies sum up at once: what they need lies in a processor's nearer caches

SHORTEST = 1.0e-12  # m, least length: keeps the direction of a collapsed segment finite


class Status(IntEnum):
    """Result code of a world's last step: 0 and remarks below it are good, and above it the worse the higher."""

    INVERTED = -1  # a remark: elements are inside out
    OK = 0
    MAX_ITERATIONS = 1  # kept, but Newton stopped above its tolerance
    CONTACT_OVERFLOW = 2  # kept, but contacts found no place
    NONFINITE = 3  # rolled back to the state before the step
    DIVERGED = 4  # rolled back: a node moved farther in one step than its scene allows
    TOO_FAR = 5  # rolled back: a part is farther from the origin than its precision resolves; model.resolution

    @property
    def failed(self) -> bool:
        """Whether the step was rolled back."""
        return self >= Status.NONFINITE


class StaticReason(IntEnum):
    """Why a static solve let go of a world; the first two are equilibria."""

    CONVERGED = 0  # within the tolerance
    ROUNDING = 1  # at rest up to what rounding moves it, above a tolerance that this precision does not resolve
    ITERATION_LIMIT = 2  # still on its way: more iterations may bring it there
    TIME_LIMIT = 3  # likewise, but for time
    NO_EQUILIBRIUM = 4  # the branch of equilibria ended, or iterates come no nearer: ask for less, or step through time
    NOT_FINITE = 5  # every way on fails: loads, commands or parameters are not finite, or tear the scene apart
    CONTACT_OVERFLOW = 6  # contacts found no place, so that bodies may lie in each other: raise the capacity

    @property
    def is_equilibrium(self) -> bool:
        """Whether the world is where loads and commands balance."""
        return self <= StaticReason.ROUNDING


class Outcome(IntEnum):
    """How a world's target fares."""

    REACHED = 0  # the commands lead to it
    MOVING = 1  # on the way as fast as rates or ``max_step`` allow
    UNREACHABLE = 2  # within its bounds the robot comes no nearer than it is told to
    CONFLICT = 3  # no effort within bounds keeps displacements within theirs; nearest ones commanded
    FAILED = 4  # not solved, not finite, or too many contacts near; actuators stay where they are


class Excess(IntEnum):
    """Second flag of a world within a step: what of it went too far; the larger one counts."""

    NOTHING = 0
    PLACE = 1  # a part, from the origin
    WAY = 2  # a part, in one step


# Elements
TURNED = ("large", "warped")  # laws that keep turned gradients for their stiffness


# Frames
class Side(IntEnum):
    """What stands on one side of a block of A with a quadratic element that frames carry nodes of."""

    NODE = 0  # a free node
    TRANSLATION = 1  # of a frame
    ROTATION = 2


class Spin(IntEnum):
    """How a master moves on with its momentum: not at all, as a frame alone, as a compound, as a free top."""

    AS_SOLVED = 0
    KEEP_SPIN = 1
    KEEP_MOMENTUM = 2
    FREE_TOP = 3


ROW_ITEMS = ("cable", "cavity", "joint row")  # what brings multiplier rows besides contacts, in their order


# Joints
JOINT_KINDS = ("hinge", "slider", "ball", "weld")  # in files by these names


class JointCoordinate(IntEnum):
    """What of a joint is free."""

    NOTHING = 0
    ANGLE = 1
    WAY = 2


class JointRow(IntEnum):
    """What a row of a joint holds."""

    POINT = 0  # anchors that meet, along an axis of the world
    SIDE = 1  # the same along an axis of the parent
    TILT = 2  # axes that stay parallel
    LOCK = 3  # all axes that stay equal
    FREE = 4  # motor and limits of the free coordinate


class JointControl(IntEnum):
    """What a joint's motor is told."""

    NONE = 0
    POSITION = 1
    VELOCITY = 2
    FORCE = 3


JOINT_CONTROLS = tuple(control.name.lower() for control in JointControl)
RIGID_SERVO = 1.0e29  # stiffness from which a servo is rigid: its reference starts at the measured position


# Air chambers
class CavityControl(IntEnum):
    """What of a chamber is told."""

    PRESSURE = 0
    VOLUME = 1
    GAS = 2


CAVITY_CONTROLS = tuple(control.name.lower() for control in CavityControl)


# Contact
SLOTS = 24  # dofs that one contact can touch: an edge (8) and a face (12) of embedded surfaces, frames on both sides
USUAL_SLOTS = 10  # without embedded surfaces: a rod segment (4) against a face with carried corners (at most 6)
WORLD = -1  # frame of what does not move
SUM_OF_POINTS = -2  # frame of an object whose box is that of its points
CORNER, EDGE, FACE, FLAT = 1, 2, 4, 8  # which part of a target was nearest, as bits; FLAT: the edge runs parallel to it
BALL_RANKS = 5  # contacts of a ball with a surface that is not convex: a floor below it and walls on all sides


class Carrier(IntEnum):
    """What carries a point."""

    NODE = 0
    FRAME = 1
    RIM = 2  # a frame, with the point on a circle around its place


class Target(IntEnum):
    """What a feature can touch: a shape on a frame, the triangles of a soft body, the segments of a rod."""

    PLANE = Kind.PLANE
    SPHERE = Kind.SPHERE
    CAPSULE = Kind.CAPSULE
    BOX = Kind.BOX
    CYLINDER = Kind.CYLINDER
    MESH = Kind.MESH
    GRID = Kind.GRID
    SOFT = 7
    CHAIN = 8
    POINTS = 9  # of a soft body, which touch but cannot be touched between them


URGENCIES = 3  # of a hit: touches, may touch within the step, waits in reserve


class CoupleColumn(IntEnum):
    """Columns of ``couple``: a set of features against one target."""

    OBJECT_A = 0
    OBJECT_B = 1
    TARGET = 2
    PAIR = 3
    EDGES = 4
    MASK = 5
    WIDTH = 6
    FIRST = 7
    KEY = 8
    SELF = 9
    CHOICE = 10  # row of the target's choice, -1 for none
    CHOICES = 11  # targets of which the choice is one, the first of which is TARGET
    PATIENT = 12  # whether touches within the slack alone wait until the step brings them about
    TRACKED = 13  # whether features remember how far they were from the target


# Panels of the factorisation on a GPU
PANEL_IDENTITY = -2  # source of an item on the diagonal of the inverse
PANEL_FIRST_STEP = 256  # by which the first step of an item is multiplied
PANEL_UPDATE = 65536  # added to the steps of an item that belongs to no column


# Inverse control
class EffectorKind(IntEnum):
    """What a target fixes."""

    POINT = 0
    ORIENTATION = 1


class RowLabel(IntEnum):
    """Which inequality of a static row holds with equality."""

    FREE = 0
    LOW = 1
    HIGH = 2


class ContactLabel(IntEnum):
    """What a contact does."""

    OPEN = 0
    STICK = 1
    SLIDE = 2
