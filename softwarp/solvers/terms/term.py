"""What a term is: one effect in the linear system, with the stages that a step walks through."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from softwarp.solvers.linear.cholesky import LinearSolver
from softwarp.solvers.response import ContactResponse
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


@dataclass(frozen=True)
class Pace:
    """What a stage does of the commands of the step that it is part of; all of them where it is the whole step.

    How much of the way to a commanded displacement, volume or pose a stage leaves to later ones is an array, ``lag``
    of the workspace, because it differs between worlds.

    Attributes:
        lapse: Time [s] in which pressures and references that have a rate move.
        ahead: Time [s] by which commanded velocities carry the poses at which bodies are held.
        look: Time [s] in which contacts are expected.
    """

    lapse: float
    ahead: float
    look: float


class Term:
    """One effect. Every stage does nothing here; a term overrides those it has a part in.

    A term stands on its shard alone: it reads the model, inputs and workspace arrays, and writes workspace arrays and,
    at the end, the state. ``System`` walks its terms in their order at every stage, so that a term may read what those
    before it wrote in the same stage.

    Args:
        shard: Worlds, inputs and workspace.

    Attributes:
        follows_paths: Whether ``solve_static`` follows a path with it.
        has_exact_tangent: Whether its exact tangent and the laws of its rows are known, so that paths can be followed
            and equilibria have gradients.
        corrections: Passes of a linear solve before which ``correct`` has something to do.
        unbounded: Static rows that obey no bounds and are eliminated.
        refreshes: Whether ``refresh`` writes outputs.
        responds: Whether its rows have compliance or no bounds, or are contacts, which ``ContactResponse`` solves.
    """

    follows_paths: bool = False
    has_exact_tangent: bool = False
    corrections: int = 0
    refreshes: bool = False
    responds: bool = False

    def __init__(self, shard: Shard) -> None:
        self.shard = shard

    @property
    def unbounded(self) -> Sequence[int]:
        """Static rows without bounds; none."""
        return ()

    # The start of a step

    def load(self) -> None:
        """Start values and warm starts from the state; flags for commands that are not finite."""

    def start_over(self) -> None:
        """Copy positions and velocities of the start of the step to the workspace anew."""

    def scale(self, h: float) -> None:
        """Factors of the bodies' M and K; ``h`` = 0 [s] selects the quasi-static mode."""

    # Rows

    def measure(self) -> None:
        """Displacements and gradients of rows at the trial positions."""

    def command(self, h: float, pace: Pace) -> None:
        """Targets, bounds and compliances of rows, and prescribed velocities, from commands and limits."""

    def law(self) -> None:
        """Laws of rows at the present displacements; needs ``measure``."""

    def predict(self, h: float) -> None:
        """Gaps of rows that look ahead with the velocities of the start; needs ``measure``."""

    def find(self, h: float, look: float, *, moving: bool, falling: bool, keeps: bool = False) -> None:
        """Contacts at the trial positions.

        Args:
            h: Step [s].
            look: Time in which bodies come nearer with their velocities [s].
            moving: Velocities were found in this step already; gaps refer to its start.
            falling: Let gravity bring bodies nearer as well.
            keeps: Contacts that pressed in earlier iterates of the step stay.
        """

    # The linear system

    def forces(self) -> None:
        """Forces of elements, and of frames, at the trial positions."""

    def weigh(self) -> None:
        """External forces of nodes besides loads and the weight of their lumped mass, after the sums over elements."""

    def tangent(self, h: float) -> None:
        """Add to A; needs ``forces``. A holds the lumped mass already; ``h`` is that of ``scale``."""

    def lean(self) -> None:
        """Velocities that forces are found with, where they are not those of the nodes; see ``Shard.felt``."""

    def slot_velocities(self) -> None:
        """Velocities of all that carries elements, where velocities were found in this step."""

    def right_hand_side(self, f_scale: float, inertia: bool, moving: bool) -> None:
        """Add to b, or to the forces of frames that b takes later; needs ``tangent``.

        Args:
            f_scale: Factor of forces: the step [s], or 1 in statics.
            inertia: Whether momentum counts.
            moving: Whether velocities were found in this step already.
        """

    def load_tangent(self, h: float) -> None:
        """Add the tangent of loads to A; after b, because damping is proportional to the stiffness of elements only."""

    def stiffen(self) -> None:
        """Add to A the symmetric part of what a step's tangent leaves out; for exact workspaces."""

    def turn(self, a_upper: Rows) -> None:
        """Add the other part to A, and transposed to ``a_upper``; for exact workspaces."""

    def sides(self, y: Rows) -> None:
        """Rows of H, transposed, among the right-hand sides, besides those that sum points."""

    def correct(self, h: float) -> None:
        """Gaps and right-hand side anew at the unknowns of the last pass of a linear solve.

        Trial positions may be those where that pass led to.
        """

    def measure_way(self, h: float, part: float) -> None:
        """How much of their way ``restrain`` would let worlds go, into ``share_of_way``."""

    def restrain(self, h: float, part: float) -> None:
        """Shorten the unknowns of a linearisation in worlds that they lead farther than it holds, or a part of that."""

    def norms(self, f_scale: float) -> None:
        """Add the size of the forces that should balance to ``norm``."""

    def rotation_step(self, x_scale: float) -> None:
        """Make changes of rotation in ``u`` changes of angular velocity at the present velocities."""

    def move(self, x_scale: float) -> None:
        """Trial poses, and what frames carry, after x_scale times the velocities."""

    # The end of a step

    def peek(self, x_scale: float) -> None:
        """The same for contacts alone, which look where a step leads to: what they do not see may stay behind."""
        self.move(x_scale)

    def arrive(self, x_scale: float) -> None:
        """The same at the end of a step, before ``release``."""
        self.move(x_scale)

    def release(self, h: float, linear: LinearSolver, response: ContactResponse | None) -> None:
        """Take from the velocities what belongs to positions only, once these are found."""

    def commit(self, h: float) -> None:
        """Velocities at the end of the step."""

    def check(self, h: float) -> None:
        """Outputs at the end of the step, and flags for what is not finite or went too far."""

    def write(self) -> None:
        """Good worlds into the state; all flags are up."""

    def refresh(self) -> None:
        """Outputs into the state, where positions were written by hand; after ``load`` and ``measure``."""


def load_factor(h: float) -> float:
    """Factor in A of the tangent of forces without damping: h^2 in a step [s^2], 1 in statics."""
    return h * h if h > 0.0 else 1.0
